"""Vertex attributes from volumes: their shapes, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.catalog.sphere_volumes import ROTATED, sphere
from benchmarks.catalog.typed_grids import TypedGrid
from geokit.errors import InputError, UnsupportedGridError
from geokit.mesh._io import load, save
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.volumes.attributes import sample_attributes
from geokit.mesh.volumes.from_volume import from_volume
from geokit.volume.at_points.sample import sample


def test_attributes_are_samples_at_the_vertices():
    body, other = sphere(6.0), sphere(9.0, transform=ROTATED)
    vectors = TypedGrid("vec3f").volume
    mesh = from_volume(body, device="cpu")
    found = sample_attributes(mesh, {"b": other, "a": body, "v": vectors}, device="cpu")
    assert list(found) == ["b", "a", "v"]
    np.testing.assert_array_equal(found["b"], sample(other, mesh.vertices, device="cpu"))
    assert found["v"].shape == (len(mesh.vertices), 3)
    # On the surface the level set is small: vertices are means of crossings.
    assert np.abs(found["a"]).max() < 0.05
    nearest = sample_attributes(mesh, {"a": body}, order=0, device="cpu")
    np.testing.assert_array_equal(nearest["a"], sample(body, mesh.vertices, order=0, device="cpu"))


@pytest.mark.slow
def test_attributes_are_ready_for_a_file(tmp_path):
    body = sphere(6.0)
    mesh = from_volume(body, device="cpu")
    save(tmp_path / "body.vtp", mesh, point_data=sample_attributes(mesh, {"distance": body}, device="cpu"))
    assert len(load(tmp_path / "body.vtp").vertices) == len(mesh.vertices)


def test_no_vertices_and_no_volumes():
    empty = TriangleMesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    assert sample_attributes(empty, {"a": sphere(6.0)}, device="cpu")["a"].shape == (0,)
    assert sample_attributes(empty, {}) == {}


@pytest.mark.parametrize("name", ["", 3, None])
def test_names(name):
    with pytest.raises(InputError, match="is not a text"):
        sample_attributes(from_volume(sphere(6.0), device="cpu"), {name: sphere(6.0)})


def test_values():
    with pytest.raises(InputError, match=r"'a'.*: ndarray is not a SparseVolume"):
        sample_attributes(from_volume(sphere(6.0), device="cpu"), {"a": np.zeros(3)})


def test_order():
    with pytest.raises(InputError, match="order"):
        sample_attributes(from_volume(sphere(6.0), device="cpu"), {"a": sphere(6.0)}, order=7)


def test_grids_without_values():
    import dataclasses

    body = sphere(6.0)
    index = dataclasses.replace(body, info=dataclasses.replace(body.info, grid_type="onindex"))
    with pytest.raises(UnsupportedGridError, match="onindex"):
        sample_attributes(from_volume(body, device="cpu"), {"a": index}, device="cpu")
