"""``geokit info``: describes the content of a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from geokit.cli._console import print_facts, print_json
from geokit.cli._kinds import kind_of_input

__all__ = ["info"]


def info(file: Path, /, *, json: Annotated[bool, Parameter(negative="")] = False) -> None:
    """Describe a mesh, a volume or a point cloud.

    The audit of a mesh says whether it is closed, manifold and consistently oriented. The voxels of a volume are not
    read if the format allows that.

    Args:
        file: A mesh (.obj .ply .stl .usd ...), a volume (.vdb .nvdb) or a point cloud (.csv .xyz .pcd .las ...).
        json: Print JSON.
    """
    kind = kind_of_input(file)
    description = {"mesh": _describe_mesh, "volume": _describe_volume, "cloud": _describe_cloud}[kind](file)
    report = {"file": str(file), "kind": kind, "byte_count": file.stat().st_size, **description}
    if json:
        print_json(report)
        return
    grids = report.pop("grids", None)
    print_facts(report)
    for grid in grids or ():
        print()
        metadata = grid.pop("metadata")
        print_facts(grid)
        if metadata:
            print("metadata")
            print_facts(dict(metadata), indent="  ")


def _describe_mesh(path: Path) -> dict[str, Any]:
    import dataclasses

    from geokit.mesh import audit, load

    mesh = load(path)
    facts: dict[str, Any] = {"name": mesh.name}
    if mesh.parts:
        facts["parts"] = [f"{part.name} ({part.face_count} faces)" for part in mesh.parts]
    report = audit(mesh)
    facts.update({field.name: getattr(report, field.name) for field in dataclasses.fields(report)})
    return facts


def _describe_volume(path: Path) -> dict[str, Any]:
    from geokit.volume import inspect

    grids = inspect(path)
    return {"grid_count": len(grids), "grids": [_describe_grid(grid) for grid in grids]}


def _describe_grid(grid: Any) -> dict[str, Any]:
    return {
        "grid": grid.name,
        "type": grid.grid_type,
        "class": grid.grid_class,
        "voxel_size": grid.voxel_size,
        "background": grid.background,
        "active_voxel_count": grid.active_voxel_count,
        "index_bounds": grid.index_bounds,
        "world_bounds": grid.world_bounds,
        "transform": grid.transform,
        "byte_count": grid.byte_count,
        "metadata": grid.metadata,
    }


def _describe_cloud(path: Path) -> dict[str, Any]:
    import numpy as np

    from geokit.points import load

    cloud = load(path)
    facts: dict[str, Any] = {"point_count": len(cloud.points)}
    if len(cloud.points):
        facts["bounds"] = np.stack([cloud.points.min(axis=0), cloud.points.max(axis=0)])
    facts["arrays"] = [f"{name} {tuple(values.shape)}" for name, values in cloud.data.items()]
    return facts
