"""Measured pictures obey the project's convention of light and row directions.

A reader and a simulator that shared one mirror error would agree with each other; Bonn's frames agree with nobody.
"""

import numpy as np
import pytest

from btfpipe.formats import ubo
from btfpipe.sample import Sample
from btfpipe.sample.ingest import ingest

pytestmark = pytest.mark.measured


@pytest.fixture(scope="module")
def wallpaper(measured_data, tmp_path_factory):
    path = tmp_path_factory.mktemp("wallpaper") / "wallpaper.sample.npz"
    with ubo.open_measurement(measured_data / "btf/ubo2003_wallpaper_view0") as measurement:
        ingest(measurement, path, crop=(0, 128, 128, 128), threads=2)
    return Sample.open(path)


def slopes(sample, lights, most_deg, sigma=0):
    """Height gradients (dz/ds, dz/dt) of the patch by Lambertian photometric stereo.

    Per texel, ``value = albedo * normal . light`` is fitted to the lights within `most_deg` of the normal that leave
    the texel brighter than 0.4 of its usual reflectance: the others are shadows. Pictures are blurred by `sigma`.
    """
    from scipy.ndimage import gaussian_filter

    near = lights[:, 2] > np.cos(np.radians(most_deg))
    values = sample.pictures(np.flatnonzero(near)).mean(axis=3)
    values = gaussian_filter(values, (0, sigma, sigma))
    vectors = lights[near]
    relative = values / vectors[:, 2, None, None]
    keep = (relative >= 0.4 * np.median(relative, axis=0)).astype(float)
    moment = np.einsum("lrc,li,lj->rcij", keep, vectors, vectors)
    right = np.einsum("lrc,lrc,li->rci", keep, values, vectors)
    normal = np.linalg.solve(moment, right[..., None])[..., 0]
    return -normal[..., 0] / normal[..., 2], -normal[..., 1] / normal[..., 2]


def curl_share(p, q):
    """Share of a gradient field's energy that no height field can have (Helmholtz, by FFT under a Hann window).

    0 for the gradient of a height field, 1/2 for noise, 1 for a pure whirl.
    """
    window = np.hanning(p.shape[0])[:, None] * np.hanning(p.shape[1])
    p, q = (np.fft.fft2((a - a.mean()) * window) for a in (p, q))
    u = np.fft.fftfreq(p.shape[1])[None]
    v = -np.fft.fftfreq(p.shape[0])[:, None]  # rows run against t
    square = u**2 + v**2
    square[0, 0] = 1
    whirl = np.abs(v * p - u * q) ** 2 / square
    return whirl.sum() / (np.abs(p) ** 2 + np.abs(q) ** 2).sum()


def heights(p, q):
    """Height whose gradient is nearest to (p, q), in texels (Frankot and Chellappa 1988), by reflection at borders."""
    from scipy.fft import dctn, idctn

    # least squares on the texel grid: divergence of the field, then the Poisson equation by cosines
    rows, cols = p.shape
    divergence = np.zeros((rows, cols))
    east = (p[:, 1:] + p[:, :-1]) / 2
    divergence[:, :-1] += east
    divergence[:, 1:] -= east
    south = -(q[1:] + q[:-1]) / 2
    divergence[:-1] += south
    divergence[1:] -= south
    scale = (
        2 * np.cos(np.pi * np.arange(rows) / rows)[:, None]
        + 2 * np.cos(np.pi * np.arange(cols) / cols)[None]
        - 4
    )
    scale[0, 0] = 1
    z = dctn(divergence, norm="ortho") / scale
    z[0, 0] = 0
    return idctn(z, norm="ortho")


def shadowed(z, light):
    """Texels from which a ray towards the light meets the height field."""
    from scipy.ndimage import map_coordinates

    flat = np.hypot(*light[:2])
    rows, cols = np.indices(z.shape, dtype=float)
    blocked = np.zeros(z.shape, bool)
    for step in range(1, 24):
        row, col = rows - step * light[1] / flat, cols + step * light[0] / flat
        above = map_coordinates(z, [row, col], order=1, mode="nearest")
        inside = (row >= 0) & (row <= z.shape[0] - 1) & (col >= 0) & (col <= z.shape[1] - 1)
        blocked |= inside & (above > z + step * light[2] / flat + 0.05)
    return blocked


def test_normals_are_integrable_in_our_convention_and_not_in_its_mirror(wallpaper):
    lights = wallpaper.light_directions
    ours, mirrored, turned = (
        curl_share(*slopes(wallpaper, turn, 70, sigma=1))
        for turn in (lights, lights * [1, -1, 1], lights[:, [1, 0, 2]] * [1, -1, 1])
    )
    assert ours <= 0.25 * mirrored, (ours, mirrored)
    # a quarter turn keeps the handedness but not the meaning of rows and columns
    assert ours <= 0.25 * turned, (ours, turned)


def test_predicted_cast_shadows_are_dark(wallpaper):
    from scipy.ndimage import gaussian_filter

    lights = wallpaper.light_directions
    p, q = slopes(wallpaper, lights, 55)
    z = heights(p - p.mean(), q - q.mean())
    z -= gaussian_filter(z, 8)  # slow errors of integration would throw long shadows
    down, right = np.gradient(z)
    albedo = wallpaper.pictures(np.flatnonzero(lights[:, 2] > 0.8)).mean(axis=(0, 3))
    grazing = np.flatnonzero(lights[:, 2] < np.cos(np.radians(74)))
    assert len(grazing) == 24
    mirrored_ratios = []
    for index in grazing:
        values = wallpaper.pictures([index])[0].mean(axis=2) / albedo
        ratios = []
        for light in (lights[index], lights[index] * [1, -1, 1]):
            shadow = shadowed(z, light)
            # cast upon a texel that itself faces the light
            cast = shadow & (light[2] - right * light[0] + down * light[1] > 0)
            assert 0.001 < cast.mean() < 0.5
            ratios.append(values[cast].mean() / values[~shadow].mean())
        assert ratios[0] < 0.8, (index, ratios)
        mirrored_ratios.append(ratios[1])
    assert max(mirrored_ratios) > 1, "the test would pass for a mirrored reader too"
