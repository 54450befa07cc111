"""Points of scanners: .e57 of terrestrial ones, sweeps of KITTI and nuScenes, and COPC, which is a .laz."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest

import geokit as gk
from tests.support.exchange_files import write_e57

RANDOM = np.random.default_rng(8)
XYZ = RANDOM.normal(size=(20, 3))
AXES = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), XYZ.T, strict=True))


# --- .e57 -------------------------------------------------------------------------------------------------------------


def test_scans_are_joined_at_their_poses(tmp_path):
    pytest.importorskip("pye57")
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    quaternions, shifts = [[1, 0, 0, 0], [0.5, -0.1, 0.7, 0.2]], [[0, 0, 0], [5, 6, 7]]
    columns = {**AXES, "rowIndex": np.arange(20, dtype=np.int32), "intensity": np.arange(20) * 1e-4}
    write_e57(tmp_path / "a.e57", [columns, columns], poses=list(zip(quaternions, shifts, strict=True)))
    cloud = gk.points.load(tmp_path / "a.e57")
    turned = [
        rotation.from_quat([*q[1:], q[0]]).apply(XYZ) + shift for q, shift in zip(quaternions, shifts, strict=True)
    ]
    np.testing.assert_allclose(cloud.points, np.concatenate(turned), rtol=0, atol=1e-14)
    assert cloud.data["scan"].tolist() == [0] * 20 + [1] * 20
    assert cloud.data["rowIndex"].dtype == np.int32
    assert cloud.data["rowIndex"].tolist() == 2 * list(range(20))
    np.testing.assert_allclose(cloud.data["intensity"], np.tile(np.arange(20) * 1e-4, 2), rtol=0, atol=1e-15)


def rows(count, *names):
    """Columns of as many rows: AXES, and others that count."""
    return {
        **{name: values[:count] for name, values in AXES.items()},
        **{name: np.arange(count) * 1.0 for name in names},
    }


def test_scans_without_points_lack_nothing(tmp_path):
    pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    write_e57(path, [rows(0)])
    assert gk.points.load(path).points.shape == (0, 3)
    write_e57(path, [rows(0), rows(2, "time"), rows(1, "time")])
    cloud = gk.points.load(path)
    np.testing.assert_array_equal(cloud.points, XYZ[[0, 1, 0]])
    assert cloud.data["time"].tolist() == [0.0, 1.0, 0.0]
    assert cloud.data["scan"].tolist() == [1, 1, 2]


def test_names_of_several_scans_are_told(tmp_path):
    pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    write_e57(path, [rows(1), rows(1)], names=["hall", "roof\n2"])
    with pytest.warns(UserWarning, match=r"names of its scans are left out.*'scan': 0 'hall', 1 'roof\\n2'"):
        gk.points.load(path)
    write_e57(path, [rows(1)], names=["hall"])
    assert not gk.points.load(path).data


def test_angles_states_and_numbers_of_all_widths(tmp_path):
    libe57 = pytest.importorskip("pye57").libe57
    path = tmp_path / "a.e57"
    # Twice as long as a unit quaternion, a half turn about z.
    pose = ([0, 0, 0, 2], [1, 1, 1])
    names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
    echoes = dict(zip(names, np.array([[2.0, 3.0], [np.pi / 2, 0.0], [0.0, 0.0]]), strict=True))
    write_e57(path, [{**echoes, "sphericalInvalidState": np.array([0, 1], np.uint8)}], poses=[pose])
    np.testing.assert_allclose(gk.points.load(path).points, [[1.0, -1.0, 1.0]], atol=1e-15)

    ends = np.array([-(2**63), 2**63 - 1])
    scaled = {name: np.array([100.5, 99.5]) for name in AXES}
    nodes = {name: lambda file: libe57.ScaledIntegerNode(file, 0, -1000, 1000, 0.5, 100.0) for name in AXES}
    nodes["flag"] = lambda file: libe57.IntegerNode(file, 0, 0, 1)
    nodes["wide"] = lambda file: libe57.IntegerNode(file, 0, -(2**63), 2**63 - 1)
    nodes["same"] = lambda file: libe57.IntegerNode(file, 7, 7, 7)
    more = {"flag": np.array([0, 1]), "wide": ends, "same": np.array([7, 7])}
    write_e57(path, [{**scaled, **more}], nodes=nodes)
    cloud = gk.points.load(path)
    np.testing.assert_array_equal(cloud.points, [[100.5] * 3, [99.5] * 3])
    for name, values in more.items():
        np.testing.assert_array_equal(cloud.data[name], values)


def test_a_scan_of_colors_only_is_refused_by_name(tmp_path):
    pytest.importorskip("pye57")
    write_e57(tmp_path / "a.e57", [{"colorRed": np.array([1], np.uint8)}])
    with pytest.raises(gk.FileFormatError, match="a scan has no coordinates; its columns are colorRed"):
        gk.points.load(tmp_path / "a.e57")


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.int64])
def test_whole_numbers_of_each_size(tmp_path, kind):
    pytest.importorskip("pye57")
    values = np.linspace(0, float(np.iinfo(kind).max) * 0.99, 20).astype(kind)
    write_e57(tmp_path / "a.e57", [{**AXES, "returnIndex": values}])
    found = gk.points.load(tmp_path / "a.e57").data["returnIndex"]
    assert found.dtype == kind
    np.testing.assert_array_equal(found, values)


def test_colors_and_normals_have_their_names_and_turn_with_the_pose(tmp_path):
    pytest.importorskip("pye57")
    half = np.sqrt(0.5)
    color = {f"color{name}": np.arange(20, dtype=np.uint8) + at for at, name in enumerate(("Red", "Green", "Blue"))}
    normals = {f"nor:normal{axis}": np.full(20, float(axis == "X")) for axis in "XYZ"}
    write_e57(tmp_path / "a.e57", [{**AXES, **color, **normals}], poses=[([half, 0, 0, half], [1, 2, 3])])
    cloud = gk.points.load(tmp_path / "a.e57")
    assert cloud.data["rgb"].dtype == np.uint8
    assert cloud.data["rgb"][3].tolist() == [3, 4, 5]
    np.testing.assert_allclose(cloud.data["normals"], np.tile([0.0, 1.0, 0.0], (20, 1)), atol=1e-15)
    assert "scan" not in cloud.data


def _colors(values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"color{name}": values for name in ("Red", "Green", "Blue")}


@pytest.mark.parametrize(
    ("values", "limits", "expected"),
    [
        (np.arange(20, dtype=np.uint16) * 10, (0, 255), np.arange(20, dtype=np.uint8) * 10),
        (np.arange(20, dtype=np.uint16) * 53, (0, 1023), np.rint(np.arange(20) * 53 / 1023 * 65535).astype(np.uint16)),
        (np.arange(20, dtype=np.int32) * 10, None, np.arange(20, dtype=np.uint8) * 10),
        (np.arange(20) * 10.0, (0.0, 255.0), np.arange(20) * 10 / 255),
        (np.arange(20) / 20, None, np.arange(20) / 20),
    ],
)
def test_colors_are_full_at_the_limits_of_the_file(tmp_path, values, limits, expected):
    pytest.importorskip("pye57")
    write_e57(tmp_path / "a.e57", [{**AXES, **_colors(values)}], limits=[limits])
    found = gk.points.load(tmp_path / "a.e57").data["rgb"]
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, np.tile(expected[:, None], 3), rtol=1e-15)


def test_colors_of_several_scans_are_full_at_one_number(tmp_path):
    pytest.importorskip("pye57")
    narrow, wide = np.full(20, 255, np.uint8), np.full(20, 65535, np.uint16)
    scans = [{**AXES, **_colors(values)} for values in (narrow, wide)]
    write_e57(tmp_path / "a.e57", scans, images=2)
    with pytest.warns(UserWarning, match="its 2 images are left out"):
        found = gk.points.load(tmp_path / "a.e57").data["rgb"]
    assert found.dtype == np.uint16
    assert (found == 65535).all()
    write_e57(tmp_path / "b.e57", [*scans, {**AXES, **_colors(np.ones(20))}])
    assert (gk.points.load(tmp_path / "b.e57").data["rgb"] == 1.0).all()


def test_spherical_coordinates_become_cartesian_and_invalid_points_are_left_out(tmp_path):
    pytest.importorskip("pye57")
    reach = np.linalg.norm(XYZ, axis=1)
    columns = {
        "sphericalRange": reach,
        "sphericalAzimuth": np.arctan2(XYZ[:, 1], XYZ[:, 0]),
        "sphericalElevation": np.arcsin(XYZ[:, 2] / reach),
        "sphericalInvalidState": np.array([0, 1, 2, 0] * 5, np.int8),
    }
    write_e57(tmp_path / "a.e57", [columns])
    valid = columns["sphericalInvalidState"] == 0
    np.testing.assert_allclose(gk.points.load(tmp_path / "a.e57").points, XYZ[valid], rtol=0, atol=1e-14)


def test_what_not_all_scans_have_is_left_out_by_name(tmp_path):
    pytest.importorskip("pye57")
    write_e57(tmp_path / "a.e57", [{**AXES, "rowIndex": np.arange(20, dtype=np.int16)}, AXES])
    with pytest.warns(UserWarning, match="not all scans have rowIndex; left out"):
        assert list(gk.points.load(tmp_path / "a.e57").data) == ["scan"]


def test_damaged_scans_are_refused_with_their_path(tmp_path):
    pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    write_e57(path, [AXES])
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[1500] ^= 1
    for content, reason in (
        (whole[: len(whole) // 2], "size in file header"),
        (bytes(flipped), "checksum"),
        (b"ASTM-E57", "cannot be read"),
        (b"LASF", "does not start with 'ASTM-E57'"),
    ):
        path.write_bytes(content)
        with pytest.raises(gk.FileFormatError, match=f"^{re.escape(str(path))}: .*{reason}"):
            gk.points.load(path)
    write_e57(path, [])
    with pytest.raises(gk.FileFormatError, match="holds no scan"):
        gk.points.load(path)


# --- sweeps without a header ------------------------------------------------------------------------------------------


def test_sweeps_of_vehicles(tmp_path):
    xyz = XYZ.astype(np.float32)
    rest = RANDOM.random((20, 1)).astype(np.float32)
    np.hstack([xyz, rest]).astype("<f4").tofile(tmp_path / "000000.bin")
    cloud = gk.points.load(tmp_path / "000000.bin")
    np.testing.assert_array_equal(cloud.points, xyz)
    np.testing.assert_array_equal(cloud.data["reflectance"], rest[:, 0])
    np.hstack([xyz, 255 * rest, np.arange(20)[:, None]]).astype("<f4").tofile(tmp_path / "n.pcd.bin")
    cloud = gk.points.load(tmp_path / "n.pcd.bin")
    np.testing.assert_array_equal(cloud.points, xyz)
    assert cloud.data["ring"].tolist() == list(range(20))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (bytes(17), "has 17 bytes, no multiple of 16"),
        (np.full((5, 4), 1e6, "<f4").tobytes(), r"row 0 \(1e\+06, .* is no echo of a scanner"),
        (np.array([[1, 2, 3, 0.5], [1, 2, 3, -1]], "<f4").tobytes(), r"row 1 \(1, 2, 3, -1\)"),
        (np.array([[1, 2, 3, np.nan]], "<f4").tobytes(), "row 0"),
    ],
)
def test_other_files_called_bin_are_refused(content, reason, tmp_path):
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(gk.FileFormatError, match=f"a.bin: {reason}"):
        gk.points.load(tmp_path / "a.bin")


# --- COPC -------------------------------------------------------------------------------------------------------------


def test_copc_is_read_as_the_laz_that_it_is(tmp_path):
    laspy = pytest.importorskip("laspy")
    gk.points.save(tmp_path / "plain.laz", XYZ)
    cloud = laspy.read(tmp_path / "plain.laz")
    # The record that makes a file COPC: center, half size, spacing, place of the hierarchy, times.
    record = struct.pack("<5d2Q2d", 0, 0, 0, 8, 0.5, 0, 0, 0, 0) + bytes(11 * 8)
    cloud.header.vlrs.insert(0, laspy.VLR(user_id="copc", record_id=1, description="", record_data=record))
    cloud.write(tmp_path / "a.copc.laz")
    np.testing.assert_allclose(gk.points.load(tmp_path / "a.copc.laz").points, XYZ, rtol=0, atol=1e-8)
