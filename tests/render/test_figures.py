"""Off-screen figures: what is drawn, where, and what is refused."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from geokit import render
from geokit.errors import FileAccessError, InputError
from geokit.mesh import TriangleMesh
from geokit.render import _backend
from geokit.render._scene import round_values
from geokit.volume import gradient_field

SIZE = (400, 300)


@pytest.fixture
def sphere() -> TriangleMesh:
    """A unit sphere of latitudes and longitudes, wound outwards."""
    around, down = 48, 24
    theta, phi = np.meshgrid(
        2.0 * np.pi * np.arange(around) / around, np.pi * np.arange(down + 1) / down, indexing="ij"
    )
    vertices = np.stack([np.sin(phi) * np.cos(theta), np.cos(phi), -np.sin(phi) * np.sin(theta)], axis=-1)
    i, j = np.meshgrid(np.arange(around), np.arange(down), indexing="ij")

    def index(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a % around) * (down + 1) + b

    corners = index(i, j), index(i, j + 1), index(i + 1, j + 1), index(i + 1, j)
    faces = [np.stack([corners[k] for k in triple], axis=-1).reshape(-1, 3) for triple in ((0, 1, 2), (0, 2, 3))]
    return TriangleMesh(vertices.reshape(-1, 3), np.concatenate(faces))


@pytest.fixture(scope="module")
def ball():
    """The level set of a sphere of radius 0.5 in voxels of 0.05, made by the package itself."""
    from geokit.volume import from_mesh

    step = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    rings = np.linspace(0.0, np.pi, 17)
    vertices = [
        (0.5 * np.sin(p) * np.cos(t), 0.5 * np.cos(p), -0.5 * np.sin(p) * np.sin(t)) for t in step for p in rings
    ]
    faces = []
    for i in range(32):
        for j in range(16):
            a, b = i * 17 + j, ((i + 1) % 32) * 17 + j
            faces += [(a, a + 1, b + 1), (a, b + 1, b)]
    return from_mesh(TriangleMesh(vertices, faces, name="ball"), 0.05, device="cpu")


def pixels(path: Path) -> np.ndarray:
    """The picture's channels in [0, 1], shape (H, W, 3 or 4)."""
    from matplotlib.image import imread

    return imread(path)


def drawn(path: Path) -> np.ndarray:
    """Where the picture is not white, shape (H, W)."""
    return (pixels(path)[..., :3] < 0.97).any(axis=-1)


@pytest.mark.slow
def test_a_mesh_is_drawn_in_the_middle_on_white(tmp_path: Path, sphere: TriangleMesh) -> None:
    target = render.figure(tmp_path / "sphere.png", mesh=sphere, size=SIZE)
    picture = pixels(target)
    assert picture.shape[:2] == (300, 400)
    assert (picture[[0, -1], :, :3] == 1.0).all()
    mask = drawn(target)
    rows, columns = np.nonzero(mask)
    # A sphere in perspective is round: as wide as high, centered, and filled to pi / 4 of its box.
    width, height = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert abs(width - height) <= 4
    assert abs(rows.mean() - 149.5) < 3
    assert abs(columns.mean() - 199.5) < 3
    assert mask.sum() == pytest.approx(np.pi / 4 * width * height, rel=0.02)
    assert height > 150


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path, sphere: TriangleMesh) -> None:
    first = render.figure(tmp_path / "a.png", mesh=sphere, size=SIZE).read_bytes()
    assert render.figure(tmp_path / "b.png", mesh=sphere, size=SIZE).read_bytes() == first


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_up_points_up(tmp_path: Path, sphere: TriangleMesh, up: str) -> None:
    axis = "xyz".index(up)
    target = render.figure(
        tmp_path / f"{up}.png", mesh=sphere, color=sphere.vertices[:, axis], colormap="gray", up=up, size=SIZE
    )
    left = pixels(target)[:, :320, :3].mean(axis=-1)
    rows = np.nonzero(drawn(target)[:, :320].any(axis=1))[0]
    middle = (rows[0] + rows[-1]) // 2
    column = int(np.nonzero(drawn(target)[middle, :320])[0].mean())
    assert left[rows[0] + 20, column] > left[rows[-1] - 20, column] + 0.2


def test_values_color_vertices_or_faces(tmp_path: Path, sphere: TriangleMesh) -> None:
    by_vertex = render.figure(tmp_path / "v.png", mesh=sphere, color=sphere.vertices[:, 1], label="height", size=SIZE)
    by_face = render.figure(
        tmp_path / "f.png", mesh=sphere, color=sphere.vertices[sphere.faces[:, 0], 1], label="height", size=SIZE
    )
    for path in (by_vertex, by_face):
        picture = pixels(path)[..., :3]
        # The color bar stands at the right; viridis runs from violet to yellow.
        assert drawn(path)[:, 340:].any()
        spread = (picture.max(axis=-1) - picture.min(axis=-1))[:, :320]
        assert spread.max() > 0.4
    assert np.abs(pixels(by_vertex) - pixels(by_face))[..., :3].mean() < 0.02


@pytest.mark.parametrize(
    ("limits", "labels"),
    [
        ((-0.02, 0.0200001), [-0.02, -0.01, 0.0, 0.01, 0.02]),
        ((8.98e-06, 0.0161), [0.005, 0.01, 0.015]),
        ((0.86, 146.0), [50, 100]),
        ((-4.0, 4.0), [-4, -2, 0, 2, 4]),
        ((1e9, 1e9 + 3), [1e9, 1e9 + 1, 1e9 + 2, 1e9 + 3]),
    ],
)
def test_color_bars_are_labeled_at_round_values(limits: tuple[float, float], labels: list[float]) -> None:
    assert round_values(*limits) == pytest.approx(labels, rel=1e-12)


@pytest.mark.parametrize("limits", [None, (-0.5, 0.5), (-0.5, 2.0), (-2.0, 0.5)])
def test_color_bars_say_where_values_lie_beyond(
    tmp_path: Path, sphere: TriangleMesh, limits: tuple[float, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from geokit.render import _scene

    written = []
    say = _scene._say_ends

    def noted(plotter, bar, title, values) -> None:
        before = set(plotter.actors)
        say(plotter, bar, title, values)
        written.append(bar.GetTitle())
        written.extend(plotter.actors[name].input for name in set(plotter.actors) - before)

    monkeypatch.setattr(_scene, "_say_ends", noted)
    low, high = sphere.vertices[:, 2].min(), sphere.vertices[:, 2].max()
    render.figure(
        tmp_path / "a.png", mesh=sphere, color=sphere.vertices[:, 2], value_limits=limits, label="z", size=SIZE
    )
    beyond = limits and limits[1] < high, limits and limits[0] > low
    assert written == ["z\n\u2265 0.5" if beyond[0] else "z", *(["\u2264 -0.5"] if beyond[1] else [])]


def test_fog_says_that_its_bar_ends_at_a_percentile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from geokit import volume
    from geokit.render import _scene

    seen = []
    monkeypatch.setattr(_scene, "_say_ends", lambda plotter, bar, title, values: seen.append((title, values)))
    values = np.linspace(0.0, 1.0, 1000).reshape(10, 10, 10) ** 8
    fog = volume.from_dense(values, voxel_size=1.0, grid_class="fog volume", name="puff")
    render.figure(tmp_path / "fog.png", volume=fog, size=SIZE)
    ((title, (low, high)),) = seen
    assert title == "puff"
    assert low == 0.0
    assert high == pytest.approx(1.0, abs=1e-6)


def test_points_are_drawn_over_a_mesh(tmp_path: Path, sphere: TriangleMesh) -> None:
    alone = pixels(render.figure(tmp_path / "a.png", mesh=sphere, size=SIZE))[..., :3]
    both = pixels(
        render.figure(tmp_path / "b.png", mesh=sphere, points=[[0.0, 0.0, 1.2]], point_color="red", size=SIZE)
    )[..., :3]
    red = (both[..., 0] > 0.4) & (both[..., 1] < 0.2)
    assert not ((alone[..., 0] > 0.4) & (alone[..., 1] < 0.2)).any()
    assert 5 < red.sum() < 400


def test_a_level_set_is_drawn_as_its_surface(tmp_path: Path, ball) -> None:
    mask = drawn(render.figure(tmp_path / "ball.png", volume=ball, size=SIZE))
    rows, columns = np.nonzero(mask)
    assert mask.sum() == pytest.approx(np.pi / 4 * (np.ptp(rows) + 1) * (np.ptp(columns) + 1), rel=0.05)


def test_other_grids_are_drawn_as_fog(tmp_path: Path, ball) -> None:
    import dataclasses

    fog = dataclasses.replace(ball, info=dataclasses.replace(ball.info, grid_class="fog volume"), _uploads={})
    target = render.figure(tmp_path / "fog.png", volume=fog, size=SIZE)
    # Fog brings a color bar along, and covers its box.
    mask = drawn(target)
    assert mask[:, 340:].any()
    assert mask[:, :320].mean() > 0.1


def test_fog_shows_its_density_and_not_its_box(tmp_path: Path) -> None:
    from benchmarks.catalog.float_grids import build_float_grid
    from geokit.volume.model.sparse_volume import SparseVolume
    from geokit.volume.nanovdb.header import info_of

    # A soft ball of radius 10 in the middle of a block of 32^3 voxels that are zero around it, 0.01 wide each.
    origins = 8 * np.stack(np.meshgrid(*[np.arange(-2, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.linalg.norm(origins[:, None] + inside + 0.5, axis=2)
    values = np.clip(1.0 - radius / 10.0, 0.0, None).astype(np.float32)
    buffer = build_float_grid(
        origins.astype(np.int32), values, np.ones(values.shape, bool), background=0.0,
        transform=np.diag([0.01, 0.01, 0.01, 1.0]), name="ball", grid_class="fog volume", signed_fill=False,
    )  # fmt: skip
    target = render.figure(tmp_path / "fog.png", volume=SparseVolume(buffer, info_of(buffer, {})), size=SIZE)
    mask = drawn(target)[:, :320]
    rows, columns = np.nonzero(mask)
    # Round: a disc, neither the hexagon of a box nor a few displaced slabs.
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert height == pytest.approx(width, rel=0.1)
    assert mask.sum() == pytest.approx(np.pi / 4 * height * width, rel=0.08)


def test_without_a_surface_at_the_isovalue_nothing_is_drawn(tmp_path: Path, ball) -> None:
    with pytest.raises(InputError, match="no surface at 9"), pytest.warns(UserWarning, match="its values are"):
        render.figure(tmp_path / "none.png", volume=ball, isovalue=9.0, size=SIZE)
    assert list(tmp_path.iterdir()) == []


def test_transparent_background(tmp_path: Path, sphere: TriangleMesh) -> None:
    picture = pixels(render.figure(tmp_path / "t.png", mesh=sphere, transparent=True, size=SIZE))
    assert picture.shape[2] == 4
    assert picture[0, 0, 3] == 0.0
    assert picture[150, 200, 3] == 1.0


def test_bad_requests_are_named(tmp_path: Path, sphere: TriangleMesh) -> None:
    target = tmp_path / "x.png"
    cases = [
        ("nothing to draw", {}),
        ("outside 64 to 8192", {"mesh": sphere, "size": (10, 10)}),
        ("is not \\(width, height\\)", {"mesh": sphere, "size": "big"}),
        ("is not known; use one of", {"mesh": sphere, "up": "w"}),
        ("is not a color", {"mesh": sphere, "color": "no such color"}),
        ("does not match", {"mesh": sphere, "color": [1.0, 2.0]}),
        ("is not a real number type", {"mesh": sphere, "color": ["a"] * 3}),
        ("is not \\(N, 3\\)", {"points": [[1.0, 2.0]]}),
        ("empty", {"points": np.zeros((0, 3))}),
        ("has no faces", {"mesh": TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))}),
        ("greater than 0", {"mesh": sphere, "opacity": 0.0}),
        ("low < high", {"mesh": sphere, "color": sphere.vertices[:, 0], "value_limits": (1.0, 1.0)}),
    ]
    for message, arguments in cases:
        with pytest.raises(InputError, match=message):
            render.figure(target, **{"size": SIZE, **arguments})
    with pytest.raises(InputError, match="not a figure format"):
        render.figure(tmp_path / "x.jpg", mesh=sphere)
    with pytest.raises(FileAccessError, match="does not exist"):
        render.figure(tmp_path / "missing" / "x.png", mesh=sphere, size=SIZE)
    assert list(tmp_path.iterdir()) == []


def test_a_volume_takes_one_color(tmp_path: Path, ball) -> None:
    with pytest.raises(InputError, match="drawn in one color"):
        render.figure(tmp_path / "x.png", volume=ball, color=[1.0], size=SIZE)


@pytest.mark.slow
def test_slice_shows_the_zero_contour(tmp_path: Path, ball) -> None:
    target = render.slice(tmp_path / "slice.png", ball, axis="z", label="distance", size=SIZE)
    picture = pixels(target)[..., :3]
    assert picture.shape[:2] == (300, 400)
    # Blue inside the band, red outside it, a black line between.
    red, green, blue = np.moveaxis(picture, -1, 0)
    assert ((blue > red + 0.2).sum()) > 100
    assert ((red > blue + 0.2).sum()) > 100
    assert ((red < 0.1) & (green < 0.1) & (blue < 0.1)).sum() > 100


def test_a_slice_stands_in_the_middle_and_says_what_it_shows(tmp_path: Path, ball) -> None:
    target = render.slice(tmp_path / "slice.png", gradient_field(ball), size=SIZE)
    ink = np.flatnonzero((pixels(target)[..., :3] < 0.9).any(axis=(0, 2)))
    assert abs(ink[0] - (SIZE[0] - 1 - ink[-1])) < 20
    text = render.slice(tmp_path / "slice.svg", gradient_field(ball), size=SIZE).read_text()
    assert f"<!-- |{ball.info.name}| -->" in text


def test_slice_refuses(tmp_path: Path, ball) -> None:
    with pytest.raises(InputError, match="is not known; use one of"):
        render.slice(tmp_path / "s.png", ball, axis="q")
    with pytest.raises(InputError, match="not a figure format"):
        render.slice(tmp_path / "s.gif", ball)


def test_image_panels(tmp_path: Path) -> None:
    values = np.linspace(0.0, 1.0, 12).reshape(3, 4)
    values[0, 0] = np.nan
    colors = np.zeros((3, 4, 3))
    colors[..., 1] = 1.0
    picture = pixels(render.image(tmp_path / "i.png", {"value": values, "green": colors}, size=SIZE))[..., :3]
    green = (picture[..., 1] > 0.95) & (picture[..., 0] < 0.05) & (picture[..., 2] < 0.05)
    assert not green[:, :200].any()
    assert green[:, 200:].mean() > 0.2
    with pytest.raises(InputError, match="not \\(H, W\\)"):
        render.image(tmp_path / "bad.png", np.zeros(3))
    with pytest.raises(InputError, match="at least one"):
        render.image(tmp_path / "bad.png", {})


def test_chart_draws_each_series(tmp_path: Path) -> None:
    lines = [
        render.Series("first", [1, 10, 100], [3, 2, 1], ["a", "b", "c"]),
        render.Series("second", [1, 100], [1, 3]),
    ]
    picture = pixels(render.chart(tmp_path / "c.png", lines, x_label="s", y_label="m", title="t", size=SIZE))[..., :3]
    blue = (picture[..., 2] > picture[..., 0] + 0.3).sum()
    orange = (picture[..., 0] > picture[..., 2] + 0.3).sum()
    assert blue > 100
    assert orange > 100


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_flat_figures_are_lines_of_any_size(tmp_path: Path, kind: str, ball) -> None:
    lines = [render.Series("first", [1, 10, 100], [3, 2, 1])]
    labels = {"x_label": "s", "y_label": "m"}
    first, second = (render.chart(tmp_path / f"{n}.{kind}", lines, **labels).read_bytes() for n in "ab")
    assert first == second
    cut = render.slice(tmp_path / f"cut.{kind.upper()}", ball, size=SIZE).read_bytes()
    for data in (first, cut):
        if kind == "svg":
            drawing = ElementTree.fromstring(data)
            assert drawing.tag == "{http://www.w3.org/2000/svg}svg"
            assert len(list(drawing.iter("{http://www.w3.org/2000/svg}path"))) > 20
        else:
            assert (data[:5], data.rstrip()[-5:]) == (b"%PDF-", b"%%EOF")
    assert (b"<image" in first, b"<image" in cut) == (False, kind == "svg")
    with pytest.raises(InputError, match=r"'.svg' is not a figure format; use one of .png"):
        render.figure(tmp_path / "a.svg", volume=ball)


@pytest.mark.parametrize(
    ("message", "series"),
    [
        ("at least one", []),
        ("equally many", [render.Series("a", [1, 2], [1])]),
        ("equally many", [render.Series("a", [1, 2], [1, 2], ["one note"])]),
        ("not finite", [render.Series("a", [1, 2], [1, np.nan])]),
        ("not positive", [render.Series("a", [0, 2], [1, 1])]),
    ],
)
def test_chart_refuses(tmp_path: Path, message: str, series: list[render.Series]) -> None:
    with pytest.raises(InputError, match=message):
        render.chart(tmp_path / "c.png", series, x_label="x", y_label="y")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_backend_follows_the_variable_and_names_what_is_missing() -> None:
    """In a process of its own: the choice is made once for each process."""
    code = (
        "from geokit.render import _backend\n"
        "from geokit.errors import MissingDependencyError\n"
        "_backend._LIBRARIES = {name: ('libnowhere.so.1',) for name in _backend._LIBRARIES}\n"
        "try:\n    _backend.gl_backend()\n"
        "except MissingDependencyError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "apt install libegl1 libgl1" in done.stdout
    working = [name for name in _backend.BACKENDS.values() if _backend._loads(name)]
    for name in working:
        if name == _backend.EGL and not _backend._egl_draws():
            continue
        environment = {**os.environ, "VTK_DEFAULT_OPENGL_WINDOW": name}
        code = "from geokit.render import gl_backend; print(gl_backend())"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=environment)
        assert done.stdout.strip() == name
    assert working, "neither EGL nor OSMesa can be loaded: figures cannot be tested here"


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="torch brought no triton")
def test_triton_is_imported_after_a_figure(tmp_path: Path) -> None:
    """torch imports triton late. After Mesa's LLVM that ended the process, wherever torch brought triton."""
    code = (
        "from geokit import mesh, render\n"
        f"render.figure({str(tmp_path / 'a.png')!r}, mesh=mesh.sphere(), size=(64, 64))\n"
        "import torch._dynamo\n"
        "print('imported')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout == "imported\n", done.stderr


@pytest.mark.slow
def test_triton_is_loaded_before_mesa(tmp_path: Path) -> None:
    """A stand-in for triton, so that the order is also tested where torch has none: a copy of another library."""
    native = tmp_path / "triton" / "_C"
    native.mkdir(parents=True)
    (tmp_path / "triton" / "__init__.py").write_text("raise ImportError('only its library is loaded')")
    with open("/proc/self/maps") as maps:
        libm = next(line.split()[-1] for line in maps if "/libm.so" in line or "/libm-" in line)
    shutil.copy(libm, native / "libtriton.so")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from geokit.render import _backend\n"
        "mapped = lambda: 'libtriton.so' in open('/proc/self/maps').read()\n"
        "loads = _backend._loads\n"
        "def watched(name):\n    print(mapped())\n    return loads(name)\n"
        "_backend._loads = watched\n"
        "_backend.gl_backend()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert set(done.stdout.split()) == {"True"}, done.stderr


def test_a_figure_without_a_file_says_what_shows_one(sphere: TriangleMesh) -> None:
    with pytest.raises(InputError, match=r"path: .*figure\('part.png', mesh=mesh\).*mesh.show\(\)"):
        render.figure(mesh=sphere)
