"""Procedural triangle meshes over one period: what no height field can hold.

Functions take the tile's size (along t and s) in mm, the finest edge in mm, a Generator and the parameters of the
specification, and return a TileMesh.
"""

import numpy as np

from btfpipe.simulation.noise import fractal_noise, scattered, smooth_noise
from btfpipe.simulation.tiles import joined


def knit(size, edge, rng, *, stitches, yarn_mm, irregularity):
    """Stockinette: courses of loops along s, each pulled through the one below.

    The loops are the usual parametric curve, (x + a sin 2x, h cos x, -d cos 2x).
    """
    courses, wales = stitches
    pitch_t, pitch_s = size[0] / courses, size[1] / wales
    radius = yarn_mm / 2
    steps = max(int(np.ceil(2.4 * (pitch_s + 2 * pitch_t) / edge / 2)), 24)
    around = max(int(np.ceil(np.pi * yarn_mm / edge)), 8)
    n = wales * steps
    x = np.arange(n + 1) / steps * 2 * np.pi
    pieces = []
    for course in range(courses):
        wobble = [
            0.12 * irregularity * smooth_noise(rng, (1, 2 * wales), 0, x / (2 * np.pi * wales))
            for _ in range(3)
        ]
        s = pitch_s * (x / (2 * np.pi) + 0.21 * np.sin(2 * x) + wobble[0])
        t = pitch_t * (course + 0.5 + 0.8 * np.cos(x) + wobble[1])
        z = -0.95 * radius * np.cos(2 * x) + yarn_mm * wobble[2]
        curve = np.stack([s, t, z], axis=1)
        twist = round(size[1] * 2.5 / yarn_mm)  # turns of two plies over the tile
        pieces.append((*_tube(curve, size[1], radius, around, twist), 1, course + 1))
    pieces = [(v, f, part, element, fibre) for v, f, fibre, part, element in pieces]
    pieces.append(_floor(size, edge, rng, -1.9 * radius, 0.15 * radius))
    return joined(pieces, ("ground", "yarn"))


def _tube(curve, period, radius, around, twist):
    """A two-ply yarn about a curve that repeats after `period` along s."""
    n = len(curve) - 1
    ahead = np.roll(curve[:-1], -1, axis=0)
    behind = np.roll(curve[:-1], 1, axis=0)
    ahead[-1, 0] += period
    behind[0, 0] -= period
    tangent = ahead - behind
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.array([0, 0, 1.0]) - tangent * tangent[:, 2:]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    side = np.cross(up, tangent)
    angle = 2 * np.pi * np.arange(around) / around
    turn = np.pi * twist * np.arange(n) / n * 2
    groove = np.abs(np.sin(angle[None] + turn[:, None] / 2))
    # the path closes after the tile only if the plies do: an even number of half turns
    r = radius * (0.8 + 0.2 * groove)
    ring = side[:, None] * np.cos(angle)[:, None] + up[:, None] * np.sin(angle)[:, None]
    vertices = curve[:-1, None] + r[..., None] * ring
    vertices = np.concatenate([vertices, vertices[:1] + np.array([period, 0, 0])])
    fibre = np.concatenate([groove, groove[:1]]) * 1.6 - 1
    i, j = np.meshgrid(np.arange(n), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = a + around, b + around
    faces = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], axis=2).reshape(-1, 3)
    return vertices.reshape(-1, 3), faces[:, ::-1], np.clip(fibre, -1, 1).ravel()


def _floor(size, edge, rng, level, rough):
    """Ground with some grain, part 0."""
    n_t, n_s = (max(int(np.ceil(0.5 * length / edge)), 4) for length in size)
    t, s = np.meshgrid(np.arange(n_t + 1) / n_t, np.arange(n_s + 1) / n_s, indexing="ij")
    cells = tuple(max(round(length / 0.8), 2) for length in size)
    grain = fractal_noise(rng, cells, t, s)
    vertices = np.stack([s * size[1], t * size[0], level + rough * grain], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n_t), np.arange(n_s), indexing="ij")
    a = (i * (n_s + 1) + j).ravel()
    faces = np.concatenate(
        [np.stack([a, a + 1, a + n_s + 2], 1), np.stack([a, a + n_s + 2, a + n_s + 1], 1)]
    )
    return vertices, faces, 0, 0, np.clip(grain, -1, 1).ravel()


def leaves(size, edge, rng, *, count, length_mm, irregularity):
    """Fallen leaves on soil: thin curved blades with a midrib, on top of one another."""
    pieces = [_floor(size, edge, rng, 0.0, 0.12 * length_mm)]
    for index in range(count):
        length = length_mm * (1 + 0.5 * irregularity * rng.uniform(-1, 1))
        blade, faces, fibre = _blade(length, edge, rng)
        azimuth, pitch, roll = rng.uniform(0, 2 * np.pi), *(0.35 * rng.uniform(-1, 1, 2))
        turn = _rotation(2, azimuth) @ _rotation(1, pitch) @ _rotation(0, roll)
        rise = length_mm * (0.12 + 0.3 * index / count)
        place = [rng.uniform(0, size[1]), rng.uniform(0, size[0]), rise]
        pieces.append((blade @ turn.T + place, faces, 1, index + 1, fibre))
    return joined(pieces, ("soil", "leaf"))


def _blade(length, edge, rng):
    """A closed leaf along x about the origin: an upper and a lower side with a common outline."""
    n_u = max(int(np.ceil(length / edge)), 8)
    n_w = max(int(np.ceil(0.5 * length / edge)), 6)
    u, w = np.meshgrid(np.linspace(0, 1, n_u + 1), np.linspace(-1, 1, n_w + 1), indexing="ij")
    half = 0.27 * length * np.sin(np.pi * u**0.8) ** 0.9
    bend, curl = rng.uniform(-0.25, 0.25), rng.uniform(0.05, 0.3)
    x = (u - 0.5) * length
    veins = np.cos(2 * np.pi * (7 * u - 1.5 * np.abs(w)))
    sheet = length * (bend * (u - 0.5) ** 2 + 0.27 * curl * w * w * half / (0.27 * length + 1e-9))
    sheet = sheet + 0.006 * length * veins - 0.012 * length * np.exp(-((w / 0.08) ** 2))
    thick = 0.01 * length * (1 - w * w) * np.sin(np.pi * u)
    top = np.stack([x, half * w, sheet + thick], axis=-1).reshape(-1, 3)
    below = np.stack([x, half * w, sheet - thick], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n_u), np.arange(n_w), indexing="ij")
    a = (i * (n_w + 1) + j).ravel()
    b, c, d = a + 1, a + n_w + 2, a + n_w + 1
    upper = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])
    faces = np.concatenate([upper, upper[:, ::-1] + len(top)])
    # tip and stalk collapse to points: their triangles have no area
    vertices = np.concatenate([top, below])
    sides = vertices[faces]
    area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    fibre = 0.35 * veins + 0.65 * np.exp(-((w / 0.1) ** 2)) - 0.1
    return vertices, faces[area > 1e-9 * length**2], np.tile(fibre.ravel(), 2)


def overhangs(size, edge, rng, *, count, height_mm, cap, irregularity):
    """Caps on stems that hide the ground and their own stems."""
    pieces = [_floor(size, edge, rng, 0.0, 0.05 * height_mm)]
    pitch = min(size[0] / count[0], size[1] / count[1])
    for index, (t, s) in enumerate(scattered(rng, count, irregularity)):
        grow = 1 + 0.35 * irregularity * rng.uniform(-1, 1)
        radius, height = 0.5 * cap * pitch * grow, height_mm * grow
        tall = min(0.45 * height, 0.8 * radius)
        angle = np.linspace(-0.5, 1, 18) * np.pi / 2
        brim_r = radius * np.where(angle < 0, 0.8 + 0.2 * np.cos(2 * angle), np.cos(angle))
        brim_z = height - tall + tall * np.where(angle < 0, 0.25 * np.sin(2 * angle), np.sin(angle))
        stem_r = 0.3 * radius
        stem = _turned(np.array([[stem_r * 1.3, -0.1 * height], [stem_r, 0.2 * height],
                                 [stem_r, height - tall]]), edge)  # fmt: skip
        under = [[0.9 * stem_r, height - 0.9 * tall]]
        hat = _turned(np.concatenate([under, np.stack([brim_r, brim_z], 1)]), edge)
        place = [s * size[1], t * size[0], 0]
        pieces.append((stem[0] + place, stem[1], 1, index + 1, 0.0))
        pieces.append((hat[0] + place, hat[1], 2, index + 1, 0.0))
    return joined(pieces, ("ground", "stem", "cap"))


def _turned(profile, edge):
    """Surface of revolution of a profile (radius, height), from the bottom up, outside outwards."""
    around = max(int(np.ceil(2 * np.pi * profile[:, 0].max() / edge)), 12)
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [
            profile[:, None, :1] * ring,
            np.broadcast_to(profile[:, None, 1:], (len(profile), around, 1)),
        ],
        axis=2,
    )
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(around), indexing="ij")
    a, b = (i * around + j).ravel(), (i * around + (j + 1) % around).ravel()
    c, d = a + around, b + around
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return vertices.reshape(-1, 3), faces


def _rotation(axis, angle):
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = np.cos(angle)
    matrix[b, a], matrix[a, b] = np.sin(angle), -np.sin(angle)
    return matrix


MESHES = {f.__name__: f for f in (knit, leaves, overhangs)}
