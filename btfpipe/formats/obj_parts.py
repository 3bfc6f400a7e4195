"""OBJ as a meso-structure: positions, polygons cut into triangles, and the material name of each."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from btfpipe.errors import InputError


def read_parts(path):
    """Read what a meso-structure needs of an OBJ file.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int64
    part : (m,) int64
        Index into `names`.
    names : tuple of str
        Of ``usemtl``, in order of use; ``default`` before the first.

    Raises
    ------
    InputError
        With the line, if something cannot be read.
    """
    path = Path(path)
    vertices, faces, part, names = [], [], [], {}
    current = "default"
    try:
        lines = path.read_text("utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    for number, line in enumerate(lines, 1):
        key, *rest = line.split("#")[0].split() or [""]
        try:
            if key == "v":
                vertices.append([float(x) for x in rest[:3]])
                if len(rest) < 3:
                    raise ValueError("three coordinates expected")
            elif key == "usemtl":
                current = " ".join(rest) or "default"
            elif key == "f":
                index = [int(corner.split("/")[0]) for corner in rest]
                index = [i - 1 if i > 0 else len(vertices) + i for i in index]
                if len(index) < 3 or min(index) < 0:
                    raise ValueError("three vertices or more expected, numbered from 1")
                faces += [[index[0], a, b] for a, b in pairwise(index[1:])]
                part += [names.setdefault(current, len(names))] * (len(index) - 2)
        except ValueError as error:
            raise InputError(f"{path}: line {number} cannot be read ({error}).") from error
    if not faces:
        raise InputError(f"{path}: holds no faces; expected a triangle mesh.")
    vertices, faces = np.array(vertices).reshape(-1, 3), np.array(faces)
    if faces.max() >= len(vertices):
        raise InputError(
            f"{path}: a face names vertex {faces.max() + 1}; the file has {len(vertices)}."
        )
    return vertices, faces, np.array(part), tuple(names)
