"""Lights, shadows, films: against the laws of geometry."""

import numpy as np
import pytest

from btfpipe.rendering.camera import filter_table, strata
from btfpipe.rendering.clearance import clearance
from btfpipe.surface import Surface
from btfpipe.surface.surface import Level

GROUND = {
    "plane": {"center": [0, -1, 0], "s": [1, 0, 0], "t": [0, 0, -1], "size": [12, 12]},
    "albedo": [0.8, 0.4, 0.2],
}
ABOVE = {
    "type": "orthographic",
    "position": [0, 8, 0],
    "target": [0, 0, 0],
    "up": [0, 0, -1],
    "height": 6,
}


def test_point_light_falls_off_with_the_square_of_the_distance(scene_file, render_file):
    height = 2.0
    lamp = {"type": "point", "position": [0.5, -1 + height, 0], "intensity": [10, 20, 30]}
    picture = render_file(scene_file([GROUND], camera=ABOVE, lights=[lamp]))
    x, z = np.meshgrid((np.arange(64) + 0.5) / 64 * 6 - 3, (np.arange(64) + 0.5) / 64 * 6 - 3)
    squared = (x - 0.5) ** 2 + z**2 + height**2
    irradiance = np.array([10, 20, 30]) * (height / np.sqrt(squared) / squared)[..., None]
    expected = irradiance * [0.8, 0.4, 0.2] / np.pi
    np.testing.assert_allclose(picture[..., :3], expected, rtol=1e-4)


@pytest.mark.parametrize("place", [[0, 1.2, 0], [0.9, 1.1, 0.9], [0.5, 4.0, 0.5]])
def test_what_lies_behind_a_point_light_throws_no_shadow(scene_file, render_file, place):
    """A card above the lamp is as if it were not there; one below it hides the lamp from its own shadow alone."""
    lamp = {"type": "point", "position": [0.5, 1, 0.5], "intensity": [10, 20, 30]}
    card = {
        "plane": {"center": place, "s": [1, 0, 0], "t": [0, 0, -1], "size": [8, 8]},
        "albedo": [0, 0, 0],
    }
    under = ABOVE | {"position": [0, 0.9, 0]}
    bare, covered = (
        render_file(scene_file(objects, camera=under, lights=[lamp]))
        for objects in ([GROUND], [GROUND, card])
    )
    assert bare[..., :3].min() > 0
    np.testing.assert_array_equal(covered[..., :3], bare[..., :3])


def test_what_lies_before_a_point_light_throws_a_widening_shadow(scene_file, render_file):
    lamp = {"type": "point", "position": [0.5, 1, 0.5], "intensity": [10, 20, 30]}
    card = {
        "plane": {"center": [0.5, 0.5, 0.5], "s": [1, 0, 0], "t": [0, 0, -1], "size": [0.5, 0.3]},
        "albedo": [0, 0, 0],
    }
    below = ABOVE | {"position": [0, -0.5, 0], "target": [0, -1, 0]}
    bare, covered = (
        render_file(scene_file(objects, camera=below, lights=[lamp]))[..., :3]
        for objects in ([GROUND], [GROUND, card])
    )
    x, z = np.meshgrid((np.arange(64) + 0.5) / 64 * 6 - 3, (np.arange(64) + 0.5) / 64 * 6 - 3)
    # a quarter of the way from the lamp to the ground: four times as wide and deep
    out = np.maximum(np.abs(x - 0.5) - 1.0, np.abs(z - 0.5) - 0.6)
    assert bare.min() > 0
    assert (out < -0.02).sum() > 200
    assert (covered[out < -0.02] == 0).all()
    np.testing.assert_array_equal(covered[out > 0.02], bare[out > 0.02])


def test_two_lights_add_up(scene_file, render_file):
    lamps = [
        {"type": "directional", "direction": [1, 2, 0], "irradiance": [1, 2, 3]},
        {"type": "point", "position": [0, 4, 1], "intensity": [30, 20, 10]},
    ]
    both = render_file(scene_file([GROUND], camera=ABOVE, lights=lamps))
    alone = [render_file(scene_file([GROUND], camera=ABOVE, lights=[lamp])) for lamp in lamps]
    np.testing.assert_allclose(both[..., :3], alone[0][..., :3] + alone[1][..., :3], rtol=1e-5)


def test_sphere_throws_the_shadow_that_geometry_says(
    sphere, lambertian, scene_file, render_file, tmp_path
):
    lambertian().save(tmp_path / "m.sample.npz")
    entry = sphere()
    direction = np.array([1.0, 1.0, 0.3])
    direction /= np.linalg.norm(direction)
    lamp = {"type": "directional", "direction": direction, "irradiance": [np.pi] * 3}
    film = {"width": 96, "height": 96, "samples": 1, "filter": "box"}
    picture = render_file(scene_file([entry, GROUND], camera=ABOVE, lights=[lamp], film=film))
    x, z = np.meshgrid((np.arange(96) + 0.5) / 96 * 6 - 3, (np.arange(96) + 0.5) / 96 * 6 - 3)
    point = np.stack([x, np.full_like(x, -1), z], axis=-1)
    nearest = np.linalg.norm(np.cross(point, direction), axis=-1)  # of the shadow ray to the centre
    seen = x**2 + z**2 > 1.02**2
    shadow, light = (nearest < 0.97) & seen, (nearest > 1.03) & seen
    assert shadow.sum() > 100
    assert (picture[shadow][:, :3] == 0).all()
    expected = np.broadcast_to(np.array([0.8, 0.4, 0.2]) * direction[1], (96, 96, 3))
    np.testing.assert_allclose(picture[..., :3][light], expected[light], rtol=1e-5)


@pytest.mark.parametrize("rings", [16, 96])
def test_facets_do_not_shade_a_smooth_surface(
    rings, sphere, lambertian, scene_file, render_file, tmp_path
):
    """Where light grazes, a facet lies in its neighbours' shadow though the smooth surface does not."""
    lambertian().save(tmp_path / "m.sample.npz")
    entry = sphere(rings=rings, segments=2 * rings)
    lamp = {"type": "directional", "direction": [1, 0.3, -0.2], "irradiance": [np.pi] * 3}
    film = {"width": 200, "height": 200, "samples": 1, "filter": "box"}
    picture = render_file(scene_file([entry], lights=[lamp], film=film))
    direction = np.array([1, 0.3, -0.2]) / np.linalg.norm([1, 0.3, -0.2])
    cosine = np.maximum(picture[..., 5:8] @ direction, 0)
    lit = cosine > 0
    dark = lit & (picture[..., 0] == 0)
    assert np.abs(picture[..., 0] - cosine).max() < 0.01
    assert dark.sum() <= 0.002 * lit.sum()


def _resampled_flat(level, times):
    """The same mesh with smaller faces: vertices stay on the flat facets, normals are interpolated."""
    vertices, normals, faces = level.vertices, level.normals.astype(float), level.faces
    for _ in range(times):
        edges = np.sort(
            np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1
        )
        unique, place = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = len(vertices) + place.reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        normals = np.concatenate([normals, normals[unique].mean(axis=1)])
        a, b, c = faces.T
        faces = np.concatenate(
            [np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tangents = np.cross([0.3, 0.8, 0.1], normals)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return Level(
        vertices, faces.astype(np.int32), normals.astype(np.float32), tangents.astype(np.float32)
    )


def test_facets_of_a_densely_resampled_coarse_mesh_do_not_shade_it(
    uv_sphere, scene_file, render_file, tmp_path, monkeypatch
):
    from btfpipe.rendering import renderer

    Surface([_resampled_flat(uv_sphere(16, 32)[0], 3)]).save(tmp_path / "dense.npz")
    lamp = {"type": "directional", "direction": [1, 0.3, -0.2], "irradiance": [np.pi] * 3}
    film = {"width": 200, "height": 200, "samples": 1, "filter": "box"}
    path = scene_file([{"mesh": "dense.npz", "albedo": [1, 1, 1]}], lights=[lamp], film=film)
    direction = np.array([1, 0.3, -0.2]) / np.linalg.norm([1, 0.3, -0.2])

    def dark_share():
        picture = render_file(path)
        lit = picture[..., 5:8] @ direction > 0
        return (lit & (picture[..., 0] == 0)).sum() / lit.sum()

    assert dark_share() <= 0.002
    monkeypatch.setattr(
        renderer, "clearance", lambda vertices, faces, normals: np.zeros(len(vertices))
    )
    assert dark_share() > 0.01


def test_clearance_is_nothing_where_normals_and_facets_agree(uv_sphere):
    level, *_ = uv_sphere(24, 48)
    assert clearance(level.vertices, level.faces, level.normals).max() < 1e-3
    flat = level.vertices * [1, 1, 0]
    up = np.broadcast_to(np.float32([0, 0, 1]), flat.shape)
    assert clearance(flat, level.faces, np.ascontiguousarray(up)).max() == 0


def test_near_things_still_throw_shadows(scene_file, render_file):
    """A card that hovers a thousandth of its size above the ground darkens it."""
    card = {
        "plane": {"center": [0, -0.999, 0], "s": [1, 0, 0], "t": [0, 0, -1], "size": [1, 1]},
        "albedo": [1, 1, 1],
    }
    lamp = {"type": "directional", "direction": [0, 1, 0], "irradiance": [1, 1, 1]}
    below = ABOVE | {"position": [0, -0.9995, 0], "target": [0, -2, 0], "height": 0.5}
    assert (
        render_file(scene_file([card, GROUND], camera=below, lights=[lamp]))[..., :3] == 0
    ).all()


@pytest.mark.parametrize(("kind", "radius"), [("box", 0.5), ("tent", 1.0), ("gaussian", 1.5)])
def test_filter_offsets_follow_the_filter(kind, radius):
    table = filter_table(kind, radius)
    assert table[0] == pytest.approx(-radius)
    assert table[-1] == pytest.approx(radius)
    np.testing.assert_allclose(table, -table[::-1], atol=1e-9)
    u = (np.arange(100_000) + 0.5) / 100_000
    offsets = np.interp(u, np.linspace(0, 1, len(table)), table)
    x = np.linspace(-radius, radius, 20_001)
    weight = {
        "box": np.ones_like(x),
        "tent": radius - np.abs(x),
        "gaussian": np.exp(-0.5 * (3 * x / radius) ** 2),
    }[kind]
    variance = (weight * x**2).sum() / weight.sum()
    assert offsets.var() == pytest.approx(variance, rel=0.01)


def test_rays_of_a_pixel_are_stratified():
    assert strata(16) == (4, 4)
    assert strata(12) == (3, 4)
    assert strata(7) == (1, 7)


def test_background_and_coverage(scene_file, render_file):
    card = {
        "plane": {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [1.1, 1.1]},
        "albedo": [1, 1, 1],
    }
    film = {"width": 64, "height": 64, "samples": 64, "filter": "box"}
    plain = render_file(scene_file([card], film=film))
    assert plain[..., 3].mean() == pytest.approx(0.25, abs=1e-3)
    np.testing.assert_allclose(plain[..., 0], plain[..., 3], atol=1e-5)  # colour has alpha in it
    assert (plain[0, 0] == [0, 0, 0, 0, 0, 0, 0, 0, -1, -1]).all()
    assert plain[32, 32, 4] == pytest.approx(5)
    np.testing.assert_allclose(plain[32, 32, 5:8], [0, 0, 1], atol=1e-6)
    behind = render_file(scene_file([card], film=film, background=[0.2, 0.4, 0.6]))
    assert (behind[..., 3] == 1).all()
    np.testing.assert_allclose(behind[0, 0, :3], [0.2, 0.4, 0.6], rtol=1e-6)
    np.testing.assert_allclose(
        behind[..., :3], plain[..., :3] + (1 - plain[..., 3:4]) * [0.2, 0.4, 0.6], atol=1e-6
    )
