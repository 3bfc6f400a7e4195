"""Growing a sample over a domain: the result is always a map of coordinates into the sample."""

from btfpipe.synthesis.coordinate_map import CoordinateMap

__all__ = ["CoordinateMap"]
