"""What readers raise is named, and text of files in messages is one line of printable text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geokit.core.files import in_one_line, named_damage
from geokit.errors import FileFormatError, InputError

PATH = Path("folder/a.PLY")


def test_any_error_is_named():
    with (
        pytest.raises(FileFormatError, match=r"^folder/a.PLY: cannot be read as .ply \(KeyError: 'x\\x1b'\); the file"),
        named_damage(PATH),
    ):
        {}["x\x1b"]


@pytest.mark.parametrize("error", [InputError("as it is"), MemoryError(), KeyboardInterrupt(), UserWarning("left out")])
def test_errors_that_are_not_the_file_s(error):
    with pytest.raises(type(error)) as caught, named_damage(PATH):
        raise error
    assert caught.value is error


def test_text_of_the_file_in_a_named_error_is_escaped():
    with pytest.raises(FileFormatError, match=r"^folder/a.PLY: has no 'x\\x00\\u2028'$"), named_damage(PATH):
        raise FileFormatError(f"{PATH}: has no 'x\0\u2028'")


def test_numpy_says_nothing():
    signaling = np.array([0x7FA00001], np.uint32).view(np.float32)
    with named_damage(PATH):
        assert np.isnan(signaling.astype(np.float64)).all()


def test_plain_text_stays():
    assert in_one_line("Grid 'Höhe' has 3 values") == "Grid 'Höhe' has 3 values"


def test_what_does_not_print_is_escaped():
    assert in_one_line("a\n b\t\x1b[31m\0\udcc3") == r"a b\t\x1b[31m\x00\udcc3"


def test_long_text_is_cut():
    assert in_one_line("x" * 1000, 10) == "x" * 10
