"""Harmonics next to the horizon, where nothing was measured: they ring there, and values have to go to 0."""

import numpy as np
import pytest

from btfpipe.compression.harmonics import compress_harmonics
from btfpipe.directions import from_angles
from btfpipe.sample import Sample


@pytest.mark.parametrize("name", ["weave", "cords"])
def test_values_next_to_the_horizon_are_next_to_nothing(ingested, rng, name):
    sample = Sample.open(ingested(name))
    small = Sample(
        np.ascontiguousarray(sample.codes[:, :16, :16]), sample.light_directions, sample.view_directions,
        sample.light_index, sample.view_index, transfer=sample.transfer, scale=sample.scale,
    )  # fmt: skip
    model = compress_harmonics(small)
    n = 20_000
    row, col = rng.integers(0, 16, (2, n))
    w_o = from_angles(np.arccos(rng.random(n)), 6.3 * rng.random(n))
    low, ring = (
        model.evaluate(row, col, from_angles(np.full(n, np.radians(t)), 6.3 * rng.random(n)), w_o)
        for t in (89.9, 75)
    )
    assert np.abs(low).max() < 0.01
    assert np.abs(ring).max() > 0.3
