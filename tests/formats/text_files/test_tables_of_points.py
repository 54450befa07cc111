"""Tables of points as people and programs write them: headers, words that are no numbers, names of columns."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk

POINTS = [[1.5, 2.5, 3.5], [4, 5, 6], [7, 8, 9.25]]
ROWS = [",".join(map(repr, row)) for row in POINTS]


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def table(header: str, rows: list[str]) -> str:
    return "".join(line + "\n" for line in ([header] if header else []) + rows)


def behind(cells: list[str]) -> list[str]:
    return [f"{row},{cell}" for row, cell in zip(ROWS, cells, strict=True)]


@pytest.mark.parametrize(
    "word",
    [
        "nan",
        "NaN",
        "-nan",
        "-nan(ind)",
        "nan(snan)",
        "N/A",
        "NA",
        "#N/A",
        "#DIV/0!",
        "null",
        "1.#QNAN",
        "-1.#IND00",
        "",
    ],
)
@pytest.mark.parametrize("row", [0, 2])
@pytest.mark.parametrize("header", ["", "x,y,z,w"])
def test_a_word_for_nothing_is_nan_and_costs_no_row(tmp_path: Path, word: str, row: int, header: str) -> None:
    cells = ["1", "2.5", "3"]
    cells[row] = word
    cloud = gk.points.load(write(tmp_path / "a.csv", table(header, behind(cells))))
    assert cloud.points.tolist() == POINTS
    (values,) = cloud.data.values()
    assert np.isnan(values[row])
    assert np.isfinite(np.delete(values, row)).all()


@pytest.mark.parametrize(("word", "value"), [("1.#INF", np.inf), ("-1.#INF00", -np.inf), ("1.5D+02", 150), ("2d0", 2)])
@pytest.mark.parametrize("separator", [",", " ", ";", "\t"])
def test_numbers_of_other_programs(tmp_path: Path, word: str, value: float, separator: str) -> None:
    text = table("", [row.replace(",", separator) for row in behind([word] * 3)])
    cloud = gk.points.load(write(tmp_path / "a.txt", text))
    assert cloud.points.tolist() == POINTS
    assert cloud.data["column_3"].tolist() == [value] * 3


@pytest.mark.parametrize("separator", [",", " ", "\t"])
def test_a_column_of_nothing_but_such_words_stays(tmp_path: Path, separator: str) -> None:
    text = table("", [row.replace(",", separator) for row in behind(["#N/A"] * 3)])
    cloud = gk.points.load(write(tmp_path / "a.txt", text))
    assert cloud.points.tolist() == POINTS
    np.testing.assert_array_equal(cloud.data["column_3"], [np.nan] * 3)


def test_coordinates_without_a_number_are_no_points(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "N/A,N/A,N/A\n1,2,3\n")
    with pytest.raises(gk.FileFormatError, match="point 0 is not finite"):
        gk.points.load(path)
    assert gk.points.load(path, finite_only=True).points.tolist() == [[1, 2, 3]]
    with pytest.raises(gk.FileFormatError, match=r"line 2 \('1,,3'\) is not a row of numbers"):
        gk.points.load(write(path, "x,y,z\n1,,3\n"))


def test_columns_of_labels_are_left_out_and_said(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", table("x,y,z,name,w", [f"{row},P {k},{k}" for k, row in enumerate(ROWS)]))
    with pytest.warns(UserWarning, match="columns of text are left out: 'name'"):
        cloud = gk.points.load(path)
    assert cloud.points.tolist() == POINTS
    assert {name: values.tolist() for name, values in cloud.data.items()} == {"w": [0, 1, 2]}
    with pytest.warns(UserWarning, match="'column_0'"):
        assert gk.points.load(write(path, "O 1 2 3\nH 4 5 6\n")).points.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (table("", behind(["P1", "0", "1"])), r"line 1 \('1.5,2.5,3.5,P1'\) is not a row of numbers"),
        (table("x,y,z,w", behind(["0", "P1", "1"])), "line 3 .* is not a row of numbers"),
        ("1 a 2 3\n4 b 5 6\n", r"line 1 \('1 a 2 3'\) is not a row of numbers"),
        ("x,y,z,450,550\n1,2,3,4,5\n", r"line 1 \('x,y,z,450,550'\) is not a row of numbers"),
        ("x;y;z\n1,5;2,5;3,5\n", "decimal commas"),
        ("1,5 2,5 3,5\n4,5 5,5 6,5\n", "decimal commas"),
        ("a,b,c\n", r"has a header \('a', 'b', 'c'\) and no rows"),
        ("time,temperature,pressure,x\n1,2,3,4\n", "'time', 'temperature', 'pressure', 'x'.*columns="),
        ("a.x,a.y,a.z,b\n1,2,3,4\n", "its columns are not named as those of points, x, y, z: "),
        ("start_pos_x,start_pos_y,start_pos_z,end_pos_x,end_pos_y,end_pos_z\n1,2,3,4,5,6\n", "are not named"),
        ("easting,northing,elevation,height\n1,2,3,4\n", "are not named"),
        ("X [m],X [ft],y,z\n1,2,3,4\n", "are not named"),
        ("X [mm],Y [m],Z [mm]\n1,2,3\n", r"its columns X \[mm\], Y \[m\], Z \[mm\] are in different units"),
        ("Easting (m),Northing (m),Height (ft)\n1,2,3\n", "are in different units; convert them to one"),
        ("lon,lat,height\n1,2,3\n", "longitudes and latitudes, which are angles"),
        ("Latitude (deg),Longitude (deg),Elevation\n1,2,3\n", "which are angles"),
    ],
)
def test_what_is_not_sure_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(gk.FileFormatError, match=message):
        gk.points.load(write(tmp_path / "a.csv", text))


@pytest.mark.parametrize(
    "names",
    [
        "X,Y,Z",
        "X [m],Y [m],Z [m]",
        "X(m),Y(m),Z(m)",
        "X [m],Y (meters),Z",
        "X (east),Y (north),Z (up)",
        "x_mm,y_mm,z_mm",
        "//X,Y,Z",
        "Points:0,Points:1,Points:2",
        "Points_0,Points_1,Points_2",
        "Points[0],Points[1],Points[2]",
        "pos_x,pos_y,pos_z",
        "position.x,position.y,position.z",
        "pose.pose.position.x,pose.pose.position.y,pose.pose.position.z",
        "px,py,pz",
        "x_coord,y_coord,z_coord",
        "X Coordinate,Y Coordinate,Z Coordinate",
        "easting,northing,height",
        "Easting (m),Northing (m),Elevation (m)",
        "E,N,H",
        "east,north,up",
        "x,y,altitude",
    ],
)
def test_columns_are_found_by_their_names(tmp_path: Path, names: str) -> None:
    # In another order, behind a column of something else.
    x, y, z = names.split(",")
    start = "//" if x.startswith("//") else ""
    header = f"{start}time,{z},{x.removeprefix('//')},{y}"
    rows = [f"{k},{c},{a},{b}" for k, (a, b, c) in enumerate(POINTS)]
    cloud = gk.points.load(write(tmp_path / "a.csv", table(header, rows)))
    assert cloud.points.tolist() == POINTS
    assert cloud.data["time"].tolist() == [0, 1, 2]
    assert len(cloud.data) == 1


@pytest.mark.parametrize("header", ["X [m] Y [m] Z [m]", "X(m)\tY(m)\tZ(m)", "# x y z", "% x y z", '"x" "y" "z"'])
def test_names_between_blanks(tmp_path: Path, header: str) -> None:
    text = table(header, [row.replace(",", "\t" if "\t" in header else " ") for row in ROWS])
    cloud = gk.points.load(write(tmp_path / "a.txt", text))
    assert cloud.points.tolist() == POINTS
    assert not cloud.data


def test_columns_are_chosen(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "x,y,z,u,v,w\n1,2,3,4,5,6\n")
    cloud = gk.points.load(path, columns=("w", "u", "v"))
    assert cloud.points.tolist() == [[6, 4, 5]]
    assert {name: values.tolist() for name, values in cloud.data.items()} == {"x_": [1], "y_": [2], "z_": [3]}
    write(path, "1,2,3,4\n")
    assert gk.points.load(path, columns=["column_1", "column_2", "column_3"]).points.tolist() == [[2, 3, 4]]


@pytest.mark.parametrize(
    ("name", "columns", "message"),
    [
        ("a.csv", ("x", "y", "q"), "columns: 'q' is not the name of one column .* 'x', 'y', 'z'"),
        ("a.csv", ("x", "y"), "three different names"),
        ("a.csv", ("x", "y", "y"), "three different names"),
        ("a.csv", "xyz", "not a list of three names"),
        ("a.csv", ("x", "y", 3), "columns"),
        ("a.ply", ("x", "y", "z"), "says itself which numbers are coordinates"),
    ],
)
def test_columns_that_are_none(tmp_path: Path, name: str, columns: object, message: str) -> None:
    path = write(tmp_path / name, "x,y,z\n1,2,3\n")
    with pytest.raises(gk.InputError, match=message):
        gk.points.load(path, columns=columns)  # type: ignore[arg-type]


def test_a_comment_is_no_header(tmp_path: Path) -> None:
    path = write(tmp_path / "a.txt", "# scanned by hand\n1 2 3\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gk.points.load(path).points.tolist() == [[1, 2, 3]]
    with pytest.warns(UserWarning, match="first 3 columns are taken as x, y, z"):
        assert gk.points.load(write(path, "# time a b c\n1 2 3 4\n")).points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    "text",
    [
        "".join(row + ",\n" for row in ROWS),
        "".join(row.replace(",", "\t\t") + "\n" for row in ROWS),
        "".join("\t" + row.replace(",", "\t") + "\n" for row in ROWS),
        "x,y,z,\n" + "".join(row + "\n" for row in ROWS),
        "3\n" + "".join(row + "\n" for row in ROWS),
        "sep=,\n" + "".join(row + "\n" for row in ROWS),
        '"sep=;"\r\nx;y;z\r\n' + "".join(row.replace(",", ";") + "\r\n" for row in ROWS),
        "".join('"' + row.replace(",", '","') + '"\n' for row in ROWS),
        "".join(row.replace(",", " , ") + "\n" for row in ROWS),
    ],
)
def test_separators(tmp_path: Path, text: str) -> None:
    cloud = gk.points.load(write(tmp_path / "a.csv", text))
    assert cloud.points.tolist() == POINTS
    assert not cloud.data


def test_an_empty_cell_between_tabulators_moves_no_column(tmp_path: Path) -> None:
    cloud = gk.points.load(write(tmp_path / "a.txt", "id\tx\ty\tz\n\t1\t2\t3\n7\t4\t5\t6\n"))
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    with pytest.raises(gk.FileFormatError, match=r"line 2 .* is not a row of numbers"):
        gk.points.load(write(tmp_path / "a.txt", "id\tx\ty\tz\n1\t\t2\t3\n4\t5\t6\t7\n"))


def test_a_large_table_with_one_odd_word_is_read_as_one_without(tmp_path: Path) -> None:
    values = np.random.default_rng(3).normal(size=(3000, 4))
    text = "\n".join(" ".join(map(repr, row)) for row in values.tolist())
    plain = gk.points.load(write(tmp_path / "a.xyz", text))
    first, _, rest = text.partition("\n")
    odd = gk.points.load(write(tmp_path / "b.xyz", f"{first.rsplit(' ', 1)[0]} -nan(ind)\n{rest}"))
    np.testing.assert_array_equal(odd.points, plain.points)
    np.testing.assert_array_equal(odd.points, values[:, :3])
    np.testing.assert_array_equal(odd.data["column_3"][1:], plain.data["column_3"][1:])


def test_odd_rows_are_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("geokit.formats.text_files.rows.BLOCK", 2)
    path = write(tmp_path / "a.csv", table("x,y,z,w", [*behind(["", "N/A", "3"]), *behind(["a", "5", "b"])]))
    with pytest.raises(gk.FileFormatError, match=r"line 5 \('1.5,2.5,3.5,a'\)"):
        gk.points.load(path)
    cloud = gk.points.load(write(path, path.read_text().replace("a", "4").replace("b", "6")))
    assert cloud.points.tolist() == POINTS * 2
    np.testing.assert_array_equal(cloud.data["w"], [np.nan, np.nan, 3, 4, 5, 6])
    with pytest.raises(gk.FileFormatError, match="line 8 has 3 values and the rows above have 4"):
        gk.points.load(write(path, path.read_text() + "1,2,3\n"))


def test_rays_keep_their_rows(tmp_path: Path) -> None:
    rays = gk.points.load_rays(write(tmp_path / "a.csv", "\ufeffox,oy,oz,dx,dy,dz\r0,0,0,0,0,1D0\r1,2,3,0,0,1\r"))
    assert rays.origins.tolist() == [[0, 0, 0], [1, 2, 3]]
    with pytest.raises(gk.FileFormatError, match=r"line 1 .* is not a row of numbers"):
        gk.points.load_rays(write(tmp_path / "a.csv", "0,0,0,0,0,A\n1,2,3,0,0,1\n"))


RAY_NAMES = [
    "ox,oy,oz,dx,dy,dz",
    "x,y,z,dx,dy,dz",
    "X [m],Y [m],Z [m],dir_x,dir_y,dir_z",
    "origin.x,origin.y,origin.z,direction.x,direction.y,direction.z",
    "start:0,start:1,start:2,ray direction:0,ray direction:1,ray direction:2",
    "px,py,pz,Dir_X,Dir_Y,Dir_Z",
]


@pytest.mark.parametrize("names", RAY_NAMES)
@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5, 6, 7], [7, 3, 4, 5, 0, 6, 1, 2], [5, 7, 4, 3, 6, 2, 1, 0]])
def test_rays_are_found_by_their_names(tmp_path: Path, names: str, order: list[int]) -> None:
    """Also behind a time, and beside words."""
    header, row = [*names.split(","), "time", "label"], ["1", "2", "3", "0.5", "0.25", "-1", "7", "a"]
    lines = "\n".join(",".join(line[at] for at in order) for line in (header, row)) + "\n"
    origins, directions = gk.points.load_rays(write(tmp_path / "a.csv", lines))
    assert origins.tolist() == [[1, 2, 3]]
    assert directions.tolist() == [[0.5, 0.25, -1]]


@pytest.mark.parametrize(
    "names", ["t,px,py,pz,vx,vy,vz", "x,y,z,nx,ny,nz,w", "ax,ay,az,bx,by,bz,c", "ox,oy,oz,a,b,c,d"]
)
def test_other_names_are_no_rays(tmp_path: Path, names: str) -> None:
    path = write(tmp_path / "a.csv", f"{names}\n0,1,2,3,4,5,6\n")
    listed = ", ".join(map(repr, names.split(",")))
    with pytest.raises(gk.FileFormatError, match=f"are not named as those of rays.*{listed}; choose 6"):
        gk.points.load_rays(path)
    origins, directions = gk.points.load_rays(path, columns=names.split(",")[:0:-1])
    assert origins.tolist() == [[6, 5, 4]]
    assert directions.tolist() == [[3, 2, 1]]


def test_columns_of_rays_are_six_names(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "a,b,c,d,e,f,g\n0,1,2,3,4,5,6\n")
    for columns in ("abcdef", ("a", "b", "c"), ("a", "b", "c", "d", "e", "e"), 6):
        with pytest.raises(gk.InputError, match=r"^columns: .*six"):
            gk.points.load_rays(path, columns=columns)
    with pytest.raises(gk.InputError, match="columns: 'h' is not the name of one column of"):
        gk.points.load_rays(path, columns=("a", "b", "c", "d", "e", "h"))
    with pytest.raises(gk.InputError, match=r"columns: \.npy says itself"):
        gk.points.load_rays(tmp_path / "a.npy", columns=tuple("abcdef"))
    with pytest.warns(UserWarning, match="the words of its comment"):
        rays = gk.points.load_rays(write(tmp_path / "a.txt", "# a b c d e f g\n0 1 2 3 4 5 6\n"))
    assert rays.directions.tolist() == [[3, 4, 5]]


@pytest.mark.parametrize("names", ["red,green,blue", "Red,Green,Blue", "R,G,B", "r,g,b"])
@pytest.mark.parametrize("kind", ["csv", "xyz", "txt"])
def test_colors_have_the_type_that_says_what_is_full(tmp_path: Path, names: str, kind: str) -> None:
    cells = {
        np.uint8: ["200,30,30", "0,0,255", "1,2,3"],
        np.uint16: ["51400,30,30", "0,0,65535", "1,2,3"],
        np.float64: ["0.25,1,0", "0,0,1", "0,1,1"],
    }
    for dtype, colors in cells.items():
        text = table(f"x,y,z,{names}", behind(colors))
        cloud = gk.points.load(write(tmp_path / f"a.{kind}", text.replace(",", " ") if kind == "xyz" else text))
        assert list(cloud.data) == ["rgb"]
        assert cloud.data["rgb"].dtype == dtype
        np.testing.assert_array_equal(cloud.data["rgb"], [list(map(float, row.split(","))) for row in colors])
    gk.points.save(tmp_path / f"b.{'xyz' if kind == 'txt' else kind}", POINTS, data={"rgb": np.eye(3, dtype="u1") * 9})
    assert gk.points.load(tmp_path / f"b.{'xyz' if kind == 'txt' else kind}").data["rgb"].dtype == np.uint8


def test_two_ways_to_write_colors_stay_apart(tmp_path: Path) -> None:
    text = table("x,y,z,red,green,blue,R,G,B", behind(["9,8,7,1,2,3"] * 3))
    data = gk.points.load(write(tmp_path / "a.csv", text)).data
    assert data["rgb"].tolist() == [[9, 8, 7]] * 3
    assert [data[name].tolist() for name in "RGB"] == [[1] * 3, [2] * 3, [3] * 3]
