"""The writers here are made from the description of the formats, apart from the reader."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.errors import InputError
from btfpipe.formats import ptm
from btfpipe.formats.images import encode_picture, read_picture
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


def jpeg_file(codes, colour, chosen, side=None, end="\n"):
    """Bytes of a PTM of grey JPEGs, and its planes as they must come back, (rows, cols, n) from the top.

    `chosen`: for each plane the place in the order, the plane that it is predicted from or -1, and whether inverted.
    `side`: by plane, flat places from the bottom and values.
    """
    rows, cols = codes.shape[:2]
    planes = codes.reshape(rows, cols, -1)
    planes = (planes if colour is None else np.concatenate([planes, colour], axis=2))[::-1]
    n, side = planes.shape[2], side or {}
    back, packed, notes = np.zeros(planes.shape, np.uint8), [b""] * n, [b""] * n
    for c in sorted(range(n), key=lambda c: chosen[c][0]):
        _, reference, inverted = chosen[c]
        assumed = np.full((rows, cols), 128)
        if reference >= 0:
            assumed = back[..., reference].astype(int)
            assumed = 255 - assumed if inverted else assumed
        left = ((planes[..., c].astype(int) - assumed + 128) % 256).astype(np.uint8)
        packed[c] = encode_picture(left, ".jpg", 100)
        seen = read_picture(packed[c])[..., 0].astype(int)
        back[..., c] = (seen + assumed - 128) % 256
        for place, value in side.get(c, ()):
            back[place // cols, place % cols, c] = value
            notes[c] += struct.pack(">IB", place, value)
    order, reference, inverted = zip(*chosen, strict=True)
    numbers = [
        [100],
        inverted,
        [0] * n,
        [0] * n,
        order,
        reference,
        map(len, packed),
        map(len, notes),
    ]
    kind = "PTM_FORMAT_JPEG_RGB" if colour is None else "PTM_FORMAT_JPEG_LRGB"
    head = ["PTM_1.2", kind, str(cols), str(rows), " ".join(f"{s:.6f}" for s in SCALES)]
    head += [" ".join(map(str, some)) for some in (BIASES, *numbers)]
    return (end.join(head) + end).encode() + b"".join(
        jpeg + note for jpeg, note in zip(packed, notes, strict=True)
    ), back[::-1]


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


@pytest.mark.parametrize("kind", ["PTM_FORMAT_JPEG_RGB", "PTM_FORMAT_JPEG_LRGB"])
@pytest.mark.parametrize("predicted", [False, True])
def test_maps_packed_by_jpeg_are_read(tmp_path, rng, kind, predicted):
    channels = 3 if kind.endswith("_RGB") else 1
    smooth = np.add.outer(np.arange(12) * 5, np.arange(10) * 7)[..., None]
    n = 6 * channels
    codes = (
        ((smooth * rng.random(n) + 100 * rng.random(n)) % 256)
        .astype(np.uint8)
        .reshape(12, 10, channels, 6)
    )
    colour = (smooth[..., [0, 0, 0]] + [3, 9, 100]).astype(np.uint8) if channels == 1 else None
    n += 0 if colour is None else 3
    chosen, side = [(c, -1, 0) for c in range(n)], {}
    if (
        predicted
    ):  # the last plane first; each second one from the next, every fourth of those inverted
        chosen = [
            (n - 1 - c, c + 1 if c % 2 == 0 and c < n - 1 else -1, int(c % 4 == 0))
            for c in range(n)
        ]
        side = {1: [(0, 7), (119, 250)], 4: [(13, 0)]}
    data, back = jpeg_file(codes, colour, chosen, side)
    (tmp_path / "a.ptm").write_bytes(data)
    model = read_model(tmp_path / "a.ptm")
    coefficients = model.coefficients.reshape(12, 10, -1)
    np.testing.assert_array_equal(coefficients, back[..., : 6 * channels])
    if colour is not None:
        np.testing.assert_array_equal(model.colour, back[..., 6:])
        assert abs(model.colour.astype(int) - colour).max() < 12  # as far as a JPEG goes
    check(
        model,
        back[..., : 6 * channels].reshape(codes.shape),
        None if colour is None else back[..., 6:],
        rng,
    )
    assert model.about["source"]["format"] == f"PTM_1.2 {kind}"


def a_jpeg_file():
    rng = np.random.default_rng(4)
    codes, colour = (
        rng.integers(0, 256, (3, 4, 1, 6), np.uint8),
        rng.integers(0, 256, (3, 4, 3), np.uint8),
    )
    chosen = [(c, c - 1, 0) for c in range(9)]
    return jpeg_file(codes, colour, chosen, {2: [(5, 9)]})[0]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"\n0 0 0 0 0 0 0 0 0\n0 0", b"\n2 0 0 0 0 0 0 0 0\n0 0", "in a way that is not read"),
        (b"\n0 1 2 3", b"\n1 0 2 3", "the order or the sizes"),
        (b"\n0 1 2 3", b"\n0 0 2 3", "the order or the sizes"),
        (b"\n-1 0 1 2", b"\n-1 0 1 9", "in a way that is not read"),
        (b"\n-1 0 1 2", b"\n-1 0 1 3", "the order or the sizes"),
        (b"\n-1 0 1 2", b"\n-1 0.5 1 2", "in a way that is not read"),
        (b"\n4\n3\n", b"\n3\n4\n", "plane 0: 3 x 4 x 1 uint8; expected 4 x 3, grey"),
        (b"\n4\n3\n", b"\n9999\n9999\n", "plane 0: 3 x 4 x 1"),
        (b"\n0 0 5 0", b"\n0 0 4 0", "1 bytes follow"),
        (b"\n0 0 5 0", b"\n0 0 9 0", "truncated"),
        (b"\0\0\0\5\t", b"\0\0\0\x0c\t", "plane 2: a correction at 12 of 12"),
        (b"\xff\xd8\xff", b"\xff\xd8\xfe", "plane 0"),
    ],
)
def test_damaged_maps_packed_by_jpeg_are_refused(tmp_path, old, new, match):
    data = a_jpeg_file()
    assert old in data
    (tmp_path / "mine").write_bytes(data.replace(old, new, 1))
    with pytest.raises(InputError, match=match) as caught:
        read_model(tmp_path / "mine")
    assert "mine" in str(caught.value)


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
    if "JPEG" in kind:
        return a_jpeg_file()
    rng = np.random.default_rng(4)
    if kind == "hsh":
        return hsh_file(rng.integers(0, 256, (3, 4, 3, 9), np.uint8), rng.random(9), rng.random(9))
    codes = rng.integers(0, 256, (3, 4, 3 if kind.endswith("_RGB") else 1, 6), np.uint8)
    return ptm_file(kind, codes, rng.integers(0, 256, (3, 4, 3), np.uint8))


@pytest.mark.parametrize(
    "kind", ["PTM_FORMAT_RGB", "PTM_FORMAT_LRGB", "PTM_FORMAT_JPEG_LRGB", "hsh"]
)
def test_every_cut_and_every_addition_is_noticed(tmp_path, kind):
    data, path = whole(kind), tmp_path / "mine"
    cuts = range(0, len(data), 1 + len(data) // 500)
    for spoiled in [data[:n] for n in cuts] + [data + b"more", data + bytes(range(99))]:
        path.write_bytes(spoiled)
        with pytest.raises(InputError, match="mine: "):
            read_model(path)
    path.write_bytes(data + b"\r\n")
    read_model(path)


@pytest.mark.parametrize(
    ("kind", "old", "new", "match"),
    [
        ("PTM_FORMAT_RGB", b"PTM_1.2", b"PTM_2.0", "version 'PTM_2.0'"),
        ("PTM_FORMAT_RGB", b"FORMAT_RGB", b"FORMAT_JPEGLS_RGB", "not supported.*ingest the pictures"),
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
