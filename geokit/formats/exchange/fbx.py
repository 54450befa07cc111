"""Scenes of Autodesk FBX (.fbx), through ufbx, always in a separate process.

ufbx's bindings (0.0.5) release objects twice when a scene has several meshes, and crash. So whatever is taken from a
scene is kept, and the process ends without releasing it.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError
from geokit.formats.attributes.mtl import image_content
from geokit.formats.file_content.body import Body, FileMaterial

# Whether ``trusted=True`` may read a file in the caller's process.
IN_PROCESS = False

_Found = TypeVar("_Found")
_kept: list[Any] = []


def prepare() -> None:
    """Import ufbx."""
    require_package("ufbx")


def read_mesh(path: Path, folders: Sequence[Path]) -> list[Body]:
    """Read each mesh at each of its nodes; nothing is merged, and invisible nodes are left out.

    Polygons stay polygons. Normals, texture coordinates and colors belong to corners; materials have a name, a diffuse
    color and its texture, which is embedded, in the file's own folder or in ``folders``. Skins and blend shapes are
    read as they are stored, without their bones. Units and axes are not converted.

    Raises:
        FileFormatError: The file is damaged, or holds no mesh.
    """
    ufbx = require_package("ufbx")
    gc.disable()
    try:
        scene = _keep(ufbx.load_memory(path.read_bytes(), ignore_animation=True))
    except ufbx.UfbxError as error:
        reason = in_one_line(str(error))
        raise FileFormatError(f"{path}: cannot be read ({reason}); the file is damaged, export it again") from None
    notes: list[str] = []
    rows: dict[int, int] = {}
    materials: list[FileMaterial] = []

    def row(material: Any) -> int:
        if material.element_id not in rows:
            rows[material.element_id] = len(materials)
            materials.append(_material(material, path, folders, notes))
        return rows[material.element_id]

    bodies, placed = [], set()
    for node in _items(scene.nodes):
        mesh = _keep(node.mesh)
        if mesh is not None:
            placed.add(mesh.element_id)
        if mesh is not None and node.visible and mesh.num_faces:
            if len(_keep(mesh.all_deformers)):
                notes.append("skins and blend shapes are read as they are stored, without their bones")
            bodies.append(_body(node, mesh, [row(one) for one in _items(node.materials)]))
    if not bodies:
        raise FileFormatError(f"{path}: holds no visible mesh; convert the geometry to meshes and export again")
    lost = [mesh for mesh in _items(scene.meshes) if mesh.element_id not in placed]
    if lost:
        notes.append(f"{len(lost)} of its meshes belong to no node and are left out")
    if len(_keep(scene.anim_curves)):
        notes.append("its animations are left out: it is read as it stands without them")
    settings = _keep(scene.settings)
    up = _keep(settings.axes).up.name
    bodies[0] = bodies[0]._replace(
        materials=tuple(materials),
        notes=tuple(notes),
        meters_per_unit=settings.unit_meters or None,
        up_axis=up[-1].lower() if up.startswith("POSITIVE_") else None,
    )
    return bodies


def _keep(found: _Found) -> _Found:
    _kept.append(found)
    return found


def _items(listed: Any) -> Iterator[Any]:
    _keep(listed)
    return (_keep(listed[at]) for at in range(len(listed)))


def _integers(listed: Any) -> NDArray[np.int64]:
    _keep(listed)
    return np.fromiter((listed[at] for at in range(len(listed))), np.int64, len(listed))


def _body(node: Any, mesh: Any, materials: list[int]) -> Body:
    faces = np.array(memoryview(_keep(mesh.faces)), np.int64).reshape(-1, 2)
    matrix = np.eye(4)
    matrix[:3] = np.array(node.geometry_to_world, np.float64).T
    # Points and lines are faces there too.
    surface = faces[:, 1] >= 3
    counts = faces[surface, 1]
    first = faces[surface, 0]
    starts = np.cumsum(counts) - counts
    corners = np.repeat(first - starts, counts) + np.arange(counts.sum())
    polygon = {}
    of_faces = _integers(mesh.face_material)
    if materials and len(of_faces) == len(faces):
        known = of_faces[surface]
        fitting = known < len(materials)
        polygon["material"] = np.where(fitting, np.array(materials)[np.where(fitting, known, 0)], -1).astype(np.int32)
    corner = {}
    for name, attribute, columns in (
        ("normal", "vertex_normal", 3),
        ("uv", "vertex_uv", 2),
        ("color", "vertex_color", 4),
    ):
        found = _keep(getattr(mesh, attribute))
        if found.exists:
            values = np.array(memoryview(_keep(found.values)), np.float64).reshape(-1, columns)
            corner[name] = values[_integers(found.indices)[corners]]
    return Body(
        np.array(memoryview(_keep(mesh.vertices)), np.float64).reshape(-1, 3),
        counts,
        _integers(mesh.vertex_indices)[corners],
        name=node.name,
        transform=matrix,
        clockwise=bool(mesh.reversed_winding),
        polygon_data=polygon,
        corner_data=corner,
    )


def _material(material: Any, path: Path, folders: Sequence[Path], notes: list[str]) -> FileMaterial:
    """A material with its diffuse color or texture; a note if the texture is not read."""
    diffuse = _keep(_keep(material.fbx).diffuse_color)
    texture = _keep(diffuse.texture)
    if texture is None or not diffuse.texture_enabled:
        color = _keep(diffuse.value_vec4)
        return FileMaterial(material.name, (color.x, color.y, color.z, 1.0) if diffuse.has_value else None)
    reference = (texture.relative_filename or texture.filename).replace("\\", "/")
    content = bytes(texture.content)
    if not content:
        content = image_content(reference, path, folders, notes)
    return FileMaterial(material.name, None, Path(reference).name, content)
