"""Factorisations in colour spaces against LAPACK, plain numpy, and their promises about files and bad input."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from btfpipe.compression import open_appearance
from btfpipe.compression.factored import SPACES, FactoredModel, compress_factored
from btfpipe.compression.svd import compress_svd
from btfpipe.directions import Hemisphere, bonn81, from_angles
from btfpipe.errors import InputError
from btfpipe.sample import Sample

COMPRESSIBLE = sorted(set(SPACES) - {"pca"})


def everything(appearance):
    return appearance.pictures(slice(0, appearance.n_pairs))


@pytest.fixture
def make_model(make_sample, rng):
    """Make a model of smooth random factors."""

    def make(space="log_y_uv_over_y", terms=(5, 3, 2), dtype=np.float32, size=0.5, **kwargs):
        sample = make_sample(rows=6, cols=7, toroidal=kwargs.pop("toroidal", False))
        if space == "pca":
            kwargs |= {"matrix": rng.normal(size=(3, 3)), "mean": rng.normal(size=3)}
        return FactoredModel(
            [(size * rng.normal(size=(sample.n_pairs, k))).astype(dtype) for k in terms],
            [rng.normal(size=(6, 7, k)).astype(dtype) for k in terms],
            space,
            sample,
            **kwargs,
        )

    return make


@pytest.mark.parametrize("space", COMPRESSIBLE)
def test_all_terms_give_every_space_back_highlights_and_black_too(make_sample, space):
    sample = make_sample(rows=6, cols=5)
    sample.codes = sample.codes * np.float32(9)
    sample.codes[3] = 0
    model = compress_factored(sample, (30, 30, 30), space, precision="single")
    values, truth = everything(model), everything(sample)
    assert truth.max() > 5
    loose = 5e-3 if space == "log_y_slog_uv" else 2e-4  # signed logarithms jump at 0
    np.testing.assert_allclose(values, truth, rtol=loose, atol=3e-5)
    assert model.about["rmse"] == pytest.approx(
        np.sqrt(((values - truth).astype(float) ** 2).mean()), rel=1e-3
    )


def test_each_channel_is_as_near_as_its_terms_allow(make_sample, rng):
    sample = make_sample(rows=12, cols=10)
    sample.codes = (sample.codes + 0.3 * rng.random(sample.codes.shape)).astype(np.float32)
    terms = (9, 5, 2)
    model = compress_factored(sample, terms, "log_rgb", precision="single")
    truth = np.log(everything(sample).astype(float) + 1e-5)
    for c, n in enumerate(terms):
        exact = truth[..., c].reshape(sample.n_pairs, -1)
        found = model.angular_factors[c] @ model.texture_factors[c].reshape(-1, n).T
        best = np.sqrt((np.linalg.svd(exact, compute_uv=False)[n:] ** 2).sum())
        assert best * (1 - 1e-5) <= np.linalg.norm(found - exact) <= 1.01 * best
    assert model.n_terms == terms
    assert np.shape(model.about["singular_values"][1]) == (5,)


def test_relative_errors_of_dark_texels_are_what_logarithms_are_for(make_sample, rng):
    sample = make_sample(rows=12, cols=10)
    pairs, texels = rng.normal(size=(sample.n_pairs, 2)), rng.normal(size=(2, 120))
    scale = np.exp(pairs @ texels + rng.normal(scale=0.1, size=(sample.n_pairs, 120)))
    sample.codes = scale.reshape(-1, 12, 10, 1) * (0.2 + rng.random(3))
    sample.codes = sample.codes.astype(np.float32)
    truth = everything(sample)

    def relative(model):
        return np.median(abs(everything(model) / truth - 1))

    logarithmic = relative(compress_factored(sample, (6, 6, 6)))
    assert logarithmic < 0.1
    assert relative(compress_factored(sample, (6, 6, 6), "rgb")) > 2 * logarithmic


def test_terms_that_do_not_exist_are_named_for_each_channel(make_sample):
    sample = make_sample(rows=4, cols=5)
    model = compress_factored(sample, (100000, 1, 25), "rgb")
    first, last = model.n_terms[0], model.n_terms[2]
    pairs = sample.n_pairs
    assert model.about["warnings"] == [
        f"channel 1: 20 texels and {pairs} pairs have at most 20 terms: 99980 terms left out",
        f"channel 1: the channel's rank is {first}: {20 - first} terms left out",
        f"channel 3: 20 texels and {pairs} pairs have at most 20 terms: 5 terms left out",
        f"channel 3: the channel's rank is {last}: {20 - last} terms left out",
    ]
    assert compress_factored(sample, (2, 1, 1)).about["warnings"] == []


@pytest.mark.parametrize("space", ["log_rgb", "log_y_uv", "log_y_slog_uv", "log_y_uv_over_y"])
def test_values_below_zero_are_said_to_be_lost_in_logarithms(make_sample, space):
    sample = make_sample()
    sample.codes[3] = 0
    assert compress_factored(sample, (2, 1, 1), space).about["warnings"] == []
    sample.codes = sample.codes - np.float32(0.05)
    warning, *more = compress_factored(sample, (2, 1, 1), space).about["warnings"]
    assert len(more) == (space == "log_y_uv_over_y")  # that loses chroma, too
    assert warning.startswith("values go down to -0.05, and logarithms take those below 0 for 0")
    assert compress_factored(sample, (2, 1, 1), "ycocg").about["warnings"] == []


def test_colours_outside_the_gamut_are_said_to_be_cut(make_sample):
    """With all terms, the error is what the limit of U / Y takes; the warning says how much of U that is at most."""
    sample = make_sample(rows=4, cols=5)
    inside, warning = of_all_terms(sample)
    assert warning is None
    rgb = [0.057, -0.061, 0.848]
    sample.codes[:, 1, 2] = rgb
    sample.codes[:, 3, 3] *= 1e-4  # dark noise is nobody's colour
    outside, warning = of_all_terms(sample)
    assert outside > 10 * inside
    y, u, _ = np.linalg.solve([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]], rgb)
    assert warning.startswith(
        f"colours with channels below 0 lose up to {u - 4 * (y + 1e-5):.3g} of their chroma"
    )
    assert of_all_terms(sample, "ycocg")[1] is None


def of_all_terms(sample, space="log_y_uv_over_y"):
    """The largest error, and what is warned of colours."""
    model = compress_factored(sample, (20, 20, 20), space, precision="single")
    warning = next((w for w in model.about["warnings"] if w.startswith("colours")), None)
    return np.abs(model.pictures(slice(None)) - sample.pictures(slice(None))).max(), warning


def test_threads_and_memory_never_show(make_sample, tmp_path):
    sample = make_sample(rows=24, cols=20)
    files = []
    for threads, memory in ((1, 2 << 30), (2, 2 << 30), (3, 109 << 20)):
        compress_factored(sample, (8, 4, 3), threads=threads, memory=memory).save(tmp_path / "m")
        files.append((tmp_path / "m").read_bytes())
    assert files[0] == files[1] == files[2]


def test_progress_rises_to_its_total(make_sample):
    seen = []
    compress_factored(
        make_sample(), (4, 3, 2), on_progress=lambda done, total: seen.append((done, total))
    )
    done = [d for d, _ in seen]
    assert done == sorted(done)
    assert {total for _, total in seen} == {done[-1]}


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    space=st.sampled_from(sorted(SPACES)),
    dtype=st.sampled_from([np.float16, np.float32, np.float64]),
    shared=st.booleans(),
    factor=st.booleans(),
    log_range=st.booleans(),
    epsilon=st.sampled_from([1e-5, 0.02]),
)
def test_a_model_comes_back_from_its_file(
    make_model, tmp_path, space, dtype, shared, factor, log_range, epsilon
):
    cosine = bonn81()[:19][np.arange(133) % 19, 2] if factor else None
    model = make_model(
        space, (3, 3, 3) if shared else (4, 2, 1), dtype, 0.1,
        pair_factor=cosine, log_range=log_range, epsilon=epsilon, toroidal=True,
    )  # fmt: skip
    if shared:
        model.texture_factors = (model.texture_factors[0],) * 3
    model.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    assert isinstance(back, FactoredModel)
    assert (back.space, back.log_range, back.epsilon) == (space, log_range, epsilon)
    assert (back.toroidal, back.nbytes) == (True, model.nbytes)
    np.testing.assert_array_equal(everything(back), everything(model))


@pytest.mark.parametrize("space", sorted(SPACES))
def test_texels_and_pictures_agree(make_model, space):
    model = make_model(space, pair_factor=np.linspace(0.1, 1, 133))
    rows, cols = np.array([0, 3, 5]), np.array([1, 6, 2])
    pictures = everything(model)
    np.testing.assert_allclose(
        model.texels(rows, cols), pictures[:, rows, cols].swapaxes(0, 1), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(model.pictures([7, 3]), pictures[[7, 3]], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("space", sorted(SPACES))
@pytest.mark.parametrize("log_range", [False, True])
@pytest.mark.parametrize("toroidal", [False, True])
def test_shading_blends_decoded_values(make_model, rng, space, log_range, toroidal):
    model = make_model(
        space, log_range=log_range, toroidal=toroidal, size=0.1 if log_range else 0.5,
        pair_factor=rng.random(133),
    )  # fmt: skip
    pictures = everything(model).astype(float)
    n = 40
    row, col = rng.uniform(-3, 9, n), rng.uniform(-3, 9, n)
    lights, views = model.light_directions, model.view_directions
    w_i, w_o = (from_angles(rng.uniform(0, 1.7, n), rng.uniform(0, 6.3, n)) for _ in range(2))
    w_i[0] = lights[4]
    found = model.evaluate(row, col, w_i, w_o)
    light_tables, view_tables = Hemisphere(lights), Hemisphere(views)
    for q in range(n):
        y, x = row[q], col[q]
        if not toroidal:
            y, x = np.clip(y, 0, 5), np.clip(x, 0, 6)
        i, j = math.floor(y), math.floor(x)
        expected = np.zeros(3)
        light_found, view_found = (
            tables.weights(direction[None])
            for tables, direction in ((light_tables, w_i[q]), (view_tables, w_o[q]))
        )
        for l_index, l_weight in zip(light_found[0][0], light_found[1][0], strict=True):
            for v_index, v_weight in zip(view_found[0][0], view_found[1][0], strict=True):
                picture = pictures[v_index * 19 + l_index]
                share = l_weight * v_weight * max(w_i[q, 2], 0) / max(lights[l_index, 2], 0.01)
                for di, dj in np.ndindex(2, 2):
                    bilinear = abs(1 - di - (y - i)) * abs(1 - dj - (x - j))
                    expected += share * bilinear * picture[(i + di) % 6, (j + dj) % 7]
        np.testing.assert_allclose(found[q], expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("interpolation", ["barycentric", "four", "nearest"])
@pytest.mark.parametrize("space", ["rgb", "log_y_uv_over_y"])
def test_at_texels_and_measured_directions_shading_is_the_picture(make_model, space, interpolation):
    model = make_model(space)
    w_i, w_o = model.light_directions[11], model.view_directions[4]
    found = model.evaluate(np.arange(6), 3, w_i, w_o, interpolation=interpolation)
    np.testing.assert_allclose(found, model.pictures([4 * 19 + 11])[0, :, 3], rtol=1e-4, atol=1e-5)


def test_rgb_with_equal_terms_is_near_the_joint_factorisation(make_sample):
    sample = make_sample(rows=12, cols=10)
    joint = compress_svd(sample, 10, precision="single").about["rmse"]
    apart = compress_factored(sample, (10, 10, 10), "rgb", precision="single").about["rmse"]
    assert apart <= joint * 1.01


def test_a_list_of_pairs_is_compressed_and_shaded(make_sample):
    whole = make_sample()
    some = np.array([5, 99, 7, 60, 61, 62, 130])
    sample = Sample(
        whole.codes[some], whole.light_directions, whole.view_directions,
        whole.light_index[some], whole.view_index[some],
    )  # fmt: skip
    model = compress_factored(sample, (7, 7, 7), precision="single")
    np.testing.assert_allclose(everything(model), everything(sample), rtol=1e-3, atol=3e-5)
    for pair in range(7):
        w_i = sample.light_directions[sample.light_index[pair]]
        w_o = sample.view_directions[sample.view_index[pair]]
        value = model.evaluate(2, 3, w_i, w_o)
        np.testing.assert_allclose(value[0], sample.pictures([pair])[0, 2, 3], rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("space", COMPRESSIBLE)
def test_non_finite_values_are_refused(make_sample, space, bad):
    for channel in range(3):
        sample = make_sample(rows=6, cols=5, views=bonn81()[:2])
        sample.codes[7, 3, 4, channel] = bad
        with np.errstate(all="ignore"), pytest.raises(InputError, match="non-finite"):
            compress_factored(sample, (2, 2, 2), space)


@pytest.mark.parametrize(
    ("args", "match"),
    [
        (((4, 4), "rgb"), "three numbers of at least 1"),
        (((4, 0, 4), "rgb"), r"\(4, 0, 4\) terms asked for"),
        (((4, 4, 4), "hsv"), "colour space 'hsv'; expected one of rgb, yuv"),
        (((4, 4, 4), "pca"), "colour space 'pca'"),
    ],
)
def test_impossible_wishes_are_refused(make_sample, args, match):
    with pytest.raises(InputError, match=match):
        compress_factored(make_sample(), *args)


def test_models_that_contradict_themselves_are_refused(make_model):
    model = make_model("rgb")
    factors = model.angular_factors, model.texture_factors
    for space, kwargs, match in (
        ("xyz", {}, "colour space 'xyz'"),
        ("pca", {}, "needs its matrix and mean"),
        ("rgb", {"epsilon": 0.0}, "expected a number between 0 and 1"),
        ("rgb", {"epsilon": math.nan}, "expected a number between 0 and 1"),
    ):
        with pytest.raises(InputError, match=match):
            FactoredModel(*factors, space, model, **kwargs)
