"""What an oriented manifold is, checked face by face."""

from collections import defaultdict

import numpy as np


def faults(vertices, faces):
    """What keeps a triangle mesh from being an oriented manifold (with or without boundary)."""
    found = []
    faces = [tuple(int(c) for c in face) for face in faces]
    used = {c for face in faces for c in face}
    if used != set(range(len(vertices))):
        found.append(f"corners name {len(used)} of {len(vertices)} vertices")
    if not np.isfinite(vertices).all():
        found.append("a vertex is not finite")
    directed = set()
    after = defaultdict(dict)  # around a vertex: the neighbour that follows a neighbour
    for a, b, c in faces:
        if len({a, b, c}) < 3:
            found.append(f"face {a, b, c} has two equal corners")
        for start, end, apex in ((a, b, c), (b, c, a), (c, a, b)):
            if (start, end) in directed:
                found.append(f"two faces run from {start} to {end}")
            directed.add((start, end))
            after[start][end] = apex
    for vertex, turns in after.items():
        # one chain, or one ring, through all faces of the vertex
        begins = set(turns) - set(turns.values())
        at = next(iter(begins or turns))
        steps = 0
        while at in turns and steps < len(turns):
            at = turns[at]
            steps += 1
        if steps < len(turns):
            found.append(f"the faces around vertex {vertex} are not one fan")
    return found


def euler_characteristics(faces):
    """Vertices - edges + faces of each connected part, sorted, by walking from face to face."""
    faces = [tuple(int(c) for c in face) for face in faces]
    at = defaultdict(list)
    for number, face in enumerate(faces):
        for corner in face:
            at[corner].append(number)
    left, result = set(range(len(faces))), []
    while left:
        part, queue = set(), [left.pop()]
        while queue:
            face = queue.pop()
            part.add(face)
            for corner in faces[face]:
                for other in at[corner]:
                    if other in left:
                        left.discard(other)
                        queue.append(other)
        corners = {c for f in part for c in faces[f]}
        edges = {frozenset((faces[f][k], faces[f][k - 1])) for f in part for k in range(3)}
        result.append(len(corners) - len(edges) + len(part))
    return sorted(result)


def boundary_edges(faces):
    """Edges that have a face on one side only."""
    directed = {(int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3)}
    return sum((b, a) not in directed for a, b in directed)
