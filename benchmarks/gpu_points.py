"""Points on a GPU, checked against the CPU, timed beside raw warp: ``python -m benchmarks.gpu_points [--out DIR]``."""

from __future__ import annotations

from benchmarks.gpu_parts import run_parts

if __name__ == "__main__":
    run_parts("gpu_points", __doc__)
