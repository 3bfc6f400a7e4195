"""Features for synthesis out of whatever is at hand: a Features file, an array, a picture, a Sample or a Model."""

from pathlib import Path

import numpy as np

from btfpipe.errors import InputError, naming

_DIMENSIONS = 16  # of the appearance of a BTF's texel that plain features keep


def read_features(
    path, k, levels, *, toroidal=False, material=None, seed=0, threads=1, memory=2 << 30
):
    """Features of a file, with neighbour lists of at least `k`.

    A Features file is taken as it is, lists are added only if it has none. An ``.npy`` array (rows, cols, d) and a picture are plain
    feature images: compared as stored, without textons. So are the texels of a Sample or a Model: the 16 leading
    coordinates of its SVD, whose distances are nearly those of the BTF itself (Eckart and Young).

    Parameters
    ----------
    path : path-like
    k : int or None
        None if no lists are needed (full search).
    levels : int
        Levels to make; a Features file keeps its own.
    toroidal : bool
        Whether an array or a picture continues at its opposite border; the other files say so themselves.
    material : str or int, optional
        Of a Model that is a database; see `btfpipe.compression.open_appearance`.
    seed, threads, memory
        For the SVD of a Sample, and for the lists.

    Returns
    -------
    Features

    Raises
    ------
    InputError
    """
    from btfpipe import store
    from btfpipe.analysis.features import Features
    from btfpipe.analysis.neighbours import add_neighbour_lists
    from btfpipe.analysis.pyramid import plain_features
    from btfpipe.compression import no_database

    path = Path(path)
    kind = _kind(path)
    if material is not None and kind not in ("sample", "model"):
        raise no_database(path)
    mask = None
    if kind == "features":
        features = Features.open(path)
    else:
        if kind in ("sample", "model"):
            image, toroidal, mask = _appearance_image(path, material, seed, threads, memory)
        elif kind is not None:
            raise InputError(
                f"{path}: holds a {kind}; expected features, a sample, a model, an array or a picture."
            )
        elif path.suffix.lower() == ".npy":
            image = _array(path)
        else:
            from btfpipe.formats.images import colours, open_picture

            picture = open_picture(path)
            image = np.asarray(colours(picture, path), np.float32)
        with naming(path):
            features = plain_features(
                image,
                toroidal,
                levels,
                mask=mask,
                sample_digest=store.digest(path),
                source=path.name,
            )
    if k is not None and k > 1 and any(level.neighbours is None for level in features.levels):
        about = features.about
        add_neighbour_lists(
            features, k, about["neighbourhood"], about["coarse_neighbourhood"], threads=threads
        )
    return features


def _kind(path):
    """The kind of one of our own files, None for anything else."""
    import zipfile

    from btfpipe import store
    from btfpipe.formats.archive import is_zip

    # a truncated zip is known by its first bytes only; its reader says what is wrong with it
    return store.read(path).kind if zipfile.is_zipfile(path) or is_zip(path) else None


def _appearance_image(path, material, seed, threads, memory):
    from btfpipe.analysis.textons import feature_image
    from btfpipe.compression import open_appearance

    appearance = open_appearance(path, material)
    image = feature_image(appearance, _DIMENSIONS, seed=seed, threads=threads, memory=memory)
    return image, appearance.toroidal, appearance.mask


def _array(path):
    try:
        image = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: not an array of numbers ({error}).") from error
    if image.dtype.kind not in "fiub":
        raise InputError(f"{path}: holds {image.dtype}; expected numbers (rows, cols, features).")
    return image[..., None] if image.ndim == 2 else image
