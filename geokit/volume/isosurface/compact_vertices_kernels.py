"""Removes the vertices of an isosurface that no face uses."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def mark_used_kernel(first: int, faces: wp.array(dtype=int), out_used: wp.array(dtype=int)):
    """Sets 1 at each vertex that a face uses; the array must be zero before."""
    out_used[faces[first + wp.tid()]] = 1


@wp.kernel
def keep_used_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    used: wp.array(dtype=int),
    place: wp.array(dtype=int),
    out_vertices: wp.array(dtype=wp.vec3d),
):
    """Moves each used vertex to its place, which is the number of used vertices before it."""
    vertex = first + wp.tid()
    if used[vertex] != 0:
        out_vertices[place[vertex]] = vertices[vertex]
