"""A folder or a zip, seen as names and bytes.

Nothing is unpacked; a zip's members are read by their place in the file, on any number of threads at once.
"""

import os
import re
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from btfpipe import store
from btfpipe.errors import InputError

COPY = re.compile(r" \(member \d+ of that name\)$")  # tells members of one name apart
_MAX_MEMBER = 2**30  # bytes of one picture, far above any real one
_MAX_RATIO = 1032  # of deflate: more is a lie
# What zipfile raises of a directory with wrong bytes: a version, a name or an extra field that cannot be.
_BROKEN = (
    zipfile.BadZipFile,
    NotImplementedError,
    IndexError,
    ValueError,
    OverflowError,
    struct.error,
)


def is_zip(path):
    """Whether a file is a zip, whole or not, or calls itself one."""
    try:
        with open(path, "rb") as file:
            head = file.read(4)
    except OSError:
        head = b""
    return head in (b"PK\x03\x04", b"PK\x05\x06") or Path(path).suffix.lower() == ".zip"


def open_archive(path):
    """Open a folder or a zip.

    Returns
    -------
    Folder or Zip
        With ``names``, ``read(name)`` and, as a context manager, an end.

    Raises
    ------
    InputError
        If it is neither, is damaged, is encrypted, holds unsafe member names or declares impossible sizes.
    """
    path = Path(path)
    if path.is_dir():
        return Folder(path)
    return Zip(path)


def is_hidden(name):
    """Whether a file in a folder or zip is none that a person put there: hidden, or of macOS's own."""
    return PurePosixPath(name).name.startswith(".") or "__MACOSX/" in name


def names_in(path):
    """Names of the files in a folder or zip; none for anything else, or if it cannot be read."""
    path = Path(path)
    if not path.is_dir() and not is_zip(path):
        return []
    try:
        with open_archive(path) as archive:
            return archive.names
    except InputError:
        return []


def read_file(path, most, expected):
    """Bytes of a file; one longer than `most` bytes is refused unread."""
    try:
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_size > most:
                raise _too_long(path, most, expected)
            return file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error


def _too_long(label, most, expected):
    return InputError(f"{label}: longer than {most} bytes; expected {expected}.")


class Folder:
    """The files below a folder; names are relative, with forward slashes.

    ``folders`` and ``others`` name what is no file: folders, and links that lead nowhere and the like.
    """

    def __init__(self, path):
        self.path = Path(path)
        files, self.folders, self.others = store.walk(self.path)
        self.names = sorted(files)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self, name, most=_MAX_MEMBER, expected="a picture"):
        """Bytes of one file; one longer than `most` bytes is refused unread."""
        return read_file(self.path / name, most, expected)

    def label(self, name):
        """What messages call a file."""
        return str(self.path / name)


class Zip:
    """The members of a zip file."""

    folders = others = ()

    def __init__(self, path):
        self.path = Path(path)
        try:
            with zipfile.ZipFile(self.path) as archive:
                members = [info for info in archive.infolist() if not info.is_dir()]
            self._file = os.open(self.path, os.O_RDONLY)
        except _BROKEN as error:
            raise InputError(
                f"{path}: not a zip file, or a truncated one ({error}). Fetch it again."
            ) from error
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
        try:
            self._check(members)
        except InputError:
            os.close(self._file)
            raise
        # a name may come twice; the second is told apart, so that a reader can report both
        self._members = {}
        for info in members:
            name, copy = info.filename, 1
            while name in self._members:
                copy += 1
                name = f"{info.filename} (member {copy} of that name)"
            self._members[name] = info
        self.names = list(self._members)

    def _check(self, members):
        total = os.fstat(self._file).st_size
        for info in members:
            name = info.filename
            parts = PurePosixPath(name.replace("\\", "/")).parts
            if ".." in parts or name.startswith(("/", "\\")) or name[1:2] == ":":
                raise InputError(
                    f"{self.path}: member {name!r} points outside the archive; remove it and pack again."
                )
            if info.flag_bits & 1:
                raise InputError(
                    f"{self.path}: member {name!r} is encrypted; pack the pictures without a password."
                )
            if (
                info.file_size > _MAX_MEMBER
                or not 0 <= info.header_offset <= total - info.compress_size
                or info.file_size > _MAX_RATIO * info.compress_size + 64
            ):
                raise InputError(
                    f"{self.path}: member {name!r} declares {info.file_size} bytes from {info.compress_size}"
                    f" packed ones; expected at most {_MAX_MEMBER}. The archive is damaged or hostile."
                )
        if sum(info.compress_size for info in members) > total:
            raise InputError(
                f"{self.path}: its members overlap; the archive is damaged or hostile."
            )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self._file)

    def read(self, name, most=_MAX_MEMBER, expected="a picture"):
        """Bytes of one member, checked against its checksum; one longer than `most` bytes is refused unread."""
        info = self._members[name]
        if info.file_size > most:
            raise _too_long(self.label(name), most, expected)
        header = os.pread(self._file, 30, info.header_offset)
        if header[:4] != b"PK\x03\x04" or len(header) < 30:
            raise InputError(f"{self.label(name)}: truncated or damaged archive; fetch it again.")
        start = info.header_offset + 30 + sum(struct.unpack("<HH", header[26:30]))
        data = os.pread(self._file, info.compress_size, start)
        if info.compress_type == zipfile.ZIP_DEFLATED:
            try:
                data = zlib.decompressobj(-15).decompress(data, info.file_size + 1)
            except zlib.error as error:
                raise InputError(
                    f"{self.label(name)}: damaged in the archive ({error})."
                ) from error
        elif info.compress_type != zipfile.ZIP_STORED:
            raise InputError(
                f"{self.label(name)}: packed by method {info.compress_type}; pack it with deflate or stored."
            )
        if len(data) != info.file_size or zlib.crc32(data) != info.CRC:
            raise InputError(f"{self.label(name)}: damaged in the archive (wrong checksum).")
        return data

    def label(self, name):
        """What messages call a member."""
        return f"{self.path}: {name}"
