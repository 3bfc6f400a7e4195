"""The CoordinateMap: which texel of the sample goes where, and turned by how much."""

from dataclasses import dataclass, field

import numpy as np

from btfpipe import store


@dataclass
class CoordinateMap:
    """Texel coordinates for each element of a domain.

    Attributes
    ----------
    row, col, angle : (layers, elements) float32
        Coordinates in the sample, at the finest level, and the angle at which the sample's s axis lies in the local
        frame, counter-clockwise from s towards t, radians.
    weight : (layers, elements) float32
        Share of each layer; 1 by default.
    sample_index : (layers, elements) int32
        Which sample the coordinates refer to; 0 by default.
    texels_per_unit : float
        Texels per unit of length of the surface (1 for a plane, whose unit is the texel).
    domain : dict
        ``{"surface": digest}`` for the vertices of a surface's finest level, or ``{"plane": [rows, cols],
        "toroidal": bool}`` for the texels of a plane, in row-major order, row 0 at the top.
    """

    row: np.ndarray
    col: np.ndarray
    angle: np.ndarray
    texels_per_unit: float
    domain: dict
    weight: np.ndarray | None = None
    sample_index: np.ndarray | None = None
    about: dict = field(default_factory=dict)

    def __post_init__(self):
        for name in ("row", "col", "angle"):
            array = np.atleast_2d(np.asarray(getattr(self, name), np.float32))
            setattr(self, name, np.ascontiguousarray(array))
        if self.weight is None:
            self.weight = np.ones_like(self.row)
        if self.sample_index is None:
            self.sample_index = np.zeros(self.row.shape, np.int32)

    @classmethod
    def open(cls, path):
        """Map a CoordinateMap from its file, checking shapes and finiteness."""
        reader = store.read(path, "map")
        row = reader.require("row", (None, None), "f")
        return cls(
            row,
            reader.require("col", row.shape, "f"),
            reader.require("angle", row.shape, "f"),
            reader.about["texels_per_unit"],
            reader.about["domain"],
            reader.require("weight", row.shape, "f"),
            reader.require("sample_index", row.shape, "i"),
            reader.about,
        )

    def save(self, path):
        """Write the CoordinateMap."""
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        arrays = {k: getattr(self, k) for k in ("row", "col", "angle", "weight", "sample_index")}
        about |= {"texels_per_unit": float(self.texels_per_unit), "domain": self.domain}
        store.write(path, "map", arrays, **about)
