"""What a user's type checker sees: every public name of the lazy packages, and the types of answers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import geokit
from tests.support.effort import of_all

PACKAGES = ("mesh", "volume", "points", "render", "threads", "accuracy", "errors")
ANSWERS = {
    "gk.mesh.load('a.ply')": "TriangleMesh",
    "gk.mesh.Surface(mesh).sign_method": "str",
    "gk.mesh.Surface(mesh).closest_point(rows)": "ClosestPoints",
    "gk.volume.from_mesh(mesh, 0.1).info": "GridInfo",
    "gk.points.NeighborGrid(rows, 0.1).knn(rows, 3)": "KNearest",
    "gk.mesh.Surface(mesh).closest_point(rows).points[0] * 2.0 - 1.0": "Array",
    "gk.volume.from_mesh(mesh, 0.1).sample(rows).shape": "tuple[",
    "len(gk.mesh.Surface(mesh).contains(rows))": "int",
}

# Packages that come with extras have four times as many files as all others. Their types are in no answer.
SETTINGS = """\
[mypy]
[mypy-torch.*,jax.*,jaxlib.*,IPython.*,distributed.*,dask.*,matplotlib.*]
follow_imports = skip
"""

pytestmark = pytest.mark.slow


def script() -> str:
    lines = ["import numpy as np", "import geokit as gk", "rows = np.zeros((4, 3))", "mesh = gk.mesh.load('a.ply')"]
    lines += [f"print(gk.{package}.{name})" for package in PACKAGES for name in getattr(geokit, package).__all__]
    lines += [f"print(gk.{name})" for name in geokit.__all__]
    lines += [f"reveal_type({call})" for call in ANSWERS]
    return "\n".join(lines) + "\n"


def check(checker: str, code: str, folder: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    file = folder / "user.py"
    file.write_text(code)
    (folder / "mypy.ini").write_text(SETTINGS)
    command = {
        "mypy": [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(cache)],
        "pyright": [sys.executable, "-m", "pyright", "--pythonpath", sys.executable],
    }[checker]
    # Outside the checkout, as a user's: its settings must not help.
    return subprocess.run([*command, str(file)], capture_output=True, text=True, cwd=folder, timeout=600)


@pytest.fixture(scope="module", params=of_all(["mypy"], ["mypy", "pyright"]))
def checker(request):
    pytest.importorskip(request.param)
    if request.param == "pyright":
        # The package brings a starter; the checker itself comes from npm with its first run.
        found = subprocess.run([sys.executable, "-m", "pyright", "--version"], capture_output=True, text=True)
        if found.returncode:
            pytest.skip(f"pyright does not start: {found.stderr.strip()[-200:]}")
    return request.param


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """What mypy keeps of geokit and NumPy: they are checked once for all tests."""
    return tmp_path_factory.mktemp("mypy")


def test_public_names_and_their_types_are_seen(checker, cache, tmp_path):
    run = check(checker, script(), tmp_path, cache)
    assert run.returncode == 0, run.stdout + run.stderr
    for call, kind in ANSWERS.items():
        line = script().splitlines().index(f"reveal_type({call})") + 1
        (seen,) = [row for row in run.stdout.splitlines() if f"user.py:{line}:" in row]
        assert kind in seen


OBJECTS = """
import numpy as np
import geokit as gk
from typing import Any

class Trimesh:
    @property
    def vertices(self) -> np.ndarray[Any, Any]:
        return np.zeros(3)
    @property
    def faces(self) -> np.ndarray[Any, Any]:
        return np.zeros(3)

class Open3D:
    vertices: list[Any]
    triangles: list[Any]

class Tensors:
    vertex: dict[str, Any]
    triangle: dict[str, Any]

class PyVista:
    @property
    def points(self) -> np.ndarray[Any, Any]:
        return np.zeros(3)
    faces: np.ndarray[Any, Any]

class Meshio:
    points: np.ndarray[Any, Any]
    cells: list[Any]

class Scene:
    geometry: dict[str, Any]

rows = np.zeros((4, 3))
"""
USE = """
thing = {made}
gk.mesh.Surface(thing).closest_point(rows)
gk.mesh.save("a.ply", thing)
gk.mesh.union(gk.mesh.simplify(thing, tolerance=0.1).mesh, thing)
gk.volume.from_mesh(thing, 0.1)
gk.points.sample(thing, 10)
gk.render.figure("a.png", mesh=thing)
"""


def test_meshes_of_other_libraries_go_in(checker, cache, tmp_path):
    """As docs/interop.md lists them, by their attributes."""
    kinds = ("Trimesh()", "Open3D()", "Tensors()", "PyVista()", "Meshio()", "Scene()", "(rows, [[0, 1, 2]])")
    use = [USE.replace("thing", f"thing{number}").format(made=made) for number, made in enumerate(kinds)]
    run = check(checker, OBJECTS + "".join(use), tmp_path, cache)
    assert run.returncode == 0, run.stdout + run.stderr
    wrong = ["gk.mesh.audit('a.ply')", "gk.mesh.Surface(3)", "gk.mesh.simplify(rows, tolerance=0.1)"]
    run = check(checker, OBJECTS + "\n".join(wrong) + "\n", tmp_path, cache)
    assert run.returncode == 1
    assert run.stdout.count("user.py:") >= len(wrong)


ROWS = """
from typing import Any
import geokit as gk

class TorchDevice:
    type: str
    index: int

class CupyDevice:
    id: int

class Tensor:
    def __dlpack__(self, *, stream: int | None = None) -> Any: ...

class OnGpu:
    __cuda_array_interface__: dict[str, Any]

class Cloud:
    points: list[list[float]]

mesh, volume = gk.mesh.box(), gk.volume.from_mesh(gk.mesh.box(), 0.1, device=CupyDevice())
surface = gk.mesh.Surface(mesh, device=TorchDevice())
for rows in (Tensor(), OnGpu(), Cloud(), [[0.0, 0.0, 0.0]]):
    surface.closest_point(rows)
    volume.sample(rows, device=["cuda:0", "cuda:1"])
    gk.points.NeighborGrid(rows, 0.1, device="cuda:*").knn(rows, 3)
surface.raycast(Tensor(), (0.0, 0.0, 1.0))
"""


def test_rows_and_devices_of_other_libraries_go_in(checker, cache, tmp_path):
    run = check(checker, ROWS, tmp_path, cache)
    assert run.returncode == 0, run.stdout + run.stderr
    wrong = ["surface.closest_point(object())", "gk.mesh.Surface(mesh, device=3)", "gk.mesh.simplify(mesh, device=[])"]
    run = check(checker, ROWS + "\n".join(wrong) + "\n", tmp_path, cache)
    assert run.returncode == 1
    assert run.stdout.count("user.py:") >= len(wrong)


ANSWERED = """
import numpy as np
import geokit as gk

rows = np.zeros((4, 3))
surface = gk.mesh.Surface(gk.mesh.box())
found = surface.signed_distance(rows)
print(float(found.distance[0]), np.linalg.norm(found.points - rows, axis=1), rows[found.distance > 0.0])
print(found.distance.square().sum().backward(), abs(1.0 - found.distance).max(), [row for row in found.points])
surface.closest_point(found.points)
gk.points.PointCloud(np.asarray(found.points), {"distance": np.asarray(found.distance)})
"""


def test_answers_are_arrays_of_any_library_and_nothing_else(checker, cache, tmp_path):
    run = check(checker, ANSWERED, tmp_path, cache)
    assert run.returncode == 0, run.stdout + run.stderr
    wrong = ["gk.volume.from_mesh(gk.mesh.box(), found.distance)", "gk.mesh.audit(found.points)"]
    wrong += ["gk.mesh.load(found.distance)", "found.distance()", "found.distance.shape.x", "found.nearest"]
    run = check(checker, ANSWERED + "\n".join(wrong) + "\n", tmp_path, cache)
    assert run.returncode == 1
    assert run.stdout.count("user.py:") >= len(wrong)


def test_a_name_that_is_not_there_is_an_error(checker, cache, tmp_path):
    run = check(checker, "import geokit as gk\nprint(gk.mesh.Surfacing)\nprint(gk.volumes)\n", tmp_path, cache)
    assert run.returncode == 1
    assert "Surfacing" in run.stdout
    assert "volumes" in run.stdout


def test_the_marker_of_typed_packages_ships():
    assert (Path(geokit.__file__).parent / "py.typed").is_file()
