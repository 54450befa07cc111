""".pcd, .pts and .las: hand-written files of each variant, round trips, what other readers see, and every error."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pytest

import geokit as gk
from geokit.formats.las import LARGEST_STEPS
from geokit.formats.pcd import compress, decompress
from geokit.points._io import load, save

RANDOM = np.random.default_rng(11)
POINTS = RANDOM.normal(size=(50, 3)) * 10.0 ** RANDOM.integers(-8, 8, (50, 3)).astype(float)
NORMALS = RANDOM.normal(size=(50, 3))
RGB = RANDOM.integers(0, 256, (50, 3)).astype(np.uint8)
RGBA = RANDOM.integers(0, 256, (50, 4)).astype(np.uint8)
ENCODINGS = ["ascii", "binary", "binary_compressed"]


def write(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


# .pcd


def header(fields="x y z", size="4 4 4", kind="F F F", count=None, points=2, data="ascii", width=None, extra=""):
    counts = f"COUNT {count}\n" if count else ""
    return (
        f"# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\n{counts}"
        f"WIDTH {points if width is None else width}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\n{extra}"
        f"DATA {data}\n"
    )


def test_pcd_ascii_by_hand(tmp_path):
    head = header("x y z normal_x normal_y normal_z id", "4 8 4 4 4 4 2", "F F F F F F U")
    cloud = load(write(tmp_path / "a.pcd", head + "1 2 3 0 0 1 7\n4 5 6 0 1 0 65535\n"))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.data["normals"].tolist() == [[0, 0, 1], [0, 1, 0]]
    assert cloud.data["id"].tolist() == [7, 65535]
    assert cloud.data["id"].dtype == np.uint16


def test_pcd_binary_by_hand(tmp_path):
    head = header("x y z _ rgb hist", "4 4 4 1 4 2", "F F F U F I", "1 1 1 3 1 2", data="binary")
    body = b"".join(
        struct.pack("<fff3xIhh", *point, color, *hist)
        for point, color, hist in [((1, 2, 3), 0xFF8040, (-1, 2)), ((4, 5, 6), 0x010203, (3, -4))]
    )
    cloud = load(write(tmp_path / "a.pcd", head.encode() + body))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.data["rgb"].tolist() == [[255, 128, 64], [1, 2, 3]]
    assert cloud.data["rgb"].dtype == np.uint8
    assert cloud.data["hist"].tolist() == [[-1, 2], [3, -4]]
    assert set(cloud.data) == {"rgb", "hist"}


@pytest.mark.parametrize(("kind", "shown"), [("U", "4286578768"), ("I", "-8388528"), ("F", "-1.1754943e-38")])
def test_pcd_colors_are_bits_whatever_their_type(kind, shown, tmp_path):
    # 0xFF800050, 0xFF800050 as a signed integer, 0x80800000 as a float: an alpha, then red, green and blue.
    head = header("x y z rgba", "4 4 4 4", f"F F F {kind}", points=1)
    cloud = load(write(tmp_path / "a.pcd", f"{head}1 2 3 {shown}\n"))
    expected = [0x80, 0, 0, 0x80] if kind == "F" else [0x80, 0, 0x50, 0xFF]
    assert cloud.data["rgba"].tolist() == [expected]


@pytest.mark.parametrize("padded", [True, False])
def test_pcd_compressed_by_hand(padded, tmp_path):
    # Field after field, with and without the bytes of the padding field; 19 literals, then 5 zeros by reference.
    plain = struct.pack("<6f", 1, 4, 2, 5, 3, 6)
    if padded:
        plain = plain[:8] + b"\0\0" + plain[8:]
    packed = bytes([len(plain) - 1]) + plain
    head = header("x _ y z", "4 1 4 4", "F U F F", data="binary_compressed")
    body = struct.pack("<II", len(packed), len(plain)) + packed
    cloud = load(write(tmp_path / "a.pcd", head.encode() + body))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_lzf_by_hand():
    # Literals "abc", a reference 3 back of 3 + 2 bytes that reaches into itself, one of 7 + 4 + 2 bytes 1 back.
    packed = np.frombuffer(b"\x02abc" + bytes([3 << 5, 2]) + bytes([7 << 5, 4, 0]), np.uint8)
    plain, bad = decompress(packed, 21)
    assert bad == -1
    assert plain.tobytes() == b"abcabcab" + b"b" * 13


@pytest.mark.parametrize(
    ("packed", "size", "bad"),
    [
        (b"\x02ab", 3, 0),  # a run beyond the end
        (b"\x00a\x20", 4, 2),  # a reference without its distance
        (b"\x00a\xe0\x00", 10, 2),  # and a long one
        (b"\x00a\x20\x01", 4, 2),  # to before the beginning
        (b"\x02abc", 2, 0),  # more than was said
        (b"\x02abc", 4, 0),  # less
        (b"\x00a\x20\x00", 3, 2),
        (b"", 1, 0),
    ],
)
def test_damaged_lzf(packed, size, bad):
    assert decompress(np.frombuffer(packed, np.uint8), size)[1] == bad


@pytest.mark.parametrize("size", [0, 1, 2, 3, 31, 32, 33, 64, 65, 263, 264, 265, 300, 8191, 8192, 8193, 8200, 70_000])
@pytest.mark.parametrize("kind", ["zeros", "noise", "text", "far"])
def test_lzf_round_trip(kind, size):
    random = np.random.default_rng(size)
    plain = {
        "zeros": np.zeros(size, np.uint8),
        "noise": random.integers(0, 256, size).astype(np.uint8),
        "text": random.integers(0, 3, size).astype(np.uint8),
        # Repeats at the largest distance that the format knows, and one beyond.
        "far": np.resize(random.integers(0, 256, 8192 + size % 2).astype(np.uint8), size),
    }[kind]
    packed = compress(plain)
    again, bad = decompress(packed, size)
    assert bad == -1
    np.testing.assert_array_equal(again, plain)
    assert len(packed) <= size + size // 32 + 1
    if kind == "zeros" and size > 8000:
        assert len(packed) < size / 50
    if kind == "far" and size > 60_000:
        # Found where a reference reaches that far, and only there.
        assert (len(packed) < size / 4) == (size % 2 == 0)


@pytest.mark.parametrize("encoding", [*ENCODINGS, None])
def test_pcd_round_trip_keeps_every_bit(encoding, tmp_path):
    data = {
        "normals": NORMALS,
        "rgb": RGB,
        "rgba": RGBA,
        "curvature": NORMALS[:, 0].astype(np.float32),
        "hist": RANDOM.normal(size=(50, 5)).astype(np.float32),
        "id": np.arange(50) + (1 << 40),
        "label": np.arange(-25, 25, dtype=np.int8),
    }
    save(tmp_path / "a.pcd", POINTS, data=data, encoding=encoding)
    cloud = load(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert set(cloud.data) == set(data)
    for name, values in data.items():
        np.testing.assert_array_equal(cloud.data[name], values)
        assert cloud.data[name].dtype == values.dtype
    said = (tmp_path / "a.pcd").read_bytes().partition(b"DATA ")[2].split()[0].decode()
    assert said == (encoding or "binary")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_float32_points_are_written_in_four_bytes(encoding, tmp_path):
    points = (np.arange(12).reshape(4, 3) / 7.0).astype(np.float32)
    save(tmp_path / "a.pcd", points, encoding=encoding)
    assert b"SIZE 4 4 4\nTYPE F F F\n" in (tmp_path / "a.pcd").read_bytes()
    np.testing.assert_array_equal(load(tmp_path / "a.pcd").points, points)
    save(tmp_path / "a.pcd", points.astype(np.float64), encoding=encoding)
    assert b"SIZE 8 8 8\nTYPE F F F\n" in (tmp_path / "a.pcd").read_bytes()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_no_points_as_pcd(encoding, tmp_path):
    save(tmp_path / "a.pcd", np.zeros((0, 3)), data={"v": np.zeros((0, 4))}, encoding=encoding)
    cloud = load(tmp_path / "a.pcd")
    assert cloud.points.shape == (0, 3)
    assert cloud.data["v"].shape == (0, 4)


def test_integers_beyond_float64_in_text(tmp_path):
    big = np.array([2**63 - 1, -(2**63) + 1, 2**53 + 1])
    save(tmp_path / "a.pcd", np.zeros((3, 3)), data={"id": big, "u": big.astype(np.uint64)}, encoding="ascii")
    cloud = load(tmp_path / "a.pcd")
    assert cloud.data["id"].tolist() == big.tolist()
    assert cloud.data["u"].tolist() == big.astype(np.uint64).tolist()


def test_points_that_are_not_finite(tmp_path):
    text = header(points=4) + "1 2 3\nnan nan nan\n4 5 6\n7 inf 9\n"
    path = write(tmp_path / "a.pcd", text)
    with pytest.raises(gk.FileFormatError, match=r"point 1 is not finite .*all 2 such points with finite_only=True"):
        load(path)
    assert load(path, finite_only=True).points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_finite_only_takes_the_rows_of_data_along(tmp_path):
    path = write(tmp_path / "a.csv", "x,y,z,id\n1,2,3,0\nnan,2,3,1\n4,5,6,2\n")
    cloud = load(path, finite_only=True)
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.data["id"].tolist() == [0, 2]


COMPRESSED = header(data="binary_compressed").encode()
DAMAGED_PCD = [
    ("# .PCD\nVERSION .7\nFIELDS x y z\n", "no DATA line"),
    ("solid ground\nDATA ascii\n", r"'solid ground' \(byte 0\) is not understood"),
    (header(extra="WIDTH 2\n"), r"'WIDTH 2' \(byte \d+\) is not understood"),
    (header(data="base64"), "DATA is 'base64'"),
    (header(size="4 4"), "list 3, 2, 3 and 3 entries"),
    (header(fields=""), "list 0, 3, 3 and 0"),
    (header(size="4 4 3"), "field 'z' has TYPE F, SIZE 3"),
    (header(kind="F F Q"), "field 'z' has TYPE Q"),
    (header(count="1 1 0"), "COUNT 0"),
    (header(count="1 1 -1"), "COUNT -1"),
    (header(count="1 1 2"), "field 'z' has COUNT 2"),
    (header("x y z a b", "4 4 4 8 8", "F F F F F", "1 1 1 100000000 100000000"), "more than 1 GiB"),
    (header("x y y"), "two fields are called 'y'"),
    (header("x y w") + "1 2 3\n4 5 6\n", "has no x, y and z; its columns are x, y, w"),
    (header(points="two"), "POINTS is 'two'|WIDTH is 'two'"),
    (header(points="9" * 30), "is '9+', not a whole number"),
    (header(width=3), "POINTS is 2 and WIDTH x HEIGHT is 3"),
    (header().replace("POINTS 2\n", "").replace("WIDTH 2\n", ""), "POINTS is missing and WIDTH x HEIGHT is missing"),
    (header() + "1 2 3\n", "ends in point 1 of the 2"),
    (header() + "1 2 3\n4 5 6\n7 8 9\n", "has 3 points and not the 2"),
    (header() + "1 2 3\n4 5\n", "line 12 has 2 values"),
    (header() + "1 2 3\n4 5 six\n", r"line 12 \('4 5 six'\) is not a row of numbers"),
    (header() + "1 2 3 4\n4 5 6 7\n", "rows have 4 values and its fields need 3"),
    (header(points=10**12), "ends in point 0 of the 1000000000000"),
    (header(kind="F F U") + "1 2 3\n4 5 -6\n", "'z' of point 1 is not an integer of 32 bits"),
    (header(kind="F F U") + "1 2 3.5\n4 5 6\n", "'z' of point 0 is not an integer"),
    (header(kind="F F U") + "1 2 nan\n4 5 6\n", "'z' of point 0 is not an integer"),
    (header(data="binary").encode() + bytes(23), "ends in point 1 of the 2"),
    (header(data="binary", points=10**17).encode() + bytes(24), "ends in point 2 of the 1"),
    (COMPRESSED + bytes(7), "ends before the sizes"),
    (COMPRESSED + struct.pack("<II", 9, 24) + bytes(8), "ends after 8 of the 9 bytes"),
    (COMPRESSED + struct.pack("<II", 8, 25) + bytes(8), "8 compressed bytes declare 25, and 2 points have 24"),
    (
        header(data="binary_compressed", points=10**8).encode() + struct.pack("<II", 8, 1_200_000_000) + bytes(8),
        "declare",
    ),
    (COMPRESSED + struct.pack("<II", 8, 24) + b"\xff" * 8, r"damaged at byte \d+"),
]


@pytest.mark.parametrize(("text", "message"), DAMAGED_PCD)
def test_damaged_pcd_is_named_with_the_place(text, message, tmp_path):
    path = write(tmp_path / "a.pcd", text)
    with pytest.raises(gk.FileFormatError, match=message) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"x": np.zeros(50)}, "'x' is taken"),
        ({"normals": NORMALS, "normal_y": np.zeros(50)}, "'normal_y' is taken"),
        ({"two words": np.zeros(50)}, "'two words' is taken or cannot be"),
        ({"_": np.zeros(50)}, "'_' is taken or cannot be"),
        ({"": np.zeros(50)}, "'' is taken or cannot be"),
        ({"none": np.zeros((50, 0))}, "'none' has no columns"),
    ],
)
def test_data_that_pcd_cannot_hold(data, message, tmp_path):
    with pytest.raises(gk.InputError, match=message):
        save(tmp_path / "a.pcd", POINTS, data=data)
    assert list(tmp_path.iterdir()) == []


def test_encodings(tmp_path):
    with pytest.raises(
        gk.InputError, match=r"'zip' is not one of \.pcd; use one of None, 'binary', 'ascii', 'binary_c"
    ):
        save(tmp_path / "a.pcd", POINTS, encoding="zip")
    with pytest.raises(gk.InputError, match=r"'ascii' is not one of \.xyz; use one of None"):
        save(tmp_path / "a.xyz", POINTS, encoding="ascii")


# .pts


@pytest.mark.parametrize(
    ("text", "data"),
    [
        ("2\n1 2 3\n4 5 6\n", {}),
        ("2\r\n1 2 3 -2048\r\n4 5 6 2047", {"intensity": [-2048, 2047]}),
        ("2\n1 2 3 255 128 0\n4 5 6 1 2 3\n", {"rgb": [[255, 128, 0], [1, 2, 3]]}),
        (" 2 \n1 2 3 0.5 255 128 0\n4 5 6 0.25 1 2 3\n", {"intensity": [0.5, 0.25], "rgb": [[255, 128, 0], [1, 2, 3]]}),
    ],
)
def test_pts_by_hand(text, data, tmp_path):
    cloud = load(write(tmp_path / "a.pts", text))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert {name: values.tolist() for name, values in cloud.data.items()} == data


@pytest.mark.parametrize("names", [(), ("intensity",), ("rgb",), ("intensity", "rgb")])
def test_pts_round_trip_keeps_every_bit(names, tmp_path):
    data = {name: {"intensity": NORMALS[:, 0], "rgb": RGB}[name] for name in names}
    save(tmp_path / "a.pts", POINTS, data=data)
    cloud = load(tmp_path / "a.pts")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert set(cloud.data) == set(names)
    for name, values in data.items():
        np.testing.assert_array_equal(cloud.data[name], values)


def test_no_points_as_pts(tmp_path):
    save(tmp_path / "a.pts", np.zeros((0, 3)))
    assert load(tmp_path / "a.pts").points.shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5 6\n", r"line 1 \('1 2 3'\) is not the number of points.* call the file .xyz"),
        ("3\n1 2 3\n4 5 6\n", "ends in point 2 of the 3"),
        ("9" * 18 + "\n1 2 3\n", "ends in point 1 of the 9+ it declares"),
        ("9" * 19 + "\n1 2 3\n", "is not the number of points"),
        ("3\n", "ends in point 0 of the 3"),
        ("1\n1 2 3\n4 5 6\n", "has 2 points and declares 1"),
        ("2\n1 2 3\n4 5\n", "line 3 has 2 values"),
        ("2\n1 2 3\n4 5 x\n", r"line 3 \('4 5 x'\) is not a row"),
        ("1\n1 2\n", "has 2 values in a row"),
        ("1\n1 2 3 4 5\n", "has 5 values in a row"),
        ("1\n1 2 3 0 0 256\n", r"color of point 0 \(\[0.0, 0.0, 256.0\]\)"),
        ("1\n1 2 3 0 0.5 6\n", "color of point 0"),
        ("1\n1 2 inf\n", "point 0 is not finite"),
    ],
)
def test_damaged_pts_is_named_with_the_place(text, message, tmp_path):
    with pytest.raises(gk.FileFormatError, match=message) as caught:
        load(write(tmp_path / "a.pts", text))
    assert str(tmp_path / "a.pts") in str(caught.value)


@pytest.mark.parametrize("data", [{"normals": NORMALS}, {"rgb": RGB.astype(float)}, {"intensity": NORMALS}])
def test_data_that_pts_cannot_hold(data, tmp_path):
    with pytest.raises(gk.InputError, match=r"\.pts holds 'intensity' \(N,\) and 'rgb'"):
        save(tmp_path / "a.pts", POINTS, data=data)


# Colors in the formats with columns.


@pytest.mark.parametrize("kind", ["ply", "csv", "xyz"])
def test_colors_are_red_green_and_blue(kind, tmp_path):
    save(tmp_path / f"a.{kind}", POINTS, data={"rgb": RGB})
    head = (tmp_path / f"a.{kind}").read_bytes()[:300]
    assert all(name in head for name in (b"red", b"green", b"blue"))
    np.testing.assert_array_equal(load(tmp_path / f"a.{kind}").data["rgb"], RGB)


# .las


def las():
    return pytest.importorskip("laspy")


def las_kinds():
    try:
        import laspy

        return ["las", "laz"] if laspy.LazBackend.detect_available() else ["las"]
    except ImportError:
        return ["las"]


@pytest.mark.parametrize("kind", las_kinds())
def test_las_round_trip(kind, tmp_path):
    las()
    points = RANDOM.uniform([-1e6, 4.5e6, -3.0], [-1e6 + 800.0, 4.5e6 + 3.0, 250.0], (1000, 3))
    data = {
        "intensity": RANDOM.integers(0, 65536, 1000).astype(np.uint16),
        "classification": RANDOM.integers(0, 256, 1000).astype(np.uint8),
        "return_number": RANDOM.integers(0, 16, 1000).astype(np.uint8),
        "gps_time": RANDOM.normal(size=1000),
        "rgb": RANDOM.integers(0, 65536, (1000, 3)).astype(np.uint16),
        "normals": RANDOM.normal(size=(1000, 3)),
        "height": RANDOM.normal(size=1000).astype(np.float32),
        "id": np.arange(1000) + (1 << 40),
        "flag": RANDOM.integers(0, 2, 1000).astype(bool),
    }
    save(tmp_path / f"a.{kind}", points, data=data)
    cloud = load(tmp_path / f"a.{kind}")
    assert_within_bound(cloud.points, points)
    for name, values in data.items():
        np.testing.assert_array_equal(cloud.data[name], values)
        assert cloud.data[name].dtype == (np.uint8 if name == "flag" else values.dtype)


def assert_within_bound(found, given):
    """What :func:`save` promises: 1.2e-9 of the extent along each axis, and two roundings of the coordinates."""
    bound = 1.2e-9 * np.ptp(given, axis=0) + 2.0 * np.spacing(np.abs(given).max(axis=0))
    assert (np.abs(found - given) <= bound).all()


@pytest.mark.parametrize("extent", [1e-300, 1e-9, 1.0, 2.0 * LARGEST_STEPS, 12345.678, 1e9, 1e300])
@pytest.mark.parametrize("offset", [0.0, 1.0, -7e6, 1e15])
def test_las_keeps_coordinates_within_its_bound(extent, offset, tmp_path):
    las()
    points = offset + extent * RANDOM.uniform(-0.5, 0.5, (200, 3))
    save(tmp_path / "a.las", points)
    assert_within_bound(load(tmp_path / "a.las").points, points)


def test_las_keeps_decimals(tmp_path):
    las()
    points = RANDOM.integers(0, 10**8, (200, 3)) / 1000.0
    save(tmp_path / "a.las", points)
    np.testing.assert_allclose(load(tmp_path / "a.las").points, points, rtol=0, atol=2.0 * np.spacing(1e5))


@pytest.mark.parametrize("value", [0.0, 0.1, -123456.789, 1e-300, 1e300])
def test_las_with_points_all_alike(value, tmp_path):
    las()
    points = np.full((5, 3), value)
    save(tmp_path / "a.las", points)
    np.testing.assert_array_equal(load(tmp_path / "a.las").points, points)


def test_no_points_as_las(tmp_path):
    las()
    save(tmp_path / "a.las", np.zeros((0, 3)))
    assert load(tmp_path / "a.las").points.shape == (0, 3)


@pytest.mark.parametrize("kind", [0, 3, 8])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_las_that_laspy_writes(kind, version, tmp_path):
    laspy = las()
    if kind == 8 and version == "1.2":
        pytest.skip("format 8 came with 1.4")
    head = laspy.LasHeader(point_format=kind, version=version)
    head.scales, head.offsets = [0.001, 0.01, 0.1], [1000.0, 2000.0, -3000.0]
    cloud = laspy.LasData(head)
    cloud.X, cloud.Y, cloud.Z = np.array([[1, -2], [3, 4], [5, 6]])
    cloud.intensity = np.array([7, 65535])
    if kind:
        cloud.red, cloud.green, cloud.blue = np.array([[1, 2], [3, 4], [5, 65535]])
    cloud.write(str(tmp_path / "a.las"))
    found = load(tmp_path / "a.las")
    np.testing.assert_allclose(found.points, [[1000.001, 2000.03, -2999.5], [999.998, 2000.04, -2999.4]], rtol=4e-16)
    assert found.data["intensity"].tolist() == [7, 65535]
    assert ("rgb" in found.data) == bool(kind)
    if kind:
        assert found.data["rgb"].tolist() == [[1, 3, 5], [2, 4, 65535]]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"X": np.zeros(50)}, "'X' is taken"),
        ({"red": np.zeros(50)}, "'red' is taken"),
        ({"n" * 33: np.zeros(50)}, "cannot be a name in .las"),
        ({"wide": np.zeros((50, 4))}, "'wide' has 4 columns"),
        ({"nir": np.zeros(50)}, "'nir' only beside 'rgb'"),
        ({"rgb": RGB.astype(float)}, "'rgb' is float64"),
        ({"intensity": np.full(50, 65536)}, "'intensity' does not fit"),
        ({"intensity": np.full(50, 0.5)}, "'intensity' does not fit"),
        ({"intensity": np.full(50, -1)}, "'intensity' does not fit"),
        ({"return_number": np.full(50, 16)}, "'return_number' does not fit"),
        ({"classification": np.zeros((50, 2), np.uint8)}, "'classification' does not fit"),
    ],
)
def test_data_that_las_cannot_hold(data, message, tmp_path):
    las()
    with pytest.raises(gk.InputError, match=message):
        save(tmp_path / "a.las", POINTS, data=data)
    assert list(tmp_path.iterdir()) == []


def test_damaged_las_is_named(tmp_path):
    las()
    save(tmp_path / "a.las", POINTS)
    whole = (tmp_path / "a.las").read_bytes()
    path = tmp_path / "b.las"

    def refused(data, message):
        with pytest.raises(gk.FileFormatError, match=message) as caught:
            load(write(path, data))
        assert str(path) in str(caught.value)

    refused(b"LAS?" + whole[4:], "does not start with 'LASF'")
    refused(whole[:300], "ends within its header, at byte 300 of 375")
    refused(whole[:-1], "ends in point 49 of the 50")
    # A count of points and one of records that nothing could hold.
    refused(whole[:247] + struct.pack("<Q", 1 << 60) + whole[255:], "ends in point 50 of the 1152921504606846976")
    refused(whole[:100] + struct.pack("<I", 1 << 31) + whole[104:], "puts 2147483648 records")
    refused(whole[:243] + struct.pack("<I", 1 << 31) + whole[247:], "2147483648 extended records")
    refused(whole[:104] + b"\x37" + whole[105:], "cannot be read as .las")
    # The bit for compressed points, and no table of chunks.
    if "laz" in las_kinds():
        refused(whole[:104] + b"\x86" + whole[105:], "table of compressed chunks")


def test_without_laspy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    write(tmp_path / "a.las", b"LASF")
    with pytest.raises(gk.MissingDependencyError, match=r"pip install 'geokit-nanovdb\[las\]'"):
        load(tmp_path / "a.las")
    with pytest.raises(gk.MissingDependencyError, match=r"pip install 'geokit-nanovdb\[las\]'"):
        save(tmp_path / "b.las", POINTS)
    assert not (tmp_path / "b.las").exists()


def test_without_a_backend_for_laz(tmp_path, monkeypatch):
    laspy = las()
    save(tmp_path / "a.las", POINTS)
    monkeypatch.setattr(laspy.LazBackend, "detect_available", lambda: ())
    whole = (tmp_path / "a.las").read_bytes()
    write(tmp_path / "a.laz", whole[:104] + b"\x86" + whole[105:])
    with pytest.raises(gk.MissingDependencyError, match="lazrs"):
        load(tmp_path / "a.laz")
    with pytest.raises(gk.MissingDependencyError, match="lazrs"):
        save(tmp_path / "b.laz", POINTS)


# What another library makes of our files, and we of its.


@pytest.fixture(scope="module")
def open3d():
    return pytest.importorskip("open3d")


@pytest.mark.parametrize(("kind", "encoding"), [("ply", None), ("pts", None), *(("pcd", e) for e in ENCODINGS)])
def test_open3d_reads_the_same(kind, encoding, open3d, tmp_path):
    path = tmp_path / f"a.{kind}"
    data = {"rgb": RGB} if kind == "pts" else {"rgb": RGB, "normals": NORMALS.astype(np.float32)}
    # Of .pcd it reads coordinates of four bytes only, and zeros for others.
    points = POINTS.astype(np.float32) if kind == "pcd" else POINTS
    save(path, points, data=data, encoding=encoding)
    found = open3d.io.read_point_cloud(str(path))
    # Text has the shortest digits of float32, which it reads as float64.
    tolerance = 6e-8 if encoding == "ascii" else 0.0
    np.testing.assert_allclose(np.asarray(found.points), points, rtol=tolerance)
    np.testing.assert_array_equal(np.rint(np.asarray(found.colors) * 255.0), RGB)
    if "normals" in data:
        np.testing.assert_allclose(np.asarray(found.normals), data["normals"], rtol=tolerance)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("ply", {}),
        ("ply", {"write_ascii": True}),
        ("pts", {}),
        ("pcd", {}),
        ("pcd", {"write_ascii": True}),
        ("pcd", {"compressed": True}),
    ],
)
def test_files_of_open3d(kind, options, open3d, tmp_path):
    path = tmp_path / f"a.{kind}"
    points, normals = POINTS.astype(np.float32).astype(np.float64), NORMALS.astype(np.float32).astype(np.float64)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    cloud.colors = open3d.utility.Vector3dVector(RGB / 255.0)
    assert open3d.io.write_point_cloud(str(path), cloud, **options)
    found = load(path)
    # It writes six digits into text, ten after the point into .pts and .pcd.
    ascii_ = options.get("write_ascii") or kind == "pts"
    tolerance = {"rtol": 1e-5 if kind == "ply" else 1e-9, "atol": 1e-10} if ascii_ else {"rtol": 0}
    np.testing.assert_allclose(found.points, points, **tolerance)
    np.testing.assert_array_equal(found.data["rgb"], RGB)
    if kind != "pts":
        np.testing.assert_allclose(found.data["normals"], normals, **tolerance)
