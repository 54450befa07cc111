"""``geokit convert``: converts between file formats, and between meshes and volumes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import CycloptsError, Parameter

from geokit.cli._batches.many_files import run_batch, targets_in
from geokit.cli._kinds import (
    Columns,
    Device,
    FiniteOnly,
    Flag,
    Kind,
    called,
    grid_names,
    kind_of_input,
    kind_of_output,
    load_cloud,
    load_grid,
    may_write,
    refuse_unused,
)
from geokit.cli._points import DEFAULT_COUNT, balls, save_cloud
from geokit.cli._program.console import announce_compiling, note, print_json, say, step
from geokit.cli._results import described
from geokit.cli._storage import Storage
from geokit.core.files import atomic_path, extension, size_of
from geokit.errors import InputError
from geokit.formats.table import FORMATS, SPARSE, STAGES, Content

if TYPE_CHECKING:
    from geokit.mesh import TriangleMesh
    from geokit.points import PointCloud
    from geokit.volume import SparseVolume

# Default number of voxels along the longest side: enough detail to look at, built in about a second.
DEFAULT_RESOLUTION = 128
# Arguments that say what is converted, where and with what answer; the others say how, and may not apply.
AROUND = ("files", "out_dir", "to", "jobs", "device", "finite_only", "force", "json")


def convert(
    *files: Annotated[Path, Parameter(name="FILES")],
    out_dir: Path | None = None,
    to: str | None = None,
    kind: Kind | None = None,
    jobs: int | None = None,
    voxel_size: float | None = None,
    half_width: float | None = None,
    sign: str | None = None,
    thickness: float | None = None,
    interior: str | None = None,
    within: float | None = None,
    order: int | None = None,
    isovalue: float | None = None,
    label: int | None = None,
    adaptivity: float | None = None,
    method: str | None = None,
    grid: str | None = None,
    codec: str | None = None,
    tolerance: float | None = None,
    radius: float | None = None,
    count: int | None = None,
    background: float | None = None,
    background_tolerance: float | None = None,
    grid_type: str | None = None,
    device: Device = None,
    finite_only: FiniteOnly = True,
    unit: str | None = None,
    up: str | None = None,
    from_unit: str | None = None,
    from_up: str | None = None,
    columns: Columns = None,
    stream: Flag = False,
    normals: int | None = None,
    density: float | None = None,
    scheduler: str | None = None,
    force: Flag = False,
    json: Flag = False,
) -> int:
    """Convert between formats, and between meshes, volumes, clouds and dense arrays.

    Args:
        files: The file to read and the file to write, whose extension names the format. With --out-dir, all are read.
        out_dir: Folder for the new files; it is made if it is missing. A file that fails is reported, the others go on.
        to: With --out-dir: extension of the new files, as in ply.
        kind: What to make where the format holds several: mesh, volume or cloud. Without it a .vdb becomes a volume, a
            USD stage a mesh, and another file a mesh, unless the options are for points.
        jobs: With --out-dir: number of files that are converted at a time; by default 1.
        voxel_size: Mesh to volume: edge length of a voxel in world units; by default the longest side / 128, unless
            tolerance is given. Cloud to cloud with stream: edge length of the voxels whose centroids replace points.
        half_width: Mesh to volume: width of the narrow band on each side, in voxels; by default 3, with tolerance the
            least that interpolation needs.
        sign: Mesh to volume: method that decides inside or outside: auto (default), winding, pseudonormal, parity, or
            none for unsigned distances.
        thickness: Mesh to volume: make a solid shell of this thickness around the surface, in world units.
        interior: Mesh to volume: what happens to surface that has the solid on both sides, between bodies that touch or
            overlap: remove (default), or keep.
        within: Mesh to volume with tolerance: distance from the surface up to which the tolerance holds, in world
            units; by default the tolerance itself, or a quarter of it for an open mesh.
        order: Mesh to volume with tolerance: order of the interpolation that will be used, 1, 2 or 3; by default the
            best one.
        isovalue: Volume to mesh: value of the surface; by default 0.
        label: Volume to mesh: the surface of the voxels that have this value, as in a segmentation.
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
        radius: Cloud to volume or mesh: radius of the ball around each point, in world units; by default as large as
            joins neighbors. Mesh to cloud: least distance between two points, instead of count.
        count: Mesh to cloud: number of points on the surface; by default 100000.
        background: From a dense volume (.nii .nrrd .tif ...): value of voxels that are not stored; by default what the
            file says, else the negative value that more than half of the border of its first slice has, else 0.
        background_tolerance: From a dense volume: largest difference from the background that still counts as it.
        grid_type: Dense volume to volume: type of the grid, such as float or int32; by default that of the values.
        unit: From a mesh: the unit of what is made, mm, cm, m, km, um, in or ft. Positions are scaled from the unit
            that the file or from-unit says, and lengths of other options are in the new one.
        up: From a mesh: the axis that points up in what is made, x, y or z; the mesh is turned by a quarter.
        from_unit: With unit, or to say it in the new file: the unit of a file that does not say its own.
        from_up: With up, or to say it in the new file: the axis that points up in a file that does not say its own.
        stream: Read and write block after block, so that neither has to fit into memory: a closed mesh in a binary .stl
            or .ply to .nvdb with voxel-size, or a cloud in a binary .ply, .las or .laz to one of these, where
            voxel-size, normals and density are as they say. It takes as much as --memory-limit says, by default half of
            what is free.
        normals: Cloud to cloud with stream: add the normal of the plane through so many nearest points, unoriented.
        density: Cloud to cloud with stream: add the number of points within this radius over the volume of the ball.
        scheduler: With stream: address of a Dask scheduler, as in tcp://host:8786, whose workers see the folder of the
            target and take up to 2^30 bytes a task; local for a cluster of this machine.
        force: Replace an existing target.
        json: Print a summary as JSON.
    """
    given = locals()
    options = {name: given[name] for name in given if name not in AROUND} | {"stream": stream or None}
    announce_compiling()

    def work(source: Path, target: Path) -> dict[str, Any]:
        job = _Job(source, target, options, device, finite_only, quiet=json or out_dir is not None)
        return _converted(job, force=force)

    if out_dir is not None:
        pairs = list(zip(files, targets_in(out_dir, files, to), strict=True))
        return run_batch(work, pairs, 1 if jobs is None else jobs, described, json=json)
    for name, value in (("to", to), ("jobs", jobs)):
        if value is not None:
            raise InputError(f"--{name}: goes with --out-dir; leave it out, or give --out-dir")
    if len(files) != 2:
        msg = f"{len(files)} {'file' if len(files) == 1 else 'files'} given; give two, IN and OUT, or --out-dir"
        raise CycloptsError(msg=msg)
    summary = work(*files)
    if json:
        print_json(summary)
    else:
        say(described(summary))
    return 0


@dataclass(frozen=True)
class _Job:
    """A file to convert. Options have the names of convert's parameters; those that were not given are None."""

    source: Path
    target: Path
    options: dict[str, Any]
    device: str | None
    finite_only: bool
    quiet: bool

    def given(self, *names: str) -> dict[str, Any]:
        """Those of some options that were given; the library's defaults apply to the others."""
        return {name: self.options[name] for name in names if self.options[name] is not None}

    def step(self, what: str) -> Any:
        """A step of the work, which is shown unless the job is quiet."""
        return step(what, quiet=self.quiet)

    @contextmanager
    def streaming(self, what: str) -> Iterator[tuple[Any, dict[str, Any]]]:
        """A step, and where and within which memory it streams."""
        from geokit.core.content_limit import default_limit
        from geokit.distributed._cluster import connected

        scheduler = self.options["scheduler"]
        with self.step(what) as shown, connected(scheduler) if scheduler else nullcontext() as executor:
            limits = {"memory_limit": default_limit(), "executor": executor}
            yield shown, {**limits, "device": self.device, "progress": shown.progress}

    def load_cloud(self) -> PointCloud:
        """The source as points."""
        return load_cloud(self.source, self.finite_only, self.options["grid"], self.options["columns"])


def _converted(job: _Job, *, force: bool) -> dict[str, Any]:
    kinds = _kinds(job)
    _refuse_unused(kinds, job)
    may_write(job.target, _CONTENTS.get(kinds[1]), force=force)
    summary = _WORK[kinds][0](job, Storage.of(job.options["codec"], job.options["tolerance"]))
    return {"source": str(job.source), "target": str(job.target), **summary, "byte_count": size_of(job.target)}


# What the kinds of targets are in the table of formats. An array goes to .npz alone.
_CONTENTS: dict[str, Content] = {"mesh": "mesh", "volume": "volume", "cloud": "points"}
UNIT_OPTIONS = ("unit", "up", "from_unit", "from_up")


def _kinds(job: _Job) -> tuple[str, str]:
    """What is read and what is made. Where the target may be a mesh or a cloud, the options decide."""
    target, options = job.target, job.options
    kinds: tuple[str, str] = kind_of_input(job.source, options["grid"]), kind_of_output(target)
    if options["kind"] is not None:
        held = FORMATS[extension(target)]
        access = {"mesh": held.mesh, "volume": held.volume, "cloud": held.points}
        if "w" not in access[options["kind"]]:
            raise InputError(f"--kind: {extension(target)} files are no {options['kind']}; choose another format")
        return kinds[0], options["kind"]
    if kinds[0] == "cloud" and options["stream"]:
        return "cloud", "cloud"
    holds_points = "w" in FORMATS[extension(target)].points
    if kinds[0] == "volume" and extension(target) == ".npz":
        return "volume", "array"
    if kinds == ("cloud", "mesh") and holds_points and options["radius"] is options["voxel_size"] is None:
        return "cloud", "cloud"
    if kinds == ("mesh", "mesh") and holds_points and (options["radius"], options["count"]) != (None, None):
        return "mesh", "cloud"
    return kinds


def _refuse_unused(kinds: tuple[str, str], job: _Job) -> None:
    """Raise an error for options that have no effect on this conversion."""
    options = job.options
    if kinds not in _WORK:
        raise InputError(f"{job.target}: a {kinds[0]} cannot be converted into a {kinds[1]}; choose another format")
    for name, value in options.items():
        if name not in ("kind", *_WORK[kinds][1]):
            refuse_unused(f"on {kinds[0]} to {kinds[1]}", **{name: value})
        if name == "scheduler" and value is not None and not options["stream"]:
            raise InputError("--scheduler: goes with --stream; give it too")
        if (
            kinds == ("cloud", "cloud")
            and value is not None
            and not options["stream"]
            and name not in ("kind", "grid", "columns")
        ):
            raise InputError(f"--{name.replace('_', '-')}: of a cloud to a cloud goes with --stream; give it too")


def _load_mesh(job: _Job) -> TriangleMesh:
    """The mesh of a file, in the unit and with the axis up that are asked for."""
    from geokit.mesh import convert_unit, load

    unit, up, from_unit, from_up = (job.options[name] for name in UNIT_OPTIONS)
    names = (("from_up_axis", "--from-up"), ("up_axis", "--up"), ("^unit", "--unit"), ("the mesh", job.source))
    with called(*names):
        return convert_unit(load(job.source), unit, up_axis=up, from_unit=from_unit, from_up_axis=from_up)


def _mesh_to_mesh(job: _Job, _: Storage) -> dict[str, Any]:
    from geokit.mesh import save, simplify

    achieved: dict[str, Any] = {}
    with job.step(f"converting {job.source}") as converting:
        mesh = _load_mesh(job)
        if tolerance := job.given("tolerance"):
            found = simplify(mesh, **tolerance, device=job.device, progress=converting.progress)
            converting.result = f"{len(mesh.faces)} faces become {len(found.mesh.faces)}"
            mesh, achieved = found.mesh, {"deviation": found.deviation, "deviation_p999": found.deviation_p999}
        save(job.target, mesh)
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), **achieved}


def _mesh_to_volume(job: _Job, storage: Storage) -> dict[str, Any]:
    if job.options["stream"]:
        return _streamed(job)
    from geokit.volume import from_mesh, save

    voxel_size = job.options["voxel_size"]
    how = job.given("half_width", "sign", "thickness", "interior", "method", "within", "order")
    with job.step(f"reading {job.source}") as reading:
        mesh = _load_mesh(job)
        reading.result = f"{len(mesh.faces)} faces"
    if voxel_size is None and storage.tolerance is None:
        longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
        # Two significant digits are easy to type again.
        voxel_size = float(f"{longest / DEFAULT_RESOLUTION:.1e}")
        if not job.quiet:
            note(f"voxel size {voxel_size:g}, about {DEFAULT_RESOLUTION} along the longest side; --voxel-size sets it")
    with job.step("voxelising") as voxelising:
        if voxel_size is None:
            # OpenVDB has no quantized grids, so a codec that is smaller in memory would not be smaller in a .vdb file.
            codec = storage.quantization or ("float" if job.target.suffix.lower() == ".vdb" else None)
            how |= {"tolerance": storage.tolerance, "codec": codec, "progress": voxelising.progress}
            volume = from_mesh(mesh, **how, device=job.device)
        else:
            volume = storage.applied(from_mesh(mesh, voxel_size=voxel_size, **how, device=job.device))
        voxelising.result = f"{volume.info.active_voxel_count} active voxels"
    with job.step(f"writing {job.target}"):
        save(job.target, volume, codec=storage.compression)
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


def _streamed(job: _Job) -> dict[str, Any]:
    from geokit.volume import from_mesh_file

    unused = ("interior", "method", "codec", "tolerance", "within", "order", *UNIT_OPTIONS)
    refuse_unused("with --stream", **job.given(*unused))
    if job.options["voxel_size"] is None:
        raise InputError("--voxel-size: is missing; --stream does not choose one")
    how = job.given("voxel_size", "half_width", "sign", "thickness")
    with job.streaming(f"voxelising {job.source}") as (voxelising, limits):
        info = from_mesh_file(job.source, job.target, **how, **limits)
        voxelising.result = f"{info.active_voxel_count} active voxels"
    return {"voxel_size": float(info.voxel_size[0]), "active_voxels": info.active_voxel_count}


def _streamed_cloud(job: _Job) -> dict[str, Any]:
    from geokit.points import process_file

    options = job.options
    refuse_unused("with --stream", **job.given("grid", "columns"))
    how = {
        "voxel_size": options["voxel_size"],
        "normals": None if options["normals"] is None else {"k": options["normals"]},
        "density": None if options["density"] is None else {"radius": options["density"]},
    }
    with job.streaming(f"converting {job.source}") as (_, limits):
        found = process_file(job.source, job.target, **how, finite_only=job.finite_only, **limits)
    if found.left_out_count and not job.quiet:
        note(f"{job.source}: {found.left_out_count} of its {found.read_count} points are not finite and were left out")
    return {"points": found.written_count}


def _volume_to_volume(job: _Job, storage: Storage) -> dict[str, Any]:
    from geokit.volume import load, load_all, save

    source, grid, given = job.source, job.options["grid"], job.given("background", "grid_type")
    if (most := job.options["background_tolerance"]) is not None:
        given["tolerance"] = most
    with job.step(f"converting {source}"):
        every = grid is None or grid_names(source, grid) is not None
        volumes = list(load_all(source, **given).values()) if every else [load(source, grid=grid, **given)]
        volumes = [storage.applied(volume) for volume in volumes]
        save(job.target, *volumes, codec=storage.compression)
    return {
        "grids": ", ".join(volume.info.name or "(unnamed)" for volume in volumes),
        **({} if extension(source) in (*SPARSE, *STAGES) else {"background": volumes[0].info.background}),
        **storage.described(volumes),
    }


def _volume_to_mesh(job: _Job, _: Storage) -> dict[str, Any]:
    from geokit.mesh import from_volume, from_volume_with_deviation, save

    source, label, how = job.source, job.options["label"], job.given("isovalue", "method", "tolerance")
    if label is not None:
        refuse_unused("with --label", isovalue=job.options["isovalue"])
        how["isovalue"] = 0.5
    outside = {"background": job.options["background"], "tolerance": job.options["background_tolerance"]}
    with job.step(f"meshing {source}") as meshing:
        volume = load_grid(source, job.options["grid"], **outside, as_floats=label is None)
        if label is not None:
            volume = _mask(volume, label, source)
        achieved: dict[str, Any] = {}
        if "tolerance" not in how:
            mesh = from_volume(volume, **how, **job.given("adaptivity"), device=job.device)
        elif job.options["adaptivity"]:
            raise InputError("--adaptivity: merges faces by no known distance; leave it out where --tolerance is given")
        else:
            found = from_volume_with_deviation(volume, **how, device=job.device, progress=meshing.progress)
            mesh, achieved = found.mesh, {"deviation": found.deviation, "deviation_p999": found.deviation_p999}
        meshing.result = f"{len(mesh.faces)} faces"
        if len(mesh.faces) == 0:
            isovalue = how.get("isovalue", 0.0)
            raise InputError(
                f"{source}: grid {volume.info.name!r} has no surface at {isovalue:g}; choose --isovalue in the range "
                "of values that geokit info prints"
            )
        save(job.target, mesh)
    return {"grid": volume.info.name, "vertices": len(mesh.vertices), "faces": len(mesh.faces), **achieved}


def _mask(volume: SparseVolume, label: int, source: Path) -> SparseVolume:
    """A volume that is 1 where a volume has the value of a label, and 0 elsewhere."""
    from geokit.volume import from_dense, to_dense
    from geokit.volume.nanovdb.provenance import with_more

    info = volume.info
    if not np.isscalar(info.background) or info.background == label:
        raise InputError(
            f"{source}: grid {info.name!r} has background {info.background}, which label {label} cannot be told from; "
            "choose another --label, or --background"
        )
    dense = to_dense(volume)
    found = dense.values == label
    if not found.any():
        labels = ", ".join(f"{value:g}" for value in np.unique(dense.values)[:20])
        raise InputError(f"{source}: no voxel of grid {info.name!r} has label {label}; choose one of {labels}")
    mask = from_dense(
        found.astype(np.float32), transform=dense.array_transform, name=info.name, grid_class="fog volume"
    )
    return with_more(mask, info.metadata)


def _volume_to_array(job: _Job, _: Storage) -> dict[str, Any]:
    with job.step(f"converting {job.source}"):
        volume = load_grid(job.source, job.options["grid"])
        found = volume.to_dense(device=job.device)
        with atomic_path(job.target) as part, open(part, "wb") as file:
            np.savez_compressed(file, **found._asdict())
    shape = " x ".join(map(str, found.values.shape))
    return {"grid": volume.info.name, "shape": shape, "dtype": str(found.values.dtype)}


def _cloud_to_cloud(job: _Job, _: Storage) -> dict[str, Any]:
    if job.options["stream"]:
        return _streamed_cloud(job)
    with job.step(f"converting {job.source}"):
        cloud = job.load_cloud()
        save_cloud(job.target, cloud)
    return {"points": len(cloud.points)}


def _cloud_to_volume(job: _Job, storage: Storage) -> dict[str, Any]:
    from geokit.volume import save

    with job.step(f"converting {job.source}"):
        cloud, how = job.load_cloud(), {name: job.options[name] for name in ("radius", "voxel_size", "half_width")}
        volume = storage.applied(balls(cloud, **how, device=job.device, quiet=job.quiet))
        save(job.target, volume, codec=storage.compression)
    active = volume.info.active_voxel_count
    return {"points": len(cloud), "active_voxels": active, **storage.described([volume])}


def _cloud_to_mesh(job: _Job, _: Storage) -> dict[str, Any]:
    from geokit.mesh import from_volume, from_volume_with_deviation, save

    with job.step(f"converting {job.source}") as converting:
        cloud, (radius, voxel_size) = job.load_cloud(), (job.options[name] for name in ("radius", "voxel_size"))
        volume = balls(cloud, radius, voxel_size, device=job.device, quiet=job.quiet)
        how = {**job.given("method", "tolerance"), "device": job.device}
        if "tolerance" in how:
            mesh = from_volume_with_deviation(volume, **how, progress=converting.progress).mesh
        else:
            mesh = from_volume(volume, **how)
        save(job.target, mesh)
    return {"points": len(cloud), "vertices": len(mesh.vertices), "faces": len(mesh.faces)}


def _mesh_to_cloud(job: _Job, _: Storage) -> dict[str, Any]:
    from geokit.mesh import load
    from geokit.points import sample

    count, radius = job.options["count"], job.options["radius"]
    with job.step(f"converting {job.source}"):
        if radius is None:
            cloud = sample(load(job.source), DEFAULT_COUNT if count is None else count)
        elif count is None:
            cloud = sample(load(job.source), method="poisson_disk", radius=radius)
        else:
            raise InputError("--count: follows from --radius; leave one of them out")
        save_cloud(job.target, cloud)
    return {"points": len(cloud.points)}


_OF_DENSE = ("background", "background_tolerance")
_OF_BALLS = ("radius", "voxel_size", "tolerance", "grid", "columns")
# What does each conversion, and the options that it takes.
_WORK: dict[tuple[str, str], tuple[Callable[[_Job, Storage], dict[str, Any]], tuple[str, ...]]] = {
    ("mesh", "mesh"): (_mesh_to_mesh, ("tolerance", *UNIT_OPTIONS)),
    ("mesh", "volume"): (
        _mesh_to_volume,
        (
            *("voxel_size", "half_width", "sign", "thickness", "interior", "method", "codec", "tolerance"),
            *("within", "order", "stream", "scheduler", *UNIT_OPTIONS),
        ),
    ),
    ("volume", "volume"): (_volume_to_volume, ("grid", "codec", "tolerance", "grid_type", *_OF_DENSE)),
    ("volume", "mesh"): (
        _volume_to_mesh,
        ("isovalue", "label", "adaptivity", "method", "grid", "tolerance", *_OF_DENSE),
    ),
    ("volume", "array"): (_volume_to_array, ("grid",)),
    ("cloud", "cloud"): (
        _cloud_to_cloud,
        ("grid", "columns", "stream", "voxel_size", "normals", "density", "scheduler"),
    ),
    ("cloud", "volume"): (_cloud_to_volume, ("half_width", "codec", *_OF_BALLS)),
    ("cloud", "mesh"): (_cloud_to_mesh, ("method", *_OF_BALLS)),
    ("mesh", "cloud"): (_mesh_to_cloud, ("count", "radius")),
}
