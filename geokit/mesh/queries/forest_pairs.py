"""Which of many meshes have triangles that intersect each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.struct_array import Parts, struct_array, struct_table
from geokit.mesh.bvh.forest import NODE_GRAIN, WIDTH, Forest

__all__ = ["self_intersecting"]


def self_intersecting(forest: Forest, meshes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of some meshes have self-intersections, as :meth:`geokit.mesh.Surface.self_intersections` lists them."""
    import warp as wp

    from geokit.mesh.bvh.forest_cpu_kernels import ForestBoxes, forest_slot_boxes_kernel
    from geokit.mesh.queries.forest_pairs_cpu_kernels import forest_pairs_kernel

    device, count, slots = forest.device, len(forest.scales), int(forest.slots[-1])
    boxes: Any = wp.empty(6 * slots, dtype=wp.float32, device=device)
    found: Any = wp.zeros(count, dtype=wp.int32, device=device)
    table = struct_table(
        ForestBoxes,
        count,
        tree=forest.table,
        slot_boxes=forest.of_slots(boxes, 6),
        found=Parts(found, np.arange(count), np.ones(count)),
        unit=2.0 ** -np.round(np.log2(forest.scales)),
    )
    searches = struct_array(table, ForestBoxes, device)
    launcher.launch(forest_slot_boxes_kernel, slots, [forest.slot_offsets], [searches], device)
    leaves = np.diff(forest.slots)[meshes] // WIDTH
    owner = np.repeat(meshes, leaves)
    leaf = np.arange(len(owner)) - np.repeat(np.cumsum(leaves) - leaves, leaves)
    items = [HostArray(values.astype(np.int32)) for values in (owner, leaf)]
    launcher.launch(forest_pairs_kernel, len(owner), items, [searches], device, grain=NODE_GRAIN)
    return np.asarray(found.numpy()[meshes] != 0)
