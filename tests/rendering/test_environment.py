"""Environment maps: against integrals in closed form, against the sum over all pixels, and in pictures."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.errors import InputError
from btfpipe.formats.images import colours, open_picture, write_picture
from btfpipe.rendering.environment import METHODS, Environment, healpix
from btfpipe.rendering.objects import rotation
from btfpipe.rendering.renderer import render
from btfpipe.rendering.scene import load_scene

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
WHITE = {"plane": {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [2, 2]}}
WHITE["albedo"] = [1, 1, 1]


def directions_of(projection, rows, cols):
    """Debevec's formulas as he writes them down, pixel by pixel; NaN outside a probe's circle."""
    out = np.full((rows, cols, 3), np.nan)
    for i in range(rows):
        for j in range(cols):
            if projection == "latlong":
                u, v = 2 * (j + 0.5) / cols, (i + 0.5) / rows
                theta, phi = np.pi * (u - 1), np.pi * v
                out[i, j] = np.sin(phi) * np.sin(theta), np.cos(phi), -np.sin(phi) * np.cos(theta)
                continue
            u, v = 2 * (j + 0.5) / cols - 1, 1 - 2 * (i + 0.5) / rows
            theta, phi = np.arctan2(v, u), np.pi * np.hypot(u, v)
            if phi < np.pi:
                # (0, 0, -1) turned by phi about y, then by theta about -z
                x = np.sin(phi)
                out[i, j] = x * np.cos(theta), x * np.sin(theta), -np.cos(phi)
    return out


def picture_of(function, projection, rows=64):
    """A map of a function of directions."""
    directions = directions_of(projection, rows, 2 * rows if projection == "latlong" else rows)
    return np.nan_to_num(function(directions)).astype(np.float32)


def lobes(directions):
    """A dim room, a warm lamp and two coloured windows."""
    out = np.full(directions.shape, 0.1)
    for towards, sharp, colour in (
        ([0.3, 0.9, 0.4], 60, [30, 20, 10]),
        ([-0.8, 0.1, -0.5], 8, [1, 2, 4]),
        ([0.5, -0.2, 0.8], 15, [2, 5, 1]),
    ):
        cosine = np.maximum(directions @ towards / np.linalg.norm(towards), 0)
        out += cosine[..., None] ** sharp * np.array(colour)
    return out


def normals(count, seed=3):
    out = np.random.default_rng(seed).standard_normal((count, 3))
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def irradiance(directions, powers, facing):
    """Of surfaces with the given normals, (n, 3)."""
    return np.maximum(facing @ directions.T, 0) @ powers


def brute_force(environment, facing):
    return np.array([environment.integrate(lambda w, n=n: np.maximum(w @ n, 0)) for n in facing])


@pytest.mark.parametrize("projection", ["latlong", "probe"])
def test_pixels_are_where_the_formulas_say_and_hold_their_solid_angles(projection):
    shape = (12, 24) if projection == "latlong" else (15, 15)
    environment = Environment(np.ones((*shape, 3)), projection)
    directions, solid_angles, _ = environment.pixels()
    expected = directions_of(projection, *shape).reshape(-1, 3)
    np.testing.assert_allclose(directions, expected[~np.isnan(expected[:, 0])], atol=1e-12)
    assert solid_angles.sum() == pytest.approx(4 * np.pi)
    # pixels at a probe's rim are cut to whole ones
    np.testing.assert_allclose(
        solid_angles @ directions, 0, atol=0.02 if projection == "probe" else 1e-12
    )


@pytest.mark.parametrize("projection", ["latlong", "probe"])
def test_integrals_over_all_pixels_are_those_of_calculus(projection):
    """Radiance that falls with the cosine from the zenith, on a surface that faces up, at an angle, and down."""
    up = picture_of(lambda w: np.maximum(w[..., 1:2], 0) * [1, 2, 3], projection, 128)
    environment = Environment(up)
    np.testing.assert_allclose(environment.power, np.pi * np.array([1, 2, 3]), rtol=1e-3)
    found = brute_force(environment, np.array([[0.0, 1, 0], [1, 0, 0], [0, -1, 0]]))
    # integrals of cos^2, and of |cos| sin^2 sin(azimuth) over a quarter of the sphere
    expected = np.array([2 * np.pi / 3, 2 / 3, 0])[:, None] * [1, 2, 3]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("projection", "row", "col", "towards"),
    [
        ("latlong", 0.5, 0.5, [0, 0, -1]),
        ("latlong", 0.5, 0.75, [1, 0, 0]),
        ("latlong", 0.5, 0.25, [-1, 0, 0]),
        ("latlong", 0.5, 0.0, [0, 0, 1]),
        ("latlong", 0.0, 0.3, [0, 1, 0]),
        ("latlong", 1.0, 0.3, [0, -1, 0]),
        ("probe", 0.5, 0.5, [0, 0, -1]),
        ("probe", 0.5, 0.75, [1, 0, 0]),
        ("probe", 0.25, 0.5, [0, 1, 0]),
        ("probe", 0.75, 0.5, [0, -1, 0]),
        ("probe", 0.5, 1.0, [0, 0, 1]),
    ],
)
def test_bright_pixel_is_a_light_from_its_side(method, projection, row, col, towards):
    rows, cols = (64, 128) if projection == "latlong" else (64, 64)
    values = np.zeros((rows, cols, 3))
    values[min(int(row * rows), rows - 1), min(int(col * cols), cols - 1)] = [1, 2, 3]
    environment = Environment(values)
    directions, powers = environment.lights(20, method)
    assert len(directions) == 1
    assert directions[0] @ towards > np.cos(1.5 * 2 * np.pi / 64)
    np.testing.assert_allclose(powers[0], environment.power, rtol=1e-12)
    assert environment.radiance(directions[0]) == pytest.approx([1, 2, 3], rel=1e-5)
    aside = np.roll(directions[0], 1)
    assert (environment.radiance(aside) == 0).all()


def test_probe_and_latitude_longitude_of_one_scene_are_the_same_light():
    flat = Environment(picture_of(lobes, "latlong", 96))
    ball = Environment(picture_of(lobes, "probe", 160))
    np.testing.assert_allclose(ball.power, flat.power, rtol=1e-3)
    facing = normals(50)
    np.testing.assert_allclose(ball.radiance(facing), lobes(facing), rtol=0.02, atol=0.01)
    np.testing.assert_allclose(flat.radiance(facing), lobes(facing), rtol=0.02, atol=0.01)
    expected = brute_force(flat, facing)
    np.testing.assert_allclose(brute_force(ball, facing), expected, rtol=2e-3)
    for environment in (flat, ball):
        found = irradiance(*environment.lights(200), facing)
        np.testing.assert_allclose(found, expected, rtol=0.02)


@settings(max_examples=20, deadline=None)
@given(
    st.integers(4, 9),
    st.sampled_from(["latlong", "probe"]),
    st.floats(-400, 400),
    st.integers(0, 99),
)
def test_pixel_centres_return_their_pixels_and_halfway_their_means(rows, projection, turned, seed):
    cols = rows if projection == "probe" else rows + seed % 7
    values = np.random.default_rng(seed).random((rows, cols, 3)).astype(np.float32)
    turn = rotation({"rotate_deg": turned, "axis": [1, 2, -0.5]})
    environment = Environment(values, projection, turn=turn)
    own = directions_of(projection, rows, cols)
    inside = ~np.isnan(own[..., 0])
    np.testing.assert_allclose(
        environment.radiance(own[inside] @ turn.T), values[inside], rtol=1e-4, atol=1e-6
    )
    if projection == "latlong":  # across the seam too
        between = own + np.roll(own, -1, axis=1)
        between *= np.sqrt(1 - own[..., 1:2] ** 2) / np.linalg.norm(
            between[..., [0, 2]], axis=-1, keepdims=True
        )
        between[..., 1] = own[..., 1]
        mean = (values + np.roll(values, -1, axis=1)) / 2
        np.testing.assert_allclose(environment.radiance(between @ turn.T), mean, rtol=1e-4)


def test_probe_is_not_darkened_at_its_rim():
    values = picture_of(lambda w: 0 * w + 1, "probe", 33)
    assert (values == 0).any()
    behind = normals(2000) * [0.05, 0.05, 1]
    behind[:, 2] = np.abs(behind[:, 2])
    behind /= np.linalg.norm(behind, axis=1, keepdims=True)
    np.testing.assert_allclose(Environment(values).radiance(behind), 1, rtol=1e-6)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(["q2tree", "median-cut"]),
    st.sampled_from([(6, 12), (5, 9), (12, 12), (16, 32)]),
    st.integers(12, 600),
    st.integers(0, 999),
)
def test_lights_carry_the_power_of_the_map(method, shape, count, seed):
    rng = np.random.default_rng(seed)
    values = rng.random((*shape, 3)) ** 8 * (rng.random(shape) < 0.5)[..., None]
    environment = Environment(values, "probe" if shape[0] == shape[1] else "latlong", intensity=2.5)
    directions, powers = environment.lights(count, method)
    assert 0 < len(directions) <= count
    np.testing.assert_allclose(powers.sum(axis=0), environment.power, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-12)
    assert (powers >= 0).all()
    again = environment.lights(count, method)
    assert (again[0] == directions).all()
    assert (again[1] == powers).all()


def test_random_lights_are_right_on_average():
    """Deviations of the mean over seeds: of the power, channel by channel, and of irradiance on surfaces of all sides."""
    environment = Environment(picture_of(lobes, "latlong", 24))
    facing = normals(6)
    expected = np.vstack([environment.power[None], brute_force(environment, facing)])
    found = []
    for seed in range(400):
        directions, powers = environment.lights(16, "alias", seed)
        assert powers.sum(axis=0) @ LUMINANCE == pytest.approx(environment.power @ LUMINANCE)
        found.append(np.vstack([powers.sum(axis=0)[None], irradiance(directions, powers, facing)]))
    error = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    assert (error > 0).all()
    z = (np.mean(found, axis=0) - expected) / error
    assert np.abs(z).max() < 3.5  # 21 of them: one chance in a hundred
    # and the spread of the numbers is theirs, not smaller
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6


def test_random_lights_follow_the_power_of_the_pixels():
    values = np.random.default_rng(5).random((4, 8, 3)) ** 3
    environment = Environment(values)
    count = 200_000
    directions, powers = environment.lights(count, "alias", 7)
    pixels, solid_angles, radiances = environment.pixels()
    assert (directions == pixels).all()
    share = solid_angles * (radiances @ LUMINANCE)
    share /= share.sum()
    times = (powers @ LUMINANCE) / (powers @ LUMINANCE).sum() * count
    squared = (times - count * share) ** 2 / (count * share)
    assert 5 < squared.sum() < 62  # chi squared of 31 degrees of freedom: 1e-3 at most outside


@pytest.mark.parametrize("projection", ["latlong", "probe"])
def test_error_of_the_quadtree_falls_with_the_number_of_lights(projection):
    environment = Environment(picture_of(lobes, projection, 64))
    facing = normals(100)
    expected = brute_force(environment, facing)
    errors = []
    for count in (12, 48, 192, 768):
        found = irradiance(*environment.lights(count), facing)
        errors.append(np.sqrt(((found - expected) ** 2).mean() / (expected**2).mean()))
    assert errors[0] < 0.2
    assert all(b < 0.6 * a for a, b in itertools.pairwise(errors))
    assert errors[-1] < 0.002


def test_roots_of_the_quadtree_are_those_of_healpix():
    """Centres as Górski et al. give them for twelve pixels; equal areas; neighbours stay together."""
    azimuth = np.pi / 2 * np.concatenate([np.arange(4) + 0.5, np.arange(4), np.arange(4) + 0.5])
    height = np.repeat([2 / 3, 0, -2 / 3], 4)
    across = np.sqrt(1 - height**2)
    centres = np.stack([across * np.sin(azimuth), height, across * np.cos(azimuth)], axis=1)
    quad, u, v = healpix(centres)
    assert list(quad) == list(range(12))
    np.testing.assert_allclose([u, v], 0.5, atol=1e-12)
    directions = normals(200_000)
    quad, u, v = healpix(directions)
    assert min(u.min(), v.min()) >= 0
    assert max(u.max(), v.max()) <= 1
    cell = (quad * 4 + np.minimum((u * 4).astype(int), 3)) * 4 + np.minimum((v * 4).astype(int), 3)
    times = np.bincount(cell, minlength=192)
    squared = ((times - times.mean()) ** 2 / times.mean()).sum()
    assert 130 < squared < 260  # chi squared of 191 degrees of freedom
    for k in range(192):  # no cell is torn: all of it within a circle
        mine = directions[cell == k]
        middle = mine.mean(axis=0) / np.linalg.norm(mine.mean(axis=0))
        assert (mine @ middle).min() > np.cos(0.32)


def test_quadtree_of_a_uniform_map_has_equal_lights():
    environment = Environment(np.ones((128, 256, 3)))
    for count in (12, 48, 192):
        directions, powers = environment.lights(count)
        assert len(directions) == count
        np.testing.assert_allclose(powers, 4 * np.pi / count, rtol=0.1)


def test_median_cut_gives_lights_of_equal_power():
    environment = Environment(picture_of(lobes, "latlong", 64))
    powers = environment.lights(32, "median-cut")[1] @ LUMINANCE
    assert len(powers) == 32
    np.testing.assert_allclose(powers, powers.mean(), rtol=0.1)
    thirds = environment.lights(3, "median-cut")[1] @ LUMINANCE
    np.testing.assert_allclose(thirds, thirds.mean(), rtol=0.02)


def test_turned_map_turns_its_lights_and_nothing_else():
    values = picture_of(lobes, "latlong", 32)
    turn = rotation({"rotate_deg": 50, "axis": [1, -2, 0.4]})
    for method in METHODS:
        still, turned = (
            Environment(values, turn=t).lights(40, method, 3) for t in (np.eye(3), turn)
        )
        np.testing.assert_allclose(turned[0], still[0] @ turn.T, atol=1e-12)
        np.testing.assert_array_equal(turned[1], still[1])
    quarter = rotation(
        {"rotate_deg": 90}
    )  # counter-clockwise seen from above: -z, the middle, comes to -x
    facing = np.array([[-1.0, 0, 0]])
    np.testing.assert_allclose(
        Environment(values, turn=quarter).radiance(facing),
        Environment(values).radiance([[0, 0, -1]]),
    )


@pytest.mark.parametrize("values", [np.zeros((4, 8, 3)), np.zeros((4, 4, 3))])
def test_black_map_has_no_lights(values):
    for method in METHODS:
        assert len(Environment(values).lights(16, method)[0]) == 0


# pictures


@pytest.fixture
def lit(scene_file, tmp_path):
    """Render objects under a map: its values, and settings of the light."""

    def make(objects, values, background=None, **light):
        film = light.pop("film", {"width": 32, "height": 32, "samples": 1, "filter": "box"})
        camera = light.pop("camera", None)
        write_picture(tmp_path / "room.exr", np.asarray(values, np.float32))
        changes = {"lights": [{"type": "environment", "map": "room.exr"} | light], "film": film}
        if camera:
            changes["camera"] = camera
        if background:
            changes["background"] = background
        return render(load_scene(scene_file(objects, **changes), read_picture=_read))

    return make


def _read(path):
    return colours(open_picture(path), path)


@pytest.mark.parametrize(
    ("method", "error"), [("q2tree", 0.01), ("median-cut", 0.01), ("alias", 0.1)]
)
def test_white_diffuser_in_a_white_room_is_as_bright_as_the_room(
    method, error, lit, lambertian, tmp_path
):
    lambertian(albedo=(1, 1, 1)).save(tmp_path / "m.sample.npz")
    dressed = {"plane": WHITE["plane"], "model": "m.sample.npz"}
    for thing in (WHITE, dressed):
        picture = lit([thing], np.full((32, 64, 3), 1.0), method=method, lights=256)
        inside = picture[4:-4, 4:-4, :3]
        assert inside.min() > 0
        np.testing.assert_allclose(inside, 1, atol=error)
        np.testing.assert_allclose(picture[0, 0, :4], 1)


def test_what_is_seen_behind_is_what_lights_the_object(lit, uv_sphere, tmp_path):
    """A red wall on the right, a blue one on the left, a green sky: a white ball is red on its right."""
    from btfpipe.surface import Surface

    Surface([uv_sphere(24, 48)[0]]).save(tmp_path / "ball.npz")

    def room(w):
        return np.stack([w[..., 0] > 0.6, w[..., 1] > 0.6, w[..., 0] < -0.6], axis=-1) * 2.0

    camera = {"type": "perspective", "position": [0, 0, 3], "target": [0, 0, 0], "fov_deg": 110}
    film = {"width": 64, "height": 64, "samples": 4, "filter": "box"}
    ball = {"mesh": "ball.npz", "albedo": [1, 1, 1]}
    for projection in ("latlong", "probe"):
        values = picture_of(room, projection)
        picture = lit([ball], values, camera=camera, film=film, lights=100)
        assert (picture[..., 3] == 1).all()
        for place, channel in (((32, 62), 0), ((2, 32), 1), ((32, 1), 2)):
            assert picture[place][channel] == pytest.approx(2, rel=1e-3)
            assert np.delete(picture[place][:3], channel).max() < 1e-3
        assert picture[62, 32, :3].max() < 1e-3
        hit = picture[..., 4] > 0
        right, left, top = (
            hit & (picture[..., 5 + k] * sign > 0.8) for k, sign in ((0, 1), (0, -1), (1, 1))
        )
        for where, channel in ((right, 0), (top, 1), (left, 2)):
            assert where.sum() > 3
            mean = picture[where][:, :3].mean(axis=0)
            assert mean[channel] > 2 * np.delete(mean, channel).max()


def test_turning_map_objects_and_camera_together_changes_nothing(lit, uv_sphere, tmp_path):
    from btfpipe.surface import Surface

    Surface([uv_sphere(24, 48)[0]]).save(tmp_path / "ball.npz")
    film = {"width": 48, "height": 48, "samples": 1, "filter": "box"}
    pictures = []
    for angle in (0, 75):
        settings = {"rotate_deg": angle, "axis": [1, 2, -0.5]}
        turn = rotation(settings)
        objects = [
            {"mesh": "ball.npz", "albedo": [1, 0.8, 0.6], "transform": settings},
            {
                "plane": {"center": [0, -1, 0], "s": [1, 0, 0], "t": [0, 0, -1], "size": [5, 5]},
                "albedo": [0.5, 0.5, 0.5],
                "transform": settings,
            },
        ]
        camera = {
            "type": "perspective",
            "position": turn @ [1, 2, 5],
            "target": [0, 0, 0],
            "up": turn @ [0, 1, 0],
        }
        values = picture_of(lobes, "latlong", 32)
        pictures.append(lit(objects, values, camera=camera, film=film, lights=30, **settings))
    still, turned = pictures
    assert (still[..., 4] > 0).mean() > 0.3
    differs = np.abs(turned[..., :3] - still[..., :3]).max(axis=2) > 1e-3 * still[..., :3].max(
        axis=2
    )
    assert differs.sum() <= 12  # of 2304: a shadow's border falls on the other side by rounding
    np.testing.assert_allclose(turned[..., 3], still[..., 3])


def test_shadow_of_a_lamp_in_the_map_falls_where_geometry_says(lit):
    """A lamp to the right and above: a card shades the ground on its left."""
    values = picture_of(
        lambda w: (w @ [0.7071, 0.7071, 0] > 0.999)[..., None] * np.ones(3), "latlong"
    )
    card = {"plane": {"center": [0, 0, 0], "s": [0, 0, -1], "t": [0, 1, 0], "size": [1, 2]}}
    ground = {"plane": {"center": [0, -1, 0], "s": [1, 0, 0], "t": [0, 0, -1], "size": [9, 9]}}
    camera = {
        "type": "orthographic",
        "position": [0, 8, 0],
        "target": [0, 0, 0],
        "up": [0, 0, -1],
        "height": 6,
    }
    picture = lit(
        [thing | {"albedo": [1, 1, 1]} for thing in (card, ground)], values, camera=camera
    )
    middle = picture[16, :, 0]  # x from -3 to 3; the shadow reaches from 0 to -2
    assert (middle[6:15] == 0).all()
    assert (middle[:4] > 0).all()
    assert (middle[17:] > 0).all()


def test_hidden_map_lights_and_is_not_seen(lit):
    values = np.full((32, 64, 3), 2.0)
    card = WHITE | {"plane": WHITE["plane"] | {"size": [1, 1]}}
    picture = lit([card], values, visible=False, intensity=0.5)
    assert (picture[0, 0, :4] == 0).all()
    assert picture[16, 16, :3] == pytest.approx(1, abs=0.05)
    seen = lit([card], values, visible=False, background=[0.25, 0.5, 1])
    assert (seen[0, 0, :4] == [0.25, 0.5, 1, 1]).all()


def test_partly_covered_pixels_blend_object_and_map(lit):
    film = {"width": 16, "height": 16, "samples": 64, "filter": "box"}
    card = WHITE | {"plane": WHITE["plane"] | {"size": [1.2, 1.2]}}
    values = np.full((32, 64, 3), 3.0)
    alone = lit([card], values, film=film, visible=False)
    both = lit([card], values, film=film)
    assert ((alone[..., 3] > 0) & (alone[..., 3] < 1)).any()
    np.testing.assert_allclose(both[..., :3], alone[..., :3] + (1 - alone[..., 3:4]) * 3, rtol=1e-5)


# bad input


def _with(values, *places):
    out = np.ones((4, 8, 3), np.float32)
    for place in places:
        out[place] = values
    return out


@pytest.mark.parametrize(
    ("values", "light", "message"),
    [
        (
            _with(np.nan, (2, 3, 1), (3, 1, 0)),
            {},
            "2 pixels are not finite, the first in row 2, column 3 (1, nan, 1)",
        ),
        (_with(np.inf, (1, 7)), {}, "1 pixels are not finite, the first in row 1, column 7"),
        (
            _with(-0.5, (0, 5, 2)),
            {},
            "1 pixels are negative, the first in row 0, column 5 (1, 1, -0.5)",
        ),
        (np.ones((4, 7, 3), np.float32), {}, "7 x 4 pixels; expected twice as wide as high"),
        (_with(1), {"projection": "probe"}, "8 x 4 pixels; an angular probe is a square"),
        (_with(1), {"projection": "cube"}, "lights[0].projection: 'cube' is not one of"),
        (_with(1), {"intensity": 0}, "lights[0].intensity: 0 is less than or equal to the minimum"),
        (
            _with(1e38, (3, 0)),
            {"intensity": 10},
            "times intensity 10: 1 pixels are not finite, the first in row 3, column 0",
        ),
        (_with(1), {"lights": 11}, "lights: 11; q2tree needs at least 12"),
        (_with(1), {"method": "cubes"}, "lights[0].method: 'cubes' is not one of"),
        (_with(1), {"rotate_deg": 10, "axis": [0, 0, 0]}, "axis is zero"),
        (_with(1), {"map": "none.exr"}, "lights[0].map is"),
        (_with(1), {"map": "$environment"}, "give it with --bind environment=FILE"),
        (_with(1), {"map": "scene.yaml"}, "not a readable picture"),
        ("XYZ", {}, "has the channels X, Y, Z; expected R, G and B, or grey"),
    ],
)
def test_unusable_map_is_refused_by_key(values, light, message, scene_file, btfpipe, tmp_path):
    names = list(values) if isinstance(values, str) else None
    write_picture(tmp_path / "room.exr", _with(1) if names else values, names=names)
    path = scene_file([WHITE], lights=[{"type": "environment", "map": "room.exr"} | light])
    done = btfpipe("render", path, "-o", tmp_path / "p.exr", code=3)
    assert message in done.stderr
    assert "lights[0]" in done.stderr
    assert not (tmp_path / "p.exr").exists()


def test_picture_never_replaces_its_own_environment(scene_file, btfpipe, tmp_path):
    write_picture(tmp_path / "room.exr", _with(1))
    before = (tmp_path / "room.exr").read_bytes()
    path = scene_file([WHITE], lights=[{"type": "environment", "map": "room.exr"}])
    done = btfpipe("render", path, "-o", tmp_path / "room.exr", "--force", code=2)
    assert "room.exr is also the input" in done.stderr
    assert (tmp_path / "room.exr").read_bytes() == before


@pytest.mark.parametrize(("radiance", "warned"), [(6e4, False), (1e6, True), (1e30, True)])
def test_radiance_beyond_half_precision_is_kept_and_told(
    scene_file, btfpipe, tmp_path, radiance, warned
):
    import json

    from btfpipe.formats.images import open_picture

    write_picture(tmp_path / "room.exr", np.full((4, 8, 3), radiance, np.float32))
    path = scene_file([WHITE], lights=[{"type": "environment", "map": "room.exr"}])
    out = tmp_path / "p.exr"
    for options in ((), ("--float",), ("--json",)):
        done = btfpipe("render", path, "-o", out, "--force", *options)
        told = "beyond 16-bit floats (65504): R, G and B are stored in 32 bits" in done.stderr
        assert told == (warned and options != ("--float",))
        picture = open_picture(out)
        seen = picture.values[0, 0, [picture.channels.index(c) for c in "RGB"]]  # beside the object
        np.testing.assert_allclose(seen, radiance, rtol=1e-3)
    assert bool(json.loads(done.stdout)["warnings"]) == warned


def test_radiance_beyond_single_precision_is_refused(scene_file, btfpipe, tmp_path):
    lamp = {"type": "directional", "direction": [0, 0, 1], "irradiance": [1e40, 0, 0]}
    path = scene_file([WHITE], lights=[lamp])
    done = btfpipe("render", path, "-o", tmp_path / "p.exr", code=3)
    assert "scene.yaml: radiance exceeds 32-bit floats" in done.stderr
    assert not (tmp_path / "p.exr").exists()


def test_picture_of_codes_is_no_environment(scene_file, btfpipe, tmp_path):
    write_picture(tmp_path / "room.png", np.zeros((4, 8, 3), np.uint8))
    path = scene_file([WHITE], lights=[{"type": "environment", "map": "room.png"}])
    done = btfpipe("render", path, "-o", tmp_path / "p.exr", code=3)
    assert "lights[0]: " in done.stderr
    assert "room.png: a picture of uint8 codes; expected radiance in floating point" in done.stderr


def test_visible_map_and_background_contradict(lit):
    with pytest.raises(InputError, match=r"background: lights\[0\] shows its map there"):
        lit([WHITE], np.ones((4, 8, 3)), background=[1, 1, 1])


def test_bad_pixels_outside_a_probe_do_not_matter():
    values = picture_of(lambda w: 0 * w + 1, "probe", 16)
    values[0, 0], values[15, 0] = np.nan, -1
    np.testing.assert_allclose(Environment(values).power, 4 * np.pi)
    assert np.isfinite(Environment(values).values).all()
    values[8, 0] = np.nan
    with pytest.raises(InputError, match="1 pixels are not finite, the first in row 8, column 0"):
        Environment(values)


def test_map_is_named_among_the_inputs_and_the_seed_places_random_lights(
    scene_file, btfpipe, tmp_path
):
    import json

    write_picture(tmp_path / "room.hdr", picture_of(lobes, "latlong", 8))
    light = {"type": "environment", "map": "$environment", "method": "alias", "lights": 5}
    film = {"width": 200, "height": 150, "samples": 4}
    path = scene_file([WHITE], lights=[light], film=film)
    pictures = []
    for seed, threads in ((1, 1), (1, 2), (2, 1)):
        done = btfpipe(
            "render", path, "-o", tmp_path / "p.exr", "--bind", f"environment={tmp_path / 'room.hdr'}",
            "--seed", seed, "--threads", threads, "--force", "--json",
        )  # fmt: skip
        assert str(tmp_path / "room.hdr") in [i["path"] for i in json.loads(done.stdout)["inputs"]]
        pictures.append((tmp_path / "p.exr").read_bytes())
    assert pictures[0] == pictures[1]
    assert pictures[0] != pictures[2]
