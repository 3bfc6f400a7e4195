"""Between the measured directions, against pictures simulated at directions that the measurement does not hold."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from btfpipe.sample import Sample


@pytest.fixture(scope="module", params=["weave", "cords"])
def material(request, data, command, ingested, tmp_path_factory):
    """A material as Sample and as SVD-40 Model, and its truth at the directions of truth.csv."""
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    sample, model, truth = ingested(name), folder / "m.model.npz", folder / "truth.sample.npz"
    spec, pairs, pictures = data / f"{name}.yaml", data / "truth.csv", folder / "truth.zip"
    command("simulate", spec, "--directions", pairs, "--format", "exr", "-o", pictures)
    command("ingest", pictures, "--pairs", "-o", truth)
    command("compress", sample, "--components", 40, "-o", model)
    return SimpleNamespace(sample=sample, model=model, truth=truth)


@pytest.fixture
def psnr(command, tmp_path):
    """Linear PSNR, dB, of each interpolation of a file against a truth, from the report of `compare`."""

    def measure(stand_in, truth):
        report = tmp_path / "report.json"
        command("compare", stand_in, truth, "--interpolation", "all", "-o", report, "--force")
        found = json.loads(report.read_text())["comparisons"]
        return {way: result["linear"]["psnr_db"] for way, result in found.items()}

    return measure


def unmeasured(truth, sample):
    """Pairs of the truth whose light or view is at least 3 degrees from all measured ones."""

    def far(directions, measured):
        return (directions @ measured.T).max(axis=1) < np.cos(np.radians(3))

    light = far(truth.light_directions, sample.light_directions)[truth.light_index]
    view = far(truth.view_directions, sample.view_directions)[truth.view_index]
    return light | view


def test_the_truth_lies_between_the_measured_directions(material):
    truth, sample = Sample.open(material.truth), Sample.open(material.sample)
    assert truth.n_pairs >= 20
    assert unmeasured(truth, sample).all()
    # of the same patch on the same scale, so that the comparison needs no fitted factor
    assert truth.shape == sample.shape
    assert truth.absolute
    assert sample.absolute


@pytest.mark.parametrize("stand_in", ["sample", "model"])
def test_barycentric_interpolation_is_nearer_the_truth_than_the_nearest_or_the_four_nearest_pictures(
    material, psnr, stand_in
):
    found = psnr(getattr(material, stand_in), material.truth)
    print({way: round(value, 2) for way, value in found.items()})  # noqa: T201
    assert found["barycentric"] >= found["nearest"] + 2.0, found
    assert found["barycentric"] >= found["four"] - 0.5, found


def test_a_truth_under_mirrored_directions_is_told_from_the_right_one(material, psnr, tmp_path):
    right = psnr(material.sample, material.truth)
    truth = Sample.open(material.truth)
    mirror = np.array([1, -1, 1])
    Sample(
        np.array(truth.codes),
        truth.light_directions * mirror,
        truth.view_directions * mirror,
        truth.light_index,
        truth.view_index,
        transfer=truth.transfer,
        scale=truth.scale,
        toroidal=truth.toroidal,
        absolute=truth.absolute,
    ).save(tmp_path / "mirrored.sample.npz")
    wrong = psnr(material.sample, tmp_path / "mirrored.sample.npz")
    print(right, wrong)  # noqa: T201
    assert wrong["barycentric"] < right["barycentric"] - 3
    assert wrong["barycentric"] < wrong["nearest"] + 2
