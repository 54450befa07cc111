"""How other programs write the content to a file. Their libraries are imported where they are used: each row of the
table runs in an environment that has its own."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from tests.foreign.content import (
    CLOUD,
    COLORS,
    FACE_IDS,
    FACES,
    HEIGHTS,
    IMAGE,
    INDICES,
    INTENSITY,
    NORMALS,
    ORIGIN,
    POINT_COLORS,
    SPACING,
    VALUES,
    VERTICES,
    VOXEL_SIZE,
)

# --- meshes ----------------------------------------------------------------------------------------------------------


def trimesh_mesh(path: Path, *, colors: bool = False, **options: Any) -> None:
    import trimesh

    mesh = trimesh.Trimesh(VERTICES, FACES, process=False, vertex_colors=COLORS if colors else None)
    mesh.export(path, **options)


def meshio_mesh(path: Path, *, arrays: bool = True, **options: Any) -> None:
    import meshio

    given = {"point_data": {"height": HEIGHTS}, "cell_data": {"id": [FACE_IDS]}} if arrays else {}
    meshio.Mesh(VERTICES, [("triangle", FACES)], **given).write(path, **options)


def pyvista_mesh(path: Path, *, unstructured: bool = False, **options: Any) -> None:
    import pyvista

    mesh = pyvista.PolyData.from_regular_faces(VERTICES, FACES)
    mesh.point_data["height"], mesh.cell_data["id"] = HEIGHTS, FACE_IDS
    (mesh.cast_to_unstructured_grid() if unstructured else mesh).save(path, **options)


def vtk_xdmf_mesh(path: Path) -> None:
    import pyvista
    from vtkmodules.vtkIOXdmf2 import vtkXdmfWriter

    mesh = pyvista.PolyData.from_regular_faces(VERTICES, FACES).cast_to_unstructured_grid()
    mesh.point_data["height"], mesh.cell_data["id"] = HEIGHTS, FACE_IDS
    writer = vtkXdmfWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(mesh)
    writer.Write()


def pyvista_surface(path: Path, **options: Any) -> None:
    import pyvista

    pyvista.PolyData.from_regular_faces(VERTICES, FACES).save(path, **options)


def pyevtk_mesh(path: Path) -> None:
    from pyevtk.hl import unstructuredGridToVTK

    x, y, z = np.ascontiguousarray(VERTICES.T)
    ends = np.arange(3, 3 * len(FACES) + 1, 3)
    types, given = np.full(len(FACES), 5, np.uint8), {"pointData": {"height": HEIGHTS}, "cellData": {"id": FACE_IDS}}
    unstructuredGridToVTK(str(path.with_suffix("")), x, y, z, FACES.ravel(), ends, types, **given)


def open3d_mesh(path: Path, *, colors: bool = False, normals: bool = False, **options: Any) -> None:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(VERTICES), o3d.utility.Vector3iVector(FACES))
    if colors:
        mesh.vertex_colors = o3d.utility.Vector3dVector(COLORS / 255)
    if normals:
        mesh.compute_triangle_normals()
    assert o3d.io.write_triangle_mesh(str(path), mesh, **options)


def pymeshlab_mesh(path: Path, **options: Any) -> None:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    rows = np.column_stack([COLORS / 255, np.ones(len(COLORS))])
    meshes.add_mesh(pymeshlab.Mesh(VERTICES, FACES, v_color_matrix=rows))
    meshes.save_current_mesh(str(path), **options)


def lagrange_mesh(path: Path, **options: Any) -> None:
    import lagrange

    mesh = lagrange.SurfaceMesh()
    mesh.add_vertices(VERTICES)
    mesh.add_triangles(FACES.astype(np.uint32))
    lagrange.io.save_mesh(path, mesh, **options)


def libigl_mesh(path: Path) -> None:
    import igl

    (igl.writeOBJ if path.suffix == ".obj" else igl.writeOFF)(str(path), VERTICES, FACES)
    assert path.exists()


def numpy_stl_mesh(path: Path, *, ascii: bool = False) -> None:
    import stl

    mesh = stl.mesh.Mesh(np.zeros(len(FACES), stl.mesh.Mesh.dtype))
    mesh.vectors[:] = VERTICES[FACES]
    mesh.save(str(path), mode=stl.Mode.ASCII if ascii else stl.Mode.BINARY)


def plyfile_mesh(path: Path, **options: Any) -> None:
    import plyfile

    vertices = np.empty(
        len(VERTICES), [*((axis, "f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))]
    )
    for name, column in zip(vertices.dtype.names or (), (*VERTICES.T, *COLORS.T), strict=True):
        vertices[name] = column
    faces = np.empty(len(FACES), [("vertex_indices", "i4", (3,)), ("id", "i4")])
    faces["vertex_indices"], faces["id"] = FACES, FACE_IDS
    elements = [plyfile.PlyElement.describe(rows, name) for rows, name in ((vertices, "vertex"), (faces, "face"))]
    plyfile.PlyData(elements, **options).write(str(path))


def pygltflib_mesh(path: Path) -> None:
    import pygltflib as gltf

    parts = [VERTICES.astype("<f4"), np.column_stack([COLORS, np.full(5, 255)]).astype("u1"), FACES.astype("<u2")]
    content = b"".join(part.tobytes() for part in parts)
    starts = np.cumsum([0, *(part.nbytes for part in parts)]).tolist()
    tree = gltf.GLTF2(
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[gltf.Node(mesh=0)],
        meshes=[gltf.Mesh(primitives=[gltf.Primitive(attributes=gltf.Attributes(POSITION=0, COLOR_0=1), indices=2)])],
        accessors=[
            gltf.Accessor(bufferView=0, componentType=5126, count=5, type="VEC3",
                          min=VERTICES.min(0).tolist(), max=VERTICES.max(0).tolist()),
            gltf.Accessor(bufferView=1, componentType=5121, normalized=True, count=5, type="VEC4"),
            gltf.Accessor(bufferView=2, componentType=5123, count=FACES.size, type="SCALAR"),
        ],
        bufferViews=[
            gltf.BufferView(buffer=0, byteOffset=start, byteLength=part.nbytes)
            for start, part in zip(starts, parts, strict=False)
        ],
        buffers=[gltf.Buffer(byteLength=len(content))],
    )  # fmt: skip
    tree.set_binary_blob(content)
    if path.suffix == ".gltf":
        tree.convert_buffers(gltf.BufferFormat.DATAURI)
    tree.save(str(path))


def lib3mf_mesh(path: Path) -> None:
    import lib3mf

    model = lib3mf.get_wrapper().CreateModel()
    model.SetUnit(lib3mf.ModelUnit.Inch)
    body = model.AddMeshObject()
    vertices, triangles = [], []
    for place in VERTICES.tolist():
        vertices.append(lib3mf.Position())
        vertices[-1].Coordinates[:] = place
    for corners in FACES.tolist():
        triangles.append(lib3mf.Triangle())
        triangles[-1].Indices[:] = corners
    body.SetGeometry(vertices, triangles)
    model.AddBuildItem(body, lib3mf.get_wrapper().GetIdentityTransform())
    model.QueryWriter("3mf").WriteToFile(str(path))


def gmsh_mesh(path: Path, *, version: float = 4.1, binary: bool = False) -> None:
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", binary)
    gmsh.option.setNumber("Mesh.SaveAll", 1)
    gmsh.model.add("pyramid")
    tag = gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(2, tag, np.arange(1, len(VERTICES) + 1), VERTICES.ravel())
    gmsh.model.mesh.addElementsByType(tag, 2, np.arange(1, len(FACES) + 1), FACES.ravel() + 1)
    gmsh.write(str(path))
    gmsh.finalize()


def gmsh_box(path: Path) -> None:
    """A box from the origin to (1, 2, 3) by Open CASCADE."""
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("box")
    gmsh.model.occ.addBox(0, 0, 0, 1, 2, 3)
    gmsh.model.occ.synchronize()
    gmsh.write(str(path))
    gmsh.finalize()


def assimp_mesh(path: Path, *, code: str) -> None:
    source = path.with_name("source.obj")
    rows = [f"v {x} {y} {z}\n" for x, y, z in VERTICES.tolist()]
    source.write_text("".join([*rows, *(f"f {a} {b} {c}\n" for a, b, c in (FACES + 1).tolist())]))
    subprocess.run(["assimp", "export", source, path, f"-f{code}"], check=True, capture_output=True, timeout=60)
    source.unlink()


def pycollada_mesh(path: Path) -> None:
    import collada

    document = collada.Collada()
    source = collada.source.FloatSource("positions", VERTICES.ravel(), ("X", "Y", "Z"))
    geometry = collada.geometry.Geometry(document, "pyramid", "pyramid", [source])
    inputs = collada.source.InputList()
    inputs.addInput(0, "VERTEX", "#positions")
    geometry.primitives.append(geometry.createTriangleSet(FACES.ravel(), inputs, "none"))
    document.geometries.append(geometry)
    node = collada.scene.Node("node", children=[collada.scene.GeometryNode(geometry, [])])
    document.scenes.append(collada.scene.Scene("scene", [node]))
    document.scene = document.scenes[0]
    document.write(str(path))


def usd_mesh(path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdUtils

    inner = path.with_suffix(".usdc") if path.suffix == ".usdz" else path
    stage = Usd.Stage.CreateNew(str(inner))
    UsdGeom.SetStageMetersPerUnit(stage, 0.5)
    UsdGeom.SetStageUpAxis(stage, "Z")
    mesh = UsdGeom.Mesh.Define(stage, "/pyramid")
    mesh.CreatePointsAttr(VERTICES.tolist())
    mesh.CreateFaceVertexCountsAttr([3] * len(FACES))
    mesh.CreateFaceVertexIndicesAttr(FACES.ravel().tolist())
    stage.Save()
    if inner != path:
        assert UsdUtils.CreateNewUsdzPackage(str(inner), str(path))
        inner.unlink()


# --- clouds ----------------------------------------------------------------------------------------------------------


def open3d_cloud(path: Path, **options: Any) -> None:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(CLOUD))
    cloud.colors = o3d.utility.Vector3dVector(POINT_COLORS / 255)
    if path.suffix != ".pts":
        cloud.normals = o3d.utility.Vector3dVector(NORMALS)
    assert o3d.io.write_point_cloud(str(path), cloud, **options)


def pypcd4_cloud(path: Path, *, encoding: str = "binary") -> None:
    from pypcd4 import Encoding, PointCloud

    cloud = PointCloud.from_xyzi_points(np.column_stack([CLOUD, INTENSITY]).astype(np.float32))
    cloud.save(path, encoding=Encoding(encoding))


def laspy_cloud(path: Path, *, version: str = "1.4", point_format: int = 7, backend: str = "") -> None:
    import laspy

    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [1 / 64] * 3, [0.0] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = CLOUD.T
    las.intensity = (INTENSITY * 256).astype(np.uint16)
    las.red, las.green, las.blue = POINT_COLORS.astype(np.uint16).T * 257
    las.write(str(path), **({"laz_backend": laspy.LazBackend[backend]} if backend else {}))


def copclib_cloud(path: Path) -> None:
    import copclib

    settings = copclib.CopcConfigWriter(7, copclib.Vector3(1 / 64, 1 / 64, 1 / 64), copclib.Vector3(0, 0, 0))
    # The library takes no other name than .copc.laz.
    named = path.with_name("a.copc.laz")
    writer = copclib.FileWriter(str(named), settings)
    points = copclib.Points(writer.copc_config.las_header)
    for x, y, z in CLOUD.tolist():
        point = points.CreatePoint()
        point.x, point.y, point.z = x, y, z
        points.AddPoint(point)
    writer.AddNode(copclib.VoxelKey(0, 0, 0, 0), points)
    writer.Close()
    named.rename(path)


def pye57_cloud(path: Path) -> None:
    import pye57

    columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.ascontiguousarray(CLOUD.T), strict=True))
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw({**columns, "intensity": INTENSITY})
    file.close()


def pymeshlab_cloud(path: Path, **options: Any) -> None:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(CLOUD, v_normals_matrix=NORMALS))
    meshes.save_current_mesh(str(path), save_vertex_normal=True, **options)


def pandas_cloud(path: Path) -> None:
    import pandas

    pandas.DataFrame({**dict(zip("xyz", CLOUD.T, strict=True)), "intensity": INTENSITY}).to_csv(
        path, index=False, sep="," if path.suffix == ".csv" else " "
    )


def polars_cloud(path: Path) -> None:
    import polars

    table = polars.DataFrame({**dict(zip("xyz", CLOUD.T, strict=True)), "intensity": INTENSITY})
    table.write_csv(path, separator="," if path.suffix == ".csv" else " ")


def numpy_cloud(path: Path) -> None:
    if path.suffix == ".npz":
        np.savez_compressed(path, points=CLOUD, intensity=INTENSITY)
    elif path.suffix == ".npy":
        np.save(path, CLOUD)
    elif path.suffix == ".bin":
        np.column_stack([CLOUD, INTENSITY]).astype("<f4").tofile(path)
    else:
        np.savetxt(path, CLOUD)


def pyvista_cloud(path: Path) -> None:
    import pyvista

    cloud = pyvista.PolyData(CLOUD)
    cloud.point_data["intensity"] = INTENSITY
    cloud.save(path)


def plyfile_cloud(path: Path, **options: Any) -> None:
    import plyfile

    rows = np.empty(len(CLOUD), [*((axis, "f8") for axis in "xyz"), ("intensity", "f4")])
    for name, column in zip(rows.dtype.names or (), (*CLOUD.T, INTENSITY), strict=True):
        rows[name] = column
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], **options).write(str(path))


# --- dense volumes ---------------------------------------------------------------------------------------------------


def simpleitk_image(path: Path, *, compressed: bool = False) -> None:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(IMAGE.transpose(2, 1, 0))
    image.SetSpacing(SPACING.tolist())
    image.SetOrigin(ORIGIN.tolist())
    SimpleITK.WriteImage(image, str(path), useCompression=compressed)


def simpleitk_slices(path: Path) -> None:
    """A folder of slices, numbered and placed by their tags."""
    import SimpleITK

    path.mkdir()
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for number in range(IMAGE.shape[2]):
        image = SimpleITK.GetImageFromArray(IMAGE[:, :, number].T)
        image.SetSpacing(SPACING[:2].tolist())
        place = ORIGIN + np.array([0, 0, number]) * SPACING
        tags = {
            "0008|0060": "CT", "0020|000d": "1.2.3", "0020|000e": "1.2.4", "0008|0018": f"1.2.5.{number}",
            "0020|0032": "\\".join(map(str, place)), "0020|0037": "1\\0\\0\\0\\1\\0", "0020|0013": str(number + 1),
        }  # fmt: skip
        for tag, value in tags.items():
            image.SetMetaData(tag, value)
        writer.SetFileName(str(path / f"{number}.dcm"))
        writer.Execute(image)


def pydicom_slices(path: Path, *, compressed: bool = False) -> None:
    import pydicom
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, RLELossless

    path.mkdir()
    for number in range(IMAGE.shape[2]):
        data = pydicom.Dataset()
        data.SOPClassUID, data.SOPInstanceUID, data.Modality = CTImageStorage, f"1.2.5.{number + 1}", "CT"
        data.StudyInstanceUID, data.SeriesInstanceUID, data.InstanceNumber = "1.2.3", "1.2.4", number + 1
        data.Columns, data.Rows, data.SamplesPerPixel = *IMAGE.shape[:2], 1
        data.PhotometricInterpretation, data.PixelRepresentation = "MONOCHROME2", 1
        data.BitsAllocated = data.BitsStored = 16
        data.HighBit = 15
        data.PixelSpacing = [SPACING[1], SPACING[0]]
        data.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        data.ImagePositionPatient = (ORIGIN + np.array([0, 0, number]) * SPACING).tolist()
        data.PixelData = IMAGE[:, :, number].T.tobytes()
        data.file_meta = pydicom.dataset.FileMetaDataset()
        data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        if compressed:
            data.compress(RLELossless)
        pydicom.dcmwrite(path / f"{number}.dcm", data, enforce_file_format=True)


def nibabel_image(path: Path) -> None:
    import nibabel

    matrix = np.diag([*SPACING, 1.0])
    matrix[:3, 3] = ORIGIN
    nibabel.save(nibabel.Nifti1Image(IMAGE, matrix), path)


def pynrrd_image(path: Path, **options: Any) -> None:
    import nrrd

    header = {
        "space": "left-posterior-superior",
        "space directions": np.diag(SPACING),
        "space origin": ORIGIN,
        **options,
    }
    nrrd.write(str(path), IMAGE, header, detached_header=path.suffix == ".nhdr")


def mrcfile_image(path: Path) -> None:
    import mrcfile

    with mrcfile.new(path) as file:
        file.set_data(IMAGE.transpose(2, 1, 0))
        file.voxel_size = tuple(SPACING.tolist())
        file.header.origin = tuple(ORIGIN.tolist())


def gemmi_image(path: Path) -> None:
    import gemmi

    grid = gemmi.FloatGrid(IMAGE.astype(np.float32))
    grid.set_unit_cell(gemmi.UnitCell(*(SPACING * IMAGE.shape), 90, 90, 90))
    grid.spacegroup = gemmi.SpaceGroup("P1")
    written = gemmi.Ccp4Map()
    written.grid = grid
    written.update_ccp4_header(2, True)
    written.write_ccp4_map(str(path))


def tifffile_image(path: Path, **options: Any) -> None:
    import tifffile

    given = {"spacing": SPACING[2], "unit": "micron", "axes": "ZYX"}
    pages = IMAGE.transpose(2, 1, 0)
    tifffile.imwrite(path, pages, imagej=True, resolution=tuple(1 / SPACING[:2]), metadata=given, **options)


def tifffile_ome(path: Path, **options: Any) -> None:
    import tifffile

    sizes = {f"PhysicalSize{axis}": size for axis, size in zip("XYZ", SPACING.tolist(), strict=True)}
    units = {f"PhysicalSize{axis}Unit": "µm" for axis in "XYZ"}
    tifffile.imwrite(path, IMAGE.transpose(2, 1, 0), ome=True, metadata={"axes": "ZYX", **sizes, **units}, **options)


def pillow_image(path: Path, **options: Any) -> None:
    from PIL import Image

    first, *rest = (Image.fromarray(page.astype(np.uint16)) for page in IMAGE.transpose(2, 1, 0))
    first.save(path, save_all=True, append_images=rest, **options)


def zarr_image(path: Path, *, version: int = 3) -> None:
    import zarr

    zarr.save_array(str(path), IMAGE, zarr_format=version)


def ome_zarr_image(path: Path) -> None:
    import ome_zarr.writer
    import zarr

    scale = [[{"type": "scale", "scale": SPACING[::-1].tolist()}]]
    group = zarr.open_group(str(path), mode="w")
    ome_zarr.writer.write_multiscale(
        [IMAGE.transpose(2, 1, 0)], group, axes=[{"name": a, "type": "space", "unit": "micrometer"} for a in "zyx"],
        coordinate_transformations=scale,
    )  # fmt: skip


def tensorstore_image(path: Path, *, driver: str = "zarr3") -> None:
    import tensorstore

    spec = {"driver": driver, "kvstore": {"driver": "file", "path": str(path)}}
    store = tensorstore.open(spec, create=True, dtype=tensorstore.int16, shape=IMAGE.shape).result()
    store[...] = IMAGE


def pyvista_image(path: Path) -> None:
    import pyvista

    image = pyvista.ImageData(dimensions=IMAGE.shape, spacing=SPACING, origin=ORIGIN)
    image.point_data["values"] = IMAGE.ravel(order="F")
    image.save(path)


def vtk_meta_image(path: Path, *, compressed: bool) -> None:
    import pyvista
    from vtkmodules.vtkIOImage import vtkMetaImageWriter

    image = pyvista.ImageData(dimensions=IMAGE.shape, spacing=SPACING, origin=ORIGIN)
    image.point_data["values"] = IMAGE.ravel(order="F")
    writer = vtkMetaImageWriter()
    writer.SetFileName(str(path))
    writer.SetCompression(compressed)
    writer.SetInputData(image)
    writer.Write()


def pyevtk_image(path: Path) -> None:
    from pyevtk.hl import imageToVTK

    spacing, origin = tuple(SPACING.tolist()), tuple(ORIGIN.tolist())
    imageToVTK(
        str(path.with_suffix("")), origin=origin, spacing=spacing, pointData={"values": np.asfortranarray(IMAGE)}
    )


def numpy_image(path: Path) -> None:
    np.save(path, IMAGE)


def midvoxio_voxels(path: Path) -> None:
    from midvoxio.voxio import write_list_to_vox

    colors = np.zeros((*IMAGE.shape, 4))
    colors[tuple(INDICES[(IMAGE.shape > INDICES).all(1)].T)] = [1, 0, 0, 1]
    palette = np.full((256, 4), 255, np.uint8)
    palette[:, 1:3] = np.arange(256)[:, None]
    write_list_to_vox(colors, str(path), palette_arr=palette)


def pyvox_voxels(path: Path) -> None:
    from pyvox.models import Vox
    from pyvox.writer import VoxWriter

    # This library takes arrays by y (from the top), z and x.
    VoxWriter(str(path), Vox.from_dense(_boxes().transpose(1, 2, 0)[:, ::-1])).write()


def _boxes() -> np.ndarray:
    colors = np.zeros(IMAGE.shape, np.uint8)
    colors[tuple(INDICES[(IMAGE.shape > INDICES).all(1)].T)] = 9
    return colors


# --- sparse volumes --------------------------------------------------------------------------------------------------


def lagrange_grid(path: Path, *, dtype: str = "float32", codec: str = "Blosc") -> None:
    import lagrange

    grid = lagrange.volume.Grid.from_points(INDICES, VALUES.astype(dtype), dtype=getattr(np, dtype))
    grid.name, grid.transform = "density", np.diag([VOXEL_SIZE] * 3 + [1.0])
    grid.save(path, getattr(lagrange.volume.Compression, codec))


def tinyvdb_grid(path: Path) -> None:
    """The values of a grid of another library, all of them written anew."""
    import tinyvdb

    lagrange_grid(path, codec="Zip")
    file = tinyvdb.open(str(path))
    file.read_grids()
    content = file.to_bytes(compression=tinyvdb.COMPRESS_ZIP, level=9)
    file.close()
    path.write_bytes(content)


PYOPENVDB = """
import sys
import numpy as np, pyopenvdb
rows = np.load(sys.argv[1])
grid = pyopenvdb.FloatGrid()
grid.name, grid.transform = "density", pyopenvdb.createLinearTransform(float(rows["size"]))
accessor = grid.getAccessor()
for place, value in zip(rows["indices"].tolist(), rows["values"].tolist()):
    accessor.setValueOn(tuple(place), value)
grid.saveFloatAsHalf = bool(rows["half"])
pyopenvdb.write(sys.argv[2], [grid])
"""


def pyopenvdb_grid(path: Path, *, half: bool = False) -> None:
    rows = path.with_name("rows.npz")
    np.savez(rows, indices=INDICES, values=VALUES.astype(np.float16) if half else VALUES, size=VOXEL_SIZE, half=half)
    subprocess.run(["/usr/bin/python3", "-c", PYOPENVDB, rows, path], check=True, capture_output=True, timeout=60)
    rows.unlink()


def vdb_tool_grid(path: Path) -> None:
    source = path.with_name("source.vdb")
    pyopenvdb_grid(source)
    subprocess.run(["vdb_tool", "-read", source, "-write", path], check=True, capture_output=True, timeout=60)
    source.unlink()


def nanovdb_convert_grid(path: Path, *, codec: str = "") -> None:
    source = path.with_name("source.vdb")
    pyopenvdb_grid(source)
    command = ["nanovdb_convert", *([f"--{codec}"] if codec else []), "-f", source, path]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    source.unlink()
