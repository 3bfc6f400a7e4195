"""Reading the scene's YAML: a closed schema, errors that name the key, files filled in."""

from importlib import resources
from pathlib import Path

from btfpipe import description
from btfpipe.errors import InputError, naming


def read_description(path, bindings=None):
    """Read and check a scene's description.

    Parameters
    ----------
    path : path-like
        YAML; the schema beside this module says what it may hold.
    bindings : dict, optional
        Values of placeholders: ``$name`` where the description names a file.

    Returns
    -------
    dict
        As written, its file names replaced by `Path` objects.

    Raises
    ------
    InputError
        If the file cannot be read or is not YAML, a key is unknown, missing, given twice or has an unusable value
        (a number that is not finite among them), there is no light, a placeholder has no binding, or a file does
        not exist.
    """
    import yaml

    path = Path(path)
    scene = description.read_description(path, "a scene")
    schema = yaml.safe_load(
        resources.files("btfpipe.rendering").joinpath("scene.schema.yaml").read_text("utf-8")
    )
    errors = list(description.validator(schema).iter_errors(scene))
    if errors:
        raise InputError(f"{path}: {_explain(errors[0])}")
    if not scene["lights"]:
        raise InputError(f"{path}: lights is empty; a scene needs at least one light.")
    unused = set(bindings or {})
    for part in ("lights", "objects"):
        for number, thing in enumerate(scene[part]):
            for key in ("surface", "map", "model", "mesh"):
                if key in thing:
                    unused.discard(thing[key].removeprefix("$"))
                    thing[key] = _file(path, f"{part}[{number}].{key}", thing[key], bindings or {})
    if unused:
        raise InputError(f"{path}: no file is named ${sorted(unused)[0]}, which --bind gives.")
    return scene


def naming_entry(part, number):
    """Say in front of what is wrong inside the block which of the scene's lights or objects it is."""
    return naming(f"{part}[{number}]")


def _file(scene, where, value, bindings):
    """The file that a value names."""
    if value.startswith("$"):
        if value[1:] not in bindings:
            raise InputError(f"{scene}: {where} is {value}; give it with --bind {value[1:]}=FILE.")
        file = Path(bindings[value[1:]])
    else:
        file = scene.parent / value
    if not file.is_file():
        raise InputError(f"{scene}: {where} is {file}, and there is no such file.")
    return file


def _explain(error, prefix=()):
    """One sentence on a schema error: where, what was found, what was expected."""
    path = [*prefix, *error.path] if not prefix else list(prefix)
    if error.validator == "oneOf" and error.context:
        kinds = [e for e in error.context if e.validator == "const"]
        if len(kinds) == len(error.validator_value):  # it names no kind that there is
            where = _where([*path, *kinds[0].path])
            expected = " or ".join(repr(e.validator_value) for e in kinds)
            return f"{where} is {kinds[0].instance!r}; expected {expected}."
        return _explain(_closest(error), [*path, *_closest(error).path])
    where = _where(path)
    known = ", ".join(error.schema.get("properties", ()))
    if error.validator == "additionalProperties":
        key = next(k for k in error.instance if k not in error.schema["properties"])
        return f"unknown key {key!r} in {where}; expected {known}."
    if error.validator == "required":
        missing = next(k for k in error.validator_value if k not in error.instance)
        return f"key {missing!r} is missing in {where}."
    return f"{where}: {error.message}."


def _closest(error):
    """The first error of the alternative that the writer most likely meant."""
    branches = {}
    for inner in error.context:
        branches.setdefault(inner.schema_path[0], []).append(inner)

    def misfit(branch):
        wrong_kind = sum(e.validator in ("required", "const") for e in branch)
        strange = 0
        for e in branch:
            if e.validator == "additionalProperties":
                strange += sum(k not in e.schema["properties"] for k in e.instance)
        return (wrong_kind + strange, len(branch))

    return min(branches.values(), key=misfit)[0]


def _where(path):
    """``objects[1].plane`` of a path of keys and indices."""
    return description.key_path(path) or "the scene"
