"""Make the two sample meshes: a pebble (genus 0) and a trefoil knot (genus 1).

Run it from anywhere: ``python data-sample/make_meshes.py [FOLDER]``; the folder is ``meshes`` beside this file.
The same program gives the same bytes.
"""

import sys
from pathlib import Path

import numpy as np

from btfpipe.formats.meshes import write_obj


def icosphere(halvings):
    """Vertices (n, 3) on the unit sphere and faces (m, 3) of a subdivided icosahedron."""
    g = (1 + 5**0.5) / 2
    vertices = np.array(
        [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g),
         (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    )  # fmt: skip
    faces = np.array(
        [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
         (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
         (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    )  # fmt: skip
    for _ in range(halvings):
        pairs = np.sort(
            np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1
        )
        pairs, middle = np.unique(pairs, axis=0, return_inverse=True)
        middle = middle.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[pairs].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
        )
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def pebble():
    """A leaning, pear-like pebble 2 high: broad below, a soft waist, a hollow on one side."""
    vertices, faces = icosphere(4)
    x, y, z = vertices.T
    radius = 1 - 0.22 * y - 0.16 * np.cos(2.4 * (y - 0.25)) + 0.07 * np.sin(2 * x + 1.3 * z)
    hollow = np.exp(-((x - 0.55) ** 2 + (y - 0.35) ** 2 + (z - 0.75) ** 2) / 0.18)
    radius = radius - 0.16 * hollow
    height = 1.18 * y
    made = np.stack(
        [radius * x + 0.16 * height**2, height * (1 - 0.06 * x), 0.92 * radius * z], axis=1
    )
    return made, faces


def curve(u):
    """The knot's centre line (..., 3) before scaling, at parameters u (...,) from 0 to 2 pi, and its direction."""

    def place(u):
        reach = 2 + 0.95 * np.cos(3 * u)
        return np.stack(
            [reach * np.cos(2 * u), reach * np.sin(2 * u), 1.05 * np.sin(3 * u)], axis=-1
        )

    along = place(u + 1e-4) - place(u - 1e-4)
    return place(u), along / np.linalg.norm(along, axis=-1, keepdims=True)


def knot(around=150, across=12):
    """A trefoil knot, 2.3 wide, of a round tube that swells and narrows a little."""
    u = 2 * np.pi * np.arange(around)[:, None] / around
    w = 2 * np.pi * np.arange(across)[None, :] / across
    centre, along = curve(u)
    # away from the circle that the curve winds about: a frame that closes after one turn
    core = np.stack([2 * np.cos(2 * u), 2 * np.sin(2 * u), 0 * u], axis=-1)
    out = centre - core
    out -= (out * along).sum(axis=-1, keepdims=True) * along
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    side = np.cross(along, out)
    thick = (0.6 + 0.06 * np.cos(3 * u))[..., None]
    around_tube = np.cos(w)[..., None] * out + np.sin(w)[..., None] * side
    vertices = (centre + thick * around_tube) / 3.1
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    k, m = (i + 1) % around, (j + 1) % across
    a, b, c, d = i * across + j, k * across + j, k * across + m, i * across + m
    faces = np.stack([np.stack([a, c, b], axis=2), np.stack([a, d, c], axis=2)], axis=2)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def knot_strokes(count=60):
    """Strokes along the knot's tube, one beside each of some vertices, as YAML for `btfpipe surface --field`."""
    vertices, _ = knot()
    pick = np.arange(count) * len(vertices) // count
    across = len(vertices) // 150
    _, along = curve(2 * np.pi * (pick // across) / 150)
    lines = ["# Along the tube: the sample's s axis follows the knot.\n", "strokes:\n"]
    for point, vector in zip(vertices[pick], along, strict=True):
        point, vector = ([round(float(x), 4) + 0.0 for x in a] for a in (point, vector))
        lines.append(f"  - {{point: {point}, vector: {vector}}}\n")
    return "".join(lines)


def main(folder):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "knot-strokes.yaml").write_text(knot_strokes())
    write_obj(folder / "pebble.obj", *pebble())
    write_obj(folder / "knot.obj", *knot())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "meshes")
