"""Without what POSIX systems alone have, geokit is imported, answers, and reads and writes files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Modules and names that Windows lacks, and files of Linux. What other libraries and Python itself take of them at
# their import, they take before: they have ways of their own where these are missing.
HIDE = """
import asyncio, builtins, importlib, io, mmap, multiprocessing, os, pkgutil, select, shutil, signal, socket, subprocess
import sys, tempfile
import numpy as np
import warp
for library in ("torch", "jax", "distributed", "xarray", "npe2", "pyvista", "matplotlib.pyplot", "meshio", "rich"):
    try:
        importlib.import_module(library)
    except ImportError:
        pass
NAMES = {
    os: "fork forkpty register_at_fork getuid geteuid getgid getegid getgroups sched_getaffinity sched_setaffinity "
    "sysconf sysconf_names uname waitid pread preadv pwrite pwritev posix_fallocate posix_spawn chown fchown lchown "
    "fchmod killpg getpgid setsid mkfifo getxattr listxattr getloadavg O_NOFOLLOW O_CLOEXEC O_DIRECTORY O_NONBLOCK "
    "O_TMPFILE WNOHANG WNOWAIT WEXITED P_PID",
    signal: "SIGKILL SIGHUP SIGALRM SIGCHLD SIGPIPE SIGUSR1 setitimer alarm pthread_sigmask ITIMER_REAL",
    select: "poll epoll",
    socket: "send_fds recv_fds",
    mmap: "MADV_DONTNEED",
}
for module, names in NAMES.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
for name in ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty"):
    sys.modules[name] = None

def hides(real):
    def call(path, *args, **options):
        if isinstance(path, (str, os.PathLike)) and str(path).startswith(("/proc", "/sys", "/dev/shm")):
            raise FileNotFoundError(2, "hidden", str(path))
        return real(path, *args, **options)
    return call

builtins.open = io.open = hides(io.open)
os.open, os.stat = hides(os.open), hides(os.stat)
"""
WORK = """
import geokit as gk
before = set(sys.modules)
for found in pkgutil.walk_packages(gk.__path__, "geokit."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)
assert {"geokit.cli.info", "geokit.formats.reader.server", "geokit.native._worker"} <= set(sys.modules) - before
mesh = gk.mesh.load(sys.argv[1])
surface = gk.mesh.Surface(mesh, device="cpu")
points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
distance = surface.closest_point(points).distance
volume = gk.volume.from_mesh(surface, voxel_size=0.05)
values = volume.sample(points)
near = distance < 0.1
assert near.any() and np.abs(np.abs(values) - distance)[near].max() < 0.01
for _ in range(2):  # new, and over what is there
    gk.mesh.save("a.stl", mesh)
    gk.volume.save("a.nvdb", volume)
assert gk.mesh.load("a.stl").face_count == mesh.face_count
assert (gk.volume.load("a.nvdb").sample(points) == values).all()
assert gk.volume.inspect("a.nvdb")[0].active_voxel_count == volume.info.active_voxel_count
assert sorted(os.listdir()) == ["a.nvdb", "a.stl"]
gk.mesh.save("a.vtp", mesh)
assert gk.mesh.load("a.vtp", trusted=True).face_count == mesh.face_count
try:
    gk.mesh.load("a.vtp")
except gk.WorkerError as error:
    assert "pass trusted=True" in str(error)
else:
    raise AssertionError("read without a fork")
from geokit.cli import main
for name in ("a.stl", "a.nvdb"):
    sys.argv[1:] = ["info", name]
    assert main() == 0
"""


@pytest.mark.slow
def test_what_only_posix_systems_have_is_not_needed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HIDE + WORK, str(ROOT / "data/samples/torus.ply")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "watertight" in done.stdout
    assert "active_voxel_count" in done.stdout
