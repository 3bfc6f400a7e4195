"""The simulated measurement against analytic laws and the project's conventions."""

import numpy as np
import pytest

from btfpipe.directions import bonn81, from_angles
from btfpipe.simulation.goniometer import Goniometer
from btfpipe.simulation.patch import Patch, height_field
from btfpipe.simulation.tracing import Tracer


def direction(theta_deg, phi_deg):
    return from_angles(np.radians(theta_deg), np.radians(phi_deg))


def one_picture(patch, light, view, **options):
    goniometer = Goniometer(patch, **({"bounces": 0} | options))
    return goniometer.pictures(view, goniometer.light(light[None]), [0])[0]


def hilly(rng, n=16, depth=3.0, albedo=0.7, f0=0.0):
    i, j = np.meshgrid(*[np.arange(n) / n * 2 * np.pi] * 2, indexing="ij")
    heights = np.sin(i) * np.sin(2 * j) + 0.3 * np.cos(3 * i + j)
    heights *= depth / np.ptp(heights)
    return height_field(
        heights,
        rng.uniform(0.1, albedo, (n, n, 3)),
        np.full((n, n), 0.4),
        np.full((n, n, 3), f0),
        (8, 8),
    )


@pytest.mark.parametrize("view", [0, 40, 75])
def test_flat_diffuser_gives_albedo_times_cosine_at_every_direction(view):
    albedo = np.random.default_rng(3).uniform(size=(6, 6, 1, 1, 3))
    fine = np.broadcast_to(albedo, (6, 6, 4, 4, 3)).transpose(0, 2, 1, 3, 4).reshape(24, 24, 3)
    patch = height_field(np.zeros((24, 24)), fine, np.ones((24, 24)), fine * 0, (6, 6))
    lights = bonn81()
    goniometer = Goniometer(patch, bounces=2, rays=4)
    pictures = goniometer.pictures(bonn81()[view], goniometer.light(lights), range(81))
    # texel (i, j) of the picture holds vertices that interpolate to neighbours: compare means
    expected = fine.mean(axis=(0, 1)) * lights[:, 2, None]
    np.testing.assert_allclose(pictures.mean(axis=(1, 2)), expected, rtol=2e-2)
    uniform = height_field(
        np.zeros((6, 6)), np.full((6, 6, 3), 0.6), np.ones((6, 6)), np.zeros((6, 6, 3)), (6, 6)
    )
    goniometer = Goniometer(uniform, bounces=2, rays=4)
    pictures = goniometer.pictures(bonn81()[view], goniometer.light(lights), range(81))
    expected = np.broadcast_to(0.6 * lights[:, 2, None, None, None], pictures.shape)
    np.testing.assert_allclose(pictures, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("phi", "dark_rows", "dark_cols"),
    [
        # light from the right throws the shadow to the left, light from the picture's top downwards
        (0, slice(14, 18), slice(6, 14)),
        (90, slice(18, 26), slice(14, 18)),
        (180, slice(14, 18), slice(18, 26)),
        (270, slice(6, 14), slice(14, 18)),
    ],
)
def test_cast_shadow_falls_away_from_the_light_by_height_times_tangent(
    make_scene, phi, dark_rows, dark_cols
):
    patch = make_scene([((14, 18), (14, 18), 8)], boxes=True, floor=(1, 1, 1))
    picture = one_picture(patch, direction(45, phi), direction(0, 0))[..., 0]
    expected = np.full((32, 32), np.sqrt(0.5))
    expected[dark_rows, dark_cols] = 0
    np.testing.assert_allclose(picture, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("phi", "rows", "cols"),
    [
        # an eye at the right sees high things move to the left, an eye at the top sees them move down
        (0, slice(20, 24), slice(4, 8)),
        (90, slice(26, 30), slice(10, 14)),
        (180, slice(20, 24), slice(16, 20)),
        (270, slice(14, 18), slice(10, 14)),
    ],
)
def test_parallax_moves_high_things_away_from_the_eye(make_scene, phi, rows, cols):
    # a square whose picture from above is rows 20 to 23, columns 10 to 13
    patch = make_scene([((10, 14), (8, 12), 6)])
    picture = one_picture(patch, direction(0, 0), direction(45, phi))[..., 1]
    expected = np.zeros((32, 32))
    expected[rows, cols] = 1
    np.testing.assert_allclose(picture, expected, atol=1e-6)


def test_things_beyond_the_border_come_back_on_the_other_side(make_scene):
    inside = make_scene([((28, 32), (4, 8), 3), ((0, 3), (4, 8), 3)], boxes=True, floor=(1, 1, 1))
    across = make_scene([((28, 35), (4, 8), 3)], boxes=True, floor=(1, 1, 1))
    light, view = direction(60, 30), direction(50, 200)
    np.testing.assert_allclose(
        one_picture(inside, light, view), one_picture(across, light, view), atol=1e-5
    )


def test_rolled_structure_gives_rolled_picture(rng):
    n = 32
    heights, albedo = rng.normal(size=(8, 8)).repeat(4, 0).repeat(4, 1), rng.uniform(size=(n, n, 3))
    light, view = direction(70, 130), direction(75, 250)

    def picture(up, right):
        arrays = [np.roll(a, (up, right), (0, 1)) for a in (heights, albedo)]
        patch = height_field(*arrays, np.ones((n, n)), np.zeros((n, n, 3)), (8, 8))
        return one_picture(patch, light, view)

    # up in the structure is towards smaller rows in the picture
    expected = np.roll(picture(0, 0), (-3, 2), (0, 1))
    close = np.isclose(picture(12, 8), expected, atol=1e-4).all(axis=-1)
    assert close.mean() > 0.95  # rays that graze an edge may fall on either side


def test_grazing_rays_agree_with_a_larger_tile(rng):
    patch = hilly(rng, depth=6.0)
    n = len(patch.vertices)
    shifts = [(8 * s, 8 * t, 0) for s in range(6) for t in range(6)]
    wide = Patch(
        (48, 48),
        np.concatenate([patch.vertices + np.float32(shift) for shift in shifts]),
        np.concatenate([patch.faces + k * n for k in range(36)]),
        np.tile(patch.source, 36),
        patch.normals,
        patch.albedo,
        patch.roughness,
        patch.f0,
    )
    origins = rng.uniform([0, 0, -2], [8, 8, 3], (2000, 3)).astype(np.float32)
    small, large = Tracer(patch), Tracer(wide)
    for theta in (30, 80, 87, 89):
        light = direction(theta, 17).astype(np.float32)[None]
        np.testing.assert_array_equal(small.free(origins, light), large.free(origins, light))
        met, expected = small.meet(origins, -light), large.meet(origins, -light)
        face = np.where(expected.face < 0, -1, expected.face % len(patch.faces))
        assert (met.face == face).mean() > 0.999
        assert (face >= 0).mean() > 0.3
    assert (small.margin < 6 * np.tan(np.radians(87))).all()  # some rays did need a second leg


def groove_by_quadrature(slope_deg, albedo, bounces, n=400):
    """Values along one wall, from the ridge to the bottom, of an endless groove lit and seen from above."""
    a = np.radians(slope_deg)
    distance = (np.arange(n) + 0.5) / n  # from the bottom line along the wall
    # 2-D form factor density 0.5 cos cos / r between points of two walls that open by pi - 2 a
    opening = np.pi - 2 * a
    x, y = distance[:, None], distance[None]
    r2 = x * x + y * y - 2 * x * y * np.cos(opening)
    kernel = 0.5 * (y * np.sin(opening)) * (x * np.sin(opening)) / r2**1.5 / n
    term = np.full(n, albedo * np.cos(a))
    total = term.copy()
    for _ in range(bounces):
        term = albedo * kernel @ term
        total += term
    return total[::-1]


@pytest.mark.parametrize("bounces", [0, 1, 2, 5])
def test_light_between_the_walls_of_a_groove_matches_the_integral_equation(make_patch, bounces):
    # walls of 45 degrees, 16 texels deep, along t; an OBJ so that the ridge stays sharp
    n, albedo = 32, 0.8
    s = np.arange(2 * n + 1) / (2 * n) * 32
    z = np.abs(s - 16)
    vertices = np.concatenate([np.stack([s, np.full_like(s, t), z], 1) for t in (0, 2, 4)])
    k = np.concatenate([np.arange(2 * n) + row * (2 * n + 1) for row in range(2)])
    m = 2 * n + 1
    faces = np.concatenate([np.stack([k, k + 1, k + m + 1], 1), np.stack([k, k + m + 1, k + m], 1)])
    patch = make_patch(
        mesh=(vertices, faces, np.zeros(len(faces), int), ("wall",)),
        texels=[4, 32],
        texels_per_mm=1,
        vertices_per_texel=1,
        structure={"obj": {"file": "groove.obj"}},
        parts={"wall": {"albedo": [albedo] * 3}},
    )
    up = direction(0, 0)
    picture = one_picture(patch, up, up, bounces=bounces, rays=400)
    expected = groove_by_quadrature(45, albedo, bounces).reshape(16, 25).mean(axis=1)
    measured = picture[..., 0].mean(axis=0)
    np.testing.assert_allclose(measured[:15], expected[:15], rtol=0.01)
    np.testing.assert_allclose(measured[::-1][:15], expected[:15], rtol=0.01)


def test_polished_floor_shows_the_wall_behind_it(make_scene):
    patch = make_scene(
        [((0, 2), (0, 32), 12)],
        boxes=True,
        thing=(0.8, 0.4, 0.2),
        f0=1.0,
        roughness=0.05,
    )
    # light and eye at the right: the floor throws its own highlight away from the eye
    picture = one_picture(patch, direction(60, 0), direction(45, 0), samples=16, bounces=1, rays=16)
    wall_alone = np.array([0.8, 0.4, 0.2]) * np.sin(np.radians(60))
    seen = picture[:, 4:10].mean(axis=(0, 1))
    # the wall is also lit by the floor, so it is a little brighter than alone
    assert (seen > 0.9 * wall_alone).all()
    assert (seen < 2.2 * wall_alone).all()
    # farther out the mirrored rays pass over the wall
    assert picture[:, 15:19].mean() < 5e-3


def test_structure_darkens_no_part_below_zero_and_no_white_patch_reflects_more_than_it_gets(rng):
    """Seen from above, summed over a hemisphere of equal light, no texel exceeds 1."""
    patch = hilly(rng, albedo=1.0, f0=0.3)
    k = np.arange(400)
    radius, phi = np.sqrt((k + 0.5) / 400), k * 2.399963
    lights = np.stack([radius * np.cos(phi), radius * np.sin(phi)], 1)
    lights = np.concatenate([lights, np.sqrt(1 - radius**2)[:, None]], axis=1)
    goniometer = Goniometer(patch, samples=4, bounces=6, rays=32)
    pictures = goniometer.pictures(direction(40, 10), goniometer.light(lights), range(400))
    assert pictures.min() >= 0
    # lights are spread with the cosine: the mean of value / cos is the reflected share
    share = (pictures / lights[:, 2, None, None, None]).mean(axis=0)
    assert share.max() < 1.02
    assert share.mean() > 0.3
