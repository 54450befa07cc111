"""Small files that unfold to much memory are refused with the estimate, before the memory is taken."""

from __future__ import annotations

import gzip
import io
import itertools
import struct
import time
import zipfile
import zlib

import h5py
import numpy as np
import pytest

from geokit import DeviceMemoryError, FileFormatError, mesh, points, volume
from geokit.volume.nanovdb.file import FILE_HEADER, FILE_METADATA
from tests.support.effort import spread
from tests.support.forked import ForkServer

pytestmark = pytest.mark.slow

# Size of the content: over the harmless gibibyte.
SIZE = 3 << 29


def _packed(head, zeros):
    """A raw deflate stream of ``head`` and so many zeros, of which 16 MiB are packed once."""
    packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS)
    first = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    piece = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    last = packer.compress(bytes(zeros % (1 << 24))) + packer.flush()
    return first + (zeros >> 24) * piece + last


def _deflated(path, name, head, zeros):
    """An archive of one member. Its checksum is wrong, as nobody gets to its end."""
    data = _packed(head, zeros)
    fields = struct.pack("<5HIII2H", 20, 0, zipfile.ZIP_DEFLATED, 0, 33, 0, len(data), len(head) + zeros, len(name), 0)
    local = b"PK\3\4" + fields + name.encode() + data
    entry = b"PK\1\2" + struct.pack("<H", 20) + fields + bytes(14) + name.encode()
    end = struct.pack("<4s4HIIH", b"PK\5\6", 0, 0, 1, 1, len(entry), len(local), 0)
    path.write_bytes(local + entry + end)


# The same content for two readers, once.
_MADE: dict[tuple[object, str], bytes] = {}


def _npz(path, name="points", rows=SIZE // 24):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (rows, 3)})
    _deflated(path, f"{name}.npy", head.getvalue(), rows * 24)


def _threemf(path):
    _deflated(path, "3D/3dmodel.model", b"<?xml version='1.0'?><model>", SIZE)


def _nvdb(path, grid_size=SIZE):
    """A zip-compressed level set of zeros behind a sound header."""
    volume.save(path, volume.from_dense(np.ones((8, 8, 8), np.float32), voxel_size=1.0, background=0.0), codec="zip")
    data = path.read_bytes()
    start = FILE_HEADER.itemsize
    block = np.frombuffer(data, FILE_METADATA, 1, start).copy()
    body = start + FILE_METADATA.itemsize + int(block["name_size"][0])
    grid = bytearray(zlib.decompress(data[body + 8 :]))
    struct.pack_into("<Q", grid, 32, grid_size)
    zeros = grid_size - len(grid)
    low, high = zlib.adler32(grid) & 0xFFFF, zlib.adler32(grid) >> 16
    checksum = struct.pack(">I", (high + zeros * low) % 65521 << 16 | low)
    packed = b"\x78\x01" + _packed(bytes(grid), zeros) + checksum
    stored = len(packed)
    block["grid_size"], block["file_size"] = grid_size, stored + 8
    path.write_bytes(
        data[:start]
        + block.tobytes()
        + data[start + FILE_METADATA.itemsize : body]
        + struct.pack("<Q", stored)
        + packed
    )


def _dense(path):
    """A small volume whose header is changed to claim 512 x 1024 x 768 floats; what is packed does not matter."""
    volume.save(path, volume.from_dense(np.ones((3, 3, 4), np.float32)), codec="zip")
    if path.suffix == ".gz":
        data = bytearray(gzip.decompress(path.read_bytes()))
        struct.pack_into("<3h", data, 42, 512, 1024, 768)
        path.write_bytes(gzip.compress(data))
    else:
        data, sizes = path.read_bytes(), (b"DimSize = " if path.suffix == ".mha" else b"sizes: ")
        path.write_bytes(data.replace(sizes + b"3 3 4", sizes + b"512 1024 768"))


def _tiff(path):
    """Pages of nothing but zeros, which need a kilobyte for each mebibyte."""
    tifffile = pytest.importorskip("tifffile")
    count, page = SIZE >> 22, zlib.compress(bytes(1 << 22))
    how = {"shape": (count, 1024, 1024), "dtype": np.float32, "compression": "zlib", "rowsperstrip": 1024}
    tifffile.imwrite(path, itertools.repeat(page, count), **how)


@pytest.mark.parametrize(("pages", "kind"), [(1, "u1"), (8, "u1"), (1, "f4")])
def test_pages_that_are_all_of_the_file_count_with_their_copies(tmp_path, pages, kind):
    """What is read at a time is a page, or eight: three to four times it is in memory."""
    tifffile = pytest.importorskip("tifffile")
    side = 4096 // int(np.sqrt(pages))
    size = pages * side**2 * np.dtype(kind).itemsize
    page = zlib.compress(bytes(size // pages))
    how = {"shape": (pages, side, side), "dtype": kind, "compression": "zlib", "rowsperstrip": side}
    tifffile.imwrite(tmp_path / "a.tif", itertools.repeat(page, pages), photometric="minisblack", **how)
    with pytest.raises(DeviceMemoryError, match="its content needs") as caught:
        volume.load(tmp_path / "a.tif", memory_limit=2 * size)
    assert caught.value.need == 4 * size
    volume.load(tmp_path / "a.tif", memory_limit=4 * size)


BOMBS = {
    "points.npz": (_npz, "points.load"),
    "rays.npz": (_npz, "points.load_rays"),
    "model.3mf": (_threemf, "mesh.load"),
    "grid.nvdb": (_nvdb, "volume.load"),
    "grids.nvdb": (_nvdb, "volume.load_all"),
    "scan.nii.gz": (_dense, "volume.load"),
    "scan.nrrd": (_dense, "volume.load_all"),
    "scan.mha": (_dense, "volume.load"),
    "scan.tif": (_tiff, "volume.load"),
}
PACKAGES = {"scan.nii.gz": "nibabel", "scan.nrrd": "nrrd", "scan.tif": "tifffile"}
_LOAD = """
import resource, sys, geokit
from geokit import DeviceMemoryError
module, function = sys.argv[2].split(".")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    getattr(getattr(geokit, module), function)(sys.argv[1])
except DeviceMemoryError as error:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before >> 10, error)
"""


@pytest.fixture(scope="module")
def server():
    with ForkServer("import numpy, geokit.mesh, geokit.points, geokit.volume") as server:
        yield server


@pytest.mark.slow
@pytest.mark.parametrize("name", spread(BOMBS, 5))
def test_bombs_are_refused_with_the_estimate(tmp_path, server, name):
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name])
    make, function = BOMBS[name]
    kind = make, (tmp_path / name).suffix
    if kind not in _MADE:
        make(tmp_path / name)
        _MADE[kind] = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(_MADE[kind])
    assert (tmp_path / name).stat().st_size < 20 << 20
    done = server.run(_LOAD, tmp_path / name, function)
    assert done.returncode == 0, done.stderr[-2000:]
    grown, _, message = done.stdout.partition(" ")
    assert message.startswith(f"{tmp_path / name}: its content needs 1.5 GiB of memory"), done.stdout
    assert "raise memory_limit" in message
    assert int(grown) < 100  # MiB


def _polygon(path):
    """One face of random corners, which crosses itself wherever it can."""
    count, kind = 2_000, path.suffix
    corners = np.random.default_rng(5).random((count, 3)).round(6) * [1, 1, 0]
    numbers = "\n".join(" ".join(map(str, row)) for row in corners.tolist())
    face = " ".join(map(str, range(count)))
    vtk_xml = (
        '<VTKFile type="{0}" version="0.1"><{0}><Piece NumberOfPoints="{1}" {2}><Points><DataArray type="Float64" '
        'NumberOfComponents="3" format="ascii">{3}</DataArray></Points><{4}><DataArray type="Int32" Name="connectivity"'
        ' format="ascii">{5}</DataArray><DataArray type="Int32" Name="offsets" format="ascii">{1}</DataArray>{6}</{4}>'
        "</Piece></{0}></VTKFile>"
    )
    types = '<DataArray type="UInt8" Name="types" format="ascii">7</DataArray>'
    texts = {
        ".obj": "v " + numbers.replace("\n", "\nv ") + "\nf " + " ".join(map(str, range(1, count + 1))) + "\n",
        ".off": f"OFF\n{count} 1 0\n{numbers}\n{count} {face}\n",
        ".ply": f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face 1\nproperty list int int vertex_indices\nend_header\n"
        f"{numbers}\n{count} {face}\n",
        ".vtk": f"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS {count} double\n{numbers}\n"
        f"POLYGONS 1 {count + 1}\n{count} {face}\n",
        ".vtp": vtk_xml.format("PolyData", count, 'NumberOfPolys="1"', numbers, "Polys", face, ""),
        ".vtu": vtk_xml.format("UnstructuredGrid", count, 'NumberOfCells="1"', numbers, "Cells", face, types),
        ".usda": '#usda 1.0\ndef Mesh "a" {\npoint3f[] points = ['
        + ", ".join(f"({x}, {y}, {z})" for x, y, z in corners.tolist())
        + f"]\nint[] faceVertexCounts = [{count}]\nint[] faceVertexIndices = [{face.replace(' ', ', ')}]\n}}\n",
        ".xdmf": f'<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry GeometryType="XYZ"><DataItem DataType="Float" '
        f'Dimensions="{count} 3" Format="XML" Precision="8">{numbers}</DataItem></Geometry><Topology '
        f'TopologyType="Mixed" NumberOfElements="1"><DataItem DataType="Int" Dimensions="{count + 2}" Format="XML" '
        f'Precision="4">3 {count} {face}</DataItem></Topology></Grid></Domain></Xdmf>',
        ".dae": '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset><up_axis>Z_UP'
        '</up_axis></asset><library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" '
        f'count="{3 * count}">{numbers}</float_array><technique_common>'
        f'<accessor source="#a" count="{count}" stride="3">'
        '<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>'
        '</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices><polylist '
        f'count="1"><input semantic="VERTEX" source="#v" offset="0"/><vcount>{count}</vcount><p>{face}</p></polylist>'
        '</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node>'
        '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>'
        '<instance_visual_scene url="#s"/></scene></COLLADA>',
    }
    path.write_text(texts[kind])
    return count


POLYGONS = {".usda": "pxr", ".dae": "collada"}


@pytest.mark.parametrize("kind", [".obj", ".off", ".ply", ".vtk", ".vtp", ".vtu", ".usda", ".xdmf", ".dae"])
def test_a_face_that_crosses_itself_costs_little(tmp_path, kind):
    pytest.importorskip(POLYGONS.get(kind, "numpy"))
    count = _polygon(tmp_path / f"a{kind}")
    begin = time.process_time()
    assert len(mesh.load(tmp_path / f"a{kind}").faces) == count - 2
    assert time.process_time() - begin < 15.0  # 0.2 s; 50 s and more where each ear is looked for among all corners


def _wide(path, kind):
    """Many names in a header: columns, elements, properties, or fields."""
    names, count = [f"c{at}" for at in range(30_000)], 30_000
    vertices = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 1\nproperty list int int vertex_indices\n"
    rows = ["0 0 0", "1 0 0", "0 1 0"]
    if kind == "columns":
        path.write_text(",".join(["x", "y", "z", *names]) + "\n" + ",".join(["1"] * (count + 3)) + "\n")
    elif kind == "words":
        path.write_text(",".join(["x", "y", "z", *names]) + "\n1,1,1" + ",a" * count + "\n")
    elif kind == "elements":
        more = "".join(f"element {name} 0\nproperty int a\n" for name in names)
        path.write_text(f"ply\nformat ascii 1.0\n{vertices}{faces}{more}end_header\n" + "\n".join([*rows, "3 0 1 2\n"]))
    elif kind == "properties":
        more = "".join(f"property int {name}\n" for name in names)
        rows = [row + " 1" * count for row in rows]
        path.write_text(f"ply\nformat ascii 1.0\n{vertices}{more}{faces}end_header\n" + "\n".join([*rows, "3 0 1 2\n"]))
    else:
        facts = {"VERSION": "0.7", "FIELDS": " ".join(["x", "y", "z", *names]), "SIZE": "4 " * (count + 3)}
        facts |= {"TYPE": "F " * (count + 3), "COUNT": "1 " * (count + 3), "WIDTH": "1", "HEIGHT": "1"}
        facts |= {"VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": "1", "DATA": "ascii\n" + "1 " * (count + 3)}
        path.write_text("".join(f"{key} {value}\n" for key, value in facts.items()))


@pytest.mark.parametrize(
    ("kind", "name"),
    [("columns", "a.csv"), ("words", "a.csv"), ("elements", "a.ply"), ("properties", "a.ply"), ("fields", "a.pcd")],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_headers_of_many_names_cost_little(tmp_path, kind, name):
    _wide(tmp_path / name, kind)
    begin = time.process_time()
    (mesh.load if kind in ("elements", "properties") else points.load)(tmp_path / name)
    assert time.process_time() - begin < 5.0  # 0.5 s; 7 s and more where each name is looked for in a list


def test_the_limit_is_the_caller_s(tmp_path):
    rows = np.zeros((40_000, 3))
    np.savez_compressed(tmp_path / "a.npz", points=rows)
    with pytest.raises(DeviceMemoryError, match="its content needs"):
        points.load(tmp_path / "a.npz", memory_limit=rows.nbytes // 2)
    assert len(points.load(tmp_path / "a.npz", memory_limit=2 * rows.nbytes)) == len(rows)
    np.savez_compressed(tmp_path / "r.npz", origins=rows, directions=rows + 1.0)
    with pytest.raises(DeviceMemoryError):
        points.load_rays(tmp_path / "r.npz", memory_limit=rows.nbytes)
    assert len(points.load_rays(tmp_path / "r.npz", memory_limit=3 * rows.nbytes).origins) == len(rows)


@pytest.mark.parametrize("codec", ["zip", "blosc"])
def test_the_limit_of_volumes(tmp_path, codec):
    path = tmp_path / "a.nvdb"
    made = volume.from_dense(np.ones((40, 40, 40), np.float32), voxel_size=1.0, background=0.0)
    volume.save(path, made, codec=codec)
    size = len(made.nanovdb)
    for load in (volume.load, volume.load_all):
        with pytest.raises(DeviceMemoryError, match="raise memory_limit"):
            load(path, memory_limit=size // 2)
        load(path, memory_limit=2 * size)


@pytest.mark.parametrize("encoding", ["binary_compressed"])
def test_the_limit_of_pcd(tmp_path, encoding):
    points.save(tmp_path / "a.pcd", np.zeros((40_000, 3)), encoding=encoding)
    with pytest.raises(DeviceMemoryError):
        points.load(tmp_path / "a.pcd", memory_limit=40_000)
    assert len(points.load(tmp_path / "a.pcd", memory_limit=2_000_000)) == 40_000


def test_the_limit_of_laz(tmp_path):
    points.save(tmp_path / "a.laz", np.zeros((40_000, 3)))
    with pytest.raises(DeviceMemoryError):
        points.load(tmp_path / "a.laz", memory_limit=40_000)
    assert len(points.load(tmp_path / "a.laz", memory_limit=4_000_000)) == 40_000


# An answer over the limit, and an array that the process of the reader cannot even allocate.
@pytest.mark.slow
@pytest.mark.parametrize("rows", [12_000_000, 1_000_000_000])
def test_readers_of_other_libraries_keep_the_limit(tmp_path, rows):
    """Files of HDF5 do not tell the size of their content in their head."""
    with h5py.File(tmp_path / "b.h5", "w") as file:
        # Chunks that were never written are zeros, and take no room in the file.
        file.create_dataset("points", (rows, 3), "<f8", chunks=(1 << 16, 3))
    path = tmp_path / "a.xdmf"
    path.write_text(
        '<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry GeometryType="XYZ">'
        f'<DataItem DataType="Float" Dimensions="{rows} 3" Format="HDF" Precision="8">b.h5:/points</DataItem>'
        '</Geometry><Topology TopologyType="Triangle" NumberOfElements="1">'
        '<DataItem DataType="Int" Dimensions="1 3" Format="XML" '
        'Precision="8">0 1 2</DataItem></Topology></Grid></Domain></Xdmf>'
    )
    with pytest.raises(FileFormatError, match=r"needs more memory .* raise memory_limit"):
        mesh.load(path, memory_limit=200 << 20)


def test_what_no_archive_is_stays_a_format_error(tmp_path):
    for name, load in (("a.npz", points.load), ("a.npz", points.load_rays), ("a.3mf", mesh.load)):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(FileFormatError, match="archive"):
            load(tmp_path / name)


def test_a_member_that_is_no_array_is_left_out(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 3)))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("readme", "text")
    assert len(points.load(tmp_path / "a.npz")) == 2
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("points", "text")
    with pytest.raises(FileFormatError, match="has no array 'points'"):
        points.load(tmp_path / "b.npz")
