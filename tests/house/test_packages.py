"""Packages besides NumPy and warp: each comes with geokit or with an extra of it, and errors name what mends it."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import geokit as gk
from geokit import native
from geokit._packages import DISTRIBUTION, PACKAGES, remedy, require_package
from geokit.formats.table import FORMATS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
BASE = {re.split(r"[<>=\[; ]", line)[0] for line in PROJECT["dependencies"]}
EXTRAS = PROJECT["optional-dependencies"]
# Of developers, not of users.
INTERNAL = {"test", "test-torch", "dev", "docs", "bench"}
# No file formats, so not in "all": gradients, which take gigabytes, clusters, and smooth patches.
LIBRARIES = {"torch", "jax", "dask", "fair"}
# A format whose library takes hundreds of megabytes.
LARGE = {"cad"}


@pytest.mark.parametrize("module", PACKAGES)
def test_every_package_is_installed_by_what_its_error_names(module: str) -> None:
    package = PACKAGES[module]
    if package.extra:
        # laspy[lazrs] brings lazrs, pyvista vtk.
        assert package.name in {*re.split(r"[\[\]<>=, ]", " ".join(EXTRAS[package.extra])), "vtk"}
        assert remedy(module) == f"pip install '{PROJECT['name']}[{package.extra}]'"
    else:
        assert package.name in BASE
        assert package.name in remedy(module)


def test_every_extra_is_in_the_table_of_the_install_page() -> None:
    text = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE))
    assert set(rows) == set(EXTRAS) - INTERNAL
    for extra, row in rows.items():
        for kind, found in FORMATS.items():
            assert (f"`{kind}`" in row) == (found.extra == extra) or extra in ("all", "xdmf"), (extra, kind)
    assert EXTRAS["all"] == [
        f"{DISTRIBUTION}[{','.join(extra for extra in EXTRAS if extra not in {*INTERNAL, *LIBRARIES, *LARGE, 'all'})}]"
    ]


# Whoever follows one of these gets the other project, whose name on PyPI is "geokit".
OTHERS = re.compile(
    r"pip install (?:-\S+ )*['\"]?geokit(?![-_]nanovdb)|\bgeokit\[[a-z]|\bgeokit-(?!nanovdb)[^\s`']*\.(?:whl|dist-info)"
)


def test_one_name_to_install_by() -> None:
    assert PROJECT["name"] == DISTRIBUTION
    commands = importlib.metadata.entry_points(group="console_scripts", name="geokit")
    assert [command.dist.name for command in commands] == [DISTRIBUTION]
    assert gk.show_config()["build"]["wheel"]
    # napari refuses a manifest of another name; auditwheel names a folder after it.
    assert f"name: {DISTRIBUTION} " in (ROOT / "geokit/plugins/napari.yaml").read_text(encoding="utf-8")
    assert f"\n  name: {DISTRIBUTION}\n" in (ROOT / "packaging/conda/recipe.yaml").read_text(encoding="utf-8")
    assert f'"{DISTRIBUTION.replace("-", "_")}.libs"' in (ROOT / "packaging/wheel.py").read_text(encoding="utf-8")


def test_no_text_says_another_name_or_an_extra_that_is_none() -> None:
    for wrong in (
        "pip install geokit",
        "pip install -U 'geokit[usd]'",
        "geokit[las]",
        "geokit-*.whl",
        "geokit-1-a.whl",
    ):
        assert OTHERS.search(wrong), wrong
    folders = ("geokit", "docs", "packaging", "examples", "benchmarks", ".ci")
    files = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "pyproject.toml", "dev")]
    files += [path for folder in folders for path in (ROOT / folder).rglob("*")]
    extras = []
    for path in files:
        if path.suffix in ("", ".md", ".ipynb", ".py", ".pyi", ".sh", ".toml", ".yaml", ".txt") and path.is_file():
            text = path.read_bytes().decode(errors="replace")
            assert not OTHERS.search(text), (path, OTHERS.search(text))
            extras += re.findall(rf"{DISTRIBUTION}\[([a-z0-9,-]+)\]", text)
    assert {"usd", "torch", "all,dask"} <= set(extras)
    assert {extra for found in extras for extra in found.split(",")} <= set(EXTRAS)


@pytest.mark.parametrize("module", PACKAGES)
def test_a_missing_package_is_named_with_the_command(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(gk.MissingDependencyError) as raised:
        require_package(module)
    assert str(raised.value).endswith(f"needs the package {PACKAGES[module].name}; install it with: {remedy(module)}")


def test_a_damaged_package_says_what_it_says_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lazrs.py").write_text("raise ImportError('libgears.so: cannot open')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lazrs", raising=False)
    with pytest.raises(gk.MissingDependencyError, match=r"lazrs \(libgears.so: cannot open\)"):
        require_package("lazrs")


SLIM = """
import sys
for name in {blocked!r}:
    sys.modules[name] = None
import numpy as np
import geokit as gk
mesh = gk.mesh.load({mesh!r})
surface = gk.mesh.Surface(mesh)
points = np.random.default_rng(0).uniform(-1.5, 1.5, (100, 3))
assert len(surface.signed_distance(points).distance) == 100
assert np.isfinite(gk.volume.from_mesh(surface, voxel_size=0.1).sample(points)).all()
assert gk.points.NeighborGrid(points, radius=0.3).knn(points, k=2).indices.shape == (100, 2)
for use in (
    lambda: gk.render.figure("a.png", mesh=mesh),
    lambda: gk.mesh.save("a.glb", mesh),
    lambda: gk.mesh.to_pyvista(mesh),
    lambda: gk.points.to_pyvista(points),
    lambda: gk.volume.to_pyvista(gk.volume.from_mesh(mesh, voxel_size=0.1)),
):
    try:
        use()
    except gk.MissingDependencyError as error:
        assert "install it with: pip install" in str(error)
    else:
        raise AssertionError("worked without its package")
"""


@pytest.mark.slow
def test_queries_need_numpy_and_warp_only(tmp_path: Path) -> None:
    # lazy_loader is part of the slim installation.
    code = SLIM.format(blocked=list(PACKAGES), mesh=str(ROOT / "data/samples/torus.ply"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())


LIGHT = """
import sys
for name in {blocked!r}:
    sys.modules[name] = None
exec({program!r})
from geokit.cli import main
for words in (
    ["info", "torus.ply"],
    ["view", "torus.ply", "cloud.ply", "-o", "page.html"],
    ["compare", "cloud.ply", "torus.ply", "report.html"],
    ["doctor"],
):
    assert main(words) == 0, words
"""


@pytest.mark.slow
def test_the_base_installation_has_pages_reports_and_the_command_line(tmp_path: Path) -> None:
    (program,) = re.findall(r"^```py\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    code = LIGHT.format(blocked=[name for name, package in PACKAGES.items() if package.extra], program=program)
    environment = {**os.environ, "BROWSER": "true", "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=600, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert {"torus.ply", "cloud.ply", "page.html", "report.html"} <= {path.name for path in tmp_path.iterdir()}
    assert f"pip install '{DISTRIBUTION}[figures]'" in done.stdout


def test_the_command_line_names_its_package() -> None:
    code = "import sys; sys.modules['cyclopts'] = None; import geokit.cli; sys.exit(geokit.cli.main(['info', 'a.obj']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    expected = "geokit: the command line needs the package cyclopts; install it with: pip install cyclopts\n"
    assert done.stderr == expected


def test_show_config_has_versions_and_build() -> None:
    found = gk.show_config()
    assert found["versions"]["geokit"] == gk.__version__
    assert {package.name for package in PACKAGES.values()} < set(found["versions"])
    assert (found["build"]["extension"] == "yes") is native.available()
    if native.available():
        assert found["build"]["openvdb"] == native.versions()["openvdb"]
        assert re.match(r"\d+\.\d+", found["build"]["tbb"])
        assert found["build"]["compiler"]
    json.dumps(found)
