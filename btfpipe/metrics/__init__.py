"""Errors of pictures and BTFs, each with formula and unit."""


def raw_bytes(sample):
    """Bytes that a Sample's pictures take uncompressed: 3 a texel and pair if 8-bit, 6 if high dynamic range."""
    import numpy as np

    each = 3 if sample.codes.dtype == np.uint8 else 6
    return each * sample.n_pairs * sample.shape[0] * sample.shape[1]
