"""The CoordinateMap: which texel of the sample goes where, and turned by how much."""

import math
from dataclasses import dataclass, field

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError

_MOST_TEXELS = 1 << 24  # beyond, single precision does not tell texels from each other
_MOST_WEIGHT = 1e3


def _check_form(reader, elements):
    """Refuse a map whose description has another form, or a plane of another size."""
    domain, size = reader.about.get("domain"), reader.about.get("sample_shape")
    if not isinstance(domain, dict) or ("plane" in domain) == ("surface" in domain):
        raise InputError(f"{reader.path}: its description names neither a surface nor a plane.")
    if "surface" in domain:
        store.check_fact(domain["surface"], "text", f"{reader.path}: surface")
    else:
        store.check_fact(domain["plane"], "shape", f"{reader.path}: plane")
        store.check_fact(domain.get("toroidal", False), "flag", f"{reader.path}: toroidal")
        if math.prod(domain["plane"]) != elements:
            raise InputError(
                f"{reader.path}: {elements} coordinates for a plane of {' x '.join(map(str, domain['plane']))} texels."
            )
    if size is not None:
        store.check_fact(size, "shape", f"{reader.path}: sample_shape")


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
        row = reader.require("row", (None, None), "f", most=_MOST_TEXELS)
        if not row.size:
            raise InputError(f"{path}: holds no coordinates.")
        _check_form(reader, row.shape[1])
        return cls(
            row,
            reader.require("col", row.shape, "f", most=_MOST_TEXELS),
            reader.require("angle", row.shape, "f"),
            reader.fact("texels_per_unit", "positive"),
            reader.about["domain"],
            reader.require("weight", row.shape, "f", most=_MOST_WEIGHT),
            reader.require("sample_index", row.shape, "i"),
            reader.about,
        )

    def save(self, path):
        """Write the CoordinateMap."""
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        arrays = {k: getattr(self, k) for k in ("row", "col", "angle", "weight", "sample_index")}
        about |= {"texels_per_unit": float(self.texels_per_unit), "domain": self.domain}
        store.write(path, "map", arrays, **about)
