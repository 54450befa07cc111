"""Meshes with colors, textures and normals of their own, as surfaces that VTK draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.errors import FileFormatError
from geokit.formats.attributes.images import pixels_of
from geokit.mesh.model.data import full_scale, has_meaning
from geokit.mesh.topology.connectivity import position_corners
from geokit.mesh.topology.normals import face_normals

if TYPE_CHECKING:
    from geokit.mesh.model.data import Material
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Of a mesh without colors of its own.
SURFACE_COLOR = "#b9c4cf"
# Edges sharper than this [degrees] stay sharp under smooth shading.
FEATURE_ANGLE = 35.0


class Painted(NamedTuple):
    """A part of a mesh with one texture, or without: pyvista's surface with ``rgb`` on its points, and the texture.

    ``is_clear`` says whether something behind it may be seen through it.
    """

    surface: Any
    texture: Any
    is_clear: bool = False


def is_painted(mesh: TriangleMesh) -> bool:
    """Whether a mesh has colors, or materials with a color or a texture that a face uses."""
    used = [mesh.materials[at] for at in np.unique(_material_rows(mesh)) if at >= 0]
    return _at_corners(mesh, "color") is not None or any(each.color or each.texture for each in used)


def painted(pv: Any, mesh: TriangleMesh, plain: tuple[float, float, float]) -> list[Painted]:
    """The parts of a mesh, by texture. Colors and alpha are those of the mesh times those of its materials.

    A UserWarning names textures that cannot be decoded.

    Args:
        pv: The module pyvista.
        mesh: A mesh for which :func:`is_painted` holds.
        plain: Color of faces without one, from 0 to 1.
    """
    rows = _material_rows(mesh)
    uv = _at_corners(mesh, "uv")
    textures = [_texture(pv, each) if uv is not None else None for each in mesh.materials]
    colors = corner_colors(mesh, plain)
    alpha = corner_alpha(mesh)
    normals = _corner_normals(pv, mesh)
    parts = []
    for material in np.unique(rows):
        texture = textures[material] if material >= 0 else None
        faces = np.flatnonzero(rows == material)
        surface = surface_of(pv, mesh.vertices[mesh.faces[faces].reshape(-1)], np.arange(3 * len(faces)).reshape(-1, 3))
        surface.point_data["Normals"] = normals[faces].reshape(-1, 3).astype(np.float32)
        surface.point_data.active_normals_name = "Normals"
        shown = colors[faces].reshape(-1, 3)
        if alpha is not None:
            shown = np.concatenate([shown, alpha[faces].reshape(-1, 1)], axis=1)
        surface.point_data["rgb"] = np.rint(np.clip(shown, 0.0, 1.0) * 255.0).astype(np.uint8)
        if texture is not None and uv is not None:
            surface.active_texture_coordinates = np.nan_to_num(uv[faces].reshape(-1, 2)).astype(np.float32)
        is_clear = alpha is not None and bool(np.any(alpha[faces] < 1.0))
        parts.append(Painted(surface, texture, is_clear or (texture is not None and texture.n_components == 4)))
    return parts


def corner_alpha(mesh: TriangleMesh) -> NDArray[np.float64] | None:
    """Opacity of the corners (F, 3), from 0 to 1: that of the mesh times that of its materials; None if all are opaque.

    Materials with a cutoff are opaque where the product reaches it.
    """
    rows = _material_rows(mesh)
    own = _at_corners(mesh, "color")
    alpha = np.ones((len(mesh.faces), 3))
    if own is not None and own.shape[2] == 4:
        alpha *= np.nan_to_num(own[..., 3], nan=1.0) / np.float64(full_scale(own.dtype))
    tints = [1.0 if each.color is None else each.color[3] for each in mesh.materials]
    alpha *= np.array([*tints, 1.0])[rows][:, None]
    cutoffs = [np.nan if each.alpha_cutoff is None else each.alpha_cutoff for each in mesh.materials]
    cutoff = np.array([*cutoffs, np.nan])[rows][:, None]
    alpha = np.where(np.isnan(cutoff), alpha, alpha >= cutoff)
    return None if np.all(alpha >= 1.0) else alpha


def corner_colors(mesh: TriangleMesh, plain: tuple[float, float, float]) -> NDArray[np.float64]:
    """Colors of the corners (F, 3, 3), from 0 to 1 as far as those of the mesh are, times those of its materials.

    Args:
        mesh: The mesh.
        plain: Color of faces without one, from 0 to 1.
    """
    rows = _material_rows(mesh)
    own = _at_corners(mesh, "color")
    colors = np.full((len(mesh.faces), 3, 3), np.nan)
    if own is not None:
        colors = own[..., :3] / np.float64(full_scale(own.dtype))
    tints = np.array([_tint(each) for each in mesh.materials] + [(np.nan,) * 3])[rows]
    # NaN means that nothing is said, also where a body of a file has no colors.
    return np.where(np.isnan(colors), 1.0, colors) * np.where(np.isnan(tints), 1.0, tints)[:, None] + np.where(
        np.isnan(colors) & np.isnan(tints)[:, None], np.array(plain) - 1.0, 0.0
    )


def own_colors(cloud: Any, count: int) -> NDArray[Any] | None:
    """The colors (N, 3) or (N, 4) that geokit's PointCloud has, else None."""
    data = getattr(cloud, "data", None)
    if not isinstance(data, Mapping):
        return None
    for name in ("rgb", "rgba", "color"):
        values = np.asarray(data.get(name, 0.0))
        if values.shape in ((count, 3), (count, 4)) and values.dtype.kind in "fui":
            return values
    return None


def bytes_of(colors: NDArray[Any]) -> NDArray[np.uint8]:
    """Red, green and blue from 0 to 255; what is not finite is black."""
    full = full_scale(colors.dtype)
    if colors.dtype == np.uint16 and colors.size and colors.max() < 256:
        # Many .las files hold bytes in numbers of 16 bits.
        full = 255
    scaled = colors[..., :3] / np.float64(full)
    return np.rint(255.0 * np.clip(np.nan_to_num(scaled, nan=0.0), 0.0, 1.0)).astype(np.uint8)


def _material_rows(mesh: TriangleMesh) -> NDArray[Any]:
    """The material of each face (F,), or -1. Files without materials may hold an array of that name."""
    rows = mesh.face_data.get("material")
    is_given = rows is not None and mesh.materials and rows.ndim == 1 and rows.dtype.kind in "iu"
    return rows if is_given and rows is not None else np.full(len(mesh.faces), -1)


def _texture(pv: Any, material: Material) -> Any:
    if material.texture is None:
        return None
    try:
        pixels = pixels_of(material.texture)
    except FileFormatError as error:
        warn(f"mesh: {error}; drawn without it")
        return None
    cutoff = material.alpha_cutoff
    if pixels.shape[2] == 4 and (cutoff == 0.0 or pixels[..., 3].min() == 255):
        pixels = pixels[..., :3]
    elif pixels.shape[2] == 4 and cutoff is not None:
        # The material's own alpha counts as well, once.
        share = 1.0 if material.color is None else max(material.color[3], 1e-9)
        pixels = np.dstack([pixels[..., :3], np.where(pixels[..., 3] / 255.0 * share >= cutoff, 255, 0)])
    texture = pv.Texture(np.ascontiguousarray(pixels, np.uint8))
    texture.repeat, texture.interpolate, texture.mipmap = True, True, True
    return texture


def _tint(material: Material) -> tuple[float, float, float]:
    """Color of a material; NaN where it has none."""
    color = material.color
    if color is None or (material.texture is not None and not any(color[:3])):
        # Many .mtl files say black beside a texture and do not mean it. White leaves a texture as it is.
        return (1.0, 1.0, 1.0) if material.texture is not None else (np.nan,) * 3
    return color[0], color[1], color[2]


def _corner_normals(pv: Any, mesh: TriangleMesh) -> NDArray[np.float64]:
    """Unit normals of the corners (F, 3, 3): those of the mesh, on the side that the face winds to, else computed."""
    flat = face_normals(mesh)
    corners, _ = position_corners(mesh)
    # Seams of attributes are no edges: vertices at one position become one.
    points = np.empty((corners.max() + 1, 3))
    points[corners.reshape(-1)] = mesh.vertices[mesh.faces.reshape(-1)]
    smooth = shaded(surface_of(pv, points, np.ascontiguousarray(corners, np.int64)))
    # Not regular_faces, which PyVista 0.46 cannot read beside VTK 9.5.
    computed = smooth.point_data["Normals"][smooth.faces.reshape(-1, 4)[:, 1:]]
    given = _at_corners(mesh, "normal")
    if given is None:
        return np.asarray(computed, np.float64)
    given = given.astype(np.float64)
    length = np.linalg.norm(given, axis=2, keepdims=True)
    is_sound = np.isfinite(length) & (length > 0.0)
    unit = given / np.where(is_sound, length, 1.0)
    # Files with wrong winding often have right normals, and VTK turns those of faces that it sees from behind.
    away = np.einsum("fck,fk->fc", np.where(is_sound, unit, 0.0), flat) < 0.0
    return np.where(is_sound, np.where(away[..., None], -unit, unit), computed)


def surface_of(pv: Any, points: NDArray[Any], faces: NDArray[Any]) -> Any:
    """Triangles for PyVista, in memory of their own.

    What a filter returns may share the faces of its input, and PyVista 0.46 frees those that are no copies with it.
    """
    return pv.PolyData.from_regular_faces(np.array(points), faces, deep=True)


def shaded(surface: Any) -> Any:
    """The surface with vertex normals, split at sharp edges."""
    return surface.compute_normals(
        cell_normals=False,
        split_vertices=True,
        feature_angle=FEATURE_ANGLE,
        consistent_normals=False,
        auto_orient_normals=False,
    )


def _at_corners(mesh: TriangleMesh, name: str) -> NDArray[Any] | None:
    """An array with a meaning at the corners, (F, 3, k), else of vertices, else of faces; None if there is none."""
    for data, axes in ((mesh.corner_data, 2), (mesh.vertex_data, 1), (mesh.face_data, 1)):
        if name in data and has_meaning(name, data[name], axes):
            values = data[name]
            if data is mesh.vertex_data:
                return values[mesh.faces]
            return values if axes == 2 else np.repeat(values[:, None], 3, axis=1)
    return None
