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
