"""Procedural height fields, each periodic over its tile.

A function takes the places of the grid as fractions (t, s) of the tile, the tile's size in mm, a Generator and the
parameters of the specification, and returns a Relief. Every structure has named parts, to which the specification gives
materials.
"""

from dataclasses import dataclass

import numpy as np

from btfpipe.errors import InputError
from btfpipe.simulation.noise import cellular, fractal_noise, scattered, smooth_noise, smoothstep


@dataclass
class Relief:
    """A height field with what its materials need.

    Attributes
    ----------
    height : (a, b) array
        Millimetres above any level.
    part : (a, b) int array
        Index into `parts`.
    element : (a, b) int array
        Thread, stone, hole: what draws one colour of a palette.
    fibre : (a, b) array
        Fine pattern of -1 to 1 that `streaks` of a material turns into albedo.
    parts : tuple of str
    """

    height: np.ndarray
    part: np.ndarray
    element: np.ndarray
    fibre: np.ndarray
    parts: tuple


def bumps(t, s, size, rng, *, count, height_mm, radius, irregularity):
    """Rounded bumps on a flat ground."""
    return _mounds(t, s, size, rng, count, height_mm, radius, irregularity, ("ground", "bump"), 1)


def holes(t, s, size, rng, *, count, depth_mm, radius, irregularity):
    """A sheet with steep round holes down to a floor."""
    return _mounds(t, s, size, rng, count, depth_mm, radius, irregularity, ("sheet", "floor"), -1)


def _mounds(t, s, size, rng, count, height_mm, radius, irregularity, parts, sign):
    points = scattered(rng, count, irregularity)
    near, _, element = cellular(points, t, s, size)
    pitch = min(size[0] / count[0], size[1] / count[1])
    spread = 1 + 0.4 * irregularity * rng.uniform(-1, 1, len(points))
    x = near / (radius * pitch * spread[element])
    if sign > 0:
        profile = np.sqrt(np.clip(1 - x * x, 0, None))
        inside = x < 1
    else:
        profile = 1 - smoothstep((x - 0.85) / 0.25)  # a wall as steep as a grid can hold
        inside = profile > 0.5
    grain = fractal_noise(rng, _cells(size, 0.8), t, s)
    height = sign * height_mm * (profile + 0.03 * grain)
    return Relief(height, inside.astype(int), np.where(inside, element + 1, 0), grain, parts)


def cobbles(t, s, size, rng, *, count, height_mm, gap, irregularity):
    """Rounded stones in mortar, parted by the borders of Voronoi cells."""
    points = scattered(rng, count, irregularity)
    near, second, element = cellular(points, t, s, size)
    pitch = min(size[0] / count[0], size[1] / count[1])
    border = (second - near) / pitch  # 0 on the border of two stones
    inside = border > gap
    dome = np.clip((border - gap) / (0.9 - gap), 0, 1)
    dome = np.sqrt(1 - (1 - dome) ** 2)
    lift = 1 + 0.3 * rng.uniform(-1, 1, len(points))
    tilt = rng.normal(scale=0.15 * irregularity, size=(len(points), 2))
    step = (np.stack([t, s], axis=-1) - points[element] + 0.5) % 1 - 0.5
    slope = np.einsum("...k,...k->...", step * np.asarray(size), tilt[element])
    grain = fractal_noise(rng, _cells(size, 0.7), t, s, 4)
    height = height_mm * (dome * lift[element] + 0.05 * grain) + slope * (dome > 0)
    return Relief(height, inside.astype(int), np.where(inside, element + 1, 0), grain,
                  ("mortar", "stone"))  # fmt: skip


def cracks(t, s, size, rng, *, count, depth_mm, width_mm, irregularity):
    """A surface broken along the wandering borders of cells; the flakes curl up at their edges."""
    points = scattered(rng, count, irregularity)
    pitch = min(size[0] / count[0], size[1] / count[1])
    cells = _cells(size, 0.5 * pitch)
    bend_t = 0.12 * pitch / size[0] * fractal_noise(rng, cells, t, s, 3)
    bend_s = 0.12 * pitch / size[1] * fractal_noise(rng, cells, t, s, 3)
    near, second, element = cellular(points, (t + bend_t) % 1, (s + bend_s) % 1, size)
    border = (second - near) / 2  # about the distance from the border, mm
    width = width_mm * (1 + 0.6 * smooth_noise(rng, cells, t, s)) / 2
    wall = smoothstep((border - width) / (0.5 * width_mm) + 0.5)
    curl = np.exp(-np.clip(border - width, 0, None) / (0.18 * pitch))
    lift = 0.2 * depth_mm * rng.uniform(0, 1, len(points))[element]
    grain = fractal_noise(rng, _cells(size, 0.6), t, s, 4)
    height = wall * (depth_mm * (1 + 0.35 * curl) + lift) + 0.05 * depth_mm * grain
    inside = wall > 0.5
    return Relief(height, inside.astype(int), np.where(inside, element + 1, 0), grain,
                  ("crack", "surface"))  # fmt: skip


def cords(t, s, size, rng, *, count, height_mm, width, irregularity, fibres):
    """Ribs along s, as of corduroy: unequal, slightly wandering, combed into fibres along their length."""
    wander = 0.25 * irregularity * smooth_noise(rng, (max(count // 3, 1), 3), t, s)
    across = t * count + wander
    index = np.floor(across).astype(int) % count
    d = 2 * (across % 1) - 1
    # each cord swells and thins along its length in its own way: the lattice has one row a cord
    own = (np.arange(count) + 0.0) / count
    swell = smooth_noise(rng, (count, 5), own[index], s)
    half = width * (1 + 0.35 * irregularity * swell)
    x = np.abs(d) / half
    round_ = np.sqrt(np.clip(1 - x**2.5, 0, None))
    lift = 1 + 0.2 * irregularity * smooth_noise(rng, (count, 4), own[index], s)
    # strands lie side by side around the cord and slide slowly over its length
    angle = np.arcsin(np.clip(d / half, -1, 1)) / np.pi + 0.5
    slide = smooth_noise(rng, (count, 4), own[index], s)
    strand = angle * fibres + 0.8 * irregularity * slide
    ridge = np.abs(np.sin(np.pi * strand))
    tone = smooth_noise(rng, (count * fibres, 6), (index + strand / fibres) / count, s)
    fuzz = smooth_noise(rng, (count * fibres, 12 * max(count // 3, 1)), across / count, s)
    inside = x < 1
    height = height_mm * (
        round_ * lift + 0.16 * round_ * (ridge - 0.6) + (0.03 + 0.05 * round_) * fuzz
    )
    fibre = np.clip(0.7 * tone + 0.5 * (ridge - 0.6) + 0.25 * fuzz, -1, 1)
    return Relief(height, inside.astype(int), np.where(inside, index + 1, 0), fibre,
                  ("groove", "cord"))  # fmt: skip


def weave(t, s, size, rng, *, warp, weft, pattern, width, thickness_mm, crimp, twist, irregularity):
    """Threads over and under each other; the warp runs along t, the weft along s."""
    if len({len(row) for row in pattern}) > 1:
        raise InputError("structure: the rows of weave's pattern differ in length.")
    pattern = np.asarray(pattern, float) * 2 - 1  # 1: the warp lies on top
    bend = 0.22 * irregularity
    a_s = s * warp + bend * smooth_noise(rng, (4, 4), t, s)
    a_t = t * weft + bend * smooth_noise(rng, (4, 4), t, s)
    over = pattern[np.arange(weft)[:, None] % len(pattern), np.arange(warp) % pattern.shape[1]]
    warp_z, warp_id, warp_fibre = _threads(
        a_s, a_t, t, over.T, warp, weft, width, crimp, twist, irregularity, rng
    )
    weft_z, weft_id, weft_fibre = _threads(
        a_t, a_s, s, -over, weft, warp, width, crimp, twist, irregularity, rng
    )
    scale = thickness_mm / 2
    warp_z, weft_z = warp_z * scale, weft_z * scale
    lint = fractal_noise(rng, _cells(size, 0.5), t, s)
    ground_z = scale * (-1.9 + 0.15 * lint)
    height = np.maximum(np.maximum(warp_z, weft_z), ground_z)
    part = np.where(height == ground_z, 0, np.where(warp_z >= weft_z, 1, 2))
    element = np.choose(part, [np.zeros_like(warp_id), warp_id + 1, weft_id + 1 + warp])
    fibre = np.choose(part, [lint, warp_fibre, weft_fibre])
    return Relief(height, part, element, fibre, ("ground", "warp", "weft"))


def _threads(across, along, place, over, count, crossings, width, crimp, twist, irregularity, rng):
    """One family of threads: height in half thicknesses (-10 beside the threads), thread, fibre pattern.

    `over` (count, crossings) is 1 where the thread lies on top, else -1.
    """
    index = np.floor(across).astype(int) % count
    d = 2 * (across % 1) - 1
    own = np.arange(count) / count
    swell = smooth_noise(rng, (count, 6), own[index], place)
    half = width * (1 + 0.3 * irregularity * swell)
    x = np.clip(d / half, -1, 1)
    at = along - 0.5
    before = np.floor(at).astype(int)
    between = smoothstep(at - before)
    low, high = over[index, before % crossings], over[index, (before + 1) % crossings]
    centre = crimp * (low + (high - low) * between)
    angle = np.arcsin(x)
    start = rng.uniform(0, 2 * np.pi, count)[index]
    phase = 2 * np.pi * twist * place + 2 * angle + start
    groove = np.exp(-((np.sin(phase / 2) / 0.4) ** 2)) if twist else np.zeros_like(x)
    lengths = smooth_noise(
        rng, (count * 6, 8), (index + 0.5 + 0.5 * angle / np.pi * 2) / count, place
    )
    body = np.sqrt(np.clip(1 - x * x, 0, None))
    z = centre + body * (1 - 0.16 * groove + 0.06 * lengths)
    fibre = np.clip(0.55 * lengths + 0.25 - 0.9 * groove, -1, 1)
    return np.where(np.abs(d) < half, z, -10.0), index, fibre


def _cells(size, spacing_mm):
    """Lattice cells along t and s, `spacing_mm` apart as nearly as a period allows."""
    return tuple(max(round(length / spacing_mm), 2) for length in size)


RELIEFS = {f.__name__: f for f in (bumps, holes, cobbles, cracks, cords, weave)}
