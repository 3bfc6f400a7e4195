"""Lights, shadows, films: against the laws of geometry."""

import numpy as np
import pytest

from btfpipe.rendering import kernels
from btfpipe.rendering.camera import filter_table, strata
from btfpipe.surface import Surface
from btfpipe.surface.consistency import consistent_positions
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
    uv_sphere, scene_file, render_file, tmp_path
):
    """Normals disagree with small flat faces, in Mitsuba as here, until the geometry is made to agree."""
    level = _resampled_flat(uv_sphere(16, 32)[0], 3)
    direction = np.array([1, 0.3, -0.2]) / np.linalg.norm([1, 0.3, -0.2])
    lamp = {"type": "directional", "direction": direction, "irradiance": [np.pi] * 3}
    film = {"width": 200, "height": 200, "samples": 1, "filter": "box"}
    path = scene_file([{"mesh": "dense.npz", "albedo": [1, 1, 1]}], lights=[lamp], film=film)

    def dark_share():
        Surface([level]).save(tmp_path / "dense.npz")
        picture = render_file(path)
        lit = picture[..., 5:8] @ direction > 0
        return (lit & (picture[..., 0] == 0)).sum() / lit.sum()

    assert dark_share() > 0.01
    level.vertices = consistent_positions(level.vertices, level.faces, level.normals, 8)
    assert dark_share() <= 0.002


@pytest.mark.parametrize(("rings", "inverted"), [(8, False), (16, False), (8, True)])
@pytest.mark.parametrize("phase_deg", [40, 90, 130])
def test_lit_share_of_a_coarse_sphere_is_that_of_a_sphere(
    rings, inverted, phase_deg, uv_sphere, scene_file, render_file, tmp_path
):
    """Of a sphere's disc (1 + cos phase) / 2 is lit, be it turned inside out; facets in shadow take from it."""
    level = uv_sphere(rings, 2 * rings)[0]
    if inverted:
        level.faces, level.normals = level.faces[:, ::-1].copy(), -level.normals
    Surface([level]).save(tmp_path / "ball.npz")
    phase = np.radians(phase_deg)
    direction = [np.sin(phase), 0, np.cos(phase)]
    lamp = {"type": "directional", "direction": direction, "irradiance": [np.pi] * 3}
    film = {"width": 200, "height": 200, "samples": 1, "filter": "box"}
    ball = {"mesh": "ball.npz", "albedo": [1, 1, 1]}
    picture = render_file(scene_file([ball], lights=[lamp], film=film))
    seen = picture[..., 3] == 1
    share = (seen & (picture[..., 0] > 0)).sum() / seen.sum()
    facing = seen & (picture[..., 5:8] @ direction > 0)
    assert (facing & (picture[..., 0] == 0)).sum() <= 0.002 * facing.sum()
    # the outline of the coarse mesh, inside the circle, takes this much from it
    outline = seen.sum() / (np.pi * (200 / 2.2) ** 2)
    assert share == pytest.approx((1 + np.cos(phase)) / 2, abs=1.2 * (1 - outline) + 0.005)
    assert outline > 0.96


def _box(low, high):
    """A closed box whose normals are those of its faces, as a level of 24 vertices."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = (np.array(low) + corner * (np.array(high) - low))[np.ravel(quads)]
    faces = (4 * np.arange(6)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    side = vertices[faces[::2]]
    normals = np.cross(side[:, 1] - side[:, 0], side[:, 2] - side[:, 1])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 4, axis=0)
    tangents = np.cross(normals, normals[:, [1, 2, 0]])
    return Level(
        vertices.astype(float), faces.astype(np.int32), normals.astype(np.float32),
        tangents.astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("size", [6, 0.01])
def test_shadow_of_a_box_touches_the_box(size, scene_file, render_file, tmp_path):
    """From above: left of the box as far as it is high, for light of 45 degrees from the right, else none."""
    Surface([_box([-1, -1, -1], [1, 0, 1])]).save(tmp_path / "box.npz")
    box = {"mesh": "box.npz", "albedo": [1, 1, 1]}
    lamp = {"type": "directional", "direction": [1, 1, 0], "irradiance": [np.pi] * 3}
    for middle in (-1, 1):
        camera = ABOVE | {"position": [middle, 8, 0], "target": [middle, 0, 0], "height": size}
        picture = render_file(scene_file([box, GROUND], camera=camera, lights=[lamp]))
        x, z = np.meshgrid((np.arange(64) + 0.5) / 64 - 0.5, (np.arange(64) + 0.5) / 64 - 0.5)
        x, z = middle + size * x, size * z
        top = (abs(x) < 1) & (abs(z) < 1)
        dark = (x > -2) & (x < -1) & (abs(z) < 1)
        albedo = np.where(top, 1, 0.8)
        np.testing.assert_allclose(
            picture[..., 0], np.where(dark, 0, albedo * np.sqrt(0.5)), rtol=1e-5
        )
        np.testing.assert_allclose(picture[..., 4], np.where(top, 8, 9), rtol=1e-6)


def test_a_small_post_throws_its_whole_shadow_on_a_resampled_sphere(
    uv_sphere, scene_file, render_file, tmp_path
):
    """Where normals disagree with faces, too, shadows begin at the foot of what throws them."""
    Surface([_resampled_flat(uv_sphere(16, 32)[0], 3)]).save(tmp_path / "ball.npz")
    Surface([_box([-0.01, 0.9, 0.37], [0.01, 0.94, 0.39])]).save(tmp_path / "post.npz")
    things = [{"mesh": f"{name}.npz", "albedo": [1, 1, 1]} for name in ("ball", "post")]
    # across the sphere's meridian, so that its surface falls away little along the shadow
    lamp = {"type": "directional", "direction": [1, 1, 0], "irradiance": [1, 1, 1]}
    camera = ABOVE | {"position": [0, 8, 0.38], "target": [0, 0, 0.38], "height": 0.1}
    picture = render_file(scene_file(things, camera=camera, lights=[lamp]))
    x, z = np.meshgrid((np.arange(64) + 0.5) / 64 - 0.5, (np.arange(64) + 0.5) / 64 - 0.5)
    x, z = 0.1 * x, 0.1 * z
    ground = 8 - picture[32, 10, 4]
    foot = (x > -0.0095 - (0.94 - ground) + 0.003) & (x < -0.01) & (abs(z) < 0.0095)
    assert foot.sum() > 100
    assert (picture[foot][:, 0] == 0).all()
    clear = (x > 0.01) | (abs(z) > 0.0105) | (x < -0.01 - (0.94 - ground) - 0.003)
    assert (picture[clear][:, 0] > 0).all()


def test_inside_of_a_thin_bowl_is_lit_as_its_normals_say(
    uv_sphere, scene_file, render_file, tmp_path
):
    """Half a coarse sphere seen and lit from its open side: the offset goes to the side that is seen."""
    level = uv_sphere(16, 32)[0]
    level.faces = level.faces[(level.vertices[level.faces][..., 2] < 1e-9).all(axis=1)]
    Surface([level]).save(tmp_path / "bowl.npz")
    bowl = {"mesh": "bowl.npz", "albedo": [1, 1, 1]}
    picture = render_file(scene_file([bowl]))
    seen = picture[..., 3] == 1
    assert 0.9 < seen.sum() / (np.pi * (64 / 2.2) ** 2) <= 1
    np.testing.assert_allclose(picture[seen][:, 0], picture[seen][:, 7], rtol=1e-5)
    assert picture[seen][:, 7].min() > 0
    behind = {"type": "directional", "direction": [0, 0, -1], "irradiance": [1, 1, 1]}
    assert (render_file(scene_file([bowl], lights=[behind]))[..., 0] == 0).all()


@pytest.mark.parametrize("below", [2.0, 1e-3, 0.0])
def test_walls_of_a_room_behind_its_lamp_do_not_block_it(below, scene_file, render_file):
    """A lamp under the ceiling of a room of six walls, and on it: the floor is lit as if nothing were there."""

    def wall(center, s, t):
        return {
            "plane": {"center": center, "s": s, "t": t, "size": [8, 8]},
            "albedo": [0.5, 0.5, 0.5],
        }

    x, y, z = np.eye(3)
    walls = [wall(4 * a * sign, b, c * sign) for a, b, c in ((x, y, z), (y, z, x), (z, x, y))
             for sign in (-1, 1)]  # fmt: skip
    height = 8 - below
    lamp = {"type": "point", "position": [0.3, 4 - below, 0.2], "intensity": [1, 1, 1]}
    camera = ABOVE | {"position": [0, 3.9, 0]}
    picture = render_file(scene_file(walls, camera=camera, lights=[lamp]))
    x, z = np.meshgrid((np.arange(64) + 0.5) / 64 * 6 - 3, (np.arange(64) + 0.5) / 64 * 6 - 3)
    squared = (x - 0.3) ** 2 + (z - 0.2) ** 2 + height**2
    np.testing.assert_allclose(picture[..., 0], 0.5 / np.pi * height / squared**1.5, rtol=1e-4)


def test_shadow_rays_end_at_a_lamp_near_a_coarse_sphere(
    uv_sphere, scene_file, render_file, tmp_path
):
    """They start off the facet; parallel to the facet's direction they would pass the lamp and meet the card."""
    Surface([uv_sphere(8, 16)[0]]).save(tmp_path / "ball.npz")
    ball = {"mesh": "ball.npz", "albedo": [1, 1, 1]}
    place = np.array([0.05, 0.1, 1.03])
    card = {
        "plane": {"center": [*place[:2], 1.032], "s": [1, 0, 0], "t": [0, 1, 0], "size": [3, 3]},
        "albedo": [1, 1, 1],
    }
    lamp = {"type": "point", "position": place, "intensity": [1, 1, 1]}
    camera = {"type": "orthographic", "position": [0, 0, 1.031], "target": [0, 0, 0], "height": 1}
    picture = render_file(scene_file([ball, card], camera=camera, lights=[lamp]))
    x, y = np.meshgrid((np.arange(64) + 0.5) / 64 - 0.5, 0.5 - (np.arange(64) + 0.5) / 64)
    toward = place - np.stack([x, y, 1.031 - picture[..., 4]], axis=-1)
    squared = (toward**2).sum(axis=-1)
    expected = np.maximum((toward * picture[..., 5:8]).sum(axis=-1), 0) / squared**1.5 / np.pi
    near = squared < 0.2**2
    assert near.sum() > 300
    np.testing.assert_allclose(picture[..., 0][near], expected[near], rtol=1e-3)


@pytest.mark.parametrize("side", [1, -1])
def test_a_normal_that_leaves_its_face_does_not_sink_the_shadow_ray(side):
    """At a knife's edge a mean normal may point to the other side of a face."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    normals = np.array([[-0.9 * side, 0, -0.436], [0, 0, 1], [0, 0, 1]], np.float32)
    n, share, three = 1, np.empty((1, 3)), [np.empty((1, 3)) for _ in range(3)]
    origins, directions = np.array([[0.4, 0.3, 2.0 * side]]), np.array([[0, 0, -1.0 * side]])
    kernels.surface_points(
        np.zeros(n, np.int64), np.zeros(n, np.int32), origins, directions, vertices,
        np.array([[0, 1, 2]], np.int32), normals, share, *three, np.empty(n), np.empty(n),
    )  # fmt: skip
    point, start, _ = three
    np.testing.assert_allclose(point, [[0.4, 0.3, 0]], atol=1e-12)
    assert 0 < side * start[0, 2] < 1e-4


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
