"""Bonn's .btf files: round trips, a second decoder written from the format's description, and broken files."""

import bz2
import math
import os
import struct
import subprocess
import sys
import tracemalloc
from contextlib import nullcontext, suppress
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from btfpipe.compression import open_appearance
from btfpipe.compression.factored import SPACES, FactoredModel
from btfpipe.directions import from_angles, ubo2014
from btfpipe.errors import InputError
from btfpipe.formats.btf import read_btf, recognise
from btfpipe.formats.btf_writing import write_btf
from btfpipe.parallel import single_threaded_blas
from btfpipe.sample import Sample
from btfpipe.sample.colour import spectrum_to_rgb
from btfpipe.sample.ingest import ingest

LIGHTS = ((0.0, 0.0), (0.5, 1.0), (1.2, -2.0))
VIEWS = ((0.0, 0.0), (0.75, 3.0))
ROWS, COLS = 4, 5
N_PAIRS, TEXELS = len(LIGHTS) * len(VIEWS), ROWS * COLS
SPECTRUM = (b"610 nm", b"450", b"530.5nm", b"690", b"570")  # names of channels
few = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(autouse=True)
def one_blas_thread():
    with single_threaded_blas():
        yield


# A generator of all kinds of files: lists of (section, bytes).


def u32(*values):
    return struct.pack(f"<{len(values)}I", *values)


def meta(version=4, flag=1, density=5.0, names=(b"R", b"G", b"B"), xml=b"<measurement/>"):
    block = u32(version) + b"dome".ljust(80, b"\0") + bytes(160)
    block += struct.pack("<4f", density, 1, 1, 1)
    block += u32(flag) if version > 1 else b""
    block += u32(len(xml)) + xml if version > 2 else b""
    if version > 3:
        block += u32(len(names)) + b"".join(u32(len(n)) + n for n in names)
    return [("meta", u32(4 + len(block)) + block)]


def directions(views=VIEWS, lights=LIGHTS):
    data = u32(len(views))
    for view in views:
        data += struct.pack("<2fI", *view, len(lights))
        data += b"".join(struct.pack("<2f", *light) for light in lights)
    return [("directions", data)]


def common(signature, rotations=0, each=9, **kwargs):
    sections = [("signature", signature), *meta(**kwargs), *directions()]
    sections.append(("size", u32(COLS, ROWS)))
    if signature.endswith(b"R"):
        sections.append(("rotations", u32(rotations) + bytes(4 * each * rotations)))
    return sections


def factors(left, right):
    """Singular values (which nobody needs), then both factors row by row."""
    terms = left.shape[1]
    head = struct.pack("<B3I", left.itemsize, terms, len(left), len(right))
    return head + bytes(terms * left.itemsize) + left.tobytes() + right.tobytes()


def dfmf(
    channels,
    model=0,
    mean=(0, 0, 0),
    matrix=(1, 0, 0, 0, 1, 0, 0, 0, 1),
    transposed=False,
    **kwargs,
):
    sections = common(b"!DFMF08FCR", **kwargs)
    colours = struct.pack("<Ii", 9, model) + struct.pack("<12f", *mean, *np.ravel(matrix))
    sections.append(("colours", colours))
    for c, (left, right) in enumerate(channels):
        pair = (right, left) if transposed else (left, right)
        sections.append((f"channel {c}", factors(*pair)))
    return sections


def fmf(left, right, signature=b"!FMF12FCER", version=2, method=0, height=False, **kwargs):
    sections = common(signature, **kwargs)
    if b"E" in signature:
        extension = struct.pack("<B", version)
        extension += u32(method) if version >= 1 else b""
        if version >= 2:
            extension += u32(3, 2) + bytes(12) if height else u32(0, 0)
        sections.append(("extension", extension))
    sections.append(("factors", u32(left.shape[1]) + factors(left, right)))
    return sections


def pvf(views, signature=b"!PVF06FCR", legacy=False, **kwargs):
    """`views`: mean (dim,), components (dim, K), weights (n, K) each."""
    terms = views[0][1].shape[1]
    if legacy:
        head = struct.pack("<i", 301074) + u32(terms, COLS, ROWS, len(views))
        sections = [("signature", signature), ("legacy", head), *directions()]
    else:
        sections = common(signature, **kwargs)
        sections.append(("counts", u32(terms, len(views))))
    for v, (mean, components, weights) in enumerate(views):
        head = struct.pack("<B3I", mean.itemsize, terms, len(weights), len(mean))
        body = bytes(terms * mean.itemsize)
        body += mean.tobytes() + components.tobytes() + weights.tobytes()
        sections.append((f"view {v}", head + body))
    return sections


def bdi(values, packing=0, mask=None, scan_lines=2, rotations=0, each=9, **kwargs):
    """`values` (rows, cols, views, lights, channels) float16."""
    mask = np.ones((ROWS, COLS), np.uint8) if mask is None else mask
    sections = [("signature", b"!BDIF06R2!"), *meta(**kwargs), *directions()]
    sections.append(("size", u32(COLS, ROWS, scan_lines) + struct.pack("<B", packing)))
    sections.append(("mask", mask.astype(np.uint8).tobytes()))
    sections.append(("rotations", u32(rotations) + bytes(4 * each * rotations)))
    stored = values.reshape(TEXELS, -1)
    if packing == 2:
        stored = stored[mask.ravel() != 0]
    for start in range(0, len(stored), COLS * scan_lines):
        chunk = stored[start : start + COLS * scan_lines].tobytes()
        chunk = bz2.compress(chunk) if packing == 1 else chunk
        sections.append((f"chunk at {start}", u32(len(chunk)) + chunk))
    return sections


def joined(sections):
    return b"".join(data for _, data in sections)


@pytest.fixture
def put(tmp_path):
    def put(sections):
        path = tmp_path / "material.btf"
        path.write_bytes(sections if isinstance(sections, bytes) else joined(sections))
        return path

    return put


def some_channels(rng, terms=(3, 2, 1), dtype=np.float32):
    return [
        (
            rng.normal(size=(N_PAIRS, k)).astype(dtype),
            rng.normal(size=(TEXELS, k)).astype(dtype),
        )
        for k in terms
    ]


def some_views(rng, per_texel, dtype=np.float32, terms=2, channels=3):
    size, n = len(LIGHTS), TEXELS
    size, n = (channels * size, n) if per_texel else (channels * n, size)
    return [
        tuple(rng.random(shape).astype(dtype) for shape in ((size,), (size, terms), (n, terms)))
        for _ in VIEWS
    ]


def every_file(rng):
    """One file of each kind, by name."""
    left = rng.random((3 * N_PAIRS, 2)).astype(np.float16)
    right = rng.random((TEXELS, 2)).astype(np.float16)
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    mask = rng.random((ROWS, COLS)) < 0.7
    five = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 5)).astype(np.float16)
    return {
        "dfmf": dfmf(some_channels(rng), model=11),
        "dfmf with rotations": dfmf(some_channels(rng), rotations=2),
        "fmf": fmf(left, right, height=True),
        "plain fmf": fmf(left, right, b"!FMF06FC"),
        "pvf": pvf(some_views(rng, True)),
        "pvf per light": pvf(some_views(rng, False), b"!PVF06FC"),
        "legacy pvf": pvf(some_views(rng, True), legacy=True),
        "bdi": bdi(values),
        "sparse bdi": bdi(values, 2, mask),
        "packed bdi": bdi(values, 1),
        "spectral bdi": bdi(five, names=SPECTRUM),
        "spectral dfmf": dfmf(some_channels(rng, (1, 2, 1, 3, 1)), model=5, names=SPECTRUM),
        "spectral fmf": fmf(
            rng.random((5 * N_PAIRS, 2)), rng.random((TEXELS, 2)), height=True, names=SPECTRUM
        ),
        "spectral pvf": pvf(some_views(rng, True, channels=5), names=SPECTRUM),
    }


KINDS = sorted(every_file(np.random.default_rng(0)))


# A second decoder of DFMF, from the format's description, which shares nothing with the first.


def decode_dfmf(data):
    """Values (views, lights, rows, cols, 3) float64 of a DFMF file."""
    assert data[:10] == b"!DFMF08FCR"
    at = 10

    def take(layout):
        nonlocal at
        values = struct.unpack_from("<" + layout, data, at)
        at += struct.calcsize("<" + layout)
        return values

    (size,) = take("I")
    at += size - 4
    (n_views,) = take("I")
    for _ in range(n_views):
        _, _, n_lights = take("ffI")
        take(f"{2 * n_lights}f")
    width, height, rotations = take("3I")
    assert rotations == 0
    _, model = take("Ii")
    mean, matrix = np.array(take("3f")), np.array(take("9f")).reshape(3, 3)
    planes = []
    for _ in range(3):
        size, terms, rows, cols = take("B3I")
        letter = {2: "e", 4: "f", 8: "d"}[size]
        take(f"{terms}{letter}")
        u = np.array(take(f"{rows * terms}{letter}")).reshape(rows, terms)
        sv = np.array(take(f"{cols * terms}{letter}")).reshape(cols, terms)
        planes.append(u @ sv.T if rows == n_views * n_lights else sv @ u.T)
    assert at == len(data)
    rgb = np.stack(colours_back(model, *planes, matrix, mean), axis=-1)
    return rgb.reshape(n_views, n_lights, height, width, 3)


def colours_back(model, a, b, c, matrix, mean):
    eps = 1e-5

    def yuv(y, u, v):
        return y + 1.13983 * v, y - 0.39465 * u - 0.5806 * v, y + 2.03211 * u

    def signed(x):
        return np.sign(x) * np.exp(abs(x) + np.log(eps))

    y = np.exp(a) - eps if model >= 9 else a
    if model == 0:
        return a, b, c
    if model in (1, 9):
        return yuv(y, b, c)
    if model == 2:
        f = np.stack([(a + 16) / 116 + b / 500, (a + 16) / 116, (a + 16) / 116 - c / 200])
        xyz = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29))
        xyz *= np.reshape((0.9642, 1, 0.8249), (3,) + (1,) * a.ndim)
        bradford = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
        bradford = np.array(bradford)
        scale = (bradford @ [0.95047, 1, 1.08883]) / (bradford @ [0.9642, 1, 0.8249])
        adapt = np.linalg.inv(bradford) @ np.diag(scale) @ bradford
        rec709 = np.array(
            [
                [0.4124564, 0.3575761, 0.1804375],
                [0.2126729, 0.7151522, 0.0721750],
                [0.0193339, 0.1191920, 0.9503041],
            ]
        )
        return np.einsum("ij,j...->i...", np.linalg.inv(rec709) @ adapt, xyz)
    if model == 3:
        return np.moveaxis(np.stack([a, b, c], axis=-1) @ matrix + mean, -1, 0)
    if model == 4:
        return a + b - c, a + c, a - b - c
    if model == 10:
        return yuv(y, signed(b), signed(c))
    if model == 11:
        return yuv(y, b * (y + eps), c * (y + eps))
    return tuple(np.exp(x) - eps for x in (a, b, c))


def all_pictures(model):
    """(views, lights, rows, cols, 3)."""
    shape = (len(model.view_directions), len(model.light_directions), *model.shape, 3)
    return model.pictures(slice(0, model.n_pairs)).reshape(shape)


def test_the_second_decoder_knows_a_value_worked_out_by_hand():
    # log Y = ln 2, U/Y = 0.1, V/Y = -0.2 at one texel of one pair: with Y = 2 - 1e-5
    one = [(np.float64([[x]]), np.float64([[1]])) for x in (math.log(2), 0.1, -0.2)]
    data = joined(
        [("", b"!DFMF08FCR"), *meta(), *directions(VIEWS[:1], LIGHTS[:1]), ("", u32(1, 1, 0))]
    )
    data += struct.pack("<Ii12f", 1, 11, *[0] * 12) + b"".join(factors(*c) for c in one)
    expected = [1.99999 - 1.13983 * 0.4, 1.99999 - 0.39465 * 0.2 + 0.5806 * 0.4, 1.99999 + 0.406422]
    np.testing.assert_allclose(decode_dfmf(data).ravel(), expected, rtol=1e-12)


@pytest.mark.parametrize("space", sorted(SPACES))
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_every_colour_model_is_read_as_described(put, rng, space, transposed, dtype):
    channels = some_channels(rng, dtype=dtype)
    if space == "lab":
        channels = [(left * dtype(60), right) for left, right in channels]
    path = put(
        dfmf(
            channels, SPACES[space], rng.normal(size=3), rng.normal(size=(3, 3)), transposed,
            rotations=0,
        )
    )  # fmt: skip
    truth = decode_dfmf(path.read_bytes())
    model = read_btf(path)
    assert model.space == space
    assert abs(truth).max() > 1
    loose = 1e-3 if space == "lab" else 1e-4  # published white points differ in the fourth digit
    np.testing.assert_allclose(
        all_pictures(model), truth, rtol=loose, atol=1e-5 * (1 + abs(truth).max())
    )


@few
@given(
    space=st.sampled_from(sorted(SPACES)),
    terms=st.tuples(*[st.integers(1, 5)] * 3),
    dtype=st.sampled_from([np.float16, np.float32, np.float64]),
    sizes=st.tuples(*[st.integers(1, 4)] * 4),
    divided=st.booleans(),
    toroidal=st.booleans(),
    absolute=st.booleans(),
    density=st.sampled_from([None, 0.5, 12.25]),
    seed=st.integers(0, 1000),
)
def test_a_model_written_is_read_back_equal(
    tmp_path, space, terms, dtype, sizes, divided, toroidal, absolute, density, seed
):
    rng = np.random.default_rng(seed)
    n_lights, n_views, rows, cols = sizes
    pair = np.arange(n_lights * n_views)
    lights, views = ubo2014()[:n_lights], ubo2014()[40 : 40 + n_views]
    source = SimpleNamespace(
        light_directions=lights, view_directions=views, light_index=pair % n_lights,
        view_index=pair // n_lights, toroidal=toroidal, texels_per_mm=density, absolute=absolute,
    )  # fmt: skip
    pca = space == "pca"
    model = FactoredModel(
        [rng.normal(size=(len(pair), k)).astype(dtype) for k in terms],
        [rng.normal(size=(rows, cols, k)).astype(dtype) for k in terms],
        space,
        source,
        matrix=rng.normal(size=(3, 3)) if pca else None,
        mean=rng.normal(size=3) if pca else None,
        pair_factor=lights[pair % n_lights, 2] if divided else None,
    )
    write_btf(tmp_path / "m.btf", model)
    back = read_btf(tmp_path / "m.btf")
    for name in ("angular_factors", "texture_factors"):
        for one, other in zip(getattr(model, name), getattr(back, name), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
    for name in ("matrix", "mean", "light_index", "view_index"):
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name))
    said = ("space", "shape", "toroidal", "absolute", "texels_per_mm")
    assert [getattr(back, n) for n in said] == [getattr(model, n) for n in said]
    np.testing.assert_allclose(back.light_directions, lights, atol=1e-6)
    np.testing.assert_allclose(back.view_directions, views, atol=1e-6)
    assert (back.pair_factor is None) != divided
    np.testing.assert_allclose(
        back.pictures(slice(0, 3)), model.pictures(slice(0, 3)), rtol=1e-5, atol=1e-30
    )


def test_written_angles_are_as_bonns_files_have_them(make_sample, tmp_path):
    directions = ubo2014()[:20]
    path = tmp_path / "m.btf"
    write_btf(path, make_sample(lights=directions, views=directions), terms=(3, 2, 2))
    data = path.read_bytes()
    at = 10 + struct.unpack_from("<I", data, 10)[0]
    assert struct.unpack_from("<I", data, at) == (20,)
    angles = np.frombuffer(data, "<f4", 40, at + 16).reshape(20, 2)
    np.testing.assert_allclose(from_angles(*angles.T), directions, atol=1e-6)
    assert angles[:, 1].max() <= np.float32(math.pi)
    assert angles[:, 1].min() < 0


def test_a_sample_written_keeps_its_highlights_and_rows(make_sample, tmp_path):
    sample = make_sample(lights=ubo2014()[:19])
    sample.codes = (np.asarray(sample.codes) * 6).astype(np.float32)
    sample.codes[:, 0] *= np.linspace(0.2, 1, 20, dtype=np.float32)[:, None]
    written = write_btf(tmp_path / "m.btf", sample, terms=(20, 12, 12))
    truth = sample.pictures(slice(0, sample.n_pairs))
    for values in (
        all_pictures(read_btf(tmp_path / "m.btf")),
        decode_dfmf((tmp_path / "m.btf").read_bytes()),
    ):
        error = values.reshape(truth.shape) - truth
        assert values.max() > 4
        assert np.sqrt((error**2).mean()) < 0.01 * np.sqrt((truth**2).mean())
    assert written.about["relative_error"] < 0.01


@pytest.mark.slow
def test_btf_extractor_reads_what_was_written_here(tmp_path):
    """Set BTF_EXTRACTOR_PYTHON to the interpreter of an environment that has it (it needs an older numpy)."""
    python = os.environ.get("BTF_EXTRACTOR_PYTHON", sys.executable)
    if subprocess.run([python, "-c", "import btf_extractor"], capture_output=True).returncode:
        pytest.skip("needs btf-extractor")
    rng = np.random.default_rng(1)
    lights = ubo2014()
    pictures = rng.random((1, 8, 6, 3)) * lights[:, 2, None, None, None]
    shade = 0.4 + 0.6 * lights[:, 2]
    pictures = (pictures[None] * shade[:, None, None, None, None]).reshape(-1, 8, 6, 3)
    pair = np.arange(151 * 151)
    sample = Sample(pictures.astype(np.float32), lights, lights, pair % 151, pair // 151)
    for space in ("rgb", "log_y_uv_over_y"):
        path = tmp_path / f"{space}.btf"
        model = write_btf(path, sample, terms=(4, 3, 3), space=space, precision="single")
        code = (
            "import sys, numpy, btf_extractor\n"
            "btf = btf_extractor.Ubo2014(sys.argv[1])\n"
            "angles = sorted(btf.angles_set)\n"
            "assert len(angles) == 151 * 151\n"
            "chosen = angles[::1000]\n"
            "pictures = numpy.stack([btf.angles_to_image(*a) for a in chosen])\n"
            "numpy.savez(sys.argv[2], angles=numpy.array(chosen), pictures=pictures)\n"
        )
        subprocess.run([python, "-c", code, path, tmp_path / "out.npz"], check=True)
        found = np.load(tmp_path / "out.npz")
        light, view = (
            from_angles(*np.radians(found["angles"][:, i : i + 2].T)) @ lights.T for i in (0, 2)
        )
        truth = model.pictures(151 * view.argmax(axis=1) + light.argmax(axis=1))
        below = truth.max() < 1
        assert below
        # it turns rows over and gives blue first
        np.testing.assert_allclose(found["pictures"][:, ::-1, :, ::-1], truth, atol=1e-4)


@pytest.mark.parametrize(
    ("signature", "version", "method"),
    [
        (b"!FMF06FC", 0, 0),
        (b"!FMF06FCR", 0, 0),
        (b"!FMF12FCER", 0, 0),
        (b"!FMF12FCER", 1, 1),
        (b"!FMF12FCER", 2, 0),
        (b"!FMF12FCER", 2, 1),
    ],
)
@pytest.mark.parametrize("transposed", [False, True])
def test_fmf_is_read_with_its_range_and_height_map(
    put, rng, signature, version, method, transposed
):
    left = rng.normal(size=(len(VIEWS), len(LIGHTS), 3, 4)).astype(np.float16)
    right = rng.normal(size=(ROWS, COLS, 4)).astype(np.float16)
    pair = (left.reshape(-1, 4), right.reshape(-1, 4))
    sections = fmf(
        *(pair[::-1] if transposed else pair), signature, version, method, height=version == 2,
        flag=0,
    )  # fmt: skip
    model = read_btf(put(sections))
    truth = np.einsum("vlck,yxk->vlyxc", left.astype(float), right.astype(float))
    if method:
        truth = np.exp(truth) - 1e-5
    truth *= np.cos([theta for theta, _ in LIGHTS])[:, None, None, None]
    np.testing.assert_allclose(all_pictures(model), truth, rtol=1e-4, atol=1e-5)
    assert ("height_map" in model.about["source"]) == (version == 2)


def test_fmf_becomes_a_model_file_that_holds_its_texture_once(put, rng, tmp_path):
    left = rng.random((3 * N_PAIRS, 2)).astype(np.float16)
    right = rng.random((TEXELS, 2)).astype(np.float16)
    model = read_btf(put(fmf(left, right, method=1)))
    model.save(tmp_path / "m.npz")
    back = open_appearance(tmp_path / "m.npz")
    np.testing.assert_array_equal(all_pictures(back), all_pictures(model))
    assert back.nbytes == model.nbytes
    assert model.nbytes == left.nbytes + right.nbytes + 24 * (len(LIGHTS) + len(VIEWS))
    assert back.about["source"]["signature"] == "!FMF12FCER"


def test_fmf_in_logarithms_can_be_written_as_a_colour_model(put, rng, tmp_path):
    left = rng.random((3 * N_PAIRS, 2)).astype(np.float32)
    right = rng.random((TEXELS, 2)).astype(np.float32)
    model = read_btf(put(fmf(left, right, method=1, flag=0)))
    write_btf(tmp_path / "m.btf", model)
    back = read_btf(tmp_path / "m.btf")
    assert back.space == "log_rgb"
    np.testing.assert_array_equal(all_pictures(back), all_pictures(model))


@pytest.mark.parametrize("per_texel", [False, True])
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_pvf_is_read_view_by_view(put, rng, per_texel, legacy, dtype):
    views = some_views(rng, per_texel, dtype)
    measurement = read_btf(put(pvf(views, legacy=legacy)), cosine="inside")
    assert measurement.n_pairs == N_PAIRS
    for pair in range(N_PAIRS):
        view, light = divmod(pair, len(LIGHTS))
        mean, components, weights = (a.astype(float) for a in views[view])
        picture = measurement.read(pair)
        for y, x, c in np.ndindex(ROWS, COLS, 3):
            if per_texel:
                at, weight = c + 3 * light, weights[y * COLS + x]
            else:
                at, weight = c + 3 * (x + COLS * y), weights[light]
            value = (components[at] * weight).sum() + mean[at]
            assert picture[y, x, c] == pytest.approx(value, rel=1e-5)


def spectra_back(model, values):
    """Values (pairs, texels, channels) of a colour model's channels, one by one, from the makers' description."""
    out = np.empty(values.shape)
    for at in np.ndindex(values.shape[:2]):
        first, *rest = values[at]
        if model == 5:  # the sum; the part of it that each but the first has
            out[at] = [first - sum(first * part for part in rest), *(first * part for part in rest)]
        elif model == 6:
            n = len(values[at])
            total = first * n
            out[at] = [
                total - sum(part / n for part in rest),
                *(total + part * total for part in rest),
            ]
        else:
            out[at] = values[at] if model == 0 else [math.exp(x) - 1e-5 for x in values[at]]
    return out


def read_pictures(opened):
    """(pairs, texels, 3) of a Model or Measurement."""
    if isinstance(opened, FactoredModel):
        return opened.pictures(slice(None)).reshape(opened.n_pairs, -1, 3)
    return np.stack([opened.read(pair) for pair in range(opened.n_pairs)]).reshape(N_PAIRS, -1, 3)


@pytest.mark.parametrize("model", [0, 5, 6, 12])
@pytest.mark.parametrize("names", [SPECTRUM, (b"R", b"G", b"B")])
@pytest.mark.parametrize("memory", [0, 3000, 1 << 20])
def test_a_dfmf_of_spectra_is_read_as_described(put, rng, model, names, memory):
    channels = some_channels(rng, (3, 2, 1, 4, 2)[: len(names)])
    opened = read_btf(put(dfmf(channels, model, names=names)), memory=memory)
    values = np.stack([left.astype(float) @ right.T for left, right in channels], axis=-1)
    truth = spectra_back(model, values)
    if len(names) != 3:
        truth = truth @ spectrum_to_rgb([610, 450, 530.5, 690, 570]).T
    np.testing.assert_allclose(read_pictures(opened), truth, rtol=1e-4, atol=1e-4 * truth.max())


def test_models_of_colours_say_nothing_of_spectra(put, rng):
    channels = some_channels(rng, (3, 2, 1, 4, 2))
    for model in (1, 2, 3, 4, 9, 10, 11, 7):
        refuses(
            put(dfmf(channels, model, names=SPECTRUM)),
            f"of 5 channels is {model}; expected one of 0, 5, 6, 12",
        )


@pytest.mark.parametrize("method", [0, 1])
def test_an_fmf_of_spectra_is_read_as_described(put, rng, method):
    left, right = rng.normal(size=(5 * N_PAIRS, 3)), rng.normal(size=(TEXELS, 3))
    opened = read_btf(put(fmf(left, right, method=method, names=SPECTRUM)))
    assert isinstance(opened, FactoredModel) == (method == 0)
    values = (left @ right.T).reshape(N_PAIRS, 5, TEXELS).swapaxes(1, 2)
    truth = np.exp(values) - 1e-5 if method else values
    truth = truth @ spectrum_to_rgb([610, 450, 530.5, 690, 570]).T
    np.testing.assert_allclose(read_pictures(opened), truth, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("per_texel", [False, True])
def test_a_pvf_of_spectra_is_the_pvf_of_its_colours(put, rng, per_texel):
    to_rgb = spectrum_to_rgb([610, 450, 530.5, 690, 570])
    views = some_views(rng, per_texel, np.float64, channels=5)
    colours = [
        (
            (mean.reshape(-1, 5) @ to_rgb.T).ravel(),
            np.einsum("nck,rc->nrk", components.reshape(-1, 5, 2), to_rgb).reshape(-1, 2),
            weights,
        )
        for mean, components, weights in views
    ]
    seen = read_pictures(read_btf(put(pvf(views, names=SPECTRUM))))
    np.testing.assert_allclose(
        seen, read_pictures(read_btf(put(pvf(colours)))), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("packing", [0, 1, 2])
def test_a_bdi_of_spectra_goes_through_ingest(put, rng, tmp_path, packing):
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 5)).astype(np.float16)
    ingest(read_btf(put(bdi(values, packing, names=SPECTRUM))), tmp_path / "s.npz")
    truth = values.astype(float) @ spectrum_to_rgb([610, 450, 530.5, 690, 570]).T
    pictures = open_appearance(tmp_path / "s.npz").pictures(slice(None))
    for pair in range(N_PAIRS):
        view, light = divmod(pair, len(LIGHTS))
        np.testing.assert_allclose(pictures[pair], truth[:, :, view, light], rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("packing", [0, 1, 2])
@pytest.mark.parametrize("memory", [0, 700, 1 << 20])
def test_bdi_is_turned_into_pictures_within_its_memory(put, rng, packing, memory):
    values = (rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)) * 9).astype(np.float16)
    mask = rng.random((ROWS, COLS)) < 0.6
    if packing == 1:
        memory += COLS * 2 * 3 * N_PAIRS * 2  # a chunk must fit, once unpacked
    measurement = read_btf(put(bdi(values, packing, mask)), memory=memory)
    truth = values if packing != 2 else np.where(mask[..., None, None, None], values, 0)
    for pair in (*range(N_PAIRS), 2, 0, 5):
        view, light = divmod(pair, len(LIGHTS))
        picture = measurement.read(pair)
        assert picture.dtype == np.float16
        np.testing.assert_array_equal(picture, truth[:, :, view, light])
    np.testing.assert_array_equal(measurement.mask, mask)


@pytest.mark.parametrize("scan_lines", [3, 9])
@pytest.mark.parametrize("packing", [0, 2])
def test_the_last_chunk_of_a_bdi_may_be_as_long_as_the_others(put, rng, scan_lines, packing):
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    sections = bdi(values, packing, scan_lines=scan_lines)
    name, chunk = sections[-1]
    full = COLS * scan_lines * 3 * N_PAIRS * 2
    assert len(chunk) < full
    padded = u32(full) + chunk[4:] + bytes(full - len(chunk) + 4)
    measurement = read_btf(put([*sections[:-1], (name, padded)]))
    for pair in range(N_PAIRS):
        view, light = divmod(pair, len(LIGHTS))
        np.testing.assert_array_equal(measurement.read(pair), values[:, :, view, light])
    refuses(put([*sections[:-1], (name, u32(full - 2) + padded[4:-2])]), "chunk .* for")
    refuses(put([*sections[:-1], (name, padded[:-1])]), "truncated")


def test_bdi_may_have_more_chunks_than_a_process_may_have_mappings(put, rng):
    values = rng.random((70000, 1, 3)).astype(np.float16)
    data = joined([("", b"!BDIF06R2!"), *meta(), *directions(VIEWS[:1], LIGHTS[:1])])
    data += u32(1, 70000, 1) + bytes(1) + bytes(70000) + u32(0)
    data += b"".join(u32(6) + texel.tobytes() for texel in values)
    np.testing.assert_array_equal(read_btf(put(data)).read(0), values)


@pytest.mark.parametrize("threads", [1, 3])
def test_bdi_goes_through_ingest(put, rng, tmp_path, threads):
    values = (rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)) * 9).astype(np.float16)
    measurement = read_btf(put(bdi(values)), memory=600)
    ingest(measurement, tmp_path / "s.npz", threads=threads)
    sample = Sample.open(tmp_path / "s.npz")
    assert (sample.is_product, sample.texels_per_mm, sample.absolute) == (True, 5.0, False)
    np.testing.assert_array_equal(
        sample.pictures(slice(0, N_PAIRS)),
        values.transpose(2, 3, 0, 1, 4).reshape(-1, ROWS, COLS, 3).astype(np.float32),
    )
    np.testing.assert_allclose(
        sample.light_directions, from_angles(*np.transpose(LIGHTS)), atol=1e-6
    )


@pytest.mark.parametrize(
    ("kwargs", "asked", "inside"),
    [
        ({"flag": 1}, None, True),
        ({"flag": 0}, None, False),
        ({"version": 1}, None, False),
        ({"flag": 0}, "inside", True),
        ({"flag": 1}, "divided", False),
    ],
)
def test_a_white_diffuser_comes_out_as_the_lights_cosine(put, kwargs, asked, inside):
    cosine = np.cos([theta for theta, _ in LIGHTS])
    stored = np.tile(cosine if inside else np.ones(3), len(VIEWS)).astype(np.float32)
    ones = np.ones((TEXELS, 1), np.float32)
    expected = np.broadcast_to(cosine[:, None, None, None], (len(VIEWS), 3, ROWS, COLS, 3))
    model = read_btf(put(dfmf([(stored[:, None], ones)] * 3, **kwargs)), cosine=asked)
    np.testing.assert_allclose(all_pictures(model), expected, rtol=1e-6)
    w_i = from_angles(1.0, 0.3)
    np.testing.assert_allclose(model.evaluate(1.5, 2, w_i, (0, 0, 1)), math.cos(1), rtol=1e-6)
    assert model.about["source"]["cosine"].startswith("inside" if inside else "divided")
    values = np.broadcast_to(stored.reshape(1, 1, len(VIEWS), 3, 1), (ROWS, COLS, len(VIEWS), 3, 3))
    measurement = read_btf(put(bdi(values.astype(np.float16), **kwargs)), cosine=asked)
    np.testing.assert_allclose(measurement.read(2), expected[0, 2], rtol=1e-3)


@pytest.mark.parametrize("each", [3, 9])
def test_rotations_of_either_length_are_skipped(put, rng, each):
    channels = some_channels(rng)
    plain = all_pictures(read_btf(put(dfmf(channels))))
    turned = read_btf(put(dfmf(channels, rotations=4, each=each)))
    np.testing.assert_array_equal(all_pictures(turned), plain)
    assert turned.about["source"]["rotations"] == 4
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    measurement = read_btf(put(bdi(values, rotations=4, each=each)))
    np.testing.assert_array_equal(measurement.read(4), values[:, :, 1, 1])


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_every_version_of_the_meta_block_is_read(put, rng, version):
    channels = some_channels(rng)
    model = read_btf(put(dfmf(channels, version=version)), cosine="inside")
    truth = channels[0][0] @ channels[0][1].T
    np.testing.assert_allclose(
        all_pictures(model)[..., 0].reshape(N_PAIRS, -1), truth, rtol=1e-5, atol=1e-6
    )
    assert (model.texels_per_mm, model.about["source"]["measurement_setup"]) == (5.0, "dome")


# Files that are not what they should be.


def test_files_are_recognised_by_their_first_bytes(put, rng, tmp_path):
    for sections in every_file(rng).values():
        assert recognise(put(sections)).startswith("its first bytes are !")
    assert "!FMF06FCR:" in recognise(put(b"!FMF06FCR"))
    assert recognise(put(b"II+\0\x08\0\0\0BigTIFF")) is None
    assert recognise(put(b"")) is None
    assert recognise(tmp_path / "nothing.btf") is None
    assert recognise(tmp_path) is None


def refuses(path, match=None, **kwargs):
    """Reading is refused by name and takes little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=match) as caught:
            read_btf(path, **kwargs)
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_cut_at_any_section_is_refused(put, rng, kind):
    sections = every_file(rng)[kind]
    data = joined(sections)
    ends = np.cumsum([len(part) for _, part in sections])
    assert ends[-1] == len(data)
    for end in (0, *ends[:-1]):
        refuses(put(data[:end]))
        refuses(put(data[: end + 1]))
    refuses(put(data[:-1]), "truncated|expected")


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_after_the_end_are_refused(put, rng, kind):
    refuses(put(joined(every_file(rng)[kind]) + b"\0"), "1 bytes follow|expected")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [0, 0x7FFFFFFF, 0xFFFFFFFF])
def test_impossible_counts_are_refused_before_memory_is_taken(put, rng, kind, value):
    data = joined(every_file(rng)[kind])
    sections = every_file(np.random.default_rng(20021202))[kind]
    assert joined(sections) == data
    counts = {"directions": [0, 12], "size": [0, 4], "counts": [0, 4], "factors": [0, 5, 9, 13]}
    counts |= {f"{what} {n}": [1, 5, 9] for what in ("channel", "view") for n in range(3)}
    counts |= {"legacy": [4, 8, 12, 16], "chunk at 0": [0], "extension": [5], "meta": [0]}
    start, seen = 0, 0
    for name, part in sections:
        for at in counts.get(name, ()):
            if name == "extension" and value == 0:
                continue
            spoilt = bytearray(data)
            struct.pack_into("<I", spoilt, start + at, value)
            if (
                name in ("factors", "counts", "legacy")
                and at in (0, 4)
                and value
                and name != "counts"
            ):
                continue  # repeated further on, and informative only
            if name == "counts" and at == 0 and value:
                continue
            refuses(put(bytes(spoilt)))
            seen += 1
        start += len(part)
    assert seen >= 5


def test_another_format_is_refused_with_what_was_found(put):
    refuses(put(b"II+\0 not a btf"), r"starts with b'II\+.*expected one of !DFMF08FCR")


def test_bad_headers_are_refused_by_name(put, rng):
    channels = some_channels(rng)
    good = dfmf(channels)
    refuses(put(dfmf(channels, model=7)), r"colour model is 7; expected one of 0 \(rgb\)")
    refuses(put(dfmf(channels, flag=2)), "cosine flag is 2; expected 0 or 1")
    for names, match in (
        ((b"450", b"550", b"650", b"infrared"), "4 channels, one of them 'infrared'; expected 3"),
        ((b"450", b"550", b"650", b"550"), "channels: wavelength 550 nm comes twice"),
        (
            (b"650", b"850", b"1050", b"1250"),
            "channels: 1 of 4 wavelengths are between 400 and 700 nm",
        ),
        ((b"Y",), "1 channels, one of them 'Y'"),
        ((), "number of channels is 0; expected at least 1"),
    ):
        refuses(put(dfmf(channels, names=names)), match)
    block = bytearray(good[1][1])
    struct.pack_into("<I", block, 0, len(block) - 1)
    refuses(put([good[0], ("meta", bytes(block)), *good[2:]]), "meta block: size is")
    for where, bad in ((LIGHTS, math.nan), (VIEWS, math.inf), (LIGHTS, 1.7), (VIEWS, -0.1)):
        angles = {"lights": LIGHTS, "views": VIEWS}
        name = "lights" if where is LIGHTS else "views"
        angles[name] = (*where[:-1], (bad, 0.0))
        spoilt = [*good[:2], *directions(**angles), *good[3:]]
        refuses(put(spoilt), f"{name[:-1]} {len(where) - 1} has the angles")
    unequal = bytearray(good[2][1])
    struct.pack_into("<f", unequal, len(unequal) - 4, 0.25)
    refuses(put([*good[:2], ("", bytes(unequal)), *good[3:]]), "lights of view 1 differ")


def test_bad_bodies_are_refused_by_name(put, rng):
    channels = some_channels(rng)
    short = [(left[:-1], right) for left, right in channels]
    refuses(put(dfmf(short)), r"channel 0 is 5 x 20; expected 6 x 20 \(2 views x 3 lights")
    for bad in (math.nan, math.inf):
        for which in (0, 1):
            spoilt = [tuple(array.copy() for array in pair) for pair in channels]
            spoilt[1][which][2, 1] = bad
            for kwargs in ({}, {"rotations": 2, "each": 3}, {"rotations": 2, "each": 9}):
                refuses(put(dfmf(spoilt, **kwargs)), "channel 1 holds 1 NaN or infinite values")
    refuses(put(dfmf(channels, 3, (math.nan, 0, 0))), "colours holds 1 NaN")
    for size, dtype in ((1e20, np.float32), (1e200, np.float64)):
        huge = [
            (channels[0][0].astype(dtype) * dtype(size), channels[0][1].astype(dtype) * dtype(size))
        ]
        refuses(
            put(dfmf(huge + channels[1:])),
            "channel 0 has factors up to .* products in single precision",
        )
    tiny = [(channels[0][0].astype(float) * 1e-60, channels[0][1].astype(float) * 1e60)]
    refuses(put(dfmf(tiny + channels[1:])), "channel 0 has factors up to")
    data = bytearray(joined(dfmf(channels)))
    data[len(joined(dfmf(channels)[:6]))] = 3
    refuses(put(bytes(data)), "channel 0: bytes of a number is 3; expected 2, 4 or 8")
    left = rng.random((3 * N_PAIRS, 2)).astype(np.float16)
    right = rng.random((TEXELS, 2)).astype(np.float16)
    refuses(put(fmf(left, right, version=3)), "version is 3; expected 0, 1 or 2")
    refuses(put(fmf(left[::3], right)), "factors is 6 x 20; expected 18 x 20")
    views = some_views(rng, True)
    refuses(put(pvf(views[:1])), "factorised views is 1; expected 2")
    wrong = [(mean, components, weights[:-1]) for mean, components, weights in views]
    refuses(put(pvf(wrong)), "view 0 has 19 weights of 9 values; expected 20 of 9, or 3 of 60")
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    refuses(put(bdi(values, packing=3)), r"compression is 3; expected 0 \(none\), 1 \(bzip2\) or 2")
    packed = bdi(values, packing=1)
    refuses(put(packed), "chunk 0: bytes once unpacked is 360; expected at most 359", memory=359)
    for chunk, match in (
        (bz2.compress(bytes(358)), "chunk 1: bytes once unpacked is 358; expected 360"),
        (bz2.compress(bytes(1 << 20)), "chunk 1: bytes once unpacked is 361; expected 360"),
        (packed[-1][1][4:-20], "chunk 1: bytes once unpacked is 0; expected 360"),
        (b"BZh9" + bytes(50), "chunk 1 is damaged"),
    ):
        opened = read_btf(put([*packed[:-1], ("", u32(len(chunk)) + chunk)]))
        with pytest.raises(InputError, match=f"material.btf: {match}"):
            opened.read(0)
    refuses(put(joined(bdi(values, packing=2, mask=np.zeros((ROWS, COLS)))) + b"\0"), "follow")


def test_a_value_that_is_not_finite_stops_ingest_by_name(put, rng, tmp_path):
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    values[1, 2, 1, 0, 2] = np.nan
    with pytest.raises(InputError, match="view 1, light 0: holds 1 NaN"):
        ingest(read_btf(put(bdi(values))), tmp_path / "s.npz")
    views = some_views(rng, True)
    views[0][0][4] = np.inf
    with pytest.raises(InputError, match="view 0, light 1: holds 20 NaN or inf"):
        ingest(read_btf(put(pvf(views))), tmp_path / "s.npz")


@settings(few, max_examples=100)
@given(
    st.sampled_from(KINDS),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4),
)
def test_any_spoilt_byte_gives_a_result_or_one_clear_refusal(put, kind, changes):
    data = bytearray(joined(every_file(np.random.default_rng(3))[kind]))
    for place, value in changes:
        data[int(place * (len(data) - 1))] = value
    try:
        found = read_btf(put(bytes(data)))
    except InputError:
        return
    assert found.n_pairs >= 1
    # what is packed shows its faults when it is unpacked
    faults = suppress(InputError) if kind == "packed bdi" else nullcontext()
    with faults:
        read_pictures(found)


def test_what_the_format_cannot_say_is_not_written(make_sample, rng, tmp_path):
    path = tmp_path / "m.btf"
    sample = make_sample()
    some = Sample(
        sample.codes[:5], sample.light_directions, sample.view_directions,
        sample.light_index[:5], sample.view_index[:5],
    )  # fmt: skip
    with pytest.raises(InputError, match=r"a \.btf file needs every view under every light"):
        write_btf(path, some)
    angular = [rng.random((133, 2))] * 3
    texture = [rng.random((4, 5, 2))] * 3
    for kwargs, match in (
        ({"epsilon": 0.01}, "epsilon is 0.01"),
        ({"pair_factor": np.full(133, 0.5)}, "factors are not their lights' cosines"),
        ({"log_range": True}, "cannot stretch the colours of yuv"),
    ):
        with pytest.raises(InputError, match=match):
            write_btf(path, FactoredModel(angular, texture, "yuv", sample, **kwargs))
    assert not path.exists()


def test_a_factored_model_is_not_asked_for_other_terms_in_vain(make_sample, rng, tmp_path):
    path = tmp_path / "m.btf"
    angular = [rng.random((133, n)).astype(np.float16) for n in (3, 2, 2)]
    texture = [rng.random((4, 5, n)).astype(np.float16) for n in (3, 2, 2)]
    model = FactoredModel(angular, texture, "yuv", make_sample())
    for options, match in (
        ({"terms": (4, 2, 2)}, "terms: 3 2 2; asked for: 4 2 2"),
        ({"space": "rgb"}, "space: yuv; asked for: rgb"),
        ({"precision": "single"}, "precision: half; asked for: single"),
    ):
        with pytest.raises(InputError, match=match):
            write_btf(path, model, **options)
    assert not path.exists()
    write_btf(path, model, terms=[3, 2, 2], space="yuv", precision="half")
    assert read_btf(path).n_terms == (3, 2, 2)
    one, other = (write_btf(path, make_sample(), **k) for k in ({}, {"terms": (32, 16, 16)}))
    assert one.n_terms == other.n_terms


def test_an_unknown_cosine_is_refused(put, rng):
    with pytest.raises(InputError, match="expected inside or divided"):
        read_btf(put(dfmf(some_channels(rng))), cosine="outside")


@pytest.mark.parametrize("packing", [0, 2])
def test_the_mask_of_a_bdi_reaches_the_sample(btfpipe, put, rng, tmp_path, packing):
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    mask = rng.random((ROWS, COLS)) < 0.6
    path = put(bdi(values, packing, mask))
    assert f"invalid texels: {(~mask).sum()}" in btfpipe("info", path).stdout
    done = btfpipe("ingest", path, "-o", tmp_path / "s.npz")
    assert f"invalid texels {(~mask).sum()}" in done.stderr
    sample = Sample.open(tmp_path / "s.npz")
    np.testing.assert_array_equal(sample.mask, mask)
    truth = values.transpose(2, 3, 0, 1, 4).reshape(N_PAIRS, ROWS, COLS, 3)
    np.testing.assert_array_equal(sample.codes, truth * mask[..., None])
    assert f"invalid texels: {(~mask).sum()}" in btfpipe("info", tmp_path / "s.npz").stdout


def test_an_empty_mask_beside_all_texels_says_nothing(put, rng):
    values = rng.random((ROWS, COLS, len(VIEWS), len(LIGHTS), 3)).astype(np.float16)
    assert read_btf(put(bdi(values, mask=np.zeros((ROWS, COLS))))).mask is None
    assert read_btf(put(bdi(values))).mask is None
