import numpy as np
import pytest

from btfpipe.compression.relighting import RelightingModel
from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.formats import ubo
from btfpipe.formats.ubo_writing import write_ubo
from btfpipe.sample import Sample
from btfpipe.sample.ingest import ingest


def read_back(path, out, **options):
    with ubo.open_measurement(path, **options) as measurement:
        ingest(measurement, out)
    return Sample.open(out)


@pytest.mark.parametrize("target", ["set", "set.zip"])
@pytest.mark.parametrize(("suffix", "tolerance"), [(".exr", 1e-3), (".png", 0.01), (".jpg", 0.08)])
def test_what_was_written_is_read_back(tmp_path, make_sample, target, suffix, tolerance):
    sample = make_sample(16, 16, absolute=True, toroidal=True, texels_per_mm=2.5, scale=1.5)
    facts = write_ubo(tmp_path / target, sample, suffix)
    back = read_back(tmp_path / target, tmp_path / "s.npz")
    every = slice(0, sample.n_pairs)
    error = np.abs(back.pictures(every) - sample.pictures(every))
    assert (error.mean() if suffix == ".jpg" else error.max()) < tolerance
    assert (back.toroidal, back.texels_per_mm, back.absolute) == (True, 2.5, True)
    assert back.is_product
    assert facts["pictures"] == sample.n_pairs


def test_eight_bit_codes_keep_their_curve(tmp_path, make_sample):
    sample = make_sample(6, 7, dtype=np.uint8, transfer="gamma2.2")
    write_ubo(tmp_path / "set", sample, ".png")
    back = read_back(tmp_path / "set", tmp_path / "s.npz")
    assert back.transfer == "gamma2.2"
    assert not back.absolute
    np.testing.assert_array_equal(back.codes, sample.codes)


def test_a_list_of_pairs_and_directions_with_decimals_survive(tmp_path, rng):
    directions = rng.normal(size=(5, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.1
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    codes = rng.random((5, 4, 6, 3)).astype(np.float16)
    sample = Sample(codes, directions, directions[::-1], np.arange(5), [1, 0, 2, 4, 3])
    write_ubo(tmp_path / "set", sample, ".exr")
    back = read_back(tmp_path / "set", tmp_path / "s.npz", pairs=True)
    for pair in range(5):
        light = directions[sample.light_index[pair]]
        at = np.argmax(back.light_directions[back.light_index] @ light)
        view = back.view_directions[back.view_index[at]]
        np.testing.assert_allclose(back.light_directions[back.light_index[at]], light, atol=3e-8)
        np.testing.assert_allclose(view, directions[::-1][sample.view_index[pair]], atol=3e-8)
        np.testing.assert_array_equal(back.codes[at], codes[pair])


def test_the_number_of_threads_never_shows(tmp_path, make_sample):
    sample = make_sample(40, 50, scale=3.0)
    for threads in (1, 3):
        write_ubo(tmp_path / f"{threads}.zip", sample, ".png", threads=threads)
    assert (tmp_path / "1.zip").read_bytes() == (tmp_path / "3.zip").read_bytes()


def test_bonns_first_names_are_bonns(tmp_path, make_sample):
    write_ubo(tmp_path / "set", make_sample(2, 2, lights=bonn81(), views=bonn81()[:9]), ".png")
    assert (tmp_path / "set/tv030_pv030/00008 tl000 pl000 tv030 pv030.png").is_file()


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path, make_sample):
    sample = make_sample(2, 2, scale=1e6)
    for suffix, options, match in (
        (".exr", {}, "beyond half"),
        (".gif", {}, "ending in"),
        (".exr", {"precision": "double"}, "precision"),
    ):
        with pytest.raises(InputError, match=match):
            write_ubo(tmp_path / "set", sample, suffix, **options)
    assert list(tmp_path.iterdir()) == []
    sample.codes[3, 0, 0, 0] = np.nan
    with pytest.raises(InputError, match="non-finite"):
        write_ubo(tmp_path / "set", sample, ".png")
    (tmp_path / "set").mkdir()
    with pytest.raises(InputError, match="not written by btfpipe"):
        write_ubo(tmp_path / "set", make_sample(2, 2), ".png")


def test_a_model_is_written_as_its_pictures(tmp_path, rng):
    codes = rng.integers(0, 256, (5, 6, 3, 6), np.uint8)
    model = RelightingModel(codes, np.ones(6) / 600, np.zeros(6), None, "ptm", "srgb")
    write_ubo(tmp_path / "set", model, ".png")
    back = read_back(tmp_path / "set", tmp_path / "s.npz")
    expected = model.pictures([0, 40, 80])
    assert expected.max() > 1
    np.testing.assert_allclose(back.pictures([0, 40, 80]), expected, atol=0.01)
    assert not back.absolute


def test_values_beyond_half_precision_are_refused_with_a_way_out(tmp_path, make_sample):
    sample = make_sample(4, 4, scale=1e6)
    with pytest.raises(InputError, match=r"beyond half precision.*write \.png"):
        write_ubo(tmp_path / "set", sample, ".exr")
    write_ubo(tmp_path / "set", sample, ".png")
    with ubo.open_measurement(tmp_path / "set") as measurement:
        codes = np.stack([measurement.read(pair) for pair in range(measurement.n_pairs)])
    assert 250 <= codes.max() <= 255
