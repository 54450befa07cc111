"""Point sets and rays in files: round trips, what other programs write, damaged files and every error."""

from __future__ import annotations

import stat

import numpy as np
import pytest

import geokit as gk
from geokit.points._io import Rays

RANDOM = np.random.default_rng(5)
POINTS = RANDOM.normal(size=(40, 3)) * 10.0 ** RANDOM.integers(-8, 8, (40, 3)).astype(float)
DATA = {
    "normals": RANDOM.normal(size=(40, 3)),
    "distance": RANDOM.normal(size=40),
    "velocity": RANDOM.normal(size=(40, 3)).astype(np.float32),
    "triangle_id": np.arange(-1, 39, dtype=np.int32),
}
WRITABLE = ["csv", "npz", "pcd", "ply", "vtp", "xyz"]
WITH_TYPES = ["npz", "pcd", "ply", "vtp"]


def write(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("kind", WRITABLE)
def test_round_trip_keeps_every_bit(kind, tmp_path):
    path = tmp_path / f"cloud.{kind}"
    gk.points.save(path, POINTS, data=DATA)
    cloud = gk.points.load(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert set(cloud.data) == set(DATA)
    for name, values in DATA.items():
        np.testing.assert_array_equal(cloud.data[name], values)
        assert cloud.data[name].dtype == (values.dtype if kind in WITH_TYPES else np.float64)


@pytest.mark.parametrize("kind", WRITABLE)
@pytest.mark.parametrize("dtype", [np.float16, np.longdouble])
def test_floats_that_files_do_not_hold_become_others(kind, dtype, tmp_path):
    path = tmp_path / f"a.{kind}"
    gk.points.save(path, np.eye(3), data={"v": np.array([0.5, 1.25, -2.0], dtype)})
    assert gk.points.load(path).data["v"].tolist() == [0.5, 1.25, -2.0]


@pytest.mark.parametrize("kind", WRITABLE)
def test_no_points(kind, tmp_path):
    path = tmp_path / f"cloud.{kind}"
    gk.points.save(path, np.zeros((0, 3)))
    assert gk.points.load(path).points.shape == (0, 3)


@pytest.mark.parametrize("kind", WRITABLE)
def test_one_point_with_flags(kind, tmp_path):
    path = tmp_path / f"cloud.{kind}"
    gk.points.save(path, [[1, 2, 3]], data={"inside": np.array([True]), "rgba": np.array([[1, 2, 3, 4]], np.uint8)})
    cloud = gk.points.load(path)
    assert cloud.points.tolist() == [[1.0, 2.0, 3.0]]
    assert cloud.data["inside"].tolist() == [1]
    wide = cloud.data["rgba"] if "rgba" in cloud.data else np.stack([cloud.data[f"rgba_{i}"] for i in range(4)], axis=1)
    assert wide.tolist() == [[1, 2, 3, 4]]


def test_point_cloud_is_checked_and_read_only():
    given = POINTS.copy()
    cloud = gk.points.PointCloud(given, {"a": [1] * 40})
    given[:] = 0.0
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert len(cloud) == 40
    assert repr(cloud) == "PointCloud(40 points, data: a)"
    with pytest.raises(ValueError, match="read-only"):
        cloud.points[0] = 1.0
    with pytest.raises(TypeError):
        cloud.data["b"] = 1
    for points, message in [
        (POINTS[:, :2], r"points: shape \(40, 2\)"),
        ([[0, 0, 0], [0, np.inf, 0]], "points: row 1 is not finite"),
        ([["a", "b", "c"]], "points: dtype"),
    ]:
        with pytest.raises(gk.InputError, match=message):
            gk.points.PointCloud(points)
    for data, message in [
        ({"a": [1, 2]}, r"'a' has shape \(2,\); give one row for each of the 40"),
        ({"a": ["x"] * 40}, "'a'.*dtype"),
        ({"a": np.zeros((40, 2, 2))}, "'a' has shape"),
    ]:
        with pytest.raises(gk.InputError, match=message):
            gk.points.PointCloud(POINTS, data)


@pytest.mark.parametrize(
    ("name", "text", "data"),
    [
        ("a.csv", "x,y,z\n1,2,3\n4,5,6\n", {}),
        ("a.csv", "1,2,3\n4,5,6\n", {}),
        ("a.csv", "\ufeffX;Y;Z\r\n1;2;3\r\n4;5;6\r\n", {}),
        ("a.csv", 'id,"x","y","z"\n7,1,2,3\n8,4,5,6\n', {"id": [7, 8]}),
        ("a.csv", 'x,y,z,"of ""a"", ""b"""\n1,2,3,7\n4,5,6,8\n', {'of "a", "b"': [7, 8]}),
        ("a.csv", "1,2,3,9\n4,5,6,10\n", {"column_3": [9, 10]}),
        ("a.csv", "easting,northing,height,class\n1,2,3,9\n4,5,6,10\n", {"class": [9, 10]}),
        ("a.csv", "x,y,z,nx,ny,nz\n1,2,3,0,0,1\n4,5,6,0,1,0\n", {"normals": [[0, 0, 1], [0, 1, 0]]}),
        ("a.csv", "x,y,z,nx\n1,2,3,0\n4,5,6,0\n", {"nx": [0, 0]}),
        ("a.xyz", "1 2 3\n\n  4\t5 6\n", {}),
        ("a.xyz", "# made by hand, twice\n1 2 3\n# a remark\n4 5 6 # another\n", {}),
        ("a.txt", "# x y z w\n1 2 3 0.5\n4 5 6 0.25\n", {"w": [0.5, 0.25]}),
        ("a.obj", "# a mesh\nv 1 2 3\nvn 0 0 1\nv 4 5 6 1.0\nf 1 2 1\n", {}),
        (
            "a.ply",
            "ply\nformat ascii 1.0\ncomment hand-made\nelement vertex 2\nproperty float x\nproperty double y\n"
            "property float z\nproperty uchar red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
            "1 2 3 255\n4 5 6 0\n3 0 1 0\n",
            {"red": [255, 0]},
        ),
    ],
)
def test_files_that_others_write(name, text, data, tmp_path):
    cloud = gk.points.load(write(tmp_path / name, text))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert {key: values.tolist() for key, values in cloud.data.items()} == data


def test_big_endian_ply(tmp_path):
    head = b"ply\nformat binary_big_endian 1.0\nelement vertex 2\n" + b"".join(
        b"property double %c\n" % axis for axis in b"xyz"
    )
    body = np.array([[1, 2, 3], [4, 5, 6]], ">f8").tobytes()
    cloud = gk.points.load(write(tmp_path / "a.ply", head + b"end_header\n" + body))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_numpy_files(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(8, dtype=np.int32).reshape(2, 4))
    cloud = gk.points.load(tmp_path / "a.npy")
    assert cloud.points.tolist() == [[0, 1, 2], [4, 5, 6]]
    assert cloud.data["column_3"].tolist() == [3, 7]
    np.savez(tmp_path / "a.npz", cloud=POINTS, note=np.array("from a scanner"), weight=np.ones(40), other=np.ones(7))
    with pytest.warns(UserWarning, match="left out: 'note', 'other'"):
        cloud = gk.points.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert set(cloud.data) == {"weight"}


def test_vtp_is_what_pyvista_reads(tmp_path):
    import pyvista

    gk.points.save(tmp_path / "a.vtp", POINTS, data=DATA)
    found = pyvista.read(tmp_path / "a.vtp")
    np.testing.assert_array_equal(found.points, POINTS)
    np.testing.assert_array_equal(found["velocity"], DATA["velocity"])
    assert found.n_verts == 40
    found.save(tmp_path / "b.vtp", binary=False)
    np.testing.assert_array_equal(gk.points.load(tmp_path / "b.vtp").points, POINTS)


PLY = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
DAMAGED = [
    ("a.csv", "x,y,z\n1,2,3\n1,2\n", "line 3 has 2 values"),
    ("a.csv", "x,y,z\n1,2,3\n1,,3\n", r"line 3 \('1,,3'\) is not a row of numbers"),
    ("a.csv", "x,y,z\n1,2,3\nsix,2,3\n", "line 3 .*is not a row of numbers"),
    ("a.csv", "x,y,z,w\n1,2,3\n", "line 1 names 4 columns and the rows have 3"),
    ("a.csv", "x,y,z,w,w\n1,2,3,4,5\n", "two columns are called 'w'"),
    ("a.csv", "1,2\n3,4\n", "has 2 columns"),
    ("a.csv", "x,y,z\n1,2,3\n1,nan,3\n", "point 1 is not finite"),
    ("a.csv", b"\xff\xfe\x00\x01\x02", "byte 0 is not text"),
    ("a.xyz", "1 2 3\n4 5 x\n", "line 2 .*is not a row of numbers"),
    ("a.obj", "v 1 2 3\nv 1 2\n", r"line 2 \('v 1 2'\) is not a vertex"),
    ("a.ply", "solid torus\n", "does not start with 'ply'"),
    ("a.ply", PLY[:60], "header has no end"),
    ("a.ply", PLY.replace("float y", "quaternion y"), "'property quaternion y' is not understood"),
    ("a.ply", PLY.replace("float y", "float x"), "'property float x' is not understood"),
    ("a.ply", PLY.replace("format ascii 1.0\n", ""), "names no format"),
    ("a.ply", PLY.replace("vertex", "corner"), "no vertex element"),
    ("a.ply", PLY.replace("float z", "float w") + "1 2 3\n4 5 6\n", "has no x, y and z"),
    ("a.ply", PLY.replace("element vertex", "element face 0\nelement vertex"), "'face' stands before"),
    ("a.ply", PLY.replace("float z", "list uchar int z"), "'z' is a list"),
    ("a.ply", PLY + "1 2 3\n", "ends in vertex 1 of the 2"),
    ("a.ply", PLY + "1 2 3\n4 5\n", r"vertex 1 \('4 5'\) is not 3 numbers"),
    ("a.ply", PLY + "1 2 3\n4 5 inf\n", "point 1 is not finite"),
    ("a.ply", PLY.replace("float z", "uchar z") + "1 2 3\n4 5 nan\n", "number that its type cannot hold"),
    ("a.ply", PLY.replace("ascii", "binary_little_endian") + "1234567890123", "ends in vertex 1 of the 2"),
    ("a.vtp", "<VTKFile type='PolyData'", "does not end as a VTK file"),
    ("a.vtp", "<VTKFile type='PolyData'><PolyData></VTKFile>", "VTK cannot read it"),
    ("a.npy", "not an array", "is not a NumPy array"),
    ("a.npz", "not an archive", "is not a NumPy archive"),
    ("a.npz", b"PK\x03\x04 and so on", "is not a NumPy archive"),
]


@pytest.mark.parametrize(("name", "text", "message"), DAMAGED)
def test_damaged_files_are_named_with_the_place(name, text, message, tmp_path, capfd):
    path = write(tmp_path / name, text)
    with pytest.raises(gk.FileFormatError, match=message) as caught:
        gk.points.load(path)
    assert str(path) in str(caught.value)
    assert "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize("kind", ["ply", "npz", "vtp"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_truncated_files(kind, share, tmp_path):
    path = tmp_path / f"a.{kind}"
    gk.points.save(path, POINTS, data=DATA)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(gk.FileFormatError, match=f"a.{kind}"):
        gk.points.load(path)


def test_arrays_that_are_no_points(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(3.0))
    with pytest.raises(gk.FileFormatError, match=r"float64 of shape \(3,\)"):
        gk.points.load(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", a=POINTS, b=POINTS)
    with pytest.raises(gk.FileFormatError, match=r"no array 'points'.*a, b"):
        gk.points.load(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", points=np.array([["1", "2", "3"]]))
    with pytest.raises(gk.FileFormatError, match="'points' has dtype"):
        gk.points.load(tmp_path / "b.npz")
    np.save(tmp_path / "c.npy", np.array([[None, 1, 2]], dtype=object), allow_pickle=True)
    with pytest.raises(gk.FileFormatError, match="not a NumPy array"):
        gk.points.load(tmp_path / "c.npy")


def test_paths_that_cannot_be_used(tmp_path):
    with pytest.raises(gk.InputError, match=r"'\.stl' is not a point format; use geokit\.mesh\.load, which reads it"):
        gk.points.load("a.stl")
    with pytest.raises(gk.InputError, match=r"'\.npy' is not a point format"):
        gk.points.save(tmp_path / "a.npy", POINTS)
    with pytest.raises(gk.FileAccessError, match="no such file"):
        gk.points.load(tmp_path / "a.csv")
    with pytest.raises(gk.FileAccessError, match="does not exist"):
        gk.points.save(tmp_path / "nowhere" / "a.csv", POINTS)


@pytest.mark.parametrize(
    ("kind", "data", "message"),
    [
        ("csv", {"a,b": np.zeros(40)}, "'a,b'"),
        ("csv", {"x": np.zeros(40)}, "'x' is taken"),
        ("csv", {"v": np.zeros((40, 3)), "v_x": np.zeros(40)}, "'v_x' is taken"),
        ("csv", {"1e5": np.zeros(40)}, "'1e5' is taken or cannot be a column's name in .csv"),
        ("csv", {"two\nlines": np.zeros(40)}, r"'two\\nlines' is taken .* rename 'two\\nlines'"),
        ("csv", {"NaN": np.zeros(40)}, "'NaN' is taken or cannot be a column's name in .csv"),
        ("ply", {"two words": np.zeros(40)}, "'two words'"),
        ("xyz", {"": np.zeros(40)}, "''"),
        ("ply", {"id": np.full(40, 1 << 40)}, "'id' has integers beyond 32 bits"),
        ("npz", {"points": np.zeros(40)}, "'points' is taken"),
        ("csv", {"a": np.zeros(39)}, "'a' has shape"),
    ],
)
def test_data_that_a_format_cannot_hold(kind, data, message, tmp_path):
    path = write(tmp_path / f"a.{kind}", "the old file")
    with pytest.raises(gk.InputError, match=message):
        gk.points.save(path, POINTS, data=data)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"the old file"


@pytest.mark.parametrize("kind", WRITABLE)
def test_a_save_replaces_the_file_and_leaves_nothing_else(kind, tmp_path):
    path = write(tmp_path / f"a.{kind}", "the old file")
    path.chmod(0o640)
    gk.points.save(path, POINTS)
    np.testing.assert_array_equal(gk.points.load(path).points, POINTS)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


RAY = np.array([[0.0, 0, 0, 0, 0, 1], [1, 2, 3, 0.5, 0, -4]])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "ox,oy,oz,dx,dy,dz\n0,0,0,0,0,1\n1,2,3,0.5,0,-4\n"),
        ("a.csv", "id,DX,DY,DZ,OX,OY,OZ\n5,0,0,1,0,0,0\n6,0.5,0,-4,1,2,3\n"),
        ("a.csv", "0,0,0,0,0,1,9\n1,2,3,0.5,0,-4,9\n"),
        ("a.txt", "# two rays\n0 0 0 0 0 1\n1 2 3 0.5 0 -4\n"),
    ],
)
def test_rays_from_text(name, text, tmp_path):
    rays = gk.points.load_rays(write(tmp_path / name, text))
    assert isinstance(rays, Rays)
    np.testing.assert_array_equal(np.concatenate(rays, axis=1), RAY)
    assert rays.origins.dtype == rays.directions.dtype == np.float64


def test_rays_from_numpy(tmp_path):
    np.savez(tmp_path / "a.npz", origins=RAY[:, :3], directions=RAY[:, 3:])
    np.savez(tmp_path / "b.npz", rays=RAY.astype(np.float32))
    np.save(tmp_path / "c.npy", RAY)
    for name in ("a.npz", "b.npz", "c.npy"):
        np.testing.assert_array_equal(np.concatenate(gk.points.load_rays(tmp_path / name), axis=1), RAY)


def test_no_rays(tmp_path):
    rays = gk.points.load_rays(write(tmp_path / "a.csv", "ox,oy,oz,dx,dy,dz\n"))
    assert rays.origins.shape == rays.directions.shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3,4,5\n", "has 5 columns; rays need ox, oy"),
        ("0,0,0,0,0,1\n0,0,0,0,0,0\n", "ray 1 has no usable direction"),
        ("0,0,0,0,0,1\n0,0,inf,0,0,1\n", "ray 1 has no usable direction or origin"),
        ("0,0,0,0,0,1\n0,0,0,0,0\n", "line 2 has 5 values"),
    ],
)
def test_damaged_rays(text, message, tmp_path):
    with pytest.raises(gk.FileFormatError, match=message):
        gk.points.load_rays(write(tmp_path / "a.csv", text))


def test_archives_that_are_no_rays(tmp_path):
    np.savez(tmp_path / "a.npz", origins=RAY[:, :3], directions=RAY[:1, 3:])
    np.savez(tmp_path / "b.npz", origins=RAY[:, :3])
    np.savez(tmp_path / "c.npz", origins=RAY[:, :3].astype(str), directions=RAY[:, 3:])
    for name, message in [("a", "of one shape"), ("b", "no arrays 'origins'"), ("c", "not numbers")]:
        with pytest.raises(gk.FileFormatError, match=message):
            gk.points.load_rays(tmp_path / f"{name}.npz")
    with pytest.raises(gk.InputError, match="not a ray format"):
        gk.points.load_rays("a.ply")
    with pytest.raises(gk.FileAccessError, match="no such file"):
        gk.points.load_rays(tmp_path / "d.csv")


def test_public_names():
    results = {"ChamferDistance", "Cover", "DirectedDistance", "Downsampled", "HausdorffDistance", "KNearest"}
    results |= {"NeighborBlock", "NeighborList", "Neighbors", "Pairs", "PointCloud", "PointNormals", "Registration"}
    results |= {"Candidates", "PointTile", "ProcessedFile"}
    functions = {"chamfer", "cluster", "cover", "density", "downsample", "hausdorff", "normals", "outliers", "register"}
    functions |= {"load_tiles", "process_file", "sample", "to_open3d", "to_pyvista", "to_trimesh"}
    assert set(dir(gk.points)) == {"NeighborGrid", "load", "load_rays", "save"} | functions | results
    for name in gk.points.__all__:
        assert getattr(gk.points, name).__name__ == name
    with pytest.raises(AttributeError, match="knn_of_old"):
        _ = gk.points.knn_of_old


def test_axes_as_rows_are_no_points(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 1000)))
    with pytest.raises(gk.FileFormatError, match=r"three rows of 1000 numbers, and a row is a point; save array.T"):
        gk.points.load(tmp_path / "a.npy")
