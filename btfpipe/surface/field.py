"""The vector field that lays the sample's right-hand direction s on every vertex."""

import numpy as np

from btfpipe.errors import InputError, NumericalError
from btfpipe.parallel import single_threaded_blas
from btfpipe.surface.topology import edges, face_components

UP = (0.0, 1.0, 0.0)
_STROKE_WEIGHT = 1e3  # against about 40 on the diagonal of the squared Laplacian
_STROKE_REACH = 0.1  # of the bounding box's diagonal


def transport(vectors, start, end):
    """Carry tangent vectors along the shortest turn from one normal to another.

    Parameters
    ----------
    vectors : (k, 3)
        Orthogonal to `start`.
    start, end : (k, 3)
        Unit normals, not opposite.

    Returns
    -------
    (k, 3) ndarray
        Orthogonal to `end`, of the same lengths.
    """
    both = start + end
    cosine = np.einsum("kx,kx->k", start, end)
    along = np.einsum("kx,kx->k", end, vectors) / np.maximum(1 + cosine, 1e-6)
    return vectors - along[:, None] * both


def tangent_basis(normals):
    """Unit tangents e1, e2 of a right-handed basis (e1, e2, n) per normal, (n, 3) each."""
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
    e1 = np.cross(axis, normals)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    return e1, np.cross(normals, e1)


def relaxed_field(vertices, faces, normals):
    """The smoothest field of a mesh, as the smallest eigenvector of its connection Laplacian.

    Inverse iteration starts, in every component, from the horizontal direction ``up x n`` (up is y; z where the
    component looks straight up), which also settles the choice where many fields are equally smooth: on a sphere s
    runs around the y axis and t points up.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    normals : (n, 3) float
        Unit normals.

    Returns
    -------
    (n, 3) float64
        Tangent vectors, long where the direction is certain, short near singularities.

    References
    ----------
    Knöppel, Crane, Pinkall and Schröder 2013, Globally optimal direction fields, section 4 (with unit weights
    instead of cotangents: resampled meshes are even).
    """
    normals = np.asarray(normals, np.float64)
    count, component = face_components(faces, len(vertices))
    e1, e2 = tangent_basis(normals)
    x = _complex(_starting_field(normals, component, count), e1, e2)
    laplacian = _connection_laplacian(faces, normals, e1, e2)
    # the smallest eigenvalue is of the order 1 / n; a shift far below it keeps flat pieces regular
    solve = _factor(laplacian, 1e-4 / len(vertices))
    energy = np.full(count, np.inf)
    with single_threaded_blas():
        for _ in range(60):
            x = _normalised(x, component, count)
            before = energy
            energy = np.bincount(component, (x.conj() * (laplacian @ x)).real, count)
            if (before - energy <= 1e-3 * np.maximum(energy, 1e-12)).all():
                break
            x = solve(x)
    return _real(x, e1, e2)


def stroke_field(vertices, faces, normals, strokes):
    """A field through given vectors, extended smoothly: the thin plate of the connection Laplacian.

    Components without strokes take `relaxed_field`.

    Parameters
    ----------
    vertices, faces, normals
        As for `relaxed_field`.
    strokes : list of (point, vector)
        Place and wanted direction of s; the vector is projected into the tangent plane of the nearest vertex.

    Returns
    -------
    (n, 3) float64
        Tangent vectors.

    Raises
    ------
    InputError
        If a point is far from the surface or a vector stands on it.

    References
    ----------
    Praun, Finkelstein and Hoppe 2000, section 3 extend by radial basis functions; the thin plate is their intrinsic
    counterpart, which does not cut across thin walls.
    """
    from scipy.sparse import diags
    from scipy.spatial import cKDTree

    normals = np.asarray(normals, np.float64)
    field = relaxed_field(vertices, faces, normals)
    points = np.array([point for point, _ in strokes], float)
    wanted = np.array([vector for _, vector in strokes], float)
    distance, vertex = cKDTree(vertices).query(points)
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    for i in np.flatnonzero(distance > _STROKE_REACH * diagonal):
        raise InputError(
            f"stroke {i + 1}: its point is {distance[i]:.3g} away from the surface, whose bounding box has a"
            f" diagonal of {diagonal:.3g}. Give points on the surface, in the mesh's unit."
        )
    length = np.linalg.norm(wanted, axis=1)
    upright = np.einsum("kx,kx->k", wanted, normals[vertex])
    wanted = wanted - upright[:, None] * normals[vertex]
    flat = np.linalg.norm(wanted, axis=1)
    for i in np.flatnonzero(flat <= 0.1 * length):
        raise InputError(
            f"stroke {i + 1}: its vector stands on the surface; give one that lies along it."
        )
    wanted /= flat[:, None]
    e1, e2 = tangent_basis(normals)
    laplacian = _connection_laplacian(faces, normals, e1, e2)
    weight = _STROKE_WEIGHT * np.bincount(vertex, minlength=len(vertices))
    pull = np.zeros(len(vertices), complex)
    np.add.at(pull, vertex, _STROKE_WEIGHT * _complex(wanted, e1[vertex], e2[vertex]))
    with single_threaded_blas():
        x = _factor(laplacian @ laplacian + diags(weight), 1e-9)(pull)
    _, component = face_components(faces, len(vertices))
    touched = np.isin(component, component[vertex])
    field[touched] = _real(x, e1, e2)[touched]
    return field


def unit_field(vectors, faces, normals, rounds):
    """Unit tangents from tangent vectors: averaged with the neighbours `rounds` times, then normalised.

    Parameters
    ----------
    vectors : (n, 3) float64
        Projected into the tangent planes first.
    faces : (m, 3) int32
    normals : (n, 3)
    rounds : int

    Returns
    -------
    (n, 3) float64
    """
    from scipy.sparse import coo_matrix

    normals = np.asarray(normals, np.float64)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    pair = edges(faces)
    near = coo_matrix((np.ones(len(pair)), (pair[:, 0], pair[:, 1])), (len(normals),) * 2).tocsr()
    near = near + near.T
    vectors = _unit(_flat(vectors, normals), normals)
    for _ in range(rounds):
        vectors = _unit(_flat(vectors + near @ vectors, normals), normals)
    return vectors


def singularities(faces, normals, tangents):
    """Index of the field around each face, (m,) int64: mostly 0, +-1 at singularities.

    On a closed component the indices add up to its Euler characteristic (Poincaré and Hopf) as long as the normals
    turn by less than half a turn over each face.
    """
    normals = np.asarray(normals, np.float64)
    tangents = np.asarray(tangents, np.float64)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    carried = transport(tangents[start], normals[start], normals[end])
    side = np.cross(normals[end], tangents[end])
    turn = np.arctan2(
        np.einsum("hx,hx->h", carried, side), np.einsum("hx,hx->h", carried, tangents[end])
    ).reshape(-1, 3)
    # what a vector gains on its way around the face is the face's share of the sphere of normals
    total = turn.sum(axis=1)
    holonomy = total - 2 * np.pi * np.round(total / (2 * np.pi))
    return np.rint((holonomy - total) / (2 * np.pi)).astype(np.int64)


def turned(tangents, normals, angle):
    """Tangents turned counter-clockwise about the normals by `angle` radians."""
    return np.cos(angle) * tangents + np.sin(angle) * np.cross(normals, tangents)


def _starting_field(normals, component, count):
    field = np.cross(UP, normals)
    lengths = np.bincount(component, np.linalg.norm(field, axis=1), count) / np.bincount(
        component, minlength=count
    )
    flat = lengths[component] < 0.1
    field[flat] = np.cross((0.0, 0.0, -1.0), normals[flat])
    return field


def _connection_laplacian(faces, normals, e1, e2):
    """Hermitian (n, n): |x|_L^2 sums |x_j - transported x_i|^2 over the edges."""
    from scipy.sparse import coo_matrix

    n = len(normals)
    i, j = edges(faces).T
    carried = transport(e1[i], normals[i], normals[j])
    turn = _complex(carried, e1[j], e2[j])
    turn /= np.abs(turn)
    degree = np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
    diagonal = np.arange(n)
    return coo_matrix(
        (
            np.concatenate([-turn, -turn.conj(), degree.astype(complex)]),
            (np.concatenate([j, i, diagonal]), np.concatenate([i, j, diagonal])),
        ),
        (n, n),
    ).tocsc()


def _factor(matrix, shift):
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    try:
        return splu(
            (matrix + shift * identity(matrix.shape[0])).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        ).solve
    except RuntimeError as error:
        raise NumericalError(
            f"the vector field's matrix cannot be factorised ({error}); ask for other --vertices."
        ) from error


def _normalised(x, component, count):
    norm = np.sqrt(np.bincount(component, np.abs(x) ** 2, count))
    return x / np.maximum(norm, 1e-300)[component]


def _complex(vectors, e1, e2):
    return np.einsum("kx,kx->k", vectors, e1) + 1j * np.einsum("kx,kx->k", vectors, e2)


def _real(x, e1, e2):
    return x.real[:, None] * e1 + x.imag[:, None] * e2


def _flat(vectors, normals):
    return vectors - np.einsum("kx,kx->k", vectors, normals)[:, None] * normals


def _unit(vectors, normals):
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    lost = length[:, 0] < 1e-9
    unit = vectors / np.where(length < 1e-9, 1.0, length)
    if lost.any():
        unit[lost] = tangent_basis(normals[lost])[0]
    return unit
