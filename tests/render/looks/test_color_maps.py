"""Color maps without matplotlib: its colors."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from geokit.errors import InputError
from geokit.render.looks.checks import DIVERGING, SEQUENTIAL, checked_colormap
from geokit.render.looks.color_maps import HELD, color_table


@pytest.mark.parametrize("name", [*HELD, "plasma"])
def test_colors_are_those_of_matplotlib(name: str) -> None:
    expected = 255.0 * matplotlib.colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
    np.testing.assert_array_equal(color_table(name), np.rint(expected))


def test_the_maps_that_are_chosen_by_default_are_held() -> None:
    assert {SEQUENTIAL, DIVERGING} <= set(HELD)


def test_other_names_are_those_of_matplotlib() -> None:
    assert checked_colormap("plasma") == "plasma"
    with pytest.raises(InputError, match="'plusma' is not known to matplotlib"):
        checked_colormap("plusma")
