"""Models: compressed Samples, one module a method, all `Appearance`s."""

import functools
import importlib
from collections import namedtuple

from btfpipe import store
from btfpipe.errors import InputError, naming
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
            "resample": "resample",
        },
    ),
    "harmonics": Method(
        "btfpipe.compression.harmonics",
        "HarmonicsModel",
        "compress_harmonics",
        {
            "view_harmonics": "view_terms",
            "light_harmonics": "light_terms",
            "equal_views": "equal_views",
        },
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


def open_appearance(path, material=None):
    """Open a Sample or a Model of any method.

    Parameters
    ----------
    path : path-like
    material : str or int, optional
        Which material of a database to evaluate: its name, or its number from 0 (in digits, too). By default the one that
        the file is set to, which is the first.

    Raises
    ------
    InputError
        If the file is neither, is damaged, or a material is asked for that it does not hold.
    """
    reader, kind = _read(path)
    return choose_material(kind.from_reader(reader), material, path)


def shading_needs(path):
    """What shading from a Sample or a Model will take, told before it is opened; see `Appearance.shading_needs`."""
    reader, kind = _read(path)
    return kind.shading_needs(reader)


def _read(path):
    """Reader of a Sample or a Model, and its class."""
    reader = store.read(path, ("sample", "model"))
    if reader.kind == "sample":
        return reader, Sample
    name = reader.fact("method", "text")
    if name not in METHODS:
        raise InputError(f"{path}: a Model of method {name!r}, which this btfpipe does not know.")
    method = METHODS[name]
    return reader, getattr(importlib.import_module(method.module), method.model)


def choose_material(appearance, material, path):
    """One material of a database opened before, whose memory it shares; see `open_appearance`."""
    if material is None:
        return appearance
    if not hasattr(appearance, "materials"):
        raise no_database(path)
    if material not in appearance.materials and str(material).isdecimal():
        material = int(material)
    with naming(path):
        return appearance.material(material)


def no_database(path):
    """The error for a file that a material is asked of and that has none to choose from."""
    return InputError(
        f"{path}: not a database, so it has no materials to choose from; leave the material out, or give a Model of several"
        f" samples ({', '.join(DATABASES)})."
    )


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


__all__ = [
    "DATABASES",
    "METHODS",
    "choose_material",
    "compress",
    "no_database",
    "open_appearance",
    "shading_needs",
]
