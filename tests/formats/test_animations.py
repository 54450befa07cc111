"""What moves in a file is read as it stands, and said once: the pose that it has without a player."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from tests.formats.test_gltf_shapes import BOX, Scene
from tests.support.exchange_files import write_collada, write_fbx

CURVE = """\tAnimationStack: 5000, "AnimStack::Take", "" {
\t}
\tAnimationLayer: 5001, "AnimLayer::Base", "" {
\t}
"""
KEYS = """\tAnimationCurveNode: 5002, "AnimCurveNode::T", "" {
\t\tProperties70: {
\t\t\tP: "d|X", "Number", "", "A",0
\t\t}
\t}
\tAnimationCurve: 5003, "AnimCurve::", "" {
\t\tDefault: 0
\t\tKeyVer: 4008
\t\tKeyTime: *2 {
\t\t\ta: 0,46186158000
\t\t}
\t\tKeyValueFloat: *2 {
\t\t\ta: 50,60
\t\t}
\t\tKeyAttrFlags: *1 {
\t\t\ta: 24836
\t\t}
\t\tKeyAttrDataFloat: *4 {
\t\t\ta: 0,0,0,0
\t\t}
\t\tKeyAttrRefCount: *1 {
\t\t\ta: 2
\t\t}
\t}
"""
LINKS = '\tC: "OO",5001,5000\n'
KEY_LINKS = '\tC: "OO",5002,5001\n\tC: "OP",5002,2000, "Lcl Translation"\n\tC: "OP",5003,5002, "d|X"\n'


def said(path: Path) -> tuple[gk.mesh.TriangleMesh, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = gk.mesh.load(path)
    return mesh, [str(one.message) for one in caught]


class TestGltf:
    def animated(self, scene: Scene, path: str, **more: Any) -> Scene:
        times, values = scene.accessor([0.0, 1.0]), scene.accessor([[0, 0, 0], [5, 0, 0]])
        channel = {"sampler": 0, "target": {"node": 0, "path": path, **more}}
        scene.tree["animations"] = [{"samplers": [{"input": times, "output": values}], "channels": [channel]}]
        return scene

    @pytest.mark.slow
    @pytest.mark.parametrize("moved", ["translation", "weights"])
    def test_is_read_as_its_nodes_stand(self, tmp_path: Path, moved: str) -> None:
        scene = self.animated(Scene().box(), moved)
        scene.tree["nodes"][0]["translation"] = [1.0, 2.0, 3.0]
        with pytest.warns(UserWarning, match="its animations are left out: it is read as it stands"):
            mesh = scene.load(tmp_path)
        np.testing.assert_array_equal(mesh.vertices, BOX.vertices + np.array([1.0, 2.0, 3.0]))
        assert len(said(tmp_path / "a.glb")[1]) == 1

    def test_says_nothing_of_an_animation_without_channels(self, tmp_path: Path) -> None:
        scene = Scene().box()
        scene.tree["animations"] = [{"samplers": [], "channels": []}]
        scene.load(tmp_path)


class TestCollada:
    ANIMATION = """<library_animations><animation id="move">
<source id="in"><float_array id="in-a" count="2">0 1</float_array><technique_common>
<accessor source="#in-a" count="2" stride="1"><param name="TIME" type="float"/></accessor></technique_common></source>
<source id="out"><float_array id="out-a" count="2">50 60</float_array><technique_common>
<accessor source="#out-a" count="2" stride="1"><param name="X" type="float"/></accessor></technique_common></source>
<sampler id="s"><input semantic="INPUT" source="#in"/><input semantic="OUTPUT" source="#out"/></sampler>
<channel source="#s" target="second/matrix(3)(0)"/></animation></library_animations>"""

    @pytest.mark.parametrize("camera", ["", '<node id="eye"><instance_camera url="#gone"/></node>'])
    def test_is_read_as_its_nodes_stand(self, tmp_path: Path, camera: str) -> None:
        pytest.importorskip("collada")
        path = tmp_path / "a.dae"
        write_collada(path)
        still = gk.mesh.load(path)
        text = path.read_text().replace("<library_visual_scenes>", f"{self.ANIMATION}<library_visual_scenes>")
        assert "<channel" in text
        path.write_text(text.replace("<node ", f"{camera}<node ", 1))
        mesh, told = said(path)
        assert [text for text in told if "its animations are left out" in text] == told
        assert len(told) == 1
        np.testing.assert_array_equal(mesh.vertices, still.vertices)


class TestFbx:
    @pytest.mark.parametrize("moves", [True, False])
    def test_is_read_as_its_nodes_stand(self, tmp_path: Path, moves: bool) -> None:
        """Programs write a stack without curves for what never moves."""
        pytest.importorskip("ufbx")
        path = tmp_path / "a.fbx"
        write_fbx(path)
        still = gk.mesh.load(path)
        text = path.read_text().replace("Objects:  {\n", f"Objects:  {{\n{CURVE}{KEYS if moves else ''}")
        path.write_text(text.replace("Connections:  {\n", f"Connections:  {{\n{LINKS}{KEY_LINKS if moves else ''}"))
        mesh, told = said(path)
        assert ["its animations are left out" in text for text in told] == [True] * moves
        np.testing.assert_array_equal(mesh.vertices, still.vertices)


class TestUsd:
    @pytest.fixture
    def stage(self, tmp_path: Path) -> Any:
        pytest.importorskip("pxr")
        from pxr import Usd

        return Usd.Stage.CreateNew(str(tmp_path / "a.usda"))

    def triangle(self, stage: Any, place: str = "/mesh") -> Any:
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh.Define(stage, place)
        mesh.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
        mesh.GetFaceVertexCountsAttr().Set([3])
        mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2])
        return mesh

    def loaded(self, stage: Any, tmp_path: Path) -> tuple[gk.mesh.TriangleMesh, list[str]]:
        stage.Save()
        mesh, told = said(tmp_path / "a.usda")
        return mesh, [text.partition(": ")[2] for text in told]

    def test_samples_of_attributes_and_places_are_said(self, stage: Any, tmp_path: Path) -> None:
        mesh = self.triangle(stage)
        move = mesh.AddTranslateOp()
        for time, x in ((3, 5.0), (4, 6.0)):
            move.Set((x, 0, 0), time)
        read, told = self.loaded(stage, tmp_path)
        assert told == [
            "its animations are left out: it is read at the default time, or at the first sample without one"
        ]
        np.testing.assert_array_equal(read.vertices[:, 0], [5.0, 6.0, 5.0])

    def test_one_sample_or_a_moving_camera_is_no_animation(self, stage: Any, tmp_path: Path) -> None:
        from pxr import UsdGeom

        self.triangle(stage).AddTranslateOp().Set((7, 0, 0), 1)
        eye = UsdGeom.Camera.Define(stage, "/eye").AddTranslateOp()
        eye.Set((0, 0, 1), 1)
        eye.Set((0, 0, 2), 2)
        read, told = self.loaded(stage, tmp_path)
        assert not told
        assert read.vertices[0, 0] == 7.0

    def test_shapes_with_samples_only_have_the_first_one(self, stage: Any, tmp_path: Path) -> None:
        """Not the radius that a sphere has without one."""
        from pxr import UsdGeom

        radius = UsdGeom.Sphere.Define(stage, "/ball").GetRadiusAttr()
        radius.Set(3.0, 1)
        radius.Set(4.0, 2)
        read, told = self.loaded(stage, tmp_path)
        assert len(told) == 1
        np.testing.assert_allclose(np.linalg.norm(read.vertices, axis=1), 3.0)

    @pytest.mark.slow
    def test_each_array_has_the_first_sample_where_it_has_no_default(self, stage: Any, tmp_path: Path) -> None:
        """Positions with a default, faces and colors without; and the other way around."""
        from pxr import Sdf, UsdGeom

        first, second = self.triangle(stage, "/first"), self.triangle(stage, "/second")
        for attribute in (first.GetFaceVertexCountsAttr(), first.GetFaceVertexIndicesAttr(), second.GetPointsAttr()):
            value = attribute.Get()
            attribute.Clear()
            attribute.Set(value, 1)
        for mesh in (first, second):
            heat = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("heat", Sdf.ValueTypeNames.FloatArray, "vertex")
            heat.Set([1.0, 2.0, 3.0], 1)
        read, told = self.loaded(stage, tmp_path)
        assert not told
        assert read.face_count == 2
        np.testing.assert_array_equal(read.vertex_data["heat"], [1, 2, 3, 1, 2, 3])

    def test_instances_have_places_of_the_first_sample(self, stage: Any, tmp_path: Path) -> None:
        """Numbers of prototypes by default, places by samples, as programs of effects write them."""
        from pxr import UsdGeom

        many = UsdGeom.PointInstancer.Define(stage, "/many")
        self.triangle(stage, "/many/mesh")
        many.GetPrototypesRel().SetTargets(["/many/mesh"])
        many.GetProtoIndicesAttr().Set([0, 0])
        many.GetPositionsAttr().Set([(0, 0, 1), (0, 0, 2)], 1)
        many.GetPositionsAttr().Set([(0, 0, 3), (0, 0, 4)], 2)
        read, told = self.loaded(stage, tmp_path)
        assert len(told) == 1
        np.testing.assert_array_equal(read.vertices[:, 2], [1, 1, 1, 2, 2, 2])

    def test_bones_are_said(self, stage: Any, tmp_path: Path) -> None:
        from pxr import Gf, UsdSkel

        mesh = self.triangle(stage)
        skeleton = UsdSkel.Skeleton.Define(stage, "/bones")
        skeleton.GetJointsAttr().Set(["a"])
        skeleton.GetRestTransformsAttr().Set([Gf.Matrix4d().SetTranslate((0, 0, 9))])
        moves = UsdSkel.Animation.Define(stage, "/moves")
        moves.GetTranslationsAttr().Set([(0, 0, 1)], 1)
        moves.GetTranslationsAttr().Set([(0, 0, 2)], 2)
        binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateSkeletonRel().SetTargets(["/bones"])
        binding.CreateJointIndicesPrimvar(False, 1).Set([0, 0, 0])
        binding.CreateJointWeightsPrimvar(False, 1).Set([1.0, 1.0, 1.0])
        read, (told,) = self.loaded(stage, tmp_path)
        assert "its animations are left out" in told
        assert "its skinned meshes are read as they are stored, without their skeletons and blend shapes" in told
        np.testing.assert_array_equal(read.vertices[:, 2], 0.0)
