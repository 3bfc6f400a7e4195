"""Procedural structures: they tile, they hold at any resolution, their parts get their materials."""

from types import SimpleNamespace

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.formats.obj_parts import read_parts
from btfpipe.simulation.goniometer import Goniometer
from btfpipe.simulation.materials import build_patch
from btfpipe.simulation.reliefs import RELIEFS
from btfpipe.simulation.spec import read_spec
from btfpipe.simulation.tiles import TileMesh, smooth_corners, split

PARAMETERS = {
    "bumps": {"count": (4, 3), "height_mm": 0.5, "radius": 0.4},
    "holes": {"count": (4, 3), "depth_mm": 0.5, "radius": 0.35},
    "cobbles": {"count": (4, 3), "height_mm": 0.5, "gap": 0.1},
    "cracks": {"count": (2, 3), "depth_mm": 0.3, "width_mm": 0.2},
    "cords": {"count": 5, "height_mm": 0.6, "width": 0.85, "fibres": 4},
    "weave": {
        "warp": 6, "weft": 4, "pattern": [[1, 0], [0, 1]], "width": 0.8, "thickness_mm": 0.5,
        "crimp": 0.7, "twist": 6,
    },
}  # fmt: skip


def relief(kind, n_t, n_s, offset=(0.0, 0.0), seed=4):
    t, s = np.meshgrid(
        (np.arange(n_t) / n_t + offset[0]) % 1,
        (np.arange(n_s) / n_s + offset[1]) % 1,
        indexing="ij",
    )
    rng = np.random.default_rng(seed)
    return RELIEFS[kind](t, s, (4.0, 3.0), rng, irregularity=0.5, **PARAMETERS[kind])


@pytest.mark.parametrize("kind", RELIEFS)
def test_relief_is_the_same_at_every_resolution(kind):
    coarse, fine = relief(kind, 40, 30), relief(kind, 80, 60)
    for name in ("height", "part", "element", "fibre"):
        np.testing.assert_allclose(
            getattr(fine, name)[::2, ::2], getattr(coarse, name), atol=1e-9, err_msg=name
        )
    assert set(np.unique(fine.part)) == set(range(len(fine.parts)))
    assert len(np.unique(fine.element)) > 4


@pytest.mark.parametrize("kind", RELIEFS)
def test_relief_runs_on_across_its_borders(kind):
    """The steps over the border are those a tile shows elsewhere, on either axis."""
    height = relief(kind, 320, 240).height
    for axis in (0, 1):
        steps = np.abs(np.diff(height, axis=axis, append=np.take(height, [0], axis=axis)))
        across = np.take(steps, -1, axis=axis)
        assert np.percentile(across, 90) <= 1.5 * np.percentile(steps, 99)


@pytest.mark.parametrize(
    ("kind", "parameters", "parts"),
    [
        ("knit", {"stitches": [3, 4], "yarn_mm": 0.7}, ["ground", "yarn"]),
        ("leaves", {"count": 12, "length_mm": 2}, ["soil", "leaf"]),
        ("overhangs", {"count": [3, 2], "height_mm": 1.5}, ["ground", "stem", "cap"]),
    ],
)
def test_mesh_structure_has_no_seam_and_shows_no_inside(make_patch, kind, parameters, parts):
    patch = make_patch(
        texels=24,
        texels_per_mm=6,
        structure={kind: parameters},
        parts={
            name: {"albedo": [[0.5, 0.3, 0.2], [0.1, 0.4, 0.3]], "mottle": 0.2} for name in parts
        },
    )
    # a picture of flat white light from all over would show holes and insides as black
    goniometer = Goniometer(patch, samples=16, bounces=0)
    lights = np.array([[0.0, 0, 1], [0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]])
    pictures = goniometer.pictures(np.array([0, 0, 1.0]), goniometer.light(lights), range(5))
    picture = pictures.sum(axis=(0, 3))
    assert (picture > 0).mean() > 0.98
    for axis in (0, 1):
        steps = np.abs(np.diff(picture, axis=axis, append=np.take(picture, [0], axis=axis)))
        assert np.take(steps, -1, axis=axis).mean() < 2 * steps.mean() + 0.05


def test_weave_shows_the_pattern_it_is_given():
    woven = relief("weave", 8 * 40, 8 * 60)
    # a thread's middle at a crossing; 1 in the pattern: the warp, part 1, lies on top
    rng_free = RELIEFS["weave"](
        *np.meshgrid((np.arange(4) + 0.5) / 4, (np.arange(6) + 0.5) / 6, indexing="ij"), (4.0, 3.0),
        np.random.default_rng(0), irregularity=0.0, **PARAMETERS["weave"],
    )  # fmt: skip
    expected = np.where((np.indices((4, 6)).sum(axis=0) % 2) == 0, 1, 2)
    np.testing.assert_array_equal(rng_free.part, expected)
    assert (woven.part == 0).any()


def test_height_picture_has_its_first_row_at_the_top(write_spec):
    heights = np.zeros((8, 8, 1), np.uint16)
    heights[1, 5] = 65535
    files = SimpleNamespace(picture=lambda name: heights)
    spec = read_spec(
        write_spec(
            texels=8, texels_per_mm=2, vertices_per_texel=1, parts={"surface": {"albedo": "#808080"}},
            structure={"picture": {"file": "h.png", "height_mm": 1}},
        )
    )  # fmt: skip
    patch = build_patch(spec, files)
    s, t, n = patch.vertices[patch.vertices[:, 2].argmax()]
    # the texel's centre lies between the nearest vertices
    assert abs(s - 5.5) <= 0.5
    assert abs(t - (8 - 1.5)) <= 0.5
    assert n > 0.2


def test_palette_colours_belong_to_whole_elements(make_patch):
    colours = [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.1, 0.1, 0.9]]
    patch = make_patch(
        texels=24, texels_per_mm=6,
        structure={"cobbles": {"count": [3, 3], "height_mm": 0.3}},
        parts={"stone": {"albedo": colours}, "mortar": {"albedo": [0, 0, 0]}},
    )  # fmt: skip
    shown = np.unique(patch.albedo.round(5), axis=0)
    np.testing.assert_allclose(shown, sorted([[0, 0, 0], *colours]), atol=1e-6)


def cube_corner(fold_deg):
    """Two squares that share the edge s = 1 and fold there."""
    a = np.radians(fold_deg)
    x, z = 1 + np.cos(a), -np.sin(a)
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [x, 0, z], [x, 1, z]]
    faces = [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]
    return TileMesh(
        np.array(vertices, float), np.array(faces), np.zeros(4, int), np.zeros(6, int), np.zeros(6),
        ("p",),
    )  # fmt: skip


def test_edges_sharper_than_the_crease_angle_stay_sharp():
    for fold, groups in ((30, 1), (50, 2)):
        group, normals = smooth_corners(cube_corner(fold), (9, 9), 40)
        # the two ends of the fold: one normal each, or two
        at_fold = {group[0, 1], group[2, 0]}
        assert len(at_fold) == groups
        expected = np.array([np.sin(np.radians(fold / 2)), 0, np.cos(np.radians(fold / 2))])
        if groups == 1:
            assert normals[group[0, 1]] @ expected > 0.98


def test_normals_run_on_across_the_border():
    """Half a sine on either side of the tile's border: both ends get the slope of the whole."""
    s, t = np.meshgrid(np.linspace(0, 4, 41), [0, 4.0])
    vertices = np.stack([s, t, np.sin(s * np.pi / 2)], -1).reshape(-1, 3)
    k = np.arange(40)
    faces = np.concatenate([np.stack([k, k + 1, k + 42], 1), np.stack([k, k + 42, k + 41], 1)])
    mesh = TileMesh(vertices, faces, np.zeros(80, int), np.zeros(82, int), np.zeros(82), ("p",))
    group, normals = smooth_corners(mesh, (4, 4), 180)
    slope = np.array([-np.pi / 2, 0, 1]) / np.hypot(np.pi / 2, 1)
    for corner in (group[0, 0], group[39, 1]):
        np.testing.assert_allclose(normals[corner], slope, atol=0.01)


def test_obj_keeps_material_names_and_cuts_polygons(tmp_path):
    path = tmp_path / "tile.obj"
    path.write_text(
        "# a quad and a triangle\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\n"
        "usemtl moss\nf 1//1 2//1 3//1 4//1\nusemtl bark\nf -4 -3 -2\n"
    )
    vertices, faces, part, names = read_parts(path)
    assert len(vertices) == 4
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    assert [names[p] for p in part] == ["moss", "moss", "bark"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\n", "no faces"),
        ("v 0 0 zero\n", "line 1"),
        ("v 0 0 0\nf 1 2 3\n", "names vertex 3"),
        ("v 0 0 0\nf 1 1\n", "line 2"),
        ("v 0 0\n", "line 1"),
    ],
)
def test_broken_obj_is_refused_by_line(tmp_path, text, words):
    path = tmp_path / "broken.obj"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_parts(path)


def test_cut_triangles_are_small_cover_the_same_area_and_leave_no_gaps(rng):
    vertices = np.array([[0, 0, 0], [4, 0, 1], [4, 3, 0], [0, 3, 2], [2, 1.5, 5]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    mesh = TileMesh(vertices, faces, np.arange(4), np.zeros(5, int), np.zeros(5), tuple("abcd"))

    def areas(m):
        a, b, c = m.vertices[m.faces].transpose(1, 0, 2)
        return np.cross(b - a, c - a) / 2

    cut = split(mesh, 0.7)
    corners = cut.vertices[cut.faces]
    assert np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2).max() <= 0.7
    for part in range(4):
        # vector areas: a turned or missing triangle would show
        np.testing.assert_allclose(
            areas(cut)[cut.part == part].sum(axis=0), areas(mesh)[part], atol=1e-9
        )
    edges = np.sort(
        np.stack([cut.faces, np.roll(cut.faces, -1, axis=1)], -1).reshape(-1, 2), axis=1
    )
    _, uses = np.unique(edges, axis=0, return_counts=True)
    border = 2 * len(cut.vertices) - len(cut.faces) - 2  # Euler: a disc with this many border edges
    assert (uses == 1).sum() == border
    assert uses.max() == 2


def test_mesh_without_area_is_refused():
    mesh = cube_corner(0)
    mesh.vertices[:] = 0
    with pytest.raises(InputError, match="no triangle with an area"):
        smooth_corners(mesh, (4, 4), 40)


def test_mesh_far_outside_its_tile_is_refused(make_patch):
    vertices = np.array([[0, 0, 0], [90, 0, 0], [0, 1, 0]], float)
    patch = make_patch(
        mesh=(vertices, np.array([[0, 1, 2]]), np.zeros(1, int), ("p",)),
        structure={"obj": {"file": "x.obj"}}, parts={"p": {"albedo": "#ffffff"}},
    )  # fmt: skip
    with pytest.raises(InputError, match="periods beyond its tile"):
        Goniometer(patch)
