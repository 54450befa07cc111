"""Distances between two point clouds: chamfer and Hausdorff."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.user_arrays import read_vectors
from geokit.errors import InputError
from geokit.points.search.nearest import build_tree, nearest

if TYPE_CHECKING:
    import warp as wp

__all__ = ["ChamferDistance", "DirectedDistance", "HausdorffDistance", "chamfer", "hausdorff"]


class DirectedDistance(NamedTuple):
    """Distances from the points of one cloud to their nearest points in another [world].

    Attributes:
        max: Largest distance, at the point ``index_from``: the directed Hausdorff distance.
        mean: Mean distance.
        rms: Root mean square of the distances.
        index_from: Point of the first cloud whose distance is ``max``; the lowest index among ties.
        index_to: Its nearest point in the other cloud; the lowest index among ties.
    """

    max: float
    mean: float
    rms: float
    index_from: int
    index_to: int


class ChamferDistance(NamedTuple):
    """Mean distances between two clouds.

    Attributes:
        distance: Mean of the two directed means, ``(a_to_b.mean + b_to_a.mean) / 2`` [world].
        squared: Sum of the two directed mean squares, ``a_to_b.rms**2 + b_to_a.rms**2`` [world squared].
        a_to_b: From the points of the first cloud to the second.
        b_to_a: From the points of the second cloud to the first.
    """

    distance: float
    squared: float
    a_to_b: DirectedDistance
    b_to_a: DirectedDistance


class HausdorffDistance(NamedTuple):
    """Largest distances between two clouds; ``max``, ``mean`` and ``rms`` are those of the larger direction [world].

    Attributes:
        max: The Hausdorff distance, between ``index_a`` and ``index_b``.
        mean: The larger of the two directed means.
        rms: The larger of the two directed root mean squares.
        index_a: A point of the first cloud; either it or ``index_b`` is the nearest point of its cloud to the other
            one.
        index_b: A point of the second cloud.
        a_to_b: From the points of the first cloud to the second.
        b_to_a: From the points of the second cloud to the first.
    """

    max: float
    mean: float
    rms: float
    index_a: int
    index_b: int
    a_to_b: DirectedDistance
    b_to_a: DirectedDistance


def chamfer(a: Any, b: Any, *, device: Any = None) -> ChamferDistance:
    """Chamfer distance between two clouds: the mean distance of a point from the other cloud.

    Both common definitions are returned: ``distance`` is the mean of the two directed means of the distances,
    ``squared`` the sum of the two directed means of the squared distances. Each nearest distance is that of the float64
    coordinates, rounded term by term; the means have an error of a few roundings. The result is the same on every
    device and for any number of threads.

    Args:
        a: Positions of the first cloud [world], shape (N, 3), float32 or float64; at least one.
        b: Positions of the second cloud [world], shape (M, 3).
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        ChamferDistance with distance [world], squared [world squared], a_to_b and b_to_a.
    Raises:
        InputError: a or b is not (N, 3), not finite, or empty; there is no such device.
    Source:
        Barrow, Tenenbaum, Bolles, Wolf, "Parametric correspondence and chamfer matching" (1977); ``squared`` is that of
        Fan, Su, Guibas, "A point set generation network for 3D object reconstruction from a single image" (2017), with
        means for sums.
    Example:
        >>> distance = gk.points.chamfer([[0, 0, 0], [1, 0, 0]], [[0, 0, 2]], device="cpu")
        >>> distance.squared, distance.a_to_b.max, distance.b_to_a.mean
        (8.5, 2.23606797749979, 2.0)

    Held by: tests/points/test_compare.py
    """
    there, back = _directed(a, b, device)
    return ChamferDistance(
        distance=0.5 * (there.mean + back.mean), squared=there.rms**2 + back.rms**2, a_to_b=there, b_to_a=back
    )


def hausdorff(a: Any, b: Any, *, device: Any = None) -> HausdorffDistance:
    """Hausdorff distance between two clouds: the largest distance of a point of either cloud from the other cloud.

    Exact for the float64 coordinates, rounded term by term; the same on every device and for any number of threads.
    Among equally far points the lowest index is returned; between equal directions, that of ``a_to_b``. For surfaces
    see :func:`geokit.mesh.hausdorff`.

    Args:
        a: Positions of the first cloud [world], shape (N, 3), float32 or float64; at least one.
        b: Positions of the second cloud [world], shape (M, 3).
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        HausdorffDistance with max, mean and rms [world], index_a, index_b, a_to_b and b_to_a.
    Raises:
        InputError: a or b is not (N, 3), not finite, or empty; there is no such device.
    Example:
        >>> distance = gk.points.hausdorff([[0, 0, 0], [4, 0, 0]], [[0, 0, 0], [1, 0, 0]], device="cpu")
        >>> distance.max, distance.index_a, distance.index_b, distance.b_to_a.max
        (3.0, 1, 1, 1.0)

    Held by: tests/points/test_compare.py
    """
    there, back = _directed(a, b, device)
    forth = there.max >= back.max
    return HausdorffDistance(
        max=max(there.max, back.max),
        mean=max(there.mean, back.mean),
        rms=max(there.rms, back.rms),
        index_a=there.index_from if forth else back.index_to,
        index_b=there.index_to if forth else back.index_from,
        a_to_b=there,
        b_to_a=back,
    )


def _directed(a: Any, b: Any, device: Any) -> tuple[DirectedDistance, DirectedDistance]:
    target = launcher.resolve_device(device)
    clouds = [read_vectors(points, name, target).array for points, name in ((a, "a"), (b, "b"))]
    for points, name in zip(clouds, ("a", "b"), strict=True):
        if len(points) == 0:
            raise InputError(f"{name}: a cloud without points is not at any distance; give at least one")
    return _from(clouds[0], clouds[1]), _from(clouds[1], clouds[0])


def _from(points: "wp.array", others: "wp.array") -> DirectedDistance:
    distances, indices = nearest(build_tree(others), 1, points)
    distance: NDArray[np.float64] = distances.numpy().reshape(-1)
    # argmax returns the first of several equal values, hence the lowest index.
    index = int(distance.argmax())
    largest = float(distance[index])
    # Scale by the largest distance before squaring, so that squares neither overflow nor vanish.
    share = distance / largest if largest > 0.0 else distance
    return DirectedDistance(
        max=largest,
        mean=float(distance.mean()),
        rms=largest * float(np.sqrt(np.mean(share * share))),
        index_from=index,
        index_to=int(indices[index : index + 1].numpy().reshape(-1)[0]),
    )
