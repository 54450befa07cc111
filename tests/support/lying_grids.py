"""Sound grids in which one field lies: what a file without a checksum can hold and every structural check accepts."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import geokit as gk
from benchmarks.catalog.mesh_catalog import torus
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_grid
from geokit.volume.nanovdb.header import aligned_buffer, grid_class_code, grid_header, info_of, tree_header
from geokit.volume.nanovdb.layout import layout_of
from geokit.volume.nanovdb.nodes import GridNodes, bits_of, grid_nodes, slot_places
from geokit.volume.tree.typed_tree import Nodes, TypedTree, tree_of
from geokit.volume.tree.typed_writer import rebuilt
from tests.support.effort import of_all

__all__ = ["LIES", "OPERATIONS", "SOURCES", "lying"]

Lie = Callable[[Any, GridNodes], None]


@functools.cache
def level_set() -> SparseVolume:
    """A float level set of a torus, with leaves in several upper nodes."""
    return gk.volume.from_mesh(torus(), voxel_size=of_all(0.12, 0.06), device="cpu")


def int64_grid() -> SparseVolume:
    """An int64 grid of a few hundred active voxels."""
    values = np.arange(20**3).reshape(20, 20, 20) % 7
    return gk.volume.from_dense(values.astype(np.int64), voxel_size=0.1)


def fog() -> SparseVolume:
    """A float fog volume."""
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 20)] * 3, indexing="ij"))
    values = np.clip(1.0 - np.linalg.norm(x, axis=0), 0.0, None).astype(np.float32)
    return gk.volume.from_dense(values, voxel_size=0.1, grid_class="fog volume")


SOURCES: dict[str, Callable[[], SparseVolume]] = {"level set": level_set, "int64": int64_grid, "fog": fog}


def _background(value: float) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        kind = nodes.background.dtype
        limits = np.iinfo(kind) if kind.kind == "i" else np.finfo(kind)
        usable = value if kind.kind == "f" else (limits.max if not value < 0 else limits.min)
        with np.errstate(over="ignore"):
            nodes.background[...] = usable

    return lie


def _voxels(*size: float) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        with np.errstate(over="ignore", under="ignore"):
            header["matrix"] = (np.eye(3) * size).ravel()
            header["inverse"] = (np.eye(3) / np.array(size)).ravel()
            header["matrix_f"], header["inverse_f"] = header["matrix"], header["inverse"]
        header["voxel_size"] = size

    return lie


def _vector(value: float) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        header["vector"] = value

    return lie


def _field(name: str, value: Any) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        header[name] = value

    return lie


def _tiles(level: str) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        node = getattr(nodes, level)
        node.value_mask[:1] |= ~node.child_mask[:1]

    return lie


def _masks(byte: int) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        nodes.leaf.value_mask[:] = byte

    return lie


def _leaf_values(value: float) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        values = nodes.leaf.values
        values[:, ::7] = value if values.dtype.kind == "f" else np.iinfo(values.dtype).min

    return lie


def _limits(level: str, value: float) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        limits = getattr(nodes, level).limits
        limits[:] = value if limits.dtype.kind == "f" else np.iinfo(limits.dtype).max

    return lie


def _moved(upper: int) -> Lie:
    """All nodes of the grid moved along x by this many upper nodes, from the one of the largest x."""

    def lie(header: Any, nodes: GridNodes) -> None:
        table = nodes.table
        origins = nodes.upper_places().origins
        step = 4096 * upper - int(origins[:, 0].max() if upper > 0 else origins[:, 0].min())
        for level in (nodes.upper, nodes.lower, nodes.leaf):
            box = level.column("<i4", 0, 1)
            box[:] = (box.astype(np.int64) + step).astype(np.int32)
        x = ((table["key"] >> np.uint64(42)).astype(np.int64) + (step >> 12)) & ((1 << 20) - 1)
        table["key"] = table["key"] & np.uint64((1 << 42) - 1) | x.astype(np.uint64) << np.uint64(42)
        box = nodes.root.column("<i4", 0, 6)[0]
        box[[0, 3]] = np.clip(box[[0, 3]].astype(np.int64) + step, -(2**31), 2**31 - 1)

    return lie


def _index_box(low: int, high: int) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        nodes.root.column("<i4", 0, 6)[0] = [low] * 3 + [high] * 3

    return lie


def _voxel_count(count: int) -> Lie:
    def lie(header: Any, nodes: GridNodes) -> None:
        tree_header(nodes.root.buffer)["voxel_count"] = count

    return lie


def _checkerboard(header: Any, nodes: GridNodes) -> None:
    """Every other tile of an upper node has another value, so that each border of two tiles is a surface."""
    _tiles("upper")(header, nodes)
    values, child = nodes.upper.values, bits_of(nodes.upper.child_mask[:1])[0]
    odd = slot_places(np.arange(32**3), 32).sum(axis=1) % 2 == 1
    values[0, odd & ~child] = -nodes.background - 1


def _root_tiles(*x: int) -> Callable[[TypedTree], TypedTree]:
    def change(tree: TypedTree) -> TypedTree:
        origins = np.array([[4096 * (i + 2), 0, 0] for i in x], np.int32)
        values = np.where(np.array(x) % 2, -tree.background - 1, tree.background).astype(tree.background.dtype)
        return replace(tree, root=Nodes(origins, values, np.ones(len(x), np.bool_)))

    return change


def _leaf(corner: int) -> Callable[[TypedTree], TypedTree]:
    def change(tree: TypedTree) -> TypedTree:
        return replace(
            tree,
            origins=np.concatenate([tree.origins, np.full((1, 3), corner, np.int32)]),
            masks=np.concatenate([tree.masks, np.full((1, 64), 255, np.uint8)]),
            values=np.concatenate([tree.values, tree.values[:1]]),
        )

    return change


TREE_LIES: dict[str, Callable[[TypedTree], TypedTree]] = {
    "root tile": _root_tiles(0),
    "root tiles": _root_tiles(*range(64)),
    "leaf at 2^31": _leaf(2**31 - 8),
    "leaf at -2^31": _leaf(-(2**31)),
}
HEADER_LIES: dict[str, Lie] = {
    "background 3.4e38": _background(3.4e38),
    "background 1e30": _background(1e30),
    "background 2000": _background(2000.0),
    "background inf": _background(np.inf),
    "background nan": _background(np.nan),
    "background -3.4e38": _background(-3.4e38),
    "background 0": _background(0.0),
    "background 1e-45": _background(1e-45),
    "voxels 1e-300": _voxels(1e-300),
    "voxels 1e300": _voxels(1e300),
    "voxels 1e-30": _voxels(1e-30),
    "voxels 1e30": _voxels(1e30),
    "voxels flat": _voxels(0.06, 1e-45, 0.06),
    "voxels long": _voxels(0.06, 0.06, 1e30),
    "translation 1e300": _vector(1e300),
    "translation 1.7e308": _vector(1.7e308),
    "translation 1e18": _vector(1e18),
    "world box nan": _field("world_bbox", np.nan),
    "header voxel size 0": _field("voxel_size", 0.0),
    "inverse 0": _field("inverse", 0.0),
    "upper tiles": _tiles("upper"),
    "lower tiles": _tiles("lower"),
    "upper checkerboard": _checkerboard,
    "masks full": _masks(255),
    "masks empty": _masks(0),
    "leaf values nan": _leaf_values(np.nan),
    "leaf values inf": _leaf_values(np.inf),
    # Negative ones would be thousands of components for segment: work, not a lie.
    "leaf values 3e38": _leaf_values(3e38),
    "leaf limits nan": _limits("leaf", np.nan),
    "root limits 3e38": _limits("root", 3e38),
    "at 2^31": _moved(2**19 - 1),
    "at -2^31": _moved(-(2**19)),
    "index box huge": _index_box(-(2**31), 2**31 - 1),
    "voxel count 2^62": _voxel_count(2**62),
    "voxel count 0": _voxel_count(0),
    "class level set": _field("grid_class", grid_class_code("level set")),
}
# By default without those of which another is the worse.
MILDER = of_all({"background 1e30", "voxels 1e-30", "voxels 1e30", "translation 1e300", "root tile"}, set())
LIES = tuple(lie for lie in (*HEADER_LIES, *TREE_LIES) if lie not in MILDER)


def lying(source: SparseVolume, lie: str) -> SparseVolume:
    """A copy of a volume with one of LIES, as it comes from a file whose checksum is left out."""
    if lie in TREE_LIES:
        source = rebuilt(TREE_LIES[lie](tree_of(source)), source)
    buffer = aligned_buffer(len(source.nanovdb))
    buffer[:] = source.nanovdb
    header = grid_header(buffer)
    header["checksum"] = np.uint64(2**64 - 1)
    if lie in HEADER_LIES:
        HEADER_LIES[lie](header, grid_nodes(buffer, layout_of(int(header["grid_type"]), lie)))
    check_grid(buffer, lie)
    return SparseVolume(buffer, info_of(buffer))


POINTS = np.array([[0.1, 0.2, 0.3], [1.0, 0.0, 0.0], [-5.0, 3.0, 1e6]])
AXES = np.eye(3)


def _operations() -> Iterator[tuple[str, Callable[[SparseVolume, Any], Any]]]:
    volume, mesh = gk.volume, gk.mesh
    on = {"device": "cpu"}

    def size(v: SparseVolume) -> float:
        return float(v.info.voxel_size[0])

    for order in (0, 1, 2, 3):
        yield f"sample {order}", lambda v, p, o=order: v.sample(POINTS, order=o, **on)
    yield "gradient", lambda v, p: v.gradient(POINTS, **on)
    yield "hessian", lambda v, p: v.hessian(POINTS, **on)
    yield "curvature", lambda v, p: v.curvature(POINTS, **on)
    yield "active_at", lambda v, p: v.active_at(POINTS, **on)
    yield "raycast", lambda v, p: v.raycast(POINTS, -AXES, **on)
    yield "raycast fog", lambda v, p: v.raycast(POINTS, -AXES, isovalue=0.5, **on)
    yield "integrate", lambda v, p: v.integrate(POINTS, -AXES, **on)
    yield "statistics", lambda v, p: volume.statistics(v)
    yield "prune", lambda v, p: volume.prune(v, 0.0)
    yield "clip", lambda v, p: volume.clip(v, [[-0.5] * 3, [0.5] * 3])
    yield "segment", lambda v, p: volume.segment(v)
    yield "to_dense", lambda v, p: v.to_dense(**on)
    yield "quantize", lambda v, p: v.quantize("fp8")
    yield "quantize tolerance", lambda v, p: v.quantize(tolerance=1e-2)
    yield "resample", lambda v, p: volume.resample(v, voxel_size=1.5 * size(v), **on)
    yield "resample 0.1", lambda v, p: volume.resample(v, voxel_size=0.1, **on)
    for name in ("gradient_field", "laplacian", "divergence", "curl"):
        yield name, lambda v, p, n=name: getattr(volume, n)(v, **on)
    yield "renormalize", lambda v, p: volume.renormalize(v, **on)
    yield "renormalize 5", lambda v, p: volume.renormalize(v, half_width=5, **on)
    yield "offset", lambda v, p: volume.offset(v, 0.1, **on)
    yield "offset voxels", lambda v, p: volume.offset(v, -2.0 * size(v), **on)
    for name in ("dilate", "erode", "opening", "closing"):
        yield name, lambda v, p, n=name: getattr(volume, n)(v, 2.0 * size(v), **on)
        yield f"{name} voxels", lambda v, p, n=name: getattr(volume, n)(v, voxels=2, **on)
    yield "smooth", lambda v, p: volume.smooth(v)
    yield "smooth median", lambda v, p: volume.smooth(v, "median", iterations=2)
    yield "union", lambda v, p: volume.union(v, SOURCES["level set"]())
    yield "union other", lambda v, p: volume.union(SOURCES["level set"](), v)
    yield "difference", lambda v, p: volume.difference(v, v)
    yield "difference smooth", lambda v, p: volume.difference(SOURCES["level set"](), v, smooth=0.1)
    for method in ("surface_nets", "marching_cubes", "dual_contouring", "openvdb"):
        yield f"from_volume {method}", lambda v, p, m=method: mesh.from_volume(v, method=m, **on).faces
    yield "from_volume fog", lambda v, p: mesh.from_volume(v, isovalue=0.5, **on).faces
    yield "save vdb", lambda v, p: volume.save(f"{p}/a.vdb", v)
    yield "save nvdb", lambda v, p: volume.save(f"{p}/a.nvdb", v)
    yield "info", lambda v, p: (repr(v), v.info.world_bounds)


OPERATIONS: dict[str, Callable[[SparseVolume, Any], Any]] = dict(_operations())
