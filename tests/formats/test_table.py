"""The table of formats: a line and a module make a format; docs/formats.md and the docstrings say what it says."""

from __future__ import annotations

import importlib
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import formats
from geokit.cli import query
from geokit.cli._kinds import kind_of_input, kind_of_output
from geokit.cli._results import OUTPUT_EXTENSIONS
from geokit.formats import pcd
from geokit.formats.reader import process as reader_process
from geokit.formats.table import FORMATS, Format, extensions, image_module, module_of
from geokit.formats.text_files import decimal
from geokit.native.parsers import extension

ROOT = Path(__file__).resolve().parents[2]

TOY = '''
"""A line of counts, then vertices and faces."""
import numpy as np
from geokit.errors import FileFormatError
from geokit.formats.file_content.body import Body


def _read(path):
    head, *rows = path.read_text().splitlines()
    try:
        count = int(head)
        return np.array([row.split() for row in rows[:count]], float), [row.split() for row in rows[count:]]
    except ValueError:
        raise FileFormatError(f"{path}: is no toy") from None


def read_mesh(path):
    points, faces = _read(path)
    return [Body(points, np.full(len(faces), 3), np.array(faces, int).ravel())]


def write_mesh(path, mesh):
    rows = [*mesh.vertices.tolist(), *mesh.faces.tolist()]
    path.write_text(f"{len(mesh.vertices)}\\n" + "".join(" ".join(map(repr, row)) + "\\n" for row in rows))


def read_points(path):
    return _read(path)[0], {}


def write_points(path, points, data):
    path.write_text(f"{len(points)}\\n" + "".join(" ".join(map(repr, row)) + "\\n" for row in points.tolist()))


def lacks_faces(head):
    return len(head.splitlines()) == 1 + int(head.splitlines()[0])
'''


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """The format .toy: a module in a folder of the package, and a line in the table."""
    # Their docstrings list the formats when they are imported: now, without this one.
    importlib.import_module("geokit.mesh._io")
    importlib.import_module("geokit.points._io")
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "toy.py").write_text(TOY)
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(folder)])
    monkeypatch.setitem(FORMATS, ".toy", Format("toy", mesh="rw", points="rw"))
    yield tmp_path
    sys.modules.pop("geokit.formats.toy", None)


def test_a_format_is_one_module_and_one_line(toy):
    mesh = mesh_catalog.l_profile()
    gk.mesh.save(toy / "a.toy", mesh)
    again = gk.mesh.load(toy / "a.toy")
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    gk.points.save(toy / "cloud.toy", mesh.vertices)
    np.testing.assert_array_equal(gk.points.load(toy / "cloud.toy").points, mesh.vertices)
    (toy / "bad.toy").write_text("nothing\n")
    with pytest.raises(gk.FileFormatError, match="is no toy"):
        gk.mesh.load(toy / "bad.toy")
    with pytest.raises(gk.InputError, match=r"\.toy holds no data arrays"):
        gk.mesh.save(toy / "b.toy", mesh, point_data={"a": mesh.vertices})
    with pytest.raises(gk.InputError, match=r"use one of .*\.toy"):
        gk.mesh.load(toy / "a.unknown")


def test_the_command_line_converts_a_new_format(toy, capsys):
    from geokit.cli import main

    mesh = mesh_catalog.l_profile()
    gk.mesh.save(toy / "a.ply", mesh)
    gk.points.save(toy / "cloud.toy", mesh.vertices)
    assert kind_of_output(toy / "a.toy") == "mesh"
    assert main(["convert", str(toy / "a.ply"), str(toy / "a.toy")]) == 0, capsys.readouterr().err
    assert kind_of_input(toy / "a.toy") == "mesh"
    assert kind_of_input(toy / "cloud.toy") == "cloud"
    np.testing.assert_array_equal(gk.mesh.load(toy / "a.toy").faces, mesh.faces)


@pytest.mark.parametrize("kind", [kind for kind, found in FORMATS.items() if not found.volume])
def test_modules_have_what_their_lines_say(kind):
    found, module = FORMATS[kind], module_of(kind)
    for content in ("mesh", "points", "rays"):
        access = getattr(found, content)
        assert "r" not in access or callable(getattr(module, f"read_{content}"))
        assert "w" not in access or callable(getattr(module, f"write_{content}"))
    assert not found.extra or f"\n{found.extra} = [" in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize("kind", extensions("mesh", "r"))
def test_meshes_are_read_where_the_table_says(kind, tmp_path, monkeypatch):
    path = tmp_path / f"a{kind}"
    with zipfile.ZipFile(path, "w"):  # .3mf files are archives, whose sizes are checked first
        pass
    asked = []

    def refuse(path, module, *_):
        asked.append(module)
        raise gk.FileFormatError(f"{path}: refused")

    monkeypatch.setattr(reader_process, "read_mesh", refuse)
    with pytest.raises(gk.FileFormatError):
        gk.mesh.load(path)
    assert asked == ([f"geokit.formats.{FORMATS[kind].module}"] if FORMATS[kind].process else [])


def listed(kinds) -> str:
    return " ".join(kinds)


def missing(content) -> str:
    """What the page says of writing: all, or all but some."""
    return " ".join(kind for kind in extensions(content, "r") if kind not in extensions(content, "w"))


def test_the_page_lists_the_formats():
    meshes, points = extensions("mesh", "w"), extensions("points", "r")
    rows = [
        f"| meshes | `{listed(extensions('mesh', 'r'))}` | all but `{missing('mesh')}` |",
        f"| ... with data on vertices or faces | | `{listed(k for k in meshes if FORMATS[k].data)}` |",
        f"| ... in float32 only | | `{listed(k for k in meshes if FORMATS[k].float32)}` |",
        f"| point clouds | `{listed(points)}` | all but `{missing('points')}` |",
        f"| rays | `{listed(extensions('rays', 'r'))}` | |",
        f"| volumes | `{listed(extensions('volume', 'r'))}` | all but `{missing('volume')}` |",
    ]
    text = (ROOT / "docs" / "formats.md").read_text()
    for row in rows:
        assert row in text, f"docs/formats.md must have the line: {row}"


def test_the_readme_counts_the_formats():
    assert f"**Files**: {len(FORMATS)} formats" in (ROOT / "README.md").read_text()


def test_the_command_line_page_lists_the_formats():
    text = " ".join((ROOT / "docs/cli.md").read_text().split())
    assert f"Points come from `{listed(extensions('points', 'r'))}`." in text
    assert f"of `{listed(k for k in extensions('rays', 'r') if k != '.npz')}`, or as the arrays" in text
    assert f"Answers go to `{listed(OUTPUT_EXTENSIONS)}`, or as CSV" in text


@pytest.mark.parametrize("command", [query.closest, query.signed, query.ray, query.sample, query.neighbors])
def test_help_texts_of_queries_list_the_formats(command):
    content = "rays" if command is query.ray else "points"
    assert f"({listed(extensions(content, 'r'))})" in command.__doc__
    assert f"output: {listed(OUTPUT_EXTENSIONS)}, or - for CSV" in command.__doc__
    assert "{" not in command.__doc__


@pytest.mark.parametrize("kind", OUTPUT_EXTENSIONS)
def test_outputs_of_queries_hold_arrays_of_any_name(kind, tmp_path):
    points, rows = np.arange(12.0).reshape(4, 3), {"triangle_id": np.arange(4), "closest": np.ones((4, 3))}
    gk.points.save(tmp_path / f"a{kind}", points, data=rows)
    cloud = gk.points.load(tmp_path / f"a{kind}")
    assert cloud.points.tolist() == points.tolist()
    for name in rows if kind in (".las", ".laz") else ():
        np.testing.assert_array_equal(cloud.data[name], rows[name])


@pytest.mark.parametrize("kind", [kind for kind, found in FORMATS.items() if found.image])
def test_modules_of_dense_volumes_have_what_their_lines_say(kind):
    found, module = FORMATS[kind], image_module(kind)
    assert callable(module.open_images)
    assert "w" not in found.volume or callable(module.write_image)
    assert not found.points or callable(module.is_volume)
    assert not found.extra or f"\n{found.extra} = [" in (ROOT / "pyproject.toml").read_text()


def test_docstrings_list_the_formats():
    assert f"path: {listed(extensions('volume', 'r'))}." in " ".join(gk.volume.load.__doc__.split())
    assert f"path: Target, {listed(extensions('volume', 'w'))};" in " ".join(gk.volume.save.__doc__.split())
    assert f"path: {listed(extensions('mesh', 'r'))}." in gk.mesh.load.__doc__
    assert f"path: {listed(extensions('mesh', 'w'))}." in gk.mesh.save.__doc__
    assert f"path: {listed(extensions('points', 'r'))}." in gk.points.load.__doc__
    assert f"path: {listed(extensions('points', 'w'))}." in gk.points.save.__doc__
    assert f"path: {listed(extensions('rays', 'r'))}." in gk.points.load_rays.__doc__


# --- without the extension of the parsers ----------------------------------------------------------------------------


@pytest.fixture
def without_parsers(monkeypatch):
    monkeypatch.setattr(extension, "parsers", lambda: None)


@pytest.mark.parametrize("size", [0, 1, 3, 32, 33, 264, 265, 8193, 20_000])
@pytest.mark.parametrize("kind", ["zeros", "noise", "text", "pairs"])
def test_lzf_in_python_is_that_in_cpp(kind, size, monkeypatch):
    random = np.random.default_rng(size)
    plain = {
        "zeros": np.zeros(size, np.uint8),
        "noise": random.integers(0, 256, size).astype(np.uint8),
        "text": random.integers(0, 3, size).astype(np.uint8),
        "pairs": np.resize(random.integers(0, 256, 700).astype(np.uint8), size),
    }[kind]
    packed = pcd.compress(plain)
    damaged = packed.copy()
    damaged[:: max(len(packed) // 5, 1)] ^= 0xE1
    expected = pcd.decompress(damaged, size)[1]
    monkeypatch.setattr(extension, "parsers", lambda: None)
    np.testing.assert_array_equal(pcd.compress(plain), packed)
    again, bad = pcd.decompress(packed, size)
    assert bad == -1
    np.testing.assert_array_equal(again, plain)
    assert pcd.decompress(damaged, size)[1] == expected


@pytest.mark.parametrize(
    ("packed", "size", "bad"),
    [(b"\x02ab", 3, 0), (b"\x00a\x20", 4, 2), (b"\x00a\xe0\x00", 10, 2), (b"\x00a\x20\x01", 4, 2), (b"", 1, 0)],
)
def test_damaged_lzf_in_python(packed, size, bad, without_parsers):
    assert pcd.decompress(np.frombuffer(packed, np.uint8), size)[1] == bad


def test_text_without_the_parsers_has_the_same_numbers(tmp_path, monkeypatch):
    points = np.random.default_rng(5).normal(size=(3000, 3)) * 1e5
    gk.points.save(tmp_path / "a.xyz", points)
    text = (tmp_path / "a.xyz").read_bytes()
    assert len(text) > decimal.SMALLEST
    if extension.parsers() is not None:
        assert decimal.plain_rows(text, text.index(b"\n"), len(text)) is not None
    monkeypatch.setattr(extension, "parsers", lambda: None)
    assert decimal.plain_rows(text, text.index(b"\n"), len(text)) is None
    np.testing.assert_array_equal(gk.points.load(tmp_path / "a.xyz").points, points)
