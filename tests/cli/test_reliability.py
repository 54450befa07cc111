"""Options for all commands, and output that cannot be written, in real processes."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.cli.conftest import ROOT, SECONDS, run_geokit, run_here

pytestmark = pytest.mark.process


@pytest.fixture
def outside(tmp_path):
    """A mesh whose vertices lie in a file of another folder."""
    (tmp_path / "home").mkdir()
    (tmp_path / "big").mkdir()
    np.eye(3).tofile(tmp_path / "big" / "b.bin")
    path = tmp_path / "home" / "a.xdmf"
    path.write_text(
        '<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry GeometryType="XYZ">'
        '<DataItem DataType="Float" Dimensions="3 3" Format="Binary" Precision="8">../big/b.bin</DataItem></Geometry>'
        '<Topology TopologyType="Triangle" NumberOfElements="1"><DataItem DataType="Int" Dimensions="1 3" Format="XML" '
        'Precision="8">0 1 2</DataItem></Topology></Grid></Domain></Xdmf>'
    )
    return path


def test_folders_of_referenced_files(outside):
    refused = run_here("info", outside)
    assert refused.returncode == 1
    assert "--reference-folder" in refused.stderr
    folder = outside.parent.parent / "big"
    for arguments in (["--reference-folder", folder, "info", outside], ["info", outside, "--reference-folder", folder]):
        assert run_here(*arguments).returncode == 0
    # What one command may read, the next one may not.
    assert run_here("info", outside).returncode == 1
    assert run_geokit("info", outside, "--reference-folder", folder).returncode == 0


def test_the_memory_limit(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", points=np.zeros((40_000, 3)))
    refused = run_here("info", tmp_path / "a.npz", "--memory-limit", 100_000)
    assert refused.returncode == 1
    assert "--memory-limit" in refused.stderr
    assert run_geokit("info", tmp_path / "a.npz", "--memory-limit", 10_000_000).returncode == 0
    assert run_here("info", tmp_path / "a.npz", "--memory-limit", "much").returncode == 2


def test_a_full_disk_behind_stdout():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "geokit", "doctor", "--help"],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=SECONDS,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "geokit: standard output: writing failed (No space left on device); check the disk\n"


def test_names_in_no_encoding_are_printed(tmp_path):
    path = os.fsencode(tmp_path) + b"/caf\xe9.obj"
    with open(path, "w") as file:
        file.write("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    done = subprocess.run(
        [sys.executable, "-m", "geokit", "info", path],
        capture_output=True, timeout=SECONDS, env={**os.environ, "PYTHONPATH": str(ROOT), "LC_ALL": "C.UTF-8"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert b"caf\xe9.obj" in done.stdout
