import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from btfpipe import store
from btfpipe.formats.images import encode_picture, write_picture
from btfpipe.sample import Sample


def nth(members, part):
    return next(name for name in members if part in name)


def truncate(members):
    name = nth(members, "tl030 pl090 tv045")
    members[name] = members[name][: len(members[name]) // 2]


def empty(members):
    members[nth(members, "tl030 pl090 tv045")] = b""


def text(members):
    members[nth(members, "tl030 pl090 tv045")] = b"this was a picture once"


def other_size(members):
    members[nth(members, "tl030 pl090 tv045")] = encode_picture(
        np.zeros((9, 5, 3), np.uint8), ".png"
    )


def missing(members):
    del members[nth(members, "tl030 pl090 tv045")]


def twice(members):
    members["again/TL30_PL90_TV45_PV180.png"] = members[nth(members, "tl030 pl090 tv045")]


def outside(members):
    members["../../etc/tl030 pl180 tv045 pv180.png"] = b"x"


def no_pictures(members):
    members.clear()
    members["readme.txt"] = b"later"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (truncate, ["tl030 pl090 tv045", "truncated"]),
        (empty, ["tl030 pl090 tv045", "empty"]),
        (text, ["tl030 pl090 tv045", "not a readable picture"]),
        (other_size, ["tl030 pl090 tv045", "9 x 5", "6 x 8", "tl000 pl000 tv000"]),
        (missing, ["tl30 pl90 tv45 pv180", "1 of 6", "--pairs"]),
        (twice, ["tl030 pl090 tv045 pv180.png", "TL30_PL90_TV45_PV180.png"]),
        (outside, ["../../etc/tl030", "outside"]),
        (
            no_pictures,
            ["readme.txt", "tl000 pl000 tv030 pv030", "name, theta_l", ".lp list", "naming it"],
        ),
    ],
)
def test_bad_sets_end_in_one_clear_sentence_and_no_file(
    btfpipe, make_measurement, tmp_path, spoil, said
):
    path, _ = make_measurement(change=spoil)
    result = btfpipe("ingest", path, "-o", tmp_path / "out" / ".." / "s.npz", code=2)
    result = btfpipe("ingest", path, "-o", tmp_path / "s.npz", "--json", code=3)
    assert result.stdout == ""
    assert result.stderr.startswith("Error: ")
    assert len(result.stderr.strip().splitlines()) == 1
    for words in said:
        assert words in result.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["set.zip"]


def test_a_truncated_zip_is_refused(btfpipe, make_measurement, tmp_path):
    path, _ = make_measurement()
    path.write_bytes(path.read_bytes()[:-100])
    assert "truncated" in btfpipe("ingest", path, "-o", tmp_path / "s.npz", code=3).stderr


def test_the_summary_counts_and_lists_strays_and_mislabelled(btfpipe, make_measurement, tmp_path):
    def change(members):
        members["notes.txt"] = b"hello"
        members["cover.jpg"] = b"hello"
        name = nth(members, "tl030 pl090 tv045")
        members[name.replace(".png", ".jpg")] = members.pop(name)

    path, codes = make_measurement(change=change)
    result = btfpipe("ingest", path, "-o", tmp_path / "s.npz", "--transfer", "srgb", "--json")
    summary = json.loads(result.stdout)
    assert summary["n_strays"] == 2
    assert summary["strays"] == ["cover.jpg", "notes.txt"]
    assert summary["n_mislabelled"] == 1
    assert (summary["toroidal"], summary["absolute"], summary["texels_per_mm"]) == (
        False,
        False,
        None,
    )
    assert summary["mislabelled"][0].endswith("tl030 pl090 tv045 pv180.jpg")
    np.testing.assert_array_equal(Sample.open(tmp_path / "s.npz").codes, codes.reshape(6, 6, 8, 3))


def test_a_plain_picture_is_a_btf_of_one_view_and_one_light(btfpipe, tmp_path, rng):
    picture = rng.integers(0, 255, (7, 9, 3), np.uint8)
    write_picture(tmp_path / "a.png", picture)
    btfpipe("ingest", tmp_path / "a.png", "-o", tmp_path / "a.npz", "--toroidal")
    sample = Sample.open(tmp_path / "a.npz")
    assert sample.toroidal
    assert sample.transfer == "srgb"
    np.testing.assert_array_equal(sample.codes[0], picture)
    for table in (sample.light_directions, sample.view_directions):
        np.testing.assert_array_equal(table, [[0, 0, 1]])


def test_a_truncated_plain_picture_is_refused(btfpipe, tmp_path, rng):
    data = encode_picture(rng.integers(0, 255, (40, 40, 3), np.uint8), ".jpg")
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2])
    result = btfpipe("ingest", tmp_path / "a.jpg", "-o", tmp_path / "a.npz", code=3)
    assert f"{tmp_path / 'a.jpg'}: truncated" in result.stderr


def test_a_file_of_our_own_is_not_ingested_again(btfpipe, make_sample, tmp_path):
    make_sample().save(tmp_path / "s.npz")
    result = btfpipe("ingest", tmp_path / "s.npz", "-o", tmp_path / "t.npz", code=3)
    assert "already a sample" in result.stderr


def test_frontal_and_size_through_the_command(btfpipe, make_measurement, tmp_path):
    path, _ = make_measurement(change=lambda m: m.popitem())  # one pair of what is no product
    btfpipe("ingest", path, "-o", tmp_path / "s.npz", "--frontal", "--size", "3x4")
    sample = Sample.open(tmp_path / "s.npz")
    assert (sample.n_pairs, sample.shape) == (1, (3, 4))


@pytest.mark.parametrize(
    "options",
    [
        ["--size", "12"],
        ["--size", "0x4"],
        ["--grey-card", "0", "0", "2", "2"],
        ["--grey-card-reflectance", "0.2"],
        ["--white", "0"],
        ["--white", "1", "--grey-card", "0", "0", "2", "2", "--grey-card-reflectance", "0.2"],
    ],
)
def test_wrong_usage_is_exit_code_2(btfpipe, make_measurement, tmp_path, options):
    path, _ = make_measurement()
    btfpipe("ingest", path, "-o", tmp_path / "s.npz", *options, code=2)
    assert not (tmp_path / "s.npz").exists()


def test_the_same_bytes_whatever_the_threads_and_the_place(btfpipe, make_measurement, tmp_path):
    path, _ = make_measurement()
    (tmp_path / "b").mkdir()
    btfpipe("ingest", path, "-o", tmp_path / "a.npz", "-t", "1")
    btfpipe("ingest", path, "-o", tmp_path / "b/other.npz", "-t", "3")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b/other.npz").read_bytes()


def run(*args):
    """The command as a process of its own."""
    return [sys.executable, "-c", "from btfpipe.cli import main; main()", *map(str, args)]


def test_a_full_disk_is_one_clear_sentence(make_measurement, tmp_path):
    path, _ = make_measurement(shape=(64, 64))
    command = run("ingest", path, "-o", tmp_path / "s.npz")
    limit = "import resource, os, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (40000, 40000)); os.execv(sys.argv[1], sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", limit, *command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 3, done.stderr
    assert "s.npz: cannot be written (File too large)" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("s.npz*"))


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a place where nobody may write")
def test_a_folder_that_takes_no_file_is_one_clear_sentence(btfpipe, make_measurement):
    path, _ = make_measurement()
    result = btfpipe("ingest", path, "-o", "/proc/s.npz", code=3)
    assert "/proc/s.npz: cannot be written" in result.stderr


def test_an_output_that_is_a_folder_is_one_clear_sentence(btfpipe, make_measurement, tmp_path):
    path, _ = make_measurement()
    (tmp_path / "s.npz").mkdir()
    result = btfpipe("ingest", path, "-o", tmp_path / "s.npz", "--force", code=3)
    assert "cannot be written (a folder is there)" in result.stderr
    assert [p.name for p in tmp_path.glob("s.npz*")] == ["s.npz"]


def test_killed_half_way_the_next_run_ends_with_the_same_bytes(make_measurement, tmp_path):
    lights = [(0, 0)] + [(theta, phi) for theta in (30, 60) for phi in range(0, 360, 6)]
    path, _ = make_measurement(lights=lights, shape=(128, 128), suffix=".jpg")
    out = tmp_path / "s.npz"

    def parts():
        return [part for part in tmp_path.glob("s.npz.*") if part.stat().st_size > 2**18]

    subprocess.run(run("ingest", path, "-o", tmp_path / "whole.npz", "-q"), check=True)

    # the victim holds still after its first block, so that the kill is certain to come half-way
    victim = (
        "import sys, time; from btfpipe.sample import ingest; from btfpipe.cli import main;"
        "real = ingest.ordered_map;"
        "ingest.ordered_map = lambda *a: (time.sleep(60) if i else x for i, x in enumerate(real(*a)));"
        "ingest._BLOCK_BYTES = 2**19; main(sys.argv[1:])"
    )
    process = subprocess.Popen([sys.executable, "-c", victim, "ingest", path, "-o", out, "-q"])
    try:
        deadline = time.monotonic() + 60
        while not parts():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert parts()
    assert not out.exists()
    subprocess.run(run("ingest", path, "-o", out, "-q"), check=True)
    assert not list(tmp_path.glob("s.npz.*"))
    assert out.read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_a_misspelt_setting_is_told_by_name(btfpipe, make_measurement, make_sample, tmp_path):
    def change(members):
        members["btfpipe.json"] = json.dumps({"whiteness": 1, "toroidal": True, "title": "cloth"})

    bonn, _ = make_measurement(change=change)
    make_sample(6, 8).save(tmp_path / "s.npz")
    sets = [bonn]
    for format_ in ("ubo", "utia", "rti", "pairs"):
        sets.append(tmp_path / format_)
        btfpipe("export", tmp_path / "s.npz", "--format", format_, "-o", sets[-1])
        done = btfpipe("ingest", sets[-1], "-o", tmp_path / "t.npz", "--force")
        assert "unknown" not in done.stderr  # what btfpipe writes itself it knows
        settings = json.loads((sets[-1] / "btfpipe.json").read_text())
        (sets[-1] / "btfpipe.json").write_text(json.dumps(settings | {"whiteness": 1}))
    for path in sets:
        done = btfpipe("ingest", path, "-o", tmp_path / "t.npz", "--force", "-q")
        assert (
            "Warning: unknown settings 'whiteness' in btfpipe.json; expected white" in done.stderr
        )
        assert "unknown settings 'whiteness' in" in btfpipe("info", path).stdout


def test_a_model_is_no_sample(tmp_path):
    from btfpipe.errors import InputError

    store.write(tmp_path / "m.npz", "model", {"x": np.zeros(3)})
    with pytest.raises(InputError, match=r"m.npz: holds a model. Expected a sample made by"):
        Sample.open(tmp_path / "m.npz")


def test_the_frontal_pair_is_taken_of_any_format(btfpipe, make_sample, tmp_path):
    from btfpipe.directions import bonn81
    from btfpipe.formats.images import write_picture
    from btfpipe.sample import Sample

    make_sample(8, 8, lights=bonn81()[:7], views=bonn81()[:3]).save(tmp_path / "s.npz")
    for format_ in ("pairs", "rti"):
        target = tmp_path / f"{format_}.zip"
        btfpipe("export", tmp_path / "s.npz", "--format", format_, "-o", target)
        btfpipe("ingest", target, "--frontal", "-o", tmp_path / f"{format_}.npz")
        sample = Sample.open(tmp_path / f"{format_}.npz")
        assert sample.n_pairs == 1
        assert sample.light_directions[0, 2] == pytest.approx(1)
    write_picture(tmp_path / "p.png", np.zeros((4, 5, 3), np.uint8))
    btfpipe("ingest", tmp_path / "p.png", "--frontal", "-o", tmp_path / "p.npz")
    assert Sample.open(tmp_path / "p.npz").shape == (4, 5)


def test_a_cosine_that_was_divided_out_is_multiplied_in(btfpipe, make_sample, tmp_path):
    from btfpipe.directions import bonn81
    from btfpipe.sample import Sample

    sample = make_sample(6, 8, lights=bonn81()[:19], views=bonn81()[:3])
    cosine = sample.light_directions[sample.light_index, 2]
    divided = Sample(
        (sample.codes / cosine[:, None, None, None]).astype(np.float32), sample.light_directions,
        sample.view_directions, sample.light_index, sample.view_index,
    )  # fmt: skip
    for name, some in (("inside", sample), ("divided", divided)):
        some.save(tmp_path / f"{name}.npz")
        for format_ in ("pairs", "ubo"):
            target = tmp_path / f"{name}.{format_}.zip"
            btfpipe("export", tmp_path / f"{name}.npz", "--format", format_, "--suffix", ".exr", "-o", target)  # fmt: skip
            out = tmp_path / f"{name}.{format_}.npz"
            done = btfpipe("ingest", target, "--cosine", name, "--json", "-o", out)
            assert ("multiplied in" in done.stdout) == (name == "divided")
            found = Sample.open(out)
            np.testing.assert_allclose(
                found.pictures(slice(None)), sample.pictures(slice(None)), rtol=2e-3, atol=1e-6
            )
    btfpipe("ingest", target, "--cosine", "divided", "--frontal", "-o", tmp_path / "one.npz")
    assert Sample.open(tmp_path / "one.npz").n_pairs == 1


def test_the_cosine_flag_of_a_model_file_is_overruled(btfpipe, make_sample, tmp_path):
    from btfpipe.compression import open_appearance

    make_sample(6, 8).save(tmp_path / "s.npz")
    btfpipe("export", tmp_path / "s.npz", "--format", "btf", "-o", tmp_path / "s.btf")
    for name in ("inside", "divided"):
        btfpipe("ingest", tmp_path / "s.btf", "--cosine", name, "-o", tmp_path / f"{name}.npz")
    one, other = (open_appearance(tmp_path / f"{name}.npz") for name in ("inside", "divided"))
    cosine = one.light_directions[one.light_index, 2][:, None, None, None]
    np.testing.assert_allclose(
        other.pictures(slice(None)), one.pictures(slice(None)) * cosine, rtol=1e-3, atol=1e-5
    )
