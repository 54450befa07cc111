"""Caches of meshes and volumes: made once, shared by threads, cleared on request, freed with their object."""

from __future__ import annotations

import copy
import dataclasses
import gc
import pickle
import re
import weakref
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

import geokit
from benchmarks.catalog import mesh_catalog
from benchmarks.catalog.sphere_volumes import sphere
from geokit.core.base.object_cache import ObjectCache


class Result:
    """Something that can be referred to weakly."""


def test_a_value_is_computed_once():
    cache, made = ObjectCache(), []

    def make():
        made.append(Result())
        return made[-1]

    assert cache.find("a", make) is cache.find("a", make) is made[0]
    assert cache.find("b", make) is made[1]
    assert len(made) == 2
    assert "a" in cache
    assert "c" not in cache


def test_none_is_a_value():
    cache = ObjectCache()
    assert cache.find("a", lambda: None) is None
    assert cache.find("a", lambda: 1) is None


def test_nothing_is_kept_of_a_failure():
    cache = ObjectCache()

    def fail():
        raise KeyError("no")

    with pytest.raises(KeyError, match="no"):
        cache.find("a", fail)
    assert cache.find("a", lambda: 3) == 3


def test_cleared_values_are_computed_again():
    cache = ObjectCache()
    cache.keep("a", 1)
    cache.clear()
    assert "a" not in cache
    assert cache.find("a", lambda: 2) == 2


def test_threads_get_one_value():
    cache = ObjectCache()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: cache.find("a", Result), range(2000)))
    assert len(set(map(id, found))) == 1


@pytest.mark.parametrize("make", [mesh_catalog.box, lambda: sphere(3.0)], ids=["mesh", "volume"])
def test_each_object_has_a_cache_that_goes_with_it(make):
    one, other = make(), make()
    with ThreadPoolExecutor(8) as pool:
        caches = set(map(id, pool.map(attrgetter("_cache"), [one] * 500)))
    assert caches == {id(one._cache)}
    assert one._cache is not other._cache
    kept = weakref.ref(one._cache.find("result", Result))
    gc.disable()
    try:
        assert kept() is not None
        del one
        assert kept() is None  # at once: nothing else holds it, and no cycle does
    finally:
        gc.enable()


@pytest.mark.parametrize("make", [mesh_catalog.box, lambda: sphere(3.0)], ids=["mesh", "volume"])
def test_copies_with_other_fields_and_pickles_begin_empty(make):
    one = make()
    if hasattr(one, "info"):  # a mapping proxy cannot be pickled
        one = dataclasses.replace(one, info=dataclasses.replace(one.info, metadata={}))
    one._cache.keep("result", 1)
    field = {"info": one.info} if hasattr(one, "info") else {"name": "other"}
    for other in (dataclasses.replace(one, **field), pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
        assert "result" not in other._cache
    assert "result" in one._cache


def test_what_a_field_asks_of_a_mesh_is_kept_with_the_mesh():
    mesh = mesh_catalog.box()
    geokit.volume.from_mesh(mesh, 0.2, device="cpu")
    names = ("content hash", "pieces", "area in its frame")
    assert all(name in mesh._cache for name in names)
    first = geokit.volume.from_mesh(mesh, 0.2, device="cpu")
    mesh._cache.clear()
    again = geokit.volume.from_mesh(mesh, 0.2, device="cpu")
    np.testing.assert_array_equal(first.nanovdb, again.nanovdb)
    assert dict(first.info.metadata) == dict(again.info.metadata)


def test_no_module_hides_attributes_of_objects_elsewhere():
    files = Path(geokit.__file__).parent.rglob("*.py")
    found = [str(path) for path in files if re.search(r"WeakKeyDictionary", path.read_text())]
    assert not found, f"keep these with their objects, see core/base/object_cache.py: {found}"
