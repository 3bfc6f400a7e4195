"""Files of every format cut, lengthened and spoilt: each gives a result or one clear refusal, whatever its bytes.

Other tests of a format go through its sections one by one; Bonn's ``.btf`` has all of its own.
"""

import functools
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.compression.model import Model
from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.formats import sources, targets
from btfpipe.formats.curet_writing import write_curet
from btfpipe.formats.describe import describe_foreign
from btfpipe.formats.images import encode_picture
from btfpipe.sample import Sample

SETS = ("curet", "pairs", "rti", "ubo", "utia")
FITTED = ("hsh", "ptm")
PICTURES = (".bmp", ".exr", ".hdr", ".jpg", ".png", ".tif")


@functools.cache
def whole(kind, packing=zipfile.ZIP_DEFLATED):
    """Bytes of a sound file."""
    rng = np.random.default_rng(4)
    if kind == "hsh":
        return (
            b"#HSH1.2\n3\n4 3 3\n4 2 1\n" + rng.random(8).astype("<f4").tobytes() + rng.bytes(144)
        )
    if kind == "ptm":
        scale, bias = b"1.5 " * 6 + b"\n", b"100 " * 6 + b"\n"
        return b"PTM_1.2\nPTM_FORMAT_RGB\n4\n3\n" + scale + bias + rng.bytes(4 * 3 * 18)
    if kind in PICTURES:
        floats = kind in (".exr", ".hdr")
        values = rng.random((5, 6, 3)).astype(np.float32)
        return encode_picture(values if floats else (values * 255).astype(np.uint8), kind)
    pair = np.arange(6)
    codes = rng.random((6, 5, 6, 3)).astype(np.float16)
    sample = Sample(codes, bonn81()[:3], bonn81()[:2], pair % 3, pair // 3)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "set.zip"
        if kind == "curet":
            write_curet(path, sample, 5, frame=(24, 32), numbers=[30, 54], calibrated=True)
        else:
            targets.write(path, kind, sample, suffix=".png")
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w", packing) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        return path.read_bytes()


def read_all(kind, data):
    """Read a file by its format, every picture of it; and describe it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("mine.zip" if kind in SETS else "mine")
        path.write_bytes(data)
        name = "ptm" if kind in FITTED else "picture" if kind in PICTURES else kind
        sources.recognise(path)
        describe_foreign(path)
        opened = sources.open_source(path, name, **({"rectify": False} if kind == "curet" else {}))
        if isinstance(opened, Model):
            return opened.pictures([0])
        with opened as measurement:
            return [measurement.read(pair) for pair in range(measurement.n_pairs)]


def refusal(kind, data):
    """Why a file is refused, or None if it is read."""
    try:
        read_all(kind, data)
    except InputError as error:
        return str(error)


@pytest.mark.parametrize("kind", [*SETS, *FITTED, *PICTURES])
def test_a_sound_file_is_read(kind):
    assert len(read_all(kind, whole(kind))) > 0


@pytest.mark.parametrize("kind", [*SETS, *FITTED])
def test_a_file_cut_anywhere_is_refused(kind):
    data = whole(kind)
    for end in np.linspace(0, len(data) - 1, 40).astype(int):
        assert "mine" in refusal(kind, data[:end])


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from((*SETS, *FITTED, *PICTURES)),
    st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=4),
    st.lists(st.tuples(st.integers(1, 400), st.integers(0, 255)), max_size=2),
    st.binary(max_size=9),
)
def test_any_spoilt_bytes_give_a_result_or_one_clear_refusal(kind, packing, anywhere, at_end, more):
    """Counts stand at the beginning of most files and near the end of a zip."""
    data = bytearray(whole(kind, packing))
    for place, value in anywhere:
        data[int(place * (len(data) - 1))] = value
    for place, value in at_end:
        data[-min(place, len(data))] = value
    said = refusal(kind, bytes(data) + more)
    assert said is None or ("mine" in said and "\n" not in said)
