"""The search over a surface against a naive twin, and its steps in turning frames against what plane geometry says."""

import dataclasses
import itertools

import numpy as np
import pytest

from btfpipe.hashing import uniform
from btfpipe.surface import Level, Surface
from btfpipe.surface.flatten import Flattener
from btfpipe.synthesis.coherence import TOLERANCE, coherent_triangles
from btfpipe.synthesis.growth import breadth_first, grow_over_surface


def turned_frames(level, angle):
    """The level with each vertex's s axis turned by its own angle (n,) towards t."""
    t = np.cross(level.normals, level.tangents)
    s = np.cos(angle)[:, None] * level.tangents + np.sin(angle)[:, None] * t
    return dataclasses.replace(level, tangents=s.astype(np.float32))


def wrapped(difference, size):
    return (difference + size / 2) % size - size / 2


def nearest_texel(row, col, shape):
    """The texel (r, c) of a toroidal sample under a coordinate."""
    return int(np.floor(row + 0.5)) % shape[0], int(np.floor(col + 0.5)) % shape[1]


def rotation_onto(start, end):
    """The smallest rotation (3, 3) that takes one unit vector to another (Rodrigues)."""
    axis = np.cross(start, end)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + start @ end)


def frame_between(level, u, normal, tangent):
    """The frame s, t of vertex u turned half-way to that of another frame, in the plane of u."""
    n, s = (np.asarray(a[u], float) for a in (level.normals, level.tangents))
    t = np.cross(n, s)
    other = rotation_onto(np.asarray(normal, float), n) @ np.asarray(tangent, float)
    half = 0.5 * np.arctan2(other @ t, other @ s)
    return np.cos(half) * s + np.sin(half) * t, np.cos(half) * t - np.sin(half) * s


class NaiveGrowth:
    """Tong et al. 2002, section 5, with this project's departures, vertex by vertex in plain Python.

    Only the flattened neighbourhoods and the order of the vertices are taken from the package. Toroidal samples alone.
    """

    def __init__(self, features, surface, scale, k, sweeps, coherence, seed):
        self.features, self.surface = features, surface
        self.scale, self.k, self.coherence, self.seed = scale, k, coherence, seed
        count = len(features.levels)
        self.squares = [self.cut_out(i) for i in range(count)]
        self.place = [None] * count
        for i in reversed(range(count)):
            n = len(surface.levels[i].vertices)
            coarsest = i == count - 1
            self.place[i] = self.scattered(i, n) if coarsest else self.inherited(i)
            done = np.full(n, not coarsest)
            for sweep in range(sweeps[0] if coarsest else sweeps[1]):
                self.sweep(i, done, 0.0 if coarsest else coherence / 2**i, coarsest and sweep == 0)

    def cut_out(self, i):
        """The vectors of the square about each texel, (rows, cols, texels of the square, d) float64."""
        level = self.features.levels[i]
        sides = (self.features.about[name] for name in ("neighbourhood", "coarse_neighbourhood"))
        image = level.vectors[level.labels].astype(float)
        return {
            side: np.stack(
                [
                    np.roll(image, (-r, -c), (0, 1))
                    for r in range(-(side // 2), side // 2 + 1)
                    for c in range(-(side // 2), side // 2 + 1)
                ],
                axis=2,
            )
            for side in sides
        }

    def scattered(self, i, n):
        rows, cols = self.features.levels[i].shape
        return np.array(
            [
                [int(uniform(self.seed, v, 0) * rows), int(uniform(self.seed, v, 1) * cols)]
                for v in range(n)
            ],
            float,
        )

    def inherited(self, i):
        """Coordinates on level i from those on the next coarser one, at twice the scale and half a texel on."""
        level, coarse = self.surface.levels[i], self.surface.levels[i + 1]
        shape = np.array(self.features.levels[i + 1].shape)
        out = np.empty((len(level.vertices), 2))
        for v in range(len(out)):
            weights = level.parent_weights[v]
            corners = coarse.faces[level.parent_face[v]]
            at = weights.astype(float) @ coarse.vertices[corners]
            led = []
            for u in corners:
                way = at - coarse.vertices[u]
                s, t = frame_between(coarse, u, level.normals[v], level.tangents[v])
                flat = np.array([way @ s, way @ t])
                flat *= self.scale / 2 ** (i + 1) * np.linalg.norm(way)
                flat /= max(np.hypot(way @ s, way @ t), 1e-12)
                led.append(self.place[i + 1][u] + [-flat[1], flat[0]])
            main = led[int(np.argmax(weights))]
            difference = wrapped(np.array(led) - main, shape)
            same = (np.abs(difference) <= 0.75).all(axis=1)
            mean = (weights[same, None] * difference[same]).sum(axis=0) / weights[same].sum()
            out[v] = 2 * (main + mean) + 0.5
        return out

    def neighbourhood(self, i, vertex, weight, done=None):
        """Blended vectors of the texels of a square, and which of them count."""
        level = self.features.levels[i]
        image = level.vectors[level.labels].astype(float)
        blend = np.tile(level.vectors[-1].astype(float), (len(vertex), 1))
        counts = np.ones(len(vertex), bool)
        for p in range(len(vertex)):
            if vertex[p, 0] < 0:
                continue
            own = weight[p].astype(float).copy()
            if done is not None:
                own[~done[vertex[p]]] = 0
            counts[p] = own.sum() >= 0.5
            if counts[p]:
                texels = [nearest_texel(*self.place[i][u], level.shape) for u in vertex[p]]
                blend[p] = own @ np.array([image[t] for t in texels]) / own.sum()
        return blend, counts

    def distance(self, i, texel, blend, counts):
        square = self.squares[i][round(len(blend) ** 0.5)][texel]
        return ((blend[counts] - square[counts]) ** 2).sum()

    def sweep(self, i, done, kappa, skip):
        level, mesh = self.surface.levels[i], Flattener(self.surface.levels[i], self.scale / 2**i)
        shape = self.features.levels[i].shape
        order = breadth_first(mesh, self.seed % len(done))
        patches = mesh.squares(order, self.features.about["neighbourhood"])
        two = i + 1 < len(self.features.levels)
        if two:
            below = Flattener(self.surface.levels[i + 1], self.scale / 2 ** (i + 1))
            squares = below.squares_at(
                level.parent_face[order], level.parent_weights[order], level.normals[order],
                level.tangents[order], self.features.about["coarse_neighbourhood"],
            )  # fmt: skip
        for m, v in enumerate(order):
            fine = self.neighbourhood(
                i, patches.pixel_vertex[m], patches.pixel_weight[m], done if skip else None
            )
            coarse = self.neighbourhood(i + 1, squares[0][m], squares[1][m]) if two else None
            runs = [
                self.place[i][u] + patches.patch_step[m, j]
                for j, u in enumerate(patches.patch_vertex[m])
                if u >= 0 and done[u]
            ]
            if runs:
                penalty, ends = self.candidates(i, np.array(runs), kappa)

                def cost(texel, fine=fine, coarse=coarse, penalty=penalty):
                    total = self.distance(i, texel, *fine)
                    if two:
                        total += self.distance(i + 1, (texel[0] // 2, texel[1] // 2), *coarse)
                    return penalty[texel] * total

                best = min(penalty, key=cost)
                self.place[i][v] = np.add(best, ends[best])
            else:
                self.place[i][v] = nearest_texel(*self.place[i][v], shape)
            done[v] = True

    def candidates(self, i, runs, kappa):
        """Factor of each candidate's distance, and the fraction that it carries on."""
        shape = self.features.levels[i].shape
        lists = self.features.levels[i].neighbours
        penalty, ends, owners = {}, {}, []
        for run in runs:
            texel = nearest_texel(*run, shape)
            if texel in owners:
                continue
            owners.append(texel)
            near = wrapped(runs - texel, np.array(shape))
            near = near[(np.abs(near) <= 0.75).all(axis=1)]
            penalty[texel] = 1 + kappa * (1 - len(near) / len(runs))
            ends[texel] = np.clip(near.mean(axis=0), -0.49, 0.49)
        for owner in owners:
            for other in lists[owner][1 : self.k]:
                texel = divmod(int(other), shape[1])
                if texel not in penalty:
                    penalty[texel] = 1 + kappa
                    ends[texel] = ends[owner]
        return penalty, ends


def small_surface(make_level, link, sizes):
    """A surface of the given levels with frames that turn from place to place."""
    levels = [make_level(n) for n in sizes]
    for i, level in enumerate(levels):
        x, y, _ = np.asarray(level.vertices).T
        levels[i] = turned_frames(level, 0.9 * x - 0.6 * y)
    for fine, coarse in itertools.pairwise(levels):
        link(fine, coarse)
    return Surface(levels, digest="small")


@pytest.mark.parametrize(("sizes", "seed"), [((160, 40), 5), ((320, 80, 20), 1234)])
def test_growth_over_a_curved_surface_equals_its_naive_twin(
    make_features, sphere, link, sizes, seed
):
    """Every level, the steps between them, distances over two levels, coherence level by level, and the seed."""
    features = make_features(rows=20, cols=24, k=6, levels=len(sizes), smooth=False)
    surface = small_surface(sphere, link, sizes)
    scale, options = (
        0.27 * sizes[0] ** 0.5,
        {"k": 6, "sweeps": (2, 1), "coherence": 0.8, "seed": seed},
    )
    twin = NaiveGrowth(features, surface, scale, **options)
    grown = grow_over_surface(features, surface, scale, levels=len(sizes), **options)
    row = wrapped(grown.row[0] - twin.place[0][:, 0], 20)
    col = wrapped(grown.col[0] - twin.place[0][:, 1], 24)
    # not all, as single precision may settle a tie otherwise
    assert (np.hypot(row, col) < 0.01).mean() > 0.98


@pytest.mark.parametrize("slope", [(0.3, 0.0), (0.0, -0.3), (0.2, 0.25)])
def test_steps_between_turned_frames_are_seen_half_way(grid, slope):
    """On a plane both frames turn a step alike, so their mean has its direction."""
    level = grid(12, 14)
    x, y, _ = level.vertices.T
    angle = slope[0] * (x - 6) + slope[1] * (y + 5)
    centre = 5 * 14 + 6
    patches = Flattener(turned_frames(level, angle), 1.0).squares([centre], 5)
    own = patches.patch_vertex[0]
    inside = own >= 0
    assert inside.sum() > 20
    way = level.vertices[centre] - level.vertices[own[inside]]
    half = (angle[own[inside]] + angle[centre]) / 2
    along = way[:, 0] * np.cos(half) + way[:, 1] * np.sin(half)
    up = way[:, 1] * np.cos(half) - way[:, 0] * np.sin(half)
    np.testing.assert_allclose(
        patches.patch_step[0][inside], np.stack([-up, along], 1), atol=1e-5
    )  # row runs against t


def naive_coherent(level, row, col, scale, shape, toroidal):
    """Whether each face's three edges are the steps that the half-way frames see, and its frames turn little."""
    found = []
    for face in level.faces:
        good = True
        for a, b in zip(face, np.roll(face, -1), strict=True):
            edge = scale * (level.vertices[b] - level.vertices[a])
            seen = np.zeros(2)
            for v in (a, b):
                n, s = (np.asarray(x[v], float) for x in (level.normals, level.tangents))
                seen += [edge @ s, edge @ np.cross(n, s)]
            seen *= np.linalg.norm(edge) / np.linalg.norm(seen)
            miss = np.array([row[b] - row[a] + seen[1], col[b] - col[a] - seen[0]])
            if toroidal:
                miss = wrapped(miss, np.array(shape))
            n, s = (np.asarray(x[a], float) for x in (level.normals, level.tangents))
            other = np.asarray(level.tangents[b], float)
            turn = np.arctan2(other @ np.cross(n, s), other @ s)
            good &= bool(np.linalg.norm(miss) <= TOLERANCE)
            good &= bool(abs(turn) * np.linalg.norm(edge) <= TOLERANCE)
        found.append(good)
    return np.array(found)


@pytest.mark.parametrize("toroidal", [True, False])
def test_coherent_triangles_are_those_of_the_naive_twin(sphere, rng, toroidal):
    """Runs of turned pieces about every vertex, jittered so that some edges pass and others do not."""
    level = sphere(600)
    level = turned_frames(level, rng.normal(scale=0.09, size=600))
    scale, shape = 8.0, (20, 28)
    # rigid along the equator and the first meridian, where the sample's borders lie; sheared far from both
    polar, azimuth = np.arccos(level.vertices[:, 2]), np.arctan2(*level.vertices[:, 1::-1].T)
    row = scale * polar + 7.3 + rng.normal(scale=0.06, size=600)
    col = scale * np.sin(polar) * azimuth + rng.normal(scale=0.06, size=600)
    if toroidal:
        row, col = row % shape[0], col % shape[1]
    row, col = row.astype(np.float32), col.astype(np.float32)
    expected = naive_coherent(level, row, col, scale, shape, toroidal)
    assert 0.1 < expected.mean() < 0.9
    found = coherent_triangles(level, row, col, scale, shape, toroidal)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("sense", [-1, 1])
def test_frames_that_turn_against_each_other_are_not_one_piece(sense):
    """The step along an edge is right half-way, but ten texels long it turns by most of a texel from end to end.

    The other two edges turn back, by less than counts.
    """
    vertices = np.array([[0, 0, 0], [10, 0, 0], [5, 1, 0]], float)
    faces = np.array([[0, 1, 2]], np.int32)
    up = np.tile(np.float32([0, 0, 1]), (3, 1))
    right = np.tile(np.float32([1, 0, 0]), (3, 1))
    row, col = (-vertices[:, 1]).astype(np.float32), vertices[:, 0].astype(np.float32)
    for turn, expected in ((0.02, True), (0.08, False)):
        angle = sense * turn * np.array([-0.5, 0.5, 0.0])
        level = turned_frames(Level(vertices, faces, up, right), angle)
        found = coherent_triangles(level, row, col, 1.0, (32, 32), False)
        assert found.tolist() == [expected]
