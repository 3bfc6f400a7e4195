"""Models: compressed Samples, one module a method, all `Appearance`s."""

import functools
import importlib
from collections import namedtuple

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.sample import Sample

# A method of compression: its module, the class of its Models, the function that makes one (None for Models that only come from
# files), and which options it takes: the name on the command line and that of the function's argument.
Method = namedtuple("Method", "module model function options")

# A further method is one module and an entry here.
METHODS = {
    "svd": Method(
        "btfpipe.compression.svd",
        "SvdModel",
        "compress_svd",
        {"components": "n_terms", "precision": "precision", "iterations": "iterations"},
    ),
    "factored": Method(
        "btfpipe.compression.factored",
        "FactoredModel",
        "compress_factored",
        {
            "space": "space",
            "channel_components": "terms",
            "precision": "precision",
            "iterations": "iterations",
        },
    ),
    "view-pca": Method(
        "btfpipe.compression.view_pca",
        "ViewPcaModel",
        "compress_view_pca",
        {"components": "components", "precision": "precision"},
    ),
    "local-pca": Method(
        "btfpipe.compression.local_pca",
        "LocalPcaModel",
        "compress_local_pca",
        {
            "components": "components",
            "clusters": "clusters",
            "target_bytes": "target_bytes",
            "precision": "precision",
        },
    ),
    "harmonics": Method(
        "btfpipe.compression.harmonics",
        "HarmonicsModel",
        "compress_harmonics",
        {"view_harmonics": "view_terms", "light_harmonics": "light_terms"},
    ),
    "coded": Method(
        "btfpipe.compression.coded",
        "CodedModel",
        "compress_coded",
        {"ratio": "ratio", "target_bytes": "target_bytes", "components": "n_terms"},
    ),
    "relighting": Method("btfpipe.compression.relighting", "RelightingModel", None, {}),
}
DATABASES = ("local-pca",)  # methods that take several samples at once


def open_appearance(path):
    """Open a Sample or a Model of any method."""
    reader = store.read(path, ("sample", "model"))
    if reader.kind == "sample":
        return Sample.from_reader(reader)
    name = reader.about.get("method")
    if name not in METHODS:
        raise InputError(f"{path}: a Model of method {name!r}, which this btfpipe does not know.")
    method = METHODS[name]
    return getattr(importlib.import_module(method.module), method.model).from_reader(reader)


def compress(
    samples, method, *, names=None, seed=0, threads=1, memory=2 << 30, on_progress=None, **options
):
    """Make a Model of one Sample or, for a database, of several.

    Parameters
    ----------
    samples : list of Appearance
        One, except for a method in `DATABASES`.
    method : str
        A key of `METHODS` that has a function.
    names : list of str, optional
        Of the materials of a database.
    seed, threads, memory, on_progress
        See the method's function.
    **options
        Those of the method, by their names on the command line; None leaves one at the method's default.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        If the method refuses the samples.
    """
    if method == "svd" and (options.get("space") or options.get("channel_components")):
        method = "factored"  # channel by channel, in a colour space
    chosen = METHODS[method]
    function = getattr(importlib.import_module(chosen.module), chosen.function)
    if method in DATABASES:
        function = functools.partial(function, names=names)
    else:
        (samples,) = samples
    return function(
        samples,
        **{chosen.options[name]: value for name, value in options.items() if value is not None},
        seed=seed, threads=threads, memory=memory, on_progress=on_progress,
    )  # fmt: skip


__all__ = ["DATABASES", "METHODS", "compress", "open_appearance"]
