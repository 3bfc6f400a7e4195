"""Models: compressed Samples, one module a method, all `Appearance`s."""

import importlib

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.sample import Sample

# Where the Model of each method lives. A further method is one module and a line here.
MODELS = {
    "svd": "btfpipe.compression.svd:SvdModel",
    "coded": "btfpipe.compression.coded:CodedModel",
}


def open_appearance(path):
    """Open a Sample or a Model of any method."""
    reader = store.read(path, ("sample", "model"))
    if reader.kind == "sample":
        return Sample.from_reader(reader)
    method = reader.about.get("method")
    if method not in MODELS:
        raise InputError(f"{path}: a Model of method {method!r}, which this btfpipe does not know.")
    module, name = MODELS[method].split(":")
    return getattr(importlib.import_module(module), name).from_reader(reader)


__all__ = ["MODELS", "open_appearance"]
