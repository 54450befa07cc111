"""Arrays of a GPU where an array of the host is asked for."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit.core.require import read_array
from geokit.errors import InputError
from tests.support.devices import DEVICES


@pytest.mark.parametrize("device", DEVICES)
def test_tensors_are_copied(device: str) -> None:
    torch = pytest.importorskip("torch")
    ball = gk.mesh.sphere(segments=8)
    vertices = torch.tensor(ball.vertices, device=device)
    np.testing.assert_array_equal(read_array(vertices, "vertices"), ball.vertices)
    surface = gk.mesh.Surface(ball, device=device)
    surface.update(vertices + 1.0)
    np.testing.assert_array_equal(surface.mesh.vertices, ball.vertices + 1.0)
    with pytest.raises(InputError, match="requires gradients"):
        read_array(vertices.requires_grad_(), "vertices")


class OnDevice:
    """An array that lies elsewhere, as CuPy's."""

    @property
    def __cuda_array_interface__(self) -> dict[str, object]:
        raise RuntimeError("not for hosts")

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise TypeError("implicit conversion")

    def get(self) -> np.ndarray:
        return np.arange(3.0)


def test_what_numpy_refuses_to_copy() -> None:
    np.testing.assert_array_equal(read_array(OnDevice(), "values"), [0.0, 1.0, 2.0])
