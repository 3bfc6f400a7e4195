"""Descriptions that people write: one YAML file in which nothing is said twice and every number is finite."""

import math
from pathlib import Path

import yaml

from btfpipe.errors import InputError


class _TwiceError(Exception):
    pass


class _Loader(yaml.SafeLoader):
    """Plain values only, and no key twice in a mapping (of which YAML would silently keep the last)."""

    def compose_mapping_node(self, anchor):
        node = super().compose_mapping_node(anchor)
        lines = {}
        for key, _ in node.value:
            name, line = (key.tag, str(key.value)), key.start_mark.line + 1
            if name in lines and isinstance(key, yaml.ScalarNode):
                raise _TwiceError(
                    f"the key {key.value!r} is given twice, in lines {lines[name]} and {line}; keep one."
                )
            lines[name] = line
        return node


def read_description(path, what, form=""):
    """Read a YAML file; its form is for the caller to check.

    Parameters
    ----------
    path : path-like
    what : str
        What it should be, such as ``"a scene"``.
    form : str
        Added to messages on files that are not YAML: what was expected.

    Returns
    -------
    dict, list or plain value
        All its numbers are finite.

    Raises
    ------
    InputError
        If the file cannot be read, is empty, binary or not YAML, gives a key twice, or holds a number that is NaN,
        infinite or beyond double precision (named by its place).
    """
    path = Path(path)
    binary = f"{path}: not {what} (YAML) but a binary file; `btfpipe info {path}` says what it is."
    try:
        thing = yaml.load(path.read_text(encoding="utf-8-sig"), _Loader)
        strange = _not_finite(thing, ())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    except (UnicodeDecodeError, yaml.reader.ReaderError) as error:
        raise InputError(binary) from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: dates and numbers that are none
        raise InputError(f"{path}: not YAML ({' '.join(str(error).split())}).{form}") from error
    except RecursionError as error:
        raise InputError(f"{path}: lists in lists beyond measure, or one in itself.") from error
    except _TwiceError as error:
        raise InputError(f"{path}: {error}") from error
    if thing is None:
        raise InputError(f"{path}: empty; expected {what}.{form}")
    if strange is not None:
        where, value = strange
        raise InputError(f"{path}: {where} is {value}; expected a finite number.")
    return thing


def validator(schema):
    """A validator of jsonschema for which a whole number is written as one: 4.0, which it would take for 4, is no count."""
    import jsonschema

    base = jsonschema.Draft202012Validator
    types = base.TYPE_CHECKER.redefine(
        "integer", lambda _, value: isinstance(value, int) and not isinstance(value, bool)
    )
    return jsonschema.validators.extend(base, type_checker=types)(schema)


def key_path(keys):
    """``objects[1].plane`` of a path of keys and indices."""
    text = ""
    for part in keys:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _not_finite(thing, keys):
    """Place and text of the first number of `thing` that is not finite, or None."""
    if isinstance(thing, dict | list):
        parts = thing.items() if isinstance(thing, dict) else enumerate(thing)
        return next(filter(None, (_not_finite(part, (*keys, key)) for key, part in parts)), None)
    if isinstance(thing, float) and not math.isfinite(thing):
        return key_path(keys) or "the file", str(thing)
    if isinstance(thing, int) and thing.bit_length() > 1023:
        return key_path(keys) or "the file", f"a number of {thing.bit_length()} bits"
    return None
