"""``geokit query``: queries a mesh, a volume or a point cloud with points or rays from a file."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import App, Parameter

from geokit.cli._kinds import Device, Flag, load_cloud, load_grid, load_rays, require_kind
from geokit.cli._program.console import announce_compiling, step
from geokit.cli._results import ASKING, DEFAULTS, OUTPUT_EXTENSIONS, Asking, Common, check_output, deliver, spread
from geokit.core.files import extension
from geokit.formats.table import with_formats

app = App(name="query", help="Find closest points, signed distances, ray hits, samples or neighbors.")

Output = Annotated[Path | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)]


@app.command
@with_formats("points", "r", outputs=OUTPUT_EXTENSIONS)
def closest(
    mesh: Path, points: Path, /, *, output: Output = None, max_distance: float = math.inf, common: Asking = ASKING
) -> None:
    """Find the closest point on a mesh for each point.

    Args:
        mesh: A mesh file.
        points: Points ({formats}).
        output: {outputs}, or - for CSV on stdout; by default only a summary is printed.
        max_distance: Search radius in world units; farther points are misses (triangle_id -1).
    """
    check_output(output, force=common.force)
    surface, queries = _surface(mesh, common.device, common), _points(points, common)
    with step(f"querying {mesh}", quiet=common.json) as asking:
        found = surface.closest_point(queries, max_distance=max_distance, progress=asking.progress)
    summary = _summary(len(queries), asking.started, surface.device)
    hits = found.triangle_id >= 0
    summary.update(hits=int(hits.sum()), **spread("distance", found.distance[hits]))
    deliver(queries, _closest(found), summary, output, json=common.json)


@app.command
@with_formats("points", "r", outputs=OUTPUT_EXTENSIONS)
def signed(mesh: Path, points: Path, /, *, output: Output = None, sign: str = "auto", common: Asking = ASKING) -> None:
    """Compute the signed distance of each point to a mesh, negative inside.

    Args:
        mesh: A mesh file.
        points: Points ({formats}).
        output: {outputs}, or - for CSV on stdout; by default only a summary is printed.
        sign: Method that decides the sign: auto (by default; sheets, which enclose nothing, have theirs by the normals
            of their faces), pseudonormal, winding or parity.
    """
    check_output(output, force=common.force)
    surface, queries = _surface(mesh, common.device, common), _points(points, common)
    with step(f"querying {mesh}", quiet=common.json) as asking:
        found = surface.signed_distance(queries, sign=sign, progress=asking.progress)
    summary = _summary(len(queries), asking.started, surface.device)
    summary.update(
        sign_method=surface.sign_method if sign == "auto" else sign,
        sign_reason=surface.sign_reason if sign == "auto" else "asked for",
        inside=int((found.distance < 0).sum()),
        **spread("distance", found.distance),
    )
    deliver(queries, _closest(found), summary, output, json=common.json)


@app.command
@with_formats("rays", "r", outputs=OUTPUT_EXTENSIONS)
def ray(
    mesh: Path,
    rays: Path,
    /,
    *,
    output: Output = None,
    max_distance: float = math.inf,
    device: Device = None,
    columns: str | None = None,
    common: Common = DEFAULTS,
) -> None:
    """Find the first hit of each ray on a mesh.

    Args:
        mesh: A mesh file.
        rays: Origins and directions ({formats}): six columns, or two arrays in .npz.
        output: {outputs}, or - for CSV on stdout; by default only a summary is printed.
        max_distance: Length of the rays in world units; farther hits are misses (triangle_id -1).
        columns: From a table (.csv .xyz .txt): names of the six columns, origins first, as in px,py,pz,vx,vy,vz; by
            default their names tell.
    """
    check_output(output, force=common.force)
    surface = _surface(mesh, device, common)
    origins, directions = load_rays(rays, columns)
    announce_compiling()
    with step(f"querying {mesh}", quiet=common.json) as asking:
        found = surface.raycast(origins, directions, max_distance=max_distance, progress=asking.progress)
    summary = _summary(len(origins), asking.started, surface.device)
    hits = found.triangle_id >= 0
    summary.update(hits=int(hits.sum()), **spread("t", found.t[hits]))
    # Hits only: on misses t is inf, and inf * 0 would raise a warning.
    positions = np.full(origins.shape, np.nan)
    positions[hits] = origins[hits] + found.t[hits, None] * directions[hits]
    data = {
        "direction": directions,
        "t": found.t,
        "hit": positions,
        "triangle_id": found.triangle_id,
        "barycentric": found.barycentric,
    }
    deliver(origins, data, summary, output, json=common.json)


@app.command
@with_formats("points", "r", outputs=OUTPUT_EXTENSIONS)
def sample(
    volume: Path,
    points: Path,
    /,
    *,
    output: Output = None,
    grid: str | None = None,
    order: int = 1,
    gradient: Flag = False,
    common: Asking = ASKING,
) -> None:
    """Sample a volume at each point.

    Args:
        volume: A .vdb or .nvdb file.
        points: Points ({formats}).
        output: {outputs}, or - for CSV on stdout; by default only a summary is printed.
        grid: Name of the grid, if the file holds several.
        order: Interpolation: 0 nearest voxel, 1 trilinear.
        gradient: Also write the gradient.
    """
    check_output(output, force=common.force)
    require_kind(volume, "volume")
    field, queries = load_grid(volume, grid), _points(points, common)
    announce_compiling()
    with step(f"querying {volume}", quiet=common.json) as asking:
        values = np.asarray(field.sample(queries, order=order, device=common.device))
        data = {"value": values}
        if gradient:
            data["gradient"] = np.asarray(field.gradient(queries, order=order, device=common.device))
    summary = _summary(len(queries), asking.started, common.device or "default")
    summary["grid"] = field.info.name
    if values.ndim == 1:
        summary.update(spread("value", values))
    else:
        summary.update(spread("length", np.linalg.norm(values, axis=1)))
    deliver(queries, data, summary, output, json=common.json)


@app.command
@with_formats("points", "r", outputs=OUTPUT_EXTENSIONS)
def neighbors(
    cloud: Path,
    queries: Path | None = None,
    /,
    *,
    radius: float | None = None,
    nearest: int | None = None,
    output: Output = None,
    common: Asking = ASKING,
) -> None:
    """Find the points of a cloud within a radius of each query, the nearest ones, or the nearest within a radius.

    With a radius alone, the output holds the number of neighbors; a .npz output also holds the neighbors themselves, as
    offsets, indices and distance: those of query i are indices[offsets[i]:offsets[i + 1]]. With nearest, every output
    holds index and distance, in one column per neighbor.

    Args:
        cloud: The points to search ({formats}).
        queries: The query points; by default the points of the cloud, each of which then finds itself.
        radius: Search radius in world units; with nearest, the largest distance.
        nearest: Number of nearest points, 1 to 1024; missing ones have index -1 and distance inf.
        output: {outputs}, or - for CSV on stdout; by default only a summary is printed.
    """
    from geokit.points import NeighborGrid
    from geokit.points._io import TABLES

    if radius is None and nearest is None:
        from cyclopts import CycloptsError

        raise CycloptsError(msg="neither --radius nor --nearest is given; give one of them, or both")

    check_output(output, force=common.force)
    # The names may be those of one table, beside a file that says itself what its coordinates are.
    tables = [path for path in (cloud, queries) if path is not None and extension(path) in TABLES] or [cloud]
    found_points = _points(cloud, common, cloud in tables)
    query_points = found_points if queries is None else _points(queries, common, queries in tables)
    announce_compiling()
    with step(f"querying {cloud}", quiet=common.json) as asking:
        grid = NeighborGrid(found_points, None if nearest else radius, device=common.device)
        ragged: dict[str, Any] | None = None
        data: dict[str, Any] = {}
        if nearest is not None:
            found = (
                grid.knn(query_points, nearest) if radius is None else grid.hybrid(query_points, nearest, radius=radius)
            )
            counts = (found.indices >= 0).sum(axis=1, dtype=np.int32)
            data = {"index": found.indices, "distance": found.distance}
            if output is not None and output.suffix.lower() != ".npz":
                # In tables, an array of three columns would be named x, y and z.
                data = {f"{name}_{i}": column for name, array in data.items() for i, column in enumerate(array.T)}
        elif output is not None and output.suffix.lower() == ".npz":
            rows = grid.radius_search(query_points)
            counts = np.diff(rows.offsets).astype(np.int32)
            ragged = {"offsets": rows.offsets, "indices": rows.indices, "distance": rows.distance}
        else:
            counts = grid.count(query_points)
    summary = _summary(len(query_points), asking.started, grid.device)
    summary.update(
        cloud_points=len(found_points), radius=radius, neighbors=int(counts.sum()), **spread("count", counts)
    )
    deliver(query_points, {"count": counts, **data}, summary, output, json=common.json, ragged=ragged)


def _surface(path: Path, device: str | None, common: Common) -> Any:
    require_kind(path, "mesh")
    from geokit.mesh import Surface, load

    announce_compiling()
    with step(f"reading {path}", quiet=common.json):
        return Surface(load(path), device=device)


def _points(path: Path, common: Asking, is_table: bool = True) -> np.ndarray:
    cloud = load_cloud(path, common.finite_only, columns=common.columns if is_table else None)
    return np.asarray(cloud.points, dtype=np.float64)


def _closest(found: Any) -> dict[str, Any]:
    return {
        "distance": found.distance,
        "closest": found.points,
        "triangle_id": found.triangle_id,
        "barycentric": found.barycentric,
    }


def _summary(count: int, started: float, device: str) -> dict[str, Any]:
    seconds = time.perf_counter() - started
    return {"queries": count, "seconds": round(seconds, 4), "device": device}
