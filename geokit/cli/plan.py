"""``geokit plan``: lists the costs of distance fields that keep a tolerance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from geokit.cli._kinds import Device, Flag, require_kind
from geokit.cli._program.console import announce_compiling, note, print_json, print_table, step

COLUMNS = ("made by", "levels", "order", "codec", "voxel size", "half width", "error", "MiB", "seconds")


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
    interior: str = "remove",
    device: Device = None,
    json: Flag = False,
) -> None:
    """List the distance fields of a mesh that keep a tolerance, with the memory, time and error to expect.

    The first line made by from_mesh is the field that ``geokit convert FILE OUT.nvdb --tolerance`` makes. The line made
    by adaptive_from_mesh, a function of the Python package, has several voxel sizes where that takes less memory.

    Args:
        file: A mesh.
        tolerance: Largest error of the interpolated distance, in world units.
        within: Distance from the surface up to which the tolerance holds, in world units; by default the tolerance
            itself, or a quarter of it for an open mesh.
        order: Order of interpolation: 1, 2 or 3; by default all.
        codec: Storage of the values: float, fp16, fp8, fp4 or fpn; by default all.
        half_width: Width of the band on each side, in voxels; by default the least that interpolation needs.
        sign: Method that decides inside or outside: auto, winding, pseudonormal, parity, or none.
        thickness: Make a solid shell of this thickness around the surface, in world units.
        interior: What happens to surface inside of solids: remove, or keep.
        json: Print JSON.
    """
    require_kind(file, "mesh")
    from geokit.mesh import load
    from geokit.volume import plan as make_plan

    announce_compiling()
    mesh = load(file)
    options: dict[str, Any] = {"within": within, "order": order, "codec": codec, "half_width": half_width}
    with step(f"planning for {file}", quiet=json) as planning:
        options |= {"sign": sign, "thickness": thickness, "interior": interior, "device": device}
        fields = make_plan(mesh, tolerance, **options, progress=planning.progress)
    if json:
        print_json({"file": str(file), "tolerance": tolerance, "fields": fields})
        return
    rows = [
        (
            f.method,
            f.level_count,
            f.order,
            f.codec,
            f.voxel_size,
            f.half_width,
            f.error,
            f.byte_count / 2**20,
            float(f"{f.seconds:.1e}"),
        )
        for f in fields
    ]
    print_table(COLUMNS, rows)
    note(
        "least memory first, of equal memory (to 5 %) the fastest to read; the first by from_mesh is what convert "
        "--tolerance makes; --order and --codec choose another"
    )
