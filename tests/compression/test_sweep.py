"""What a sweep tries, and that its picture has every method."""

import itertools
import json

import numpy as np
import pytest

from btfpipe.compression import METHODS
from btfpipe.compression.sweep import SETTINGS, draw_sweep, sweep
from btfpipe.directions import bonn81
from btfpipe.formats.images import read_picture
from btfpipe.sample import Sample


def test_every_method_that_makes_models_is_tried_with_options_it_has():
    assert set(SETTINGS) == {name for name, method in METHODS.items() if method.function}
    for name, tried in SETTINGS.items():
        for options in tried:
            assert set(options) <= set(METHODS[name].options)


@pytest.fixture
def rows(make_sample):
    """A sweep of two settings a method over a tiny sample."""
    sample = make_sample(12, 12, lights=bonn81()[:19], views=bonn81()[:7])
    settings = {name: tried[:2] for name, tried in SETTINGS.items() if name != "coded"}
    return sweep(sample, settings)


def test_more_terms_are_larger_files_and_smaller_errors(rows):
    made = [row for row in rows if "skipped" not in row]
    assert {"svd", "factored", "local-pca"} <= {row["method"] for row in made}
    for method in ("svd", "factored"):
        own = [row for row in made if row["method"] == method]
        for less, more in itertools.pairwise(own):
            assert less["ratio"] > more["ratio"]
            assert less["display_psnr_db"] < more["display_psnr_db"]


def test_a_small_sample_has_a_point_of_the_default_and_of_harmonics(make_sample):
    """Fixed ratios leave no room for its tables, and its directions tell few harmonics apart."""
    sample = make_sample(12, 12, lights=bonn81()[:37], views=bonn81()[:1], dtype=np.uint8)
    found = sweep(sample, {name: SETTINGS[name] for name in ("coded", "harmonics")})
    made = [row for row in found if "skipped" not in row]
    assert [row["method"] for row in made] == ["coded", "harmonics", "harmonics"]
    assert made[0]["options"] == {}
    assert made[0]["ratio"] < 100
    harmonics = [tuple(row["options"].values()) for row in found[-2:]]
    assert harmonics == [(1, 9), (1, 16)]
    assert len(found) == len(SETTINGS["coded"]) + 2


def test_warnings_of_the_models_are_kept(make_sample):
    few, many = sweep(make_sample(4, 4), {"svd": [{"components": 2}, {"components": 64}]})
    assert "warnings" not in few
    assert "left out" in many["warnings"][0]


def test_what_several_settings_have_in_common_is_said_once(
    btfpipe, make_sample, tmp_path, monkeypatch
):
    settings = {name: SETTINGS[name][:3] for name in ("svd", "harmonics")}
    monkeypatch.setattr("btfpipe.compression.sweep.SETTINGS", settings)
    product = make_sample(12, 12)
    every = np.arange(product.n_pairs)[::-1]
    tables = product.light_directions, product.view_directions
    index = product.light_index[every], product.view_index[every]
    Sample(product.codes[every], *tables, *index).save(tmp_path / "s.npz")
    said = btfpipe("compare", "--sweep", tmp_path / "s.npz", "-o", tmp_path / "r.json").stderr
    (line,) = (line for line in said.splitlines() if "harmonics" in line)
    assert line.count("--view-harmonics") == len(
        [row for row in json.loads((tmp_path / "r.json").read_text())["sweep"] if "skipped" in row]
    )
    assert "list of 133 pairs" in line


@pytest.mark.parametrize(
    ("ratios", "expected"),
    [
        ((0.4, 3.0), ["0.5:1", "1:1", "2:1"]),
        ((3.0, 110.0), ["5:1", "10:1", "20:1", "50:1", "100:1"]),
    ],
)
def test_every_part_of_the_axis_has_ticks(monkeypatch, ratios, expected):
    from matplotlib.axes import Axes

    set_xticks, seen = Axes.set_xticks, []

    def watched(self, ticks, labels):
        seen.extend(labels)
        return set_xticks(self, ticks, labels)

    monkeypatch.setattr(Axes, "set_xticks", watched)
    draw_sweep([{"method": "svd", "ratio": r, "display_psnr_db": 30 + r} for r in ratios])
    assert set(expected) <= set(seen)


def test_the_picture_tells_all_methods_apart(rows, monkeypatch):
    from matplotlib.axes import Axes

    looks = {}
    plot = Axes.plot

    def watched(self, *args, **kwargs):
        (line,) = plot(self, *args, **kwargs)
        looks[line.get_label()] = line.get_color(), line.get_marker()
        return [line]

    monkeypatch.setattr(Axes, "plot", watched)
    every = [dict(row, method=name) for name in SETTINGS for row in rows if row["method"] == "svd"]
    picture = read_picture(draw_sweep(every, "tiny"))
    assert set(looks) == set(SETTINGS)
    for part in zip(*looks.values(), strict=True):
        assert len(set(part)) == len(SETTINGS)
    assert picture.std() > 10
