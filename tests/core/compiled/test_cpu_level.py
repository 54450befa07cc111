"""Levels of x86-64: which one a machine has, and the flags that warp gets."""

from __future__ import annotations

import pytest
import warp as wp

from geokit.core.compiled import cpu_level
from geokit.errors import InputError

V3 = "fpu avx avx2 bmi1 bmi2 f16c fma abm movbe xsave"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Sets what Linux says of the processors."""

    def has(flags: str, architecture: str = "x86_64") -> None:
        (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nflags\t\t: {flags}\n\nprocessor\t: 1\nflags\t\t: {flags}\n")
        monkeypatch.setattr(cpu_level, "_FEATURES", tmp_path / "cpuinfo")
        monkeypatch.setattr(cpu_level.platform, "machine", lambda: architecture)
        cpu_level._features.cache_clear()

    monkeypatch.delenv("GEOKIT_CPU", raising=False)
    yield has
    cpu_level._features.cache_clear()


@pytest.mark.parametrize(
    ("flags", "architecture", "level"),
    [
        (V4, "x86_64", "x86-64-v4"),
        (V3, "x86_64", "x86-64-v3"),
        (V4.replace(" avx512vl", ""), "x86_64", "x86-64-v3"),
        (V3.replace(" fma", ""), "x86_64", "native"),
        (V4, "aarch64", "native"),
        ("", "x86_64", "native"),
    ],
)
def test_the_best_level_that_the_machine_has(machine, flags, architecture, level):
    machine(flags, architecture)
    assert cpu_level.level() == level


def test_a_system_that_does_not_list_its_features(machine, monkeypatch, tmp_path):
    machine(V4)
    monkeypatch.setattr(cpu_level, "_FEATURES", tmp_path / "none")
    assert cpu_level.level() == "native"


@pytest.mark.parametrize("wanted", ["x86-64-v3", "native"])
def test_the_environment_chooses_a_lower_level(machine, monkeypatch, wanted):
    machine(V4)
    monkeypatch.setenv("GEOKIT_CPU", wanted)
    assert cpu_level.level() == wanted


@pytest.mark.parametrize("wanted", ["x86-64-v4", "znver4"])
def test_a_level_that_the_machine_lacks(machine, monkeypatch, wanted):
    machine(V3)
    monkeypatch.setenv("GEOKIT_CPU", wanted)
    with pytest.raises(InputError, match=r"GEOKIT_CPU: .* is not for this machine; use one of x86-64-v3, native"):
        cpu_level.level()


def test_flags_are_those_of_warp_with_another_target(monkeypatch):
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", "-march=native -mllvm=-inline-threshold=9000")
    assert cpu_level.flags_of("x86-64-v3") == "-target-cpu x86-64-v3 -mllvm=-inline-threshold=9000"
    assert cpu_level.flags_of("native") is None
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", None)
    assert cpu_level.flags_of("x86-64-v4") == "-target-cpu x86-64-v4 -mprefer-vector-width=512"


@pytest.mark.parametrize("flags", ["", "-target-cpu znver4"])
def test_flags_of_the_user_are_kept(monkeypatch, flags):
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    assert cpu_level.flags_of("x86-64-v3") is None
