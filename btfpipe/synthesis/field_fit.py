"""Whether a surface's field suits a material that runs in one direction."""

import math

from btfpipe.analysis.direction import dominant_direction
from btfpipe.surface.curl import summed_curl

_ONE_DIRECTION = 0.5  # share of the change from which on a material has a direction to follow
_FAR_BETTER, _WORTH_IT = 2.0, 5.0  # times fewer dislocations, and so many fewer, are worth a word


def judge_field(features, level, texels_per_unit, turn=0.0):
    """Say how many dislocations a material will have, and if a quarter turn would be far better.

    The material is taken for evenly spaced stripes of its strongest wave; see
    `btfpipe.surface.curl`.

    Parameters
    ----------
    features : Features
    level : btfpipe.surface.Level
        The finest.
    texels_per_unit : float
    turn : float
        Angle of the sample's s axis against the field, radians.

    Returns
    -------
    facts : dict
        ``one_directional``, from 0 to 1; of a material that is, ``period_texels`` of its stripes,
        about how many ``dislocations`` they will have, and ``dislocations_turned_90`` with the
        field turned by a quarter.
    warnings : list of str
    """
    material = dominant_direction(features.levels[0], features.toroidal)
    facts = {"one_directional": material.share}
    if material.share < _ONE_DIRECTION:
        return facts, []
    here, turned = (
        summed_curl(level, turn + material.angle + quarter) * texels_per_unit / material.period
        for quarter in (0.0, math.pi / 2)
    )
    facts |= {
        "period_texels": material.period,
        "dislocations": here,
        "dislocations_turned_90": turned,
    }
    if here < _FAR_BETTER * turned or here - turned < _WORTH_IT:
        return facts, []
    return facts, [
        "the material runs in one direction, and along this field its pattern would break in about"
        f" {here:.0f} places; turned by 90 degrees, in about {turned:.0f}. Pass --turn-deg"
        f" {_quarter_more(turn)} here, give the surface another field with `btfpipe surface"
        " --turn-deg`, or draw strokes for it (`btfpipe surface --field`)"
    ]


def _quarter_more(turn):
    """The angle a quarter turn on, in degrees, short of a half turn."""
    degrees = math.degrees(turn) + 90
    return f"{degrees - 180 if degrees > 90 + 1e-9 else degrees:.6g}"
