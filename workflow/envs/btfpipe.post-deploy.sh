#!/usr/bin/env bash
# Installs the checkout that Snakemake was started in.
set -euo pipefail
python -m pip install --constraint constraints.txt .
