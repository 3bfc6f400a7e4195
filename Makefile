# `make sample` and `make test` set up everything they need in .venv; other targets likewise.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
CORES ?= all
SNAKEMAKE := $(BIN)/snakemake --cores $(CORES)

export PATH := $(abspath $(BIN)):$(PATH)

.PHONY: all setup sample gallery formats data-sample test test-slow fuzz mutants bench peers lint fix clean

all: lint test

setup: $(READY)

# What is installed is compiled by all processors: pip takes one.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"btfpipe needs Python 3.11 or newer; {sys.executable} is {v[0]}.{v[1]}. Pass PYTHON=... to make.")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt --editable ".[test,lint]"
	-@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib
	@touch $@

# The main job: every stage on data-sample/, pictures and a report in results/.
sample: $(READY)
	$(SNAKEMAKE) --configfile config/sample.yaml
	@$(SNAKEMAKE) --configfile config/sample.yaml --report results/sample/report.html --quiet all
	@echo "Pictures: results/sample/pictures/  Report: results/sample/report.html  Fidelity: results/sample/fidelity.md"

# The same materials, larger surfaces and pictures.
gallery: $(READY)
	$(SNAKEMAKE) --configfile config/gallery.yaml

# A simulated material written in every format, read back, and laid side by side.
formats: $(READY)
	$(SNAKEMAKE) --configfile config/formats.yaml
	@echo "Side by side: results/formats/formats/weave.png  Errors: results/formats/formats/weave.md"

# Remake the simulated materials and the meshes in data-sample/.
data-sample: $(READY)
	$(BIN)/python data-sample/make_meshes.py
	$(BIN)/btfpipe simulate data-sample/weave.yaml -o data-sample/weave.zip --force
	$(BIN)/btfpipe simulate data-sample/cords.yaml -o data-sample/cords.zip --force

# Files of tests side by side: WORKERS of them at a time, each file by one process.
WORKERS ?= auto
PARALLEL = -n $(WORKERS) --dist loadfile --no-loadscope-reorder

test: $(READY)
	$(BIN)/python -m pytest -m "not slow" $(PARALLEL)

test-slow: $(READY)
	$(BIN)/python -m pytest

# The property-based tests on examples that nobody tried before, ROUNDS times.
ROUNDS ?= 20
fuzz: $(READY)
	for round in $$(seq $(ROUNDS)); do HYPOTHESIS_PROFILE=other $(BIN)/python -m pytest -q -m hypothesis || exit 1; done

# Changes of one line each, on a copy of the package, of which every one must make the tests named for it fail. ONLY: words of names or files.
ONLY ?=
mutants: $(READY)
	$(BIN)/python tests/mutants/mutants.py $(ONLY)

# Peers that the benchmarks time themselves against are installed here only.
bench: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[bench,peers,test,lint]"
	$(BIN)/python -m pytest benchmarks --benchmark-enable -s -q

# Pictures and meshes beside those of other programs, which are installed here only.
peers: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[peers,test,lint]"
	$(BIN)/python -m pytest -m peer -s -q

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell README.md DESIGN.md CHANGELOG.md config data-sample/README.md btfpipe workflow tests
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/snakemake --lint --configfile config/sample.yaml

fix: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow
	$(BIN)/python workflow/scripts/config_readme.py

clean:
	rm -rf results gallery logs .snakemake .benchmarks .pytest_cache .ruff_cache
