"""Interactive pages: a scene that a browser draws, in one file."""

from __future__ import annotations

import html
import json
import os
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geokit.core import launcher
from geokit.core.files import atomic_path, require_extension
from geokit.core.interop.types import Device
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_count, require_items, require_one_world, require_path
from geokit.errors import InputError
from geokit.render._camera import UP
from geokit.render.looks.checks import SEQUENTIAL, checked_colormap, checked_label

if TYPE_CHECKING:
    from geokit.render.viewer.arrays import Arrays

# 256^3: 32 MiB in the browser, and a texture that phones take.
MAX_VOXELS = 1 << 24
# Below, nothing can be recognized.
FEWEST_VOXELS = 1 << 12
# Of the frame in a notebook [pixels].
NOTEBOOK_HEIGHT = 520
# Scripts of a page: one scope, in this order.
SCRIPTS = ("data", "camera", "programs", "surfaces", "volumes", "picking", "panel", "viewer")
_VIEWER = Path(__file__).parent / "viewer"


@dataclass(frozen=True)
class Page:
    """A self-contained page; a notebook shows it below its cell.

    Attributes:
        html: Its text, ASCII.
        path: The file that it was written to; None if it was not.
    """

    html: str = field(repr=False)
    path: Path | None = None

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{NOTEBOOK_HEIGHT}px;border:0"
        return f'<iframe style="{style}" srcdoc="{html.escape(self.html)}"></iframe>'


def _bytes(*things: Any, max_voxels: int = MAX_VOXELS, **_: Any) -> float:
    """Arrays of float32, compressed, as text, and joined."""
    total = 0.0
    for thing in things:
        thing = getattr(thing, "mesh", thing)
        if hasattr(thing, "face_count"):
            total += 70 * thing.face_count
        elif hasattr(thing, "info"):
            box = thing.info.index_bounds
            total += 16 * min(max_voxels, 0 if box is None else int((box[1] - box[0] + 1).prod(dtype=float)))
        else:
            total += 60 * len(thing)
    return total


@needs(_bytes)
def view(
    *things: Any,
    path: str | os.PathLike[str] | None = None,
    names: Sequence[str] | None = None,
    title: str = "",
    colormap: str = SEQUENTIAL,
    up: str = "y",
    max_voxels: int = MAX_VOXELS,
    device: Device = None,
) -> Page:
    """Make an interactive page of meshes, volumes and clouds: one HTML file, which needs no network and no server.

    A browser with WebGL2 draws it. Surfaces show their colors, or any array by a color map; level sets a surface with a
    slider for its isovalue; other grids fog with a slider for its density; all grids slices along three axes; clouds
    points. A click prints the position, the number of the triangle or point, and the values there.

    Positions in the page are float32 relative to the middle of the scene: exact to 1e-7 of its size. Values of arrays
    are float32, or integers as they are. Voxels are half floats: exact to 5e-4 of themselves, and to 6e-8 of the
    largest one. Grids of more than ``max_voxels`` in their box are shown at larger steps, and the page says so; smooth
    surfaces then are within 0.2 of such a step for 99% of their points.
    Textures are not drawn, and vectors are shown by their length.

    Args:
        things: What to draw, at least one: TriangleMesh, Surface, PointCloud or SparseVolume, meshes and clouds of
            other libraries, pairs of arrays (vertices, faces), or points [world], shape (N, 3).
        path: Target, a .html file; None writes none.
        names: A name for each thing; None takes its own.
        title: Title of the page; "" is made of the names.
        colormap: The color map to begin with, of matplotlib; the page has some others to choose from.
        up: The world axis that points up at first: "x", "y" or "z".
        max_voxels: Most voxels of a volume's box in the page, at least 4096.
        device: The device that reads volumes; None for the first GPU, else the CPU.
    Returns:
        Page with the text and the path.
    Raises:
        InputError: Nothing to draw, an empty thing, one that cannot be drawn or lies beyond float32, an unknown axis or
            color map, another number of names, a file name without .html, or units or up axes that are known and
            differ.
        FileAccessError: The target cannot be written.
        UnsupportedGridError: A grid stores points, or indices without a channel.
    """
    from geokit.render.viewer.arrays import Arrays
    from geokit.render.viewer.scene import read_thing, scene_record

    target = None
    if path is not None:
        require_extension(path, (".html",), "page")
        target = require_path(path)
    require_choice(up, "up", UP)
    checked_label(title, "title")
    checked_colormap(colormap)
    max_voxels = require_count(max_voxels, "max_voxels", FEWEST_VOXELS)
    launcher.resolve_device(device)
    if not things:
        raise InputError("things: there is nothing to draw; give a mesh, a volume, a cloud, or points")
    found = [read_thing(thing, f"things[{row}]") for row, thing in enumerate(things)]
    said = {f"things[{row}]": getattr(thing, "info", thing) for row, thing in enumerate(found)}
    require_one_world(**{name: thing for name, thing in said.items() if hasattr(thing, "up_axis")})
    labels = [_name(thing) for thing in found]
    if names is not None:
        given: list[str] = require_items(names, "names", str)
        labels = [checked_label(name, f"names[{row}]") for row, name in enumerate(given)]
        if len(labels) != len(found):
            raise InputError(f"names: {len(labels)} names for {len(found)} things; give one for each")
    title = title or ", ".join(labels)
    arrays = Arrays()
    options: dict[str, Any] = {"title": title, "colormap": colormap, "up": up}
    scene = scene_record(found, labels, arrays, **options, max_voxels=max_voxels, device=device)
    text = _page_text(scene, arrays, title)
    if target is not None:
        with atomic_path(target) as part:
            part.write_text(text, encoding="ascii")
    return Page(text, target)


def _name(thing: Any) -> str:
    """Its own name, as far as fonts have it, else its kind."""
    name = thing.info.name if hasattr(thing, "info") else getattr(thing, "name", "")
    kind = {"TriangleMesh": "mesh", "PointCloud": "points", "SparseVolume": "volume"}[type(thing).__name__]
    return name.encode("utf-8", "replace").decode() or kind


@needs(lambda thing, *_, **__: _bytes(thing), fatal=True)
def show(thing: Any, path: str | os.PathLike[str] | None = None) -> Page:
    """A page of one thing, shown: below the cell of a notebook, elsewhere in the browser, unless ``path`` is given."""
    if path is not None or _in_notebook():
        return view(thing, path=path)
    page = view(thing, path=temporary_path())
    open_in_browser(page)
    return page


def temporary_path() -> Path:
    """A name for a page in a new folder, which stays: the browser may read the page at any later time."""
    return Path(tempfile.mkdtemp(prefix="geokit-view-")) / "view.html"


def open_in_browser(page: Page) -> bool:
    """Open a page that was written; False where no browser starts."""
    return page.path is not None and webbrowser.open(page.path.resolve().as_uri())


def _in_notebook() -> bool:
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and hasattr(shell, "kernel")


def _page_text(scene: dict[str, Any], arrays: Arrays, title: str) -> str:
    """The page, all of it ASCII: a text of one byte a character, and safe in any encoding.

    Args:
        scene: The scene, as JSON can hold it.
        arrays: The arrays that it names.
        title: The page's title.
    """
    script = "\n".join(_read(f"{name}.js") for name in SCRIPTS)
    # Within a script element "<" could end it.
    held = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")
    data = "\n".join(
        f'<script type="text/plain" id="array-{number}">{text}</script>' for number, text in enumerate(arrays.texts)
    )
    parts = {
        "title": html.escape(title).encode("ascii", "xmlcharrefreplace").decode("ascii"),
        "style": _read("viewer.css"),
        "scene": held,
        "arrays": data,
        "script": script,
    }
    before, *pieces = _read("viewer.html").split("{{")
    found = [before]
    for piece in pieces:
        name, _, rest = piece.partition("}}")
        found += [parts[name], rest]
    return "".join(found)


def _read(name: str) -> str:
    return (_VIEWER / name).read_text(encoding="ascii")
