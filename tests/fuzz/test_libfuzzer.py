"""Every target of libFuzzer builds, runs its seeds and some thousand inputs, and finds nothing."""

from __future__ import annotations

import pytest

from tests.fuzz.libfuzzer import TARGETS, build, run
from tests.sanitize.compiler import find_clang


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_target_finds_nothing(name: str) -> None:
    clang = find_clang()
    if isinstance(clang, str):
        pytest.skip(f"needs {clang}")
    inputs, covered, found = run(name, build(name, clang.program), seconds=2)
    assert not found
    # The seeds alone reach more than the first refusal; Blosc's library is not instrumented.
    assert inputs > 10
    assert covered > 5
