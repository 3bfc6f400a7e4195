"""btfpipe's own files with a part spoilt: every command refuses them in one line, and `info` says what is wrong."""

import re

import numpy as np
import pytest

from btfpipe import store
from btfpipe.analysis.pyramid import plain_features
from btfpipe.compression import compress, open_appearance
from btfpipe.compression.relighting import RelightingModel
from btfpipe.surface import Surface
from btfpipe.surface.surface import Level
from btfpipe.synthesis import CoordinateMap

OPTIONS = {"svd": {"components": 2}, "factored": {}, "coded": {}, "local-pca": {"clusters": 2}}
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


@pytest.fixture
def spoil(tmp_path, make_sample, rng):
    """Write a sound file of a kind with parts of its description (`about`) or arrays replaced, or left out if None."""

    def sound(kind, path):
        if kind == "sample":
            make_sample(6, 6).save(path)
        elif kind == "features":
            plain_features(rng.random((8, 8, 2)), True, 1).save(path)
        elif kind == "surface":
            normals = np.tile(np.float32([0, 0, 1]), (4, 1))
            tangents = np.tile(np.float32([1, 0, 0]), (4, 1))
            Surface([Level(SQUARE, np.int32([[0, 1, 2], [0, 2, 3]]), normals, tangents)]).save(path)
        elif kind == "map":
            places = np.zeros((1, 6), np.float32)
            CoordinateMap(places, places, places, 1.0, {"plane": [2, 3]}).save(path)
        elif kind == "relighting":
            codes = np.zeros((2, 2, 3, 6), np.uint8)
            RelightingModel(codes, np.ones(6), np.zeros(6), None, "ptm", "srgb").save(path)
        else:
            compress([make_sample(6, 6)], kind, **OPTIONS[kind]).save(path)

    def make(kind, about=None, arrays=None):
        path = tmp_path / "mine.npz"
        sound(kind, path)
        reader = store.read(path)
        members = {name: np.array(reader[name]) for name in reader.names()} | (arrays or {})
        facts = {k: v for k, v in (reader.about | (about or {})).items() if v != "out"}
        with path.open("wb") as file:
            writer = store.Writer(file)
            for name, array in members.items():
                writer.array(name, array)
            writer.about(facts)
            writer.close()
        return path

    return make


DESCRIPTIONS = [
    ("sample", {"transfer": "out"}, "lacks 'transfer'"),
    ("sample", {"scale": "1"}, "scale is '1'; expected a positive number"),
    ("sample", {"toroidal": [1]}, r"toroidal is \[1\]; expected true or false"),
    ("sample", {"texels_per_mm": -1}, "texels_per_mm is -1; expected a positive number"),
    ("svd", {"absolute": None}, "absolute is None; expected true or false"),
    ("svd", {"method": ["svd"]}, "method is .*; expected a text"),
    ("factored", {"space": ["rgb"]}, "space is .*; expected a text"),
    ("factored", {"epsilon": ""}, "epsilon is ''; expected a positive number"),
    ("coded", {"terms": [1, 2, 2, 2]}, "lacks the factors' shape"),
    ("relighting", {"basis": ["ptm"]}, "basis is .*; expected a text"),
    ("features", {"levels": "out"}, "lacks 'levels'"),
    ("features", {"levels": 1.0}, "levels is 1.0; expected a whole number"),
    ("features", {"neighbourhood": 0}, "neighbourhood is 0; expected a whole number from 1"),
    ("features", {"neighbourhood": 4}, "neighbourhood of 4 texels; expected an odd number"),
    ("surface", {"levels": None}, "levels is None"),
    ("map", {"domain": "plane"}, "names neither a surface nor a plane"),
    ("map", {"domain": {"plane": [1 << 30, 4]}}, "6 coordinates for a plane of"),
    ("map", {"domain": {"plane": "23"}}, "plane is '23'; expected two whole numbers"),
    ("map", {"sample_shape": 5}, "sample_shape is 5; expected two whole numbers"),
    ("map", {"texels_per_unit": 0}, "texels_per_unit is 0; expected a positive number"),
]  # fmt: skip
ARRAYS = [
    ("sample", {"light_directions": np.full((19, 3), 1e308)}, "light_directions reaches"),
    ("svd", {"view_directions": np.zeros((7, 3))}, "view_directions are not all unit vectors"),
    ("sample", {"pictures": np.zeros((133, 0, 6, 3), np.float32)}, "there are none"),
    ("svd", {"texture_factors": np.zeros((6, 6, 2), ">f4")}, "no kind of number that btfpipe"),
    ("svd", {"texture_factors": np.zeros((6, 6, 2), "g")}, "no kind of number that btfpipe"),
    ("coded", {"singular_values": None}, "factors are not finite"),
    ("coded", {"colour": np.full((3, 3), 1e100)}, "colour reaches 1e.100"),
    ("features", {"level0_vectors": np.full((65, 2), 1e30)}, "level0_vectors reaches"),
    ("surface", {"level0_vertices": SQUARE * 1e20}, "level 0: spans"),
    ("surface", {"level0_vertices": SQUARE * 1e-30}, "level 0: spans"),
    ("surface", {"level0_tangents": np.full((4, 3), 3e38, np.float32)}, "level0_tangents reaches"),
    ("surface", {"level0_normals": np.zeros((4, 3), np.float32)}, "normals of level 0 are not all unit"),
    ("map", {"row": np.full((1, 6), 1e30, np.float32)}, "row reaches 1e.30"),
]  # fmt: skip


def check(btfpipe, path, kind, wanted):
    """`info` and the command that the file is for say the same."""
    problems = btfpipe("info", path).stdout.partition("problems:")[2]
    use = {"features": ["synthesize", path, "--plane", "8x8", "--levels", 1]}
    out = path.with_name("out.map.npz" if kind in use else "out.png")
    command = use.get(kind, ["preview", path])
    if kind in ("sample", "features") or kind in OPTIONS or kind == "relighting":
        refused = btfpipe(*command, "-o", out, code=3).stderr
        assert refused.count("\n") == 1
        assert str(path) in refused
        assert re.search(wanted, refused)
        assert not out.exists()
    assert re.search(wanted, problems)


@pytest.mark.parametrize(("kind", "about", "wanted"), DESCRIPTIONS)
def test_a_description_of_another_form_is_refused(btfpipe, spoil, kind, about, wanted):
    check(btfpipe, spoil(kind, about=about), kind, wanted)


@pytest.mark.parametrize(("kind", "arrays", "wanted"), ARRAYS)
def test_arrays_that_no_command_could_use_are_refused(btfpipe, spoil, kind, arrays, wanted):
    if arrays == {"singular_values": None}:
        sound = store.read(spoil(kind))
        arrays = {"singular_values": np.zeros_like(sound["singular_values"])}
    check(btfpipe, spoil(kind, arrays=arrays), kind, wanted)


def test_a_file_of_an_unknown_kind_is_a_problem(btfpipe, spoil):
    assert (
        "its kind is 'weave'; expected one of sample"
        in btfpipe("info", spoil("sample", {"kind": "weave"})).stdout
    )


def test_a_name_of_a_material_that_is_no_text_is_shown_and_refused(btfpipe, spoil):
    sound = open_appearance(spoil("local-pca"))
    materials = [sound.about["materials"][0] | {"name": {"a": 1}}]
    said = btfpipe("info", spoil("local-pca", {"materials": materials})).stdout
    assert "name of material 0 is {'a': 1}; expected a text" in said


def test_a_model_whose_values_overflow_is_refused_by_preview_and_compare(
    btfpipe, spoil, make_sample, tmp_path
):
    large = {
        "texture_factors": np.full((6, 6, 2), 1e30, np.float32),
        "angular_factors": np.full((133, 3, 2), 1e30, np.float32),
    }
    path = spoil("svd", arrays=large)
    refused = btfpipe("preview", path, "-o", tmp_path / "a.png", code=3).stderr
    assert f"{path}: 36 of the 36 pictures to show hold non-finite values" in refused
    make_sample(6, 6).save(tmp_path / "s.npz")
    refused = btfpipe("compare", path, tmp_path / "s.npz", "-o", tmp_path / "a.json", code=3).stderr
    assert f"{path} against" in refused


def test_a_size_of_the_sample_that_is_no_number_is_not_believed(
    btfpipe, spoil, make_sample, tmp_path
):
    path = spoil("svd", {"sample_bytes": {}})
    make_sample(6, 6).save(tmp_path / "s.npz")
    btfpipe("compare", path, tmp_path / "s.npz", "-o", tmp_path / "a.json")


def test_a_sample_without_a_positive_value_can_be_compared_with(btfpipe, make_sample, tmp_path):
    sample = make_sample(12, 12)
    sample.codes = -np.ones_like(sample.codes)
    sample.save(tmp_path / "s.npz")
    make_sample(12, 12).save(tmp_path / "other.npz")
    btfpipe("compare", tmp_path / "other.npz", tmp_path / "s.npz", "-o", tmp_path / "a.json")
