import json
import os
from pathlib import Path

import numpy as np
import pytest

from btfpipe import store
from btfpipe.directions import from_angles
from btfpipe.formats.images import encode_picture, write_picture
from btfpipe.sample import Sample
from btfpipe.sample.describe import describe_sample


@pytest.fixture
def info(btfpipe):
    """What `info --json` says of a file."""

    def run(path):
        return json.loads(btfpipe("info", path, "--json").stdout)

    return run


def test_a_sample_is_explained(info, make_sample, tmp_path):
    make_sample(
        dtype=np.uint8, transfer="srgb", toroidal=True, texels_per_mm=3.0, scale=2.0, absolute=True
    ).save(tmp_path / "s.npz")
    said = info(tmp_path / "s.npz")
    assert said["kind"] == "sample"
    assert said["problems"] == []
    sample = said["sample"]
    assert (sample["rows"], sample["cols"], sample["pairs"]) == (16, 20, 19 * 7)
    assert sample["views"] == {"number": 7, "set": None, "rings_deg": {"0": 1, "15": 6}}
    assert (sample["transfer"], sample["scale"], sample["texels_per_mm"]) == ("srgb", 2, 3)
    assert sample["toroidal"]
    assert sample["product"]
    assert sample["absolute_scale"] == "known"


def test_bonns_directions_are_known(info, make_sample, tmp_path):
    from btfpipe.directions import bonn81, ubo2014

    make_sample(2, 2, lights=bonn81(), views=ubo2014()).save(tmp_path / "s.npz")
    sample = info(tmp_path / "s.npz")["sample"]
    assert sample["lights"]["set"] == "Bonn's 81"
    assert sample["views"]["set"] == "UBO2014's 151"


def test_clipped_values_are_counted(info, make_sample, tmp_path):
    sample = make_sample(dtype=np.uint8)
    codes = np.minimum(sample.codes, 254)
    codes[3, 2, 1, 0] = codes[5, :2, 0, 2] = 255
    sample.codes = codes
    sample.save(tmp_path / "s.npz")
    assert info(tmp_path / "s.npz")["sample"]["clipped_values"] == 3


def test_values_that_are_not_finite_are_a_problem(info, make_sample, tmp_path):
    sample = make_sample()
    sample.codes[3, 2, 1, 0] = np.nan
    sample.codes[5, :2, 0, 2] = np.inf
    sample.save(tmp_path / "s.npz")
    said = info(tmp_path / "s.npz")
    assert said["arrays"]["pictures"]["not_finite"] == 3
    assert said["problems"] == ["pictures holds 3 NaN or infinite values."]


def test_missing_and_double_pairs_are_named(info, make_sample, tmp_path):
    full = make_sample(4, 4)
    keep = [0, 0, *range(2, full.n_pairs)]
    Sample(
        full.codes[keep],
        full.light_directions,
        full.view_directions,
        full.light_index[keep],
        full.view_index[keep],
    ).save(tmp_path / "s.npz")
    said = info(tmp_path / "s.npz")
    assert (said["sample"]["missing_pairs"], said["sample"]["duplicate_pairs"]) == (1, 1)
    assert any("view 0 light 1" in problem for problem in said["problems"])
    assert any("twice" in problem for problem in said["problems"])


def scattered(count, side=2):
    """A list of as many lights and views as pairs."""
    rng = np.random.default_rng(4)
    lights, views = (
        from_angles(rng.uniform(0, 1.4, count), rng.uniform(0, 6, count)) for _ in range(2)
    )
    codes = rng.integers(0, 255, (count, side, side, 3), np.uint8)
    return Sample(codes, lights, views, np.arange(count), np.arange(count))


@pytest.mark.parametrize("format_", [None, "pairs", "ubo", "utia"])
def test_a_list_of_pairs_is_a_fact_and_no_problem(btfpipe, info, tmp_path, format_):
    path = tmp_path / "s.npz"
    scattered(12).save(path)
    if format_:
        btfpipe("export", path, "--format", format_, "-o", tmp_path / "set.zip")
        path = tmp_path / "set.zip"
    said = info(path)
    assert said["problems"] == []
    said = said.get("sample", said)
    assert (said["arrangement"], said["product"]) == ("list of pairs", False)
    assert said["missing_pairs"] is None


@pytest.mark.parametrize(
    ("lost", "arrangement"), [(13, "views times lights"), (14, "list of pairs")]
)
def test_a_product_that_lacks_more_than_a_tenth_is_a_list(
    info, make_sample, tmp_path, lost, arrangement
):
    full = make_sample(2, 2)
    assert full.n_pairs == 133
    Sample(
        full.codes[lost:],
        full.light_directions,
        full.view_directions,
        full.light_index[lost:],
        full.view_index[lost:],
    ).save(tmp_path / "s.npz")
    said = info(tmp_path / "s.npz")
    assert said["sample"]["arrangement"] == arrangement
    assert len(said["problems"]) == (arrangement != "list of pairs")


def test_a_list_of_positions_is_described_in_little_memory(peak_bytes):
    with peak_bytes() as peak:
        assert describe_sample(scattered(1500))["pairs"] == 1500
    assert peak[0] < 4 << 20


@pytest.mark.parametrize("kind", ["model", "features", "surface", "map"])
def test_every_kind_of_our_own_is_described(info, tmp_path, kind):
    store.write(
        tmp_path / "x.npz", kind, {"values": np.array([1.0, np.nan]), "n": np.arange(3)}, seed=5
    )
    said = info(tmp_path / "x.npz")
    assert said["kind"] == kind
    assert said["about"]["seed"] == 5
    assert said["arrays"]["n"] == {"shape": [3], "dtype": "int64"}
    assert said["problems"] == ["values holds 1 NaN or infinite values."]


def test_a_damaged_array_is_a_problem_and_the_rest_is_still_described(info, make_sample, tmp_path):
    path = tmp_path / "s.npz"
    make_sample().save(path)
    data = path.read_bytes()
    place = data.rindex(b"\x93NUMPY")
    path.write_bytes(data[:place] + b"XXXXXX" + data[place + 6 :])
    said = info(path)
    assert "pictures" in said["problems"][0]
    assert "light_index" in said["arrays"]


def test_a_set_is_explained_with_all_that_is_wrong(info, make_measurement):
    def change(members):
        names = list(members)
        members["again tl000 pl000 tv000 pv360.png"] = members[names[0]]
        members["readme.txt"] = b"x"
        del members[names[1]]
        members[names[2]] = members[names[2]][:50]
        members[names[3]] = encode_picture(np.full((9, 5, 3), 255, np.uint8), ".png")

    path, _ = make_measurement(change=change)
    said = info(path)
    assert said["kind"] == "UBO2003 set"
    assert (said["pairs"], said["missing_pairs"], said["duplicate_pairs"]) == (5, 1, 1)
    assert said["ignored"] == ["readme.txt"]
    assert said["clipped_values"] == 9 * 5 * 3
    assert said["lights"]["rings_deg"] == {"0": 1, "30": 2}
    problems = "\n".join(said["problems"])
    for words in ("1 pictures cannot be read", "truncated", "tl30 pl0 tv0 pv0", "twice", "9 x 5"):
        assert words in problems


def test_a_sound_set_has_no_problems(info, make_measurement):
    said = info(make_measurement("folder", suffix=".exr", dtype=np.float16)[0])
    assert said["problems"] == []
    assert (said["rows"], said["cols"], said["stored_as"]) == (6, 8, "float16")


def test_values_that_are_not_finite_in_a_set_are_named(info, make_measurement):
    def change(members):
        picture = np.ones((6, 8, 3), np.float16)
        picture[0, 0, 0] = np.inf
        members[list(members)[2]] = encode_picture(picture, ".exr")

    path, _ = make_measurement(suffix=".exr", dtype=np.float16, change=change)
    (problem,) = info(path)["problems"]
    assert "tl030 pl090 tv000 pv000.exr: 1 NaN or infinite" in problem


def test_layers_of_an_exr_are_told_apart(info, tmp_path):
    values = np.zeros((4, 5, 5), np.float32)
    values[..., 3] = 2
    values[1, 1, 4] = np.nan
    write_picture(tmp_path / "a.exr", values, names=["R", "G", "B", "depth.Z", "normal.X"])
    said = info(tmp_path / "a.exr")
    assert (said["kind"], said["rows"], said["cols"]) == ("picture", 4, 5)
    assert said["layers"]["colour"]["channels"] == ["R", "G", "B"]
    assert said["layers"]["depth"]["greatest"] == 2
    assert said["problems"] == ["layer normal: 1 NaN or infinite values."]


def test_a_mislabelled_picture_is_a_problem(info, tmp_path, rng):
    (tmp_path / "a.jpg").write_bytes(
        encode_picture(rng.integers(0, 9, (4, 4, 3), np.uint8), ".png")
    )
    said = info(tmp_path / "a.jpg")
    assert said["format"] == "png"
    assert "png" in said["problems"][0]


def test_a_mesh_is_described(info, tmp_path):
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 2)]
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
    text = [f"v {x} {y} {z}" for x, y, z in corners]
    text += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (tmp_path / "a.obj").write_text("\n".join(text))
    said = info(tmp_path / "a.obj")
    assert (said["kind"], said["vertices"], said["faces"]) == ("mesh", 4, 4)
    assert (said["components"], said["boundary_loops"], said["genus"]) == (1, 0, 0)
    assert said["greatest"] == [1, 1, 2]
    assert said["problems"] == []
    (tmp_path / "b.obj").write_text("\n".join(text[:4]))
    assert "no faces" in info(tmp_path / "b.obj")["problems"][0]
    (tmp_path / "c.obj").write_text("\n".join([*text, "v 3 3 3", "f 1 2 5"]))
    fin = info(tmp_path / "c.obj")
    assert (fin["components"], fin["boundary_loops"], fin["problems"]) == (2, 1, [])
    assert fin["repairs"]["parted_edges"] == 1
    (tmp_path / "d.obj").write_text("\n".join([*text[:4], "v nan 0 0", "f 1 2 5"]))
    assert "not finite" in info(tmp_path / "d.obj")["problems"][0]


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("a.bin", b"\x00\x01\x02", "unknown"),
        ("empty.jpg", b"", "unknown"),
        ("cut.zip", b"PK\x03\x04 and no more", "zip"),
        ("notes.txt", b"hello", "unknown"),
    ],
)
def test_what_is_unknown_or_damaged_is_said_to_be_so(info, tmp_path, name, data, kind):
    (tmp_path / name).write_bytes(data)
    said = info(tmp_path / name)
    assert said["kind"] == kind
    assert name in said["problems"][0]


def test_folders_and_zips_of_something_else_are_said_to_be_so(info, tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    said = info(tmp_path)
    assert (said["kind"], said["files"]) == ("folder", 1)
    np.savez(tmp_path / "numpy.npz", x=np.zeros(3))
    assert info(tmp_path / "numpy.npz")["kind"] == "zip"


def test_without_json_a_person_reads_it_on_stdout(btfpipe, make_sample, make_measurement, tmp_path):
    make_sample().save(tmp_path / "s.npz")
    result = btfpipe("info", tmp_path / "s.npz")
    assert result.stderr == ""
    assert result.stdout.startswith(f"{tmp_path / 's.npz'}:\n  kind: sample\n")
    assert "rings deg: 0 1, 15 6\n" in result.stdout
    assert result.stdout.endswith("problems: none\n")
    path, _ = make_measurement(change=lambda m: m.pop(next(iter(m))))
    assert (
        "  - 1 of 6 view/light pairs are missing (tl0 pl0 tv0 pv0)" in btfpipe("info", path).stdout
    )


def test_a_newer_file_is_refused(btfpipe, tmp_path, monkeypatch):
    monkeypatch.setattr(store, "FORMAT_VERSION", store.FORMAT_VERSION + 1)
    store.write(tmp_path / "a.npz", "sample", {})
    monkeypatch.undo()
    assert "newer btfpipe" in btfpipe("info", tmp_path / "a.npz", code=3).stderr


@pytest.mark.parametrize("scale", [np.nan, np.inf, 0.0, -1.0])
def test_a_scale_that_is_no_positive_number_is_a_problem(info, make_sample, tmp_path, scale):
    make_sample(scale=scale).save(tmp_path / "s.npz")
    (problem,) = info(tmp_path / "s.npz")["problems"]
    assert f"scale is {scale}; expected a positive number" in problem


def test_what_is_no_file_in_a_folder_is_a_stray(info, make_measurement):
    path, _ = make_measurement("folder")
    (path / "tl000 pl000 tv075 pv000.png").symlink_to("gone")
    (path / "tl000 pl000 tv075 pv090.png").mkdir()
    (path / "deeper").mkdir()
    said = info(path)
    assert said["problems"] == []
    assert said["pairs"] == 6
    assert sorted(said["ignored"]) == ["tl000 pl000 tv075 pv000.png", "tl000 pl000 tv075 pv090.png"]


def test_a_folder_that_cannot_be_listed_is_one_clear_sentence(
    btfpipe, make_measurement, monkeypatch
):
    path, _ = make_measurement("folder")
    (path / "closed").mkdir()
    real = os.scandir

    def scandir(where):
        if str(where).endswith("closed"):
            raise PermissionError(13, "Permission denied", str(where))
        return real(where)

    monkeypatch.setattr(os, "scandir", scandir)
    done = btfpipe("info", path, code=3)
    assert f"{path / 'closed'}: cannot be read (Permission denied)" in done.stderr


def test_a_file_that_vanishes_while_a_folder_is_listed_is_named(
    btfpipe, make_measurement, monkeypatch
):
    path, _ = make_measurement("folder")
    real = Path.stat

    def stat(self, **kwargs):
        if self.name.startswith("00003"):
            raise FileNotFoundError(2, "No such file or directory", str(self))
        return real(self, **kwargs)

    monkeypatch.setattr(Path, "stat", stat)
    done = btfpipe("info", path, code=3)
    assert "00003" in done.stderr
    assert "cannot be read (No such file or directory)" in done.stderr


@pytest.mark.parametrize("format_", ["utia", "pairs", "rti", "btf"])
def test_sets_of_every_format_are_described(btfpipe, make_sample, tmp_path, format_):
    from btfpipe.directions import bonn81

    make_sample(12, 10, lights=bonn81()[:7], views=bonn81()[:3]).save(tmp_path / "s.npz")
    path = tmp_path / ("s.btf" if format_ == "btf" else "set.zip")
    btfpipe("export", tmp_path / "s.npz", "--format", format_, "-o", path)
    facts = json.loads(btfpipe("info", path, "--json").stdout)
    assert facts["kind"] == f"{format_} source"
    assert facts["because"]
    assert (facts["rows"], facts["cols"]) == (12, 10)
    assert facts["pairs"] == (7 if format_ == "rti" else 21)
    assert facts["lights"]["number"] == 7
    assert facts["problems"] == [] or format_ == "utia"


def test_a_damaged_set_is_described_by_what_is_wrong(btfpipe, make_sample, tmp_path):
    make_sample(6, 6).save(tmp_path / "s.npz")
    btfpipe("export", tmp_path / "s.npz", "--format", "btf", "-o", tmp_path / "s.btf")
    (tmp_path / "cut.btf").write_bytes((tmp_path / "s.btf").read_bytes()[:-100])
    facts = json.loads(btfpipe("info", tmp_path / "cut.btf", "--json").stdout)
    assert len(facts["problems"]) == 1
    assert "cut.btf" in facts["problems"][0]


@pytest.mark.parametrize("method", ["coded", "local-pca", "svd"])
@pytest.mark.parametrize("table", ["light_index", "view_index"])
def test_a_model_with_a_wrong_index_is_refused_like_a_sample(
    btfpipe, make_sample, tmp_path, method, table
):
    from btfpipe.compression import compress as make_model

    sample = make_sample(8, 8)
    some = Sample(
        sample.codes[:100], sample.light_directions, sample.view_directions,
        sample.light_index[:100], sample.view_index[:100],
    )  # fmt: skip
    path = tmp_path / "m.npz"
    make_model([some], method).save(path)
    assert "problems: none" in btfpipe("info", path).stdout
    reader = store.read(path)
    arrays = {name: np.array(reader[name]) for name in reader.names()}
    arrays[table][3] = 9999
    about = {k: v for k, v in reader.about.items() if k not in ("kind", "format", "btfpipe")}
    store.write(path, "model", arrays, **about)
    message = f"m.npz: {table} runs from 0 to 9999 over 100 pairs"
    assert message in btfpipe("info", path).stdout
    assert message in btfpipe("preview", path, "-o", tmp_path / "p.png", code=3).stderr


def test_a_crop_is_written_as_its_option_and_keys_as_words(btfpipe, make_measurement, tmp_path):
    path, _ = make_measurement()
    btfpipe("ingest", path, "--crop", 0, 1, 4, 5, "-o", tmp_path / "s.npz")
    said = btfpipe("info", tmp_path / "s.npz").stdout
    assert "      crop: 0 1 4 5\n" in said
    assert "      source size: 6 x 8\n" in said
    assert "    light_directions: shape 3 x 3, dtype float64, not finite 0\n" in said
    keys = [line.partition(":")[0] for line in said.splitlines()[1:]]
    arrays = store.read(tmp_path / "s.npz").names()
    assert {key.strip() for key in keys if "_" in key} == {name for name in arrays if "_" in name}


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.yaml", "objects: []\nlights: []\n", "a scene, which `btfpipe render` reads"),
        ("a.yml", "structure: {}\n", "a specification, which `btfpipe simulate` reads"),
        ("a.yaml", "strokes: []\n", "strokes, which `btfpipe surface --field` reads"),
        ("a.json", '{"comparisons": {}}', "a report of `btfpipe compare`"),
        (
            "a.yaml",
            "other: 1\n",
            "nothing that btfpipe reads; none of its keys is objects, structure",
        ),
    ],
)
def test_descriptions_are_told_from_pictures(btfpipe, info, tmp_path, name, text, what):
    (tmp_path / name).write_text(text)
    said = info(tmp_path / name)
    assert (said["kind"], said["problems"]) == ("description", [])
    assert said["what"].startswith(what)


def test_a_description_that_is_not_yaml_is_a_problem(info, tmp_path):
    (tmp_path / "a.yaml").write_text("a: [1\n")
    assert "not YAML" in info(tmp_path / "a.yaml")["problems"][0]


@pytest.mark.parametrize("text", ["{", "[1, 2]", '{"x": 1}', "[" * 100_000])
def test_other_json_is_taken_for_a_list_of_directions(info, tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    assert info(tmp_path / "a.json")["kind"] == "pairs source"
