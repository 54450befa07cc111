"""``geokit convert``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from geokit import native
from geokit.core import launcher
from geokit.mesh import load as load_mesh
from geokit.points import downsample
from geokit.points import load as load_points
from geokit.volume import from_dense
from geokit.volume import load as load_volume
from geokit.volume import save as save_volume

needs_openvdb = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ply", "stl", "off", "vtp"])
def test_mesh_to_mesh(geokit, cube: Path, tmp_path: Path, kind: str) -> None:
    target = tmp_path / f"cube.{kind}"
    done = geokit("convert", cube, target)
    assert done.returncode == 0, done.stderr
    assert str(target) in done.stdout
    before, after = load_mesh(cube), load_mesh(target)
    corners = [np.sort(mesh.vertices[mesh.faces].reshape(-1, 9), axis=0) for mesh in (before, after)]
    np.testing.assert_array_equal(*corners)


@pytest.mark.parametrize("kind", ["nrrd", "mha", pytest.param("vdb", marks=needs_openvdb)])
def test_the_mesh_of_one_label_of_a_segmentation(geokit, tmp_path: Path, kind: str) -> None:
    labels = np.zeros((30, 24, 20), np.int16)
    labels[4:20, 4:20, 4:16] = 2
    labels[8:12, 8:12, 8:12] = 3
    labels[20:26, 6:12, 6:12] = 1
    transform = np.diag([0.5, 0.5, 2.0, 1.0])
    transform[:3, 3] = 7.0, -3.0, 100.0
    source, target = tmp_path / f"labels.{kind}", tmp_path / "two.ply"
    save_volume(source, from_dense(labels, transform=transform, name="labels"))
    done = geokit("convert", source, target, "--label", "2")
    assert done.returncode == 0, done.stderr
    mesh = load_mesh(target)
    # The surface is halfway between voxels: the corners and edges of the box and of the hole are cut, 4% here.
    assert mesh.volume == pytest.approx((labels == 2).sum() * 0.5, rel=0.05)
    low, high = (
        transform[:3, :3] @ np.array(corner) + transform[:3, 3] for corner in ((3.5, 3.5, 3.5), (19.5, 19.5, 15.5))
    )
    np.testing.assert_allclose(mesh.bounds, [low, high], atol=1e-6)
    for more, text in (
        (("--label", "7"), "no voxel of grid 'labels' has label 7; choose one of 0, 1, 2, 3"),
        (("--label", "0"), "choose another --label, or --background"),
        (("--label", "2", "--isovalue", "1"), "--isovalue: has no effect with --label"),
    ):
        done = geokit("convert", source, tmp_path / "none.ply", *more)
        assert (done.returncode, text in done.stderr) == (1, True), done.stderr
    done = geokit("convert", target, tmp_path / "none.stl", "--label", "2")
    assert (done.returncode, "--label" in done.stderr) == (1, True)


@pytest.mark.parametrize(("size", "code"), [("0.5", 0), ("-1", 1)])
def test_the_listener_of_compiles_ends_with_the_command(
    geokit, cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: str, code: int
) -> None:
    mine: list[str] = []
    monkeypatch.setattr(launcher, "_compile_listener", mine.append)
    assert geokit("convert", cube, tmp_path / "cube.nvdb", "--voxel-size", size).returncode == code
    assert launcher.on_compile(None) == mine.append


@pytest.mark.slow
def test_mesh_to_volume_block_after_block(geokit, cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, target = tmp_path / "cube.stl", tmp_path / "cube.nvdb"
    assert geokit("convert", cube, plain).returncode == 0
    limit = ("--stream", "--memory-limit", "300000000")
    done = geokit("convert", plain, target, "--voxel-size", "0.13", *limit, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["active_voxels"] == load_volume(target).info.active_voxel_count
    for more, text in (
        ((), "--voxel-size: is missing"),
        (("--voxel-size", "0.1", "--codec", "zip"), "--codec: has no"),
        (("--voxel-size", "0.1", "--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler answers there"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr("geokit.distributed._cluster.PATIENCE", 0.2)
            done = geokit("convert", plain, target, *limit, *more, "--force")
        assert done.returncode != 0
        assert text in done.stderr
    done = geokit("convert", plain, target, "--force", "--scheduler", "local")
    assert "--scheduler: goes with --stream" in done.stderr
    there = tmp_path / "there" / target.name
    there.parent.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr("os.cpu_count", lambda: 1)  # workers: each takes two seconds to start
        done = geokit("convert", plain, there, "--voxel-size", "0.13", *limit, "--scheduler", "local")
    assert done.returncode == 0, done.stderr
    assert there.read_bytes() == target.read_bytes()


@pytest.mark.slow
def test_cloud_to_cloud_block_after_block(geokit, tmp_path: Path) -> None:
    source, target = tmp_path / "a.ply", tmp_path / "b.ply"
    points = np.random.default_rng(0).random((500, 3))
    points[7] = np.nan
    source.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 500\nproperty double x\nproperty double y\n"
        b"property double z\nend_header\n" + points.tobytes()
    )
    how = ("--stream", "--voxel-size", "0.2", "--normals", "8", "--density", "0.3")
    done = geokit("convert", source, target, *how)
    assert done.returncode == 0, done.stderr
    assert "1 of its 500 points are not finite" in done.stderr
    found = load_points(target)
    np.testing.assert_array_equal(found.points, downsample(np.delete(points, 7, 0), voxel_size=0.2).points)
    assert set(found.data) == {"normals", "curvature", "density"}
    for more, text in (
        (("--normals", "8"), "--normals: of a cloud to a cloud goes with --stream"),
        (("--stream", "--radius", "1"), "--radius: has no effect"),
        (("--stream", "--no-finite-only"), "point 7 is not finite"),
    ):
        done = geokit("convert", source, target, *more, "--force")
        assert done.returncode != 0
        assert text in done.stderr


@pytest.mark.slow
def test_mesh_to_volume(geokit, cube: Path, tmp_path: Path) -> None:
    target = tmp_path / "cube.nvdb"
    done = geokit("convert", cube, target, "--voxel-size", "0.125", "--half-width", "4", "--codec", "zip", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    volume = load_volume(target)
    assert report["active_voxels"] == volume.info.active_voxel_count
    assert volume.info.background == pytest.approx(0.5)
    values = volume.sample([[0.5, 0.5, 0.0], [0.5, 0.5, 0.25], [0.5, 0.5, -0.25], [0.5, 0.5, 9.0]], device="cpu")
    np.testing.assert_allclose(values, [0.0, -0.25, 0.25, 0.5], atol=1e-6)


@pytest.mark.slow
def test_the_chosen_voxel_size_is_said(geokit, cube: Path, tmp_path: Path) -> None:
    done = geokit("convert", cube, tmp_path / "cube.nvdb")
    assert "voxel size 0.0078" in done.stderr
    assert "--voxel-size" in done.stderr
    assert load_volume(tmp_path / "cube.nvdb").info.voxel_size.tolist() == [0.0078] * 3


@pytest.mark.slow
def test_nothing_is_replaced_without_force(geokit, fails, cube: Path, tmp_path: Path) -> None:
    target = tmp_path / "cube.off"
    target.write_text("mine")
    fails(geokit("convert", cube, target), 1, "cube.off", "--force")
    assert target.read_text() == "mine"
    assert geokit("convert", cube, target, "--force").returncode == 0
    assert load_mesh(target).faces.shape == (12, 3)


@pytest.mark.slow
def test_options_without_effect_are_refused(geokit, fails, cube: Path, cube_sdf: Path, tmp_path: Path) -> None:
    fails(geokit("convert", cube, tmp_path / "a.ply", "--voxel-size", "1"), 1, "--voxel-size", "no effect")
    fails(geokit("convert", cube_sdf, tmp_path / "a.nvdb", "--isovalue", "1"), 1, "--isovalue", "no effect")
    fails(geokit("convert", cube_sdf, tmp_path / "a.csv"), 1, "volume cannot be converted into a cloud")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_bad_values_are_named(geokit, fails, cube: Path, cube_sdf: Path, tmp_path: Path) -> None:
    fails(geokit("convert", cube, tmp_path / "a.nvdb", "--voxel-size", "-1"), 1, "voxel_size")
    fails(geokit("convert", cube, tmp_path / "a.nvdb", "--voxel-size", "1", "--codec", "rar"), 1, "rar", "zip")
    fails(geokit("convert", cube, tmp_path / "no" / "a.ply"), 1, "does not exist")
    fails(geokit("convert", cube_sdf, tmp_path / "a.nvdb", "--grid", "smoke"), 1, "smoke")
    fails(geokit("convert", cube, tmp_path / "a.nvdb", "--device", "cuda:77", "--voxel-size", "1"), 1, "cuda:77")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@needs_openvdb
def test_vdb_and_back(geokit, cube_sdf: Path, tmp_path: Path) -> None:
    vdb, again = tmp_path / "cube.vdb", tmp_path / "again.nvdb"
    assert geokit("convert", cube_sdf, vdb).returncode == 0
    assert geokit("convert", vdb, again, "--grid", "cube").returncode == 0
    first, second = load_volume(cube_sdf), load_volume(again)
    assert first.info.active_voxel_count == second.info.active_voxel_count
    random = np.random.default_rng(0)
    points = random.uniform(-0.3, 1.3, (2000, 3))
    np.testing.assert_array_equal(first.sample(points, device="cpu"), second.sample(points, device="cpu"))


@pytest.mark.slow
@needs_openvdb
def test_sixteen_bits_and_metadata_of_the_file_are_kept_and_shown(geokit, cube_sdf: Path, tmp_path: Path) -> None:
    volume = load_volume(cube_sdf)
    info = dataclasses.replace(volume.info, metadata={**volume.info.metadata, "geokit:file:creator": "Houdini"})
    first, copy, whole = tmp_path / "first.vdb", tmp_path / "copy.vdb", tmp_path / "whole.vdb"
    save_volume(first, dataclasses.replace(volume, info=info), half=True)
    assert geokit("convert", first, copy).returncode == 0
    assert geokit("volume", "resample", first, whole, "--voxel-size", "0.05").returncode == 0
    assert abs(copy.stat().st_size - first.stat().st_size) <= 0.03 * first.stat().st_size
    for path, half in ((first, True), (copy, True), (whole, None)):
        (grid,) = json.loads(geokit("info", path, "--json").stdout)["grids"]
        assert grid["metadata"]["geokit:file:creator"] == "Houdini"
        assert grid["metadata"].get("is_saved_as_half_float") is half
    lines = geokit("info", copy).stdout.split()
    assert lines[lines.index("geokit:file:creator") + 1] == "Houdini"
    assert lines[lines.index("is_saved_as_half_float") + 1] == "yes"


@pytest.mark.slow
@needs_openvdb
def test_volume_to_mesh(geokit, cube_sdf: Path, tmp_path: Path) -> None:
    target = tmp_path / "cube.ply"
    done = geokit("convert", cube_sdf, target, "--isovalue", "0.0625")
    assert done.returncode == 0, done.stderr
    mesh = load_mesh(target)
    # The cube grown by one voxel.
    np.testing.assert_allclose(mesh.bounds, [[-0.0625] * 3, [1.0625] * 3], atol=1e-3)


@pytest.mark.skipif(native.available(), reason="geokit was built with OpenVDB")
def test_without_openvdb_the_packages_are_named(geokit, fails, cube_sdf: Path, tmp_path: Path) -> None:
    fails(geokit("convert", cube_sdf, tmp_path / "cube.vdb"), 1, "libopenvdb-dev")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "grid_type"),
    [
        (["--codec", "fp8,zip"], "fp8"),
        (["--codec", "fp16"], "fp16"),
        (["--tolerance", "1e-3"], None),
        (["--codec", "fpn, blosc", "--tolerance", "0.002"], "fpn"),
    ],
)
def test_quantized(geokit, cube_sdf: Path, tmp_path: Path, options, grid_type) -> None:
    target = tmp_path / "small.nvdb"
    done = geokit("convert", cube_sdf, target, *options, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    before, after = load_volume(cube_sdf), load_volume(target)
    assert after.info.grid_type == (grid_type or report["types"])
    assert after.info.byte_count < before.info.byte_count
    points = np.random.default_rng(0).uniform(-0.3, 1.3, (2000, 3))
    change = np.abs(before.sample(points, device="cpu") - after.sample(points, device="cpu")).max()
    assert 0.0 < change <= report["achieved_error"] * (1 + 1e-6) <= (1e-3 if grid_type is None else 0.01)
    assert after.info.metadata["geokit:achieved_error"] == pytest.approx(report["achieved_error"])


@pytest.mark.slow
def test_mesh_to_shell_and_to_unsigned(geokit, cube: Path, tmp_path: Path) -> None:
    shell, unsigned = tmp_path / "shell.nvdb", tmp_path / "unsigned.nvdb"
    assert geokit("convert", cube, shell, "--voxel-size", "0.0625", "--thickness", "0.25").returncode == 0
    assert geokit("convert", cube, unsigned, "--voxel-size", "0.0625", "--sign", "none").returncode == 0
    points = [[0.5, 0.5, 0.0], [0.5, 0.5, 0.125], [0.5, 0.5, -0.125], [0.5, 0.5, 0.1875]]
    found = load_volume(shell).sample(points, device="cpu")
    np.testing.assert_allclose(found, [-0.125, 0.0, 0.0, 0.0625], atol=1e-6)
    np.testing.assert_allclose(load_volume(unsigned).sample(points[:3], device="cpu"), [0, 0.125, 0.125], atol=1e-6)


@pytest.mark.slow
def test_what_a_grid_loses_is_said(geokit, cube: Path, tmp_path: Path) -> None:
    done = geokit("convert", cube, tmp_path / "coarse.nvdb", "--voxel-size", "3")
    assert done.returncode == 0
    assert "geokit: warning: cube: 1 of its pieces are too thin" in done.stderr
    assert "File" not in done.stderr


@pytest.mark.slow
def test_bad_storage_is_named(geokit, fails, cube_sdf: Path, tmp_path: Path) -> None:
    fails(geokit("convert", cube_sdf, tmp_path / "a.nvdb", "--codec", "fp8,fp4"), 1, "codec", "two of a kind")
    fails(geokit("convert", cube_sdf, tmp_path / "a.nvdb", "--codec", "fpn"), 1, "codec", "--tolerance")
    fails(geokit("convert", cube_sdf, tmp_path / "a.nvdb", "--codec", "fp4", "--tolerance", "1e-9"), 1, "tolerance")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_cloud_to_cloud(geokit, tmp_path: Path) -> None:
    source, target = tmp_path / "a.csv", tmp_path / "a.ply"
    source.write_text("x,y,z,heat\n0,1,2,5\n3,4,5,6\n")
    assert geokit("convert", source, target).returncode == 0
    from geokit.points import load

    cloud = load(target)
    assert cloud.points.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert cloud.data["heat"].tolist() == [5, 6]


@pytest.mark.slow
def test_a_tolerance_makes_the_smallest_field_that_keeps_it(geokit, cube: Path, tmp_path: Path) -> None:
    options = ("--tolerance", "0.02", "--within", "0.01", "--order", "1", "--device", "cpu", "--json")
    done = geokit("convert", cube, tmp_path / "cube.vdb", *options)
    if not native.available():
        assert done.returncode == 1
        return
    report = json.loads(done.stdout)
    info = load_volume(tmp_path / "cube.vdb").info
    # OpenVDB keeps floats.
    assert (report["types"], report["order"]) == ("float", 1)
    assert report["achieved_error"] == info.achieved_error <= 0.02
    assert info.metadata["geokit:checked_within"] == 0.01


@pytest.mark.slow
def test_a_tolerance_takes_faces_away(geokit, cube_sdf: Path, tmp_path: Path) -> None:
    full, few, fewer = (tmp_path / name for name in ("full.ply", "few.ply", "fewer.ply"))
    assert geokit("convert", cube_sdf, full, "--device", "cpu").returncode == 0
    done = geokit("convert", cube_sdf, few, "--tolerance", "0.05", "--device", "cpu", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert 0.0 < report["deviation_p999"] <= report["deviation"] <= 0.05
    assert report["faces"] == len(load_mesh(few).faces) < 0.5 * len(load_mesh(full).faces)
    done = geokit("convert", full, fewer, "--tolerance", "0.1", "--device", "cpu", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["deviation"] <= 0.1
    assert len(load_mesh(fewer).faces) < len(load_mesh(full).faces)


@pytest.mark.slow
def test_several_files(geokit, cube: Path, tmp_path: Path) -> None:
    (tmp_path / "other.stl").write_text("solid\nnonsense")
    again = tmp_path / "again.obj"
    again.write_text(cube.read_text())
    out = tmp_path / "new" / "folder"
    given = [cube, tmp_path / "missing.obj", tmp_path / "other.stl", again]
    done = geokit("convert", *given, "--out-dir", out, "--to", "off", "--jobs", "2", "--json")
    assert done.returncode == 1
    assert [line["target"] for line in json.loads(done.stdout)] == [str(out / "cube.off"), str(out / "again.off")]
    lines = done.stderr.splitlines()
    assert len(lines) == 3
    assert "missing.obj" in lines[0]
    assert "other.stl" in lines[1]
    assert lines[2] == "geokit: 2 of 4 files were not converted"
    assert sorted(path.name for path in out.iterdir()) == ["again.off", "cube.off"]
    assert load_mesh(out / "again.off").faces.shape == (12, 3)


@pytest.mark.slow
def test_refused_lists_of_files(geokit, fails, cube: Path, tmp_path: Path) -> None:
    twin = tmp_path / "cube.ply"
    fails(geokit("convert", cube, twin, "--out-dir", tmp_path, "--to", "off"), 1, "cube.ply", "cube.off", "cube.obj")
    fails(geokit("convert", cube, "--out-dir", tmp_path), 1, "--out-dir", "--to")
    fails(geokit("convert", cube, "--out-dir", tmp_path, "--to", "off", "--jobs", "0"), 1, "--jobs", "from 1")
    fails(geokit("convert", cube, tmp_path / "a.off", "--to", "off"), 1, "--to", "--out-dir")
    fails(geokit("convert", cube), 2, "1 file", "--out-dir")
    assert list(tmp_path.iterdir()) == []
