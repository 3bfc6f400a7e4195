"""Show what each format gives back of a sample, beside the sample itself."""

from pathlib import Path

import numpy as np

from btfpipe.compression import open_appearance
from btfpipe.formats.images import write_picture
from btfpipe.metrics.comparison import compare, matching_pairs, white_level
from btfpipe.metrics.pictures import to_display
from btfpipe.metrics.sheet import below, beside, titled, to_bytes
from btfpipe.rendering.preview import sample_sheet_pairs
from btfpipe.sample import Sample
from btfpipe.sample.resize import Resizer

_PAIRS = 5
_SIDE = 160  # pixels of a picture, about


def formats_sheet(original, appearances, sheet, table):
    """Write a sheet and a table of errors.

    Parameters
    ----------
    original : path
        The Sample that was written.
    appearances : dict of str to path
        What was read back, by format.
    sheet, table : path
        To write: a picture, and Markdown.
    """
    sample = Sample.open(original)
    white = white_level(sample)[0]
    shader = sample.shader()
    at = np.indices(sample.shape, np.float32).reshape(2, -1)

    def evaluated(light, view):
        values = np.zeros((at.shape[1], 3), np.float32)
        shader.shade(
            *at,
            *(
                np.ascontiguousarray(np.broadcast_to(d, values.shape), np.float32)
                for d in (light, view)
            ),
            values,
        )
        return values.reshape(*sample.shape, 3)

    blocks = []
    lines = [
        "| format | texels | pairs | display RMSE at its own pairs | largest difference |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, path in appearances.items():
        back = open_appearance(path)
        pairs = sample_sheet_pairs(back, _PAIRS, 1)[0]
        theirs = [back.pictures([pair])[0] for pair in pairs]
        ours = [
            evaluated(
                back.light_directions[back.light_index[pair]],
                back.view_directions[back.view_index[pair]],
            )
            for pair in pairs
        ]
        rows = [beside([_shown(p, white) for p in row]) for row in (theirs, ours)]
        error = "not compared: another part of the patch", ""
        if tuple(back.shape) == tuple(sample.shape):
            found = matching_pairs(back, sample)
            if found is not None:
                rmse = compare(back, sample).overall()["display"]["rmse"]
            else:
                rmse = compare(sample, back, interpolation="barycentric").overall()["display"][
                    "rmse"
                ]
            most = max(float(np.abs(a - b).max()) for a, b in zip(theirs, ours, strict=True))
            error = f"{rmse:.5f}", f"{most:.4f}"
        lines.append(
            f"| {name} | {back.shape[0]} x {back.shape[1]} | {back.n_pairs} | {error[0]} | {error[1]} |"
        )
        blocks.append(titled(below(rows, gap=2), f"{name}: read back, and the sample below"))
    write_picture(sheet, below([beside(blocks[i : i + 2]) for i in range(0, len(blocks), 2)]))
    Path(table).write_text("\n".join(lines) + "\n")


def _shown(picture, white):
    """Display codes, enlarged by whole texels or resized to about one size."""
    if max(picture.shape[:2]) > _SIDE:
        picture = Resizer(picture.shape[:2], (_SIDE, _SIDE), False)(picture)
    zoom = max(1, round(_SIDE / max(picture.shape[:2])))
    return to_bytes(to_display(picture, white)).repeat(zoom, 0).repeat(zoom, 1)


if "snakemake" in globals():
    names = [Path(path).name.split(".")[-2] for path in snakemake.input.appearances]  # noqa: F821
    formats_sheet(
        snakemake.input.sample,  # noqa: F821
        dict(zip(names, snakemake.input.appearances, strict=True)),  # noqa: F821
        snakemake.output.sheet,  # noqa: F821
        snakemake.output.table,  # noqa: F821
    )
