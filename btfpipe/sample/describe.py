"""What a container of the project's is, and what is wrong with it, in plain values."""

import math

import numpy as np

from btfpipe.directions import bonn81, to_angles, ubo2014
from btfpipe.errors import InputError
from btfpipe.parallel import blocks
from btfpipe.sample.sample import Sample

_BLOCK_VALUES = 2**22
_LISTED = 20


def describe_container(reader, report=lambda done, total: None):
    """Describe any of the project's files.

    Parameters
    ----------
    reader : store.Reader
    report : callable
        ``report(done, total)`` while values are read.

    Returns
    -------
    dict
        ``kind``, ``digest``, ``about``, ``arrays`` (name to shape, type and number of values that are not finite), for
        a sample also ``sample``, where there is a mask ``invalid_texels``, and ``problems``: a list of sentences.
    """
    problems, arrays = [], {}
    for name in reader.names():
        try:
            array = reader[name]
        except InputError as error:
            problems.append(str(error))
            continue
        arrays[name] = {"shape": list(array.shape), "dtype": str(array.dtype)}
        if array.dtype.kind == "f":
            bad = _not_finite(array, report)
            arrays[name]["not_finite"] = bad
            if bad:
                problems.append(f"{name} holds {bad} NaN or infinite values.")
    description = {"kind": reader.kind, "digest": reader.digest}
    if arrays.get("mask", {}).get("dtype") == "bool":
        description["invalid_texels"] = int(np.count_nonzero(~reader["mask"]))
    if reader.kind == "sample" and not problems:
        try:
            sample = Sample.from_reader(reader)
        except InputError as error:
            problems.append(str(error))
        else:
            description["sample"] = describe_sample(sample, report)
            problems += description["sample"].pop("problems")
    return description | {"about": reader.about, "arrays": arrays, "problems": problems}


def _not_finite(array, report):
    flat = array.reshape(-1)
    bad = 0
    for block in blocks(flat.size, _BLOCK_VALUES):
        values = flat[block]
        bad += values.size - int(np.count_nonzero(np.isfinite(values)))
        report(block.stop, flat.size)
    return bad


def describe_sample(sample, report=lambda done, total: None):
    """Describe a Sample: sizes, directions, pairs, clipped values, scale.

    Returns
    -------
    dict
        With ``problems``, a list of sentences.
    """
    arranged, problems = describe_pairs(
        sample.view_index,
        sample.light_index,
        len(sample.view_directions),
        len(sample.light_directions),
    )
    clipped = _clipped(sample, report)
    description = {
        "rows": sample.shape[0],
        "cols": sample.shape[1],
        "pairs": sample.n_pairs,
        "views": describe_directions(sample.view_directions),
        "lights": describe_directions(sample.light_directions),
        **arranged,
        "clipped_values": clipped,
        "clipped_share": clipped / sample.codes.size,
        "stored_as": str(sample.codes.dtype),
        "transfer": sample.transfer,
        "scale": sample.scale,
        "absolute_scale": "known" if sample.absolute else "unknown",
        "toroidal": sample.toroidal,
        "texels_per_mm": sample.texels_per_mm,
        "flattened": sample.gain is not None,
        "nbytes": sample.nbytes,
        "problems": problems,
    }
    for name in ("scale", "texels_per_mm"):
        value = getattr(sample, name)
        if value is not None and not (math.isfinite(value) and value > 0):
            description["problems"].append(f"{name} is {value}; expected a positive number.")
    for name, table in (("view", sample.view_directions), ("light", sample.light_directions)):
        length = np.linalg.norm(table, axis=1)
        if abs(length - 1).max() > 1e-4 or table[:, 2].min() < -1e-6:
            description["problems"].append(
                f"{name} directions are not all unit vectors above the surface."
            )
    return description


def describe_pairs(view_index, light_index, n_views, n_lights, name="view {} light {}".format):
    """Say how pairs are arranged, and what is wrong with that.

    Parameters
    ----------
    view_index, light_index : (pairs,) int
    n_views, n_lights : int
        How many there are of each.
    name : callable
        ``name(view, light)`` gives what a pair is called.

    Returns
    -------
    dict, list of str
        Facts (``product``, ``arrangement``, ``missing_pairs``: None for a list of pairs, ``duplicate_pairs``), and
        problems, as sentences.
    """
    number = np.asarray(view_index, np.int64) * n_lights + light_index
    seen, whole = np.unique(number), n_views * n_lights
    missing, twice = whole - len(seen), len(number) - len(seen)
    product = len(number) == whole and bool((number == np.arange(whole)).all())
    # Files get lost out of a product one by one. Where more than a tenth is not there, nobody meant to have it: a list
    # of positions has about as many views and lights as pairs, and so nearly all of their combinations "missing".
    is_list = not product and (missing == 0 or missing > max(1, whole // 10))
    facts = {
        "product": product,
        "arrangement": "list of pairs" if is_list else "views times lights",
        "missing_pairs": None if is_list else missing,
        "duplicate_pairs": twice,
    }
    problems = []
    if missing and not is_list:
        gaps = np.setdiff1d(np.arange(whole), seen)[:_LISTED].tolist()
        names = ", ".join(name(*divmod(gap, n_lights)) for gap in gaps)
        more = ", ..." if missing > _LISTED else ""
        problems.append(f"{missing} of {whole} view/light pairs are missing ({names}{more}).")
    if twice:
        problems.append(f"{twice} pairs are there twice.")
    return facts, problems


def describe_directions(directions):
    """Number, rings and name of a set of directions (n, 3)."""
    theta, _ = to_angles(directions)
    rings, counts = np.unique(np.round(np.degrees(theta), 2), return_counts=True)
    known = {"Bonn's 81": bonn81(), "UBO2014's 151": ubo2014()}
    return {
        "number": len(directions),
        "set": next(
            (
                name
                for name, table in known.items()
                if table.shape == directions.shape and np.allclose(table, directions, atol=1e-4)
            ),
            None,
        ),
        "rings_deg": {f"{ring:g}": int(count) for ring, count in zip(rings, counts, strict=True)}
        if len(rings) <= _LISTED
        else f"{len(rings)} polar angles from {rings[0]:g} to {rings[-1]:g}",
    }


def _clipped(sample, report):
    """Values at the largest code of 8-bit pictures."""
    if sample.codes.dtype != np.uint8:
        return 0
    flat = sample.codes.reshape(-1)
    clipped = 0
    for block in blocks(flat.size, 4 * _BLOCK_VALUES):
        clipped += int(np.count_nonzero(flat[block] == 255))
        report(block.stop, flat.size)
    return clipped
