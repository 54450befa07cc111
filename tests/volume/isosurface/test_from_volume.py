"""Isosurfaces: place, winding, splitting of quads, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog.float_grids import build_float_grid
from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.errors import DeviceMemoryError, InputError, MissingDependencyError, UnsupportedGridError
from geokit.mesh._audit import audit
from geokit.mesh._hausdorff import hausdorff
from geokit.mesh.volumes.from_volume import _split_quads, from_volume, from_volume_with_deviation
from geokit.native import _openvdb
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import TREE_OFFSET, aligned_buffer, info_of, tree_header
from geokit.volume.nanovdb.layout import layout_of
from tests.support.reference import closest_point

needs_openvdb = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

# How far crossings keep from the ends of their edge [voxels].
END = 1e-6
CENTER = np.array([0.31, -0.17, 0.23])


def _grid(field, count=32, transform=None, background=3.0, grid_class="level set"):
    """A float grid of count^3 voxels; ``field`` gives the values of world points (N, 3)."""
    transform = np.eye(4) if transform is None else transform
    blocks = np.array(list(np.ndindex(*[count // 8] * 3))) * 8
    ijk = blocks[:, None] + np.array(list(np.ndindex(8, 8, 8)))
    values = field(ijk.reshape(-1, 3) @ transform[:3, :3].T + transform[:3, 3]).reshape(-1, 512)
    buffer = build_float_grid(
        blocks.astype(np.int32),
        values.astype(np.float32),
        np.ones(values.shape, bool),
        background=background,
        transform=transform,
        name="ball",
        grid_class=grid_class,
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def _leaves(origins, values, masks, background=1.0):
    buffer = build_float_grid(
        origins,
        values,
        masks,
        background=background,
        transform=np.eye(4),
        name="leaves",
        grid_class="unknown",
        signed_fill=False,
    )
    return SparseVolume(buffer, info_of(buffer))


def _leaf_masks(buffer):
    """The 64 bytes of each leaf that say which voxels are active, writable."""
    tree = tree_header(buffer)
    layout = layout_of(1, "test grid")
    begin = TREE_OFFSET + int(tree["node_offset"][0]) + 16
    return np.ndarray((int(tree["node_count"][0]), 64), np.uint8, buffer, begin, (layout.leaf_size, 1))


def _ball(points):
    return np.linalg.norm(points - CENTER, axis=1) - 1.0


def _around(voxel_size):
    transform = np.diag([voxel_size] * 3 + [1.0])
    transform[:3, 3] = -2.0
    return transform


def _signed_volume(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


def _edges_meet_in_opposite_pairs(mesh):
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    return len(forward) == len(edges) and all((b, a) in forward for a, b in forward)


METHODS = [
    "surface_nets",
    "marching_cubes",
    "dual_contouring",
    pytest.param("openvdb", marks=needs_openvdb),
]


@pytest.fixture(params=METHODS)
def method(request):
    return request.param


class TestBall:
    def test_closed_outward_and_named(self, method):
        mesh = from_volume(_grid(_ball, transform=_around(0.125)), method=method, device="cpu")
        assert mesh.name == "ball"
        assert _edges_meet_in_opposite_pairs(mesh)
        # Vertices lie off the sphere by about h^2 at most: inside it, but for those of dual contouring.
        assert 0.98 < _signed_volume(mesh) / (4 / 3 * np.pi) < (1.01 if method == "dual_contouring" else 1.0)

    def test_vertices_converge_at_second_order(self, method):
        errors = []
        for count in (16, 32, 64):
            mesh = from_volume(_grid(_ball, count, _around(4.0 / count)), method=method, device="cpu")
            errors.append(np.abs(_ball(mesh.vertices)).max())
        assert errors[0] < 0.25**2
        assert 3.0 < errors[0] / errors[1] < 5.5
        assert 3.0 < errors[1] / errors[2] < 5.5

    @pytest.mark.parametrize("isovalue", [-0.5, 0.25])
    def test_isovalue_is_an_offset_of_the_radius(self, method, isovalue):
        mesh = from_volume(_grid(_ball, transform=_around(0.125)), isovalue=isovalue, method=method, device="cpu")
        radius = np.linalg.norm(mesh.vertices - CENTER, axis=1)
        assert np.abs(radius - (1.0 + isovalue)).max() < 0.125**2

    @pytest.mark.parametrize(
        "linear",
        [
            [[0.2, 0.05, 0.0], [0.0, 0.1, 0.03], [0.02, 0.0, 0.15]],
            [[-0.15, 0.0, 0.0], [0.0, 0.15, 0.0], [0.0, 0.0, 0.15]],
        ],
        ids=["sheared", "mirrored"],
    )
    def test_normals_point_to_increasing_values_under_any_transform(self, method, linear):
        transform = np.eye(4)
        transform[:3, :3] = linear
        transform[:3, 3] = CENTER - transform[:3, :3] @ [15.5, 15.5, 15.5]
        mesh = from_volume(_grid(_ball, transform=transform), method=method, device="cpu")
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = np.einsum("ij,ij->i", normals, corners.mean(axis=1) - CENTER)
        assert (outward > 0).all()
        assert _edges_meet_in_opposite_pairs(mesh)

    @pytest.mark.parametrize("grid_class", ["level set", "unknown"])
    def test_faces_turn_to_increasing_values_whatever_the_class(self, method, grid_class):
        volume = _grid(_ball, transform=_around(0.125), grid_class=grid_class)
        before = volume.nanovdb.copy()
        assert _signed_volume(from_volume(volume, method=method, device="cpu")) > 4.0
        np.testing.assert_array_equal(volume.nanovdb, before)

    def test_fog_is_a_body_of_greater_values(self, method):
        volume = _grid(lambda p: -_ball(p), transform=_around(0.125), background=0.0, grid_class="fog volume")
        mesh = from_volume(volume, isovalue=0.125, method=method, device="cpu")
        assert _signed_volume(mesh) > 0.9 * 4 / 3 * np.pi * 0.875**3

    def test_far_from_the_origin(self, method):
        far = _around(0.125)
        far[:3, 3] += 1e6
        near = from_volume(_grid(_ball, transform=_around(0.125)), method=method, device="cpu")
        mesh = from_volume(_grid(lambda p: _ball(p - 1e6), transform=far), method=method, device="cpu")
        # The field is made from points near 1e6, whose rounding is 1e-10; the voxels are float32.
        assert mesh.vertices.shape == near.vertices.shape
        assert np.abs(mesh.vertices - 1e6 - near.vertices).max() < 1e-6

    @pytest.mark.parametrize("isovalue", [50.0, -50.0])
    def test_value_that_is_never_taken_gives_an_empty_mesh(self, method, isovalue):
        with pytest.warns(UserWarning, match=f"grid 'ball' has no surface at {isovalue:g}; its values are "):
            mesh = from_volume(_grid(_ball, transform=_around(0.125)), isovalue=isovalue, method=method, device="cpu")
        assert mesh.vertices.shape == (0, 3)
        assert mesh.faces.shape == (0, 3)
        assert mesh.name == "ball"

    @needs_openvdb
    def test_adaptivity_merges_faces_and_keeps_the_surface(self):
        volume = _grid(_ball, 64, _around(0.0625))
        full, merged = from_volume(volume, device="cpu"), from_volume(volume, adaptivity=0.5)
        assert len(merged.faces) < 0.5 * len(full.faces)
        assert np.abs(_ball(merged.vertices)).max() < 0.1
        assert _edges_meet_in_opposite_pairs(merged)

    @needs_openvdb
    def test_surface_nets_are_those_of_openvdb(self):
        volume = _grid(_ball, transform=_around(0.125))
        ours = from_volume(volume, method="surface_nets", device="cpu")
        theirs = from_volume(volume, method="openvdb")
        assert ours.faces.shape == theirs.faces.shape
        # OpenVDB's points are float32 [world]; in the order of x, y, z, where no two are nearer than that.
        ours_sorted, theirs_sorted = (m.vertices[np.lexsort(np.round(m.vertices, 4).T)] for m in (ours, theirs))
        assert np.abs(ours_sorted - theirs_sorted).max() < 1e-5

    def test_auto_is_surface_nets(self):
        volume = _grid(_ball, transform=_around(0.125))
        auto, nets = from_volume(volume, device="cpu"), from_volume(volume, method="surface_nets", device="cpu")
        np.testing.assert_array_equal(auto.vertices, nets.vertices)
        np.testing.assert_array_equal(auto.faces, nets.faces)
        assert not auto.vertices.flags.writeable
        assert not auto.faces.flags.writeable

    def test_integers_have_no_isosurface(self, method):
        volume = _grid(_ball)
        buffer = volume.nanovdb.copy()
        buffer[636] = 4  # the type's place in the header, and NanoVDB's int32
        with pytest.raises(UnsupportedGridError, match="int32"):
            from_volume(SparseVolume(buffer, info_of(buffer)), method=method)

    @pytest.mark.slow
    @pytest.mark.parametrize("threads", ["1", "2", "5"])
    def test_threads_change_nothing(self, method, threads, monkeypatch):
        volume = _grid(_ball, 64, _around(0.0625))
        expected = from_volume(volume, method=method, device="cpu")
        monkeypatch.setenv("GEOKIT_THREADS", threads)
        found = from_volume(volume, method=method, device="cpu")
        np.testing.assert_array_equal(found.vertices, expected.vertices)
        np.testing.assert_array_equal(found.faces, expected.faces)


class TestTolerance:
    @pytest.mark.slow
    def test_fewer_faces_no_farther_than_asked_for(self, method):
        volume = _grid(_ball, transform=_around(0.125))
        full = from_volume(volume, method=method, device="cpu")
        found = from_volume_with_deviation(volume, tolerance=0.02, method=method, device="cpu")
        assert 8 < len(found.mesh.faces) < 0.4 * len(full.faces)
        assert 0.0 < found.deviation_p999 <= found.deviation <= 0.02
        assert found.mesh.name == "ball"
        assert audit(found.mesh).watertight
        assert _signed_volume(found.mesh) > 0.9 * _signed_volume(full)
        # The vertices of the full mesh, which nothing but the bound has seen between them.
        off = closest_point(found.mesh.vertices, found.mesh.faces, full.vertices).distance.max()
        assert off <= found.deviation

    @pytest.mark.slow
    def test_flag_gives_the_same_mesh(self):
        volume = _grid(_ball, transform=_around(0.25), count=16)
        mesh = from_volume(volume, tolerance=0.05, device="cpu")
        found = from_volume_with_deviation(volume, tolerance=0.05, device="cpu")
        assert type(mesh) is type(found.mesh)
        np.testing.assert_array_equal(mesh.vertices, found.mesh.vertices)
        np.testing.assert_array_equal(mesh.faces, found.mesh.faces)

    @pytest.mark.slow
    def test_isovalue_is_that_of_the_full_mesh(self):
        volume = _grid(_ball, transform=_around(0.125))
        mesh = from_volume(volume, isovalue=0.25, tolerance=0.02, device="cpu")
        assert np.abs(np.linalg.norm(mesh.vertices - CENTER, axis=1) - 1.25).max() < 0.04

    def test_tolerance_that_allows_nothing_keeps_every_face(self):
        volume = _grid(_ball, transform=_around(0.25), count=16)
        full = from_volume(volume, device="cpu")
        found = from_volume_with_deviation(volume, tolerance=1e-12, device="cpu")
        assert found.deviation == 0.0
        np.testing.assert_array_equal(found.mesh.faces, full.faces)

    @pytest.mark.filterwarnings("ignore:.*has no surface at:UserWarning")
    def test_no_surface_gives_an_empty_mesh(self):
        found = from_volume_with_deviation(_grid(_ball, 16), tolerance=0.1, isovalue=50.0, device="cpu")
        assert found.mesh.faces.shape == (0, 3)
        assert found.deviation == 0.0

    @needs_openvdb
    def test_far_fewer_faces_than_adaptivity_leaves_at_the_same_distance(self):
        volume = _grid(_ball, transform=_around(0.125))
        full, merged = from_volume(volume, device="cpu"), from_volume(volume, adaptivity=0.2)
        apart = hausdorff(full, merged, samples=0, device="cpu").max
        found = from_volume_with_deviation(volume, tolerance=apart, device="cpu")
        assert len(found.mesh.faces) < 0.5 * len(merged.faces)


OWN = ["surface_nets", "marching_cubes", "dual_contouring"]
REAL_TYPES = ["float", "double", "half", "fp4", "fp8", "fp16", "fpn"]


def _crossings(values, active, isovalue):
    """Crossed edges of a dense field with an active end: first voxels, axes and crossings, in float64."""
    starts, axes, places = [], [], []
    inside = values < isovalue
    for axis in range(3):
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        crossed = (inside[low] != inside[high]) & (active[low] | active[high])
        at = np.argwhere(crossed)
        a, b = values[low][crossed], values[high][crossed]
        starts.append(at)
        axes.append(np.full(len(at), axis))
        places.append((isovalue - a) / (b - a))
    return np.concatenate(starts), np.concatenate(axes), np.concatenate(places)


def _voxels_around(lower, upper):
    ijk = np.stack(np.meshgrid(*[np.arange(a, b) for a, b in zip(lower, upper, strict=True)], indexing="ij"), axis=-1)
    return ijk.reshape(-1, 3), ijk.shape[:3]


def _edge_keys(points, lower):
    """Start and axis of the edge that each point lies on, as one number, for sorting."""
    local = points - lower
    fraction = np.abs(local - np.round(local))
    axis = np.argmax(fraction, axis=1)
    assert (np.sort(fraction, axis=1)[:, 1] < 1e-9).all()
    start = np.round(local).astype(np.int64)
    rows = np.arange(len(points))
    start[rows, axis] = np.floor(local[rows, axis]).astype(np.int64)
    return ((start[:, 0] * 4096 + start[:, 1]) * 4096 + start[:, 2]) * 3 + axis


def _active_tiles(grid):
    """Makes the tiles of the lower and the upper node active, and says which voxels then are."""
    layout, buffer = grid.layout, grid.volume.nanovdb
    tree = tree_header(buffer)
    for level, first in ((1, 1), (2, 1)):
        buffer[TREE_OFFSET + int(tree["node_offset"][level]) + 32] |= 1 << first
    assert layout.upper_size > layout.lower_size
    volume = SparseVolume(buffer, info_of(buffer))

    def active(ijk):
        x, y, z = ijk.T
        leaves = (x >= -8) & (x < 8) & (y >= 0) & (y < 8) & (z >= 0) & (z < 8)
        lower = (x >= 0) & (x < 8) & (y >= 0) & (y < 8) & (z >= 8) & (z < 16)
        upper = (x >= 0) & (x < 128) & (y >= 0) & (y < 128) & (z >= 128) & (z < 256)
        return leaves | lower | upper

    return volume, active


class TestEveryType:
    """Two leaves with a border of root entries between them, beside tiles: noise, so that every case occurs."""

    @pytest.mark.parametrize("grid_type", REAL_TYPES)
    def test_marching_cubes_has_a_vertex_on_each_crossed_edge(self, grid_type):
        grid = TypedGrid(grid_type)
        isovalue = float(np.median(grid.leaves)) + 0.01
        mesh = from_volume(grid.volume, isovalue=isovalue, method="marching_cubes", device="cpu")
        lower = np.array([-12, -4, -4])
        ijk, shape = _voxels_around(lower, (12, 12, 12))
        active = ((ijk >= [-8, 0, 0]) & (ijk < [8, 8, 8])).all(axis=1).reshape(shape)
        start, axis, place = _crossings(grid.at(ijk).reshape(shape), active, isovalue)
        expected = start + lower + np.eye(3)[axis] * np.clip(place, END, 1 - END)[:, None]
        order, found = np.argsort(_edge_keys(expected, lower)), np.argsort(_edge_keys(mesh.vertices, lower))
        assert len(mesh.vertices) == len(expected)
        # float32's rounding of differences of values that are up to 100 times as large, for the wide codes of fp16.
        assert np.abs(mesh.vertices[found] - expected[order]).max() < 2e-6
        report = audit(mesh)
        assert report.watertight
        assert report.manifold
        assert report.oriented

    @pytest.mark.parametrize("grid_type", REAL_TYPES)
    def test_surface_nets_are_means_of_a_cells_crossings(self, grid_type):
        grid = TypedGrid(grid_type)
        isovalue = float(np.median(grid.leaves)) + 0.01
        mesh = from_volume(grid.volume, isovalue=isovalue, method="surface_nets", device="cpu")
        lower = np.array([-12, -4, -4])
        ijk, shape = _voxels_around(lower, (12, 12, 12))
        start, axis, place = _crossings(grid.at(ijk).reshape(shape), np.ones(shape, bool), isovalue)
        points = start + np.eye(3)[axis] * place[:, None]
        total, number = np.zeros((*shape, 3)), np.zeros(shape)
        for u, v in np.ndindex(2, 2):
            other = np.stack([np.delete(np.arange(3), a) for a in range(3)])[axis]
            cell = start.copy()
            cell[np.arange(len(cell)), other[:, 0]] -= u
            cell[np.arange(len(cell)), other[:, 1]] -= v
            inside = (cell >= 0).all(axis=1)
            np.add.at(total, tuple(cell[inside].T), points[inside])
            np.add.at(number, tuple(cell[inside].T), 1)
        cells = np.floor(mesh.vertices).astype(int) - lower
        _, row, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        single = count[row.ravel()] == 1
        assert single.sum() > 300
        where = tuple(cells[single].T)
        mean = total[where] / number[where][:, None] + lower
        assert np.abs(mesh.vertices[single] - mean).max() < 2e-6
        assert audit(mesh).manifold
        assert audit(mesh).watertight

    @pytest.mark.slow
    @pytest.mark.parametrize("method", OWN)
    def test_active_tiles_of_every_size_have_a_surface(self, method):
        volume, active = _active_tiles(grid := TypedGrid("float"))
        # Between the background and the tiles, whatever these are.
        levels = np.sort([float(grid.background), float(grid.upper_tile), float(grid.lower_tile)])
        isovalue = 0.5 * (levels[0] + levels[1])
        mesh = from_volume(volume, isovalue=isovalue, method=method, device="cpu")
        report = audit(mesh)
        assert report.watertight
        assert report.manifold
        if method == "marching_cubes":
            lower = np.array([-12, -4, -4])
            ijk, shape = _voxels_around(lower, (132, 132, 260))
            crossed, _, _ = _crossings(grid.at(ijk).reshape(shape), active(ijk).reshape(shape), isovalue)
            assert len(mesh.vertices) == len(crossed)


class TestActiveRegion:
    @pytest.mark.parametrize("method", [*OWN, pytest.param("openvdb", marks=needs_openvdb)])
    def test_the_surface_ends_where_no_voxel_is_active(self, method):
        volume = _grid(lambda p: p[:, 2] - 0.03, 16, _around(0.25), background=1.0)
        full = from_volume(volume, method=method, device="cpu")
        buffer = aligned_buffer(len(volume.nanovdb))
        buffer[:] = volume.nanovdb
        for mask in _leaf_masks(buffer):
            mask[:] = np.where(np.arange(64) // 8 < 4, 255, 0)  # of each leaf, the half of lower x
        half = from_volume(SparseVolume(buffer, volume.info), method=method, device="cpu")
        assert 0 < len(half.faces) < len(full.faces)
        report = audit(half)
        assert report.boundary_edge_count > 0
        assert report.manifold
        assert report.unreferenced_count == 0

    @pytest.mark.parametrize("method", OWN)
    def test_a_field_cut_off_by_the_background_is_closed(self, method):
        # A plane that leaves the leaves: all around them is outside, so that the interpolant turns there.
        volume = _grid(lambda p: p[:, 2] - 0.03, 16, _around(0.25), background=1.0)
        report = audit(from_volume(volume, method=method, device="cpu"))
        assert report.watertight
        assert report.euler_number == 2

    @pytest.mark.parametrize("method", OWN)
    def test_one_voxel(self, method):
        values = np.ones((1, 512), np.float32)
        values[0, 0] = -1.0
        mask = np.zeros((1, 512), bool)
        mask[0, 0] = True
        volume = _leaves(np.zeros((1, 3), np.int32), values, mask)
        mesh = from_volume(volume, method=method, device="cpu")
        # The corners of the leaf: seven of the eight cells around the voxel belong to blocks without a leaf.
        assert audit(mesh).watertight
        assert audit(mesh).euler_number == 2
        # An octahedron, or a cube of cells.
        assert len(mesh.vertices) == (6 if method == "marching_cubes" else 8)
        assert np.abs(mesh.vertices).max() <= 0.5 + 1e-6

    @pytest.mark.parametrize("method", OWN)
    @pytest.mark.filterwarnings("ignore:.*has no surface at:UserWarning")
    def test_no_leaf(self, method):
        volume = _leaves(np.empty((0, 3), np.int32), np.empty((0, 512), np.float32), np.empty((0, 512), bool))
        assert len(from_volume(volume, method=method, device="cpu").faces) == 0

    @pytest.mark.parametrize("method", OWN)
    def test_voxels_that_have_the_isovalue_itself(self, method):
        rng = np.random.default_rng(4)
        values = rng.integers(-1, 2, (27, 512)).astype(np.float32)
        blocks = (8 * np.array(list(np.ndindex(3, 3, 3)))).astype(np.int32)
        mesh = from_volume(_leaves(blocks, values, np.ones((27, 512), bool)), method=method, device="cpu")
        report = audit(mesh)
        assert report.watertight
        assert report.manifold
        if method != "dual_contouring":  # which may put several vertices of a corner into that corner
            assert report.degenerate_count == 0
            assert report.coincident_count == 0

    @pytest.mark.parametrize("method", OWN)
    def test_voxels_that_are_not_finite(self, method):
        values = np.random.default_rng(5).normal(size=(8, 512)).astype(np.float32)
        values[:, ::7] = np.nan
        values[:, ::11] = np.inf
        values[:, ::13] = -np.inf
        blocks = (8 * np.array(list(np.ndindex(2, 2, 2)))).astype(np.int32)
        mesh = from_volume(_leaves(blocks, values, np.ones((8, 512), bool)), method=method, device="cpu")
        # NaN counts as outside; vertices stay in their cells.
        assert np.isfinite(mesh.vertices).all()
        assert mesh.vertices.min() > -1.0
        assert mesh.vertices.max() < 16.0
        assert audit(mesh).watertight


class TestQuads:
    def test_shorter_diagonal(self):
        points = np.array([[0, 0, 0], [1, 0, 0], [1.5, 1.5, 0], [0, 1, 0]], dtype=float)
        triangles = _split_quads(points, np.array([[0, 1, 2, 3], [1, 2, 3, 0]], np.int32))
        # The diagonal from 1 to 3, wherever the quad starts, and the quad's winding in both halves.
        assert sorted(map(sorted, triangles.tolist())) == [[0, 1, 3], [0, 1, 3], [1, 2, 3], [1, 2, 3]]
        for a, b, c in points[triangles]:
            assert np.cross(b - a, c - a)[2] > 0

    def test_no_quads(self):
        assert _split_quads(np.empty((0, 3)), np.empty((0, 4), np.int32)).shape == (0, 3)


class TestRefusals:
    @pytest.mark.parametrize("method", ["", "nets", None])
    def test_method(self, method):
        with pytest.raises(InputError, match="method"):
            from_volume(_grid(_ball), method=method)

    @pytest.mark.parametrize("method", OWN)
    def test_adaptivity_of_methods_that_have_none(self, method):
        with pytest.raises(InputError, match="openvdb"):
            from_volume(_grid(_ball), method=method, adaptivity=0.5)

    def test_device(self):
        with pytest.raises(InputError, match="device"):
            from_volume(_grid(_ball), device="tpu")

    @pytest.mark.parametrize("method", OWN)
    def test_more_than_can_be_numbered(self, method, monkeypatch):
        monkeypatch.setattr("geokit.volume.isosurface.launch.SAFE_PLANES", 0)
        from_volume(_grid(_ball), device="cpu", method=method)
        monkeypatch.setattr("geokit.volume.isosurface.launch.LARGEST", 5)
        with pytest.raises(DeviceMemoryError, match="more than 5 vertices"):
            from_volume(_grid(_ball), device="cpu", method=method)

    def test_memory(self, monkeypatch):
        monkeypatch.setattr("geokit.core.memory.available_memory.available_host", lambda: 1000)
        monkeypatch.setattr("geokit.volume.isosurface.launch.UNCHECKED_BYTES", 0)
        with pytest.raises(DeviceMemoryError, match="larger voxels"):
            from_volume(_grid(_ball), device="cpu")

    @pytest.mark.parametrize("isovalue", [np.nan, np.inf, -np.inf, "high", None])
    def test_isovalue(self, isovalue):
        with pytest.raises(InputError, match="isovalue"):
            from_volume(_grid(_ball), isovalue=isovalue)

    @pytest.mark.parametrize("adaptivity", [-0.1, 1.1, np.nan, "much"])
    def test_adaptivity(self, adaptivity):
        with pytest.raises(InputError, match="adaptivity"):
            from_volume(_grid(_ball), adaptivity=adaptivity)

    @pytest.mark.parametrize("tolerance", [0.0, -0.1, np.nan, np.inf, "little"])
    def test_tolerance(self, tolerance):
        for function in (from_volume, from_volume_with_deviation):
            with pytest.raises(InputError, match="tolerance"):
                function(_grid(_ball, 16), tolerance=tolerance)

    def test_tolerance_and_adaptivity(self):
        with pytest.raises(InputError, match="adaptivity: it merges faces by no known distance"):
            from_volume(_grid(_ball, 16), tolerance=0.1, adaptivity=0.5)

    @pytest.mark.parametrize(
        ("grid_type", "background"), [("vec3f", (0.0, 0.0, 0.0)), ("rgba8", (0, 0, 0, 0)), ("onindex", 0)]
    )
    def test_grids_that_are_not_scalar(self, grid_type, background):
        volume = _grid(_ball)
        info = dataclasses.replace(volume.info, grid_type=grid_type, background=background)
        with pytest.raises(InputError, match=f"of type {grid_type} is not scalar"):
            from_volume(SparseVolume(volume.nanovdb, info))

    def test_without_openvdb(self, monkeypatch):
        monkeypatch.setattr(_openvdb, "_load", lambda: (None, "not built"))
        with pytest.raises(MissingDependencyError, match="libopenvdb-dev"):
            from_volume(_grid(_ball), method="openvdb")


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int16])
def test_a_mask_without_an_isosurface_names_the_class_that_has_one(dtype: type) -> None:
    mask = np.zeros((6, 6, 6), dtype)
    mask[2:4, 2:4, 2:4] = 1
    with pytest.raises(gk.UnsupportedGridError, match=r'from_dense\(\.\.\., grid_class="fog volume"\)'):
        gk.mesh.from_volume(gk.volume.from_dense(mask, voxel_size=1.0), isovalue=0.5)
    fog = gk.volume.from_dense(mask, voxel_size=1.0, grid_class="fog volume")
    assert gk.mesh.audit(gk.mesh.from_volume(fog, isovalue=0.5)).signed_volume > 0.0


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("method", ["surface_nets", "marching_cubes", "dual_contouring", "openvdb"])
def test_what_has_no_end_is_outside_of_an_unknown_grid(method, mirrored):
    if method == "openvdb" and not native.available():
        pytest.skip("geokit was built without OpenVDB")
    transform = np.diag([-0.5 if mirrored else 0.5, 0.5, 0.5, 1.0])
    mask = np.zeros((12, 12, 12), np.float32)
    mask[2:9, 3:10, 1:7] = 1.0
    for values, background, isovalue in ((mask, 0.0, 0.5), (1.0 - mask, 1.0, 0.5), (200.0 * mask - 100.0, -100.0, 0.0)):
        grid = gk.volume.from_dense(values, transform=transform, background=background, grid_class="unknown")
        found = audit(from_volume(grid, isovalue=isovalue, method=method))
        assert found.watertight
        assert found.signed_volume == pytest.approx(7 * 7 * 6 / 8, rel=0.15)


@pytest.mark.parametrize("how", [{}, {"method": "marching_cubes"}, {"adaptivity": 0.5}, {"tolerance": 0.1}])
def test_a_mesh_without_faces_is_told_with_the_range(how):
    if "adaptivity" in how and not native.available():
        pytest.skip("needs OpenVDB")
    sdf = gk.volume.from_mesh(gk.mesh.box(), 0.1, device="cpu")
    with pytest.warns(
        UserWarning, match=r"grid 'box' has no surface at 99; its values are -0\.[23] to 0\.[234]"
    ) as told:
        mesh = gk.mesh.from_volume(sdf, isovalue=99.0, device="cpu", **how)
    assert (len(told), mesh.face_count) == (1, 0)


def test_a_grid_without_voxels_says_so():
    empty = gk.volume.from_dense(np.zeros((3, 3, 3), np.float32), name="fog")
    with pytest.warns(UserWarning, match="grid 'fog' has no surface at 1; it has no active voxel"):
        gk.mesh.from_volume(empty, isovalue=1.0, device="cpu")
