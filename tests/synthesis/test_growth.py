"""Growth over surfaces: laws on flat grids and spheres, where the answer is known."""

import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.surface import Surface
from btfpipe.synthesis.coherence import coherence_facts, coherent_triangles
from btfpipe.synthesis.growth import grow_over_surface, scale_for


def one_level(level):
    return Surface([level], digest="one")


def wrapped(difference, size):
    return (difference + size / 2) % size - size / 2


def test_one_neighbour_lays_a_sample_rigidly_on_a_flat_grid(grid, make_features):
    features = make_features(rows=16, cols=20)
    grown = grow_over_surface(
        features, one_level(grid(30, 30)), 1.0, k=1, levels=1, sweeps=(1, 1), seed=2
    )
    row, col = grown.row.reshape(30, 30), grown.col.reshape(30, 30)
    down, right = np.mgrid[0:30, 0:30]
    np.testing.assert_allclose(wrapped(row - row[0, 0] - down, 16), 0, atol=1e-3)
    np.testing.assert_allclose(wrapped(col - col[0, 0] - right, 20), 0, atol=1e-3)
    assert grown.about["synthesis"][0]["starts"] == 1


def test_a_turned_sample_is_turned_counter_clockwise(grid, make_features):
    features = make_features(rows=16, cols=20)
    angle = np.radians(90)
    grown = grow_over_surface(
        features, one_level(grid(30, 30)), 1.0, k=1, levels=1, sweeps=(1, 1), turn=angle
    )
    row, col = grown.row.reshape(30, 30), grown.col.reshape(30, 30)
    # The sample's right-hand axis points up the grid: cols grow upwards, rows to the right.
    np.testing.assert_allclose(wrapped(col[1:] - col[:-1] + 1, 20), 0, atol=1e-3)
    np.testing.assert_allclose(wrapped(row[:, 1:] - row[:, :-1] - 1, 16), 0, atol=1e-3)
    assert (grown.angle == np.float32(angle)).all()


@pytest.mark.parametrize("scale", [1.0, 0.7, 1.3])
def test_fractions_keep_a_run_rigid_at_any_scale(grid, make_features, scale):
    features = make_features(rows=16, cols=20)
    surface = one_level(grid(30, 30))
    grown = grow_over_surface(features, surface, scale, k=1, levels=1, sweeps=(1, 1), seed=2)
    col = grown.col.reshape(30, 30)
    right = np.arange(30) * scale
    np.testing.assert_allclose(wrapped(col - col[:, :1] - right, 20), 0, atol=0.02)
    facts = coherence_facts(grown, surface, (16, 20), True)
    assert facts["coherent_share"] == 1
    assert facts["patch_texels"] == pytest.approx((29 * scale) ** 2)


def test_cols_run_east_and_rows_south_on_a_sphere(sphere, make_features):
    features = make_features(rows=16, cols=20)
    level = sphere(4000)
    grown = grow_over_surface(
        features, one_level(level), 18.0, k=1, levels=1, sweeps=(1, 1), seed=2
    )
    v = level.vertices
    a, b = level.faces[:, 0], level.faces[:, 1]
    mild = np.abs(v[a, 2]) < 0.5
    a, b = a[mild], b[mild]
    longitude = np.arctan2(v[:, 1], v[:, 0])
    cosine = np.sqrt(1 - (v[a, 2] + v[b, 2]) ** 2 / 4)
    east = 18 * cosine * wrapped(longitude[b] - longitude[a], 2 * np.pi)
    south = -18 * (np.arcsin(v[b, 2]) - np.arcsin(v[a, 2]))
    dcol = wrapped(grown.col[0][b] - grown.col[0][a], 20)
    drow = wrapped(grown.row[0][b] - grown.row[0][a], 16)
    alike = (np.abs(dcol - east) < 0.25) & (np.abs(drow - south) < 0.25)
    assert alike.mean() > 0.6  # the rest are seams
    assert ((np.abs(dcol + east) < 0.25) & (np.abs(drow - south) < 0.25)).mean() < 0.2  # mirrored
    assert ((np.abs(dcol - south) < 0.25) & (np.abs(drow - east) < 0.25)).mean() < 0.2  # turned


def test_a_finer_level_continues_the_coarser_one(grid_surface, make_features):
    features = make_features(rows=16, cols=20, levels=2)
    grown = grow_over_surface(features, grid_surface, 1.0, k=1, levels=2, sweeps=(1, 1), seed=2)
    row, col = grown.row.reshape(41, 41), grown.col.reshape(41, 41)
    down, right = np.mgrid[0:41, 0:41]
    np.testing.assert_allclose(wrapped(row - row[0, 0] - down, 16), 0, atol=1e-2)
    np.testing.assert_allclose(wrapped(col - col[0, 0] - right, 20), 0, atol=1e-2)


def test_coherent_triangles_are_those_of_the_vertices_own_motion(grid):
    level = grid(8, 8)
    down, right = (a.ravel().astype(np.float32) for a in np.mgrid[0:8, 0:8])
    assert coherent_triangles(level, down + 3, right + 2, 1.0, (32, 32), False).all()
    assert not coherent_triangles(level, down, -right, 1.0, (32, 32), False).any()  # mirrored
    jump = right + 5 * (right >= 4)
    whole = coherent_triangles(level, down, jump, 1.0, (32, 32), False).reshape(2, 7, 7)
    assert not whole[:, :, 3].any()
    assert whole[:, :, [0, 1, 2, 4, 5, 6]].all()
    jump = (right + 30) % 32  # the border of a toroidal sample is none
    assert coherent_triangles(level, down, jump, 1.0, (32, 32), True).all()
    assert not coherent_triangles(level, down, jump, 1.0, (32, 32), False).all()


def test_both_forms_of_the_distance_choose_alike(sphere_surface, make_features):
    features = make_features(rows=24, cols=24, levels=2, toroidal=False)
    a, b = (
        grow_over_surface(features, sphere_surface, k=5, levels=2, distance=form, seed=2)
        for form in ("gram", "vectors")
    )
    same = (a.row == b.row) & (a.col == b.col)
    assert same.mean() > 0.999  # float32 sums in another order may settle a tie otherwise


def test_the_gram_matrix_alone_decides_where_there_is_one(sphere_surface, make_features):
    features = make_features(rows=24, cols=24, levels=2)
    plain = grow_over_surface(features, sphere_surface, k=5, levels=2, seed=2)
    for level in features.levels:
        full = level.vectors.astype(np.float64)
        level.gram = (full @ full.T).astype(np.float32)
    by_gram = grow_over_surface(features, sphere_surface, k=5, levels=2, seed=2, distance="gram")
    same = (plain.row == by_gram.row) & (plain.col == by_gram.col)
    assert same.mean() > 0.99


def test_lists_of_all_texels_choose_as_full_search(grid, make_features):
    features = make_features(rows=8, cols=8, k=64, smooth=False)
    options = {"levels": 1, "sweeps": (3, 1), "seed": 4}
    surface = one_level(grid(14, 12))
    a = grow_over_surface(features, surface, 1.0, k=64, **options)
    b = grow_over_surface(features, surface, 1.0, full=True, **options)
    np.testing.assert_allclose(a.row, b.row, atol=1e-4)
    np.testing.assert_allclose(a.col, b.col, atol=1e-4)


def test_only_the_seed_decides(sphere_surface, make_features):
    features = make_features(rows=24, cols=24, levels=2)
    options = {"k": 5, "levels": 2}
    one = grow_over_surface(features, sphere_surface, seed=1, threads=1, **options)
    two = grow_over_surface(features, sphere_surface, seed=1, threads=2, memory=1, **options)
    other = grow_over_surface(features, sphere_surface, seed=2, threads=1, **options)
    assert one.row.tobytes() + one.col.tobytes() == two.row.tobytes() + two.col.tobytes()
    assert one.row.tobytes() != other.row.tobytes()


def test_wider_search_finds_nearer_neighbourhoods(sphere_surface, make_features):
    features = make_features(rows=24, cols=24, levels=2, k=11, toroidal=False)
    options = {"levels": 2, "sweeps": (2, 1), "coherence": 0.0}
    narrow, wide, full = (
        grow_over_surface(features, sphere_surface, **options, **search).about["synthesis"][0]
        for search in ({"k": 1}, {"k": 11}, {"full": True})
    )
    assert narrow["mean_distance"] > wide["mean_distance"] > 0.8 * full["mean_distance"]
    assert narrow["candidates"] < wide["candidates"] < full["candidates"]


def test_weighting_coherence_makes_larger_patches(sphere_surface, make_features):
    features = make_features(rows=32, cols=32, levels=2, toroidal=False)
    loose, firm = (
        coherence_facts(
            grow_over_surface(features, sphere_surface, k=5, levels=2, coherence=weight, seed=3),
            sphere_surface, (32, 32), False,
        )
        for weight in (0.0, 2.0)
    )  # fmt: skip
    assert firm["coherent_share"] > loose["coherent_share"] + 0.1
    assert firm["patch_texels"] > 1.5 * loose["patch_texels"]


def test_a_patch_that_leaves_the_sample_falls_back_to_full_search(sphere_surface, make_features):
    features = make_features(rows=12, cols=12, toroidal=False)
    surface = Surface(sphere_surface.levels[:1], digest="sphere")
    grown = grow_over_surface(features, surface, k=1, levels=1, sweeps=(1, 1))
    assert grown.about["synthesis"][0]["fallbacks"] > 0
    assert 1.5 <= grown.row.min() <= grown.row.max() <= 9.5


def test_scale_is_texels_per_unit_or_repeats_or_one_an_edge(grid):
    surface = one_level(grid(11, 21))
    assert scale_for(surface, (16, 20), texels_per_unit=3) == 3
    assert scale_for(surface, (16, 20), repeats=2) == pytest.approx(2 * 20 / 20)
    assert scale_for(surface, (16, 20)) == pytest.approx(3 / (2 + np.sqrt(2)))  # edges 1, 1, sqrt 2


def test_a_scale_far_from_the_mesh_is_refused(sphere_surface, make_features):
    features = make_features(levels=2)
    with pytest.raises(InputError, match="texels per edge of the surface; expected"):
        grow_over_surface(features, sphere_surface, 500.0, k=5, levels=2)


def test_more_levels_than_the_surface_has_are_refused(grid, make_features):
    with pytest.raises(InputError, match="the surface has 1 levels, fewer than --levels 2"):
        grow_over_surface(make_features(levels=2), one_level(grid(9, 9)), 1.0, k=5, levels=2)


def test_a_surface_without_usable_places_is_refused(grid, make_features):
    features = make_features(levels=2)
    fine, coarse = grid(9, 9), grid(5, 5, 2.0)
    with pytest.raises(InputError, match="does not say where the vertices of level 0"):
        grow_over_surface(features, Surface([fine, coarse]), 1.0, k=5, levels=2)
    fine.parent_face = np.full(81, 32, np.int32)
    fine.parent_weights = np.full((81, 3), 1 / 3, np.float32)
    with pytest.raises(InputError, match="names face 32 of level 1, which has 32"):
        grow_over_surface(features, Surface([fine, coarse]), 1.0, k=5, levels=2)


def test_a_dot_product_matrix_of_every_texel_is_refused(grid, make_features):
    features = make_features(rows=100, cols=100, k=None)
    with pytest.raises(InputError, match="10001 vectors would take"):
        grow_over_surface(features, one_level(grid(9, 9)), 1.0, k=1, levels=1, distance="gram")
