"""Every kernel compiles for CUDA: the compiler comes with warp, so no GPU is needed to see it."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

import pytest
import warp as wp

from geokit.core import launcher

ROOT = Path(__file__).resolve().parents[2]
# Modules that have been compiled on this machine, by their hash: they are compiled again when they change.
COMPILED = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "geokit-tests", "sm_90")
KERNEL_FILES = sorted((ROOT / "geokit").rglob("*_kernels.py"))


def kernels_of(path: Path) -> tuple[object, list[wp.Kernel]]:
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    mine = [value for value in vars(module).values() if isinstance(value, wp.Kernel)]
    return module, [kernel for kernel in mine if kernel.module.name == module.__name__]


def test_there_are_kernels():
    assert sum(bool(kernels_of(path)[1]) for path in KERNEL_FILES) >= 8


@pytest.mark.slow
@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.stem)
def test_compiles_for_sm_90(path, tmp_path):
    launcher.resolve_device("cpu")
    module, kernels = kernels_of(path)
    known = COMPILED / f"{path.stem}_{wp.get_module(module.__name__).get_module_hash().hex()}_{wp.__version__}"
    if kernels and known.exists():
        return
    if not kernels:  # a file of functions or of C++ text, which compile with the kernels that use them
        public = {name: value for name, value in vars(module).items() if not name.startswith("__")}
        assert any(isinstance(value, (wp.Function, str)) for value in public.values())
        return
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    text = "".join(file.read_text() for file in tmp_path.rglob("*.ptx"))
    for kernel in kernels:
        assert kernel.key in text
    known.parent.mkdir(parents=True, exist_ok=True)
    known.touch()


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.stem)
def test_first_parameter_is_the_first_item(path):
    # On the CPU a launch is cut into slices: a kernel without an offset would answer the first slice again and again.
    for kernel in kernels_of(path)[1]:
        assert kernel.adj.args[0].label == "first"
        assert kernel.adj.args[0].type in (int, wp.int32)


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.stem)
def test_kernels_end_in_kernel(path):
    for kernel in kernels_of(path)[1]:
        assert kernel.key.endswith("_kernel")
