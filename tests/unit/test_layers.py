"""The house rules of imports: each layer imports only to its left, and kernels only other kernels."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "geokit"
FILES = sorted(PACKAGE.rglob("*.py"))

# From left to right; a module may import from its own layer and from those before it.
LAYERS = [
    ("errors",),
    (
        "_exporters",
        "_files",
        "_frame",
        "_host_array",
        "_kept_memory",
        "_lazy",
        "_loans",
        "_memory",
        "_pinned",
        "_ply_header",
        "_recorded",
        "_scratch",
        "_spread",
    ),
    ("kernels",),
    ("_launch",),
    ("threads",),
    ("_download",),
    ("_arrays",),
    ("_blocks",),
    ("native",),
    ("mesh", "volume", "points"),
    ("render",),
    ("accuracy",),
    ("cli", "__main__"),
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
# The doors between meshes and volumes.
DOORS = {("volume", "from_mesh"), ("volume", "_from_mesh_tolerance"), ("mesh", "from_volume")}


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer_of(module: str) -> str:
    parts = module.split(".")
    if parts[-1].endswith("_kernels"):
        return "kernels"
    return parts[1] if len(parts) > 1 else ""


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def imports_of(path: Path) -> list[tuple[str, bool]]:
    """Imported modules, and whether each import stands inside a function; those for annotations only are left out."""
    found: list[tuple[str, bool]] = []

    def visit(node: ast.AST, inside: bool) -> None:
        if is_type_checking(node):
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


def resolved(name: str) -> str:
    """The module that an imported name is or lies in."""
    path = ROOT.joinpath(*name.split("."))
    return name if path.is_dir() or path.with_suffix(".py").is_file() else name.rpartition(".")[0]


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_imports_only_to_the_left(path):
    module = module_of(path)
    layer = layer_of(module)
    if not layer:
        return
    for name, inside in imports_of(path):
        if name.split(".")[0] != "geokit":
            continue
        target = resolved(name)
        if target in ("geokit", "geokit.__version__"):
            continue
        other = layer_of(target)
        assert RANK[other] <= RANK[layer], f"{module} imports {target}, which stands to its right"
        if {layer, other} == {"mesh", "volume"}:
            door = tuple(module.split(".")[1:3])
            assert door in DOORS, f"{module} imports {target}: mesh and volume meet only in {sorted(DOORS)}"
            assert inside, f"{module} imports {target} outside a function"


@pytest.mark.parametrize("path", [p for p in FILES if p.stem.endswith("_kernels")], ids=module_of)
def test_kernel_files_import_only_warp_and_kernels(path):
    for name, _ in imports_of(path):
        root = name.split(".")[0]
        assert root in {"warp", "geokit", "typing"}, f"{path}: imports {name}"
        if root == "geokit":
            assert resolved(name).endswith("_kernels"), f"{path}: imports {name}"


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_no_kernel_uses_warp_s_atomics(path):
    # On a CPU they are plain reads and writes, and geokit runs a launch in several threads.
    assert "wp.atomic_" not in path.read_text()


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_only_the_extension_s_package_imports_it(path):
    inside_native = path.is_relative_to(PACKAGE / "native")
    for name, _ in imports_of(path):
        assert inside_native or "_native" not in name.split(".")[-1], f"{path}: imports {name}"


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_only_the_command_line_prints_or_exits(path):
    if path.is_relative_to(PACKAGE / "cli") or path.stem in {"__main__", "_reader_worker"}:
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in {"print", "exit", "quit", "sys.exit", "os._exit"}, f"{path}:{node.lineno}: {called}"


def test_importing_geokit_is_light():
    heavy = ("warp", "trimesh", "vtk", "vtkmodules", "pyvista", "meshio", "scipy", "matplotlib", "pxr")
    code = (
        "import sys, geokit\n"
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
        "__version__",
        "accuracy",
        "errors",
        "mesh",
        "points",
        "render",
        "threads",
        "volume",
    }
    for namespace in (geokit.mesh, geokit.volume, geokit.points, geokit.render, geokit.threads, geokit.accuracy):
        for name in namespace.__all__:
            assert getattr(namespace, name) is not None
