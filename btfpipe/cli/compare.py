"""`btfpipe compare`: how far a Model is from a Sample."""

import contextlib
from pathlib import Path

import click

from btfpipe.cli.options import flag, input_file, material_option, material_taken, progress, stage
from btfpipe.errors import naming

_WAYS = ("barycentric", "four", "nearest")
# What they are between the pairs of a list.
_OF_LISTS = {
    "barycentric": "nine nearest pairs",
    "four": "four nearest pairs",
    "nearest": "nearest pair",
}
_DEFINITIONS = {
    "linear": "values as stored, linear Rec. 709",
    "display": "linear values over white, clipped to [0, 1], sRGB curve",
    "rmse": "sqrt(mean((model - sample)^2)) over pairs, texels valid in both, and channels",
    "psnr_db": "20 log10(peak / rmse), peak = white in linear and 1 in display; null: no error",
    "relative_error": "sqrt(sum((model - sample)^2) / sum(sample^2)), linear",
    "rmse_after_best_scale": "linear rmse of best_scale * model, for samples of unknown absolute scale",
    "ratio": "sample_bytes / bytes: pictures that MODEL stands for, 3 bytes a texel and pair (6 if half"
    " floats), over the bytes of its file",
    "ssim": "Wang et al. 2004 on display luma, 11 x 11 Gaussian windows of 1.5 texels; mean over"
    " pairs, of windows whose texels are all valid; null: there are none",
}


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="[MODEL] SAMPLE", type=input_file())
@click.option(
    "--sweep",
    is_flag=True,
    help="Compress SAMPLE by every method at several sizes instead, and measure each; the picture shows PSNR"
    " against the ratio of bytes.",
)
@click.option(
    "--interpolation",
    "ways",
    multiple=True,
    type=click.Choice([*_WAYS, "reciprocal", "all"]),
    help="Evaluate MODEL between its directions, as rendering does; repeatable. By default only"
    " where SAMPLE has a pair that MODEL lacks, barycentrically.",
)
@click.option(
    "--picture",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Picture to write: errors over all pairs; the best, middle and worst picture.",
)
@material_option
@stage(out="optional", outputs=("picture",))
def compare(files, sweep, ways, picture, material, out, seed, threads, memory, quiet):
    """Measure how far MODEL (a Model or a Sample) is from SAMPLE, at all of SAMPLE's direction pairs.

    Writes a report in JSON: RMSE, PSNR, relative error and SSIM, overall and for each pair; bytes and their ratio.
    With a SAMPLE of directions that MODEL never saw, this measures the interpolation too.

    \b
    Examples:
      btfpipe compare corduroy.model.npz corduroy.sample.npz -o fidelity.json --picture fidelity.png
      btfpipe compare weave.model.npz weave_truth.sample.npz --interpolation all -o truth.json
      btfpipe compare --sweep weave.sample.npz -o sweep.json --picture sweep.png
    """
    if picture is not None and picture.suffix.lower() not in (".png", ".jpg", ".tif"):
        raise click.UsageError(f"{picture}: not a picture's name; end it in .png.")
    wanted = "one file, SAMPLE" if sweep else "two files, MODEL and SAMPLE"
    if len(files) != (1 if sweep else 2):
        raise click.UsageError(f"{len(files)} files are given; expected {wanted}.")
    if not sweep:
        return _compare(*files, material, ways, picture, out, threads, quiet)
    if ways:
        raise click.UsageError(
            "--sweep measures at the sample's own pairs; leave --interpolation out."
        )
    if material is not None:
        raise click.UsageError("--sweep makes its own Models; leave --material out.")
    return _sweep(files[0], picture, out, seed, threads, memory, quiet)


def _sweep(path, picture, out, seed, threads, memory, quiet):
    """Compress a Sample in many ways: report, picture, summary."""
    from btfpipe import store
    from btfpipe.compression.sweep import draw_sweep, sweep
    from btfpipe.files import whole
    from btfpipe.metrics import comparison, raw_bytes
    from btfpipe.sample import Sample

    sample = Sample.open(path)
    with naming(path), progress("compare: files", quiet) as report:
        rows = sweep(sample, seed=seed, threads=threads, memory=memory, on_progress=report)
    facts = {
        "texels": list(sample.shape),
        "pairs": sample.n_pairs,
        "sample_bytes": raw_bytes(sample),
        "sweep": rows,
    }
    with contextlib.ExitStack() as files:  # both appear, or neither
        if out is not None:
            definitions = _DEFINITIONS | {"white": comparison.white_level(sample)[1]}
            about = {"sample": {"file": path.name, "digest": store.digest(path)}}
            store.put_json(
                files.enter_context(whole(out, "w")),
                about | facts | {"definitions": definitions},
            )
        if picture is not None:
            drawn = draw_sweep(
                rows,
                f"{path.name}: {' x '.join(map(str, sample.shape))} texels, {sample.n_pairs} pairs",
            )
            files.enter_context(whole(picture)).write(_encoded(drawn, picture))
    if not quiet:
        skipped = {}  # settings by method and reason, which is said once
        for row in rows:
            options = " ".join(
                f"{flag(name)} {' '.join(map(str, value)) if isinstance(value, tuple) else value}"
                for name, value in row["options"].items()
            )
            name = f"{row['method']} {options or 'by default'}"
            if "skipped" in row:
                skipped.setdefault((row["method"], row["skipped"]), []).append(name)
                continue
            click.echo(
                f"{name}: {row['ratio']:.1f}:1, display PSNR {_db(row['display_psnr_db'])}, linear"
                f" {_db(row['linear_psnr_db'])}, {row['seconds']:.1f} s",
                err=True,
            )
        for (_, reason), names in skipped.items():
            click.echo(f"skipped: {', '.join(names)}: {reason}", err=True)
    return {"inputs": [path], **facts}


def _encoded(png, picture):
    """A PNG in the format that a picture's name asks for."""
    if picture.suffix.lower() == ".png":
        return png
    from btfpipe.formats.images import encode_picture, read_picture

    return encode_picture(read_picture(png)[..., :3], picture.suffix.lower())


def _compare(model, sample, material, ways, picture, out, threads, quiet):
    """Compare a Model with a Sample: report, picture, summary."""
    from btfpipe import store
    from btfpipe.compression import open_appearance
    from btfpipe.files import whole
    from btfpipe.metrics import comparison, raw_bytes
    from btfpipe.sample import Sample

    reference = Sample.open(sample)
    taken = material_taken(model, material)
    stand_in = open_appearance(model, material)
    ways = _WAYS if "all" in ways else tuple(dict.fromkeys(ways))
    if not ways:
        ways = (None,) if comparison.matching_pairs(stand_in, reference) is not None else _WAYS[:1]
    white, white_is = comparison.white_level(reference)
    results = {}
    with naming(f"{model} against {sample}"), progress("compare: pictures", quiet) as report:
        for done_ways, way in enumerate(ways):
            results[way or "own_pairs"] = comparison.compare(
                stand_in,
                reference,
                interpolation=way,
                threads=threads,
                on_progress=lambda done, total: report(done_ways * total + done, len(ways) * total),  # noqa: B023
            )
    size, raw = model.stat().st_size, raw_bytes(stand_in)
    facts = {
        "texels": list(reference.shape),
        "pairs": reference.n_pairs,
        "white": white,
        "bytes": size,
        "sample_bytes": raw,
        "ratio": raw / size,
    }
    overall = {name: result.overall() for name, result in results.items()}
    words = {} if stand_in.is_product else _OF_LISTS
    shown = {words.get(name, name): result for name, result in results.items()}
    if picture is not None:
        from btfpipe.formats.images import encode_picture
        from btfpipe.metrics.sheet import error_sheet

        first = next(iter(results))
        pictures_of = comparison.model_pictures(
            stand_in, reference, None if first == "own_pairs" else first
        )
        sheet = encode_picture(error_sheet(reference, shown, pictures_of), picture.suffix.lower())
    with contextlib.ExitStack() as files:  # both appear, or neither
        if out is not None:
            report = {
                "model": {"file": model.name, "digest": store.digest(model)} | taken,
                "sample": {"file": sample.name, "digest": store.digest(sample)},
                **facts,
                "definitions": _DEFINITIONS
                | {"white": white_is}
                | {name: words[name] for name in results if name in words},
                "comparisons": {
                    name: overall[name] | {"per_pair": _per_pair(result, reference)}
                    for name, result in results.items()
                },
            }
            store.put_json(files.enter_context(whole(out, "w")), report)
        if picture is not None:
            files.enter_context(whole(picture)).write(sheet)
    for name, result in overall.items():
        linear, display = result["linear"], result["display"]
        relative, ssim = linear["relative_error"], display["ssim"]
        if not quiet:
            click.echo(
                f"{words.get(name, name)}: linear RMSE {linear['rmse']:.5f}, PSNR {_db(linear['psnr_db'])}, relative error"
                f" {'undefined' if relative is None else f'{100 * relative:.2f} %'}; display PSNR"
                f" {_db(display['psnr_db'])}, SSIM {'none (no 11 x 11 valid texels)' if ssim is None else round(ssim, 4)}",
                err=True,
            )
    return {"inputs": [model, sample], **taken, **facts, "comparisons": overall}


def _db(value):
    return "infinite" if value is None else f"{value:.2f} dB"


def _per_pair(result, sample):
    columns = {
        name: getattr(result, name) for name in ("rmse", "relative_error", "display_rmse", "ssim")
    }
    numbers = {
        name: [None if value != value else float(f"{value:.6g}") for value in column]
        for name, column in columns.items()
    }
    return {"light": sample.light_index, "view": sample.view_index, **numbers}
