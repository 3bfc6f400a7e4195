"""What every command shares: options, summary, progress, exit codes.

Exit codes: 0 done, 1 unforeseen (with traceback), 2 wrong usage or configuration, 3 unusable input,
4 numerical failure, 128 + n if signal n ended it.
"""

import contextlib
import functools
import json
import math
import os
import re
import resource
import sys
import time
from pathlib import Path

import click
from numpy.linalg import LinAlgError

from btfpipe import __version__, files, store
from btfpipe.errors import BtfError, InputError, NumericalError
from btfpipe.parallel import available_threads


class Memory(click.ParamType):
    """An amount of memory such as 512M or 2G, as bytes."""

    name = "size"

    def convert(self, value, param, ctx):
        if isinstance(value, int):
            return value
        found = re.fullmatch(r"(\d+(?:\.\d+)?)([KMGT]?)B?", str(value).strip().upper())
        if not found:
            self.fail(f"{value!r} is not an amount of memory; write 512M or 2G.", param, ctx)
        amount = float(found[1]) * 1024 ** " KMGT".index(found[2] or " ")
        if amount > 2**60:
            self.fail(f"{value!r} is more memory than any machine has.", param, ctx)
        return int(amount)


class FiniteFloat(click.FloatRange):
    """A number, neither NaN nor infinite, perhaps within bounds."""

    name = "float"

    def convert(self, value, param, ctx):
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number

    def _describe_range(self):
        return "" if self.min is None and self.max is None else super()._describe_range()


def _common(out):
    """The options that mean the same everywhere."""
    options = [
        click.option("-f", "--force", is_flag=True, help="Replace the output if it exists."),
        click.option("--seed", type=click.IntRange(0, 2**63 - 1), default=0,
                     help="Seed of everything random; the same seed gives the same bytes."),
        click.option("-t", "--threads", type=click.IntRange(min=1), default=available_threads,
                     show_default="all processors", help="Threads; never changes the result."),
        click.option("--memory", type=Memory(), default="2G",
                     help="Working memory to stay within, such as 512M or 2G."),
        click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON on stdout."),
        click.option("-q", "--quiet", is_flag=True, help="No progress, no summary; warnings stay."),
    ]  # fmt: skip
    if out:
        options.insert(
            0,
            click.option("-o", "--out", required=out == "required", type=click.Path(path_type=Path),
                         help="File to write."),
        )  # fmt: skip
    return options


def stage(out="required", *, outputs=(), folder=False):
    """Give a command the common options, its summary and its exit codes.

    The command gets only those common options that its signature names. It returns a dict, the part of the
    summary that only it knows; ``inputs`` in it may be a list of paths, which are replaced by name and digest,
    and ``text`` is for a command whose result is to be read: it goes to stdout in place of the summary's sentence.

    Parameters
    ----------
    out : str or None
        ``"required"``, ``"optional"``, or None for a command that writes no file.
    outputs : tuple of str
        Names of the command's own options that name further files to write. All are checked before the work:
        none may be there without --force, be an input too, or lie where nothing can be written.
    folder : bool
        Whether the command replaces folders, too.
    """

    def decorate(command):
        takes = command.__code__.co_varnames[: command.__code__.co_argcount]

        @functools.wraps(command)
        def run(force, seed, threads, memory, as_json, quiet, out=None, **kwargs):
            targets = [Path(p) for p in (out, *map(kwargs.get, outputs)) if p is not None]
            _check_targets(targets, _paths(kwargs, outputs), force)
            common = {
                "out": out, "seed": seed, "threads": threads, "memory": memory, "quiet": quiet,
                "as_json": as_json,
            }  # fmt: skip
            _limit_numba(threads)
            start = time.perf_counter()
            try:
                for target in targets:
                    files.check_writable(target, folder)
                facts = command(**{k: v for k, v in common.items() if k in takes}, **kwargs)
                inputs = [_input(path) for path in facts.pop("inputs", [])]
                text = facts.pop("text", None)
            except BtfError as error:
                click.echo(f"Error: {error}", err=True)
                sys.exit(error.exit_code)
            except MemoryError:
                click.echo(
                    f"Error: {command.__name__} needs more memory than there is; ask for less (smaller"
                    " pictures, fewer vertices) or lower --memory.",
                    err=True,
                )
                sys.exit(InputError.exit_code)
            except LinAlgError as error:  # numpy's, which is scipy's too
                click.echo(
                    f"Error: {command.__name__} came upon a matrix that cannot be worked with ({error}); `btfpipe info` may"
                    " say what is odd about the inputs, and other options of the method may get by.",
                    err=True,
                )
                sys.exit(NumericalError.exit_code)
            summary = {"stage": command.__name__, "btfpipe": __version__, "inputs": inputs}
            if out is not None:
                summary["out"] = str(out)
            summary |= {
                "parameters": {k: str(v) if isinstance(v, Path) else v for k, v in kwargs.items()},
                **({"seed": seed} if "seed" in takes else {}),
                "threads": threads,
                **facts,
                "seconds": round(time.perf_counter() - start, 3),
                "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
            }
            if as_json:
                click.echo(json.dumps(store.jsonable(summary), allow_nan=False))
            elif text is not None:
                click.echo(text)
            elif not quiet:
                click.echo(_sentence(summary, facts), err=True)

        for option in reversed(_common(out)):
            run = option(run)
        return run

    return decorate


def _paths(kwargs, outputs):
    """The inputs among a command's own arguments: every path, alone or in a tuple, that is no output."""
    for name, value in kwargs.items():
        if name not in outputs:
            for one in value if isinstance(value, tuple) else (value,):
                if isinstance(one, Path):
                    yield one


def refuse_inputs(target, inputs):
    """Refuse an output that is an input too, or a folder with one; for inputs that are found late, inside of others."""
    whole = _end_of_links(target)
    for path in inputs:
        found = _end_of_links(path)
        if found == whole:
            raise click.UsageError(f"{target} is also the input; choose another name to write.")
        if found.is_relative_to(whole):
            raise click.UsageError(
                f"{target} is a folder that holds the input {path}; choose another name to write."
            )


def _end_of_links(path):
    return Path(os.path.realpath(path))  # which stands links in a ring


def _check_targets(targets, inputs, force):
    """Refuse outputs that are in the way of themselves, of inputs, or of what is there."""
    inputs = list(inputs)
    for i, target in enumerate(targets):
        if target.name in ("", ".."):
            raise click.UsageError(f"{str(target)!r} is no name of a file; give one to write.")
        refuse_inputs(target, inputs)
        if _end_of_links(target) in map(_end_of_links, targets[:i]):
            raise click.UsageError(f"{target} is to be written twice; choose two names.")
        if os.path.exists(target) and not force:
            raise click.UsageError(f"{target} exists; pass --force to replace it.")
        if not os.path.isdir(target.parent):
            raise click.UsageError(f"{target.parent}: no such folder; make it first.")


def _limit_numba(threads):
    """Bound numba's threads: before its first import by its environment, which it must not see change later."""
    if "numba" not in sys.modules:
        os.environ.setdefault("NUMBA_NUM_THREADS", str(threads))
        return
    import numba

    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def _input(path):
    return {"path": str(path), "digest": store.digest(path)}


def _sentence(summary, facts):
    """The summary for a person, on one line."""
    shown = ", ".join(
        f"{k.replace('_', ' ')} {v:.4g}" if isinstance(v, float) else f"{k.replace('_', ' ')} {v}"
        for k, v in facts.items()
        if isinstance(v, int | float | str)
    )
    made = f" → {summary['out']}" if "out" in summary else ""
    return f"{summary['stage']}{made}: {shown} ({summary['seconds']:.1f} s)"


@contextlib.contextmanager
def progress(label, quiet=False):
    """Progress on stderr for anything over two seconds; the block gets ``report(done, total)``.

    A bar if stderr is a terminal, otherwise a line every 10 % but at most one in two seconds.
    """
    if quiet:
        yield lambda done, total: None
        return
    if sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(total=None, desc=label, file=sys.stderr, delay=2, leave=False) as bar:

            def report(done, total):
                bar.total = total
                bar.update(done - bar.n)

            yield report
        return
    state = {"time": time.monotonic(), "share": 0}

    def log(done, total):
        share = 10 * done // max(total, 1)
        now = time.monotonic()
        if share > state["share"] and now - state["time"] > 2:
            state.update(time=now, share=share)
            click.echo(f"{label}: {done} of {total}", err=True)

    yield log


def warn(*sentences):
    """Print sentences on stderr, with --quiet too: they belong to the result."""
    for sentence in sentences:
        click.echo(f"Warning: {sentence.rstrip('.')}.", err=True)


class _InputPath(click.Path):
    """A file or folder that is there: no pipe, which can be read but once, and no device."""

    def convert(self, value, param, ctx):
        path = super().convert(value, param, ctx)
        if not (path.is_file() or path.is_dir()):
            self.fail(
                f"{value} is a pipe or a device; expected a file. Save it as one first.", param, ctx
            )
        return path


def input_file(**kwargs):
    """Type of a command's input argument: any file or folder that is there."""
    return _InputPath(exists=True, path_type=Path, **kwargs)


def material_option(command):
    """``--material`` of a command that evaluates a Model, for `open_appearance`."""
    return click.option(
        "--material",
        metavar="NAME|NUMBER",
        help="Which material of a database to take, by name or number from 0.  [default: the first]",
    )(command)


def material_taken(path, material):
    """Say which material a command takes of a file, if it is a Model of several; warn unless it was named.

    Returns
    -------
    dict
        ``material``, its name, for the summary; nothing of a file with none to choose from.

    Raises
    ------
    InputError
        See `open_appearance`.
    """
    from btfpipe.compression import DATABASES, open_appearance

    if not store.is_ours(path) or store.read(path).about.get("method") not in DATABASES:
        return {}
    model = open_appearance(path, material)
    names = list(model.materials)
    if len(names) == 1:
        return {}
    taken = names.pop(model.about["material"])
    if material is None:
        warn(
            f"{path} holds {len(names) + 1} materials; took {taken!r}; --material takes another: {', '.join(names)}"
        )
    return {"material": taken}


def flag(name):
    """An option as it is typed, from its name in Python."""
    return "--" + name.replace("_", "-")
