"""``geokit hollow``: a closed part with walls of one thickness, and holes through which it drains."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from cyclopts import CycloptsError

from geokit import mesh, volume
from geokit.cli._kinds import Device, called, may_write, require_kind
from geokit.cli._program.console import announce_compiling, note, step
from geokit.cli._program.lengths import AnyLength, FromUnit, Places, length_in, lengths_in, unit_of
from geokit.cli._results import DEFAULTS, Changed, Common, Source, deliver_mesh, spread
from geokit.core.memory.available_memory import require_room
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.mesh import Surface, TriangleMesh

# With voxels of a fifth of the wall, its thickness is right to about a twentieth of a voxel on smooth parts.
VOXELS_IN_WALL = 5
# From a corner of a box the cavity is the square root of 3 walls away; beyond twice the wall the part is solid.
MOST_WALLS = 2.0
# Memory for each face of the result, with the bands around it. Faces from which their number is said first.
BYTES_PER_FACE = 330
MANY_FACES = 1_000_000


def hollow(
    source: Source,
    target: Changed,
    /,
    *,
    wall: AnyLength,
    voxel_size: AnyLength | None = None,
    drain: Places | None = None,
    drain_radius: AnyLength | None = None,
    from_unit: FromUnit = None,
    device: Device = None,
    common: Common = DEFAULTS,
) -> None:
    """Hollow a closed part, and measure its walls. Lengths are in the unit of the file, or have one: 2mm, 0.1in.

    What is thinner than two walls stays solid. Closed cavities are those that no drain opens.

    Args:
        source: A closed mesh.
        wall: Thickness of the walls.
        voxel_size: Edge length of the voxels; by default a fifth of the wall.
        drain: A place on the surface where a hole goes through the wall, as in 20,0,-8; may be given several times.
        drain_radius: Radius of these holes.
    """
    if (drain is None) != (drain_radius is None):
        raise CycloptsError(msg="--drain and --drain-radius go together; give both, or none")
    may_write(target, "mesh", force=common.force)
    require_kind(source, "mesh")
    announce_compiling()
    remedy = "; geokit wrap makes a closed body of it"
    names = ("^.*(?=: its union)", source), ("(?<=: its union)(.*); repair .*", rf"\1{remedy}")
    with step(f"reading {source}", quiet=common.json), called(*names):
        # Walls are measured from what bounds the body: bodies that overlap count once.
        part = mesh.union(mesh.convert_unit(mesh.load(source), from_unit=from_unit))
        audit = mesh.audit(part)
    if not audit.watertight:
        wrong = audit.boundary_edge_count + audit.non_manifold_edge_count
        raise InputError(
            f"{source}: is not closed: {wrong} edges are not those of two faces; geokit repair fills holes{remedy}"
        )
    meters = part.meters_per_unit
    sizes = lengths_in(meters, wall=wall, voxel_size=voxel_size, drain_radius=drain_radius)
    thick, radius = sizes["wall"], sizes.get("drain_radius", 0.0)
    voxel = sizes.get("voxel_size", thick / VOXELS_IN_WALL)
    # Each edge of a voxel that a surface crosses makes two faces, and there are two surfaces.
    a, b, c = part.vertices[part.faces].swapaxes(0, 1)
    count = 2.0 * float(np.abs(np.cross(b - a, c - a)).sum()) / voxel**2
    size = f"{thick:g} in voxels of {voxel:g} makes about {count:,.0f} faces"
    fitting = "give --wall {:.2g} or more, or --voxel-size {:.2g} or more".format
    # The number of faces goes with the square of the voxels.
    more = 1.05 * np.array([thick, voxel])
    require_room(BYTES_PER_FACE * count, f"--wall: {size}, which need", lambda times: fitting(*(times**0.5 * more)))
    if count > MANY_FACES and not common.json:
        note(f"a wall of {size}; larger voxels (--voxel-size) make fewer")
    with step("hollowing", quiet=common.json):
        surface = mesh.Surface(part, device=device)
        solid = volume.from_mesh(surface, voxel)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that nothing is left, which is refused below
            cavity = volume.offset(solid, -thick, device=device)
            inside = mesh.from_volume(cavity, device=device)
        if not inside.face_count:
            raise InputError(
                f"--wall: no place of {source} is {thick:g} deep; give thinner walls, so that some is hollow"
            )
        inner = mesh.Surface(inside, device=device)
        places = np.reshape([length_in(meters, axis, "drain") for axis in drain or ()], (-1, 3))
        tubes = [_tube(place, surface, inner, thick, radius) for place in places]
        holes = [volume.from_mesh(tube, voxel, device=device) for tube in tubes]
        grids = volume.difference(solid, cavity, *holes), solid
        made, whole = (mesh.from_volume(grid, method="dual_contouring", device=device) for grid in grids)
        depth = -np.asarray(surface.signed_distance(made.vertices).distance)
        is_wall = depth > 0.5 * thick
        for tube in tubes:  # around a drain the depth is that of the hole
            is_wall &= np.asarray(mesh.Surface(tube, device=device).signed_distance(made.vertices).distance) > radius
        closed = sum(piece.volume < 0.0 for piece in mesh.split(made))
    walls = spread("wall", depth[is_wall])
    facts = {"voxel_size": voxel, **{key: walls[key] for key in ("wall_min", "wall_max") if walls}}
    facts |= {"material": made.volume / whole.volume, "closed_cavities": closed}
    deliver_mesh(made, target, common, **unit_of(meters), **facts)


def _tube(place: Any, outer: Surface, inner: Surface, wall: float, radius: float) -> TriangleMesh:
    """A cylinder through the wall at a place, along the shortest way to the cavity."""
    found = outer.closest_point(place[None])
    start, told = found.points[0], "--drain: {:g},{:g},{:g}".format(*place)
    if found.distance[0] > wall:
        nearest = "{:g},{:g},{:g}".format(*start)
        raise InputError(f"{told} is {found.distance[0]:g} away from the surface; the nearest place there is {nearest}")
    below = inner.closest_point(found.points)
    depth = float(below.distance[0])
    if depth > MOST_WALLS * wall:
        raise InputError(f"{told} is {depth:g} away from the cavity; choose a place where the part is hollow")
    way = (below.points[0] - start) / depth
    # The axis of z turns to the way, up to its sign. From 1.5 walls before the surface to half a wall behind the wall.
    turned = np.linalg.qr(np.column_stack([way, np.eye(3)]))[0][:, [1, 2, 0]]
    pose = np.eye(4)
    pose[:3] = np.column_stack([turned, start + 0.5 * (depth - wall) * way])
    return mesh.transform(mesh.cylinder(radius, depth + 2.0 * wall), pose)
