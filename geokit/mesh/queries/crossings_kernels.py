"""All crossings of rays with a surface: first their number, then the ordered list."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.mesh.bvh.ray_walk_kernels import WALK_CONSTANTS
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False})

# Register limit of a GPU thread; see docs/design/launches-and-memory.md.
REGISTERS = 64


@wp.kernel(cuda_max_registers=REGISTERS)
@cpp.native_item(
    "mesh/queries/crossings.inl", "count_crossings", SurfaceTree, **WALK_CONSTANTS, CROSSINGS=True, UNORDERED=True
)
def count_crossings_kernel(first: int): ...


@wp.kernel(cuda_max_registers=REGISTERS)
@cpp.native_item(
    "mesh/queries/crossings.inl", "list_crossings", SurfaceTree, **WALK_CONSTANTS, CROSSINGS=True, UNORDERED=True
)
def list_crossings_kernel(first: int): ...
