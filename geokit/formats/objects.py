"""What meshes of other libraries carry on their vertices, faces and corners; none of the libraries is imported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.objects import POLYGON_CELLS, attribute, getattr_or_none, host
from geokit.formats.attributes.images import as_read, png_of
from geokit.formats.file_content.body import Body, FileMaterial
from geokit.formats.meshio_files import named
from geokit.formats.vtk import unit_of

# Meters in the units that trimesh names, each by the names that files have; the first is written.
UNITS = {
    1.0: ("m", "meter", "meters"),
    0.001: ("mm", "millimeter", "millimeters"),
    0.01: ("cm", "centimeter", "centimeters"),
    1000.0: ("km", "kilometer", "kilometers"),
    0.0254: ("in", "inch", "inches"),
    0.3048: ("ft", "foot", "feet"),
    1e-6: ("um", "micron", "microns"),
}

# Open3D's names, which are plural.
_OPEN3D = {"normals": "normal", "colors": "color", "texture_uvs": "uv", "material_ids": "material"}


def carried_by(mesh: Any, body: Body, *, images: bool = True) -> Body:
    """A body with what a mesh of trimesh, pyvista, meshio or Open3D carries besides positions and polygons.

    Whatever raises an error in the other library is left out with a note.

    Args:
        mesh: The object.
        body: Its points and polygons.
        images: Whether the images of materials come along, which may take a second to encode.
    """
    if attribute(mesh, "visual") is not None:
        read: Callable[[Any, Body, bool], Body] = _of_trimesh
    elif attribute(mesh, "triangles") is not None:
        read = _of_open3d
    elif attribute(mesh, "triangle") is not None:
        read = _of_open3d_tensors
    elif attribute(mesh, "point_data") is not None and attribute(mesh, "cell_data") is not None:
        read = _of_meshio if isinstance(attribute(mesh, "cells"), list) else _of_pyvista
    else:
        return body
    try:
        return _with_sound_materials(read(mesh, body, images))
    except MemoryError:
        raise
    except Exception as error:  # of the other library
        return body._replace(notes=(f"its attributes cannot be read ({type(error).__name__}: {error})",))


def _of_trimesh(mesh: Any, body: Body, images: bool) -> Body:
    visual = mesh.visual
    vertex, face = (_arrays(attribute(mesh, f"{kind}_attributes")) for kind in ("vertex", "face"))
    given = getattr_or_none(mesh, "_cache")
    # Asking for normals computes them; trimesh's own writers look here as well for those that are there.
    if given is not None and "vertex_normals" in given:
        vertex.setdefault("normal", np.asarray(mesh.vertex_normals))
    kind = attribute(visual, "kind")
    materials: tuple[FileMaterial, ...] = ()
    if kind == "vertex":
        vertex.setdefault("color", np.asarray(visual.vertex_colors))
    elif kind == "face":
        face.setdefault("color", np.asarray(visual.face_colors))
    elif kind == "texture":
        vertex = {**_arrays(attribute(visual, "vertex_attributes")), **vertex}
        if (uv := attribute(visual, "uv")) is not None:
            vertex["uv"] = np.asarray(uv)
        materials, rows = _trimesh_materials(visual, len(body.counts), images)
        if materials:
            face["material"] = rows
    unit = str(attribute(mesh, "units") or "").lower()
    meters = next((meters for meters, names in UNITS.items() if unit in names), None)
    return body._replace(vertex_data=vertex, polygon_data=face, materials=materials, meters_per_unit=meters)


def _trimesh_materials(
    visual: Any, face_count: int, images: bool
) -> tuple[tuple[FileMaterial, ...], NDArray[np.int32]]:
    """The materials that say anything, and which of them each face has."""
    material = attribute(visual, "material")
    several = attribute(material, "materials")
    rows = attribute(visual, "face_materials") if several is not None else None
    used = np.zeros(face_count, np.int64) if rows is None else np.asarray(rows, np.int64)
    found = [
        _trimesh_material(each, at, images) for at, each in enumerate(several if several is not None else [material])
    ]
    kept = [at for at, each in enumerate(found) if each != FileMaterial("")]
    renumbered = np.full(len(found) + 1, -1, np.int32)
    renumbered[kept] = np.arange(len(kept))
    return tuple(found[at] for at in kept), renumbered[np.where((used >= 0) & (used < len(found)), used, -1)]


def _trimesh_material(material: Any, number: int, images: bool) -> FileMaterial:
    is_pbr = hasattr(material, "baseColorFactor")
    color = attribute(material, "baseColorFactor" if is_pbr else "diffuse")
    picture = attribute(material, "baseColorTexture" if is_pbr else "image")
    name, channels = str(attribute(material, "name") or ""), None
    given = {"OPAQUE": 0.0, "MASK": attribute(material, "alphaCutoff")}.get(attribute(material, "alphaMode") or "")
    cutoff = None if given is None else float(given)
    if color is not None:
        full = 255.0 if np.asarray(color).dtype.kind in "iu" else 1.0
        channels = tuple((np.asarray(color, np.float64) / full).tolist())
        channels = channels if len(channels) == 4 else (*channels[:3], 1.0)
    if picture is None or not images:
        return FileMaterial(name, channels, alpha_cutoff=cutoff)
    data, end = as_read(picture)
    known = str((attribute(picture, "info") or {}).get("file_path") or "").replace("\\", "/").rpartition("/")[2]
    known = known if known.lower().endswith(end) else f"{name or f'texture_{number}'}{end}"
    return FileMaterial(name, channels, known, data, cutoff)


def _of_pyvista(mesh: Any, body: Body, _: bool) -> Body:
    # Vertices and lines come before polygons in the data of cells.
    first = int(attribute(mesh, "n_verts") or 0) + int(attribute(mesh, "n_lines") or 0)
    polygon = {name: rows[first : first + len(body.counts)] for name, rows in _marked(mesh.cell_data).items()}
    fields = getattr_or_none(mesh, "GetFieldData")
    unit = {} if fields is None else unit_of(fields())
    return body._replace(vertex_data=_marked(mesh.point_data), polygon_data=polygon, **unit)


def _marked(data: Any) -> dict[str, NDArray[Any]]:
    """Arrays by name; those marked as normals and texture coordinates are called so."""
    marks = {"active_normals_name": "normal", "active_texture_coordinates_name": "uv"}
    names = {attribute(data, mark): name for mark, name in marks.items() if name not in data.keys()}  # noqa: SIM118
    found = {names.get(name, name): np.asarray(values) for name, values in data.items()}
    uv = found.get("uv")
    return found if uv is None or uv.ndim != 2 else {**found, "uv": uv[:, :2]}


def _of_meshio(mesh: Any, body: Body, _: bool) -> Body:
    blocks = [at for at, block in enumerate(mesh.cells) if attribute(block, "type") in POLYGON_CELLS]
    polygon = {name: np.concatenate([np.asarray(rows[at]) for at in blocks]) for name, rows in mesh.cell_data.items()}
    return body._replace(vertex_data=named(_arrays(mesh.point_data)), polygon_data=named(polygon))


def _of_open3d(mesh: Any, body: Body, images: bool) -> Body:
    def rows(name: str) -> NDArray[Any]:
        found = attribute(mesh, name)
        return np.empty(0) if found is None else np.asarray(found)

    vertex = {"normal": rows("vertex_normals"), "color": rows("vertex_colors")}
    face = {"normal": rows("triangle_normals"), "material": rows("triangle_material_ids")}
    corner = {"uv": rows("triangle_uvs")}
    # The first row of an image is at the bottom here.
    pictures = [np.asarray(image) for image in attribute(mesh, "textures") or ()]
    if pictures and not face["material"].size:
        face["material"] = np.zeros(len(body.counts), np.int32)
    materials = tuple(
        FileMaterial("", None, f"texture_{at}.png", png_of(pixels[::-1]))
        if images and pixels.ndim > 1 and pixels.size
        else FileMaterial("")  # empty images have no axes
        for at, pixels in enumerate(pictures)
    )
    vertex, face, corner = ({name: at for name, at in data.items() if at.size} for data in (vertex, face, corner))
    return body._replace(vertex_data=vertex, polygon_data=face, corner_data=corner, materials=materials)


def _of_open3d_tensors(mesh: Any, body: Body, images: bool) -> Body:
    def rows(group: Any, without: str) -> dict[str, NDArray[Any]]:
        items = group.items() if callable(getattr_or_none(group, "items")) else vars(group).items()
        return {_OPEN3D.get(name, name): host(values, name, "fiub") for name, values in items if name != without}

    vertex, face = rows(mesh.vertex, "positions"), rows(mesh.triangle, "indices")
    corner = {"uv": face.pop("uv").reshape(-1, 2)} if "uv" in face and face["uv"].ndim == 3 else {}
    material, found = attribute(mesh, "material"), FileMaterial("")
    if material is not None and material.is_valid():
        color = {**material.vector_properties}.get("base_color")
        channels = None if color is None or np.all(np.asarray(color) == 1.0) else tuple(map(float, np.asarray(color)))
        image = {**material.texture_maps}.get("albedo")
        data = (
            b"" if image is None or image.is_empty() or not images else png_of(host(image.as_tensor().cpu(), "albedo"))
        )
        found = FileMaterial("", channels, "albedo.png" if data else "", data)
    if found != FileMaterial("") and "material" not in face:
        face["material"] = np.zeros(len(body.counts), np.int32)
    materials = (found,) if found != FileMaterial("") else ()
    return body._replace(vertex_data=vertex, polygon_data=face, corner_data=corner, materials=materials)


def _with_sound_materials(body: Body) -> Body:
    """Materials that no face names, and rows without a material, would be refused."""
    rows = body.polygon_data.get("material")
    if rows is None or not body.materials or np.asarray(rows).dtype.kind not in "iu":
        return body
    rows = np.asarray(rows)
    if rows.size and not (rows.min() >= -1 and rows.max() < len(body.materials)):
        face = {name: values for name, values in body.polygon_data.items() if name != "material"}
        return body._replace(polygon_data=face, notes=(*body.notes, "faces name materials that are not there"))
    return body


def _arrays(data: Mapping[str, Any] | None) -> dict[str, NDArray[Any]]:
    return {} if data is None else {str(name): np.asarray(values) for name, values in data.items()}
