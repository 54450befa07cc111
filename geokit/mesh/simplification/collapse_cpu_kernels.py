"""Edge collapse by quadric errors: vertices are prepared side by side, edges of a part are collapsed by one thread."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.mesh.triangle.closest_kernels import SLIVER_SINE_SQUARED

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Vertices with more faces stay.
MOST = 128
# Weight of a vertex's distance from where it was, beside that from the planes of its faces: where sides are flat it
# alone decides. It moves no corner of them by more than SAME_PLACE.
EVENNESS = 1.0e-8
# Squared share of the edge within which a place is that of an end.
SAME_PLACE = 1.0e-10
# Squared share of the edge that the new vertex may be away from its middle.
FARTHEST = 4.0
# Share of the trace's third power below which a quadric has no place of least error.
SINGULAR = 1.0e-24
# Squared cosine of the largest angle by which a face may turn in one collapse.
FLAT = 0.04
# Points at which a new face is looked at have barycentric weights that are multiples of one divided by this. Each costs
# time; what they miss is found by the proof.
LATTICE = 3
# Squared share of its longest edge that a new face is high at least; lower ones have no area to an audit.
THIN = 1.0e-22
# Squared share of the limit within which a sample keeps its face.
WELL_WITHIN = 0.0625
# How a vertex can have changed since the last trial; numbers in the counts of a part.
WATCHED, SKIPPED, COUNTS = 1, 2, 7


@wp.struct
class Decimation:
    """A mesh that loses edges, and the input that it is compared with, at unit size.

    A removed face has -1 as its first corner. Lists end with -1: corners of a vertex, samples of a face.
    """

    position: wp.array(dtype=wp.vec3d)
    face: wp.array(dtype=int)
    first_corner: wp.array(dtype=int)
    next_corner: wp.array(dtype=int)
    quadric: wp.array(dtype=wp.float64)
    # Vertices that stay: they are not manifold, or already gone.
    locked: wp.array(dtype=int)
    # Vertices that were asked to stay.
    fixed: wp.array(dtype=wp.bool)
    # The edge that each vertex has chosen; -1 for none. Then the one that it last tried in vain; a negative error for
    # none.
    error: wp.array(dtype=wp.float64)
    partner: wp.array(dtype=int)
    tried: wp.array(dtype=wp.float64)
    tried_partner: wp.array(dtype=int)
    # The heap of each part begins at its place; vertices of several parts stay, and are in none.
    heap: wp.array(dtype=int)
    heap_begin: wp.array(dtype=int)
    heap_place: wp.array(dtype=int)
    # Points of the input, each with its face there, in lists of the faces that they are near now.
    sample: wp.array(dtype=wp.vec3d)
    sample_face: wp.array(dtype=int)
    first_sample: wp.array(dtype=int)
    next_sample: wp.array(dtype=int)
    input_position: wp.array(dtype=wp.vec3d)
    input_face: wp.array(dtype=int)
    # Squared limit around each face of the input; empty for none.
    limit: wp.array(dtype=wp.float64)
    # Vertices that went, of each part from where its heap begins; the vertex that each became, and where.
    log: wp.array(dtype=int)
    into: wp.array(dtype=int)
    new_place: wp.array(dtype=wp.vec3d)
    # WATCHED where the limit is less than when the log was written, SKIPPED where a collapse was not repeated.
    changed: wp.array(dtype=int)
    # Of each part: vertices in the heap, faces left, the fewest that are wanted, whether there is more to try; vertices
    # in the log, those that were there before, and how many of these were tried again.
    count: wp.array(dtype=int)


_CONSTANTS = {
    "LATTICE": LATTICE,
    "SLIVER_SINE_SQUARED": SLIVER_SINE_SQUARED,
    "MOST": MOST,
    "EVENNESS": EVENNESS,
    "SAME_PLACE": SAME_PLACE,
    "FARTHEST": FARTHEST,
    "SINGULAR": SINGULAR,
    "FLAT": FLAT,
    "THIN": THIN,
    "WELL_WITHIN": WELL_WITHIN,
    **{"SKIPPED": SKIPPED, "COUNTS": COUNTS},
}


@wp.kernel
@cpp.native_item("mesh/simplification/collapse_cpu.inl", "prepare", **_CONSTANTS)
def prepare_kernel(first: int, out_state: Decimation): ...


@wp.kernel
@cpp.native_item("mesh/simplification/collapse_cpu.inl", "choose", **_CONSTANTS)
def choose_kernel(first: int, out_state: Decimation): ...


@wp.kernel
@cpp.native_item("mesh/simplification/collapse_cpu.inl", "collapse", **_CONSTANTS)
def collapse_kernel(first: int, steps: int, worst: wp.float64, out_state: Decimation):
    """Tries the next ``steps`` edges of each part: those of the log, then those of no larger error than the worst."""
