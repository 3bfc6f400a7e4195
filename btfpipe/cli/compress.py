"""`btfpipe compress`: Samples to a Model."""

import click

from btfpipe.cli.options import input_file, naming, progress, stage


@click.command()
@click.argument("samples", nargs=-1, required=True, type=input_file())
@click.option(
    "--method",
    type=click.Choice(["svd"]),
    default="svd",
    show_default=True,
    help="svd: full-matrix singular value decomposition (Zhou et al. 2005).",
)
@click.option(
    "--components",
    type=click.IntRange(min=1),
    default=40,
    show_default=True,
    help="Terms of the sum; no more are made than the lesser of texels and three channels a pair.",
)
@click.option(
    "--precision",
    type=click.Choice(["half", "single"]),
    default="half",
    show_default=True,
    help="Numbers in the file: 2 or 4 bytes each.",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0),
    help="Power iterations; by default as many as the error needs.",
)
@stage()
def compress(samples, method, components, precision, iterations, out, seed, threads, memory, quiet):
    """Make a Model that stands for a Sample, in a fraction of its bytes.

    The Model's error is measured on the file's own factors, over all linear values.

    \b
    Example:
      btfpipe compress corduroy.sample.npz -o corduroy.model.npz --components 40
    """  # fmt: skip
    from btfpipe import store
    from btfpipe.compression.svd import compress_svd
    from btfpipe.metrics import raw_bytes
    from btfpipe.sample import Sample

    if len(samples) > 1:
        raise click.UsageError(f"method {method} takes one sample; {len(samples)} are given.")
    sample = Sample.open(samples[0])
    with naming(samples[0]), progress("compress: pictures read", quiet) as report:
        model = compress_svd(
            sample,
            components,
            iterations=iterations,
            precision=precision,
            seed=seed,
            threads=threads,
            memory=memory,
            on_progress=report,
        )
    raw = raw_bytes(sample)
    model.about |= {
        "seed": seed,
        "sample": store.digest(samples[0]),
        "sample_bytes": raw,
        "source": sample.about.get("source"),
    }
    model.save(out)
    size = out.stat().st_size
    warnings = []
    texels = sample.shape[0] * sample.shape[1]
    most = min(texels, 3 * sample.n_pairs)
    if components > most:
        warnings.append(
            f"{texels} texels and {sample.n_pairs} pairs of three channels have at most {most} terms:"
            f" {components - most} terms left out"
        )
    if model.n_terms < min(components, most):
        warnings.append(
            f"the sample's rank is {model.n_terms}: {min(components, most) - model.n_terms} terms left out"
        )
    if not quiet:
        for warning in warnings:
            click.echo(f"Warning: {warning}.", err=True)
    shown = ("n_terms", "iterations", "excess", "precision", "rmse", "relative_error")
    return {
        "inputs": list(samples),
        **{name: model.about[name] for name in shown},
        "bytes": size,
        "sample_bytes": raw,
        "ratio": raw / size,
        "warnings": warnings,
    }
