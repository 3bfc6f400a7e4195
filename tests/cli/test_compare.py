"""`btfpipe compare` from the outside."""

import json

import numpy as np
import pytest

from btfpipe.compression.svd import compress_svd
from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.formats.images import read_picture
from btfpipe.sample import Sample


@pytest.fixture
def files(make_sample, tmp_path):
    sample = make_sample(dtype=np.uint8, transfer="srgb")
    sample.save(tmp_path / "s.npz")
    compress_svd(sample, 5).save(tmp_path / "m.npz")
    return tmp_path


def test_report_and_summary_agree_and_are_whole(btfpipe, files):
    done = btfpipe("compare", files / "m.npz", files / "s.npz", "-o", files / "r.json", "--json")
    facts = json.loads(done.stdout)
    report = json.loads((files / "r.json").read_text())
    found = report["comparisons"]["own_pairs"]
    assert facts["comparisons"]["own_pairs"]["linear"] == found["linear"]
    assert report["bytes"] == (files / "m.npz").stat().st_size
    assert report["ratio"] == pytest.approx(3 * 16 * 20 * 133 / report["bytes"])
    assert report["model"]["digest"] != report["sample"]["digest"]
    assert set(found["per_pair"]) == {
        "light",
        "view",
        "rmse",
        "relative_error",
        "display_rmse",
        "ssim",
    }
    assert all(len(column) == 133 for column in found["per_pair"].values())
    assert np.sqrt(np.mean(np.square(found["per_pair"]["rmse"]))) == pytest.approx(
        found["linear"]["rmse"], rel=1e-4
    )
    for name in ("rmse", "psnr_db", "relative_error", "ssim", "white"):
        assert name in report["definitions"]


def test_the_report_is_the_same_for_any_threads(btfpipe, files):
    for threads in (1, 2):
        out = files / f"{threads}.json"
        btfpipe("compare", files / "m.npz", files / "s.npz", "-o", out, "-t", threads)
    assert (files / "1.json").read_bytes() == (files / "2.json").read_bytes()


def test_directions_nobody_measured_are_interpolated_in_every_way_asked(
    btfpipe, files, make_sample
):
    make_sample(lights=bonn81()[:37], dtype=np.uint8, transfer="srgb").save(files / "truth.npz")
    ask = ("compare", files / "m.npz", files / "truth.npz", "--json", "-q")
    assert set(json.loads(btfpipe(*ask).stdout)["comparisons"]) == {"barycentric"}
    every = json.loads(btfpipe(*ask, "--interpolation", "all").stdout)["comparisons"]
    assert list(every) == ["barycentric", "four", "nearest"]
    errors = [way["linear"]["rmse"] for way in every.values()]
    assert len(set(errors)) == 3
    two = json.loads(btfpipe(*ask, "--interpolation", "four", "--interpolation", "nearest").stdout)[
        "comparisons"
    ]
    assert two == {name: every[name] for name in ("four", "nearest")}


def test_a_sample_compares_with_a_sample(btfpipe, files):
    facts = json.loads(btfpipe("compare", files / "s.npz", files / "s.npz", "--json").stdout)
    linear = facts["comparisons"]["own_pairs"]["linear"]
    assert linear["rmse"] == 0
    assert linear["psnr_db"] is None
    assert facts["ratio"] == pytest.approx(1, abs=0.1)


def test_the_picture_is_written_whole_and_kept_without_force(btfpipe, files):
    ask = ("compare", files / "m.npz", files / "s.npz", "--picture", files / "e.png")
    btfpipe(*ask)
    sheet = read_picture(files / "e.png")
    assert sheet.shape[2] == 3
    assert min(sheet.shape[:2]) > 300
    assert sheet.std() > 20
    assert "--force" in btfpipe(*ask, code=2).stderr
    btfpipe(*ask, "--force")


@pytest.mark.parametrize(
    ("name", "message"),
    [("nowhere/e.png", "no such folder"), ("e.doc", "end it in .png")],
)
def test_a_picture_that_cannot_be_is_refused_before_the_work(btfpipe, files, name, message):
    done = btfpipe(
        "compare", files / "m.npz", files / "s.npz", "-o", files / "r.json", "--picture", files / name,
        code=2,
    )  # fmt: skip
    assert message in done.stderr
    assert not (files / "r.json").exists()


def test_things_that_do_not_compare_are_refused_and_nothing_is_written(btfpipe, files, make_sample):
    make_sample(12, 20).save(files / "small.npz")
    cases = [
        ("s.npz", "m.npz", "holds a model"),  # the wrong way round
        ("small.npz", "s.npz", "12 x 20 texels"),
    ]
    for model, sample, message in cases:
        done = btfpipe(
            "compare", files / model, files / sample, "-o", files / "r.json", "--picture", files / "e.png",
            code=3,
        )  # fmt: skip
        assert message in done.stderr
        assert not list(files.glob("r.json*")) + list(files.glob("e.png*"))


def test_the_report_and_the_picture_appear_together_or_not_at_all(btfpipe, files, monkeypatch):
    from btfpipe.formats import images

    ask = ("compare", files / "m.npz", files / "s.npz", "-o", files / "r.json", "--picture")

    def fail(*_, **__):
        raise InputError("no room in the picture")

    with monkeypatch.context() as patch:
        patch.setattr(images, "encode_picture", fail)
        assert "no room" in btfpipe(*ask, files / "e.png", code=3).stderr
    assert not list(files.glob("r.json*")) + list(files.glob("e.png*"))
    btfpipe(*ask, files / "e.png")
    assert (files / "r.json").exists()
    assert (files / "e.png").exists()


def test_the_picture_replaces_no_input(btfpipe, files, make_sample):
    make_sample().save(files / "s.png")
    done = btfpipe(
        "compare", files / "m.npz", files / "s.png", "--picture", files / "s.png", "-f", code=2
    )
    assert "is also the input" in done.stderr


def test_what_has_no_error_or_no_likeness_is_called_so(btfpipe, files, make_sample):
    sample = make_sample(8, 8)
    sample.save(files / "small.npz")
    sample.codes[:] = 0
    sample.save(files / "black.npz")
    said = btfpipe("compare", files / "small.npz", files / "black.npz").stderr
    assert "relative error undefined; display" in said
    assert "SSIM none (no 11 x 11 valid texels)\n" in said


def test_of_lists_the_nearest_pairs_are_what_is_reported(btfpipe, files, make_sample):
    full = make_sample(dtype=np.uint8, transfer="srgb")
    keep = np.arange(0, full.n_pairs, 2)
    Sample(
        full.codes[keep], full.light_directions, full.view_directions, full.light_index[keep],
        full.view_index[keep], transfer="srgb",
    ).save(files / "list.npz")  # fmt: skip
    ask = ("compare", files / "list.npz", files / "s.npz")
    # after a line of progress, where kernels have to be compiled first
    said = btfpipe(*ask, "-o", files / "r.json").stderr.splitlines()
    assert any(line.startswith("nine nearest pairs: linear") for line in said)
    report = json.loads((files / "r.json").read_text())
    assert list(report["comparisons"]) == ["barycentric"]
    assert report["definitions"]["barycentric"] == "nine nearest pairs"
    assert "\nnearest pair: linear" in btfpipe(*ask, "--interpolation", "all").stderr
