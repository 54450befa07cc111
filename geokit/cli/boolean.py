"""``geokit boolean``: what closed meshes enclose together, alone or in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Parameter

from geokit import mesh
from geokit.cli._kinds import called, may_write, require_kind
from geokit.cli._program.console import step
from geokit.cli._program.lengths import unit_of
from geokit.cli._results import DEFAULTS, Common, deliver_mesh
from geokit.errors import InputError

app = App(name="boolean", help="Unite, subtract or intersect closed meshes.")

Files = Annotated[Path, Parameter(name="FILES", help="The meshes to read, then the one to write.")]


def _combining(name: str, least: int, text: str) -> None:
    """Add a command that reads at least so many meshes."""

    def run(*files: Files, common: Common = DEFAULTS) -> None:
        if len(files) <= least:
            raise CycloptsError(msg=f"{name}: {len(files)} files given; name {least} or more to read, and one to write")
        *sources, target = files
        may_write(target, "mesh", force=common.force)
        for source in sources:
            require_kind(source, "mesh")
        names: list[Any] = [(rf"others\[{number}\]", source) for number, source in enumerate(sources[1:])]
        names += [("^mesh(?=:)|(?<= of )mesh(?=;)", sources[0])]
        names += [("; (repair|close) .*", "; geokit wrap makes a closed body of it")]
        with step(f"combining {', '.join(map(str, sources))}", quiet=common.json):
            meshes = [mesh.load(source) for source in sources]
            with called(*names):
                made = getattr(mesh, name)(*meshes)
        if not made.face_count:
            raise InputError(f"{target}: the {name} is empty; nothing is written")
        found, unit = mesh.audit(made), unit_of(made.meters_per_unit)
        open_edges = {"boundary_edge_count": found.boundary_edge_count}
        size = {"volume": found.signed_volume} if found.watertight else open_edges
        deliver_mesh(made, target, common, **unit, area=found.area, **size)

    run.__doc__ = text
    app.command(run, name=name)


_combining("union", 1, "Write what meshes enclose together, or the bodies of one mesh: IN ... OUT.")
_combining("difference", 2, "Write what the first mesh encloses, and no other one does: IN IN ... OUT.")
_combining("intersection", 2, "Write what all meshes enclose: IN IN ... OUT.")
