"""The picture of a comparison: errors over all direction pairs, and the best, middle and worst picture."""

import numpy as np

from btfpipe.metrics.pictures import to_display

_GAP = 8
_TEXT = 14
_WIDEST = 640

# Black, violet, orange, pale yellow: even steps of lightness, so that it reads in grey too.
_RAMP = np.array(
    [(0, 0, 4), (60, 15, 110), (140, 40, 100), (220, 80, 40), (250, 170, 20), (252, 255, 190)]
)


def ramp(values):
    """Colours (..., 3) uint8 of values in [0, 1]."""
    place = np.linspace(0, 1, len(_RAMP))
    values = np.clip(values, 0, 1)
    return np.stack([np.interp(values, place, _RAMP[:, c]) for c in range(3)], -1).astype(np.uint8)


def pair_matrix(values, sample):
    """Values of the pairs as a picture: (views, lights) for a product, else rows of even length.

    Cells without a pair are not a number.
    """
    values = np.asarray(values, float)
    if sample.is_product:
        return values.reshape(len(sample.view_directions), len(sample.light_directions))
    width = int(np.ceil(np.sqrt(len(values))))
    matrix = np.full((-(-len(values) // width), width), np.nan)
    matrix.ravel()[: len(values)] = values
    return matrix


def error_sheet(sample, comparisons, pictures_of):
    """Draw comparisons of one Sample.

    Parameters
    ----------
    sample : Sample
    comparisons : dict
        `Comparison` by name; one map of display RMSE each, on one scale.
    pictures_of : callable
        From a slice of pairs to the Model's pictures, of the first comparison.

    Returns
    -------
    (rows, cols, 3) uint8
    """
    worst = max(float(c.display_rmse.max()) for c in comparisons.values()) or 1.0
    what = "views down, lights across" if sample.is_product else "pairs row by row"
    maps = []
    for name, comparison in comparisons.items():
        matrix = pair_matrix(comparison.display_rmse, sample)
        zoom = max(1, _WIDEST // max(matrix.shape) // max(1, len(comparisons) - 1))
        drawn = ramp(np.nan_to_num(matrix / worst))
        drawn[np.isnan(matrix)] = 255
        drawn = drawn.repeat(zoom, 0).repeat(zoom, 1)
        overall = comparison.overall()["display"]
        title = f"{name}: display RMSE {overall['rmse']:.4f}"
        maps.append(titled(drawn, title))
    bar = ramp(np.linspace(1, 0, maps[0].shape[0] - _TEXT - _GAP)[:, None].repeat(16, 1))
    bar = titled(bar, f"{worst:.3f}", _label("0", 60))
    blocks = [titled(beside([*maps, bar]), f"display RMSE of each pair ({what})")]

    comparison = next(iter(comparisons.values()))
    order = comparison.order()
    for word, pair in (
        ("best", order[0]),
        ("middle", order[len(order) // 2]),
        ("worst", order[-1]),
    ):
        pair = int(pair)
        chosen = slice(pair, pair + 1)
        reference, model = (
            to_display(p[0], comparison.white)
            for p in (sample.pictures(chosen), pictures_of(chosen))
        )
        error = np.abs(model - reference)
        largest = float(np.quantile(error, 0.99))
        factor = min(2.0 ** np.floor(np.log2(0.9 / largest)), 1024.0) if largest > 0 else 1.0
        zoom = max(1, 192 // max(sample.shape))
        row = [
            titled(to_bytes(p).repeat(zoom, 0).repeat(zoom, 1), title)
            for p, title in (
                (reference, "sample"),
                (model, "model"),
                (np.clip(error * factor, 0, 1), f"difference x {factor:g}"),
            )
        ]
        light, view = (
            _angles(table[index[pair]])
            for table, index in (
                (sample.light_directions, sample.light_index),
                (sample.view_directions, sample.view_index),
            )
        )
        title = (
            f"{word}: pair {pair}, light {light}, view {view}, display RMSE"
            f" {comparison.display_rmse[pair]:.4f}"
        )
        blocks.append(titled(beside(row), title))
    return below(blocks)


def _angles(direction):
    from btfpipe.directions import to_angles

    theta, phi = np.degrees(to_angles(direction))
    return f"({theta:.0f}, {phi % 360:.0f}) deg"


def to_bytes(picture):
    """8-bit codes of display values."""
    return np.round(picture * 255).astype(np.uint8)


def _label(text, width):
    """A line of text, black on white."""
    import OpenImageIO as oiio

    height = _TEXT + _GAP
    buffer = oiio.ImageBuf(oiio.ImageSpec(max(width, 7 * len(text) + 4), height, 3, oiio.UINT8))
    oiio.ImageBufAlgo.fill(buffer, (1.0, 1.0, 1.0))
    oiio.ImageBufAlgo.render_text(buffer, 2, _TEXT, text, _TEXT - 2, "DroidSans", (0.0, 0.0, 0.0))
    line = buffer.get_pixels(oiio.UINT8)
    used = np.flatnonzero((line < 255).any(axis=(0, 2)))
    return line[:, : max(width, int(used[-1]) + 4 if len(used) else 1)]


def titled(picture, title, *lines):
    """A picture with a line of text above, and more pictures under it."""
    return below([_label(title, picture.shape[1]), picture, *lines], gap=0)


def beside(pictures):
    """Pictures in a row, on white."""
    height = max(p.shape[0] for p in pictures)
    padded = [
        np.pad(p, ((0, height - p.shape[0]), (0, _GAP), (0, 0)), constant_values=255)
        for p in pictures
    ]
    return np.concatenate(padded, axis=1)


def below(pictures, gap=_GAP):
    """Pictures in a column, on white."""
    width = max(p.shape[1] for p in pictures)
    padded = [
        np.pad(p, ((0, gap), (0, width - p.shape[1]), (0, 0)), constant_values=255)
        for p in pictures
    ]
    return np.concatenate(padded, axis=0)
