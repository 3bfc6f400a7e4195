"""The search of Tong et al. 2002, section 5: the best texel for each vertex, one vertex after the other.

A neighbourhood pixel is a surface texton, a blend ``s = w0 t0 + w1 t1 + w2 t2`` of the textons of three
vertices (equation 1). As the weights add up to one, its squared distance to a texton t is

    |s - t|^2 = sum_i w_i |t_i - t|^2 - sum_{i<j} w_i w_j |t_i - t_j|^2,

so the squared distances of the textons, which follow from the dot-product matrix, are all that is looked up. The Euclidean form of
the same distance blends feature vectors instead; it serves plain feature images, which have a vector a texel.
"""

import numpy as np

from btfpipe.compiled import leaf
from btfpipe.synthesis.exemplar import coarse_texel, texel_under, wrapped

CLOCK, CANDIDATES, FALLBACKS, STARTS, MOVED = range(5)  # places in the tally
FAST = {"reassoc", "contract", "nsz"}


@leaf
def _resample(vertex, weight, skip, label, done, tables, base, share, constant, blend):
    """Blend the textons under each pixel of a neighbourhood.

    Pixels that no triangle covers carry the default texton. With `skip`, vertices not yet synthesised are left out, and with
    them the pixels that mostly hang on them.
    """
    default = max(tables.table.shape[0], tables.vectors.shape[0]) - 1
    n = tables.table.shape[0]
    for p in range(vertex.shape[0]):
        if vertex[p, 0] < 0:
            base[p, 0] = base[p, 1] = base[p, 2] = default
            share[p, 0] = 1.0
            share[p, 1] = share[p, 2] = 0.0
        else:
            total = np.float32(0.0)
            for j in range(3):
                u = vertex[p, j]
                base[p, j] = label[u]
                share[p, j] = weight[p, j]
                if skip and not done[u]:
                    share[p, j] = 0.0
                total += share[p, j]
            if total < 0.5:
                share[p, 0] = share[p, 1] = share[p, 2] = 0.0
                constant[p] = 0.0 if n > 0 else -1.0  # the vectors' distance leaves it out
                continue
            for j in range(3):
                share[p, j] /= total
        a, b, c = base[p, 0], base[p, 1], base[p, 2]
        wa, wb, wc = share[p, 0], share[p, 1], share[p, 2]
        if n > 0:
            constant[p] = (
                wa * wb * tables.table[a, b]
                + wb * wc * tables.table[b, c]
                + wc * wa * tables.table[c, a]
            )
            base[p, 0] = a * n
            base[p, 1] = b * n
            base[p, 2] = c * n
        else:
            constant[p] = 0.0
            depth = tables.vectors.shape[1]
            for i in range(depth):
                blend[p * depth + i] = (
                    wa * tables.vectors[a, i]
                    + wb * tables.vectors[b, i]
                    + wc * tables.vectors[c, i]
                )


@leaf(fastmath=FAST)
def square_of_run(a, i, b, j, n):
    """Squared distance of ``a[i:i + n]`` and ``b[j:j + n]``. Unsigned places: signed ones may be negative, and are not vectorised."""
    i = np.uint64(i)
    j = np.uint64(j)
    total = np.float32(0.0)
    for d in range(np.uint64(n)):
        step = a[i + d] - b[j + d]
        total += step * step
    return total


@leaf(fastmath=FAST)
def _square(
    r, c, side, labels, table, image, width, n, depth, base, share, constant, blend, total, limit
):  # fmt: skip
    """`total` plus the distance of the resampled neighbourhood to that of texel (r, c); given up row by row above `limit`."""
    p = 0
    for i in range(side):
        run = (r + i) * width + c
        if n > 0:
            for j in range(side):
                t = labels[np.uint64(run + j)]
                total += (
                    share[p, 0] * table[np.uint64(base[p, 0] + t)]
                    + share[p, 1] * table[np.uint64(base[p, 1] + t)]
                    + share[p, 2] * table[np.uint64(base[p, 2] + t)]
                    - constant[p]
                )
                p += 1
        else:
            solid = True
            for j in range(side):
                solid &= constant[p + j] >= 0
            if solid:
                total += square_of_run(blend, p * depth, image, run * depth, side * depth)
            else:
                for j in range(side):
                    if constant[p + j] >= 0:
                        total += square_of_run(
                            blend, (p + j) * depth, image, (run + j) * depth, depth
                        )
            p += side
        if total >= limit:
            break
    return total


@leaf(fastmath=FAST)
def _choose(tries, penalty, count, cols, coarse_side, coarse_sample, coarse, side, sample, fine):
    """Place in `tries` of the texel nearest by penalty times distance, and its distance; the coarser level first."""
    labels, table, image, width, n, depth = sample
    base, share, constant, blend = fine
    labels1, table1, image1, width1, n1, depth1 = coarse_sample
    base1, share1, constant1, blend1 = coarse
    best = 0
    best_distance = np.float32(np.inf)
    lowest = np.float32(np.inf)
    for m in range(count):
        limit = lowest / penalty[m]
        r = tries[m] // cols
        c = tries[m] - r * cols
        total = np.float32(0.0)
        if coarse_side > 0:
            total = _square(
                coarse_texel(r), coarse_texel(c), coarse_side, labels1, table1, image1, width1, n1, depth1,
                base1, share1, constant1, blend1, total, limit,
            )  # fmt: skip
        if total < limit:
            total = _square(
                r, c, side, labels, table, image, width, n, depth, base, share, constant, blend, total,
                limit,
            )  # fmt: skip
            if total < limit:
                best = m
                best_distance = total
                lowest = total * penalty[m]
    return best, best_distance


def scratch_lists(exemplar, owners):
    """Room for what `list_candidates` lists of so many owners; one more than can be listed, which it may write to."""
    most = 1 + max(exemplar.rows * exemplar.cols, owners * exemplar.lists.shape[1])
    return np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.float32)


@leaf
def list_candidates(
    owners, n, support, kappa, full, lists, usable, compared, stamp, tries, origin, penalty
):  # fmt: skip
    """The texels to compare: first those that runs lead to, then their lists, or all texels.

    Parameters
    ----------
    owners, support : (n,) int32, float32
        Texels that the runs lead to, marked as compared, and the share of the runs that do.
    kappa, full
        As in `grow`.
    lists, usable
        Of the `Exemplar`.
    compared : (texels,) int32
        Holds `stamp` for texels already listed.
    tries, origin, penalty : int32, int32, float32
        Of `scratch_lists`, filled in: texel, the owner in whose list it was found (-1 in a full search), factor of its distance.

    Returns
    -------
    int
        Number listed.
    """
    count = 0
    for j in range(n):
        if usable[owners[j]]:
            tries[count] = owners[j]
            origin[count] = j
            penalty[count] = np.float32(1.0) + kappa * (np.float32(1.0) - support[j])
            count += 1
    if not full:
        for j in range(n):
            for e in range(1, lists.shape[1]):
                texel = lists[owners[j], e]
                tries[count] = (
                    texel  # and written over by the next if it is there already: no branch to mispredict
                )
                origin[count] = j
                penalty[count] = np.float32(1.0) + kappa
                count += compared[texel] != stamp
                compared[texel] = stamp
    if full or count == 0:
        for texel in range(len(usable)):
            if usable[texel] and compared[texel] != stamp:
                tries[count] = texel
                origin[count] = -1
                penalty[count] = np.float32(1.0) + kappa
                count += 1
    return count


def scratch(exemplar, widest):
    """What `grow` writes down about one vertex, of a patch of up to `widest` vertices.

    The neighbourhoods on this and the coarser level (see `_resample`), the vertex that last compared each texel; where the runs
    of the patch lead, the texels there, their share of the runs and mean fraction; the candidates.
    """
    return (
        _room(exemplar.fine),
        _room(exemplar.coarse),
        np.full(exemplar.rows * exemplar.cols, -1, np.int32),
        np.empty((widest, 2), np.float32),
        np.empty(widest, np.int32),
        np.empty(widest, np.float32),
        np.empty((widest, 2), np.float32),
        scratch_lists(exemplar, widest),
    )


def _room(tables):
    """Base, share, constant and blend of a neighbourhood."""
    pixels = tables.side * tables.side
    return (
        np.zeros((pixels, 3), np.int32),
        np.zeros((pixels, 3), np.float32),
        np.zeros(pixels, np.float32),
        np.zeros(pixels * tables.vectors.shape[1], np.float32),
    )


@leaf
def grow(
    vertices, patches, coarse_vertex, coarse_weight, exemplar, full, skip, kappa, row, col, label, done,
    visited, moved, distances, coarse_label, room, tally,
):  # fmt: skip
    """Synthesise the given vertices in order.

    Parameters
    ----------
    vertices : (n,) int32
    patches : Patches
        Of these vertices.
    coarse_vertex, coarse_weight : (n, p, 3) int32, float32
        Neighbourhoods on the coarser level; n = 0 for none.
    exemplar : Exemplar
    full : bool
        All texels are candidates, instead of the k-coherent ones. Those are also tried for a vertex that has no candidate, because
        all leave a sample that is not toroidal; such vertices are counted.
    skip : bool
        Leave out of the neighbourhoods what is not `done`.
    kappa : float32
        The distance of a texel that no run of the patch leads to is multiplied by ``1 + kappa``; where a share of the runs
        leads to it, by less in proportion.
    row, col : (all vertices,) float32
        Coordinates; changed in place, as are `label` (int32) and `done` (bool).
    visited, moved : (all vertices,) int64
        When each was last synthesised, and when its texel last changed; a vertex with nothing new around it is passed over.
    distances : (all vertices,) float32
        Distance of the texel chosen.
    coarse_label : (vertices of the coarser level,) int32
    room
        Of `scratch`.
    tally : (5,) int64
        The clock of `visited` and `moved`. Counts: candidates compared, fallbacks, starts (vertices that keep their random texel, having
        no synthesised one near), vertices whose texel changed.
    """
    fine, coarse, compared, place, owners, support, fraction, (tries, origin, penalty) = room
    compared[:] = -1
    pair = (
        exemplar.cols, exemplar.coarse.side, exemplar.coarse.flat, coarse, exemplar.fine.side,
        exemplar.fine.flat, fine,
    )  # fmt: skip
    for i in range(vertices.shape[0]):
        v = vertices[i]
        if not _is_news(patches.pixel_vertex[i], patches.patch_vertex[i], visited[v], moved):
            continue
        tally[CLOCK] += 1
        visited[v] = tally[CLOCK]
        _resample(
            patches.pixel_vertex[i],
            patches.pixel_weight[i],
            skip,
            label,
            done,
            exemplar.fine,
            *fine,
        )
        if exemplar.coarse.side > 0:
            _resample(
                coarse_vertex[i], coarse_weight[i], False, coarse_label, done, exemplar.coarse, *coarse
            )  # fmt: skip
        runs = 0
        for j in range(patches.patch_vertex.shape[1]):
            u = patches.patch_vertex[i, j]
            if u < 0:
                break
            if done[u]:
                place[runs, 0] = row[u] + patches.patch_step[i, j, 0]
                place[runs, 1] = col[u] + patches.patch_step[i, j, 1]
                runs += 1
        n = _gather(place[:runs], exemplar, compared, i, owners, support, fraction)
        if runs == 0:
            tally[STARTS] += 1
            done[v] = True
            moved[v] = tally[CLOCK]
            continue
        found = list_candidates(
            owners,
            n,
            support,
            kappa,
            full,
            exemplar.lists,
            exemplar.usable,
            compared,
            i,
            tries,
            origin,
            penalty,
        )
        if origin[0] < 0 and not full:
            tally[FALLBACKS] += 1
        m, distance = _choose(tries, penalty, found, *pair)
        best = tries[m]
        best_run = origin[m]
        r0 = best // exemplar.cols
        c0 = best - r0 * exemplar.cols
        if texel_under(row[v], col[v], exemplar) != best:
            tally[MOVED] += 1
            moved[v] = tally[CLOCK]
        row[v] = r0
        col[v] = c0
        if best_run >= 0:
            row[v] += fraction[best_run, 0]
            col[v] += fraction[best_run, 1]
        label[v] = exemplar.fine.labels[r0 + exemplar.fine.side // 2, c0 + exemplar.fine.side // 2]
        done[v] = True
        tally[CANDIDATES] += found
        distances[v] = distance


@leaf
def _is_news(pixel_vertex, patch_vertex, since, moved):
    """Whether a texel of a neighbourhood or a patch has changed since a time."""
    for p in range(pixel_vertex.shape[0]):
        for j in range(3):
            u = pixel_vertex[p, j]
            if u >= 0 and moved[u] >= since:
                return True
    for j in range(patch_vertex.shape[0]):
        u = patch_vertex[j]
        if u < 0:
            break
        if moved[u] >= since:
            return True
    return False


@leaf
def _gather(place, exemplar, compared, i, owners, support, fraction):
    """The distinct texels that the runs of a patch lead to, each with the share of the runs that do and their mean fraction.

    A run leads to all texels within 0.75 texel: one that ends near the middle between two is not split. The mean keeps a
    run that meets itself again rigid. Returns the number of texels, which are marked as compared.
    """
    n = 0
    for j in range(place.shape[0]):
        texel = texel_under(place[j, 0], place[j, 1], exemplar)
        if texel < 0 or compared[texel] == i:
            continue
        compared[texel] = i
        r = texel // exemplar.cols
        c = texel - r * exemplar.cols
        sum_row = np.float32(0.0)
        sum_col = np.float32(0.0)
        count = np.float32(0.0)
        for m in range(place.shape[0]):
            dr = place[m, 0] - r
            dc = place[m, 1] - c
            if exemplar.toroidal:
                dr -= exemplar.rows * np.floor(dr / exemplar.rows + np.float32(0.5))
                dc -= exemplar.cols * np.floor(dc / exemplar.cols + np.float32(0.5))
            if abs(dr) <= 0.75 and abs(dc) <= 0.75:
                sum_row += dr
                sum_col += dc
                count += np.float32(1.0)
        owners[n] = texel
        support[n] = count / place.shape[0]
        fraction[n, 0] = min(max(sum_row / count, np.float32(-0.49)), np.float32(0.49))
        fraction[n, 1] = min(max(sum_col / count, np.float32(-0.49)), np.float32(0.49))
        n += 1
    return n


@leaf
def inherit(
    face, weight, parent_faces, step, parent_row, parent_col, exemplar, rows, cols, row, col, label
):
    """First pass (section 5.1): coordinates from the places on the coarser level.

    Parameters
    ----------
    face, weight : (n,) int32, (n, 3) float32
        Places on the coarser level.
    parent_faces : (m, 3) int32
    step : (n, 3, 2) float32
        Change of (row, col), in coarse texels, from each corner of the face to the place.
    parent_row, parent_col : float32
        Coordinates of the coarser level, whose sample has `rows` x `cols` texels.
    exemplar : Exemplar
        Of the finer level.
    row, col, label : (n,)
        Filled in.
    """
    for v in range(face.shape[0]):
        heaviest = 0
        for j in range(1, 3):
            if weight[v, j] > weight[v, heaviest]:
                heaviest = j
        u = parent_faces[face[v], heaviest]
        r0 = parent_row[u] + step[v, heaviest, 0]
        c0 = parent_col[u] + step[v, heaviest, 1]
        sum_row = 0.0
        sum_col = 0.0
        total = 0.0
        for j in range(3):  # corners of the same run are blended
            u = parent_faces[face[v], j]
            dr = parent_row[u] + step[v, j, 0] - r0
            dc = parent_col[u] + step[v, j, 1] - c0
            if exemplar.toroidal:
                dr -= rows * np.floor(dr / rows + 0.5)
                dc -= cols * np.floor(dc / cols + 0.5)
            if abs(dr) <= 0.75 and abs(dc) <= 0.75:
                sum_row += weight[v, j] * dr
                sum_col += weight[v, j] * dc
                total += weight[v, j]
        r = 2.0 * (r0 + sum_row / total) + 0.5
        c = 2.0 * (c0 + sum_col / total) + 0.5
        if exemplar.toroidal:
            r = wrapped(r, exemplar.rows)
            c = wrapped(c, exemplar.cols)
        else:
            r = min(max(r, 0.0), exemplar.rows - 1.0)
            c = min(max(c, 0.0), exemplar.cols - 1.0)
        row[v] = r
        col[v] = c
        half = exemplar.fine.side // 2
        label[v] = exemplar.fine.labels[
            int(np.floor(r + 0.5)) + half, int(np.floor(c + 0.5)) + half
        ]
