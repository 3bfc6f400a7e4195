"""The Surface: a triangle mesh prepared for synthesis, and its coarser levels."""

from dataclasses import dataclass, field

import numpy as np

from btfpipe import store


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
        from btfpipe.errors import InputError

        reader = store.read(path, "surface")
        levels = []
        for i in range(reader.about["levels"]):
            p = f"level{i}_"
            vertices = reader.require(p + "vertices", (None, 3), "f")
            n = len(vertices)
            faces = reader.require(p + "faces", (None, 3), "i")
            if len(faces) and (faces.min() < 0 or faces.max() >= n):
                raise InputError(f"{path}: a face of level {i} names a vertex beyond {n - 1}.")
            level = Level(
                vertices,
                faces,
                reader.require(p + "normals", (n, 3), "f"),
                reader.require(p + "tangents", (n, 3), "f"),
            )
            if p + "parent_face" in reader:
                level.parent_face = reader.require(p + "parent_face", (n,), "i")
                level.parent_weights = reader.require(p + "parent_weights", (n, 3), "f")
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
