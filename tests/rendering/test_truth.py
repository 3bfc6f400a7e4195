"""What a picture must show, known without the renderer."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81, from_angles
from btfpipe.sample import Sample

OBLIQUE = [
    from_angles(0.3, 1.0),
    from_angles(np.radians(75), 2.0),
    from_angles(np.radians(84), 5.0),
]


@pytest.mark.parametrize("kind", ["raw", "svd"])
def test_lambertian_sphere_shines_with_the_cosine_whatever_the_light(
    kind, lambertian, sphere, scene_file, render_file, tmp_path
):
    sample = lambertian()
    entry = sphere()
    if kind == "raw":
        sample.save(tmp_path / "m.sample.npz")
    else:
        compress_svd(sample, 4, precision="single").save(tmp_path / "m.sample.npz")
    x, y = np.meshgrid((np.arange(64) + 0.5) / 32 - 1, 1 - (np.arange(64) + 0.5) / 32)
    x, y = 1.1 * x, 1.1 * y
    on = x**2 + y**2 < 0.95**2  # at the rim the mesh's outline is not the sphere's
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    for direction in [bonn81()[0], bonn81()[37], bonn81()[80], *OBLIQUE]:
        light = {"type": "directional", "direction": direction, "irradiance": [2, 3, 4]}
        picture = render_file(scene_file([entry], lights=[light]))
        cosine = np.maximum(normal @ direction, 0)
        expected = cosine[..., None] * np.array([1, 0.5, 0.25]) * [2, 3, 4] / np.pi
        assert np.abs(picture[..., :3] - expected)[on].max() < 1e-3
        assert np.abs(picture[..., 5:8] - normal)[on].max() < 1e-3


def _flat_scene(sample, scene_file, light, view, film=None):
    """A plane of one texel a unit, lit and seen from two directions."""
    rows, cols = sample.shape
    plane = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [cols, rows]}
    up = [0, 1, 0] if abs(view[1]) < 0.9 else [1, 0, 0]
    camera = {
        "type": "orthographic",
        "position": 50 * view,
        "target": [0, 0, 0],
        "up": up,
        "height": rows,
    }
    film = film or {"width": cols, "height": rows, "samples": 1, "filter": "box"}
    lights = [{"type": "directional", "direction": light, "irradiance": [np.pi] * 3}]
    entry = {"plane": plane, "model": "m.sample.npz"}
    return scene_file([entry], camera=camera, film=film, lights=lights)


def test_flat_patch_seen_frontally_is_the_measured_picture(
    make_sample, scene_file, render_file, tmp_path
):
    sample = make_sample()
    sample.save(tmp_path / "m.sample.npz")
    for pair in (0, 5, 18):
        light = sample.light_directions[sample.light_index[pair]]
        picture = render_file(_flat_scene(sample, scene_file, light, np.array([0.0, 0, 1])))
        np.testing.assert_allclose(picture[..., :3], sample.pictures([pair])[0], atol=1e-5)
        assert (picture[..., 3] == 1).all()
        rows, cols = np.mgrid[: sample.shape[0], : sample.shape[1]]
        np.testing.assert_allclose(picture[..., 8], rows, atol=1e-4)
        np.testing.assert_allclose(picture[..., 9], cols, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32])
def test_evaluate_at_texel_centres_and_measured_directions_returns_the_pictures(make_sample, dtype):
    gain = np.random.default_rng(2).random((16, 20, 3), np.float32) + 0.5
    transfer = "linear" if dtype == np.float32 else "gamma2.2"
    sample = make_sample(dtype=dtype, gain=gain, transfer=transfer, scale=1.5)
    rows, cols = (a.ravel() for a in np.mgrid[:16, :20])
    for interpolation in ("barycentric", "four", "nearest"):
        for pair in (0, 40, 101, 132):
            light = sample.light_directions[sample.light_index[pair]]
            view = sample.view_directions[sample.view_index[pair]]
            value = sample.evaluate(rows, cols, light, view, interpolation=interpolation)
            picture = sample.pictures([pair])[0]
            np.testing.assert_allclose(value.reshape(16, 20, 3), picture, atol=1e-5)


def test_flat_patch_seen_obliquely_is_the_measured_picture_resampled(
    make_sample, scene_file, render_file, tmp_path
):
    sample = make_sample()
    sample.save(tmp_path / "m.sample.npz")
    film = {"width": 50, "height": 40, "samples": 1, "filter": "box"}
    for pair in (2 * 19 + 3, 6 * 19 + 11):
        light = sample.light_directions[sample.light_index[pair]]
        view = sample.view_directions[sample.view_index[pair]]
        picture = render_file(_flat_scene(sample, scene_file, light, view, film))
        # where each pixel's ray meets the plane z = 0
        right = np.cross(-view, [0, 1, 0])
        right /= np.linalg.norm(right)
        up = np.cross(right, -view)
        a, b = np.meshgrid((np.arange(50) + 0.5) / 50 - 0.5, 0.5 - (np.arange(40) + 0.5) / 40)
        point = a[..., None] * 20 * right + b[..., None] * 16 * up
        point = point - point[..., 2:] / view[2] * view
        row, col = 8 - point[..., 1] - 0.5, point[..., 0] + 10 - 0.5
        inside = (np.abs(point[..., 0]) < 9.99) & (np.abs(point[..., 1]) < 7.99)
        measured = sample.pictures([pair])[0]
        expected = np.stack(
            [
                map_coordinates(measured[..., c], [row, col], order=1, mode="nearest")
                for c in range(3)
            ],
            axis=-1,
        )
        np.testing.assert_allclose(picture[..., :3][inside], expected[inside], atol=1e-5)
        assert (picture[..., 3] == 1)[inside].all()


def test_compressed_flat_patch_misses_the_measured_picture_by_the_compression_error(
    make_sample, scene_file, render_file, tmp_path
):
    sample = make_sample()
    model = compress_svd(sample, 3, precision="single")
    model.save(tmp_path / "m.sample.npz")
    light = sample.light_directions[7]
    picture = render_file(_flat_scene(sample, scene_file, light, np.array([0.0, 0, 1])))
    error = np.sqrt(((picture[..., :3] - sample.pictures([7])[0]) ** 2).mean())
    own = np.sqrt(((model.pictures([7])[0] - sample.pictures([7])[0]) ** 2).mean())
    assert own > 1e-4
    assert error == pytest.approx(own, rel=0.01)


def arrow(side=24):
    """A picture without any symmetry: an F, pointing up and opening to the right."""
    picture = np.full((side, side, 3), 0.1, np.float32)
    picture[4:-4, 8:11] = 1
    picture[4:7, 8:18] = 1
    picture[11:14, 8:15] = 1
    return picture


def _arrow_sample(tmp_path, **kwargs):
    lights = views = bonn81()[:7]
    shade = np.tile(lights[:, 2], 7).astype(np.float32)
    pair = np.arange(49)
    sample = Sample(
        shade[:, None, None, None] * arrow(), lights, views, pair % 7, pair // 7, **kwargs
    )
    sample.save(tmp_path / "m.sample.npz")
    return sample


def _symmetries(picture):
    """The eight turned and mirrored forms of a square picture, itself first."""
    return [np.rot90(p, k) for p in (picture, picture[:, ::-1]) for k in range(4)]


def _best_symmetry(seen, picture):
    """Which form of the picture looks most like what is seen."""
    scores = [np.corrcoef(seen.ravel(), form.ravel())[0, 1] for form in _symmetries(picture)]
    assert max(scores) > 0.7
    return int(np.argmax(scores))


def test_arrow_stays_upright_on_a_plane(scene_file, render_file, tmp_path):
    _arrow_sample(tmp_path)
    plane = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [2.2, 2.2]}
    film = {"width": 24, "height": 24, "samples": 4, "filter": "box"}
    picture = render_file(scene_file([{"plane": plane, "model": "m.sample.npz"}], film=film))
    assert _best_symmetry(picture[..., 0], arrow()[..., 0]) == 0


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_arrow_is_turned_but_never_mirrored_on_a_sphere(
    turn, sphere, scene_file, render_file, tmp_path
):
    _arrow_sample(tmp_path)
    angle = turn * np.pi / 2

    def coordinates(lat, lon):
        lon = (lon + np.pi) % (2 * np.pi) - np.pi
        # the local step from the middle of the front, turned into the sample (DESIGN: conventions)
        ds, dt = 20 * lon, 20 * lat
        row = 11.5 + ds * np.sin(angle) - dt * np.cos(angle)
        col = 11.5 + ds * np.cos(angle) + dt * np.sin(angle)
        return np.clip(row, 0, 23), np.clip(col, 0, 23)

    entry = sphere(coordinates, angle, 20.0)
    camera = {"type": "orthographic", "position": [0, 0, 5], "target": [0, 0, 0], "height": 1.2}
    film = {"width": 24, "height": 24, "samples": 4, "filter": "box"}
    picture = render_file(scene_file([entry], camera=camera, film=film))
    # an angle of 90 degrees lays the sample's right along the picture's up: a counter-clockwise quarter turn
    assert _best_symmetry(picture[..., 0], arrow()[..., 0]) == turn


def test_light_is_turned_into_the_sample(scene_file, render_file, tmp_path):
    """A texel that is brighter when lit from its right; laid at 90 degrees it is brighter lit from above."""
    from btfpipe.synthesis import CoordinateMap

    lights = bonn81()
    codes = (lights[:, 2] * (1 + lights[:, 0])).astype(np.float32)
    codes = np.ascontiguousarray(np.broadcast_to(codes[:, None, None, None], (81, 4, 4, 3)))
    Sample(codes, lights, bonn81()[:1], np.arange(81), np.zeros(81, int), toroidal=True).save(
        tmp_path / "m.sample.npz"
    )
    n = 8 * 8
    row, col = (a.ravel() for a in np.mgrid[:8, :8])
    for angle, brightest in ((0, [1, 0]), (np.pi / 2, [0, 1]), (np.pi, [-1, 0])):
        CoordinateMap(
            row % 4, col % 4, np.full(n, angle), 1.0, {"plane": [8, 8], "toroidal": True}
        ).save(tmp_path / "turned.map.npz")
        plane = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [4, 4]}
        entry = {"plane": plane, "model": "m.sample.npz", "map": "turned.map.npz"}
        seen = {}
        for x, y in ([1, 0], [0, 1], [-1, 0], [0, -1]):
            direction = from_angles(np.radians(45), np.arctan2(y, x))
            lamp = {"type": "directional", "direction": direction, "irradiance": [np.pi] * 3}
            seen[x, y] = render_file(scene_file([entry], lights=[lamp]))[..., 0].mean()
        assert max(seen, key=seen.get) == tuple(brightest)
        expected = np.sqrt(0.5) * (1 + np.sqrt(0.5))
        assert seen[tuple(brightest)] == pytest.approx(expected, rel=0.02)
