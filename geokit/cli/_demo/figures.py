"""Figures of the demo."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit import render
from geokit.accuracy.report.table import write_rows
from geokit.cli._demo.input import Camera
from geokit.cli._demo.steps import AccuracyPoint, DemoLog, Neighborhood, Projection
from geokit.mesh.model.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from geokit.mesh import RayHits
    from geokit.volume.model.sparse_volume import SparseVolume

FIGURES = ("surface.png", "raycast.png", "slice.png", "neighbors.png")
# Number of projected points in the figure; more of them could not be told apart.
SHOWN_POINTS = 400
# The color map ends at this quantile of the values; otherwise a few outliers would leave the rest in one color.
SHOWN_SHARE = 0.995
# The same for neighbor counts, which have a longer tail.
SHOWN_SHARE_OF_COUNTS = 0.95


def draw_figures(
    figure_format: str,
    log: DemoLog,
    folder: Path,
    *,
    extracted: TriangleMesh,
    deviation: NDArray[np.float64],
    projection: Projection,
    image: tuple[Camera, "RayHits"],
    mesh: TriangleMesh,
    volume: "SparseVolume",
    neighborhood: Neighborhood,
) -> None:
    with log.step("draw the figures", "figures") as entry:
        top = float(np.quantile(deviation, SHOWN_SHARE)) or 1.0
        render.figure(
            folder / "surface.png",
            mesh=extracted,
            color=deviation,
            points=projection.points[:SHOWN_POINTS],
            point_color="#d1495b",
            point_size=5.0,
            label="distance",
            value_limits=(0.0, top),
        )
        _draw_rays(folder / "raycast.png", mesh, *image)
        render.slice(
            folder / f"slice.{figure_format}",
            volume,
            axis="z",
            label="signed distance",
            title="Signed distance, middle slice",
        )
        render.figure(
            folder / "neighbors.png",
            points=neighborhood.points,
            color=neighborhood.counts,
            label="neighbors",
            point_size=3.0,
            value_limits=(0.0, float(np.quantile(neighborhood.counts, SHOWN_SHARE_OF_COUNTS))),
        )
        entry.count = len(FIGURES)


def _draw_rays(path: Path, mesh: TriangleMesh, camera: Camera, hits: "RayHits") -> None:
    shape = (camera.height, camera.width)
    depth = np.where(np.isfinite(hits.t), hits.t, np.nan).reshape(shape)
    colors = 0.5 + 0.5 * mesh.face_normals[hits.triangle_id]
    colors[hits.triangle_id < 0] = 1.0
    panels = {"depth": depth, "normal": colors.reshape(*shape, 3)}
    render.image(path, panels, size=(1280, 480), label="distance along the ray", colormap="viridis_r")


def accuracy_chart(target: Path, measured: list[AccuracyPoint], exact_seconds: float, sample_count: int) -> None:
    """Write the chart, and accuracy.csv beside it with the numbers."""
    columns = (*AccuracyPoint.__dataclass_fields__, "samples", "exact_bvh_seconds")
    rows = [(*dataclasses.astuple(point), sample_count, exact_seconds) for point in measured]
    write_rows(target.with_suffix(".csv"), columns, rows)
    seconds = [point.build_seconds + point.sample_seconds for point in measured]
    notes = [f"{point.voxel_size:.2g}" for point in measured]
    render.chart(
        target,
        [
            render.Series("largest error", seconds, [point.largest_error for point in measured], notes),
            render.Series("root mean square error", seconds, [point.rms_error for point in measured]),
        ],
        x_label=f"seconds to build the SDF and sample {sample_count:,} points",
        y_label="error against the exact distance [world]",
        title=f"SDF samples by voxel size; exact BVH distances take {exact_seconds:.2f} s",
    )
