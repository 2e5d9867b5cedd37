"""Compiled loops of :mod:`rille.stages.odometry.resection.bundle_adjustment`: cost and normal equations of tracks, sums
in their order."""

from __future__ import annotations

import numpy as np
from numba import njit

NEAREST = 1e-6
"""Depth, metres, below which a landmark counts as behind the camera."""


@njit(cache=True, nogil=True)
def _observe(X, along, shift, pixel, cam, R, t, j):  # type: ignore[no-untyped-def]
    """Error, derivatives by the pose and by the depth of one landmark, pixels, in ``j`` (2, 8); False if behind."""
    fx, fy, cx, cy = cam
    a, b, c = X[0] + shift * along[0], X[1] + shift * along[1], X[2] + shift * along[2]
    x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
    y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
    z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
    if not z > NEAREST:
        return False
    u, v = x / z, y / z
    kx, ky = fx / z, fy / z
    wx = R[0, 0] * along[0] + R[0, 1] * along[1] + R[0, 2] * along[2]
    wy = R[1, 0] * along[0] + R[1, 1] * along[1] + R[1, 2] * along[2]
    wz = R[2, 0] * along[0] + R[2, 1] * along[1] + R[2, 2] * along[2]
    j[0, 0], j[0, 1], j[0, 2] = kx, 0.0, -kx * u
    j[1, 0], j[1, 1], j[1, 2] = 0.0, ky, -ky * v
    j[0, 3], j[0, 4], j[0, 5] = -kx * u * y, kx * (z + u * x), -kx * y
    j[1, 3], j[1, 4], j[1, 5] = -ky * (z + v * y), ky * v * x, ky * x
    j[0, 6], j[1, 6] = kx * (wx - u * wz), ky * (wy - v * wz)
    j[0, 7], j[1, 7] = fx * u + cx - pixel[0], fy * v + cy - pixel[1]
    return True


@njit(cache=True, nogil=True)
def cost(X, along, pixels, seen, cam, sigma, huber, R, t, shift):  # type: ignore[no-untyped-def]
    """Huber's cost of tracks ``pixels`` (frame, n, 2) where ``seen``, of landmarks moved by ``shift`` (n,) pixels."""
    j = np.empty((2, 8))
    total = 0.0
    for f in range(len(R)):
        for n in range(len(X)):
            if seen[f, n] and _observe(X[n], along[n], shift[n], pixels[f, n], cam, R[f], t[f], j):
                r = np.sqrt(j[0, 7] ** 2 + j[1, 7] ** 2) / sigma
                total += 0.5 * r * r if r <= huber else huber * r - 0.5 * huber * huber
    return total


@njit(cache=True, nogil=True)
def normal(X, along, pixels, seen, cam, sigma, huber, R, t, shift, A, B, d, ga, gd):  # type: ignore[no-untyped-def]
    """Adds the tracks' part of the normal equations: ``A`` (p, p), ``B`` (p, n), ``d`` (n,), gradients (p,), (n,).

    p is six a frame, ``v, w`` of its pose, and last the shift that all landmarks share.
    """
    j, last = np.empty((2, 8)), len(A) - 1
    for f in range(len(R)):
        at = 6 * f
        for n in range(len(X)):
            if not (seen[f, n] and _observe(X[n], along[n], shift[n], pixels[f, n], cam, R[f], t[f], j)):
                continue
            r = np.sqrt(j[0, 7] ** 2 + j[1, 7] ** 2) / sigma
            weight = (huber / r if r > huber else 1.0) / (sigma * sigma)
            for i in range(6):
                p, q = weight * j[0, i], weight * j[1, i]
                for k in range(i + 1):
                    A[at + i, at + k] += p * j[0, k] + q * j[1, k]
                B[at + i, n] += p * j[0, 6] + q * j[1, 6]
                ga[at + i] += p * j[0, 7] + q * j[1, 7]
            square = weight * (j[0, 6] * j[0, 6] + j[1, 6] * j[1, 6])
            slope = weight * (j[0, 6] * j[0, 7] + j[1, 6] * j[1, 7])
            d[n] += square
            gd[n] += slope
            B[last, n] += square
            ga[last] += slope
    for n in range(len(X)):
        A[last, last] += B[last, n]
        for i in range(last):
            A[last, i] += B[i, n]
    for i in range(last + 1):
        for k in range(i):
            A[k, i] = A[i, k]
