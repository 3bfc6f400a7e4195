"""Compiled traversal and matching of half-edges, for `_pairing`; loaded when a mesh needs them."""

import numpy as np

from btfpipe.compiled import njit

_MOST_COMPARED = 64  # half-edges of an edge of which every two are compared


@njit(cache=True, nogil=True)
def spread(opposite, agree, sense, piece):
    """Breadth-first traversal of faces, which fills `sense` and `piece`.

    Pairs that contradict them are cleared, and counted.
    """
    m = len(sense)
    queue = np.empty(m, np.int32)
    found = 0
    cut = 0
    for root in range(m):
        if sense[root] != 0:
            continue
        sense[root] = 1
        piece[root] = found
        queue[0] = root
        read, write = 0, 1
        while read < write:
            f = queue[read]
            read += 1
            for h in range(3 * f, 3 * f + 3):
                g = opposite[h]
                if g < 0:
                    continue
                wanted = sense[f] if agree[h] else -sense[f]
                other = g // 3
                if sense[other] == 0:
                    sense[other] = wanted
                    piece[other] = found
                    queue[write] = other
                    write += 1
                elif sense[other] != wanted:
                    opposite[h] = -1
                    opposite[g] = -1
                    cut += 1
        found += 1
    return cut


@njit(cache=True, nogil=True)
def match(opposite, order, starts, angle, ends, piece, rim, same):
    """Pair the half-edges of each edge, which are sorted by angle around it."""
    n = len(order)
    for i in range(len(starts)):
        first = starts[i]
        last = starts[i + 1] if i + 1 < len(starts) else n
        ring = _alternated(angle[first:last], ends[first:last], same) + first
        size = last - first
        alternates = True
        for k in range(size):
            if ends[ring[k]] == ends[ring[(k + 1) % size]]:
                alternates = False
        if alternates:
            for k in range(size):
                if not ends[ring[k]]:
                    _join(opposite, order, ring[k], ring[(k + 1) % size])
        elif size <= _MOST_COMPARED:
            _match_by_score(opposite, order, first, last, angle, ends, piece, rim, same)
        else:
            _match_nested(opposite, order, ring, ends)


@njit(cache=True, nogil=True)
def _join(opposite, order, a, b):
    opposite[order[a]] = order[b]
    opposite[order[b]] = order[a]


@njit(cache=True, nogil=True)
def _alternated(angle, ends, same):
    """The order around an edge; faces that lie on each other end and begin the inside by turns."""
    n = len(angle)
    ring = np.empty(n, np.int64)
    used = np.zeros(n, np.bool_)
    before = False
    first = 0
    while first < n:
        last = first + 1
        while last < n and angle[last] - angle[last - 1] <= same:
            last += 1
        for k in range(first, last):
            pick = -1
            for at in range(first, last):
                if not used[at] and (pick < 0 or (ends[pick] == before and ends[at] != before)):
                    pick = at
            used[pick] = True
            before = ends[pick]
            ring[k] = pick
        first = last
    return ring


@njit(cache=True, nogil=True)
def _match_by_score(opposite, order, first, last, angle, ends, piece, rim, same):
    while True:
        best, one, two = np.inf, -1, -1
        for a in range(first, last):
            if opposite[order[a]] >= 0:
                continue
            for b in range(a + 1, last):
                if opposite[order[b]] >= 0 or ends[a] == ends[b]:
                    continue
                score = abs(abs(angle[a] - angle[b]) - np.pi)
                if rim[piece[a]] or rim[piece[b]]:
                    score += 10
                if piece[a] != piece[b]:
                    score += 20
                if score < best - same:
                    best, one, two = score, a, b
        if one < 0:
            return
        _join(opposite, order, one, two)


@njit(cache=True, nogil=True)
def _match_nested(opposite, order, ring, ends):
    """As brackets match, around the edge twice; what has no partner stays."""
    n = len(ring)
    stack = np.empty(2 * n, np.int64)
    height = 0
    for k in range(2 * n):
        at = ring[k % n]
        if opposite[order[at]] >= 0:
            continue
        if not ends[at]:
            if k < n:
                stack[height] = at
                height += 1
        elif height > 0:
            height -= 1
            _join(opposite, order, stack[height], at)
