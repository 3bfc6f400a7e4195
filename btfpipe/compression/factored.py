"""Factorisations channel by channel in a colour space: what Bonn's ``.btf`` files hold, and how to make one.

A matrix (pairs, texels) for each of three channels of a colour space, each the product of two factors with its own
number of terms: luminance gets more than colour. Several of the spaces are logarithmic, so that the factors' error is
relative to the value.
"""

import math

import numpy as np

from btfpipe.compiled import leaf, njit
from btfpipe.compression.model import Model, measured_error
from btfpipe.compression.svd import factorise, left_out, pictures_to_read, planar_pictures
from btfpipe.errors import InputError
from btfpipe.sample.appearance import ShadingNeeds, svd_levels

EPSILON = 1e-5  # added inside logarithms by the ``.btf`` formats
_MOST_CHROMA = 4.0  # of |U| / Y and |V| / Y; colours without negative channels stay below 3.83
_NOTICED = 0.01  # share of the largest luminance that chroma may lose without a word

RGB, YUV, LAB, PCA, YCOCG = 0, 1, 2, 3, 4
LOG_Y_UV, LOG_Y_SLOG_UV, LOG_Y_UV_OVER_Y, LOG_RGB = 9, 10, 11, 12

# Names of the colour spaces, and their numbers in ``.btf`` files.
SPACES = {
    "rgb": RGB,
    "yuv": YUV,
    "lab": LAB,
    "pca": PCA,
    "ycocg": YCOCG,
    "log_y_uv": LOG_Y_UV,
    "log_y_slog_uv": LOG_Y_SLOG_UV,
    "log_y_uv_over_y": LOG_Y_UV_OVER_Y,
    "log_rgb": LOG_RGB,
}
_LINEAR = ("rgb", "yuv", "pca", "ycocg")

# Rows: red, green, blue from the space's channels.
_FROM_YUV = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])
_FROM_YCOCG = np.array([[1, 1, -1], [1, 0, 1], [1, -1, -1]], float)
_D50 = (0.9642, 1.0, 0.8249)
# XYZ relative to the D50 white of Lab, adapted to D65 (Bradford), to linear Rec. 709
_FROM_D50 = np.array(
    [
        [3.1338561, -1.6168667, -0.4906146],
        [-0.9787684, 1.9161415, 0.0334540],
        [0.0719453, -0.2289914, 1.4052427],
    ]
)
_FROM_D50 /= (_FROM_D50 @ np.array(_D50))[:, None]  # white is 1, 1, 1 to the last digit


class FactoredModel(Model):
    """A Sample as ``channel_c[pair, texel] = sum_k angular_c[pair, k] * texture_c[texel, k]``, in a colour space.

    The three channels of a pair and texel are decoded to linear RGB, perhaps stretched (``exp(x) - epsilon``), and
    multiplied by the pair's factor. Values are never clamped.

    Parameters
    ----------
    angular_factors : sequence of three (pairs, K_c) float16, float32 or float64
    texture_factors : sequence of three (rows, cols, K_c)
        One array three times is stored once.
    space : str
        Of `SPACES`. ``lab`` is CIE L*a*b* under D50 with L* = 100 for 1, taken to linear Rec. 709; ``pca`` is
        ``channels @ matrix + mean``.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm, absolute.
    matrix, mean : (3, 3), (3,), optional
        Of the space ``pca``.
    log_range : bool
        Whether decoded values are logarithms: ``exp(x) - epsilon`` follows.
    pair_factor : (pairs,), optional
        A factor of each pair's values: the light's cosine where it was divided out before factorising.
    epsilon : float
        Added inside logarithms.
    about : dict, optional
        Facts for the file.
    """

    method = "factored"

    def __init__(
        self,
        angular_factors,
        texture_factors,
        space,
        source,
        *,
        matrix=None,
        mean=None,
        log_range=False,
        pair_factor=None,
        epsilon=EPSILON,
        about=None,
    ):
        super().__init__(texture_factors[0].shape[:2], source, about)
        if space not in SPACES:
            raise InputError(f"colour space {space!r}; expected one of {', '.join(SPACES)}.")
        if space == "pca" and (matrix is None or mean is None):
            raise InputError("colour space pca needs its matrix and mean.")
        if not 0 < epsilon < 1:
            raise InputError(f"epsilon {epsilon:g}; expected a number between 0 and 1.")
        self.angular_factors = tuple(angular_factors)
        self.texture_factors = tuple(texture_factors)
        self.space = space
        self.matrix = np.asarray(np.eye(3) if matrix is None else matrix, np.float32)
        self.mean = np.asarray(np.zeros(3) if mean is None else mean, np.float32)
        self.log_range = bool(log_range)
        self.pair_factor = None if pair_factor is None else np.asarray(pair_factor, np.float32)
        self.epsilon = float(epsilon)

    @property
    def n_terms(self):
        """Terms of each channel."""
        return tuple(factors.shape[1] for factors in self.angular_factors)

    @property
    def is_linear(self):
        """Whether blending before decoding is blending the values."""
        return self.space in _LINEAR and not self.log_range

    def arrays(self):
        arrays = {f"angular_{c}": factors for c, factors in enumerate(self.angular_factors)}
        arrays |= {
            f"texture_{c}": factors
            for c, factors in enumerate(self.texture_factors)
            if c == 0 or factors is not self.texture_factors[0]
        }
        if self.space == "pca":
            arrays |= {"colour_matrix": self.matrix, "colour_mean": self.mean}
        if self.pair_factor is not None:
            arrays["pair_factor"] = self.pair_factor
        return arrays

    def save(self, path):
        self.about |= {
            "space": self.space,
            "log_range": self.log_range,
            "epsilon": self.epsilon,
        }
        super().save(path)

    @classmethod
    def from_arrays(cls, reader, source):
        about, n_pairs = reader.about, len(source.light_index)
        shape, angular, texture = (None, None), [], []
        for c in range(3):
            name = f"texture_{c}" if f"texture_{c}" in reader else "texture_0"
            known = texture and name == "texture_0"
            texture.append(texture[0] if known else reader.require(name, (*shape, None), "f"))
            shape = texture[0].shape[:2]
            angular.append(reader.require(f"angular_{c}", (n_pairs, texture[c].shape[2]), "f"))
        pca = about.get("space") == "pca"
        factor = "pair_factor" in reader
        return cls(
            angular,
            texture,
            reader.fact("space", "text"),
            source,
            matrix=reader.require("colour_matrix", (3, 3), "f") if pca else None,
            mean=reader.require("colour_mean", (3,), "f") if pca else None,
            log_range=reader.fact("log_range", "flag", False),
            pair_factor=reader.require("pair_factor", (n_pairs,), "f") if factor else None,
            epsilon=reader.fact("epsilon", "positive", EPSILON),
            about=about,
        )

    def _decode(self, channels, out):
        _decode_all(
            *channels, SPACES[self.space], self.matrix, self.mean, np.float32(self.epsilon),
            self.log_range, out,
        )  # fmt: skip

    def pictures(self, pairs):
        channels = [
            np.asarray(angular[pairs], np.float32)
            @ np.asarray(texture, np.float32).reshape(-1, texture.shape[2]).T
            for angular, texture in zip(self.angular_factors, self.texture_factors, strict=True)
        ]
        out = np.empty((len(channels[0]), *self.shape, 3), np.float32)
        self._decode(channels, out.reshape(len(out), -1, 3))
        if self.pair_factor is not None:
            out *= self.pair_factor[pairs][:, None, None, None]
        return out

    def texels(self, rows, cols):
        channels = [
            np.asarray(texture[rows, cols], np.float32) @ np.asarray(angular, np.float32).T
            for angular, texture in zip(self.angular_factors, self.texture_factors, strict=True)
        ]
        out = np.empty((*channels[0].shape, 3), np.float32)
        self._decode(channels, out)
        if self.pair_factor is not None:
            out *= self.pair_factor[None, :, None]
        return out

    @classmethod
    def shading_needs(cls, reader):
        factors = []
        for c in range(3):
            name = f"texture_{c}" if f"texture_{c}" in reader else "texture_0"
            factors.append(reader.require(name, (None,) * 3, "f", finite=False))
            factors.append(reader.require(f"angular_{c}", (None,) * 2, "f", finite=False))
        levels = svd_levels(math.prod(factors[0].shape[:2]), len(factors[1]))
        return ShadingNeeds(
            4 * sum(f.size for f in factors), max(f.size for f in factors), **levels
        )

    def shader(self, interpolation="barycentric"):
        from btfpipe.compression.factored_shading import FactoredShader

        return FactoredShader(self, interpolation)


def compress_factored(
    sample,
    terms=(32, 16, 16),
    space="log_y_uv_over_y",
    *,
    precision="half",
    epsilon=EPSILON,
    iterations=None,
    seed=0,
    threads=1,
    memory=2 << 30,
    on_progress=None,
):
    """Factorise a Sample channel by channel in a colour space, as Bonn's UBO2014 files are.

    Each channel is the best rank-K approximation in the least-squares sense *of the space*: in the logarithmic ones
    that weighs relative errors, dark texels as much as bright.

    Parameters
    ----------
    sample : Appearance
        Read in blocks of pictures, about 10 times.
    terms : three int
        Terms of each channel, at least 1; fewer where the rank is less.
    space : str
        Of `SPACES`, except ``pca``.
    precision : str
        Of the factors: ``half`` or ``single``.
    epsilon : float
        Added inside logarithms; ``.btf`` files can hold only 1e-5.
    iterations : int, optional
        As in `compress_svd`.
    seed : int
        Of the random start.
    threads : int
        Never changes the result.
    memory : int
        Bytes of private memory to stay within; never changes the result.
    on_progress : callable, optional
        Called with (pictures read, pictures to read).

    Returns
    -------
    FactoredModel
        Its ``about`` holds `n_terms`, `singular_values` and `excess` of each channel, and `rmse` and
        `relative_error` as measured on the decoded linear values; `warnings` (sentences).

    Raises
    ------
    InputError
        Not three numbers of terms, none of a channel, an unknown space or precision, values that are not finite
        or beyond half precision, too little memory.
    """
    if space not in SPACES or space == "pca":
        names = ", ".join(name for name in SPACES if name != "pca")
        raise InputError(f"colour space {space!r}; expected one of {names}.")
    terms = tuple(terms)
    if len(terms) != 3 or min(terms) < 1:
        raise InputError(f"{terms} terms asked for; expected three numbers of at least 1.")
    total = sum(pictures_to_read(sample, n, 1, iterations, False) for n in terms) + sample.n_pairs
    into = _into(space)
    done, angular, texture, facts = 0, [], [], []
    extremes = []

    def report(read, _):
        if on_progress is not None:
            on_progress(done + read, total)

    for c, n_terms in enumerate(terms):

        def rows(sample, pairs, c=c):
            planar = planar_pictures(sample, pairs)
            values = planar.reshape(-1, 3, planar.shape[1])
            out = np.empty((len(values), values.shape[2]), np.float32)
            extremes.append(
                _encode_channel(values, SPACES[space], into, np.float32(epsilon), c, out)
            )
            return out

        vectors, weights, found = factorise(
            sample, n_terms, rows=rows, channels=1, measure=False, iterations=iterations,
            precision=precision, seed=seed, threads=threads, memory=memory, on_progress=report,
        )  # fmt: skip
        texture.append(vectors.reshape(*sample.shape, -1))
        angular.append(np.ascontiguousarray(weights[:, 0]))
        facts.append(found)
        done += pictures_to_read(sample, n_terms, 1, iterations, False)
    model = FactoredModel(angular, texture, space, sample, epsilon=epsilon)
    model.about = {
        "n_terms": list(model.n_terms),
        "space": space,
        "precision": precision,
        **{key: [f[key] for f in facts] for key in ("iterations", "excess", "singular_values")},
        **measured_error(model, sample, threads=threads, on_progress=report),
        "warnings": _losses(np.array(extremes), epsilon)
        + [
            f"channel {c}: {warning}"
            for c, (n, fact) in enumerate(zip(terms, facts, strict=True), 1)
            for warning in left_out(sample, n, fact["n_terms"], channels=1)
        ],
    }
    return model


def _losses(extremes, epsilon):
    """Warnings of what logarithmic spaces cannot hold, from what `_encode_channel` returned, call by call."""
    least, (most, cut) = extremes[:, 0].min(), extremes[:, 1:].max(axis=0)
    choose = "choose --space linear, or another method"
    warnings = []
    if least < -epsilon:  # further below 0 than what is added
        warnings.append(
            f"values go down to {least:.3g}, and logarithms take those below 0 for 0; {choose}"
        )
    if cut > _NOTICED * most:
        warnings.append(
            f"colours with channels below 0 lose up to {cut:.3g} of their chroma (luminance goes up to {most:.3g}), as U / Y and V / Y"
            f" are kept within {_MOST_CHROMA:g}; {choose}"
        )
    return warnings


def _into(space):
    """Matrix from RGB to the linear part of a space."""
    if space in ("rgb", "log_rgb"):
        return np.eye(3, dtype=np.float32)
    matrix = {"ycocg": _FROM_YCOCG, "lab": _FROM_D50}.get(space, _FROM_YUV)
    return np.linalg.inv(matrix).astype(np.float32)


_YUV = tuple(map(tuple, _FROM_YUV.tolist()))
_WHITE = tuple(map(tuple, _FROM_D50.tolist()))
_X0, _Z0 = _D50[0], _D50[2]


@leaf
def _yuv(y, u, v):
    return (
        y + np.float32(1.13983) * v,
        y - np.float32(0.39465) * u - np.float32(0.5806) * v,
        y + np.float32(2.03211) * u,
    )


@leaf
def _unlab(t):
    """Inverse of Lab's cube root, with the straight piece near 0 (CIE 15)."""
    if t > 6.0 / 29.0:
        return t * t * t
    return (t - 4.0 / 29.0) * (108.0 / 841.0)


@leaf
def _lab(t):
    if t > 216.0 / 24389.0:
        return np.cbrt(t)
    return t * (841.0 / 108.0) + 4.0 / 29.0


@leaf
def decode_colour(space, a, b, c, matrix, mean, epsilon, log_range):
    """Red, green and blue of the three channels of a space, all float32."""
    if space == LOG_Y_UV_OVER_Y:
        y = np.exp(a)
        a, b, c = _yuv(y - epsilon, b * y, c * y)
    elif space == YUV:
        a, b, c = _yuv(a, b, c)
    elif space == YCOCG:
        a, b, c = a + b - c, a + c, a - b - c
    elif space == LOG_RGB:
        a, b, c = np.exp(a) - epsilon, np.exp(b) - epsilon, np.exp(c) - epsilon
    elif space == LOG_Y_UV:
        a, b, c = _yuv(np.exp(a) - epsilon, b, c)
    elif space == LOG_Y_SLOG_UV:
        u = np.sign(b) * np.exp(abs(b)) * epsilon
        v = np.sign(c) * np.exp(abs(c)) * epsilon
        a, b, c = _yuv(np.exp(a) - epsilon, u, v)
    elif space == PCA:
        a, b, c = (
            a * matrix[0, 0] + b * matrix[1, 0] + c * matrix[2, 0] + mean[0],
            a * matrix[0, 1] + b * matrix[1, 1] + c * matrix[2, 1] + mean[1],
            a * matrix[0, 2] + b * matrix[1, 2] + c * matrix[2, 2] + mean[2],
        )
    elif space == LAB:
        t = (a + 16.0) / 116.0
        x, y, z = _X0 * _unlab(t + b / 500.0), _unlab(t), _Z0 * _unlab(t - c / 200.0)
        a = np.float32(_WHITE[0][0] * x + _WHITE[0][1] * y + _WHITE[0][2] * z)
        b = np.float32(_WHITE[1][0] * x + _WHITE[1][1] * y + _WHITE[1][2] * z)
        c = np.float32(_WHITE[2][0] * x + _WHITE[2][1] * y + _WHITE[2][2] * z)
    if log_range:
        a, b, c = np.exp(a) - epsilon, np.exp(b) - epsilon, np.exp(c) - epsilon
    return a, b, c


@njit(cache=True, nogil=True, error_model="numpy")
def _decode_all(a, b, c, space, matrix, mean, epsilon, log_range, out):
    """Fill ``out`` (m, n, 3) from three channels (m, n)."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = decode_colour(
                space, a[i, j], b[i, j], c[i, j], matrix, mean, epsilon, log_range
            )


@njit(cache=True, nogil=True, error_model="numpy")
def _encode_channel(values, space, into, epsilon, channel, out):
    """Fill ``out`` (pairs, texels) with one channel of linear pictures (pairs, 3, texels).

    Returns the least value of which a logarithm was taken as of 0, or 0; the largest luminance that divided chroma; and the most
    that chroma lost, both as values.
    """
    zero = np.float32(0)
    least = most = cut = zero
    for p in range(values.shape[0]):
        for t in range(values.shape[2]):
            r, g, b = values[p, 0, t], values[p, 1, t], values[p, 2, t]
            x = into[channel, 0] * r + into[channel, 1] * g + into[channel, 2] * b
            if space == LOG_RGB or (channel == 0 and space >= LOG_Y_UV):
                least = min(least, x)
                x = np.log(max(x, zero) + epsilon)  # NaN stays: the comparison is false
            elif space == LOG_Y_UV_OVER_Y:
                y = max(into[0, 0] * r + into[0, 1] * g + into[0, 2] * b, zero) + epsilon
                most = max(most, y)
                cut = max(cut, abs(x) - np.float32(_MOST_CHROMA) * y)
                x = min(max(x / y, np.float32(-_MOST_CHROMA)), np.float32(_MOST_CHROMA))
            elif space == LOG_Y_SLOG_UV:
                # below epsilon the sign alone would remain; 0 decodes to 0
                size = abs(x)
                x = np.sign(x) * np.log(size / epsilon) if size > epsilon else zero
            elif space == LAB:
                fy = _lab(into[1, 0] * r + into[1, 1] * g + into[1, 2] * b)
                if channel == 0:
                    x = np.float32(116.0 * fy - 16.0)
                elif channel == 1:
                    x = (into[0, 0] * r + into[0, 1] * g + into[0, 2] * b) / _X0
                    x = np.float32(500.0 * (_lab(x) - fy))
                else:
                    x = np.float32(200.0 * (fy - _lab(x / _Z0)))
            out[p, t] = x
    return least, most, cut
