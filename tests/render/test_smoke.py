"""Fog drawn as smoke: how much light reaches a sample, what is seen, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image

import geokit as gk
from geokit.render._smoke import AMBIENT, BACKGROUND, FREE_PATH, _light

SIZE = (90, 80)


def ball(peak: float = 2.0, **options: Any) -> Any:
    """A ball of radius 1 with one density, in 40 voxels of 0.05."""
    axis = (np.arange(48) - 23.5) * 0.05
    radius = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij")), axis=0)
    values = np.where(radius < 1.0, peak, 0.0)
    return gk.volume.from_dense(values, voxel_size=0.05, name="density", grid_class="fog volume", **options)


def drawn(path: Path, **options: Any) -> np.ndarray[Any, Any]:
    options = {"volume": ball(), "look": "smoke", "size": SIZE, **options}
    return image.imread(gk.render.figure(path / "smoke.png", **options))


@pytest.mark.parametrize("towards", [(0, 0, 1), (0, -2, 0), (0.5, 0, 1), (-0.3, 0.8, -0.2), (1, 0.4, 0.7)])
def test_light_falls_off_exponentially_along_the_ray(towards: tuple[float, float, float]) -> None:
    """In a layer of even smoke that is wide enough, only the depth along the ray counts."""
    main = int(np.argmax(np.abs(towards)))
    depth = np.full((60, 60, 60), 0.02)
    light = np.moveaxis(_light(depth, np.array(towards, float)), main, 0)[:, 30, 30]
    light = light[::-1] if towards[main] > 0 else light
    step = np.linalg.norm(towards) / abs(towards[main])
    np.testing.assert_allclose(light[:25], np.exp(-0.02 * step * np.arange(25)), rtol=1e-3)


def test_a_sample_is_in_the_shadow_of_what_is_between_it_and_the_light() -> None:
    depth = np.zeros((20, 20, 20))
    depth[10, 10, 10] = 50.0
    light = _light(depth, np.array([0.0, 1.0, 1.0]))
    assert light[10, 10, 10] == 1.0
    assert light[10, 8, 8] == pytest.approx(0.0, abs=1e-12)
    assert (light[10, 12, 12], light[11, 8, 8]) == (1.0, 1.0)


def test_as_much_is_covered_as_smoke_absorbs(tmp_path: Path) -> None:
    pixels = drawn(tmp_path, transparent=True, azimuth=0, elevation=0, value_limits=(0.0, 20.0))
    # A tenth of the densest smoke over the ball's diameter; the box of samples is a little longer than it.
    expected = 1.0 - np.exp(-0.1 * 2.0 / (FREE_PATH * 2.0))
    assert pixels[40, 45, 3] == pytest.approx(expected, rel=0.06)
    assert pixels[0, 0, 3] == 0.0


def test_smoke_is_lit_from_above_left_and_the_rest_is_dark(tmp_path: Path) -> None:
    pixels = drawn(tmp_path)
    np.testing.assert_allclose(pixels[0, 0, :3], BACKGROUND, atol=0.004)
    smoke = pixels[..., 0] > 0.1
    rows, columns = np.nonzero(smoke)
    middle = pixels[..., 0]
    center_row, center_column = int(rows.mean()), int(columns.mean())
    reach = int(0.25 * np.ptp(rows))
    above_left = middle[center_row - reach, center_column - reach]
    below_right = middle[center_row + reach, center_column + reach]
    assert above_left > 0.6
    assert below_right < 0.5 * above_left
    assert below_right > 0.8 * AMBIENT


def test_smoke_can_have_a_color(tmp_path: Path) -> None:
    white, red = drawn(tmp_path), drawn(tmp_path, color="red")
    np.testing.assert_allclose(red[..., 0], white[..., 0], atol=0.01)
    assert red[40, 45, 1] < 0.05


def test_the_same_smoke_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = (gk.render.figure(tmp_path / n, volume=ball(), look="smoke", size=SIZE) for n in ("a.png", "b.png"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"look": "mist"}, "look: 'mist' is not known; use one of 'values', 'smoke'"),
        ({"isovalue": 1.0}, "look: smoke is drawn alone"),
        ({"points": np.zeros((1, 3))}, "look: smoke is drawn alone"),
        ({"volume": None, "points": np.zeros((1, 3))}, "look: smoke is drawn alone"),
        ({"color": "no color"}, "color: 'no color' is not a color"),
        ({"color": np.zeros(3)}, "a volume is drawn in one color"),
        ({"volume": ball(-1.0)}, "no value above 0: there is no smoke"),
        ({"volume": ball(0.0)}, "no active voxels"),
        ({"value_limits": (3.0, 1.0)}, "value_limits: .* is not \\(low, high\\)"),
    ],
)
def test_refusals(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(gk.InputError, match=message):
        drawn(tmp_path, **options)
    assert list(tmp_path.iterdir()) == []
