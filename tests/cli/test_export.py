import json

import numpy as np
import pytest

from btfpipe.compression import open_appearance
from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81
from btfpipe.metrics.comparison import matching_pairs
from btfpipe.sample import Sample


@pytest.fixture
def small(make_sample, tmp_path):
    """A Sample file of one view, straight down, and two more."""
    path = tmp_path / "s.npz"
    make_sample(12, 12, lights=bonn81()[:7], views=bonn81()[:3]).save(path)
    return path


@pytest.mark.parametrize(
    ("format_", "suffix", "taken_for", "atol"),
    [
        ("ubo", ".png", "ubo", 0.02),
        ("utia", ".png", "utia", 0.02),
        ("pairs", ".png", "pairs", 0.02),
        ("ubo", ".exr", "ubo", 1e-3),
        ("utia", ".exr", "utia", 3e-3),
        ("pairs", ".exr", "pairs", 1e-3),
        ("rti", ".png", "rti", 0.02),
    ],
)
@pytest.mark.parametrize("brightness", [1, 40])
@pytest.mark.parametrize("absolute", [False, True])
def test_what_is_exported_is_ingested_as_it_was(
    btfpipe, small, tmp_path, format_, suffix, taken_for, atol, brightness, absolute
):
    bright = Sample.open(small)
    bright.codes = bright.codes * np.float32(brightness)
    bright.absolute = absolute
    bright.save(small)
    target = tmp_path / "set.zip"
    done = btfpipe("export", small, "--format", format_, "--suffix", suffix, "-o", target)
    assert ("--suffix .exr keeps them" in done.stderr) == (brightness > 1 and suffix == ".png")
    done = btfpipe("ingest", target, "-o", tmp_path / "back.npz", "--json")
    facts = json.loads(done.stdout)
    assert facts["taken_for"] == taken_for
    sample, back = Sample.open(small), Sample.open(tmp_path / "back.npz")
    found = matching_pairs(sample, back)
    assert len(back.light_directions) == 7
    assert back.n_pairs == (7 if format_ == "rti" else 21)
    assert back.absolute == absolute
    np.testing.assert_allclose(
        back.pictures(slice(None)), sample.pictures(found), atol=atol * brightness
    )


def test_a_model_is_exported_like_a_sample(btfpipe, make_sample, tmp_path):
    model = compress_svd(make_sample(12, 12), 6)
    model.save(tmp_path / "m.npz")
    btfpipe("export", tmp_path / "m.npz", "--suffix", ".exr", "-o", tmp_path / "folder")
    btfpipe("ingest", tmp_path / "folder", "-o", tmp_path / "back.npz")
    back = Sample.open(tmp_path / "back.npz")
    np.testing.assert_allclose(
        back.pictures(slice(None)),
        model.pictures(matching_pairs(model, back)),
        rtol=1e-3,
        atol=1e-3,
    )


@pytest.mark.parametrize("format_", ["ubo", "utia", "pairs", "rti"])
def test_settings_in_upper_case_count(btfpipe, small, tmp_path, format_):
    bright = Sample.open(small)
    bright.codes = bright.codes * np.float32(8)
    bright.save(small)
    btfpipe("export", small, "--format", format_, "--suffix", ".png", "-o", tmp_path / "set")
    (settings,) = (tmp_path / "set").glob("**/btfpipe.json")
    settings.rename(settings.with_name("BTFPIPE.JSON"))
    facts = json.loads(
        btfpipe("ingest", tmp_path / "set", "-o", tmp_path / "b.npz", "--json").stdout
    )
    assert facts.get("strays") in ([], None)
    assert Sample.open(tmp_path / "b.npz").pictures(slice(None)).max() > 4


def test_a_file_of_factors_says_what_it_left_out(btfpipe, small, tmp_path):
    factors = ("--format", "btf", "--channel-components", 3, 2, 2, "--json")
    done = btfpipe("export", small, *factors, "-o", tmp_path / "s.btf")
    btfpipe("ingest", tmp_path / "s.btf", "-o", tmp_path / "back.npz")
    values = Sample.open(small).pictures(slice(None))
    error = open_appearance(tmp_path / "back.npz").pictures(slice(None)) - values
    relative = np.sqrt(np.sum(error**2) / np.sum(values**2))
    assert json.loads(done.stdout)["relative_error"] == pytest.approx(relative, rel=1e-3)
    again = btfpipe(
        "export", tmp_path / "back.npz", "--format", "btf", "--json", "-o", tmp_path / "t.btf"
    )
    assert "relative_error" not in json.loads(again.stdout)


def test_a_folder_of_others_is_left_alone_when_a_set_is_written(btfpipe, small, tmp_path):
    (tmp_path / "set.part").mkdir()
    (tmp_path / "set.part/mine.txt").write_text("mine")
    for options in ([], ["--force"]):
        btfpipe("export", small, "-o", tmp_path / "set", *options)
        assert (tmp_path / "set.part/mine.txt").read_text() == "mine"
        assert {p.name for p in tmp_path.iterdir()} == {"s.npz", "set", "set.part"}


def test_an_option_of_another_format_is_refused(btfpipe, small, tmp_path):
    done = btfpipe(
        "export", small, "--format", "pairs", "--sample-number", 3, "-o", tmp_path / "x.zip", code=2
    )
    assert "--sample-number is not for pairs" in done.stderr
    assert not list(tmp_path.glob("x.zip*"))


def test_every_format_of_the_tables_is_offered():
    import importlib

    compress, export, ingest = (
        importlib.import_module(f"btfpipe.cli.{n}") for n in ("compress", "export", "ingest")
    )
    from btfpipe.compression import METHODS
    from btfpipe.formats.sources import FORMATS
    from btfpipe.formats.targets import WRITERS

    assert set(ingest._FORMATS) == set(FORMATS)
    assert set(export._FORMATS) == set(WRITERS)
    assert set(compress._METHODS) == {name for name, m in METHODS.items() if m.function}


@pytest.mark.parametrize(
    ("format_", "name", "expected"),
    [
        ("ubo", "weave.btf", "ubo writes a folder of pictures, or NAME.zip"),
        ("btf", "x.zip", "btf writes one file; call it NAME.btf"),
        ("btf", "x", "btf writes one file; call it NAME.btf"),
        (None, "weave.exr", "ubo writes a folder of pictures, or NAME.zip"),
        ("pairs", "list.CSV", "pairs writes a folder of pictures, or NAME.zip"),
    ],
)
def test_an_ending_that_says_another_format_is_wrong_usage(
    btfpipe, small, tmp_path, format_, name, expected
):
    options = ["--format", format_] if format_ else []
    done = btfpipe("export", small, *options, "-o", tmp_path / name, code=2)
    assert f"{tmp_path / name}: {expected}" in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["s.npz"]


def test_a_folder_may_have_a_dot_in_its_name(btfpipe, small, tmp_path):
    btfpipe("export", small, "-o", tmp_path / "wool_1.5mm")
    assert (tmp_path / "wool_1.5mm").is_dir()
