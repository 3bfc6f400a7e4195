"""Environments in the frequency domain, in scenes: against the same map as directional lights, and in closed form."""

import numpy as np
import pytest

from btfpipe.compression.harmonics import compress_harmonics
from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.formats.images import colours, open_picture, write_picture
from btfpipe.rendering import kernels
from btfpipe.rendering.renderer import render
from btfpipe.rendering.scene import load_scene
from btfpipe.sample import Sample


@pytest.fixture
def white(tmp_path):
    """File of a white diffuser, as harmonics."""
    directions = bonn81()
    pair = np.arange(81 * 81)
    codes = directions[pair % 81, 2][:, None, None, None] * np.ones((1, 2, 2, 3))
    sample = Sample(codes.astype(np.float32), directions, directions, pair % 81, pair // 81)
    compress_harmonics(sample).save(tmp_path / "white.npz")
    return tmp_path / "white.npz"


def write_map(path, function, rows=32):
    """A latitude-longitude map, y up, the picture's middle towards -z."""
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / rows, indexing="ij"
    )
    theta, phi = np.pi * (u - 1), np.pi * v
    towards = np.stack(
        [np.sin(phi) * np.sin(theta), np.cos(phi), -np.sin(phi) * np.cos(theta)], axis=-1
    )
    write_picture(path, function(towards).astype(np.float32))


def picture(folder, method, extra="", more="", film=(8, 8), position="[0, 0, 3]"):
    """Render a plane that faces +z, two units a side, of the white diffuser."""
    path = folder / "scene.yaml"
    path.write_text(
        f"camera: {{type: orthographic, position: {position}, target: [0, 0, 0], height: 1.8}}\n"
        f"lights: [{{type: environment, map: map.exr, visible: false, lights: 3000, method: {method}{extra}}}]\n"
        "objects:\n"
        "- {plane: {center: [0, 0, 0], s: [0.8, 0.6, 0], t: [-0.6, 0.8, 0], size: [3, 3]}, model: white.npz}\n"
        + more
    )
    scene = load_scene(
        path,
        film={"width": film[1], "height": film[0], "samples": 1},
        read_picture=lambda name: colours(open_picture(name), name),
    )
    return render(scene)[..., :3]


def test_a_white_sky_makes_a_white_diffuser_white(white):
    write_map(white.parent / "map.exr", lambda d: np.ones((*d.shape[:-1], 3)))
    np.testing.assert_allclose(picture(white.parent, "harmonics"), 1, atol=0.01)


def test_the_frequency_domain_agrees_with_many_lights(white):
    def sky(d):
        lamp = np.maximum(d @ [0.48, 0.36, 0.8], 0) ** 12
        floor = np.maximum(-d[..., 1], 0)
        return 0.2 + lamp[..., None] * [6, 3, 1] + floor[..., None] * [0, 0.2, 1]

    write_map(white.parent / "map.exr", sky)
    spectral, sampled = (picture(white.parent, method) for method in ("harmonics", "q2tree"))
    assert np.ptp(sampled[4, 4]) > 0.2  # of different colours
    np.testing.assert_allclose(spectral, sampled, rtol=0.02)


def test_the_terms_asked_for_are_those_that_light(white):
    """A narrow lamp needs many, and each more brings some light."""
    lamp = [[0.48], [0.36], [0.8]]
    write_map(white.parent / "map.exr", lambda d: (d @ lamp > 0.995) * np.ones(3), 96)
    truth = picture(white.parent, "q2tree")[4, 4, 0]
    seen = [
        picture(white.parent, "harmonics", f", occlusion_rays: 0, terms: {n}")[4, 4, 0]
        for n in (4, 169, 400, 784)
    ]
    assert len(set(seen)) == 4
    np.testing.assert_allclose(seen[1:], truth, rtol=2e-3)
    assert abs(seen[0] / truth - 1) > 0.1


@pytest.mark.parametrize("option", ["terms: 25", "occlusion_rays: 3"])
@pytest.mark.parametrize("method", ["q2tree", "alias"])
def test_options_of_the_frequency_domain_are_not_taken_elsewhere(white, option, method):
    write_map(white.parent / "map.exr", lambda d: np.ones((*d.shape[:-1], 3)))
    with pytest.raises(
        InputError,
        match=rf"lights\[0\]: {option[:5]}.* is of method harmonics; the method is {method}",
    ):
        picture(white.parent, method, f", {option}")


@pytest.mark.parametrize("method", ["harmonics", "q2tree"])
def test_values_below_zero_darken_nothing(white, method):
    """A patch of which a half reflects less than nothing, as compression has it, beside a white one."""
    directions = bonn81()
    pair = np.arange(81 * 81)
    sign = np.where(np.arange(2) == 0, -1.0, 1.0)[None, None, :, None]
    codes = directions[pair % 81, 2][:, None, None, None] * np.ones((1, 2, 2, 3)) * sign
    sample = Sample(codes.astype(np.float32), directions, directions, pair % 81, pair // 81)
    (compress_harmonics(sample) if method == "harmonics" else sample).save(white)
    write_map(white.parent / "map.exr", lambda d: np.ones((*d.shape[:-1], 3)))
    seen = picture(white.parent, method)
    assert seen.min() == 0
    np.testing.assert_allclose(seen.max(), 1, atol=0.02)


def test_the_back_of_a_surface_is_lit_as_by_many_lights(white):
    """Behind, the frame is mirrored; the diffuser is tilted along s, so that the mirror would show."""
    directions = bonn81()
    pair = np.arange(81 * 81)
    tilted = np.maximum(directions @ [0.45, 0.35, 0.82], 0)
    codes = tilted[pair % 81][:, None, None, None] * np.ones((1, 2, 2, 3))
    sample = Sample(codes.astype(np.float32), directions, directions, pair % 81, pair // 81)
    compress_harmonics(sample).save(white)
    write_map(
        white.parent / "map.exr",
        lambda d: 0.1 + np.maximum(d @ [0.6, -0.3, -0.74], 0)[..., None] ** 6 * [4, 2, 1],
    )
    back = {"position": "[0, 0, -3]"}
    spectral, sampled = (
        picture(white.parent, method, **back) for method in ("harmonics", "q2tree")
    )
    assert sampled.mean() > 0.2
    np.testing.assert_allclose(spectral, sampled, rtol=0.03)


def test_a_wall_hides_its_share_of_the_sky(white):
    """A wall that stands on the plane takes half of the sky from a point at its foot."""
    write_map(white.parent / "map.exr", lambda d: np.ones((*d.shape[:-1], 3)))
    wall = "- {plane: {center: [0.02, 0, 50], s: [0, 1, 0], t: [0, 0, 1], size: [100, 100]}, albedo: [0, 0, 0]}\n"
    hidden = picture(white.parent, "harmonics", ", occlusion_rays: 256", wall, (1, 9))[0, 4]
    np.testing.assert_allclose(hidden, 0.5, atol=0.06)
    whole = picture(white.parent, "harmonics", ", occlusion_rays: 0", wall, (1, 9))[0, 4]
    np.testing.assert_allclose(whole, 1, atol=0.01)


@pytest.mark.parametrize("side", [4.0, 8.0, 16.0])
def test_a_ceiling_hides_what_its_form_factor_says(white, side):
    """A square card four units above hides more the higher it stands in the sky, by the cosine."""
    write_map(white.parent / "map.exr", lambda d: np.ones((*d.shape[:-1], 3)))
    card = (
        f"- {{plane: {{center: [0, 0, 4], s: [1, 0, 0], t: [0, 1, 0], size: [{side}, {side}]}},"
        " albedo: [0, 0, 0]}\n"
    )
    seen = picture(white.parent, "harmonics", ", occlusion_rays: 1024", card, (3, 3))[1, 1]
    # of a differential element and a rectangle above its corner, four times (Siegel and Howell)
    a = side / 2 / 4
    part = a / np.sqrt(1 + a * a) * np.arctan(a / np.sqrt(1 + a * a)) / np.pi
    np.testing.assert_allclose(seen, 1 - 4 * part, atol=0.035)


@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -1], [0.6, 0, 0.8], [0.48, -0.6, -0.64]])
def test_rays_of_ambient_visibility_follow_the_cosine(normal):
    """Moments of the cosine's distribution: of the height 2/3 and 1/2, across it none and a quarter each way."""
    points, rays = 400, 16
    normals = np.tile(np.array(normal, float), (points, 1))
    start, chosen = np.arange(3.0 * points).reshape(points, 3), np.arange(points)
    origin, toward = (np.empty((points * rays, 3), np.float32) for _ in range(2))
    kernels.cosine_rays(start, normals, chosen, 7 * chosen, rays, 3, origin, toward)
    np.testing.assert_array_equal(origin, np.repeat(start, rays, axis=0))
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), 1, atol=1e-6)
    height = toward @ normals[0]
    assert height.min() >= 0
    assert height.mean() == pytest.approx(2 / 3, abs=0.01)
    assert np.square(height).mean() == pytest.approx(1 / 2, abs=0.01)
    across = toward - height[:, None] * normals[0]
    np.testing.assert_allclose(across.mean(axis=0), 0, atol=0.01)
    spread = across.T @ across / len(across)
    np.testing.assert_allclose(spread, (np.eye(3) - np.outer(normal, normal)) / 4, atol=0.01)


def test_a_scene_without_a_model_of_harmonics_is_told_so(white, make_sample):
    write_map(white.parent / "map.exr", lambda d: np.ones((*d.shape[:-1], 3)))
    make_sample(toroidal=True).save(white)
    with pytest.raises(InputError, match=r"lights\[0\]: method harmonics needs an object"):
        picture(white.parent, "harmonics")
