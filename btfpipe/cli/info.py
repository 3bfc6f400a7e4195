"""`btfpipe info`: what any file is and what is wrong with it."""

import click

from btfpipe import store
from btfpipe.cli.options import input_file, progress, stage
from btfpipe.errors import BtfError


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


def _lines(thing, depth):
    """Nested facts as indented lines; problems last."""
    indent = "  " * depth
    for key, value in thing.items():
        name = str(key).replace("_", " ") if depth == 1 else str(key)
        if key == "problems":
            yield f"{indent}problems: {'none' if not value else ''}".rstrip()
            yield from (f"{indent}  - {problem}" for problem in value)
        elif isinstance(value, dict) and value and all(map(_simple, value.values())):
            inside = ", ".join(f"{k} {_plain(v)}" for k, v in value.items())
            if len(inside) < 90:
                yield f"{indent}{name}: {inside}"
            else:
                yield f"{indent}{name}:"
                yield from _lines(value, depth + 1)
        elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            yield f"{indent}{name}:"
            for number, item in enumerate(value):
                rest = {k: v for k, v in item.items() if k != "name"}
                yield from _lines({str(item.get("name", number)): rest}, depth + 1)
        elif isinstance(value, dict) and value:
            yield f"{indent}{name}:"
            yield from _lines(value, depth + 1)
        else:
            yield f"{indent}{name}: {_plain(value)}"


def _simple(value):
    return not isinstance(value, dict)


def _plain(value):
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        if not value:
            return "none"
        shown = " x ".join if all(isinstance(v, int) for v in value) else ", ".join
        return shown(_plain(v) for v in value)
    return str(value) if value != {} else "none"
