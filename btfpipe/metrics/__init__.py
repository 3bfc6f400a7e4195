"""Errors of pictures and BTFs, each with formula and unit.

Two domains. *Linear*: the values themselves, radiance relative to a white diffuser. *Display*: the values divided by
a stated white, clipped to [0, 1] and encoded by the sRGB curve, as a person sees them.
"""

from btfpipe.metrics.pictures import (
    mean_squared_error,
    psnr,
    relative_error,
    rmse,
    ssim,
    to_display,
)

__all__ = [
    "mean_squared_error",
    "psnr",
    "raw_bytes",
    "relative_error",
    "rmse",
    "ssim",
    "to_display",
]


def raw_bytes(appearance):
    """Bytes of a Sample's pictures, uncompressed: 3 a texel and pair if 8-bit, 6 (half floats) otherwise.

    Of a Model: those of the Sample it was made from, taken for 8-bit if its file does not say.
    """
    codes = getattr(appearance, "codes", None)
    said = None if codes is not None else appearance.about.get("sample_bytes")
    if isinstance(said, int) and said > 0:
        return said
    each = 3 if codes is None or codes.dtype.itemsize == 1 else 6
    return each * appearance.n_pairs * appearance.shape[0] * appearance.shape[1]
