"""The command: what it writes, that it repeats itself, and what it refuses."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

from btfpipe.formats.images import read_picture, write_picture
from btfpipe.formats.ubo import parse_name
from btfpipe.sample import Sample
from btfpipe.simulation.campaign import require_memory
from btfpipe.simulation.materials import build_patch
from btfpipe.simulation.spec import read_spec

DATA = Path(__file__).parents[2] / "data-sample"


def pictures(path):
    """Decoded pictures of a zip by ((theta, phi) of the light, of the view)."""
    with zipfile.ZipFile(path) as archive:
        members = {parse_name(Path(name).name): name for name in archive.namelist()}
        return {
            angles: read_picture(archive.read(name), name)
            for angles, name in members.items()
            if angles is not None
        }


def test_same_seed_same_bytes_for_one_and_two_threads(btfpipe, write_spec, tmp_path):
    spec = write_spec(
        parts={"ground": {"albedo": "#806040", "f0": 0.1}, "bump": {"albedo": "#ccc0a0", "f0": 0.5}}
    )
    for name, threads, seed in (("a", 1, 0), ("b", 2, 0), ("c", 2, 1)):
        btfpipe("simulate", spec, "-o", tmp_path / f"{name}.zip", "-t", threads, "--seed", seed)
    a, b, c = ((tmp_path / f"{name}.zip").read_bytes() for name in "abc")
    assert a == b
    assert a != c  # other light paths


def test_little_memory_gives_the_same_pictures_in_another_order(btfpipe, write_spec, tmp_path):
    spec = write_spec()
    summary = btfpipe(
        "simulate", spec, "-o", tmp_path / "a.zip", "--format", "exr", "--json"
    ).stdout
    assert json.loads(summary)["pictures"] == 6
    # room for the geometry and the tables of one or two lights, not of three
    patch = build_patch(read_spec(spec), None)
    memory = require_memory(patch, 8, 1 << 40) + 2 * 13 * len(patch.normals)
    btfpipe("simulate", spec, "-o", tmp_path / "b.zip", "--format", "exr", "--memory", memory)
    a, b = pictures(tmp_path / "a.zip"), pictures(tmp_path / "b.zip")
    assert list(a) != list(b)
    assert a.keys() == b.keys()
    for angles, picture in a.items():
        np.testing.assert_array_equal(picture, b[angles])
    for little in (1000, require_memory(patch, 8, 1 << 40) + 100):
        done = btfpipe("simulate", spec, "-o", tmp_path / "c.zip", "--memory", little, code=3)
        assert "--memory" in done.stderr
        assert not (tmp_path / "c.zip").exists()


@pytest.mark.parametrize("file_format", ["jpeg", "png", "exr"])
def test_ingest_brings_back_values_scale_and_period(btfpipe, write_spec, tmp_path, file_format):
    spec = write_spec(
        largest_value=2.0,
        parts={"ground": {"albedo": [0.5, 0.4, 0.3]}, "bump": {"albedo": [0.1, 0.2, 0.3]}},
    )
    btfpipe("simulate", spec, "-o", tmp_path / "set", "--format", file_format, "--quality", 100)
    btfpipe("ingest", tmp_path / "set", "-o", tmp_path / "s.sample.npz")
    btfpipe("simulate", spec, "-o", tmp_path / "truth.zip", "--format", "exr")
    sample, truth = Sample.open(tmp_path / "s.sample.npz"), pictures(tmp_path / "truth.zip")
    assert sample.is_product
    assert sample.toroidal
    assert sample.absolute
    assert sample.texels_per_mm == 4
    assert (len(sample.view_directions), len(sample.light_directions)) == (2, 3)
    got = sample.pictures(slice(None))
    tolerance = {"jpeg": 0.05, "png": 0.01, "exr": 1e-3}[file_format]
    for light, view in ((0, 0), (2, 1)):
        angles = [(0.0, 0.0), (30.0, 90.0), (60.0, 200.0)][light], [(0.0, 0.0), (40.0, 20.0)][view]
        np.testing.assert_allclose(got[view * 3 + light], truth[angles], atol=tolerance)


def test_table_of_pairs_gives_truth_at_any_direction(btfpipe, write_spec, tmp_path):
    spec, table = write_spec(), tmp_path / "pairs.csv"
    table.write_text(
        "# unmeasured\ntheta_v_deg, phi_v_deg, theta_i_deg, phi_i_deg\n"
        "40,20,30,90\n12.5,301.25,47.125,7.5\n40,20,61,0\n"
    )
    btfpipe("simulate", spec, "--directions", table, "--format", "exr", "-o", tmp_path / "t.zip")
    btfpipe("simulate", spec, "--format", "exr", "-o", tmp_path / "all.zip")
    truth, measured = pictures(tmp_path / "t.zip"), pictures(tmp_path / "all.zip")
    assert set(truth) == {
        ((30.0, 90.0), (40.0, 20.0)), ((47.125, 7.5), (12.5, 301.25)), ((61.0, 0.0), (40.0, 20.0)),
    }  # fmt: skip
    same = ((30.0, 90.0), (40.0, 20.0))
    np.testing.assert_array_equal(truth[same], measured[same])
    btfpipe("ingest", tmp_path / "t.zip", "--pairs", "-o", tmp_path / "t.sample.npz")
    assert Sample.open(tmp_path / "t.sample.npz").n_pairs == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sampels": 4}, "sampels"),
        ({"samples": 0}, "samples: 0 is less"),
        ({"samples": 4.0}, "samples: 4.0 is not of type 'integer'"),
        ({"texels_per_mm": 1e-300}, "texels_per_mm: 1e-300 is less"),
        (
            {"structure": {"bumps": {"count": [2, 2], "height_mm": 1000}}},
            "spec.yaml: structure: height_mm of bumps is 1000 over a tile of 3 x 3 mm",
        ),
        (
            {
                "structure": {
                    "weave": {"warp": 2, "weft": 2, "thickness_mm": 0.3, "pattern": [[1, 0], [0]]}
                }
            },
            "rows of weave's pattern differ in length",
        ),
        ({"texels": "big"}, "texels"),
        ({"structure": {"weave": {"warp": 4, "thickness_mm": 1}}}, "structure.weave: 'weft'"),
        ({"structure": {}}, "structure"),
        ({"parts": {"ground": {"albedo": "#806040"}}}, "spec.yaml: parts: no material for 'bump'"),
        (
            {"parts": {"ground": {"albedo": "brown"}, "bump": {"albedo": "#ffffff"}}},
            "ground.albedo",
        ),
        (
            {"parts": {k: {"albedo": "#102030"} for k in ("ground", "bump", "thread")}},
            "'thread' is not a part of bumps",
        ),
        ({"directions": {"views": [[0, 0]], "lights": [[90, 0]]}}, "theta 90"),
        ({"directions": {"views": [[0, 0], [0, 50]], "lights": [[3, 0]]}}, "0 and 1 are the same"),
        (
            {
                "structure": {"picture": {"file": "no.png", "height_mm": 1}},
                "parts": {"surface": {"albedo": "#ffffff"}},
            },
            "no such file",
        ),
        (
            {"structure": {"obj": {"file": "no.obj"}}, "parts": {"default": {"albedo": "#ffffff"}}},
            "no.obj: cannot be read",
        ),
    ],
)
def test_bad_specification_is_refused_by_key_and_nothing_is_written(
    btfpipe, write_spec, tmp_path, changes, words
):
    done = btfpipe("simulate", write_spec(**changes), "-o", tmp_path / "out.zip", code=3)
    assert words in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["spec.yaml"]


def test_specification_that_is_no_yaml_is_refused(btfpipe, tmp_path):
    path = tmp_path / "spec.yaml"
    for text, words in (
        ("texels: [1, ", "not YAML"),
        ("- a list", "not of type 'object'"),
        ("", "empty; expected a specification"),
        ("texels: 8\ntexels: 9", "the key 'texels' is given twice, in lines 1 and 2"),
        ("texels: [8, .inf]", "texels[1] is inf; expected a finite number"),
    ):
        path.write_text(text)
        assert words in btfpipe("simulate", path, "-o", tmp_path / "o.zip", code=3).stderr
    path.write_bytes(b"\xff\xfe\x00")
    assert "binary file" in btfpipe("simulate", path, "-o", tmp_path / "o.zip", code=3).stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n1,2\n", "has the columns a, b"),
        ("theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n", "no pairs"),
        ("theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n1,2,3,x\n", "not a number"),
        ("theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n1,2,3\n", "not a number"),
        ("theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n1,2,95,0\n", "theta_v_deg 95"),
        ("theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n1,2,3,4\n1,2,3,364\n", "occurs twice"),
    ],
)
def test_bad_table_of_pairs_is_refused(btfpipe, write_spec, tmp_path, text, words):
    table = tmp_path / "pairs.csv"
    table.write_text(text)
    out = tmp_path / "out.zip"
    done = btfpipe("simulate", write_spec(), "--directions", table, "-o", out, code=3)
    assert words in done.stderr
    assert not out.exists()


def test_folder_that_simulate_did_not_write_is_left_alone(btfpipe, write_spec, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "holiday.jpg").write_bytes(b"precious")
    done = btfpipe("simulate", write_spec(), "-o", folder, "--force", code=3)
    assert "not written by btfpipe" in done.stderr
    assert [path.name for path in folder.iterdir()] == ["holiday.jpg"]
    spec, out = write_spec(), tmp_path / "set"
    btfpipe("simulate", spec, "-o", out)
    names = sorted(path.name for path in out.iterdir())
    (out / "old").mkdir()
    btfpipe("simulate", spec, "-o", out, "--force")
    assert sorted(path.name for path in out.iterdir()) == names == [
        "btfpipe.json", "tv000_pv000", "tv040_pv020"
    ]  # fmt: skip


def test_pictures_named_by_the_specification_are_read_beside_it(btfpipe, write_spec, tmp_path):
    ramp = np.linspace(0, 65535, 16).astype(np.uint16)
    write_picture(tmp_path / "height.png", np.tile(ramp, (16, 1)))
    colour = np.zeros((2, 2, 3), np.uint8)
    colour[0] = 255  # the upper half is white
    write_picture(tmp_path / "colour.png", colour)
    spec = write_spec(
        directions={"views": [[0, 0]], "lights": [[60, 0], [60, 180]]},
        structure={"picture": {"file": "height.png", "height_mm": 1.5}},
        parts={"surface": {"albedo": {"picture": "colour.png"}, "roughness": {"picture": "colour.png"}}},
    )  # fmt: skip
    btfpipe("simulate", spec, "--format", "exr", "-o", tmp_path / "o.zip")
    got = pictures(tmp_path / "o.zip")
    right, left = (got[(60.0, phi), (0.0, 0.0)].astype(float) for phi in (0.0, 180.0))
    # the ramp rises to the right, so it faces the light at the left
    assert left[:6, 2:9].mean() > 2 * right[:6, 2:9].mean()
    assert left[2:4].mean() > 3 * left[8:10].mean()


@pytest.mark.parametrize("name", ["weave", "cords"])
def test_committed_set_equals_a_fresh_simulation_within_two_grey_levels(btfpipe, tmp_path, name):
    """A few pairs of each set, at the 99.9 % quantile; machines may differ in rounding."""
    table = tmp_path / "pairs.csv"
    table.write_text(
        "theta_i_deg,phi_i_deg,theta_v_deg,phi_v_deg\n0,0,0,0\n60,72,0,0\n75,180,60,36\n30,240,60,36\n"
        "60,72,75,90\n30,240,75,90\n"
    )
    btfpipe("simulate", DATA / f"{name}.yaml", "--directions", table, "-o", tmp_path / "new.zip")
    committed, fresh = pictures(DATA / f"{name}.zip"), pictures(tmp_path / "new.zip")
    assert len(fresh) == 6
    # JPEG turns a last digit that rounds otherwise into several grey levels, in the few blocks where that happens
    error = [np.abs(picture.astype(int) - committed[angles]) for angles, picture in fresh.items()]
    assert np.quantile(error, 0.999) <= 2


def test_committed_sets_are_small_and_whole():
    spec = yaml.safe_load((DATA / "weave.yaml").read_text())
    assert spec["directions"] == "bonn25"
    assert sum((DATA / f"{name}.zip").stat().st_size for name in ("weave", "cords")) < 6e6
    for name in ("weave", "cords"):
        with zipfile.ZipFile(DATA / f"{name}.zip") as archive:
            assert len(archive.namelist()) == 626
            assert json.loads(archive.read("btfpipe.json"))["toroidal"] is True
