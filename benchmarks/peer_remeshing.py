"""Remesh a mesh with another program, in a process of its own, which may crash or take too long.

`python peer_remeshing.py pymeshlab|gpytoolbox in.npz out.npz N`: vertices and faces in; vertices, faces and seconds out.
"""

import sys
import time
import warnings

import numpy as np

_TRIAL = 30_000  # vertices at most of the run that finds the length for the wanted number
_NEAR = 0.05
_ROUNDS = 3  # of which the nearest to the wanted number counts


def pymeshlab(vertices, faces, length):
    """MeshLab's isotropic explicit remeshing, its defaults but for the length."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    start = time.perf_counter()
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=10,
        adaptive=False,
        targetlen=pymeshlab.PureValue(length),
        featuredeg=30,
        checksurfdist=True,
    )
    seconds = time.perf_counter() - start
    made = meshes.current_mesh()
    return made.vertex_matrix(), made.face_matrix(), seconds


def gpytoolbox(vertices, faces, length):
    """Gpytoolbox's remeshing after Botsch and Kobbelt."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its imports are deprecated by scipy
        import gpytoolbox
    start = time.perf_counter()
    made = gpytoolbox.remesh_botsch(vertices, faces.astype(np.int64), i=10, h=length)[:2]
    return *made, time.perf_counter() - start


def length_for(vertices, faces, n):
    """Edges of n vertices spread evenly: 2 faces a vertex, each of area sqrt(3)/4 times the squared edge."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return np.sqrt(area / n * 2 / np.sqrt(3))


def main(peer, source, out, n):
    remesh = {"pymeshlab": pymeshlab, "gpytoolbox": gpytoolbox}[peer]
    with np.load(source) as data:
        mesh = data["vertices"], data["faces"]
    n = int(n)
    trial, scale, best = min(n, _TRIAL), 1.0, None
    for _ in range(_ROUNDS):
        made = remesh(*mesh, scale * length_for(*mesh, trial))
        off = len(made[0]) / trial
        if best is None or abs(np.log(off)) < abs(np.log(best[0])):
            best = off, scale, made
        if abs(off - 1) <= _NEAR:
            break
        scale *= np.sqrt(off)
    off, scale, made = best
    if trial < n:
        made = remesh(*mesh, scale * np.sqrt(off) * length_for(*mesh, n))
    np.savez(out, vertices=made[0], faces=made[1], seconds=made[2])


if __name__ == "__main__":
    main(*sys.argv[1:])
