"""What gives a glTF mesh its shape beside plain triangles, against the specification's formulas."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from tests.support.attributed import PNG

PNG_TEXT = base64.b64encode(PNG).decode()
BOX = gk.mesh.box((1.0, 2.0, 3.0))
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Scene:
    """A .gltf or .glb under construction: arrays become accessors."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [],
            "accessors": [], "bufferViews": [],
        }  # fmt: skip
        self.data = b""

    def view(self, values: Any, kind: str) -> int:
        raw = np.ascontiguousarray(values, f"<{kind}" if kind[1] != "1" else kind).tobytes()
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw)})
        self.data += raw + bytes(-len(raw) % 4)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values: Any, kind: str = "f4", **more: Any) -> int:
        rows = np.asarray(values).reshape(len(values), -1)
        entry = {"bufferView": self.view(rows, kind), "componentType": CODES[kind], "count": len(rows)}
        self.tree["accessors"].append({**entry, "type": TYPES[rows.shape[1]], **more})
        return len(self.tree["accessors"]) - 1

    def sparse(self, count: int, rows: Any, values: Any, kind: str = "f4", base: int | None = None) -> int:
        """An accessor of zeros, or of another's values, but for some rows."""
        values = np.asarray(values).reshape(len(rows), -1)
        place = {"bufferView": self.view(rows, "u2"), "componentType": CODES["u2"]}
        entry: dict[str, Any] = {"componentType": CODES[kind], "count": count, "type": TYPES[values.shape[1]]}
        if base is not None:
            entry = dict(self.tree["accessors"][base])
        entry["sparse"] = {"count": len(rows), "indices": place, "values": {"bufferView": self.view(values, kind)}}
        self.tree["accessors"].append(entry)
        return len(self.tree["accessors"]) - 1

    def mesh(self, **part: Any) -> Scene:
        """Add a mesh of one primitive."""
        self.tree["meshes"].append({"primitives": [part]})
        return self

    def box(self, **part: Any) -> Scene:
        position, faces = self.accessor(BOX.vertices), self.accessor(BOX.faces.ravel(), "u2")
        return self.mesh(attributes={"POSITION": position}, indices=faces, **part)

    def load(self, folder: Path) -> gk.mesh.TriangleMesh:
        """What geokit reads from a .gltf, and the same from a .glb."""
        size = {"byteLength": len(self.data)}
        text = base64.b64encode(self.data).decode()
        path = folder / "a.gltf"
        path.write_text(json.dumps({**self.tree, "buffers": [{**size, "uri": f"data:;base64,{text}"}]}))
        mesh = gk.mesh.load(path)
        head = json.dumps({**self.tree, "buffers": [size]}).encode()
        head += b" " * (-len(head) % 4)
        chunks = b"".join(
            len(chunk).to_bytes(4, "little") + name + chunk for name, chunk in ((b"JSON", head), (b"BIN\0", self.data))
        )
        (folder / "a.glb").write_bytes(
            b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks
        )
        again = gk.mesh.load(folder / "a.glb")
        np.testing.assert_array_equal(again.vertices, mesh.vertices)
        np.testing.assert_array_equal(again.faces, mesh.faces)
        return mesh


@pytest.fixture
def scene() -> Scene:
    return Scene()


def matrix(turn: float, shift: Any, scale: float = 1.0) -> np.ndarray:
    """A turn about z, then a shift."""
    made = np.eye(4)
    made[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    made[:3, :3] *= scale
    made[:3, 3] = shift
    return made


def columns(values: np.ndarray) -> list[float]:
    return values.T.ravel().tolist()


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def bodies(boxes: Any) -> np.ndarray:
    """Boxes of eight vertices each, in an order that does not depend on that of their nodes."""
    rows = np.reshape(getattr(boxes, "vertices", boxes), (-1, 24))
    return rows[np.argsort(rows.sum(axis=1))]


class TestFans:
    def test_of_indices(self, scene: Scene, tmp_path: Path) -> None:
        ring = [[np.cos(a), np.sin(a), 0.0] for a in np.arange(7) * 2 * np.pi / 7]
        position = scene.accessor([[9.0, 9.0, 9.0], *ring])
        scene.mesh(attributes={"POSITION": position}, indices=scene.accessor(range(1, 8), "u1"), mode=6)
        mesh = scene.load(tmp_path)
        assert mesh.face_count == 5
        assert mesh.area == pytest.approx(7 / 2 * np.sin(2 * np.pi / 7))
        assert (mesh.face_normals[:, 2] > 0.99).all()

    def test_without_indices_beside_triangles(self, scene: Scene, tmp_path: Path) -> None:
        top = BOX.vertices[BOX.faces][:, :, 2].min(axis=1) > 1.4
        corners = [[-0.5, -1, 1.5], [0.5, -1, 1.5], [0.5, 1, 1.5], [-0.5, 1, 1.5]]
        rest = {"POSITION": scene.accessor(BOX.vertices)}
        scene.mesh(attributes=rest, indices=scene.accessor(BOX.faces[~top].ravel(), "u4"))
        scene.tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": scene.accessor(corners)}, "mode": 6})
        assert scene.load(tmp_path).volume == pytest.approx(6.0)


class TestSparseAccessors:
    @pytest.mark.parametrize("kind", ["f4", "i2"])
    def test_of_positions_with_a_buffer(self, scene: Scene, tmp_path: Path, kind: str) -> None:
        points = (2 * BOX.vertices).astype(int)
        spoiled = points.copy()
        spoiled[[1, 6]] = 77
        base = scene.accessor(spoiled, kind)
        position = scene.sparse(8, [1, 6], points[[1, 6]], kind, base)
        scene.mesh(attributes={"POSITION": position}, indices=scene.accessor(BOX.faces.ravel(), "u2"))
        np.testing.assert_array_equal(scene.load(tmp_path).vertices, points)

    def test_of_positions_without_one(self, scene: Scene, tmp_path: Path) -> None:
        position = scene.sparse(8, range(1, 8), BOX.vertices[1:])
        scene.mesh(attributes={"POSITION": position}, indices=scene.accessor(BOX.faces.ravel(), "u2"))
        expected = BOX.vertices.copy()
        expected[0] = 0.0
        np.testing.assert_array_equal(scene.load(tmp_path).vertices, expected)

    @pytest.mark.slow
    def test_of_indices_and_attributes(self, scene: Scene, tmp_path: Path) -> None:
        faces = BOX.faces.ravel()
        spoiled = faces.copy()
        spoiled[5] = 0
        index = scene.sparse(36, [5], faces[5:6], "u2", scene.accessor(spoiled, "u2"))
        heat = np.arange(8.0)
        shown = scene.sparse(8, [3], [30.0], "f4", scene.accessor(heat))
        scene.mesh(attributes={"POSITION": scene.accessor(BOX.vertices), "_HEAT": shown}, indices=index)
        mesh = scene.load(tmp_path)
        np.testing.assert_array_equal(mesh.faces, BOX.faces)
        heat[3] = 30.0
        np.testing.assert_array_equal(mesh.vertex_data["HEAT"], heat)

    def test_that_name_rows_beyond_their_accessor_are_refused(self, scene: Scene, tmp_path: Path) -> None:
        position = scene.sparse(8, [9], [[0.0, 0.0, 0.0]], "f4", scene.accessor(BOX.vertices))
        scene.mesh(attributes={"POSITION": position}, indices=scene.accessor(BOX.faces.ravel(), "u2"))
        with pytest.raises(gk.FileFormatError, match=r"a\.gltf: its meshes cannot be read"):
            scene.load(tmp_path)


class TestMorphTargets:
    @pytest.fixture
    def moves(self) -> np.ndarray:
        return np.random.default_rng(5).normal(size=(2, 8, 3)).astype("<f4").astype(float)

    def test_weights_of_the_mesh(self, scene: Scene, moves: np.ndarray, tmp_path: Path) -> None:
        scene.box(targets=[{"POSITION": scene.accessor(move)} for move in moves])
        scene.tree["meshes"][0]["weights"] = [0.25, -2.0]
        expected = BOX.vertices + 0.25 * moves[0] - 2.0 * moves[1]
        np.testing.assert_allclose(scene.load(tmp_path).vertices, expected, atol=1e-6)

    def test_weights_of_nodes_come_first(self, scene: Scene, moves: np.ndarray, tmp_path: Path) -> None:
        """Two nodes share a mesh, one with weights of its own, one with those of the mesh, and a sparse target."""
        sparse = scene.sparse(8, [2, 4], moves[1][[2, 4]])
        scene.box(targets=[{"POSITION": scene.accessor(moves[0])}, {"POSITION": sparse}])
        scene.tree["meshes"][0]["weights"] = [1.0, 0.0]
        scene.tree["nodes"].append({"mesh": 0, "weights": [0.0, 3.0], "translation": [10, 0, 0]})
        scene.tree["scenes"][0]["nodes"] = [0, 1]
        mesh = scene.load(tmp_path)
        second = BOX.vertices + np.array([10.0, 0, 0])
        second[[2, 4]] += 3.0 * moves[1][[2, 4]]
        np.testing.assert_allclose(bodies(mesh), bodies([BOX.vertices + moves[0], second]), atol=1e-5)

    def test_normals_move_too(self, scene: Scene, tmp_path: Path) -> None:
        normals = np.tile([0.0, 0.0, 1.0], (8, 1))
        attributes = {"POSITION": scene.accessor(BOX.vertices), "NORMAL": scene.accessor(normals)}
        target = {"NORMAL": scene.accessor(np.tile([1.0, 0.0, 0.0], (8, 1)))}
        scene.mesh(attributes=attributes, indices=scene.accessor(BOX.faces.ravel(), "u2"), targets=[target])
        scene.tree["meshes"][0]["weights"] = [1.0]
        mesh = scene.load(tmp_path)
        np.testing.assert_array_equal(mesh.vertices, BOX.vertices)
        np.testing.assert_allclose(mesh.vertex_data["normal"], np.tile([0.5**0.5, 0.0, 0.5**0.5], (8, 1)), atol=1e-6)

    def test_other_attributes_move_too(self, scene: Scene, tmp_path: Path) -> None:
        """Texture coordinates under the name that the file gives them, colors within their range, and tangents."""
        texture = {"index": 0, "texCoord": 1}
        scene.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}}]
        scene.tree["textures"], scene.tree["images"] = [{"source": 0}], [{"uri": "data:;base64," + PNG_TEXT}]
        given = {
            "POSITION": BOX.vertices, "TEXCOORD_0": np.full((8, 2), 0.5), "TEXCOORD_1": np.full((8, 2), 0.25),
            "COLOR_0": np.tile([0.5, 0.5, 0.0, 1.0], (8, 1)), "TANGENT": np.tile([1.0, 0, 0, -1.0], (8, 1)),
        }  # fmt: skip
        move = {
            "TEXCOORD_1": np.tile([0.5, 0.0], (8, 1)), "COLOR_0": np.tile([0.25, 9.0, 0, 0], (8, 1)),
            "TANGENT": np.tile([0.0, 1.0, 0.0], (8, 1)),
        }  # fmt: skip
        attributes, target = ({name: scene.accessor(rows) for name, rows in part.items()} for part in (given, move))
        faces = scene.accessor(BOX.faces.ravel(), "u2")
        scene.mesh(attributes=attributes, indices=faces, targets=[target], material=0)
        scene.tree["meshes"][0]["weights"] = [1.0]
        mesh = scene.load(tmp_path)
        # Rows of images go down there.
        np.testing.assert_allclose(mesh.vertex_data["uv"], np.tile([0.75, 0.75], (8, 1)))
        np.testing.assert_allclose(mesh.vertex_data["color"], np.tile([0.75, 1.0, 0.0, 1.0], (8, 1)))
        np.testing.assert_allclose(mesh.vertex_data["TANGENT"], np.tile([1.0, 1.0, 0.0, -1.0], (8, 1)))

    def test_no_weights_are_zeros(self, scene: Scene, moves: np.ndarray, tmp_path: Path) -> None:
        scene.box(targets=[{"POSITION": scene.accessor(move)} for move in moves])
        np.testing.assert_array_equal(scene.load(tmp_path).vertices, BOX.vertices)


class TestSkins:
    def test_blend_the_poses_of_their_joints(self, scene: Scene, tmp_path: Path) -> None:
        """Weights as normalized integers, two sets of joints, and a node whose own pose has no meaning."""
        random = np.random.default_rng(6)
        root, arm = matrix(0.4, [1.0, 2.0, 3.0], 2.0), matrix(-1.0, [0.5, 0.0, -1.0])
        inverse = [matrix(0.3, [0.0, 1.0, 0.0]), matrix(0.7, [2.0, 0.0, 0.0]), np.eye(4)]
        poses = [root @ inverse[0], root @ arm @ inverse[1], np.eye(4)]
        weights = random.integers(0, 200, (8, 4))
        joints = random.integers(0, 3, (8, 8))
        more = random.integers(0, 200, (8, 4))
        attributes = {
            "POSITION": scene.accessor(BOX.vertices),
            "JOINTS_0": scene.accessor(joints[:, :4], "u1"),
            "WEIGHTS_0": scene.accessor(weights, "u1", normalized=True),
            "JOINTS_1": scene.accessor(joints[:, 4:], "u2"),
            "WEIGHTS_1": scene.accessor(more / 255.0),
        }
        scene.mesh(attributes=attributes, indices=scene.accessor(BOX.faces.ravel(), "u2"))
        scene.tree["nodes"] = [
            {"mesh": 0, "skin": 0, "translation": [100.0, 0, 0], "name": "body"},
            {"matrix": columns(root), "children": [2]},
            {"matrix": columns(arm)},
            {},
        ]
        scene.tree["scenes"][0]["nodes"] = [0, 1, 3]
        binds = scene.accessor([columns(bind) for bind in inverse])
        scene.tree["skins"] = [{"joints": [1, 2, 3], "inverseBindMatrices": binds}]
        all_weights = np.concatenate([weights, more], axis=1).astype(float)
        all_weights /= all_weights.sum(axis=1, keepdims=True)
        expected = np.zeros((8, 3))
        for vertex in range(8):
            for weight, joint in zip(all_weights[vertex], joints[vertex], strict=True):
                expected[vertex] += weight * placed(BOX.vertices[vertex], poses[joint])
        mesh = scene.load(tmp_path)
        np.testing.assert_allclose(mesh.vertices, expected, atol=2e-6)
        assert not [name for name in mesh.vertex_data if "JOINT" in name.upper() or "WEIGHT" in name.upper()]

    def test_move_only_what_has_joints(self, scene: Scene, tmp_path: Path) -> None:
        """A primitive without joints stands at its node, vertices whose weights are 0 stand in the world."""
        points, faces = scene.accessor(BOX.vertices), scene.accessor(BOX.faces.ravel(), "u2")
        weights = np.tile([1.0, 0, 0, 0], (8, 1))
        weights[0] = 0.0
        joints = {"JOINTS_0": scene.accessor(np.zeros((8, 4)), "u1"), "WEIGHTS_0": scene.accessor(weights)}
        scene.mesh(attributes={"POSITION": points, **joints}, indices=faces)
        scene.tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": points}, "indices": faces})
        # A quarter turn, rounded.
        bone = {"translation": [0.0, 0.0, 50.0], "rotation": [0.0, 0.0, 0.7, 0.7]}
        scene.tree["nodes"] = [{"mesh": 0, "skin": 0, "translation": [10.0, 0, 0]}, bone]
        scene.tree["scenes"][0]["nodes"] = [0, 1]
        scene.tree["skins"] = [{"joints": [1]}]
        moved = placed(BOX.vertices, matrix(np.pi / 2, [0.0, 0.0, 50.0]))
        moved[0] = BOX.vertices[0]
        expected = bodies([BOX.vertices + np.array([10.0, 0, 0]), moved])
        np.testing.assert_allclose(bodies(scene.load(tmp_path)), expected, atol=1e-5)

    def test_with_too_few_bind_matrices_are_refused(self, scene: Scene, tmp_path: Path) -> None:
        joints = {"JOINTS_0": scene.accessor(np.zeros((8, 4)), "u1"), "WEIGHTS_0": scene.accessor(np.ones((8, 4)))}
        scene.box()
        scene.tree["meshes"][0]["primitives"][0]["attributes"].update(joints)
        scene.tree["nodes"] = [{"mesh": 0, "skin": 0}, {}, {}]
        scene.tree["skins"] = [{"joints": [1, 2], "inverseBindMatrices": scene.accessor([columns(np.eye(4))])}]
        with pytest.raises(gk.FileFormatError, match="1 inverse bind matrices for 2 joints"):
            scene.load(tmp_path)

    def test_in_the_bind_pose_are_the_mesh(self, scene: Scene, tmp_path: Path) -> None:
        """Far from the origin: positions are kept relative to the joints."""
        far = matrix(0.0, [3e6, 0.0, 0.0])
        scene.box()
        rows = {"JOINTS_0": np.zeros((8, 4), int), "WEIGHTS_0": np.tile([1.0, 0, 0, 0], (8, 1))}
        part = scene.tree["meshes"][0]["primitives"][0]
        part["attributes"]["JOINTS_0"] = scene.accessor(rows["JOINTS_0"], "u1")
        part["attributes"]["WEIGHTS_0"] = scene.accessor(rows["WEIGHTS_0"])
        scene.tree["nodes"] = [{"mesh": 0, "skin": 0, "scale": [5.0, 5.0, 5.0]}, {"matrix": columns(far)}]
        scene.tree["scenes"][0]["nodes"] = [0, 1]
        scene.tree["skins"] = [{"joints": [1]}]
        np.testing.assert_allclose(scene.load(tmp_path).vertices, placed(BOX.vertices, far), atol=1e-6)

    def test_of_a_deep_skeleton(self, scene: Scene, tmp_path: Path) -> None:
        """Each joint is placed once, however many lie above it."""
        count, step = 3000, matrix(0.001, [0.01, 0.0, 0.02])
        pose = np.linalg.matrix_power(step, count)
        joints = np.zeros((8, 4), int)
        joints[4:, 0] = count - 1
        attributes = {
            "POSITION": scene.accessor(BOX.vertices),
            "JOINTS_0": scene.accessor(joints, "u2"),
            "WEIGHTS_0": scene.accessor(np.tile([1.0, 0, 0, 0], (8, 1))),
        }
        scene.mesh(attributes=attributes, indices=scene.accessor(BOX.faces.ravel(), "u2"))
        # The deepest comes first.
        chain = [{"matrix": columns(step), "children": [number]} for number in range(count)]
        chain[0].pop("children")
        scene.tree["nodes"] = [{"mesh": 0, "skin": 0}, *chain]
        scene.tree["scenes"][0]["nodes"] = [0, count]
        scene.tree["skins"] = [{"joints": list(range(count, 0, -1))}]
        expected = np.concatenate([placed(BOX.vertices[:4], step), placed(BOX.vertices[4:], pose)])
        np.testing.assert_allclose(scene.load(tmp_path).vertices, expected, atol=1e-5)

    def test_whose_nodes_are_their_own_parents_are_refused(self, scene: Scene, tmp_path: Path) -> None:
        scene.box()
        scene.tree["nodes"] = [{"mesh": 0, "skin": 0}, {"children": [2]}, {"children": [1]}]
        scene.tree["skins"] = [{"joints": [1]}]
        with pytest.raises(gk.FileFormatError, match="nodes are their own parents"):
            scene.load(tmp_path)


class TestInstances:
    def test_have_poses_below_their_node(self, scene: Scene, tmp_path: Path) -> None:
        scene.box()
        half = np.sqrt(0.5)
        turns = np.array([[0, 0, 0, 1], [0, 0, half, half], [half, 0, 0, half]])
        shifts, scales = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0]]), np.array([[1, 1, 1], [2, 1, 1], [1, 1, 3]])
        attributes = {
            "TRANSLATION": scene.accessor(shifts), "ROTATION": scene.accessor(turns), "SCALE": scene.accessor(scales),
        }  # fmt: skip
        pose = matrix(0.9, [1.0, 1.0, 1.0])
        instancing = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
        scene.tree["nodes"] = [{"matrix": columns(pose), "mesh": 0, "extensions": instancing}]
        scene.tree["extensionsUsed"] = scene.tree["extensionsRequired"] = list(instancing)
        mesh = scene.load(tmp_path)
        assert mesh.volume == pytest.approx(6.0 * (1 + 2 + 3))
        rotations = [np.eye(3), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]]
        expected = [
            placed((BOX.vertices * scale) @ np.transpose(turn) + shift, pose)
            for scale, turn, shift in zip(scales, rotations, shifts, strict=True)
        ]
        np.testing.assert_allclose(bodies(mesh), bodies(expected), atol=1e-5)

    def test_turns_may_be_normalized_integers(self, scene: Scene, tmp_path: Path) -> None:
        scene.box()
        turn = scene.accessor([[0, 0, 32767, 0]], "i2", normalized=True)
        scene.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"ROTATION": turn}}}
        np.testing.assert_allclose(scene.load(tmp_path).vertices, BOX.vertices * [-1, -1, 1], atol=1e-6)

    def test_that_mirror_keep_their_outside(self, scene: Scene, tmp_path: Path) -> None:
        """Below a node that mirrors too, with turns of bytes, sparse places without a buffer, and a morphed mesh."""
        normals = BOX.vertices / np.linalg.norm(BOX.vertices, axis=1, keepdims=True)
        attributes = {"POSITION": scene.accessor(BOX.vertices), "NORMAL": scene.accessor(normals)}
        # Twice as long along x.
        target = {"POSITION": scene.accessor(BOX.vertices * [1, 0, 0])}
        scene.mesh(attributes=attributes, indices=scene.accessor(BOX.faces.ravel(), "u2"), targets=[target])
        scene.tree["meshes"][0]["weights"] = [1.0]
        instances = {
            "ROTATION": scene.accessor([[0, 0, 90, 90], [0, 0, 127, 0], [90, 0, 0, 90]], "i1", normalized=True),
            "SCALE": scene.accessor([[1, 1, -1], [-2, -1, -1], [1, 1, 1]]),
            "TRANSLATION": scene.sparse(3, [1, 2], [[10, 0, 0], [20, 0, 0]]),
        }
        scene.tree["nodes"][0]["scale"] = [1, -3, 1]
        scene.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": instances}}
        mesh = scene.load(tmp_path)
        assert mesh.volume == pytest.approx(12.0 * 3 * (1 + 2 + 1))
        middles = np.repeat(mesh.vertices.reshape(3, 8, 3).mean(axis=1), 8, axis=0)
        np.testing.assert_allclose(np.sort(middles[::8, 0]), [0, 10, 20], atol=1e-6)
        outward = mesh.vertices - middles
        assert (np.einsum("ij,ij->i", outward, mesh.vertex_data["normal"]) > 0).all()

    def test_without_places_are_as_many_as_their_numbers(self, scene: Scene, tmp_path: Path) -> None:
        scene.box()
        attributes = {"_ID": scene.accessor([4, 5], "u2")}
        scene.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
        np.testing.assert_array_equal(scene.load(tmp_path).vertices, np.tile(BOX.vertices, (2, 1)))
        attributes["SCALE"] = scene.accessor(np.ones((3, 3)))
        with pytest.raises(gk.FileFormatError, match="attributes of 2 and 3 instances of one node"):
            scene.load(tmp_path)

    def test_of_a_skin_are_refused(self, scene: Scene, tmp_path: Path) -> None:
        scene.box()
        scene.tree["nodes"][0].update(skin=0, extensions={"EXT_mesh_gpu_instancing": {"attributes": {}}})
        with pytest.raises(gk.FileFormatError, match="instances of a skin"):
            scene.load(tmp_path)


def test_hidden_nodes_are_left_out_with_all_below(scene: Scene, tmp_path: Path) -> None:
    scene.box()
    hidden = {"KHR_node_visibility": {"visible": False}}
    shown = {"KHR_node_visibility": {"visible": True}}
    scene.tree["nodes"] = [{"mesh": 0, "extensions": shown}, {"children": [2], "extensions": hidden}, {"mesh": 0}]
    scene.tree["scenes"][0]["nodes"] = [0, 1]
    scene.tree["extensionsUsed"] = scene.tree["extensionsRequired"] = list(hidden)
    assert scene.load(tmp_path).face_count == 12


def test_nodes_with_cameras_are_placed_as_others_are(scene: Scene, tmp_path: Path) -> None:
    """With their meshes and children; primitives of one node are numbered."""
    scene.box()
    scene.tree["meshes"][0]["primitives"] *= 2
    scene.tree["cameras"] = [{"type": "perspective", "perspective": {"znear": 0.1, "aspectRatio": 1.5, "yfov": 0.7}}]
    scene.tree["nodes"] = [
        {"name": "world", "mesh": 0},
        {"name": "eye", "camera": 0, "mesh": 0, "translation": [10, 0, 0], "children": [2]},
        {"name": "eye", "mesh": 0, "translation": [10, 0, 0]},
    ]
    scene.tree["scenes"][0]["nodes"] = [0, 1]
    mesh = scene.load(tmp_path)
    assert [part.name for part in mesh.parts] == ["eye_0", "eye_1", "eye_1_0", "eye_1_1", "world_0", "world_1"]
    assert mesh.vertices.reshape(6, 8, 3).mean(axis=1)[:, 0].tolist() == [10, 10, 20, 20, 0, 0]


@pytest.mark.parametrize("size", [0, 95])
def test_a_view_that_is_too_short_is_refused(scene: Scene, tmp_path: Path, size: int) -> None:
    scene.box()
    scene.tree["bufferViews"][0].update(byteLength=size, byteStride=12)
    with pytest.raises(gk.FileFormatError, match="8 elements of 12 bytes reach beyond buffer view 0"):
        scene.load(tmp_path)


@pytest.mark.parametrize(("entry", "index"), [("children", -1), ("mesh", -1), ("mesh", 1)])
def test_numbers_of_no_node_and_no_mesh_are_refused(scene: Scene, tmp_path: Path, entry: str, index: int) -> None:
    scene.box()
    scene.tree["nodes"][0][entry] = [index] if entry == "children" else index
    with pytest.raises(gk.FileFormatError, match=r"a\.gltf: its meshes cannot be read \(IndexError"):
        scene.load(tmp_path)


class TestCompressed:
    def test_positions_that_only_a_decoder_has_are_refused(self, scene: Scene, tmp_path: Path) -> None:
        """Whether the file says that it requires the extension or not."""
        scene.tree["accessors"].append({"componentType": 5126, "count": 8, "type": "VEC3"})
        draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
        scene.mesh(attributes={"POSITION": 0}, indices=scene.accessor(BOX.faces.ravel(), "u2"), extensions=draco)
        with pytest.raises(
            gk.FileFormatError, match=r"without positions \('KHR_draco_mesh_compression'\).*gltf-transform"
        ):
            scene.load(tmp_path)

    def test_buffers_that_only_a_decoder_fills_are_refused(self, tmp_path: Path) -> None:
        fallback = {"byteLength": 96, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
        scene = Scene().box()
        tree = {**scene.tree, "buffers": [fallback]}
        (tmp_path / "a.gltf").write_text(json.dumps(tree))
        with pytest.raises(gk.FileFormatError, match=r"compressed with 'EXT_meshopt_compression'"):
            gk.mesh.load(tmp_path / "a.gltf")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["f4", "u2"])
@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("overrides", [True, False])
def test_texture_coordinates_are_those_that_the_base_color_takes(scene, tmp_path, kind, number, overrides):
    given = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    turned = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    transform = {**turned, "texCoord": number} if overrides else turned
    texture = {"index": 0, "texCoord": 1 - number if overrides else number}
    material = {"baseColorTexture": {**texture, "extensions": {"KHR_texture_transform": transform}}}
    scene.tree["materials"] = [{"pbrMetallicRoughness": material}]
    scene.tree["textures"], scene.tree["images"] = [{"source": 0}], [{"uri": "data:;base64," + PNG_TEXT}]
    other = scene.accessor(np.full((4, 2), 0.25))
    uv = [other, other]
    # Not normalized, as gltfpack writes them.
    uv[number] = scene.accessor(given, kind)
    attributes = {"POSITION": scene.accessor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])}
    attributes |= {f"TEXCOORD_{at}": index for at, index in enumerate(uv)}
    scene.mesh(attributes=attributes, indices=scene.accessor([0, 1, 2, 2, 1, 3], "u2"), material=0)
    mesh = scene.load(tmp_path)
    # The example of the specification: the lower left quarter of the image, turned clockwise.
    np.testing.assert_allclose(mesh.vertex_data["uv"], [[0, 0], [0, 0.5], [0.5, 0], [0.5, 0.5]], atol=1e-7)
    np.testing.assert_allclose(mesh.vertex_data["TEXCOORD_1"], 0.25)


@pytest.mark.parametrize("length", [0, 10, 340])
def test_a_buffer_that_is_cut_off_is_called_so(tmp_path: Path, length: int) -> None:
    scene = Scene().box()
    path, whole = tmp_path / "a.gltf", len(scene.data)
    path.write_text(json.dumps({**scene.tree, "buffers": [{"byteLength": whole, "uri": "a.bin"}]}))
    (tmp_path / "a.bin").write_bytes(scene.data[: min(length, whole - 4)])
    with pytest.raises(
        gk.FileFormatError, match=rf"buffer 0 \('a.bin'\) has \d+ of its {whole} bytes; get a whole copy"
    ):
        gk.mesh.load(path)
    gk.mesh.save(path.with_suffix(".glb"), BOX)
    content = path.with_suffix(".glb").read_bytes()
    path.with_suffix(".glb").write_bytes(content[:-9])
    with pytest.raises(gk.FileFormatError, match=rf"has {len(content) - 9} of the {len(content)} bytes that it says"):
        gk.mesh.load(path.with_suffix(".glb"))
