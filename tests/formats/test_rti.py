import zipfile

import numpy as np
import pytest

from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.formats import rti, sources
from btfpipe.formats.images import encode_picture
from btfpipe.formats.rti import write_lp
from btfpipe.sample import Sample
from btfpipe.sample.ingest import ingest


def read_back(path, out, **options):
    with rti.open_measurement(path, **options) as measurement:
        facts = ingest(measurement, out)
    return Sample.open(out), facts


@pytest.fixture
def lp(tmp_path, rng):
    """Make a folder with a list of lights and two pictures; returns its path and the pictures."""
    pictures = rng.integers(0, 250, (2, 5, 6, 3), np.uint8)
    folder = tmp_path / "dome"
    folder.mkdir()
    (folder / "in").mkdir()
    (folder / "first light.png").write_bytes(encode_picture(pictures[0], ".png"))
    (folder / "in/b.PNG").write_bytes(encode_picture(pictures[1], ".png"))

    def make(text):
        (folder / "list.lp").write_text(text)
        return folder, pictures

    return make


def test_names_with_blanks_and_lists_made_elsewhere_are_read(tmp_path, lp):
    folder, pictures = lp('2\r\n\r\nfirst light.png  0.0 0 2\r\n"C:\\scans\\B.png"\t-3 0 4\r\n')
    back, facts = read_back(folder, tmp_path / "s.npz")
    np.testing.assert_allclose(back.light_directions, [[0, 0, 1], [-0.6, 0, 0.8]])
    np.testing.assert_array_equal(back.view_directions, [[0, 0, 1]])
    np.testing.assert_array_equal(back.codes, pictures)
    assert back.is_product
    assert (back.transfer, facts["format"]) == ("srgb", "RTI")
    assert rti.recognise(folder) == "list.lp lists 2 pictures with light directions"
    assert rti.recognise(folder / "list.lp") is not None


@pytest.mark.parametrize("target", ["set", "set.zip"])
@pytest.mark.parametrize(("suffix", "tolerance"), [(".exr", 1e-3), (".png", 0.01), (".jpg", 0.05)])
def test_the_frontal_view_comes_back(tmp_path, make_sample, target, suffix, tolerance):
    sample = make_sample(16, 16, views=bonn81()[3::-1], absolute=True, texels_per_mm=2.5, scale=1.5)
    facts = write_lp(tmp_path / target, sample, suffix)
    back, _ = read_back(tmp_path / target, tmp_path / "s.npz")
    frontal = sample.pictures(np.flatnonzero(sample.view_index == 3))
    error = np.abs(back.pictures(slice(0, back.n_pairs)) - frontal)
    assert (error.mean() if suffix == ".jpg" else error.max()) < tolerance
    np.testing.assert_allclose(back.light_directions, sample.light_directions, atol=1e-11)
    assert facts["view_deg"] == [0, 0]
    assert facts["views_left_out"] == 3


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "expected the number of pictures"),
        ("first light.png 0 0 1\n", "expected the number of pictures"),
        ("99999999999\nfirst light.png 0 0 1\n", "expected the number of pictures"),
        ("3\nfirst light.png 0 0 1\nin/b.PNG 1 0 1\n", "announces 3 pictures and lists 2"),
        ("1\nfirst light.png 0 0 1\nin/b.PNG 1 0 1\n", "announces 1 pictures and lists 2"),
        ("0\n", "announces 0"),
        ("1\nfirst light.png 0 0\n", "line 2.*expected a name and x y z"),
        ("1\n0 0 1\n", "line 2.*expected a name and x y z"),
        ("1\nfirst light.png 0 0 nan\n", "line 2.*expected a name and x y z"),
        ("1\nfirst light.png 0 0 0\n", "line 2.*expected a name and x y z of a length between"),
        ("1\nfirst light.png 0 0 1e300\n", "line 2.*expected a name and x y z"),
        ("1\nfirst light.png 0 1 -0.1\n", "below the surface"),
        ("2\nfirst light.png 0 0 1\nin/b.PNG 0 0 2\n", "the same light"),
        ("2\nfirst light.png 0 0 1\nFirst light.png 0 1 2\n", "twice"),
        ("1\nc.png 0 0 1\n", "'c.png', but it is not there"),
        ("1\n../../etc/passwd 0 0 1\n", "it is not there"),
    ],
)
def test_a_wrong_list_is_refused_with_the_reason(lp, text, match):
    folder, _ = lp(text)
    with pytest.raises(InputError, match=match):
        with rti.open_measurement(folder):
            pass


def test_a_list_with_a_wrong_number_is_still_taken_for_one(lp):
    folder, _ = lp("2\nfirst light.png 0 0 1\nin/b.PNG 0 one 1\n")
    for path in (folder, folder / "list.lp"):
        assert sources.recognise(path)[0] == "rti"
        with pytest.raises(InputError, match=r"list\.lp, line 3: 'in/b\.PNG 0 one 1'"):
            sources.open_source(path, "rti").__enter__()


def test_a_folder_without_a_list_or_with_two_is_refused(tmp_path, lp):
    with pytest.raises(InputError, match="found none"), rti.open_measurement(tmp_path):
        pass
    folder, _ = lp("1\nfirst light.png 0 0 1\n")
    (folder / "other.lp").write_text("1\nin/b.PNG 0 0 1\n")
    with (
        pytest.raises(InputError, match=r"found list\.lp, other\.lp.*--listing"),
        rti.open_measurement(folder),
    ):
        pass
    assert sources.recognise(folder) == ("rti", "2 lists of lights: list.lp, other.lp")
    with rti.open_measurement(folder, listing="other.lp") as measurement:
        assert measurement.n_pairs == 1
    for path, listing in ((folder / "third.lp", None), (folder, "third.lp")):
        with pytest.raises(InputError, match=r"found list\.lp, other\.lp\. third\.lp is not there"):
            with rti.open_measurement(path, listing=listing):
                pass


def test_a_cut_picture_and_an_unsafe_zip_are_refused_by_name(tmp_path, lp):
    folder, _ = lp("1\nfirst light.png 0 0 1\n")
    picture = folder / "first light.png"
    picture.write_bytes(picture.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"first light\.png: truncated"):
        read_back(folder, tmp_path / "s.npz")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("list.lp", "1\na.png 0 0 1\n")
        archive.writestr("../a.png", b"x")
    with (
        pytest.raises(InputError, match="points outside"),
        rti.open_measurement(tmp_path / "a.zip"),
    ):
        pass
    for path in (tmp_path / "a.zip", folder / "in", tmp_path / "none.lp", __file__):
        assert rti.recognise(path) is None
