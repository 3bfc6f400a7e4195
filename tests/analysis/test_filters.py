"""The filter bank and its convolution."""

import numpy as np
import pytest
from scipy import ndimage

from btfpipe.analysis.filters import N_FILTERS, base_sigma, filter_pictures, leung_malik


def test_bank_has_the_kernels_of_leung_and_malik():
    kernels = leung_malik(1.0)
    assert len(kernels) == N_FILTERS == 48
    assert kernels.shape[1] == kernels.shape[2]
    assert kernels.shape[1] % 2 == 1
    sums, weights = kernels.sum(axis=(1, 2)), np.abs(kernels).sum(axis=(1, 2))
    assert np.allclose(sums[:44], 0, atol=1e-12)
    assert np.allclose(sums[44:], 1)
    assert np.allclose(weights, 1)
    first, second = kernels[:18], kernels[18:36]
    assert np.allclose(first[:, ::-1, ::-1], -first)
    assert np.allclose(second[:, ::-1, ::-1], second)


def test_kernels_are_derivatives_of_their_gaussians():
    """Found by finite differences of the Gaussian itself, in the bank's order, signs included."""
    sigma, step = 1.2, 1e-3
    kernels = leung_malik(sigma)
    half = kernels.shape[1] // 2
    row, col = np.mgrid[-half : half + 1, -half : half + 1].astype(float)

    def bell(row, col, across, along, angle):
        u = col * np.cos(angle) + row * np.sin(angle)
        v = row * np.cos(angle) - col * np.sin(angle)
        return np.exp(-((u / across) ** 2) / 2 - (v / along) ** 2 / 2)

    def shifted(n, angle, *widths):
        return bell(row + n * step * np.sin(angle), col + n * step * np.cos(angle), *widths)

    expected = []
    widths = sigma * np.sqrt(2) ** np.arange(4)
    angles = np.arange(6) * np.pi / 6
    long = [(w, 3 * w, angle) for w in widths[:3] for angle in angles]
    for w, v, angle in long:
        first = shifted(1, angle, w, v, angle) - shifted(-1, angle, w, v, angle)
        expected.append((first, v))
    for w, v, angle in long:
        middle = 2 * shifted(0, angle, w, v, angle)
        second = shifted(1, angle, w, v, angle) + shifted(-1, angle, w, v, angle) - middle
        expected.append((second, v))
    for w in [*widths, *(3 * widths)]:
        laplacian = -4 * shifted(0, 0, w, w, 0)
        for turn in range(4):
            laplacian += shifted(1, turn * np.pi / 2, w, w, 0)
        expected.append((laplacian, w))
    expected += [(shifted(0, 0, w, w, 0), None) for w in widths]
    for kernel, (derivative, reach) in zip(kernels, expected, strict=True):
        if reach is None:
            reach = np.inf
            derivative = derivative * (kernel > 0)
        else:
            inside = (np.abs(row) <= np.ceil(3 * reach)) & (np.abs(col) <= np.ceil(3 * reach))
            derivative = np.where(inside, derivative - derivative[inside].mean(), 0)
        derivative /= np.abs(derivative).sum()
        np.testing.assert_allclose(kernel, derivative, atol=1e-5)


def test_second_derivatives_answer_a_parabola_with_its_curvature():
    """A valley is positive, a ridge negative, and along the valley nothing bends."""
    kernels = leung_malik(1.0)[18:24]
    half = kernels.shape[1] // 2
    axis = np.arange(-half, half + 1.0)
    valley = np.broadcast_to(axis**2, kernels.shape[1:])  # across the columns
    across, along = ((kernels[i] * valley).sum() for i in (0, 3))
    assert across > 5 * abs(along)


def test_elongated_gaussians_are_three_times_longer_than_wide():
    kernel = np.abs(leung_malik(1.0)[0])  # first derivative across the columns
    axis = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    long = np.sqrt((kernel.sum(axis=1) * axis**2).sum())
    assert long == pytest.approx(3, rel=0.05)


@pytest.mark.parametrize("turn", range(6))
def test_a_grating_excites_the_filters_of_its_orientation(turn):
    angle = turn * np.pi / 6
    row, col = np.mgrid[:96, :96]
    phase = (col * np.cos(angle) + row * np.sin(angle)) / 1.4  # the finest filters' own frequency
    responses = np.concatenate(
        list(filter_pictures(np.sin(phase)[None], leung_malik(1.4), toroidal=False))
    )
    energy = (responses[:, 30:-30, 30:-30] ** 2).mean(axis=(1, 2))
    assert energy[:6].argmax() == turn
    assert energy[18:24].argmax() == turn
    assert energy[turn] > 5 * np.delete(energy[:6], turn).max()


@pytest.mark.parametrize("toroidal", [True, False])
@pytest.mark.parametrize("shape", [(40, 33), (9, 12)])
def test_responses_match_direct_convolution_with_the_stated_border(rng, toroidal, shape):
    pictures = rng.random((2, *shape))
    kernels = leung_malik(0.8)[[0, 3, 20, 43, 47]]
    for kernel, response in zip(kernels, filter_pictures(pictures, kernels, toroidal), strict=True):
        mode = "wrap" if toroidal else "reflect"
        direct = np.stack([ndimage.convolve(picture, kernel, mode=mode) for picture in pictures])
        assert response.dtype == np.float32
        assert np.abs(response - direct).max() < 1e-6


def test_threads_do_not_change_the_responses(rng):
    pictures = rng.random((5, 24, 24))
    one, two = (
        np.stack(list(filter_pictures(pictures, leung_malik(1.0), False, threads)))
        for threads in (1, 2)
    )
    assert one.tobytes() == two.tobytes()


def test_small_pictures_get_smaller_filters():
    sigmas = [base_sigma(n, 2 * n) for n in (8, 64, 96, 128, 512)]
    assert sigmas == sorted(sigmas)
    assert sigmas[0] == 0.7
    assert sigmas[3] == 1
    assert sigmas[-1] == pytest.approx(np.sqrt(2))
