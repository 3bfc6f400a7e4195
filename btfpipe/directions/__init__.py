"""Directions on the hemisphere: measured sets, and interpolation between them.

A direction is a unit vector (s, t, n) pointing away from the surface; theta is its angle from n, phi
its azimuth from s towards t. Radians, except in names that end in ``_deg``.
"""

from btfpipe.directions.interpolation import Hemisphere
from btfpipe.directions.sets import bonn81, from_angles, nearest, to_angles, ubo2014

__all__ = ["Hemisphere", "bonn81", "from_angles", "nearest", "to_angles", "ubo2014"]
