"""The best rigid step for paired points, from their sums: by distances from planes or between points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# A motion that changes the distances from the planes by less than a millionth of itself is undetermined; the
# eigenvalues are squares. Float64 sums leave about 1e-16 of canceled terms, data with six digits 1e-12.
FREE_EIGENVALUE = 1e-12
# Singular values of the pairs' products are squares of lengths too. Points are collinear or coincide if their width is
# less than a millionth of their extent.
FREE_SINGULAR_VALUE = 1e-12
# A motion is determined if it changes the distances from the planes by more than this many times what the normals'
# uncertainty explains, in squares. Free motions of spheres, planes, cylinders and tori have 0.5 to 2.6 of it.
NOISE_FACTOR = 3.0


class Step(NamedTuple):
    """A rotation about a center and the shift of the center.

    Attributes:
        rotation: Shape (3, 3).
        shift: Shift of the center [world], shape (3,).
        rank: Number of the six degrees of freedom that the pairs determine; the others are left unchanged.
    """

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    rank: int


def plane_step(sums: NDArray[np.float64], size: float) -> Step:
    """Gauss-Newton step for the squared distances from the partners' planes; of least norm if it is not unique.

    Args:
        sums: The 29 sums of plane_sums_kernel.
        size: The length [world] by which rotations are measured.
    """
    matrix = _symmetric(sums)
    values, vectors = np.linalg.eigh(matrix)
    determined = values > FREE_EIGENVALUE * max(float(values[-1]), float(sums[0]) * np.finfo(np.float64).tiny)
    along = vectors.T @ -sums[23:29]
    motion = vectors[:, determined] @ (along[determined] / values[determined])
    return Step(_rotation_by(motion[:3] / size), motion[3:], int(determined.sum()))


def plane_rank(sums: NDArray[np.float64], noise: NDArray[np.float64]) -> int:
    """Number of motions whose distances from the planes change by more than the normals' uncertainty explains.

    Args:
        sums: The 29 sums of plane_sums_kernel.
        noise: The same sums with directions in which the normals are uncertain, as long as that, in place of normals.
    """
    matrix = _symmetric(sums)
    least = FREE_EIGENVALUE * max(float(np.linalg.eigvalsh(matrix)[-1]), float(sums[0]) * np.finfo(np.float64).tiny)
    # As many eigenvalues are positive as there are independent motions with more than their noise.
    return int((np.linalg.eigvalsh(matrix - NOISE_FACTOR * _symmetric(noise)) > least).sum())


def point_step(sums: NDArray[np.float64]) -> Step:
    """Motion that minimizes the squared distances between paired points; never a reflection.

    Args:
        sums: The 17 sums of point_sums_kernel.
    """
    count = sums[0]
    mean, partner_mean = sums[2:5] / count, sums[5:8] / count
    product = sums[8:17].reshape(3, 3) - count * np.outer(mean, partner_mean)
    u, values, vt = np.linalg.svd(product)
    rank = 3
    if values[0] <= 0.0:
        rotation = np.eye(3)
    elif values[1] <= FREE_SINGULAR_VALUE * values[0]:
        rotation = _least_rotation(u[:, 0], vt[0])
        rank = 5
    else:
        flip = np.sign(np.linalg.det(u @ vt))
        rotation = vt.T @ np.diag([1.0, 1.0, flip]) @ u.T
        rank = 6
    return Step(rotation, partner_mean - rotation @ mean, rank)


def _symmetric(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = sums[2:23]
    return matrix + np.triu(matrix, 1).T


def orthonormal(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to a matrix that roundings have made slightly non-orthonormal."""
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt


def _rotation_by(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation about the vector by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sin(a) / a and (1 - cos(a)) / a^2, by np.sinc to be accurate at a = 0.
    sine, half = np.sinc(angle / np.pi), np.sinc(angle / (2.0 * np.pi))
    return np.eye(3) + sine * cross + 0.5 * half * half * (cross @ cross)


def _least_rotation(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation by the smallest angle from one unit vector to another."""
    axis = np.cross(start, end)
    sine, cosine = float(np.linalg.norm(axis)), float(start @ end)
    if sine > 0.0:
        return _rotation_by(axis * (np.arctan2(sine, cosine) / sine))
    if cosine > 0.0:
        return np.eye(3)
    # Half a turn about any perpendicular axis.
    across = np.eye(3)[np.argmin(np.abs(start))]
    across = across - start * (start @ across)
    return 2.0 * np.outer(across, across) / (across @ across) - np.eye(3)
