import math

import numpy as np
import pytest
from scipy.special import lpmv

from btfpipe.compression import open_appearance
from btfpipe.compression.relighting import RelightingModel, evaluate_basis
from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError


def a_model(rng, basis="hsh", terms=9, colour=False, transfer="srgb", shape=(5, 7)):
    codes = rng.integers(0, 256, (*shape, 1 if colour else 3, terms), np.uint8)
    scale = rng.normal(size=terms).astype(np.float32) / 300
    offset = rng.normal(size=terms).astype(np.float32) / 3
    offset[-1 if basis == "ptm" else 0] += 1
    colours = rng.integers(0, 256, (*shape, 3), np.uint8) if colour else None
    return RelightingModel(codes, scale, offset, colours, basis, transfer)


def naive(model, i, j, light):
    """Value (3,) of one texel, from the definition."""
    if light[2] <= 0:
        return np.zeros(3)
    x, y = light[:2]
    if model.basis == "ptm":
        basis = [x * x, y * y, x * y, x, y, 1]
    else:
        basis = [harmonic(k, light) for k in range(model.coefficients.shape[3])]
    coefficients = model.coefficients[i, j].astype(float) * model.scale + model.offset
    display = np.maximum(coefficients @ np.array(basis), 0)
    if model.colour is not None:
        display = display * model.colour[i, j] / 255
    if model.transfer == "linear":
        return display
    if model.transfer == "gamma2.2":
        return display**2.2
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def harmonic(number, light):
    """Hemispherical harmonic by associated Legendre functions, of 2 cos(theta) - 1; signs as RTI files have them."""
    band = math.isqrt(number)
    order = band - (number - band * band)
    x, y, z = light
    c = np.clip(z, np.cos(np.pi / 2 - 0.01), 1)
    phi, m = np.arctan2(y, x), abs(order)
    norm = (2 * band + 1) / (2 * np.pi) * math.factorial(band - m) / math.factorial(band + m)
    value = np.sqrt(norm) * lpmv(m, band, 2 * c - 1)
    if order == 0:
        return value
    return -np.sqrt(2) * value * (np.cos(m * phi) if order > 0 else np.sin(m * phi))


def random_lights(rng, n):
    lights = rng.normal(size=(n, 3))
    lights[:, 2] = np.abs(lights[:, 2])
    return (lights / np.linalg.norm(lights, axis=1, keepdims=True)).astype(np.float32)


def test_the_harmonics_are_those_of_the_definition(rng):
    lights = np.concatenate([random_lights(rng, 40), [[0, 0, 1], [1, 0, 0], [0, -1, 0]]])
    basis = evaluate_basis("hsh", 16, lights)
    expected = [[harmonic(k, light) for k in range(16)] for light in lights]
    np.testing.assert_allclose(basis, expected, atol=1e-6)


def test_the_harmonics_are_orthonormal_over_the_hemisphere():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cosine, weights = (nodes + 1) / 2, weights / 2
    phi = np.arange(16) * np.pi / 8
    theta, phi = np.meshgrid(np.arccos(cosine), phi, indexing="ij")
    basis = evaluate_basis("hsh", 16, from_angles(theta, phi).reshape(-1, 3))
    share = np.repeat(weights, 16) * np.pi / 8
    # the nearest node to the horizon is bent by a hair
    np.testing.assert_allclose((basis * share[:, None]).T @ basis, np.eye(16), atol=2e-2)


@pytest.mark.parametrize(
    ("basis", "terms", "colour", "transfer"),
    [
        ("ptm", 6, False, "srgb"),
        ("ptm", 6, True, "gamma2.2"),
        ("hsh", 4, False, "linear"),
        ("hsh", 9, False, "srgb"),
        ("hsh", 16, True, "srgb"),
    ],
)
def test_every_way_to_a_value_agrees_with_the_definition(rng, basis, terms, colour, transfer):
    model = a_model(rng, basis, terms, colour, transfer)
    rows, cols = rng.integers(0, 5, 6), rng.integers(0, 7, 6)
    lights = random_lights(rng, 6)
    lights[0] = [0.6, 0, -0.8]
    expected = [naive(model, i, j, w) for i, j, w in zip(rows, cols, lights, strict=True)]
    values = model.evaluate(rows, cols, lights, [0, 0, 1])
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)
    assert (values[0] == 0).all()
    pictures = model.pictures(slice(3, 80, 19))
    for picture, light in zip(pictures, bonn81()[3:80:19], strict=True):
        for i, j in ((0, 0), (4, 6), (2, 3)):
            np.testing.assert_allclose(
                picture[i, j], naive(model, i, j, light), rtol=1e-4, atol=1e-5
            )
    texels = model.texels(rows, cols)
    assert texels.shape == (6, 81, 3)
    np.testing.assert_allclose(
        texels, model.pictures(slice(0, 81))[:, rows, cols].swapaxes(0, 1), rtol=1e-5, atol=1e-6
    )


def test_linear_values_are_blended_between_texels_and_the_view_does_not_matter(rng):
    model = a_model(rng)
    light = random_lights(rng, 1)[0]
    value = model.evaluate(1.25, 2.5, light, [0.6, 0, 0.8])
    corners = [
        (0.75 if i == 1 else 0.25) * 0.5 * naive(model, i, j, light) for i in (1, 2) for j in (2, 3)
    ]
    np.testing.assert_allclose(value[0], sum(corners), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(value, model.evaluate(1.25, 2.5, light, [0, 0, 1]))


def test_values_above_the_displays_white_are_kept(rng):
    model = a_model(rng, "ptm", 6)
    model.offset[5] = 3
    assert model.pictures([0]).max() > 8


@pytest.mark.parametrize("colour", [False, True])
def test_a_saved_model_is_the_same_again(tmp_path, rng, colour):
    model = a_model(rng, "ptm", 6, colour, "gamma2.2")
    model.save(tmp_path / "m.npz")
    again = open_appearance(tmp_path / "m.npz")
    assert isinstance(again, RelightingModel)
    assert (again.basis, again.transfer, again.shape) == ("ptm", "gamma2.2", (5, 7))
    np.testing.assert_array_equal(again.pictures([0, 40]), model.pictures([0, 40]))
    lights = random_lights(rng, 9)
    np.testing.assert_array_equal(*(m.evaluate(1, 2.5, lights, [0, 0, 1]) for m in (model, again)))
    assert again.nbytes == 5 * 7 * (9 if colour else 18) + 48 + 82 * 24
    assert again.is_product


def test_what_does_not_go_together_is_refused(rng):
    codes = np.zeros((2, 2, 3, 6), np.uint8)
    good = {"basis": "ptm", "transfer": "srgb", "colour": None}
    for change, match in (
        ({"basis": "hsh"}, "6 terms of the basis 'hsh'"),
        ({"basis": "fourier"}, "fourier"),
        ({"transfer": "log"}, "log"),
        ({"colour": codes[:, :, 0, :3]}, "3 channels"),
    ):
        with pytest.raises(InputError, match=match):
            RelightingModel(codes, np.ones(6), np.ones(6), **good | change)


@pytest.mark.parametrize("name", ["scale", "offset"])
@pytest.mark.parametrize("value", [1e13, np.inf, np.nan])
def test_values_that_no_picture_has_are_refused_naming_the_file(tmp_path, name, value):
    codes = np.zeros((2, 2, 3, 6), np.uint8)
    model = RelightingModel(codes, np.ones(6), np.ones(6), None, "ptm", "srgb")
    setattr(model, name, np.full(6, value * (1 if name == "scale" else 255), np.float32))
    model.save(tmp_path / "mine.npz")
    with pytest.raises(InputError, match=r"mine\.npz: .* (display values up to|infinite)"):
        open_appearance(tmp_path / "mine.npz")
