"""``geokit query``: questions about a mesh, a volume or a point cloud, asked with points or rays from a file."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import App, Parameter

from geokit.cli._console import announce_compiling
from geokit.cli._kinds import kind_of_input, load_grid
from geokit.cli._results import check_output, deliver
from geokit.errors import InputError

__all__ = ["app"]

app = App(name="query", help="Ask for closest points, signed distances, ray hits, samples or neighbours.")

Flag = Annotated[bool, Parameter(negative="")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)]


@app.command
def closest(
    mesh: Path,
    points: Path,
    /,
    *,
    output: Output = None,
    max_distance: float = math.inf,
    device: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> None:
    """Closest point on a mesh for each point.

    Args:
        mesh: A mesh file.
        points: Points (.csv .txt .xyz .npy .npz .ply .pcd .pts .las .vtp).
        output: .csv .npz .pcd .ply .vtp .xyz, or - for CSV on stdout; only a summary where not given.
        max_distance: Search radius in world units; farther points are misses (triangle_id -1).
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
        force: Replace the output where it exists.
        json: Print the summary as JSON.
    """
    check_output(output, force=force)
    surface, queries = _surface(mesh, device), _points(points)
    started = time.perf_counter()
    found = surface.closest_point(queries, max_distance=max_distance)
    summary = _summary(len(queries), started, surface.device)
    hits = found.triangle_id >= 0
    summary.update(hits=int(hits.sum()), **_spread("distance", found.distance[hits]))
    data = {
        "distance": found.distance,
        "closest": found.points,
        "triangle_id": found.triangle_id,
        "barycentric": found.barycentric,
    }
    deliver(queries, data, summary, output, json=json)


@app.command
def signed(
    mesh: Path,
    points: Path,
    /,
    *,
    output: Output = None,
    device: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> None:
    """Distance to a mesh for each point, negative inside.

    Args:
        mesh: A mesh file.
        points: Points (.csv .txt .xyz .npy .npz .ply .pcd .pts .las .vtp).
        output: .csv .npz .pcd .ply .vtp .xyz, or - for CSV on stdout; only a summary where not given.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
        force: Replace the output where it exists.
        json: Print the summary as JSON.
    """
    check_output(output, force=force)
    surface, queries = _surface(mesh, device), _points(points)
    started = time.perf_counter()
    found = surface.signed_distance(queries)
    summary = _summary(len(queries), started, surface.device)
    summary.update(
        sign_method=surface.sign_method,
        inside=int((found.distance < 0).sum()),
        **_spread("distance", found.distance),
    )
    data = {
        "distance": found.distance,
        "closest": found.points,
        "triangle_id": found.triangle_id,
        "barycentric": found.barycentric,
    }
    deliver(queries, data, summary, output, json=json)


@app.command
def ray(
    mesh: Path,
    rays: Path,
    /,
    *,
    output: Output = None,
    max_distance: float = math.inf,
    device: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> None:
    """First hit on a mesh for each ray.

    Args:
        mesh: A mesh file.
        rays: Origins and directions: six columns (.csv .txt .xyz .npy), or two arrays (.npz).
        output: .csv .npz .pcd .ply .vtp .xyz, or - for CSV on stdout; only a summary where not given.
        max_distance: Length of the rays in world units; farther hits are misses (triangle_id -1).
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
        force: Replace the output where it exists.
        json: Print the summary as JSON.
    """
    from geokit.points import load_rays

    check_output(output, force=force)
    surface = _surface(mesh, device)
    origins, directions = load_rays(rays)
    announce_compiling()
    started = time.perf_counter()
    found = surface.raycast(origins, directions, max_distance=max_distance)
    summary = _summary(len(origins), started, surface.device)
    hits = found.triangle_id >= 0
    summary.update(hits=int(hits.sum()), **_spread("t", found.t[hits]))
    # inf * 0 on misses would be a warning and no position.
    positions = np.full(origins.shape, np.nan)
    positions[hits] = origins[hits] + found.t[hits, None] * directions[hits]
    data = {
        "direction": directions,
        "t": found.t,
        "hit": positions,
        "triangle_id": found.triangle_id,
        "barycentric": found.barycentric,
    }
    deliver(origins, data, summary, output, json=json)


@app.command
def sample(
    volume: Path,
    points: Path,
    /,
    *,
    output: Output = None,
    grid: str | None = None,
    order: int = 1,
    gradient: Flag = False,
    device: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> None:
    """Value of a volume at each point.

    Args:
        volume: A .vdb or .nvdb file.
        points: Points (.csv .txt .xyz .npy .npz .ply .pcd .pts .las .vtp).
        output: .csv .npz .pcd .ply .vtp .xyz, or - for CSV on stdout; only a summary where not given.
        grid: Name of the grid where the file holds several.
        order: Interpolation: 0 nearest voxel, 1 trilinear.
        gradient: Give the gradient as well.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
        force: Replace the output where it exists.
        json: Print the summary as JSON.
    """
    check_output(output, force=force)
    _require_kind(volume, "volume")
    field, queries = load_grid(volume, grid), _points(points)
    announce_compiling()
    started = time.perf_counter()
    values = np.asarray(field.sample(queries, order=order, device=device))
    data = {"value": values}
    if gradient:
        data["gradient"] = np.asarray(field.gradient(queries, order=order, device=device))
    summary = _summary(len(queries), started, device or "default")
    summary["grid"] = field.info.name
    if values.ndim == 1:
        summary.update(_spread("value", values))
    else:
        summary.update(_spread("length", np.linalg.norm(values, axis=1)))
    deliver(queries, data, summary, output, json=json)


@app.command
def neighbors(
    cloud: Path,
    queries: Path | None = None,
    /,
    *,
    radius: float | None = None,
    nearest: int | None = None,
    output: Output = None,
    device: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> None:
    """Points of a cloud within a radius of each query, its nearest ones, or the nearest within a radius.

    Within a radius, a .npz output holds the neighbours themselves too, as offsets, indices and distance: those of
    query i are indices[offsets[i]:offsets[i + 1]]. Of the nearest every output holds index and distance, a column for
    each.

    Args:
        cloud: The points that are found (.csv .txt .xyz .npy .npz .ply .pcd .pts .las .vtp).
        queries: Where to look; the cloud's own points where not given, each of which then finds itself.
        radius: Search radius in world units; how far the nearest may be.
        nearest: So many of the nearest points, 1 to 1024; -1 and inf where there are fewer.
        output: .csv .npz .pcd .ply .vtp .xyz, or - for CSV on stdout; only a summary where not given.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
        force: Replace the output where it exists.
        json: Print the summary as JSON.
    """
    from geokit.points import NeighborGrid

    if radius is None and nearest is None:
        from cyclopts import CycloptsError

        raise CycloptsError(msg="neither --radius nor --nearest is given; give one of them, or both")

    check_output(output, force=force)
    found_points = _points(cloud)
    asked = found_points if queries is None else _points(queries)
    announce_compiling()
    started = time.perf_counter()
    grid = NeighborGrid(found_points, None if nearest else radius, device=device)
    ragged = None
    data: dict[str, Any] = {}
    if nearest is not None:
        found = grid.knn(asked, nearest) if radius is None else grid.hybrid(asked, nearest, radius=radius)
        counts = (found.indices >= 0).sum(axis=1, dtype=np.int32)
        data = {"index": found.indices, "distance": found.distance}
        if output is not None and output.suffix.lower() != ".npz":
            # Tables name columns of three x, y and z, which these are not.
            data = {f"{name}_{i}": column for name, array in data.items() for i, column in enumerate(array.T)}
    elif output is not None and output.suffix.lower() == ".npz":
        rows = grid.radius_search(asked)
        counts = np.diff(rows.offsets).astype(np.int32)
        ragged = {"offsets": rows.offsets, "indices": rows.indices, "distance": rows.distance}
    else:
        counts = grid.count(asked)
    summary = _summary(len(asked), started, grid.device)
    summary.update(
        cloud_points=len(found_points), radius=radius, neighbors=int(counts.sum()), **_spread("count", counts)
    )
    deliver(asked, {"count": counts, **data}, summary, output, json=json, ragged=ragged)


def _surface(path: Path, device: str | None) -> Any:
    _require_kind(path, "mesh")
    from geokit.mesh import Surface, load

    announce_compiling()
    return Surface(load(path), device=device)


def _points(path: Path) -> np.ndarray:
    from geokit.points import load

    return np.asarray(load(path).points, dtype=np.float64)


def _require_kind(path: Path, wanted: str) -> None:
    found = kind_of_input(path)
    if found != wanted:
        raise InputError(f"{path}: holds a {found}, and this query needs a {wanted}")


def _summary(count: int, started: float, device: str) -> dict[str, Any]:
    seconds = time.perf_counter() - started
    return {"queries": count, "seconds": round(seconds, 4), "device": device}


def _spread(name: str, values: np.ndarray) -> dict[str, float]:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return {}
    return {
        f"{name}_min": float(finite.min()),
        f"{name}_mean": float(finite.mean()),
        f"{name}_max": float(finite.max()),
    }
