"""Compares what geokit reads with what another program was given to write, value by value."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

import geokit as gk
from tests.foreign.content import (
    CLOUD,
    FACES,
    IMAGE,
    INDICES,
    ORIGIN,
    SPACING,
    VALUES,
    VERTICES,
    VOXEL_SIZE,
)  # fmt: skip
from tests.foreign.table import Row

__all__ = ["faults"]


def faults(row: Row, folder: Path) -> list[str]:
    """What is wrong with a file ``a`` with the row's extension in a folder; empty if all is right."""
    path = folder / f"a{row.kind}"
    try:
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            found = list(_FAULTS[row.what](row, path))
    except gk.errors.GeokitError as error:
        if row.options.get("refused", "\n") in str(error):
            return []
        return [f"refused: {error}"]
    if "refused" in row.options:
        found.append("is not refused")
    said = [str(one.message) for one in given if issubclass(one.category, UserWarning)]
    if not row.limit:
        found += [f"warned: {text}" for text in said]
    return found


def _mesh(row: Row, path: Path) -> Any:
    mesh = gk.mesh.load(path)
    options = row.options
    if options.get("box"):
        report = gk.mesh.audit(mesh)
        if not (report.watertight and report.oriented):
            yield "the box is not closed"
        if not np.allclose([mesh.vertices.min(0), mesh.vertices.max(0)], [[0, 0, 0], [1, 2, 3]], rtol=0, atol=1e-6):
            yield f"the box reaches from {mesh.vertices.min(0)} to {mesh.vertices.max(0)}"
        return
    # Triangles that begin with their lowest corner, in their order: programs renumber vertices and faces.
    rows, corners, order = _sorted(mesh.vertices[mesh.faces])
    expected, given_corners, given_order = _sorted(VERTICES[FACES[:, ::-1] if options.get("inside_out") else FACES])
    if not np.array_equal(rows, expected):
        yield f"triangles {rows.tolist()}"
        return
    for name, values in row.data.items():
        if name.startswith("face:"):
            kind, label, wanted = "face", name.removeprefix("face:"), values[given_order]
            held = mesh.face_data.get(label)
            have = None if held is None else np.asarray(held)[order]
        else:
            kind, label, wanted = "vertex", name, values[FACES][given_order[:, None], given_corners]
            held = mesh.vertex_data.get(label)
            have = None if held is None else np.asarray(held)[mesh.faces][order[:, None], corners]
        yield from _array(kind, label, have, wanted, (mesh.vertex_data.keys(), mesh.face_data.keys()))
    for name, value in (("meters_per_unit", options.get("unit")), ("up_axis", options.get("up"))):
        if value is not None and getattr(mesh, name) != value:
            yield f"{name} is {getattr(mesh, name)}, not {value}"


def _sorted(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners rotated so that the lowest is first, rows sorted; where the corners and the rows come from."""
    first = np.array([min(range(3), key=lambda i: tuple(triangle[i])) for triangle in np.round(triangles, 4).tolist()])
    corners = (first[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, corners[:, :, None], axis=1)
    order = np.lexsort(np.round(turned, 4).reshape(len(turned), 9).T[::-1])
    return turned[order], corners[order], order


def _array(kind: str, name: str, have: Any, wanted: np.ndarray, names: Any) -> Any:
    if have is None:
        yield f"no {kind} array '{name}' but {[list(one) for one in names]}"
    elif name in ("rgb", "color"):
        # Some programs add an alpha of one.
        full = 1 / 255 if have.dtype.kind == "f" else np.iinfo(have.dtype).max / 255
        if not np.allclose(have[..., :3] / full, wanted, atol=0.01) or not np.allclose(have[..., 3:] / full, 255):
            yield f"{kind} array '{name}' is {have.tolist()}"
    elif not np.array_equal(have, wanted):
        yield f"{kind} array '{name}' is {have.tolist()}"


def _points(row: Row, path: Path) -> Any:
    found = gk.points.load(path)
    if not np.array_equal(found.points, CLOUD):
        yield f"points {found.points[:3].tolist()}..."
        return
    for name, values in row.data.items():
        yield from _array("point", name, found.data.get(name), values, [found.data.keys()])


def _image(row: Row, path: Path) -> Any:
    options = row.options
    volume = gk.volume.load(path)
    if options.get("boxes"):
        indices = _active(volume)
        wanted = INDICES[(IMAGE.shape > INDICES).all(1)]
        if not np.array_equal(np.unique(indices - indices.min(0), axis=0), np.unique(wanted - wanted.min(0), axis=0)):
            yield f"voxels {indices.tolist()}"
        return
    origin, scale = np.asarray(options.get("origin", ORIGIN), float), np.asarray(options.get("scale", SPACING), float)
    inside = np.argwhere(np.ones(IMAGE.shape))
    places = (inside * scale + origin) * options.get("flip", [1, 1, 1])
    values = volume.sample(places, order=0, device="cpu")
    if volume.info.active_voxel_count != IMAGE.size:
        yield f"{volume.info.active_voxel_count} voxels"
    if not np.array_equal(values, IMAGE[tuple(inside.T)]):
        yield f"values {values[:5].tolist()}... by the transform {volume.info.transform.tolist()}"
    if not np.allclose(np.sort(volume.info.voxel_size), np.sort(scale), rtol=1e-6):
        yield f"voxel sizes {volume.info.voxel_size}"


def _active(volume: gk.volume.SparseVolume) -> np.ndarray:
    (low, high) = np.asarray(volume.info.index_bounds)
    places = np.argwhere(np.ones(high - low + 1)) + low
    return places[volume.active_at(places, space="index", device="cpu")]


def _grid(row: Row, path: Path) -> Any:
    for trusted in (False, True):
        volume = gk.volume.load(path, trusted=trusted)
        indices, values = gk.volume.active_voxels(volume)[:2]
        order = np.lexsort(indices.T[::-1])
        wanted = VALUES.astype(np.float16).astype(np.float32) if row.options.get("half") else VALUES
        if not np.array_equal(indices[order], INDICES[np.lexsort(INDICES.T[::-1])]):
            yield f"voxels {indices.tolist()}"
        elif not np.array_equal(values[order], wanted[np.lexsort(INDICES.T[::-1])]):
            yield f"values {values.tolist()}"
        if not np.array_equal(volume.info.transform, np.diag([VOXEL_SIZE] * 3 + [1.0])):
            yield f"transform {volume.info.transform.tolist()}"
        if volume.info.name != "density":
            yield f"name {volume.info.name}"
    (info,) = gk.volume.inspect(path)
    if (info.name, info.active_voxel_count) != ("density", len(INDICES)):
        yield f"inspect says {info}"


_FAULTS = {"mesh": _mesh, "points": _points, "image": _image, "grid": _grid}
