"""Interactive pages in a real browser: pixels, clicks, sliders, themes, a phone, a frame of a notebook."""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support.browser import Browser, missing, running

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing())]

SIZE = (720, 420)
LIGHT, DARK = np.array([255, 255, 255]), np.array([20, 23, 28])
# From the front to the viewer, as geokit.render.figure has it [degrees].
AZIMUTH, ELEVATION = 28.8, 17.0
BALL = mesh_catalog.icosphere(3)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running() as found:
        yield found


class Shown:
    """A page in the browser."""

    def __init__(self, browser: Browser, path: Path) -> None:
        self.browser = browser
        browser.open(path)
        self.wait("return document.documentElement.dataset.ready === 'yes'")

    def wait(self, script: str) -> None:
        for _ in range(500):
            if self.browser.run(script):
                return
            time.sleep(0.02)
        raise AssertionError(self.browser.run("return document.getElementById('message').textContent") or script)

    def pixels(self) -> np.ndarray:
        """The canvas after what was asked for is drawn, from the top, (H, W, 3)."""
        from PIL import Image

        # What moved is drawn once more after 150 ms, in full; a later timer ends later.
        self.browser.run("return new Promise(done => setTimeout(() => requestAnimationFrame(() => done(1)), 165))")
        address = self.browser.run("return document.getElementById('canvas').toDataURL('image/png')")
        data = base64.b64decode(address.partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def covered(self, back: np.ndarray = LIGHT) -> float:
        """Share of the pixels that are not background."""
        return float((np.abs(self.pixels() - back).max(axis=2) > 12).mean())

    def box(self) -> tuple[float, float, float, float]:
        return tuple(
            self.browser.run(
                "const b = document.getElementById('canvas').getBoundingClientRect();"
                "return [b.left, b.top, b.width, b.height]"
            )
        )

    def place(self, x: float = 0.5, y: float = 0.5) -> tuple[float, float]:
        left, top, width, height = self.box()
        return left + x * width, top + y * height

    def pick(self, x: float = 0.5, y: float = 0.5, *, kind: str = "mouse") -> dict[str, str]:
        """What a click at a share of the canvas's width and height prints; empty where it hits nothing."""
        self.browser.click(*self.place(x, y), kind=kind)
        return self.browser.run(
            "const box = document.getElementById('picked'); if (box.hidden) return {};"
            "return Object.fromEntries([...box.querySelectorAll('td')].map(td => [td.dataset.name, td.textContent]))"
        )

    def slide(self, name: str, share: float) -> None:
        self.browser.run(
            "const input = document.querySelector(`[data-name='${arguments[0]}']`);"
            "input.value = Number(input.min) + arguments[1] * (Number(input.max) - Number(input.min));"
            "input.dispatchEvent(new Event('input'))",
            name,
            share,
        )

    def press(self, selector: str) -> None:
        self.browser.run("document.querySelector(arguments[0]).click()", selector)


def position(picked: dict[str, str]) -> np.ndarray:
    return np.array([float(number) for number in picked["position"].split(",")])


@pytest.fixture
def shown(browser: Browser, tmp_path: Path) -> Iterator[Callable[..., Shown]]:
    browser.size(*SIZE)
    browser.scheme("light")

    def make(*things: Any, **options: Any) -> Shown:
        gk.render.view(*things, path=tmp_path / "page.html", device="cpu", **options)
        return Shown(browser, tmp_path / "page.html")

    yield make
    assert browser.errors == []


def towards_viewer() -> np.ndarray:
    """Direction to the viewer, with z up."""
    turn, rise = np.radians([AZIMUTH, ELEVATION])
    return np.array([np.cos(rise) * np.sin(turn), -np.cos(rise) * np.cos(turn), np.sin(rise)])


def test_a_click_in_the_middle_finds_the_triangle(shown: Callable[..., Shown]) -> None:
    moved = BALL.vertices * [1.0, 2.0, 0.5] + [1000.0, -7.0, 3.0]
    height = 3.0 * moved[:, 2] + moved[:, 0]
    mesh = gk.mesh.TriangleMesh(
        moved, BALL.faces, vertex_data={"height": height}, face_data={"number": np.arange(BALL.face_count) * 7}
    )
    page = shown(mesh, up="z")
    found = page.pick()
    center, to_viewer = mesh.bounds.mean(axis=0), towards_viewer()
    hit = gk.mesh.Surface(mesh, device="cpu").raycast((center + 50.0 * to_viewer)[None], -to_viewer[None])
    assert int(found["triangle"]) == hit.triangle_id[0]
    exact = center + (50.0 - hit.t[0]) * to_viewer
    # A click is a pixel off the middle at most: half a pixel of some 0.01.
    assert np.abs(position(found) - exact).max() < 0.02
    on_surface = gk.mesh.Surface(mesh, device="cpu").closest_point(position(found)[None])
    assert on_surface.distance[0] < 1e-3  # seven digits of 1000
    assert int(found["number"]) == 7 * hit.triangle_id[0]
    assert float(found["height"]) == pytest.approx(3.0 * exact[2] + exact[0], abs=0.1)
    assert sorted(map(int, found["vertices"].split(","))) == sorted(mesh.faces[hit.triangle_id[0]])
    assert page.pick(0.02, 0.02) == {}


def test_what_is_transparent_is_seen_through(shown: Callable[..., Shown]) -> None:
    def colored(mesh: gk.mesh.TriangleMesh, *color: float) -> gk.mesh.TriangleMesh:
        values = np.tile(color, (mesh.vertex_count, 1))
        return gk.mesh.TriangleMesh(mesh.vertices, mesh.faces, vertex_data={"color": values})

    def middle(alpha: float) -> np.ndarray:
        around = gk.mesh.TriangleMesh(2.0 * BALL.vertices, BALL.faces)
        pixels = shown(colored(BALL, 1.0, 0.0, 0.0), colored(around, 0.0, 0.0, 1.0, alpha)).pixels()
        return pixels[pixels.shape[0] // 2, pixels.shape[1] // 2].astype(int)

    blue, both, red = middle(1.0), middle(0.4), middle(0.0)
    assert blue[2] > blue[0] + 60
    assert red[0] > red[2] + 60
    # The nearest faces alone: 40% of their light, and 60% of what lies behind.
    np.testing.assert_allclose(both, 0.4 * blue + 0.6 * red, rtol=0, atol=6)


def test_a_mesh_is_drawn_in_its_colors(shown: Callable[..., Shown]) -> None:
    red = np.tile(np.array([255, 0, 0], np.uint8), (BALL.vertex_count, 1))
    heat = BALL.vertices[:, 0]
    page = shown(gk.mesh.TriangleMesh(BALL.vertices, BALL.faces, vertex_data={"color": red, "heat": heat}))
    pixels = page.pixels()
    height, width = pixels.shape[:2]
    red_part, green, blue = pixels[height // 2, width // 2]
    assert red_part > 120
    assert max(green, blue) < 70
    assert 0.2 < page.covered() < 0.7
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50
    # A disk of the right size: of the box around the ball, the corners fit.
    rows = np.flatnonzero((np.abs(pixels - LIGHT).max(axis=2) > 12).any(axis=1))
    assert 0.5 * height < np.ptp(rows) < 0.65 * height
    # By the attribute: blue at one side, yellow at the other.
    page.browser.run("const s = document.querySelector('#panel select'); s.value = '0'; s.onchange()")
    pixels = page.pixels()
    left, right = (pixels[height // 2, width // 2 + side * height // 4] for side in (-1, 1))
    assert left[2] > left[1]
    assert right[1] > right[2] + 40
    page.slide("opacity", 0.3)
    assert 0.2 < page.covered() < 0.7
    assert page.pixels().mean() > pixels.mean() + 5
    page.press("[data-name='show-0']")
    assert page.covered() == 0.0
    assert page.pick() == {}


def test_two_objects_hide_each_other(shown: Callable[..., Shown]) -> None:
    small = gk.mesh.TriangleMesh(0.5 * BALL.vertices, BALL.faces)
    page = shown(BALL, small, names=["large", "small"], up="z")
    assert np.linalg.norm(position(page.pick())) == pytest.approx(1.0, abs=0.02)
    page.press("[data-name='show-0']")
    assert np.linalg.norm(position(page.pick())) == pytest.approx(0.5, abs=0.02)
    assert page.browser.run("return document.querySelector('#picked b').textContent") == "small"


def test_the_isovalue_moves_the_surface(shown: Callable[..., Shown], browser: Browser) -> None:
    sdf = gk.volume.from_mesh(mesh_catalog.icosphere(4), 0.1, half_width=3.0, device="cpu")
    browser.size(560, 320)  # rays take long without a GPU
    page = shown(sdf, up="z")
    found = page.pick()
    assert float(found["value"]) == pytest.approx(0.0, abs=1e-4)
    assert np.linalg.norm(position(found)) == pytest.approx(1.0, abs=5e-3)
    at = position(found) / np.linalg.norm(position(found))
    assert at @ towards_viewer() > 0.999
    assert len(np.unique(page.pixels().reshape(-1, 3), axis=0)) > 50
    shares = [page.covered()]
    for share, radius in ((0.9, 1.24), (0.1, 0.76)):
        page.slide("isovalue", share)
        shares.append(page.covered())
        assert np.linalg.norm(position(page.pick())) == pytest.approx(radius, abs=0.01)
    # Disks: their areas are as the squares of the radii, but for perspective.
    assert shares[1] / shares[0] == pytest.approx(1.24**2, rel=0.1)
    assert shares[2] / shares[0] == pytest.approx(0.76**2, rel=0.1)


def test_rotated_voxels(shown: Callable[..., Shown]) -> None:
    turn = np.eye(4)
    turn[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    turn[:3, :3] *= [0.1, 0.1, 0.05]
    turn[:3, 3] = [50.0, 60.0, -70.0]
    index = np.stack(np.meshgrid(*[np.arange(-9.0, 10.0)] * 3, indexing="ij"), axis=-1)
    values = index[..., 0] + 0.5 * index[..., 1]  # a slanted plane through index 0
    sheet = gk.volume.from_dense(values + 100.0, transform=turn, origin=(-9, -9, -9), name="sheet")
    page = shown(sheet, up="z")
    page.browser.run("const s = document.querySelector('#panel select'); s.value = 'surface'; s.onchange()")
    page.slide("isovalue", 100.0 / (100.0 + 13.5))
    found = page.pick()
    at = np.linalg.inv(turn) @ [*position(found), 1.0]
    assert at[0] + 0.5 * at[1] == pytest.approx(0.0, abs=0.2)  # half floats of 113
    assert float(found["value"]) == pytest.approx(100.0, abs=0.06)


def test_a_panel_names_the_grid_of_a_file(shown: Callable[..., Shown]) -> None:
    ball = gk.volume.from_mesh(BALL, 0.1)
    named = gk.volume.from_dense(np.ones((3, 3, 3)), name="<b>density")
    page = shown(ball, named, names=["ball.vdb", "smoke.vdb"])
    facts = page.browser.run("return [...document.querySelectorAll('.facts')].map(p => p.textContent)")
    assert [text.partition(":")[0] for text in facts] == [f"level set {ball.info.name}".strip(), "volume <b>density"]


def test_fog_and_what_stands_in_it(shown: Callable[..., Shown]) -> None:
    at = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 41)] * 3, indexing="ij"), axis=-1)
    puff = np.clip(1.0 - np.linalg.norm(at, axis=-1), 0.0, None)
    fog = gk.volume.from_dense(puff, voxel_size=0.05, origin=(-20, -20, -20), grid_class="fog volume", name="puff")
    page = shown(fog, gk.mesh.TriangleMesh(0.3 * BALL.vertices, BALL.faces))
    page.press("[data-name='show-1']")
    thin = page.pixels()
    # The bar ends at a percentile, and says so.
    least, most = page.browser.run("return [...document.querySelectorAll('#legend div span')].map(s => s.textContent)")
    assert least == "0"
    assert most.startswith("\u2265 0.")
    page.slide("density", 0.9)
    thick = page.pixels()
    height, width = thin.shape[:2]
    assert thin.min() < 200
    assert np.abs(thick - LIGHT).sum() > 1.2 * np.abs(thin - LIGHT).sum()
    # The densest is in the middle.
    found = page.pick()
    assert float(found["greatest value"]) == pytest.approx(1.0, abs=0.05)
    assert np.linalg.norm(position(found)) < 0.06
    # A ball in thin fog shows, a bit veiled; through it nothing is seen of the fog behind.
    page.slide("density", 0.1)
    below = (height // 2 + height // 14, width // 2)  # the mark is in the middle
    fog_alone = page.pixels()[below]
    page.press("[data-name='show-1']")
    assert np.abs(page.pixels()[below] - fog_alone).max() > 30
    assert "triangle" in page.pick()


def test_slices(shown: Callable[..., Shown]) -> None:
    at = np.arange(1.0, 22.0)
    ramp = np.broadcast_to(at, (21, 21, 21)).copy()  # grows along z
    page = shown(gk.volume.from_dense(ramp, voxel_size=0.1, background=0.0, name="ramp"), up="z")
    page.browser.run("const s = document.querySelector('#panel select'); s.value = 'none'; s.onchange()")
    assert page.covered() == 0.0
    seen = []
    for axis in "xyz":
        page.press(f"[data-name='slice-{axis}-on']")
        seen.append(page.pixels())
    assert np.abs(seen[0] - seen[1]).max() > 50
    page.slide("slice-z", 0.55)
    assert np.abs(page.pixels() - seen[2]).max() > 50
    for axis in "xy":
        page.press(f"[data-name='slice-{axis}-on']")
    found = page.pick()
    # The box has a voxel more at each end: 0.55 of 22 voxels from index -1.
    assert position(found)[2] == pytest.approx(0.1 * (0.55 * 22 - 1), abs=1e-3)
    assert float(found["value"]) == pytest.approx(0.55 * 22, abs=0.02)
    # One value, but for the rim, where it fades to the background.
    _, counts = np.unique(page.pixels().reshape(-1, 3), axis=0, return_counts=True)
    area = counts.sum() - counts.max()
    assert np.sort(counts)[-2] > 0.6 * area


def test_a_cloud(shown: Callable[..., Shown]) -> None:
    points = np.random.default_rng(3).normal(size=(100_000, 3))
    page = shown(gk.points.PointCloud(points, {"radius": np.linalg.norm(points, axis=1)}), up="z")
    assert page.covered() > 0.02
    assert len(np.unique(page.pixels().reshape(-1, 3), axis=0)) > 100
    found = page.pick()
    number = int(found["point"])
    np.testing.assert_allclose(position(found), points[number], atol=2e-6)
    assert float(found["radius"]) == pytest.approx(np.linalg.norm(points[number]), rel=1e-6)
    before = page.covered()
    page.slide("size", 0.5)
    assert page.covered() > before + 0.02


def test_the_mouse_turns_moves_and_zooms(shown: Callable[..., Shown]) -> None:
    page = shown(gk.mesh.box(size=(1.0, 2.0, 3.0)), up="z")
    start = page.pixels()
    page.browser.drag(page.place(0.4, 0.5), page.place(0.6, 0.6))
    turned = page.pixels()
    assert np.abs(turned - start).max() > 50
    page.browser.drag(page.place(0.5, 0.5), page.place(0.7, 0.5), button=2)
    columns = [np.flatnonzero((image != LIGHT).any(axis=(0, 2))).mean() for image in (turned, page.pixels())]
    assert columns[1] - columns[0] == pytest.approx(0.2 * page.box()[2], rel=0.15)
    page.press("#fit")
    before = page.covered()
    x, y = page.place()
    page.browser.scroll(x, y, 400)
    assert page.covered() < 0.7 * before
    page.press("#fit")
    assert page.covered() == pytest.approx(before, rel=0.02)
    page.browser.run("const s = document.getElementById('up'); s.value = 'x'; s.onchange()")
    assert np.abs(page.pixels() - start).max() > 50


def test_light_and_dark(shown: Callable[..., Shown], browser: Browser) -> None:
    page = shown(BALL)
    assert (page.pixels()[2, 2] == LIGHT).all()
    browser.scheme("dark")
    assert (page.pixels()[2, 2] == DARK).all()
    color = "return getComputedStyle(document.body).color"
    assert browser.run(color) == "rgb(230, 233, 238)"
    page.press("#theme")
    assert (page.pixels()[2, 2] == LIGHT).all()
    assert browser.run(color) == "rgb(29, 36, 48)"


def test_a_screenshot_is_a_file(shown: Callable[..., Shown], browser: Browser, tmp_path: Path) -> None:
    from PIL import Image

    page = shown(gk.mesh.TriangleMesh(BALL.vertices, BALL.faces, vertex_data={"heat": BALL.vertices[:, 0]}))
    browser.devtools("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.press("#shot")
    target = tmp_path / "geokit.png"
    for _ in range(200):
        if target.exists():
            break
        time.sleep(0.05)
    saved = np.asarray(Image.open(target).convert("RGB")).astype(int)
    drawn = page.pixels()
    assert saved.shape == drawn.shape
    # But for the legend in its corner the two are one picture.
    assert (saved[:-60] == drawn[:-60]).all()
    assert (saved[-60:, -250:] != drawn[-60:, -250:]).any()


def test_on_a_phone(shown: Callable[..., Shown], browser: Browser) -> None:
    browser.size(390, 844, mobile=True)
    page = shown(BALL, gk.points.PointCloud(BALL.vertices), title="a title that is much too long for a phone's width")
    assert browser.run("return document.documentElement.scrollWidth") <= 390
    outside = (
        "return [...document.querySelectorAll('button, select, h1')].filter(e => e.offsetParent &&"
        " e.getBoundingClientRect().right > 391).map(e => e.id || e.tagName)"
    )
    assert browser.run(outside) == []
    left, _, width, height = page.box()
    assert (left, width) == (0, 390)
    assert height > 500
    assert "triangle" in page.pick(0.5, 0.5, kind="touch")
    page.press("#panel-button")
    assert browser.run(outside) == []
    assert page.box()[3] > 300
    assert page.covered() > 0.1


def shown_in_jupyter() -> str:
    """What a cell that ends in `show()` shows, from a kernel of its own."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    cell = nbformat.v4.new_code_cell("import geokit as gk\ngk.mesh.sphere().show()")
    notebook = nbformat.v4.new_notebook(cells=[cell])
    done = nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    (shown,) = [out for out in done.cells[0].outputs if out.output_type == "execute_result"]
    return shown.data["text/html"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_a_frame_of_a_notebook(shown: Callable[..., Shown], browser: Browser, tmp_path: Path) -> None:
    target = tmp_path / "notebook.html"
    target.write_text(f"<!DOCTYPE html><body>{shown_in_jupyter()}</body>")
    browser.open(target)
    for _ in range(200):
        inner = "const inside = document.querySelector('iframe').contentDocument; "
        if browser.run(inner + "return inside.documentElement.dataset.ready === 'yes'"):
            break
        time.sleep(0.05)
    assert browser.run(inner + "return inside.getElementById('message').hidden")
    assert browser.run(inner + "return inside.getElementById('canvas').width") > 300


def test_nothing_is_fetched_and_nothing_evil_runs(shown: Callable[..., Shown], browser: Browser) -> None:
    evil = "</script><script>document.title = 'caught'</script><img src=x onerror=\"document.title='caught'\">"
    mesh = gk.mesh.TriangleMesh(BALL.vertices, BALL.faces, vertex_data={evil: BALL.vertices[:, 0]}, name=evil)
    page = shown(mesh)
    assert evil in page.pick()
    assert browser.run("return document.title") == evil
    assert browser.run("return performance.getEntriesByType('resource').map(entry => entry.name)") == []


def test_a_browser_without_webgl2_says_so(browser: Browser, tmp_path: Path) -> None:
    script = "HTMLCanvasElement.prototype.getContext = () => null"
    added = browser.devtools("Page.addScriptToEvaluateOnNewDocument", source=script)
    gk.render.view(BALL, path=tmp_path / "page.html")
    browser.open(tmp_path / "page.html")
    browser.devtools("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert "WebGL2" in browser.run("return document.getElementById('message').innerText")
    assert not browser.run("return document.getElementById('message').hidden")
