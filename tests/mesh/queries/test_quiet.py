"""Queries print nothing: a message of warp on stdout would end up in pipes."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
import numpy as np
import geokit as gk
corners = np.random.default_rng(0).random((30, 3))
surface = gk.mesh.Surface(gk.mesh.TriangleMesh(corners, np.arange(30).reshape(-1, 3)), device="cpu")
surface.raycast_all(corners, corners - 0.5)
surface.overlapping(corners - 0.1, corners + 0.1)
"""


@pytest.mark.slow
def test_lists_of_crossings_and_overlaps():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert done.stdout + done.stderr == ""
