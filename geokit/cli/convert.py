"""``geokit convert``: converts between file formats, and between meshes and volumes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from geokit.cli._console import announce_compiling, note, print_json, step
from geokit.cli._kinds import kind_of_input, kind_of_output, may_write
from geokit.cli._storage import Storage
from geokit.core.files import extension
from geokit.errors import InputError
from geokit.formats.table import FORMATS

__all__ = ["convert"]

# Default number of voxels along the longest side: enough detail to look at, built in about a second.
DEFAULT_RESOLUTION = 128

Flag = Annotated[bool, Parameter(negative="")]


def convert(
    source: Annotated[Path, Parameter(name="IN")],
    target: Annotated[Path, Parameter(name="OUT")],
    /,
    *,
    voxel_size: float | None = None,
    half_width: float | None = None,
    sign: str | None = None,
    thickness: float | None = None,
    within: float | None = None,
    order: int | None = None,
    isovalue: float | None = None,
    adaptivity: float | None = None,
    method: str | None = None,
    grid: str | None = None,
    codec: str | None = None,
    tolerance: float | None = None,
    device: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> None:
    """Convert between mesh formats, volume formats, and from one to the other.

    Args:
        source: File to read.
        target: File to write; its extension names the format.
        voxel_size: Mesh to volume: edge length of a voxel in world units; by default the longest side / 128, unless
            tolerance is given.
        half_width: Mesh to volume: width of the narrow band on each side, in voxels; by default 3, with tolerance the
            least that interpolation needs.
        sign: Mesh to volume: method that decides inside or outside: auto (default), winding, pseudonormal, parity, or
            none for unsigned distances.
        thickness: Mesh to volume: make a solid shell of this thickness around the surface, in world units.
        within: Mesh to volume with tolerance: distance from the surface up to which the tolerance holds, in world
            units; by default the tolerance itself, or a quarter of it for an open mesh.
        order: Mesh to volume with tolerance: order of the interpolation that will be used, 1, 2 or 3; by default the
            best one.
        isovalue: Volume to mesh: value of the surface; by default 0.
        adaptivity: Volume to mesh: 0 (default) keeps every face, 1 merges as many as possible.
        method: Mesh to volume: geokit or openvdb. Volume to mesh: auto (default), surface_nets, dual_contouring,
            marching_cubes or openvdb.
        grid: Name of the grid to read, if a file holds several.
        codec: Storage of a volume: a compression (none, zip or blosc; by default blosc for .vdb and none for .nvdb), a
            quantization (fp4, fp8, fp16, fpn, or float for 32 bits), or both, as in fp8,zip.
        tolerance: Mesh to volume without voxel-size: largest error of interpolated distances near the surface, in world
            units; the voxel size, order and codec of least memory are chosen. Otherwise to a volume: largest change of
            a voxel when it is quantized; without a codec, the smallest one that keeps it is chosen. To a mesh: largest
            distance from the mesh with every face, in world units; as few faces as possible are kept.
        device: Device to compute on: cpu, cuda:0, ...; by default the first GPU, else the CPU.
        force: Replace an existing target.
        json: Print a summary as JSON.
    """
    kinds = kind_of_input(source), kind_of_output(target)
    if kinds == ("cloud", "mesh") and "w" in FORMATS[extension(target)].points:
        kinds = "cloud", "cloud"
    options = {
        "voxel-size": voxel_size,
        "half-width": half_width,
        "sign": sign,
        "thickness": thickness,
        "within": within,
        "order": order,
        "isovalue": isovalue,
        "adaptivity": adaptivity,
        "method": method,
        "grid": grid,
        "codec": codec,
        "tolerance": tolerance,
    }
    _refuse_unused(kinds, options, target)
    may_write(target, force=force)
    storage = Storage.of(codec, tolerance)
    announce_compiling()
    if kinds == ("mesh", "mesh"):
        summary = _mesh_to_mesh(source, target, tolerance, device, quiet=json)
    elif kinds == ("mesh", "volume"):
        how = {"half_width": half_width, "sign": sign, "thickness": thickness, "method": method, "device": device}
        how.update(within=within, order=order)
        summary = _mesh_to_volume(source, target, voxel_size, how, storage, quiet=json)
    elif kinds == ("volume", "volume"):
        summary = _volume_to_volume(source, target, grid, storage, quiet=json)
    elif kinds == ("volume", "mesh"):
        how = {"isovalue": isovalue, "adaptivity": adaptivity, "method": method, "device": device}
        how["tolerance"] = tolerance
        summary = _volume_to_mesh(source, target, how, grid, quiet=json)
    else:
        summary = _cloud_to_cloud(source, target, quiet=json)
    summary = {"source": str(source), "target": str(target), **summary, "byte_count": target.stat().st_size}
    if json:
        print_json(summary)
    else:
        details = ", ".join(f"{name} {value}" for name, value in summary.items() if name not in ("source", "target"))
        print(f"{target}: {details}")


_USES = {
    ("mesh", "mesh"): ("tolerance",),
    ("mesh", "volume"): (
        "voxel-size",
        "half-width",
        "sign",
        "thickness",
        "method",
        "codec",
        "tolerance",
        "within",
        "order",
    ),
    ("volume", "volume"): ("grid", "codec", "tolerance"),
    ("volume", "mesh"): ("isovalue", "adaptivity", "method", "grid", "tolerance"),
    ("cloud", "cloud"): (),
}


def _refuse_unused(kinds: tuple[str, str], options: dict[str, Any], target: Path) -> None:
    """Raise an error for options that have no effect on this conversion."""
    if kinds not in _USES:
        raise InputError(f"{target}: a {kinds[0]} cannot be converted into a {kinds[1]}; choose another format")
    for name, value in options.items():
        if value is not None and name not in _USES[kinds]:
            raise InputError(f"--{name}: has no effect on {kinds[0]} to {kinds[1]}; leave it out")


def _mesh_to_mesh(
    source: Path, target: Path, tolerance: float | None, device: str | None, *, quiet: bool
) -> dict[str, Any]:
    from geokit.mesh import load, save, simplify

    achieved: dict[str, Any] = {}
    with step(f"converting {source}", quiet=quiet) as converting:
        mesh = load(source)
        if tolerance is not None:
            found = simplify(mesh, tolerance=tolerance, device=device)
            converting.result = f"{len(mesh.faces)} faces become {len(found.mesh.faces)}"
            mesh, achieved = found.mesh, {"deviation": found.deviation, "deviation_p999": found.deviation_p999}
        save(target, mesh)
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), **achieved}


def _mesh_to_volume(
    source: Path, target: Path, voxel_size: float | None, how: dict[str, Any], storage: Storage, *, quiet: bool
) -> dict[str, Any]:
    from geokit.mesh import load
    from geokit.volume import from_mesh, save

    with step(f"reading {source}", quiet=quiet) as reading:
        mesh = load(source)
        reading.result = f"{len(mesh.faces)} faces"
    if voxel_size is None and storage.tolerance is None:
        longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
        voxel_size = _rounded(longest / DEFAULT_RESOLUTION)
        if not quiet:
            note(f"voxel size {voxel_size:g}, about {DEFAULT_RESOLUTION} along the longest side; --voxel-size sets it")
    with step("voxelising", quiet=quiet) as voxelising:
        if voxel_size is None:
            # OpenVDB has no quantized grids, so a codec that is smaller in memory would not be smaller in a .vdb file.
            codec = storage.quantization or ("float" if target.suffix.lower() == ".vdb" else None)
            volume = from_mesh(mesh, tolerance=storage.tolerance, codec=codec, **_given(how))
        else:
            volume = storage.applied(from_mesh(mesh, voxel_size=voxel_size, **_given(how)))
        voxelising.result = f"{volume.info.active_voxel_count} active voxels"
    with step(f"writing {target}", quiet=quiet):
        save(target, volume, codec=storage.compression)
    band = float(np.abs(volume.info.background)) / float(volume.info.voxel_size[0])
    chosen = {} if voxel_size else {"order": volume.info.order, "achieved_error_999": volume.info.achieved_error_999}
    return {
        "faces": len(mesh.faces),
        "voxel_size": float(volume.info.voxel_size[0]),
        "half_width": float(f"{band:.4g}"),
        "active_voxels": volume.info.active_voxel_count,
        **chosen,
        **storage.described([volume]),
    }


def _given(options: dict[str, Any]) -> dict[str, Any]:
    """Keep the options that were given; the library's defaults apply to the others."""
    return {name: value for name, value in options.items() if value is not None}


def _rounded(length: float) -> float:
    """Round to two significant digits, so that the voxel size is easy to type again."""
    return float(f"{length:.1e}")


def _volume_to_volume(source: Path, target: Path, grid: str | None, storage: Storage, *, quiet: bool) -> dict[str, Any]:
    from geokit.volume import load, load_all, save

    with step(f"converting {source}", quiet=quiet):
        volumes = list(load_all(source).values()) if grid is None else [load(source, grid=grid)]
        volumes = [storage.applied(volume) for volume in volumes]
        save(target, *volumes, codec=storage.compression)
    return {
        "grids": ", ".join(volume.info.name or "(unnamed)" for volume in volumes),
        **storage.described(volumes),
    }


def _volume_to_mesh(
    source: Path, target: Path, how: dict[str, Any], grid: str | None, *, quiet: bool
) -> dict[str, Any]:
    from geokit.cli._kinds import load_grid
    from geokit.mesh import from_volume, from_volume_with_deviation, save

    with step(f"meshing {source}", quiet=quiet) as meshing:
        volume = load_grid(source, grid)
        achieved: dict[str, Any] = {}
        if how["tolerance"] is None:
            mesh = from_volume(volume, **_given(how))
        elif how["adaptivity"]:
            raise InputError("--adaptivity: merges faces by no known distance; leave it out where --tolerance is given")
        else:
            found = from_volume_with_deviation(volume, **_given({**how, "adaptivity": None}))
            mesh, achieved = found.mesh, {"deviation": found.deviation, "deviation_p999": found.deviation_p999}
        meshing.result = f"{len(mesh.faces)} faces"
        if len(mesh.faces) == 0:
            isovalue = how["isovalue"] or 0.0
            raise InputError(f"{source}: grid {volume.info.name!r} has no surface at {isovalue:g}; choose --isovalue")
        save(target, mesh)
    return {"grid": volume.info.name, "vertices": len(mesh.vertices), "faces": len(mesh.faces), **achieved}


def _cloud_to_cloud(source: Path, target: Path, *, quiet: bool) -> dict[str, Any]:
    from geokit.points import load, save

    with step(f"converting {source}", quiet=quiet):
        cloud = load(source)
        save(target, cloud.points, data=dict(cloud.data))
    return {"points": len(cloud.points)}
