"""`btfpipe compress` from the outside."""

import json

import numpy as np
import pytest

from btfpipe.compression import open_appearance
from btfpipe.compression.svd import SvdModel, compress_svd
from btfpipe.directions import bonn81
from btfpipe.sample import Sample

SVD = ("--method", "svd")


@pytest.fixture
def sample_file(make_sample, tmp_path):
    path = tmp_path / "s.sample.npz"
    make_sample(dtype=np.uint8, transfer="srgb", about={"source": "made up"}).save(path)
    return path


def test_the_summary_states_error_bytes_and_ratio(btfpipe, sample_file, tmp_path):
    out = tmp_path / "m.model.npz"
    done = btfpipe("compress", sample_file, "-o", out, *SVD, "--components", 8, "--json")
    facts = json.loads(done.stdout)
    assert facts["bytes"] == out.stat().st_size
    assert facts["sample_bytes"] == 3 * 16 * 20 * 133
    assert facts["ratio"] == pytest.approx(facts["sample_bytes"] / facts["bytes"])
    assert facts["n_terms"] == 8
    assert facts["seed"] == 0
    model, sample = open_appearance(out), Sample.open(sample_file)
    assert isinstance(model, SvdModel)
    everything = slice(0, 133)
    difference = model.pictures(everything) - sample.pictures(everything)
    assert facts["rmse"] == pytest.approx(np.sqrt((difference**2).mean()), rel=1e-4)
    assert model.about["source"] == "made up"


def test_precision_decides_the_bytes(btfpipe, sample_file, tmp_path):
    sizes = {}
    for precision in ("half", "single"):
        out = tmp_path / f"{precision}.npz"
        btfpipe(
            "compress", sample_file, "-o", out, *SVD, "--precision", precision, "--components", 8
        )
        sizes[precision] = out.stat().st_size
    assert sizes["single"] - sizes["half"] == pytest.approx(2 * 8 * (16 * 20 + 3 * 133), abs=128)


def test_same_bytes_for_any_threads_and_other_bytes_for_another_seed(
    btfpipe, sample_file, tmp_path
):
    runs = {"a": ("-t", 1), "b": ("-t", 2), "c": ("-t", 2, "--memory", "109M"), "d": ("--seed", 7)}
    for name, options in runs.items():
        btfpipe(
            "compress",
            sample_file,
            "-o",
            tmp_path / name,
            *SVD,
            "--components",
            8,
            "--iterations",
            0,
            *options,
        )
    data = {name: (tmp_path / name).read_bytes() for name in runs}
    assert data["a"] == data["b"] == data["c"] != data["d"]


def test_a_rank_below_the_components_is_a_warning(btfpipe, make_sample, tmp_path):
    sample = make_sample()
    sample.codes[:] = sample.codes[:1]
    sample.save(tmp_path / "s.npz")
    done = btfpipe(
        "compress", tmp_path / "s.npz", "-o", tmp_path / "m.npz", *SVD, "--components", 5, "--json"
    )
    facts = json.loads(done.stdout)
    assert facts["n_terms"] == 3
    assert "2 terms left out" in facts["warnings"][0]
    quiet = btfpipe(
        "compress", tmp_path / "s.npz", "-o", tmp_path / "n.npz", *SVD, "--components", 5, "-q"
    )
    assert quiet.stderr == f"Warning: {facts['warnings'][0]}.\n"


def test_one_picture_of_one_view_and_light_compresses(btfpipe, make_sample, tmp_path):
    from btfpipe.directions import bonn81

    make_sample(lights=bonn81()[:1], views=bonn81()[:1]).save(tmp_path / "s.npz")
    done = btfpipe("compress", tmp_path / "s.npz", "-o", tmp_path / "m.npz", *SVD, "--json")
    facts = json.loads(done.stdout)
    assert facts["relative_error"] < 1e-3
    assert facts["n_terms"] == 3
    (warning,) = facts["warnings"]
    assert "at most 3 terms: 37 terms left out" in warning
    assert warning in done.stderr


def bad_sources(make_sample, folder):
    """Files that cannot be compressed, and what the message says of each."""
    compress_svd(make_sample(), 3).save(folder / "model.npz")
    (folder / "text.npz").write_text("no zip at all")
    whole = make_sample()
    whole.save(folder / "cut.npz")
    (folder / "cut.npz").write_bytes((folder / "cut.npz").read_bytes()[:-2000])
    spoilt = make_sample()
    spoilt.codes[5, 1, 1, 0] = np.nan
    spoilt.save(folder / "nan.npz")
    return {
        "model.npz": "holds a model",
        "text.npz": "not a btfpipe file",
        "cut.npz": "not a btfpipe file, or damaged",
        "nan.npz": "non-finite",
    }


def test_what_is_no_sample_is_refused_and_nothing_is_written(btfpipe, make_sample, tmp_path):
    for name, message in bad_sources(make_sample, tmp_path).items():
        out = tmp_path / "out.npz"
        done = btfpipe("compress", tmp_path / name, "-o", out, "--components", 4, code=3)
        assert message in done.stderr, name
        assert done.stdout == ""
        assert not list(tmp_path.glob("out.npz*"))


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--components", 0), 2, "0 is not in the range"),
        (("--method", "magic"), 2, "magic"),
        ((*SVD, "--memory", "10K"), 3, "s.sample.npz: 50 vectors"),
        (("--method", "view-pca", "--clusters", 3), 2, "view-pca has no --clusters"),
        (("--ratio", 50, "--target-bytes", "9K"), 2, "two ways to say the same"),
        (
            ("--method", "local-pca", "--clusters", 3, "--target-bytes", "9K"),
            2,
            "two ways to say the same",
        ),
        (("--method", "harmonics", "--view-harmonics", 7), 3, "square number"),
        (("--equal-views",), 2, "coded has no --equal-views"),
        (("--memory", "9" * 400), 2, "more memory than any machine has"),
    ],
)
def test_impossible_options_are_refused(btfpipe, sample_file, tmp_path, options, code, message):
    done = btfpipe("compress", sample_file, "-o", tmp_path / "m.npz", *options, code=code)
    assert message in done.stderr
    assert not list(tmp_path.glob("m.npz*"))


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--ratio", 8),
        ("--method", "svd", "--space", "log", "--channel-components", 9, 4, 4),
        ("--method", "view-pca", "--components", 4, "--precision", "byte"),
        ("--method", "local-pca", "--clusters", 3, "--components", 5),
        ("--method", "harmonics", "--view-harmonics", 4, "--light-harmonics", 9),
        ("--method", "harmonics", "--view-harmonics", 4, "--light-harmonics", 9, "--equal-views"),
    ],
)
def test_every_method_makes_a_model_whose_summary_is_true(btfpipe, sample_file, tmp_path, options):
    out = tmp_path / "m.npz"
    facts = json.loads(btfpipe("compress", sample_file, "-o", out, *options, "--json").stdout)
    model, sample = open_appearance(out), Sample.open(sample_file)
    values = sample.pictures(slice(None))
    error = np.sqrt(np.mean(np.square(model.pictures(slice(None)) - values, dtype=np.float64)))
    assert facts["rmse"] == pytest.approx(error, rel=1e-3)
    assert facts["relative_error"] == pytest.approx(
        error / np.sqrt(np.mean(np.square(values, dtype=np.float64))), rel=1e-3
    )
    assert facts["bytes"] == out.stat().st_size
    value = model.evaluate(3.0, 4.0, [0, 0, 1], [0, 0, 1])
    assert np.isfinite(value).all()
    if "--ratio" in options:
        assert facts["ratio"] >= 8


def test_several_samples_make_a_database(btfpipe, make_sample, tmp_path):
    for name, seed in (("wool", 1), ("felt", 2)):
        make_sample(seed=seed).save(tmp_path / f"{name}.npz")
    files = tmp_path / "wool.npz", tmp_path / "felt.npz"
    out = tmp_path / "m.npz"
    done = btfpipe(
        "compress", *files, "-o", out, "--method", "local-pca", "--clusters", 8, "--components", 9, "--json"
    )  # fmt: skip
    facts = json.loads(done.stdout)
    assert (
        facts["sample_bytes"] == 2 * 6 * 16 * 20 * 133
        or facts["sample_bytes"] == 2 * 3 * 16 * 20 * 133
    )
    model = open_appearance(out)
    assert list(model.materials) == ["wool", "felt"]
    for number, path in enumerate(files):
        values = Sample.open(path).pictures(slice(None))
        error = model.material(number).pictures(slice(None)) - values
        assert np.sqrt((error**2).mean()) < 0.1 * values.std()


def test_a_database_of_other_directions_is_refused_or_resampled(btfpipe, make_sample, tmp_path):
    files = tmp_path / "wool.npz", tmp_path / "felt.npz"
    make_sample().save(files[0])
    make_sample(8, 9, seed=2, lights=bonn81()[:37], views=bonn81()[:19]).save(files[1])
    out = tmp_path / "m.npz"
    ask = ("compress", *files, "-o", out, "--method", "local-pca", "--clusters", 8)
    done = btfpipe(*ask, code=3)
    assert "felt has 37 lights, wool has 19" in done.stderr
    assert done.stderr.endswith("or pass --resample.\n")
    assert not out.exists()
    facts = json.loads(btfpipe(*ask, "--resample", "--json").stdout)
    wool, felt = facts["materials"]
    assert "resampled_from" not in wool
    assert felt["resampled_from"] == {"lights": 37, "views": 19, "pairs": 703}
    assert "resampled from: lights 37" in btfpipe("info", out).stdout.replace("_", " ")
    # the sample's own first directions are the database's: there nothing is interpolated
    sample, model = Sample.open(files[1]), open_appearance(out, "felt")
    values = sample.pictures([37 * 3 + 5])[0]
    error = model.pictures([19 * 3 + 5])[0] - values
    assert np.sqrt((error**2).mean()) < 0.1 * values.std()


def test_resampling_is_for_databases_of_several(btfpipe, sample_file, tmp_path):
    for options, message in (
        ((), "method coded has no --resample"),
        (("--method", "local-pca"), "--resample is for a database of several samples; 1 is given"),
    ):
        done = btfpipe(
            "compress", sample_file, "-o", tmp_path / "m.npz", "--resample", *options, code=2
        )
        assert message in done.stderr


def test_several_samples_are_refused_by_a_method_that_takes_one(btfpipe, sample_file, tmp_path):
    done = btfpipe("compress", sample_file, sample_file, "-o", tmp_path / "m.npz", code=2)
    assert "method coded takes one sample; 2 are given" in done.stderr


def test_an_existing_model_is_kept_without_force(btfpipe, sample_file, tmp_path):
    out = tmp_path / "m.npz"
    out.write_text("mine")
    done = btfpipe("compress", sample_file, "-o", out, code=2)
    assert "--force" in done.stderr
    assert out.read_text() == "mine"


def test_svd_in_a_space_counts_terms_by_channel(btfpipe, sample_file, tmp_path):
    done = btfpipe(
        "compress", sample_file, "-o", tmp_path / "m.npz", *SVD, "--space", "log", "--components", 4, code=2
    )  # fmt: skip
    assert "svd channel by channel has no --components" in done.stderr
    done = btfpipe(
        "compress", sample_file, "-o", tmp_path / "m.npz", *SVD, "--precision", "byte", code=2
    )
    assert "no --precision byte" in done.stderr


def test_materials_of_one_name_are_refused_with_the_way_out(btfpipe, sample_file, tmp_path):
    method = ("--method", "local-pca", "-o", tmp_path / "m.npz")
    done = btfpipe("compress", sample_file, sample_file, *method, code=2)
    assert "are not all different; rename one." in done.stderr
