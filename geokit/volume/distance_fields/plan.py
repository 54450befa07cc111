"""Prediction of the settings and the cost of a distance field with a tolerance, before it is made."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

from geokit.core.blocks.chunked_queries import Progress
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.types import Device, MeshLike
from geokit.core.memory.needs import needs
from geokit.core.require import require_callable
from geokit.volume.adaptive.choice import WORTH_LEVELS, fewer_bytes
from geokit.volume.adaptive.refine import Refinement
from geokit.volume.adaptive.storage import ACCEPTED_SHARE
from geokit.volume.distance_fields.adaptive import MOST_LEVELS
from geokit.volume.tolerance.checked_fields import made_within
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.interpolation_errors import REACH
from geokit.volume.tolerance.search import Search, Setting, quickest

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Leaves of the small band that is built to measure the time.
TIMED_LEAVES = 2000.0
# Of the time of a plan, about the part before several voxel sizes are tried.
SEARCH_SHARE = 0.7
# A field of at most this many leaves is built and checked, as in from_mesh: that takes a second or two.
CHECKED_LEAVES = 20_000.0


class PlannedField(NamedTuple):
    """A field that keeps a tolerance, with its predicted cost.

    Attributes:
        order: Order of interpolation, 1, 2 or 3.
        codec: Codec of the values; if levels differ, those of all levels, such as "fp16+fp8".
        voxel_size: Edge length of a voxel [world], of level 0 if there are several.
        half_width: Width of the band on either side of the surface [voxels], of level 0 if there are several.
        error: Predicted largest error of the interpolated distance [world].
        byte_count: Predicted size of all grids in bytes.
        seconds: Predicted time to build it [s], without the search.
        method: The function that makes it, "from_mesh" or "adaptive_from_mesh".
        level_count: Number of voxel sizes.
        codec_tolerance: How far the codec may change a voxel [world]; None where its bits alone decide.
    """

    order: int
    codec: str
    voxel_size: float
    half_width: float
    error: float
    byte_count: int
    seconds: float
    method: str = "from_mesh"
    level_count: int = 1
    codec_tolerance: float | None = None


@of_constants
@needs()
def plan(
    mesh: MeshLike | Surface,
    tolerance: float,
    *,
    within: float | None = None,
    order: int | None = None,
    half_width: float | None = None,
    sign: str = "auto",
    thickness: float | None = None,
    interior: str = "remove",
    codec: str | None = None,
    device: Device = None,
    progress: Progress | None = None,
) -> list[PlannedField]:
    """List fields with which a mesh's distances keep a tolerance, and what each of them costs.

    Of :func:`from_mesh` there is one setting for each order and codec that can compete; all others need more memory
    than the best, whatever their other settings. The first of them is what ``from_mesh`` tries first. If it has no more
    than 20,000 leaves, it is built and checked. Otherwise it is predicted like the others, and a check may still lead
    ``from_mesh`` to another one near it. The memory is to a quarter that of the grid with a row's own numbers, as the
    example makes it: ``compact``, and with the tolerance of the codec if it has one. The other rows are not searched as
    finely as the first: ``from_mesh(mesh, tolerance=, order=, codec=)`` of such a row may end with less than half of
    its memory. The time is extrapolated from a small band of the same mesh by the number of leaves.

    One more row has the method "adaptive_from_mesh": several voxel sizes if they promise at most 0.95 of the bytes of
    one, else the field of one, which ``adaptive_from_mesh`` then makes as well. So where its ``level_count`` is 1, one
    voxel size is the smaller. Its memory is exact up to the cells that the checks of the made field refine. There is no
    such row with ``thickness``, ``half_width`` or sign "none". No error is above the tolerance.

    Args:
        mesh: Triangles, or a Surface of them.
        tolerance: Largest error of the interpolated distance [world].
        within: Distance from the surface up to which the tolerance holds [world]; None as for :func:`from_mesh`.
        order: Order of interpolation; None for all.
        half_width: Width of the band [voxels]; None for as little as interpolation needs.
        sign: Method that tells inside from outside, as for :func:`from_mesh`.
        thickness: Thickness [world] of a solid shell around the surface.
        interior: What happens to surface inside of solids, as for :func:`from_mesh`.
        codec: Codec of the values; None for all.
        device: Where to compute.
        progress: Called as ``progress(percent, 100)``, with an estimate of the end.
    Returns:
        The fields, least memory first; of equal memory (to 5 %) the fastest to read.
    Raises:
        InputError: An argument is out of range, or no setting keeps the tolerance; the message names one that can be
            kept.
        DeviceMemoryError: No setting that keeps the tolerance fits into memory.
    Example:
        >>> torus = gk.mesh.load("data/samples/torus.ply")
        >>> best = gk.volume.plan(torus, 0.01, device="cpu")[0]
        >>> best.method, best.error <= 0.01, best.byte_count < 1_000_000
        ('from_mesh', True, True)
        >>> field = gk.volume.from_mesh(torus, best.voxel_size, half_width=best.half_width, compact=True, device="cpu")
        >>> field = gk.volume.quantize(field, best.codec, tolerance=best.codec_tolerance)
        >>> field.info.byte_count == best.byte_count
        True
    """
    search = tolerance_search(
        mesh,
        tolerance,
        within=within,
        order=order,
        half_width=half_width,
        sign=sign,
        thickness=thickness,
        interior=interior,
        codec=codec,
        device=device,
    )
    if progress is not None:
        require_callable(progress, "progress")
        search.progress = lambda percent, _: progress(int(SEARCH_SHARE * percent), 100)
    made = made_within(search, lambda s: make_setting(search, s), most_leaves=CHECKED_LEAVES)
    settings = _best_of_each(search)
    if made.achieved is not None:
        settings[0] = made.setting._replace(error=made.achieved.largest)
    per_leaf: dict[str, float] = {}
    planned = []
    if progress:
        progress(int(100 * SEARCH_SHARE), 100)
    for setting in settings:
        kind = setting.option.codec
        if kind not in per_leaf:
            per_leaf[kind] = _seconds_per_leaf(search, setting)
        planned.append(
            PlannedField(
                setting.option.order,
                kind,
                setting.voxel_size,
                setting.half_width,
                setting.error,
                round(setting.byte_count),
                per_leaf[kind] * setting.counts.leaves,
                codec_tolerance=setting.option.share * search.tolerance or None,
            )
        )
    if made.volume is not None:
        planned[0] = planned[0]._replace(byte_count=made.volume.info.byte_count)
    if thickness is not None or half_width is not None or search.sign_method == "none":
        return planned
    levels = fewer_bytes(search, MOST_LEVELS, WORTH_LEVELS * planned[0].byte_count)
    if levels.tree is None:
        return [planned[0], planned[0]._replace(method="adaptive_from_mesh"), *planned[1:]]
    leaves = levels.byte_count / levels.tree.storage.leaf_bytes(levels.tree.lattice.size)
    return [_adaptive(levels.tree, levels.byte_count, max(per_leaf.values()) * leaves), *planned]


def _adaptive(tree: Refinement, byte_count: float, seconds: float) -> PlannedField:
    storage, size = tree.storage, tree.lattice.size
    codecs = [storage.codec_of(tree.lattice_of(level).size) for level in range(tree.level_count)]
    return PlannedField(
        storage.order,
        codecs[0] if len(set(codecs)) == 1 else "+".join(codecs),
        size,
        REACH[storage.order] + storage.within / size,
        ACCEPTED_SHARE * storage.tolerance,
        round(byte_count),
        seconds,
        "adaptive_from_mesh",
        tree.level_count,
    )


def _best_of_each(search: Search) -> list[Setting]:
    """The best of each group of settings that differ only in the codec's share of the tolerance."""
    found: dict[tuple[int, str], Setting] = {}
    for setting in quickest(search.settings()):
        found.setdefault((setting.option.order, setting.option.codec), setting)
    return list(found.values())


def _seconds_per_leaf(search: Search, setting: Setting) -> float:
    """Time per leaf of a band like this one, measured on a small one; the first call also loads the kernels."""
    coarser = max(1.0, setting.counts.leaves / TIMED_LEAVES) ** 0.5
    small = setting._replace(voxel_size=setting.voxel_size * coarser)
    for _ in range(2):
        start = time.perf_counter()
        volume = make_setting(search, small)
        seconds = time.perf_counter() - start
    leaves = search.memory.counts(small.voxel_size, small.half_width * small.voxel_size).leaves
    return seconds / leaves if volume.info.active_voxel_count else 0.0
