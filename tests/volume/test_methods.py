"""Methods of a volume that forward to verbs take what these take."""

from __future__ import annotations

import inspect

import pytest

import geokit as gk

METHODS = {
    name: method
    for name, method in inspect.getmembers(gk.volume.SparseVolume, inspect.isfunction)
    if f":func:`geokit.volume.{name}`" in (method.__doc__ or "")
}


def test_there_are_such_methods() -> None:
    assert {"sample", "gradient", "raycast", "to_dense"} <= METHODS.keys()


@pytest.mark.parametrize("name", METHODS)
def test_arguments_are_those_of_the_verb(name: str) -> None:
    own, verb = (inspect.signature(function) for function in (METHODS[name], getattr(gk.volume, name)))
    assert list(own.parameters.values())[1:] == list(verb.parameters.values())[1:]
    assert own.return_annotation == verb.return_annotation
