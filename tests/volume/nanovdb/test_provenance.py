"""What a volume's metadata says about where it came from, through every kind of file."""

from __future__ import annotations

import numpy as np
import pytest

import geokit
from benchmarks.catalog.sphere_volumes import sphere
from geokit import native
from geokit.volume import load, save
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.file import read
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.provenance import content_hash, provenance, with_error


def test_only_what_is_known_is_said():
    assert provenance() == {"geokit:version": geokit.__version__}
    assert provenance("bunny", "ab", np.float32(0.5), 1, 0) == {
        "geokit:source": "bunny",
        "geokit:source_sha256": "ab",
        "geokit:voxel_size": 0.5,
        "geokit:tolerance": 1.0,
        "geokit:achieved_error": 0.0,
        "geokit:version": geokit.__version__,
    }
    assert all(type(value) in (str, float) for value in provenance("a", "b", 1, 2, 3).values())


def test_errors_add_up():
    first = with_error({"mine": 1}, 0.5, 0.25)
    assert first == {"mine": 1, **provenance(None, None, None, 0.5, 0.25)}
    assert with_error(first, 0.5, 0.5)["geokit:achieved_error"] == 0.75
    assert with_error(first, 0.5, 0.5)["geokit:tolerance"] == 1.0
    # A step without a tolerance leaves the whole without one, also for steps to come.
    loose = with_error(first, None, 0.5)
    assert "geokit:tolerance" not in loose
    assert "geokit:tolerance" not in with_error(loose, 0.5, 0.0)


@pytest.mark.parametrize("odd", ["x", True, (1.0, 2.0), b"1"])
def test_odd_values_of_our_keys_are_no_errors(odd):
    assert with_error({"geokit:achieved_error": odd, "geokit:tolerance": odd}, 1.0, 0.5)["geokit:achieved_error"] == 0.5


def test_hash_is_that_of_the_content():
    values = np.arange(12.0).reshape(4, 3)
    assert content_hash(values) == content_hash(np.asfortranarray(values)) == content_hash(values[::1].astype(">f8"))
    others = [
        values.reshape(3, 4),
        values.astype(np.float32),
        values + 1e-16,
        values + 1e-15 * np.eye(4, 3),
        values[:3],
    ]
    hashes = [content_hash(other) for other in others]
    assert hashes[2] == content_hash(values + 1e-16)
    assert len({content_hash(values), hashes[0], hashes[1], hashes[3], hashes[4]}) == 5
    assert content_hash(values, values) != content_hash(values)
    assert len(content_hash()) == 64


def known_volume() -> SparseVolume:
    volume = sphere(6.0)
    return SparseVolume(volume.nanovdb, info_of(volume.nanovdb, provenance("sphere", "00ff", 0.1, 1e-3, 9.5e-4)))


def test_through_nvdb(tmp_path):
    save(tmp_path / "x.nvdb", known_volume())
    assert read(tmp_path / "x.nvdb")[0].metadata == known_volume().info.metadata


@pytest.mark.skipif(not native.available(), reason="the OpenVDB extension is not built")
def test_through_vdb(tmp_path):
    save(tmp_path / "x.vdb", known_volume())
    assert load(tmp_path / "x.vdb").info.metadata == known_volume().info.metadata
