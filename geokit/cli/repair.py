"""``geokit repair``: vertices merged, faces wound alike, holes filled."""

from __future__ import annotations

from geokit import mesh
from geokit.cli._kinds import Flag, called, may_write, require_kind
from geokit.cli._program.console import step
from geokit.cli._program.lengths import AnyLength, FromUnit, lengths_in, unit_of
from geokit.cli._results import DEFAULTS, Changed, Common, Source, deliver_mesh


def repair(
    source: Source,
    target: Changed,
    /,
    *,
    tolerance: AnyLength | None = None,
    max_width: AnyLength | None = None,
    fair: Flag = False,
    untangle: int | None = None,
    from_unit: FromUnit = None,
    common: Common = DEFAULTS,
) -> None:
    """Merge vertices, drop faces that are none, wind faces alike, and fill holes. What is sound stays as it is.

    Lengths are in the unit of the file, or have one: 0.5mm.

    Args:
        source: The mesh to repair.
        tolerance: Distance within which vertices are merged; by default only those at one place are.
        max_width: Holes wider than this stay open; by default all are filled.
        fair: Whether to make patches as smooth as what is around them.
        untangle: Rings of faces that are cut out at most where the mesh crosses itself; by default it may.
    """
    may_write(target, "mesh", force=common.force)
    require_kind(source, "mesh")
    names = ("^mesh(?=:)", source), ("^rings(?=:)", "--untangle"), ("repair first, more rings", "a larger --untangle")
    with step(f"repairing {source}", quiet=common.json), called(*names):
        found = mesh.convert_unit(mesh.load(source), from_unit=from_unit)
        meters = found.meters_per_unit
        lengths = lengths_in(meters, tolerance=tolerance, max_width=max_width)
        made, *counts, holes = mesh.repair(found, **lengths, fair=fair)
        facts: dict[str, float] = dict(zip(("merged", "dropped", "flipped"), counts, strict=True))
        if untangle is not None:
            made, _, *cut = mesh.remove_self_intersections(made, rings=untangle)
            facts |= zip(("faces_cut", "places", "deviation"), cut, strict=True)
        audit = mesh.audit(made, self_intersections=True)
    left = {"faired": int(holes.faired.sum())} if fair else {}
    left |= {"open": int((~holes.filled).sum()), "non_manifold_edges": audit.non_manifold_edge_count}
    left |= {"crossing_pairs": int(audit.self_intersection_count or 0), "watertight": audit.watertight}
    deliver_mesh(made, target, common, **unit_of(meters), **facts, filled=int(holes.filled.sum()), **left)
