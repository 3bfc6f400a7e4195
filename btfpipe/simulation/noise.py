"""Irregularity that repeats with the tile: the same pattern at any resolution."""

import numpy as np


def smooth_noise(rng, cells, t, s):
    """Cubic noise over a random periodic lattice, about -1 to 1, mean near 0.

    Parameters
    ----------
    rng : Generator
    cells : (int, int)
        Lattice cells over the tile along t and s.
    t, s : arrays
        Places as fractions of the tile; any real numbers.
    """
    from scipy.ndimage import map_coordinates

    lattice = rng.uniform(-1, 1, size=cells)
    t, s = np.broadcast_arrays(np.asarray(t, float), np.asarray(s, float))
    return map_coordinates(lattice, [t % 1 * cells[0], s % 1 * cells[1]], order=3, mode="grid-wrap")


def fractal_noise(rng, cells, t, s, octaves=3):
    """Octaves of `smooth_noise`, each of twice the frequency and half the strength."""
    total = 0.0
    for octave in range(octaves):
        scale = 2**octave
        total = total + smooth_noise(rng, (cells[0] * scale, cells[1] * scale), t, s) / scale
    return total / (2 - 2.0 ** (1 - octaves))


def scattered(rng, cells, irregularity):
    """One point a cell of a staggered periodic lattice, moved about: (n, 2) fractions (t, s)."""
    n_t, n_s = cells
    i, j = np.meshgrid(np.arange(n_t), np.arange(n_s), indexing="ij")
    stagger = 0.5 * (i % 2) if n_t % 2 == 0 else 0.0
    points = np.stack([(i + 0.5) / n_t, (j + 0.25 + stagger) / n_s], axis=-1).reshape(-1, 2)
    move = rng.uniform(-0.5, 0.5, points.shape) * irregularity
    return (points + move / [n_t, n_s]) % 1


def cellular(points, t, s, size):
    """Distances to the nearest and second nearest of periodic points, and which is nearest.

    Parameters
    ----------
    points : (n, 2)
        Fractions of the tile (t, s).
    t, s : (a, b) arrays
        Places, fractions in [0, 1).
    size : (float, float)
        Size of the tile along t and s; distances are in its unit.

    Returns
    -------
    nearest, second : (a, b)
    index : (a, b) int
    """
    from scipy.spatial import cKDTree

    size = np.asarray(size, float)
    tree = cKDTree(points * size % size, boxsize=size)
    places = np.stack([t * size[0], s * size[1]], axis=-1)
    distance, index = tree.query(places, k=2)
    return distance[..., 0], distance[..., 1], index[..., 0]


def smoothstep(x):
    """0 below 0, 1 above 1, smooth between."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
