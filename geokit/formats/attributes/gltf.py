"""Attributes and materials of glTF 2.0: how they are found in its header, and a writer that has them."""

from __future__ import annotations

import base64
import contextlib
import json
import struct
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileAccessError, FileFormatError
from geokit.formats.attributes.columns import as_columns, from_columns, utf8
from geokit.formats.file_content.body import FileMaterial
from geokit.mesh.model.data import full_scale, has_meaning

if TYPE_CHECKING:
    from geokit.mesh.model.data import Material
    from geokit.mesh.model.triangle_mesh import TriangleMesh

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_NAMES = {"NORMAL": "normal", "TEXCOORD_0": "uv", "COLOR_0": "color"}
_TEXTURES = ("normalTexture", "occlusionTexture", "emissiveTexture")
_IMAGES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg"}
# Colors of a PNG, in byte 25: gray and RGB with alpha. Transparency of others stands before the pixels.
_ALPHA_TYPES, _PNG_HEAD = (b"\x04", b"\x06"), 2048
_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_ARRAYS, _INDICES = 34962, 34963
# Larger integers are no float32.
_LARGEST_EXACT = 1 << 24


def _file(header: dict[str, Any], chunks: bytes) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", _MAGIC, 2, 20 + len(text) + len(chunks), len(text), _JSON)
    return head + text + chunks


def attributes_of(raw: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Attributes by geokit's names, from the file's."""
    found: dict[str, NDArray[Any]] = {}
    for name, given in raw.items():
        values = np.asarray(given)
        plain = name.removeprefix("_")
        known = _NAMES.get(plain, plain)
        if known in ("normal", "uv") and values.dtype.kind in "iu":
            values = (values / np.iinfo(values.dtype).max).astype(np.float32)
        if known == "uv" and values.shape[1:] == (2,):
            # Images begin at the top there.
            values = np.stack([values[:, 0], 1 - values[:, 1]], axis=1)
        found[known] = values[:, 0] if values.shape[1:] == (1,) else values
    return from_columns(found)


def materials_of(
    header: dict[str, Any], view: Callable[[int], memoryview], get: Callable[[str], bytes]
) -> tuple[tuple[FileMaterial, ...], tuple[str, ...]]:
    """The materials, and notes on what of them is left out.

    Args:
        header: The header.
        view: The bytes of a buffer view.
        get: Reads a file by its reference.
    """
    notes: dict[str, None] = {}
    images: dict[int, tuple[str, bytes]] = {}
    clear = _with_clear_vertices(header)
    found = []
    for number, material in enumerate(header.get("materials", ())):
        surface = material.get("pbrMetallicRoughness", {})
        if "metallicRoughnessTexture" in surface or any(name in material for name in _TEXTURES):
            notes["of its textures only those of the base color are read"] = None
        color = surface.get("baseColorFactor")
        name, data = "", b""
        if "baseColorTexture" in surface:
            try:
                texture = header["textures"][surface["baseColorTexture"]["index"]]
                extensions = texture.get("extensions", {}).values()
                at = next(part["source"] for part in (texture, *extensions) if "source" in part)
                if at not in images:
                    images[at] = _image(header, at, view, get)
                name, data = images[at]
            except (FileAccessError, FileFormatError) as error:
                notes[f"a texture is left out: {error}"] = None
            except (LookupError, TypeError, ValueError, StopIteration):
                notes[f"the texture of material {number} is left out: its entry in the header is damaged"] = None
        color = color and tuple(map(float, color))
        cutoff = None
        if number in clear or has_alpha(color, data):
            mode = material.get("alphaMode")
            cutoff = None if mode == "BLEND" else float(material.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.0
        found.append(FileMaterial(str(material.get("name", "")), color, name, data, cutoff))
    return tuple(found), tuple(notes)


def _image(
    header: dict[str, Any], at: int, view: Callable[[int], memoryview], get: Callable[[str], bytes]
) -> tuple[str, bytes]:
    image = header["images"][at]
    if "uri" in image:
        data, name = _content(image["uri"], get), "" if image["uri"].startswith("data:") else image["uri"]
    else:
        data, name = bytes(view(image["bufferView"])), image.get("name", "")
    kind = next((kind for magic, kind in _IMAGES.items() if data.startswith(magic)), image.get("mimeType", ""))
    name = PurePosixPath(name or f"texture_{at}").name
    end = {"image/png": ".png", "image/jpeg": ".jpg", "image/webp": ".webp"}.get(kind, "")
    return name if PurePosixPath(name).suffix else name + end, data


def _content(uri: str, get: Callable[[str], bytes]) -> bytes:
    if not uri.startswith("data:"):
        return get(uri)
    return base64.b64decode(uri.partition(",")[2], validate=True)


def holds_type(values: NDArray[Any], _kind: str) -> bool:
    """Whether integers have up to 16 bits, or are float32 as well."""
    return values.dtype.kind not in "iu" or values.dtype.itemsize < 4 or _in_range(values, _LARGEST_EXACT)


def _in_range(values: NDArray[Any], largest: int, least: int | None = None) -> bool:
    return not values.size or bool((-largest if least is None else least) <= values.min() and values.max() <= largest)


def holds_texture(data: bytes) -> bool:
    """Whether an image is one of those that each reader of glTF knows."""
    return data.startswith(tuple(_IMAGES))


def glb_of(mesh: TriangleMesh) -> bytes:
    """A .glb of one node with a primitive for each material: attributes of vertices, materials and textures.

    Numbers are in float32. Integers of 32 bits become shorter ones, or float32 where they do not fit.
    """
    header, content = _written(mesh)
    return _file(header, struct.pack("<I4s", len(content), _BINARY) + content)


def gltf_of(mesh: TriangleMesh) -> bytes:
    """The .gltf with the same content. Its buffer is inside, since two files cannot be replaced together."""
    header, content = _written(mesh)
    header["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    return json.dumps(header).encode()


def _written(mesh: TriangleMesh) -> tuple[dict[str, Any], bytes]:
    """The header, and the content of its buffer."""
    binary = _Binary()
    rows = mesh.face_data.get("material")
    if rows is None:
        rows = np.full(len(mesh.faces), -1)
    data = {name: values for name, values in mesh.vertex_data.items() if _stored_name(name, values) or _fits(values)}
    data.update(as_columns({name: values for name, values in mesh.vertex_data.items() if name not in data}, (*data,)))
    attributes = {_stored_name(name, values) or f"_{name}": _stored(name, values) for name, values in data.items()}
    primitives = []
    used_materials = np.unique(rows)
    for material in used_materials.tolist():
        faces = mesh.faces[rows == material]
        if len(used_materials) == 1:
            used, local = np.arange(mesh.vertex_count), faces
        else:
            used, local = np.unique(faces, return_inverse=True)
        points = mesh.vertices[used].astype(np.float32)
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        placed = {"POSITION": binary.accessor(points, _ARRAYS, bounds)}
        for name, values in attributes.items():
            normalized = {"normalized": True} if name == "COLOR_0" and values.dtype.kind == "u" else {}
            placed[name] = binary.accessor(values[used], _ARRAYS, normalized)
        indices = binary.accessor(local.reshape(-1).astype(np.uint32), _INDICES, {})
        primitive = {"attributes": placed, "indices": indices, "mode": 4}
        primitives.append({**primitive, "material": material} if material >= 0 else primitive)
    name = utf8(mesh.name) or "mesh"
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "geokit"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": primitives}],
    }
    header |= _material_entries(mesh.materials, binary, _is_clear(mesh.vertex_data.get("color")))
    content = bytes(binary.content)
    header |= {"accessors": binary.accessors, "bufferViews": binary.views, "buffers": [{"byteLength": len(content)}]}
    return header, content


def _material_entries(materials: tuple[Material, ...], binary: _Binary, is_clear: bool) -> dict[str, Any]:
    images: dict[bytes, int] = {}
    entries: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    for material in materials:
        # The default is metal, which files that do not say mean least.
        surface: dict[str, Any] = {"metallicFactor": 0.0}
        if material.color is not None:
            surface["baseColorFactor"] = [float(channel) for channel in material.color]
        if material.texture is not None:
            data = material.texture.data
            if data not in images:
                images[data] = len(views)
                kind = next(kind for magic, kind in _IMAGES.items() if data.startswith(magic))
                views.append({"bufferView": binary.view(data, {}), "mimeType": kind, "name": material.texture.name})
            surface["baseColorTexture"] = {"index": images[data]}
        entries.append({"name": material.name, "pbrMetallicRoughness": surface, **_alpha_entries(material, is_clear)})
    found: dict[str, Any] = {"materials": entries} if entries else {}
    return found | ({"images": views, "textures": [{"source": at} for at in range(len(views))]} if views else {})


def _alpha_entries(material: Material, is_clear: bool) -> dict[str, Any]:
    if material.alpha_cutoff is not None:
        mask = {"alphaMode": "MASK", "alphaCutoff": float(material.alpha_cutoff)}
        return mask if material.alpha_cutoff > 0.0 else {}
    # What is opaque is not declared to blend: viewers sort that by its distance, and wrongly so.
    blends = is_clear or has_alpha(material.color, material.texture.data if material.texture else b"")
    return {"alphaMode": "BLEND"} if blends else {}


def has_alpha(color: tuple[float, ...] | None, image: bytes) -> bool:
    """Whether a material is not opaque all over, as far as the head of its image tells."""
    is_png = image.startswith(b"\x89PNG")
    in_image = image[25:26] in _ALPHA_TYPES or b"tRNS" in image[:_PNG_HEAD] if is_png else image.startswith(b"RIFF")
    return bool(in_image or (color and len(color) > 3 and color[3] < 1.0))


def _with_clear_vertices(header: dict[str, Any]) -> set[int]:
    """Materials of which a part of a mesh has colors with alpha."""
    found = set()
    for part in (part for mesh in header.get("meshes", ()) for part in mesh.get("primitives", ())):
        with contextlib.suppress(LookupError, TypeError):  # damaged entries are named elsewhere
            if header["accessors"][part["attributes"]["COLOR_0"]]["type"] == "VEC4":
                found.add(part["material"])
    return found


def _is_clear(colors: NDArray[Any] | None) -> bool:
    return colors is not None and colors.shape[1:] == (4,) and bool(np.any(colors[:, 3] < full_scale(colors.dtype)))


def _stored_name(name: str, values: NDArray[Any]) -> str:
    """The name in the format of an array with a meaning; "" for others."""
    return next((theirs for theirs, ours in _NAMES.items() if ours == name and has_meaning(name, values)), "")


def _fits(values: NDArray[Any]) -> bool:
    return values.ndim == 1 or values.shape[1] in _TYPES


def _stored(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """The values in a type of the format."""
    if _stored_name(name, values) == "TEXCOORD_0":
        return np.stack([values[:, 0], 1 - values[:, 1]], axis=1).astype(np.float32)
    kind, size = values.dtype.kind, values.dtype.itemsize
    if _stored_name(name, values) == "COLOR_0" and (kind == "i" or size > 2) and kind != "f":
        return (values / np.iinfo(values.dtype).max).astype(np.float32)
    if kind == "b":
        return values.astype(np.uint8)
    if kind == "f" or size <= 2:
        return values.astype(np.float32) if kind == "f" else values
    for narrow in (np.uint16, np.int16):
        if _in_range(values, int(np.iinfo(narrow).max), int(np.iinfo(narrow).min)):
            return values.astype(narrow)
    return values.astype(np.float32)


class _Binary:
    """The binary chunk while it grows, with its views and accessors."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, more: dict[str, Any]) -> int:
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(data), **more})
        self.content += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, values: NDArray[Any], target: int, more: dict[str, Any]) -> int:
        table = np.ascontiguousarray(values).reshape(len(values), -1)
        table = table.astype(table.dtype.newbyteorder("<"))
        rows = table.view(np.uint8).reshape(len(table), -1)
        # Rows of vertices begin at multiples of four bytes.
        padding = -rows.shape[1] % 4
        strided = {"byteStride": rows.shape[1] + padding} if padding else {}
        view = self.view(np.pad(rows, ((0, 0), (0, padding))).tobytes(), {"target": target, **strided})
        component, kind = _COMPONENTS[table.dtype.str[1:]], _TYPES[table.shape[1]]
        entry = {"bufferView": view, "componentType": component, "count": len(table), "type": kind, **more}
        self.accessors.append(entry)
        return len(self.accessors) - 1
