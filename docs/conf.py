"""How Sphinx builds the site: `./dev docs` writes it to site/.

Pages are the Markdown files beside this one. Three things are made here, so that they are written down once: pages of
the files in the repository's root, the API reference (sections of each door's `__init__.pyi`, texts of the docstrings),
and the links of docstrings to the tests that hold them.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import os
import re
from functools import cache, cached_property
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

project = "geokit"
author = "The authors of geokit"
version = release = re.search(r'__version__ = "(.*)"', (ROOT / "geokit/__init__.py").read_text(encoding="utf-8"))[1]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["figures/**"]
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
# Types in signatures are short names: Surface is one of mesh and one of torch.
suppress_warnings = ["ref.python"]
highlight_language = "text"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
# Written as they stand in the code, not spelled out.
autodoc_type_aliases = {name: name for name in ("ArrayLike", "NDArray", "DTypeLike", "Progress", "Function")}
autodoc_mock_imports = [name for name in ("torch", "jax") if importlib.util.find_spec(name) is None]
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Source"]
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "pydata_sphinx_theme"
html_title = f"geokit {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_sidebars = {page: [] for page in ("index", "install", "gallery", "coming-from")}
html_theme_options = {
    "logo": {"text": "geokit"},
    "navbar_align": "left",
    "header_links_before_dropdown": 8,
    "show_toc_level": 1,
    "secondary_sidebar_items": {"**": ["page-toc"], "index": []},
    "navigation_depth": 2,
    "footer_start": [],
    "footer_end": [],
}
html_context = {"default_mode": "auto"}

# Pages that are files of the root.
ROOT_PAGES = {
    "changelog": "CHANGELOG.md",
    "contributing": "CONTRIBUTING.md",
    "wheels": "packaging/README.md",
    "samples": "data/samples/README.md",
}


def root_page(name: str) -> str:
    """A file of the root as a page of docs/, with the links that its new place needs."""

    file = ROOT / ROOT_PAGES[name]

    def moved(link: re.Match[str]) -> str:
        return link[0] if "://" in link[1] else f"]({os.path.relpath(file.parent / link[1], DOCS)}"

    return re.sub(r"\]\(([^)#\s]+)", moved, file.read_text(encoding="utf-8"))


def linked_to_pages(text: str, docname: str) -> str:
    """Links to files of the root that are pages lead to those, and anchors in HTML become Sphinx's."""
    text = re.sub(r'^<a id="([^"]+)"></a>$', r"(\1)=", text, flags=re.MULTILINE)
    for page, file in ROOT_PAGES.items():
        up = os.path.relpath(ROOT / file, (DOCS / docname).parent)
        text = text.replace(f"]({up}", f"]({os.path.relpath(DOCS / page, (DOCS / docname).parent)}.md")
    return text


def sections(door: str) -> list[tuple[str, list[str]]]:
    """Headings and names of a door: the comments of its `__init__.pyi` and the names below each, else `__all__`."""
    found: list[tuple[str, list[str]]] = []
    stub = ROOT / "geokit" / door / "__init__.pyi"
    text = stub.read_text(encoding="utf-8") if stub.exists() else ""
    for comment, code in re.findall(r"((?:^#.*\n)+)((?:^(?!#).*\n?)+)", text, re.MULTILINE):
        heading = " ".join(line.lstrip("# ") for line in comment.splitlines()).rstrip(".")
        imports = [node for node in ast.parse(code).body if isinstance(node, ast.ImportFrom)]
        found.append((heading, [alias.asname for node in imports for alias in node.names if alias.asname]))
    return found or [("Names", list(importlib.import_module(f"geokit.{door}").__all__))]


def members(thing: type) -> list[str]:
    """Documented methods and properties of a class, and those of its bases that no door shows: queries of Surface."""
    own = [base for base in thing.__mro__ if re.match(r"geokit\.(?!core\b)", base.__module__)]
    shown = {each for base in own[1:] if _is_shown(base) for each in base.__mro__}
    named = {name: value for base in own if base not in shown for name, value in vars(base).items()}
    return [
        name
        for name, value in named.items()
        if not name.startswith("_")
        and (callable(value) or isinstance(value, (property, cached_property, classmethod, staticmethod)))
        and (inspect.getdoc(value) or "").strip()
    ]


def _is_shown(thing: type) -> bool:
    door = importlib.import_module(".".join(thing.__module__.split(".")[:2]))
    return thing.__name__ in getattr(door, "__all__", ())


def first_line(thing: object) -> str:
    text = (inspect.getdoc(thing) or "").split("\n\n")[0].replace("\n", " ")
    text = re.sub(r":\w+:`~?([^`<]+)`", r"`\1`", text).replace("``", "`").replace("|", r"\|")
    return re.sub(r"(?<=[.;:]) .*", "", text, count=1).rstrip(".:;")


def api_page(door: str) -> str:
    """The reference of a door: for each section a table of its names, then their docstrings."""
    module = importlib.import_module(f"geokit.{door}")
    lines = [f"# geokit.{door}", "", f"```{{eval-rst}}\n.. automodule:: geokit.{door}\n   :no-members:\n```", ""]
    for heading, names in sections(door):
        lines += [f"## {heading}", "", "| name | what it is |", "|---|---|"]
        for name in names:
            lines.append(f"| {{py:obj}}`{name} <geokit.{door}.{name}>` | {first_line(getattr(module, name))} |")
        lines += ["", "```{eval-rst}"]
        for name in names:
            thing, full = getattr(module, name), f"geokit.{door}.{name}"
            if inspect.isclass(thing) and issubclass(thing, Exception):
                lines += [f".. autoexception:: {full}", ""]
            elif inspect.isclass(thing):
                listed = members(thing)
                lines += [f".. autoclass:: {full}", *([f"   :members: {', '.join(listed)}"] if listed else []), ""]
            elif inspect.isfunction(thing):
                lines += [f".. autofunction:: {full}", ""]
            else:  # kernels' functions and structs of warp
                lines += [f".. py:data:: {full}", "", f"   {first_line(thing)}", ""]
        lines += ["```", ""]
    return "\n".join(lines)


def read_source(app: object, docname: str, source: list[str]) -> None:
    from sphinx.ext.autodoc.mock import mock

    if docname in ROOT_PAGES:
        source[0] = root_page(docname)
    elif docname.startswith("api/") and docname != "api/index":
        with mock(autodoc_mock_imports):
            source[0] = api_page(docname.removeprefix("api/"))
    source[0] = linked_to_pages(source[0], docname)


@cache
def held_by() -> dict[str, list[str]]:
    """By the name of what it holds, the files of tests in the table of held-by.md."""
    rows = re.findall(r"^\| `([\w.]+)` \| (.+) \|$", (DOCS / "held-by.md").read_text(encoding="utf-8"), re.MULTILINE)
    return {name: re.findall(r"`([^`]+)`", files) for name, files in rows}


def link_tests(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """The tests that hold a thing, after its docstring, as links to those files."""
    if files := [file for file in held_by().get(name, ()) if file.endswith(".py")]:
        links = ", ".join(f":download:`{file} </{os.path.relpath(ROOT / file, DOCS)}>`" for file in files)
        lines += ["", f"**Held by** {links}", ""]


def public_signature(app: object, what: str, name: str, thing: object, options: object, given: str, returned: str):
    """A signature without private fields of a dataclass, and with the names of aliases inside other types."""
    given = given and re.sub(r", _\w+: .*?(?=, \w+:|\)$)", "", given)
    return tuple(text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in (given, returned))


def setup(app: object) -> None:
    app.connect("source-read", read_source)
    app.connect("autodoc-process-docstring", link_tests, priority=400)
    app.connect("autodoc-process-signature", public_signature)
