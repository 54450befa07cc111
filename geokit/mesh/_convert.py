"""Meshes for other libraries; each library is imported when it is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.interop.types import MeshLike
from geokit.core.memory.needs import needs
from geokit.errors import FileFormatError, MissingDependencyError
from geokit.formats.attributes.images import picture_of, pixels_of
from geokit.formats.held import what_is_held
from geokit.formats.objects import UNITS
from geokit.formats.table import Format
from geokit.formats.vtk import poly_data
from geokit.mesh.attributes.derived import with_data
from geokit.mesh.attributes.seams import split_seams
from geokit.mesh.model.data import full_scale, has_meaning
from geokit.mesh.surfaces.objects import require_mesh

if TYPE_CHECKING:
    import meshio
    import open3d
    import pyvista
    import trimesh

    from geokit.mesh.model.data import Material
    from geokit.mesh.model.triangle_mesh import TriangleMesh

_ARRAYS = Format("", vertex="*", face="*")
_TRIMESH = _ARRAYS._replace(materials=True)
_OPEN3D = Format("", vertex="normal rgb", face="normal", corner="uv", materials=True)


def _bytes(mesh: TriangleMesh) -> int:
    # Libraries keep indices in 64 bits; each array is there twice for a moment.
    arrays = (*mesh.vertex_data.values(), *mesh.face_data.values(), *mesh.corner_data.values())
    return 48 * (mesh.vertex_count + mesh.face_count) + 2 * sum(values.nbytes for values in arrays)


@needs(_bytes)
def to_trimesh(mesh: MeshLike) -> trimesh.Trimesh:
    """A ``trimesh.Trimesh`` of the same vertices and faces; nothing is merged or dropped.

    A vertex whose corners differ in an attribute, such as on a seam of texture coordinates, becomes several. Colors and
    the colors of materials become 8 bits, as trimesh has them; where a mesh also has texture coordinates or materials,
    and for further arrays, ``visual.vertex_attributes``, ``vertex_attributes`` and ``face_attributes`` keep them as
    they are. A UserWarning names what is left out.

    Args:
        mesh: A mesh, also of another library (:func:`as_mesh`).
    Returns:
        trimesh.Trimesh with copies of the arrays, float64, and the mesh's name in ``metadata``.
    Raises:
        InputError: It is no mesh.
    """
    mesh = require_mesh(mesh, "mesh")
    unit = UNITS.get(mesh.meters_per_unit or 0.0, ("",))[0]
    mesh, lost = what_is_held(mesh, _TRIMESH._replace(unit=bool(unit)), None)
    import trimesh

    metadata = {"name": mesh.name} if mesh.name else None
    vertex, face = (dict(data) for data in (mesh.vertex_data, mesh.face_data))
    materials, rows = mesh.materials, face.get("material")
    if materials and rows is not None:
        del face["material"]
    else:
        materials = ()
    given: dict[str, Any] = {}
    normal, uv, color = (vertex.get(name) for name in ("normal", "uv", "color"))
    if normal is not None and has_meaning("normal", normal):
        given["vertex_normals"] = np.array(vertex.pop("normal"), np.float64)
    has_uv = uv is not None and has_meaning("uv", uv)
    if has_uv or materials:
        visual = trimesh.visual.TextureVisuals(
            uv=np.array(vertex.pop("uv"), np.float64) if has_uv else None,
            **_trimesh_materials(trimesh.visual.material, materials, rows, lost),
        )
        if color is not None:
            visual.vertex_attributes["color"] = np.array(vertex.pop("color"))
        given["visual"] = visual
    elif color is not None and has_meaning("color", color):
        given["vertex_colors"] = _bytes_of_colors(vertex.pop("color"))
    elif "color" in face and has_meaning("color", face["color"]):
        given["face_colors"] = _bytes_of_colors(face.pop("color"))
    _say(lost, "trimesh")
    made = trimesh.Trimesh(
        np.array(mesh.vertices),
        np.array(mesh.faces),
        process=False,
        validate=False,
        metadata=metadata,
        vertex_attributes={name: np.array(values) for name, values in vertex.items()},
        face_attributes={name: np.array(values) for name, values in face.items()},
        **given,
    )
    if unit:
        made.units = unit
    return made


@needs(_bytes, fatal=True)  # VTK ends the process where memory runs out
def to_pyvista(mesh: MeshLike) -> pyvista.PolyData:
    """A ``pyvista.PolyData`` of the same vertices and faces, with its attributes as point and cell data.

    Normals and texture coordinates are marked as such. A vertex whose corners differ in an attribute becomes several.
    Textures are objects of their own in PyVista, so materials are left out; a UserWarning says so.

    Args:
        mesh: A mesh, also of another library (:func:`as_mesh`).
    Returns:
        pyvista.PolyData with copies of the arrays, float64.
    Raises:
        InputError: It is no mesh.
    """
    mesh, lost = what_is_held(require_mesh(mesh, "mesh"), _ARRAYS._replace(unit=True), None)
    _say(lost, "PyVista")
    return poly_data(mesh)


@needs(_bytes)
def to_meshio(mesh: MeshLike) -> meshio.Mesh:
    """A ``meshio.Mesh`` of the same vertices and faces, as one block of triangles, with its attributes as data.

    A vertex whose corners differ in an attribute becomes several. Materials are left out; a UserWarning says so.

    Args:
        mesh: A mesh, also of another library (:func:`as_mesh`).
    Returns:
        meshio.Mesh with copies of the arrays, float64.
    Raises:
        InputError: It is no mesh.
    """
    mesh, lost = what_is_held(require_mesh(mesh, "mesh"), _ARRAYS, None)
    _say(lost, "meshio")
    import meshio

    return meshio.Mesh(
        np.array(mesh.vertices),
        [("triangle", np.array(mesh.faces))],
        point_data={name: np.array(values) for name, values in mesh.vertex_data.items()},
        cell_data={name: [np.array(values)] for name, values in mesh.face_data.items()},
    )


@needs(_bytes)
def to_open3d(mesh: MeshLike) -> open3d.geometry.TriangleMesh:
    """An ``open3d.geometry.TriangleMesh`` of the same vertices and faces.

    It holds normals, colors of vertices without alpha, texture coordinates, and the images of materials. A vertex whose
    corners differ in normal or color becomes several. A UserWarning names what is left out.

    Open3D's tensor meshes are made of it by ``open3d.t.geometry.TriangleMesh.from_legacy``, in float32.

    Args:
        mesh: A mesh, also of another library (:func:`as_mesh`).
    Returns:
        open3d.geometry.TriangleMesh with copies of the arrays, float64.
    Raises:
        InputError: It is no mesh.
        MissingDependencyError: Open3D is not installed.
    """
    mesh = require_mesh(mesh, "mesh")
    try:
        import open3d
    except ImportError as error:
        raise MissingDependencyError(
            f"to_open3d needs the package open3d ({error}); install it with: pip install open3d"
        ) from None
    mesh = split_seams(mesh, [name for name in ("normal", "color") if _means(mesh.corner_data, name, 2)])
    if "uv" not in mesh.corner_data and _means(mesh.vertex_data, "uv", 1):
        rest = {name: values for name, values in mesh.vertex_data.items() if name != "uv"}
        mesh = with_data(mesh, vertex_data=rest, corner_data={"uv": mesh.vertex_data["uv"][mesh.faces]})
    mesh, lost = what_is_held(mesh, _OPEN3D, None)
    utility, geometry = open3d.utility, open3d.geometry
    found = geometry.TriangleMesh(
        utility.Vector3dVector(np.array(mesh.vertices)), utility.Vector3iVector(np.array(mesh.faces))
    )
    vertex, face = mesh.vertex_data, mesh.face_data
    if "normal" in vertex:
        found.vertex_normals = utility.Vector3dVector(np.array(vertex["normal"], np.float64))
    if "color" in vertex:
        found.vertex_colors = utility.Vector3dVector(vertex["color"] / np.float64(full_scale(vertex["color"].dtype)))
    if "normal" in face:
        found.triangle_normals = utility.Vector3dVector(np.array(face["normal"], np.float64))
    if "uv" in mesh.corner_data:
        found.triangle_uvs = utility.Vector2dVector(np.array(mesh.corner_data["uv"].reshape(-1, 2), np.float64))
    if "material" in face:
        found.triangle_material_ids = utility.IntVector(face["material"].astype(np.int32))
    if any(material.texture for material in mesh.materials):
        # The first row of an image is at the bottom there.
        found.textures = [geometry.Image(np.ascontiguousarray(pixels[::-1])) for pixels in _all_pixels(mesh, lost)]
    if any(material.name or material.color for material in mesh.materials):
        lost.append("the names and colors of materials")
    _say(lost, "Open3D")
    return found


def _trimesh_materials(kinds: Any, materials: tuple[Material, ...], rows: Any, lost: list[str]) -> dict[str, Any]:
    """Arguments of trimesh's TextureVisuals; faces without a material have a last one that says nothing."""
    made = []
    for material in materials:
        picture = None
        if material.texture is not None:
            try:
                picture = picture_of(material.texture)
                picture.info["file_path"] = material.texture.name
            except FileFormatError as error:
                lost.append(f"the {error}")
        color = None if material.color is None else _bytes_of_colors(np.array(material.color))
        cutoff = material.alpha_cutoff
        alpha = (
            {}
            if cutoff is None
            else {"alphaMode": "MASK", "alphaCutoff": cutoff}
            if cutoff
            else {"alphaMode": "OPAQUE"}
        )
        named = {"name": material.name or None, "baseColorFactor": color, "baseColorTexture": picture}
        made.append(kinds.PBRMaterial(**named, **alpha))
    if len(made) == 1 and not np.any(rows):
        return {"material": made[0]}
    if not made:
        return {"material": kinds.PBRMaterial()}
    return {
        "material": kinds.MultiMaterial([*made, kinds.PBRMaterial()]),
        "face_materials": np.where(rows < 0, len(made), rows),
    }


def _all_pixels(mesh: TriangleMesh, lost: list[str]) -> list[NDArray[np.uint8]]:
    """The pixels of each material's texture; none where it has no texture that can be decoded."""
    found = []
    for material in mesh.materials:
        pixels = np.zeros((0, 0, 3), np.uint8)
        if material.texture is not None:
            try:
                pixels = pixels_of(material.texture)
            except FileFormatError as error:
                lost.append(f"the {error}")
        found.append(pixels)
    return found


def _bytes_of_colors(colors: NDArray[Any]) -> NDArray[np.uint8]:
    if colors.dtype == np.uint8:
        return np.array(colors)
    shares = np.clip(colors.astype(np.float64) / full_scale(colors.dtype), 0.0, 1.0)
    return np.rint(np.nan_to_num(shares) * 255.0).astype(np.uint8)


def _means(data: Any, name: str, axes: int) -> bool:
    return name in data and has_meaning(name, data[name], axes)


def _say(lost: list[str], library: str) -> None:
    if lost:
        warn(f"{library} does not hold {', '.join(lost)}; left out")
