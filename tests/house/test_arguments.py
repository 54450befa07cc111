"""Every argument of every public function, spoiled with every bad value: a named error, or a value that may be given.

A full run is some 30,000 calls, one in twenty-four by default.
``python -m tests.house.test_arguments NAME`` prints what the calls of one name do.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit.errors import GeokitError
from tests.support.bad_arguments import BAD
from tests.support.effort import of_all
from tests.support.public_calls import Call, Scene, kinds_of, public_calls, public_names

# Processor time of a call [s], and time after which one that does not return to Python ends the process.
LONGEST, DEADLINE = 5.0, 120.0
PARTS = 24
# One in so many calls is made in the inner loop, and by default.
SAMPLE, SHARE = 401, of_all(24, 1)
# Functions that answer NaN by contract, and where.
NOT_A_NUMBER = {
    "mesh.Surface.closest_point": "misses",
    "mesh.Surface.signed_distance": "misses",
    "mesh.Surface.raycast": "misses",
    "mesh.Surfaces.closest_point": "misses",
    "mesh.Surfaces.signed_distance": "misses",
    "mesh.Surfaces.raycast": "misses",
    "mesh.hausdorff": "means of no samples, or of a mesh without area",
    "volume.raycast": "misses",
    "volume.SparseVolume.raycast": "misses",
    "volume.curvature": "where the gradient is zero",
    "volume.SparseVolume.curvature": "where the gradient is zero",
    "volume.statistics": "of no voxels",
}
# Valid calls that run for seconds or minutes.
TOO_LONG = {
    ("accuracy.write_stability", "chosen", "None"),
    ("accuracy.run", "charts", "None"),
    ("accuracy.run", "quick", "numpy.False_"),
}


class Hang(BaseException):
    pass


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise Hang


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder, before = tmp_path_factory.mktemp("arguments"), Path.cwd()
    os.chdir(folder)  # relative paths among the bad values
    with pytest.MonkeyPatch.context() as patch:
        # Pages without a path are not opened.
        patch.setattr("geokit.render._view.temporary_path", lambda: folder / "page.html")
        patch.setattr("geokit.render._view.open_in_browser", lambda _: False)
        yield Scene(folder)
    os.chdir(before)


def wrong_outcomes(scene: Scene, call: Call, chosen: Any = None) -> Iterator[str]:
    """What is wrong with the outcomes of a call's spoiled arguments; ``chosen`` picks some by their number."""
    number = 0
    for parameter in call.parameters:
        kinds = kinds_of(call, parameter)
        for name, bad in BAD.items():
            number += 1
            if (chosen is not None and not chosen(number)) or (call.name, parameter.name, name) in TOO_LONG:
                continue
            try:
                value = bad.make(scene.mesh, scene.sdf, scene.folder)
            except GeokitError:  # a class of geokit refuses to hold it
                continue
            found = _outcome(call, parameter.name, value, may_be=bool(kinds & bad.fits), calls="callable" in kinds)
            if found:
                yield f"{call.name}({parameter.name}={name}): {found}"


def _outcome(call: Call, parameter: str, value: Any, *, may_be: bool, calls: bool) -> str:
    """What is wrong with the call, or nothing."""
    faulthandler.dump_traceback_later(DEADLINE, exit=True)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        answer = call(**{parameter: value})
    except GeokitError as error:
        return "" if str(error).strip() else "an error without a message"
    except Hang:
        return f"no end after {LONGEST} s of processor time"
    except Exception as error:
        # What a caller's own function raises is the caller's.
        return "" if calls and callable(value) else f"raw {type(error).__name__}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        faulthandler.cancel_dump_traceback_later()
    if not may_be:
        return "taken"
    return "NaN" if _has_nan(answer) and call.name.split("(")[0] not in NOT_A_NUMBER else ""


def _has_nan(answer: Any) -> bool:
    if isinstance(answer, (tuple, list)):
        return any(map(_has_nan, answer))
    if isinstance(answer, gk.mesh.TriangleMesh):
        return bool(np.isnan(answer.vertices).any())
    array = answer if isinstance(answer, np.ndarray) else np.array(answer if isinstance(answer, float) else 0.0)
    return array.dtype.kind == "f" and bool(np.isnan(array).any())


@pytest.fixture(autouse=True)
def _limits() -> Iterator[None]:
    before = signal.signal(signal.SIGPROF, _stop)
    with warnings.catch_warnings():
        # NumPy's warnings of overflow and of NaN stay errors: an answer made of them is nonsense.
        warnings.simplefilter("ignore", UserWarning)
        yield
    signal.signal(signal.SIGPROF, before)


def test_every_public_function_has_a_call(scene: Scene) -> None:
    assert {call.name.split("(")[0] for call in public_calls(scene)} == public_names()


@pytest.mark.slow
def test_some_bad_arguments(scene: Scene) -> None:
    found = []
    for shift, call in enumerate(public_calls(scene)):
        # Charts and pages take seconds each.
        if not call.name.startswith(("render.", "accuracy.", "volume.plan")):
            found += wrong_outcomes(scene, call, lambda number, shift=shift: (number + 7 * shift) % SAMPLE == 0)
    assert found == []


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_bad_arguments(scene: Scene, part: int) -> None:
    found: list[str] = []
    for shift, call in enumerate(list(public_calls(scene))[part::PARTS]):
        call()
        found += wrong_outcomes(scene, call, lambda number, shift=shift: (number + shift) % SHARE == 0)
    assert found == []


class TestSubjects:
    """What records hold is checked by the functions that take them."""

    @pytest.mark.parametrize(
        "held", [{"mesh": 3}, {"volume": np.zeros(3)}, {"mesh": None}, {"points": np.zeros((2, 3)), "volume": 3}]
    )
    def test_subject(self, held: dict[str, Any]) -> None:
        with pytest.raises(gk.InputError, match="subjects"):
            gk.accuracy.run([gk.accuracy.Subject("x", **held)], devices=["cpu"], quick=True)


@pytest.mark.parametrize(
    ("part", "named"),
    [
        (gk.mesh.MeshPart(3, 0, 1), r"parts\[0\].name"),
        (gk.mesh.MeshPart("a", 0.5, 1), r"parts\[0\].first_face"),
        (gk.mesh.MeshPart("a", 0, 2), r"parts\[0\].face_count"),
        (("a", 0, 1), r"parts\[0\]"),
    ],
)
def test_parts_of_a_mesh(part: Any, named: str) -> None:
    with pytest.raises(gk.InputError, match=named):
        gk.mesh.TriangleMesh(np.eye(3), [[0, 1, 2]], parts=(part,))


if __name__ == "__main__":
    import tempfile

    warnings.simplefilter("error")
    warnings.simplefilter("ignore", UserWarning)
    signal.signal(signal.SIGPROF, _stop)
    with tempfile.TemporaryDirectory() as made:
        os.chdir(made)
        shown = Scene(Path(made))
        for one in public_calls(shown):
            if sys.argv[1] in one.name:
                print(one.name, *wrong_outcomes(shown, one), sep="\n  ")
