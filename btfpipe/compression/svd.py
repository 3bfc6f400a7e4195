"""Full-matrix SVD (Zhou et al. 2005, section 4): texels x (pairs and channels), n terms, no mean removed.

The product of two factors: eigen-textures over the texels, and angular factors over pairs and channels, whose
linear combination gives any picture. Its error is the least that n terms can have (Eckart-Young).
"""

import numpy as np

from btfpipe import store
from btfpipe.sample.appearance import Appearance


class SvdModel(Appearance):
    """A Sample as ``value[texel, pair, channel] = sum_n texture[texel, n] * angular[pair, channel, n]``.

    Parameters
    ----------
    texture_factors : (rows, cols, n) float16 or float32
        Eigen-textures.
    angular_factors : (pairs, 3, n) float16 or float32
        Weights of the eigen-textures in each picture and channel, singular values inside.
    source : Appearance
        Gives directions, index tables, toroidal, texels_per_mm.
    """

    def __init__(self, texture_factors, angular_factors, source, about=None):
        self.texture_factors = texture_factors
        self.angular_factors = angular_factors
        self.shape = texture_factors.shape[:2]
        for name in (
            "light_directions",
            "view_directions",
            "light_index",
            "view_index",
            "toroidal",
            "texels_per_mm",
        ):
            setattr(self, name, getattr(source, name))
        self.absolute = getattr(source, "absolute", False)
        self.about = dict(about or {})

    @property
    def n_terms(self):
        return self.texture_factors.shape[2]

    @classmethod
    def from_reader(cls, reader):
        """Map the Model from its file."""
        from types import SimpleNamespace

        about = reader.about
        texture = reader.require("texture_factors", (None, None, None), "f")
        source = SimpleNamespace(
            light_directions=reader.require("light_directions", (None, 3), "f"),
            view_directions=reader.require("view_directions", (None, 3), "f"),
            light_index=reader.require("light_index", (None,), "iu"),
            view_index=reader.require("view_index", (None,), "iu"),
            toroidal=about["toroidal"],
            texels_per_mm=about["texels_per_mm"],
            absolute=about["absolute"],
        )
        angular = reader.require(
            "angular_factors", (len(source.light_index), 3, texture.shape[2]), "f"
        )
        return cls(texture, angular, source, about)

    def save(self, path):
        """Write the Model."""
        about = {k: v for k, v in self.about.items() if k not in ("kind", "format", "btfpipe")}
        about |= {
            "method": "svd",
            "toroidal": self.toroidal,
            "texels_per_mm": self.texels_per_mm,
            "absolute": self.absolute,
        }
        names = ("light_directions", "view_directions", "light_index", "view_index")
        arrays = {name: getattr(self, name) for name in names}
        arrays["texture_factors"] = self.texture_factors
        arrays["angular_factors"] = self.angular_factors
        store.write(path, "model", arrays, **about)

    def pictures(self, pairs):
        angular = np.asarray(self.angular_factors[pairs], np.float32)
        texture = np.asarray(self.texture_factors, np.float32).reshape(-1, self.n_terms)
        values = angular.reshape(-1, self.n_terms) @ texture.T
        return np.ascontiguousarray(
            values.reshape(len(angular), 3, *self.shape).transpose(0, 2, 3, 1)
        )

    def texels(self, rows, cols):
        texture = np.asarray(self.texture_factors[rows, cols], np.float32)
        angular = np.asarray(self.angular_factors, np.float32).reshape(-1, self.n_terms)
        return (texture @ angular.T).reshape(len(texture), -1, 3)

    def shader(self, interpolation="barycentric"):
        from btfpipe.compression.svd_shading import SvdShader

        return SvdShader(self, interpolation)

    @property
    def nbytes(self):
        return int(
            sum(
                a.nbytes
                for a in (
                    self.texture_factors,
                    self.angular_factors,
                    self.light_directions,
                    self.view_directions,
                )
            )
        )
