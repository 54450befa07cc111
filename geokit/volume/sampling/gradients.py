"""Derivatives of samples, gradients and hits of a volume, with respect to points, rays and active values.

With respect to points these are the exact derivatives of the interpolant, which geokit computes anyway: the derivative
of a sample is the gradient, that of a gradient the Hessian. With respect to values they are the weights of the voxels
around a point. Inactive voxels, tiles and the background are constants.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.gradients.library import Library, dot
from geokit.core.gradients.rules import Asked, Rule, is_torch_tensor, untracked
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import set_bits
from geokit.volume.nanovdb.types import COMPONENTS
from geokit.volume.sampling.kernel_table import query_kernel
from geokit.volume.sampling.leaf_table import made_table
from geokit.volume.sampling.space import SPACES, world_to_index
from geokit.volume.sampling.trilinear_table import sample_and_slopes
from geokit.volume.tree.leaves import assemble, leaves_of

# First voxel of the stencil of each order, from the voxel below the point.
BEGIN = {1: 0, 2: -1, 3: -1}


def _weights(library: Library, order: int, t: Any) -> tuple[Any, Any]:
    """Weights (..., S) of the voxels of a stencil along an axis for points at t in [0, 1), and their slopes."""
    if order == 1:
        weights, slopes = [1.0 - t, t], [t * 0.0 - 1.0, t * 0.0 + 1.0]
    elif order == 2:
        weights = [0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)]
        slopes = [t - 0.5, -2.0 * t, t + 0.5]
    else:
        weights = [
            0.5 * t * ((2.0 - t) * t - 1.0),
            0.5 * (t * t * (3.0 * t - 5.0) + 2.0),
            0.5 * t * ((4.0 - 3.0 * t) * t + 1.0),
            0.5 * t * t * (t - 1.0),
        ]
        slopes = [
            0.5 * ((4.0 - 3.0 * t) * t - 1.0),
            0.5 * t * (9.0 * t - 10.0),
            0.5 * ((8.0 - 9.0 * t) * t + 1.0),
            0.5 * t * (3.0 * t - 2.0),
        ]
    return library.stack(weights, -1), library.stack(slopes, -1)


def _numbers(volume: SparseVolume) -> SparseVolume:
    """The same leaves, whose active voxels hold 1 plus their row in ``active_voxels``; elsewhere 0."""
    volume = getattr(volume, "template", volume)  # of geokit.jax.Volume

    def make() -> SparseVolume:
        leaves = leaves_of(volume)
        node, slot = set_bits(leaves.masks)
        values = np.zeros((len(leaves.origins), 512))
        values[node, slot] = np.arange(1, len(node) + 1)
        return assemble(leaves, values, volume, transform=np.eye(4))

    return volume._cache.find("numbers of values", make)


class _Stencil:
    """The voxels around points: rows of their active values, and their weights along each axis."""

    def __init__(self, library: Library, volume: SparseVolume, points: Any, order: int, space: str) -> None:
        self.library, self.space = library, space
        place = library.wide(points)
        self.matrix = library.constant(np.linalg.inv(volume.info.transform[:3, :3]), points)
        if space == "world":
            place = (place - library.constant(volume.info.transform[:3, 3].copy(), points)) @ self.matrix.T
        base = library.floor(library.detach(place))
        self.voxels = (base[:, None] + library.constant(_steps(order), points)).reshape(-1, 3)
        self.axes = [_weights(library, order, (place - base)[:, axis]) for axis in range(3)]

    def read(self, volume: SparseVolume, device: Any) -> Any:
        """Values (N, S^3) of the voxels in a volume."""
        values = untracked(volume).sample(self.voxels, order=0, space="index", device=device)
        return values.reshape(len(self.axes[0][0]), -1)

    def products(self, *slopes: int) -> Any:
        """Weight of each voxel (N, S^3); along the axes ``slopes`` the slope of the weight."""
        x, y, z = (pair[1 if axis in slopes else 0] for axis, pair in enumerate(self.axes))
        return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(len(x), -1)

    def add(self, shares: Any, volume: SparseVolume, count: int, device: Any) -> Any:
        """Sums (count,) of shares (N, S^3) by the active value that they belong to."""
        rows = self.library.whole(self.read(_numbers(volume), device))
        # Row 0 gathers what belongs to constants.
        return self.library.add(shares.reshape(-1), rows.reshape(-1), count + 1)[1:]


def _steps(order: int) -> NDArray[np.float64]:
    one = np.arange(BEGIN[order], BEGIN[order] + order + 1, dtype=np.float64)
    return np.stack(np.meshgrid(one, one, one, indexing="ij"), axis=-1).reshape(-1, 3)


def _order(asked: Asked) -> int:
    volume, order = asked.arguments["volume"], asked.arguments["order"]
    order = int((volume.info.order or 1) if order is None else order)
    if order == 0:
        raise InputError("order: samples of order 0 are constant around voxels; take order 1, 2 or 3 for gradients")
    return order


def _check_gradient(asked: Asked) -> None:
    _order(asked)
    components = COMPONENTS.get(asked.arguments["volume"].info.grid_type, 1)
    if components > 1 or asked.arguments["channel"] is not None:
        raise InputError("points: second derivatives are known for scalar grids without channels; detach the points")


def _pull_sample(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    (slope,), order, points = slopes, _order(asked), asked.tensors["points"]
    volume, space, device = (asked.arguments[name] for name in ("volume", "space", "device"))
    along = volume.gradient(points, order=order, space=space, channel=asked.arguments["channel"], device=device)
    found = {"points": slope[:, None] * along if slope.ndim == 1 else (slope[:, :, None] * along).sum(1)}
    if "values" in asked.tensors:
        stencil = _Stencil(library, volume, points, order, space)
        shares = library.wide(slope)[:, None] * stencil.products()
        found["values"] = stencil.add(shares, volume, len(asked.tensors["values"]), device)
    return found


def _is_quick_alone(points: Any) -> bool:
    """Whether samples alone are clearly faster: on a CPU, where a gradient costs as much as a sample."""
    return bool(points.is_cpu)


def _sample_at_once(asked: Asked) -> Any:
    """Samples of order 1 together with their gradients, which cost little beside them on a GPU."""
    volume, space, points = asked.arguments["volume"], asked.arguments["space"], asked.tensors["points"]
    if len(asked.tensors) > 1 or _is_quick_alone(points) or points.ndim != 2 or 0 in points.shape[:1]:
        return None
    if points.shape[1] != 3 or asked.arguments["channel"] is not None or _order(asked) != 1 or space not in SPACES:
        return None
    from geokit.core.gradients.tensor_rows import device_of

    device = launcher.resolve_device(asked.arguments["device"])
    found = sample_and_slopes(volume, points, space, device) if device == device_of(points) else None
    return found and ((found[0],), found[1])


def _sample_adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """The derivatives of samples by points where they are."""
    points, (slope,) = asked.tensors["points"], slopes
    if wanted != ["points"] or slope is None:
        return None
    if is_torch_tensor(points):
        along = _slopes_of_tensors(asked, arrays)
    else:
        options = {name: asked.arguments[name] for name in ("space", "channel", "device")}
        along = asked.arguments["volume"].gradient(points, order=_order(asked), **options)
    if along is None:
        return None
    from geokit.volume.sampling.sample_slopes_kernels import SAMPLE_SLOPES

    count, out = len(points), arrays.made(len(points), 3)
    by, vectors = arrays.given(slope), arrays.given(along, 3)
    arrays.launch(SAMPLE_SLOPES[arrays.number], count, [len(by) // count, by, vectors], [out])
    return {"points": out}


def _slopes_of_tensors(asked: Asked, arrays: Any) -> Any:
    """Gradients at tensors on a GPU, of scalar grids, which the query itself has checked; None for others."""
    volume, space, points = (asked.arguments["volume"], asked.arguments["space"], asked.tensors["points"])
    is_scalar = asked.arguments["channel"] is None and COMPONENTS.get(volume.info.grid_type) == 1
    order, device = _order(asked), launcher.resolve_device(asked.arguments["device"])
    if _is_quick_alone(points) or not is_scalar or device != arrays.device:
        return None
    if order == 1 and made_table(volume, device) is not None:
        return None
    from geokit.core.gradients.tensor_rows import TensorRows, launch

    rows = points.double()
    along = rows.new_empty((len(rows), 1, 3))
    kernel, _ = query_kernel("gradient", order, 1, False)
    inputs = [wp.uint64(volume.id(device)), TensorRows(rows), *world_to_index(volume, space), wp.float64(0.0)]
    launch(kernel, len(rows), inputs, [wp.from_torch(along)], device)
    return along.to(points.dtype)


def _pull_gradient(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    _check_gradient(asked)
    (slope,), order, points = slopes, _order(asked), asked.tensors["points"]
    volume, space, device = (asked.arguments[name] for name in ("volume", "space", "device"))
    stencil = _Stencil(library, volume, points, order, space)
    if order == 1:
        second = _mixed(library, stencil, stencil.read(volume, device))
    else:
        plain, constant = untracked(volume), library.detach(points)
        query = functools.partial(plain.hessian, order=order, space=space, device=device)
        # One of traced values says that it has none, which must not happen within a callback.
        second = library.ask(query, constant, (3, 3)) if isinstance(plain, SparseVolume) else query(constant)
    second = library.once(library.wide(second), "points: third derivatives of samples are not known", asked.tensors)
    found = {"points": (second * library.wide(slope)[:, None, :]).sum(2)}
    if "values" in asked.tensors:
        along = library.wide(slope) @ stencil.matrix.T if space == "world" else library.wide(slope)
        shares = sum(along[:, axis, None] * stencil.products(axis) for axis in range(3))
        found["values"] = stencil.add(shares, volume, len(asked.tensors["values"]), device)
    return found


def _mixed(library: Library, stencil: _Stencil, values: Any) -> Any:
    """Hessians (N, 3, 3) of the trilinear interpolant: along a single axis it is linear."""
    values = library.wide(values)
    xy, yz, zx = ((values * stencil.products(a, (a + 1) % 3)).sum(1) for a in range(3))
    none = xy * 0.0
    second = library.stack(
        [library.stack([none, xy, zx], -1), library.stack([xy, none, yz], -1), library.stack([zx, yz, none], -1)], -2
    )
    return stencil.matrix.T @ second @ stencil.matrix if stencil.space == "world" else second


def _pull_raycast(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    """A hit stays on the isosurface: it moves along its ray by as much as the values there change."""
    volume, device = asked.arguments["volume"], asked.arguments["device"]
    message = "origins: second derivatives of hits of a volume are not known; take the gradient once"
    t, hits, _ = (library.wide(part) for part in answer)
    slope_t, slope_hits, _ = slopes
    found = t < np.inf
    directions = library.wide(library.detach(asked.tensors["directions"]))
    hits = library.where(found[:, None], hits, 0.0)
    t = library.where(found, t, 0.0)
    along = library.wide(untracked(volume).gradient(hits, order=1, device=device))
    steep = dot(along, directions)
    some = found & (steep != 0.0)
    slope_hits = library.where(found[:, None], library.wide(slope_hits), 0.0)
    total = library.where(found, library.wide(slope_t), 0.0) + dot(slope_hits, directions)
    back = library.where(some, -total / library.where(some, steep, 1.0), 0.0)
    moved = back[:, None] * along + slope_hits
    result = {
        "origins": library.once(moved, message, asked.tensors),
        "directions": library.once(t[:, None] * moved, message, asked.tensors),
    }
    if "values" in asked.tensors:
        stencil = _Stencil(library, volume, hits, 1, "world")
        shares = back[:, None] * stencil.products()
        result["values"] = stencil.add(shares, volume, len(asked.tensors["values"]), device)
    return {name: library.once(part, message, asked.tensors) for name, part in result.items()}


def _pull_adaptive(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    points = asked.tensors["points"]
    query = functools.partial(asked.arguments["self"].gradient, device=asked.arguments["device"])
    along = library.ask(query, library.detach(points), (3,))
    message = "points: second derivatives of an AdaptiveSDF are not known; take those of a SparseVolume"
    return {"points": slopes[0][:, None] * library.once(along, message, asked.tensors)}


def _shapes(*columns: tuple[int, ...], name: str = "points", of: bool = False) -> Any:
    """Shapes of outputs with these columns for each row; ``of`` a grid's components come before them."""

    def shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
        count = asked.tensors[name].shape[0]
        components = COMPONENTS.get(asked.arguments["volume"].info.grid_type, 1) if of else 1
        extra = (components,) if components > 1 else ()
        return [((count, *extra, *column), "float") for column in columns]

    return shapes


SAMPLE = Rule(
    (True,),
    pull=_pull_sample,
    adjoint=_sample_adjoint,
    at_once=_sample_at_once,
    check=_order,
    shapes=_shapes((), of=True),
)
GRADIENT = Rule((True,), pull=_pull_gradient, check=_check_gradient, shapes=_shapes((3,), of=True))
ADAPTIVE = Rule((True,), pull=_pull_adaptive, shapes=_shapes(()))
RAYCAST = Rule((True, True, False), pull=_pull_raycast, shapes=_shapes((), (3,), (3,), name="origins"))
