"""The 205 pairs of light and view of the CUReT database, made by rule.

A robot turns a flat sample under a fixed lamp; the camera stands at seven places in the horizontal plane, 22.5 to 157.5
degrees from the lamp. So the angle between light and view takes seven values, and the pairs are no product of lights and
views.

World frame: z points to the lamp, y up. The sample's normal n is one of 81; with beta = asin(n_y) and alpha = atan2(n_x, n_z)
the robot turns the sample's frame by R = Ry(alpha) Rx(-beta), which takes z to n. The camera of place k stands in direction
Ry(-22.5 k deg) z, upright.

References
----------
Dana, van Ginneken, Nayar, Koenderink 1999, Reflectance and Texture of Real-World Surfaces, section 4.
"""

from collections import namedtuple

import numpy as np

COUNT = 205
STEP = np.pi / 8  # between places of the camera
_MOST_POLAR = np.radians(85)
_SPLITS = 3

# What the rule gives for the pictures 1 to 205, in order.
#   light, view  (205, 3)    unit vectors in the sample's frame (s, t, n)
#   camera       (205,)      place of the camera, 1 to 7
#   alpha, beta  (205,)      turns of the robot, radians
#   projection   (205, 2, 3) rows: the camera's right and up in the sample's frame; with a sample's point it gives
#                            the point's place in the picture, in an orthographic camera
CuretSet = namedtuple("CuretSet", "light view camera alpha beta projection")


def curet205():
    """The pairs of the CUReT database as a `CuretSet`; index 0 is picture 1.

    Two azimuths of lights at one polar angle come in ascending order, pi counted as -pi, but for the one tie of four in
    which the published table puts the lights nearer to straight below first.
    """
    normals = _normals()
    beta = np.arcsin(normals[:, 1])
    alpha = np.arctan2(normals[:, 0], normals[:, 2])
    light = _towards(alpha, beta)
    theta = np.arccos(light[:, 2])
    phi = np.arctan2(light[:, 1], light[:, 0])
    # pi and -pi are one azimuth, and rounding picks either
    phi = np.where(np.abs(np.abs(phi) - np.pi) < 1e-9, -np.pi, phi)
    rounded, phi = np.round(theta, 5), np.round(phi, 7)
    order = []
    for camera in range(1, 8):
        seen = _towards(alpha + camera * STEP, beta)
        kept = (theta < _MOST_POLAR) & (np.arccos(np.clip(seen[:, 2], -1, 1)) < _MOST_POLAR)
        # the one tie of four normals that the published table orders otherwise
        tied = (np.abs(theta - 0.876815) < 1e-5) & (camera == 1)
        last = np.where(tied, np.round(np.abs(phi + np.pi / 2), 5), 0)
        for normal in np.lexsort((phi, last, -rounded)):
            if kept[normal]:
                order.append((camera, normal))
    camera, index = np.array(order).T
    alpha, beta = alpha[index], beta[index]
    turned = alpha + camera * STEP
    right = np.stack(
        [np.cos(turned), -np.sin(turned) * np.sin(beta), np.sin(turned) * np.cos(beta)], axis=-1
    )
    up = np.stack([np.zeros_like(beta), np.cos(beta), np.sin(beta)], axis=-1)
    return CuretSet(
        light[index], _towards(turned, beta), camera, alpha, beta, np.stack([right, up], axis=1)
    )


def _towards(alpha, beta):
    """The lamp's direction in the sample's frame after turns `alpha`, `beta`; the camera's, if its place is in alpha."""
    return np.stack(
        [-np.sin(alpha), -np.cos(alpha) * np.sin(beta), np.cos(alpha) * np.cos(beta)], axis=-1
    )


def _normals():
    """The 81 unit vectors of two octants, every triangle split three times at the mid-points of its edges."""
    up, front = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    triangles = [(np.array([side, 0.0, 0.0]), up, front) for side in (1.0, -1.0)]
    for _ in range(_SPLITS):
        finer = []
        for a, b, c in triangles:
            ab, bc, ca = ((p + q) / np.linalg.norm(p + q) for p, q in ((a, b), (b, c), (c, a)))
            finer += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = finer
    corners = np.array(triangles).reshape(-1, 3)
    return corners[np.sort(np.unique(np.round(corners, 9), axis=0, return_index=True)[1])]
