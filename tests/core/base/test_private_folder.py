"""Private folders are removed with their process, also if it is killed, and never while it lives."""

from __future__ import annotations

import errno
import fcntl
import grp
import itertools
import os
import signal
import stat
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from geokit.core.base import private_folder as module
from geokit.core.base.private_folder import (
    FOREIGN_SECONDS,
    LOCK,
    PREFIX,
    make_own,
    private_folder,
    remove_folder,
    require_trusted,
    temporary_parent,
)
from geokit.core.files import atomic_path
from geokit.errors import FileAccessError, InputError
from tests.support.forked import forked
from tests.support.interrupts import interrupted, interrupts

HOLDER = """
import sys, time
from geokit.core.base.private_folder import private_folder
with private_folder(sys.argv[1]) as folder:
    (folder / "part.bin").write_bytes(bytes(1000))
    print(folder, flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that holds a private folder in ``tmp_path``, and the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLDER, tmp_path], stdout=subprocess.PIPE, text=True)
    try:
        yield process, Path(process.stdout.readline().strip())
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture(autouse=True)
def _always_looking(monkeypatch):
    monkeypatch.setattr(module, "LOOKING_SHARE", 0)
    module._next_look.clear()


def test_a_folder_is_private_and_removed_with_its_content(tmp_path):
    with private_folder(tmp_path) as folder:
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        (folder / "sub").mkdir()
        (folder / "sub" / "file").write_text("x")
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_a_killed_process_is_removed_and_that_of_a_living_one_is_not(tmp_path, holder):
    process, held = holder
    with private_folder(tmp_path):
        assert (held / "part.bin").is_file()
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (held / "part.bin").is_file()
    with private_folder(tmp_path):
        assert not held.exists()


OWN = f"{PREFIX}00000000-0123456789abcdef"


def aged(folder):
    """Make a folder and all in it two days old."""
    old = time.time() - 2 * FOREIGN_SECONDS
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (old, old))


def folder_with(folder, *names):
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("machine", ["00000000", None])
@pytest.mark.parametrize(
    "name",
    [
        "notes",
        "batch",
        "batch-3-of-64",
        "{}-notes",
        "{}-0123456789abcde",
        "{}-0123456789abcdef0",
        "{}-0123456789ABCDEF",
    ],
)
def test_a_folder_that_only_begins_like_an_own_one_stays(tmp_path, name, machine):
    folder = folder_with(tmp_path / f"{PREFIX}{name.format(machine or module._machine())}", LOCK, "data")
    aged(folder)
    with private_folder(tmp_path):
        pass
    assert sorted(path.name for path in folder.iterdir()) == ["data", LOCK]


@pytest.mark.parametrize("machine", ["00000000", None])
def test_a_folder_without_the_lock_of_an_own_one_stays(tmp_path, machine):
    machine = machine or module._machine()
    kept = [folder_with(tmp_path / f"{PREFIX}{machine}-{i:016x}", "data") for i in range(4)]
    (kept[1] / LOCK).mkdir()
    (kept[2] / LOCK).write_text("the lock of something else")
    (tmp_path / "lock of another").touch()
    (kept[3] / LOCK).symlink_to(tmp_path / "lock of another")
    empty = folder_with(tmp_path / f"{PREFIX}{machine}-{9:016x}")
    for folder in (*kept, empty):
        aged(folder)
    with private_folder(tmp_path):
        pass
    assert all((folder / "data").exists() for folder in kept)
    assert not (kept[0] / LOCK).exists()
    assert not empty.exists()  # its process was killed before it had a lock


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a folder to another user")
def test_a_folder_of_another_user_stays(tmp_path):
    folder = folder_with(tmp_path / OWN, LOCK)
    os.chown(folder, 1001, 1001)
    aged(folder)
    with private_folder(tmp_path):
        pass
    assert folder.exists()


def test_the_lock_is_removed_last(tmp_path, monkeypatch):
    folder = folder_with(tmp_path / OWN, LOCK, "a", "z")
    folder_with(folder / "sub", "file")
    gone = []
    for name in ("unlink", "rmdir"):
        remove = getattr(os, name)
        monkeypatch.setattr(os, name, lambda path, remove=remove: (gone.append(os.path.basename(path)), remove(path)))
    remove_folder(folder)
    assert sorted(gone[:-2]) == ["a", "file", "sub", "z"]
    assert gone[-2:] == [LOCK, OWN]


def test_only_own_folders_are_touched(tmp_path):
    kept = [tmp_path / ".geokit", tmp_path / ".other-1", tmp_path / f"{PREFIX}file"]
    kept[0].mkdir()
    kept[1].mkdir()
    kept[2].write_text("a file of that name")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "data").write_text("x")
    (outside / LOCK).touch()
    (tmp_path / f"{PREFIX}{module._machine()}-{0:016x}").symlink_to(outside)
    with private_folder(tmp_path):
        pass
    assert all(path.exists() for path in kept)
    assert (outside / "data").read_text() == "x"


def test_a_link_is_removed_and_what_it_leads_to_is_not(tmp_path):
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    outside.mkdir()
    (outside / "data").write_text("x")
    folder.mkdir()
    for link in (tmp_path / "link", folder / "link"):
        link.symlink_to(outside)
    remove_folder(tmp_path / "link")
    remove_folder(folder)
    assert list(tmp_path.iterdir()) == [outside]
    assert (outside / "data").read_text() == "x"


def test_a_folder_that_others_could_have_filled_is_not_taken_for_an_own_one(tmp_path, monkeypatch):
    folder = tmp_path / "folder"
    for _ in range(2):
        make_own(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (tmp_path / "link").symlink_to(folder)
    (tmp_path / "file").write_text("x")
    for name, reason in (("link", "is a link"), ("file", "is no folder")):
        with pytest.raises(InputError, match=rf"{name}: {reason}, .*; remove it"):
            make_own(tmp_path / name)
    folder.chmod(0o777)
    with pytest.raises(InputError, match="may be written by other users"):
        make_own(folder)
    if os.geteuid():
        monkeypatch.setattr(os, "geteuid", lambda: -1)
    else:
        os.chown(folder, 1001, 1001)  # what is root's is trusted
    with pytest.raises(InputError, match="belongs to another user"):
        make_own(folder)


@pytest.fixture
def shared():
    """A folder that other users can enter, for root to give away."""
    if os.geteuid():
        pytest.skip("only root may give a folder to another user")
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o755)
        yield Path(folder)


def refusal(path, user):
    """What require_trusted says to a user, in a process of that user."""

    def work():
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
        try:
            require_trusted(path)
        except InputError as error:
            return str(error)
        return ""

    return forked(work, 60.0)[0]


def place(path, owner, mode, group=None):
    path.mkdir()
    os.chown(path, owner, owner if group is None else group)
    path.chmod(mode)
    return path


def test_a_place_is_trusted_that_only_root_and_the_user_can_write_to(shared):
    roots = place(shared / "roots", 0, 0o755)
    own = place(shared / "own", 1002, 0o755)
    below = place(own / "below", 1002, 0o700)
    tmp = place(shared / "tmp", 0, 0o1777)
    in_tmp = place(tmp / "own", 1002, 0o755)
    for path in (roots, own, below, in_tmp):
        assert refusal(path, 1002) == "", path
    (tmp / "roots link").symlink_to(below)
    assert refusal(tmp / "roots link", 1002) == ""
    assert refusal(roots, 0) == refusal(in_tmp, 1002) == ""
    assert "belongs to another user" in refusal(own, 0)


def test_a_place_that_another_user_could_have_filled_is_not_trusted(shared):
    theirs = place(shared / "theirs", 1001, 0o755)
    open_to_all = place(shared / "open", 0, 0o777)
    of_group = place(shared / "group", 1002, 0o775)
    tmp = place(shared / "tmp", 0, 0o1777)
    own = place(shared / "own", 1002, 0o755)
    (tmp / "link").symlink_to(own)
    os.lchown(tmp / "link", 1001, 1001)
    (own / "up").symlink_to(open_to_all)
    expected = {
        theirs: (theirs, "belongs to another user"),
        place(theirs / "own", 1002, 0o755): (theirs, "belongs to another user"),
        open_to_all: (open_to_all, "may be written by other users"),
        place(open_to_all / "own", 1002, 0o700): (open_to_all, "may be written by other users"),
        of_group: (of_group, "may be written by other users"),
        tmp: (tmp, "may be written by other users"),
        tmp / "link": (tmp / "link", "belongs to another user"),
        own / "up" / "own": (open_to_all, "may be written by other users"),
    }
    for path, (culprit, reason) in expected.items():
        assert refusal(path, 1002).startswith(f"{culprit}: {reason}, so "), path


def test_a_group_of_the_owner_alone_may_write(shared, monkeypatch):
    folder = place(shared / "folder", 0, 0o775)
    require_trusted(folder)  # the group root
    others = SimpleNamespace(gr_name="root", gr_mem=["root", "somebody"])
    monkeypatch.setattr(grp, "getgrgid", lambda _: others)
    with pytest.raises(InputError, match="may be written by other users"):
        require_trusted(folder)


def test_another_user_who_may_write_by_an_access_control_list_is_seen(shared):
    """The bits of the group are the most that a list grants, so that even an owner's own group is not trusted then."""
    folder = place(shared / "folder", 0, 0o755)
    require_trusted(folder)
    # Version 2; tag, rights and number: owner, user 1001, group, mask, others.
    rows = [(1, 7, -1), (2, 7, 1001), (4, 5, -1), (16, 7, -1), (32, 5, -1)]
    entries = struct.pack("<I", 2) + b"".join(struct.pack("<HHi", *row) for row in rows)
    try:
        os.setxattr(folder, "system.posix_acl_access", entries)
    except OSError as error:
        pytest.skip(f"no access control lists here: {error}")

    def write():
        os.setgroups([])
        os.setgid(1001)
        os.setuid(1001)
        (folder / "planted").touch()

    forked(write, 60.0)
    assert (folder / "planted").exists()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o775
    with pytest.raises(InputError, match="may be written by other users"):
        require_trusted(folder)
    folder.chmod(0o755)  # which is the mask now
    require_trusted(folder)


def test_another_machine_s_folder_is_removed_only_after_a_day(tmp_path):
    foreign = folder_with(tmp_path / OWN, LOCK, "part")
    with private_folder(tmp_path):
        assert (foreign / "part").exists()
    aged(foreign)
    with private_folder(tmp_path):
        assert not foreign.exists()


def test_without_locks_nothing_is_removed(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    left = folder_with(tmp_path / f"{PREFIX}{module._machine()}-{0:016x}", LOCK)
    monkeypatch.setattr(fcntl, "flock", unsupported)
    with private_folder(tmp_path) as folder:
        assert folder.is_dir()
    assert [path.name for path in tmp_path.iterdir()] == [left.name]


@pytest.mark.slow
def test_threads_that_make_and_remove_folders_never_lose_theirs(tmp_path):
    lost = []

    def work():
        for _ in range(200):
            with private_folder(tmp_path) as folder:
                (folder / "part").write_text("x")
                if not (folder / "part").exists():
                    lost.append(folder)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not lost
    assert list(tmp_path.iterdir()) == []


def test_looking_takes_a_small_share_of_the_time(tmp_path, monkeypatch):
    looks = []
    scan = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: looks.append(path) or scan(path))
    monkeypatch.setattr(module, "LOOKING_SHARE", 1e9)
    for _ in range(3):
        with private_folder(tmp_path):
            pass
    assert looks.count(tmp_path) == 1


def test_no_folder_for_temporary_files_is_named(monkeypatch):
    def none():
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr(tempfile, "gettempdir", none)
    with pytest.raises(FileAccessError, match=r"temporary files: No usable .*TMPDIR"):
        temporary_parent()


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_at_any_call_leaves_nothing(tmp_path):
    def block():
        with private_folder(tmp_path) as folder, open(folder / "part", "w") as file:
            file.write("x")

    number = 0
    for number in interrupts(block):
        assert list(tmp_path.iterdir()) == [], number
    assert number > 50


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_at_any_call_leaves_the_old_file_or_the_new_one(tmp_path):
    def block():
        with atomic_path(target) as part:
            part.write_text("new")

    target, found = tmp_path / "target", set()
    for number in itertools.count():
        target.write_text("old")
        interrupt = interrupted(number, block)
        assert [one.name for one in tmp_path.iterdir()] == ["target"], number
        found.add(target.read_text())
        if not interrupt:
            break
    assert found == {"old", "new"}
    assert number > 100
