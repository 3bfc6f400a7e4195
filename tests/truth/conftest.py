"""The committed materials through the real commands; what they are compared with is known from elsewhere."""

from pathlib import Path

import pytest
from click.testing import CliRunner

DATA = Path(__file__).parents[2] / "data-sample"


@pytest.fixture(scope="session")
def data():
    """Folder of the committed materials, their specifications and meshes."""
    return DATA


@pytest.fixture(scope="session")
def command():
    """Run a btfpipe command that has to succeed."""
    from btfpipe.cli import main

    def run(*args):
        result = CliRunner().invoke(main, [*map(str, args), "--quiet"])
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code == 0, result.output

    return run


@pytest.fixture(scope="session")
def ingested(command, tmp_path_factory):
    """Path of a committed material as a Sample; each is ingested once."""
    folder = tmp_path_factory.mktemp("samples")

    def get(name, *options):
        path = folder / f"{name}{''.join(options)}.sample.npz"
        if not path.exists():
            command("ingest", DATA / f"{name}.zip", *options, "-o", path)
        return path

    return get
