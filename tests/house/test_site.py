"""The site's pages: names and calls that they show exist, their code runs, and their pictures are what it draws."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import importlib.util
import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import geokit
from geokit import native

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
# Without those that building the site writes.
ALL_PAGES = {path for path in DOCS.rglob("*.md") if path.parent.parent != DOCS / "api"}
PAGES = sorted(path for path in ALL_PAGES if "design" not in path.parts)
# Written for the site: their Python blocks run in one namespace. Blocks of other pages have tests of their own.
RUN = ["conventions", "troubleshooting", "which/distances", "which/sign", "which/from-mesh", "which/meshing"]
RUN += ["which/simplify", "gallery", "interop", "batch", "large-files"]
# Of guides the results are checked too, in test_guides.py.
GUIDES = ["hollow", "clearance", "smoke", "sdf-samples", "close-scan", "compare-scans", "as-built"]
GUIDES += ["mask-to-mesh", "vdb-library", "granular", "fit-shape", "ocean", "print-file", "loader", "sequence"]
# What the pages call such objects.
OBJECTS = {
    "mesh": geokit.mesh.TriangleMesh,
    "surface": geokit.mesh.Surface,
    "volume": geokit.volume.SparseVolume,
    "sdf": geokit.volume.SparseVolume,
    "grid": geokit.points.NeighborGrid,
}
# Largest mean difference of a picture's colors, in [0, 1]: fonts and drivers differ a little.
SAME_PICTURE = 0.03


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```(?:python|py)\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)


def inline(text: str) -> list[str]:
    """Code between backticks, outside of fences."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))


def resolve(dotted: str, objects: dict[str, object]) -> object:
    first, *rest = dotted.split(".")
    found = geokit if first in ("gk", "geokit") else objects[first]
    for name in rest:
        inner = f"{found.__name__}.{name}" if inspect.ismodule(found) and not hasattr(found, name) else ""
        if inner and importlib.util.find_spec(inner):
            importlib.import_module(inner)
        if name in getattr(found, "__annotations__", {}) or (not hasattr(found, name) and _has_field(found, name)):
            return None  # the type of a field is not followed
        found = getattr(found, name)
    return found


def _has_field(kind: object, name: str) -> bool:
    """Whether instances have a field that the class has not: one of its __init__, or one that its docstring names."""
    return inspect.isclass(kind) and bool(re.search(rf"^\s+{name}: ", inspect.getdoc(kind) or "", re.MULTILINE))


def dotted(node: ast.AST) -> str | None:
    if isinstance(node, ast.Attribute):
        inner = dotted(node.value)
        return inner and f"{inner}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else None


def check(code: str, objects: dict[str, object]) -> int:
    """Resolve each name of geokit in a piece of code and bind the arguments of each call; return how many."""
    try:
        tree = ast.parse(code)
    except SyntaxError:
        names = re.findall(r"\b(?:gk|geokit)(?:\.[A-Za-z_]\w*)+", code)
        for name in names:
            resolve(name, objects)
        return len(names)
    count = 0
    for node in ast.walk(tree):
        known = {"gk", "geokit", *objects}
        if isinstance(node, ast.Attribute) and (name := dotted(node)) and name.split(".")[0] in known:
            resolve(name, objects)
            count += 1
        if isinstance(node, ast.Call) and (name := dotted(node.func)) and name.split(".")[0] in known and "." in name:
            called = resolve(name, objects)
            given = [argument for argument in node.args if getattr(argument, "value", None) is not ...]
            if called is None or any(isinstance(argument, ast.Starred) for argument in given):
                continue
            signature = inspect.signature(called)
            bind = signature.bind_partial if len(given) < len(node.args) else signature.bind
            if name.split(".")[0] in objects:
                given = [node.func, *given]  # self
            keywords = {keyword.arg: None for keyword in node.keywords if keyword.arg}
            bind(*given, **keywords)
    return count


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).with_suffix("").as_posix())
def test_names_and_calls_exist(page: Path) -> None:
    for block in blocks(page):
        check(block, {})
    for code in inline(text_of(page)):
        if "gk." in code or re.match(r"geokit\.(?!(?:nvdb|vdb)\b)\w+(\.\w+)*$", code):
            check(code, {})


def rows(peer: str) -> list[list[str]]:
    """The cells of the table of a peer, without its head."""
    (section,) = re.findall(
        rf"^## {peer}\n(.*?)(?=^## |\Z)", text_of(DOCS / "coming-from.md"), re.MULTILINE | re.DOTALL
    )
    table = [re.split(r"(?<!\\) \| ", line.strip("| ")) for line in section.splitlines() if line.startswith("| ")]
    return table[1:]


def test_the_check_finds_what_is_not_there() -> None:
    wrong = ["gk.mesh.closest(a)", "gk.mesh.load('a.ply', grids=1)", "surface.closest_points(p)", "mesh.faces_of"]
    wrong += ["gk.volume.from_mesh(mesh, 0.1, 3.0)", "surface.raycast(origins)", "gk.mesh.load = Surface of gk.meshes"]
    for code in wrong:
        with pytest.raises((AttributeError, TypeError)):
            check(code, OBJECTS)
    assert check("gk.render.figure(..., up='z')", OBJECTS)
    assert check("mesh.vertices", OBJECTS)


PEERS = re.findall(r"^## (.*)$", text_of(DOCS / "coming-from.md"), re.MULTILINE)


@pytest.mark.parametrize("peer", PEERS)
def test_equivalents_exist(peer: str) -> None:
    assert len(rows(peer)) >= 10
    for row in rows(peer):
        codes = re.findall(r"`([^`]+)`", row[1])
        assert codes or "none" in row[1] or "gradients" in row[1], row
        for code in codes:
            assert check(code, OBJECTS) >= 1, code


@pytest.mark.parametrize("peer", ["trimesh", "PyVista", "warp"])
def test_calls_of_peers_exist(peer: str) -> None:
    """Those of the peers that geokit itself needs; libigl, Open3D and pyopenvdb are not among them."""
    import pyvista
    import trimesh.boolean
    import trimesh.registration
    import warp

    objects: dict[str, dict[str, object]] = {
        "trimesh": {"trimesh": trimesh, "mesh": trimesh.creation.box()},
        "PyVista": dict.fromkeys(("polydata", "points"), pyvista.PolyData)
        | {"pyvista": pyvista, "image": pyvista.ImageData},
        "warp": {"wp": warp, "mesh": warp.Mesh},
    }

    for row in rows(peer):
        for code in re.findall(r"`([^`]+)`", row[0]):
            first, *rest = re.match(r"[\w.]+", code)[0].split(".")
            found = objects[peer][first]
            if peer == "warp" and rest[0] in warp._src.context.builtin_functions:
                continue
            for name in rest:
                assert hasattr(found, name), code
                found = getattr(found, name)


def conf() -> object:
    spec = importlib.util.spec_from_file_location("site_conf", DOCS / "conf.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_page_is_in_the_site() -> None:
    """Each page stands in a toctree, and each toctree names pages."""
    reached: set[Path] = set()
    for page in ALL_PAGES:
        for body in re.findall(r"^```\{toctree\}\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL):
            for line in body.splitlines():
                if not line or line.startswith(":"):
                    continue
                entry = re.sub(r"^.*<(.*)>$", r"\1", line)
                found = list(page.parent.glob(f"{entry}.md"))
                assert found, f"{page.name}: {entry}"
                reached.update(found)
    assert reached | {DOCS / "index.md"} == ALL_PAGES


def test_the_reference_has_every_public_name() -> None:
    made = conf()
    doors = {path.stem for path in (DOCS / "api").glob("*.md")} - {"index"}
    packages = {name for name in geokit.__all__ if inspect.ismodule(getattr(geokit, name))} | {"native"}
    assert doors == packages
    for door in doors:
        listed = [name for _, names in made.sections(door) for name in names]
        assert sorted(listed) == sorted(importlib.import_module(f"geokit.{door}").__all__), door


def test_each_public_name_is_on_one_page_and_long_classes_have_their_own() -> None:
    made = conf()
    for door in ("mesh", "volume", "points", "kernels", "threads"):
        pages = made.api_pages(door)
        names = [name for text in pages.values() for name in re.findall(rf":: geokit\.{door}\.(\w+)", text)]
        assert sorted(names) == sorted(importlib.import_module(f"geokit.{door}").__all__), door
        for page in set(pages) - {door}:
            assert f"\n{page}\n" in pages[door]
    alone = made.api_pages("mesh")["mesh/Surface"]
    assert "closest_point, " in alone
    assert alone.count(".. auto") == 1


def test_the_index_for_models_has_every_page() -> None:
    lines = conf().index_for_models().splitlines()
    listed = [re.fullmatch(r" *- \[.+\]\((\S+)\.html\): \S.*", line) for line in lines[4:]]
    assert all(listed), lines[4 + listed.index(None)]
    names = [line[1] for line in listed if line]
    wanted = {page.relative_to(DOCS).with_suffix("").as_posix() for page in ALL_PAGES} - {"index"}
    assert sorted(names) == sorted(wanted)
    assert lines[2].startswith("> Closest points, ray hits")


def test_the_reference_has_the_queries_of_internal_bases() -> None:
    """Methods that a class has from a public one are shown there."""
    made = conf()
    for thing in (geokit.mesh.Surface, geokit.mesh.Surfaces, geokit.volume.SparseVolume, geokit.points.NeighborGrid):
        public = {name for name in dir(thing) if not name.startswith("_") and callable(getattr(thing, name))}
        assert public <= set(made.members(thing)), thing
    assert {"closest_point", "raycast_all", "overlapping", "distance", "audit"} <= set(
        made.members(geokit.mesh.Surface)
    )
    if importlib.util.find_spec("torch"):
        assert "closest_point" not in made.members(geokit.torch.Surface)


def test_pages_of_the_root_and_their_links() -> None:
    made = conf()
    for name in made.ROOT_PAGES:
        assert (DOCS / f"{name}.md").exists()
        text = made.linked_to_pages(made.root_page(name), name)
        for target in re.findall(r"\]\(([^)#\s]+)", text):
            assert "://" in target or (DOCS / target).exists(), f"{name}: {target}"


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_code_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = DOCS / f"{name}.md"
    if name in ("gallery", "interop") and not native.available():
        pytest.skip("geokit was built without OpenVDB")
    if name == "batch" and importlib.util.find_spec("dask") is None:
        pytest.skip("dask is not installed")
    if name == "interop" and "geokit" not in importlib.metadata.entry_points(group="xarray.backends").names:
        pytest.skip("geokit was installed before it had these entry points")
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    assert blocks(page)
    for block in blocks(page):
        exec(compile(block, str(page), "exec"), namespace)
    pictures = {path.name for path in tmp_path.glob("*.png")}
    if name == "gallery":
        from matplotlib import image

        kept = DOCS / "figures" / "gallery"
        assert pictures == {path.name for path in kept.iterdir()}
        for picture in pictures:
            assert f"(figures/gallery/{picture})" in text_of(page)
            drawn, expected = (image.imread(folder / picture)[..., :3] for folder in (tmp_path, kept))
            assert drawn.shape == expected.shape
            assert np.abs(drawn - expected).mean() < SAME_PICTURE, picture
    else:
        assert not pictures


def test_every_new_page_with_code_runs() -> None:
    elsewhere = {"tour", "kernels", "gradients", "granular", "warp-tour"}
    with_code = {page.relative_to(DOCS).with_suffix("").as_posix() for page in PAGES if blocks(page)}
    assert with_code - elsewhere == {*RUN, *(f"guides/{name}" for name in GUIDES)}


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: page.stem)
def test_answers_are_taken_by_name(page: Path) -> None:
    """closest_point has the points first, signed_distance the distances: unpacked, they are exchanged unseen."""
    for block in blocks(page):
        assert not re.search(r"^\s*\w+, .*= .*\b(closest_point|signed_distance)\([^()]*\)\s*(#|$)", block, re.MULTILINE)


def test_the_install_page_counts_the_kernel_modules() -> None:
    (said,) = re.findall(r"^- all (\d+) kernel modules", text_of(DOCS / "install.md"), re.MULTILINE)
    assert int(said) == len(list((ROOT / "geokit").rglob("*_kernels.py")))
