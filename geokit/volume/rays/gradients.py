"""Derivatives of transmittances and emissions with respect to rays and to the active values of both grids.

A second walk along the ray has them in closed form: see integrate_slopes.inl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.gradients.library import Library
from geokit.core.gradients.rules import Asked, Deferred, Rule, held_by, untracked
from geokit.core.interop import user_arrays
from geokit.core.interop.arrays import reinterpreted
from geokit.core.memory.pinned import host_flags
from geokit.volume.rays.ray_field import ray_field
from geokit.volume.tree.leaves import value_places

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume


class _Walk:
    """The rays of a call and its grids, as kernels take them."""

    def __init__(self, asked: Asked, origins: Any, directions: Any) -> None:
        """``origins`` and ``directions`` are constant rays of any container, in float64."""
        arguments = asked.arguments
        self.device = launcher.resolve_device(arguments["device"])
        rows = [origins, directions]
        self.rays, self.heading = user_arrays.read_rows(rows, ["origins", "directions"], self.device, defer=True)
        volume = _known(arguments["volume"])
        self.emits = arguments["emission"] is not None
        # Without emission nothing is read of the second grid.
        emission = _known(arguments["emission"]) if self.emits else volume
        self.wanted = {"values": volume, "emission.values": emission}
        self.wanted = {name: grid for name, grid in self.wanted.items() if name in asked.tensors}
        self.field = ray_field(volume, self.device, emission)
        self.limits = [wp.float64(float(arguments[name])) for name in ("t_min", "max_distance", "extinction")]
        self.emission = wp.uint64(emission.id(self.device))

    def answer(self) -> tuple[Any, Any]:
        """Transmittance and emission in float64."""
        from geokit.volume.rays.integrate_kernels import DEPTH, emission_kernel

        found = [user_arrays.empty(len(self.rays), wp.float64, self.rays.rows) for _ in range(2)]
        kernel: Any = emission_kernel if self.emits else DEPTH[wp.float64]
        second = self.emission if self.emits else wp.float64(0.0)
        inputs = [self.rays.rows, self.heading.rows, self.field, second, *self.limits]
        launcher.launch(kernel, len(self.rays), inputs, [*found, host_flags(1, self.device)], self.device)
        return self.rays.to_caller(found[0]), self.rays.to_caller(found[1])

    def derivatives(self, slopes: Any) -> dict[str, Any]:
        """Derivatives by name in the container of the rays; a row of ``slopes`` is that of ray_slopes_kernel."""
        from geokit.volume.rays import integrate_slopes_kernels as kernels

        device, rows = self.device, self.rays.rows
        light = user_arrays.read_vectors(slopes, "slopes", device, defer=True).rows
        found = {name: user_arrays.empty(len(rows), wp.vec3d, rows) for name in ("origins", "directions")}
        sums = {name: _Sums(grid, rows, device) for name, grid in self.wanted.items()}
        nothing = _Sums(None, rows, device)
        both = [sums.get(name, nothing) for name in ("values", "emission.values")]
        for begin in range(0, len(rows), kernels.RAYS_AT_ONCE):
            part = slice(begin, min(begin + kernels.RAYS_AT_ONCE, len(rows)))
            given = [rows[part], self.heading.rows[part], light[part]]
            inputs: list[Any] = [*given, self.field, self.emission, *self.limits]
            count = len(given[0])
            for one in sums.values():
                one.clear()
            length: Any = wp.empty(count, dtype=wp.vec2d, device=device)
            outputs = [found["origins"][part], found["directions"][part], length, *(one.least for one in both)]
            launcher.launch(kernels.ray_slopes_kernel, count, inputs, outputs, device)
            if sums:
                inputs += [one.reciprocals for one in both]
                launcher.launch(kernels.add_slopes_kernel, count, inputs, [one.sums for one in both], device)
            for one in sums.values():
                one.collect()
        result = {name: self.rays.to_caller(array) for name, array in found.items()}
        give: Any = self.rays.to_lists
        return result | {name: give(one.total) for name, one in sums.items()}


class _Sums:
    """Sums of the shares of a grid's values, with an entry for each value of its buffer; see collect_kernel."""

    def __init__(self, grid: SparseVolume | None, like: Any, device: "wp.Device") -> None:
        count = 0
        if grid is not None:
            places, size = value_places(grid), 4 if grid.info.grid_type == "float" else 8
            count = grid.nanovdb.nbytes // size
            self.places: Any = wp.array(places, dtype=wp.int64, device=device)
            self.total = user_arrays.full(len(places), 0.0, wp.float64, like)
        self.device = device
        self.least: Any = wp.empty(count, dtype=wp.int64, device=device)
        self.reciprocals = (
            reinterpreted(self.least, wp.float64, (count,)) if count else wp.empty(0, dtype=wp.float64, device=device)
        )
        self.sums: Any = wp.empty(count, dtype=wp.int64, device=device)

    def clear(self) -> None:
        """Before a part of the rays."""
        from geokit.volume.rays.integrate_slopes_kernels import LARGEST_RECIPROCAL_BITS

        self.least.fill_(LARGEST_RECIPROCAL_BITS)
        self.sums.zero_()

    def collect(self) -> None:
        """Add the sums of a part of the rays to the totals."""
        from geokit.volume.rays.integrate_slopes_kernels import collect_kernel

        inputs = [self.places, self.sums, self.reciprocals]
        launcher.launch(collect_kernel, len(self.places), inputs, [self.total], self.device)


def _known(holder: Any) -> SparseVolume:
    """The volume of an argument; one of jax arrays is made of its values."""
    held = held_by(holder)
    if isinstance(holder, Deferred):
        made: SparseVolume = holder.made(**{name: np.asarray(value) for name, value in held.items()})
        return made
    plain: SparseVolume = untracked(holder)
    return plain


def _pull(library: Library, asked: Asked, answer: Any, slopes: Any) -> dict[str, Any]:
    origins, directions = (library.wide(library.detach(asked.tensors[name])) for name in ("origins", "directions"))
    message = "origins: second derivatives of integrals along rays are not known; take the gradient once"
    walk = _Walk(asked, origins, directions)
    # Of float32 rays the answer was rounded.
    rounded = "float64" not in str(answer[0].dtype)
    transmittance, emission = walk.answer() if rounded else answer
    by_transmittance, by_emission = (library.wide(library.detach(slope)) for slope in slopes)
    rows = [by_transmittance * transmittance, by_emission * float(walk.emits), emission]
    found = walk.derivatives(library.stack(rows, -1))
    # Second derivatives also depend on the slopes.
    tensors = {**asked.tensors, "transmittance": slopes[0], "emission": slopes[1]}
    return {name: library.once(part, message, tensors) for name, part in found.items()}


def _shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
    return [((asked.tensors["origins"].shape[0],), "float")] * 2


INTEGRATE = Rule((True, True), pull=_pull, is_traced=False, shapes=_shapes)
