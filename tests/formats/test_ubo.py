import json
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.formats import ubo
from btfpipe.formats.archive import open_archive

polar = st.integers(0, 89_999_999).map(lambda n: n / 1e6)
azimuth = st.integers(0, 359_999_999).map(lambda n: n / 1e6)


@given(polar, azimuth, polar, azimuth)
def test_a_written_name_is_read_back(tl, pl, tv, pv):
    path = ubo.pair_name(7, (tl, pl), (tv, pv), ".jpg")
    light, view = ubo.parse_name(path.rsplit("/", 1)[1])
    np.testing.assert_allclose([*light, *view], [tl, pl, tv, pv], atol=5e-7)


@given(
    st.permutations(["tl015", "pl000", "tv30.5", "pv270"]),
    st.sampled_from([" ", "_", "", "-x-"]),
    st.booleans(),
    st.sampled_from(["", "00012 ", "img_", "wool "]),
)
def test_only_the_keyed_angles_count(keys, separator, upper, prefix):
    name = prefix + separator.join(keys) + ".jpg"
    assert ubo.parse_name(name.upper() if upper else name) == ((15, 0), (30.5, 270))


@pytest.mark.parametrize(
    "name",
    [
        "img_tv30_pv270_tl15_pl0.jpg",
        "TL015_PL000_TV030_PV270.EXR",
        "tl_15 pl_0 tv_30 pv_270.png",
        "wool tl=15.0, pl=0, tv=30, pv=270.jpg",
        "PV270PL000TL015TV030.HDR",
        "tv030.000_pv270.000_tl015.000_pl-0.000.exr",
    ],
)
def test_names_that_others_use_are_read(name):
    assert ubo.parse_name(name) == ((15, 0), (30, 270))


@pytest.mark.parametrize(
    "name",
    ["00012.jpg", "tl000 pl000 tv000.jpg", "tl000 pl000 tv000 pv000 tl015.jpg", "total 0.jpg"],
)
def test_a_name_without_each_key_once_is_no_pair(name):
    assert ubo.parse_name(name) is None


def test_bonns_own_example():
    assert ubo.parse_name("00008 tl000 pl000 tv030 pv030.jpg") == ((0, 0), (30, 30))


def test_a_full_set_comes_out_in_bonns_order(make_measurement):
    order = np.random.default_rng(3).permutation(81)
    directions = [tuple(a) for a in bonn81(degrees=True).tolist()]
    shuffled = [directions[i] for i in order]
    path, codes = make_measurement(lights=shuffled, views=((0, 0),), shape=(2, 2))
    with ubo.open_measurement(path) as measurement:
        np.testing.assert_array_equal(measurement.light_directions, bonn81())
        np.testing.assert_array_equal(measurement.light_index, np.arange(81))
        for pair in (0, 17, 80):
            where = shuffled.index(directions[pair])
            np.testing.assert_array_equal(measurement.read(pair), codes[0, where])


def test_one_direction_written_in_two_ways_is_one_direction(make_measurement):
    def change(members):
        first = next(iter(members))
        members["x tl000 pl270 tv000 pv360.png"] = members[first]

    path, _ = make_measurement(change=change)
    with pytest.raises(InputError, match=r"1 pairs are there twice .*tl000 pl000.*tl000 pl270"):
        with ubo.open_measurement(path):
            pass


def test_a_missing_pair_is_named_and_a_list_of_pairs_accepted(make_measurement):
    def change(members):
        del members[next(name for name in members if "tl030 pl000 tv045" in name)]

    path, codes = make_measurement(change=change)
    with pytest.raises(InputError, match=r"1 of 6 .* \(first: tl30 pl0 tv45 pv180\).*--pairs"):
        with ubo.open_measurement(path):
            pass
    with ubo.open_measurement(path, pairs=True) as measurement:
        pairs = list(zip(measurement.view_index, measurement.light_index, strict=True))
        assert pairs == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)]
        np.testing.assert_array_equal(measurement.read(4), codes[1, 2])


def test_strays_are_listed_and_otherwise_ignored(make_measurement):
    strays = ["readme.txt", "__MACOSX/._00 tl000 pl000 tv000 pv000.png", "Thumbs.db", "a/cover.png"]

    path, _ = make_measurement(change=lambda m: m.update(dict.fromkeys(strays, b"x")))
    with ubo.open_measurement(path) as measurement:
        assert measurement.n_pairs == 6
        assert sorted(measurement.facts["strays"]) == sorted(strays)


def test_a_folder_reads_like_a_zip(make_measurement):
    folder, codes = make_measurement("folder")
    with ubo.open_measurement(folder) as measurement:
        np.testing.assert_array_equal(measurement.read(5), codes[1, 2])


def test_a_light_below_the_surface_is_refused_by_name(make_measurement):
    path, _ = make_measurement(lights=((0, 0), (95, 0)))
    with pytest.raises(InputError, match=r"tl095.*polar angle 95"):
        with ubo.open_measurement(path):
            pass


def test_a_source_without_pictures_says_what_names_it_expects(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(InputError, match=r"notes.txt.*tl000 pl000 tv030 pv030"):
        with ubo.open_measurement(tmp_path):
            pass


@pytest.mark.parametrize("name", ["btfpipe.json", "BTFPIPE.JSON"])
def test_settings_of_a_simulated_set_are_honoured(make_measurement, name):
    settings = {"white": 0.5, "transfer": "linear", "toroidal": True, "texels_per_mm": 4.0}
    path, _ = make_measurement(change=lambda m: m.update({name: json.dumps(settings)}))
    with ubo.open_measurement(path) as measurement:
        assert (measurement.white, measurement.toroidal, measurement.texels_per_mm) == (
            0.5,
            True,
            4,
        )
        assert measurement.transfer(measurement.read(0)) == "linear"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "not JSON"),
        ("[1]", "no mapping"),
        ('{"white": -1}', "white is -1"),
        ('{"white": true}', "white is True"),
        ('{"transfer": "log"}', "transfer is 'log'"),
        ('{"toroidal": 1}', "toroidal is 1"),
        ('{"texels_per_mm": "4"}', "texels_per_mm is '4'"),
        ('{"white": 1}' + " " * (1 << 20), "longer than 1048576 bytes; expected settings"),
    ],
)
def test_wrong_settings_are_refused_by_key(make_measurement, text, match):
    path, _ = make_measurement(change=lambda m: m.update({"btfpipe.json": text}))
    with pytest.raises(InputError, match=match):
        with ubo.open_measurement(path):
            pass


@pytest.mark.parametrize(
    ("suffix", "dtype", "transfer"),
    [(".jpg", np.uint8, "gamma2.2"), (".png", np.uint8, "srgb"), (".exr", np.float16, "linear")],
)
def test_the_transfer_curve_follows_the_kind_of_file(make_measurement, suffix, dtype, transfer):
    path, _ = make_measurement(suffix=suffix, dtype=dtype, shape=(16, 16))
    with ubo.open_measurement(path) as measurement:
        assert measurement.transfer(measurement.read(0)) == transfer


def test_the_listing_counts_what_is_missing(make_measurement):
    path, _ = make_measurement(change=lambda m: m.pop(next(iter(m))))
    with open_archive(path) as archive:
        assert list(ubo.Listing(archive).missing()) == [((0, 0), (0, 0))]


def test_a_list_with_as_many_directions_as_pairs_is_read_in_little_memory(peak_bytes):
    angles = [(30 + k / 100, k / 10) for k in range(1500)]
    names = [ubo.pair_name(k, angle, angle, ".png") for k, angle in enumerate(angles)]
    archive = SimpleNamespace(names=names, label=str, others=[], folders=[])
    listing = ubo.Listing(archive)
    assert len(listing.pairs) == len(listing.views) == len(listing.lights) == 1500
    with peak_bytes() as peak:
        listing.require_whole("set.zip", any_pairs=True)
        with pytest.raises(InputError, match=r"2248500 of 2250000 .*first: tl30.01 .* tv30 pv0\)"):
            listing.require_whole("set.zip")
    assert peak[0] < 4 << 20


def test_copies_made_by_a_browser_are_not_lost(make_measurement):
    def change(members):
        first = next(iter(members))
        members[first.replace(".png", " (1).png")] = members[first]

    path, _ = make_measurement(change=change)
    with pytest.raises(InputError, match=r"there twice .*pv000\.png.*pv000 \(1\)\.png"):
        with ubo.open_measurement(path):
            pass


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name_are_a_pair_there_twice(make_measurement):
    path, _ = make_measurement()
    with zipfile.ZipFile(path, "a") as archive:
        name = archive.namelist()[0]
        archive.writestr(name, b"x")
    with pytest.raises(InputError, match=r"there twice .*member 2 of that name"):
        with ubo.open_measurement(path):
            pass


def test_settings_nested_too_deep_are_refused(make_measurement):
    path, _ = make_measurement(change=lambda m: m.update({"btfpipe.json": "[" * 200_000}))
    with pytest.raises(InputError, match=r"btfpipe\.json: not JSON"):
        with ubo.open_measurement(path):
            pass


@pytest.mark.parametrize("azimuth", ["9" * 400, "-" + "9" * 400])
def test_an_azimuth_that_is_no_number_is_refused(azimuth):
    (light, _) = ubo.parse_name(f"tl030 pl{azimuth} tv000 pv000.png")
    with pytest.raises(InputError, match=r"azimuth -?inf degrees"):
        ubo.direction(light, "x.png")
