"""Whether a material runs in one direction, as cords do and a weave does not."""

from collections import namedtuple

import numpy as np

_VECTORS = 16  # leading dimensions of a level's vectors, which fall in extent

# angle: in which the material changes, from s towards t, radians in (-pi / 2, pi / 2]: cords along
# s change along t.
# share: how much of the change is in one direction, 0 (in all alike, or in two at right angles) to
# 1.
# period: of the strongest wave within a sixth of a turn of that direction, in texels.
Direction = namedtuple("Direction", "angle share period")


def dominant_direction(level, toroidal):
    """The direction of a feature image's waves, by where their power lies.

    Parameters
    ----------
    level : btfpipe.analysis.FeatureLevel
    toroidal : bool
        Another sample is faded out towards its border.

    Returns
    -------
    Direction
    """
    image = np.asarray(level.vectors, np.float32)[:, :_VECTORS][level.labels]
    image = image - image.mean(axis=(0, 1))
    rows, cols = image.shape[:2]
    if not toroidal:
        image = image * np.outer(np.hanning(rows + 2)[1:-1], np.hanning(cols + 2)[1:-1])[..., None]
    power = np.square(np.abs(np.fft.fft2(image, axes=(0, 1)))).sum(axis=2)
    # row runs against t
    along_t, along_s = -np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(cols)[None]
    frequency = np.hypot(along_t, along_s)
    power[0, 0] = 0.0
    total = power.sum()
    if total == 0:
        return Direction(0.0, 0.0, float(max(rows, cols)))
    # mean of the doubled angle, so that opposite senses are one direction
    twice = (power * np.exp(2j * np.arctan2(along_t, along_s))).sum() / total
    angle = float(np.angle(twice)) / 2
    near = np.abs(along_s * np.cos(angle) + along_t * np.sin(angle)) >= 0.5 * frequency
    strongest = np.argmax(np.where(near, power, 0.0))
    return Direction(angle, float(np.abs(twice)), float(1 / frequency.flat[strongest]))
