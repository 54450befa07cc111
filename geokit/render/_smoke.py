"""Fog as smoke: white, lit from one side, with its own shadow, in front of the dark."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import InputError
from geokit.render._grid import dense_field
from geokit.volume._dense import from_dense
from geokit.volume._integrate import integrate

if TYPE_CHECKING:
    from geokit.render._camera import Camera
    from geokit.volume.model.sparse_volume import SparseVolume

BACKGROUND = (0.07, 0.08, 0.1)
# Where the light is, seen from the camera: left, above, and on the camera's side of the scene.
LIGHT = (-0.6, 0.7, 0.4)
# Mean free path in the densest smoke [longest side of the box].
FREE_PATH = 0.03
# Share of the extinction that the light meets: most of what is scattered goes on forward.
SHADOW = 0.25
# Share of the light that comes from everywhere.
AMBIENT = 0.12
# Samples along the longest side, and rays at a time.
RESOLUTION, RAYS = 192, 1 << 20


def draw_smoke(
    volume: "SparseVolume",
    camera: "Camera",
    size: tuple[int, int],
    *,
    limits: tuple[float, float] | None,
    color: str | None,
    transparent: bool,
) -> NDArray[np.float64]:
    """Pixels (H, W, 4) of a fog volume, with its light scattered once.

    Args:
        volume: A grid whose values are densities, vectors by their length.
        camera: Where it is seen from.
        size: Width and height in pixels.
        limits: Values of no smoke and of the densest; None is 0 and the 99th percentile of the positive ones.
        color: Of the smoke in full light; None is white.
        transparent: Leave the background out.
    Raises:
        InputError: There is no smoke, or no such color.
    """
    tint = _rgb(color)
    field = dense_field(volume, resolution=RESOLUTION)
    thick = field.values[field.values > 0.0]
    low, high = limits or (0.0, float(np.quantile(thick, 0.99)) if thick.size else 0.0)
    if not (field.values > low).any():
        raise InputError(f"volume: grid {volume.info.name!r} has no value above {low:g}: there is no smoke to draw")
    density = np.clip((field.values - low) / (high - low), 0.0, None)
    extinction = 1.0 / (FREE_PATH * float(np.max(np.multiply(field.spacing, density.shape))))
    step = float(field.spacing[0])
    light = AMBIENT + (1.0 - AMBIENT) * _light(SHADOW * extinction * step * density, np.array(LIGHT) @ camera.frame)
    transform = np.diag([*field.spacing, 1.0])
    transform[:3, 3] = field.origin
    smoke, lit = (from_dense(values, transform=transform) for values in (density, extinction * density * light))

    width, height = size
    x = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * camera.tangent * width / height
    y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * camera.tangent
    pixels = np.empty((height, width, 4))
    rows = max(1, RAYS // width)
    for at in range(0, height, rows):
        across, up = np.meshgrid(x, y[at : at + rows])
        rays = np.stack([across, up, -np.ones_like(up)], axis=-1).reshape(-1, 3) @ camera.frame
        seen = integrate(smoke, np.broadcast_to(camera.position, rays.shape), rays, extinction=extinction, emission=lit)
        through, scattered = (values.reshape(up.shape)[..., None] for values in seen)
        covered = 1.0 - through
        if transparent:
            part = np.divide(scattered, covered, out=np.zeros_like(scattered), where=covered > 0.0) * tint
        else:
            part, covered = through * BACKGROUND + scattered * tint, np.ones_like(covered)
        pixels[at : at + rows] = np.concatenate([part, covered], axis=2)
    return np.clip(pixels, 0.0, 1.0)


def _rgb(color: str | None) -> NDArray[np.float64]:
    to_rgb = require_package("matplotlib.colors").to_rgb
    try:
        return np.array(to_rgb(color or "white"))
    except ValueError as error:
        raise InputError(f"color: {color!r} is not a color; use a name such as 'steelblue' or '#336699'") from error


def _light(depth: NDArray[np.float64], towards: NDArray[Any]) -> NDArray[np.float64]:
    """Share of the light that reaches each sample: slice by slice, away from the light.

    Args:
        depth: Optical depth of a step between samples, shape (nx, ny, nz).
        towards: Direction to the light, of any length.
    """
    main = int(np.argmax(np.abs(towards)))
    forward = towards[main] < 0.0
    # Slices in the order in which the light meets them; each looks back along the ray to the one before.
    slices = np.moveaxis(depth, main, 0)[:: 1 if forward else -1]
    shift = np.delete(towards, main) / abs(towards[main])
    step = float(np.sqrt(1.0 + shift @ shift))
    light = np.empty(slices.shape)
    passed = np.ones(slices.shape[1:])
    for place, own in enumerate(slices):
        for axis, share in enumerate(shift):
            passed = (1.0 - abs(share)) * passed + abs(share) * _neighbor(passed, axis, share > 0.0)
        light[place] = passed
        passed = passed * np.exp(-step * own)
    return np.moveaxis(light[:: 1 if forward else -1], 0, main)


def _neighbor(plane: NDArray[np.float64], axis: int, ahead: bool) -> NDArray[np.float64]:
    """Each sample's neighbor along an axis; beyond the border is full light."""
    moved = np.ones_like(plane)
    before, after = ([slice(None)] * 2 for _ in range(2))
    before[axis], after[axis] = slice(None, -1), slice(1, None)
    here, there = (before, after) if ahead else (after, before)
    moved[tuple(here)] = plane[tuple(there)]
    return moved
