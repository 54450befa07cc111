"""First crossings along rays on a CPU, through crossing blocks: a thread casts a packet of rays (raycast_cpu.inl)."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.rays.crossing_blocks_kernels import by_voxel
from geokit.volume.rays.raycast_kernels import NUMBERS, SHORTEST_DIRECTION, RayField

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Rays in a packet: 8 are 5% slower, 32 no faster.
PACKET = wp.constant(16)
# If a cubic's coefficients add up to less, no value or slope of it on [0, 1] overflows.
LARGEST_SUM = 1e300


# An item is a packet of rays. Of one that is not usable the host then refuses the whole batch and names its row.
@wp.kernel
@cpp.native_item(
    "volume/rays/raycast_cpu.inl",
    "first_crossings",
    G=int(PACKET),
    LARGEST_SUM=LARGEST_SUM,
    SHORTEST_DIRECTION=float(SHORTEST_DIRECTION),
    **NUMBERS,
)
def raycast_packets_kernel(first: int, field: RayField, below: Any, above: Any): ...


RAYCAST_PACKETS = by_voxel(raycast_packets_kernel)
