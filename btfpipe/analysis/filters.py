"""The Leung-Malik filter bank: what a texel's surroundings look like, in 48 numbers.

First and second derivatives of elongated Gaussians at 6 orientations and 3 scales, 8 Laplacians of Gaussians
and 4 Gaussians (Leung and Malik 2001, section 2.1). Scales grow by the square root of 2.
"""

import numpy as np

from btfpipe.parallel import ordered_map

N_FILTERS = 48
_ORIENTATIONS = 6
_ELONGATION = 3.0
_REACH = 3.0  # supports end at three standard deviations


def base_sigma(rows, cols):
    """Standard deviation of the bank's finest filters, in texels, for pictures of this size.

    Leung and Malik's own, the square root of 2, from 256 texels on; smaller pictures scale it by the square root
    of their shorter side (1 at 128), down to 0.7, below which a sampled derivative is no longer one.
    """
    return float(np.clip(np.sqrt(min(rows, cols) / 128), 0.7, np.sqrt(2)))


def leung_malik(sigma):
    """The 48 kernels of the bank.

    Derivatives and Laplacians have zero mean and absolute values that sum to 1, Gaussians sum to 1, so that each
    filter weighs alike. Each kernel reaches three of its own standard deviations and is zero from there on.

    Parameters
    ----------
    sigma : float
        Standard deviation of the finest filters, texels.

    Returns
    -------
    (48, side, side) float64
        18 first derivatives (scale by scale, 6 orientations each, 30 degrees apart, the first along the columns),
        18 second derivatives, 8 Laplacians, 4 Gaussians.
    """
    scales = sigma * np.sqrt(2.0) ** np.arange(4)
    radius = int(np.ceil(_REACH * 3 * scales[3]))
    axis = np.arange(-radius, radius + 1.0)
    col, row = np.meshgrid(axis, axis)
    first, second = [], []
    for scale in scales[:3]:
        inside = _window(row, col, _ELONGATION * scale)
        for angle in np.arange(_ORIENTATIONS) * np.pi / _ORIENTATIONS:
            across = (col * np.cos(angle) + row * np.sin(angle)) / scale
            along = (row * np.cos(angle) - col * np.sin(angle)) / (_ELONGATION * scale)
            bell = np.exp(-(across**2 + along**2) / 2) * inside
            first.append(_zero_mean(-across * bell, inside))
            second.append(_zero_mean((across**2 - 1) * bell, inside))
    laplacians, gaussians = [], []
    for scale in np.concatenate([scales, 3 * scales]):
        inside = _window(row, col, scale)
        square = (row**2 + col**2) / scale**2
        laplacians.append(_zero_mean((square - 2) * np.exp(-square / 2) * inside, inside))
    for scale in scales:
        bell = np.exp(-(row**2 + col**2) / (2 * scale**2)) * _window(row, col, scale)
        gaussians.append(bell / bell.sum())
    return np.stack(first + second + laplacians + gaussians)


def _window(row, col, sigma):
    reach = np.ceil(_REACH * sigma)
    return (np.abs(row) <= reach) & (np.abs(col) <= reach)


def _zero_mean(kernel, inside):
    kernel = np.where(inside, kernel - kernel[inside].mean(), 0)
    return kernel / np.abs(kernel).sum()


def filter_pictures(pictures, kernels, toroidal, threads=1):
    """Convolve pictures with kernels, yielding one kernel's responses at a time.

    Beyond the border a toroidal picture goes on at the opposite side; any other is mirrored, its border texels
    repeated.

    Parameters
    ----------
    pictures : (n, rows, cols) array
    kernels : (m, side, side) array
        Odd side; the origin is the middle.
    toroidal : bool
    threads : int

    Yields
    ------
    (n, rows, cols) float32
        Responses to one kernel, in the kernels' order.
    """
    from scipy import fft

    pictures = np.asarray(pictures, np.float32)
    rows, cols = pictures.shape[1:]
    radius = kernels.shape[1] // 2
    pad = 0 if toroidal else radius
    padded = np.pad(pictures, ((0, 0), (pad, pad), (pad, pad)), "symmetric") if pad else pictures
    size = [n if toroidal else fft.next_fast_len(n, real=True) for n in padded.shape[1:]]
    spectra = fft.rfft2(padded, size)

    def respond(kernel):
        wrapped = np.zeros(size)
        i = np.arange(-radius, radius + 1)
        np.add.at(wrapped, (i[:, None] % size[0], i[None, :] % size[1]), kernel)
        spectrum = fft.rfft2(wrapped).astype(np.complex64)
        return fft.irfft2(spectra * spectrum, size)[:, pad : pad + rows, pad : pad + cols]

    yield from ordered_map(respond, kernels, threads)
