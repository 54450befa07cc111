"""Prepared objects as pickles and deep copies: what arrives answers as what was sent."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support.devices import DEVICES

POINTS = np.random.default_rng(5).uniform(-1.2, 1.2, (3000, 3))


def by_pickle(thing):
    return pickle.loads(pickle.dumps(thing))


def out_of_band(thing):
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(thing, protocol=5, buffer_callback=buffers.append)
    return pickle.loads(text, buffers=[bytes(buffer.raw()) for buffer in buffers])


WAYS = pytest.mark.parametrize("send", [by_pickle, out_of_band, copy.deepcopy, copy.copy])


@WAYS
@pytest.mark.parametrize("device", DEVICES)
def test_surface(send, device):
    surface = gk.mesh.Surface(mesh_catalog.torus(), device=device)
    surface.update(surface.mesh.vertices * [1.0, 1.1, 0.9])
    arrived = send(surface)
    assert arrived.device == surface.device
    for one, other in zip(arrived.signed_distance(POINTS), surface.signed_distance(POINTS), strict=True):
        np.testing.assert_array_equal(one, other)
    # Neither holds memory of the other.
    del surface
    arrived.update(arrived.mesh.vertices + 1.0)


@WAYS
@pytest.mark.parametrize("device", DEVICES)
def test_volume(send, device):
    volume = gk.volume.from_mesh(mesh_catalog.torus(), voxel_size=0.1, device=device)
    arrived = send(volume)
    np.testing.assert_array_equal(arrived.nanovdb, volume.nanovdb)
    assert dict(arrived.info.metadata) == dict(volume.info.metadata)
    assert arrived.info.grid_class == "level set"
    np.testing.assert_array_equal(arrived.info.transform, volume.info.transform)
    np.testing.assert_array_equal(arrived.sample(POINTS, device=device), volume.sample(POINTS, device=device))
    with pytest.raises(TypeError):
        arrived.info.metadata["new"] = 1


@WAYS
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("radius", [None, 0.2])
@pytest.mark.parametrize("skin", [None, 0.05])
def test_neighbor_grid(send, device, dtype, radius, skin):
    grid = gk.points.NeighborGrid(POINTS.astype(dtype), radius, skin=skin, device=device)
    grid.update(POINTS[::-1].astype(dtype))
    arrived = send(grid)
    assert repr(arrived) == repr(grid)
    for one, other in zip(arrived.radius_search(), grid.radius_search(), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.fixture(scope="module")
def field():
    return gk.volume.adaptive_from_mesh(mesh_catalog.torus(), tolerance=0.02)


@pytest.mark.slow
@WAYS
def test_adaptive_field(send, field):
    expected = field.sample(POINTS, device="cpu")
    arrived = send(field)
    assert arrived.tolerance == field.tolerance
    np.testing.assert_array_equal(arrived.sample(POINTS, device="cpu"), expected)


@WAYS
def test_mesh_and_cloud(send):
    mesh = mesh_catalog.torus()
    np.testing.assert_array_equal(send(mesh).vertices, mesh.vertices)
    cloud = gk.points.PointCloud(POINTS)
    np.testing.assert_array_equal(send(cloud).points, cloud.points)


def test_a_damaged_pickle_is_refused_when_it_is_first_used():
    volume = gk.volume.from_mesh(mesh_catalog.torus(), voxel_size=0.1, device="cpu")
    text = bytearray(pickle.dumps(volume))
    at = text.find(volume.nanovdb[:8].tobytes())
    text[at : at + 8] = b"\0" * 8
    with pytest.raises(gk.errors.GeokitError):
        pickle.loads(bytes(text)).sample(POINTS, device="cpu")
