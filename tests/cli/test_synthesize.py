"""The command from outside: files in, a map out, errors that say what to do."""

import json

import numpy as np
import pytest

from btfpipe.analysis.features import Features
from btfpipe.analysis.pyramid import plain_features
from btfpipe.surface import Level, Surface
from btfpipe.synthesis import CoordinateMap


@pytest.fixture
def flat(tmp_path):
    """A flat surface of one level, 24 x 24 vertices, in a file."""
    i, j = np.mgrid[0:24, 0:24]
    vertices = np.stack([j.ravel(), -i.ravel(), 0 * i.ravel()], axis=1).astype(float)
    place = np.arange(24 * 24).reshape(24, 24)
    a, b, c, d = (
        x.ravel() for x in (place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]).astype(np.int32)
    frames = (np.tile(np.float32(axis), (len(vertices), 1)) for axis in ([0, 0, 1], [1, 0, 0]))
    path = tmp_path / "flat.surface.npz"
    Surface([Level(vertices, faces, *frames)]).save(path)
    return path


@pytest.fixture
def image(tmp_path, rng):
    path = tmp_path / "image.npy"
    np.save(path, rng.random((24, 24, 4)).astype(np.float32))
    return path


def test_a_surface_is_dressed_and_the_map_names_it(btfpipe, tmp_path, flat, image):
    out = tmp_path / "c.map.npz"
    result = btfpipe(
        "synthesize", image, flat, "-o", out, "--levels", 1, "--repeats", 2, "--turn-deg", 30, "--json"
    )  # fmt: skip
    summary = json.loads(result.stdout)
    made = CoordinateMap.open(out)
    assert made.domain == {"surface": Surface.open(flat).digest}
    assert made.row.shape == (1, 24 * 24)
    assert made.texels_per_unit == pytest.approx(2 * 24 / 23) == summary["texels_per_unit"]
    assert (made.angle == np.float32(np.radians(30))).all()
    assert 0 < summary["coherent_share"] <= 1
    assert [step["level"] for step in summary["steps"]] == [0] * 16


def test_a_field_across_a_material_of_one_direction_is_warned_of(btfpipe, tmp_path, rng):
    from shared_meshes import even_sphere

    Surface([even_sphere(400)]).save(tmp_path / "sphere.surface.npz")
    cords = np.sin(2 * np.pi * np.arange(24) / 6)[:, None, None] + 0.1 * rng.random((24, 24, 2))
    np.save(tmp_path / "cords.npy", cords.astype(np.float32))
    said = {}
    for turn in (0, 90):
        result = btfpipe(
            "synthesize", tmp_path / "cords.npy", tmp_path / "sphere.surface.npz", "-o", tmp_path / f"{turn}.map.npz",
            "--levels", 1, "--sweeps", 1, 1, "--turn-deg", turn, "--texels-per-unit", 6, "--json", "--quiet",
        )  # fmt: skip
        said[turn] = json.loads(result.stdout) | {"stderr": result.stderr}
    assert said[0]["warnings"] == []
    assert said[0]["stderr"] == ""
    assert said[0]["dislocations"] == pytest.approx(said[90]["dislocations_turned_90"])
    assert said[90]["dislocations"] > 8
    (warning,) = said[90]["warnings"]
    assert said[90]["stderr"] == f"Warning: {warning}.\n"
    assert "--turn-deg 0 here" in warning


def test_a_plane_from_a_picture(btfpipe, tmp_path, rng):
    from btfpipe.formats.images import write_picture

    write_picture(tmp_path / "p.png", (rng.random((20, 20, 3)) * 255).astype(np.uint8))
    out = tmp_path / "c.map.npz"
    btfpipe("synthesize", tmp_path / "p.png", "--plane", "24x32", "-o", out, "--levels", 2, "-k", 4)
    made = CoordinateMap.open(out)
    assert made.domain == {"plane": [24, 32], "toroidal": True}
    assert made.row.shape == (1, 24 * 32)


def test_a_sample_is_compared_by_its_leading_coordinates(btfpipe, tmp_path, make_sample):
    make_sample(rows=16, cols=16, toroidal=True).save(tmp_path / "s.sample.npz")
    out = tmp_path / "c.map.npz"
    btfpipe(
        "synthesize", tmp_path / "s.sample.npz", "--plane", "16x16", "-o", out, "--levels", 1, "-k", 3
    )  # fmt: skip
    made = CoordinateMap.open(out)
    assert made.about["toroidal_sample"] is True
    assert made.row.max() < 16


def test_same_seed_same_bytes_for_any_threads(btfpipe, tmp_path, flat, image):
    outs = [tmp_path / f"{t}.map.npz" for t in (1, 2)]
    for threads, out in zip((1, 2), outs, strict=True):
        btfpipe("synthesize", image, flat, "-o", out, "--levels", 1, "-t", threads, "--seed", 5)
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_nan_in_features_is_refused_and_nothing_is_written(btfpipe, tmp_path, flat):
    image = np.ones((16, 16, 2), np.float32)
    image[3, 4, 1] = np.nan
    np.save(tmp_path / "bad.npy", image)
    out = tmp_path / "c.map.npz"
    result = btfpipe("synthesize", tmp_path / "bad.npy", flat, "-o", out, "--levels", 1, code=3)
    assert "row 3, col 4" in result.stderr
    assert not list(tmp_path.glob("c.map*"))


def test_nan_in_a_features_file_is_refused(btfpipe, tmp_path, flat):
    features = plain_features(np.ones((16, 16, 2), np.float32), levels=1)
    features.levels[0].vectors[5] = np.nan
    features.save(tmp_path / "bad.features.npz")
    out = tmp_path / "c.map.npz"
    result = btfpipe("synthesize", tmp_path / "bad.features.npz", flat, "-o", out, code=3)
    assert "NaN" in result.stderr


def test_a_sample_smaller_than_the_neighbourhood_is_refused(btfpipe, tmp_path, flat):
    np.save(tmp_path / "small.npy", np.ones((4, 4, 2), np.float32))
    result = btfpipe(
        "synthesize", tmp_path / "small.npy", flat, "-o", tmp_path / "c.map.npz", "--levels", 1, code=3
    )  # fmt: skip
    assert "small.npy" in result.stderr
    assert "neighbourhood of 5 x 5" in result.stderr


def test_levels_that_the_surface_lacks_are_refused(btfpipe, tmp_path, flat, image):
    out = tmp_path / "c.map.npz"
    result = btfpipe("synthesize", image, flat, "-o", out, "--levels", 2, code=3)
    assert "the surface has 1 levels" in result.stderr


def test_a_file_of_another_kind_is_refused(btfpipe, tmp_path, flat, image):
    out = tmp_path / "c.map.npz"
    assert "holds a surface" in btfpipe("synthesize", flat, flat, "-o", out, code=3).stderr
    features = plain_features(np.load(image), levels=1)
    features.save(tmp_path / "f.features.npz")
    result = btfpipe("synthesize", image, tmp_path / "f.features.npz", "-o", out, code=3)
    assert "holds a features" in result.stderr


def test_lists_are_made_where_a_features_file_has_none(btfpipe, tmp_path, image):
    plain_features(np.load(image), levels=1).save(tmp_path / "f.features.npz")
    assert Features.open(tmp_path / "f.features.npz").levels[0].neighbours is None
    out = tmp_path / "c.map.npz"
    btfpipe("synthesize", tmp_path / "f.features.npz", "--plane", "16x16", "-o", out, "--levels", 1)
    assert out.exists()


def test_an_array_of_text_is_refused(btfpipe, tmp_path):
    np.save(tmp_path / "t.npy", np.array([["a", "b"]]))
    result = btfpipe(
        "synthesize", tmp_path / "t.npy", "--plane", "16x16", "-o", tmp_path / "c.map.npz", code=3
    )
    assert "expected numbers" in result.stderr


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--plane", "16"],
        ["--plane", "16x16", "--repeats", 2],
        ["--plane", "16x16", "--turn-deg", 90],
    ],
)
def test_wrong_usage_exits_2(btfpipe, tmp_path, image, options):
    btfpipe("synthesize", image, *options, "-o", tmp_path / "c.map.npz", code=2)


def test_a_truncated_file_of_our_own_is_called_damaged(btfpipe, tmp_path, make_sample):
    make_sample().save(tmp_path / "s.sample.npz")
    data = (tmp_path / "s.sample.npz").read_bytes()
    (tmp_path / "s.sample.npz").write_bytes(data[: len(data) // 2])
    result = btfpipe(
        "synthesize",
        tmp_path / "s.sample.npz",
        "--plane",
        "16x16",
        "-o",
        tmp_path / "c.npz",
        code=3,
    )
    assert "s.sample.npz: not a btfpipe file, or damaged" in result.stderr


def test_features_whose_distances_overflow_are_refused_by_name(btfpipe, tmp_path):
    np.save(tmp_path / "large.npy", np.full((16, 16, 3), 1e30))
    result = btfpipe(
        "synthesize", tmp_path / "large.npy", "--plane", "16x16", "-o", tmp_path / "c.npz", code=3
    )
    assert "large.npy: feature image reaches 1e+30" in result.stderr
