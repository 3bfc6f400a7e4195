import json

import numpy as np
import pytest

from btfpipe.directions import from_angles
from btfpipe.errors import InputError
from btfpipe.formats import pairs, ubo
from btfpipe.formats.images import encode_picture
from btfpipe.sample import Sample
from btfpipe.sample.ingest import drift_gain
from btfpipe.sample.ingest import ingest as ingest_measurement
from btfpipe.sample.measurement import Measurement, frontal


@pytest.fixture
def ingest(tmp_path):
    """Ingest a set and open the result."""

    def run(path, out="s.sample.npz", pairs=False, **options):
        with ubo.open_measurement(path, pairs=pairs) as measurement:
            facts = ingest_measurement(measurement, tmp_path / out, **options)
        return Sample.open(tmp_path / out), facts

    return run


def test_pictures_are_stored_code_for_code(make_measurement, ingest):
    path, codes = make_measurement()
    sample, facts = ingest(path)
    assert sample.is_product
    assert sample.transfer == facts["source_transfer"] == "srgb"
    assert sample.codes.dtype == np.uint8
    np.testing.assert_array_equal(sample.codes, codes.reshape(6, 6, 8, 3))


def test_one_view_under_many_lights_is_a_product(make_measurement, ingest):
    sample, _ = ingest(make_measurement(views=((0, 0),))[0])
    assert (len(sample.view_directions), len(sample.light_directions)) == (1, 3)
    assert sample.is_product


def test_pairs_that_are_no_product_are_kept_as_a_list(make_measurement, ingest):
    path, _ = make_measurement(change=lambda m: m.pop(next(iter(m))))
    sample, facts = ingest(path, pairs=True)
    assert sample.n_pairs == 5
    assert not sample.is_product
    assert not facts["product"]


def test_unclipped_values_survive(make_measurement, ingest):
    path, codes = make_measurement(suffix=".exr", dtype=np.float16)
    sample, _ = ingest(path)
    assert codes.max() > 3
    assert sample.codes.dtype == np.float16
    np.testing.assert_array_equal(sample.pictures(slice(None)), codes.reshape(6, 6, 8, 3))


def test_sixteen_bits_survive(make_measurement, ingest):
    path, codes = make_measurement(dtype=np.uint16)
    sample, _ = ingest(path, transfer="linear")
    expected = codes.reshape(6, 6, 8, 3) / 65535
    np.testing.assert_allclose(sample.pictures(slice(None)), expected, atol=1e-7)


def test_sixteen_bits_are_decoded_by_their_curve(make_measurement, ingest):
    path, codes = make_measurement(dtype=np.uint16)
    sample, _ = ingest(path, transfer="gamma2.2")
    expected = (codes.reshape(6, 6, 8, 3) / 65535) ** 2.2
    np.testing.assert_allclose(sample.pictures(slice(None)), expected, atol=1e-6)


def test_crop_keeps_the_named_part(make_measurement, ingest):
    path, codes = make_measurement()
    sample, _ = ingest(path, crop=(1, 2, 3, 4))
    np.testing.assert_array_equal(sample.codes, codes.reshape(6, 6, 8, 3)[:, 1:4, 2:6])


def test_resizing_averages_light_and_not_codes(make_measurement, ingest):
    path, codes = make_measurement(shape=(6, 8))
    sample, _ = ingest(path, size=(3, 4), transfer="gamma2.2")
    linear = (codes.reshape(6, 6, 8, 3) / 255) ** 2.2
    mean = linear.reshape(6, 3, 2, 4, 2, 3).mean(axis=(2, 4))
    error = sample.codes - 255 * mean ** (1 / 2.2)
    assert np.abs(error).max() < 0.51
    wrong = codes.reshape(6, 3, 2, 4, 2, 3).mean(axis=(2, 4)) - 255 * mean ** (1 / 2.2)
    assert np.abs(wrong).max() > 5


def test_texels_per_mm_follows_the_size(make_measurement, ingest):
    path, _ = make_measurement()
    assert ingest(path, texels_per_mm=10.0)[0].texels_per_mm == 10
    assert ingest(path, texels_per_mm=10.0, size=(3, 4))[0].texels_per_mm == 5
    assert ingest(path, texels_per_mm=10.0, size=(6, 4))[0].texels_per_mm is None


def test_white_makes_the_scale_absolute(make_measurement, ingest):
    path, _ = make_measurement(suffix=".exr", dtype=np.float16)
    unknown, _ = ingest(path)
    known, _ = ingest(path, white=0.25)
    assert not unknown.absolute
    assert known.absolute
    np.testing.assert_allclose(known.pictures([3]), 4 * unknown.pictures([3]))


def test_a_grey_card_gives_its_reflectance(tmp_path, ingest):
    """A Lambertian card of known reflectance comes out as that reflectance times the cosine."""
    lights = ((20, 0), (60, 0))
    for number, (theta, phi) in enumerate(lights):
        picture = np.full((8, 8, 3), 0.1, np.float32)
        picture[2:5, 3:6] = 1.7 * 0.18 * np.cos(np.radians(theta))
        name = ubo.pair_name(number, (theta, phi), (0, 0), ".exr").split("/")[1]
        (tmp_path / name).write_bytes(encode_picture(picture, ".exr"))
    sample, _ = ingest(tmp_path, grey_card=(2, 3, 3, 3), grey_card_reflectance=0.18)
    assert sample.absolute
    card = sample.pictures(slice(None))[:, 3, 4, 0]
    np.testing.assert_allclose(card, 0.18 * np.cos(np.radians([20, 60])), rtol=1e-5)


def test_a_clipped_grey_card_is_refused(make_measurement, ingest):
    def change(members):
        for name in members:
            members[name] = encode_picture(np.full((6, 8, 3), 255, np.uint8), ".png")

    path, _ = make_measurement(change=change)
    with pytest.raises(InputError, match="grey card is clipped"):
        ingest(path, grey_card=(0, 0, 2, 2), grey_card_reflectance=0.5)


def test_a_black_grey_card_is_refused(make_measurement, ingest):
    def change(members):
        for name in members:
            members[name] = encode_picture(np.zeros((6, 8, 3), np.uint8), ".png")

    path, _ = make_measurement(change=change)
    with pytest.raises(InputError, match="has the mean 0"):
        ingest(path, grey_card=(0, 0, 2, 2), grey_card_reflectance=0.5)


def test_settings_of_the_source_are_taken_and_overruled(make_measurement, ingest):
    settings = {"white": 0.5, "transfer": "linear", "toroidal": True, "texels_per_mm": 4.0}
    path, _ = make_measurement(change=lambda m: m.update({"btfpipe.json": json.dumps(settings)}))
    sample, _ = ingest(path)
    assert (sample.scale, sample.transfer, sample.toroidal) == (2, "linear", True)
    assert (sample.texels_per_mm, sample.absolute) == (4, True)
    other, _ = ingest(path, white=0.25, transfer="srgb", toroidal=False, texels_per_mm=8.0)
    assert (other.scale, other.transfer, other.toroidal) == (4, "srgb", False)
    assert other.texels_per_mm == 8


def test_a_crop_breaks_the_repeat(make_measurement, ingest):
    path, _ = make_measurement(change=lambda m: m.update({"btfpipe.json": '{"toroidal": true}'}))
    assert ingest(path)[0].toroidal
    assert not ingest(path, crop=(0, 0, 3, 3))[0].toroidal
    assert ingest(path, crop=(0, 0, 3, 3), toroidal=True)[0].toroidal


def test_clipped_pixels_are_counted_inside_the_crop(make_measurement, ingest):
    def change(members):
        picture = np.full((6, 8, 3), 100, np.uint8)
        picture[0, 0] = 255
        picture[3, 3, 1] = 255
        picture[3, 4] = 255
        for name in members:
            members[name] = encode_picture(np.full((6, 8, 3), 100, np.uint8), ".png")
        members[name] = encode_picture(picture, ".png")

    path, _ = make_measurement(change=change)
    for options, pixels in (({}, 3), ({"crop": (2, 2, 3, 3)}, 2), ({"size": (3, 4)}, 3)):
        _, facts = ingest(path, **options)
        assert (facts["clipped_pixels"], facts["clipped_pictures"]) == (pixels, 1)


def test_flatten_removes_a_slow_drift_and_keeps_the_pattern(tmp_path, ingest):
    y, x = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 48), indexing="ij")
    pattern = 0.4 + 0.1 * np.sign(np.sin(10 * x) * np.sin(9 * y))
    drift = 1 + 0.25 * x - 0.15 * y + 0.1 * x * x
    colour = np.array([1.0, 0.8, 0.5])
    for phi in (0, 90):
        picture = ((pattern * drift)[..., None] * colour).astype(np.float32)
        name = f"tl30 pl{phi} tv0 pv0.exr"
        (tmp_path / name).write_bytes(encode_picture(picture, ".exr"))
    plain, _ = ingest(tmp_path, "plain.npz")
    flat, facts = ingest(tmp_path, "flat.npz", flatten=True)

    def residue(sample):
        ratio = sample.pictures([0])[0, ..., 0] / pattern
        return ratio.max() / ratio.min() - 1

    assert residue(plain) > 0.7
    assert residue(flat) < 0.15 * residue(plain)
    assert facts["drift"] == pytest.approx(drift.max() / drift.min() - 1, rel=0.1)
    np.testing.assert_allclose(
        flat.pictures([0]).mean(axis=(0, 1, 2)), plain.pictures([0]).mean(axis=(0, 1, 2)), rtol=0.03
    )
    np.testing.assert_allclose(flat.texels([3], [7])[0, 0], flat.pictures([0])[0, 3, 7])


def test_flatten_refuses_what_is_no_slow_drift():
    mean = np.ones((8, 8, 3))
    mean[:, :4] = 0.0
    with pytest.raises(InputError, match="no slow drift"):
        drift_gain(mean)


def test_flatten_refuses_a_patch_that_repeats(make_measurement, ingest):
    path, _ = make_measurement()
    with pytest.raises(InputError, match="repeats"):
        ingest(path, flatten=True, toroidal=True)


@pytest.mark.parametrize("options", [{}, {"size": (5, 7)}, {"flatten": True}])
def test_the_number_of_threads_never_shows(
    make_measurement, ingest, tmp_path, monkeypatch, options
):
    monkeypatch.setattr("btfpipe.sample.ingest._BLOCK_BYTES", 1)  # a block for each picture
    lights = [(15, phi) for phi in range(0, 360, 15)]
    path, _ = make_measurement(lights=lights)
    for threads in (1, 4):
        ingest(path, f"{threads}.npz", threads=threads, **options)
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "4.npz").read_bytes()


@pytest.mark.parametrize(
    ("value", "match"),
    [
        (np.full((6, 9, 3), 5, np.uint8), r"6 x 9 pixels; the first picture, .*, has 6 x 8"),
        (np.full((6, 8, 3), 5, np.uint16), r"holds uint16 values; the first picture, .* uint8"),
    ],
)
def test_a_picture_unlike_the_first_is_named_with_both(make_measurement, ingest, value, match):
    def change(members):
        members[list(members)[4]] = encode_picture(value, ".png")

    path, _ = make_measurement(change=change)
    with pytest.raises(InputError, match=match) as error:
        ingest(path)
    assert "tl030 pl000 tv045 pv180" in str(error.value).split(";")[0]
    assert "tl000 pl000 tv000 pv000" in str(error.value).split(";")[1]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_picture_with_values_that_are_not_finite_is_named(
    make_measurement, ingest, tmp_path, bad
):
    def change(members):
        picture = np.ones((6, 8, 3), np.float32)
        picture[2, 3, 1] = bad
        members[next(n for n in members if "tl030 pl090 tv045" in n)] = encode_picture(
            picture, ".exr"
        )

    path, _ = make_measurement(suffix=".exr", dtype=np.float32, change=change)
    with pytest.raises(InputError, match=r"tl030 pl090 tv045.*holds 1 NaN or infinite"):
        ingest(path)
    assert not list(tmp_path.glob("s.sample.npz*"))


@pytest.mark.parametrize("crop", [(0, 0, 7, 3), (-1, 0, 2, 2), (0, 0, 0, 3), (5, 7, 1, 2)])
def test_a_crop_outside_the_pictures_is_refused(make_measurement, ingest, crop):
    with pytest.raises(InputError, match=r"--crop .* does not lie inside .* 6 x 8 pixels"):
        ingest(make_measurement()[0], crop=crop)


def near_lamps(folder, codes):
    """Pictures of one view under near lamps, the second overhead."""
    folder.mkdir()
    text = "name,lamp_x,lamp_y,lamp_z,camera_x,camera_y,camera_z\n"
    for i, (picture, lamp) in enumerate(zip(codes, ("20,0,20", "0,0,30"), strict=True)):
        (folder / f"{i}.png").write_bytes(encode_picture(picture, ".png"))
        text += f"{i}.png,{lamp},0,0,50\n"
    (folder / "list.csv").write_text(text)
    return pairs.open_measurement(folder, patch_cm=(10, 10))


def test_a_clipped_grey_card_under_a_near_lamp_is_refused(tmp_path):
    codes = np.full((2, 8, 8, 3), 100, np.uint8)
    codes[1, 3, 3, 1] = 255
    card = {"grey_card": (2, 2, 3, 3), "grey_card_reflectance": 0.5}
    with near_lamps(tmp_path / "clipped", codes) as measurement:
        with pytest.raises(InputError, match="grey card is clipped"):
            ingest_measurement(measurement, tmp_path / "s.npz", **card)
    codes[1, 3, 3, 1] = 100
    with near_lamps(tmp_path / "good", codes) as measurement:
        # the corrected pictures are what the card is measured in
        linear = ((100 / 255 + 0.055) / 1.055) ** 2.4
        factors = pairs.correction((8, 8), (10, 10), np.array([0, 0, 30.0]), (800**0.5 + 30) / 2)
        facts = ingest_measurement(measurement, tmp_path / "s.npz", **card)
    np.testing.assert_allclose(facts["white"], linear * factors[2:5, 2:5].mean() / 0.5, rtol=1e-3)


def test_the_frontal_pair_is_one_nearest_the_normal(tmp_path, make_measurement):
    path, codes = make_measurement(lights=((60, 0), (20, 10)), views=((50, 0), (10, 90)))
    with ubo.open_measurement(path) as whole:
        one = frontal(whole)
        assert one.names == whole.names[:1]
        np.testing.assert_array_equal(one.read(0), codes[1, 1])
        np.testing.assert_array_equal(one.light_directions, whole.light_directions[:1])
        np.testing.assert_array_equal(one.view_directions, whole.view_directions[:1])
        assert (one.n_pairs, one.white, one.toroidal) == (1, whole.white, whole.toroidal)
    codes = np.stack([np.full((4, 4, 3), code, np.uint8) for code in (50, 100)])
    with near_lamps(tmp_path / "lamps", codes) as measurement:
        ingest_measurement(measurement, tmp_path / "all.npz")
        ingest_measurement(frontal(measurement), tmp_path / "one.npz")
    every, one = Sample.open(tmp_path / "all.npz"), Sample.open(tmp_path / "one.npz")
    np.testing.assert_allclose(one.light_directions, [[0, 0, 1]])
    np.testing.assert_array_equal(
        one.codes[0], every.codes[np.argmax(every.light_directions[every.light_index, 2])]
    )


def test_of_pairs_equally_near_the_normal_the_first_is_frontal():
    azimuths = np.radians([200, 10, 100, 300])
    directions = from_angles(np.radians([30, 30, 30, 40]), azimuths)
    tables = directions, directions[::-1]
    for order in ([0, 1, 2, 3], [2, 1, 0, 3], [3, 1, 2, 0]):
        order = np.array(order)
        measurement = Measurement(
            "x", *tables, order, 3 - order, [str(i) for i in order], read=int, transfer=str
        )
        assert frontal(measurement).names == [str(next(i for i in order if i != 3))]


def test_values_that_a_curve_takes_beyond_any_are_refused_by_name(
    make_measurement, ingest, tmp_path
):
    def change(members):
        for name in members:
            members[name] = encode_picture(np.full((6, 8, 3), 1e30, np.float32), ".exr")

    path, _ = make_measurement(suffix=".exr", dtype=np.float32, change=change)
    with pytest.raises(InputError, match=r"tl\d+.*holds 144 NaN or infinite"):
        ingest(path, transfer="srgb")
    assert not list(tmp_path.glob("s.sample.npz*"))


@pytest.mark.parametrize("given", [{"white": 1e-320}, {"white": 1e35}, {"texels_per_mm": 1e300}])
def test_a_scale_that_no_sample_may_have_is_refused(make_measurement, ingest, given):
    with pytest.raises(InputError, match=r"set.zip: (scale|texels_per_mm) is .*positive number"):
        ingest(make_measurement()[0], **given)
