"""The summed curl of a field: analytic fields, and dislocations counted on stripes that know nothing of curl."""

from pathlib import Path

import numpy as np
import pytest
from shared_meshes import even_sphere

from btfpipe.surface import Level
from btfpipe.surface.curl import curl_facts, face_curl, summed_curl
from btfpipe.surface.prepare import prepare
from btfpipe.surface.topology import edges


def grid(u, v):
    """Faces of a grid of parameters, and its parameters (n,) each; counter-clockwise seen with u right and v up."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(len(u)), np.arange(len(v)), indexing="ij"))
    at = np.arange(len(u) * len(v)).reshape(len(u), len(v))
    a, b, c, d = (x.ravel() for x in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return faces, u[i], v[j]


def test_a_turning_field_on_a_plane_has_the_curl_of_its_formula():
    """The curl of s = (cos a x, sin a x) is a cos a x, that of t = (-sin a x, cos a x) is -a sin a x."""
    faces, x, y = grid(np.linspace(0, 2.0, 81), np.linspace(0, 1.5, 61))
    a = 2.3
    level = Level(
        np.stack([x, y, 0 * x], 1), faces, np.tile(np.float32([0, 0, 1]), (len(x), 1)),
        np.stack([np.cos(a * x), np.sin(a * x), 0 * x], 1).astype(np.float32),
    )  # fmt: skip
    middle = x[faces].mean(axis=1)  # a sixth of an edge from where the edges' means lie
    area = 2.0 * 1.5 / len(faces)
    np.testing.assert_allclose(
        face_curl(level), a * np.cos(a * middle) * area, atol=0.02 * a * area
    )
    np.testing.assert_allclose(
        face_curl(level, np.pi / 2), -a * np.sin(a * middle) * area, atol=0.02 * a * area
    )
    along = np.linspace(0, 2.0, 100_001)
    expected = 1.5 * np.trapezoid(np.abs(a * np.cos(a * along)), along)
    assert summed_curl(level) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_sphere_combed_around_its_axis(turn):
    """The geodesic curvature of parallels is cot(theta), whose integral over the sphere is 4 pi; meridians have none."""
    level = even_sphere(8000)
    t = np.cross(level.normals, level.tangents)
    level.tangents = (np.cos(turn) * level.tangents + np.sin(turn) * t).astype(np.float32)
    assert summed_curl(level, -turn) == pytest.approx(4 * np.pi, rel=0.01)
    assert summed_curl(level, np.pi / 2 - turn) < 0.06 * 4 * np.pi
    assert face_curl(level).sum() == pytest.approx(0, abs=1e-9)
    # in between, the curl of the sum is the sum of the curls
    assert summed_curl(level) == pytest.approx(4 * np.pi * np.cos(turn), rel=0.02)
    away = np.abs(level.vertices[level.faces][..., 2].mean(axis=1)) > 0.2
    north = level.vertices[level.faces][..., 2].mean(axis=1) > 0
    assert (np.sign(face_curl(level, -turn))[away] == np.where(north, 1, -1)[away]).mean() > 0.999


@pytest.mark.parametrize("slope", [0.0, 0.4, 1.0])
def test_cones_and_cylinders_combed_along_their_parallels(slope):
    """Unrolled, the parallels of a cone are arcs about its apex: of radius rho they have the curl 1 / rho."""
    angle = np.arctan(slope)
    rho = np.linspace(1.0, 2.0, 61)
    azimuth = np.linspace(0, 1.5, 91)
    faces, phi, r = grid(azimuth, rho)
    radius = 1.0 + (r - 1.0) * np.sin(angle) if slope == 0 else r * np.sin(angle)
    vertices = np.stack([radius * np.cos(phi), radius * np.sin(phi), -r * np.cos(angle)], 1)
    normals = np.stack(
        [np.cos(angle) * np.cos(phi), np.cos(angle) * np.sin(phi), np.sin(angle) + 0 * phi], 1
    )
    parallel = np.stack([-np.sin(phi), np.cos(phi), 0 * phi], 1)
    flipped = faces[:, ::-1]  # outward
    level = Level(
        vertices, np.ascontiguousarray(flipped), normals.astype(np.float32), parallel.astype(np.float32)
    )  # fmt: skip
    expected = 1.5 * np.sin(angle) * (2.0 - 1.0)  # of 1 / rho over rho drho dphi
    rounding = 1e-6 * len(faces)  # of positions in single precision
    assert summed_curl(level) == pytest.approx(expected, rel=2e-3, abs=rounding)
    assert summed_curl(level, np.pi / 2) < rounding


def dislocations(level, turn, spacing):
    """Dislocations of stripes across a direction, as even as they can be (Knöppel et al. 2015): of the phase that fits best.

    The phase is that of the smallest eigenvector of a Laplacian that expects each edge to advance it by the edge's part along
    the direction; a dislocation is a face around which the phase goes through whole turns.
    """
    from scipy.sparse import coo_matrix, identity
    from scipy.sparse.linalg import splu

    n, pair = len(level.vertices), edges(level.faces)
    s = np.asarray(level.tangents, float)
    direction = np.cos(turn) * s + np.sin(turn) * np.cross(level.normals, s)

    def advance(a, b):
        along = ((direction[a] + direction[b]) / 2 * (level.vertices[b] - level.vertices[a])).sum(1)
        return 2 * np.pi / spacing * along

    i, j = pair.T
    wave = np.exp(1j * advance(i, j))
    degree = np.bincount(pair.ravel(), minlength=n).astype(complex)
    own = np.arange(n)
    laplacian = coo_matrix(
        (np.r_[-wave, -wave.conj(), degree], (np.r_[j, i, own], np.r_[i, j, own])), (n, n)
    )
    matrix = (laplacian + 1e-6 * identity(n)).tocsc()
    symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    solve = splu(matrix, permc_spec="MMD_AT_PLUS_A", **symmetric).solve
    psi = np.exp(2j * np.pi * np.random.default_rng(1).random(n))
    for _ in range(20):
        psi = solve(psi)
        psi /= np.linalg.norm(psi)
    around = np.zeros(len(level.faces))
    for k in range(3):
        a, b = level.faces[:, k], level.faces[:, (k + 1) % 3]
        expected = advance(a, b)
        miss = np.angle(psi[b] / psi[a] * np.exp(-1j * expected))
        around += expected + miss
    return int(np.abs(np.rint(around / (2 * np.pi))).sum())


def test_the_summed_curl_foretells_the_dislocations_of_even_stripes():
    level = even_sphere(2500)
    for spacing in (0.35, 0.5):
        across, along = (dislocations(level, turn, spacing) for turn in (0, np.pi / 2))
        assert across == pytest.approx(summed_curl(level) / spacing, rel=0.12)
        assert along == 0
        facts = curl_facts(level)
        assert across == pytest.approx(facts["curl_s"] * 2 * np.pi / spacing, rel=0.12)


def test_surface_reports_which_direction_of_the_pebbles_field_is_even():
    """Stripes along s, which runs around the pebble, can be even; those along t are crowded towards its ends."""
    from btfpipe.formats.meshes import read_mesh

    pebble = Path(__file__).resolve().parents[2] / "data-sample" / "meshes" / "pebble.obj"
    surface, facts = prepare(*read_mesh(pebble), 4000, 1)
    level = surface.levels[0]
    assert facts["curl_s"] * 2 * np.pi == pytest.approx(summed_curl(level))
    assert facts["curl_s"] > 6 * facts["curl_t"]
    spacing = 0.35
    for turn, name in ((0, "curl_s"), (np.pi / 2, "curl_t")):
        foretold = 2 * np.pi * facts[name] / spacing
        counted = dislocations(level, turn, spacing)
        assert counted <= 1.05 * foretold
        assert counted >= 0.85 * foretold - 4
