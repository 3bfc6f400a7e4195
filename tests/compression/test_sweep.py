"""What a sweep tries, and that its picture has every method."""

import itertools

import pytest

from btfpipe.compression import METHODS
from btfpipe.compression.sweep import SETTINGS, draw_sweep, sweep
from btfpipe.directions import bonn81
from btfpipe.formats.images import read_picture


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
