"""Examples in docstrings run, and what public functions promise is written down in the house's form."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import geokit
from geokit import native

ROOT = Path(__file__).resolve().parents[2]
WITH_EXAMPLES = sorted(path for path in (ROOT / "geokit").rglob("*.py") if ">>>" in path.read_text(encoding="utf-8"))
OF_JAX = [path for path in WITH_EXAMPLES if path.is_relative_to(ROOT / "geokit" / "jax")]
DOORS = (geokit.mesh, geokit.volume, geokit.points, geokit.render, geokit.accuracy)
PUBLIC = [
    pytest.param(getattr(namespace, name), id=f"{namespace.__name__}.{name}")
    for namespace in DOORS
    for name in namespace.__all__
]


def test_there_are_examples():
    assert len(WITH_EXAMPLES) >= 3


def _examples(paths: list[Path]) -> None:
    for path in paths:
        module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        failed, tried = doctest.testmod(module, extraglobs={"gk": geokit, "geokit": geokit})
        assert tried > 0
        assert failed == 0


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(set(WITH_EXAMPLES) - set(OF_JAX)), ids=lambda path: path.stem)
def test_examples_run(path, monkeypatch, tmp_path):
    # Some read data/samples, some write beside it.
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    _examples([path])


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("jax") is None, reason="needs jax")
def test_examples_of_jax_run():
    # In a process of their own: jax starts threads, which forks of other tests must not meet.
    assert OF_JAX
    script = "from tests.house import test_docstrings as t; t._examples(t.OF_JAX)"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


@pytest.mark.parametrize("thing", PUBLIC)
def test_public_names_are_documented(thing):
    text = inspect.getdoc(thing) or ""
    assert text
    if inspect.isfunction(thing):
        assert "Raises:" in text or not _raises(thing), f"{thing.__name__} does not say what it raises"
        missing = [name for name in inspect.signature(thing).parameters if f"{name}:" not in text]
        assert not missing, f"{thing.__name__} does not describe {missing}"


RECORDS = [
    pytest.param(kind, id=f"{namespace.__name__}.{name}")
    for namespace in (*DOORS, native)
    for name in namespace.__all__
    if inspect.isclass(kind := getattr(namespace, name))
    and (hasattr(kind, "_fields") or dataclasses.is_dataclass(kind))
]


@pytest.mark.parametrize("kind", RECORDS)
def test_records_name_their_fields(kind):
    first, *_ = text = (inspect.getdoc(kind) or "").splitlines()
    fields = getattr(kind, "_fields", None) or [field.name for field in dataclasses.fields(kind)]
    assert not re.match(rf"({'|'.join(fields)})\b.*\(", first), f"{kind.__name__} says no more than its fields"
    found = {name for line in text if (named := re.match(r"    ([\w, ]+): ", line)) for name in named[1].split(", ")}
    missing = [name for name in fields if name not in found and not name.startswith("_")]
    assert not missing, f"{kind.__name__} does not describe {missing}"


@pytest.mark.parametrize("door", [geokit.mesh, geokit.volume, geokit.points, native], ids=lambda door: door.__name__)
def test_doors_list_their_names_in_a_stub(door):
    stub = Path(door.__file__).with_name("__init__.pyi").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\b(\w+) as \1\b", stub)) == sorted(door.__all__)
    page = (ROOT / "docs" / "api" / f"{door.__name__.removeprefix('geokit.')}.md").read_text(encoding="utf-8")
    assert "__init__.pyi)" in page


def test_methods_say_what_they_do():
    for kind in {getattr(namespace, name) for namespace in DOORS for name in namespace.__all__}:
        for name, method in vars(kind).items() if inspect.isclass(kind) else ():
            if not name.startswith("_") and inspect.isfunction(method):
                assert not (inspect.getdoc(method) or "").startswith("See "), f"{kind.__name__}.{name}"


@pytest.mark.parametrize("thing", PUBLIC)
def test_no_argument_is_without_effect(thing):
    assert "no effect" not in (inspect.getdoc(thing) or "")


def test_the_table_of_what_tests_hold_is_true():
    table = (ROOT / "docs" / "held-by.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w.]+)` \| (.+) \|$", table, re.MULTILINE)
    assert len(rows) > 100
    names = [name for name, _ in rows]
    assert names == sorted(names), "rows are in the order of their names"
    for name, files in rows:
        for file in re.findall(r"`([^`]+)`", files):
            assert (ROOT / file).exists(), f"{name}: {file}"


def test_docstrings_do_not_name_their_tests():
    for path in (ROOT / "geokit").rglob("*.py"):
        assert "Held by" not in path.read_text(encoding="utf-8"), f"{path}: give it a row in docs/held-by.md"


def _raises(function) -> bool:
    return "raise " in inspect.getsource(function)
