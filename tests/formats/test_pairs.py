import json
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.directions import bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.formats import pairs, sources, utia
from btfpipe.formats.describe import describe_foreign
from btfpipe.formats.images import encode_picture
from btfpipe.formats.pairs import correction, write_pairs
from btfpipe.sample import Sample
from btfpipe.sample.ingest import ingest


def read_back(path, out, **options):
    with pairs.open_measurement(path, **options) as measurement:
        facts = ingest(measurement, out)
    return Sample.open(out), facts


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def scattered(rng, n):
    """Unit vectors (n, 3) above the surface."""
    return unit(rng.normal(size=(n, 3)) * [1, 1, 0] + [0, 0, 0.8])


def put(folder, listed, pictures, name="list.csv", suffix=".png"):
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(listed)
    for key, picture in pictures.items():
        target = folder / (key + suffix)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(encode_picture(picture, suffix))
    return folder


@pytest.mark.parametrize("target", ["set", "set.zip"])
@pytest.mark.parametrize(("suffix", "tolerance"), [(".exr", 1e-3), (".png", 0.01)])
def test_a_product_comes_back_as_that_product(tmp_path, make_sample, target, suffix, tolerance):
    sample = make_sample(6, 7, absolute=True, toroidal=True, texels_per_mm=2.5, scale=1.5)
    write_pairs(tmp_path / target, sample, suffix)
    back, facts = read_back(tmp_path / target, tmp_path / "s.npz")
    every = slice(0, sample.n_pairs)
    np.testing.assert_allclose(back.pictures(every), sample.pictures(every), atol=tolerance)
    np.testing.assert_allclose(back.light_directions, sample.light_directions, atol=1e-15)
    assert back.is_product
    assert (back.toroidal, back.texels_per_mm, back.absolute) == (True, 2.5, True)
    assert facts["format"] == "pairs (vectors)"
    assert facts["n_strays"] == 0


@settings(max_examples=10, deadline=None)
@given(st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_any_list_of_pairs_comes_back(tmp_path_factory, n, seed):
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("pairs")
    lights, views = scattered(rng, n), scattered(rng, 3)
    codes = (rng.random((n, 3, 4, 3)) * 1000).astype(np.float16)
    sample = Sample(codes, lights, views, rng.permutation(n), rng.integers(0, 3, n))
    write_pairs(folder / "set.zip", sample)
    back, _ = read_back(folder / "set.zip", folder / "s.npz")
    where = [int(np.flatnonzero((back.codes == c).all(axis=(1, 2, 3)))[0]) for c in codes]
    for table, index in (("light_directions", "light_index"), ("view_directions", "view_index")):
        ours = getattr(back, table)[getattr(back, index)][where]
        np.testing.assert_allclose(ours, getattr(sample, table)[getattr(sample, index)], atol=1e-9)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_angles_in_a_csv_of_a_spreadsheet(tmp_path, rng, separator):
    pictures = {f"in/a {i}": rng.integers(0, 250, (5, 6, 3), np.uint8) for i in range(3)}
    rows = [["Name", "theta_l", "phi_l", "Theta_V", "phi_v", "remark"]]
    angles = [(0, 20, 30, 40), (61.5, 350, 0, 0), (10, -30, 45, 270)]
    rows += [[f"in\\a {i}.png", *map(str, a), "x"] for i, a in enumerate(angles)]
    text = "\ufeff" + "\r\n".join(separator.join(row) for row in rows) + "\r\n\r\n"
    back, facts = read_back(put(tmp_path / "set", text, pictures), tmp_path / "s.npz")
    for i, (tl, pl, tv, pv) in enumerate(np.radians(angles)):
        light = back.light_directions[back.light_index[i]]
        np.testing.assert_allclose(light, from_angles(tl, pl), atol=1e-9)
        view = back.view_directions[back.view_index[i]]
        np.testing.assert_allclose(view, from_angles(tv, pv), atol=1e-9)
        np.testing.assert_array_equal(back.codes[i], pictures[f"in/a {i}"])
    assert back.transfer == "srgb"
    assert not facts["product"]


def test_json_says_directions_and_settings(tmp_path, rng):
    picture = rng.integers(0, 250, (5, 6, 3), np.uint8)
    row = {"name": "a.png", "lx": 0, "ly": 0, "lz": 7, "vx": 1, "vy": 0, "vz": 1}
    listed = {"pairs": [row], "white": 0.5, "transfer": "gamma2.2"}
    folder = put(tmp_path / "set", json.dumps(listed), {"a": picture}, name="list.json")
    back, _ = read_back(folder / "list.json", tmp_path / "s.npz")
    np.testing.assert_allclose(back.view_directions, [[0.5**0.5, 0, 0.5**0.5]])
    assert (back.scale, back.transfer, back.absolute) == (2, "gamma2.2", True)
    put(tmp_path / "set", json.dumps([row]), {}, name="list.json")
    back, _ = read_back(folder, tmp_path / "s.npz")
    assert back.transfer == "srgb"


def near_lamp(shape, patch_cm, lamp, power):
    """Naive twin: linear picture of a white diffuser under a small lamp, texel by texel."""
    rows, cols = shape
    picture = np.empty((rows, cols, 3))
    for i in range(rows):
        for j in range(cols):
            at = np.array(
                [
                    (j + 0.5 - cols / 2) * patch_cm[1] / cols,
                    (rows / 2 - i - 0.5) * patch_cm[0] / rows,
                    0,
                ]
            )
            to = lamp - at
            distance = np.sqrt((to**2).sum())
            picture[i, j] = power * (to[2] / distance) / distance**2
    return picture  # fmt: skip


def test_pictures_under_near_lamps_become_those_of_distant_ones(tmp_path):
    patch, power = (8.0, 10.0), 40.0**2
    lamps = np.array([[0, 0, 40.0], [20, -5, 30], [-30, 25, 20], [5, 60, 30]])
    cameras = np.array([[0, 0, 50.0], [10, 0, 50], [0, 0, 60], [-40, 10, 35]])
    pictures = {
        str(i): near_lamp((8, 10), patch, lamp, power).astype(np.float32)
        for i, lamp in enumerate(lamps)
    }
    text = "name," + ",".join(pairs.COLUMNS["positions"]) + "\n"
    for i in range(4):
        text += ",".join(map(str, [f"{i}.exr", *lamps[i], *cameras[i]])) + "\n"
    folder = put(tmp_path / "set", text, pictures, suffix=".exr")
    back, facts = read_back(folder, tmp_path / "s.npz", patch_cm=patch)
    # a white diffuser under a distant light has the light's cosine everywhere
    cosine = unit(lamps)[:, 2]
    np.testing.assert_allclose(back.light_directions[back.light_index], unit(lamps), atol=1e-12)
    reference = np.median(np.linalg.norm(lamps, axis=1))
    expected = cosine * power / reference**2
    values = back.pictures(slice(0, 4))
    np.testing.assert_allclose(
        values, np.broadcast_to(expected[:, None, None, None], values.shape), rtol=1e-5
    )
    corner = np.array([5, 4, 0])
    angles = [
        np.degrees(np.arccos(unit(c) @ unit(c - corner * [x, y, 1])))
        for c in cameras for x in (-1, 1) for y in (-1, 1)
    ]  # fmt: skip
    np.testing.assert_allclose(facts["view_spread_deg"], max(angles))
    assert 5 < facts["light_spread_deg"] < 20
    fine = np.concatenate(
        [correction((501, 401), patch, lamp, np.linalg.norm(lamp)).ravel() for lamp in lamps]
    )
    np.testing.assert_allclose(facts["correction_over_patch"], [fine.min(), fine.max()], rtol=0.01)


def test_eight_bit_pictures_are_linear_before_they_are_corrected(tmp_path):
    lamp, patch = np.array([10.0, 5, 20]), (12.0, 12.0)
    factor = correction((16, 16), patch, lamp, np.linalg.norm(lamp))
    codes = np.full((16, 16, 3), 128, np.uint8)
    codes[0, :5] = 255
    text = "name," + ",".join(pairs.COLUMNS["positions"]) + "\na.png,10,5,20,0,0,30\n"
    folder = put(tmp_path / "set", text, {"a": codes})
    (folder / "btfpipe.json").write_text('{"patch_cm": [12, 12]}')
    back, facts = read_back(folder, tmp_path / "s.npz")
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(back.pictures([0])[0, 1:, :, 0], factor[1:] * linear, rtol=1e-3)
    assert back.pictures([0]).max() > 1
    assert (facts["clipped_pixels"], facts["clipped_pictures"]) == (5, 1)
    assert facts["source_transfer"] == "srgb"


@pytest.mark.parametrize(
    ("lamp", "camera", "told"),
    [((0, 0, 30), (0, 0, 50), []), ((1, 0, 0.01), (0, 0, 50), ["light"]), ((0, 0, 30), (0, 0, 9), ["view"])],
)  # fmt: skip
def test_a_lamp_or_camera_too_near_for_one_direction_is_told(tmp_path, lamp, camera, told):
    row = ",".join(map(str, ("a.png", *lamp, *camera)))
    folder = put(tmp_path / "set", POSITIONS + row + "\n", {"a": np.full((4, 4, 3), 9, np.uint8)})
    _, facts = read_back(folder, tmp_path / "s.npz", patch_cm=(12.0, 12.0))
    warnings = facts.get("warnings", [])
    assert [warning.partition(" ")[0] for warning in warnings] == told
    assert all("degrees between the patch's middle and its corners" in w for w in warnings)


HEAD = "name,theta_l,phi_l,theta_v,phi_v\n"
POSITIONS = "name," + ",".join(pairs.COLUMNS["positions"]) + "\n"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "expected one .csv or .json"),
        ("name,tl\na.png,3\n", "expected one .csv or .json"),
        (HEAD, "lists no pictures"),
        (HEAD + "a.png,0,0,0\n", r"line 2 \('a.png'\): phi_v is missing; expected a number"),
        (HEAD + "\na.png,0,0,nan,0\n", r"line 3 \('a.png'\): theta_v is 'nan'"),
        ("\n" + HEAD + "a.png,0,0,0,1e999\n", r"line 3 \('a.png'\): phi_v is '1e999'"),
        (HEAD + " ,0,0,0,0\n", "line 2: has no name"),
        (HEAD + "a.png,0,0,95,0\n", "polar angle 95"),
        (HEAD + "b.png,0,0,0,0\n", r"1 of 1 pictures are not there \(first: 'b.png'\)"),
        (HEAD + "../a.png,0,0,0,0\n", "not there"),
        (HEAD + "/etc/passwd,0,0,0,0\n", "not there"),
        (HEAD + "a.png,0,0,0,0\na.png,10,0,0,0\n", "lists 'a.png' twice"),
        (HEAD + "a.png,0,0,0,0\nc.png,0,90,0,0\n", "pairs are there twice .*'a.png' and 'c.png'"),
        (HEAD.replace("\n", ",name\n") + "a.png,0,0,0,0,b\n", "expected one .csv or .json"),
        ("name,lx,ly,lz,vx,vy,vz\na.png,0,0,0,0,0,1\n", "light of 'a.png'"),
        ("name,lx,ly,lz,vx,vy,vz\na.png,0,0,1,0,0,-1\n", "view of 'a.png'"),
        ("name,lx,ly,lz,vx,vy,vz\na.png,0,0,1,1e300,0,1\n", "view of 'a.png'"),
        (POSITIONS + "a.png,1,2,0,0,0,9\n", "light of 'a.png'"),
        (POSITIONS + "a.png,1,2,5,0,0,9\n", "--patch-cm"),
    ],
)
def test_a_wrong_list_is_refused_with_the_reason(tmp_path, text, match):
    picture = np.zeros((4, 4, 3), np.uint8)
    folder = put(tmp_path / "set", text, {"a": picture, "c": picture})
    with pytest.raises(InputError, match=match):
        with pairs.open_measurement(folder):
            pass


def test_a_list_with_a_wrong_number_is_still_taken_for_one(tmp_path):
    picture = np.zeros((4, 4, 3), np.uint8)
    folder = put(tmp_path / "set", HEAD + "a.png,0,0,0,0\nc.png,1x,0,0,0\n", {"a": picture})
    for path in (folder, folder / "list.csv"):
        assert sources.recognise(path)[0] == "pairs"
    with pytest.raises(InputError, match=r"list\.csv, line 3 \('c\.png'\): theta_l is '1x'"):
        sources.open_source(folder, "pairs").__enter__()
    row = {"name": "a.png", "lx": 0, "ly": 0, "lz": 7, "vx": 1, "vy": 0}
    (folder / "list.json").write_text(json.dumps([row, row | {"vz": 1}]))
    assert sources.recognise(folder / "list.json")[0] == "pairs"
    with pytest.raises(InputError, match=r"picture 1 \('a\.png'\): vz is missing"):
        sources.open_source(folder / "list.json", "pairs").__enter__()
    assert sources.recognise(folder)[1].startswith("2 lists of pictures")


def test_a_patch_of_no_size_and_several_lists_are_refused(tmp_path):
    folder = put(
        tmp_path / "set", POSITIONS + "a.png,1,2,5,0,0,9\n", {"a": np.zeros((4, 4, 3), np.uint8)}
    )
    for size in ("[0, 3]", "[3]", '"x"', "[NaN, 3]"):
        (folder / "btfpipe.json").write_text('{"patch_cm": ' + size + "}")
        with pytest.raises(InputError, match="patch_cm is"), pairs.open_measurement(folder):
            pass
    (folder / "btfpipe.json").unlink()
    (folder / "other.csv").write_text(HEAD + "a.png,0,0,0,0\n")
    with pytest.raises(InputError, match=r"found list\.csv, other\.csv.*--listing"):
        with pairs.open_measurement(folder):
            pass
    with pairs.open_measurement(folder, listing="other.csv") as measurement:
        assert measurement.n_pairs == 1
    with (
        pytest.raises(InputError, match=r"no third\.csv"),
        pairs.open_measurement(folder, listing="third.csv"),
    ):
        pass  # fmt: skip
    with pytest.raises(InputError, match="not a list of pictures"):
        with pairs.open_measurement(folder, listing="a.png"):
            pass


def test_a_truncated_picture_and_a_lying_zip_are_refused_by_name(tmp_path, make_sample):
    write_pairs(tmp_path / "set.zip", make_sample(4, 4, lights=bonn81()[:2], views=bonn81()[:1]))
    with zipfile.ZipFile(tmp_path / "set.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["1.exr"] = members["1.exr"][:-30]
    with zipfile.ZipFile(tmp_path / "cut.zip", "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match=r"1\.exr: truncated"):
        read_back(tmp_path / "cut.zip", tmp_path / "s.npz")
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("directions.csv", " " * ((1 << 24) + 1))
    assert pairs.recognise(tmp_path / "bomb.zip") is None
    with pytest.raises(InputError, match="longer than"):
        with pairs.open_measurement(tmp_path / "bomb.zip", listing="directions.csv"):
            pass


def test_lists_are_recognised_and_other_things_are_not(tmp_path, make_sample, make_measurement):
    sample = make_sample(4, 4, lights=bonn81()[:2], views=bonn81()[:1])
    write_pairs(tmp_path / "set", sample)
    for path in (tmp_path / "set", tmp_path / "set/directions.csv"):
        assert pairs.recognise(path) == "directions.csv lists 2 pictures with vectors"
    bonns, _ = make_measurement()
    (tmp_path / "list.csv").write_bytes(b"\xff\0\xfe" * 20)
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for path in (
        bonns,
        tmp_path / "list.csv",
        tmp_path / "deep.json",
        tmp_path / "none.csv",
        __file__,
    ):
        assert pairs.recognise(path) is None
    assert utia.recognise(tmp_path / "set") is None


def test_mislabelled_pictures_are_the_same_however_often_they_are_read(tmp_path):
    n = 30
    folder = tmp_path / "set"
    folder.mkdir()
    rows = "".join(f"{i:02d}.jpg,{i},0,0,0\n" for i in range(n))
    (folder / "list.csv").write_text(HEAD + rows)
    data = encode_picture(np.zeros((4, 4, 3), np.uint8), ".png")
    for i in range(n):
        (folder / f"{i:02d}.jpg").write_bytes(data)
    with pairs.open_measurement(folder) as measurement:
        for pair in (*range(n)[::-1], *range(n)):
            measurement.read(pair)
        facts = ingest(measurement, tmp_path / "s.npz", threads=2)
    assert facts["n_mislabelled"] == n
    assert facts["mislabelled"] == [f"{i:02d}.jpg" for i in range(20)]
    described = describe_foreign(folder, threads=2)
    assert described["facts"]["mislabelled"] == facts["mislabelled"]
    (problem,) = described["problems"]
    assert problem.startswith("30 pictures are mislabelled: 00.jpg, 01.jpg,")
    json.dumps(described["facts"])
