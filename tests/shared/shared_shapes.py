"""Shapes that a resampling may tear: thin limbs, thin walls, long thin triangles, sharp tips."""

import numpy as np
from shared_meshes import torus

SHAPES = {}
# variation of edge lengths of shapes that few vertices cannot be even on: spikes of half a spacing, and bars of 1.3
# spacings, which neither one row of triangles nor two fill evenly
CROWDED = {("hedgehog", 3000): 0.215, ("cage", 3000): 0.225}


def _shape(function):
    SHAPES[function.__name__] = function
    return function


def boxes(solid):
    """The surface of the cubes of a solid (x, y, z) array of booleans, two triangles a square."""
    solid = np.pad(solid, 1)
    quads = []
    for axis in range(3):
        for side in (-1, 1):
            free = solid & ~np.roll(solid, -side, axis)
            for cell in np.argwhere(free):
                corner = cell + (np.eye(3, dtype=int)[axis] if side > 0 else 0)
                u, w = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
                quad = [corner, corner + u, corner + u + w, corner + w]
                quads.append(quad if side > 0 else quad[::-1])
    points, index = np.unique(np.array(quads).reshape(-1, 3), axis=0, return_inverse=True)
    a, b, c, d = index.reshape(-1, 4).T
    return points.astype(float), np.concatenate(
        [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    ).astype(np.int32)


def tube(rings, radii, sides):
    """A tube about the x axis of quads cut in two, closed by a fan at each end.

    `rings` are the places of the rings along x, `radii` their radii; 0 at an end makes a tip.
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    vertices, first = [], []
    for x, radius in zip(rings, radii, strict=True):
        first.append(len(vertices))
        if radius == 0:
            vertices.append((x, 0, 0))
        else:
            vertices.extend((x, radius * np.cos(a), radius * np.sin(a)) for a in angle)
    faces = []
    for a, b, ra, rb in zip(first, first[1:], radii, radii[1:], strict=False):
        for k in range(sides):
            m = (k + 1) % sides
            if ra == 0:
                faces.append((a, b + m, b + k))
            elif rb == 0:
                faces.append((a + k, a + m, b))
            else:
                faces += [(a + k, a + m, b + m), (a + k, b + m, b + k)]
    for a, radius, turn in ((first[0], radii[0], 1), (first[-1], radii[-1], -1)):
        if radius > 0:  # a fan from its first corner
            faces += [(a, a + k + 1, a + k)[::turn] for k in range(1, sides - 1)]
    # the first ring's fan looks towards -x, the last one's towards +x
    return np.array(vertices, float), np.array(faces, np.int32)


@_shape
def plank():
    """12 triangles, 100 x 2 x 0.1."""
    vertices, faces = boxes(np.ones((1, 1, 1), bool))
    return (vertices - 1) * (100, 2, 0.1), faces


@_shape
def beam():
    """12 triangles, 30 x 1 x 1."""
    vertices, faces = boxes(np.ones((1, 1, 1), bool))
    return (vertices - 1) * (30, 1, 1), faces


@_shape
def rod():
    """A cylinder of 32 long quads, with fans as its ends."""
    return tube((0, 60), (0.5, 0.5), 32)


@_shape
def disc():
    """A flat cylinder of 64 sides."""
    return tube((0, 0.2), (5, 5), 64)


@_shape
def cylinder():
    """A cylinder of quads that are nearly squares, with fans around middles as its ends."""
    x = np.linspace(0, 6, 31)
    return tube(np.r_[0, x, 6], np.r_[0, np.ones(31), 0], 32)


@_shape
def capsule():
    """20 triangles: a rod of five sides with tips."""
    return tube((0, 1, 5, 6), (0, 1, 1, 0), 5)


@_shape
def comb():
    """A spine with 12 teeth of 16 : 1."""
    solid = np.zeros((36, 18, 1), bool)
    solid[:, :2] = True
    solid[::3] = True
    return boxes(solid)


@_shape
def cage():
    """The twelve bars of a cube, 20 : 1, and a bar across each side: genus 17."""
    n = 21
    i, j, k = np.indices((n, n, n))
    border = [(a == 0) | (a == n - 1) for a in (i, j, k)]
    middle = [a == n // 2 for a in (i, j, k)]
    rows = sum(b.astype(int) for b in border) >= 2
    for a in range(3):
        rows |= border[a] & middle[(a + 1) % 3]
    return boxes(rows)


def icosphere(halvings):
    """A unit sphere of 20 * 4**halvings triangles."""
    from scipy.spatial import ConvexHull

    ratio = (1 + 5**0.5) / 2
    points = np.array(
        [(0, a, b * ratio) for a in (-1, 1) for b in (-1, 1)]
        + [(a, b * ratio, 0) for a in (-1, 1) for b in (-1, 1)]
        + [(b * ratio, 0, a) for a in (-1, 1) for b in (-1, 1)]
    )
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for _ in range(halvings):
        faces = _outward(points, ConvexHull(points).simplices)
        pairs = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0)
        middle = points[pairs].sum(axis=1)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
    return points, _outward(points, ConvexHull(points).simplices).astype(np.int32)


def _outward(points, faces):
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fx,fx->f", normal, corners.sum(axis=1)) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces


@_shape
def starfish():
    """Five long arms that thin out to blunt tips."""
    points, faces = icosphere(5)
    radius = np.full(len(points), 0.12)
    for k in range(5):
        arm = np.array([np.cos(0.4 * np.pi * k), np.sin(0.4 * np.pi * k), 0])
        angle = np.arccos(np.clip(points @ arm, -1, 1))
        radius += np.exp(-((angle / 0.18) ** 2))
    return points * radius[:, None], faces


@_shape
def hedgehog():
    """A torus with spikes."""
    vertices, faces = torus(160, 80)
    u, w = (a.ravel() for a in np.meshgrid(
        2 * np.pi * np.arange(160) / 160, 2 * np.pi * np.arange(80) / 80, indexing="ij"
    ))  # fmt: skip
    centre = np.stack([np.cos(u), 0 * u, -np.sin(u)], axis=1)
    spike = np.maximum(np.cos(8 * u) * np.cos(2 * w), 0) ** 40
    return centre + (vertices - centre) * (1 + 2 * spike)[:, None], faces


def dense_sphere(side, rings=500, segments=500):
    """A unit sphere of 250,000 vertices up to 60 degrees of latitude, and a sample of `side` texels laid four times around it.

    Returns
    -------
    Level
        Tangents to the east.
    CoordinateMap
    """
    from btfpipe.surface.surface import Level
    from btfpipe.synthesis import CoordinateMap

    lat, lon = np.meshgrid(
        np.linspace(np.pi / 3, -np.pi / 3, rings),
        np.linspace(-np.pi, np.pi, segments, endpoint=False),
        indexing="ij",
    )
    vertices = np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1)
    east = np.stack([np.cos(lon), 0 * lon, -np.sin(lon)], -1)
    a = np.arange(rings * segments).reshape(rings, segments)
    b = np.roll(a, -1, axis=1)
    faces = np.concatenate(
        [np.stack([a[:-1], a[1:], b[1:]], -1), np.stack([a[:-1], b[1:], b[:-1]], -1)]
    ).reshape(-1, 3)
    vertices, east = vertices.reshape(-1, 3), east.reshape(-1, 3).astype(np.float32)
    level = Level(vertices, faces.astype(np.int32), vertices.astype(np.float32), east)
    per_unit = 4 * side / (2 * np.pi)  # the sample four times around
    row, col = (-lat * per_unit) % side, (lon * per_unit) % side
    return level, CoordinateMap(row.ravel(), col.ravel(), 0 * row.ravel(), per_unit, {})
