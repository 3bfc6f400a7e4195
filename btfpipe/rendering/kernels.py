"""Compiled steps of the renderer, over the rays of one tile. Flat arrays in, given arrays filled."""

import numpy as np

from btfpipe.compiled import njit
from btfpipe.hashing import uniform

# Positions in single precision are less than this far off, as a fraction of a face's largest coordinate.
_ROUNDING = 4e-6
# A shadow ray to a point light ends this fraction before it: nothing that the lamp lies on blocks it.
_SHORTER = 1e-5


@njit(cache=True, nogil=True, inline="always")
def filter_offset(table, u):
    """Offset in a pixel where the film's filter has the integral u; see `camera.filter_table`."""
    last = len(table) - 1
    i = min(int(u * last), last - 1)
    return table[i] + (u * last - i) * (table[i + 1] - table[i])


@njit(cache=True, nogil=True, inline="always")
def film_ray(
    x, y, film_width, film_height, position, axes, extent, perspective, ray, origins, directions
):
    """Fill the origin and the direction of a ray through the place (x, y) of the film, in pixels."""
    right = (x / film_width * 2.0 - 1.0) * extent[0]
    up = (1.0 - y / film_height * 2.0) * extent[1]
    length = np.sqrt(1.0 + right * right + up * up)
    for k in range(3):
        if perspective:
            origins[ray, k] = position[k]
            directions[ray, k] = (axes[2, k] + right * axes[0, k] + up * axes[1, k]) / length
        else:
            origins[ray, k] = position[k] + right * axes[0, k] + up * axes[1, k]
            directions[ray, k] = axes[2, k]


@njit(cache=True, nogil=True, inline="always")
def face_edges(vertices, faces, f):
    """Edges u and v of face f from its first vertex, and u x v, as nine numbers."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ux = vertices[b, 0] - vertices[a, 0]
    uy = vertices[b, 1] - vertices[a, 1]
    uz = vertices[b, 2] - vertices[a, 2]
    vx = vertices[c, 0] - vertices[a, 0]
    vy = vertices[c, 1] - vertices[a, 1]
    vz = vertices[c, 2] - vertices[a, 2]
    return ux, uy, uz, vx, vy, vz, uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, nogil=True)
def camera_rays(
    x0, y0, width, height, film_width, film_height, rows, cols, table, seed,
    position, axes, extent, perspective, origins, directions,
):  # fmt: skip
    """Stratified rays of a rectangle of pixels, pixel by pixel: fills origins and directions (rays, 3) float64."""
    samples = rows * cols
    for y in range(height):
        for x in range(width):
            pixel = (y0 + y) * film_width + x0 + x
            for s in range(samples):
                ray = (y * width + x) * samples + s
                u = 0.5
                v = 0.5
                if samples > 1:
                    u = (s % cols + uniform(seed, pixel * samples + s, 0)) / cols
                    v = (s // cols + uniform(seed, pixel * samples + s, 1)) / rows
                film_ray(
                    x0 + x + 0.5 + filter_offset(table, u), y0 + y + 0.5 + filter_offset(table, v),
                    film_width, film_height, position, axes, extent, perspective,
                    ray, origins, directions,
                )  # fmt: skip


@njit(cache=True, nogil=True)
def _shadow_start(f, share, side, gx, gy, gz, vertices, faces, normals, point, start):
    """Fill `start` (3,): a point of face f moved onto the face's Phong surface, and off it by the rounding.

    Hanika 2021, Hacking the shadow terminator (Ray Tracing Gems II, chapter 4): the barycentric mean of the
    point's projections onto those tangent planes of the vertices that it lies below, as seen from the face's
    `side` (1 or -1), to which its unit normal g points. The offset of a point depends on its own face alone.
    """
    x, y, z = point[0], point[1], point[2]
    ox = 0.0
    oy = 0.0
    oz = 0.0
    largest = 0.0
    for k in range(3):
        i = faces[f, k]
        below = side * (
            (vertices[i, 0] - x) * normals[i, 0]
            + (vertices[i, 1] - y) * normals[i, 1]
            + (vertices[i, 2] - z) * normals[i, 2]
        )
        if below > 0.0:
            scale = share[k] * below * side
            ox += scale * normals[i, 0]
            oy += scale * normals[i, 1]
            oz += scale * normals[i, 2]
        for c in range(3):
            largest = max(largest, abs(vertices[i, c]))
    if ox * gx + oy * gy + oz * gz < 0.0:
        # normals that point to the face's other side describe no surface on this one
        ox, oy, oz = 0.0, 0.0, 0.0
    rounding = _ROUNDING * largest + 1e-30
    start[0] = x + ox + rounding * gx
    start[1] = y + oy + rounding * gy
    start[2] = z + oz + rounding * gz


@njit(cache=True, nogil=True)
def surface_points(
    hits, prim, origins, directions, vertices, faces, normals,
    share, point, start, normal, facing, depth,
):  # fmt: skip
    """What shading needs of each hit.

    Parameters
    ----------
    hits : (n,) int64
        Rays that hit.
    prim : (rays,) int32
        Face of each ray.
    share : (n, 3) float64
        Filled: barycentric coordinates, found again in double precision.
    point, start : (n, 3) float64
        Filled: the point, and where its shadow rays start (`_shadow_start`), so that a coarse face does not show
        where light grazes.
    normal : (n, 3) float64
        Filled: shading normal, towards the ray's side of the face.
    facing : (n,) float64
        Filled: 1, or -1 where the face is seen from behind.
    depth : (n,) float64
        Filled: distance along the ray.
    """
    for h in range(len(hits)):
        ray = hits[h]
        f = prim[ray]
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        ux, uy, uz, vx, vy, vz, gx, gy, gz = face_edges(vertices, faces, f)
        dx = directions[ray, 0]
        dy = directions[ray, 1]
        dz = directions[ray, 2]
        px = vertices[a, 0] - origins[ray, 0]
        py = vertices[a, 1] - origins[ray, 1]
        pz = vertices[a, 2] - origins[ray, 2]
        along = gx * dx + gy * dy + gz * dz
        rx = py * dz - pz * dy
        ry = pz * dx - px * dz
        rz = px * dy - py * dx
        v = 0.0
        w = 0.0
        if along != 0.0:
            # Moeller and Trumbore, signs folded in
            v = (rx * vx + ry * vy + rz * vz) / along
            w = -(rx * ux + ry * uy + rz * uz) / along
        v = min(max(v, 0.0), 1.0)
        w = min(max(w, 0.0), 1.0 - v)
        u = 1.0 - v - w
        share[h, 0] = u
        share[h, 1] = v
        share[h, 2] = w
        nx = u * normals[a, 0] + v * normals[b, 0] + w * normals[c, 0]
        ny = u * normals[a, 1] + v * normals[b, 1] + w * normals[c, 1]
        nz = u * normals[a, 2] + v * normals[b, 2] + w * normals[c, 2]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        area = np.sqrt(gx * gx + gy * gy + gz * gz)
        if area > 0.0:
            gx /= area
            gy /= area
            gz /= area
        if length < 1e-12:
            nx, ny, nz, length = gx, gy, gz, 1.0
        side = 1.0 if along < 0.0 else -1.0
        nx *= side / length
        ny *= side / length
        nz *= side / length
        gx *= side
        gy *= side
        gz *= side
        facing[h] = side
        normal[h, 0] = nx
        normal[h, 1] = ny
        normal[h, 2] = nz
        x = u * vertices[a, 0] + v * vertices[b, 0] + w * vertices[c, 0]
        y = u * vertices[a, 1] + v * vertices[b, 1] + w * vertices[c, 1]
        z = u * vertices[a, 2] + v * vertices[b, 2] + w * vertices[c, 2]
        point[h, 0] = x
        point[h, 1] = y
        point[h, 2] = z
        depth[h] = (
            (x - origins[ray, 0]) * dx + (y - origins[ray, 1]) * dy + (z - origins[ray, 2]) * dz
        )
        _shadow_start(f, share[h], side, gx, gy, gz, vertices, faces, normals, point[h], start[h])


@njit(cache=True, nogil=True)
def light_rays(
    directional, place, power, start, point, normal, w_i, irradiance, lit, origin, toward, far
):
    """Direction to the light (n, 3) and irradiance across it (n, 3) at each point, float64.

    Returns the number of points whose shading normal faces the light; `lit` (n,) int64 lists them, and origin (n, 3), direction
    `toward` (n, 3) and length `far` (n,) float32 of their shadow rays are filled in the same order.
    """
    count = 0
    for h in range(len(point)):
        x, y, z = place[0], place[1], place[2]
        falloff = 1.0
        length = 1.0
        if not directional:
            x -= point[h, 0]
            y -= point[h, 1]
            z -= point[h, 2]
            falloff = max(x * x + y * y + z * z, 1e-30)
            length = np.sqrt(falloff)
        w_i[h, 0] = x / length
        w_i[h, 1] = y / length
        w_i[h, 2] = z / length
        for c in range(3):
            irradiance[h, c] = power[c] / falloff
        if w_i[h, 0] * normal[h, 0] + w_i[h, 1] * normal[h, 1] + w_i[h, 2] * normal[h, 2] > 0.0:
            lit[count] = h
            away = 1e30
            if not directional:
                # from where the shadow ray starts, so that it ends at the lamp and not beside it
                x = place[0] - start[h, 0]
                y = place[1] - start[h, 1]
                z = place[2] - start[h, 2]
                length = max(np.sqrt(x * x + y * y + z * z), 1e-30)
                away = length * (1.0 - _SHORTER)
            origin[count, 0] = start[h, 0]
            origin[count, 1] = start[h, 1]
            origin[count, 2] = start[h, 2]
            toward[count, 0] = x / length
            toward[count, 1] = y / length
            toward[count, 2] = z / length
            far[count] = away
            count += 1
    return count


@njit(cache=True, nogil=True)
def cosine_rays(start, normal, chosen, items, rays, seed, origin, toward):
    """Rays spread by the cosine about the normals of some points, `rays` each: fills origin and toward (m, 3) float32.

    `items` (n,) int64 number the points for the random numbers; the rays of one are stratified by azimuth.
    """
    for q in range(len(chosen)):
        h = chosen[q]
        nx, ny, nz = normal[h, 0], normal[h, 1], normal[h, 2]
        # Duff et al. 2017: a frame about the normal without a branch
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        for k in range(rays):
            square = uniform(seed, items[q], 2 * k)
            azimuth = 2.0 * np.pi * (k + uniform(seed, items[q], 2 * k + 1)) / rays
            radius = np.sqrt(square)
            x, y, z = radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1.0 - square)
            ray = q * rays + k
            toward[ray, 0] = x * (1.0 + sign * nx * nx * a) + y * b + z * nx
            toward[ray, 1] = x * sign * b + y * (sign + ny * ny * a) + z * ny
            toward[ray, 2] = -x * sign * nx - y * ny + z * nz
            for c in range(3):
                origin[ray, c] = start[h, c]


@njit(cache=True, nogil=True)
def count_lookups(lit, face, weight, coherent):
    """How many texel coordinates `gather_lookups` will fill for the points `lit` of one object."""
    count = 0
    for q in range(len(lit)):
        f = face[lit[q]]
        for layer in range(len(coherent)):
            count += 1 if coherent[layer, f] else 3
    return count


@njit(cache=True, inline="always")
def _interpolated(layer, f, i, h, share, faces, row, col, rows, cols, toroidal):
    """Texel coordinate at point h of the coherent face f, from its vertex i; a toroidal sample is crossed the short way."""
    r = float(row[layer, i])
    s = float(col[layer, i])
    for e in range(3):
        j = faces[f, e]
        drow = row[layer, j] - row[layer, i]
        dcol = col[layer, j] - col[layer, i]
        if toroidal:
            drow -= np.round(drow / rows) * rows
            dcol -= np.round(dcol / cols) * cols
        r += share[h, e] * drow
        s += share[h, e] * dcol
    return r, s


@njit(cache=True, nogil=True)
def gather_lookups(
    lit, face, share, normal, facing, toward_eye, w_i, faces, row, col, weight, axis, coherent,
    rows, cols, toroidal, at_row, at_col, at_i, at_o, blend, target, corner,
):  # fmt: skip
    """List the texel coordinates, lights and views that the points `lit` of one dressed object need.

    Inside a coherent face one lookup at the interpolated coordinate, elsewhere one at each vertex.

    Parameters
    ----------
    lit : (m,) int64
        Points (indices of the arrays below).
    face : (n,) int64
        Face of the object.
    share, normal, facing, toward_eye, w_i : (n, 3), (n, 3), (n,), (n, 3), (n, 3) float64
        As `surface_points` fills them; directions in the scene's frame.
    faces, row, col, weight, axis, coherent
        The object's; see `Dressing`.
    at_row, at_col, at_i, at_o, blend, target, corner
        Filled in place: arguments of ``shade``, the share of each lookup, its point, and the corner of the face that it is of,
        or -1 between all three.

    Returns
    -------
    int
        Lookups filled in.
    """
    count = 0
    for q in range(len(lit)):
        h = lit[q]
        f = face[h]
        for layer in range(len(row)):
            one = coherent[layer, f]
            for k in range(1 if one else 3):
                i = faces[f, k]
                if one:
                    r, s = _interpolated(
                        layer, f, i, h, share, faces, row, col, rows, cols, toroidal
                    )
                    w = 0.0
                    x = 0.0
                    y = 0.0
                    z = 0.0
                    for e in range(3):
                        j = faces[f, e]
                        w += share[h, e] * weight[layer, j]
                        x += share[h, e] * axis[layer, j, 0]
                        y += share[h, e] * axis[layer, j, 1]
                        z += share[h, e] * axis[layer, j, 2]
                else:
                    w = share[h, k] * weight[layer, i]
                    r = float(row[layer, i])
                    s = float(col[layer, i])
                    x = axis[layer, i, 0]
                    y = axis[layer, i, 1]
                    z = axis[layer, i, 2]
                if w <= 0.0:
                    continue
                nx = normal[h, 0]
                ny = normal[h, 1]
                nz = normal[h, 2]
                across = x * nx + y * ny + z * nz
                x -= across * nx
                y -= across * ny
                z -= across * nz
                length = np.sqrt(x * x + y * y + z * z) + 1e-30
                x /= length
                y /= length
                z /= length
                # t = n x s on the face's front; behind it the frame is mirrored, so that s and t stay in place
                side = facing[h]
                tx = (ny * z - nz * y) * side
                ty = (nz * x - nx * z) * side
                tz = (nx * y - ny * x) * side
                at_row[count] = r
                at_col[count] = s
                at_i[count, 0] = w_i[h, 0] * x + w_i[h, 1] * y + w_i[h, 2] * z
                at_i[count, 1] = w_i[h, 0] * tx + w_i[h, 1] * ty + w_i[h, 2] * tz
                at_i[count, 2] = w_i[h, 0] * nx + w_i[h, 1] * ny + w_i[h, 2] * nz
                at_o[count, 0] = toward_eye[h, 0] * x + toward_eye[h, 1] * y + toward_eye[h, 2] * z
                at_o[count, 1] = (
                    toward_eye[h, 0] * tx + toward_eye[h, 1] * ty + toward_eye[h, 2] * tz
                )
                at_o[count, 2] = (
                    toward_eye[h, 0] * nx + toward_eye[h, 1] * ny + toward_eye[h, 2] * nz
                )
                blend[count] = w
                target[count] = h
                corner[count] = -1 if one else k
                count += 1
    return count


@njit(cache=True, nogil=True)
def add_lookups(values, blend, target, irradiance, radiance):
    """Add ``value * E / pi`` of each lookup to its point's radiance (n, 3) float64.

    Values below 0, where compression rings, count as 0; NaN stays.
    """
    for q in range(len(values)):
        h = target[q]
        for c in range(3):
            value = np.float32(0.0) if values[q, c] < 0 else values[q, c]
            radiance[h, c] += value * blend[q] * irradiance[h, c] / np.pi


@njit(cache=True, nogil=True)
def add_diffuse(lit, albedo, normal, w_i, irradiance, radiance):
    """Add a perfect diffuser's radiance at the points `lit`."""
    for q in range(len(lit)):
        h = lit[q]
        cosine = w_i[h, 0] * normal[h, 0] + w_i[h, 1] * normal[h, 1] + w_i[h, 2] * normal[h, 2]
        for c in range(3):
            radiance[h, c] += albedo[c] * cosine * irradiance[h, c] / np.pi


@njit(cache=True, nogil=True)
def texel_coordinates(
    points, face, share, faces, row, col, weight, coherent, rows, cols, wrap, texel
):
    """Sample coordinates (n, 2) of the heaviest layer at the points of one object, for the picture's layers."""
    for q in range(len(points)):
        h = points[q]
        f = face[h]
        near = 0
        for k in range(1, 3):
            if share[h, k] > share[h, near]:
                near = k
        i = faces[f, near]
        layer = 0
        for other in range(1, len(row)):
            if weight[other, i] > weight[layer, i]:
                layer = other
        if coherent[layer, f]:
            r, s = _interpolated(layer, f, i, h, share, faces, row, col, rows, cols, wrap)
        else:
            r = float(row[layer, i])
            s = float(col[layer, i])
        if wrap:
            r -= np.floor(r / rows) * rows
            s -= np.floor(s / cols) * cols
        texel[h, 0] = r
        texel[h, 1] = s


@njit(cache=True, nogil=True)
def resolve(hits, samples, radiance, depth, normal, texel, picture):
    """Gather rays into pixels (pixels, 10) float64: colour, coverage, depth, normal, texel.

    Colour is the mean of the rays' radiance, misses counting as black; depth and normal are means over the hits,
    the texel is the first hit's.
    """
    count = np.zeros(len(picture), np.int64)
    picture[:] = 0.0
    picture[:, 8] = -1.0
    picture[:, 9] = -1.0
    for h in range(len(hits)):
        p = hits[h] // samples
        for c in range(3):
            picture[p, c] += radiance[h, c]
            picture[p, 5 + c] += normal[h, c]
        picture[p, 4] += depth[h]
        if count[p] == 0:
            picture[p, 8] = texel[h, 0]
            picture[p, 9] = texel[h, 1]
        count[p] += 1
    for p in range(len(picture)):
        for c in range(3):
            picture[p, c] /= samples
        picture[p, 3] = count[p] / samples
        if count[p] > 0:
            picture[p, 4] /= count[p]
            length = np.sqrt(picture[p, 5] ** 2 + picture[p, 6] ** 2 + picture[p, 7] ** 2)
            for c in range(5, 8):
                picture[p, c] /= max(length, 1e-30)
