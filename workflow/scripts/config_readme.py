"""Write the tables of keys in config/README.md and config/scenes/README.md from the schemas; `make fix` runs it."""

import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
START, END = "<!-- keys: made from the schema by `make fix` -->\n", "<!-- end of keys -->\n"


def keys(schema, prefix=""):
    """Every key of the config's schema as (name, description, default), depth first."""
    for name, entry in schema.get("properties", {}).items():
        default = entry.get("default")
        required = name in schema.get("required", [])
        shown = "required" if required else "" if default in (None, {}) else f"`{default}`"
        yield f"{prefix}{name}", entry["description"], shown
        yield from keys(entry, f"{prefix}{name}.")
        if isinstance(entry.get("additionalProperties"), dict):
            yield from keys(entry["additionalProperties"], f"{prefix}{name}.NAME.")


def table(head, rows):
    """Lines of a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def config_keys(schema):
    """The table of the config's keys."""
    rows = [[f"`{name}`", what, default] for name, what, default in keys(schema)]
    return table(["key", "what it is", "default"], rows)


def scene_keys(schema):
    """A table for each part of a scene and each kind of its lights and objects."""
    known = {f"#/$defs/{name}": entry for name, entry in schema["$defs"].items()}

    def rows(part, prefix=""):
        for name, entry in part["properties"].items():
            entry = known.get(entry.get("$ref"), {}) | entry
            what = entry.get("description", "")
            if "enum" in entry:
                what += f" One of {', '.join(f'`{value}`' for value in entry['enum'])}."
            if "const" in entry:
                what = f"`{entry['const']}`"
            required = "required" if name in part.get("required", []) else ""
            yield [f"`{prefix}{name}`", what.strip(), required]
            if "properties" in entry:
                yield from rows(entry, f"{prefix}{name}.")

    text = ""
    for name, part in schema["properties"].items():
        kinds = part.get("items", {}).get("oneOf", [part])
        for kind in kinds:
            if "properties" not in kind:
                text += f"\n## `{name}`\n\n{kind['description']} Red, green and blue.\n"
                continue
            text += f"\n## `{name}`"
            if len(kinds) > 1:
                names = " and ".join(f"`{key}`" for key in kind["required"] if key != "type")
                text += f" with {names}"
            text += "\n\n"
            text += f"{kind['description']}\n\n" if "description" in kind else ""
            text += table(["key", "what it is", ""], rows(kind))
    return text


TABLES = {
    "config/README.md": ("workflow/schemas/config.schema.yaml", config_keys),
    "config/scenes/README.md": ("btfpipe/rendering/scene.schema.yaml", scene_keys),
}


def with_keys(text, made):
    """A README's text with what stands between its marks made anew."""
    head, rest = text.split(START)
    _, tail = rest.split(END)
    return head + START + made + END + tail


if __name__ == "__main__":
    for name, (schema, make) in TABLES.items():
        text = (ROOT / name).read_text()
        made = with_keys(text, make(yaml.safe_load((ROOT / schema).read_text())))
        if "--check" in sys.argv and made != text:
            sys.exit(f"{name} is out of date: run `make fix`")
        (ROOT / name).write_text(made)
