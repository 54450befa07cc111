"""Isosurfaces: place, winding, splitting of quads, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from geokit import native
from geokit.errors import InputError, MissingDependencyError, UnsupportedGridError
from geokit.mesh.from_volume import _split_quads, from_volume
from geokit.volume._build import build_float_grid
from geokit.volume._nanovdb import info_of
from geokit.volume.model import SparseVolume

needs_openvdb = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")

CENTRE = np.array([0.31, -0.17, 0.23])


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


def _ball(points):
    return np.linalg.norm(points - CENTRE, axis=1) - 1.0


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


@needs_openvdb
class TestBall:
    def test_closed_outward_and_named(self):
        mesh = from_volume(_grid(_ball, transform=_around(0.125)))
        assert mesh.name == "ball"
        assert _edges_meet_in_opposite_pairs(mesh)
        # An inscribed polyhedron of cells of h lacks about h^2 of the volume, and is never larger.
        assert 0.98 < _signed_volume(mesh) / (4 / 3 * np.pi) < 1.0

    def test_vertices_converge_at_second_order(self):
        errors = []
        for count in (16, 32, 64):
            mesh = from_volume(_grid(_ball, count, _around(4.0 / count)))
            errors.append(np.abs(_ball(mesh.vertices)).max())
        assert errors[0] < 0.25**2
        assert 3.0 < errors[0] / errors[1] < 5.5
        assert 3.0 < errors[1] / errors[2] < 5.5

    @pytest.mark.parametrize("isovalue", [-0.5, 0.25])
    def test_isovalue_is_an_offset_of_the_radius(self, isovalue):
        mesh = from_volume(_grid(_ball, transform=_around(0.125)), isovalue=isovalue)
        radius = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
        assert np.abs(radius - (1.0 + isovalue)).max() < 0.125**2

    @pytest.mark.parametrize(
        "linear",
        [
            [[0.2, 0.05, 0.0], [0.0, 0.1, 0.03], [0.02, 0.0, 0.15]],
            [[-0.15, 0.0, 0.0], [0.0, 0.15, 0.0], [0.0, 0.0, 0.15]],
        ],
        ids=["sheared", "mirrored"],
    )
    def test_normals_point_to_increasing_values_under_any_transform(self, linear):
        transform = np.eye(4)
        transform[:3, :3] = linear
        transform[:3, 3] = CENTRE - transform[:3, :3] @ [15.5, 15.5, 15.5]
        mesh = from_volume(_grid(_ball, transform=transform))
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = np.einsum("ij,ij->i", normals, corners.mean(axis=1) - CENTRE)
        assert (outward > 0).all()
        assert _edges_meet_in_opposite_pairs(mesh)

    @pytest.mark.parametrize("grid_class", ["level set", "unknown"])
    def test_faces_turn_to_increasing_values_whatever_the_class(self, grid_class):
        volume = _grid(_ball, transform=_around(0.125), grid_class=grid_class)
        before = volume.nanovdb.copy()
        assert _signed_volume(from_volume(volume)) > 4.0
        np.testing.assert_array_equal(volume.nanovdb, before)

    def test_fog_is_a_body_of_greater_values(self):
        volume = _grid(lambda p: -_ball(p), transform=_around(0.125), background=0.0, grid_class="fog volume")
        assert _signed_volume(from_volume(volume, isovalue=0.125)) > 0.9 * 4 / 3 * np.pi * 0.875**3

    def test_far_from_the_origin(self):
        far = _around(0.125)
        far[:3, 3] += 1e6
        near = from_volume(_grid(_ball, transform=_around(0.125)))
        mesh = from_volume(_grid(lambda p: _ball(p - 1e6), transform=far))
        # The field is made from points near 1e6, whose rounding is 1e-10; the voxels are float32.
        assert mesh.vertices.shape == near.vertices.shape
        assert np.abs(mesh.vertices - 1e6 - near.vertices).max() < 1e-6

    def test_adaptivity_merges_faces_and_keeps_the_surface(self):
        volume = _grid(_ball, 64, _around(0.0625))
        full, merged = from_volume(volume), from_volume(volume, adaptivity=0.5)
        assert len(merged.faces) < 0.5 * len(full.faces)
        assert np.abs(_ball(merged.vertices)).max() < 0.1
        assert _edges_meet_in_opposite_pairs(merged)

    @pytest.mark.parametrize("isovalue", [50.0, -50.0])
    def test_value_that_is_never_taken_gives_an_empty_mesh(self, isovalue):
        mesh = from_volume(_grid(_ball, transform=_around(0.125)), isovalue=isovalue)
        assert mesh.vertices.shape == (0, 3)
        assert mesh.faces.shape == (0, 3)
        assert mesh.name == "ball"

    def test_integers_have_no_isosurface(self):
        volume = _grid(_ball)
        buffer = volume.nanovdb.copy()
        buffer[636] = 4  # the type's place in the header, and NanoVDB's int32
        with pytest.raises(UnsupportedGridError):
            from_volume(SparseVolume(buffer, info_of(buffer)))


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
    @pytest.mark.parametrize("isovalue", [np.nan, np.inf, -np.inf, "high", None])
    def test_isovalue(self, isovalue):
        with pytest.raises(InputError, match="isovalue"):
            from_volume(_grid(_ball), isovalue=isovalue)

    @pytest.mark.parametrize("adaptivity", [-0.1, 1.1, np.nan, "much"])
    def test_adaptivity(self, adaptivity):
        with pytest.raises(InputError, match="adaptivity"):
            from_volume(_grid(_ball), adaptivity=adaptivity)

    @pytest.mark.parametrize(
        ("grid_type", "background"), [("vec3f", (0.0, 0.0, 0.0)), ("rgba8", (0, 0, 0, 0)), ("onindex", 0)]
    )
    def test_grids_that_are_not_scalar(self, grid_type, background):
        volume = _grid(_ball)
        info = dataclasses.replace(volume.info, grid_type=grid_type, background=background)
        with pytest.raises(InputError, match=f"of type {grid_type} is not scalar"):
            from_volume(SparseVolume(volume.nanovdb, info))

    def test_without_openvdb(self, monkeypatch):
        monkeypatch.setattr(native, "_load", lambda: (None, "not built"))
        with pytest.raises(MissingDependencyError, match="libopenvdb-dev"):
            from_volume(_grid(_ball))
