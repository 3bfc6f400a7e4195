"""`btfpipe info`: what any file is and what is wrong with it."""

import click

from btfpipe import store
from btfpipe.cli.options import input_file, progress, stage
from btfpipe.errors import BtfError

_OF_NAMES = ("arrays", "layers", "settings")  # facts that go by names of the file's own
_SIZES = ("shape", "size", "plane")  # facts that are written 32 x 32


@click.command()
@click.argument("file", type=input_file())
@stage(out=None)
def info(file, threads, quiet):
    """Say what FILE is and what is wrong with it, on stdout.

    FILE may be any of btfpipe's files, a measurement in any format that `ingest` reads, a picture or a mesh.

    \b
    Example:
        btfpipe info corduroy.sample.npz
        btfpipe info UBO_CORDUROY256.zip --json
    """
    with progress("looking", quiet) as report:
        if not file.is_dir() and store.is_ours(file):
            from btfpipe.sample.describe import describe_container

            reader = store.read(file)
            facts = describe_container(reader, report)
            if not facts["problems"]:
                facts["problems"] += _refusal(file, reader.kind)
        else:
            from btfpipe.formats.describe import describe_foreign

            facts = describe_foreign(file, threads, report)
    return {"inputs": [file], **facts, "text": "\n".join([f"{file}:", *_lines(facts, 1)])}


def _refusal(file, kind):
    """What its own reader finds wrong with one of btfpipe's files, as a list of sentences."""
    from btfpipe.analysis.features import Features
    from btfpipe.compression import open_appearance
    from btfpipe.surface.surface import Surface
    from btfpipe.synthesis.coordinate_map import CoordinateMap

    readers = {
        "sample": open_appearance,
        "model": open_appearance,
        "features": Features.open,
        "surface": Surface.open,
        "map": CoordinateMap.open,
    }
    if kind not in readers:
        return [f"{file}: its kind is {kind!r}; expected one of {', '.join(readers)}."]
    try:
        readers[kind](file)
    except BtfError as error:
        return [str(error)]
    return []


def _lines(thing, depth, names=False):
    """Nested facts as indented lines; problems last. Keys that are `names` stay as they are, others are read as words."""
    indent = "  " * depth
    for key, value in thing.items():
        name = str(key) if names else _words(key)
        if key == "problems":
            yield f"{indent}problems: {'none' if not value else ''}".rstrip()
            yield from (f"{indent}  - {problem}" for problem in value)
        elif (
            isinstance(value, dict)
            and value
            and not any(isinstance(v, dict) for v in value.values())
        ):
            inside = ", ".join(f"{_words(k)} {_plain(v, k)}" for k, v in value.items())
            if len(inside) < 90:
                yield f"{indent}{name}: {inside}"
            else:
                yield f"{indent}{name}:"
                yield from _lines(value, depth + 1, key in _OF_NAMES)
        elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            yield f"{indent}{name}:"
            for number, item in enumerate(value):
                rest = {k: v for k, v in item.items() if k != "name"}
                yield from _lines({str(item.get("name", number)): rest}, depth + 1, True)
        elif isinstance(value, dict) and value:
            yield f"{indent}{name}:"
            yield from _lines(value, depth + 1, key in _OF_NAMES)
        else:
            yield f"{indent}{name}: {_plain(value, key)}"


def _words(key):
    return str(key).replace("_", " ")


def _plain(value, key=""):
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        if not value:
            return "none"
        if all(isinstance(v, int) for v in value):  # as options take them, such as --crop 0 0 32 32
            return (" x " if str(key).endswith(_SIZES) else " ").join(map(_plain, value))
        return ", ".join(map(_plain, value))
    return str(value) if value != {} else "none"
