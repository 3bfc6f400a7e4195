"""What can be written, in one table."""

import importlib
from collections import namedtuple

# A format that can be written: where its function is, function(path, appearance, *, threads, on_progress, **options), and which options
# a user may set: by their names on the command line, those of the function's arguments.
Writer = namedtuple("Writer", "module function options")

WRITERS = {
    "ubo": Writer("btfpipe.formats.ubo_writing", "write_ubo", {"suffix": "suffix"}),
    "utia": Writer("btfpipe.formats.utia", "write_utia", {"suffix": "suffix"}),
    "curet": Writer(
        "btfpipe.formats.curet_writing",
        "write_curet",
        {"suffix": "suffix", "sample_number": "sample_number"},
    ),
    "rti": Writer("btfpipe.formats.rti", "write_lp", {"suffix": "suffix"}),
    "btf": Writer("btfpipe.formats.btf_writing", "write_btf", {"channel_components": "terms"}),
    "pairs": Writer("btfpipe.formats.pairs", "write_pairs", {"suffix": "suffix"}),
}


def write(path, name, appearance, *, threads=1, on_progress=None, **options):
    """Write an Appearance in the named format; returns facts for a summary.

    Raises
    ------
    InputError
        As the format's function.
    """
    writer = WRITERS[name]
    function = getattr(importlib.import_module(writer.module), writer.function)
    options = {writer.options.get(key, key): value for key, value in options.items()}
    facts = function(path, appearance, threads=threads, on_progress=on_progress, **options)
    if isinstance(facts, dict):
        return facts
    model = facts  # that a .btf holds
    # of what was left out on the way
    told = () if model is appearance else ("rmse", "relative_error", "warnings")
    return {
        "method": model.method,
        "terms": list(model.n_terms),
        **{name: model.about[name] for name in told if name in model.about},
    }
