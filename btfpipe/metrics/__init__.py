"""Errors of pictures and BTFs, each with its formula and unit."""
