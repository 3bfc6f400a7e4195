"""Relighting: a basis that is continuous in the light's direction, with coefficients at each texel; the view plays no part.

The kind of Model that RTI files are (`formats.ptm` reads them): polynomial texture maps (Malzbender, Gelb and Wolters 2001,
equation 1) and hemispherical harmonics (Gautron et al. 2004). The basis is evaluated at the light itself, so nothing is
interpolated between directions; that a Model has pairs at all is for what looks at Models through pictures. It lists Bonn's 81
lights and one view, along the normal.

Both are fitted to display values. A value is the sum of coefficient times basis, at least 0, through the transfer curve; above
the display's white the curve goes on, nothing is clamped. The light's cosine is inside, as in the pictures; below the horizon
the value is 0.
"""

from types import SimpleNamespace

import numpy as np

from btfpipe.compiled import njit
from btfpipe.compression.model import Model
from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.parallel import blocks
from btfpipe.sample.shading import corners
from btfpipe.sample.transfer import TRANSFERS, decode

TERMS = {"ptm": (6,), "hsh": (1, 4, 9, 16)}
_LEAST_COSINE = np.cos(
    np.pi / 2 - 0.01
)  # harmonics are bent at the horizon; fitters stop short of it
_QUERIES = 8192  # whose basis is in memory at a time
# Display values that no picture has, whose linear values (a power of 2.4, of up to four times that by the basis) are still within
# single precision.
_MOST_DISPLAY = 1e15


def evaluate_basis(kind, n_terms, directions):
    """Basis functions (n, n_terms) float64 at lights (n, 3), unit vectors.

    ``ptm``: u^2, v^2, u v, u, v, 1 with (u, v) the light's x and y. ``hsh``: real harmonics over the hemisphere, that is of
    2 cos(theta) - 1, band by band, in each first the cosines of falling order, then order 0, then the sines; orthonormal, with the
    signs that RTI files use. The polar angle is kept 0.01 from the horizon.
    """
    x, y, z = np.asarray(directions, float).T
    if kind == "ptm":
        return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=1)
    c = np.clip(z, _LEAST_COSINE, 1)
    across = np.hypot(x, y)
    turn = (x + 1j * y) / np.maximum(across, 1e-30)
    turn[across < 1e-12] = 1
    first, second, third = turn, turn**2, turn**3
    s = c - c * c
    root = np.sqrt(s)
    middle = 2 * c - 1
    bow = 1 - 5 * s
    terms = [
        np.full_like(c, np.sqrt(1 / 2)),
        np.sqrt(6) * root * first.real,
        np.sqrt(3 / 2) * middle,
        np.sqrt(6) * root * first.imag,
        -np.sqrt(30) * s * second.real,
        np.sqrt(30) * middle * root * first.real,
        np.sqrt(5 / 2) * (1 - 6 * s),
        np.sqrt(30) * middle * root * first.imag,
        -np.sqrt(30) * s * second.imag,
        2 * np.sqrt(35) * s * root * third.real,
        -np.sqrt(210) * middle * s * second.real,
        2 * np.sqrt(21) * root * bow * first.real,
        np.sqrt(7 / 2) * (((20 * c - 30) * c + 12) * c - 1),
        2 * np.sqrt(21) * root * bow * first.imag,
        -np.sqrt(210) * middle * s * second.imag,
        2 * np.sqrt(35) * s * root * third.imag,
    ]
    return np.stack(terms[:n_terms], axis=1) / np.sqrt(np.pi)


class RelightingModel(Model):
    """Coefficients of a basis over the lights, at each texel.

    Parameters
    ----------
    coefficients : (rows, cols, 3 or 1, n) uint8
        Codes of them, ``code * scale + offset``, for display values with 1 as white.
    scale, offset : (n,) float32
    colour : (rows, cols, 3) uint8, optional
        With one channel of coefficients: 255 times the colour that the channel is multiplied by.
    basis : str
        ``ptm`` (6 terms) or ``hsh`` (1, 4, 9 or 16).
    transfer : str
        Curve from display values to linear ones: ``srgb``, ``gamma2.2`` or ``linear``.
    source : optional
        Gives directions and so on; by default Bonn's 81 lights and a view along the normal.

    Raises
    ------
    InputError
        If shapes and basis do not go together, or scales and offsets are not finite or give display values beyond 1e15.
    """

    method = "relighting"

    def __init__(
        self, coefficients, scale, offset, colour, basis, transfer, *, source=None, about=None
    ):  # fmt: skip
        super().__init__(coefficients.shape[:2], source or _nominal(), about)
        n = coefficients.shape[3]
        if basis not in TERMS or n not in TERMS[basis]:
            raise InputError(f"{n} terms of the basis {basis!r}; expected one of {TERMS}.")
        if transfer not in TRANSFERS:
            raise InputError(f"transfer {transfer!r}; expected one of {', '.join(TRANSFERS)}.")
        if coefficients.shape[2] != (3 if colour is None else 1):
            raise InputError(
                f"{coefficients.shape[2]} channels of coefficients; expected 3, or 1 beside a colour."
            )
        self.coefficients, self.colour = coefficients, colour
        most = float(np.abs(scale).sum(dtype=float) * 255 + np.abs(offset).sum(dtype=float))
        if not most < _MOST_DISPLAY:  # NaN too
            raise InputError(
                f"scales and offsets of the coefficients allow display values up to {most:.3g}; expected below"
                f" {_MOST_DISPLAY:g}, with 1 as white. The file is damaged."
            )
        self.scale, self.offset = (np.asarray(a, np.float32) for a in (scale, offset))
        self.basis, self.transfer = basis, transfer
        self.about |= {"basis": basis, "n_terms": n, "transfer": transfer}

    def arrays(self):
        arrays = {"coefficients": self.coefficients, "scale": self.scale, "offset": self.offset}
        return arrays if self.colour is None else arrays | {"colour": self.colour}

    @classmethod
    def from_arrays(cls, reader, source):
        coefficients = reader.require("coefficients", (None, None, None, None), "u")
        n = (coefficients.shape[3],)
        return cls(
            coefficients,
            reader.require("scale", n, "f"),
            reader.require("offset", n, "f"),
            reader.require("colour", (*coefficients.shape[:2], 3), "u")
            if "colour" in reader
            else None,
            reader.fact("basis", "text"),
            reader.fact("transfer", "text"),
            source=source,
            about=reader.about,
        )

    def weights(self, directions):
        """What codes (n, terms) float32 count under lights (n, 3), and what is added (n,) float32."""
        basis = evaluate_basis(self.basis, self.coefficients.shape[3], directions)
        return (basis * self.scale).astype(np.float32), (basis @ self.offset).astype(np.float32)

    def _values(self, codes, colour, pairs):
        """Linear values (n, pairs, 3) float32 of codes (n, channels, terms) and colours (n, 3)."""
        lights = self.light_directions[self.light_index[pairs]]
        weights, added = self.weights(lights)
        display = codes.astype(np.float32) @ weights.T + added  # (n, channels, pairs)
        display = np.maximum(display, 0, out=display)
        if colour is not None:
            display = display * (colour.astype(np.float32) / 255)[:, :, None]
        values = decode(display, self.transfer).astype(np.float32).swapaxes(1, 2)
        return values * (lights[:, 2] > 0)[:, None]

    def pictures(self, pairs):
        codes = np.asarray(self.coefficients).reshape(-1, *self.coefficients.shape[2:])
        colour = None if self.colour is None else np.asarray(self.colour).reshape(-1, 3)
        index = np.arange(self.n_pairs)[pairs]
        out = np.empty((len(index), *self.shape, 3), np.float32)
        for slot, pair in enumerate(
            index
        ):  # one at a time, as the way there takes several times its bytes
            out[slot] = self._values(codes, colour, [pair]).reshape(*self.shape, 3)
        return out

    def texels(self, rows, cols):
        colour = None if self.colour is None else self.colour[rows, cols]
        return self._values(self.coefficients[rows, cols], colour, slice(None))

    def shader(self, interpolation="barycentric"):
        return RelightingShader(self)


def _nominal():
    lights = bonn81()
    return SimpleNamespace(
        light_directions=lights,
        view_directions=np.array([[0.0, 0.0, 1.0]]),
        light_index=np.arange(len(lights), dtype=np.int32),
        view_index=np.zeros(len(lights), np.int32),
        toroidal=False,
        texels_per_mm=None,
        absolute=False,
    )


class RelightingShader:
    """Evaluates a `RelightingModel` at any light, bilinearly between the linear values of its texels."""

    def __init__(self, model):
        self.model = model
        self.rows, self.cols = model.shape
        self.codes = np.ascontiguousarray(model.coefficients).reshape(
            -1, *model.coefficients.shape[2:]
        )
        self.colour = np.zeros((0, 3), np.uint8)
        if model.colour is not None:
            self.colour = np.ascontiguousarray(model.colour).reshape(-1, 3)
        self.curve = TRANSFERS.index(model.transfer)

    def shade(self, row, col, w_i, w_o, out):
        """Fill `out`; see `Appearance.shader`."""
        for part in blocks(len(row), _QUERIES):
            weights, added = self.model.weights(w_i[part])
            _shade(
                self.codes, self.colour, self.curve, self.rows, self.cols, self.model.toroidal,
                row[part], col[part], w_i[part], weights, added, out[part],
            )  # fmt: skip


@njit(cache=True, nogil=True, inline="always")
def _linear(value, curve):
    """Linear value of a display value at least 0; `curve` counts along `TRANSFERS`."""
    if curve == 2:
        return value
    if curve == 1:
        return value**2.2
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(codes, colour, curve, rows, cols, toroidal, row, col, w_i, weights, added, out):
    texel = np.zeros(4, np.int64)
    bilinear = np.zeros(4, np.float32)
    channels, terms = codes.shape[1:]
    for q in range(len(row)):
        out[q, :] = 0.0
        if not w_i[q, 2] > 0.0:
            continue
        corners(float(row[q]), float(col[q]), rows, cols, toroidal, texel, bilinear)
        for k in range(4):
            if bilinear[k] == 0.0:
                continue
            t = texel[k]
            display = 0.0
            for c in range(3):
                if c < channels:
                    total = added[q]
                    for n in range(terms):
                        total += weights[q, n] * codes[t, c, n]
                    display = max(float(total), 0.0)
                value = display
                if channels == 1:
                    value *= colour[t, c] / 255.0
                out[q, c] += bilinear[k] * _linear(value, curve)
