"""``geokit info``: describes the content of a file."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from geokit.cli._kinds import Columns, FiniteOnly, Flag, kind_of_input, load_cloud, refuse_unused
from geokit.cli._program.console import print_facts, print_json, step
from geokit.core.files import extension, size_of
from geokit.errors import GeokitError
from geokit.formats.table import SPARSE


def info(
    file: Path, /, *, finite_only: FiniteOnly = True, columns: Columns = None, stream: Flag = False, json: Flag = False
) -> None:
    """Describe a mesh, a volume or a point cloud.

    The audit of a mesh says whether it is closed, manifold and consistently oriented. The voxels of a volume are read
    for the range of its values in a .vdb or .nvdb of up to 64 MiB, and else only if the format demands it.

    Args:
        file: A mesh (.obj .ply .stl .usd ...), a volume (.vdb .nvdb .nii .nrrd ...) or a point cloud (.csv .pcd .las
            ...).
        stream: Read a mesh in a binary .stl or .ply block after block, so that it need not fit into memory.
        json: Print JSON.
    """
    kind = kind_of_input(file)
    refuse_unused(f"on a {kind}", stream=None if kind == "mesh" else stream or None)
    refuse_unused(f"on a {kind}", columns=None if kind == "cloud" else columns)
    with step(f"reading {file}", quiet=json) as reading:
        if stream:
            from geokit.core.content_limit import default_limit
            from geokit.mesh import audit_file

            description = dataclasses.asdict(audit_file(file, memory_limit=default_limit(), progress=reading.progress))
        elif kind == "cloud":
            description = _describe_cloud(file, finite_only, columns)
        else:
            description = _describe_mesh(file) if kind == "mesh" else _describe_volume(file)
    report = {"file": str(file), "kind": kind, "byte_count": size_of(file), **description}
    if json:
        print_json(report)
        return
    if kind == "mesh" and report["self_intersection_count"] is None:
        report["self_intersection_count"] = "not asked (Surface.self_intersections of the Python package finds them)"
    grids = report.pop("grids", None)
    print_facts(report)
    for grid in grids or ():
        print()
        metadata = grid.pop("metadata")
        # Of a dense file only the header is read, and it need not say what lies around.
        unknown = {
            "active_voxel_count": "not asked (no voxel is read)",
            "background": "not stated",
            "value_range": "not known (geokit volume statistics asks each voxel)",
        }
        grid.update({name: what for name, what in unknown.items() if grid.get(name, "") is None})
        if isinstance(grid["transform"], str):
            grid["transform"] = "frustum (voxels widen away from a camera); geokit does not read it, resample it first"
            grid["voxel_size"] = grid["world_bounds"] = "not the same everywhere"
        print_facts(grid)
        if metadata:
            print("metadata")
            print_facts(dict(metadata), indent="  ")


def _describe_mesh(path: Path) -> dict[str, Any]:
    from geokit.mesh import audit, load

    mesh = load(path)
    facts: dict[str, Any] = {"name": mesh.name}
    if mesh.parts:
        facts["parts"] = [f"{part.name} ({part.face_count} faces)" for part in mesh.parts]
    for kind, data in (("vertex", mesh.vertex_data), ("face", mesh.face_data), ("corner", mesh.corner_data)):
        if data:
            facts[f"{kind}_data"] = [f"{name} {values.dtype} {tuple(values.shape)}" for name, values in data.items()]
    if mesh.materials:
        facts["materials"] = [_described(material) for material in mesh.materials]
    if mesh.meters_per_unit is not None:
        facts["meters_per_unit"] = mesh.meters_per_unit
    if mesh.up_axis is not None:
        facts["up_axis"] = mesh.up_axis
    report = audit(mesh)
    facts.update({field.name: getattr(report, field.name) for field in dataclasses.fields(report)})
    return facts


def _described(material: Any) -> str:
    texture = material.texture
    return material.name + (f" ({texture.name}, {len(texture.data):,} bytes)" if texture else "")


def _describe_volume(path: Path) -> dict[str, Any]:
    from geokit.volume import inspect
    from geokit.volume._io import READ_AT_ONCE, unique_names

    grids = inspect(path)
    described = [_describe_grid(grid) for grid in grids]
    if extension(path) in SPARSE:
        names = unique_names([grid.name for grid in grids])
        ranges = _value_ranges(path, names) if size_of(path) <= READ_AT_ONCE else {}
        for grid, name in zip(described, names, strict=True):
            grid["value_range"] = ranges.get(name)
    return {"grid_count": len(grids), "grids": described}


def _value_ranges(path: Path, names: list[str]) -> dict[str, tuple[float, float] | None]:
    """Smallest and largest value of the active voxels of each grid, without those that cannot be loaded."""
    from geokit.volume import load, load_all
    from geokit.volume.nanovdb.header import value_range

    try:
        return {name: value_range(volume.nanovdb) for name, volume in load_all(path).items()}
    except GeokitError:  # one of them
        found = {}
        for name in names:
            with contextlib.suppress(GeokitError):
                found[name] = value_range(load(path, grid=name).nanovdb)
        return found


def _describe_grid(grid: Any) -> dict[str, Any]:
    # geokit.volume.inspect gives NaN for it.
    frustum = bool(np.isnan(grid.transform).all())
    return {
        "grid": grid.name,
        "type": grid.grid_type,
        "class": grid.grid_class,
        "voxel_size": None if frustum else grid.voxel_size,
        "background": grid.background,
        "active_voxel_count": grid.active_voxel_count,
        "index_bounds": grid.index_bounds,
        "world_bounds": None if frustum else grid.world_bounds,
        "transform": "frustum" if frustum else grid.transform,
        "byte_count": grid.byte_count,
        "metadata": grid.metadata,
    }


def _describe_cloud(path: Path, finite_only: bool, columns: str | None) -> dict[str, Any]:
    cloud = load_cloud(path, finite_only, columns=columns)
    facts: dict[str, Any] = {"point_count": len(cloud.points)}
    system = cloud.coordinate_system
    if system is not None and system.records:
        facts["coordinate_system"] = system.name or "not named"
    if len(cloud.points):
        facts["bounds"] = np.stack([cloud.points.min(axis=0), cloud.points.max(axis=0)])
    facts["arrays"] = [f"{name} {tuple(values.shape)}" for name, values in cloud.data.items()]
    return facts
