"""Files that were once faults: mutants and inputs of fuzzers, cut down to what matters."""

from __future__ import annotations

import contextlib
import re
import warnings
from pathlib import Path

import pytest

from geokit.errors import GeokitError
from tests.fuzz.originals import Target
from tests.fuzz.trial import facts_of

FOUND = Path(__file__).with_name("found")
# What is loaded from a file, and whether it is accepted.
FILES = {
    "signaling_nan.npy": ("points", False),  # NumPy warned of a cast
    "signaling_nan.stl": ("mesh", False),
    "python_2_header.npy": ("points", True),  # NumPy warned of the header
    "escape.xyz": ("points", False),  # the message would have colored the terminal
    "escape.pcd": ("points", False),
    "two_names.ply": ("points", False),  # NumPy's ValueError: a field occurs more than once
    "name_of_zeros.ply": ("mesh", False),  # the message held the zeros of a name of a list
    "long_map_name.vdb": ("volume", False),  # line ends and other bytes of the file stood in the message
    "long_name.mha": ("volume", False),  # the message did not name the file
    "long_plane.mrc": ("volume", False),  # memory was taken for the first of its planes
    "too_many_voxels.mrc": ("volume", False),  # NumPy's ValueError: more than 2^63
    "signaling_nan.nii": ("volume", True),  # NumPy warned of a cast
    "no_end.msh": ("mesh", False),  # the warning quoted the bytes behind the name of a section
}


def test_every_file_is_listed() -> None:
    assert sorted(FILES) == sorted(path.name for path in FOUND.iterdir())
    assert sum(path.stat().st_size for path in FOUND.iterdir()) < 30_000


@pytest.mark.parametrize("name", FILES)
def test_it_loads_or_is_refused_by_name(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    content, accepted = FILES[name]
    path = FOUND / name
    pytest.importorskip({".nii": "nibabel", ".mrc": "mrcfile"}.get(path.suffix, "numpy"))
    printable = rf"\A{re.escape(str(path))}[\x20-\x7e]*\Z"
    refusal = contextlib.nullcontext() if accepted else pytest.raises(GeokitError, match=printable)
    with warnings.catch_warnings(record=True) as given, refusal:
        warnings.simplefilter("always")
        facts_of(Target(content, path.suffix), path)
    for warning in given:  # of what is left out
        assert re.match(printable, str(warning.message)), warning
    assert capfd.readouterr() == ("", "")
