"""What trimesh does not understand of a .gltf or .glb is refused by name, and normalized positions are restored.

trimesh leaves out what it does not know: compressed meshes become triangles at one point, instances are lost, and
normalized integers are taken for coordinates.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

__all__ = ["understood"]

# Extensions that do not change the shape, by the beginnings of their names.
_LOOKS = (
    "KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_xmp", "KHR_animation_pointer", "EXT_texture_", "EXT_lights_",
    "MSFT_texture_", "MSFT_packing_", "ADOBE_materials_", "AGI_",
)  # fmt: skip
_QUANTIZED = "KHR_mesh_quantization"
# Extensions that change the shape of a file even where it does not require them.
_SHAPES = {"EXT_mesh_gpu_instancing": "instances", "MSFT_lod": "levels of detail"}
_REMEDIES = {
    "KHR_draco_mesh_compression": "export it without compression, or decompress it with gltf-transform copy",
    "EXT_meshopt_compression": "export it without compression, or decompress it with gltf-transform copy",
    "KHR_meshopt_compression": "export it without compression, or decompress it with gltf-transform copy",
}
# Integer types of accessors by their code.
_INTEGERS: dict[Any, Any] = {5120: np.dtype("<i1"), 5121: np.dtype("<u1"), 5122: np.dtype("<i2"), 5123: np.dtype("<u2")}
_MODES = {6: "triangle fans"}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def understood(path: Path, read: Callable[[str], bytes]) -> bytes | None:
    """The file with normalized positions as floats; None if it is understood as it is.

    Args:
        path: A .gltf or .glb file.
        read: Reads another file that this one refers to.
    Raises:
        FileFormatError: The file needs an extension that is not understood, or is of another version of glTF.
    """
    data = path.read_bytes()
    tree, binary = _opened(data)
    if not isinstance(tree, dict):
        return None  # trimesh says what is wrong
    _require_understood(tree, path)
    wanted = _normalized(tree)
    if not wanted:
        return None
    for index in wanted:
        _restore(tree, index, lambda number: _buffer(tree, number, binary, read))
    text = json.dumps(tree).encode()
    if not data.startswith(b"glTF"):
        return text
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(binary), _BINARY) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def _opened(data: bytes) -> tuple[Any, bytes]:
    """The tree of a file, and the binary chunk of a .glb; None if it cannot be read."""
    binary = b""
    try:
        if data.startswith(b"glTF"):
            size, kind = struct.unpack_from("<II", data, 12)
            if kind != _JSON:
                return None, b""
            at = 20 + size
            if at + 8 <= len(data):
                length, _ = struct.unpack_from("<II", data, at)
                binary = data[at + 8 : at + 8 + length]
            data = data[20 : 20 + size]
        return json.loads(data), binary
    except (ValueError, struct.error, RecursionError):
        return None, b""


def _require_understood(tree: dict[str, Any], path: Path) -> None:
    version = str(_object(tree.get("asset")).get("version", "2.0"))
    if not version.startswith("2"):
        raise FileFormatError(f"{path}: is glTF {version[:20]}, and only 2 is read; convert it with gltf-pipeline")
    for name in _listed(tree.get("extensionsRequired"), str):
        if name != _QUANTIZED and not name.startswith(_LOOKS):
            remedy = _REMEDIES.get(name, "export it without")
            raise FileFormatError(f"{path}: requires the glTF extension {name[:80]!r}, which is not read; {remedy}")
    for node in _listed(tree.get("nodes")):
        for name, what in _SHAPES.items():
            if name in _object(node.get("extensions")):
                raise FileFormatError(f"{path}: has {what} ({name}), which are not read; export it without")
    for primitive in _primitives(tree):
        mode = primitive.get("mode")
        if mode in _MODES:
            raise FileFormatError(f"{path}: holds {_MODES[mode]}, which are not read; export it as triangles")
        for index in (primitive.get("indices"), _position(primitive)):
            if "sparse" in (_at(tree, "accessors", index) or {}):
                raise FileFormatError(f"{path}: holds sparse accessors, which are not read; export it without")


def _normalized(tree: dict[str, Any]) -> list[int]:
    """Accessors of positions that are normalized integers."""
    found = set()
    for index in map(_position, _primitives(tree)):
        accessor = _at(tree, "accessors", index) or {}
        if accessor.get("normalized") is True and accessor.get("componentType") in _INTEGERS:
            found.add(index)
    return sorted(found)


def _restore(tree: dict[str, Any], index: int, buffer: Callable[[int], bytes]) -> None:
    """Replace an accessor of integers by one of floats, in a buffer of its own."""
    accessor = tree["accessors"][index]
    view = tree["bufferViews"][accessor["bufferView"]]
    kind, count = _INTEGERS[accessor["componentType"]], int(accessor["count"])
    step = int(view.get("byteStride") or 3 * kind.itemsize)
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    rows: NDArray[Any] = np.ndarray((count, 3), kind, buffer(view["buffer"]), start, (step, kind.itemsize))
    # As the specification has it: the most negative integer is -1 as well.
    values = np.maximum(rows / np.iinfo(kind).max, -1.0).astype("<f4").tobytes()
    tree["buffers"].append(
        {"byteLength": len(values), "uri": "data:application/octet-stream;base64," + base64.b64encode(values).decode()}
    )
    tree["bufferViews"].append({"buffer": len(tree["buffers"]) - 1, "byteLength": len(values)})
    place = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": 5126, "count": count, "type": "VEC3"}
    tree["accessors"][index] = place


def _buffer(tree: dict[str, Any], number: int, binary: bytes, read: Callable[[str], bytes]) -> bytes:
    uri = tree["buffers"][number].get("uri")
    if uri is None:
        return binary
    head, _, content = str(uri).partition(",")
    return base64.b64decode(content) if head.startswith("data:") and head.endswith(";base64") else read(str(uri))


def _primitives(tree: dict[str, Any]) -> list[dict[str, Any]]:
    found = (_listed(mesh.get("primitives")) for mesh in _listed(tree.get("meshes")))
    return [primitive for primitives in found for primitive in primitives]


def _position(primitive: dict[str, Any]) -> Any:
    return _object(primitive.get("attributes")).get("POSITION")


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _at(tree: dict[str, Any], name: str, index: Any) -> dict[str, Any] | None:
    found = tree.get(name)
    if not isinstance(found, list) or not isinstance(index, int) or not 0 <= index < len(found):
        return None
    return found[index] if isinstance(found[index], dict) else None


def _listed(value: Any, kind: type = dict) -> list[Any]:
    """The entries of a list that are objects, or texts; damaged files hold anything."""
    return [entry for entry in value if isinstance(entry, kind)] if isinstance(value, list) else []
