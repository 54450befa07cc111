"""What holds for every verb: help, exit codes, one-line errors, quick starts."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from geokit.cli._program.app import GROUPS, VERBS, examples_of

ROOT = Path(__file__).resolve().parents[2]


def test_help_lists_every_verb(geokit) -> None:
    done = geokit("--help")
    assert done.returncode == 0
    assert done.stderr == ""
    for verb in VERBS:
        assert verb in done.stdout


@pytest.mark.slow
def test_no_arguments_is_help(geokit) -> None:
    assert geokit().stdout == geokit("--help").stdout


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_each_verb_has_help(geokit_process, verb: str) -> None:
    done = geokit_process(verb, "--help")
    assert done.returncode == 0
    assert f"geokit {verb}" in done.stdout
    assert f"\nExamples:\n  geokit {verb}" in done.stdout
    for question in ("closest", "signed", "ray", "sample", "neighbors") if verb == "query" else ():
        assert question in done.stdout


@pytest.mark.parametrize("verb", VERBS)
def test_each_verb_has_a_row_in_the_page(verb: str) -> None:
    assert f"\n| `geokit {verb}" in (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")


def test_each_command_has_an_example_of_its_own() -> None:
    commands = [[verb] for verb in VERBS if verb not in GROUPS]
    for group in GROUPS:
        app = importlib.import_module(f"geokit.cli.{group}").app
        commands += [[group, name] for name in app if not name.startswith("-")]
    assert len(commands) > 40
    for command in commands:
        found = examples_of([*command, "--help"])
        assert found, command
        assert all(line.split()[1 : 1 + len(command)] == command for line in found), command
    assert examples_of([]) == examples_of(["--help"]) == examples_of(["help"])
    assert set(examples_of([])) < set(examples_in_page())
    assert examples_of(["--memory-limit", "9", "info", "-h"]) == examples_of(["help", "info"])
    assert examples_of(["volume"]) == examples_of(["volume", "--help"])
    assert examples_of(["info", "a.obj"]) == []


def test_the_page_has_the_same_examples() -> None:
    for verb in VERBS:
        of_verb = [line for line in examples_in_page() if line.split()[1] == verb]
        alone = [line for line in of_verb if line == f"geokit {verb}"]
        assert examples_of(["help", verb]) == (alone or of_verb)


def examples_in_page() -> list[str]:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith("geokit ")]


def test_version(geokit) -> None:
    import geokit as package

    assert geokit("--version").stdout.strip() == package.__version__


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("frobnicate",), "frobnicate"),
        (("info",), "FILE"),
        (("info", "a.obj", "--frob"), "--frob"),
        (("convert", "a.obj"), "OUT"),
        (("convert", "a.obj", "b.vdb", "--voxel-size", "wide"), "wide"),
        (("query", "nearest", "a", "b"), "nearest"),
        (("query", "neighbors", "a.csv"), "--radius"),
        (("render", "a.obj"), "--output"),
        (("demo", "--out"), "--out"),
    ],
)
def test_usage_errors_are_one_line_and_code_2(geokit, fails, arguments: tuple[str, ...], words: str) -> None:
    fails(geokit(*arguments), 2, words, "--help")


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "nowhere.obj"),
        ("convert", "nowhere.obj", "out.stl"),
        ("query", "closest", "nowhere.obj", "points.csv"),
        ("query", "neighbors", "nowhere.csv", "--radius", "1"),
        ("query", "sample", "nowhere.nvdb", "points.csv"),
        ("render", "nowhere.obj", "-o", "out.png"),
    ],
)
def test_a_missing_file_is_one_line_and_code_1(geokit, fails, tmp_path: Path, arguments: tuple[str, ...]) -> None:
    fails(geokit(*arguments, cwd=tmp_path), 1, "nowhere", "no such file")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_format_lists_the_known_ones(geokit, fails, tmp_path: Path) -> None:
    path = tmp_path / "mesh.xyzzy"
    path.write_text("?")
    fails(geokit("info", path), 1, ".xyzzy", ".obj", ".vdb", ".csv")


def test_debug_shows_where_an_error_came_from(geokit, tmp_path: Path) -> None:
    done = geokit("info", "nowhere.obj", cwd=tmp_path, GEOKIT_DEBUG="1")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("geokit: nowhere.obj")


@pytest.mark.slow
def test_an_unexpected_exception_is_one_line() -> None:
    code = (
        "import sys, geokit.cli, geokit.cli.info as info\n"
        "def broken(*_): raise RuntimeError('gears\\njammed')\n"
        "info.kind_of_input = broken\n"
        "sys.exit(geokit.cli.main(['info', 'x.obj']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 1
    assert done.stderr == "geokit: internal error: RuntimeError: gears jammed; GEOKIT_DEBUG=1 shows where\n"


@pytest.mark.slow
def test_a_missing_package_is_named(cube: Path, tmp_path: Path) -> None:
    code = (
        "import sys, geokit.cli\n"
        "sys.modules['trimesh'] = None\n"
        f"sys.exit(geokit.cli.main(['convert', {str(cube)!r}, {str(tmp_path / 'cube.glb')!r}]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 1
    assert done.stderr == (
        f"geokit: warning: {tmp_path / 'cube.glb'}: the unit of the mesh is not known, and the file says meter; say it "
        "with convert_unit(mesh, from_unit=...)\n"
        "geokit: writing a .glb file needs the package trimesh; install it with: pip install trimesh\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_interrupt_is_code_130() -> None:
    code = (
        "import sys, geokit.cli, geokit.cli.info as info\n"
        "def interrupted(*_): raise KeyboardInterrupt\n"
        "info.kind_of_input = interrupted\n"
        "sys.exit(geokit.cli.main(['info', 'x.obj']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 130
    assert done.stderr == "geokit: interrupted\n"


@pytest.mark.slow
def test_a_reader_that_leaves_is_no_error(cube: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "geokit", "info", str(cube)],
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            timeout=60,
        )
    finally:
        os.close(writer)
    assert done.stderr == ""
    assert done.returncode == 141


def imported_by(*arguments: str) -> set[str]:
    """Top-level names of the modules that a command imports, in a process of its own."""
    code = (
        "import sys, geokit.cli\n"
        "code = geokit.cli.main(sys.argv[1:])\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)\n"
        "sys.exit(code)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=ROOT, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return set(done.stderr.splitlines()[-1].split())


HEAVY = {"warp", "vtk", "vtkmodules", "pyvista", "trimesh", "meshio", "scipy", "matplotlib", "pxr"}


def test_help_imports_nothing_heavy() -> None:
    assert not imported_by("--help") & (HEAVY | {"numpy"})


@pytest.mark.slow
def test_info_imports_nothing_heavy(cube: Path, cube_sdf: Path) -> None:
    assert not imported_by("info", str(cube)) & HEAVY
    assert not imported_by("info", str(cube_sdf)) & HEAVY
