"""Command lines and files of newcomers, in this process: what the verbs do by default, and what they say."""

from __future__ import annotations

import dataclasses
import glob
import json
import re
import shlex
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import native
from geokit.cli import main

ROOT = Path(__file__).resolve().parents[2]


class Done(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Iterator[Callable[..., Done]]:
    before = warnings.showwarning

    def call(*arguments: Any) -> Done:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        return Done(code, *capfd.readouterr())

    yield call
    warnings.showwarning = before


ORGANIZED = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 2\nPOINTS 4\nDATA ascii\n"
    "0 1 2\nnan nan nan\n4 5 6\nnan nan nan\n"
)


class TestUnits:
    """Meshes in the unit and with the axis up that another program needs."""

    @pytest.mark.slow
    def test_convert(self, run: Callable[..., Done], tmp_path: Path) -> None:
        start, printed = tmp_path / "a.stl", tmp_path / "b.3mf"
        gk.mesh.save(start, gk.mesh.box((1.0, 2.0, 3.0), center=(0.5, 1.0, 1.5)))
        assert "--unit: " in (said := run("convert", start, printed, "--unit", "mm").err)
        assert f"{start} does not say what its unit is now; give --from-unit" in said
        done = run(
            "convert", start, printed, "--from-unit", "in", "--unit", "mm", "--from-up", "y", "--up", "z"
        )  # fmt: skip
        assert done.code == 0, done.err
        mesh = gk.mesh.load(printed)
        np.testing.assert_allclose(mesh.bounds, [[0, -76.2, 0], [25.4, 0, 50.8]], atol=1e-12)
        assert (mesh.meters_per_unit, mesh.up_axis) == (0.001, "z")
        # From here on the file says its unit.
        done = run("convert", printed, tmp_path / "c.nvdb", "--unit", "cm", "--voxel-size", "0.1")
        assert done.code == 0, done.err
        lower, upper = gk.volume.load(tmp_path / "c.nvdb").info.world_bounds
        assert upper[0] - lower[0] == pytest.approx(2.54 + 0.6, abs=0.2)
        facts = json.loads(run("info", printed, "--json").out)
        assert (facts["meters_per_unit"], facts["up_axis"]) == (0.001, "z")

    def test_an_unknown_unit(self, run: Callable[..., Done], tmp_path: Path) -> None:
        gk.mesh.save(tmp_path / "a.stl", gk.mesh.box())
        done = run("convert", tmp_path / "a.stl", tmp_path / "b.ply", "--from-unit", "ell", "--unit", "mm")
        assert "--from-unit: 'ell' is no known unit; use one of m, mm" in done.err
        assert not (tmp_path / "b.ply").exists()


class TestOrganizedClouds:
    """Points of rays without an echo are left out, and that is said."""

    SAID = "2 of its 4 points are not finite and are left out"

    @pytest.fixture
    def cloud(self, tmp_path: Path) -> Path:
        path = tmp_path / "people.pcd"
        path.write_text(ORGANIZED)
        return path

    def test_info(self, run: Callable[..., Done], cloud: Path) -> None:
        done = run("info", cloud, "--json")
        assert (done.code, json.loads(done.out)["point_count"]) == (0, 2)
        assert self.SAID in done.err
        assert run("info", cloud, "--finite-only").code == 0
        assert "--stream: has no effect on a cloud" in run("info", cloud, "--stream").err

    def test_convert_and_query(self, run: Callable[..., Done], cloud: Path, tmp_path: Path) -> None:
        done = run("convert", cloud, tmp_path / "a.xyz")
        assert (done.code, len(gk.points.load(tmp_path / "a.xyz"))) == (0, 2)
        assert self.SAID in done.err
        done = run("query", "neighbors", cloud, "--nearest", "1", "-o", tmp_path / "b.csv")
        assert (done.code, self.SAID in done.err) == (0, True)

    def test_a_file_may_be_refused_instead(self, run: Callable[..., Done], cloud: Path, tmp_path: Path) -> None:
        for verb in (["info", cloud], ["convert", cloud, tmp_path / "a.xyz"], ["render", cloud, "-o", "a.png"]):
            done = run(*verb, "--no-finite-only")
            assert done.code == 1
            assert "leave out all 2 such points with --finite-only" in done.err


def test_what_was_not_asked_is_not_none(run: Callable[..., Done]) -> None:
    path = ROOT / "data/samples/bracket.obj"
    lines = dict(line.split(maxsplit=1) for line in run("info", path).out.splitlines())
    assert lines["self_intersection_count"].startswith("not asked")
    assert json.loads(run("info", path, "--json").out)["self_intersection_count"] is None


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("info a b", 2, "'b': one argument too many"),
        ("info -", 2, "-: input is not read from a pipe"),
        ("volume union one.vdb", 2, "1 files given; name at least two"),
        ("info missing.obj", 1, "no such file"),
        ("convert a.obj b.obj --voxel 0.1", 2, "--voxel"),
        ("nothing", 2, 'Unknown command "nothing"'),
        ("inf torus.ply", 2, 'Unknown command "inf". Did you mean "info"?'),
        ("volume ofset a.vdb b.vdb --distance .1", 2, 'Unknown command "ofset". Did you mean "offset"?'),
        ("query sigend a.obj b.csv", 2, 'Did you mean "signed"?'),
        ("convert a.obj b.vdb --voxelsize 0.1", 2, "Unknown option: --voxelsize. Did you mean --voxel-size?"),
        ("convert a.obj b.vdb --voxelsize=0.1", 2, "Did you mean --voxel-size?"),
        ("volume offset a.vdb b.vdb --distanze .1", 2, "Did you mean --distance instead of --distanze?"),
        ("render a.obj -o a.png --colur red", 2, "Did you mean --color?"),
        ("render a.obj -o a.png --look smok", 2, 'Did you mean "smoke"?'),
        ("--json info a.obj", 2, "--json: there is no such option before a command; write"),
    ],
)
def test_exit_codes(run: Callable[..., Done], line: str, code: int, said: str) -> None:
    done = run(*line.split())
    assert done.code == code
    assert said in done.err
    assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize(
    "line",
    [
        "convert in.ply -o out.stl",
        "convert -o out.stl in.ply",
        "convert in.ply --output out.stl --force",
        "mesh transform in.ply --output=out.stl --scale 2",
        "boolean union in.ply -o out.stl other.ply",
        "mesh box -o out.stl --size 1 1 1",
        "compare in.ply other.ply -o out.stl.csv",
    ],
)
def test_what_is_written_may_be_said_with_o(
    run: Callable[..., Done], tmp_path: Path, monkeypatch: Any, line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    gk.mesh.save("in.ply", gk.mesh.box())
    gk.mesh.save("other.ply", gk.mesh.box(center=(0.4, 0.4, 0.4)))
    done = run(*line.split())
    assert done.code == 0, done.err
    assert len(list(tmp_path.glob("out.stl*"))) == 1


@pytest.mark.parametrize("line", ["info in.ply -o a.txt", "convert in.ply -o a.stl -o b.stl"])
def test_o_is_unknown_where_nothing_or_one_file_is_written(run: Callable[..., Done], line: str) -> None:
    done = run(*line.split())
    assert done.code == 2
    assert "Unknown option: -o" in done.err


@pytest.mark.parametrize(
    "line",
    [
        "convert a.nvdb b.fbx",
        "convert a.nvdb b.dcm",
        "convert a.ply b.step",
        "convert a.ply b.e57 --count 9",
        "render a.ply -o b.exr",
        "render a.nvdb -o b.jpg --slice x",
        "view a.ply -o b.pdf",
        "mesh transform a.ply b.fbx",
        "mesh split a.ply b.dae",
        "volume prune a.nvdb b.dcm",
    ],
)
def test_targets_are_checked_before_the_work(
    run: Callable[..., Done], tmp_path: Path, monkeypatch: Any, line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.nvdb", "a.ply"):
        # Reading them would end in another error.
        Path(name).write_text("ply\nformat ascii 1.0\nelement vertex 0\nelement face 9\n")
    done = run(*line.split())
    assert done.code == 1
    assert "; use one of ." in done.err


def test_names_below_the_home(run: Callable[..., Done], tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    gk.mesh.save(tmp_path / "a.ply", gk.mesh.box())
    assert run("convert", "~/a.ply", "~/b.ply").code == 0
    assert run("convert", "~/b.ply", "--out-dir=~/made", "--to", "stl").code == 0
    assert (tmp_path / "made" / "b.stl").exists()
    assert "https://example.com/a.ply: is a URL" in run("info", "https://example.com/a.ply").err


def test_a_frustum_is_called_so(run: Callable[..., Done], tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "camera.nvdb"
    gk.volume.save(path, gk.volume.from_dense(np.ones((2, 2, 2)), name="camera"))
    # What inspect gives for one: few programs write such files.
    (found,) = gk.volume.inspect(path)
    nothing = np.full((4, 4), np.nan)
    frustum = dataclasses.replace(found, transform=nothing, voxel_size=nothing[0, :3])
    monkeypatch.setattr("geokit.volume.inspect", lambda _: [frustum])
    done = run("info", path)
    assert (done.code, "nan" in done.out) == (0, False)
    assert "frustum (voxels widen away from a camera)" in done.out
    (said,) = json.loads(run("info", path, "--json").out)["grids"]
    assert (said["transform"], said["voxel_size"], said["world_bounds"]) == ("frustum", None, None)


def test_summaries_of_queries_have_a_spread(run: Callable[..., Done], tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "plane.ply", gk.mesh.plane((8.0, 8.0)))
    heights = np.linspace(0.0, 1.0, 101)
    gk.points.save(tmp_path / "p.csv", np.column_stack([np.zeros((101, 2)), heights]))
    files = (tmp_path / "plane.ply", tmp_path / "p.csv")
    said = json.loads(run("query", "closest", *files, "--device", "cpu", "--json").out)
    wanted = {"min": 0.0, "mean": 0.5, "max": 1.0, "std": heights.std(), "p5": 0.05, "p50": 0.5, "p95": 0.95}
    wanted["rms"] = float(np.sqrt(np.mean(heights**2)))
    assert {name: said[f"distance_{name}"] for name in wanted} == pytest.approx(wanted, abs=1e-6)


def test_a_size_that_is_none(run: Callable[..., Done], tmp_path: Path) -> None:
    done = run("render", ROOT / "data/samples/bracket.obj", "-o", tmp_path / "a.png", "--size", "10")
    assert (done.code, "800x600" in done.err) == (2, True)


def test_help_and_version(run: Callable[..., Done]) -> None:
    assert run("-V").out.strip() == gk.__version__
    assert "Describe a mesh" in run("help").out
    assert "--json" in run("help", "info").out
    assert run("--install-completion", "--help").code == 0


def test_smoke_with_several_grids(run: Callable[..., Done], tmp_path: Path) -> None:
    grids = [gk.volume.from_dense(np.full((3, 3, 3), at + 1.0), name=n) for at, n in enumerate(("heat", "density"))]
    path = tmp_path / "smoke.nvdb"
    gk.volume.save(path, *grids)
    assert gk.volume.load(path).info.name == "density"
    done = run("volume", "statistics", path, "--json")
    assert (json.loads(done.out)["mean"], done.code) == (2.0, 0)
    said = "has several grids, and 'density' is taken, without 'heat'; --grid chooses another, --grid all takes all"
    assert said in done.err
    gk.volume.save(path, grids[0], gk.volume.from_dense(np.ones((2, 2, 2)), name="soot"))
    done = run("volume", "statistics", path)
    assert (done.code, "choose one with --grid" in done.err) == (1, True)
    assert run("volume", "statistics", path, "--grid", "soot").code == 0


def test_all_grids_of_a_file(run: Callable[..., Done], tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    grids = [gk.volume.from_dense(np.full((4, 4, 4), at + 1.0), name=n) for at, n in enumerate(("heat", "density"))]
    wind = gk.volume.from_dense(np.ones((4, 4, 4, 3), np.float32), name="wind")
    gk.volume.save("smoke.nvdb", *grids, wind)
    box = ("--lower", "0", "0", "0", "--upper", "1", "1", "1")
    for words in (["prune"], ["resample", "--voxel-size", "2", "--device", "cpu"], ["clip", *box]):
        done = run("volume", words[0], "smoke.nvdb", "out.nvdb", *words[1:], "--grid", "all", "--json", "--force")
        assert (done.code, done.err) == (0, "")
        assert json.loads(done.out)["grids"] == 3
        found = gk.volume.load_all("out.nvdb")
        assert list(found) == ["heat", "density", "wind"]
        assert gk.volume.statistics(found["heat"]).maximum == 1.0
    done = run("volume", "statistics", "smoke.nvdb", "--grid", "all", "--json")
    assert [one["grid"] for one in json.loads(done.out)] == ["heat", "density", "wind"]
    assert run("volume", "statistics", "smoke.nvdb", "--grid", "all").out.count("smoke.nvdb") == 3
    done = run("volume", "gradient", "smoke.nvdb", "g.nvdb", "--grid", "all", "--device", "cpu")
    assert (done.code, "smoke.nvdb: grid 'wind': " in done.err) == (1, True)
    done = run("volume", "union", "smoke.nvdb", "smoke.nvdb", "u.nvdb", "--grid", "all")
    assert (done.code, "--grid: all goes with operations on one file" in done.err) == (1, True)
    assert run("convert", "smoke.nvdb", "copy.nvdb", "--grid", "all").code == 0
    assert len(gk.volume.inspect("copy.nvdb")) == 3
    # A grid of that name is that grid.
    gk.volume.save("named.nvdb", grids[0], gk.volume.from_dense(np.ones((2, 2, 2)), name="all"))
    assert json.loads(run("volume", "statistics", "named.nvdb", "--grid", "all", "--json").out)["grid"] == "all"


def test_the_package_says_where_files_are_loaded() -> None:
    with pytest.raises(AttributeError, match=r"use one of geokit\.mesh\.load, geokit\.volume\.load"):
        gk.load  # noqa: B018
    with pytest.raises(AttributeError, match="geokit attribute lood"):
        gk.lood  # noqa: B018


def test_numbers_are_short(run: Callable[..., Done], tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "ball.ply", mesh_catalog.icosphere(2))
    done = run("convert", tmp_path / "ball.ply", tmp_path / "b.ply", "--tolerance", "0.1", "--device", "cpu")
    assert (done.code, "deviation" in done.out) == (0, True)
    assert all(len(number) <= 12 for number in re.findall(r"\d+\.\d+(?:e-?\d+)?", done.out.partition(": ")[2]))


class TestKinds:
    """Meshes, volumes, clouds and arrays become each other where the package can do it."""

    @pytest.fixture
    def ball(self, tmp_path: Path) -> Path:
        path = tmp_path / "ball.ply"
        mesh = mesh_catalog.icosphere(3)
        gk.mesh.save(path, gk.mesh.TriangleMesh(mesh.vertices, mesh.faces, vertex_data={"heat": mesh.vertices[:, 0]}))
        return path

    def test_mesh_to_cloud(self, run: Callable[..., Done], ball: Path, tmp_path: Path) -> None:
        assert run("convert", ball, tmp_path / "a.xyz", "--count", "500").code == 0
        assert run("convert", ball, tmp_path / "b.ply", "--radius", "0.3").code == 0
        cloud = gk.points.load(tmp_path / "b.ply")
        assert len(gk.points.load(tmp_path / "a.xyz")) == 500
        assert 50 < len(cloud) < 500
        np.testing.assert_allclose(cloud.data["heat"], cloud.points[:, 0], atol=1e-6)
        done = run("convert", ball, tmp_path / "c.xyz", "--count", "5", "--radius", "1")
        assert (done.code, "--count: follows from --radius" in done.err) == (1, True)

    @pytest.mark.slow
    def test_cloud_to_volume_and_mesh(self, run: Callable[..., Done], ball: Path, tmp_path: Path) -> None:
        cloud = gk.points.sample(gk.mesh.load(ball), 4000, method="poisson_disk")
        gk.points.save(tmp_path / "c.csv", cloud.points)
        done = run("convert", tmp_path / "c.csv", tmp_path / "c.nvdb", "--device", "cpu")
        assert (done.code, "--radius and --voxel-size set them" in done.err) == (0, True)
        inside = gk.volume.load(tmp_path / "c.nvdb").sample([[1.0, 0, 0], [0.7, 0, 0], [1.5, 0, 0]], device="cpu") < 0.0
        assert inside.tolist() == [True, False, False]
        assert run("convert", tmp_path / "c.csv", tmp_path / "c.stl", "--radius", "0.1", "--device", "cpu").code == 0
        # A shell without a hole: its outside, and its inside.
        report = gk.mesh.audit(gk.mesh.load(tmp_path / "c.stl"))
        assert (report.watertight, report.component_count) == (True, 2)
        # What may be a mesh or a cloud stays a cloud, unless an option speaks of balls or voxels.
        assert run("convert", tmp_path / "c.csv", tmp_path / "c.ply").code == 0
        assert len(gk.points.load(tmp_path / "c.ply")) == 4000
        (tmp_path / "one.csv").write_text("x,y,z\n0,0,0\n")
        done = run("convert", tmp_path / "one.csv", tmp_path / "one.stl")
        assert (done.code, "--radius: the points have no distances" in done.err) == (1, True)

    @pytest.mark.filterwarnings("ignore:.*holds no place and no voxel size:UserWarning")
    def test_volume_to_array(self, run: Callable[..., Done], tmp_path: Path) -> None:
        values = np.arange(24.0, dtype=np.float32).reshape(2, 3, 4)
        volume = gk.volume.from_dense(values, voxel_size=0.5, origin=(1, 2, 3))
        gk.volume.save(tmp_path / "a.nvdb", volume)
        for kind in ("npy", "npz"):
            assert run("convert", tmp_path / "a.nvdb", "--out-dir", tmp_path, "--to", kind, "--force").code == 0
        dense = volume.to_dense(device="cpu")
        np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), dense.values)
        with np.load(tmp_path / "a.npz") as found:
            again = gk.volume.DenseGrid(found["values"], found["origin"], found["transform"])
        assert gk.volume.from_dense(again).to_dense(device="cpu").values.tolist() == dense.values.tolist()
        np.testing.assert_array_equal(again.transform, dense.transform)


class TestProgress:
    def test_long_steps_say_how_far_they_are(self, capfd: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
        from geokit.cli._program import console

        monkeypatch.setattr(console, "PATIENCE", 0.02)
        with console.step("thinking") as step:
            while "25%" not in (said := capfd.readouterr().err):
                step.progress(1, 4)
                time.sleep(0.001)
        assert re.search(r"^geokit: thinking \.\.\. \d+ s, 25%, about \d+ s left$", said, re.MULTILINE)

    def test_also_where_the_library_says_nothing(self, capfd: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
        from geokit.cli._program import console

        monkeypatch.setattr(console, "PATIENCE", 0.02)
        with console.step("thinking"):
            said = ""
            while not said.endswith("\n"):
                said += capfd.readouterr().err
                time.sleep(0.001)
        assert re.fullmatch(r"(geokit: thinking \.\.\. \d+ s\n)+", said)

    @pytest.mark.slow
    @pytest.mark.parametrize("line", ["plan {} --tolerance 0.02", "convert {} out.nvdb --tolerance 0.02"])
    def test_searches_say_what_is_left(
        self, run: Callable[..., Done], tmp_path: Path, monkeypatch: Any, line: str
    ) -> None:
        from geokit.cli._program import console

        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(console, "PATIENCE", 0.001)
        gk.mesh.save("ball.ply", mesh_catalog.icosphere(2))
        done = run(*line.format("ball.ply").split(), "--device", "cpu")
        assert done.code == 0
        assert re.search(r"\d+%, about \d+ s left", done.err)

    def test_short_and_quiet_steps_say_nothing(self, capfd: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
        from geokit.cli._program import console

        with console.step("thinking") as step:
            step.progress(1, 2)
        monkeypatch.setattr(console, "PATIENCE", 0.0)
        with console.step("thinking", quiet=True) as step:
            step.progress(1, 2)
        assert capfd.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="built without OpenVDB")
def test_the_examples_of_the_documents_in_order(run: Callable[..., Done], tmp_path: Path, monkeypatch: Any) -> None:
    for package in ("pxr", "nibabel"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("webbrowser.open", lambda _: True)
    _inputs()
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("geokit ")]
    assert len(lines) > 25
    # Each worker, and each driver that is tried, takes a second.
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    monkeypatch.setattr("geokit.cli.doctor._try_opengl", lambda _: "works")
    # Their own tests run these, with less work.
    heavy = ("geokit bench", "geokit demo", "geokit doctor --")
    for line in (line for line in lines if not line.startswith(heavy)):
        words = shlex.split(re.split("[|>]", line)[0], comments=True)[1:]
        # As a shell does.
        done = run(*(name for word in words for name in (sorted(glob.glob(word)) if "*" in word else [word])))
        assert done.code == 0, f"{line}: {done.err}"
    outputs = [line.split("--out ")[1].split()[0] for line in lines if line.startswith("geokit bench")]
    assert len(outputs) == len(set(outputs)), "an example meets the output of another"


def _inputs() -> None:
    """The files for which the names of the examples stand."""
    random = np.random.default_rng(1)
    ring = mesh_catalog.torus(24, 12)
    colors = {"color": random.integers(0, 256, (ring.vertex_count, 3), np.uint8)}
    gk.mesh.save("bunny.usd", gk.mesh.TriangleMesh(ring.vertices * 0.06, ring.faces, vertex_data=colors))
    gk.mesh.save("hollow.stl", mesh_catalog.torus())
    for name in ("scans/one.ply", "scans/two.ply"):
        Path(name).parent.mkdir(exist_ok=True)
        gk.mesh.save(name, gk.mesh.TriangleMesh(ring.vertices * 0.1, ring.faces))
    Path("fields.toml").write_text('[[step]]\nverb = "convert"\noutput = "{stem}.nvdb"\nvoxel-size = 0.02\n')
    Path("smoke.vdb").write_bytes((ROOT / "data/samples/smoke.vdb").read_bytes())
    points = random.random((50, 3)) * 0.2 - 0.1
    for name in ("scan.ply", "design.stl"):
        gk.mesh.save(name, gk.mesh.TriangleMesh(ring.vertices * 0.1, ring.faces))
    box = gk.mesh.box((20.0, 20.0, 20.0))
    gk.mesh.save("part.3mf", gk.mesh.TriangleMesh(box.vertices, box.faces, meters_per_unit=0.001))
    gk.mesh.save("ring.stl", gk.mesh.torus(20.0, 8.0))
    for name in ("points.csv", "cloud.ply", "survey.ply"):
        gk.points.save(name, points)
    np.save("points.npy", points)
    labels = np.pad(np.full((4, 4, 4), 2, np.uint8), 2)
    gk.volume.save("segmentation.nii.gz", gk.volume.from_dense(labels, voxel_size=0.5))
    Path("rays.csv").write_text("ox,oy,oz,dx,dy,dz\n0.1,0,1,0,0,-1\n")
    for at, name in enumerate(("a.vdb", "b.vdb", "c.vdb", "body.vdb", "tool.vdb", "in.vdb", "other.nvdb")):
        moved = gk.mesh.TriangleMesh(ring.vertices + np.array([0.1 * at, 0.0, 0.0]), ring.faces)
        gk.volume.save(name, gk.volume.from_mesh(moved, 0.05, device="cpu"))
        gk.mesh.save(Path(name).with_suffix(".stl"), moved)


class TestNamesThatATerminalObeys:
    """What files and their content are called is printed as escapes, as in "\\x1b[31m"."""

    EVIL = "e\x1b[31mvil\x07\n\u202e\x9b31m[red]"

    @pytest.mark.filterwarnings("always::UserWarning")
    def test_nothing_is_printed_raw(self, run: Callable[..., Done], tmp_path: Path) -> None:
        mesh, cloud, volume, told = (tmp_path / f"{self.EVIL}{end}" for end in (".obj", ".npz", ".nvdb", ".xyz"))
        mesh.write_text(
            "v 0 0 0\nv 1 0 0\nv 0 1 0\no a\x1b[31m\nusemtl m\x1b[32m\nf 1 2 3\no b\nwhat\x1b[33m\nf 3 2 1\n"
        )
        np.savez(cloud, points=np.zeros((1, 3)), **{"a\x1b[34m": np.zeros(1)})
        made = gk.volume.from_mesh(gk.mesh.box(), 0.2, name="g\x1b[35m", device="cpu")
        gk.volume.save(volume, made)
        told.write_text("# a b c d\x1b[36m\n1 2 3 4\n")
        for arguments, code in [
            *((("info", path), 0) for path in (mesh, cloud, volume, told)),
            (("convert", told, tmp_path / f"{self.EVIL}.ply"), 0),
            (("convert", mesh, tmp_path / f"{self.EVIL}.stl"), 0),
            (("info", tmp_path / self.EVIL), 1),
            (("info", mesh, f"--{self.EVIL}"), 2),
        ]:
            done = run(*arguments)
            assert done.code == code
            printed = done.out + done.err
            assert "\\x1b[31mvil\\x07" in printed, arguments
            assert all(line.isprintable() for line in printed.split("\n")), (arguments, printed)
