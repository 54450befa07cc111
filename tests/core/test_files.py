"""Files appear whole or not at all; frames, memory and exceptions keep their promises."""

from __future__ import annotations

import os
import stat

import numpy as np
import pytest

from geokit import FileAccessError, GeokitError, InputError, errors
from geokit.core import available_memory
from geokit.core.files import atomic_path, extension, require_extension, require_file
from geokit.core.frame import Frame


def test_a_file_is_replaced_whole(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with atomic_path(target) as part:
        assert part.suffix == ".txt"
        assert part.parent == tmp_path
        part.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["out.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")

    def give_up(part):
        part.write_text("half")
        raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"), atomic_path(target) as part:
        give_up(part)
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out.txt"]


def test_permissions_are_the_usual_ones(tmp_path):
    mask = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "new.txt") as part:
            part.write_text("x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "new.txt").stat().st_mode) == 0o640
    os.chmod(tmp_path / "new.txt", 0o600)
    with atomic_path(tmp_path / "new.txt") as part:
        part.write_text("y")
    assert stat.S_IMODE((tmp_path / "new.txt").stat().st_mode) == 0o600


def test_a_target_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(FileAccessError, match="does not exist"), atomic_path(tmp_path / "none" / "out.txt"):
        pass
    with pytest.raises(FileAccessError, match="is a directory"), atomic_path(tmp_path):
        pass


def test_a_writer_s_own_failure_names_the_target(tmp_path):
    def full_disk():
        raise OSError(28, "No space left on device")

    with (
        pytest.raises(FileAccessError, match=r"out\.txt: writing failed \(No space left"),
        atomic_path(tmp_path / "out.txt"),
    ):
        full_disk()
    assert list(tmp_path.iterdir()) == []


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileAccessError, match=r"none\.obj: no such file"):
        require_file(tmp_path / "none.obj")
    with pytest.raises(OSError, match="is a directory"):
        require_file(tmp_path)


def test_extensions():
    assert extension("A/B.VDB") == ".vdb"
    assert require_extension("x.PLY", (".ply", ".obj"), "mesh") == ".ply"
    with pytest.raises(InputError, match=r"x\.doc: '\.doc' is not a mesh format; use one of \.obj, \.ply"):
        require_extension("x.doc", (".ply", ".obj"), "mesh")
    with pytest.raises(InputError, match="no extension"):
        require_extension("x", (".ply",), "mesh")


def test_every_exception_is_a_geokit_error_and_what_callers_expect():
    expected = {
        "InputError": ValueError,
        "FileAccessError": OSError,
        "FileFormatError": GeokitError,
        "UnsupportedGridError": GeokitError,
        "MissingDependencyError": ImportError,
        "DeviceMemoryError": MemoryError,
    }
    assert set(expected) == set(errors.__all__) - {"GeokitError"}
    for name, base in expected.items():
        kind = getattr(errors, name)
        assert issubclass(kind, GeokitError)
        assert issubclass(kind, base)
        assert str(kind("file: row 3")) == "file: row 3"


def test_a_frame_maps_its_box_to_the_unit_cube():
    frame = Frame.around(np.array([1e6, 2.0, 3.0]), np.array([1e6 + 4.0, 3.0, 3.0]))
    np.testing.assert_array_equal(frame.origin, [1e6 + 2.0, 2.5, 3.0])
    assert frame.scale == 2.0


def test_a_frame_of_a_point_or_of_huge_numbers_is_finite():
    assert Frame.around(np.zeros(3), np.zeros(3)).scale == 1.0
    huge = Frame.around(np.full(3, -1.7e308), np.full(3, 1.7e308))
    np.testing.assert_array_equal(huge.origin, 0.0)
    assert huge.scale == 1.7e308


def test_there_is_some_memory():
    assert (1 << 20) < available_memory.available_host() < (1 << 50)
