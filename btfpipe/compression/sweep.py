"""Rate against distortion: a Sample compressed by every method at several sizes, and what each costs and gives."""

import io
import tempfile
import time
from pathlib import Path

from btfpipe.compression import compress
from btfpipe.errors import InputError
from btfpipe.metrics import raw_bytes
from btfpipe.metrics.comparison import compare

# Settings that a sweep tries, by method: from the smallest file to the largest.
SETTINGS = {
    "coded": [{"ratio": ratio} for ratio in (400.0, 200.0, 100.0, 50.0, 25.0)],
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
        By method a list of options of `compress`; `SETTINGS` by default.
    seed, threads, memory
        As for `compress`.
    on_progress : callable, optional
        Called with (files done, files in all).

    Returns
    -------
    list of dict
        ``method``, ``options``, true ``bytes`` of the file, ``ratio`` to 3 bytes a texel and pair (6 for half floats), ``display_psnr_db``,
        ``linear_psnr_db``, ``relative_error``, ``ssim``, ``seconds`` to compress; or ``skipped``, the reason why a
        method cannot take the Sample.
    """
    settings = SETTINGS if settings is None else settings
    raw, total = raw_bytes(sample), sum(map(len, settings.values()))
    rows = []
    with tempfile.TemporaryDirectory(prefix="btfpipe-") as folder:
        path = Path(folder) / "model.npz"
        for method, options in ((m, o) for m, tried in settings.items() for o in tried):
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
                }
            rows.append(row)
            if on_progress is not None:
                on_progress(len(rows), total)
    return rows


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
    ticks = [t for t in (2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000) if ratios and min(ratios) / 1.5 < t < max(ratios) * 1.5]  # fmt: skip
    axes.set_xticks(ticks, [f"{t}:1" for t in ticks])
    axes.minorticks_off()
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()
