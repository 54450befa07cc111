"""Files appear whole or not at all; frames, memory and exceptions keep their promises."""

from __future__ import annotations

import os
import shutil
import socket
import stat

import numpy as np
import pytest

from geokit import FileAccessError, GeokitError, InputError, errors
from geokit.core.files import atomic_path, extension, require_extension, require_file
from geokit.core.frame import Frame
from geokit.core.memory import available_memory
from geokit.core.require import require_path


def test_a_file_is_replaced_whole(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with atomic_path(target) as part:
        assert part.suffix == ".txt"
        assert part.parent.parent == tmp_path
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
        "WorkerError": RuntimeError,
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
    assert np.isfinite(huge.scale)
    np.testing.assert_array_equal((1.7e308 - huge.origin) / huge.scale, 1.0)


def test_there_is_some_memory():
    assert (1 << 20) < available_memory.available_host() < (1 << 50)


def test_a_symbolic_link_is_followed(tmp_path):
    (tmp_path / "there").mkdir()
    real = tmp_path / "there" / "real.bin"
    real.write_text("old")
    link, chain = tmp_path / "link.txt", tmp_path / "chain.txt"
    link.symlink_to("there/real.bin")
    chain.symlink_to("link.txt")
    with atomic_path(chain) as part:
        assert part.suffix == ".txt"
        assert part.parent.parent == real.parent  # beside the file, so that the rename stays on its file system
        part.write_text("new")
    assert chain.is_symlink()
    assert link.is_symlink()
    assert not real.is_symlink()
    assert real.read_text() == "new"
    assert [path.name for path in real.parent.iterdir()] == ["real.bin"]


def test_a_link_to_nothing_makes_the_file_that_it_names(tmp_path):
    link = tmp_path / "link.txt"
    link.symlink_to("later.txt")
    with atomic_path(link) as part:
        part.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "later.txt").read_text() == "new"
    (tmp_path / "loop").symlink_to("loop")
    with (
        pytest.raises(FileAccessError, match=r"loop: cannot write there \(Too many levels"),
        atomic_path(tmp_path / "loop"),
    ):
        pass


@pytest.mark.parametrize("size", [0, 3, 5000])
def test_hard_links_all_get_the_new_content(tmp_path, size):
    target, other = tmp_path / "a.bin", tmp_path / "b.bin"
    target.write_bytes(b"old content")
    target.chmod(0o640)
    os.link(target, other)
    with atomic_path(target) as part:
        part.write_bytes(b"n" * size)
        assert other.read_bytes() == b"old content"
    assert os.path.samefile(target, other)
    assert other.read_bytes() == b"n" * size
    assert stat.S_IMODE(other.stat().st_mode) == 0o640
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bin", "b.bin"]


def test_hard_links_keep_the_old_content_without_room(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    target, other = tmp_path / "a.bin", tmp_path / "b.bin"
    target.write_text("old")
    os.link(target, other)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(FileAccessError, match="No space left"), atomic_path(target) as part:
        part.write_text("much longer")
    assert other.read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bin", "b.bin"]


def test_hard_links_get_the_whole_new_content_despite_an_interrupt(tmp_path, monkeypatch):
    target, other = tmp_path / "a.bin", tmp_path / "b.bin"
    target.write_bytes(b"old")
    os.link(target, other)
    copy = shutil.copyfileobj

    def interrupted(source, file, size):
        file.write(source.read(100))
        monkeypatch.setattr(shutil, "copyfileobj", copy)
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "copyfileobj", interrupted)
    with pytest.raises(KeyboardInterrupt), atomic_path(target) as part:
        part.write_bytes(b"n" * 5000)
    assert other.read_bytes() == b"n" * 5000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bin", "b.bin"]


def test_fifos_and_devices_are_refused_by_name(tmp_path):
    fifo = tmp_path / "fifo.ply"
    os.mkfifo(fifo)
    (tmp_path / "null.ply").symlink_to("/dev/null")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
    for name, kind in (("fifo.ply", "FIFO"), ("null.ply", "character device"), ("s", "socket")):
        with (
            pytest.raises(FileAccessError, match=f"{name}: is a {kind}; name a regular file"),
            atomic_path(tmp_path / name),
        ):
            pass
        with pytest.raises(FileAccessError, match=f"{name}: is a {kind}; name a regular file"):
            require_file(tmp_path / name)
    assert stat.S_ISFIFO(fifo.stat().st_mode)


def test_a_file_without_a_name_is_refused(tmp_path):
    with open(tmp_path / "gone", "w") as file:
        os.unlink(tmp_path / "gone")
        with pytest.raises(FileAccessError, match="has no name"), atomic_path(f"/proc/self/fd/{file.fileno()}"):
            pass


def test_a_folder_that_vanishes_meanwhile_is_named(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()

    def vanish(part):
        shutil.rmtree(folder)
        part.write_text("x")

    named = pytest.raises(FileAccessError, match=r"out\.txt: writing failed \(No such file")
    with named, atomic_path(folder / "out.txt") as part:
        vanish(part)
    assert not folder.exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    def read_only(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "mkdir", read_only)
    named = pytest.raises(FileAccessError, match=r"out\.txt: cannot write there \(Read-only file system\)")
    with named, atomic_path(tmp_path / "out.txt"):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(FileAccessError, match="Permission denied"), atomic_path(tmp_path / "out.txt"):
            pass
    finally:
        tmp_path.chmod(0o755)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give files away")
def test_the_owner_is_kept(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")
    os.chown(target, 1234, 2345)
    with atomic_path(target) as part:
        part.write_text("new")
    assert (target.stat().st_uid, target.stat().st_gid) == (1234, 2345)


@pytest.mark.parametrize("length", [245, 246, 254, 255])
def test_the_longest_names_are_written(tmp_path, length):
    for name in ("n" * (length - 4) + ".ply", "n." + "e" * (length - 2), "ü" * ((length - 4) // 2) + ".ply"):
        with atomic_path(tmp_path / name) as part:
            part.write_text("x")
        assert (tmp_path / name).read_text() == "x"
    with pytest.raises(FileAccessError, match="File name too long"), atomic_path(tmp_path / ("n" * 256)):
        pass


def test_names_in_bytes_and_in_no_encoding(tmp_path):
    name = os.path.join(os.fsencode(tmp_path), b"caf\xe9.ply")
    with atomic_path(name) as part:
        part.write_text("x")
    assert require_file(name) == require_file(os.fsdecode(name)) == tmp_path / "caf\udce9.ply"
    assert os.listdir(os.fsencode(tmp_path)) == [b"caf\xe9.ply"]
    assert extension(name) == ".ply"


@pytest.mark.parametrize("path", [None, 3, 1.5, ["x.ply"]])
def test_what_is_no_path_is_named(path):
    for function in (require_path, require_file, extension, lambda path: atomic_path(path).__enter__()):
        with pytest.raises(InputError, match=r"path: .* is not a path"):
            function(path)


def test_a_zero_byte_is_named(tmp_path):
    with pytest.raises(InputError, match="zero byte"), atomic_path(tmp_path / "a\0.ply"):
        pass
    with pytest.raises(InputError, match="zero byte"):
        require_file(tmp_path / "a\0.ply")


def test_a_missing_working_folder_is_named(tmp_path, monkeypatch):
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with pytest.raises(FileAccessError, match=r"out\.txt"), atomic_path("out.txt"):
        pass


def test_the_umask_of_the_process_never_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "umask", lambda _: pytest.fail("other threads would create files with this mask"))
    with atomic_path(tmp_path / "out.txt") as part:
        part.write_text("x")
