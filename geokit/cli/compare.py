"""``geokit compare``: how far a scan is from its design."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from geokit import mesh, points
from geokit.cli._batches.report import table, write_page
from geokit.cli._kinds import Flag, called, load_cloud, refuse_unused, require_kind
from geokit.cli._points import DEFAULT_COUNT
from geokit.cli._program.console import announce_compiling, shown, step
from geokit.cli._program.lengths import AnyLength, FromUnit, lengths_in, unit_of
from geokit.cli._results import ASKING, OUTPUT_EXTENSIONS, Asking, check_output, deliver, spread
from geokit.core.files import extension
from geokit.core.require import require_one_world
from geokit.errors import InputError
from geokit.formats.table import FORMATS, with_formats
from geokit.render.looks.color_maps import color_table

# Bars of a histogram, and the size of its picture [pixels].
BINS, WIDTH, HEIGHT = 48, 720, 140
# Of the deviations that have colors of their own without --limit.
PERCENT = 99


@with_formats("points", "r", outputs=OUTPUT_EXTENSIONS)
def compare(
    scan: Path,
    design: Path,
    result: Annotated[Path | None, Parameter(name="OUT")] = None,
    /,
    *,
    limit: AnyLength | None = None,
    align: Flag = False,
    from_unit: FromUnit = None,
    common: Asking = ASKING,
) -> None:
    """Measure how far a scan is from its design: negative inside of it, and behind the faces of an open one.

    Args:
        scan: A point cloud, or a mesh, on whose surface 100,000 points are taken.
        design: A mesh in the same unit.
        result: A page (.html) with a map, a histogram and the numbers, or the points with their deviations ({outputs});
            by default only the numbers are printed.
        limit: Deviation that is allowed, in the unit of the files or with its own, as in 0.1mm: the share of points
            beyond it is printed, and the colors of the page end there.
        align: Move the scan to the design first, as a rigid body; its place has to be about right.
    """
    check_output(result, ".html", force=common.force)
    kind = require_kind(scan, "mesh", "cloud")
    require_kind(design, "mesh")
    announce_compiling()
    names = ("^SCAN(?=:)", scan), ("(?<= of )DESIGN(?=;)", design)
    with step(f"reading {scan} and {design}", quiet=common.json), called(*names):
        world = {"DESIGN": mesh.convert_unit(mesh.load(design), from_unit=from_unit)}
        if kind == "cloud":
            cloud = load_cloud(scan, common.finite_only, columns=common.columns)
        else:
            refuse_unused("on a mesh", columns=common.columns)
            world["SCAN"] = mesh.load(scan)
            cloud = points.sample(world["SCAN"], DEFAULT_COUNT)
        meters = require_one_world(**world)["meters_per_unit"]
    if not len(cloud):
        raise InputError(f"{scan}: has no points; there is nothing to compare")
    allowed = lengths_in(meters, limit=limit)
    at, facts = np.asarray(cloud.points, dtype=np.float64), {"points": len(cloud), **unit_of(meters)}
    with step("comparing", quiet=common.json), called(("^max_distance", "--align"), ("; raise it.*", "; leave it out")):
        surface = mesh.Surface(world["DESIGN"], device=common.device)
        if align:
            placed = points.register(at, surface)
            if placed.rmse > 0.0:  # again without what is damaged, which pulls the scan to its side
                placed = points.register(at, surface, initial=placed.transform, max_distance=3.0 * placed.rmse)
            at = at @ placed.transform[:3, :3].T + placed.transform[:3, 3]
            facts |= {f"align_{name}": getattr(placed, name) for name in ("transform", "rmse", "fitness", "rank")}
        off = np.asarray(surface.signed_distance(at).distance)
    facts |= {"sign_reason": surface.sign_reason, **spread("deviation", off)}
    facts |= {"deviation_min_at": at[np.argmin(off)], "deviation_max_at": at[np.argmax(off)]}
    if allowed:
        facts |= {**allowed, "beyond_limit": float(np.mean(np.abs(off) > allowed["limit"]))}
    if result is not None and extension(result) == ".html":
        from geokit.render._camera import up_of

        far = allowed.get("limit") or float(np.percentile(np.abs(off), PERCENT)) or 1.0
        body = _page(at, off, far, facts, up_of(world["DESIGN"], FORMATS[extension(design)].up))
        write_page(result, f"{scan.name} against {design.name}", body)
        facts["output"], result = str(result), None
    deliver(at, {"deviation": off}, facts, result, json=common.json)


def _page(at: Any, off: Any, far: float, facts: dict[str, Any], up: str) -> str:
    """A map, a histogram in its colors up to a deviation, and the numbers."""
    from geokit.points import PointCloud
    from geokit.render import view

    def color(at: Any) -> Any:
        """Of numbers from 0 to 1, or beyond."""
        return colors[np.clip(np.floor(at * len(colors)), 0, len(colors) - 1).astype(int)]

    colors = color_table("coolwarm")
    rgb = color(0.5 + 0.5 * off / far)
    scene = view(PointCloud(at, {"deviation": off, "rgb": rgb}), names=["scan"], colormap="coolwarm", up=up)
    # What is farther away is in the outermost bars, as it has the outermost colors.
    counts, edges = np.histogram(np.clip(off, -far, far), bins=BINS, range=(-far, far))
    side = WIDTH / BINS
    bars = [
        f'<rect x="{bar * side:.1f}" y="{HEIGHT - high:.1f}" width="{side - 1:.1f}" height="{high:.1f}" '
        f'fill="#{bytes(color((bar + 0.5) / BINS)).hex()}">'
        f"<title>{edges[bar]:.4g} to {edges[bar + 1]:.4g}: {counts[bar]:,}</title></rect>"
        for bar, high in enumerate(HEIGHT * counts / counts.max())
    ]
    rows = [(name.replace("_", " "), shown(value)) for name, value in facts.items()]
    head = f"<h2>Deviation from {-far:.4g} to {far:.4g}</h2>"
    return f"{scene._repr_html_()}{head}<svg width={WIDTH} height={HEIGHT}>{''.join(bars)}</svg>{table(('', ''), rows)}"
