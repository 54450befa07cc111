"""``geokit wrap``: a closed mesh around anything."""

from __future__ import annotations

import numpy as np

from geokit import mesh
from geokit.cli._kinds import Flag, called, load_cloud, may_write, refuse_unused, require_kind
from geokit.cli._program.console import announce_compiling, step
from geokit.cli._program.lengths import AnyLength, FromUnit, lengths_in, unit_of
from geokit.cli._results import ASKING, Asking, Changed, Source, deliver_mesh


def wrap(
    source: Source,
    target: Changed,
    /,
    *,
    tolerance: AnyLength,
    gap: AnyLength | None = None,
    offset: AnyLength | None = None,
    cavities: Flag = False,
    from_unit: FromUnit = None,
    common: Asking = ASKING,
) -> None:
    """Make a closed mesh around anything: a body with holes, loose triangles, sheets, or a point cloud.

    The input lies inside, and no point of the wrap is farther from it than the deviation that is printed. Bridges are
    faces where a gap was closed. Lengths are in the unit of the file, or have one: 0.5mm.

    Args:
        source: A mesh or a point cloud.
        tolerance: Largest distance of the wrap from the input, but where gaps are closed.
        gap: Largest width of holes to close in the walls of bodies; by default none.
        offset: How far the input is grown first: it lies this deep inside at least; by default not at all.
        cavities: Keep the walls of cavities, which are left out otherwise.
    """
    may_write(target, "mesh", force=common.force)
    kind = require_kind(source, "mesh", "cloud")
    announce_compiling()
    with step(f"reading {source}", quiet=common.json), called():
        if kind == "mesh":
            refuse_unused("on a mesh", columns=common.columns)
            found = mesh.load(source)
        else:
            points = load_cloud(source, common.finite_only, columns=common.columns).points
            found = mesh.TriangleMesh(points, np.repeat(np.arange(len(points))[:, None], 3, axis=1))
        found = mesh.convert_unit(found, from_unit=from_unit)
    meters = found.meters_per_unit
    how = lengths_in(meters, tolerance=tolerance, gap=gap, offset=offset)
    with step("wrapping", quiet=common.json), called(("^mesh(?=:)", source), ("^(?=(tolerance|offset):)", "--")):
        made = mesh.wrap(found, **how, cavities=cavities, device=common.device)
    facts = made._asdict() | {"bridges": int(made.bridges.sum())}
    deliver_mesh(facts.pop("mesh"), target, common, **unit_of(meters), **facts)
