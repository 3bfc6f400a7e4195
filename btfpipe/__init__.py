"""Dress surfaces in measured or simulated bidirectional texture functions."""

__version__ = "0.1.0"
