"""The data of interactive pages, read back from their text; what is refused; how pages are shown."""

from __future__ import annotations

import base64
import html
import json
import re
import sys
import types
import webbrowser
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.errors import FileAccessError, InputError

BALL = mesh_catalog.icosphere(2)
# The scripts, the styles and the color maps.
BARE_BYTES = 80_000


class Read:
    """The scene of a page, and its arrays."""

    def __init__(self, page: gk.render.Page) -> None:
        held = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page.html)
        assert held
        self.scene = json.loads(held[1])
        self.texts = dict(re.findall(r'<script type="text/plain" id="array-(\d+)">(.*?)</script>', page.html))
        self.objects = self.scene["objects"]

    def array(self, said: dict[str, Any]) -> np.ndarray:
        kind = np.dtype("<" + said["type"])
        data = base64.b64decode(self.texts[str(said["id"])])
        if said["packed"]:
            planes = np.frombuffer(zlib.decompress(data, -15), np.uint8).reshape(kind.itemsize, -1)
            data = planes.T.tobytes()
        values = np.frombuffer(data, kind)
        if said["differences"]:
            values = np.cumsum(values, dtype=kind)
        return values.reshape(said["shape"])

    def world(self, local: np.ndarray) -> np.ndarray:
        return local.astype(np.float64) * self.scene["scale"] + self.scene["center"]

    def attribute(self, name: str, number: int = 0) -> np.ndarray:
        (found,) = [each for each in self.objects[number]["attributes"] if each["name"] == name]
        return self.array(found["values"])


def test_a_mesh_comes_back() -> None:
    count = BALL.face_count
    far = BALL.vertices + np.array([1e7, -2e6, 5.0])
    mesh = gk.mesh.TriangleMesh(
        far,
        BALL.faces,
        name="ball",
        vertex_data={"height": far[:, 2], "push": BALL.vertices, "color": np.tile([1.0, 0.5, 0.0], (len(far), 1))},
        face_data={"label": np.arange(count) + 2**24, "far": np.arange(count) + 2**40},
        corner_data={"share": np.arange(3.0 * count).reshape(count, 3)},
    )
    read = Read(gk.render.view(mesh))
    (said,) = read.objects
    assert (said["kind"], said["name"]) == ("mesh", "ball")
    assert np.abs(read.world(read.array(said["vertices"])) - far).max() < 1e-7 * np.sqrt(3.0)
    np.testing.assert_array_equal(read.array(said["faces"]), BALL.faces)
    np.testing.assert_array_equal(read.attribute("label"), mesh.face_data["label"])
    assert read.attribute("label").dtype == np.int32
    np.testing.assert_array_equal(read.attribute("far"), mesh.face_data["far"].astype(np.float32))
    np.testing.assert_array_equal(read.attribute("height"), far[:, 2].astype(np.float32))
    np.testing.assert_allclose(read.attribute("push"), np.linalg.norm(BALL.vertices, axis=1), rtol=1e-6)
    np.testing.assert_array_equal(read.attribute("share"), mesh.corner_data["share"])
    assert said["colors"]["at"] == "vertex"
    np.testing.assert_array_equal(read.array(said["colors"]["values"]), np.tile([255, 128, 0], (len(far), 1)))
    assert {each["name"] for each in said["attributes"]} == {"height", "push", "label", "far", "share"}


def test_vertices_at_one_position_are_one_for_normals() -> None:
    torn = gk.mesh.TriangleMesh(BALL.vertices[BALL.faces.reshape(-1)], np.arange(3 * BALL.face_count).reshape(-1, 3))
    read = Read(gk.render.view(BALL, torn))
    assert read.objects[0]["positions"] is None
    positions = read.array(read.objects[1]["positions"])
    assert read.objects[1]["position_count"] == BALL.vertex_count == len(np.unique(positions))
    # The same numbers are the same positions.
    first = np.unique(positions, return_index=True)[1]
    corners = torn.vertices[torn.faces].reshape(-1, 3)
    np.testing.assert_array_equal(corners[first][positions.reshape(-1)], corners)


def test_colors_of_materials_are_those_of_corners() -> None:
    materials = [gk.mesh.Material("red", (1.0, 0.0, 0.0, 1.0)), gk.mesh.Material("blue", (0.0, 0.0, 1.0, 1.0))]
    rows = np.arange(BALL.face_count) % 2
    mesh = gk.mesh.TriangleMesh(BALL.vertices, BALL.faces, face_data={"material": rows}, materials=materials)
    read = Read(gk.render.view(mesh))
    colors = read.array(read.objects[0]["colors"]["values"])
    np.testing.assert_array_equal(colors, 255 * np.array([[1, 0, 0], [0, 0, 1]])[rows][:, None].repeat(3, axis=1))


def test_transparent_materials_are_opacities_of_corners() -> None:
    materials = [
        gk.mesh.Material("glass", (1.0, 1.0, 1.0, 0.25)),
        gk.mesh.Material("leaf", (0.0, 1.0, 0.0, 0.25), alpha_cutoff=0.5),
        gk.mesh.Material("wall", (1.0, 0.0, 0.0, 1.0)),
    ]
    rows = np.arange(BALL.face_count) % 3
    mesh = gk.mesh.TriangleMesh(BALL.vertices, BALL.faces, face_data={"material": rows}, materials=materials)
    read = Read(gk.render.view(mesh))
    alpha = read.array(read.objects[0]["colors"]["alpha"])
    np.testing.assert_array_equal(alpha, np.array([64, 0, 255])[rows][:, None].repeat(3, axis=1))
    opaque = gk.mesh.TriangleMesh(BALL.vertices, BALL.faces, vertex_data={"color": np.ones((BALL.vertex_count, 4))})
    assert Read(gk.render.view(opaque)).objects[0]["colors"]["alpha"] is None


def half_error(values: np.ndarray) -> np.ndarray:
    return 5e-4 * np.abs(values) + 6e-8 * np.abs(values).max()


def test_a_level_set_comes_back() -> None:
    sdf = gk.volume.from_mesh(BALL, 0.1, half_width=2.0, device="cpu")
    read = Read(gk.render.view(sdf, names=["band"], device="cpu"))
    (said,) = read.objects
    assert (said["kind"], said["name"], said["class"], said["coarser"]) == ("volume", "band", "level set", 1.0)
    low, high = sdf.info.index_bounds + np.array([[-1], [1]])
    whole = gk.volume.to_dense(sdf, bounds=(low, high), device="cpu")
    assert tuple(said["shape"]) == whole.values.shape
    values = read.array(said["values"]).view(np.float16).T.astype(np.float64)
    assert (np.abs(values * said["scale"] - whole.values) <= half_error(whole.values)).all()
    assert said["low"] == whole.values.min()
    assert -said["from"] == said["to"] == whole.values.max()
    # Indices of the array to the world.
    matrix = np.reshape(said["matrix"], (4, 4))
    at = np.array([[0, 0, 0], [3, 5, 1]])
    there = read.world(at @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(there, (at + low) @ sdf.info.transform[:3, :3].T + sdf.info.transform[:3, 3], atol=1e-12)


@pytest.mark.parametrize("max_voxels", [1 << 12, 1 << 14, 1 << 17])
def test_large_volumes_are_coarser_within_the_stated_error(max_voxels: int) -> None:
    # A sphere of 100 voxels across: a band of 3 voxels falls between the largest of these steps.
    sdf = gk.volume.from_mesh(mesh_catalog.icosphere(5), 0.02, device="cpu")
    read = Read(gk.render.view(sdf, max_voxels=max_voxels, device="cpu"))
    (said,) = read.objects
    shape, matrix = said["shape"], np.reshape(said["matrix"], (4, 4)) * read.scene["scale"]
    assert max_voxels / 3 < np.prod(shape) <= max_voxels
    assert said["coarser"] > 1.5
    step = 0.02 * said["coarser"]
    np.testing.assert_allclose(np.diag(matrix)[:3], step)
    values = read.array(said["values"]).view(np.float16).T.astype(np.float64)
    # Where the field crosses zero between two samples along x.
    i, j, k = np.nonzero((values[:-1] < 0.0) != (values[1:] < 0.0))
    a, b = values[i, j, k], values[i + 1, j, k]
    at = np.stack([i + a / (a - b), j, k], axis=1)
    off = np.abs(np.linalg.norm(at * step + matrix[:3, 3] + read.scene["center"], axis=1) - 1.0)
    assert np.quantile(off, 0.99) < 0.2 * step


def test_other_grids() -> None:
    random = np.random.default_rng(1)
    fog = random.random((7, 9, 5)).astype(np.float32)
    arrows = random.random((4, 4, 4, 3)).astype(np.float32)
    labels = random.integers(1, 200, (5, 5, 5))
    volumes = [gk.volume.from_dense(values, voxel_size=0.5) for values in (fog, arrows, labels)]
    read = Read(gk.render.view(*volumes, device="cpu"))
    for said, values in zip(read.objects, (fog, np.linalg.norm(arrows, axis=3), labels), strict=True):
        held = read.array(said["values"]).view(np.float16).T.astype(np.float64)
        inner = held[1:-1, 1:-1, 1:-1] * said["scale"]
        assert (np.abs(inner - values) <= half_error(values)).all()
        assert (held[0] == 0.0).all()
        assert (said["class"], said["from"]) == ("fog", 0.0)


def test_long_boxes_fit_in_textures() -> None:
    ends = np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 0.0]])
    balls = gk.volume.from_points(ends, radius=1.0, voxel_size=0.25, device="cpu")
    (said,) = Read(gk.render.view(balls, device="cpu")).objects
    assert max(said["shape"]) <= 1024
    assert said["coarser"] > 1.0


def test_a_cloud_comes_back() -> None:
    random = np.random.default_rng(2)
    points = random.random((20_000, 3)) * [1e3, 1.0, 10.0]
    data = {
        "rgb": random.integers(0, 256, (20_000, 3), np.uint8),
        "time": random.random(20_000),
        "n": np.arange(20_000),
    }
    page = gk.render.view(gk.points.PointCloud(points, data))
    read = Read(page)
    (said,) = read.objects
    assert np.abs(read.world(read.array(said["vertices"])) - points).max() < 1e-7 * 1e3
    np.testing.assert_array_equal(read.array(said["colors"]["values"]), data["rgb"])
    np.testing.assert_array_equal(read.attribute("time"), data["time"].astype(np.float32))
    np.testing.assert_array_equal(read.attribute("n"), data["n"])
    # 12 bytes of position, 3 of color, 4 of time, in base64; ascending numbers take next to none.
    assert len(page.html) < BARE_BYTES + 20_000 * 19 * 4 / 3


def test_what_is_missing_and_infinite_stays() -> None:
    heat = np.array([1.0, np.nan, np.inf, 3.0])
    read = Read(gk.render.view(gk.points.PointCloud(np.eye(4, 3), {"heat": heat})))
    np.testing.assert_array_equal(read.attribute("heat"), heat.astype(np.float32))
    assert (read.objects[0]["attributes"][0]["low"], read.objects[0]["attributes"][0]["high"]) == (1.0, 3.0)


def test_color_maps_are_those_of_matplotlib() -> None:
    import matplotlib

    read = Read(gk.render.view(BALL, colormap="plasma"))
    tables = read.array(read.scene["colors"])
    assert read.scene["colormap"] == read.scene["maps"][0] == "plasma"
    for name, table in zip(read.scene["maps"], tables, strict=True):
        exact = matplotlib.colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
        assert np.abs(table / 255.0 - exact).max() <= 0.5 / 255.0 + 1e-12


def test_small_things_make_small_pages() -> None:
    assert len(gk.render.view(BALL).html) < BARE_BYTES
    sdf = gk.volume.from_mesh(BALL, 0.02, device="cpu")
    # A band compresses to less than its active voxels take.
    assert len(gk.render.view(sdf, device="cpu").html) < BARE_BYTES + 2 * (sdf.info.active_voxel_count or 0)


def test_the_page_is_alone_and_ascii() -> None:
    text = gk.render.view(BALL, title="Kugel \u00fc").html
    assert text.isascii()
    assert "<title>Kugel &#252;</title>" in text
    for outside in ("http", "src=", "url(", "@import", "import("):
        assert outside not in text, outside


def test_names_cannot_leave_their_place() -> None:
    evil = "</script><script>alert(1)</script><!--"
    page = gk.render.view(BALL, gk.points.PointCloud(BALL.vertices, {evil: BALL.vertices[:, 0]}), names=[evil, "b"])
    assert evil not in page.html
    read = Read(page)
    assert read.objects[0]["name"] == evil
    assert read.objects[1]["attributes"][0]["name"] == evil
    assert page.html.count("<script") == 2 + len(read.texts)


def test_the_same_page_twice() -> None:
    sdf = gk.volume.from_mesh(BALL, 0.2, device="cpu")
    assert gk.render.view(BALL, sdf, device="cpu").html == gk.render.view(BALL, sdf, device="cpu").html


def test_many_kinds_of_things() -> None:
    import pyvista

    surface = gk.mesh.Surface(BALL, device="cpu")
    pair = (BALL.vertices, BALL.faces)
    read = Read(gk.render.view(surface, pair, pyvista.Sphere(), BALL.vertices, [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    assert [each["kind"] for each in read.objects] == ["mesh", "mesh", "mesh", "cloud", "cloud"]


@pytest.mark.parametrize(
    ("things", "options", "named"),
    [
        ((), {}, "things: there is nothing to draw"),
        ((BALL, "a"), {}, r"things\[1\]: str"),
        ((BALL, {}), {}, r"things\[1\]: dict"),
        ((BALL, None), {}, r"things\[1\]: NoneType"),
        ((np.zeros((3, 2)),), {}, r"things\[0\]: shape \(3, 2\)"),
        (([[0.0, 0.0, np.nan]],), {}, r"things\[0\]: .*row 0"),
        ((np.zeros((0, 3)),), {}, r"things\[0\]: has no points"),
        ((gk.mesh.TriangleMesh(np.eye(3), np.zeros((0, 3), int)),), {}, r"things\[0\]: has no faces"),
        ((gk.mesh.TriangleMesh(1e39 * np.eye(3), [[0, 1, 2]]),), {}, r"things\[0\]: .*float32"),
        ((gk.volume.from_dense(np.zeros((2, 2, 2))),), {}, r"things\[0\]: .*no active voxels"),
        ((BALL,), {"names": ["a", "b"]}, "names: 2 names for 1"),
        ((BALL,), {"names": [3]}, r"names\[0\]"),
        ((BALL,), {"title": 3}, "title"),
        ((BALL,), {"up": "w"}, "up"),
        ((BALL,), {"colormap": "none such"}, "colormap"),
        ((BALL,), {"max_voxels": 100}, "max_voxels"),
        ((BALL,), {"path": "a.png"}, "a.png.*html"),
    ],
)
def test_refusals(things: Any, options: Any, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=named):
        gk.render.view(*things, **options)
    assert not list(tmp_path.iterdir())


class TestPage:
    def test_is_written(self, tmp_path: Path) -> None:
        page = gk.render.view(BALL, path=tmp_path / "a.html")
        assert page.path == tmp_path / "a.html"
        assert page.path.read_text(encoding="ascii") == page.html
        assert len(repr(page)) < 200
        with pytest.raises(FileAccessError):
            gk.render.view(BALL, path=tmp_path / "none" / "a.html")

    def test_a_notebook_shows_it(self) -> None:
        page = gk.render.view(BALL)
        shown = page._repr_html_()
        held = re.fullmatch(r'<iframe style="[^"]*" srcdoc="([^"]*)"></iframe>', shown)
        assert held
        assert html.unescape(held[1]) == page.html


class TestShow:
    @pytest.mark.parametrize(
        "thing", [BALL, gk.points.PointCloud(BALL.vertices), gk.volume.from_mesh(BALL, 0.2, device="cpu")], ids=type
    )
    def test_opens_a_browser(self, thing: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        opened: list[str] = []
        monkeypatch.setattr(webbrowser, "open", lambda address: bool(opened.append(address)) or True)
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        page = thing.show()
        assert page.path.parent.parent == tmp_path
        assert opened == [page.path.as_uri()]
        assert page.path.read_text() == page.html

    def test_not_with_a_path_and_not_in_a_notebook(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        def opened(_: str) -> bool:
            raise AssertionError

        monkeypatch.setattr(webbrowser, "open", opened)
        assert BALL.show(tmp_path / "a.html").path == tmp_path / "a.html"
        notebook = types.SimpleNamespace(get_ipython=lambda: types.SimpleNamespace(kernel=1))
        monkeypatch.setitem(sys.modules, "IPython", notebook)  # type: ignore[misc]
        assert BALL.show().path is None
