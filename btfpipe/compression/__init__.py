"""Models: compressed Samples, one module a method, all `Appearance`s."""

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.sample import Sample


def open_appearance(path):
    """Open a Sample or a Model of any method."""
    reader = store.read(path, ("sample", "model"))
    if reader.kind == "sample":
        return Sample.from_reader(reader)
    method = reader.about.get("method")
    if method == "svd":
        from btfpipe.compression.svd import SvdModel

        return SvdModel.from_reader(reader)
    raise InputError(f"{path}: a Model of method {method!r}, which this btfpipe does not know.")


__all__ = ["open_appearance"]
