"""The default limit follows the file's size and the free memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from geokit import DeviceMemoryError, InputError
from geokit.core import content_limit as module
from geokit.core.content_limit import GROWTH, HARMLESS, SHARE, content_limit, require_content, set_default_limit


@pytest.mark.parametrize(
    ("size", "free", "expected"),
    [
        (0, 1 << 40, HARMLESS),
        (HARMLESS // GROWTH - 1, 1 << 40, HARMLESS),
        (1 << 30, 1 << 40, GROWTH << 30),
        (1 << 30, 1 << 33, int(SHARE * (1 << 33))),
        (100, 1000, int(SHARE * 1000)),
    ],
)
def test_the_default(monkeypatch, size, free, expected):
    monkeypatch.setattr(module, "available_host", lambda: free)
    assert content_limit(size) == expected
    assert content_limit(size, 7) == 7


@pytest.mark.parametrize("limit", [0, -1, 1.5, "1", True])
def test_limits_that_are_none(limit):
    with pytest.raises(InputError, match="memory_limit"):
        content_limit(10, limit)


def test_the_default_can_be_set():
    set_default_limit(5)
    try:
        assert content_limit(1 << 30) == 5
        assert content_limit(1 << 30, 7) == 7
    finally:
        set_default_limit(None)


def test_the_message_has_the_estimate(tmp_path):
    path = Path(tmp_path / "a.npz")
    path.write_bytes(bytes(1000))
    require_content(path, 3 << 30, 3 << 30)
    with pytest.raises(
        DeviceMemoryError, match=r"a\.npz: its content needs 3 GiB of memory, 3.22e\+06 times the file's"
    ):
        require_content(path, 3 << 30, (3 << 30) - 1)
