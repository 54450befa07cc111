"""The header and the buffers of a .gltf or .glb; what is not understood of it is refused by name."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from geokit.errors import FileFormatError
from geokit.formats.scene_content.gltf_accessors import Accessors, entry_of, object_of, objects, primitives_of
from geokit.formats.scene_content.gltf_shapes import INSTANCES, VISIBILITY, write_out

# Extensions that do not change the shape, by the beginnings of their names.
_LOOKS = (
    "KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_xmp", "KHR_animation_pointer", "EXT_texture_", "EXT_lights_",
    "MSFT_texture_", "MSFT_packing_", "ADOBE_materials_", "AGI_",
)  # fmt: skip
_WRITTEN_OUT = ("KHR_mesh_quantization", INSTANCES, VISIBILITY)
# Extensions that change the shape of a file even where it does not require them.
_SHAPES = {"MSFT_lod": "levels of detail"}
# What animations change of a shape; with a pointer it may be anything.
_MOVES = ("translation", "rotation", "scale", "weights", "pointer")
_DECOMPRESS = "export it without compression, or decompress it with gltf-transform copy"
_REMEDIES = dict.fromkeys(
    ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"), _DECOMPRESS
)
_OTHER_VERSION = "{}: is glTF {}, and only 2 is read; convert it with gltf-pipeline"
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def opened(path: Path, read: Callable[[str], bytes]) -> tuple[dict[str, Any], Accessors]:
    """The file's JSON, with all that gives its meshes their shape as positions and nodes, and its accessors.

    A damaged file raises other errors too, as they come.

    Args:
        path: A .gltf or .glb file.
        read: Reads another file that this one refers to.
    Raises:
        FileFormatError: The file needs an extension that is not understood, is of another version of glTF, or is cut
            off.
    """
    data = path.read_bytes()
    if data.startswith(b"glTF") and len(data) >= 8 and data[4:8] != b"\2\0\0\0":
        raise FileFormatError(_OTHER_VERSION.format(path, int.from_bytes(data[4:8], "little")))
    told = int.from_bytes(data[8:12], "little") if data.startswith(b"glTF") else 0
    if len(data) < told:
        raise FileFormatError(f"{path}: has {len(data)} of the {told} bytes that it says; get a whole copy")
    tree, binary = _split(data)
    _require_understood(tree, path)
    _add_a_scene(tree)
    _add_base_colors(tree)
    accessors = Accessors(tree, binary, read)
    # Damage in what is not used is damage as well.
    for number in range(len(tree.get("bufferViews", ()))):
        accessors.view(number)
    for number in range(len(tree.get("accessors", ()))):
        accessors.stored(number)
    write_out(tree, accessors)
    return tree, accessors


def is_animated(tree: dict[str, Any]) -> bool:
    """Whether animations move nodes, joints or morph targets."""
    channels = [channel for one in objects(tree.get("animations")) for channel in objects(one.get("channels"))]
    return any(object_of(channel.get("target")).get("path") in _MOVES for channel in channels)


def _add_a_scene(tree: dict[str, Any]) -> None:
    """Give a tree that names no scenes one of all nodes that are no children."""
    nodes = objects(tree.get("nodes"))
    if "scenes" in tree or not nodes:
        return
    children = {child for node in nodes for child in objects(node.get("children"), int)}
    tree["scenes"] = [{"nodes": [number for number in range(len(tree["nodes"])) if number not in children]}]


def _add_base_colors(tree: dict[str, Any]) -> None:
    """Give materials of the older model, with specular colors, their diffuse colors as base colors."""
    for material in objects(tree.get("materials")):
        old = object_of(object_of(material.get("extensions")).get("KHR_materials_pbrSpecularGlossiness"))
        names = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
        if "pbrMetallicRoughness" not in material and names.keys() & old.keys():
            material["pbrMetallicRoughness"] = {new: old[name] for name, new in names.items() if name in old}


def _split(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The tree of a file, and the binary chunk of a .glb."""
    binary = b""
    if data.startswith(b"glTF"):
        size, kind = struct.unpack_from("<II", data, 12)
        if kind != _JSON:
            raise ValueError("its first chunk is no JSON")
        at = 20 + size
        # Chunks of other kinds are to be passed over.
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<II", data, at)
            at += 8 + length
            if at > len(data):
                raise ValueError("a chunk reaches beyond the file")
            if kind == _BINARY and not binary:
                binary = data[at - length : at]
        data = data[20 : 20 + size]
    # Names in the code page of a machine are no reason to refuse a file.
    tree = json.loads(data.decode(json.detect_encoding(data), "replace"))
    if not isinstance(tree, dict):
        raise ValueError("its JSON is no object")
    return tree, binary


def _require_understood(tree: dict[str, Any], path: Path) -> None:
    version = str(object_of(tree.get("asset")).get("version", "2.0"))
    if not version.startswith("2"):
        raise FileFormatError(_OTHER_VERSION.format(path, version[:20]))
    for name in objects(tree.get("extensionsRequired"), str):
        if name not in _WRITTEN_OUT and not name.startswith(_LOOKS):
            remedy = _REMEDIES.get(name, "export it without")
            raise FileFormatError(f"{path}: requires the glTF extension {name[:80]!r}, which is not read; {remedy}")
    for node in objects(tree.get("nodes")):
        for name, what in _SHAPES.items():
            if name in object_of(node.get("extensions")):
                raise FileFormatError(f"{path}: has {what} ({name}), which are not read; export it without")
        if "skin" in node and INSTANCES in object_of(node.get("extensions")):
            raise FileFormatError(
                f"{path}: has instances of a skin ({INSTANCES}), which are not read; export it without"
            )
    for primitive in primitives_of(tree):
        # Without data there is only what an extension holds, whether the file requires it or not.
        position = entry_of(tree, "accessors", object_of(primitive.get("attributes")).get("POSITION"))
        if position is not None and "bufferView" not in position and "sparse" not in position:
            name = next(iter(object_of(primitive.get("extensions"))), "no buffer of positions")
            remedy = _REMEDIES.get(name, "export it again")
            raise FileFormatError(f"{path}: holds a mesh without positions ({name[:80]!r}); {remedy}")
    for buffer in objects(tree.get("buffers")):
        # A buffer that only a decoder would fill.
        for name, extension in object_of(buffer.get("extensions")).items():
            if name in _REMEDIES and "uri" not in buffer and object_of(extension).get("fallback") is True:
                raise FileFormatError(f"{path}: is compressed with {name!r}, which is not read; {_REMEDIES[name]}")
