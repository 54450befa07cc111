"""Mesh files in and out, in the formats that geokit/formats/table.py lists."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geokit._warn import warn
from geokit.core.content_limit import content_limit, require_content
from geokit.core.files import atomic_path, extension, named_damage, refuse_empty, require_file
from geokit.core.interop.types import MeshLike
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import file_size, needs
from geokit.core.require import require_count, require_flag, require_path, require_text
from geokit.errors import InputError
from geokit.formats.file_content.references import allowed_folders
from geokit.formats.foreign import require_format
from geokit.formats.held import what_is_held
from geokit.formats.polygons import join
from geokit.formats.reading_defaults import default_step, default_tolerance
from geokit.formats.table import FORMATS, Format, extensions, module_of, with_formats
from geokit.mesh._transform import convert_unit
from geokit.mesh.attributes.derived import with_data
from geokit.mesh.model.data import checked_data
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.objects import require_mesh

MOST_STEPS = 1 << 31

# VTK writes these into memory first, and ends the process where it gets none. Its libraries are mapped at first use.
VTK_FORMATS, VTK_BYTES, VTK_MORE = (".vtp", ".vtu", ".vtk"), 220 << 20, 50 << 20

# Of what a writer makes on the way: for each face, and for each byte of attributes.
SAVE_BYTES = {
    ".ply": (80.0, 3.0), ".obj": (212.0, 0.0), ".off": (200.0, 0.0), ".stl": (250.0, 0.0), ".xdmf": (205.0, 7.0),
    ".vtp": (97.0, 4.6), ".vtk": (225.0, 5.0), ".vtu": (97.0, 3.25),
}  # fmt: skip


@needs(lambda path, **_: 5 * file_size(path))
@with_formats("mesh", "r", processed=[kind for kind in extensions("mesh", "r") if FORMATS[kind].process])
def load(
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    tolerance: float | None = None,
    step: int | None = None,
    reference_folders: Sequence[str | os.PathLike[str]] | None = None,
    trusted: bool = False,
    memory_limit: int | None = None,
) -> TriangleMesh:
    """Load a triangle mesh from a file; the extension determines the format.

    Positions are those of the file in float64, in the file's own units and axes. Nothing is merged, moved or dropped:
    unused vertices, duplicates and triangles without area stay. The one exception is .stl, which has no shared corners:
    exactly equal corners are merged. Polygons, also concave ones, are split into triangles that keep their winding. All
    bodies of a file are joined and named in ``parts``; each is moved by its transform (a mirrored body keeps its
    outside). From USD, visible prims of the default and render purposes are read at the default time. From files with
    volume cells, only the surface cells are read. Parts of CAD (.step, .iges) become triangles within 1e-4 of
    the diagonal of their box of the true faces, in millimeters.

    Normals, texture coordinates, colors and all other arrays of numbers come along, in the types of the file (colors of
    a .ply from 0 to 255 as uint8, but of uint16); only normals are turned by transforms. Where a body lacks an array
    that another one has, it is NaN there, 0 in integers, -1 in ``material``. Materials come from .obj (its .mtl), .glb
    or .gltf, .dae and .fbx. A UserWarning names what is left out: images and .mtl files that are missing, arrays that
    do not fit the mesh.

    .obj, .gltf, .xdmf, .dae, .fbx and USD files may refer to other files. Those are opened only if they are regular
    files in the file's own folder (after following symbolic links) or in ``reference_folders``.

    Other libraries read {processed}.
    Unless the file is trusted, they do so in a process of its own, with a limit on time and memory. A process that has
    imported the library is kept for a minute, so each further file takes some milliseconds longer than reading it does.

    Args:
        path: {formats}.
        name: The mesh's name; None is the file's name without its extension.
        tolerance: Of .step and .iges: largest distance between a curved face and its triangles [mm], for which Open
            CASCADE, whose estimate may be half of it, is asked for 0.4 of it; None for 1e-4 of the diagonal of the
            file's box.
        step: Of an .xdmf with a time series: which one, from 0, or from -1 back from the last; None reads files of one
            mesh only.
        reference_folders: Further folders in which files may lie that this one refers to.
        trusted: Whether a file for another library is known to be sound. It is then read in this process (all but
            .fbx), which saves a copy; a crash of the library is one of this process, and no limit on time and memory
            applies.
        memory_limit: Largest size of the decompressed content [bytes]; None is a hundred times the file's size, at
            least 1 GiB, and at most half of the free memory.
    Returns:
        TriangleMesh with at least one face.
    Raises:
        InputError: The extension is none of these, tolerance is not positive, or tolerance or step is given for another
            format.
        FileAccessError: The file is missing or not readable, or refers to a file outside the folders.
        FileFormatError: The file is truncated or damaged, has no faces, has an index out of range or a coordinate that
            is not finite, its content does not match its extension, it has no such step, or reading it takes too much
            memory or time.
        DeviceMemoryError: The content is larger than memory_limit.
        MissingDependencyError: A USD file without usd-core installed.
        WorkerError: The separate process did not start, or was killed from outside.
    Example:
        >>> load("data/samples/bracket.obj")
        TriangleMesh('bracket', 76 vertices, 152 faces)
    """
    if name is not None:
        require_text(name, "name")
    require_flag(trusted, "trusted")
    kind = require_format(path, "mesh", "r")
    if tolerance is not None:
        tolerance = require_finite_scalar(tolerance, "tolerance", low=0.0)
        if not FORMATS[kind].curved:
            raise InputError(f"tolerance: {kind} has no curved faces; leave it out, or simplify what was loaded")
    elif FORMATS[kind].curved:
        tolerance = default_tolerance()
    if step is not None:
        step = require_count(step, "step", -MOST_STEPS, MOST_STEPS)
        if not FORMATS[kind].series:
            raise InputError(f"step: {kind} holds no time series; leave it out")
    elif FORMATS[kind].series:
        step = default_step()
    options = {name: value for name, value in (("tolerance", tolerance), ("step", step)) if value is not None}
    path = require_file(path)
    refuse_empty(path)
    folders = allowed_folders(reference_folders)
    limit = content_limit(path.stat().st_size, memory_limit)
    with named_damage(path):
        module = module_of(kind)
        size = module.content_bytes(path) if hasattr(module, "content_bytes") else 0
        require_content(path, size or path.stat().st_size, limit)
        taken = folders if FORMATS[kind].references else None
        if not FORMATS[kind].process:
            bodies = module.read_mesh(path) if taken is None else module.read_mesh(path, taken)
        elif trusted and getattr(module, "IN_PROCESS", True):
            from geokit.formats.reader import trusted as in_process

            bodies = in_process.read_mesh(path, module, taken, options)
        else:
            from geokit.formats.reader import process as reader_process

            bodies = reader_process.read_mesh(path, module.__name__, limit, taken, options)
        return join(bodies, path, path.stem if name is None else name)


def _save_bytes(path: Any, mesh: TriangleMesh, point_data: Any = None, cell_data: Any = None) -> float:
    kind = extension(path)
    bytes_per_face, times_data = SAVE_BYTES.get(kind, (60.0, 1.0))
    held = (mesh.vertex_data, mesh.face_data, mesh.corner_data, point_data or {}, cell_data or {})
    data = sum(getattr(values, "nbytes", 0) for arrays in held for values in arrays.values())
    need = bytes_per_face * mesh.face_count + times_data * data
    if kind not in VTK_FORMATS or "pyvista" in sys.modules:
        return need
    return need + (VTK_MORE if "vtkmodules.vtkCommonCore" in sys.modules else VTK_BYTES)


@needs(_save_bytes, fatal=True)
@with_formats("mesh", "w", arrays=[kind for kind in extensions("mesh", "w") if FORMATS[kind].data])
def save(
    path: str | os.PathLike[str],
    mesh: MeshLike,
    *,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a mesh, with optional data on its vertices and faces; the extension determines the format.

    The file is replaced atomically: a reader sees either the old file or the new one. Positions keep float64 except in
    .stl, .glb, .gltf and USD, which store float32 (relative precision 6e-8 of the largest coordinate). Only .obj keeps
    the names of parts.

    The mesh's attributes are written where the format holds them:

    - {arrays} hold any arrays, .glb and .gltf on vertices only, .obj and .off normals, texture coordinates and
      colors.
    - .obj, .glb, .gltf and USD hold materials. An .obj with materials is written with an .mtl beside it. Images lie
      beside an .obj, .usd, .usda or .usdc; they are called after it. Of files of the same names they replace those to
      which the file that is replaced refers; others stay, and a number is added to the new names, with a UserWarning.
    - Where a format has no attributes of corners, a vertex is written once for each set of values of its corners.
    - Types change only where a format lacks them: .obj, .msh, .xdmf and USD write colors of integers as floats up to 1,
      .glb and .gltf numbers of 64 bits as float32, .msh all as float64. .ply writes colors of floats as uint8 where
      they are k / 255 exactly, since other programs take all colors of .ply for bytes. Others stay, with a
      UserWarning.
    - Signs that the format has not in names become "_": all but ASCII in .ply, all but letters and digits in USD.
    - .glb and .gltf are in meters with y up, .3mf is in the unit that it states with z up: a mesh whose
      ``meters_per_unit`` and ``up_axis`` are known is scaled and turned to that. Where the unit is not known, numbers
      stay, and a UserWarning says which unit the file states (a .3mf millimeters).

    One UserWarning names what the format does not hold; of a unit and the axis that is up, where files of the format
    are taken for others. Arguments that it does not hold are an error.

    Args:
        path: {formats}.
        mesh: The mesh.
        point_data: Arrays (V,) or (V, k) by name, in place of those of the mesh with these names.
        cell_data: Arrays (F,) or (F, k) by name, the same.
    Raises:
        InputError: An unknown extension, a mesh without faces, data for a format that cannot store it, data of a wrong
            shape or type, or coordinates that float32 cannot hold for a format of float32.
        FileAccessError: The target cannot be written.
        MissingDependencyError: A USD file without usd-core installed.
    Example:
        >>> bracket = load("data/samples/bracket.obj")
        >>> save("out.vtp", bracket, point_data={"height": bracket.vertices[:, 2]})
    """
    kind = require_format(path, "mesh", "w")
    written = FORMATS[kind]
    mesh = require_mesh(mesh, "mesh")
    if len(mesh.faces) == 0:
        raise InputError("mesh: has no faces; a mesh file without faces cannot be read back")
    points = checked_data(point_data, "point_data", (len(mesh.vertices),), "vertices")
    cells = checked_data(cell_data, "cell_data", (len(mesh.faces),), "faces")
    if (points and written.vertex != "*") or (cells and written.face != "*"):
        known = sorted(other for other in extensions("mesh", "w") if FORMATS[other].data)
        raise InputError(f"{path}: {kind} holds no data arrays; use one of {', '.join(known)}")
    if points or cells:
        mesh = with_data(mesh, vertex_data={**mesh.vertex_data, **points}, face_data={**mesh.face_data, **cells})
    mesh = _in_world_of(mesh, written, path)
    if written.float32:
        _require_float32(mesh, kind)
    module = module_of(kind)
    mesh, lost = what_is_held(mesh, written, module, kind)
    if lost:
        warn(f"{path}: {kind} does not hold {', '.join(lost)}; left out")
    target = require_path(path)
    stem, beside = _companions(module, mesh, target)
    if stem != target.stem:
        named = ", ".join(map(repr, beside))
        warn(f"{path}: files that it does not refer to have the names of its companions; these are {named}")
    with atomic_path(path) as part:
        module.write_mesh(part, mesh, *([stem] if beside else []))
        # None of the old files is replaced before all new ones are there.
        with contextlib.ExitStack() as stack:
            for name, content in beside.items():
                stack.enter_context(atomic_path(target.parent / name)).write_bytes(content)


def _in_world_of(mesh: TriangleMesh, written: Format, path: Any) -> TriangleMesh:
    """The mesh in the unit, and with the axis up, that a format has by its specification."""
    if not written.default_unit:
        return mesh
    if mesh.meters_per_unit is None:
        warn(
            f"{path}: the unit of the mesh is not known, and the file says {written.default_unit}; say it with "
            "convert_unit(mesh, from_unit=...)"
        )
    unit = None if written.unit or mesh.meters_per_unit is None else written.default_unit
    return convert_unit(mesh, unit, up_axis=mesh.up_axis and written.fixed_up)


def _companions(module: ModuleType, mesh: TriangleMesh, target: Path) -> tuple[str, dict[str, bytes]]:
    """The files beside a mesh file, and the stem of their names: they replace none that belongs to another file."""
    if not hasattr(module, "companions"):
        return target.stem, {}
    own: set[str] | None = None
    for number in itertools.count(1):
        stem = target.stem if number == 1 else f"{target.stem}_{number}"
        beside: dict[str, bytes] = module.companions(mesh, target.with_name(stem + target.suffix))
        differing = {name for name, content in beside.items() if _differs(target.parent / name, content)}
        if differing and own is None:
            own = module.companions_of(target) if target.is_file() else set()
        if own is None or differing <= own:
            break
    return stem, beside


def _differs(path: Path, content: bytes) -> bool:
    """Whether a regular file of this name holds something else."""
    try:
        return os.path.isfile(path) and (path.stat().st_size != len(content) or path.read_bytes() != content)
    except OSError:
        return True


def _require_float32(mesh: TriangleMesh, kind: str) -> None:
    largest = np.abs(mesh.vertices).max(axis=1)
    if largest.max() > np.finfo(np.float32).max:
        row = int(np.argmax(largest))
        raise InputError(
            f"mesh: vertex {row} ({mesh.vertices[row].tolist()}) is beyond the float32 of {kind}; save as .ply or .vtp"
        )
