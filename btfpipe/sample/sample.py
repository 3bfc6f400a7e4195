"""The Sample: pictures of one flat patch, each with a light and a view direction."""

import numpy as np

from btfpipe import store
from btfpipe.errors import InputError
from btfpipe.sample.appearance import Appearance, ShadingNeeds
from btfpipe.sample.transfer import TRANSFERS, decode, decode_table

_UNIT = 1e-4  # by how much the length of a direction may be off


def check_index(name, index, count, pairs):
    """Refuse a table of `pairs` indices into `count` directions that has another length or leaves them."""
    low, high = (index.min(), index.max()) if len(index) else (0, -1)
    if len(index) != pairs or not 0 <= low <= high < count:
        raise InputError(
            f"{name} runs from {low} to {high} over {len(index)} pairs; expected 0 to {count - 1} over {pairs}."
        )


def read_directions(reader):
    """Lights and views (n, 3) of a file: unit vectors."""
    tables = []
    for name in ("light_directions", "view_directions"):
        table = reader.require(name, (None, 3), "f", most=1 + _UNIT)
        if not len(table) or np.abs(np.linalg.norm(table, axis=1) - 1).max() > _UNIT:
            raise InputError(f"{reader.path}: {name} are not all unit vectors.")
        tables.append(table)
    return tables


class Sample(Appearance):
    """A measured or simulated BTF, in one layout: ``(pair, row, col, channel)`` and two index tables.

    Parameters
    ----------
    codes : (pairs, rows, cols, 3) uint8, float16 or float32
        Stored pictures, usually mapped from a file.
    light_directions, view_directions : (n, 3)
        Unit vectors.
    light_index, view_index : (pairs,) int
        Light and view of each pair; a product has ``pair = view * lights + light``.
    transfer : str
        Curve from codes to linear values: ``srgb``, ``gamma2.2`` or ``linear``.
    scale : float
        Linear values are ``scale * decode(code)``.
    gain : (rows, cols, 3) float32, optional
        A further factor per texel, from flattening slow brightness drift.
    toroidal : bool
    mask : (rows, cols) bool, optional
        Valid texels; all by default.
    texels_per_mm : float, optional
    absolute : bool
        Whether the scale is known, so that 1 is a perfect white diffuser.
    about : dict
        Provenance: source, what was done at ingest.
    """

    def __init__(
        self,
        codes,
        light_directions,
        view_directions,
        light_index,
        view_index,
        *,
        transfer="linear",
        scale=1.0,
        gain=None,
        toroidal=False,
        mask=None,
        texels_per_mm=None,
        absolute=False,
        about=None,
    ):
        if codes.ndim != 4 or codes.shape[3] != 3 or len(codes) != len(light_index):
            raise InputError(
                f"pictures have shape {codes.shape}; expected ({len(light_index)}, rows, cols, 3)."
            )
        if transfer not in TRANSFERS:
            raise InputError(f"transfer {transfer!r}; expected one of {', '.join(TRANSFERS)}.")
        if codes.dtype not in (np.uint8, np.float16, np.float32):
            raise InputError(f"pictures are {codes.dtype}; expected uint8, float16 or float32.")
        self.codes = codes
        self.shape = codes.shape[1:3]
        self.light_directions = np.ascontiguousarray(light_directions, np.float64)
        self.view_directions = np.ascontiguousarray(view_directions, np.float64)
        self.light_index = np.ascontiguousarray(light_index, np.int32)
        self.view_index = np.ascontiguousarray(view_index, np.int32)
        for name, index, count in (
            ("light_index", self.light_index, len(self.light_directions)),
            ("view_index", self.view_index, len(self.view_directions)),
        ):
            check_index(name, index, count, len(codes))
        self.transfer = transfer
        self.scale = float(scale)
        self.gain = gain
        self.toroidal = bool(toroidal)
        self.mask = mask
        self.texels_per_mm = texels_per_mm
        self.absolute = bool(absolute)
        self.about = dict(about or {})

    @classmethod
    def open(cls, path):
        """Map a Sample from its file."""
        return cls.from_reader(store.read(path, "sample"))

    @classmethod
    def from_reader(cls, reader):
        """As `open`, from a `store.Reader`."""
        codes = reader.require("pictures", (None, None, None, 3), finite=False)
        if not codes.size:
            raise InputError(f"{reader.path}: pictures have shape {codes.shape}; there are none.")
        shape = codes.shape[1:3]
        lights, views = read_directions(reader)
        return cls(
            codes,
            lights,
            views,
            reader.require("light_index", (len(codes),), "iu"),
            reader.require("view_index", (len(codes),), "iu"),
            transfer=reader.fact("transfer", "text"),
            scale=reader.fact("scale", "positive"),
            gain=reader.require("gain", (*shape, 3), "f") if "gain" in reader else None,
            toroidal=reader.fact("toroidal", "flag"),
            mask=reader.require("mask", shape, "b") if "mask" in reader else None,
            texels_per_mm=reader.fact("texels_per_mm", "positive", None),
            absolute=reader.fact("absolute", "flag"),
            about=reader.about,
        )

    def facts(self):
        """The description that goes into the file, apart from provenance."""
        return {
            "transfer": self.transfer,
            "scale": self.scale,
            "toroidal": self.toroidal,
            "texels_per_mm": self.texels_per_mm,
            "absolute": self.absolute,
            "cosine": "the light's cosine is inside the values",
            "colour_space": "linear Rec. 709 after decoding",
        }

    def save(self, path):
        """Write the Sample; `ingest` streams larger ones with the same members."""
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        with store.create(path, "sample", **(about | self.facts())) as writer:
            self.write_tables(writer)
            writer.array("pictures", self.codes)

    def write_tables(self, writer):
        """Write all members but the pictures."""
        for name in ("light_directions", "view_directions", "light_index", "view_index"):
            writer.array(name, getattr(self, name))
        for name in ("gain", "mask"):
            if getattr(self, name) is not None:
                writer.array(name, getattr(self, name))

    def decode(self, codes):
        """Linear float32 values of stored codes, the per-texel gain left out."""
        if codes.dtype == np.uint8:
            return decode_table(np.uint8, self.transfer, self.scale)[codes]
        if self.transfer == "linear":
            return codes.astype(np.float32) * np.float32(self.scale)
        return (decode(codes, self.transfer) * self.scale).astype(np.float32)

    def pictures(self, pairs):
        values = self.decode(np.asarray(self.codes[pairs]))
        return values if self.gain is None else values * self.gain

    def texels(self, rows, cols):
        rows, cols = np.asarray(rows), np.asarray(cols)
        values = self.decode(np.ascontiguousarray(self.codes[:, rows, cols].swapaxes(0, 1)))
        return values if self.gain is None else values * self.gain[rows, cols][:, None]

    def shader(self, interpolation="barycentric"):
        from btfpipe.sample.shading import RawShader

        return RawShader(self, interpolation)

    @classmethod
    def shading_needs(cls, reader):
        codes = reader.require("pictures", (None,) * 4, finite=False)
        return ShadingNeeds(
            codes.nbytes,
            levels=(4 if codes.dtype == np.float32 else 2) * codes.size // 3,
            making_levels=0 if codes.dtype == np.float32 else codes.size,
            instead="a Model in the sample's place: `btfpipe compress` makes one that takes far less",
        )

    @property
    def nbytes(self):
        return int(self.codes.nbytes + self.light_directions.nbytes + self.view_directions.nbytes)
