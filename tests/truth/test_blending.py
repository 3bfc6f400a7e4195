"""Between measured directions a coded Model's blended roots are nearer the truth than its blended values."""

import pytest

from btfpipe.compression.coded import compress_coded
from btfpipe.metrics.comparison import compare, model_pictures
from btfpipe.sample import Sample


@pytest.mark.slow
@pytest.mark.parametrize("name", ["weave", "cords"])
def test_blended_roots_are_nearer_the_truth_than_blended_values(
    data, command, ingested, tmp_path, name
):
    truth = tmp_path / "truth.sample.npz"
    command(
        "simulate", data / f"{name}.yaml", "--directions", data / "truth.csv", "--format", "exr",
        "-o", tmp_path / "truth.zip",
    )  # fmt: skip
    command("ingest", tmp_path / "truth.zip", "--pairs", "-o", truth)
    truth = Sample.open(truth)
    roots = compress_coded(Sample.open(ingested(name)))
    values = Sample(
        roots.pictures(slice(0, roots.n_pairs)), roots.light_directions, roots.view_directions,
        roots.light_index, roots.view_index, absolute=True, toroidal=True,
    )  # fmt: skip
    ours, theirs = (
        compare(m, truth, interpolation="barycentric").overall() for m in (roots, values)
    )
    assert ours["display"]["psnr_db"] > theirs["display"]["psnr_db"] + 0.4
    assert ours["linear"]["psnr_db"] > theirs["linear"]["psnr_db"] - 0.1
    every = slice(0, truth.n_pairs)
    found = model_pictures(roots, truth, "barycentric")(every).mean()
    assert found == pytest.approx(truth.pictures(every).mean(), rel=0.02)
