"""The command line: one module a command, imported when it is called."""

import contextlib
import importlib
import signal
import sys

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


@contextlib.contextmanager
def _signals_clean_up():
    """Leave the block as by `sys.exit` on Ctrl-C, SIGTERM or SIGHUP, with 128 + the signal's number, as shells count.

    So what is half written goes first. Further signals are ignored meanwhile: they often come in pairs, from the terminal and
    from the program that started this one. Signals that this process was told to ignore stay ignored.
    """

    def leave(number, frame):
        for one in before:
            signal.signal(one, signal.SIG_IGN)
        sys.exit(128 + number)

    before = {}
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(one) in (signal.SIG_DFL, signal.default_int_handler):
            with contextlib.suppress(ValueError):  # not the main thread, which alone may ask
                before[one] = signal.signal(one, leave)
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


class _Stages(click.Group):
    """Imports a command only when it is asked for, and lists commands in the order of the work."""

    def main(self, *args, **kwargs):
        with _signals_clean_up():
            return super().main(*args, **kwargs)

    def list_commands(self, ctx):
        return list(STAGES)

    def get_command(self, ctx, name):
        if name not in STAGES:
            return None
        return getattr(importlib.import_module(f"btfpipe.cli.{name}"), name)

    def format_commands(self, ctx, formatter):
        with formatter.section("Stages"):
            formatter.write_dl(list(STAGES.items()))


@click.group(
    cls=_Stages,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(__version__, prog_name="btfpipe")
def main():
    """Dress surfaces in measured or simulated bidirectional texture functions.

    Each stage reads files, writes one file, and says with --json what it did.
    """
