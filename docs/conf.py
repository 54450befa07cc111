"""How Sphinx builds the site: `./dev docs` writes it to site/.

Pages are the Markdown files beside this one. Four things are made here, so that they are written down once: pages of
the files in the repository's root, the API reference (sections of each door's `__init__.pyi`, texts of the docstrings),
the links of docstrings to the tests that hold them, and `llms.txt`.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import os
import re
import shutil
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
    "navigation_depth": 3,
    "footer_start": [],
    "footer_end": [],
}
html_context = {"default_mode": "auto"}

# Members from which on a class has a page of its own.
LONG = 6
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


def described(full: str, thing: object) -> list[str]:
    """The directive of a public name, with the members of a class."""
    if inspect.isclass(thing):
        kind = "autoexception" if issubclass(thing, Exception) else "autoclass"
        listed = members(thing) if kind == "autoclass" else []
        return [f".. {kind}:: {full}", *([f"   :members: {', '.join(listed)}"] if listed else []), ""]
    if inspect.isfunction(thing):
        return [f".. autofunction:: {full}", ""]
    return [f".. py:data:: {full}", "", f"   {first_line(thing)}", ""]  # kernels' functions and structs of warp


def api_pages(door: str) -> dict[str, str]:
    """The reference of a door by page: tables of its names, docstrings of each section, and of each class with methods.

    A door with one section is one page, but for its classes.
    """
    module, parts, made = importlib.import_module(f"geokit.{door}"), sections(door), {}
    head = [f"# geokit.{door}", "", f"```{{eval-rst}}\n.. automodule:: geokit.{door}\n   :no-members:\n```", ""]
    for heading, names in parts:
        head += [f"## {heading}", "", "| name | what it is |", "|---|---|"]
        body: list[str] = []
        for name in names:
            thing, full = getattr(module, name), f"geokit.{door}.{name}"
            head.append(f"| {{py:obj}}`{name} <{full}>` | {first_line(thing)} |")
            lines = described(full, thing)
            if inspect.isclass(thing) and len(members(thing)) >= LONG:
                made[f"{door}/{name}"] = "\n".join([f"# {full}", "", "```{eval-rst}", *lines, "```", ""])
            else:
                body += lines
        head.append("")
        if body and len(parts) > 1:
            page = re.sub(r"\W+", "-", re.split("[:;]", heading)[0].lower())
            made[f"{door}/{page}"] = "\n".join([f"# {heading}", "", "```{eval-rst}", *body, "```", ""])
        elif body:
            head += ["```{eval-rst}", *body, "```", ""]
    if made:
        head += ["```{toctree}", ":hidden:", "", *made, "```", ""]
    return {door: "\n".join(head), **made}


def write_pages(app: object, config: object) -> None:
    """Write the pages of sections and classes beside those of the doors, which are made when they are read."""
    from sphinx.ext.autodoc.mock import mock

    for stub in (DOCS / "api").glob("*.md"):
        shutil.rmtree(stub.with_suffix(""), ignore_errors=True)
        with mock(autodoc_mock_imports):
            made = {} if stub.stem == "index" else api_pages(stub.stem)
        for page, text in made.items():
            if page != stub.stem:
                stub.with_suffix("").mkdir(exist_ok=True)
                (DOCS / "api" / f"{page}.md").write_text(text, encoding="utf-8")


def first_sentence(text: str) -> str:
    """Of the first paragraph of a page that is prose."""
    for paragraph in re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL).split("\n\n"):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(paragraph.split()))
        if re.match(r"[A-Z`\"*]", plain):
            return re.split(r"(?<=[.?!])\s", plain)[0].rstrip(":")
    return ""


def index_for_models() -> str:
    """``llms.txt`` (llmstxt.org): every page of the site with its first sentence, in the order of the site."""
    summary = first_sentence((ROOT / "README.md").read_text(encoding="utf-8"))
    lines, done = ["# geokit", "", f"> {summary}", ""], set()

    def add(page: Path, level: int) -> None:
        if page in done:  # a pattern names those beside it, too
            return
        done.add(page)
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        text = root_page(name) if name in ROOT_PAGES else page.read_text(encoding="utf-8")
        door = re.fullmatch(r"api/(?!index)(\w+)", name)
        said = first_line(importlib.import_module(f"geokit.{door[1]}")) if door else first_sentence(text)
        if name != "index":
            title = re.search(r"^# (.*)", text, re.MULTILINE)[1]
            lines.append(f"{'  ' * level}- [{title}]({name}.html): {said}")
        for body in re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            for entry in (line for line in body.splitlines() if line and not line.startswith(":")):
                for child in sorted(page.parent.glob(re.sub(r"^.*<(.*)>$", r"\1", entry) + ".md")):
                    add(child, level + (page.stem != "index" or page.parent != DOCS))

    add(DOCS / "index.md", 0)
    return "\n".join(lines) + "\n"


def write_index(app: object, error: object) -> None:
    from sphinx.ext.autodoc.mock import mock

    with mock(autodoc_mock_imports):
        (Path(app.outdir) / "llms.txt").write_text(index_for_models(), encoding="utf-8")


def read_source(app: object, docname: str, source: list[str]) -> None:
    from sphinx.ext.autodoc.mock import mock

    if docname in ROOT_PAGES:
        source[0] = root_page(docname)
    elif re.fullmatch(r"api/(?!index)\w+", docname):
        with mock(autodoc_mock_imports):
            source[0] = api_pages(docname.removeprefix("api/"))[docname.removeprefix("api/")]
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
    app.connect("config-inited", write_pages)
    app.connect("build-finished", write_index)
    app.connect("source-read", read_source)
    app.connect("autodoc-process-docstring", link_tests, priority=400)
    app.connect("autodoc-process-signature", public_signature)
