"""Units and up axes: everything that is made of a mesh or a volume says what that says of its world."""

from __future__ import annotations

import pickle
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import geokit as gk
from geokit import native
from tests.support import public_calls as calls

pytestmark = pytest.mark.filterwarnings("ignore:.*does not hold the unit:UserWarning")

METERS, UP = 0.0254, "x"
WORLD = {"geokit:meters_per_unit": METERS, "geokit:up_axis": UP}
# What says another world on purpose.
OTHER = {"mesh.convert_unit", "mesh.TriangleMesh", "volume.SparseVolume"}


def told(thing: Any) -> Any:
    if isinstance(thing, gk.volume.SparseVolume):
        return type(thing)(thing.nanovdb, replace(thing.info, metadata={**thing.info.metadata, **WORLD}))
    return gk.mesh.TriangleMesh(thing.vertices, thing.faces, meters_per_unit=METERS, up_axis=UP)


def worlds(thing: Any) -> Iterator[tuple[Any, Any]]:
    """What each mesh and volume within a result says, by plain reading."""
    if isinstance(thing, gk.mesh.TriangleMesh):
        yield thing.meters_per_unit, thing.up_axis
    elif isinstance(thing, gk.mesh.Surface):
        yield from worlds(thing.mesh)
    elif isinstance(thing, gk.volume.SparseVolume):
        yield from worlds(thing.info)
    elif isinstance(thing, gk.volume.GridInfo):
        yield tuple(thing.metadata.get(key) for key in WORLD)
    elif isinstance(thing, gk.volume.AdaptiveSDF):
        yield from worlds(thing.levels)
    elif isinstance(thing, (tuple, list, dict)):
        for one in thing.values() if isinstance(thing, dict) else thing:
            yield from worlds(one)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> calls.Scene:
    octahedron = calls._octahedron
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr(calls, "_octahedron", lambda: told(octahedron()))
        scene = calls.Scene(tmp_path_factory.mktemp("scene"))
    scene.fog, scene.field, scene.index = (told(one) for one in (scene.fog, scene.field, scene.index))
    return scene


@pytest.mark.slow
def test_every_public_call_hands_the_world_on(scene: calls.Scene) -> None:
    silent, asked = [], []
    for call in calls.public_calls(scene):
        if call.name.partition("(")[0] in OTHER or not call.name.startswith(("mesh.", "volume.")):
            continue
        given = *call.arguments.values(), getattr(call.function, "__self__", None)
        if any(found == (METERS, UP) for found in worlds(given)):
            asked.append(call.name)
            silent += [call.name for found in worlds(call()) if found != (METERS, UP)]
    assert silent == []
    assert {"volume.resample", "volume.adaptive_from_mesh", "mesh.from_volume(tolerance)", "mesh.union"} <= {*asked}
    assert len(asked) > 60


def pairs(calls_of: calls.Scene, a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Calls of two things of which one says ``a`` of its world and the other ``b``."""
    vertices, faces = body()
    one, two = gk.mesh.TriangleMesh(vertices, faces, **a), gk.mesh.TriangleMesh(vertices + 4.5, faces, **b)
    first, second = (gk.mesh.Surface(mesh, device="cpu") for mesh in (one, two))
    sdf, other = (gk.volume.from_mesh(surface, 2.0) for surface in (first, second))
    fogs = [
        gk.volume.SparseVolume(calls_of.fog.nanovdb, replace(calls_of.fog.info, metadata=dict(v.info.metadata)))
        for v in (sdf, other)
    ]
    rays = {"origins": [[-1.0, 0.4, 0.4]], "directions": [[1.0, 0.0, 0.0]], "device": "cpu"}
    csg = {
        name: lambda name=name: getattr(gk.volume, name)(sdf, sdf, other)
        for name in ("union", "intersection", "difference")
    }
    return {
        "mesh.hausdorff": lambda: gk.mesh.hausdorff(first, two, samples=0, device="cpu"),
        "mesh.union": lambda: gk.mesh.union(one, two),
        "mesh.difference": lambda: gk.mesh.difference(one, two),
        "mesh.intersection": lambda: gk.mesh.intersection(one, two),
        "mesh.transfer_attributes": lambda: gk.mesh.transfer_attributes(one, two, device="cpu"),
        "mesh.sample_attributes": lambda: gk.mesh.sample_attributes(one, {"d": other}, device="cpu"),
        "Surface.contacts": lambda: first.contacts(second),
        "Surface.distance": lambda: first.distance(second),
        "Surface.intersecting_triangles": lambda: first.intersecting_triangles(second),
        **(csg if native.available() else {}),
        "volume.integrate": lambda: gk.volume.integrate(fogs[0], **rays, emission=fogs[1]),
        "render.view": lambda: gk.render.view(one, other, device="cpu"),
    }


@pytest.mark.parametrize(
    ("a", "b", "what"),
    [
        ({"meters_per_unit": 0.001}, {"meters_per_unit": 0.0254}, "meters_per_unit"),
        ({"up_axis": "y", "meters_per_unit": 1.0}, {"up_axis": "z"}, "up_axis"),
    ],
)
def test_two_known_worlds_are_an_error(scene: calls.Scene, a: Any, b: Any, what: str) -> None:
    for call in pairs(scene, a, b).values():
        with pytest.raises(gk.InputError, match=rf"{what} differs: .*mesh\.convert_unit"):
            call()


@pytest.mark.parametrize(
    ("a", "b"),
    [({}, {"meters_per_unit": 0.001, "up_axis": "z"}), ({"meters_per_unit": 0.3048, "up_axis": "x"},) * 2],
)
def test_an_unknown_world_and_an_equal_one_are_none(scene: calls.Scene, a: Any, b: Any) -> None:
    for call in pairs(scene, a, b).values():
        call()


@pytest.mark.skipif(not native.available(), reason="needs OpenVDB")
@pytest.mark.parametrize("masks", [False, True])
def test_a_union_says_what_any_of_its_operands_says(masks: bool) -> None:
    plain, known = (
        gk.volume.from_mesh(gk.mesh.TriangleMesh(*body(), **said), 2.0, device="cpu")
        for said in ({}, {"meters_per_unit": METERS, "up_axis": UP})
    )
    if masks:
        plain = gk.volume.from_dense(np.ones((4, 4, 4), bool), grid_type="mask")
        known = told(plain)
    for made in (gk.volume.union(plain, known), gk.volume.difference(plain, plain, known)):
        assert [*worlds(made)] == [(METERS, UP)]
    assert [*worlds(plain)] == [(None, None)]


def test_a_transform_may_change_the_world() -> None:
    inch, mm = (
        gk.mesh.Surface(gk.mesh.TriangleMesh(*body(), meters_per_unit=size, up_axis=up), device="cpu")
        for size, up in ((0.0254, "z"), (0.001, "y"))
    )
    moved = np.diag([25.4, 25.4, 25.4, 1.0])
    moved[0, 3] = 25.4 * 10
    assert inch.distance(mm, transform=moved).distance == pytest.approx(25.4 * 5 - 5)


def test_a_stage_has_one_unit(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    volumes = [
        gk.volume.from_mesh(gk.mesh.TriangleMesh(*body(), meters_per_unit=meters, name=name), 4.0, device="cpu")
        for name, meters in (("a", 1.0), ("b", 0.01))
    ]
    with pytest.raises(gk.InputError, match=r"volumes\[1\]: meters_per_unit differs: 0\.01, and 1\.0 of volumes"):
        gk.volume.save(tmp_path / "a.usda", *volumes)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(("meters", "unit"), [(1e-6, "um"), (1e-3, "mm"), (1.0, "m"), (0.3048, None)])
def test_a_field_names_the_unit_of_its_mesh(meters: float, unit: str | None) -> None:
    mesh = gk.mesh.TriangleMesh(*body(), meters_per_unit=meters, up_axis="z")
    for how in ({"voxel_size": 2.0}, {"tolerance": 0.5}, {"voxel_size": 2.0, "thickness": 4.0}):
        metadata = gk.volume.from_mesh(gk.mesh.Surface(mesh, device="cpu"), **how).info.metadata
        assert metadata.get("geokit:unit") == unit
        assert metadata.get("geokit:meters_per_unit") == (None if unit else meters)
        assert metadata["geokit:up_axis"] == "z"
    plain = gk.volume.from_mesh(gk.mesh.TriangleMesh(*body()), 2.0, device="cpu")
    assert not {"geokit:unit", *WORLD} & {*plain.info.metadata}
    assert [*worlds(gk.mesh.from_volume(plain, device="cpu"))] == [(None, None)]


def test_bodies_that_overlap_keep_their_unit() -> None:
    """Their union is another mesh than the one that was given."""
    vertices, faces = body()
    both = np.concatenate([vertices, vertices + 5.0]), np.concatenate([faces, faces + len(vertices)])
    volume = gk.volume.from_mesh(gk.mesh.TriangleMesh(*both, meters_per_unit=METERS, up_axis=UP), 2.0, device="cpu")
    assert volume.info.metadata["geokit:interior"] == "removed"
    assert [*worlds(volume)] == [(METERS, UP)]


@pytest.mark.parametrize("kind", [".nvdb", *([".vdb"] if native.available() else [])])
def test_files_and_pickles_keep_both(kind: str, tmp_path: Path) -> None:
    volume = gk.volume.from_mesh(told(gk.mesh.sphere()), 0.2, device="cpu")
    gk.volume.save(tmp_path / f"a{kind}", volume)
    assert [*worlds(gk.volume.load(tmp_path / f"a{kind}"))] == [(METERS, UP)]
    assert [*worlds(gk.volume.inspect(tmp_path / f"a{kind}"))] == [(METERS, UP)]
    assert [*worlds(pickle.loads(pickle.dumps(volume)))] == [(METERS, UP)]


@pytest.mark.parametrize("value", ["furlong", -1.0, float("nan"), (1, 2), True])
def test_metadata_that_name_no_length_are_no_unit(value: Any) -> None:
    volume = gk.volume.from_mesh(gk.mesh.sphere(), 0.2, device="cpu")
    for key in ("geokit:unit", "geokit:meters_per_unit", "geokit:up_axis"):
        said = replace(volume.info, metadata={key: value})
        mesh = gk.mesh.from_volume(gk.volume.SparseVolume(volume.nanovdb, said), device="cpu")
        assert (mesh.meters_per_unit, mesh.up_axis) == (None, None)


def body() -> tuple[np.ndarray, np.ndarray]:
    """A box of 10 by 20 by 30."""
    box = gk.mesh.box((10.0, 20.0, 30.0))
    return box.vertices, box.faces


def sides_of_3mf(path: Path) -> np.ndarray:
    """The sides in meters, by the file's own words."""
    root = ElementTree.fromstring(zipfile.ZipFile(path).read("3D/3dmodel.model"))
    vertices = [[float(one.attrib[axis]) for axis in "xyz"] for one in root.iter() if one.tag.endswith("}vertex")]
    lengths = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
    return np.ptp(vertices, axis=0) * lengths[root.attrib["unit"]]


@pytest.mark.parametrize("kind", [".nvdb", *([".vdb"] if native.available() else [])])
@pytest.mark.parametrize("meters", [1e-6, 1e-3, 0.0254])
def test_a_part_has_its_size_after_a_volume(kind: str, meters: float, tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "a.3mf", gk.mesh.TriangleMesh(*body(), meters_per_unit=meters, up_axis="z"))
    gk.volume.save(tmp_path / f"a{kind}", gk.volume.from_mesh(gk.mesh.load(tmp_path / "a.3mf"), 1.0, device="cpu"))
    gk.mesh.save(tmp_path / "b.3mf", gk.mesh.from_volume(gk.volume.load(tmp_path / f"a{kind}"), device="cpu"))
    before, after = (sides_of_3mf(tmp_path / name) for name in ("a.3mf", "b.3mf"))
    np.testing.assert_allclose(after, before, rtol=0.1)


@pytest.mark.parametrize("kind", ["usda", "glb", "vtp"])
def test_meshes_of_volumes_have_their_size_in_other_formats(kind: str, tmp_path: Path) -> None:
    pytest.importorskip({"usda": "pxr", "glb": "trimesh", "vtp": "pyvista"}[kind])
    volume = gk.volume.from_mesh(gk.mesh.TriangleMesh(*body(), meters_per_unit=0.01, up_axis="z"), 1.0, device="cpu")
    path = tmp_path / f"a.{kind}"
    gk.mesh.save(path, gk.mesh.from_volume(volume, device="cpu"))
    if kind == "usda":
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(path))
        assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (0.01, "Z")
    elif kind == "glb":
        import trimesh

        np.testing.assert_allclose(trimesh.load(path, force="mesh").extents, [0.1, 0.3, 0.2], rtol=0.1)
    else:
        import pyvista

        assert pyvista.read(path).field_data["meters_per_unit"].tolist() == [0.01]


def test_a_map_states_angstroms_and_says_so(tmp_path: Path) -> None:
    pytest.importorskip("mrcfile")
    volume = gk.volume.from_dense(np.ones((3, 4, 5), np.float32), voxel_size=2.0)
    with pytest.warns(UserWarning, match=r"a\.mrc: the unit of the volume is not known, and the file says angstrom"):
        gk.volume.save(tmp_path / "a.mrc", volume)


def test_a_volume_in_inches_is_in_millimeters_in_files_that_do_not_know_inches(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    volume = told(gk.volume.from_dense(np.ones((3, 4, 5), np.float32), voxel_size=2.0))
    gk.volume.save(tmp_path / "a.nii", volume)
    header = nibabel.load(tmp_path / "a.nii").header
    assert header.get_xyzt_units()[0] == "mm"
    np.testing.assert_allclose(header.get_zooms(), 2.0 * 25.4, rtol=1e-6)
