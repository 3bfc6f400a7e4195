"""Previews: tone mapping, layers, sheets."""

import numpy as np
import pytest

from btfpipe.formats.images import read_picture, write_picture
from btfpipe.rendering.preview import GAP, auto_exposure, sheet, tone_map
from btfpipe.rendering.renderer import LAYERS


@pytest.fixture
def exr(tmp_path):
    def make(name="a.exr", value=0.5, rows=20, cols=30, names=LAYERS):
        picture = np.zeros((rows, cols, len(names)), np.float32)
        picture[5:15, 5:25, :3] = value
        picture[5:15, 5:25, 3] = 1
        if len(names) > 5:
            picture[5:15, 5:15, 4] = 2
            picture[5:15, 15:25, 4] = 4
            picture[5:15, 5:25, 5:8] = [0, 0, 1]
            picture[..., 8:] = -1
            picture[5:15, 5:25, 8] = np.arange(10)[:, None]
            picture[5:15, 5:25, 9] = np.arange(20)
        write_picture(tmp_path / name, picture, names=list(names))
        return tmp_path / name

    return make


def test_exposure_counts_in_doublings(exr, btfpipe, tmp_path):
    path = exr(value=0.2)
    seen = []
    for stops in (0, 1):
        btfpipe("preview", path, "-o", tmp_path / "p.png", "--exposure", stops, "--force")
        seen.append(int(read_picture(tmp_path / "p.png")[10, 10, 0]))
    srgb = [round(255 * (1.055 * v ** (1 / 2.4) - 0.055)) for v in (0.2, 0.4)]
    assert seen == srgb


def test_automatic_exposure_is_shared_and_ignores_what_is_not_covered(exr, btfpipe, tmp_path):
    dark, bright = exr("a.exr", 0.1), exr("b.exr", 0.4)
    btfpipe("preview", dark, bright, "-o", tmp_path / "p.png", "--columns", 2)
    picture = read_picture(tmp_path / "p.png")
    assert picture.shape == (20, 60 + GAP, 3)
    linear = [((picture[10, x, 0] / 255 + 0.055) / 1.055) ** 2.4 for x in (10, 44)]
    assert linear[1] == pytest.approx(0.8, abs=0.01)
    assert linear[0] == pytest.approx(0.2, abs=0.01)
    mostly_empty = np.zeros((50, 50, 4), np.float32)
    mostly_empty[0, 0] = [0.1, 0.2, 0.1, 1]
    assert auto_exposure([mostly_empty]) == pytest.approx(4)
    assert auto_exposure([np.zeros((4, 4, 4))]) == 1


def test_filmic_curve_keeps_highlights_apart():
    ramp = np.linspace(0, 6, 50)[None, :, None] * np.ones((1, 1, 3))
    clipped, bent = tone_map(ramp), tone_map(ramp, filmic=True)
    assert (clipped[0, 20:, 0] == 255).all()
    assert bent[0, 20, 0] < bent[0, 45, 0]
    assert (np.diff(bent[0, :, 0].astype(int)) >= 0).all()


def test_layers_are_shown(exr, btfpipe, tmp_path):
    path = exr()
    shown = {}
    for layer in ("alpha", "depth", "normal", "texel"):
        btfpipe("preview", path, "-o", tmp_path / "p.png", "--layer", layer, "--force")
        shown[layer] = read_picture(tmp_path / "p.png")[..., :3]
    assert (shown["alpha"][10, 10] == 255).all()
    assert (shown["alpha"][0, 0] == 0).all()
    assert shown["depth"][10, 10, 0] == 255  # near is white
    assert 0 < shown["depth"][10, 20, 0] < 60
    assert list(shown["normal"][10, 10]) == [128, 128, 255]
    assert list(shown["texel"][14, 24]) == [255, 255, 0]
    assert (shown["texel"][0, 0] == 0).all()


def test_sheet_of_a_sample_has_lights_across_and_views_down(make_sample, btfpipe, tmp_path):
    sample = make_sample()
    sample.save(tmp_path / "s.npz")
    btfpipe("preview", tmp_path / "s.npz", "-o", tmp_path / "p.png", "--exposure", 0)
    picture = read_picture(tmp_path / "p.png")
    assert picture.shape == (6 * (16 + GAP) - GAP, 6 * (20 + GAP) - GAP, 3)
    # the most frontal view and light stand first, since the set starts with them
    np.testing.assert_array_equal(picture[:16, :20], tone_map(sample.pictures([0])[0]))


def test_labels_are_written_below():
    plain = np.zeros((40, 80, 3), np.uint8)
    labelled = sheet([plain, plain], 2, ["one", "two"])
    assert labelled.shape[0] > 40
    assert labelled[40:].max() > 100


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--layer", "depth"], "has no channel 'Z'"),
        (["a.txt"], "previews are PNG or JPEG"),
    ],
)
def test_what_cannot_be_shown_is_refused(options, message, exr, btfpipe, tmp_path):
    path = exr(names=LAYERS[:4])
    out = tmp_path / (options.pop() if options[0] == "a.txt" else "p.png")
    assert message in btfpipe("preview", path, "-o", out, *options, code=3).stderr
    assert not out.exists()


def test_labels_are_whole_below_pictures_smaller_than_they(make_sample, btfpipe, tmp_path):
    small, large = (np.zeros((16, width, 3), np.uint8) for width in (20, 200))
    label = "light 60 120\nview 75 345"
    narrow, wide = (sheet([picture], 1, [label])[16:] for picture in (small, large))
    assert narrow.shape[1] < wide.shape[1]
    # what is written below the wide picture is written below the narrow one, and nothing beside
    np.testing.assert_array_equal(narrow, wide[:, : narrow.shape[1]])
    assert (wide[:, narrow.shape[1] - 3 :] == wide[0, -1]).all()
    assert all(line.max() > 100 for line in (narrow[:12], narrow[12:]))
    make_sample().save(tmp_path / "s.npz")
    btfpipe("preview", tmp_path / "s.npz", "-o", tmp_path / "p.png", "--labels")
    assert read_picture(tmp_path / "p.png").shape[0] == 6 * (16 + 24 + GAP) - GAP


@pytest.mark.parametrize("stops", ["nan", "inf", "61", "-61"])
def test_exposure_that_is_none_is_wrong_usage(stops, exr, btfpipe, tmp_path):
    done = btfpipe("preview", exr(), "-o", tmp_path / "p.png", "--exposure", stops, code=2)
    assert "not a finite number" in done.stderr or "not in the range -60<=x<=60" in done.stderr


@pytest.mark.parametrize("filmic", [False, True])
def test_utmost_exposure_is_white(filmic):
    assert (tone_map(np.full((2, 2, 3), 6e4), 2.0**60, filmic) == 255).all()


def test_other_files_are_refused(exr, make_sample, btfpipe, tmp_path):
    (tmp_path / "x.exr").write_bytes(b"not a picture")
    assert (
        "x.exr" in btfpipe("preview", tmp_path / "x.exr", "-o", tmp_path / "p.png", code=3).stderr
    )
    write_picture(tmp_path / "codes.png", np.full((4, 4, 3), 128, np.uint8))
    codes = btfpipe("preview", tmp_path / "codes.png", "-o", tmp_path / "p.png", code=3)
    assert "codes.png: a picture of uint8 codes" in codes.stderr
    assert "expected a rendered .exr" in codes.stderr
    make_sample().save(tmp_path / "s.npz")
    half = (tmp_path / "s.npz").read_bytes()[:1000]
    (tmp_path / "half.npz").write_bytes(half)
    damaged = btfpipe("preview", tmp_path / "half.npz", "-o", tmp_path / "p.png", code=3)
    assert "half.npz: not a btfpipe file, or damaged" in damaged.stderr
    both = btfpipe("preview", tmp_path / "s.npz", exr(), "-o", tmp_path / "p.png", code=3)
    assert "give it alone" in both.stderr
    layer = btfpipe(
        "preview", tmp_path / "s.npz", "--layer", "depth", "-o", tmp_path / "p.png", code=3
    )
    assert "has no layer depth" in layer.stderr


def test_the_sheet_of_a_list_of_pairs_shows_pairs_that_are_there(make_sample):
    from btfpipe.rendering.preview import sample_sheet
    from btfpipe.sample import Sample

    product = make_sample(8, 8)
    diagonal = np.arange(0, product.n_pairs, 8)  # no product, and most combinations are missing
    listed = Sample(
        product.codes[diagonal], product.light_directions, product.view_directions,
        product.light_index[diagonal], product.view_index[diagonal],
    )  # fmt: skip
    pictures, labels, columns = sample_sheet(listed, 4, 3)
    assert len(pictures) == 12
    assert columns == 4
    assert len(set(labels)) == 12
    stored = list(listed.pictures(slice(None)))
    assert all(any(np.array_equal(p, q) for q in stored) for p in pictures)


@pytest.mark.parametrize("layer", ["colour", "depth"])
def test_values_that_are_not_finite_are_refused(exr, btfpipe, tmp_path, layer):
    path = exr("a.exr", np.nan)
    if layer == "depth":
        picture = np.full((4, 4, len(LAYERS)), np.inf, np.float32)
        write_picture(path, picture, names=list(LAYERS))
    refused = btfpipe("preview", path, "--layer", layer, "-o", tmp_path / "a.png", code=3).stderr
    assert f"{path}: holds" in refused
    assert "NaN or infinite values in" in refused


@pytest.mark.parametrize("value", [1e-45, 3e38])
def test_the_darkest_and_the_brightest_pictures_can_be_shown(exr, btfpipe, tmp_path, value):
    btfpipe("preview", exr("a.exr", value), "-o", tmp_path / "a.png")
    btfpipe("preview", exr("a.exr", value), "-f", "--exposure", 60, "-o", tmp_path / "a.png")
