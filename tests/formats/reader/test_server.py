"""The processes that read files with other libraries: what one file does ends with it, and every end has its error."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.formats.reader import process as reader_process
from geokit.formats.reader import server as reader_server
from tests.support.effort import of_all
from tests.support.interrupts import interrupts

pytestmark = pytest.mark.process

# Its files are programs; the body's name is what they say.
READER = """
import array, builtins, os, signal, socket, sys, time, warnings
from geokit.formats.reader import worker as reader_worker
from geokit.formats.file_content.body import Body

def prepare():
    pass

def read_mesh(path):
    names = {**globals(), "path": path, "said": "", "size": 1}
    exec(path.read_text(), names)
    corners = array.array("d", [float(os.path.basename(path))] * (9 * names["size"]))
    return [Body(corners, array.array("q", [3]), array.array("q", [0, 1, 2]), name=str(names["said"]))]
"""
LIMIT = 1 << 24
# Files with what happens between a caller and its server.
SENDERS = ("server.py", "interrupts.py", "socket.py", "subprocess.py", "contextlib.py", "selectors.py")
PIDS = "said = f'{os.getpid()} {os.getppid()}'"


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Writes a program and returns its path."""
    numbers = itertools.count()
    (tmp_path / "reader_of_programs.py").write_text(READER)
    monkeypatch.syspath_prepend(tmp_path)

    def write(program: str = PIDS) -> Path:
        path = tmp_path / str(next(numbers))
        path.write_text(program)
        return path

    yield write
    reader_server._forget_all()


def read(path: Path, limit: int = LIMIT) -> str:
    """What the program said, after checking that its points are those of this file."""
    (body,) = reader_process.read_mesh(path, "reader_of_programs", limit, None)
    assert (body.points == float(path.name)).all()
    return body.name


def pids(path: Path) -> tuple[int, int]:
    """Process and server of a file."""
    process, server = map(int, read(path).split())
    return process, server


def lives(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def ends(*processes: int) -> bool:
    """Whether all processes end within some seconds."""
    for _ in range(200):
        if not any(map(lives, processes)):
            return True
        time.sleep(0.05)
    return False


def announced(path: Path) -> int:
    """The process that writes its number to a file."""
    for _ in range(2000):
        if path.exists() and path.read_text():
            break
        time.sleep(0.01)
    return int(path.read_text())


def test_one_server_and_a_process_for_each_file(make):
    found = [pids(make()) for _ in range(5)]
    assert len({process for process, _ in found}) == 5
    assert len({server for _, server in found}) == 1
    assert os.getpid() not in found[0]
    assert ends(*(process for process, _ in found))


def test_what_a_file_does_ends_with_it(make, tmp_path):
    state = "said = [os.getcwd(), os.environ.get('LEAK'), hasattr(builtins, 'leak'), len(warnings.filters), "
    state += "len(os.listdir('/proc/self/fd')), signal.getsignal(signal.SIGTERM)]"
    before = read(make(state))
    leak = "os.chdir('/tmp'); os.environ['LEAK'] = '1'; builtins.leak = 1; warnings.simplefilter('ignore'); "
    leak += "os.dup(0); signal.signal(signal.SIGTERM, signal.SIG_IGN); " + state
    assert read(make(leak)) != before
    assert read(make(state)) == before
    assert str(tmp_path) in before  # references are relative to the file's folder


def test_the_environment_is_the_caller_s(make, monkeypatch):
    path = make("said = os.environ.get('GEOKIT_TEST')")
    assert read(path) == "None"
    monkeypatch.setenv("GEOKIT_TEST", "1")
    assert read(path) == "1"
    assert read(make("said = os.getppid()")) == read(make("said = os.getppid()"))


LESS = "reader_worker._described = lambda array: ('<f8', (9,), b'12345678')"
MORE = "reader_worker._described = lambda array: ('<f8', (1 << 50,), b'12345678')"
WRONG = "reader_worker._described = lambda array: ('nonsense', (9,), b'')"
ENDS = {
    "crash": ("os.kill(os.getpid(), signal.SIGSEGV)", gk.FileFormatError, r"crashed its reader \(SIGSEGV\)"),
    "abort": ("os.abort()", gk.FileFormatError, r"crashed its reader \(SIGABRT\)"),
    "exit": ("sys.exit(1)", gk.FileFormatError, "SystemExit"),
    "harder exit": ("os._exit(3)", gk.FileFormatError, r"without an answer \(status 3\)"),
    "exception": ("1 / 0", gk.FileFormatError, "ZeroDivisionError"),
    "killed": ("os.kill(os.getpid(), signal.SIGKILL)", gk.WorkerError, r"killed from outside \(SIGKILL\)"),
    "terminated": ("os.kill(os.getpid(), signal.SIGTERM)", gk.WorkerError, r"killed from outside \(SIGTERM\)"),
    "interrupted": ("os.kill(os.getpid(), signal.SIGINT)", gk.WorkerError, r"killed from outside \(SIGINT\)"),
    "memory": ("bytearray(1 << 40)", gk.FileFormatError, "more memory"),
    "large answer": ("size = 1 << 18", gk.FileFormatError, "more memory"),
    "half an answer": (LESS, gk.FileFormatError, "without an answer"),
    "impossible answer": (MORE, gk.FileFormatError, "more memory"),
    "wrong answer": (WRONG, gk.FileFormatError, "wrong answer"),
    "no library": ("import no_such_module", gk.MissingDependencyError, "no_such_module"),
    "closed handles": ("os.closerange(0, 100)", gk.FileFormatError, "without an answer"),
}


def test_every_end_is_named_and_the_next_file_is_read(make):
    _, server = pids(make())
    for name, (program, error, match) in ENDS.items():
        path = make(program)
        with pytest.raises(error, match=match) as caught:
            read(path)
        assert name == "no library" or str(caught.value).startswith(f"{path}: "), name
        assert pids(make())[1] == server, name


@pytest.mark.parametrize("stubborn", [False, True])
def test_a_hang_is_stopped(make, monkeypatch, stubborn):
    pids(make())
    # Long enough for the program to begin, on a busy machine too.
    monkeypatch.setattr(reader_process, "BASE_SECONDS", 3.0)
    monkeypatch.setattr(reader_server, "GRACE_SECONDS", 2.0 if stubborn else 60.0)
    wait = "signal.signal(signal.SIGALRM, signal.SIG_IGN);" * stubborn
    path = make(f"open(path.name + '.pid', 'w').write(str(os.getpid())); {wait} time.sleep(60)")
    with pytest.raises(gk.FileFormatError, match="its reader was stopped"):
        read(path)
    assert ends(int(path.with_suffix(".pid").read_text()))
    monkeypatch.setattr(reader_process, "BASE_SECONDS", 15.0)
    read(make())


def test_a_caller_that_gives_up_leaves_no_process(make):
    path = make("open(path.name + '.pid', 'w').write(str(os.getpid())); time.sleep(60)")
    request = {"content": "mesh", "path": str(path), "names": None, "limit": LIMIT, "memory": 8 << 30}
    pid = path.with_suffix(".pid")
    with reader_server.exchange("reader_of_programs", request, 60.0):
        process = announced(pid)
    assert ends(process)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.slow
@pytest.mark.parametrize("starts", [False, True])
def test_an_interrupt_at_any_call_leaves_no_process_and_the_next_file_is_read(make, starts):
    path, number, before = make(), 0, set(children(os.getpid()))

    def block():
        if starts:
            reader_server._forget_all()
        read(path)

    read(path)
    # Starting takes long: a few calls stand for all, others by each run of all tests.
    for number in interrupts(block, SENDERS, step=of_all(101, 5) if starts else of_all(37, 1)):
        assert set(children(os.getpid())) == before, number
        process, server = pids(path)
        # The reader of the interrupted call has ended too: beside the one that waits there is no other.
        assert ends(process), number
        assert alone(server), number
    assert number > 100


def alone(server: int) -> bool:
    """Whether a server has soon no more than the process that waits for the next file."""
    for _ in range(200):
        if len(children(server)) <= 1:
            return True
        time.sleep(0.05)
    return False


def children(process: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def test_processes_that_are_killed_while_they_wait_are_replaced(make):
    _, server = pids(make())
    spares = children(server)
    for spare in spares:
        os.kill(spare, signal.SIGKILL)
    assert ends(*spares)
    assert pids(make())[1] == server
    os.kill(server, signal.SIGKILL)
    process, other = pids(make())
    assert other != server
    assert ends(process, *spares)


def test_a_server_that_is_killed_at_work_is_named_and_replaced(make):
    path = make("open(path.name + '.pid', 'w').write(str(os.getpid())); os.kill(os.getppid(), 9); time.sleep(60)")
    with pytest.raises(gk.WorkerError, match=r"killed from outside \(its server was killed\)") as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert ends(int(path.with_suffix(".pid").read_text()))
    read(make())


def test_a_module_that_crashes_on_import_does_not_blame_the_file(make, tmp_path):
    path = make()
    (tmp_path / "crashing.py").write_text("import os; os.kill(os.getpid(), 11)")
    with pytest.raises(gk.WorkerError, match=r"did not start \(SIGSEGV"):
        reader_process.read_mesh(path, "crashing", LIMIT, None)
    (tmp_path / "crashing.py").write_text("import time; time.sleep(60)")
    before, reader_server.START_SECONDS = reader_server.START_SECONDS, 1.0
    try:
        with pytest.raises(gk.WorkerError, match="were not imported within 1 s"):
            reader_process.read_mesh(path, "crashing", LIMIT, None)
    finally:
        reader_server.START_SECONDS = before


def test_the_memory_limit_is_that_of_the_file(make):
    path = make("import numpy; numpy.empty(6 << 30, numpy.uint8)")
    read(path, limit=1 << 30)
    with pytest.raises(gk.FileFormatError, match="more memory"):
        read(path, limit=1 << 20)
    read(path, limit=1 << 30)


def test_threads_share_a_server_and_get_their_own_answers(make):
    paths = [make(f"size = {1 + 997 * (at % 7)}; time.sleep(0.002 * {at % 3}); {PIDS}") for at in range(60)]
    paths[30].write_text("os.kill(os.getpid(), 11)")

    def outcome(path):
        try:
            return pids(path)[1]
        except gk.FileFormatError as error:
            return str(error)

    with ThreadPoolExecutor(16) as threads:
        found = list(threads.map(outcome, paths))
    assert "SIGSEGV" in found.pop(30)
    assert len(set(found)) == 1


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_forked_children_read_beside_threads(make):
    paths = [make() for _ in range(40)]
    with ThreadPoolExecutor(4) as threads:
        waiting = [threads.submit(pids, path) for path in paths]
        forked = []
        for _ in range(4):
            process = os.fork()
            if not process:
                good = False
                with contextlib.suppress(BaseException):
                    good = all(pids(path)[0] for path in paths[:5])
                os._exit(0 if good else 1)
            forked.append(process)
        servers = {one.result()[1] for one in waiting}
    assert [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in forked] == [0] * 4
    assert len(servers) == 1


@pytest.mark.parametrize("how", ["exit", "kill"])
def test_nothing_outlives_the_caller(make, tmp_path, how):
    quick, slow = make(), make("open(path.name + '.pid', 'w').write(str(os.getpid())); time.sleep(60)")
    program = (
        f"import sys, threading; from pathlib import Path; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from geokit.formats.reader.process import read_mesh\n"
        f"print(read_mesh(Path({str(quick)!r}), 'reader_of_programs', {LIMIT}, None)[0].name, flush=True)\n"
        f"wait = lambda: read_mesh(Path({str(slow)!r}), 'reader_of_programs', {LIMIT}, None)\n"
        "threading.Thread(target=wait, daemon=True).start()\n"
        f"if {how == 'kill'}: threading.Event().wait()\n"
        f"import time\nwhile not Path({str(slow) + '.pid'!r}).exists(): time.sleep(0.01)\n"
    )
    caller = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    _, server = map(int, caller.stdout.readline().split())
    process = announced(slow.with_suffix(".pid"))
    if how == "kill":
        caller.kill()
    _, errors = caller.communicate(timeout=30)
    assert (caller.returncode, errors) == (-signal.SIGKILL if how == "kill" else 0, "")
    assert ends(server, process)


def test_an_idle_server_ends_and_is_replaced(make, tmp_path, monkeypatch):
    text = (tmp_path / "reader_of_programs.py").read_text()
    (tmp_path / "reader_of_programs.py").write_text(text + "reader_worker.IDLE_SECONDS = 0.1\n")
    _, server = pids(make())
    assert ends(server)
    assert pids(make())[1] != server


@pytest.mark.slow
def test_many_files_leave_nothing(make):
    good, bad = make(), make("os.kill(os.getpid(), 11)")

    def state():
        return len(os.listdir("/proc/self/fd")), threading.active_count(), children(os.getpid())

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    for number in range(200):
        if number % 4:
            server = pids(good)[1]
        else:
            with pytest.raises(gk.FileFormatError):
                read(bad)
        if number == 20:
            before, memory = state(), resident()
    assert state() == before
    assert resident() - memory < 4 << 20
    for _ in range(100):
        if len(children(server)) <= 1:
            break
        time.sleep(0.05)
    assert len(children(server)) <= 1
    assert len(os.listdir(f"/proc/{server}/fd")) < 20


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".glb", ".3mf", ".vtk", ".msh", ".usda"])
def test_real_files_beside_damaged_ones(tmp_path, kind):
    mesh = mesh_catalog.l_profile()
    path, damaged = tmp_path / f"a{kind}", tmp_path / f"b{kind}"
    gk.mesh.save(path, mesh)
    whole = path.read_bytes()
    damaged.write_bytes(whole[: len(whole) // 2])
    for _ in range(3):
        np.testing.assert_array_equal(gk.mesh.load(path).faces, mesh.faces)
        with pytest.raises(gk.FileFormatError):
            gk.mesh.load(damaged)


def test_exit_statuses_are_named():
    assert [reader_server.status_name(status) for status in (-9, -1, 0, 1, 3)] == [
        "SIGKILL", "SIGHUP", "status 0", "status 1", "status 3"
    ]  # fmt: skip
