"""The Surface: a triangle mesh prepared for synthesis, and its coarser levels."""

from dataclasses import dataclass, field

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError

EXTENTS = (1e-15, 1e15)  # of a mesh, whose squares and their reciprocals are in single precision
_UNIT = 1e-3  # by how much the length of a normal or tangent may be off
# of a corner of the triangle that a vertex lies in, which may be a little outside
_MOST_WEIGHT = 1e3


def require_extent(vertices, name):
    """Refuse a mesh (n, 3) whose lengths, or places, are beyond what later stages multiply in single precision."""
    low, high = EXTENTS
    reach = float(np.abs(vertices).max(initial=0))
    extent = float(np.ptp(vertices, axis=0).max()) if reach < high and len(vertices) else 0.0
    if not low < extent <= reach * 2 < 2 * high:
        raise InputError(
            f"{name}: spans {extent:.3g} and reaches {reach:.3g}; expected lengths between {low:g} and {high:g}. Export the"
            " mesh in another unit."
        )


@dataclass
class Level:
    """One level of the mesh pyramid; level 0 is the finest.

    Attributes
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
        Counter-clockwise seen from outside.
    normals : (n, 3) float32
        Unit shading normals, interpolated from the input mesh.
    tangents : (n, 3) float32
        Unit vectors s of the local frame, orthogonal to the normal; t = n x s.
    parent_face : (n,) int32, optional
        Face of the next coarser level that lies along the normal; absent on the coarsest.
    parent_weights : (n, 3) float32, optional
        Barycentric coordinates in it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    parent_face: np.ndarray | None = None
    parent_weights: np.ndarray | None = None

    @property
    def bitangents(self):
        """The vectors t of the local frame, (n, 3) float32."""
        return np.cross(self.normals, self.tangents)


@dataclass
class Surface:
    """A dense mesh with tangent frames and a pyramid, finest level first."""

    levels: list[Level]
    about: dict = field(default_factory=dict)
    digest: str = ""

    @classmethod
    def open(cls, path):
        """Map a Surface from its file, checking indices and finiteness."""
        reader = store.read(path, "surface")
        levels = []
        for i in range(reader.fact("levels", "count")):
            p = f"level{i}_"
            vertices = reader.require(p + "vertices", (None, 3), "f")
            n = len(vertices)
            require_extent(vertices, f"{path}: level {i}")
            faces = reader.require(p + "faces", (None, 3), "i")
            if not len(faces) or faces.min() < 0 or faces.max() >= n:
                raise InputError(
                    f"{path}: level {i} has no faces, or one that names a vertex beyond {n - 1}."
                )
            frame = []
            for name in ("normals", "tangents"):
                vectors = reader.require(p + name, (n, 3), "f", most=1 + _UNIT)
                if np.abs(np.linalg.norm(vectors, axis=1) - 1).max() > _UNIT:
                    raise InputError(f"{path}: {name} of level {i} are not all unit vectors.")
                frame.append(vectors)
            normals, tangents = (np.asarray(vectors, np.float32) for vectors in frame)
            level = Level(
                np.asarray(vertices, np.float64), np.asarray(faces, np.int32), normals, tangents
            )
            if p + "parent_face" in reader:
                level.parent_face = reader.require(p + "parent_face", (n,), "i")
                level.parent_weights = reader.require(
                    p + "parent_weights", (n, 3), "f", most=_MOST_WEIGHT
                )
            levels.append(level)
        return cls(levels, reader.about, reader.digest)

    def save(self, path):
        """Write the Surface."""
        arrays = {}
        for i, level in enumerate(self.levels):
            for name in (
                "vertices",
                "faces",
                "normals",
                "tangents",
                "parent_face",
                "parent_weights",
            ):
                if getattr(level, name) is not None:
                    arrays[f"level{i}_{name}"] = getattr(level, name)
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        store.write(path, "surface", arrays, **(about | {"levels": len(self.levels)}))
