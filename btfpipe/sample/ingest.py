"""From a measurement to a Sample file, streaming: no more than a few pictures are in memory at a time."""

import dataclasses

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, ordered_map
from btfpipe.sample.measurement import nearest_normal
from btfpipe.sample.sample import Sample
from btfpipe.sample.transfer import decode, decode_table, encode

_BLOCK_BYTES = 2**22
_LISTED = 20  # names of strays and the like that a summary lists
_FULL = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}


def ingest(
    measurement,
    path,
    *,
    crop=None,
    size=None,
    transfer=None,
    white=None,
    grey_card=None,
    grey_card_reflectance=None,
    flatten=False,
    toroidal=None,
    texels_per_mm=None,
    threads=1,
    report=lambda done, total: None,
    about=None,
):
    """Read all pictures of a measurement and write them as a Sample.

    Eight-bit pictures are stored as they are, with their transfer curve; others as linear floating point (16-bit floats
    stay so), unclipped. Resized eight-bit pictures are rounded to eight bits again. Texels that the measurement's mask leaves
    out, or of which any source is left out, are stored as 0, which costs no compression anything.

    Parameters
    ----------
    measurement : Measurement
    path : path-like
        Sample to write; it appears only when complete.
    crop : (row, col, rows, cols), optional
        Part of the pictures to keep.
    size : (rows, cols), optional
        Size of the result in texels; see `resize.Resizer`.
    transfer : str, optional
        Curve of the pictures, by default what the format means.
    white : float, optional
        Decoded value, 1 for the largest code, of a perfect white diffuser lit at normal incidence. It makes the
        scale absolute.
    grey_card : (row, col, rows, cols), optional
        Part of the uncropped pictures that shows a diffuse card of known reflectance; measured in the pair nearest
        the normal, in place of `white`.
    grey_card_reflectance : float, optional
        In (0, 1].
    flatten : bool
        Store a gain that removes slow drift of brightness over the patch; see `drift_gain`.
    toroidal : bool, optional
        By default what the source says, unless a crop breaks it.
    texels_per_mm : float, optional
        Of the source's pictures, before resizing.
    threads : int
        Never changes the result.
    report : callable
        ``report(done, total)`` after each block of pictures.
    about : dict, optional
        Further provenance for the file.

    Returns
    -------
    dict
        Facts for the summary: sizes, clipped pixels and so on.

    Raises
    ------
    InputError
        If a picture cannot be decoded, differs in size or kind, or holds values that are not finite; if a region lies
        outside the pictures; if no texel is valid.
    """
    first = measurement.read(0)
    shape = first.shape[:2]
    _inside(crop, shape, "--crop", measurement)
    _inside(grey_card, shape, "--grey-card", measurement)
    row, col, rows, cols = crop or (0, 0, *shape)
    texels = tuple(size or (rows, cols))
    curve = source_curve = transfer or measurement.transfer(first)
    stored, clipped_in = measurement, {}
    if measurement.correct is not None:
        measurement = _corrected(measurement, curve, clipped_in)
        curve, first = "linear", measurement.read(0)
    cropped = (rows, cols) != shape
    if toroidal is None:
        toroidal = bool(measurement.toroidal) and not cropped
    if flatten and toroidal:
        raise InputError(
            f"{measurement.source}: a patch that repeats has no drift to remove; leave --flatten out or say"
            " --not-toroidal."
        )
    white = _white(measurement, stored, white, grey_card, grey_card_reflectance, curve)
    mask = _mask(measurement, (row, col, rows, cols), texels, toroidal)
    eight_bit = first.dtype == np.uint8
    dtype = first.dtype if first.dtype in (np.uint8, np.float16) else np.dtype(np.float32)
    convert = _converter(first.dtype, dtype, curve, (rows, cols), texels, toroidal)
    table = decode_table(np.uint8, curve) if eight_bit else None
    curved = first.dtype.kind == "f" and curve != "linear"  # which takes large values beyond any
    full = _FULL.get(first.dtype)
    same = (
        eight_bit and (rows, cols) == texels
    )  # stored as read: one look at the whole block will do

    def read_block(block):
        pictures = np.empty((block.stop - block.start, *texels, 3), dtype)
        clipped = []
        for slot, pair in enumerate(range(block.start, block.stop)):
            picture = first if pair == 0 else measurement.read(pair)
            _like_first(picture, first, pair, measurement)
            picture = picture[row : row + rows, col : col + cols]
            if full and not same and picture.max() == full:
                clipped.append(_count_clipped(picture, full))
            pictures[slot] = convert(picture)
            if curved:
                _require_finite(pictures[slot], measurement.names[pair])
        if full and same and pictures.max() == full:
            clipped = [_count_clipped(p, full) for p in pictures if p.max() == full]
        if mask is not None:
            pictures[:, ~mask] = 0
        total = None
        if flatten:
            total = np.zeros((*texels, 3))
            for picture in pictures:
                total += table[picture] if eight_bit else picture
        return pictures, clipped, total

    n_pairs = measurement.n_pairs
    sample = Sample(
        np.broadcast_to(np.zeros(1, dtype), (n_pairs, *texels, 3)),
        measurement.light_directions,
        measurement.view_directions,
        measurement.light_index,
        measurement.view_index,
        transfer=curve if eight_bit else "linear",
        scale=measurement.scale if white is None else 1.0 / white,
        toroidal=toroidal,
        mask=mask,
        texels_per_mm=_density(measurement, texels_per_mm, (rows, cols), texels),
        absolute=white is not None,
    )
    for name in ("scale", "texels_per_mm"):
        if getattr(sample, name) is not None:
            store.check_fact(getattr(sample, name), "positive", f"{measurement.source}: {name}")
    facts = {
        "rows": texels[0],
        "cols": texels[1],
        "pairs": n_pairs,
        "views": len(sample.view_directions),
        "lights": len(sample.light_directions),
        "product": sample.is_product,
        "stored_as": str(dtype),
        "source_transfer": source_curve,
        "white": white,
        "crop": list(crop) if crop else None,
        "source_size": list(shape),
        "clipped_pixels": 0,
        "clipped_pictures": 0,
    }
    size_of_block = max(1, _BLOCK_BYTES // (rows * cols * 3 * first.itemsize))
    with store.create(path, "sample", **(about or {}), **sample.facts()) as writer:
        sample.write_tables(writer)
        mean = np.zeros((*texels, 3))
        done = 0
        with writer.stream("pictures", sample.codes.shape, dtype) as put:
            work = blocks(n_pairs, size_of_block)
            for pictures, clipped, total in ordered_map(read_block, work, threads):
                put(pictures)
                facts["clipped_pixels"] += sum(clipped)
                facts["clipped_pictures"] += len(clipped)
                if flatten:
                    mean += total
                done += len(pictures)
                report(done, n_pairs)
        if flatten:
            gain = drift_gain(mean / n_pairs, mask)
            writer.array("gain", gain)
            facts["drift"] = float(gain.max() / gain.min() - 1)
        facts["clipped_pixels"] += sum(clipped_in.values())
        facts["clipped_pictures"] += len(clipped_in)
        facts |= _plain_facts(measurement)
        if mask is not None:
            facts["invalid_texels"] = sample.n_invalid
        writer.facts["source"] = facts
    said = ("toroidal", "texels_per_mm", "absolute")
    return facts | {key: getattr(sample, key) for key in said}


def drift_gain(mean, mask=None):
    """Gain that removes slow drift of brightness from a patch.

    The drift is the quadratic in row and column that fits the mean picture best: slow by construction, and free of the
    border trouble of a blur. Its reciprocal keeps the patch's mean and, being grey, its colours.

    Parameters
    ----------
    mean : (rows, cols, 3)
        Linear mean over all lights and views.
    mask : (rows, cols) bool, optional
        Valid texels, which alone are fitted; all by default.

    Returns
    -------
    (rows, cols, 3) float32

    Raises
    ------
    InputError
        If the fit is not positive everywhere.
    """
    brightness = mean.mean(axis=2)
    rows, cols = brightness.shape
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    valid = slice(None) if mask is None else mask.ravel()
    fit = np.linalg.lstsq(terms[valid], brightness.ravel()[valid], rcond=None)[0]
    drift = (terms @ fit).reshape(rows, cols)
    if mask is not None:
        drift[~mask] = drift[mask].mean()  # nothing is known there
    if drift.min() < 0.1 * drift.max():
        raise InputError(
            "--flatten: the mean picture falls to less than a tenth across the patch; that is no slow drift."
            " Crop to the evenly lit part, or leave --flatten out."
        )
    gain = (drift.mean() / drift).astype(np.float32)
    return np.repeat(gain[..., None], 3, axis=2)


def _converter(source, dtype, curve, shape, texels, toroidal):
    """A function from a cropped picture as read to one as stored."""
    table = decode_table(np.uint8, curve) if source == np.uint8 else None

    def linear(picture):
        if table is not None:
            return table[picture]
        if source == np.uint16:
            return decode(picture / 65535.0, curve).astype(np.float32)
        if curve == "linear":
            return picture
        with np.errstate(over="ignore", invalid="ignore"):  # shows in the picture
            return decode(picture, curve).astype(np.float32)

    if shape == texels:
        return (lambda picture: picture) if source == np.uint8 else linear
    from btfpipe.sample.resize import Resizer

    resizer = Resizer(shape, texels, toroidal)

    def convert(picture):
        resized = resizer(linear(picture))
        if dtype == np.uint8:
            return (encode(resized, curve) * 255 + 0.5).astype(np.uint8)
        return resized

    return convert


def _corrected(measurement, curve, clipped):
    """The measurement with linear, corrected pictures; `clipped` gets the number of clipped pixels by pair.

    They are counted before the correction, over the whole picture. Eight-bit pictures become 16-bit floats, which hold
    them well; others 32-bit ones.
    """

    def read(pair):
        picture = measurement.read(pair)
        full = _FULL.get(picture.dtype)
        if full and picture.max() == full:
            clipped[pair] = _count_clipped(picture, full)
        dtype = np.float16 if picture.dtype == np.uint8 else np.float32
        with np.errstate(over="ignore", invalid="ignore"):  # shows in the picture
            linear = decode(picture / (full or 1), curve).astype(np.float32)
            return measurement.correct(pair, linear).astype(dtype)

    return dataclasses.replace(
        measurement, read=read, transfer=lambda picture: "linear", correct=None
    )


def _count_clipped(picture, full):
    """Pixels of which any channel is at the largest code."""
    at = picture == full
    return int(np.count_nonzero(at[..., 0] | at[..., 1] | at[..., 2]))


def _like_first(picture, first, pair, measurement):
    """Refuse a picture of another size or kind than the first, or with values that are not finite."""
    name = measurement.names[pair]
    if picture.shape != first.shape:
        raise InputError(
            f"{name}: has {picture.shape[0]} x {picture.shape[1]} pixels; the first picture,"
            f" {measurement.names[0]}, has {first.shape[0]} x {first.shape[1]}. All pictures of a set must agree."
        )
    if picture.dtype != first.dtype:
        raise InputError(
            f"{name}: holds {picture.dtype} values; the first picture, {measurement.names[0]}, holds"
            f" {first.dtype}. All pictures of a set must agree."
        )
    if picture.dtype.kind == "f":
        _require_finite(picture, name)


def _require_finite(picture, name):
    bad = picture.size - int(np.isfinite(picture).sum())
    if bad:
        raise InputError(f"{name}: holds {bad} NaN or infinite values; mend or remove the picture.")


def _inside(region, shape, option, measurement):
    if region is None:
        return
    row, col, rows, cols = region
    if min(row, col) < 0 or min(rows, cols) < 1 or row + rows > shape[0] or col + cols > shape[1]:
        raise InputError(
            f"{option} {row} {col} {rows} {cols} does not lie inside the pictures of {measurement.source},"
            f" which have {shape[0]} x {shape[1]} pixels."
        )


def _mask(measurement, crop, shape, toroidal):
    """Valid texels of the cropped and resized pictures, or None if all are."""
    if measurement.mask is None:
        return None
    from btfpipe.sample.resize import resize_mask

    row, col, rows, cols = crop
    mask = resize_mask(measurement.mask[row : row + rows, col : col + cols], shape, toroidal)
    if not mask.any():
        raise InputError(
            f"{measurement.source}: no valid texel is left; choose another --crop or a larger --size."
        )
    return None if mask.all() else mask


def _white(measurement, stored, white, grey_card, reflectance, curve):
    """Decoded value of a perfect white diffuser, or None if the scale is unknown.

    Whether a grey card is clipped shows in the pictures as `stored`, before any correction.
    """
    if grey_card is None:
        return white if white is not None else measurement.white
    pair = nearest_normal(measurement)
    row, col, rows, cols = grey_card
    card = stored.read(pair)[row : row + rows, col : col + cols]
    full = _FULL.get(card.dtype)
    if full and card.max() == full:
        raise InputError(
            f"{measurement.names[pair]}: the grey card is clipped; choose a region without {full}, or"
            " give --white."
        )
    if measurement is not stored:
        card, full = measurement.read(pair)[row : row + rows, col : col + cols], None
    mean = float(decode(card / (full or 1), curve).mean())
    if not mean > 0:
        raise InputError(
            f"{measurement.names[pair]}: the grey card's region has the mean {mean:g}."
        )
    light = measurement.light_directions[measurement.light_index[pair]]
    return mean / (reflectance * float(light[2]))


def _density(measurement, texels_per_mm, shape, texels):
    """Texels per millimetre after resizing; unknown if rows and columns are scaled differently."""
    density = texels_per_mm or measurement.texels_per_mm
    across, down = texels[1] / shape[1], texels[0] / shape[0]
    if density is None or abs(across / down - 1) > 0.02:
        return None
    return density * across


def _plain_facts(measurement):
    """The reader's facts; lists and sets sorted, as threads may have filled them in any order, and cut short."""
    facts = {}
    for key, value in measurement.facts.items():
        if isinstance(value, list | set):
            facts[f"n_{key}"] = len(value)
            value = sorted(value)[:_LISTED]
        facts[key] = value
    return facts
