"""``geokit plan``: what a distance field within a tolerance would cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from geokit.cli._console import announce_compiling, note, print_json, print_table, step
from geokit.cli._kinds import kind_of_input
from geokit.errors import InputError

__all__ = ["plan"]

COLUMNS = ("order", "codec", "voxel size", "half width", "error", "MiB", "seconds")


def plan(
    file: Path,
    /,
    *,
    tolerance: float,
    within: float | None = None,
    order: int | None = None,
    codec: str | None = None,
    half_width: float | None = None,
    sign: str = "auto",
    thickness: float | None = None,
    device: str | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> None:
    """List the distance fields of a mesh that keep a tolerance, with the memory, time and error to expect.

    The first line is what ``geokit convert FILE OUT.nvdb --tolerance`` makes.

    Args:
        file: A mesh.
        tolerance: Largest error of the interpolated distance, in world units.
        within: How far from the surface it holds, in world units; the tolerance itself where not given, a quarter of it
            where the mesh is open.
        order: Order of interpolation: 1, 2 or 3; all where not given.
        codec: How values are stored: float, fp16, fp8, fp4 or fpn; all where not given.
        half_width: Width of the band on each side, in voxels; as little as interpolation needs where not given.
        sign: How inside is told from outside: auto, winding, pseudonormal, parity, or none.
        thickness: Of a solid shell around the surface, in world units.
        device: Where to compute: cpu, cuda:0, ...; the first GPU where not given.
        json: Print JSON.
    """
    if kind_of_input(file) != "mesh":
        raise InputError(f"{file}: not a mesh; plans are made for distance fields of meshes")
    from geokit.mesh import load
    from geokit.volume import plan as make_plan

    announce_compiling()
    mesh = load(file)
    options: dict[str, Any] = {"within": within, "order": order, "codec": codec, "half_width": half_width}
    with step(f"planning for {file}", quiet=json):
        fields = make_plan(mesh, tolerance, **options, sign=sign, thickness=thickness, device=device)
    if json:
        print_json({"file": str(file), "tolerance": tolerance, "fields": fields})
        return
    rows = [
        (f.order, f.codec, f.voxel_size, f.half_width, f.error, f.byte_count / 2**20, float(f"{f.seconds:.1e}"))
        for f in fields
    ]
    print_table(COLUMNS, rows)
    note("the first is what convert --tolerance makes; --order and --codec choose another")
