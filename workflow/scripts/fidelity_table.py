"""Gather the reports of `btfpipe compare` into one table, as Markdown and HTML."""

import html
import json
from pathlib import Path

HEAD = [
    "material",
    "what",
    "against",
    "between directions",
    "PSNR linear, dB",
    "PSNR display, dB",
    "relative error",
    "SSIM",
]


def rows_of(report, material, what, against):
    """One row an interpolation of a report."""
    for name, result in report["comparisons"].items():
        linear, display = result["linear"], result["display"]
        yield [
            material,
            what,
            against,
            name.replace("own_pairs", "none: its own pairs"),
            f"{linear['psnr_db']:.1f}",
            f"{display['psnr_db']:.1f}",
            f"{100 * linear['relative_error']:.2f} %",
            f"{display['ssim']:.4f}",
        ]


def fidelity_table(models, truth, table, page):
    """Write the table of all reports.

    Parameters
    ----------
    models, truth : list of path
        Reports named ``SAMPLE.model.json`` and ``SAMPLE.WHAT-at-truth.json``.
    table, page : path
        Markdown and HTML to write.
    """
    rows = []
    for path in map(Path, models):
        report = json.loads(path.read_text())
        rows += rows_of(report, path.name.split(".")[0], "model", "sample")
    for path in map(Path, truth):
        material, what = path.name.split(".")[:2]
        report = json.loads(path.read_text())
        rows += rows_of(report, material, what.removesuffix("-at-truth"), "truth")
    lines = [HEAD, ["---"] * len(HEAD), *rows]
    Path(table).write_text("".join(f"| {' | '.join(line)} |\n" for line in lines))
    cells = [
        "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in line) + "</tr>"
        for tag, line in [("th", HEAD), *(("td", row) for row in rows)]
    ]
    style = "table{border-collapse:collapse;font:14px sans-serif}td,th{border:1px solid #bbb;padding:.3em .7em}"
    Path(page).write_text(
        f"<!doctype html><meta charset=utf-8><title>Fidelity</title><style>{style}</style>"
        f"<table>{''.join(cells)}</table>\n"
    )


if __name__ == "__main__":
    fidelity_table(
        snakemake.input.models,  # noqa: F821
        snakemake.input.truth,  # noqa: F821
        snakemake.output.table,  # noqa: F821
        snakemake.output.page,  # noqa: F821
    )
