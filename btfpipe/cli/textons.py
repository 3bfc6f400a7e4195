"""`btfpipe textons`: Sample or Model to Features."""

import click

from btfpipe.cli.options import input_file, material_option, material_taken, progress, stage
from btfpipe.errors import naming


@click.command()
@click.argument("source", type=input_file())
@click.option(
    "--levels",
    type=click.IntRange(1, 6),
    default=3,
    help="Levels of the texton pyramid; each halves the sides.",
)
@click.option(
    "--textons",
    "n_textons",
    type=click.IntRange(min=2),
    default=400,
    help="Textons of the finest level; a quarter a level from there on. More keep larger pieces of a regular"
    " material whole: try 1600 where they break up.",
)
@click.option(
    "--images",
    type=click.IntRange(min=1),
    default=400,
    help="Representative pictures that the textons are made from; all, if there are fewer.",
)
@click.option(
    "--neighbourhood",
    type=click.IntRange(min=1),
    default=5,
    help="Side of the square neighbourhood, texels, odd.",
)
@click.option(
    "--coarse-neighbourhood",
    type=click.IntRange(min=1),
    default=3,
    help="Side of the square on the next coarser level, texels, odd.",
)
@click.option(
    "-k",
    "k",
    type=click.IntRange(min=1),
    default=20,
    help="Length of the neighbour lists, the texel itself included; the most that synthesis can use.",
)
@material_option
@stage()
def textons(
    source, levels, n_textons, images, neighbourhood, coarse_neighbourhood, k, material, out, seed, threads, memory,
    quiet,
):  # fmt: skip
    """Extract surface textons and neighbour lists (Tong et al. 2002).

    SOURCE is a Sample or a Model; an SVD Model is fastest. The result says which texels of the sample
    are alike in all pictures, on every level of a pyramid.

    \b
    Example:
      btfpipe textons corduroy.model.npz -o corduroy.features.npz
    """
    from btfpipe import store
    from btfpipe.analysis.textons import texton_features
    from btfpipe.compression import open_appearance

    taken = material_taken(source, material)
    appearance = open_appearance(source, material)
    with naming(source), progress("textons", quiet) as report:
        features = texton_features(
            appearance,
            levels=levels,
            n_textons=n_textons,
            n_pictures=images,
            neighbourhood=neighbourhood,
            coarse_neighbourhood=coarse_neighbourhood,
            k=k,
            seed=seed,
            threads=threads,
            memory=memory,
            on_progress=report,
        )
    facts = dict(features.about)
    features.about |= {"sample_digest": store.digest(source), "source": source.name, "seed": seed}
    features.about |= taken
    features.save(out)
    return {"inputs": [source], **taken, **facts, "bytes": out.stat().st_size}
