"""What coordinates and times of a .las refer to stays with them, and colors keep their full from format to format."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from geokit.cli import main
from geokit.errors import FileFormatError, InputError

laspy = pytest.importorskip("laspy")

WKT = 'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS_1984"]],AUTHORITY["EPSG","32633"]]'
KEYS = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32633)
POINTS = np.random.default_rng(0).uniform([5e5, 5e6, 0.0], [500_050.0, 5_000_050.0, 5.0], (300, 3)).round(3)


def written(path: Path, kind: str, *, standard: bool = True, start: float = 3e8) -> Path:
    """A file by laspy alone."""
    point_format, version = (3, "1.2") if kind == "keys" else (7, "1.4")
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001] * 3, [5e5, 5e6, 0.0]
    times = laspy.header.GpsTimeType
    header.global_encoding.gps_time_type = times.STANDARD if standard else times.WEEK_TIME
    # A record of another kind before it.
    header.vlrs.append(laspy.VLR("someone", 7, "notes", b"123"))
    if kind == "keys":
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "keys", KEYS))
    if kind == "wkt":
        header.global_encoding.wkt = True
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(WKT))
    las = laspy.LasData(header)
    las.x, las.y, las.z = POINTS.T
    las.gps_time = start + np.arange(float(len(POINTS)))
    if kind == "behind":
        header.global_encoding.wkt = True
        las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.vlrs.known.WktCoordinateSystemVlr(WKT)])
    las.write(str(path))
    return path


def stated(path: Path) -> tuple[list[bytes], bool, bool]:
    """By laspy: the contents of the records, whether they are WKT, and whether times are standard."""
    with laspy.open(path) as reader:
        header = reader.header
        records = [*header.vlrs, *(header.evlrs or [])]
        found = [record.record_data_bytes() for record in records if record.user_id == "LASF_Projection"]
        standard = header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
        return found, bool(header.global_encoding.wkt), bool(standard)


@pytest.mark.parametrize("kind", ["wkt", "keys", "behind"])
@pytest.mark.parametrize("extension", ["las", "laz"])
@pytest.mark.parametrize("standard", [True, False])
def test_a_cloud_keeps_them(kind: str, extension: str, standard: bool, tmp_path: Path) -> None:
    source = written(tmp_path / f"a.{extension}", kind, standard=standard, start=3e8 if standard else 1000.0)
    before = stated(source)
    cloud = gk.points.load(source)
    assert cloud.coordinate_system.name == ("EPSG:32633" if kind == "keys" else "WGS 84 / UTM zone 33N")
    assert [content for _, _, content in cloud.coordinate_system.records] == before[0]
    for number, target in enumerate(("b.las", "b.laz")):
        some = cloud[:: number + 1]
        gk.points.save(tmp_path / target, some)
        assert stated(tmp_path / target) == before
        again = gk.points.load(tmp_path / target)
        assert again.coordinate_system == cloud.coordinate_system
        np.testing.assert_allclose(again.points, some.points, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("kind", ["wkt", "keys", "behind"])
@pytest.mark.parametrize("options", [[], ["--stream", "--voxel-size", "5"], ["--stream", "--normals", "8"]])
def test_from_file_to_file(kind: str, options: list[str], tmp_path: Path) -> None:
    source = written(tmp_path / "a.las", kind)
    assert main(["convert", str(source), str(tmp_path / "b.laz"), *options]) == 0
    assert stated(tmp_path / "b.laz") == stated(source)


def test_times_say_themselves_what_they_are(tmp_path: Path) -> None:
    for start, standard in ((3e8, True), (1000.0, False), (604_600.0, True)):
        gk.points.save(tmp_path / "a.las", POINTS, data={"gps_time": start + np.arange(300.0)})
        assert stated(tmp_path / "a.las") == ([], False, standard)


@pytest.mark.parametrize("target", ["b.ply", "b.npz", "b.vtp"])
def test_formats_without_them_say_so(target: str, tmp_path: Path) -> None:
    cloud = gk.points.load(written(tmp_path / "a.las", "wkt"))
    with pytest.warns(UserWarning, match=r"holds no coordinate system; WGS 84 / UTM zone 33N is left out"):
        gk.points.save(tmp_path / target, cloud, data={})


def test_info_names_it_and_shows_where_the_points_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(written(tmp_path / "a.las", "wkt"))]) == 0
    shown = capsys.readouterr().out
    assert "WGS 84 / UTM zone 33N" in shown
    (line,) = [line for line in shown.splitlines() if line.startswith("bounds")]
    numbers = [float(word.strip("(), ")) for word in line.split(None, 1)[1].split(",")]
    np.testing.assert_allclose(numbers, np.ravel([POINTS.min(axis=0), POINTS.max(axis=0)]), atol=1e-3)


def test_a_record_longer_than_its_place_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "a.las", "wkt")
    content = bytearray(path.read_bytes())
    struct.pack_into("<H", content, 375 + 20, 60_000)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"a\.las: a record of 60000 bytes is longer than its place"):
        gk.points.load(path, trusted=True)


RGB = np.array([[255, 255, 255], [0, 0, 0], [255, 128, 0], [1, 2, 3]], np.uint8)
AT = np.arange(12.0).reshape(4, 3)
WIDE = RGB.astype(np.uint16) * np.uint16(257)


@pytest.mark.parametrize(
    "colors", [RGB, WIDE, RGB / 255.0, (RGB / 255.0).astype(np.float32)], ids=lambda c: c.dtype.name
)
def test_full_stays_full(colors: np.ndarray, tmp_path: Path) -> None:
    for name in ("a.las", "a.laz"):
        gk.points.save(tmp_path / name, AT, data={"rgb": colors})
        las = laspy.read(tmp_path / name)
        assert np.array_equal(np.stack([las.red, las.green, las.blue], axis=1), WIDE)
    gk.points.save(tmp_path / "a.pts", AT, data={"rgb": colors})
    rows = (tmp_path / "a.pts").read_text().splitlines()[1:]
    assert np.array_equal([list(map(int, row.split()[3:])) for row in rows], RGB)
    gk.points.save(tmp_path / "a.pcd", AT, data={"rgb": colors}, encoding="binary")
    head, body = (tmp_path / "a.pcd").read_bytes().split(b"DATA binary\n", 1)
    assert b"FIELDS x y z rgb\nSIZE 8 8 8 4\nTYPE F F F F\nCOUNT 1 1 1 1\n" in head
    packed = np.frombuffer(body, np.uint8).reshape(4, 28)[:, 24:27]
    assert np.array_equal(packed[:, ::-1], RGB)


def test_bytes_in_sixteen_bits_are_taken_for_bytes(tmp_path: Path) -> None:
    """Many programs write them so into .las."""
    with pytest.warns(UserWarning, match="none of which is above 255, are taken for bytes"):
        gk.points.save(tmp_path / "a.pcd", AT, data={"rgb": RGB.astype(np.uint16)})
    assert np.array_equal(gk.points.load(tmp_path / "a.pcd").data["rgb"], RGB)
    gk.points.save(tmp_path / "a.las", AT, data={"rgb": RGB.astype(np.uint16)})
    assert np.array_equal(gk.points.load(tmp_path / "a.las").data["rgb"], RGB)
    black = np.zeros((4, 3), np.uint16)
    gk.points.save(tmp_path / "a.pcd", AT, data={"rgb": black})
    assert np.array_equal(gk.points.load(tmp_path / "a.pcd").data["rgb"], black)


def test_rows_of_a_cloud() -> None:
    cloud = gk.points.PointCloud(AT, {"rgb": RGB, "kind": np.array([2, 6, 2, 2])})
    ground = cloud[cloud.data["kind"] == 2]
    assert np.array_equal(ground.points, AT[[0, 2, 3]])
    assert np.array_equal(ground.data["rgb"], RGB[[0, 2, 3]])
    assert ground.data["kind"].tolist() == [2, 2, 2]
    assert len(cloud[1:3]) == 2
    assert np.array_equal(cloud[[3, 0, 0, -1]].points, AT[[3, 0, 0, 3]])
    assert len(cloud[[]]) == len(cloud[np.zeros(4, bool)]) == 0
    for rows in (1, "kind", [0.5], [True, False], np.zeros((2, 2), int), (slice(2), 0), None):
        with pytest.raises(InputError, match=r"rows: .* is not a slice, a mask of 4 rows, or numbers of rows"):
            cloud[rows]
    with pytest.raises(InputError, match=r"rows: index 4 is out of bounds.*; the cloud has 4 points"):
        cloud[[0, 4]]
