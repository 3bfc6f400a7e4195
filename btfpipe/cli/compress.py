"""`btfpipe compress`: Samples to a Model."""

import click

from btfpipe.cli.options import input_file, naming, progress, stage

# As in btfpipe.compression.METHODS, which is not imported for --help.
_METHODS = ("svd",)


@click.command()
@click.argument("samples", nargs=-1, required=True, type=input_file())
@click.option(
    "--method",
    type=click.Choice(_METHODS),
    default="svd",
    show_default=True,
    help="svd: full-matrix singular value decomposition (Zhou et al. 2005).",
)
@click.option(
    "--components",
    type=click.IntRange(min=1),
    help="Terms of the sum. [default: svd 40]",
)
@click.option(
    "--precision",
    type=click.Choice(["half", "single"]),
    help="Numbers in the file: 2 or 4 bytes each.  [default: half]",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0),
    help="Power iterations of svd; by default as many as the error needs.",
)
@stage()
def compress(samples, method, out, seed, threads, memory, quiet, **options):
    """Make a Model that stands for a Sample, in a fraction of its bytes.

    The Model's error is measured on the file's own numbers, over all linear values.

    \b
    Example:
      btfpipe compress corduroy.sample.npz -o corduroy.model.npz --components 40
    """
    from btfpipe import store
    from btfpipe.compression import DATABASES, METHODS
    from btfpipe.compression import compress as compress_samples
    from btfpipe.metrics import raw_bytes
    from btfpipe.sample import Sample

    takes = METHODS[method].options
    for name, value in options.items():
        if value is not None and name not in takes:
            raise click.UsageError(
                f"method {method} has no {_flag(name)}; it takes {', '.join(map(_flag, takes))}."
            )
    if len(samples) > 1 and method not in DATABASES:
        raise click.UsageError(
            f"method {method} takes one sample; {len(samples)} are given. Methods that make a database of several:"
            f" {', '.join(DATABASES)}."
        )
    opened = [Sample.open(path) for path in samples]
    with naming(samples[0]), progress("compress: pictures read", quiet) as report:
        model = compress_samples(
            opened, method, seed=seed, threads=threads, memory=memory, on_progress=report, **options
        )
    raw = sum(raw_bytes(sample) for sample in opened)
    warnings = model.about.pop("warnings", [])
    model.about |= {
        "seed": seed,
        "sample": store.digest(samples[0]),
        "sample_bytes": raw,
        "source": opened[0].about.get("source"),
    }
    model.save(out)
    size = out.stat().st_size
    if not quiet:
        for warning in warnings:
            click.echo(f"Warning: {warning}.", err=True)
    own = ("seed", "sample", "sample_bytes", "source", "singular_values")
    return {
        "inputs": list(samples),
        **{name: value for name, value in model.about.items() if name not in own},
        "bytes": size,
        "sample_bytes": raw,
        "ratio": raw / size,
        "warnings": warnings,
    }


def _flag(name):
    return "--" + name.replace("_", "-")
