"""Compiled loops of :mod:`rille.stages.odometry.resection.pnp`: weighted errors, and Levenberg-Marquardt of many small
problems.

One problem's arithmetic does not depend on the others in its batch, and sums run in the order of the landmarks.
"""

from __future__ import annotations

import numpy as np
from numba import njit

UNKNOWNS = 7
"""Translation, rotation, and the error that all disparities share."""


@njit(cache=True, nogil=True)
def _observe(X, along, sigma_d, pixel, cam, sigma, nearest, R, t, bias, jacobian):  # type: ignore[no-untyped-def]
    """Whitened error (2) and Jacobian (2, 7) of one landmark, in ``jacobian`` (2, 8); its length, inf if behind."""
    fx, fy, cx, cy = cam
    a, b, c = X[0] + bias * along[0], X[1] + bias * along[1], X[2] + bias * along[2]
    x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
    y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
    z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
    if not z >= nearest:
        return np.inf
    u, v = x / z, y / z
    kx, ky = fx / z, fy / z
    wx = R[0, 0] * along[0] + R[0, 1] * along[1] + R[0, 2] * along[2]
    wy = R[1, 0] * along[0] + R[1, 1] * along[1] + R[1, 2] * along[2]
    wz = R[2, 0] * along[0] + R[2, 1] * along[1] + R[2, 2] * along[2]
    gu, gv = kx * (wx - u * wz), ky * (wy - v * wz)
    j = jacobian
    j[0, 0], j[0, 1], j[0, 2] = kx, 0.0, -kx * u
    j[1, 0], j[1, 1], j[1, 2] = 0.0, ky, -ky * v
    j[0, 3], j[0, 4], j[0, 5] = -kx * u * y, kx * (z + u * x), -kx * y
    j[1, 3], j[1, 4], j[1, 5] = -ky * (z + v * y), ky * v * x, ky * x
    j[0, 6], j[1, 6] = gu, gv
    j[0, 7], j[1, 7] = fx * u + cx - pixel[0], fy * v + cy - pixel[1]
    length2 = (gu * gu + gv * gv) * sigma_d * sigma_d
    if length2 > 0.0:
        size = np.sqrt(gu * gu + gv * gv)
        eu, ev = gu / size, gv / size
        shrink = 1.0 / sigma - 1.0 / np.sqrt(sigma * sigma + length2)
        for k in range(8):
            lost = shrink * (eu * j[0, k] + ev * j[1, k])
            j[0, k], j[1, k] = j[0, k] / sigma - eu * lost, j[1, k] / sigma - ev * lost
    else:
        for k in range(8):
            j[0, k], j[1, k] = j[0, k] / sigma, j[1, k] / sigma
    return np.sqrt(j[0, 7] ** 2 + j[1, 7] ** 2)


@njit(cache=True, nogil=True)
def _square(X, along, sigma_d, pixel, cam, sigma, nearest, R, t, bias):  # type: ignore[no-untyped-def]
    """Squared length of the whitened error of one landmark, inf if behind: ``e^T (sigma^2 I + g g^T)^-1 e``."""
    fx, fy, cx, cy = cam
    a, b, c = X[0] + bias * along[0], X[1] + bias * along[1], X[2] + bias * along[2]
    x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
    y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
    z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
    if not z >= nearest:
        return np.inf
    u, v = x / z, y / z
    wx = R[0, 0] * along[0] + R[0, 1] * along[1] + R[0, 2] * along[2]
    wy = R[1, 0] * along[0] + R[1, 1] * along[1] + R[1, 2] * along[2]
    wz = R[2, 0] * along[0] + R[2, 1] * along[1] + R[2, 2] * along[2]
    gu, gv = sigma_d * fx / z * (wx - u * wz), sigma_d * fy / z * (wy - v * wz)
    eu, ev = fx * u + cx - pixel[0], fy * v + cy - pixel[1]
    mixed = gu * eu + gv * ev
    return (eu * eu + ev * ev - mixed * mixed / (sigma * sigma + gu * gu + gv * gv)) / (sigma * sigma)


@njit(cache=True, nogil=True)
def norms(X, along, sigma_d, pixels, cam, sigma, nearest, R, t, bias, out):  # type: ignore[no-untyped-def]
    """Weighted error lengths ``out`` (b, n) at poses (b); observations of one problem serve all, or of each its own."""
    for b in range(len(out)):
        o = b if len(X) > 1 else 0
        for n in range(out.shape[1]):
            data = X[o, n], along[o, n], sigma_d[o, n], pixels[o, n]
            out[b, n] = np.sqrt(_square(*data, cam, sigma, nearest, R[b], t[b], bias[b]))


@njit(cache=True, nogil=True)
def _cost(X, along, sigma_d, pixels, cam, sigma, nearest, huber, prior, active, R, t, bias):  # type: ignore[no-untyped-def]
    """Huber's cost of the active landmarks and of the prior; infinite if one is behind the camera."""
    total = 0.5 * prior * bias * bias
    for n in range(len(active)):
        if active[n]:
            r = np.sqrt(_square(X[n], along[n], sigma_d[n], pixels[n], cam, sigma, nearest, R, t, bias))
            total += 0.5 * r * r if r <= huber else huber * r - 0.5 * huber * huber
    return total


@njit(cache=True, nogil=True)
def _normal(X, along, sigma_d, pixels, cam, sigma, nearest, huber, active, R, t, bias, jacobian, out, gradient):  # type: ignore[no-untyped-def]
    """Weighted normal matrix and gradient, without the prior."""
    out[:] = 0.0
    gradient[:] = 0.0
    for n in range(len(active)):
        if not active[n]:
            continue
        r = _observe(X[n], along[n], sigma_d[n], pixels[n], cam, sigma, nearest, R, t, bias, jacobian)
        if r == np.inf:
            continue
        w = huber / r if r > huber else 1.0
        for i in range(UNKNOWNS):
            a, b = w * jacobian[0, i], w * jacobian[1, i]
            for k in range(i, UNKNOWNS):
                out[i, k] += a * jacobian[0, k] + b * jacobian[1, k]
            gradient[i] += a * jacobian[0, 7] + b * jacobian[1, 7]
    for i in range(UNKNOWNS):
        for k in range(i):
            out[i, k] = out[k, i]


@njit(cache=True, nogil=True)
def _step(normal, gradient, damping, lower, step):  # type: ignore[no-untyped-def]
    """Damped step by Cholesky's factors; False where the matrix is not positive."""
    most = 0.0
    for i in range(UNKNOWNS):
        most = max(most, normal[i, i])
    floor = 1e-12 * most + 1e-300
    for i in range(UNKNOWNS):
        for k in range(i + 1):
            total = normal[i, k]
            if i == k:
                total += damping * normal[i, i] + floor
            for m in range(k):
                total -= lower[i, m] * lower[k, m]
            if i == k:
                if not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    for i in range(UNKNOWNS):
        total = -gradient[i]
        for m in range(i):
            total -= lower[i, m] * step[m]
        step[i] = total / lower[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        total = step[i]
        for m in range(i + 1, UNKNOWNS):
            total -= lower[m, i] * step[m]
        step[i] = total / lower[i, i]
    return True


@njit(cache=True, nogil=True)
def _moved(R, t, step, out_R, out_t):  # type: ignore[no-untyped-def]
    """Pose after a left perturbation: ``R <- exp(w) R, t <- exp(w) t + v``."""
    x, y, z = step[3], step[4], step[5]
    angle2 = x * x + y * y + z * z
    angle = np.sqrt(angle2)
    a, b = (1.0, 0.5) if angle < 1e-9 else (np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2)
    turn = np.empty((3, 3))
    turn[0, 0], turn[0, 1], turn[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    turn[1, 0], turn[1, 1], turn[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    turn[2, 0], turn[2, 1], turn[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for i in range(3):
        for k in range(3):
            out_R[i, k] = turn[i, 0] * R[0, k] + turn[i, 1] * R[1, k] + turn[i, 2] * R[2, k]
        out_t[i] = turn[i, 0] * t[0] + turn[i, 1] * t[1] + turn[i, 2] * t[2] + step[i]


@njit(cache=True, nogil=True)
def minimise(X, along, sigma_d, pixels, cam, sigma, nearest, huber, prior, active, iterations, tolerance, R, t, bias):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt of each problem, poses (b) in place; the greatest number of iterations that one took.

    A problem ends when its step promises to lower its cost by no more than ``tolerance`` of it. The damping is
    Marquardt's (scaled by the diagonal), which also holds a singular problem still instead of letting it fly off.
    """
    jacobian, normal = np.empty((2, UNKNOWNS + 1)), np.empty((UNKNOWNS, UNKNOWNS))
    lower, gradient, step = np.zeros((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    new_R, new_t = np.empty((3, 3)), np.empty(3)
    most = 0
    for b in range(len(R)):
        o = b if len(X) > 1 else 0
        data = (X[o], along[o], sigma_d[o], pixels[o], cam, sigma, nearest, huber)
        damping = 1e-4
        cost = _cost(*data, prior, active[b], R[b], t[b], bias[b])
        for done in range(iterations):
            most = max(most, done + 1)
            _normal(*data, active[b], R[b], t[b], bias[b], jacobian, normal, gradient)
            normal[6, 6] += prior
            gradient[6] += prior * bias[b]
            if not _step(normal, gradient, damping, lower, step):
                damping *= 10.0
                continue
            _moved(R[b], t[b], step, new_R, new_t)
            new_bias = bias[b] + step[6]
            new_cost = _cost(*data, prior, active[b], new_R, new_t, new_bias)
            promised = 0.0
            for k in range(UNKNOWNS):
                promised -= 0.5 * gradient[k] * step[k]
            finished = promised <= tolerance * (cost if cost < np.inf else 0.0) + 1e-20
            if new_cost < cost:
                R[b], t[b], bias[b] = new_R, new_t, new_bias
                cost = new_cost
                damping = max(damping * 0.1, 1e-12)
            else:
                damping *= 10.0
            if finished:
                break
    return most
