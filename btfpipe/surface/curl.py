"""How far the directions of a field are from being the gradients of evenly spaced stripes.

Stripes that cross a field s at a constant spacing have a phase whose gradient is s; where s has
curl there is no such phase, and stripes have to begin or end. Around a closed path they are out of
step by the path integral of s, which is that of its curl over the area inside. So the sum of the
curl's magnitude over a surface, in spacings of the stripes, is about how many dislocations they
have (Knöppel et al. 2015, Stripe patterns on surfaces).
"""

import numpy as np


def face_curl(level, turn=0.0):
    """Integral of the curl of a unit direction over each face of a surface.

    That is the circulation of ``<d, .>`` around the face. Along an edge `d` is the mean of its two
    ends; at either, the edge is turned into the tangent plane at its full length, as transport
    along it does.

    Parameters
    ----------
    level : btfpipe.surface.Level
    turn : float
        Angle of `d` from s towards t, radians: 0 for s, a quarter turn for t.

    Returns
    -------
    (m,) float64
        In units of length; positive counter-clockwise. On a closed surface they add up to 0.
    """
    vertices, faces = np.asarray(level.vertices, np.float64), np.asarray(level.faces)
    normals, s = (np.asarray(a, np.float64) for a in (level.normals, level.tangents))
    directions = np.cos(turn) * s + np.sin(turn) * np.cross(normals, s)
    total = np.zeros(len(faces))
    for k in range(3):
        a, b = faces[:, k], faces[:, (k + 1) % 3]
        edge = vertices[b] - vertices[a]
        length = np.linalg.norm(edge, axis=1)
        for v in (a, b):
            flat = edge - np.einsum("mx,mx->m", edge, normals[v])[:, None] * normals[v]
            stretch = length / np.maximum(np.linalg.norm(flat, axis=1), 1e-30)
            total += 0.5 * stretch * np.einsum("mx,mx->m", flat, directions[v])
    return total


def summed_curl(level, turn=0.0):
    """Sum of the magnitude of `face_curl` over all faces, in units of length.

    Divided by the spacing of stripes that run at right angles to the direction, it is about the
    number of their dislocations.
    """
    return float(np.abs(face_curl(level, turn)).sum())


def curl_facts(level):
    """``curl_s`` and ``curl_t``: the summed curl over 2 pi, for stripes 2 pi units of length apart.

    Of `curl_s` the stripes run along t, of `curl_t` along s. Stripes d units apart have 2 pi / d
    times as many dislocations.
    """
    return {
        "curl_s": summed_curl(level) / (2 * np.pi),
        "curl_t": summed_curl(level, np.pi / 2) / (2 * np.pi),
    }
