"""Meshes that stay on the device where kernels made them: a GPU, or warp arrays on the CPU."""

from __future__ import annotations

import copy
import dataclasses
import gc
import pickle
import threading
import weakref

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.sphere_volumes import sphere
from benchmarks.catalog.typed_grids import TypedGrid
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh.model import device_mesh as device_mesh_module
from geokit.mesh.model.device_mesh import arrays_on, box_of, mesh_on_device
from geokit.volume.model.sparse_volume import SparseVolume, made_on_device
from geokit.volume.nanovdb.header import info_of
from tests.support.devices import DEVICES

pytestmark = pytest.mark.parametrize("device", DEVICES)


def placed(mesh, device):
    """The mesh as if kernels had made it on a device."""
    vertices = wp.array(mesh.vertices, dtype=wp.vec3d, device=device)
    faces = wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=device)
    return mesh_on_device(vertices, faces, mesh.name)


@pytest.fixture
def journeys(monkeypatch):
    """The copies to the host since the start of the test, one entry for each."""
    made = []
    download = device_mesh_module.download

    def counted(*arrays):
        made.append(len(arrays))
        return download(*arrays)

    monkeypatch.setattr(device_mesh_module, "download", counted)
    return made


def test_arrays_come_once_and_together(device, journeys):
    whole = mesh_catalog.icosphere(2)
    mesh = placed(whole, device)
    assert journeys == []
    for _ in range(2):
        np.testing.assert_array_equal(mesh.faces, whole.faces)
        np.testing.assert_array_equal(mesh.vertices, whole.vertices)
    assert journeys == [2]
    assert (mesh.vertices.dtype, mesh.faces.dtype) == (np.float64, np.int32)
    assert mesh.vertices is mesh.vertices
    for array in (mesh.vertices, mesh.faces):
        assert array.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        mesh.vertices = whole.vertices


def test_counts_box_and_text_leave_it_there(device, journeys):
    whole = mesh_catalog.torus()
    mesh = placed(whole, device)
    assert (mesh.vertex_count, mesh.face_count) == (len(whole.vertices), len(whole.faces))
    assert (whole.vertex_count, whole.face_count) == (len(whole.vertices), len(whole.faces))
    assert repr(mesh) == repr(whole)
    np.testing.assert_array_equal(mesh.bounds, whole.bounds)
    assert mesh.diagonal == whole.diagonal
    assert (mesh.name, mesh.parts) == (whole.name, ())
    assert mesh in {mesh}
    assert journeys == []


@pytest.mark.parametrize("count", [1, 2, 255, 257, 65_535, 65_537, 200_000])
def test_boxes_of_any_number_of_points(count, device):
    points = np.random.default_rng(count).normal(size=(count, 3)) * [1.0, 1e-200, 1e200]
    expected = [points.min(axis=0), points.max(axis=0)]
    np.testing.assert_array_equal(box_of(wp.array(points, dtype=wp.vec3d, device=device)), expected)
    np.testing.assert_array_equal(placed(TriangleMesh(points, [[0, 0, 0]]), device).bounds, expected)


@pytest.mark.parametrize("vertex_count", [0, 3])
def test_without_faces(vertex_count, device):
    mesh = placed(TriangleMesh(np.ones((vertex_count, 3)), np.zeros((0, 3), int)), device)
    assert np.isnan(mesh.bounds).all()
    assert np.isnan(mesh.diagonal)
    assert repr(mesh) == f"TriangleMesh({vertex_count} vertices, 0 faces)"
    with pytest.raises(gk.InputError, match="no faces"):
        Surface(mesh, device=device)
    assert (mesh.vertices.shape, mesh.faces.shape) == ((vertex_count, 3), (0, 3))


def test_threads_wait_for_one_journey(device, monkeypatch):
    whole = mesh_catalog.icosphere(1)
    mesh = placed(whole, device)
    download, made, start, found = device_mesh_module.download, [], threading.Barrier(8), []
    arrived = threading.Event()

    def slow(*arrays):
        made.append(arrays)
        arrived.wait(0.2)  # the other threads arrive meanwhile
        return download(*arrays)

    monkeypatch.setattr(device_mesh_module, "download", slow)

    def read(name):
        start.wait()
        found.append((name, getattr(mesh, name)))

    threads = [threading.Thread(target=read, args=(name,)) for name in 4 * ["vertices", "faces"]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    assert len(found) == len(threads)
    assert all(array is getattr(mesh, name) for name, array in found)


def test_after_a_journey_that_failed_it_is_still_there(device, monkeypatch):
    whole = mesh_catalog.box()
    mesh = placed(whole, device)

    def full(*arrays):
        raise MemoryError("no more")

    with monkeypatch.context() as patch:
        patch.setattr(device_mesh_module, "download", full)
        with pytest.raises(MemoryError, match="no more"):
            mesh.vertices  # noqa: B018
    np.testing.assert_array_equal(mesh.vertices, whole.vertices)


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda mesh: pickle.loads(pickle.dumps(mesh))])
@pytest.mark.parametrize("is_read", [False, True])
def test_copies_are_of_the_host_and_read_only(how, is_read, device):
    whole = mesh_catalog.icosphere(1)
    mesh = placed(whole, device)
    if is_read:
        mesh.vertices  # noqa: B018
    other = how(mesh)
    assert type(other) is TriangleMesh
    assert other is not mesh
    assert other._on_device is None
    assert (other.name, other.parts) == (mesh.name, mesh.parts)
    for one, two in ((other.vertices, whole.vertices), (other.faces, whole.faces)):
        np.testing.assert_array_equal(one, two)
        assert not one.flags.writeable


def test_dataclass_tools(device):
    whole = mesh_catalog.box()
    named = dataclasses.replace(placed(whole, device), name="other")
    assert named.name == "other"
    np.testing.assert_array_equal(named.faces, whole.faces)
    assert [field.name for field in dataclasses.fields(named)][:4] == ["vertices", "faces", "name", "parts"]
    with pytest.raises(AttributeError, match="'TriangleMesh' object has no attribute 'nothing'"):
        named.nothing  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute 'vertices'"):
        TriangleMesh.__new__(TriangleMesh).vertices  # noqa: B018


def test_a_surface_takes_the_arrays_over(device, journeys):
    whole = mesh_catalog.torus()
    mesh = placed(whole, device)
    held = mesh._on_device
    surface = Surface(mesh, device=device)
    assert surface._vertices is held.vertices
    assert surface._faces is held.faces
    assert surface._warp_mesh.indices is held.faces
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (500, 3))
    expected = Surface(whole, device=device)
    directions = np.roll(points, 1, axis=0)
    for one, two in (
        (surface.closest_point(points), expected.closest_point(points)),
        (surface.raycast(points, directions), expected.raycast(points, directions)),
        (surface.overlapping(points - 0.1, points + 0.1), expected.overlapping(points - 0.1, points + 0.1)),
    ):
        for part, other in zip(one, two, strict=True):
            np.testing.assert_array_equal(part, other)
    assert repr(surface) == repr(expected)
    assert journeys == []
    # Signs need the connectivity of the faces, on the host.
    np.testing.assert_array_equal(surface.signed_distance(points).distance, expected.signed_distance(points).distance)
    np.testing.assert_allclose(surface.winding_number(points), expected.winding_number(points), rtol=0.0, atol=1e-5)
    assert surface.sign_method == expected.sign_method
    assert journeys == [2]
    surface.update(1.5 * whole.vertices)
    np.testing.assert_array_equal(surface.bounds, 1.5 * whole.bounds)
    np.testing.assert_array_equal(mesh.vertices, whole.vertices)


@pytest.mark.slow
def test_the_device_s_memory_goes_with_the_first_reading_unless_a_surface_needs_it(device):
    mesh, other = (placed(mesh_catalog.box(), device) for _ in range(2))
    alone, used = (weakref.ref(one._on_device.vertices) for one in (mesh, other))
    surface = Surface(other, device=device)
    for one in (mesh, other):
        one.faces  # noqa: B018
        assert one._on_device is None
    gc.collect()
    if device != "cpu":  # there NumPy's arrays are in that memory
        assert alone() is None
    assert used() is surface._vertices


def test_another_device_gets_a_copy(device, journeys):
    whole = mesh_catalog.box()
    mesh = placed(whole, device)
    vertices, faces = arrays_on(mesh, wp.get_device(device))
    assert vertices is mesh._on_device.vertices
    assert journeys == []
    for other in DEVICES:
        points = [[0.5, 0.5, 3.0]]
        np.testing.assert_array_equal(Surface(mesh, device=other).closest_point(points).distance, [2.0])
    np.testing.assert_array_equal(mesh.vertices, whole.vertices)
    vertices, faces = arrays_on(mesh, wp.get_device(device))
    np.testing.assert_array_equal(vertices.numpy(), whole.vertices)
    np.testing.assert_array_equal(faces.numpy(), whole.faces.reshape(-1))


@pytest.mark.parametrize("method", ["surface_nets", "marching_cubes", "dual_contouring"])
def test_isosurfaces_stay_where_they_are_made(method, device, journeys):
    volume = sphere(11.3)
    mesh = gk.mesh.from_volume(volume, method=method, device=device)
    assert mesh._on_device.vertices.device == wp.get_device(device)
    assert mesh.name == volume.info.name
    surface = Surface(mesh, device=device)
    distance = surface.closest_point([[0.0, 0.0, 0.0]]).distance[0]
    assert journeys == []
    expected = gk.mesh.from_volume(volume, method=method, device="cpu")
    assert mesh.faces.shape == expected.faces.shape
    assert (mesh.faces != expected.faces).any(axis=1).mean() < 0.01  # diagonals of quads that are as long as each other
    np.testing.assert_allclose(mesh.vertices, expected.vertices, rtol=0.0, atol=1e-6 * volume.info.voxel_size[0])
    assert distance == pytest.approx(np.linalg.norm(mesh.vertices, axis=1).min(), rel=0.02)


@pytest.mark.parametrize("kind", ["float", "double", "int32", "bool", "vec3f", "vec3d", "rgba8", "fp8"])
def test_attributes_leave_it_there(kind, device):
    volumes = {"distance": sphere(11.3), "other": TypedGrid(kind).volume}
    mesh = gk.mesh.from_volume(volumes["distance"], device=device)
    order = 0 if kind in ("int32", "bool") else 1
    found = gk.mesh.sample_attributes(mesh, volumes, order=order, device=device)
    assert mesh._on_device is not None
    for name, volume in volumes.items():
        expected = volume.sample(mesh.vertices, order=order, device=device)
        assert type(found[name]) is np.ndarray
        assert (found[name].dtype, found[name].shape) == (expected.dtype, expected.shape)
        np.testing.assert_array_equal(found[name], expected)


@pytest.mark.filterwarnings("ignore:.*has no surface at:UserWarning")
@pytest.mark.parametrize("method", ["surface_nets", "marching_cubes", "dual_contouring"])
@pytest.mark.parametrize("kind", ["from_mesh", "fp8", "nothing"])
def test_a_volume_on_a_device_stays_there_too(method, kind, device):
    if kind == "fp8":
        made = sphere(11.3).quantize("fp8")
    elif kind == "nothing":
        made = gk.volume.clip(sphere(5.0), [[50.0, 50.0, 50.0], [51.0, 51.0, 51.0]])
    else:
        made = gk.volume.from_mesh(mesh_catalog.torus(), 0.07, device="cpu")
    there = made_on_device(wp.array(made.nanovdb, dtype=wp.uint8, device=device), made.info)
    mesh = gk.mesh.from_volume(there, method=method, device=device)
    assert ("nanovdb" in vars(there)) == (kind == "nothing")
    expected = gk.mesh.from_volume(made, method=method, device=device)
    assert (len(mesh.faces) > 0) == (kind != "nothing")
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.faces, expected.faces)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*has no surface at:UserWarning")
@pytest.mark.parametrize("method", ["surface_nets", "marching_cubes"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_every_vertex_is_used_and_in_its_place(method, share, device):
    # Where neither end of a crossed edge is active there is no face, and a vertex may remain without one.
    rng = np.random.default_rng(5)
    blocks = 8 * np.array(list(np.ndindex(3, 3, 3)), np.int32)
    values = rng.normal(size=(27, 512)).astype(np.float32)

    def mesh_of(active):
        buffer = build_float_grid(
            blocks,
            values,
            active,
            background=-1.0,
            transform=np.eye(4),
            name="noise",
            grid_class="unknown",
            signed_fill=False,
        )
        return gk.mesh.from_volume(SparseVolume(buffer, info_of(buffer)), method=method, device=device)

    mesh, full = mesh_of(rng.random(values.shape) < share), mesh_of(np.ones(values.shape, bool))
    box = mesh.bounds
    used = np.unique(mesh.faces)
    np.testing.assert_array_equal(used, np.arange(mesh.vertex_count))
    if share == 0.0:
        assert mesh.face_count == 0
        return
    np.testing.assert_array_equal(box, [mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
    # Its triangles are among those of the whole surface, in the same places.
    assert (mesh.face_count == full.face_count) == (share == 1.0)
    whole, part = ({tuple(row) for row in one.vertices[one.faces].reshape(-1, 9)} for one in (full, mesh))
    assert part <= whole
