"""Children of a process that has used geokit: forked, spawned, served; queries there answer as in the parent."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork"),
]

SECONDS = 120.0

# Starts with two threads and enough queries for several slices, so that the pool has run before the fork.
PRELUDE = """
import os, sys, threading, time
import numpy as np
import geokit as gk

grid = np.random.default_rng(0).random((200_000, 3))
corners = np.random.default_rng(1).random((3000, 3))
mesh = gk.mesh.TriangleMesh(corners, np.arange(3000).reshape(-1, 3))
surface = gk.mesh.Surface(mesh, device="cpu")
volume = gk.volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 0.5, [[-1] * 3, [1] * 3], 0.05)

def answers():
    return [
        surface.closest_point(grid).distance,
        volume.sample(grid, device="cpu"),
        gk.points.NeighborGrid(grid[:20_000], 0.02, device="cpu").count(),
    ]

def child_agrees(expected, seconds=60):
    child = os.fork()
    if child == 0:
        try:
            ok = all(np.array_equal(*pair) for pair in zip(expected, answers()))
        except BaseException as error:
            print(repr(error), flush=True)
            ok = False
        os._exit(0 if ok else 1)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status == 0
        time.sleep(0.01)
    os.kill(child, 9)
    os.waitpid(child, 0)
    print("the child hung", flush=True)
    return False
"""


def run(script: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "GEOKIT_THREADS": "2"}
    return subprocess.run(
        [sys.executable, "-c", PRELUDE + script], capture_output=True, text=True, timeout=SECONDS, env=environment
    )


def assert_passed(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_forked_child_answers_as_its_parent():
    assert_passed(run("sys.exit(not child_agrees(answers()))"))


def test_children_forked_while_other_threads_compute_answer_right():
    assert_passed(
        run("""
expected, stop = answers(), False

def work():
    while not stop:
        answers()

busy = [threading.Thread(target=work) for _ in range(2)]
for thread in busy:
    thread.start()
passed = []
for _ in range(10):
    time.sleep(0.05)
    passed.append(child_agrees(expected))
stop = True
for thread in busy:
    thread.join()
sys.exit(not all(passed))
""")
    )


def test_a_fork_waits_for_a_module_that_is_being_loaded():
    assert_passed(
        run("""
expected = answers()
from geokit.core import launcher
held, released = threading.Event(), []

def load():
    with launcher._load_lock:
        held.set()
        time.sleep(0.5)
        released.append(True)

loader = threading.Thread(target=load)
loader.start()
held.wait()
passed = child_agrees(expected)
loader.join()
sys.exit(not (passed and released))
""")
    )


def test_a_team_of_threads_works_in_a_child():
    script = """
import tempfile, pathlib, importlib.util
text = '''
import warp as wp
import geokit as gk

@wp.kernel
def twice_kernel(share: gk.threads.Share, values: wp.array(dtype=float)):
    for k in range(wp.tid(), share.count, share.step):
        i = gk.threads.item(share, k)
        values[i] = 2.0 * values[i]
        gk.threads.barrier(share)
'''
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "twice.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location("twice", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    import warp as wp
    team = gk.threads.Team(2, device="cpu")

    def answers():
        values = wp.array(np.arange(64, dtype=np.float32), device="cpu")
        team.run(module.twice_kernel, 64, [values])
        return [values.numpy()]

    expected = answers()
    assert expected[0][3] == 6.0
    sys.exit(not child_agrees(expected))
"""
    assert_passed(run(script))


def test_a_child_of_a_process_with_cuda_is_refused_by_name(monkeypatch):
    from geokit.core import launcher
    from geokit.errors import InputError

    monkeypatch.setattr(launcher, "_has_lost_cuda", True)
    launcher.resolve_device("cpu")
    with pytest.raises(InputError, match="spawn"):
        launcher._require_cuda()


def squared_distances(points: np.ndarray) -> np.ndarray:
    import geokit as gk

    triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    return gk.mesh.Surface(triangle, device="cpu").closest_point(points).distance ** 2


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_pools_of_processes(method):
    points = np.random.default_rng(3).random((5000, 3)) + np.array([0, 0, 1])
    expected = squared_distances(points)
    with multiprocessing.get_context(method).Pool(2) as pool:
        answers = pool.map_async(squared_distances, [points] * 4).get(timeout=SECONDS)
    for answer in answers:
        np.testing.assert_array_equal(answer, expected)


def test_joblib():
    joblib = pytest.importorskip("joblib")
    points = np.random.default_rng(4).random((5000, 3))
    answers = joblib.Parallel(n_jobs=2)(joblib.delayed(squared_distances)(points) for _ in range(4))
    for answer in answers:
        np.testing.assert_array_equal(answer, squared_distances(points))


class Samples:
    """A data set as PyTorch's DataLoader takes it: its workers sample a volume that they got from their parent."""

    def __init__(self, volume) -> None:
        self.volume = volume

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> np.ndarray:
        points = np.random.default_rng(index).random((3000, 3))
        return self.volume.sample(points, device="cpu")


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_of_a_data_loader(method):
    data = pytest.importorskip("torch.utils.data")
    import geokit as gk

    volume = gk.volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 0.5, [[-1] * 3, [1] * 3], 0.1)
    samples = Samples(volume)
    expected = [samples[k] for k in range(len(samples))]
    loader = data.DataLoader(samples, batch_size=None, num_workers=2, multiprocessing_context=method, timeout=SECONDS)
    for answer, other in zip(loader, expected, strict=True):
        np.testing.assert_array_equal(np.asarray(answer), other)


def test_asyncio_and_daemon_threads():
    assert_passed(
        run("""
import asyncio
expected = answers()

async def all_at_once():
    return await asyncio.gather(*(asyncio.to_thread(answers) for _ in range(8)))

for got in asyncio.run(all_at_once()):
    assert all(np.array_equal(*pair) for pair in zip(expected, got))

def endless():
    while True:
        answers()

threading.Thread(target=endless, daemon=True).start()
time.sleep(0.3)
""")
    )
