"""What a reader of a foreign format hands to `ingest`."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np


@dataclass
class Measurement:
    """Pictures of one patch that are still to be read, with their directions.

    Attributes
    ----------
    source : Path
    light_directions, view_directions : (n, 3) float64
        Unit vectors.
    light_index, view_index : (pairs,) int32
        A product has ``pair = view * lights + light``.
    names : list of str
        What messages call the picture of each pair.
    read : callable
        ``read(pair)`` gives a picture (rows, cols, 3) as stored: uint8, uint16, float16 or float32. Called from
        several threads at once.
    transfer : callable
        ``transfer(picture)`` gives the transfer curve that the format means for a picture read.
    correct : callable or None
        ``correct(pair, picture)`` gives a linear picture (rows, cols, 3) float32 as it would be under one distant light,
        where the source's lamp stood near, or with the light's cosine inside, where it was divided out. The Sample then holds floating-point values.
    white : float or None
        Decoded value that stands for a perfect white diffuser lit at normal incidence.
    scale : float
        Factor on decoded values where that is not known: values as they were before they were scaled to fit.
    toroidal : bool or None
        None if the source does not say.
    texels_per_mm : float or None
    mask : (rows, cols) bool or None
        Valid pixels of the pictures; None if all are.
    facts : dict
        What else the reader found and the summary should say.
    """

    source: Path
    light_directions: np.ndarray
    view_directions: np.ndarray
    light_index: np.ndarray
    view_index: np.ndarray
    names: list
    read: Callable
    transfer: Callable
    correct: Callable | None = None
    white: float | None = None
    scale: float = 1.0
    toroidal: bool | None = None
    texels_per_mm: float | None = None
    mask: np.ndarray | None = None
    facts: dict = field(default_factory=dict)

    @property
    def n_pairs(self):
        return len(self.light_index)


def nearest_normal(measurement):
    """The pair whose light and view are nearest the normal.

    The sum of the squared polar angles is least; of several such pairs it is the first.
    """
    squares = [
        np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2]) ** 2
        for directions in (measurement.light_directions, measurement.view_directions)
    ]
    total = squares[0][measurement.light_index] + squares[1][measurement.view_index]
    return int(np.argmin(np.round(total, 9)))  # equal angles differ by rounding


def frontal(measurement):
    """The one pair of a measurement that is nearest the normal, of light and view; see `nearest_normal`.

    Parameters
    ----------
    measurement : Measurement
        Open for as long as the result is used.

    Returns
    -------
    Measurement
        Of one light, one view and one pair; what else it says is the same.
    """
    pair = nearest_normal(measurement)
    light, view = measurement.light_index[pair], measurement.view_index[pair]
    correct = measurement.correct
    return replace(
        measurement,
        light_directions=measurement.light_directions[light : light + 1],
        view_directions=measurement.view_directions[view : view + 1],
        light_index=np.zeros(1, np.int32),
        view_index=np.zeros(1, np.int32),
        names=[measurement.names[pair]],
        read=lambda _: measurement.read(pair),
        correct=correct and (lambda _, picture: correct(pair, picture)),
    )


def with_cosine(measurement):
    """A measurement whose values were divided by their light's cosine, with the cosine multiplied in.

    Parameters
    ----------
    measurement : Measurement

    Returns
    -------
    Measurement
        With linear pictures in floating point, as our convention has them: see DESIGN.
    """
    correct = measurement.correct
    cosines = np.maximum(measurement.light_directions[measurement.light_index, 2], 0)

    def multiplied(pair, picture):
        picture = picture if correct is None else correct(pair, picture)
        return picture * np.float32(cosines[pair])

    measurement.facts["cosine"] = "divided, as asked; multiplied in"
    return replace(measurement, correct=multiplied)
