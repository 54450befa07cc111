"""Rules of the house: who imports whom (geokit/LAYERS), what each room may do, and that documents quote the order."""

from __future__ import annotations

import ast
import functools
import importlib
import pkgutil
import re
import subprocess
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "geokit"
FILES = sorted(PACKAGE.rglob("*.py"))
KERNEL_FILES = [path for path in FILES if path.stem.endswith("_kernels")]
MOST_FILES = 25
MOST_CPP_LINES = 5

# The one exception: methods of SparseVolume and TriangleMesh forward to verbs, which they import when they are called.
FORWARDING = ("volume/model/sparse_volume", "mesh/model/triangle_mesh")


class Room(NamedTuple):
    rank: int
    meets: str | None


def read_rooms(text: str) -> dict[str, Room]:
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    rooms = {}
    for rank, line in enumerate(filter(None, lines)):
        name, _, meets = (part.strip() for part in line.partition("+"))
        assert name not in rooms, f"geokit/LAYERS names {name} twice"
        rooms[name] = Room(rank, meets or None)
    return rooms


ROOMS = read_rooms((PACKAGE / "LAYERS").read_text())


def name_of(path: Path) -> str:
    """The file's path as geokit/LAYERS writes it: without suffix, a package as its folder."""
    name = path.relative_to(PACKAGE).with_suffix("").as_posix()
    return name.removesuffix("__init__").rstrip("/")


def room_of(name: str) -> str:
    fitting = [room for room in ROOMS if name == room or name.startswith(room + "/")]
    assert fitting, f"geokit/{name}: no line of geokit/LAYERS fits; give it a room"
    return max(fitting, key=len)


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


@functools.cache
def imports_of(path: Path) -> list[tuple[str, bool]]:
    """Imported names in full, and whether inside a function; those for annotations only are left out."""
    found: list[tuple[str, bool]] = []

    def visit(node: ast.AST, inside: bool) -> None:
        if isinstance(node, ast.expr) or is_type_checking(node):
            return
        if isinstance(node, ast.Import):
            found.extend((alias.name, inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; name the module in full"
            found.extend((f"{node.module}.{alias.name}", inside) for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child, inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))

    visit(ast.parse(path.read_text(encoding="utf-8")), False)
    return found


def public_modules() -> dict[str, str]:
    """Public names of the lazy packages, as "mesh.Surface", and the file that each stands in."""
    found = {}
    for stub in PACKAGE.rglob("__init__.pyi"):
        package = name_of(stub.with_suffix(".py"))
        for node in ast.parse(stub.read_text()).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    target = "/".join(filter(None, [package, *node.module.split(".")]))
                    found[".".join(filter(None, [package, alias.name]))] = target
    return found


PUBLIC = public_modules()


def resolved(name: str) -> str | None:
    """The file or package, as LAYERS writes it, that an imported name is or lies in; None for geokit itself."""
    parts = name.split(".")[1:]
    while parts:
        if ".".join(parts) in PUBLIC:
            return PUBLIC[".".join(parts)]
        path = PACKAGE.joinpath(*parts)
        if path.with_suffix(".py").is_file() or path.is_dir():
            return "/".join(parts)
        parts = parts[:-1]
    return None


@functools.cache
def edges() -> dict[str, list[tuple[str, bool]]]:
    found: dict[str, list[tuple[str, bool]]] = defaultdict(list)
    for path in FILES:
        for name, inside in imports_of(path):
            target = resolved(name) if name.split(".")[0] == "geokit" else None
            if target and target != name_of(path):
                found[name_of(path)].append((target, inside))
    return found


def test_imports_only_from_rooms_before():
    for path in FILES:
        name = name_of(path)
        if not name:
            continue
        room = room_of(name)
        for target, inside in edges()[name]:
            other = room_of(target)
            forwards = name in FORWARDING and inside and target.split("/")[0] == name.split("/")[0]
            assert forwards or ROOMS[other].rank <= ROOMS[room].rank, (
                f"geokit/{name} imports {target}: geokit/LAYERS has {other} after {room}"
            )


def test_geokit_itself_is_asked_for_its_version_and_folder_only():
    for path in FILES:
        name = name_of(path)
        if name and not name.startswith("cli"):
            used = {
                node
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.Attribute)
            }
            whole = {ast.unparse(node) for node in used if ast.unparse(node.value) == "geokit"}
            assert whole <= {"geokit.__version__", "geokit.__path__"}, f"geokit/{name}: reaches all rooms by {whole}"


def test_meshes_and_volumes_meet_only_where_layers_says():
    for path in FILES:
        name = name_of(path)
        door = name.split("/")[0]
        if door not in ("mesh", "volume"):
            continue
        met = {target.split("/")[0] for target, _ in edges()[name]} & ({"mesh", "volume"} - {door})
        assert met <= {ROOMS[room_of(name)].meets}, f"geokit/{name} imports {met}; geokit/LAYERS does not allow it"


@pytest.mark.slow
def test_no_import_circle():
    graph = {
        name: {target for target, inside in targets if not (name in FORWARDING and inside)}
        for name, targets in edges().items()
    }
    done: set[str] = set()

    def follow(name: str, way: list[str]) -> None:
        assert name not in way, " -> ".join([*way[way.index(name) :], name])
        if name in done:
            return
        for target in sorted(graph.get(name, ())):
            follow(target, [*way, name])
        done.add(name)

    for name in sorted(graph):
        follow(name, [])


def test_every_line_of_layers_is_a_file_or_a_folder():
    for room in ROOMS:
        assert (PACKAGE / room).is_dir() or (PACKAGE / f"{room}.py").is_file(), f"geokit/LAYERS: {room} is not there"


def test_no_folder_fills_up():
    count = Counter(path.parent for path in [*FILES, *(ROOT / "tests").rglob("*.py")] if path.name != "__init__.py")
    full = {folder.relative_to(ROOT).as_posix(): size for folder, size in count.items() if size > MOST_FILES}
    assert not full, f"which room is missing? {full}"


def quoted_order() -> str:
    """The order of whole rooms, as documents quote it."""
    return " < ".join(room for room in ROOMS if "_" not in room.split("/")[-1][:1])


@pytest.mark.parametrize("document", ["CONTRIBUTING.md", "docs/design/house.md"])
def test_documents_quote_the_order(document):
    text = re.sub(r"[`>\s]+", " ", (ROOT / document).read_text())
    assert quoted_order() in text, f"{document} must quote: {quoted_order()}"


def test_kernel_files_import_only_warp_kernels_and_cpp():
    for path in KERNEL_FILES:
        for name, _ in imports_of(path):
            root = name.split(".")[0]
            # Of numpy only the scalar types are of use: a np.float32 is a float in the C++ of a kernel.
            assert root in {"warp", "geokit", "typing", "numpy"}, f"{path}: imports {name}"
            if root == "geokit":
                target = resolved(name)
                assert target == "core/cpp" or str(target).endswith("_kernels"), f"{path}: imports {name}"


@pytest.mark.slow
def test_cpp_of_more_than_a_few_lines_stands_in_an_inl_file():
    for path in KERNEL_FILES:
        tree = ast.parse(path.read_text())
        # Expressions of their own are docstrings.
        docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in docstrings:
                lines = [line for line in node.value.splitlines() if line.strip()]
                assert len(lines) <= MOST_CPP_LINES, (
                    f"{path}:{node.lineno}: move it to a .inl file, read by core/cpp.py"
                )


def test_no_kernel_uses_warp_s_atomics():
    for path in FILES:
        # On a CPU they are plain reads and writes, and geokit runs a launch in several threads.
        assert "wp.atomic_" not in path.read_text(encoding="utf-8"), path


@pytest.mark.slow
def test_only_the_extension_s_package_imports_it():
    for path in FILES:
        inside_native = path.is_relative_to(PACKAGE / "native")
        for name, _ in imports_of(path):
            assert inside_native or "_native" not in name.split(".")[-1], f"{path}: imports {name}"


@pytest.mark.slow
def test_only_the_command_line_prints_or_exits():
    for path in FILES:
        if (
            path.is_relative_to(PACKAGE / "cli")
            or path.stem == "__main__"
            or path == PACKAGE / "formats/reader/worker.py"
        ):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in {"print", "exit", "quit", "sys.exit", "os._exit"}, (
                    f"{path}:{node.lineno}: {called}"
                )


def test_importing_geokit_is_light():
    heavy = ("warp", "trimesh", "vtk", "vtkmodules", "pyvista", "meshio", "scipy", "matplotlib", "pxr")
    code = (
        "import sys, geokit\n"
        "assert 'geokit.core' not in sys.modules\n"
        "from geokit import accuracy, mesh, volume, points, threads, errors\n"
        f"print(sorted(set(sys.modules) & set({heavy!r})))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd="/")
    assert run.stdout.strip() == "[]"


def test_public_names_are_those_of_the_contract():
    import geokit

    assert set(geokit.__all__) == {
        "DeviceMemoryError",
        "FileAccessError",
        "FileFormatError",
        "GeokitError",
        "InputError",
        "MissingDependencyError",
        "UnsupportedGridError",
        "WorkerError",
        "__version__",
        "accuracy",
        "distributed",
        "errors",
        "jax",
        "kernels",
        "mesh",
        "points",
        "register",
        "release_memory",
        "sample_path",
        "render",
        "show_config",
        "threads",
        "torch",
        "volume",
    }
    for namespace in (
        geokit.mesh,
        geokit.volume,
        geokit.points,
        geokit.render,
        geokit.kernels,
        geokit.threads,
        geokit.accuracy,
    ):
        for name in namespace.__all__:
            assert getattr(namespace, name) is not None


@pytest.mark.parametrize("package", ["mesh", "volume", "points", "render", "threads", "accuracy"])
def test_no_module_shares_its_name_with_a_public_one(package):
    module = importlib.import_module(f"geokit.{package}")
    modules = {found.name for found in pkgutil.iter_modules(module.__path__)}
    assert not modules & set(module.__all__)
