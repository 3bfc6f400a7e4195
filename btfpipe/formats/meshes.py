"""Triangle meshes of others: OBJ, PLY, OFF and STL in, OBJ out.

Only positions and faces are read: `btfpipe surface` makes its own normals (files often store those of facets),
and colours, texture coordinates and materials have no use here.
"""

import struct
from pathlib import Path

import numpy as np

from btfpipe.errors import InputError

ENDINGS = (".obj", ".ply", ".off", ".stl")


def read_mesh(path):
    """Read a mesh; polygons become fans of triangles.

    Parameters
    ----------
    path : path-like
        An OBJ, PLY, OFF or STL file, ascii or binary, told by its ending and checked by its content.

    Returns
    -------
    vertices : (n, 3) float64
        As in the file, in its unit; not checked for finiteness.
    faces : (m, 3) int32
        Indices within range.

    Raises
    ------
    InputError
        For an unknown ending, broken syntax (with the line), an index beyond the vertices, and a file without
        faces.
    """
    path = Path(path)
    reader = {".obj": _read_obj, ".ply": _read_ply, ".off": _read_off, ".stl": _read_stl}.get(
        path.suffix.lower()
    )
    if reader is None:
        raise InputError(
            f"{path}: not a mesh that can be read; expected one of {', '.join(ENDINGS)}."
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    try:
        vertices, polygons, where = reader(path, data)
        with np.errstate(invalid="ignore"):  # of NaN that signal
            vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
        if not isinstance(polygons, np.ndarray):
            polygons = _fans(path, polygons, where)
    except (KeyError, ValueError, IndexError, OverflowError, struct.error) as error:
        raise InputError(
            f"{path}: broken or cut short ({type(error).__name__}: {error})."
        ) from error
    if not len(polygons):
        raise InputError(
            f"{path}: holds {len(vertices) or 'no'} vertices and no faces; expected a triangle mesh."
            + (" Reconstruct a surface from the points first." if len(vertices) else "")
        )
    return vertices, _checked(path, polygons, len(vertices))


def _fans(path, polygons, where):
    """Triangles (m, 3) int64 of lists of corners; `where(i)` names polygon i for messages."""
    sizes = np.fromiter(map(len, polygons), np.int64, len(polygons))
    short = np.flatnonzero(sizes < 3)
    if len(short):
        raise InputError(
            f"{path}: {len(short)} of {len(sizes)} faces have fewer than 3 corners (first:"
            f" {where(short[0])} has {sizes[short[0]]}). Remove them or export the mesh again."
        )
    if (sizes == 3).all():
        return np.array(polygons, np.int64).reshape(-1, 3)
    return np.array(
        [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)], np.int64
    )


def _checked(path, polygons, n_vertices):
    """Triangles (m, 3) int32 whose corners are there."""
    beyond = (polygons < 0) | (polygons >= n_vertices)
    if beyond.any():
        rows = np.flatnonzero(beyond.any(axis=1))
        found = polygons[rows[0]][beyond[rows[0]]][0]
        raise InputError(
            f"{path}: {len(rows)} faces name vertices that are not there (first: number {found}, counted"
            f" from 0, of {n_vertices}). The file is cut short or damaged."
        )
    return polygons.astype(np.int32)


def _text_lines(path, data, comment=b"#"):
    """Line number and words of each line that says something."""
    if b"\0" in data[:4096]:
        raise InputError(f"{path}: holds binary data where text was expected; is its ending right?")
    joined = data.replace(b"\\\r\n", b"  ").replace(b"\\\n", b" ")
    for number, line in enumerate(joined.splitlines(), 1):
        words = line.split(comment, 1)[0].split()
        if words:
            yield number, words


def _numbers(path, line, words, kind=float):
    try:
        return [kind(word) for word in words]
    except ValueError:
        shown = b" ".join(words[:6]).decode(errors="replace")
        raise InputError(f"{path}: line {line}: expected numbers, found {shown!r}.") from None


def _read_obj(path, data):
    vertices, polygons, lines = [], [], []
    for line, words in _text_lines(path, data):
        if words[0] == b"v":
            if len(words) < 4:
                raise InputError(
                    f"{path}: line {line}: a vertex has {len(words) - 1} coordinates of 3."
                )
            vertices.append(_numbers(path, line, words[1:4]))
        elif words[0] == b"f":
            corners = _numbers(path, line, [w.split(b"/", 1)[0] for w in words[1:]], int)
            if 0 in corners:
                raise InputError(f"{path}: line {line}: a face names vertex 0; OBJ counts from 1.")
            # negative numbers count back from the vertices read so far
            count = len(vertices)
            polygons.append([c - 1 if c > 0 else count + c for c in corners])
            lines.append(line)
    return vertices, polygons, lambda i: f"line {lines[i]}"


def _read_off(path, data):
    words = [(line, w) for line, row in _text_lines(path, data) for w in row]
    if not words or not words[0][1].endswith(b"OFF"):
        raise InputError(f"{path}: does not start with OFF; is its ending right?")
    header = words[0][1]
    if header != b"OFF":
        raise InputError(
            f"{path}: is {header.decode(errors='replace')}; only plain OFF is read. Convert it to PLY."
        )
    try:
        n_vertices, n_faces = int(words[1][1]), int(words[2][1])
        place = 4 + 3 * n_vertices
        vertices = np.array([float(w) for _, w in words[4:place]]).reshape(n_vertices, 3)
        polygons, rows = [], {}
        for line, w in words[place:]:
            rows.setdefault(line, []).append(w)
        starts = list(rows)[:n_faces]
        if len(starts) < n_faces:
            raise ValueError(f"{len(starts)} of {n_faces} faces are there")
        for line in starts:
            count = int(rows[line][0])
            polygons.append([int(w) for w in rows[line][1 : 1 + count]])
            if len(polygons[-1]) < count:
                raise ValueError(f"line {line}: a face has {len(polygons[-1])} corners of {count}")
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: broken or cut short ({error}).") from error
    return vertices, polygons, lambda i: f"line {starts[i]}"


_PLY_TYPES = {
    b"char": "i1", b"int8": "i1", b"uchar": "u1", b"uint8": "u1",
    b"short": "i2", b"int16": "i2", b"ushort": "u2", b"uint16": "u2",
    b"int": "i4", b"int32": "i4", b"uint": "u4", b"uint32": "u4",
    b"float": "f4", b"float32": "f4", b"double": "f8", b"float64": "f8",
}  # fmt: skip


def _read_ply(path, data):
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"{path}: has no PLY header; is its ending right?")
    form, elements = None, []
    for words in map(bytes.split, data[:end].splitlines()[1:]):
        if words[:1] == [b"format"]:
            form = words[1]
        elif words[:1] == [b"element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == [b"property"] and elements:
            elements[-1][2].append(words[1:])
    body = data[data.index(b"\n", end) + 1 :]
    if form == b"ascii":
        rows = _ply_ascii(elements, body)
    else:
        order = {b"binary_little_endian": "<", b"binary_big_endian": ">"}[form]
        rows = _ply_binary(elements, body, order)
    with np.errstate(invalid="ignore"):  # of NaN that signal
        vertices = np.stack(
            [np.asarray(rows[b"vertex"][axis], float) for axis in (b"x", b"y", b"z")], 1
        )
    faces = rows.get(b"face", {})
    polygons = faces.get(b"vertex_indices", faces.get(b"vertex_index", []))
    return vertices, polygons, lambda i: f"face {i}"


def _ply_ascii(elements, body):
    lines = iter([line.split() for line in body.splitlines() if line.strip()])
    result = {}
    for name, count, properties in elements:
        table = {p[-1]: [] for p in properties}
        for i in range(count):
            words = next(lines, None)
            if words is None:
                raise ValueError(f"{i} of {count} {name.decode()} lines are there")
            at = 0
            for p in properties:
                if p[0] == b"list":
                    size = int(words[at])
                    items = [
                        int(w) if p[2] not in (b"float", b"double") else 0
                        for w in words[at + 1 : at + 1 + size]
                    ]
                    if len(items) < size:
                        raise ValueError(f"a list of {name.decode()} {i} is short")
                    table[p[-1]].append(items)
                    at += 1 + size
                else:
                    table[p[-1]].append(float(words[at]))
                    at += 1
        result[name] = table
    return result


def _ply_binary(elements, body, order):
    at, result = 0, {}
    for name, count, properties in elements:
        lists = [p for p in properties if p[0] == b"list"]
        if not lists:
            dtype = np.dtype([(p[-1].decode(), order + _PLY_TYPES[p[0]]) for p in properties])
            rows = np.frombuffer(body, dtype, count, at)
            result[name] = {p[-1]: rows[p[-1].decode()] for p in properties}
            at += count * dtype.itemsize
            continue
        if len(properties) == 1 and count:
            # the usual case, triangles only, as one table
            sizes, items = order + _PLY_TYPES[lists[0][1]], order + _PLY_TYPES[lists[0][2]]
            dtype = np.dtype([("n", sizes), ("corner", items, 3)])
            if at + count * dtype.itemsize <= len(body):
                rows = np.frombuffer(body, dtype, count, at)
                if (rows["n"] == 3).all():
                    result[name] = {lists[0][-1]: rows["corner"].astype(np.int64)}
                    at += count * dtype.itemsize
                    continue
        table = {p[-1]: [] for p in properties}
        for _ in range(count):
            for p in properties:
                size = 1
                if p[0] == b"list":
                    size_type = np.dtype(order + _PLY_TYPES[p[1]])
                    size = int(np.frombuffer(body, size_type, 1, at)[0])
                    at += size_type.itemsize
                    if size < 0 or size > len(body):
                        raise ValueError(f"a list of {size} items")
                dtype = np.dtype(order + _PLY_TYPES[p[2] if p[0] == b"list" else p[0]])
                items = np.frombuffer(body, dtype, size, at)
                at += size * dtype.itemsize
                table[p[-1]].append(items.tolist() if p[0] == b"list" else items[0])
        result[name] = table
    return result


def _read_stl(path, data):
    count = struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else 0
    if len(data) == 84 + 50 * count and count:
        rows = np.frombuffer(
            data, np.dtype([("normal", "<f4", 3), ("corner", "<f4", 9), ("tag", "<u2")]), count, 84
        )
        vertices = rows["corner"].reshape(-1, 3)
    elif data.lstrip()[:5].lower() == b"solid" and b"facet" in data:
        corners = []
        for line, words in _text_lines(path, data, b"\0"):
            if words[0].lower() == b"vertex":
                corners.append(_numbers(path, line, words[1:4]))
        if len(corners) % 3 or not data.rstrip().lower().splitlines()[-1].startswith(b"endsolid"):
            raise InputError(f"{path}: ends in the middle of a facet; the file is cut short.")
        vertices = np.array(corners)
    else:
        raise InputError(
            f"{path}: {len(data)} bytes are not an STL file of {count} facets ({84 + 50 * count} bytes);"
            " the file is cut short or its ending is wrong."
        )
    return vertices, np.arange(len(vertices)).reshape(-1, 3), lambda i: f"facet {i}"


def write_obj(path, vertices, faces):
    """Write a mesh as OBJ with 5 decimals; the same mesh gives the same bytes."""
    from btfpipe.files import whole

    with whole(path, "w") as file:
        file.writelines(f"v {x:.5f} {y:.5f} {z:.5f}\n" for x, y, z in vertices)
        file.writelines(f"f {a} {b} {c}\n" for a, b, c in np.asarray(faces) + 1)
