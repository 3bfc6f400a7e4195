"""The writers here are made from the description of the formats, apart from the reader."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.errors import InputError
from btfpipe.formats import ptm
from btfpipe.formats.ptm import read_model

SCALES = np.array([0.5, 2.0, 0.25, 1.0, 1.5, 1.0])
BIASES = np.array([100, 128, 3, 140, 120, 0])


def ptm_file(kind, codes, colour=None, version="PTM_1.2", end="\n", one_line=False):
    """Bytes of a PTM of codes (rows, cols, channels, 6), row 0 at the top."""
    rows, cols = codes.shape[:2]
    upside_down = codes[::-1]
    head = [version, kind]
    head += [f"{cols} {rows}"] if one_line else [str(cols), str(rows)]
    numbers = [" ".join(f"{s:.6f}" for s in SCALES) + " ", " ".join(str(b) for b in BIASES)]
    head += [" ".join(numbers)] if one_line else numbers
    body = b""
    if kind == "PTM_FORMAT_RGB":
        for c in range(3):
            body += upside_down[:, :, c].tobytes()
    elif version == "PTM_1.2":
        body = upside_down[:, :, 0].tobytes() + colour[::-1].tobytes()
    else:
        for i in range(rows):
            for j in range(cols):
                body += upside_down[i, j, 0].tobytes() + colour[rows - 1 - i, j].tobytes()
    return (end.join(head) + end).encode() + body


def hsh_file(codes, scales, biases, end="\n", comment=""):
    rows, cols, _, terms = codes.shape
    head = f"#HSH1.2{end}{comment}3{end}{cols} {rows} 3{end}{terms} 2 1{end}".encode()
    numbers = struct.pack(f"<{2 * terms}f", *scales, *biases)
    return head + numbers + b"".join(codes[i].tobytes() for i in reversed(range(rows)))


def srgb(code):
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)  # fmt: skip


def expected(codes, colour, light):
    """Naive twin: linear picture by the published formula."""
    u, v = light[:2]
    a = (codes.astype(float) - BIASES) * SCALES
    value = (
        a[..., 0] * u * u
        + a[..., 1] * v * v
        + a[..., 2] * u * v
        + a[..., 3] * u
        + a[..., 4] * v
        + a[..., 5]
    )
    value = np.maximum(value, 0) / 255
    return srgb(value if colour is None else value * colour / 255)  # fmt: skip


def check(model, codes, colour, rng):
    for pair in rng.integers(0, 81, 4):
        light = model.light_directions[pair]
        np.testing.assert_allclose(
            model.pictures([pair])[0], expected(codes, colour, light), rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("version", ["PTM_1.1", "PTM_1.2"])
@pytest.mark.parametrize("kind", ["PTM_FORMAT_RGB", "PTM_FORMAT_LRGB"])
@pytest.mark.parametrize(("end", "one_line"), [("\n", False), ("\r\n", False), ("\n", True)])
def test_polynomial_texture_maps_are_read(tmp_path, rng, kind, version, end, one_line):
    channels = 3 if kind == "PTM_FORMAT_RGB" else 1
    codes = rng.integers(0, 256, (4, 5, channels, 6), np.uint8)
    colour = rng.integers(0, 256, (4, 5, 3), np.uint8) if channels == 1 else None
    (tmp_path / "a.ptm").write_bytes(ptm_file(kind, codes, colour, version, end, one_line))
    model = read_model(tmp_path / "a.ptm")
    check(model, codes, colour, rng)
    assert model.about["source"] == {"format": f"{version} {kind}", "source_transfer": "srgb"}
    assert "PTM" in ptm.recognise(tmp_path / "a.ptm")


@settings(max_examples=15, deadline=None)
@given(
    st.integers(1, 6), st.integers(1, 6), st.sampled_from([1, 4, 9, 16]), st.integers(0, 2**32 - 1),
    st.sampled_from(["\n", "\r\n"]), st.sampled_from(["", "# made by hand\n"]),
)  # fmt: skip
def test_harmonics_are_read(tmp_path_factory, rows, cols, terms, seed, end, comment):
    from btfpipe.compression.relighting import evaluate_basis

    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 256, (rows, cols, 3, terms), np.uint8)
    scales, biases = rng.normal(size=(2, terms)).astype(np.float32)
    path = tmp_path_factory.mktemp("hsh") / "a.rti"
    path.write_bytes(hsh_file(codes, scales, biases, end, comment))
    model = read_model(path, transfer="gamma2.2")
    light = model.light_directions[40]
    # the basis itself is compared with its definition where it lives
    basis = evaluate_basis("hsh", terms, light[None])[0]
    display = np.maximum((codes / 255 * scales + biases) @ basis, 0)
    np.testing.assert_allclose(model.pictures([40])[0], display**2.2, rtol=1e-3, atol=1e-4)
    assert "HSH" in ptm.recognise(path)


def whole(kind):
    rng = np.random.default_rng(4)
    if kind == "hsh":
        return hsh_file(rng.integers(0, 256, (3, 4, 3, 9), np.uint8), rng.random(9), rng.random(9))
    codes = rng.integers(0, 256, (3, 4, 3 if kind.endswith("_RGB") else 1, 6), np.uint8)
    return ptm_file(kind, codes, rng.integers(0, 256, (3, 4, 3), np.uint8))


@pytest.mark.parametrize("kind", ["PTM_FORMAT_RGB", "PTM_FORMAT_LRGB", "hsh"])
def test_every_cut_and_every_addition_is_noticed(tmp_path, kind):
    data, path = whole(kind), tmp_path / "mine"
    for spoiled in [data[:n] for n in range(len(data))] + [data + b"more", data + bytes(range(99))]:
        path.write_bytes(spoiled)
        with pytest.raises(InputError, match="mine: "):
            read_model(path)
    path.write_bytes(data + b"\r\n")
    read_model(path)


@pytest.mark.parametrize(
    ("kind", "old", "new", "match"),
    [
        ("PTM_FORMAT_RGB", b"PTM_1.2", b"PTM_2.0", "version 'PTM_2.0'"),
        ("PTM_FORMAT_RGB", b"FORMAT_RGB", b"FORMAT_JPEG_RGB", "compressed by JPEG.*ingest the pictures"),
        ("PTM_FORMAT_RGB", b"FORMAT_RGB", b"FORMAT_LUM", "not supported"),
        ("PTM_FORMAT_RGB", b"\n4\n3\n", b"\n4000\n3000\n", "calls for 216000000 bytes"),
        ("PTM_FORMAT_RGB", b"\n4\n3\n", b"\n400000\n300000\n", "at most"),
        ("PTM_FORMAT_RGB", b"\n4\n3\n", b"\n-4\n-3\n", "at most"),
        ("PTM_FORMAT_RGB", b"\n4\n3\n", b"\n4.5\n3\n", "at most"),
        ("PTM_FORMAT_RGB", b"\n4\n3\n", b"\n0\n3\n", "at most"),
        ("PTM_FORMAT_RGB", b"2.000000", b"nan", "expected 14 numbers"),
        ("PTM_FORMAT_RGB", b"2.000000", b"1e99", "expected 14 numbers"),
        ("PTM_FORMAT_RGB", b"2.000000", b"2.0 7 7", "expected 14 numbers"),
        ("hsh", b"\n3\n4 3 3\n", b"\n4\n4 3 3\n", "an adaptive basis"),
        ("hsh", b"\n3\n4 3 3\n", b"\n3\n4 3 1\n", "1 channels"),
        ("hsh", b"\n9 2 1\n", b"\n8 2 1\n", "8 terms"),
        ("hsh", b"\n9 2 1\n", b"\n9 1 1\n", "basis type 1"),
        ("hsh", b"\n9 2 1\n", b"\n9 2 4\n", "4 bytes each"),
        ("hsh", b"\n3\n4 3 3\n", b"\n3\n99999 9999 3\n", "at most"),
        ("hsh", b"\n3\n4 3 3\n", b"\n3\n9999 9999 3\n", "truncated"),
        ("hsh", b"#HSH1.2", b"HSH1.2", "expected PTM_1.2 or #HSH1.2"),
    ],
)  # fmt: skip
def test_a_wrong_header_is_refused_with_the_reason(tmp_path, kind, old, new, match):
    data = whole(kind)
    assert data.count(old) == 1
    (tmp_path / "mine").write_bytes(data.replace(old, new))
    with pytest.raises(InputError, match=match):
        read_model(tmp_path / "mine")


@pytest.mark.parametrize("place", [0, 9])  # a scale, a bias
@pytest.mark.parametrize(  # NaN, a signalling one, inf, 1.7e38, 2.4e15, -2.4e15
    "bits", [0x7FC00000, 0x7FA00000, 0x7F800000, 0x7F000000, 0x59086A00, 0xD9086A00]
)
def test_scales_that_no_picture_has_are_refused(tmp_path, bits, place):
    data = bytearray(whole("hsh"))
    at = data.index(b"9 2 1\n") + 6 + 4 * place
    data[at : at + 4] = struct.pack("<I", bits)
    (tmp_path / "mine").write_bytes(data)
    with pytest.raises(InputError, match=r"mine: .* display values up to"):
        read_model(tmp_path / "mine")


@pytest.mark.parametrize(("place", "bits"), [(0, 0x530FFFFF), (9, 0x57800000)])  # 6e11, 2.8e14
def test_values_far_beyond_white_are_finite(tmp_path, place, bits):
    """Damaged or not, what is read has linear values in single precision (a power of 2.4 of these display values)."""
    data = bytearray(whole("hsh"))
    at = data.index(b"9 2 1\n") + 6 + 4 * place
    data[at : at + 4] = struct.pack("<I", bits)
    (tmp_path / "mine").write_bytes(data)
    values = read_model(tmp_path / "mine").pictures(slice(None))
    assert np.isfinite(values).all()
    assert values.max() > 1e20


def test_other_files_are_not_taken_for_ptms(tmp_path):
    (tmp_path / "empty").touch()
    for path in (tmp_path / "empty", tmp_path, tmp_path / "nothing", __file__):
        assert ptm.recognise(path) is None
    with pytest.raises(InputError, match="cannot be read"):
        read_model(tmp_path / "nothing")
