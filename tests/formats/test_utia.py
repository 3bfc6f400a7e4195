import json
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.formats import ubo, utia
from btfpipe.formats.images import encode_picture
from btfpipe.formats.utia import pair_name, write_utia
from btfpipe.sample import Sample
from btfpipe.sample.colour import rgb_to_xyz, xyz_to_rgb
from btfpipe.sample.ingest import ingest

# IEC 61966-2-1, its own rounded numbers
SRGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def read_back(path, out, **options):
    with utia.open_measurement(path, **options) as measurement:
        ingest(measurement, out)
    return Sample.open(out)


def a_set(folder, pictures, suffix=".exr", names=None):
    """Write pictures of {(light, view): array} in the layout by hand."""
    for (light, view), picture in pictures.items():
        target = folder / pair_name(light, view, suffix)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(encode_picture(picture, suffix, names=names))
    return folder


def test_the_matrix_is_the_standards_own():
    np.testing.assert_allclose(rgb_to_xyz(np.eye(3)).T, SRGB, atol=1e-4)
    np.testing.assert_allclose(xyz_to_rgb(rgb_to_xyz([[0.2, 3, 0.7]])), [[0.2, 3, 0.7]], atol=1e-5)


def test_names_are_utias():
    assert pair_name((15, 60), (30, 90), ".png") == "tv030_pv090/tl015_pl060_tv030_pv090.png"


@given(st.tuples(*[st.integers(0, 89), st.integers(0, 359)] * 2))
def test_a_written_name_is_read_back(angles):
    name = pair_name(angles[:2], angles[2:], ".exr").rpartition("/")[2]
    assert ubo.parse_name(name) == (angles[:2], angles[2:])


@pytest.mark.parametrize("names", [None, ["X", "Y", "Z"]])
def test_xyz_becomes_linear_rgb_and_nothing_is_clamped(tmp_path, rng, names):
    rgb = rng.random((6, 8, 3)) * 9
    xyz = (rgb @ SRGB.T).astype(np.float32)
    path = a_set(tmp_path / "set", {((0, 0), (0, 0)): xyz}, names=names)
    sample = read_back(path, tmp_path / "s.npz")
    np.testing.assert_allclose(sample.pictures(slice(0, 1))[0], rgb, rtol=2e-3, atol=5e-3)
    assert sample.pictures(slice(0, 1)).max() > 5
    if names is None:
        sample = read_back(path, tmp_path / "s.npz", colour="rgb")
        np.testing.assert_array_equal(sample.pictures(slice(0, 1))[0], xyz)


@pytest.mark.parametrize("target", ["set", "set.zip"])
@pytest.mark.parametrize(
    ("suffix", "colour", "tolerance"), [(".exr", "xyz", 3e-3), (".exr", "rgb", 1e-3), (".png", "xyz", 0.01)]
)  # fmt: skip
def test_what_was_written_is_read_back(tmp_path, make_sample, target, suffix, colour, tolerance):
    sample = make_sample(6, 7, absolute=True, toroidal=True, texels_per_mm=2.5, scale=1.5)
    facts = write_utia(tmp_path / target, sample, suffix, colour=colour)
    back = read_back(tmp_path / target, tmp_path / "s.npz")
    every = slice(0, sample.n_pairs)
    np.testing.assert_allclose(back.pictures(every), sample.pictures(every), atol=tolerance)
    np.testing.assert_allclose(back.light_directions, sample.light_directions, atol=1e-7)
    assert (back.toroidal, back.texels_per_mm, back.absolute) == (True, 2.5, True)
    assert back.is_product
    assert facts["pictures"] == sample.n_pairs
    assert utia.recognise(tmp_path / target).startswith(f"{sample.n_pairs} pictures")


def test_eight_bit_codes_come_back_as_they_were(tmp_path, make_sample):
    sample = make_sample(6, 7, dtype=np.uint8, transfer="srgb", scale=1.25, absolute=True)
    write_utia(tmp_path / "set", sample)
    back = read_back(tmp_path / "set", tmp_path / "s.npz")
    np.testing.assert_array_equal(back.codes, sample.codes)
    np.testing.assert_allclose(back.scale, 1.25)


def test_without_the_list_the_nominal_light_is_kept_with_a_warning(tmp_path, make_sample):
    write_utia(tmp_path / "set", make_sample(2, 2, lights=bonn81()[:7], views=bonn81()[:7]))
    (tmp_path / "set/btfpipe.json").unlink()  # as UTIA's own sets come
    with utia.open_measurement(tmp_path / "set") as measurement:
        assert measurement.facts["coincident_pairs"] == 7
        assert "7 pairs" in measurement.facts["warnings"][0]
        assert "--directions" in measurement.facts["warnings"][0]
        assert len(measurement.light_directions) == 7


def test_names_in_a_set_of_our_own_say_true_angles(tmp_path, make_sample):
    directions = bonn81()[:3]
    sample = make_sample(4, 4, lights=directions, views=directions)
    write_utia(tmp_path / "set", sample)
    with utia.open_measurement(tmp_path / "set") as measurement:
        assert measurement.facts["coincident_pairs"] == 3
        assert "warnings" not in measurement.facts
    (tmp_path / "set/btfpipe.json").write_text('{"white": 0.5}')  # as a user adds it to UTIA's own
    with utia.open_measurement(tmp_path / "set") as measurement:
        assert len(measurement.facts["warnings"]) == 1


def test_with_the_list_coincident_pairs_get_their_true_light(tmp_path, make_sample):
    nominal = bonn81(degrees=True)[:7]
    write_utia(tmp_path / "set", make_sample(2, 2, lights=bonn81()[:7], views=bonn81()[:7]))
    rows = [f"{i + 1}\t{t} {p}\t{t + 6.5}  {p + 3}" for i, (t, p) in enumerate(nominal)]
    listed = tmp_path / "directions.txt"
    listed.write_text("No Theta Phi ThetaS PhiS\n" + "\n".join(rows) + "\n")
    sample = read_back(tmp_path / "set", tmp_path / "s.npz", directions=listed)
    assert not sample.is_product
    assert sample.n_pairs == 49
    light = sample.light_directions[sample.light_index]
    for pair in range(49):
        view = sample.view_index[pair]
        theta, phi = nominal[pair % 7]
        if pair % 7 == view:
            theta, phi = theta + 6.5, phi + 3
        np.testing.assert_allclose(
            light[pair], from_angles(*np.radians([theta, phi])), atol=1e-7, err_msg=str(pair)
        )
    assert sample.about["source"]["shifted_lights"] == 7
    assert "warnings" not in sample.about["source"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("No Theta\n", "holds no directions"),
        ("1 0 0 5\n", "line 1.*expected five numbers"),
        ("1 0 0 5 x\n", "line 1.*expected five numbers"),
        ("1 0 0 nan 0\n", "line 1.*expected five numbers"),
        ("1 0 0 5 0 7\n", "line 1.*expected five numbers"),
        ("1 0 0 95 0\n", "polar angle 95"),
        ("1 0 0 5 0\n2 0 90 6 0\n", "comes twice"),
        ("1 15 0 5 0\n", "no line for the direction 0 0"),
    ],
)
def test_a_list_that_does_not_fit_is_refused_by_name(tmp_path, make_sample, text, match):
    write_utia(tmp_path / "set", make_sample(2, 2, lights=bonn81()[:7], views=bonn81()[:7]))
    listed = tmp_path / "directions.txt"
    listed.write_text(text)
    with pytest.raises(InputError, match=match) as error:
        with utia.open_measurement(tmp_path / "set", directions=listed):
            pass
    assert str(listed) in str(error.value)


def test_colours_beyond_half_precision_are_refused_and_not_made_infinite(tmp_path):
    xyz = np.full((4, 4, 3), 1, np.float16)
    xyz[1, 1] = [60000, 10, 10]
    path = a_set(tmp_path / "set", {((0, 0), (0, 0)): xyz})
    with utia.open_measurement(path) as measurement, pytest.raises(InputError, match="beyond half"):
        measurement.read(0)


@pytest.mark.parametrize("bad", [np.inf, 3e38])
def test_colours_that_are_no_numbers_in_rgb_come_out_so_without_a_warning(tmp_path, bad):
    xyz = np.full((4, 4, 3), 1, np.float32)
    xyz[1, 1] = [bad, -bad, bad]
    path = a_set(tmp_path / "set", {((0, 0), (0, 0)): xyz})
    with utia.open_measurement(path) as measurement:
        assert np.isfinite(measurement.read(0)).sum() < 48


@pytest.mark.parametrize("spoil", ["nan", "cut", "missing", "size", "colour", "bomb", "outside"])
def test_broken_sets_are_refused_by_name(tmp_path, rng, spoil):
    lights, views = [(0, 0), (30, 0)], [(0, 0), (45, 90)]
    members = {}
    for light in lights:
        for view in views:
            picture = rng.random((6, 8, 3)).astype(np.float16)
            members[pair_name(light, view, ".exr")] = encode_picture(picture, ".exr")
    victim = pair_name((30, 0), (45, 90), ".exr")
    if spoil == "nan":
        members[victim] = encode_picture(np.full((6, 8, 3), np.nan, np.float16), ".exr")
    elif spoil == "cut":
        members[victim] = members[victim][:-40]
    elif spoil == "missing":
        del members[victim]
    elif spoil == "size":
        members[victim] = encode_picture(np.zeros((5, 8, 3), np.float16), ".exr")
    elif spoil == "colour":
        members["btfpipe.json"] = json.dumps({"colour": "cmyk"})
    elif spoil == "outside":
        members["../" + victim] = members.pop(victim)
    path = tmp_path / "set.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    if spoil == "bomb":
        data = bytearray(path.read_bytes())
        struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, 2**31)
        path.write_bytes(data)
    match = {
        "nan": "NaN", "cut": "truncated", "missing": r"1 of 4 .*tl30 pl0 tv45 pv90", "size": "5 x 8",
        "colour": "cmyk", "bomb": "declares", "outside": "points outside",
    }[spoil]  # fmt: skip
    with pytest.raises(InputError, match=match):
        read_back(path, tmp_path / "s.npz")
    assert not (tmp_path / "s.npz").exists()


def test_other_things_are_not_taken_for_utias_layout(tmp_path, make_measurement):
    bonns, _ = make_measurement()
    assert utia.recognise(bonns) is None
    assert "in their names" in ubo.recognise(bonns)
    (tmp_path / "x.zip").write_bytes(b"PK\3\4 and no more")
    for path in (tmp_path, tmp_path / "x.zip", tmp_path / "nothing", __file__):
        assert utia.recognise(path) is None
        assert ubo.recognise(path) is None or path == tmp_path
