"""Checks of single arguments: what each takes, what it refuses, and that messages survive any value."""

from __future__ import annotations

import decimal
import fractions
from pathlib import Path

import numpy as np
import pytest

from geokit.core import require
from geokit.errors import InputError


class Failing:
    """An object whose protocols all raise."""

    def _fail(self, *_: object) -> None:
        raise ZeroDivisionError

    __array__ = __float__ = __fspath__ = __index__ = __iter__ = __repr__ = _fail


def test_numbers() -> None:
    given = (2, 0.5, np.float32(0.5), np.int8(2), np.array(0.5), decimal.Decimal("0.5"), fractions.Fraction(1, 2))
    assert [require.require_number(value, "x") for value in given] == [2.0, 0.5, 0.5, 2.0, 0.5, 0.5, 0.5]
    refused = (
        "1",
        b"1",
        True,
        np.True_,
        1j,
        np.complex64(1),
        None,
        [1.0],
        np.ones(1),
        np.ma.masked,
        Failing(),
        10**400,
    )
    for value in (*refused, np.ma.masked, np.datetime64("2020-01-01"), memoryview(b"1"), np.array(None, object)):
        with pytest.raises(InputError, match=r"^x: "):
            require.require_number(value, "x")


def test_counts() -> None:
    assert [require.require_count(value, "n", 1, 9) for value in (1, np.uint8(9))] == [1, 9]
    for value in (0, 10, 2.0, True, np.False_, "3", None, np.timedelta64(3), Failing(), 10**5000):
        with pytest.raises(InputError, match=r"n: .* is not a whole number from 1 to 9"):
            require.require_count(value, "n", 1, 9)
    with pytest.raises(InputError, match="from 0 to 9223372036854775807"):
        require.require_count(2**63, "n")


def test_flags_texts_and_choices() -> None:
    assert require.require_flag(np.True_, "f") is True
    assert require.require_choice("a", "c", ("a", "b")) == "a"
    for value in (0, 1, np.nan, None, "True", Failing()):
        with pytest.raises(InputError, match=r"f: .* is neither True nor False"):
            require.require_flag(value, "f")
    for value in (None, 3, b"a", ["a"], np.array(["a", "b"]), Failing(), {}):
        with pytest.raises(InputError, match=r"c: .* is not known; use one of 'a', 'b'"):
            require.require_choice(value, "c", {"a": 1, "b": 2})
        with pytest.raises(InputError, match=r"t: .* is not a text"):
            require.require_text(value, "t")
    assert require.require_text("\udcff", "t") == "\udcff"  # a byte of a file that is not UTF-8
    with pytest.raises(InputError, match=r"t: '\\ud800' has characters that no file can hold"):
        require.require_text("\ud800", "t")


def test_paths() -> None:
    for given in ("a/b", b"a/b", Path("a/b")):
        assert require.require_path(given) == Path("a/b")
    for value in (None, 3, bytearray(b"a"), Failing(), "a\0", Path("a\0"), "\ud800"):
        with pytest.raises(InputError, match="path: "):
            require.require_path(value)


def test_mappings_and_lists() -> None:
    assert require.require_mapping({"a": 1}, "m") == {"a": 1}
    assert require.require_items((n for n in (1, 2)), "i", int) == [1, 2]
    for value in (None, [], "a", {1: 2}, {" ": 2}, Failing()):
        with pytest.raises(InputError, match="m: "):
            require.require_mapping(value, "m")
    for value in (None, 3, "ab", b"ab", {"a": 1}, Failing()):
        with pytest.raises(InputError, match=r"i: .* is not a list"):
            require.require_items(value, "i")
    with pytest.raises(InputError, match=r"i\[1\]: str is not a int"):
        require.require_items([1, "a"], "i", int)


def test_arrays() -> None:
    unmasked = np.ma.array([1.0, 2.0])
    for value in ([1, 2], np.array([1, 2], ">i2"), unmasked, np.array([1, 2], np.float16)):
        assert require.read_array(value, "a", np.float64).tolist() == [1.0, 2.0]
    with pytest.raises(InputError, match="a: row 1 is masked"):
        require.read_array(np.ma.array([1.0, 2.0], mask=[0, 1]), "a")
    for value in (
        ["1"],
        [True],
        [1j],
        [None],
        [[1], [1, 2]],
        b"12",
        bytearray(8),
        memoryview(b"12"),
        Failing(),
        10**400,
    ):
        with pytest.raises(InputError, match="a: "):
            require.read_array(value, "a")
    with pytest.raises(InputError, match="is not finite"):
        require.require_table([1.0, np.nan], "a", (2,))
    with pytest.raises(InputError, match=r"shape \(1,\) is not \(2,\)"):
        require.require_table([1.0], "a", (2,))


def test_messages_are_short() -> None:
    assert require.described(Failing()) == "a Failing"
    assert require.described(10**5000) == "a int"
    assert len(require.described(list(range(1000)))) == require.LONGEST
    assert "\n" not in require.described(np.zeros((5, 5)))
