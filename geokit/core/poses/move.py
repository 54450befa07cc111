"""Rigid maps, rows of points and directions moved by them in float64, and queries of what stands somewhere else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.query import Query
from geokit.core.gradients.rules import held_by, is_tracked
from geokit.core.interop import user_arrays
from geokit.core.launches import captured
from geokit.core.require import read_array, require_affine_maps
from geokit.errors import InputError

# How far axes may be from orthonormal: poses in float32 are off by 1e-7, and distances are off by no larger share.
RIGID = 1e-6
# Memory of a moved row.
BYTES_PER_MOVE = 24


def require_rigid(transform: Any) -> NDArray[np.float64]:
    """A rigid map for column vectors, (4, 4), or several, (B, 4, 4), as float64.

    Raises:
        InputError: It has another shape or last row, a number that is not finite, or is not rigid.
    """
    maps = require_affine_maps(transform, "transform")
    _require_orthonormal(maps.reshape(-1, 4, 4), "" if maps.ndim == 2 else "map {} is ")
    return maps


def require_rigid_maps(transforms: Any, count: int) -> NDArray[np.float64]:
    """A rigid map for each of ``count`` bodies, (count, 4, 4), as float64.

    Raises:
        InputError: The shape is another one, or a map is not as :func:`require_rigid` says; the message names it.
    """
    maps: NDArray[np.float64] = read_array(transforms, "transform", np.float64)
    if maps.shape != (count, 4, 4):
        raise InputError(f"transform: shape {maps.shape} is not ({count}, 4, 4); give a map for each mesh")
    maps = require_affine_maps(maps, "transform")
    _require_orthonormal(maps, "map {} is ")
    return maps


def _require_orthonormal(maps: NDArray[np.float64], named: str) -> None:
    linear = maps[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        bad = ~(np.abs(linear.transpose(0, 2, 1) @ linear - np.eye(3)).max(axis=(1, 2)) <= RIGID)
    if bad.any():
        raise InputError(
            f"transform: {named.format(int(np.argmax(bad)))}not a rigid motion, as its axes are not of length 1 and at "
            "right angles; geokit.mesh.transform moves a mesh by any affine map"
        )


def move(rows: Any, matrix: NDArray[np.float64], *, turned: bool = False) -> Any:
    """Rows on a device where the map places them; ``turned`` only, for directions."""
    from geokit.core.poses.move_kernels import move_kernel

    shift = np.zeros(3) if turned else matrix[:3, 3]
    out = wp.empty(len(rows), dtype=wp.vec3d, device=rows.device)
    inputs = [rows, wp.mat33d(*matrix[:3, :3].ravel().tolist()), wp.vec3d(*shift.tolist())]
    launcher.launch(move_kernel, len(rows), inputs, [out], rows.device)
    return out


def move_packed(
    rows: Any, offsets: Any, maps: NDArray[np.float64], *, turned: bool = False, count: int | None = None
) -> Any:
    """As :func:`move`, in the kind of memory of ``rows``; map m moves the rows from ``offsets[m]`` on.

    Of ``count`` rows, if that is more than there are, each map makes as many as there are, from all of them.
    """
    from geokit.core.poses.move_kernels import move_packed_kernel

    device = rows.device
    linear, shift = np.ascontiguousarray(maps[:, :3, :3]), np.ascontiguousarray(maps[:, :3, 3])
    if turned:
        shift = np.zeros_like(shift)
    inputs = [
        offsets,
        rows,
        wp.array(linear, dtype=wp.mat33d, device=device),
        wp.array(shift, dtype=wp.vec3d, device=device),
    ]
    count = len(rows) if count is None else count
    out = user_arrays.empty(count, wp.vec3d, rows)
    launcher.launch(move_packed_kernel, count, inputs, [out], device)
    return out


def answer_placed(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The answer of a call whose option ``transform`` says where the surface or volume is.

    The query itself never sees the option. Rows and answers are moved in float64 on the device of the query; of several
    poses those of all are asked at once.

    Raises:
        InputError: The transform is not rigid, the query refuses it, or rows or the body carry gradients.
    """
    options = dict(options)
    maps = require_rigid(options.pop("transform"))
    expected = query.positional[: 1 + len(query.rows)]
    if any(name not in options for name in expected[len(given) :]):
        return query.call(*given, **options)  # which names what is missing
    body, *values = *given, *(options.pop(name) for name in expected[len(given) :])
    if query.places is not None:
        query.places(body, **options)
    refuse_tracked(query, (body, *values), options)
    device = body._device if hasattr(body, "_device") else launcher.resolve_device(options.get("device"))
    batches = user_arrays.read_rows(values[: len(query.rows)], query.rows, device)
    placed, give = move, batches[0].to_caller
    if maps.ndim == 3:
        placed, give = _mover(len(batches[0]), len(maps), device), batches[0].of_poses(len(maps))
    to_body: Any = np.linalg.inv(maps)
    rows: list[Any] = [
        placed(batch.array, to_body, turned=name == "directions")
        for name, batch in zip(query.rows, batches, strict=True)
    ]
    found: Any = query.call(body, *rows, *values[len(query.rows) :], **options)
    if query.kind is None:
        return give(placed(found, maps, turned=True) if query.is_turned else found)
    fields = found._asdict()
    for field in query.moved:
        fields[field] = placed(fields[field], maps, turned=field == "normals")
    if query.is_ragged:
        give = batches[0].to_lists or give
    return query.kind(*map(give, fields.values()))


def _mover(count: int, poses: int, device: Any) -> Callable[..., Any]:
    """:func:`move` by many poses: of ``count`` rows, or of those of each pose, one after the other."""
    if count * poses > np.iinfo(np.int32).max:
        raise InputError(f"transform: {poses} poses of {count} rows are more than 2^31 - 1; ask for fewer at a time")
    captured.refuse(device, "transform: many poses are copied from the host")
    starts = wp.array(count * np.arange(poses + 1, dtype=np.int32), dtype=wp.int32, device=device)
    return lambda rows, maps, turned: move_packed(rows, starts, maps, turned=turned, count=count * poses)


def refuse_tracked(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> None:
    """Refuse tensors with gradients beside a transform, through which it carries none.

    Raises:
        InputError: The body holds such tensors, or some rows are one.
    """
    if held_by(given[0]):
        raise InputError(
            f"transform: the {type(given[0]).__name__} holds tensors with gradients; move the rows by their library"
        )
    rows = dict(zip(query.rows, given[1:], strict=False))
    for name, value in (rows | {name: options[name] for name in query.rows if name in options}).items():
        if is_tracked(value):
            raise InputError(f"{name}: a tensor with gradients beside transform; move the rows by its library")
