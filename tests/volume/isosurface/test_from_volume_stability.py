"""Isosurfaces where they fail first: edges, thin bodies, bodies that touch, scales, values at the end of the band."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from benchmarks.catalog.float_grids import build_float_grid
from geokit.mesh._audit import audit
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.surface import Surface
from geokit.mesh.volumes.from_volume import from_volume
from geokit.volume.distance_fields.from_mesh import from_mesh
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

pytestmark = pytest.mark.filterwarnings("ignore:.*has no surface at:UserWarning")

METHODS = ["surface_nets", "marching_cubes", "dual_contouring"]
HALF_WIDTH = 3.0
# Half the edge of the cube [voxels], off the grid.
CUBE = 16.3
# Float32 rounds distances of up to three voxels by 2e-7; planes that meet at a corner add some of that up.
EXACT = 2e-6


def turned(first, second):
    c, s, e, f = np.cos(first), np.sin(first), np.cos(second), np.sin(second)
    return np.array([[1, 0, 0], [0, e, -f], [0, f, e]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


TURNS = {"square": (0.0, 0.0), "turned": (0.4, 0.7), "otherwise": (0.2, 1.1)}
MIDDLE = np.array([0.13, 0.27, 0.41])


def cube_distance(points, turn):
    """Exact signed distance from a cube, in float64."""
    q = np.abs((points - MIDDLE) @ turn) - CUBE
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=-1)
    return outside + np.minimum(q.max(axis=-1), 0.0)


def level_set(distance, reach, voxel_size=1.0):
    """A level set of ``distance(points)`` [voxels], whose surface lies within ``reach`` voxels of the origin."""
    count = int(reach + HALF_WIDTH) // 8 + 1
    blocks = np.array(list(np.ndindex(*3 * [2 * count]))) - count
    values = distance((8 * blocks[:, None] + np.array(list(np.ndindex(8, 8, 8)))).astype(float))
    near = (np.abs(values) < HALF_WIDTH).any(axis=1)
    buffer = build_float_grid(
        (8 * blocks[near]).astype(np.int32),
        (np.clip(values[near], -HALF_WIDTH, HALF_WIDTH) * voxel_size).astype(np.float32),
        np.abs(values[near]) < HALF_WIDTH,
        background=HALF_WIDTH * voxel_size,
        transform=np.diag([voxel_size] * 3 + [1.0]),
        name="body",
        grid_class="level set",
        signed_fill=True,
    )
    return SparseVolume(buffer, info_of(buffer))


def cube(turn):
    return level_set(lambda points: cube_distance(points, turn), 1.8 * CUBE)


def edge_points(turn):
    """Points on the twelve edges of the cube, a tenth of a voxel apart."""
    corners = (np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0) * CUBE
    along = np.linspace(0, 1, 330)[:, None]
    pairs = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
    return np.concatenate([corners[a] * (1 - along) + corners[b] * along for a, b in pairs]) @ turn.T + MIDDLE


class TestEdges:
    """What docs/design/isosurfaces.md promises of edges and corners."""

    @pytest.mark.slow
    @pytest.mark.parametrize("name", TURNS)
    @pytest.mark.parametrize(
        ("method", "largest", "rms"),
        [("surface_nets", 1.05, 0.5), ("marching_cubes", 1.05, 0.45), ("dual_contouring", 0.75, 0.1)],
    )
    def test_distance_of_a_cubes_edges_from_the_mesh(self, name, method, largest, rms):
        turn = turned(*TURNS[name])
        mesh = from_volume(cube(turn), method=method, device="cpu")
        off = Surface(mesh, device="cpu").closest_point(edge_points(turn)).distance
        assert off.max() < largest
        assert np.sqrt((off**2).mean()) < rms
        assert audit(mesh).watertight
        assert audit(mesh).manifold

    def test_dual_contouring_of_a_cube_square_to_the_grid_is_exact(self):
        turn = np.eye(3)
        mesh = from_volume(cube(turn), method="dual_contouring", device="cpu")
        assert np.abs(cube_distance(mesh.vertices, turn)).max() < EXACT
        assert Surface(mesh, device="cpu").closest_point(edge_points(turn)).distance.max() < EXACT
        assert abs(audit(mesh).signed_volume / (2 * CUBE) ** 3 - 1) < 1e-6

    @pytest.mark.parametrize("name", ["turned", "otherwise"])
    def test_dual_contouring_puts_most_vertices_of_a_turned_cube_onto_it(self, name):
        turn = turned(*TURNS[name])
        mesh = from_volume(cube(turn), method="dual_contouring", device="cpu")
        off = np.abs(cube_distance(mesh.vertices, turn))
        assert np.quantile(off, 0.9) < 1e-4
        assert off.max() < 0.5


CLOSED = {
    "tetrahedron": (mesh_catalog.tetrahedron, 2),
    "box": (mesh_catalog.box, 2),
    "icosphere": (mesh_catalog.icosphere, 2),
    "torus": (mesh_catalog.torus, 0),
    "l_profile": (mesh_catalog.l_profile, 2),
    "nested_boxes": (mesh_catalog.nested_boxes, 4),
}


class TestLevelSetsOfMeshes:
    @pytest.mark.slow
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("name", CLOSED)
    def test_topology(self, name, method):
        make, euler_number = CLOSED[name]
        mesh = make()
        volume = from_mesh(mesh, mesh.diagonal / 60, device="cpu")
        report = audit(from_volume(volume, method=method, device="cpu"))
        assert report.watertight
        assert report.manifold
        assert report.oriented
        assert report.euler_number == euler_number
        assert report.signed_volume > 0.0

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("make", [mesh_catalog.two_boxes_touching_at_a_vertex, mesh_catalog.overlapping_spheres])
    def test_bodies_that_touch_or_overlap(self, make, method):
        mesh = make()
        report = audit(from_volume(from_mesh(mesh, mesh.diagonal / 47, device="cpu"), method=method, device="cpu"))
        assert report.watertight
        assert report.manifold
        assert report.oriented

    @pytest.mark.slow
    @pytest.mark.parametrize("method", METHODS)
    def test_coarse_to_fine(self, method):
        mesh = mesh_catalog.torus()
        for count in (6, 9, 14, 21, 40):
            report = audit(
                from_volume(from_mesh(mesh, mesh.diagonal / count, device="cpu"), method=method, device="cpu")
            )
            assert report.watertight
            assert report.manifold
            # Below two voxels across, the tube is broken into pieces or lost.
            if count >= 21:
                assert report.euler_number == 0

    @pytest.mark.parametrize("method", METHODS)
    def test_an_open_shell_gives_a_manifold_mesh(self, method):
        mesh = mesh_catalog.open_shell()
        report = audit(from_volume(from_mesh(mesh, mesh.diagonal / 40, device="cpu"), method=method, device="cpu"))
        assert report.non_manifold_edge_count == 0
        assert report.oriented or report.boundary_edge_count > 0


class TestScalesAndValues:
    @pytest.mark.slow
    @pytest.mark.parametrize("method", METHODS)
    def test_voxel_sizes(self, method):
        turn = turned(*TURNS["turned"])
        meshes = []
        for size in (2.0**-20, 1.0, 2.0**20):
            volume = level_set(lambda p: cube_distance(p, turn), 1.8 * CUBE, voxel_size=size)
            meshes.append(from_volume(volume, method=method, device="cpu").vertices / size)
        # Powers of two change no digit of the values, nor of the vertices.
        np.testing.assert_allclose(meshes[0], meshes[1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(meshes[2], meshes[1], rtol=0, atol=1e-9)

    @pytest.mark.slow
    @pytest.mark.parametrize("method", METHODS)
    def test_isovalues_through_the_band(self, method):
        volume = level_set(lambda p: np.linalg.norm(p, axis=-1) - 12.3, 13)
        before = 0.0
        for isovalue in (-3.0, -2.999, -2.0, -1.0, -0.1, -1e-6, 0.0, 1e-30, 1.0, 2.5, 2.999):
            report = audit(from_volume(volume, isovalue=isovalue, method=method, device="cpu"))
            if isovalue == -3.0:  # voxels outside are not below the isovalue, and none inside is either
                assert report.face_count == 0
                continue
            assert report.watertight
            assert report.manifold
            assert report.euler_number == 2
            assert report.signed_volume >= before
            before = report.signed_volume
        # At the background, what lies beyond the band counts as outside.
        assert audit(from_volume(volume, isovalue=3.0, method=method, device="cpu")).watertight

    @pytest.mark.slow
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("thickness", [1.7, 1.0, 0.6, 0.2])
    def test_thin_plates(self, method, thickness):
        # Thinner than a voxel, a plate is what the voxels that happen to lie in it say: pieces, but sound ones.
        def distance(p):
            q = np.abs(p - MIDDLE) - np.array([12.0, 12.0, thickness / 2])
            return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)

        mesh = from_volume(level_set(distance, 14), method=method, device="cpu")
        if len(mesh.faces):
            assert audit(mesh).watertight
            assert audit(mesh).manifold
        else:
            assert thickness < 1.0

    def test_empty_bodies_are_a_mesh_without_faces(self):
        volume = level_set(lambda p: np.linalg.norm(p - 0.5, axis=-1) - 0.1, 1)
        mesh = from_volume(volume, method="surface_nets", device="cpu")
        assert isinstance(mesh, TriangleMesh)
        assert len(mesh.faces) == 0
