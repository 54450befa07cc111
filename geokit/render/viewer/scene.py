"""What the page draws: a record for each mesh, cloud and volume, in a frame whose numbers float32 holds well."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.objects import points_of, polygons_of
from geokit.errors import InputError
from geokit.mesh.model.data import MEANINGS, has_meaning
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.topology.connectivity import position_corners
from geokit.points._io import PointCloud
from geokit.render.looks.checks import DIVERGING, require_drawable, value_range
from geokit.render.looks.color_maps import HELD, color_table
from geokit.render.looks.painted import SURFACE_COLOR, bytes_of, corner_alpha, corner_colors, is_painted
from geokit.volume._dense import to_dense
from geokit.volume.at_points.sample import sample
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    from geokit.render.viewer.arrays import Arrays

_RED, _GREEN, _BLUE = bytes.fromhex(SURFACE_COLOR[1:])
PLAIN = (_RED / 255.0, _GREEN / 255.0, _BLUE / 255.0)
# Arrays of a cloud that are its colors, if they have three or four columns.
COLOR_NAMES = ("color", "colors", "rgb", "rgba")
# Longest side of a box; browsers promise 256, and all that run on a GPU have 2048.
LONGEST_SIDE = 1024
# Largest distance between samples whose mean is a coarser one [voxels]: the width of the usual band, and of a wisp; and
# the most of them along an axis.
LEVEL_SET_STEP, FOG_STEP, MOST_SAMPLES = 6.0, 2.0, 4
# Share of the positive values of a fog that the color map's upper end is above.
FOG_SHARE = 0.99


class Frame(NamedTuple):
    """The page's own frame: world minus ``center``, divided by ``scale``; the scene lies within about 1 of zero."""

    center: NDArray[np.float64]
    scale: float

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        return ((points - self.center) / self.scale).astype(np.float32)

    def matrix(self, transform: NDArray[np.float64]) -> NDArray[np.float64]:
        """A transform to the world (4, 4) as one to this frame."""
        found = transform.copy()
        found[:3, 3] -= self.center
        found[:3] /= self.scale
        return found


def read_thing(thing: Any, where: str) -> TriangleMesh | PointCloud | SparseVolume:
    """What is given, as one of geokit's own objects.

    Raises:
        InputError: It cannot be drawn; the message names ``where``.
    """
    if isinstance(thing, (TriangleMesh, PointCloud, SparseVolume)):
        return thing
    if isinstance(thing, Surface):
        return thing.mesh
    # A list of two rows is two points, a tuple of two arrays a mesh.
    if not isinstance(thing, list) and polygons_of(thing, where) is not None:
        return require_mesh(thing, where)
    points = points_of(thing, where)
    if points is thing and not isinstance(thing, (list, tuple)) and not hasattr(thing, "shape"):
        raise InputError(
            f"{where}: {type(thing).__name__} cannot be drawn; give a mesh, a volume, a cloud, or points (N, 3)"
        )
    try:
        return PointCloud(thing)
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix('points: ')}") from error


def _bounds(thing: TriangleMesh | PointCloud | SparseVolume, where: str) -> NDArray[np.float64]:
    if isinstance(thing, SparseVolume):
        bounds = thing.info.world_bounds
        if bounds is None:
            raise InputError(f"{where}: grid {thing.info.name!r} has no active voxels: there is nothing to draw")
        # Of one voxel there is something to see, too.
        return bounds + np.array([[-1.0], [1.0]]) * np.abs(thing.info.transform[:3, :3]).sum(axis=1)
    if isinstance(thing, TriangleMesh):
        _require_content(thing.face_count, thing.bounds, where, "faces")
        return thing.bounds
    points = thing.points
    bounds = np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))
    _require_content(len(points), bounds, where, "points")
    return bounds


def scene_record(
    things: list[TriangleMesh | PointCloud | SparseVolume],
    names: list[str],
    arrays: Arrays,
    *,
    title: str,
    colormap: str,
    up: str,
    max_voxels: int,
    device: Any,
) -> dict[str, Any]:
    """The scene as JSON, which names the arrays that it uses."""
    boxes = [_bounds(thing, f"things[{row}]") for row, thing in enumerate(things)]
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    frame = Frame(0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0)
    records = []
    for thing, name in zip(things, names, strict=True):
        if isinstance(thing, TriangleMesh):
            records.append(_mesh_record(thing, name, frame, arrays))
        elif isinstance(thing, PointCloud):
            records.append(_cloud_record(thing, name, frame, arrays))
        else:
            records.append(_volume_record(thing, name, frame, arrays, max_voxels=max_voxels, device=device))
    maps = list(dict.fromkeys((colormap, *HELD)))
    return {
        "title": title,
        "up": up,
        "center": frame.center.tolist(),
        "scale": frame.scale,
        "low": frame.local(low).tolist(),
        "high": frame.local(high).tolist(),
        "colormap": colormap,
        "diverging": DIVERGING,
        "maps": maps,
        "colors": arrays.add(np.stack([color_table(name) for name in maps])),
        "objects": records,
    }


def _mesh_record(mesh: TriangleMesh, name: str, frame: Frame, arrays: Arrays) -> dict[str, Any]:
    corners, position_count = position_corners(mesh)
    tables = (("vertex", mesh.vertex_data), ("face", mesh.face_data), ("corner", mesh.corner_data))
    return {
        "kind": "mesh",
        "name": name,
        "vertices": arrays.add(frame.local(mesh.vertices)),
        "faces": arrays.add(mesh.faces, differences=True),
        # Normals are smooth across vertices at one position.
        "positions": None if corners is mesh.faces else arrays.add(corners, differences=True),
        "position_count": position_count,
        "colors": _mesh_colors(mesh, arrays),
        "attributes": [record for at, data in tables for record in _attributes(data, at, arrays, MEANINGS)],
    }


def _cloud_record(cloud: PointCloud, name: str, frame: Frame, arrays: Arrays) -> dict[str, Any]:
    colors = next((key for key in COLOR_NAMES if key in cloud.data and cloud.data[key].shape[1:] in ((3,), (4,))), None)
    return {
        "kind": "cloud",
        "name": name,
        "vertices": arrays.add(frame.local(cloud.points)),
        "colors": None if colors is None else {"at": "vertex", "values": arrays.add(bytes_of(cloud.data[colors]))},
        "attributes": list(_attributes(cloud.data, "vertex", arrays, () if colors is None else (colors,))),
    }


def _mesh_colors(mesh: TriangleMesh, arrays: Arrays) -> dict[str, Any] | None:
    colors = mesh.vertex_data.get("color")
    if not is_painted(mesh):
        return None
    opacity = corner_alpha(mesh)
    alpha = None if opacity is None else arrays.add(np.rint(255.0 * np.clip(opacity, 0.0, 1.0)).astype(np.uint8))
    if colors is not None and has_meaning("color", colors) and not mesh.materials and "color" not in mesh.corner_data:
        return {"at": "vertex", "values": arrays.add(bytes_of(colors)), "alpha": alpha}
    return {"at": "corner", "values": arrays.add(bytes_of(corner_colors(mesh, PLAIN))), "alpha": alpha}


def _attributes(data: Mapping[str, NDArray[Any]], at: str, arrays: Arrays, left_out: Any) -> list[dict[str, Any]]:
    """Arrays that can be shown by a color map: numbers, and vectors by their length."""
    found = []
    axes = 2 if at == "corner" else 1
    for name, values in data.items():
        if name in left_out and (name not in MEANINGS or has_meaning(name, values, axes)):
            continue
        numbers = _numbers(values if values.ndim == axes else np.linalg.norm(values.astype(np.float64), axis=-1))
        low, high = value_range(numbers.astype(np.float64), None)
        record = {"name": name, "at": at, "values": arrays.add(numbers), "low": low, "high": high}
        found.append(record if values.ndim == axes else {**record, "vector": True})
    return found


def _numbers(values: NDArray[Any]) -> NDArray[Any]:
    """Numbers of up to 4 bytes: integers as they are where they fit in int32, all others as float32."""
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind in "iu" and values.size:
        if values.dtype.itemsize <= 4:
            return values
        limits = np.iinfo(np.int32)
        if limits.min <= values.min() and values.max() <= limits.max:
            return values.astype(np.int32)
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _require_content(count: int, bounds: NDArray[np.float64], where: str, what: str) -> None:
    """Refuse what has nothing to draw, or lies beyond float32.

    Raises:
        InputError: The message names ``where``.
    """
    if count == 0:
        raise InputError(f"{where}: has no {what}: there is nothing to draw")
    require_drawable(bounds, where)


class _Box(NamedTuple):
    """Values (X, Y, Z) of a box of samples; index of the samples to world (4, 4); how much coarser than the voxels."""

    values: NDArray[Any]
    transform: NDArray[np.float64]
    coarser: float


def _volume_record(
    volume: SparseVolume, name: str, frame: Frame, arrays: Arrays, *, max_voxels: int, device: Any
) -> dict[str, Any]:
    box = _box(volume, max_voxels, device)
    values = np.nan_to_num(box.values)
    low, high = float(values.min()), float(values.max())
    scale = max(abs(low), abs(high)) or 1.0
    is_level_set = volume.info.grid_class == "level set"
    fog = values[values > 0.0]
    top = float(np.quantile(fog, FOG_SHARE)) if fog.size and low >= 0.0 else high
    half = (values / scale).astype(np.float16)
    return {
        "kind": "volume",
        "name": name,
        "grid": volume.info.name.encode("utf-8", "replace").decode(),
        "class": "level set" if is_level_set else "fog",
        # The first axis varies fastest in a texture.
        "values": arrays.add(half.T.view(np.uint16)),
        "shape": list(half.shape),
        "scale": scale,
        "low": low,
        "high": high,
        # Ends of the color map.
        "from": -scale if is_level_set else min(low, 0.0),
        "to": scale if is_level_set else top,
        "matrix": frame.matrix(box.transform).ravel().tolist(),
        "coarser": box.coarser,
        "voxel_size": volume.info.voxel_size.tolist(),
        "active": volume.info.active_voxel_count,
    }


def _box(volume: SparseVolume, max_voxels: int, device: Any) -> _Box:
    bounds = volume.info.index_bounds
    if bounds is None:
        raise InputError(f"grid {volume.info.name!r} has no active voxels: there is nothing to draw")
    factor = _factor(bounds[1] - bounds[0] + 1, max_voxels)
    return _dense(volume, bounds, device) if factor == 1.0 else _sampled(volume, bounds, factor, device)


def _factor(size: NDArray[np.int64], max_voxels: int) -> float:
    """How much coarser the samples of a box must be: 1 for as fine as the voxels."""

    def fits(factor: float) -> bool:
        sides = np.ceil(size / factor) + 2.0
        return float(np.prod(sides)) <= max_voxels and float(sides.max()) <= LONGEST_SIDE

    factor = 1.0
    while not fits(factor):
        factor *= 1.05
    return factor


def _dense(volume: SparseVolume, bounds: NDArray[np.int64], device: Any) -> _Box:
    # A voxel around the active ones, so that surfaces close and fog fades out.
    grid = to_dense(volume, bounds=bounds + np.array([[-1], [1]]), device=device)
    return _Box(_scalars(grid.values), grid.array_transform, 1.0)


def _sampled(volume: SparseVolume, bounds: NDArray[np.int64], factor: float, device: Any) -> _Box:
    """Means of the interpolant over steps of ``factor`` voxels, a plane at a time.

    A level set's values end with its band, and at large steps few samples are in it: their mean still says on which
    side, and how near, a surface is.
    """
    first, last = bounds.astype(np.float64)
    counts = np.ceil((last - first + 1.0) / factor).astype(int) + 2
    first = 0.5 * (first + last) - 0.5 * factor * (counts - 1)
    axes = [start + factor * np.arange(count) for start, count in zip(first, counts, strict=True)]
    farthest = LEVEL_SET_STEP if volume.info.grid_class == "level set" else FOG_STEP
    parts = min(int(np.ceil(factor / farthest)), MOST_SAMPLES)
    offsets = factor * ((np.arange(parts) + 0.5) / parts - 0.5)
    values = np.zeros(tuple(counts), np.float32)
    grid = np.stack(np.meshgrid(axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.empty((len(grid), 3))
    for row, x in enumerate(axes[0]):
        for offset in itertools.product(offsets, repeat=3):
            points[:, 0], points[:, 1:] = x + offset[0], grid + offset[1:]
            found = np.asarray(sample(volume, points, space="index", device=device))
            values[row] += _scalars(found.reshape(counts[1], counts[2], *found.shape[1:]), 2)
    steps = np.diag([factor, factor, factor, 1.0])
    steps[:3, 3] = first
    return _Box(values / parts**3, volume.info.transform @ steps, factor)


def _scalars(values: NDArray[Any], axes: int = 3) -> NDArray[Any]:
    """Numbers as they are, vectors as their length."""
    values = values.astype(np.float32) if values.dtype.kind not in "f" else values
    return values if values.ndim == axes else np.linalg.norm(values, axis=-1)
