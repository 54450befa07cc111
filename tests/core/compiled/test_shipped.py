"""Objects that a wheel brings: they are what warp compiles, they serve every call, and no others are used."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from geokit.core.compiled import cpu_level, shipped
from tests.support.forked import ForkServer

ROOT = Path(__file__).resolve().parents[3]
HERE = cpu_level.level()
MODULE = "geokit.core.frame_kernels"

pytestmark = pytest.mark.skipif(HERE == cpu_level.NATIVE, reason="wheels have objects for x86-64-v3 and v4")

# A few kernels, by hand; prints the answer.
ASK = """
import numpy as np
import geokit as gk
grid = gk.points.NeighborGrid(np.random.default_rng(0).random((5000, 3)), 0.1, device="cpu")
print(int(np.asarray(grid.count()).sum()))
"""
# Small ones, which are compiled.
ASK_FEW = """
import numpy as np
import geokit as gk
points = gk.mesh.sample_surface(gk.mesh.box(), 100, method="poisson_disk").points
volume = gk.volume.from_dense(np.random.default_rng(0).random((9, 9, 9)), voxel_size=0.1)
print(points.sum(), volume.active_at(points, device="cpu").sum())
"""
# Every public call, in a process that has no other work. Figures and pages have no kernels of their own.
ASK_ALL = """
import sys, tempfile
from pathlib import Path
from tests.support.effort import ALL
from tests.support.public_calls import Scene, public_calls
for call in public_calls(Scene(Path(tempfile.mkdtemp(dir=sys.argv[1])))):
    if ALL or not call.name.startswith(("accuracy.write_", "render.")):
        call()
"""


def run(script: str, *arguments: object, **environment: object) -> tuple[str, str]:
    given = {name: str(value) for name, value in environment.items()}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", *([] if script.endswith(".py") else ["-c"]), script, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=1500,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]), **given},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def compiled(cache: Path) -> list[Path]:
    """Objects of geokit that were compiled into a cache."""
    return sorted(cache.glob("*/wp_geokit*/*.o"))


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> Path:
    """All objects for this machine's level. What the cache of the tests has is copied from there."""
    folder = tmp_path_factory.mktemp("objects")
    run("packaging/kernels.py", folder, "--cpu", HERE, "--jobs", 1)
    return folder


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    with ForkServer("import numpy, warp, geokit.core.launcher, geokit.core.kernel_cache") as server:
        yield server


def ran(server: ForkServer, script: str, **environment: object) -> tuple[str, str]:
    """The same in a fork of one process, which has imported warp."""
    done = server.run(script, environment=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


@pytest.fixture(scope="module")
def whole(objects, server) -> str:
    """The answer with all objects as they were brought."""
    answer, err = ran(server, ASK, GEOKIT_KERNELS=objects)
    assert err == ""
    return answer


@pytest.fixture
def copied(objects, tmp_path) -> Path:
    return Path(shutil.copytree(objects, tmp_path / "objects"))


@pytest.mark.slow
def test_every_public_call_compiles_nothing(objects, tmp_path):
    _, err = run(ASK_ALL, tmp_path, WARP_CACHE_PATH=tmp_path / "cache", GEOKIT_KERNELS=objects)
    assert [path.name for path in compiled(tmp_path / "cache")] == []
    assert "compiling" not in err


@pytest.mark.slow
def test_objects_are_byte_for_byte_what_is_compiled_here(objects, server, tmp_path):
    answer, err = run(ASK_FEW, WARP_CACHE_PATH=tmp_path / "cache", GEOKIT_KERNELS="")
    made = compiled(tmp_path / "cache")
    assert len(made) >= 3
    for path in made:
        assert path.read_bytes() == (objects / path.name).read_bytes(), path.name
    assert err.count("compiling kernels") == 1
    assert ran(server, ASK_FEW, WARP_CACHE_PATH=tmp_path / "other", GEOKIT_KERNELS=objects) == (answer, "")
    assert compiled(tmp_path / "other") == []


def for_another_warp(folder: Path) -> None:
    index = json.loads((folder / shipped.INDEX).read_text())
    (folder / shipped.INDEX).write_text(json.dumps({**index, "warp": "1.0.0"}))


def damaged_index(folder: Path) -> None:
    (folder / shipped.INDEX).write_text('{"warp": ')


def damaged_objects(folder: Path) -> None:
    for path in folder.glob("*.o"):
        path.write_bytes(path.read_bytes()[:-100] + bytes(100))


def lost_objects(folder: Path) -> None:
    for path in folder.glob("*.o"):
        path.unlink()


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [for_another_warp, damaged_index, damaged_objects, lost_objects])
def test_what_does_not_fit_is_not_used(whole, copied, server, spoil):
    """The cache of the tests is used, so that nothing is compiled anew."""
    spoil(copied)
    again, err = ran(server, ASK, GEOKIT_KERNELS=copied)
    assert again == whole
    assert ("is damaged and not used" in err) is (spoil in (damaged_objects, lost_objects))


@pytest.mark.slow
def test_another_processor_does_not_use_them(objects, server):
    script = f"""
import geokit.core.launcher as launcher, warp as wp
from geokit.core.compiled import cpu_level, modules, shipped
(module,) = modules.warp_modules({MODULE!r})
cpu_level.choose(module)
print(shipped.find(module, launcher.resolve_device("cpu"), 1) is not None)
"""
    assert ran(server, script, GEOKIT_KERNELS=objects)[0] == "True\n"
    assert ran(server, script, GEOKIT_KERNELS=objects, GEOKIT_CPU="native")[0] == "False\n"


@pytest.mark.slow
@pytest.mark.parametrize("cache", ["/dev/null/cache", "/proc/nowhere"])
def test_without_a_folder_for_compiled_kernels(objects, server, tmp_path, cache):
    _, err = ran(server, ASK, GEOKIT_KERNELS=objects, WARP_CACHE_PATH=cache, HOME="/nonexistent", TMPDIR=tmp_path)
    assert err.count("\n") == 1
    assert "WARP_CACHE_PATH" in err


@pytest.mark.slow
def test_objects_for_gpus_are_found_whatever_the_processor(server, tmp_path):
    """They are compiled here and not run: that takes a GPU."""
    run("packaging/kernels.py", tmp_path, "--cuda", "90", "80-ptx", "--only", MODULE)
    script = f"""
import geokit.core.launcher as launcher
from types import SimpleNamespace
from geokit.core.compiled import cpu_level, modules, shipped
launcher.resolve_device("cpu")
(module,) = modules.warp_modules({MODULE!r})
cpu_level.choose(module)
for arch in (75, 86, 90, 100):
    found = shipped.find(module, SimpleNamespace(is_cpu=False, arch=arch), launcher.BLOCK_DIM)
    print(found and (found.arch, found.binary.suffix))
"""
    for level in (HERE, cpu_level.NATIVE):
        out, _ = ran(server, script, GEOKIT_KERNELS=tmp_path, GEOKIT_CPU=level)
        assert out.splitlines() == ["None", "(80, '.ptx')", "(90, '.cubin')", "(80, '.ptx')"]


def test_machine_code_of_the_same_architecture_comes_before_ptx():
    names = [name for name, _ in shipped._suffixes(None, SimpleNamespace(is_cpu=False, arch=89), 128, "wp_a_0")]
    codes = [name for name in names if name.endswith(".cubin")]
    assert codes == [f".sm{arch}.cubin" for arch in range(89, 79, -1)]
    assert names[len(codes) : len(codes) + 2] == [".sm89.ptx", ".sm88.ptx"]


def test_no_folders_where_the_environment_says_none(monkeypatch, tmp_path):
    monkeypatch.setenv("GEOKIT_KERNELS", "")
    assert shipped.folders() == []
    monkeypatch.setenv("GEOKIT_KERNELS", str(tmp_path))
    assert shipped.folders() == [tmp_path]
    monkeypatch.delenv("GEOKIT_KERNELS")
    assert shipped.folders()[0] == shipped.OBJECTS
