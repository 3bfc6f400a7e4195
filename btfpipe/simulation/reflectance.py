"""How one point reflects: a diffuse part under a GGX coat, as compiled functions.

Values are ``pi * f * cos(theta_i)``: relative to a perfect white diffuser lit at normal incidence. The diffuse part is
weakened by what the coat reflects on the way in and out, so nothing reflects more than it gets, and the whole is
reciprocal. References: Walter et al. 2007 (GGX), Heitz 2014 (height-correlated masking) and 2018 (visible normals),
Schlick 1994; the reflectance at grazing is min(1, 50 f0), so f0 = 0 is a plain Lambertian.
"""

import numpy as np

from btfpipe.compiled import njit


@njit(cache=True, inline="always")
def schlick(f0, cosine):
    """Fresnel reflectance at an angle from the one at normal incidence."""
    f90 = min(1.0, 50.0 * f0)
    x = 1.0 - cosine
    x2 = x * x
    return f0 + (f90 - f0) * x2 * x2 * x


@njit(cache=True, inline="always")
def average_fresnel(f0):
    """Mean of `schlick` over the hemisphere, weighted with the cosine."""
    return f0 + (min(1.0, 50.0 * f0) - f0) / 21.0


@njit(cache=True, inline="always")
def glossy(roughness, n_l, n_v, n_h):
    """Value of the coat without Fresnel: pi D G2 / (4 n_l n_v) n_l."""
    a2 = roughness * roughness
    a2 = a2 * a2
    d = n_h * n_h * (a2 - 1.0) + 1.0
    g = n_v * np.sqrt(a2 + (1.0 - a2) * n_l * n_l) + n_l * np.sqrt(a2 + (1.0 - a2) * n_v * n_v)
    return a2 / (d * d) * 0.5 / g * n_l


@njit(cache=True, inline="always")
def lobes(normal, f0, roughness, light, view):
    """What `reflect` needs apart from colour: n_l, n_v, l_h and the coat's value; n_l <= 0 means unlit."""
    n_l = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
    if n_l <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    n_v = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
    n_v = max(n_v, 1e-3)  # a shading normal may look away from an eye that sees the triangle
    if f0[0] + f0[1] + f0[2] <= 0.0:
        return n_l, n_v, 1.0, 0.0
    hx = light[0] + view[0]
    hy = light[1] + view[1]
    hz = light[2] + view[2]
    length = np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12
    n_h = (normal[0] * hx + normal[1] * hy + normal[2] * hz) / length
    l_h = (light[0] * hx + light[1] * hy + light[2] * hz) / length
    return n_l, n_v, l_h, glossy(roughness, n_l, n_v, max(n_h, 0.0))


@njit(cache=True, inline="always")
def reflect(albedo, f0, n_l, n_v, l_h, coat):
    """Value of one colour channel, the light's cosine inside."""
    through = (1.0 - schlick(f0, n_l)) * (1.0 - schlick(f0, n_v))
    return albedo * through * n_l + schlick(f0, l_h) * coat


@njit(cache=True, inline="always")
def visible_normal(view, roughness, u1, u2):
    """Draw a GGX half vector seen from `view` (x, y, z > 0), all in the frame of the normal."""
    a = roughness * roughness
    x = a * view[0]
    y = a * view[1]
    z = view[2]
    length = np.sqrt(x * x + y * y + z * z)
    x /= length
    y /= length
    z /= length
    across = np.sqrt(x * x + y * y)
    if across > 1e-7:
        t1x = -y / across
        t1y = x / across
    else:
        t1x = 1.0
        t1y = 0.0
    t2x = -z * t1y
    t2y = z * t1x
    t2z = x * t1y - y * t1x
    r = np.sqrt(u1)
    phi = 2.0 * np.pi * u2
    p1 = r * np.cos(phi)
    p2 = r * np.sin(phi)
    s = 0.5 * (1.0 + z)
    p2 = (1.0 - s) * np.sqrt(max(0.0, 1.0 - p1 * p1)) + s * p2
    p3 = np.sqrt(max(0.0, 1.0 - p1 * p1 - p2 * p2))
    hx = a * (p1 * t1x + p2 * t2x + p3 * x)
    hy = a * (p1 * t1y + p2 * t2y + p3 * y)
    hz = max(1e-6, p2 * t2z + p3 * z)
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    return hx / length, hy / length, hz / length


@njit(cache=True, inline="always")
def masking_ratio(roughness, n_l, n_v):
    """G2 / G1(view) of Smith's masking, height-correlated: the weight of a direction from `visible_normal`."""
    a2 = roughness * roughness
    a2 = a2 * a2
    lambda_l = 0.5 * (np.sqrt(1.0 + a2 * (1.0 / (n_l * n_l) - 1.0)) - 1.0)
    lambda_v = 0.5 * (np.sqrt(1.0 + a2 * (1.0 / (n_v * n_v) - 1.0)) - 1.0)
    return (1.0 + lambda_v) / (1.0 + lambda_v + lambda_l)


@njit(cache=True, inline="always")
def frame(nx, ny, nz):
    """Two unit vectors that make a right-handed frame with a unit normal (Duff et al. 2017)."""
    sign = 1.0 if nz >= 0.0 else -1.0
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny
