"""Kinds of files by name and content, and the check before one is replaced."""

from __future__ import annotations

import contextlib
import csv
import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from geokit import points
from geokit.cli._program.console import note
from geokit.core.files import extension, require_file
from geokit.errors import GeokitError, InputError
from geokit.formats.foreign import refuse_foreign, require_format
from geokit.formats.table import FORMATS, SPARSE, STAGES, Content, image_module, module_of, volume_kind

if TYPE_CHECKING:
    from geokit.points._io import PointCloud, Rays
    from geokit.volume.model.sparse_volume import SparseVolume

Kind = Literal["mesh", "volume", "cloud"]
UpAxis = Annotated[Literal["x", "y", "z", "-x", "-y", "-z"], Parameter(allow_leading_hyphen=True)]
_TABLE = "From a table of points (.csv .xyz .txt): names of the columns of x, y and z, as in east,north,up; by default "
Columns = Annotated[str | None, Parameter(help=_TABLE + "their names tell.")]
_FINITE = "Leave out points that are not finite, with a notice; --no-finite-only refuses such files."
Flag = Annotated[bool, Parameter(negative="")]
FiniteOnly = Annotated[bool, Parameter(negative="--no-finite-only", help=_FINITE)]
_DEVICE = "Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU."
Device = Annotated[str | None, Parameter(help=_DEVICE)]

# Headers of .ply end within this; the counts in a .vtp stand in its first element.
_HEAD_BYTES = 1 << 16
# How the library's messages name parameters of clouds, and how the user knows them.
_OPTIONS = (
    ("finite_only=True", "--finite-only"),
    ("with grid=", "with --grid"),
    (r"columns=\(([^)]*)\)", lambda found: "--columns " + re.sub("[' ]*,[' ]*", ",", found[1]).strip("'")),
    ("^columns:", "--columns:"),
)
_UNITS = (
    ("^from_unit(?=:)|(?<=give )from_unit", "--from-unit"),
    (r"mesh\.convert_unit(?= gives)", "geokit convert --unit"),
)
# Parts of USD's names for fields in .vdb files, which are compressed in .usdc.
_VOLUMES = (b"OpenVDB", b"field:")


def kind_of_input(path: Path, grid: str | None = None) -> Kind:
    """Return the kind of an existing file; .ply and .vtp files without faces are point clouds, .npy tables too.

    Args:
        path: The file.
        grid: Of a .vdb, which may hold volumes and points: the grid that is meant; None for all.

    Raises:
        FileAccessError: The file is missing or unreadable.
        InputError: The extension is unknown.
    """
    if volume_kind(path):
        return "volume"
    require_file(path)
    if extension(path) not in FORMATS:
        refuse_foreign(path)
    kind = kind_of_output(path)
    if extension(path) == ".vdb":
        return "cloud" if _holds_points(path, grid) else "volume"
    if extension(path) in STAGES:
        return "volume" if _holds_volumes(path) else "mesh"
    if kind == "volume" and FORMATS[extension(path)].points and not image_module(extension(path)).is_volume(path):
        return "cloud"
    return "cloud" if kind == "mesh" and _lacks_faces(path) else kind


def require_kind(path: Path, *wanted: Kind) -> Kind:
    """Return the kind of an existing file, which has to be one of some.

    Raises:
        InputError: It is another one.
    """
    found, needed = kind_of_input(path), " or a ".join(wanted)
    if found not in wanted:
        raise InputError(f"{path}: holds a {found}, and this command needs a {needed}; geokit convert makes one of it")
    return found


def kind_of_output(path: Path) -> Kind:
    """Return the kind of file that a name stands for.

    Raises:
        InputError: The extension is unknown.
    """
    kind = extension(path)
    if kind not in FORMATS:
        listed = ", ".join(sorted(FORMATS))
        raise InputError(f"{path}: '{kind or 'no extension'}' is not a known format; use one of {listed}")
    found = FORMATS[kind]
    return "mesh" if found.mesh else "volume" if found.volume else "cloud"


def _lacks_faces(path: Path) -> bool:
    """Whether a file that may be a mesh or a cloud announces no faces; False where that cannot be told."""
    kind = extension(path)
    if not FORMATS[kind].points:
        return False
    lacks_faces = getattr(module_of(kind), "lacks_faces", None)
    if lacks_faces is None:
        return False
    with open(path, "rb") as file:
        return bool(lacks_faces(file.read(_HEAD_BYTES)))


def _holds_points(path: Path, grid: str | None) -> bool:
    """Whether all grids of a .vdb that are meant hold points. A file that does not begin with points is not asked."""
    from geokit import native
    from geokit.native._metadata import POINTS

    with open(path, "rb") as file:
        if grid is None and POINTS.encode() not in file.read(_HEAD_BYTES):
            return False
    if not native.available():
        return False
    found = [one["grid_type"] for one in native.inspect_vdb(path) if grid in (None, one["name"])]
    return set(found) == {"points"}


def _holds_volumes(path: Path) -> bool:
    """Whether a USD stage holds volumes and nothing else. One that names no .vdb files is not asked."""
    from geokit.core.content_limit import content_limit

    with open(path, "rb") as file, contextlib.suppress(ValueError):  # an empty file cannot be mapped
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            named = any(content.find(word) >= 0 for word in _VOLUMES)
        if named:
            from geokit.volume.images.stage import has_volumes_only

            return has_volumes_only(path, content_limit(path.stat().st_size))
    return False


def may_write(path: Path, content: Content | None = None, *, force: bool) -> None:
    """Check that a file may be written, before the work for it.

    Raises:
        InputError: The extension is none in which ``content`` is written, or the file exists and ``force`` is not
            given.
    """
    if content is not None:
        require_format(path, content, "w")
    if path.exists() and not force:
        raise InputError(f"{path}: exists already; add --force to replace it")


def refuse_unused(where: str, **options: Any) -> None:
    """Refuse the first of the options that is given: it has no effect there, as in "on a mesh"."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"--{name.replace('_', '-')}: has no effect {where}; leave it out")


def load_cloud(
    path: Path, finite_only: bool = True, grid: str | None = None, columns: str | None = None
) -> "PointCloud":
    """Load a point cloud; points that are not finite, as sensors write them for rays without an echo, are left out.

    Args:
        path: The file.
        finite_only: False refuses a file with such points.
        grid: Of a .vdb: name of the grid of points; None for the only one.
        columns: Of a table: names of the columns of x, y and z, with commas between; None finds them.
    Raises:
        FileFormatError: The file is damaged, or has such points.
        InputError: A .vdb has no such grid, or several and no name is given.
    """
    from geokit.points._io import load_counted

    with called(*_OPTIONS):
        cloud, left_out = load_counted(path, grid=grid, columns=_split(columns), finite_only=finite_only)
    if left_out:
        total = left_out + len(cloud.points)
        note(f"{path}: {left_out} of its {total} points are not finite and are left out (--finite-only, the default)")
    return cloud


def load_rays(path: Path, columns: str | None = None) -> "Rays":
    """Load rays; ``columns`` names those of a table, as for :func:`load_cloud`.

    Raises:
        FileFormatError: The file is damaged or holds no rays.
        InputError: Columns are not six names of the table's.
    """
    with called(*_OPTIONS):
        return points.load_rays(path, columns=_split(columns))


def _split(columns: str | None) -> list[str] | None:
    return None if columns is None else next(csv.reader([columns], skipinitialspace=True))


def load_shown(
    path: Path, kind: Kind, grid: str | None, finite_only: bool, columns: str | None, up: str | None
) -> tuple[Any, str]:
    """What a file of a kind holds, for a picture, and the axis that points up there: ``up``, if that is given."""
    from geokit.render._camera import up_of, up_of_points

    usual = FORMATS[extension(path)].up
    if kind == "volume":
        return load_grid(path, grid, as_floats=True), up or usual
    if kind == "mesh":
        from geokit.mesh import load

        mesh = load(path)
        return mesh, up or up_of(mesh, usual)
    cloud = load_cloud(path, finite_only, grid if extension(path) == ".vdb" else None, columns)
    return cloud, up or up_of_points(cloud.points, usual)


@contextlib.contextmanager
def called(*names: tuple[Any, Any]) -> Iterator[None]:
    """Let the library's messages name options and files, which the user knows, and not its parameters.

    Args:
        names: Regular expressions, and what is put in their place as by ``re.sub``, or a file.
    """
    try:
        yield
    except GeokitError as error:
        told = str(error)
        for pattern, name in (*names, *_UNITS):
            told = re.sub(pattern, str(name).replace("\\", "\\\\") if isinstance(name, Path) else name, told)
        raise type(error)(told) from error


def grid_names(path: Path, name: str | None) -> list[str] | None:
    """Names of all grids of a file if ``name`` is "all" and none of them is called so; None if it means one grid."""
    if name != "all":
        return None
    from geokit.volume import inspect
    from geokit.volume._io import unique_names

    names = unique_names([one.name for one in inspect(path)])
    return None if name in names else names


def load_grid(
    path: Path,
    name: str | None,
    *,
    background: float | None = None,
    tolerance: float | None = None,
    as_floats: bool = False,
    bounds: Any = None,
    remedy: str = "--grid chooses another",
) -> "SparseVolume":
    """Load the grid called ``name``, or the only grid of the file.

    Args:
        path: The file.
        name: Of the grid; None for the only one.
        background: Of a dense volume.
        tolerance: Around it.
        as_floats: Of a dense volume, whether to read whole numbers as floats, which have isosurfaces.
        bounds: Box [world] of the part to load.
        remedy: What the notice of grids that are left out ends with.

    Raises:
        InputError: No grid has that name, or no name was given and there are several grids.
    """
    from geokit.volume import inspect, load
    from geokit.volume.nanovdb.types import TYPES

    dense: Any = {"background": background, "tolerance": tolerance or 0.0}
    with called(_OPTIONS[1]):
        if as_floats and (volume_kind(path) or extension(path)) not in (*SPARSE, *STAGES):
            whole = {kind.name for kind in TYPES if kind.family in ("integer", "bool", "mask")}
            dense["grid_type"] = "float" if {one.grid_type for one in inspect(path)} <= whole else None
        volume = load(path, grid=name, bounds=bounds, **dense)
        if name is None and volume.info.name == "density" and len(found := inspect(path)) > 1:
            left_out = ", ".join(repr(one.name) for one in found if one.name != "density")
            note(f"{path}: has several grids, and 'density' is taken, without {left_out}; {remedy}")
        return volume
