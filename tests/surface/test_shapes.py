"""Resampling keeps the shape: thin limbs, thin walls, long thin triangles, sharp tips.

Distances are measured here by points of the test's own, not by `deviation`, which is itself compared with them.
"""

import json

import numpy as np
import pytest
from shared_shapes import CROWDED, SHAPES, icosphere

from btfpipe.errors import InputError
from btfpipe.surface import deviation
from btfpipe.surface import prepare as preparation
from btfpipe.surface.cleaning import clean
from btfpipe.surface.prepare import prepare
from btfpipe.surface.smooth_input import smooth_input
from btfpipe.surface.topology import describe, edge_lengths, mesh_area

QUICK = {"plank", "comb", "starfish", "hedgehog", "capsule"}
SMOOTH = {"cylinder", "starfish", "capsule"}


def triangle_grid(parts):
    """Barycentric coordinates of an even grid on a triangle."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(parts + 1), np.arange(parts + 1)))
    keep = i + j <= parts
    i, j = i[keep] / parts, j[keep] / parts
    return np.stack([i, j, 1 - i - j], axis=1)


def grid_points(vertices, faces, step):
    """Points on all faces, closer than `step` along their edges, at most some millions."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.minimum(np.ceil(longest / step).astype(int), 300)
    return np.concatenate(
        [
            (triangle_grid(p) @ corners[parts == p]).reshape(-1, 3) for p in np.unique(parts)
        ]
    )  # fmt: skip


def farthest(points, vertices, faces):
    import igl

    squared = igl.point_mesh_squared_distance(points, vertices, faces.astype(np.int64))[0]
    return float(np.sqrt(squared.max()))


def topology(faces, n):
    euler, loops, _ = describe(faces, n)
    return sorted(zip(euler.tolist(), loops.tolist(), strict=True))


def check(name, mesh, n, evenness):
    vertices, faces, _ = clean(*mesh, name)
    made, facts = prepare(*mesh, n, 1, smooth=False, name=name)
    level = made.levels[0]
    lengths = edge_lengths(level.vertices, level.faces)
    spacing = lengths.mean()
    there = farthest(
        grid_points(vertices, faces, max(spacing / 2, 0.02)), level.vertices, level.faces
    )
    back = farthest(grid_points(level.vertices, level.faces, spacing / 2), vertices, faces)
    assert abs(len(level.vertices) - n) <= 0.05 * n
    assert there <= 0.5 * spacing
    assert back <= 0.5 * spacing
    assert mesh_area(level.vertices, level.faces) == pytest.approx(
        mesh_area(vertices, faces), rel=0.01 if n >= 30_000 else 0.03
    )
    assert lengths.std() <= evenness * spacing
    assert topology(level.faces, len(level.vertices)) == topology(faces, len(vertices))
    # what the summary says is true, as far as points of either kind can tell
    said = facts["distance"]
    assert said["input_to_result"]["max"] == pytest.approx(there, abs=0.1 * spacing)
    assert said["result_to_input"]["max"] == pytest.approx(back, abs=0.1 * spacing)


@pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in sorted(SHAPES)
    ],
)
def test_shapes_are_kept_at_three_thousand_vertices(name):
    check(name, SHAPES[name](), 3000, CROWDED.get((name, 3000), 0.12 if name in SMOOTH else 0.2))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SHAPES))
def test_shapes_are_kept_at_thirty_thousand_vertices(name):
    check(name, SHAPES[name](), 30_000, 0.12 if name in SMOOTH else 0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SHAPES))
def test_shapes_are_kept_at_a_quarter_of_a_million_vertices(name):
    check(name, SHAPES[name](), 250_000, 0.12 if name in SMOOTH else 0.2)


MEASURED = {
    "bunny": ("bunny/bunny.obj", 0.12),
    "armadillo": ("armadillo/armadillo.obj", 0.12),
    "torus": ("torus/torus.obj", 0.12),
    "spot": ("spot/spot_low_resolution.obj", 0.12),
    "three_holes": ("three_holes/3holes.obj", 0.12),
    "plane_holes": ("plane/plane_holes.obj", 0.2),
}


@pytest.mark.measured
@pytest.mark.parametrize(
    "n", [3000, pytest.param(30_000, marks=pytest.mark.slow), pytest.param(250_000, marks=pytest.mark.slow)]
)  # fmt: skip
@pytest.mark.parametrize("name", sorted(MEASURED))
def test_measured_meshes_are_kept(measured_data, name, n):
    from btfpipe.formats.meshes import read_mesh

    path, evenness = MEASURED[name]
    check(name, read_mesh(measured_data / "meshes" / path), n, evenness)


@pytest.mark.slow
def test_a_shape_that_needs_more_vertices_is_told_how_many_and_they_do(shapes, btfpipe, tmp_path):
    vertices, faces = shapes.sphere(1)
    many = np.concatenate([vertices + np.array((3 * i, 0, 0)) for i in range(40)])
    mesh = shapes.obj(
        tmp_path / "many.obj", many, np.concatenate([faces + 42 * i for i in range(40)])
    )
    out = tmp_path / "s.npz"
    command = ["surface", mesh, "-o", out, "--levels", 1, "--no-smooth"]
    refused = btfpipe(*command, "--vertices", 100, code=3).stderr
    assert "many.obj: 100 vertices asked for are too few for its shape" in refused
    assert not out.exists()
    enough = int(refused.split("Ask for ")[1].split()[0])
    facts = json.loads(btfpipe(*command, "--vertices", enough, "--json").stdout)
    assert abs(facts["vertices"] - enough) <= 0.05 * enough
    assert facts["components"] == 40


@pytest.mark.parametrize("lost", ["limb", "area"])
def test_a_torn_result_is_not_written(monkeypatch, lost):
    real = preparation.resample

    def torn(source, n, report=lambda done, total: None):
        made = real(source, n, report)
        made.deviation.from_input[0] = 0.6 * made.spacing if lost == "limb" else 0
        made.deviation.area_ratio *= 1 if lost == "limb" else 0.96
        return made

    monkeypatch.setattr(preparation, "resample", torn)
    monkeypatch.setattr(preparation, "_MOST_TRIED", 4000)
    said = "0.60 spacings from it" if lost == "limb" else r"area would change by 4\.\d %"
    shares = []
    with pytest.raises(InputError, match=f"{said}.* Up to 6000 were tried, and do not suffice"):
        prepare(
            *SHAPES["cylinder"](), 3000, 1, smooth=False,
            report=lambda done, total: shares.append(done / total),
        )  # fmt: skip
    assert shares == sorted(shares)
    assert shares[-1] == 1


def test_coarser_levels_say_how_far_off_they_are():
    _, facts = prepare(*SHAPES["cylinder"](), 3000, 3, smooth=False)
    assert len(facts["level_distances_spacings"]) == 3
    assert 0 < facts["level_distances_spacings"][0] < 0.5


def test_boxes_stay_boxes_though_smoothed():
    """Rounding is for facets: corners of 90 degrees are shape."""
    for name in ("beam", "comb"):
        _, facts = prepare(*SHAPES[name](), 3000, 1)
        assert facts["area_ratio"] == pytest.approx(1, abs=1e-3)
        assert facts["smoothing_moved"]["max"] < 1e-9 + 1e-3 * facts["spacing"]
    # and a ring of facets is rounded: the cylinder's area comes nearer to the round one's
    _, facts = prepare(*SHAPES["cylinder"](), 10_000, 1)
    assert facts["smoothing_moved"]["max"] > 0
    assert (
        facts["distance"]["result_to_input"]["max"]
        <= facts["smoothing_moved"]["max"] + 0.5 * facts["spacing"]
    )


def test_a_coarse_ball_is_smoothed_into_a_ball():
    """Corners with a ball's normals give the ball, whose radius everybody knows."""
    off = {}
    for smooth in (False, True):
        surface, _ = prepare(*icosphere(2), 10_000, 1, smooth=smooth)
        off[smooth] = np.abs(np.linalg.norm(surface.levels[0].vertices, axis=1) - 1).mean()
    assert off[True] < 0.1 * off[False]


def test_normals_between_corners_are_nearer_to_those_of_waves_than_linear_ones():
    """A sheet of waves, eight facets each, whose slopes everybody knows."""
    k, height = np.pi / 4, 0.2
    i, j = (a.ravel().astype(float) for a in np.meshgrid(range(41), range(41), indexing="ij"))
    corner = np.arange(41 * 41).reshape(41, 41)
    a, b, c, d = (
        x.ravel() for x in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    vertices = np.stack([i, j, height * np.sin(k * i) * np.cos(k * j)], axis=1)
    rng = np.random.default_rng(3)
    face, weights = rng.integers(0, len(faces), 5000), rng.dirichlet((1, 1, 1), 5000)
    off = {}
    for alpha in (0.0, 0.5):
        source = smooth_input(vertices, faces, alpha=alpha)
        x, y, _ = source.flat(face, weights).T
        true = (
            height * k * np.stack([-np.cos(k * x) * np.cos(k * y), np.sin(k * x) * np.sin(k * y)])
        )
        true = np.append(true, np.ones((1, 5000)), axis=0)
        cosine = (source.normals(face, weights) * true.T).sum(axis=1) / np.linalg.norm(true, axis=0)
        inside = (np.abs(x - 20) < 14) & (np.abs(y - 20) < 14)
        off[alpha] = np.arccos(np.clip(cosine, -1, 1))[inside].mean()
    assert off[0.5] < 0.6 * off[0.0]


def test_smoothing_moves_nothing_farther_than_phong_tessellation_does():
    """That of its paper: with 3/4 of the pull to the tangent planes."""
    for name in ("starfish", "hedgehog"):
        vertices, faces = SHAPES[name]()
        _, facts = prepare(vertices, faces, 8000, 1)
        assert 0 < facts["smoothing_moved"]["max"] <= smooth_input(vertices, faces).largest_move()


def test_a_box_beside_a_ball_stays_a_box():
    """The ball's facets set how far vertices may move; normals of the box's corners would swell its sides by as much."""
    ball, ball_faces = icosphere(1)
    box, box_faces = SHAPES["beam"]()
    both = np.concatenate([box, 4 * ball + (0, 8, 0)])
    surface, _ = prepare(both, np.concatenate([box_faces, ball_faces + len(box)]), 6000, 1)
    level = surface.levels[0]
    low, high = box.min(axis=0), box.max(axis=0)
    on_box = level.vertices[level.vertices[:, 1] < 3]
    off = np.abs(np.stack([on_box - low, on_box - high])).min(axis=(0, 2))
    assert len(on_box) > 2000
    assert off.max() < 1e-6


def sheets(gap):
    """Two squares above each other, as one mesh of two parts."""
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    return np.concatenate([square, square + np.array((0, 0, gap))]), np.concatenate(
        [faces, faces + 4]
    )


def test_deviation_is_the_distance_of_what_is_apart():
    vertices, faces = sheets(0.01)
    lifted = vertices + np.array((0, 0, 0.002))
    found = deviation.measure(lifted, faces, vertices, faces, 0.1)
    assert found.from_input.max() == pytest.approx(0.002)
    assert found.to_input.max() == pytest.approx(0.002)
    assert found.mean_from_input == pytest.approx(0.002)
    assert found.mean_to_input == pytest.approx(0.002)
    assert found.area_ratio == pytest.approx(1)
    facts = found.summary(0.1, 1.0)["input_to_result"]
    assert facts["max_spacings"] == pytest.approx(0.02)
    assert facts["max_of_extent"] == pytest.approx(0.002)


def test_deviation_sees_what_is_lost_and_what_is_too_much():
    vertices, faces = sheets(0.5)
    half = deviation.measure(vertices, faces[:2], vertices, faces, 0.05)
    assert half.from_input.max() == pytest.approx(0.5)
    assert half.to_input.max() == pytest.approx(0, abs=1e-12)
    assert half.area_ratio == pytest.approx(0.5)
    double = deviation.measure(vertices, faces, vertices, faces[:2], 0.05)
    assert double.from_input.max() == pytest.approx(0, abs=1e-12)
    assert double.to_input.max() == pytest.approx(0.5)
    worst, where = deviation.farthest_beyond(half, 0.05, np.empty((0, 3)))
    assert worst == pytest.approx(0.5)
    assert where[2] == pytest.approx(0.5)


def test_only_corners_sharper_than_sixty_degrees_may_be_a_spacing_off():
    def cone(opening_deg):
        angle = 2 * np.pi * np.arange(48) / 48
        radius = np.tan(np.deg2rad(opening_deg / 2))
        ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
        k = np.arange(48)
        faces = np.stack([k, (k + 1) % 48, np.full(48, 48)], axis=1)
        return np.concatenate([ring, [(0, 0, 1.0)]]), faces

    for opening, sharp in ((50, True), (70, False)):
        vertices, faces = cone(opening)
        tips = deviation.sharp_tips(vertices, faces, 0.1)
        assert (len(tips) == 1) == sharp
        # the tip is cut off by 0.7 of a spacing
        cut = vertices.copy()
        cut[48, 2] -= 0.07
        found = deviation.measure(cut, faces, vertices, faces, 0.1)
        assert (deviation.farthest_beyond(found, 0.1, tips) is None) == sharp
        cut[48, 2] -= 0.04
        found = deviation.measure(cut, faces, vertices, faces, 0.1)
        assert deviation.farthest_beyond(found, 0.1, tips) is not None


@pytest.mark.parametrize(("n", "most"), [(300, 0.3), (3000, 0.03), (30_000, 0.01), (250_000, 0.01)])
def test_area_may_be_off_by_less_where_there_are_more_vertices(n, most):
    assert deviation.most_area_error(n) == pytest.approx(most)
