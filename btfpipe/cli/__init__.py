"""The command line: one module a command, imported when it is called."""

import importlib

import click

from btfpipe import __version__

STAGES = {
    "simulate": "Ray-trace a meso-structure into a measurement.",
    "ingest": "Bring a measurement in.",
    "info": "Say what any file is and what is wrong with it.",
    "compress": "Make a Model that stands for a Sample.",
    "compare": "Measure how far a Model is from a Sample.",
    "export": "Write a Sample or Model in a format that others read.",
    "textons": "Extract surface textons and neighbour lists.",
    "surface": "Prepare a mesh for synthesis.",
    "synthesize": "Grow a Sample over a surface or a plane.",
    "render": "Make a picture of a scene.",
    "preview": "Tone-map a picture; make contact sheets.",
}


class _Stages(click.Group):
    """Imports a command only when it is asked for, and lists commands in the order of the work."""

    def list_commands(self, ctx):
        return list(STAGES)

    def get_command(self, ctx, name):
        if name not in STAGES:
            return None
        return getattr(importlib.import_module(f"btfpipe.cli.{name}"), name)

    def format_commands(self, ctx, formatter):
        with formatter.section("Stages"):
            formatter.write_dl(list(STAGES.items()))


@click.group(cls=_Stages, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="btfpipe")
def main():
    """Dress surfaces in measured or simulated bidirectional texture functions.

    Each stage reads files, writes one file, and says with --json what it did.
    """
