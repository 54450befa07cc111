"""What a format leaves out of a mesh is named, and nothing else."""

from __future__ import annotations

import pytest

from geokit.formats.held import what_is_held
from geokit.formats.table import Format
from geokit.mesh import TriangleMesh


@pytest.mark.parametrize("unit", [True, False])
@pytest.mark.parametrize("kind", ["", ".obj"])
def test_units_and_up_axes(unit: bool, kind: str) -> None:
    mesh = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], meters_per_unit=0.001, up_axis="z")
    _, lost = what_is_held(mesh, Format("obj", mesh="rw", unit=unit, up="y"), None, kind)
    expected = [] if unit else ["the unit of 0.001 m"]
    # What holds a unit holds the axis too, or is turned.
    if kind and not unit:
        expected.append("that z is up (y is in most such files)")
    assert lost == expected
