"""Transfer curves between stored codes and linear values."""

import numpy as np

TRANSFERS = ("srgb", "gamma2.2", "linear")


def decode(values, transfer):
    """Linear values of display values, both with 1 as white; beyond [0, 1] the curves go on."""
    values = np.asarray(values, dtype=np.float64)
    if transfer == "srgb":  # IEC 61966-2-1
        low = values / 12.92
        high = ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4
        return np.where(values <= 0.04045, low, high)
    if transfer == "gamma2.2":
        return np.maximum(values, 0) ** 2.2
    return values


def encode(values, transfer):
    """Display values of linear ones; the inverse of `decode`."""
    values = np.asarray(values)
    if transfer == "srgb":
        high = 1.055 * np.maximum(values, 0.0031308) ** (1 / 2.4) - 0.055
        return np.where(values <= 0.0031308, values * 12.92, high)
    if transfer == "gamma2.2":
        return np.maximum(values, 0) ** (1 / 2.2)
    return values


def decode_table(dtype, transfer, scale=1.0):
    """Linear value of every code: a look-up table for uint8 (256) or for float16 by its bits (65,536).

    Not-a-number codes decode to 0 in the float16 table; stored samples hold none.
    """
    dtype = np.dtype(dtype)
    if dtype == np.uint8:
        return (decode(np.arange(256) / 255, transfer) * scale).astype(np.float32)
    if dtype == np.float16:
        values = np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float64)
        values[~np.isfinite(values)] = 0
        return (decode(values, transfer) * scale).astype(np.float32)
    raise ValueError(f"no table for {dtype}")
