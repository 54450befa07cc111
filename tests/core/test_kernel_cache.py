"""The kernel cache, damaged or unusable: kernels are compiled again or elsewhere, and their answers are right."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

from geokit.core import kernel_cache
from geokit.core.launches import warp_private
from tests.support.effort import of_all
from tests.support.forked import ForkServer

pytestmark = pytest.mark.slow

KERNEL = """
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def square_kernel(first: int, values: wp.array(dtype=int), out: wp.array(dtype=int)):
    i = first + wp.tid()
    out[i] = values[i] * values[i]
"""

# Half of the time of compiling goes into warp's own headers, which its processes do not share: here they do.
SCRIPT = """
import os
import numpy as np
from geokit.core import launcher
device = launcher.resolve_device("cpu")
import warp as wp
wp._src.context.runtime.get_clang_pch_dir = lambda: os.environ["HEADERS"]
from square_kernels import square_kernel
values = wp.array(np.arange(10, dtype=np.int32), device=device)
out = wp.empty(10, dtype=int, device=device)
launcher.launch(square_kernel, 10, [values], [out], device)
assert out.numpy().tolist() == [k * k for k in range(10)]
print(wp.config.kernel_cache_dir)
"""


class Cache:
    """A cache folder with one compiled module, and processes that use it."""

    server: ForkServer
    headers: Path

    def __init__(self, folder: Path) -> None:
        self.root, self.temporary, self.code = folder / "cache", folder / "temporary", folder / "code"
        self.notices: list[str] = []
        self.temporary.mkdir()
        self.code.mkdir()
        (self.code / "square_kernels.py").write_text(KERNEL)

    def given(self, **environment: str) -> dict[str, str]:
        path = os.pathsep.join([str(self.code), *filter(None, [os.environ.get("PYTHONPATH")])])
        folders = {"WARP_CACHE_PATH": self.root, "TMPDIR": self.temporary, "HEADERS": self.headers}
        return {"PYTHONPATH": path, **{name: str(folder) for name, folder in folders.items()}, **environment}

    def start(self) -> subprocess.Popen[str]:
        """A process of its own; the others are forks of one."""
        return subprocess.Popen(
            [sys.executable, "-c", SCRIPT],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **self.given()},
        )

    def script(self, before: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return self.server.run(before + SCRIPT, environment=self.given(**environment))

    def run(self, before: str = "", **environment: str) -> tuple[Path, str]:
        """The folder that was used, and stderr without the notice that kernels are compiled."""
        done = self.script(before, **environment)
        return self.finished(done.returncode, done.stdout, done.stderr)

    def finished(self, code: int | None, out: str, err: str) -> tuple[Path, str]:
        assert code == 0, f"status {code}: {err}"
        self.notices = [line for line in err.splitlines() if "compiling kernels" in line]
        return Path(out.strip()), "".join(line for line in err.splitlines(True) if "compiling kernels" not in line)

    @property
    def folder(self) -> Path:
        (folder,) = self.root.glob("*/wp_square_kernels_*")
        return folder

    def files(self, suffix: str) -> list[Path]:
        files = sorted(self.folder.glob(f"*{suffix}"))
        assert files
        return files


@pytest.fixture(scope="module", autouse=True)
def server(tmp_path_factory) -> Iterator[None]:
    Cache.headers = tmp_path_factory.mktemp("headers")
    with ForkServer("import numpy, warp, geokit.core.launcher, geokit.core.kernel_cache") as Cache.server:
        yield


@pytest.fixture(scope="module")
def filled(tmp_path_factory) -> Cache:
    cache = Cache(tmp_path_factory.mktemp("filled"))
    _, err = cache.run()
    assert err == ""
    assert len(cache.notices) == 1
    assert str(cache.folder.parent) in cache.notices[0]
    _, err = cache.run()
    assert err == ""
    assert cache.notices == []
    return cache


@pytest.fixture
def cache(filled, tmp_path) -> Cache:
    cache = Cache(tmp_path)
    shutil.copytree(filled.root, cache.root)
    return cache


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def random_bytes(path: Path) -> None:
    path.write_bytes(bytes((k * 7919 + 13) % 251 for k in range(path.stat().st_size)))


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for k in range(len(data) // 4, len(data), 97):
        data[k] ^= 0x41
    path.write_bytes(bytes(data))


def flipped_once(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def folder_instead(path: Path) -> None:
    path.unlink()
    path.mkdir()


def fifo_instead(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        (".o", cut),
        (".meta", fifo_instead),
        (".blake2", flipped),
        *of_all(
            [],
            [
                (".o", fifo_instead),
                (".o", folder_instead),
                (".meta", emptied),
                (".o", flipped),
                (".meta", cut),
            ],
        ),
    ],
)
def test_damaged_files_are_compiled_again(cache, damage, suffix):
    for file in cache.files(suffix):
        damage(file)
    used, err = cache.run()
    assert used.parent == cache.root
    assert err.count("\n") <= 1
    assert "damaged" in err
    assert cache.run()[1] == ""


@pytest.mark.parametrize("damage", [flipped_once, *of_all([], [emptied, random_bytes, flipped])])
def test_damage_before_the_first_digest(cache, damage):
    for file in cache.files(".blake2"):
        file.unlink()
    for file in cache.files(".o"):
        damage(file)
    assert "compiled again" in cache.run("from geokit.core import kernel_cache; kernel_cache.PATIENCE = 0.1\n")[1]
    assert cache.run()[1] == ""


def test_missing_files_are_made_again(cache):
    for suffix in (".o", ".meta"):
        for file in cache.files(suffix):
            file.unlink()
        cache.run()
        assert cache.files(suffix)


def test_too_little_stack_is_named(cache):
    done = cache.script("import resource; resource.setrlimit(resource.RLIMIT_STACK, (1 << 18, 1 << 18))\n")
    err = done.stderr
    assert done.returncode == 1
    assert (
        "DeviceMemoryError: kernels of square_kernels: need 1024 kB of stack, and the limit is 256 kB (ulimit -s)"
        in err
    )


@pytest.mark.parametrize("home", of_all(["/proc/nowhere"], ["/proc/nowhere", "/dev/null/home"]))
def test_no_home(tmp_path, home):
    cache = Cache(tmp_path)
    used, err = cache.run(WARP_CACHE_PATH=f"{home}/cache")
    assert used.is_relative_to(cache.temporary)
    assert err.count("\n") == 1
    assert "WARP_CACHE_PATH" in err
    assert used.parent.stat().st_mode & 0o077 == 0 or used.stat().st_mode & 0o077 == 0


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="root may write to read-only folders")
def test_read_only_cache(tmp_path):
    cache = Cache(tmp_path)
    cache.root.mkdir(mode=0o555)
    used, err = cache.run()
    assert used.is_relative_to(cache.temporary)
    assert err.count("\n") == 1


def test_a_folder_that_others_may_write_to_is_not_used(tmp_path):
    cache = Cache(tmp_path)
    (cache.temporary / f"geokit-kernels-{os.getuid()}").mkdir()
    (cache.temporary / f"geokit-kernels-{os.getuid()}").chmod(0o777)
    used, _ = cache.run(WARP_CACHE_PATH="/dev/null/cache")
    assert not used.is_relative_to(cache.temporary)


USER, OTHER = 1002, 1001
# Python may lie where only root can read: what it imports late it imports before.
BECOME = f"""
import encodings.ascii, os, tempfile, geokit.core.launcher
geokit.core.launcher.resolve_device("cpu")
os.setgroups([])
os.setgid({USER})
os.setuid({USER})
"""


class Shared(Cache):
    """A cache in a folder that all users can enter, and processes of one of them that use it."""

    def run(self, before: str = "", **environment: str) -> tuple[Path, str]:
        headers = str(self.root.parent / "headers")
        return super().run(BECOME + before, HEADERS=headers, **environment)

    def give(self, owner: int, mode: int) -> None:
        for path in (self.root, *self.root.rglob("*")):
            os.chown(path, owner, owner)
            path.chmod(mode if path.is_dir() else mode & 0o666)


@pytest.fixture
def shared(filled) -> Iterator[Shared]:
    if os.getuid() != 0 or not all(place.stat().st_mode & 0o001 for place in Path(wp.__file__).parents):
        pytest.skip("only root may become another user, who must get at warp's headers")
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o755)
        cache = Shared(Path(folder))
        shutil.copytree(filled.root, cache.root)
        shutil.copytree(Cache.headers, cache.root.parent / "headers")
        cache.temporary.chmod(0o1777)
        for path in (cache.root.parent / "headers").rglob("*"):
            path.chmod(0o755)
        os.chown(cache.root.parent / "headers", USER, USER)
        yield cache


@pytest.mark.parametrize(
    ("owner", "mode", "reason"),
    [
        (OTHER, 0o755, "belongs to another user"),
        *of_all(
            [],
            [
                (0, 0o777, "may be written by other users"),
                (USER, 0o777, "may be written by other users"),
                (0, 0o1777, "may be written by other users"),
            ],
        ),
    ],
)
def test_kernels_that_another_user_could_have_written_are_not_run(shared, owner, mode, reason):
    shared.give(owner, mode)
    used, err = shared.run()
    assert used == shared.temporary / f"geokit-kernels-{USER}"
    assert len(shared.notices) == 1
    assert err.count("\n") == 1
    assert f"{shared.root}" in err
    assert f"{reason}, so what is in it is not trusted" in err
    assert "WARP_CACHE_PATH names another folder" in err
    assert shared.run()[0] == used
    assert shared.notices == []  # the other folder is kept


def test_a_parent_of_the_usual_folder_that_others_may_write_to(shared):
    # As HOME=/home/all: whoever may write there can put another cache in the place of this one.
    shared.give(USER, 0o755)
    shared.root.parent.chmod(0o777)
    used, err = shared.run(TMPDIR="/tmp")
    assert not used.is_relative_to(shared.root)
    assert f"{shared.root.parent}: may be written by other users" in err


@pytest.mark.parametrize("owner", [0, USER])
def test_a_cache_of_root_s_or_of_the_user_s_is_used(shared, owner):
    shared.give(owner, 0o755)
    used, err = shared.run()
    assert used.is_relative_to(shared.root)
    assert (err, shared.notices) == ("", [])


@pytest.mark.parametrize("suffix", [".o", *of_all([], [".meta"])])
def test_a_file_of_another_user_s_is_compiled_again(shared, suffix):
    shared.give(USER, 0o755)
    os.chown(shared.files(suffix)[0], OTHER, OTHER)
    used, err = shared.run()
    assert used.is_relative_to(shared.root)
    assert len(shared.notices) == 1
    assert err.count("\n") == 1
    assert "belongs to another user" in err
    assert "compiled again" in err


def test_a_module_of_another_user_s_that_cannot_be_removed(shared):
    shared.give(USER, 0o755)
    os.chown(shared.folder, OTHER, OTHER)
    used, err = shared.run()
    assert used == shared.temporary / f"geokit-kernels-{USER}"
    assert err.count("\n") == 1
    assert f"belongs to another user: '{shared.folder}'" in err


def test_an_open_umask_in_a_closed_folder(shared):
    # Nobody else gets there, so what all may write is trusted, and not compiled anew by each process.
    shared.give(USER, 0o777)
    for folder in (shared.root, *shared.root.glob("*")):
        folder.chmod(0o700)
    used, err = shared.run()
    assert used.is_relative_to(shared.root)
    assert (err, shared.notices) == ("", [])


@pytest.mark.usefixtures("filled")  # the headers are compiled
def test_two_processes_with_an_empty_cache(tmp_path):
    cache = Cache(tmp_path)
    started = [cache.start() for _ in range(2)]
    for process in started:
        out, err = process.communicate(timeout=120)
        _, err = cache.finished(process.returncode, out, err)
        assert err == ""


@pytest.fixture
def full_disk(tmp_path):
    """A small file system."""
    mount = shutil.which("mount")
    folder = tmp_path / "full"
    folder.mkdir()
    command = [mount or "mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    if mount is None or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("this user may not mount a small file system")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.process
@pytest.mark.parametrize("room", [0, 4096, 8192])
def test_full_disk(tmp_path, full_disk, room):
    (full_disk / "filler").write_bytes(bytes(65536 - room))
    cache = Cache(tmp_path)
    used, err = cache.run(WARP_CACHE_PATH=str(full_disk))
    assert used.is_relative_to(cache.temporary)
    assert err.count("\n") == 1


READ_ONLY = """
import tempfile
from geokit.core import kernel_cache
def unknown():
    raise FileNotFoundError(2, "No usable temporary directory found")
kernel_cache.TEMPORARY = {folders!r}
tempfile.gettempdir = unknown
"""


def test_where_python_knows_no_folder_for_temporary_files(tmp_path):
    cache = Cache(tmp_path)
    err = cache.script(READ_ONLY.format(folders=[str(cache.temporary)]), WARP_CACHE_PATH="/dev/null/cache").stderr
    assert f"{cache.temporary}/geokit-kernels-{os.getuid()} is used instead" in err
    # Without compiled kernels that folder does not help.
    assert "FileAccessError: temporary files: No usable" in err.splitlines()[-1]
    assert "TMPDIR" in err.splitlines()[-1]


def test_where_no_folder_can_be_written_to(tmp_path):
    err = Cache(tmp_path).script(READ_ONLY.format(folders=[]), WARP_CACHE_PATH="/dev/null/cache").stderr
    assert "FileAccessError: kernel cache: /dev/null/cache" in err.splitlines()[-1]
    assert "WARP_CACHE_PATH" in err.splitlines()[-1]


@pytest.mark.parametrize("leaves", ["draft", "object", "both"])
def test_what_an_interrupt_leaves_is_removed(tmp_path, monkeypatch, leaves):
    # At whichever call of the compiler's it comes: an object without its digest would count as damaged.
    folder = tmp_path / "wp_square_kernels_0"
    draft = tmp_path / f"{folder.name}_p{os.getpid()}_t{threading.get_ident()}"

    def load(*_: object) -> None:
        for place in {"draft": [draft], "object": [folder], "both": [folder, draft]}[leaves]:
            place.mkdir()
            (place / "square.o").write_bytes(b"object")
        raise KeyboardInterrupt

    monkeypatch.setattr(warp_private, "module_files", lambda *_: (folder / "square.o", folder / "square.meta"))
    monkeypatch.setattr(warp_private, "load_module", load)
    module = SimpleNamespace(name="square")
    with pytest.raises(KeyboardInterrupt):
        kernel_cache._load_checked(module, SimpleNamespace(), 1, None)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert not draft.exists()


def test_an_interrupt_while_the_digest_is_kept_leaves_no_draft(tmp_path, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        kernel_cache._keep(tmp_path / "square.blake2", "digest")
    assert list(tmp_path.iterdir()) == []
