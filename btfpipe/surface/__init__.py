"""Meshes prepared for synthesis."""

from btfpipe.surface.surface import Level, Surface

__all__ = ["Level", "Surface"]
