"""CUReT: simulated sets written, read back and brought to the frontal view; and broken ones."""

import shutil
import struct
import zipfile

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from btfpipe.directions.curet import curet205
from btfpipe.errors import InputError
from btfpipe.formats import curet
from btfpipe.formats.archive import open_archive
from btfpipe.formats.compress_z import compress
from btfpipe.formats.curet_geometry import find_shifts, outline, resample
from btfpipe.formats.images import encode_picture, read_picture
from btfpipe.sample import Sample
from btfpipe.sample.appearance import Appearance
from btfpipe.sample.ingest import ingest

PAIRS = curet205()
FRAME = (112, 124)


class Coated(Appearance):
    """A Lambertian texture with a highlight."""

    toroidal, texels_per_mm, absolute = False, None, True

    def __init__(self, albedo):
        self.albedo = np.asarray(albedo, np.float32)
        self.shape = self.albedo.shape[:2]

    def values(self, light, view):
        """The picture of a pair, by the law."""
        half = (light + view) / np.linalg.norm(light + view)
        return (self.albedo + 0.1 * half[2] ** 30) * light[2]

    def shader(self, interpolation="barycentric"):
        return self

    def shade(self, row, col, w_i, w_o, out):
        assert (w_i == w_i[0]).all()
        assert (w_o == w_o[0]).all()
        picture = self.values(w_i[0], w_o[0])
        out[:] = picture[row.astype(int), col.astype(int)]


def smooth(rows, cols, seed=1, blur=2.5):
    noise = np.random.default_rng(seed).normal(size=(rows, cols, 3))
    noise = gaussian_filter(noise, (blur, blur, 0))
    return np.clip(0.5 + 0.15 * noise / noise.std(), 0.1, 0.85)


@pytest.fixture(scope="module")
def coated():
    return Coated(smooth(72, 72))


@pytest.fixture(scope="module")
def whole(coated, tmp_path_factory):
    """A whole set with everything that has to be fitted: path, shifts, and where the sample's middle is."""
    path = tmp_path_factory.mktemp("curet") / "sample11.zip"
    shifts = np.random.default_rng(5).uniform(-2, 2, (205, 2))
    scale = np.array([1, 1, 1.04, 1, 1, 1, 1])
    curet.write_curet(
        path, coated, 11, frame=FRAME, side=72, centre=(58, 60), shifts=shifts, camera_scale=scale,
        height=2.0, suffix=".png", threads=2,
    )  # fmt: skip
    return path, shifts, scale


def turn(index):
    """Change of (row, col) in the picture for one of (row, col) in the patch, by hand: (n, 2, 2)."""
    a = PAIRS.alpha[index] + PAIRS.camera[index] * np.pi / 8
    b = PAIRS.beta[index]
    # x = s cos a - t sin a sin b, y = t cos b; s = col, t = -row
    zero = np.zeros_like(a)
    return np.stack(
        [np.stack([np.cos(b), zero], -1), np.stack([np.sin(a) * np.sin(b), np.cos(a)], -1)], 1
    )


def numbers_of(measurement):
    return np.array([int(name.rsplit("-", 1)[1].split(".")[0]) for name in measurement.names])


FEW = (4, 30, 54, 60, 101, 120, 150, 174, 193)


@pytest.mark.parametrize("name", ["sample05", "set.zip"])
@pytest.mark.parametrize("suffix", [".bmp.Z", ".bmp", ".png"])
def test_a_written_set_read_back_has_the_appearances_pictures(coated, tmp_path, suffix, name):
    path = tmp_path / name
    curet.write_curet(
        path, coated, 5, suffix=suffix, frame=FRAME, side=72, numbers=FEW, offset=-0.02
    )
    with curet.open_measurement(path, side=72, size=72, register=False) as measurement:
        assert numbers_of(measurement).tolist() == list(FEW)
        assert measurement.white == 1
        for pair, number in enumerate(FEW):
            got = measurement.read(pair)
            assert got.dtype == np.float32
            light, view = PAIRS.light[number - 1], PAIRS.view[number - 1]
            np.testing.assert_array_equal(
                measurement.light_directions[measurement.light_index[pair]], light
            )
            np.testing.assert_array_equal(
                measurement.view_directions[measurement.view_index[pair]], view
            )
            want = coated.values(light, view)
            error = (got - want)[6:-6, 6:-6]
            # pixels of a tilted sample hold up to 1 / cos texels: blurred twice
            assert abs(error.mean()) < 0.003
            assert error.std() < 0.35 * want.std()
            assert error.std() < 0.1 * want.std() or view[2] < 0.6


def test_rectified_pictures_agree_with_a_resampling_written_apart(coated, tmp_path):
    few = FEW[::3]  # too few to fit anything
    curet.write_curet(tmp_path / "sample05", coated, 5, frame=FRAME, side=72, numbers=few)
    with (
        curet.open_measurement(tmp_path / "sample05", side=72, size=72, register=False) as flat,
        curet.open_measurement(tmp_path / "sample05", rectify=False) as raw,
    ):
        at = np.stack(np.meshgrid(*2 * [np.arange(72) - 35.5], indexing="ij")).reshape(2, -1)
        for pair, number in enumerate(few):
            picture = raw.read(pair)
            assert picture.shape == (*FRAME, 3)
            where = turn(np.array([number - 1]))[0] @ at + (np.array(FRAME)[:, None] - 1) / 2
            for c in range(3):
                want = map_coordinates(picture[..., c], where, order=1, mode="nearest")
                got = flat.read(pair)[..., c]
                np.testing.assert_allclose(got.ravel(), want, atol=1e-5)


def test_centre_height_scale_and_shifts_are_found(whole, coated):
    path, shifts, scale = whole
    with curet.open_measurement(path, threads=2) as measurement:
        facts = measurement.facts
        used = numbers_of(measurement) - 1
        assert facts["sample_rows_pixels"] == pytest.approx(72, abs=1.2)
        assert facts["sample_cols_pixels"] == pytest.approx(72, abs=1.2)
        assert facts["shear"] == pytest.approx(1, abs=0.02)
        assert facts["camera_scale"]["3"] == pytest.approx(1.04, abs=0.01)
        assert all(facts["camera_scale"][k] == 1 for k in "124567")
        assert facts["registered"] >= 0.95 * len(used)
        assert facts["radiometry"] == "acal.dat"
        found = np.array(facts["shifts"])[:, 1:]
        assert [row[0] - 1 for row in facts["shifts"]] == used.tolist()
        # where the sample's middle is seen, by the reader and in truth
        sine = np.sin(PAIRS.beta[used])
        across = np.sin(PAIRS.alpha[used] + PAIRS.camera[used] * np.pi / 8) * np.cos(
            PAIRS.beta[used]
        )
        k = scale[PAIRS.camera[used] - 1]
        seen = np.array([-sine, across]).T * k[:, None]
        centre = np.array([facts["centre_row"], facts["centre_col"]])
        read = centre + facts["surface_height_pixels"] * seen + found
        true = np.array([58, 60]) + 2.0 * seen + shifts[used]
        turns = turn(used) * k[:, None, None]
        # which point of the sample the patch is centred on is free
        point = np.linalg.lstsq(turns.reshape(-1, 2), (true - read).ravel(), rcond=None)[0]
        assert np.abs(point).max() < 1
        error = np.linalg.norm(true - read - turns @ point, axis=1)
        assert np.median(error) < 0.15
        assert np.quantile(error, 0.95) < 0.5
        # and so pictures of all directions show one texel in one place
        texels, side = 64, facts["patch_side_pixels"]
        assert measurement.read(0).shape == (texels, texels, 3)
        at = (np.arange(texels) - (texels - 1) / 2) * side / texels + 35.5
        where = np.meshgrid(at - point[0], at - point[1], indexing="ij")
        scores = []
        for pair in range(len(used)):
            want = coated.values(PAIRS.light[used[pair]], PAIRS.view[used[pair]])
            want = map_coordinates(want[..., 1], where, order=1)
            scores.append(np.corrcoef(measurement.read(pair)[..., 1].ravel(), want.ravel())[0, 1])
        assert np.quantile(scores, 0.05) > 0.95


def test_a_picture_whose_texture_is_not_recognised_is_not_shifted(rng):
    texture = smooth(60, 60, blur=1.5)[..., 0] * 200
    greys = [texture.astype(np.uint8) for _ in range(8)]
    greys[3] = np.roll(greys[3], (2, -1), (0, 1))
    greys[5] = (gaussian_filter(rng.normal(size=(60, 60)), 1.5) * 200 + 100).astype(np.uint8)
    affines = np.tile([[1.0, 0, 6], [0, 1, 6]], (8, 1, 1))
    frontal = np.tile([0.0, 0, 1], (8, 1))
    shifts, registered = find_shifts(greys, affines, frontal, frontal, 48)
    assert registered.tolist() == [True] * 5 + [False] + [True] * 2
    want = np.zeros((8, 2))
    want[3] = 2, -1
    np.testing.assert_allclose(shifts, want, atol=0.05)


def test_the_number_of_threads_changes_nothing(whole):
    with (
        curet.open_measurement(whole[0], view_limit_deg=25, threads=1) as one,
        curet.open_measurement(whole[0], view_limit_deg=25, threads=3) as three,
    ):
        assert one.facts == three.facts
        np.testing.assert_array_equal(one.read(5), three.read(5))


def test_oblique_views_are_dropped_and_counted(whole):
    with curet.open_measurement(whole[0], view_limit_deg=30, register=False) as measurement:
        used = numbers_of(measurement)
        assert len(used) == int((PAIRS.view[:, 2] >= np.cos(np.radians(30)) - 1e-9).sum())
        assert len(measurement.facts["dropped"]) == 205 - len(used)
        assert measurement.facts["largest_shift_pixels"] == 0
        assert measurement.facts["registered"] == 0
        assert measurement.facts["missing"] == []


def test_an_arrow_comes_out_upright_and_not_mirrored_for_every_camera(tmp_path):
    albedo = np.full((40, 40, 3), 0.2)
    albedo[8:34, 17:22] = 0.9  # shaft
    for i in range(8):
        albedo[6 + i, 19 - i : 20 + i + 1] = 0.9  # head, up
    albedo[28:34, 22:32] = 0.6  # flag, to the lower right
    numbers = [*range(1, 200, 3), *range(200, 206)]
    curet.write_curet(
        tmp_path / "sample01", Coated(albedo), 1, frame=(72, 72), side=48, suffix=".png", numbers=numbers,
    )  # fmt: skip
    with curet.open_measurement(
        tmp_path / "sample01", side=48, size=40, centre=(35.5, 35.5), register=False, view_limit_deg=85
    ) as measurement:  # fmt: skip
        assert sorted(set(PAIRS.camera[numbers_of(measurement) - 1])) == [1, 2, 3, 4, 5, 6, 7]
        flat = albedo[..., 0]
        variants = [flat, flat[::-1], flat[:, ::-1], flat[::-1, ::-1], flat.T, flat[::-1].T]
        for pair in range(measurement.n_pairs):
            got = measurement.read(pair)[..., 0].ravel()
            scores = [np.corrcoef(got, v.ravel())[0, 1] for v in variants]
            assert np.argmax(scores) == 0
            view = PAIRS.view[numbers_of(measurement)[pair] - 1]
            assert scores[0] > (0.9 if view[2] > 0.26 else 0.6)


def rewrite(path, change):
    """Change the pictures of a folder."""
    for file in sorted(path.rglob("*.png")):
        file.write_bytes(encode_picture(np.ascontiguousarray(change(read_picture(file))), ".png"))


def test_mirrored_pictures_are_refused(coated, tmp_path):
    path = tmp_path / "sample05"
    numbers = range(4, 205, 8)
    curet.write_curet(path, coated, 5, suffix=".png", frame=FRAME, side=60, numbers=numbers)
    rewrite(path, lambda picture: picture[:, ::-1])
    with pytest.raises(InputError, match="mirrored"):
        with curet.open_measurement(path):
            pass


def test_cropped_pictures_without_outline_are_read_around_their_middle(coated, tmp_path):
    path = tmp_path / "sample05"
    numbers = [n for n in range(1, 206) if PAIRS.view[n - 1, 2] > 0.6][1::3]
    assert 54 in numbers
    curet.write_curet(path, coated, 5, suffix=".png", frame=FRAME, side=72, numbers=numbers)
    rewrite(path, lambda picture: picture[41:-41, 47:-47])
    with curet.open_measurement(path) as measurement:
        facts = measurement.facts
        assert (facts["outlines"], facts["sample_rows_pixels"]) == (0, None)
        assert (facts["centre_row"], facts["centre_col"]) == (14.5, 14.5)
        assert 18 < facts["patch_side_pixels"] <= 30
        assert facts["camera_scale"]["1"] == 1
        frontal = numbers_of(measurement).tolist().index(54)
        want = coated.values(PAIRS.light[53], PAIRS.view[53])
        n = measurement.read(frontal).shape[0] // 2
        got = measurement.read(frontal)[n - 6 : n + 6, n - 6 : n + 6]
        np.testing.assert_allclose(got, want[30:42, 30:42], atol=0.15)
        assert np.corrcoef(got.ravel(), want[30:42, 30:42].ravel())[0, 1] > 0.9


def test_without_calibration_values_are_codes_and_the_scale_is_unknown(coated, tmp_path):
    curet.write_curet(tmp_path / "s", coated, 5, frame=FRAME, numbers=[54], calibrated=False)
    with (
        curet.open_measurement(tmp_path / "s", rectify=False) as raw,
        curet.open_measurement(tmp_path / "s", side=40, size=40) as flat,
    ):
        codes = raw.read(0)
        assert codes.dtype == np.uint8
        assert (raw.white, flat.white) == (None, None)
        assert raw.transfer(codes) == flat.transfer(flat.read(0)) == "linear"
        assert raw.facts["radiometry"] == "none"
        mean = codes[40:72, 46:78].mean() / 255
        assert flat.read(0).mean() == pytest.approx(mean, rel=0.05)


@pytest.mark.parametrize("sample", [1, 8, 9, 44, 45, 61])
def test_value_is_pi_radiance_over_the_lamps_irradiance(tmp_path, sample):
    e0 = {1: 9.56379, 8: 9.56379, 9: 57.664, 44: 57.664, 45: 13.0799, 61: 13.0799}[sample]
    folder = tmp_path / f"sample{sample}"
    folder.mkdir()
    codes = np.random.default_rng(2).integers(0, 256, (6, 8, 3), np.uint8)
    (folder / f"{sample:02d}-017.png").write_bytes(encode_picture(codes, ".png"))
    acal = "".join(f"{0.001 * n} {0.01 * n}\n" for n in range(1, 62))
    (tmp_path / "acal.dat").write_text(acal)  # beside the set, rows by place
    with curet.open_measurement(folder, rectify=False) as measurement:
        radiance = 0.001 * sample * codes.astype(float) + 0.01 * sample
        np.testing.assert_allclose(measurement.read(0), np.pi * radiance / e0, rtol=1e-6)
        assert (measurement.white, measurement.facts["radiometry"]) == (1.0, "acal.dat")
    gains, offsets = np.array([0.1, 0.2, 0.3]), np.array([-0.1, 0, 0.1])
    row = " ".join(f"{g} {o}" for g, o in zip(gains, offsets, strict=True))
    (folder / "ccal.dat").write_text(f"{sample} {row}\n")  # in the set, row by number; goes first
    with curet.open_measurement(folder, rectify=False) as measurement:
        radiance = gains * codes + offsets
        np.testing.assert_allclose(measurement.read(0), np.pi * radiance / e0, rtol=1e-6, atol=1e-7)
        assert measurement.facts["radiometry"] == "ccal.dat"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "rows of finite numbers"),
        ("1 2\n3\n", "all of one length"),
        ("1 nan\n", "finite"),
        ("a b\n", "not a table"),
        ("1 2 3 4\n", "4 numbers a row; expected 2"),
        ("1 2\n", "0 rows for sample 5"),
        ("5 1 2\n5 1 2\n", "2 rows for sample 5"),
        ("5 -1 2\n", "gain of sample 5 is -1"),
        ("5 1 2\n" + " " * (1 << 20), "longer than 1048576 bytes; expected a table"),
    ],
)
def test_damaged_calibrations_are_refused_by_name(coated, tmp_path, text, match):
    curet.write_curet(tmp_path / "sample05", coated, 5, frame=FRAME, numbers=[54])
    (tmp_path / "sample05/acal.dat").write_text(text)
    with pytest.raises(InputError, match=rf"acal\.dat: .*{match}"):
        with curet.open_measurement(tmp_path / "sample05"):
            pass


def test_a_calibration_needs_the_samples_number(coated, tmp_path):
    curet.write_curet(tmp_path / "s", coated, 5, frame=FRAME, numbers=[54], suffix=".png")
    (tmp_path / "t").mkdir()
    shutil.copy(tmp_path / "s/sample05/05-054.png", tmp_path / "t/054.png")
    shutil.copy(tmp_path / "s/acal.dat", tmp_path / "t/acal.dat")
    with pytest.raises(InputError, match="no name tells which"):
        with curet.open_measurement(tmp_path / "t"):
            pass
    with curet.open_measurement(tmp_path / "t", sample_number=5, side=40) as measurement:
        assert measurement.white == 1


def test_mean_brdfs_agree_with_a_table_of_known_answers(coated, tmp_path):
    path = tmp_path / "sample05"
    curet.write_curet(path, coated, 5, suffix=".png", frame=FRAME, side=72, numbers=FEW)
    # f = value / (pi cos theta_i)
    means = [
        coated.values(light, view).mean() / np.pi / light[2]
        for light, view in zip(PAIRS.light, PAIRS.view, strict=True)
    ]
    table = tmp_path / "abrdf.dat"
    table.write_text("4 " + "1 " * 205 + "\n5 " + " ".join(f"{x:.6f}" for x in means) + "\n")
    published = curet.read_brdf_table(table)
    assert sorted(published) == [4, 5]
    with curet.open_measurement(path, side=68) as measurement:
        ratios = curet.brdf_ratios(measurement, published[5])
        assert len(ratios) == len(FEW)
        np.testing.assert_allclose(ratios, 1, atol=0.03)
        # out of order they do not
        assert np.abs(curet.brdf_ratios(measurement, published[5][::-1]) - 1).max() > 0.05
    table.write_text("5 1 2 3\n")
    with pytest.raises(InputError, match="4 numbers a row; expected 206"):
        curet.read_brdf_table(table)


@pytest.mark.measured
def test_the_published_brdfs_are_read(measured_data):
    table = curet.read_brdf_table(measured_data / "btf/curet_tables/abrdf.dat")
    assert sorted(table) == list(range(1, 62))
    assert table[1][:3].tolist() == [0.200, 0.110, 0.199]


def test_an_incomplete_set_becomes_a_sample_that_is_a_list_of_pairs(whole, tmp_path):
    with zipfile.ZipFile(whole[0]) as archive:
        archive.extractall(tmp_path / "sample11")
    for number in range(1, 206):
        if number % 5:
            (tmp_path / f"sample11/sample11/11-{number:03d}.png").unlink()
    with curet.open_measurement(tmp_path / "sample11", size=32) as measurement:
        assert measurement.facts["missing"] == [n for n in range(1, 206) if n % 5]
        facts = ingest(measurement, tmp_path / "a.sample.npz", threads=2)
        expected = measurement.read(3)
    sample = Sample.open(tmp_path / "a.sample.npz")
    assert (sample.shape, sample.absolute, sample.is_product) == ((32, 32), True, False)
    assert facts["n_missing"] == 164
    assert len(sample.light_directions) <= sample.n_pairs <= 41
    np.testing.assert_array_equal(sample.pictures([3])[0], expected)


def test_larger_texels_are_means_of_pixels():
    picture = np.random.default_rng(0).integers(0, 256, (20, 24, 3), np.uint8)
    out = np.empty((5, 6, 3), np.float32)
    affine = np.array([[4, 0, 1.5], [0, 4, 1.5]])
    resample(picture, affine, 4, out)
    np.testing.assert_allclose(out, picture.reshape(5, 4, 6, 4, 3).mean(axis=(1, 3)), atol=1e-3)


def test_an_outline_has_the_moments_of_the_parallelogram():
    grey = np.zeros((100, 120), np.uint8)
    row, col = np.indices(grey.shape)
    t, s = 52 - row, col - 61 + 0.4 * (52 - row)
    grey[(np.abs(s) < 30) & (np.abs(t) < 20)] = 150
    (at_row, at_col), covariance = outline(grey)
    assert (at_row, at_col) == pytest.approx((52, 61), abs=0.1)
    # x = s - 0.4 t, y = t
    want = np.array([[60**2 + 0.16 * 40**2, -0.4 * 40**2], [-0.4 * 40**2, 40**2]]) / 12
    np.testing.assert_allclose(covariance, want, rtol=0.06)
    assert outline(np.roll(grey, 40, axis=1)) is None  # cut by the frame
    assert outline(np.full_like(grey, 90)) is None
    assert outline(np.where(np.hypot(s, t) < 25, 150, 0).astype(np.uint8)) is None  # an ellipse


def test_sets_are_recognised_by_their_names(coated, whole, tmp_path, make_measurement):
    assert "205 pictures" in curet.recognise(whole[0])
    curet.write_curet(tmp_path / "x", coated, 5, frame=FRAME, numbers=[54])
    assert "05-054.bmp.Z" in curet.recognise(tmp_path / "x")
    assert curet.recognise(make_measurement("sample03")[0]) is None  # Bonn's names
    plain = tmp_path / "plain"
    plain.mkdir()
    assert curet.recognise(plain) is None
    for i in range(3):
        (plain / f"photo{i + 1}.png").write_bytes(b"")
    assert curet.recognise(plain) is None
    named = plain.rename(tmp_path / "sample07")
    assert "sampleNN" in curet.recognise(named)
    (named / "lights.lp").write_bytes(b"")
    assert curet.recognise(named) is None
    (tmp_path / "bad.zip").write_bytes(b"PK\x03\x04")
    assert curet.recognise(tmp_path / "bad.zip") is None


def test_strays_are_listed_and_otherwise_ignored(coated, tmp_path):
    path = tmp_path / "sample05"
    curet.write_curet(path, coated, 5, frame=FRAME, numbers=[54])
    for stray in (".xvpics/05-054.bmp.Z", "sample05/.xvpics/05-001.bmp", "cover.png", "readme.1"):
        (path / stray).parent.mkdir(exist_ok=True)
        (path / stray).write_bytes(b"x")
    with curet.open_measurement(path, side=40) as measurement:
        assert measurement.n_pairs == 1
        assert len(measurement.facts["strays"]) == 4


SPOILT = {
    "number 0": (lambda f: f.with_name("05-000.bmp.Z"), None, "none of CUReT's 1 to 205"),
    "number 206": (lambda f: f.with_name("05-206.bmp.Z"), None, "none of CUReT's 1 to 205"),
    "twice": (lambda f: f.with_name("05-54.bmp.Z"), None, "there twice"),
    "cut in the magic": (None, lambda d: d[:2], "no file of Unix compress|not a readable"),
    "cut in the header": (None, lambda d: d[:20], "truncated, or no BMP inside"),
    "cut after the header": (None, lambda d: d[:200], r"truncated; holds \d+ of 41718 bytes"),
    "cut at the end": (None, lambda d: d[:-40], r"truncated; holds \d+ of 41718 bytes"),
    "impossible code": (None, lambda d: d[:3] + b"\xff\xff" + d[5:], "stands for nothing"),
    "empty": (None, lambda d: b"", "empty"),
    "no BMP inside": (None, lambda d: compress(b"PK" + bytes(100)), "no BMP inside"),
    "huge size": (
        None,
        lambda d: compress(struct.pack("<2sI4xIIiiHH", b"BM", 54, 54, 40, 30000, 30000, 1, 24) + bytes(99)),
        "declares 30000 x 30000 pixels",
    ),
    "bomb": (
        None,
        lambda d: compress(struct.pack("<2sI4xIIiiHH", b"BM", 66, 54, 40, 2, 2, 1, 24) + bytes(10**7)),
        "more than the .* bytes expected",
    ),
    "another size": (
        None,
        lambda d: compress(encode_picture(np.full((9, 9, 3), 99, np.uint8), ".bmp")),
        "has 9 x 9 pixels; the first picture",
    ),
    "deep": (
        None,
        lambda d: encode_picture(np.zeros((*FRAME, 3), np.uint16), ".png"),
        "holds uint16 values",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", SPOILT)
def test_broken_sets_are_refused_by_name(coated, tmp_path, kind):
    path = tmp_path / "sample05"
    curet.write_curet(path, coated, 5, frame=FRAME, numbers=[54, 30])
    file = path / "sample05/05-054.bmp.Z"
    name, change, match = SPOILT[kind]
    if name is not None:
        shutil.copy(file, name(file))
        match = f"sample05.*{match}"
    else:
        file.write_bytes(change(file.read_bytes()))
        match = f"05-054.bmp.Z: .*({match})"
    with pytest.raises(InputError, match=match):
        with curet.open_measurement(path, side=40) as measurement:
            measurement.read(0)


def test_a_bmp_may_be_padded_and_carry_any_name(coated, tmp_path):
    path = tmp_path / "sample05"
    curet.write_curet(path, coated, 5, frame=FRAME, numbers=[54], suffix=".bmp")
    file = path / "sample05/05-054.bmp"
    data = file.read_bytes()
    assert curet.unpack_bmp(compress(data + b"\0\0"), "x") == data + b"\0\0"
    file.write_bytes(compress(data))  # packed, though its name does not say so
    with curet.open_measurement(path, side=40) as measurement:
        assert measurement.read(0).shape == (40, 40, 3)
        assert measurement.facts["mislabelled"] == set()
    file.write_bytes(encode_picture(read_picture(data), ".png"))
    with curet.open_measurement(path, side=40) as measurement:
        measurement.read(0)
        assert measurement.facts["mislabelled"] == {"sample05/05-054.bmp"}


def test_sets_without_usable_pictures_or_room_for_the_patch_are_refused(coated, tmp_path):
    with pytest.raises(InputError, match=r"no numbered pictures .*01-001"):
        with curet.open_measurement(tmp_path):
            pass
    path = tmp_path / "sample05"
    curet.write_curet(path, coated, 5, frame=FRAME, numbers=[4])
    with pytest.raises(InputError, match="none of its 1 pictures is seen within 60 degrees"):
        with curet.open_measurement(path, view_limit_deg=60):
            pass
    with pytest.raises(InputError, match=r"05-004.*patch of 150\.0 pixels a side leaves"):
        with curet.open_measurement(path, side=150, centre=(56, 62)):
            pass
    with pytest.raises(InputError, match="cannot be cut out"):
        with curet.open_measurement(path, centre=(0, 0)):
            pass


def test_the_writer_refuses_what_is_no_curet(coated, tmp_path):
    with pytest.raises(InputError, match="1 to 61"):
        curet.write_curet(tmp_path / "x", coated, 62)
    with pytest.raises(InputError, match=r"\.tif: no ending"):
        curet.write_curet(tmp_path / "x", coated, 1, suffix=".tif")
    with pytest.raises(InputError, match="was not written by btfpipe"):
        curet.write_curet(tmp_path, coated, 1, frame=FRAME, numbers=[1])
    assert list(tmp_path.iterdir()) == []


def test_the_writer_counts_what_it_clips(coated, tmp_path):
    facts = curet.write_curet(
        tmp_path / "x", coated, 5, frame=FRAME, numbers=[54], largest_value=0.5
    )
    assert facts["clipped_pixels"] > 100
    with curet.open_measurement(tmp_path / "x", side=40) as measurement:
        assert measurement.facts["source_clipped_pixels"] >= facts["clipped_pixels"]


def test_a_scale_that_is_not_known_is_not_claimed(coated, tmp_path):
    for absolute, factor in ((False, 0.3), (False, 5), (True, 0.3), (True, 5)):
        other = Coated(coated.albedo)
        other.absolute = absolute
        other.values = lambda light, view, f=factor: f * coated.values(light, view)
        path = tmp_path / f"{absolute}{factor}"
        facts = curet.write_curet(path, other, 5, frame=FRAME, suffix=".png", numbers=[54, 60])
        largest = factor * max(coated.values(PAIRS.light[n], PAIRS.view[n]).max() for n in (53, 59))
        expected = max(largest, 1) if absolute else largest
        np.testing.assert_allclose(facts["largest_value"], expected, rtol=1e-6)
        assert facts["clipped_pixels"] == 0
        assert (path / "acal.dat").exists() == facts["calibrated"] == absolute
        with (
            curet.open_measurement(path, rectify=False) as measurement,
        ):
            assert measurement.white == (1 if absolute else None)
            brightest = max(measurement.read(0).max(), measurement.read(1).max())
            reached = brightest if absolute else brightest / 255 * largest
            assert 0.9 * largest < reached < 1.01 * largest


def test_a_set_of_our_own_is_written_over_and_nothing_else_is(coated, tmp_path):
    path = tmp_path / "sample05"
    curet.write_curet(path, coated, 5, frame=FRAME, numbers=[54, 60])
    curet.write_curet(path, coated, 5, frame=FRAME, numbers=[30])
    with curet.open_measurement(path, rectify=False) as measurement:
        assert numbers_of(measurement).tolist() == [30]
        assert measurement.facts["strays"] == []
    with pytest.raises(InputError, match="expected a larger one"):
        curet.write_curet(path, coated, 5, frame=FRAME, numbers=[54], offset=2.0)
    assert [p.name for p in (path / "sample05").iterdir()] == ["05-030.bmp.Z"]


def test_the_listing_finds_the_samples_number(coated, tmp_path):
    curet.write_curet(tmp_path / "x.zip", coated, 33, frame=FRAME, numbers=[54, 60])
    with open_archive(tmp_path / "x.zip") as archive:
        listing = curet.Listing(archive)
    assert listing.sample_number == 33
    assert list(listing.pictures) == [54, 60]
    assert list(listing.calibrations) == ["acal.dat"]
