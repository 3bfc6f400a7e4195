"""Pictures for people: tone mapping and contact sheets."""

import math
from pathlib import Path

import numpy as np

from btfpipe.compression import no_database, open_appearance
from btfpipe.errors import InputError, naming
from btfpipe.sample.transfer import encode

GAP = 4  # pixels between the pictures of a sheet
BACKDROP = 0.18  # display value behind transparent pictures and between them
LAYERS = ("colour", "alpha", "depth", "normal", "texel")


def auto_exposure(pictures, percentile=99.0):
    """Factor that brings the given percentile of all covered pixels' brightness to 0.8.

    Parameters
    ----------
    pictures : list of (rows, cols, 3 or 4) arrays
        Linear; the fourth channel is coverage.
    percentile : float
    """
    bright = []
    for picture in pictures:
        values = picture[..., :3].max(axis=-1)
        if picture.shape[2] > 3:
            values = values[picture[..., 3] > 0.5]
        bright.append(values.ravel())
    bright = np.concatenate(bright)
    top = float(np.percentile(bright, percentile)) if bright.size else 0.0
    return 0.8 / top if top > 0 else 1.0


def tone_map(picture, exposure=1.0, filmic=False):
    """Display values (rows, cols, 3) uint8 of a linear picture, alpha laid over the backdrop.

    Parameters
    ----------
    picture : (rows, cols, 3 or 4) array
        Linear Rec. 709, alpha multiplied in.
    exposure : float
        Factor before the curve.
    filmic : bool
        Bend highlights to white (Narkowicz's fit of the ACES curve) instead of clipping them.
    """
    factor = np.float32(min(exposure, float(np.finfo(np.float32).max)))
    with np.errstate(over="ignore"):  # white, too
        colour = np.maximum(np.asarray(picture[..., :3], np.float32) * factor, 0)
    if filmic:
        colour = np.minimum(colour, 1e6)  # white long before, and its square is still a number
        colour = colour * (2.51 * colour + 0.03) / (colour * (2.43 * colour + 0.59) + 0.14)
    if picture.shape[2] > 3:
        behind = np.float32(((BACKDROP + 0.055) / 1.055) ** 2.4)
        colour = colour + (1 - np.clip(picture[..., 3:4], 0, 1)) * behind
    return np.clip(encode(np.clip(colour, 0, 1), "srgb") * 255 + 0.5, 0, 255).astype(np.uint8)


def show_layer(channels, layer, name):
    """Display picture (rows, cols, 3) uint8 of another layer than colour.

    Parameters
    ----------
    channels : dict
        Channel name to (rows, cols) array.
    layer : str
        ``alpha``, ``depth`` (near is white), ``normal`` (components from -1 to 1) or ``texel`` (columns red, rows
        green, each from 0 to the picture's largest).
    name : str
        What messages call the picture.
    """
    needs = {
        "alpha": ("A",),
        "depth": ("Z",),
        "normal": ("N.X", "N.Y", "N.Z"),
        "texel": ("texel.col", "texel.row"),
    }[layer]
    missing = [c for c in needs if c not in channels]
    if missing:
        raise InputError(
            f"{name}: has no channel {missing[0]!r}, which the layer {layer} needs; it has"
            f" {', '.join(channels)}."
        )
    planes = _stacked(channels, needs, name).astype(np.float64)
    if layer == "alpha":
        shown = np.repeat(planes, 3, axis=-1)
    elif layer == "depth":
        hit = planes > 0
        if hit.any():
            near, far = planes[hit].min(), planes[hit].max()
            shown = np.where(hit, 1 - 0.9 * (planes - near) / max(far - near, 1e-12), 0)
        else:
            shown = np.zeros_like(planes)
        shown = np.repeat(shown, 3, axis=-1)
    elif layer == "normal":
        shown = np.where((planes != 0).any(axis=-1, keepdims=True), planes / 2 + 0.5, 0)
    else:
        top = np.maximum(planes.max(axis=(0, 1)), 1e-12)
        shown = np.where(planes >= 0, planes / top, 0)
        shown = np.concatenate([shown, np.zeros_like(shown[..., :1])], axis=-1)
    return np.clip(shown * 255 + 0.5, 0, 255).astype(np.uint8)


def read_channels(path):
    """Channels of a rendered picture, name to (rows, cols) array.

    Raises
    ------
    InputError
        If it is no picture, or holds display codes instead of radiance.
    """
    from btfpipe.formats.images import open_picture

    picture = open_picture(path)
    if picture.values.dtype.kind != "f":
        raise InputError(
            f"{path}: a picture of {picture.values.dtype} codes, made for display; expected a rendered .exr, whose"
            " floating-point values are linear radiance."
        )
    return {c: picture.values[..., i] for i, c in enumerate(picture.channels)}


def colour_of(channels, name):
    """Colour, with alpha where there is one, (rows, cols, 3 or 4) float32."""
    missing = [c for c in "RGB" if c not in channels]
    if missing:
        raise InputError(
            f"{name}: has no channel {missing[0]!r}; it has {', '.join(channels)}. Expected a rendered picture."
        )
    return _stacked(channels, [*"RGB", *(["A"] if "A" in channels else [])], name)


def _stacked(channels, wanted, name):
    """Some channels (rows, cols, n) float32, all finite."""
    planes = np.stack([np.asarray(channels[c], np.float32) for c in wanted], axis=-1)
    bad = planes.size - np.count_nonzero(np.isfinite(planes))
    if bad:
        raise InputError(
            f"{name}: holds {bad} NaN or infinite values in {', '.join(wanted)}; mend or remove the picture."
        )
    return planes


def sheet(pictures, columns=None, labels=None):
    """Lay display pictures out in rows; cells are as wide as their labels need.

    Parameters
    ----------
    pictures : list of (rows, cols, 3) uint8
        May differ in size; each is centred in a cell of the largest.
    columns : int, optional
        As square a sheet as possible by default.
    labels : list of str, optional
        Written under the pictures, in as many lines as they have.
    """
    columns = min(columns or math.ceil(math.sqrt(len(pictures))), len(pictures))
    rows = math.ceil(len(pictures) / columns)
    height = max(p.shape[0] for p in pictures)
    width = max(p.shape[1] for p in pictures)
    scale = max(1, round(width / 400))
    text = 12 * scale * max(label.count("\n") + 1 for label in labels) if labels else 0
    if labels:
        lines = [line for label in labels for line in label.split("\n")]
        width = max(width, *(_width(line, scale) for line in lines))
    gap = GAP if len(pictures) > 1 else 0
    out = np.full(
        (rows * (height + text + gap) - gap, columns * (width + gap) - gap, 3),
        round(BACKDROP * 255),
        np.uint8,
    )
    for number, picture in enumerate(pictures):
        y = number // columns * (height + text + gap)
        x = number % columns * (width + gap)
        top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
        out[y + top : y + top + picture.shape[0], x + left : x + left + picture.shape[1]] = picture
        if labels:
            strip = out[y + height : y + height + text, x : x + width]
            for line, words in enumerate(labels[number].split("\n")):
                part = strip[12 * scale * line : 12 * scale * (line + 1)]
                part[:] = _write(words, part, scale)
    return out


def _width(label, scale):
    """Pixels that a label takes, its margins with it; 0 without a font."""
    import OpenImageIO as oiio

    extent = oiio.ImageBufAlgo.text_size(label, 9 * scale)
    return extent.width + 6 * scale if extent.defined else 0


def _write(label, strip, scale):
    """The strip with a label on it, through OpenImageIO's text (it needs a font; without one, no label)."""
    import OpenImageIO as oiio

    buffer = oiio.ImageBuf(np.ascontiguousarray(strip))
    drawn = oiio.ImageBufAlgo.render_text(
        buffer, 3 * scale, 9 * scale, label, 9 * scale, "", (0.9, 0.9, 0.9)
    )
    if not drawn:
        oiio.geterror()
        return strip
    return buffer.get_pixels(oiio.UINT8)


def sample_sheet(appearance, lights=6, views=6):
    """Linear pictures of evenly chosen pairs: views down and lights across, or a list's pairs row by row.

    Parameters
    ----------
    appearance : Appearance
    lights, views : int
        At most this many of each; of a list of pairs at most their product.

    Returns
    -------
    pictures : list of (rows, cols, 3) float32
    labels : list of str
    columns : int

    Raises
    ------
    InputError
        If values are not finite.
    """
    from btfpipe.directions import to_angles

    pairs, columns = sample_sheet_pairs(appearance, lights, views)
    w_i, w_o = (
        np.asarray(table)[np.asarray(index)]
        for table, index in (
            (appearance.light_directions, appearance.light_index),
            (appearance.view_directions, appearance.view_index),
        )
    )
    with np.errstate(over="ignore", invalid="ignore"):  # shows in the pictures
        pictures = [np.asarray(appearance.pictures([pair])[0]) for pair in pairs]
    bad = sum(not np.isfinite(picture).all() for picture in pictures)
    if bad:
        raise InputError(f"{bad} of the {len(pairs)} pictures to show hold non-finite values.")
    labels = [
        "light {:.0f} {:.0f}\nview {:.0f} {:.0f}".format(
            *np.degrees(to_angles(w_i[pair])), *np.degrees(to_angles(w_o[pair]))
        )
        for pair in pairs
    ]
    return pictures, labels, columns


def sample_sheet_pairs(appearance, lights, views):
    """The pairs that `sample_sheet` shows, and how many stand in a row."""
    w_i, w_o = (np.asarray(a) for a in (appearance.light_directions, appearance.view_directions))
    if appearance.is_product:
        light, view = _spread(w_i, w_i[:, 2], lights), _spread(w_o, w_o[:, 2], views)
        return [v * len(w_i) + i for v in view for i in light], len(light)
    points = np.concatenate(
        [w_i[np.asarray(appearance.light_index)], w_o[np.asarray(appearance.view_index)]], axis=1
    )
    pairs = _spread(points, points[:, 2] + points[:, 5], lights * views)
    return pairs, min(lights, len(pairs))


def _spread(points, frontal, count):
    """Indices of points far from each other, the most frontal first, in the order of the set."""
    chosen = [int(np.argmax(frontal))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return sorted(chosen)


def _starts_like_ours(path):
    """Whether a file is, or once was, a zip file, as ours are; a truncated one has lost the rest."""
    with path.open("rb") as file:
        return file.read(2) == b"PK"


def preview(
    paths, *, columns=None, exposure=None, filmic=False, layer="colour", labels=False, material=None
):
    """Display picture (rows, cols, 3) uint8 of rendered pictures, or of one Sample or Model.

    Parameters
    ----------
    paths : list of path-like
    columns : int, optional
    exposure : float, optional
        Stops (doublings), -60 to 60; by default one exposure that suits the whole sheet.
    filmic : bool
    layer : str
        One of `LAYERS`.
    labels : bool
        Write names, or directions in degrees, below the pictures.
    material : str or int, optional
        Of a database; see `btfpipe.compression.open_appearance`.

    Returns
    -------
    (rows, cols, 3) uint8
    float
        The exposure used, in stops.

    Raises
    ------
    InputError
        If a file is neither a picture nor a Sample or Model, or lacks the layer or the material.
    """
    paths = [Path(p) for p in paths]
    archives = [p for p in paths if _starts_like_ours(p)]
    if material is not None and not archives:
        raise no_database(paths[0])
    if archives:
        if len(paths) > 1:
            raise InputError(
                f"{archives[0]}: a sheet shows several pictures or one Sample or Model; give it alone."
            )
        if layer != "colour":
            raise InputError(f"{paths[0]}: a Sample or Model has no layer {layer}.")
        with naming(paths[0]):
            linear, names, columns_found = sample_sheet(open_appearance(paths[0], material))
        columns = columns or columns_found
    else:
        channels = [read_channels(p) for p in paths]
        names = [p.stem for p in paths]
        if layer != "colour":
            shown = [show_layer(c, layer, str(p)) for c, p in zip(channels, paths, strict=True)]
            return sheet(shown, columns, names if labels else None), 0.0
        linear = [colour_of(c, str(p)) for c, p in zip(channels, paths, strict=True)]
    factor = auto_exposure(linear) if exposure is None else 2.0**exposure
    shown = [tone_map(p, factor, filmic) for p in linear]
    return sheet(shown, columns, names if labels else None), math.log2(factor)
