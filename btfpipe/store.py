"""The container of everything the project writes: one `.npz`, readable by `numpy.load`.

Members are stored, not compressed, and their array data starts at a multiple of 64 bytes, so that
a reader maps them into memory instead of copying them. One member, ``about.json``, says what the
file is: kind, format version, parameters, digests of the inputs, program version. Nothing in the file
depends on the clock, the machine's paths or the number of threads, so equal work gives equal bytes.
"""

import contextlib
import hashlib
import io
import json
import math
import mmap
import os
import stat
import struct
import tempfile
import tokenize
import zipfile
from pathlib import Path

import numpy as np

from btfpipe import __version__
from btfpipe.errors import InputError, amount
from btfpipe.files import whole

ALIGNMENT = 64
FORMAT_VERSION = 1
_PADDING_ID = 0xD935  # the extra-field id that alignment tools for zip files use
_ABOUT = "about.json"
# What numpy raises of a header with wrong bytes, and reading of a file that ends early.
_BROKEN = (ValueError, TypeError, SyntaxError, tokenize.TokenError, OSError, EOFError, struct.error)
_SINGLE = float(np.finfo(np.float32).max)
_NO_ZIP = (zipfile.BadZipFile, OSError, ValueError, NotImplementedError)  # what `zipfile` raises
_MOST_NUMBER = 1e30  # of a description, whose reciprocal is still within single precision
# What a description's facts may be: in words, and whether a value is one.
_FORMS = {
    "text": ("a text", lambda value: isinstance(value, str)),
    "flag": ("true or false", lambda value: isinstance(value, bool)),
    "count": (
        "a whole number from 1",
        lambda value: type(value) is int and 0 < value < _MOST_NUMBER,
    ),
    "shape": (
        "two whole numbers from 1",
        lambda value: (
            isinstance(value, list)
            and len(value) == 2
            and all(type(n) is int and 0 < n < _MOST_NUMBER for n in value)
        ),
    ),
    "positive": (
        "a positive number",
        lambda value: (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and 1 / _MOST_NUMBER < value < _MOST_NUMBER
        ),
    ),
}


def put_json(file, thing):
    """Write `thing` as indented JSON into an open text file."""
    json.dump(jsonable(thing), file, indent=2, allow_nan=False)
    file.write("\n")


def jsonable(thing):
    """`thing` as JSON can hold it: plain values throughout, null for NaN and infinity."""
    if isinstance(thing, dict):
        return {key: jsonable(value) for key, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [jsonable(value) for value in thing]
    if isinstance(thing, float):
        return float(thing) if math.isfinite(thing) else None
    if thing is None or isinstance(thing, str | int):
        return thing
    return jsonable(_plain(thing))


def _plain(thing):
    """What `json` cannot write by itself: numpy scalars, arrays and paths."""
    if isinstance(thing, np.generic):
        return thing.item()
    if isinstance(thing, np.ndarray):
        return thing.tolist()
    if isinstance(thing, Path):
        return str(thing)
    raise TypeError(f"{type(thing).__name__} has no JSON form")


def scratch(shape, dtype):
    """An array of zeros, mapped from a temporary file without a name that goes when the array does.

    For results too large to be kept in memory until they are written. The folder is that of `tempfile`: the
    environment variable TMPDIR chooses it.

    Raises
    ------
    InputError
        If the folder has no room for it.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    with tempfile.TemporaryFile() as file:
        try:
            # a mapped file that runs out of room ends the program, without a word
            reserve = getattr(os, "posix_fallocate", None)  # macOS has none
            reserve(file.fileno(), 0, size) if reserve else file.truncate(size)
        except OSError as error:
            raise InputError(
                f"{tempfile.gettempdir()}: no room for a temporary file of {amount(size)}"
                f" ({error.strerror}); make room there, choose another folder by TMPDIR, or raise --memory."
            ) from error
        return np.memmap(file, dtype, "r+", shape=tuple(shape))


def will_read(array, part):
    """Ask the system for ``array[:, part]`` of a mapped array, and for nothing around it.

    Left to itself it reads on behind every place that is touched: for a few scan lines of all pictures nearly the whole file,
    and again for the next few if the file is larger than memory. Of an array in memory nothing is asked.
    """
    mapped = array.base
    if isinstance(mapped, mmap.mmap) and hasattr(mapped, "madvise"):
        for start, length in _pages(array, part):
            mapped.madvise(mmap.MADV_WILLNEED, start, length)


def _pages(array, part):
    """Start and length, in bytes of the mapped file, of ``array[i, part]`` for each i, from whole pages on."""
    size, line = array.strides[:2]
    first = array.offset % mmap.ALLOCATIONGRANULARITY + part.start * line
    for start in range(first, first + len(array) * size, size):
        page = start // mmap.PAGESIZE * mmap.PAGESIZE
        yield page, start + (part.stop - part.start) * line - page


class Writer:
    """Writes the members of a container one after the other, streaming.

    Use it through `create`. `array` writes a whole array, `stream` opens a member of known shape to
    be filled block by block in C order.
    """

    def __init__(self, file):
        self._file = file
        self._zip = zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True)

    def array(self, name, array):
        """Write one array as member `name`."""
        array = np.asarray(array)
        with self.stream(name, array.shape, array.dtype) as put:
            # what lies in another order is copied part by part
            for part in [array] if array.flags.c_contiguous else array:
                put(part)

    @contextlib.contextmanager
    def stream(self, name, shape, dtype):
        """Open member `name` of the given shape; the block gets a function that appends C-order data.

        Raises
        ------
        ValueError
            If the blocks do not add up to the shape.
        """
        dtype = np.dtype(dtype)
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header,
            {
                "descr": np.lib.format.dtype_to_descr(dtype),
                "fortran_order": False,
                "shape": tuple(int(n) for n in shape),
            },
        )
        expected = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize
        written = 0
        with self._open(f"{name}.npy", len(header.getvalue())) as member:
            member.write(header.getvalue())

            def put(block):
                nonlocal written
                block = np.ascontiguousarray(block, dtype=dtype)
                member.write(memoryview(block).cast("B") if block.size else b"")
                written += block.nbytes

            yield put
            if written != expected:
                raise ValueError(f"member {name}: {written} bytes written, {expected} promised")

    def about(self, thing):
        """Write the description; the last member."""
        with self._open(_ABOUT, 0) as member:
            member.write((json.dumps(thing, default=_plain, sort_keys=True) + "\n").encode())

    def _open(self, name, prefix):
        """Open a member whose data after `prefix` bytes starts at a multiple of 64 bytes."""
        info = zipfile.ZipInfo(name)  # the zip epoch: no clock time inside
        info.external_attr = 0o644 << 16
        zip64_extra = 20  # what zipfile adds to the local header when force_zip64 is set
        start = self._file.tell() + 30 + len(name.encode()) + zip64_extra + 4 + prefix
        padding = -start % ALIGNMENT
        info.extra = struct.pack("<HH", _PADDING_ID, padding) + bytes(padding)
        return self._zip.open(info, "w", force_zip64=True)

    def close(self):
        self._zip.close()


@contextlib.contextmanager
def create(path, kind, **about):
    """Open a container for writing; it appears at `path` only if the block succeeds.

    Parameters
    ----------
    path : path-like
        Target.
    kind : str
        What the file holds: ``sample``, ``model``, ``features``, ``surface``, ``map``.
    **about
        Plain values for the description (parameters, seed, digests of the inputs). The mapping is
        passed to the block as ``writer.facts`` and may still be extended there.
    """
    with whole(path) as file:
        writer = Writer(file)
        writer.facts = about
        try:
            yield writer
            writer.about(
                {"kind": kind, "format": FORMAT_VERSION, "btfpipe": __version__, **writer.facts}
            )
        except BaseException:
            with contextlib.suppress(Exception):
                writer.close()  # or it complains when collected, after its file is gone
            raise
        writer.close()


def write(path, kind, arrays, **about):
    """Write a dict of arrays and a description at once."""
    with create(path, kind, **about) as writer:
        for name, array in arrays.items():
            writer.array(name, array)


class Reader:
    """A container opened for reading. Arrays are mapped, read-only, when asked for.

    Attributes
    ----------
    about : dict
        The description.
    path : Path
        The file.
    """

    def __init__(self, path, kind=None):
        self.path = Path(path)
        self._members = {}
        try:
            with zipfile.ZipFile(self.path) as archive:
                if _ABOUT not in archive.namelist():
                    raise InputError(
                        f"{path}: a zip file, but not one of btfpipe's (no {_ABOUT} inside)."
                        f"{_expected(kind)} `btfpipe info {path}` says what it is."
                    )
                if archive.getinfo(_ABOUT).compress_type != zipfile.ZIP_STORED:
                    raise ValueError(f"{_ABOUT} is compressed")
                self.about = json.loads(archive.read(_ABOUT))
                if not (
                    isinstance(self.about, dict)
                    and isinstance(self.about.get("kind"), str)
                    and isinstance(self.about.get("format"), int)
                ):
                    raise ValueError(f"{_ABOUT} names no kind and format")
                for info in archive.infolist():
                    self._members[info.filename] = info
        except FileNotFoundError as error:
            raise InputError(f"{path}: no such file.{_expected(kind)}") from error
        except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, EOFError) as error:
            raise InputError(
                f"{path}: not a btfpipe file, or damaged ({error}).{_expected(kind)}"
                f" `btfpipe info {path}` says what it is."
            ) from error
        found = self.about["kind"]
        if kind is not None and found not in ((kind,) if isinstance(kind, str) else kind):
            raise InputError(f"{path}: holds a {found}.{_expected(kind)}")
        if self.about["format"] > FORMAT_VERSION:
            raise InputError(
                f"{path}: format version {self.about['format']}, written by btfpipe"
                f" {self.about.get('btfpipe')}; this is {__version__}, which reads up to"
                f" {FORMAT_VERSION}. Install a newer btfpipe."
            )

    @property
    def kind(self):
        return self.about["kind"]

    def names(self):
        """Names of the arrays, in the order written."""
        return [name[:-4] for name in self._members if name.endswith(".npy")]

    def __contains__(self, name):
        return f"{name}.npy" in self._members

    def __getitem__(self, name):
        """Map array `name`, read-only."""
        info = self._members.get(f"{name}.npy")
        if info is None:
            raise InputError(f"{self.path}: holds no array {name!r}; it has {self.names()}.")
        try:
            return self._map(info)
        except _BROKEN as error:
            raise InputError(f"{self.path}: array {name!r} is damaged ({error}).") from error

    def _map(self, info):
        with self.path.open("rb") as file:
            file.seek(info.header_offset)
            header = file.read(30)
            if header[:4] != b"PK\x03\x04":
                raise ValueError("no local header where the directory says")
            name_length, extra_length = struct.unpack("<HH", header[26:30])
            file.seek(info.header_offset + 30 + name_length + extra_length)
            start = file.tell()
            version = np.lib.format.read_magic(file)
            if version != (1, 0):
                raise ValueError(f"npy version {version}")
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
            offset = file.tell()
        size = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if fortran or dtype.hasobject or info.file_size != offset - start + size:
            raise ValueError(f"{info.file_size} bytes do not hold {shape} of {dtype}")
        if dtype.kind not in "biuf" or dtype.itemsize > 8 or not dtype.isnative:
            raise ValueError(f"{dtype.str} is no kind of number that btfpipe writes")
        if size == 0:
            return np.zeros(shape, dtype)
        return np.memmap(self.path, dtype, "r", offset, shape)

    def fact(self, name, form, *default):
        """One value of the description, checked.

        Parameters
        ----------
        name : str
        form : str
            ``text``, ``flag``, ``count``, ``shape`` or ``positive``.
        *default
            What a missing value or null stands for; without it they are refused.

        Raises
        ------
        InputError
        """
        value = self.about.get(name)
        if value is None and default:
            return default[0]
        if name not in self.about:
            raise InputError(f"{self.path}: its description lacks {name!r}.")
        return check_fact(value, form, f"{self.path}: {name}")

    def require(self, name, shape, dtype=None, finite=True, most=_SINGLE):
        """Map array `name` and check it.

        Parameters
        ----------
        name : str
        shape : tuple
            Expected shape; None stands for any length.
        dtype : str, optional
            Expected kind characters of the dtype, such as ``"f"`` or ``"iu"``.
        finite : bool
            Refuse NaN and infinity in floating-point arrays. Leave it out only for bulk data whose
            reading would cost more than the work that follows.
        most : float
            Greatest absolute value, for what is squared or multiplied later on; by default that of single precision, as
            in which all is worked with.

        Raises
        ------
        InputError
        """
        array = self[name]
        if len(array.shape) != len(shape) or any(
            want is not None and want != have
            for want, have in zip(shape, array.shape, strict=False)
        ):
            wanted = tuple("any" if n is None else n for n in shape)
            raise InputError(f"{self.path}: {name} has shape {array.shape}; expected {wanted}.")
        if dtype is not None and array.dtype.kind not in dtype:
            raise InputError(f"{self.path}: {name} is {array.dtype}; expected kind {dtype!r}.")
        if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
            bad = int(np.size(array) - np.isfinite(array).sum())
            raise InputError(f"{self.path}: {name} holds {bad} NaN or infinite values.")
        if finite and array.size and (most < _SINGLE or array.dtype == np.float64):
            reached = max(float(array.max()), -float(array.min()))
            if reached > most:
                raise InputError(
                    f"{self.path}: {name} reaches {reached:.3g}; expected at most {most:.3g}. The file is damaged."
                )
        return array

    @property
    def digest(self):
        """Digest of the content: of the members' names, sizes and checksums (12 hex digits)."""
        return _members_digest(self._members.values())


def check_fact(value, form, what):
    """A value of a description, refused if it has another form (see `Reader.fact`); `what` is what messages call it."""
    wanted, fits = _FORMS[form]
    if not fits(value):
        raise InputError(f"{what} is {value!r:.40}; expected {wanted}.")
    return value


def is_ours(path):
    """Whether a file is a container of the project's (perhaps of a newer version, perhaps damaged)."""
    try:
        with zipfile.ZipFile(path) as archive:
            return _ABOUT in archive.namelist()
    except _NO_ZIP:
        return False


def _expected(kind):
    if kind is None:
        return ""
    kinds = [kind] if isinstance(kind, str) else list(kind)
    return f" Expected a {' or '.join(kinds)} made by {' or '.join(_MAKERS[k] for k in kinds)}."


_MAKERS = {
    "sample": "`btfpipe ingest`",
    "model": "`btfpipe compress`",
    "features": "`btfpipe textons`",
    "surface": "`btfpipe surface`",
    "map": "`btfpipe synthesize`",
}


def read(path, kind=None):
    """Open a container; see `Reader`. `kind` may be one kind or several."""
    return Reader(path, kind)


def _members_digest(infos):
    digest = hashlib.sha256()
    for info in sorted(infos, key=lambda info: info.filename):
        digest.update(f"{info.filename}\0{info.file_size}\0{info.CRC}\n".encode())
    return digest.hexdigest()[:12]


def walk(folder):
    """Everything below a folder, by names relative to it with forward slashes.

    Returns
    -------
    files : dict of str to int
        Sizes in bytes of the regular files; links to files are followed.
    folders : list of str
    others : list of str
        Links that lead nowhere, pipes and the like.

    Raises
    ------
    InputError
        If a folder cannot be listed, or a file vanishes meanwhile.
    """

    def fail(error):
        raise error

    folder = Path(folder)
    files, folders, others = {}, [], []
    try:
        for where, below, names in os.walk(folder, onerror=fail):
            here = Path(where).relative_to(folder)
            folders += [(here / name).as_posix() for name in below]
            for name in names:
                place, short = Path(where) / name, (here / name).as_posix()
                dangling = place.is_symlink() and not place.exists()
                found = None if dangling else place.stat()
                if found is not None and stat.S_ISREG(found.st_mode):
                    files[short] = found.st_size
                else:
                    others.append(short)
    except OSError as error:
        raise InputError(
            f"{error.filename or folder}: cannot be read ({error.strerror}); the folder must be readable"
            " throughout and stay as it is."
        ) from error
    return files, folders, others


def digest(path):
    """Digest of any input, cheap for large ones (12 hex digits).

    Zip files, ours and foreign, by the checksums of their members; folders by the names and sizes of their
    files; everything else by its bytes.
    """
    path = Path(path)
    if path.is_dir():
        digest = hashlib.sha256()
        files = walk(path)[0]
        for name in sorted(files, key=lambda name: name.split("/")):
            digest.update(f"{name}\0{files[name]}\n".encode())
        return digest.hexdigest()[:12]
    try:
        with zipfile.ZipFile(path) as archive:
            return _members_digest(archive.infolist())
    except _NO_ZIP:
        pass
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:12]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
