"""Write the table of keys in config/README.md from the config's schema; `make fix` runs it."""

import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
SCHEMA = ROOT / "workflow/schemas/config.schema.yaml"
README = ROOT / "config/README.md"
START, END = "<!-- keys: made from the schema by `make fix` -->\n", "<!-- end of keys -->\n"


def keys(schema, prefix=""):
    """Every key of a schema as (name, description, default), depth first."""
    for name, entry in schema.get("properties", {}).items():
        default = entry.get("default")
        required = name in schema.get("required", [])
        shown = "required" if required else "" if default in (None, {}) else f"`{default}`"
        yield f"{prefix}{name}", entry["description"], shown
        yield from keys(entry, f"{prefix}{name}.")
        if isinstance(entry.get("additionalProperties"), dict):
            yield from keys(entry["additionalProperties"], f"{prefix}{name}.NAME.")


def with_table(text, schema):
    """The README's text with its table made anew."""
    head, rest = text.split(START)
    _, tail = rest.split(END)
    rows = [f"| `{name}` | {what} | {default} |\n" for name, what, default in keys(schema)]
    table = "| key | what it is | default |\n| --- | --- | --- |\n" + "".join(rows)
    return head + START + table + END + tail


if __name__ == "__main__":
    text = README.read_text()
    made = with_table(text, yaml.safe_load(SCHEMA.read_text()))
    if "--check" in sys.argv:
        sys.exit(made != text and "config/README.md is out of date: run `make fix`")
    README.write_text(made)
