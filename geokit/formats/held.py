"""Which attributes of a mesh a file format holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.table import Format
from geokit.mesh.attributes.derived import with_data
from geokit.mesh.attributes.seams import split_seams
from geokit.mesh.model.data import Data, full_scale, has_meaning
from geokit.mesh.model.triangle_mesh import TriangleMesh


def what_is_held(mesh: TriangleMesh, held: Format, module: Any, kind: str = "") -> tuple[TriangleMesh, list[str]]:
    """The mesh with what a format holds, and the names of what it does not.

    Attributes of corners move to vertices where only these may have them; one that both have is that of the corners.

    Args:
        mesh: The mesh.
        held: The line of the format.
        module: The module of the format, which may define ``holds_type(values, kind)``, ``holds_name(name, kind)``
            and ``holds_texture(data)``, and ``HOLDS_CUTOFFS = False`` if its materials have no alpha cutoff.
        kind: The extension, for these.
    """
    said = mesh.materials or mesh.meters_per_unit or mesh.up_axis
    if not (mesh.vertex_data or mesh.face_data or mesh.corner_data or said):
        return mesh, []
    holds_type = getattr(module, "holds_type", lambda *_: True)
    holds_name = getattr(module, "holds_name", lambda *_: True)
    holds_texture = getattr(module, "holds_texture", None)
    materials = " material" * held.materials
    corner = _held(mesh.corner_data, held.corner or held.vertex, 2, holds_type, kind)
    vertex = _held(mesh.vertex_data, held.vertex, 1, holds_type, kind)
    face = _held(mesh.face_data, held.face + materials, 1, holds_type, kind)
    for data in (corner, vertex, face):
        for name in [name for name in data if not holds_name(name, kind)]:
            del data[name]
    lost = [f"vertex {name!r}" for name in mesh.vertex_data if name not in vertex]
    # Without materials, their numbers are not worth a word.
    lost += [f"face {name!r}" for name in mesh.face_data if name not in face and (name, materials) != ("material", "")]
    lost += [f"corner {name!r}" for name in mesh.corner_data if name not in corner]
    color = vertex.get("color")
    if color is not None and "rgb" in held.vertex and color.shape[1] == 4:
        vertex["color"] = color[:, :3]
        if np.any(color[:, 3] != full_scale(color.dtype)):
            lost.append("the alpha of vertex 'color'")
    if mesh.materials and not held.materials:
        lost.append("materials")
    # A meter is what is meant where nothing is said.
    if mesh.meters_per_unit not in (None, 1.0) and not held.unit:
        lost.append(f"the unit of {mesh.meters_per_unit:g} m")
    # So is the axis that is up in most files of the format; what holds a unit holds the axis too.
    if kind and not held.unit and mesh.up_axis not in (None, held.up):
        lost.append(f"that {mesh.up_axis} is up ({held.up} is in most such files)")
    kept_materials = []
    for material in mesh.materials if held.materials else ():
        if holds_texture and material.texture and not holds_texture(material.texture.data):
            lost.append(f"the texture {material.texture.name!r}")
            material = material._replace(texture=None)
        if material.alpha_cutoff and not getattr(module, "HOLDS_CUTOFFS", True):
            lost.append(f"the alpha cutoff of material {material.name!r}")
        kept_materials.append(material)
    kept = with_data(
        mesh,
        vertex_data=vertex,
        face_data=face,
        corner_data=corner,
        materials=tuple(kept_materials),
        meters_per_unit=mesh.meters_per_unit if held.unit else None,
        up_axis=mesh.up_axis,
    )
    return (kept if held.corner else split_seams(kept, list(corner))), lost


def _held(
    data: Data, allowed: str, axes: int, holds_type: Callable[[NDArray[Any], str], bool], kind: str
) -> dict[str, NDArray[Any]]:
    """The arrays with an allowed name and type."""

    def is_held(name: str, values: NDArray[Any]) -> bool:
        if name == "material" and name in allowed:
            return values.ndim == 1 and values.dtype.kind in "iu"
        names = allowed.replace("rgb", "color").split()
        return "*" in names or (name in names and has_meaning(name, values, axes))

    return {name: values for name, values in data.items() if is_held(name, values) and holds_type(values, kind)}
