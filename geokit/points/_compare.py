"""Distances between two point clouds: chamfer and Hausdorff."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.gradients.differentiable import library_of
from geokit.core.gradients.rules import is_on_tape, is_tracked
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.interop.user_arrays import read_vectors
from geokit.core.memory.needs import needs, rows
from geokit.core.query.ask import query
from geokit.core.require import described
from geokit.errors import InputError
from geokit.points.search.groups import read_offsets
from geokit.points.search.nearest import nearest
from geokit.points.search.nearest_tree import build_tree


class DirectedDistance(NamedTuple):
    """Distances from the points of one cloud to their nearest points in another [world].

    Of groups each is an array (G,), and indices count all points.

    Attributes:
        max: Largest distance, at the point ``index_from``: the directed Hausdorff distance.
        mean: Mean distance.
        rms: Root mean square of the distances.
        index_from: Point of the first cloud whose distance is ``max``; the lowest index among ties.
        index_to: Its nearest point in the other cloud; the lowest index among ties.
    """

    max: Array
    mean: Array
    rms: Array
    index_from: Array
    index_to: Array


class ChamferDistance(NamedTuple):
    """Mean distances between two clouds. Of groups ``distance`` and ``squared`` are arrays (G,).

    Attributes:
        distance: Mean of the two directed means, ``(a_to_b.mean + b_to_a.mean) / 2`` [world].
        squared: Sum of the two directed mean squares, ``a_to_b.rms**2 + b_to_a.rms**2`` [world squared].
        a_to_b: From the points of the first cloud to the second.
        b_to_a: From the points of the second cloud to the first.
    """

    distance: Array
    squared: Array
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


@needs(lambda a, b, **_: 48 * (rows(a) + rows(b)))
def chamfer(a: Rows, b: Rows, *, groups: Rows | None = None, device: Device = None) -> ChamferDistance:
    """Chamfer distance between two clouds: the mean distance of a point from the other cloud.

    Both common definitions are returned: ``distance`` is the mean of the two directed means of the distances,
    ``squared`` the sum of the two directed means of the squared distances. Each nearest distance is that of the float64
    coordinates, rounded term by term; the means have an error of a few roundings. The result is the same on every
    device and for any number of threads.

    Args:
        a: Positions of the first cloud [world], shape (N, 3), float32 or float64; at least one.
        b: Positions of the second cloud [world], shape (M, 3).
        groups: For the distances of G pairs of clouds in one call: the offsets of the clouds in a and those in b, each
            (G + 1,); cloud g of a is the rows ``groups[0][g] .. groups[0][g + 1] - 1``. None for one pair.
        device: Where to compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        ChamferDistance with distance [world], squared [world squared], a_to_b and b_to_a. With groups their numbers are
        arrays (G,) in the container of a (float32 for float32), with the bits of a call for each pair.
    Raises:
        InputError: a or b is not (N, 3), not finite, or empty; groups are not two arrays of offsets, as many in both;
            one of the clouds is empty; there is no such device.
    Source:
        Barrow, Tenenbaum, Bolles, Wolf, "Parametric correspondence and chamfer matching" (1977); ``squared`` is that of
        Fan, Su, Guibas, "A point set generation network for 3D object reconstruction from a single image" (2017), with
        means for sums.
    Example:
        >>> distance = gk.points.chamfer([[0, 0, 0], [1, 0, 0]], [[0, 0, 2]], device="cpu")
        >>> distance.squared, distance.a_to_b.max, distance.b_to_a.mean
        (8.5, 2.23606797749979, 2.0)
        >>> a, b, each = [[0, 0, 0], [1, 0, 0]], [[0, 0, 2], [1, 0, 3]], [0, 1, 2]
        >>> gk.points.chamfer(a, b, groups=(each, each), device="cpu").distance.tolist()
        [2.0, 3.0]
    """
    if groups is not None:
        return _chamfer_of_groups(a, b, groups, device)
    found: ChamferDistance = _compared(a, b, device, _chamfer_of, _pull_chamfer)
    return found


@needs(lambda a, b, **_: 48 * (rows(a) + rows(b)))
def hausdorff(a: Rows, b: Rows, *, device: Device = None) -> HausdorffDistance:
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
    """
    found: HausdorffDistance = _compared(a, b, device, _hausdorff_of, _pull_hausdorff)
    return found


def _hausdorff_of(there: Any, back: Any) -> HausdorffDistance:
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


def _pull_hausdorff(slopes: list[Any], ways: list[DirectedDistance]) -> list[tuple[Any, ...]]:
    there, back = ways
    larger = [there[part] >= back[part] for part in range(3)]
    return [tuple(slopes[part] * (larger[part] == forth) for part in range(3)) for forth in (True, False)]


def _compared(a: Any, b: Any, device: Any, of: Callable[..., Any], pull: Callable[..., Any]) -> Any:
    """What ``of`` makes of the distances from each cloud to the other."""
    if not is_on_tape(a) and not is_on_tape(b):
        return of(*_directed(a, b, device))
    found = _between(a, b, device)
    return _on_tape(found, [_whole(found.a_to_b), _whole(found.b_to_a)], of, pull)


def _on_tape(found: Any, offsets: Sequence[NDArray[np.int64]], of: Callable[..., Any], pull: Callable[..., Any]) -> Any:
    """What ``of`` makes of distances on a tape, as arrays of a number for each group.

    ``pull(slopes, ways)`` gives the slopes of maximum, mean and root mean square of both ways, from those of the
    numbers of both together.
    """
    from geokit.core.gradients import on_tape

    half = len(found) // 2
    arrays, indices = [found[0], found[half]], [found[1], found[half + 1]]
    distances = [array.numpy().astype(np.float64, copy=False) for array in arrays]
    measured = [_measured(*one) for one in zip(distances, offsets, "ab", strict=True)]
    ways = [DirectedDistance(*one, index.numpy()[one[3]]) for one, index in zip(measured, indices, strict=True)]
    *numbers, _, _ = answer = of(*ways)

    def given(values: NDArray[Any]) -> Any:
        kind = arrays[0].dtype if values.dtype.kind == "f" else wp.int32
        return wp.array(values, dtype=kind, device=arrays[0].device)

    def back(slopes: list[Any]) -> list[NDArray[np.float64]]:
        known = [0.0 if slope is None else slope.numpy().astype(np.float64) for slope in slopes]
        alone, shared = (known[-10:-5], known[-5:]), pull(known[:-10], ways)
        result = []
        for number, (way, own) in enumerate(zip(ways, offsets, strict=True)):
            of_max, of_mean, of_rms = (alone[number][part] + shared[number][part] for part in range(3))
            sizes = np.diff(own)
            # A root has no slope at 0.
            share = of_rms / (sizes * np.where(way.rms > 0.0, way.rms, 1.0))
            result.append(np.repeat(of_mean / sizes, sizes) + distances[number] * np.repeat(share, sizes))
            result[number][way.index_from] += of_max
        return result

    outputs = [given(values) for values in (*numbers, *ways[0], *ways[1])]
    has_slope = [out.dtype != wp.int32 for out in outputs]
    on_tape.record(arrays, outputs, has_slope, back, "points")
    return type(answer)(*outputs[:-10], DirectedDistance(*outputs[-10:-5]), DirectedDistance(*outputs[-5:]))


def _directed(a: Any, b: Any, device: Any) -> tuple[DirectedDistance, DirectedDistance]:
    if is_tracked(a) or is_tracked(b):
        found = _between(a, b, device)
        return _summed(found.a_to_b, found.index_b), _summed(found.b_to_a, found.index_a)
    clouds = [batch.array for batch in _clouds(a, b, device)]
    return _from(clouds[0], clouds[1], "a"), _from(clouds[1], clouds[0], "b")


def _clouds(a: Any, b: Any, device: Any) -> list[Any]:
    target = launcher.resolve_device(device)
    batches = [read_vectors(points, name, target) for points, name in ((a, "a"), (b, "b"))]
    for batch, name in zip(batches, "ab", strict=True):
        if len(batch) == 0:
            raise InputError(f"{name}: a cloud without points is not at any distance; give at least one")
    return batches


def _chamfer_of_groups(a: Any, b: Any, groups: Any, device: Any) -> ChamferDistance:
    if not isinstance(groups, (tuple, list)) or len(groups) != 2:
        raise InputError(f"groups: {described(groups)} is not a pair; give the offsets of a and those of b")
    target = launcher.resolve_device(device)
    tracked = is_tracked(a) or is_tracked(b)
    batches = [] if tracked else [read_vectors(points, name, target) for points, name in ((a, "a"), (b, "b"))]
    sizes = [rows(a), rows(b)] if tracked else [len(batch) for batch in batches]
    first, second = (read_offsets(groups[i], sizes[i], f"rows of {'ab'[i]}", f"groups[{i}]") for i in range(2))
    if len(first) != len(second) or len(first) == 1:
        raise InputError(f"groups: {len(first) - 1} clouds in a and {len(second) - 1} in b; give as many, at least one")
    for name, offsets in (("a", first), ("b", second)):
        if not np.diff(offsets).all():
            number = int(np.argmin(np.diff(offsets)))
            raise InputError(f"{name}: cloud {number} has no points, so it is not at any distance; leave the pair out")
    if tracked:
        found = _between_groups(a, b, (first, second), device)

        if is_on_tape(a) or is_on_tape(b):
            answer: ChamferDistance = _on_tape(found, (first, second), _chamfer_of, _pull_chamfer)
            return answer
        library = library_of(found.a_to_b)
        return _chamfer_of(
            _summed_groups(library, *found[:3], first),
            _summed_groups(library, *found[3:], second),
        )
    there = _from_groups(batches[0].array, batches[1].array, first, second, "a")
    back = _from_groups(batches[1].array, batches[0].array, second, first, "b")
    chamfer_of = _chamfer_of(there, back)

    def given(values: Any) -> Any:
        kind = wp.float64 if values.dtype == np.float64 else wp.int32
        return batches[0].to_caller(wp.array(values, dtype=kind, device=target))

    directed = (DirectedDistance(*map(given, one)) for one in (there, back))
    return ChamferDistance(given(chamfer_of.distance), given(chamfer_of.squared), *directed)


def _chamfer_of(there: DirectedDistance, back: DirectedDistance) -> ChamferDistance:
    squared = there.rms * there.rms + back.rms * back.rms
    return ChamferDistance(distance=0.5 * (there.mean + back.mean), squared=squared, a_to_b=there, b_to_a=back)


def _pull_chamfer(slopes: list[Any], ways: list[DirectedDistance]) -> list[tuple[Any, ...]]:
    return [(0.0, 0.5 * slopes[0], 2.0 * slopes[1] * way.rms) for way in ways]


class _BetweenGroups(NamedTuple):
    """As _Between, with the point of each group that is farthest from the other cloud."""

    a_to_b: Any
    index_b: Any
    far_a: Any
    b_to_a: Any
    index_a: Any
    far_b: Any


@query(inputs=("a", "b"), gradient=".gradients.distances:BETWEEN_GROUPS", name="a, b")
def _between_groups(a: Any, b: Any, offsets: Any, device: Any) -> _BetweenGroups:
    target = launcher.resolve_device(device)
    batches = [read_vectors(points, name, target) for points, name in ((a, "a"), (b, "b"))]
    found: list[Any] = []
    for asked, other, pair in zip(batches, batches[::-1], (offsets, offsets[::-1]), strict=True):
        distance, index = nearest(build_tree(other.array, pair[1]), 1, asked.array, groups=(pair[1], pair[0]))
        far = _by_size(distance.numpy().reshape(-1), pair[0], lambda table: table.argmax(axis=1)) + pair[0][:-1]
        numbers = wp.array(far, dtype=wp.int32, device=target)
        found += [asked.to_caller(out) for out in (distance.flatten(), index.flatten(), numbers)]
    return _BetweenGroups(*found)


def _summed_groups(library: Any, distance: Any, index: Any, far: Any, offsets: NDArray[np.int64]) -> DirectedDistance:
    """Tensors of one number for each group."""
    sizes = np.diff(offsets)
    group = library.constant(np.repeat(np.arange(len(sizes)), sizes), distance)
    count = library.constant(sizes.astype(np.float64), distance)

    def mean(values: Any) -> Any:
        return library.add(values, group, len(sizes)) / count

    square = mean(distance * distance)
    # A root has no slope at 0.
    rms = (square + (square == 0.0)) ** 0.5 * (square > 0.0)
    at = library.whole(far)
    return DirectedDistance(library.take(distance, at), mean(distance), rms, far, index[at])


def _by_size(values: NDArray[Any], offsets: NDArray[np.int64], reduce: Any) -> NDArray[Any]:
    """``reduce`` of the values of each group, applied to tables (R, n) of the R groups of n values.

    NumPy sums a row of a table as it sums the same values alone.
    """
    sizes = np.diff(offsets)
    if len(sizes) == 1:
        return reduce(values[None])
    parts = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    found = [reduce(values[offsets[part][:, None] + np.arange(sizes[part[0]])]) for part in parts]
    return np.concatenate(found)[np.argsort(np.concatenate(parts))]


def _from_groups(
    points: "wp.array", others: "wp.array", own: NDArray[np.int64], theirs: NDArray[np.int64], name: str
) -> DirectedDistance:
    distances, indices = nearest(build_tree(others, theirs), 1, points, groups=(theirs, own))
    measured = _measured(distances.numpy().reshape(-1), own, name)
    return DirectedDistance(*measured, indices.numpy().reshape(-1)[measured[3]])


def _measured(distances: NDArray[np.float64], own: NDArray[np.int64], name: str) -> tuple[Any, Any, Any, Any]:
    """Maximum, mean, root mean square and farthest point of each group, whose distances ``own`` divides."""

    def measures(table: NDArray[np.float64]) -> NDArray[np.float64]:
        # argmax returns the first of several equal values, hence the lowest index.
        index = table.argmax(axis=1)
        # Scale by the largest distance before squaring, so that squares neither overflow nor vanish.
        largest = table[np.arange(len(table)), index]
        share = table / np.where(largest > 0.0, largest, 1.0)[:, None]
        rms = largest * np.sqrt(np.mean(share * share, axis=1))
        return np.stack([largest, table.mean(axis=1), rms, index], axis=1)

    with np.errstate(invalid="ignore"):
        found = _by_size(distances, own, measures)
    far = found[:, 3].astype(np.int64) + own[:-1]
    if (found[:, 0] == np.inf).any():
        row = int(far[np.argmax(found[:, 0])])
        raise InputError(f"{name}: row {row} is so far away that its squared distance is not a float64; scale both")
    largest, mean, rms, _ = np.ascontiguousarray(found.T)
    return largest, mean, rms, far.astype(np.int32)


class _Between(NamedTuple):
    """Distance of each point of a cloud to the other cloud, and the index of the point there."""

    a_to_b: Any
    index_b: Any
    b_to_a: Any
    index_a: Any


@query(inputs=("a", "b"), gradient=".gradients.distances:BETWEEN", name="a, b")
def _between(a: Any, b: Any, device: Any) -> _Between:
    batches = _clouds(a, b, device)
    found: list[Any] = []
    for asked, other in (batches, batches[::-1]):
        distance, index = nearest(build_tree(other.array), 1, asked.array)
        found += [asked.to_caller(distance.flatten()), asked.to_caller(index.flatten())]
    return _Between(*found)


def _summed(distance: Any, index: Any) -> DirectedDistance:
    """Tensors of one number each."""
    number = distance.argmax()
    square = (distance * distance).mean()
    # A root has no slope at 0.
    rms = (square + (square == 0.0)) ** 0.5 * (square > 0.0)
    return DirectedDistance(distance[number], distance.mean(), rms, number, index[number])


def _from(points: "wp.array", others: "wp.array", name: str) -> DirectedDistance:
    distances, indices = nearest(build_tree(others), 1, points)
    measured = _measured(distances.numpy().reshape(-1), _whole(points), name)
    index = int(measured[3][0])
    numbers: Any = (*measured, indices[index : index + 1].numpy().reshape(-1))
    return DirectedDistance(*(part.item() for part in numbers))


def _whole(points: Any) -> NDArray[np.int64]:
    """The offsets of one group."""
    return np.array([0, len(points)])
