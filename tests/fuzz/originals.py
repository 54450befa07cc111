"""Sound files of every format that geokit reads: small, several variants each. Mutants are made of them."""

from __future__ import annotations

import functools
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import geokit as gk
from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.mesh_catalog import l_profile
from benchmarks.catalog.typed_grids import TypedGrid
from geokit.formats.table import FORMATS, SPARSE, STAGES
from tests.formats.images.vox_files import vox_of
from tests.support.exchange_files import write_cad, write_collada, write_e57, write_fbx

__all__ = ["TARGETS", "Original", "Target", "originals"]


class Target(NamedTuple):
    """What is loaded from a format: "mesh", "points", "rays" or "volume"."""

    content: str
    kind: str


class Original(NamedTuple):
    """A file, and those beside it that it refers to, by name; of a folder, no data and the files in it."""

    variant: str
    data: bytes
    beside: dict[str, bytes]


TARGETS = [
    Target(content, kind)
    for kind, row in FORMATS.items()
    for content in ("mesh", "points", "rays", "volume")
    if "r" in getattr(row, content)
]

RANDOM = np.random.default_rng(3)
MESH = l_profile()
POINTS = RANDOM.normal(size=(30, 3))
DATA = {
    "normals": RANDOM.normal(size=(30, 3)),
    "rgb": RANDOM.integers(0, 256, (30, 3)).astype(np.uint8),
    "id": np.arange(30, dtype=np.int32),
}
RAYS = np.concatenate([POINTS, POINTS[:, ::-1] + 0.1], axis=1)


@functools.cache
def originals(target: Target) -> list[Original]:
    """The originals of a target, in an order that does not change."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for i, (variant, make) in enumerate(_MAKERS[target.content](target.kind)):
            own = Path(folder) / str(i)
            own.mkdir()
            path = own / f"a{target.kind}"
            made = make(path)
            if made is not None:
                path.write_bytes(made.encode() if isinstance(made, str) else made)
            files = sorted(other for other in own.rglob("*") if other != path and other.is_file())
            rest = {other.relative_to(own).as_posix(): other.read_bytes() for other in files}
            # meshio names files beside it by their whole path.
            data = b"" if path.is_dir() else path.read_bytes().replace(f"{own}/".encode(), b"")
            found.append(Original(variant, data, rest))
    return found


# A variant's name, and what writes the file to a path or returns its content.
_Makers = Iterator[tuple[str, Callable[[Path], "str | bytes | None"]]]


def _meshes(kind: str) -> _Makers:
    if "w" in FORMATS[kind].mesh:
        yield "saved", lambda path: gk.mesh.save(path, MESH)
    if FORMATS[kind].data:
        data = {"height": MESH.vertices[:, 2]}
        yield "with data", lambda path: gk.mesh.save(path, MESH, point_data=data)
    if kind == ".obj":
        yield "polygons", lambda path: QUADS_OBJ
    if kind == ".ply":
        yield "ascii", lambda path: QUADS_PLY
        yield "big-endian", lambda path: _big_endian_ply()
    if kind == ".stl":
        yield "ascii", lambda path: _ascii_stl()
    if kind == ".off":
        yield "polygons", lambda path: "OFF\n# a pyramid\n5 5 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n.5 .5 1\n" + QUADS_OFF
    if kind == ".gltf":
        yield "buffer beside", lambda path: _gltf(path, merged=False)
        yield "buffer inside", lambda path: _gltf(path, merged=True)
    if kind in (".vtk", ".vtu", ".msh", ".xdmf"):
        for variant, options in MESHIO[kind].items():
            yield variant, functools.partial(_by_meshio, options)
    if kind == ".usdz":
        yield "packed", _usdz
    if FORMATS[kind].extra == "cad":
        yield "solids", write_cad
    if kind == ".dae":
        yield "polygons", write_collada
    if kind == ".fbx":
        yield "two bodies", write_fbx
        yield "one body", functools.partial(write_fbx, bodies=("cube",))


QUADS_OBJ = (
    "mtllib none.mtl\ng base\nv 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 1 1 0\nv 0 1 0\nv 0.5 0.5 1\nvt 0 0\nvn 0 0 1\n"
    "f 4/1/1 3/1/1 2/1/1 1/1/1\no sides\nf 1 2 5\nf -4 -3 -1\nf 3//1 4//1 5//1 \\\n\nf 4 1 5\n"
)
QUADS_PLY = (
    "ply\nformat ascii 1.0\ncomment two faces\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 1 2\n"
)
QUADS_OFF = "4 3 2 1 0\n3 0 1 4\n3 1 2 4\n3 2 3 4\n3 3 0 4\n"
MESHIO: dict[str, dict[str, dict[str, object]]] = {
    ".vtk": {"binary 5.1": {"file_format": "vtk51"}, "ascii 4.2": {"file_format": "vtk42", "binary": False}},
    ".vtu": {"ascii": {"binary": False}, "compressed": {"compression": "zlib"}},
    ".msh": {"2.2 binary": {"file_format": "gmsh22"}, "4.1": {"file_format": "gmsh"},
             "4.1 ascii": {"file_format": "gmsh", "binary": False}},
    ".xdmf": {"hdf": {"data_format": "HDF"}, "binary": {"data_format": "Binary"}},
}  # fmt: skip


def _by_meshio(options: dict[str, object], path: Path) -> None:
    import meshio

    mesh = meshio.Mesh(MESH.vertices, [("triangle", MESH.faces.astype(np.int64))])
    mesh.write(path, **{"file_format": None, **options})


def _big_endian_ply() -> bytes:
    head = QUADS_PLY.replace("ascii", "binary_big_endian").split("0 0 0\n")[0].encode()
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], ">f4").tobytes()
    faces = b"\x04" + np.arange(4, dtype=">i4").tobytes() + b"\x03" + np.arange(3, dtype=">i4").tobytes()
    return head + corners + faces


def _ascii_stl() -> str:
    lines = []
    for triangle in MESH.vertices[MESH.faces].tolist():
        corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle)
        lines.append(f"facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    return f"solid a\n{''.join(lines)}endsolid a\n"


def _gltf(path: Path, merged: bool) -> None:
    import trimesh

    mesh = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), merge_buffers=True, embed_buffers=merged)
    for name, data in files.items():
        (path if name.endswith(".gltf") else path.with_name(name)).write_bytes(data)


def _usdz(path: Path) -> None:
    from pxr import UsdUtils

    inner = path.with_name("inner.usdc")
    gk.mesh.save(inner, MESH)
    assert UsdUtils.CreateNewUsdzPackage(str(inner), str(path))
    inner.unlink()


def _points(kind: str) -> _Makers:
    given = {"rgb": DATA["rgb"]} if kind == ".pts" else DATA
    for encoding in FORMATS[kind].encodings or (None,) if "w" in FORMATS[kind].points else ():
        yield encoding or "saved", lambda path, e=encoding: gk.points.save(path, POINTS, data=given, encoding=e)
    rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in POINTS.tolist())
    if kind == ".obj":
        yield "vertices", lambda path: "".join(f"v {row}\n" for row in rows.splitlines())
    if kind == ".ply":
        head = QUADS_PLY.split("element face")[0].replace("vertex 4", "vertex 30") + "end_header\n"
        yield "ascii", lambda path: head + rows
    if kind == ".pts":
        yield "bare", lambda path: "30\n" + rows
    if kind in (".xyz", ".txt"):
        yield "bare", lambda path: rows
    if kind in (".csv", ".txt"):
        yield (
            "named",
            lambda path: (
                "# a comment\nid,x,y,z\n"
                + "".join(f"{i},{row.replace(' ', ',')}\n" for i, row in enumerate(rows.splitlines()))
            ),
        )
    if kind == ".npy":
        yield "float64", lambda path: np.save(path, POINTS)
        yield "float32", lambda path: np.save(path, np.asfortranarray(POINTS.astype(np.float32)))
    if kind == ".bin":
        yield "sweep", lambda path: np.column_stack([POINTS, RANDOM.random(30)]).astype("<f4").tobytes()
    if kind == ".e57":
        axes = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), POINTS.T, strict=True))
        yield "one scan", lambda path: write_e57(path, [{**axes, "intensity": np.linspace(0, 1, 30)}])
        yield "two scans", lambda path: write_e57(path, [axes, axes])
    if kind == ".npz":
        yield "deflated", lambda path: np.savez_compressed(path, points=POINTS, **DATA)


def _rays(kind: str) -> _Makers:
    separator = "," if kind == ".csv" else " "
    rows = "".join(separator.join(map(repr, row)) + "\n" for row in RAYS.tolist())
    if kind == ".npy":
        yield "table", lambda path: np.save(path, RAYS)
    elif kind == ".npz":
        yield "named", lambda path: np.savez(path, origins=POINTS, directions=RAYS[:, 3:])
        yield "table", lambda path: np.savez_compressed(path, RAYS)
    else:
        yield "bare", lambda path: rows
        yield "named", lambda path: separator.join(("ox", "oy", "oz", "dx", "dy", "dz")) + "\n" + rows


def _volumes(kind: str) -> _Makers:
    ball = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 14)] * 3, indexing="ij")), axis=0)
    level_set = gk.volume.from_dense(
        (0.6 - ball).clip(-0.4, 0.4).astype(np.float32) * -1, voxel_size=0.15, background=0.4, grid_class="level set",
        name="ball",
    )  # fmt: skip
    whole = gk.volume.from_dense((ball * 9).astype(np.int64), voxel_size=0.15, name="whole")
    if kind in STAGES:
        yield "one field", lambda path: gk.volume.save(path, level_set)
        yield "two fields", lambda path: gk.volume.save(path, level_set, whole)
        return
    if kind not in SPARSE:
        yield from _dense(kind, level_set)
        return
    for codec in ("none", "zip", "blosc"):
        yield codec, lambda path, c=codec: gk.volume.save(path, level_set, codec=c)
    yield "two grids", lambda path: gk.volume.save(path, level_set, whole)
    types = ("vec3f", "bool", "double") if kind == ".vdb" else ("fp4", "fpn", "vec3f", "bool", "mask", "int16", "half")
    for name in types:
        yield name, lambda path, n=name: gk.volume.save(path, TypedGrid(n).volume)
    if kind == ".vdb":
        yield "half", lambda path: gk.volume.save(path, level_set, half=True)
    else:
        yield "bare grid", lambda path: level_set.nanovdb.tobytes()
        for name in ("onindex", "indexmask"):
            yield name, lambda path, n=name: gk.volume.save(path, IndexGrid(n).volume)


def _dense(kind: str, level_set: gk.volume.SparseVolume) -> _Makers:
    """Dense volumes as geokit writes them, and as other programs do."""
    values = np.arange(9 * 8 * 7, dtype=np.int16).reshape(9, 8, 7)
    small = gk.volume.from_dense(values, transform=np.diag([0.1, 0.1, 0.2, 1.0]), name="small")
    for codec in (None, "zip", "none") if "w" in FORMATS[kind].volume else ():
        if codec is None or kind in (".nrrd", ".mhd", ".mha", ".tif", ".tiff"):
            yield f"saved {codec}", lambda path, c=codec: _quietly(gk.volume.save, path, small, codec=c)
    if "w" in FORMATS[kind].volume:
        yield "level set", lambda path: _quietly(gk.volume.save, path, level_set)
    if kind in (".nrrd", ".vti", ".nii", ".npy"):
        vectors = gk.volume.from_dense(np.stack([values, values + 1, values + 2], axis=-1).astype(np.float32))
        yield "vectors", lambda path: _quietly(gk.volume.save, path, vectors)
    if kind in (".nii", ".nii.gz"):
        yield "scaled series", lambda path: _nifti(path, values)
    if kind == ".nhdr":
        yield "detached", lambda path: _nrrd(path, values)
    if kind in (".tif", ".tiff"):
        yield "imagej", lambda path: _tiff(path, values, imagej=True, metadata={"spacing": 2.0, "unit": "um"})
        yield "plain", lambda path: _tiff(path, values, compression="zlib", predictor=True)
    if kind == ".zarr":
        yield "array", lambda path: _zarr_array(path, values, 2)
        yield "array of version 3", lambda path: _zarr_array(path, values, 3)
    if kind == ".dcm":
        yield "series", lambda path: _series(path, values)
        yield "one file", lambda path: _slice(path, values[:, :, 0], 0)
        yield "run-length coded", lambda path: _series(path, values, packed=True)
    if kind == ".vox":
        yield "two models", lambda path: vox_of(2)
    if kind == ".npy":
        yield "fortran", lambda path: np.save(path, np.asfortranarray(values.astype(np.float64)))


def _quietly(function: Callable[..., None], *args: object, **options: object) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # .npy has no place
        function(*args, **options)


def _zarr_array(path: Path, values: np.ndarray, version: int) -> None:
    import zarr

    chunks = (4, 4, 4)
    array = zarr.create_array(path, shape=values.shape, chunks=chunks, dtype=values.dtype, zarr_format=version)
    array[...] = values


def _series(path: Path, values: np.ndarray, packed: bool = False) -> None:
    path.mkdir()
    for k in range(3):
        _slice(path / f"{k}.dcm", values[:, :, k], k, packed)


def _slice(path: Path, values: np.ndarray, k: int, packed: bool = False) -> None:
    import pydicom

    data = pydicom.Dataset()
    data.SOPClassUID, data.SOPInstanceUID, data.SeriesInstanceUID = pydicom.uid.CTImageStorage, f"1.2.{k}", "1.2"
    data.Rows, data.Columns, data.SamplesPerPixel = values.shape[1], values.shape[0], 1
    data.PhotometricInterpretation, data.SeriesDescription = "MONOCHROME2", "small"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 1
    data.PixelSpacing, data.SliceThickness, data.InstanceNumber = ["0.5", "0.5"], "2", k
    data.ImageOrientationPatient, data.ImagePositionPatient = list("100010"), ["1", "2", str(2 * k)]
    data.RescaleSlope, data.RescaleIntercept = "2", "-10"
    data.PixelData = np.ascontiguousarray(values.T).tobytes()
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    if packed:
        data.compress(pydicom.uid.RLELossless)
    data.save_as(path, enforce_file_format=True)


def _nifti(path: Path, values: np.ndarray) -> None:
    import nibabel

    header = nibabel.Nifti1Header(endianness=">")
    header.set_data_dtype(np.int16)
    image = nibabel.Nifti1Image(np.stack([values, values], axis=-1), np.diag([0.2, 0.2, 0.3, 1.0]), header)
    image.header.set_slope_inter(0.5, -10.0)
    nibabel.save(image, path)


def _nrrd(path: Path, values: np.ndarray) -> None:
    import nrrd

    nrrd.write(str(path), values, {"spacings": [0.1, 0.2, 0.3], "encoding": "raw"}, detached_header=True)


def _tiff(path: Path, values: np.ndarray, **options: object) -> None:
    import tifffile

    tifffile.imwrite(path, values, **options)


_MAKERS = {"mesh": _meshes, "points": _points, "rays": _rays, "volume": _volumes}
