"""Small files of formats that geokit only reads: .dae, .e57 and CAD by their libraries, .fbx as text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["CUBE", "CUBE_QUADS", "write_cad", "write_collada", "write_e57", "write_fbx"]

# A cube of quads wound outward, which has its own corner of normals for each.
CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
CUBE_QUADS = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
_NORMALS = np.array([[0, 0, -1], [0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]], np.float64)
_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)


def write_collada(path: Path, *, image: str | None = None, matrix: Any = None) -> None:
    """A cube in centimeters whose first two quads are red and whose others are blue or have an image, placed twice.

    Args:
        path: The .dae file.
        image: Reference of the image of the second material.
        matrix: Matrix (4, 4) of the second place; None moves it by 10 along x.
    """
    import collada as dae

    scene = dae.Collada()
    scene.assetInfo.unitmeter, scene.assetInfo.unitname = 0.01, "centimeter"
    scene.assetInfo.upaxis = dae.asset.UP_AXIS.Z_UP
    diffuse: Any = (0.0, 0.0, 1.0, 1.0)
    parameters = []
    if image is not None:
        picture = dae.material.CImage("picture", image)
        surface = dae.material.Surface("surface", picture)
        sampler = dae.material.Sampler2D("sampler", surface)
        diffuse, parameters = dae.material.Map(sampler, "UV"), [surface, sampler]
        scene.images.append(picture)
    looks = []
    for name, color, given in (("red", (1.0, 0.0, 0.0, 1.0), []), ("blue", diffuse, parameters)):
        effect = dae.material.Effect(f"{name}-effect", given, "phong", diffuse=color)
        look = dae.material.Material(f"{name}-id", name, effect)
        scene.effects.append(effect)
        scene.materials.append(look)
        looks.append((name, look))
    sources = [
        dae.source.FloatSource("positions", CUBE.ravel() * 0.1, ("X", "Y", "Z")),
        dae.source.FloatSource("normals", _NORMALS.ravel(), ("X", "Y", "Z")),
        dae.source.FloatSource("uv", _UV.ravel(), ("S", "T")),
    ]
    cube = dae.geometry.Geometry(scene, "cube-id", "cube", sources)
    inputs = dae.source.InputList()
    for offset, kind, name in ((0, "VERTEX", "#positions"), (1, "NORMAL", "#normals"), (2, "TEXCOORD", "#uv")):
        inputs.addInput(offset, kind, name, *(["0"] if kind == "TEXCOORD" else []))
    for name, faces in (("red", range(2)), ("blue", range(2, 6))):
        rows = [[CUBE_QUADS[face][corner], face, corner] for face in faces for corner in range(4)]
        cube.primitives.append(
            cube.createPolylist(np.array(rows, np.int32).ravel(), np.full(len(faces), 4, np.int32), inputs, name)
        )
    scene.geometries.append(cube)
    first, second = (
        dae.scene.GeometryNode(cube, [dae.scene.MaterialNode(name, look, inputs=[]) for name, look in looks])
        for _ in range(2)
    )
    shift = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    if matrix is None:
        shift[0, 3] = 10.0
    nodes = [
        dae.scene.Node("first", children=[first]),
        dae.scene.Node("second", children=[second], transforms=[dae.scene.MatrixTransform(shift.ravel())]),
    ]
    scene.scenes.append(dae.scene.Scene("scene", nodes))
    scene.scene = scene.scenes[0]
    with open(path, "wb") as file:
        scene.write(file)


def _fbx_array(name: str, values: Any) -> str:
    return f"\t\t{name}: *{np.size(values)} {{\n\t\t\ta: {','.join(map(repr, np.ravel(values).tolist()))}\n\t\t}}\n"


def write_fbx(path: Path, *, bodies: Sequence[str] = ("cube", "box"), image: str | None = None) -> None:
    """Cubes of quads in inches, each 10 further along x; two quads of each are red, the others blue or have an image.

    Args:
        path: The .fbx file, which is text.
        bodies: Names of the nodes.
        image: Reference of the image of the second material.
    """
    ends = CUBE_QUADS.copy()
    ends[:, 3] = -1 - ends[:, 3]
    layers = (
        '\t\tLayerElementNormal: 0 {\n\t\tMappingInformationType: "ByPolygonVertex"\n'
        '\t\tReferenceInformationType: "Direct"\n' + _fbx_array("Normals", np.repeat(_NORMALS, 4, axis=0)) + "\t\t}\n"
        '\t\tLayerElementUV: 0 {\n\t\tName: "map"\n\t\tMappingInformationType: "ByPolygonVertex"\n'
        '\t\tReferenceInformationType: "IndexToDirect"\n'
        + _fbx_array("UV", _UV) + _fbx_array("UVIndex", np.tile(np.arange(4), 6)) + "\t\t}\n"
        '\t\tLayerElementMaterial: 0 {\n\t\tMappingInformationType: "ByPolygon"\n'
        '\t\tReferenceInformationType: "IndexToDirect"\n' + _fbx_array("Materials", [0, 0, 1, 1, 1, 1]) + "\t\t}\n"
        '\t\tLayer: 0 {\n'
        + "".join(
            f'\t\tLayerElement: {{\n\t\tType: "LayerElement{kind}"\n\t\tTypedIndex: 0\n\t\t}}\n'
            for kind in ("Normal", "UV", "Material")
        )
        + "\t\t}\n"
    )  # fmt: skip
    objects, links = [], []
    for number, name in enumerate(bodies):
        shape, node = 1000 + number, 2000 + number
        objects.append(
            f'\tGeometry: {shape}, "Geometry::", "Mesh" {{\n'
            + _fbx_array("Vertices", CUBE * 0.1) + _fbx_array("PolygonVertexIndex", ends) + layers + "\t}\n"
            f'\tModel: {node}, "Model::{name}", "Mesh" {{\n\t\tVersion: 232\n\t\tProperties70: {{\n'
            f'\t\t\tP: "Lcl Translation", "Lcl Translation", "", "A",{10.0 * number},0,0\n\t\t}}\n\t}}\n'
        )  # fmt: skip
        links += [(node, 0), (shape, node), (3000, node), (3001, node)]
    for number, (name, color) in enumerate((("red", "1,0,0"), ("blue", "0,0,1"))):
        objects.append(
            f'\tMaterial: {3000 + number}, "Material::{name}", "" {{\n\t\tShadingModel: "phong"\n\t\tProperties70: {{\n'
            f'\t\t\tP: "DiffuseColor", "Color", "", "A",{color}\n\t\t}}\n\t}}\n'
        )
    lines = "".join(f'\tC: "OO",{one},{other}\n' for one, other in links)
    if image is not None:
        objects.append(
            f'\tTexture: 4000, "Texture::t", "" {{\n\t\tType: "TextureVideoClip"\n\t\tFileName: "{image}"\n'
            f'\t\tRelativeFilename: "{image}"\n\t}}\n'
        )
        lines += '\tC: "OP",4000,3001, "DiffuseColor"\n'
    path.write_text(
        "; FBX 7.4.0 project file\nFBXHeaderExtension:  {\n\tFBXHeaderVersion: 1003\n\tFBXVersion: 7400\n}\n"
        "GlobalSettings:  {\n\tVersion: 1000\n\tProperties70:  {\n"
        '\t\tP: "UpAxis", "int", "Integer", "",2\n\t\tP: "UpAxisSign", "int", "Integer", "",1\n'
        '\t\tP: "FrontAxis", "int", "Integer", "",1\n\t\tP: "FrontAxisSign", "int", "Integer", "",-1\n'
        '\t\tP: "CoordAxis", "int", "Integer", "",0\n\t\tP: "CoordAxisSign", "int", "Integer", "",1\n'
        '\t\tP: "UnitScaleFactor", "double", "Number", "",2.54\n\t}\n}\n'
        f"Objects:  {{\n{''.join(objects)}}}\nConnections:  {{\n{lines}}}\n"
    )


def write_cad(path: Path, *shapes: Any, radius: float = 1.0, unit: str = "MM") -> None:
    """A cylinder of height 3 around the z axis and a cube of size 2 that begins at (5, 0, 0), or other shapes.

    Args:
        path: A .step or .iges file.
        shapes: Of Open CASCADE, instead.
        radius: Radius of the cylinder.
        unit: Unit of a .step file.
    """
    from OCP.BRep import BRep_Builder
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Pnt
    from OCP.IGESControl import IGESControl_Writer
    from OCP.Interface import Interface_Static
    from OCP.Message import Message, Message_PrinterOStream
    from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
    from OCP.TopoDS import TopoDS_Compound

    # Its reports go to the standard output otherwise.
    Message.DefaultMessenger_s().RemovePrinters(Message_PrinterOStream.get_type_descriptor_s())
    whole, builder = TopoDS_Compound(), BRep_Builder()
    builder.MakeCompound(whole)
    if not shapes:
        shapes = (
            BRepPrimAPI_MakeCylinder(radius, 3.0).Shape(),
            BRepPrimAPI_MakeBox(gp_Pnt(5.0, 0.0, 0.0), 2.0, 2.0, 2.0).Shape(),
        )
    for shape in shapes:
        builder.Add(whole, shape)
    if path.suffix in (".iges", ".igs"):
        writer = IGESControl_Writer()
        assert writer.AddShape(whole)
        writer.ComputeModel()
        assert writer.Write(str(path))
    else:
        step = STEPControl_Writer()
        Interface_Static.SetCVal_s("write.step.unit", unit)
        step.Transfer(whole, STEPControl_AsIs)
        step.Write(str(path))
        Interface_Static.SetCVal_s("write.step.unit", "MM")


def write_e57(
    path: Path,
    scans: Sequence[dict[str, Any]],
    *,
    poses: Sequence[Any] | None = None,
    limits: Sequence[tuple[float, float] | None] | None = None,
    images: int = 0,
    names: Sequence[str] = (),
    nodes: dict[str, Any] | None = None,
) -> None:
    """Scans with float64 coordinates, scaled integers for "intensity", and integers for everything else.

    Args:
        path: The .e57 file.
        scans: Columns by the names of the format, for each scan.
        poses: Quaternion (w, x, y, z) and translation of each scan; None writes no poses.
        limits: Limits of the colors of each scan; None writes none.
        images: Number of images, which are empty.
        names: Names of the first scans.
        nodes: What makes the nodes of some columns from the file.
    """
    import pye57
    from pye57 import libe57

    whole = pye57.E57(str(path), "w")
    file = whole.image_file
    file.extensionsAdd("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt")
    for number, columns in enumerate(scans):
        scan = libe57.StructureNode(file)
        scan.set("guid", libe57.StringNode(file, f"scan {number}"))
        if number < len(names):
            scan.set("name", libe57.StringNode(file, names[number]))
        if poses is not None:
            pose = libe57.StructureNode(file)
            for name, parts, values in zip(("rotation", "translation"), ("wxyz", "xyz"), poses[number], strict=True):
                entry = libe57.StructureNode(file)
                for part, value in zip(parts, values, strict=True):
                    entry.set(part, libe57.FloatNode(file, float(value)))
                pose.set(name, entry)
            scan.set("pose", pose)
        if limits is not None and limits[number] is not None:
            ends = libe57.StructureNode(file)
            for color in ("Red", "Green", "Blue"):
                for end, value in zip(("Minimum", "Maximum"), limits[number] or (), strict=True):
                    kind = libe57.FloatNode if isinstance(value, float) else libe57.IntegerNode
                    ends.set(f"color{color}{end}", kind(file, value))
            scan.set("colorLimits", ends)
        prototype = libe57.StructureNode(file)
        for name, values in columns.items():
            if nodes and name in nodes:
                node = nodes[name](file)
            elif values.dtype.kind == "f" and name == "intensity":
                node = libe57.ScaledIntegerNode(file, 0, 0, 2**16 - 1, 1e-4, 0.0)
            elif values.dtype.kind == "f":
                node = libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE)
            else:
                node = libe57.IntegerNode(file, 0, 0, int(np.iinfo(values.dtype).max))
            prototype.set(name, node)
        points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
        scan.set("points", points)
        whole.data3d.append(scan)
        if not len(next(iter(columns.values()))):
            continue
        buffers = libe57.VectorSourceDestBuffer()
        # It knows wide integers as C's long long only.
        wide = {np.dtype(kind): np.longlong for kind in (np.int32, np.int64)}
        kept = [np.ascontiguousarray(values, wide.get(values.dtype)) for values in columns.values()]
        for name, values in zip(columns, kept, strict=True):
            buffers.append(libe57.SourceDestBuffer(file, name, values, len(values), True, True))
        writer = points.writer(buffers)
        writer.write(len(kept[0]))
        writer.close()
    for _ in range(images):
        file.root()["images2D"].append(libe57.StructureNode(file))
    whole.close()
