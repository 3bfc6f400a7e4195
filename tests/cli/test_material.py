"""`--material` of every command that evaluates a Model: a database set to a material does what that material does."""

import json

import numpy as np
import pytest

from btfpipe import store
from btfpipe.compression.local_pca import compress_local_pca
from btfpipe.directions import bonn81
from btfpipe.formats.images import read_picture

COMMANDS = {
    "export": ("export", "--format", "pairs", "--suffix", ".exr"),
    "textons": ("textons", "--levels", 1, "--textons", 8),
    "synthesize": ("synthesize", "--plane", "8x8", "--levels", 1),
    "preview": ("preview",),
}
ENDINGS = {"export": ".zip", "preview": ".png"}


@pytest.fixture
def folder(make_sample, tmp_path):
    """A database of two materials, the same that evaluates its second one by default, and the samples."""
    samples = [
        make_sample(rows, 16, seed=rows, lights=bonn81()[:7], views=bonn81()[:3])
        for rows in (15, 14)
    ]
    names = ["wool", "felt"]
    for name, sample in zip(names, samples, strict=True):
        sample.save(tmp_path / f"{name}.npz")
    database = compress_local_pca(samples, clusters=6, names=names)
    database.save(tmp_path / "cloth.npz")
    database.material("felt").save(tmp_path / "felt-first.npz")
    return tmp_path


def contents(path):
    """What a result holds, apart from which file it came from."""
    if path.suffix == ".zip":
        import zipfile

        with zipfile.ZipFile(path) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    if path.suffix == ".png":
        return {"picture": read_picture(path).tobytes()}
    reader = store.read(path)
    return {name: reader[name].tobytes() for name in reader.names()}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_takes_the_material_it_is_told(btfpipe, folder, name):
    command, *options = COMMANDS[name]
    results = {}
    for case, ask in {
        "first": ("cloth.npz",),
        "named": ("cloth.npz", "--material", "felt"),
        "numbered": ("cloth.npz", "--material", 1),
        "own": ("felt-first.npz",),
    }.items():
        out = folder / f"{case}{ENDINGS.get(name, '.out.npz')}"
        btfpipe(command, folder / ask[0], *ask[1:], *options, "-o", out, "-q")
        results[case] = contents(out)
    assert results["named"] == results["numbered"] == results["own"] != results["first"]


def test_compare_measures_the_material_it_is_told(btfpipe, folder):
    for name, number in (("wool", 0), ("felt", 1)):
        ask = ("compare", folder / "cloth.npz", folder / f"{name}.npz", "--json", "-q")
        linear = json.loads(btfpipe(*ask, "--material", name).stdout)["comparisons"]["own_pairs"][
            "linear"
        ]
        facts = store.read(folder / "cloth.npz").about["materials"][number]
        assert linear["rmse"] == pytest.approx(facts["rmse"], rel=1e-4)
    assert "15 x 16 texels" in btfpipe(*ask, code=3).stderr  # the first, which is no felt


def test_info_lists_the_materials(btfpipe, folder):
    lines = btfpipe("info", folder / "cloth.npz").stdout.splitlines()
    at = lines.index("    materials:")
    assert lines[at + 1] == "      wool:"
    assert "      felt:" in lines[at + 2 :]
    assert "        shape: 14 x 16" in lines


@pytest.mark.parametrize("name", [*COMMANDS, "compare"])
def test_a_material_that_is_not_there_is_refused(btfpipe, folder, name):
    command, *options = COMMANDS.get(name, (name, folder / "wool.npz"))
    out = folder / f"out{ENDINGS.get(name, '.npz')}"
    for file, material, message in (
        ("cloth.npz", "silk", "cloth.npz: no material 'silk'; the database holds 2: wool, felt."),
        ("cloth.npz", 2, "cloth.npz: no material 2; the database holds 2: wool, felt."),
        ("wool.npz", "wool", "wool.npz: not a database, so it has no materials to choose from"),
    ):
        source = [folder / file, *options]
        done = btfpipe(command, *source, "--material", material, "-o", out, code=3)
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
        assert not out.exists()


def test_what_is_no_model_at_all_has_no_materials(btfpipe, folder):
    np.save(folder / "image.npy", np.zeros((8, 8, 3)))
    btfpipe("preview", folder / "wool.npz", "-o", folder / "wool.png")
    for command, file, *options in (
        ("synthesize", "image.npy", "--plane", "8x8"),
        ("preview", "wool.png"),
    ):
        out = folder / f"out{ENDINGS.get(command, '.npz')}"
        done = btfpipe(command, folder / file, *options, "--material", 0, "-o", out, code=3)
        assert f"{file}: not a database" in done.stderr


def test_a_sweep_has_no_material(btfpipe, folder):
    done = btfpipe("compare", "--sweep", folder / "wool.npz", "--material", 0, code=2)
    assert "leave --material out" in done.stderr


@pytest.mark.parametrize("name", [*COMMANDS, "compare"])
def test_a_material_taken_unasked_is_named_with_the_others(btfpipe, folder, name):
    command, *options = COMMANDS.get(name, (name, folder / "wool.npz"))
    out = folder / f"out{ENDINGS.get(name, '.out.npz')}"
    options += ["-o", out, "-q", "--json", "--force"]
    for ask, taken, warnings in (
        (["cloth.npz"], "wool", f"Warning: {folder / 'cloth.npz'} holds 2 materials; took 'wool';"
         " --material takes another: felt.\n"),
        (["cloth.npz", "--material", 0], "wool", ""),
        (["wool.npz"], None, ""),
    ):  # fmt: skip
        done = btfpipe(command, folder / ask[0], *options, *ask[1:])
        assert done.stderr == warnings
        assert json.loads(done.stdout).get("material") == taken
