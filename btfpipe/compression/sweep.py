"""Rate against distortion: a Sample compressed by every method at several sizes, and what each costs and gives."""

import io
import tempfile
import time
from pathlib import Path

from btfpipe.compression import compress
from btfpipe.compression.harmonics import supported
from btfpipe.errors import InputError
from btfpipe.metrics import raw_bytes
from btfpipe.metrics.comparison import compare

# Settings that a sweep tries, by method: from the smallest file to the largest.
SETTINGS = {
    # by default 100 : 1, or what a small sample's tables leave
    "coded": [{"ratio": 400.0}, {"ratio": 200.0}, {}, {"ratio": 50.0}, {"ratio": 25.0}],
    "svd": [{"components": n} for n in (4, 8, 16, 32, 64, 128)],
    # of logarithms, the default; about as large as an SVD of as many terms as luminance has
    "factored": [{"channel_components": (n, n // 2, n // 2)} for n in (4, 8, 16, 32, 64, 128)],
    "view-pca": [{"components": n} for n in (1, 2, 5, 10, 20)],
    "local-pca": [{"clusters": n, "components": 8} for n in (1, 2, 4, 8, 16)],
    "harmonics": [
        {"view_harmonics": v, "light_harmonics": n} for v, n in ((9, 9), (16, 16), (25, 25), (36, 25))
    ],
}  # fmt: skip
_MARKS = {"svd": "o", "view-pca": "s", "local-pca": "^", "harmonics": "D", "factored": "v"}


def sweep(sample, settings=None, *, seed=0, threads=1, memory=2 << 30, on_progress=None):
    """Compress a Sample in many ways and measure each file.

    Parameters
    ----------
    sample : Sample
    settings : dict, optional
        By method a list of options of `compress`; `SETTINGS` by default. Harmonics are asked for as far as the directions
        tell them apart.
    seed, threads, memory
        As for `compress`.
    on_progress : callable, optional
        Called with (files done, files in all).

    Returns
    -------
    list of dict
        ``method``, ``options``, true ``bytes`` of the file, ``ratio`` to 3 bytes a texel and pair (6 for half floats), ``display_psnr_db``,
        ``linear_psnr_db``, ``relative_error``, ``ssim``, ``seconds`` to compress, and ``warnings`` if there are any; or
        ``skipped``, the reason why a method cannot take the Sample.
    """
    plan = _plan(sample, SETTINGS if settings is None else settings)
    raw, rows = raw_bytes(sample), []
    with tempfile.TemporaryDirectory(prefix="btfpipe-") as folder:
        path = Path(folder) / "model.npz"
        for method, options in plan:
            row = {"method": method, "options": options}
            start = time.perf_counter()
            try:
                model = compress(
                    [sample], method, seed=seed, threads=threads, memory=memory, **options
                )
            except InputError as error:
                row["skipped"] = str(error)
            else:
                row["seconds"] = round(time.perf_counter() - start, 3)
                # no part of a file, as `compress` writes it
                warnings = model.about.pop("warnings", [])
                model.save(path)
                size = path.stat().st_size
                figures = compare(model, sample, threads=threads).overall()
                row |= {
                    "bytes": size,
                    "ratio": raw / size,
                    "display_psnr_db": figures["display"]["psnr_db"],
                    "linear_psnr_db": figures["linear"]["psnr_db"],
                    "relative_error": figures["linear"]["relative_error"],
                    "ssim": figures["display"]["ssim"],
                } | ({"warnings": warnings} if warnings else {})
            rows.append(row)
            if on_progress is not None:
                on_progress(len(rows), len(plan))
    return rows


def _plan(sample, settings):
    """Each (method, options) to try, once."""
    plan = []
    for method, tried in settings.items():
        for options in tried:
            options = dict(options)
            for name, directions in (
                ("view_harmonics", sample.view_directions),
                ("light_harmonics", sample.light_directions),
            ):
                if name in options:
                    options[name] = supported(directions, options[name])
            if (method, options) not in plan:
                plan.append((method, options))
    return plan


def draw_sweep(rows, title=""):
    """PNG (bytes) of a sweep: display PSNR over the ratio, a line a method; rows without error are left out."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for method in dict.fromkeys(row["method"] for row in rows):
        points = sorted(
            (row["ratio"], row["display_psnr_db"])
            for row in rows
            if row["method"] == method and row.get("display_psnr_db") is not None
        )
        if points:
            axes.plot(*zip(*points, strict=True), marker=_MARKS.get(method, "*"), label=method)
    axes.set_xscale("log")
    axes.invert_xaxis()
    axes.set_xlabel("sample over file, true bytes (ratio; larger files to the right)")
    axes.set_ylabel("PSNR, display domain (dB)")
    axes.set_title(title)
    axes.grid(True, which="both", alpha=0.3)
    if axes.lines:
        axes.legend()
    ratios = [row["ratio"] for row in rows if "ratio" in row]
    steps = [step * 10.0**power for power in range(-3, 5) for step in (1, 2, 5)]
    ticks = [t for t in steps if ratios and min(ratios) / 1.5 < t < max(ratios) * 1.5]
    axes.set_xticks(ticks, [f"{t:g}:1" for t in ticks])
    axes.minorticks_off()
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()
