"""What gives a glTF mesh its shape beside positions and nodes is written out as such.

Default weights of morph targets, skins in the pose of their nodes, and instances become float positions and nodes;
hidden nodes lose their meshes. The first texture coordinates become those of the base color's texture, where a file has
others there or transforms them.

Source:
    Khronos, glTF 2.0 Specification, 3.7.2.2 (morph targets), 3.7.3 (skins);
    EXT_mesh_gpu_instancing; KHR_node_visibility; KHR_texture_transform, whose rotation is that of its example: counter-
    clockwise in an image whose rows go down.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.formats.scene_content.gltf_accessors import FLOAT, Accessors, entry_of, object_of, objects, primitives_of

INSTANCES = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"
_TRANSFORM = "KHR_texture_transform"
_SHORTEST = 4 * np.finfo(np.float64).eps
_WEIGHT, _JOINT = "WEIGHTS_", "JOINTS_"


def write_out(tree: dict[str, Any], accessors: Accessors) -> None:
    """Change the file's JSON so that float positions and nodes are all there is."""
    done: dict[tuple[str, int], int] = {}
    for primitive in primitives_of(tree):
        _float_positions(primitive, accessors, done)
    hidden = [number for number, node in enumerate(tree.get("nodes", ())) if _is_hidden(node)]
    for number in _reached(tree, hidden):
        tree["nodes"][number].pop("mesh", None)
    # Poses are those of the file, before nodes are added or taken away.
    poses = _poses(tree) if any(map(_is_skinned, objects(tree.get("nodes")))) else []
    morphed: dict[tuple[int, tuple[float, ...]], int] = {}
    for number, node in enumerate(list(tree.get("nodes", ()))):
        weights = _weights(tree, node)
        if weights:
            key = node["mesh"], tuple(weights)
            if key not in morphed:
                morphed[key] = _morphed(tree, node["mesh"], weights, accessors)
            node["mesh"] = morphed[key]
        if _is_skinned(node):
            _skin(tree, number, poses, accessors)
        extensions = object_of(node.get("extensions"))
        if INSTANCES in extensions:
            _instantiate(tree, node, extensions.pop(INSTANCES), accessors)
    # Morph targets move the coordinates under their own names.
    for primitive in primitives_of(tree):
        if _has_other_uv(tree, primitive):
            _base_uv(tree, primitive, accessors, done)


def _float_positions(primitive: dict[str, Any], accessors: Accessors, done: dict[tuple[str, int], int]) -> None:
    attributes = primitive["attributes"]
    index = attributes["POSITION"]
    if accessors.stored(index).dtype.kind == "f":
        return
    key = "float", index
    if key not in done:
        done[key] = accessors.add(accessors.numbers(index))
    attributes["POSITION"] = done[key]


def _uv_of(tree: dict[str, Any], primitive: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The number of the coordinates that a primitive's base color takes, and their transform."""
    surface = object_of(object_of(entry_of(tree, "materials", primitive.get("material"))).get("pbrMetallicRoughness"))
    texture = object_of(surface.get("baseColorTexture"))
    transform = object_of(object_of(texture.get("extensions")).get(_TRANSFORM))
    return transform.get("texCoord", texture.get("texCoord", 0)), transform


def _has_other_uv(tree: dict[str, Any], primitive: dict[str, Any]) -> bool:
    """Whether its texture coordinates are other ones than the first as they are stored."""
    number, transform = _uv_of(tree, primitive)
    given = entry_of(tree, "accessors", object_of(primitive.get("attributes")).get(f"TEXCOORD_{number}"))
    if given is None:
        return False
    plain = given.get("componentType") == FLOAT or given.get("normalized") is True
    return number != 0 or not plain or any(name in transform for name in ("offset", "rotation", "scale"))


def _base_uv(
    tree: dict[str, Any], primitive: dict[str, Any], accessors: Accessors, done: dict[tuple[str, int], int]
) -> None:
    """The coordinates of the base color's texture, transformed, as the first ones, which take the place of those."""
    number, transform = _uv_of(tree, primitive)
    attributes = primitive["attributes"]
    index = attributes[f"TEXCOORD_{number}"]
    key = f"uv {transform}", index
    if key not in done:
        scale, offset = (np.array(transform.get(name, [at, at]), float) for name, at in (("scale", 1), ("offset", 0)))
        sine, cosine = np.sin(transform.get("rotation", 0.0)), np.cos(transform.get("rotation", 0.0))
        u, v = (accessors.numbers(index) * scale).T
        moved = np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1) + offset
        done[key] = accessors.add(moved)
    first = attributes.get("TEXCOORD_0")
    if number and first is not None:
        attributes[f"TEXCOORD_{number}"] = first
    attributes["TEXCOORD_0"] = done[key]


def _is_skinned(node: dict[str, Any]) -> bool:
    return "skin" in node and "mesh" in node


def _is_hidden(node: dict[str, Any]) -> bool:
    """Whether a node is hidden, and with it all below."""
    return object_of(object_of(node.get("extensions")).get(VISIBILITY)).get("visible") is False


def _weights(tree: dict[str, Any], node: dict[str, Any]) -> list[float]:
    """Weights of a node's morph targets, or of its mesh; nothing if all are 0."""
    mesh = object_of(entry_of(tree, "meshes", node.get("mesh")))
    weights = node.get("weights", mesh.get("weights"))
    if not isinstance(weights, list) or not any(
        object_of(part).get("targets") for part in objects(mesh.get("primitives"))
    ):
        return []
    return weights if any(weights) else []


def _morphed(tree: dict[str, Any], number: int, weights: list[float], accessors: Accessors) -> int:
    """Number of a copy of a mesh, displaced by its targets."""
    mesh = dict(tree["meshes"][number])
    mesh.pop("weights", None)
    mesh["primitives"] = []
    for primitive in tree["meshes"][number]["primitives"]:
        changed = {**primitive, "attributes": dict(primitive["attributes"])}
        targets = changed.pop("targets", [])
        if len(targets) != len(weights):
            raise ValueError(f"{len(weights)} weights for {len(targets)} morph targets")
        for name in changed["attributes"]:
            moved = [(w, t[name]) for w, t in zip(weights, targets, strict=True) if w and name in t]
            if not moved:
                continue
            values = accessors.numbers(changed["attributes"][name])
            for weight, index in moved:
                steps = accessors.numbers(index)
                # The fourth number of a tangent is a side.
                values[:, : steps.shape[1]] += float(weight) * steps
            if name == "NORMAL":
                values = _unit(values)
            elif name.startswith("COLOR_"):
                values = np.clip(values, 0.0, 1.0)
            changed["attributes"][name] = accessors.add(values)
        mesh["primitives"].append(changed)
    tree["meshes"].append(mesh)
    return len(tree["meshes"]) - 1


def _skin(tree: dict[str, Any], number: int, poses: list[NDArray[np.float64]], accessors: Accessors) -> None:
    """Put a node's mesh where its joints are, into a node of its own: the pose of the node itself has no meaning."""
    node = tree["nodes"][number]
    skin = tree["skins"][node.pop("skin")]
    joints = np.stack([poses[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        # Columns come first in the file.
        inverse = accessors.numbers(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(inverse) < len(joints):
            raise ValueError(f"{len(inverse)} inverse bind matrices for {len(joints)} joints")
        joints = joints @ inverse[: len(joints)]
    # Positions are float32: they are kept relative to the joints' middle.
    middle = joints[:, :3, 3].mean(axis=0)
    joints[:, :3, 3] -= middle
    given = tree["meshes"][node.pop("mesh")]
    parts: dict[bool, list[Any]] = {False: [], True: []}
    for primitive in given["primitives"]:
        parts[any(name.startswith(_WEIGHT) for name in primitive["attributes"])].append(primitive)
    if parts[False]:
        # What has no joints stays with the node.
        tree["meshes"].append({**given, "primitives": parts[False]})
        node["mesh"] = len(tree["meshes"]) - 1
    if not parts[True]:
        return
    moved = [_skinned(primitive, joints, middle, accessors) for primitive in parts[True]]
    tree["meshes"].append({**given, "primitives": moved})
    placed = {"name": node["name"]} if "name" in node else {}
    tree["nodes"].append({**placed, "mesh": len(tree["meshes"]) - 1, "translation": middle.tolist()})
    for scene in objects(tree.get("scenes")):
        if number in _reached(tree, scene.get("nodes", ())):
            scene["nodes"] = [*scene["nodes"], len(tree["nodes"]) - 1]


def _skinned(
    primitive: dict[str, Any], joints: NDArray[np.float64], middle: NDArray[np.float64], accessors: Accessors
) -> dict[str, Any]:
    """A primitive where its joints are, relative to their middle; vertices without weights stay in the world."""
    attributes = dict(primitive["attributes"])
    sets = sorted(name.removeprefix(_WEIGHT) for name in attributes if name.startswith(_WEIGHT))
    weights = np.concatenate([accessors.numbers(attributes[_WEIGHT + name]) for name in sets], axis=1)
    numbers = np.concatenate([accessors.stored(attributes[_JOINT + name]) for name in sets], axis=1)
    # Programs round weights; their sum is meant to be 1.
    total = weights.sum(axis=1, keepdims=True)
    weights = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0.0)
    numbers = np.where(weights > 0.0, numbers, 0).astype(np.int64)
    blended = np.einsum("vk,vkij->vij", weights, joints[numbers])
    resting = np.eye(4)
    resting[:3, 3] = -middle
    blended[total[:, 0] <= 0.0] = resting
    points = accessors.numbers(attributes["POSITION"])
    moved = np.einsum("vij,vj->vi", blended[:, :3, :3], points) + blended[:, :3, 3]
    attributes["POSITION"] = accessors.add(moved)
    if "NORMAL" in attributes:
        # Normals go with the cofactors, which need no inverse.
        rows = blended[:, :3, :3]
        cofactors = np.stack([np.cross(rows[:, (i + 1) % 3], rows[:, (i + 2) % 3]) for i in range(3)], axis=1)
        normals = np.einsum("vij,vj->vi", cofactors, accessors.numbers(attributes["NORMAL"]))
        attributes["NORMAL"] = accessors.add(_unit(normals))
    for name in sets:
        del attributes[_WEIGHT + name], attributes[_JOINT + name]
    return {**primitive, "attributes": attributes}


def _instantiate(tree: dict[str, Any], node: dict[str, Any], instances: dict[str, Any], accessors: Accessors) -> None:
    """Give a node a child for each instance of its mesh."""
    if "mesh" not in node:
        return
    names = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
    found = object_of(instances.get("attributes"))
    placed = {names[name]: accessors.numbers(index).tolist() for name, index in found.items() if name in names}
    counts = {tree["accessors"][index]["count"] for index in found.values()}
    if not counts:
        return
    if len(counts) > 1:
        raise ValueError(f"attributes of {' and '.join(map(str, sorted(counts)))} instances of one node")
    mesh = node.pop("mesh")
    first = len(tree["nodes"])
    # Without a place, as with numbers only, instances are all at the node.
    rows: Iterator[Any] = zip(*placed.values(), strict=True) if placed else itertools.repeat((), *counts)
    tree["nodes"].extend({"mesh": mesh, **dict(zip(placed, row, strict=True))} for row in rows)
    node["children"] = [*node.get("children", ()), *range(first, len(tree["nodes"]))]


def _poses(tree: dict[str, Any]) -> list[NDArray[np.float64]]:
    """Matrix of each node to the world; those of nodes that are reached from no root are local."""
    nodes = objects(tree.get("nodes"))
    local = [local_pose(node) for node in nodes]
    parent = {child: number for number, node in enumerate(nodes) for child in node.get("children", ())}
    found: dict[int, NDArray[np.float64]] = {}
    for number in range(len(nodes)):
        way = [number]
        while way[-1] not in found and way[-1] in parent:
            way.append(parent[way[-1]])
            if len(way) > len(nodes):
                raise ValueError("nodes are their own parents")
        for at in reversed(way):
            if at not in found:
                found[at] = found[parent[at]] @ local[at] if at in parent else local[at]
    return [found[number] for number in range(len(nodes))]


def local_pose(node: dict[str, Any]) -> NDArray[np.float64]:
    """Matrix of a node to its parent."""
    matrix = np.eye(4)
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    if not node.keys() & {"translation", "rotation", "scale"}:
        return matrix
    own = np.eye(4)
    x, y, z, w = turn = np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64).reshape(4)
    # Programs round quaternions, whose length is meant to be 1.
    length = np.dot(np.square(turn[[3, 0, 1, 2]])[None], np.ones(4))[0]
    if length >= _SHORTEST:
        x, y, z, w = turn * np.sqrt(2.0 / length)
        own[:3, :3] = [
            [1 - y * y - z * z, x * y - z * w, x * z + y * w],
            [x * y + z * w, 1 - x * x - z * z, y * z - x * w],
            [x * z - y * w, y * z + x * w, 1 - x * x - y * y],
        ]
    own[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64).reshape(3)
    own[:3, 3] = np.array(node.get("translation", (0.0, 0.0, 0.0)), np.float64).reshape(3)
    return matrix @ own


def turn_of(w: float, x: float, y: float, z: float) -> NDArray[np.float64]:
    """The rotation of a quaternion of length 1."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _reached(tree: dict[str, Any], roots: Any) -> set[int]:
    reached: set[int] = set()
    waiting = list(roots)
    while waiting:
        number = waiting.pop()
        if number not in reached:
            reached.add(number)
            waiting.extend(tree["nodes"][number].get("children", ()))
    return reached


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)
