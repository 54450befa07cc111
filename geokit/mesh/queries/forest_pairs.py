"""Which of many meshes have triangles that intersect each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.memory.host_array import HostArray
from geokit.core.memory.struct_array import Parts, struct_array, struct_table
from geokit.mesh.bvh.forest import WIDTH, Forest
from geokit.mesh.bvh.winding_moments import NODE_GRAIN

__all__ = ["self_intersecting"]


def self_intersecting(forest: Forest, meshes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of some meshes have self-intersections, as :meth:`geokit.mesh.Surface.self_intersections` lists them."""
    import warp as wp

    from geokit.mesh.queries import forest_pairs_cpu_kernels as kernels

    device, count, slots = forest.device, len(forest.scales), int(forest.slots[-1])
    boxes: Any = wp.empty(6 * slots, dtype=wp.float32, device=device)
    found: Any = wp.zeros(count, dtype=wp.int32, device=device)
    table = struct_table(
        kernels.ForestBoxes,
        count,
        tree=forest.table,
        slot_boxes=Parts.between(boxes, forest.slots, 6),
        found=Parts.between(found, np.arange(count + 1)),
        unit=2.0 ** -np.round(np.log2(forest.scales)),
    )
    searches = struct_array(table, kernels.ForestBoxes, device)
    begin = HostArray(forest.slots.astype(np.int32))
    launcher.launch(kernels.forest_slot_boxes_kernel, slots, [begin], [searches], device)
    leaves = np.diff(forest.slots)[meshes] // WIDTH
    owner = np.repeat(meshes, leaves)
    leaf = np.arange(len(owner)) - np.repeat(np.cumsum(leaves) - leaves, leaves)
    items = [HostArray(values.astype(np.int32)) for values in (owner, leaf)]
    launcher.launch(kernels.forest_pairs_kernel, len(owner), items, [searches], device, grain=NODE_GRAIN)
    return np.asarray(found.numpy()[meshes] != 0)
