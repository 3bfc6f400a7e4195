"""What tests of several methods share."""

import numpy as np
import pytest

from btfpipe.directions import Hemisphere
from btfpipe.parallel import single_threaded_blas
from btfpipe.sample import light_cosines


@pytest.fixture(autouse=True)
def one_blas_thread():
    """Many BLAS threads on small matrices only wait for each other."""
    with single_threaded_blas():
        yield


def _blended_pictures(model, row, col, w_i, w_o, interpolation):
    """Blend whole pictures over view, and value / cos over light; then four texels."""
    lights = Hemisphere(model.light_directions, interpolation).weights(w_i)
    views = Hemisphere(model.view_directions, interpolation).weights(w_o)
    cosines = light_cosines(model.light_directions)
    pictures = model.pictures(slice(0, model.n_pairs)).astype(np.float64)
    pictures = pictures.reshape(len(model.view_directions), len(cosines), *model.shape, 3)
    pictures = pictures / cosines[:, None, None, None]
    mode = "wrap" if model.toroidal else "edge"
    out = np.zeros((len(row), 3))
    for q in range(len(row)):
        if w_i[q, 2] <= 0:
            continue
        chosen = pictures[np.ix_(views[0][q], lights[0][q])]
        picture = np.einsum("o,i,oirck->rck", views[1][q], lights[1][q], chosen) * w_i[q, 2]
        picture = np.pad(picture, ((40, 40), (40, 40), (0, 0)), mode)
        top, left = int(np.floor(row[q])), int(np.floor(col[q]))
        y, x = row[q] - top, col[q] - left
        block = picture[40 + top : 42 + top, 40 + left : 42 + left]
        out[q] = np.einsum("r,c,rck->k", (1 - y, y), (1 - x, x), block)
    return out


@pytest.fixture
def blended_pictures():
    """A naive twin of shading: ``blended_pictures(model, row, col, w_i, w_o, interpolation)`` gives values (n, 3)."""
    return _blended_pictures
