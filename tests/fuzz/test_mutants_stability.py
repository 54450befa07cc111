"""Damaged files of every format: each loads or is refused by name, whatever is asked of it afterwards.

Not one ends the process, prints, hangs for 20 s of CPU time, takes 2 GiB or raises anything but a GeokitError.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import pytest

from geokit import native
from geokit.formats.table import FORMATS
from tests.formats.images.needed import need
from tests.fuzz.campaign import Worker, run
from tests.fuzz.originals import TARGETS, Target
from tests.support.effort import of_all

MUTANTS = of_all(10, 200)
# Nearly all damage of these is noticed: so few of their mutants load that more are needed to meet one.
LEAST = {".usdc": 30, ".dae": 15}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def idle() -> Iterator[list[Worker]]:
    """Processes of one target go on with the next: each would import the same libraries and load the same kernels."""
    workers: list[Worker] = []
    yield workers
    for worker in workers:
        worker.close()


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: f"{target.content}{target.kind}")
def test_every_mutant_ends_well(target: Target, idle: list[Worker]) -> None:
    if target.kind == ".vdb" and not native.available():
        pytest.skip("geokit was built without OpenVDB")
    if target.kind in (".las", ".laz") and not importlib.util.find_spec("laspy"):
        pytest.skip("needs laspy")
    if FORMATS[target.kind].extra == "cad" and not importlib.util.find_spec("OCP"):
        pytest.skip("needs cadquery-ocp-novtk")
    need(target.kind)
    count = max(MUTANTS, LEAST.get(target.kind, 0))
    tally = run(target, range(count), idle=idle)
    assert not tally.faults
    refused = sum(count for end, count in tally.ends.items() if end.startswith("refused"))
    # The mutants would prove nothing if they were all whole, or all no files of their format.
    assert refused >= count // 10
    assert tally.ends["same"] + tally.ends["differs"] > count // 20
