"""Writes Bonn's ``.btf`` files (DFMF); `btf` reads them."""

import math
import struct

import numpy as np

from btfpipe import files
from btfpipe.compression.factored import EPSILON, SPACES, FactoredModel, compress_factored
from btfpipe.directions import to_angles
from btfpipe.errors import InputError


def write_btf(
    path,
    appearance,
    *,
    terms=None,
    space=None,
    precision=None,
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Write a DFMF file (``!DFMF08FCR``), the kind of the UBO2014 downloads.

    A `FactoredModel` is written as it is; anything else is compressed first. Rows keep their order, so that what is
    written is read back equal; the light's cosine stays inside the values, and the flag says so.

    Parameters
    ----------
    path : path-like
    appearance : Appearance
        Of a product of views and lights. Some other readers also need as many lights as views, and colour model
        ``rgb`` or ``log_y_uv_over_y``.
    terms, space, precision : optional
        As in `compress_factored`, by default (32, 16, 16), ``log_y_uv_over_y`` and ``half``. A FactoredModel keeps its own;
        others may not be asked for.
    seed, threads, memory, on_progress
        As in `compress_factored`, where it is used.

    Returns
    -------
    FactoredModel
        What was written.

    Raises
    ------
    InputError
        If the pairs are not a product, or a FactoredModel does what the format cannot say, or has other terms, space or
        precision than those given.
    """
    appearance.require_product("a .btf file")
    files.check_writable(path)
    model = appearance
    if isinstance(model, FactoredModel):
        _require_own(model, terms, space, precision)
    else:
        given = {"terms": terms, "space": space, "precision": precision}
        given = {name: value for name, value in given.items() if value is not None}
        model = compress_factored(
            appearance, **given, seed=seed, threads=threads, memory=memory, on_progress=on_progress
        )
    number, flag = _expressible(model)
    light, view = (
        np.stack(to_angles(directions), axis=-1)
        for directions in (model.light_directions, model.view_directions)
    )
    rows, cols = model.shape
    with files.whole(path) as file:
        file.write(b"!DFMF08FCR" + _meta(model, flag))
        lights = struct.pack("<I", len(light)) + _signed(light)
        file.write(struct.pack("<I", len(view)))
        for angles in view:
            file.write(_signed(angles) + lights)
        file.write(struct.pack("<3I", cols, rows, 0))
        file.write(struct.pack("<Ii", max(model.n_terms), number))
        file.write(model.mean.astype("<f4").tobytes() + model.matrix.astype("<f4").tobytes())
        for angular, texture in zip(model.angular_factors, model.texture_factors, strict=True):
            _write_factors(file, angular, texture.reshape(rows * cols, -1))
    return model


def _require_own(model, terms, space, precision):
    """Refuse to write a FactoredModel otherwise than it is; None asks for nothing."""
    half = all(factors.dtype == np.float16 for factors in model.angular_factors)
    for what, given, own in (
        ("terms", terms if terms is None else tuple(terms), model.n_terms),
        ("space", space, model.space),
        ("precision", precision, "half" if half else "single"),
    ):
        if given not in (None, own):
            given, own = (
                value if isinstance(value, str) else " ".join(map(str, value))
                for value in (given, own)
            )
            raise InputError(
                f"the model's {what}: {own}; asked for: {given}. A factored model is written as it is: leave that out, or"
                " compress the Sample again."
            )


def _expressible(model):
    """Colour model and cosine flag of a FactoredModel, which must be what the format can say."""
    number = SPACES[model.space]
    if model.log_range:
        if model.space != "rgb":
            raise InputError(
                f"a .btf file cannot stretch the colours of {model.space} by exp; only those of rgb."
            )
        number = SPACES["log_rgb"]
    if model.epsilon != EPSILON:
        raise InputError(f"epsilon is {model.epsilon:g}; a .btf file can hold only {EPSILON:g}.")
    if model.pair_factor is None:
        return number, 1
    cosine = np.asarray(model.light_directions)[model.light_index, 2]
    if not np.allclose(model.pair_factor, cosine, rtol=0, atol=1e-6):
        raise InputError(
            "the pairs' factors are not their lights' cosines; a .btf file can hold no others."
        )
    return number, 0


def _meta(model, flag):
    said = {True: "true", False: "false"}
    xml = (
        f'<btfpipe toroidal="{said[bool(model.toroidal)]}"'
        f' absolute="{said[bool(model.absolute)]}"/>'
    ).encode()
    block = struct.pack("<I80s80s80s", 4, b"btfpipe", b"", b"")
    block += struct.pack("<4f", model.texels_per_mm or 0.0, 1.0, 1.0, 1.0)
    block += struct.pack("<II", flag, len(xml)) + xml
    block += struct.pack("<I", 3) + b"".join(
        struct.pack("<I", 1) + name for name in (b"R", b"G", b"B")
    )
    return struct.pack("<I", 4 + len(block)) + block


def _signed(angles):
    """Angles as float32, azimuths in (-pi, pi]."""
    theta, phi = angles[..., 0], angles[..., 1]
    phi = np.where(phi > math.pi, phi - 2 * math.pi, phi)
    return np.stack([theta, phi], axis=-1).astype("<f4").tobytes()


def _write_factors(file, angular, texture):
    """One channel; singular values are the products of the factors' lengths."""
    dtype = np.dtype(np.result_type(angular, texture)).newbyteorder("<")
    values = np.ones(angular.shape[1])
    for factors in (angular, texture):
        squares = np.zeros(factors.shape[1])
        for start in range(0, len(factors), 4096):
            part = np.asarray(factors[start : start + 4096], np.float64)
            squares += np.square(part).sum(axis=0)
        values *= np.sqrt(squares)
    values = np.minimum(values, float(np.finfo(dtype).max))
    file.write(struct.pack("<B3I", dtype.itemsize, len(values), len(angular), len(texture)))
    for array in (values, angular, texture):
        file.write(np.ascontiguousarray(array, dtype).tobytes())
