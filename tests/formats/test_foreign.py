"""Files of other programs are refused with the program that converts them, in Python and on the command line."""

from __future__ import annotations

import re

import pytest

import geokit as gk
from geokit.cli import main
from geokit.formats.foreign import FOREIGN
from geokit.formats.table import FORMATS, extensions


@pytest.mark.parametrize("kind", FOREIGN)
def test_every_row_has_a_remedy_that_geokit_reads(kind, tmp_path):
    assert kind not in FORMATS
    path = tmp_path / f"a{kind.upper()}"
    path.write_bytes(b"x")
    name, remedy = FOREIGN[kind]
    named = FORMATS.keys() & set(re.findall(r"\.[a-z0-9.]+", remedy))
    # Arrays are passed, archives are unpacked.
    assert named or any(word in remedy for word in ("unpack", "pass"))
    read = {*extensions("mesh", "r"), *extensions("points", "r"), *extensions("volume", "r")}
    assert read.issuperset(named)
    for load in (gk.mesh.load, gk.points.load, gk.volume.load):
        with pytest.raises(gk.InputError) as raised:
            load(path)
        assert str(raised.value) == f"{path}: '{kind}' is {name}, which geokit does not read; {remedy}"


def test_the_command_line_says_the_same(tmp_path, capsys):
    (tmp_path / "part.x_t").write_bytes(b"x")
    assert main(["info", str(tmp_path / "part.x_t")]) != 0
    assert "does not read; export it there as .step" in capsys.readouterr().err


def test_other_extensions_and_written_files_list_what_there_is(tmp_path):
    with pytest.raises(gk.InputError, match=r"'\.unknown' is not a mesh format; use one of"):
        gk.mesh.load(tmp_path / "a.unknown")
    box = gk.mesh.box()
    with pytest.raises(gk.InputError, match=r"'\.blend' is not a mesh format; use one of"):
        gk.mesh.save(tmp_path / "a.blend", box)


DOORS = {"mesh": gk.mesh, "volume": gk.volume, "points": gk.points}


@pytest.mark.parametrize("kind", FORMATS)
def test_a_wrong_door_names_the_right_ones(kind, tmp_path):
    path = tmp_path / f"a{kind}"
    path.write_bytes(b"x")
    for verb, access in (("load", "r"), ("save", "w")):
        right = {door for door in DOORS if kind in extensions(door, access)}
        for door in DOORS.keys() - right:
            things = () if verb == "load" else (gk.mesh.box() if door == "mesh" else [[0.0, 0.0, 0.0]],)
            with pytest.raises(gk.InputError) as raised:
                getattr(DOORS[door], verb)(path, *things)
            said = str(raised.value)
            assert set(re.findall(rf"geokit\.(\w+)\.{verb}", said)) == right, said
            assert right or "; use one of ." in said
            assert path.read_bytes() == b"x"


def test_a_folder_a_url_and_a_home(tmp_path, monkeypatch):
    for load in (gk.mesh.load, gk.points.load):
        with pytest.raises(gk.GeokitError, match=r"is a directory; name a file in it, .* geokit\.volume\.load"):
            load(tmp_path)
        with pytest.raises(gk.InputError, match=r"https://example\.com/a\.ply: is a URL; download it"):
            load("https://example.com/a.ply")
    with pytest.raises(gk.InputError, match="is a URL; download it"):
        gk.volume.load("s3://bucket/a.vdb")
    with pytest.raises(gk.GeokitError, match="is a directory; name a file in it"):
        gk.mesh.save(tmp_path, gk.mesh.box())
    grid = gk.volume.from_dense([[[1.0]]])
    monkeypatch.setenv("HOME", str(tmp_path))
    gk.mesh.save("~/a.ply", gk.mesh.box())
    gk.points.save("~/a.csv", [[0.0, 0.0, 0.0]])
    for name in ("a.nvdb", "a.npy"):
        gk.volume.save(f"~/{name}", grid)
        assert len(gk.volume.inspect(f"~/{name}")) == 1
    assert (len(gk.mesh.load("~/a.ply").faces), len(gk.points.load("~/a.csv"))) == (12, 1)
    assert {one.name for one in tmp_path.iterdir()} >= {"a.ply", "a.csv", "a.nvdb", "a.npy"}
