"""A triangle mesh prepared for queries: frame, bounding volume hierarchy and sign."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.blocks.several_devices import OnDevices, replicas, shows_arguments
from geokit.core.frame import Frame
from geokit.core.gradients.rules import hold, split
from geokit.core.interop.notebook import repr_html
from geokit.core.interop.types import Devices, MeshLike
from geokit.core.memory import available_memory
from geokit.core.memory.needs import needs
from geokit.core.memory.struct_array import handed_out
from geokit.core.memory.unchecked import allocating
from geokit.core.require import read_array
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh.attributes.derived import derived
from geokit.mesh.contacts.motion import MotionQueries
from geokit.mesh.model.device_mesh import arrays_on
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.queries.rays import RayQueries
from geokit.mesh.sign.queries import FAR
from geokit.mesh.surfaces.objects import require_mesh
from geokit.mesh.topology.size_limits import require_measurable

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from geokit.mesh.surfaces.user_kernels import Surface as InKernels
    from geokit.mesh.topology.audit import MeshAudit

# Memory for building a surface, for each triangle of a closed mesh; and for a warp Mesh of it on a GPU.
BYTES_PER_FACE = 190
BYTES_PER_FACE_CUDA = 240
WARP_BYTES_PER_FACE = 400
# Triangles whose leaves a GPU holds: an array of warp has at most 2^31 - 1 rows, and a triangle takes 20.
MOST_FACES_CUDA = (2**31 - 1) // 20
# Triangles in a leaf of the warp Mesh. On a CPU a leaf of eight is one contiguous read; on a GPU one triangle per
# thread diverges least.
LEAF_SIZE_CPU = 8
LEAF_SIZE_CUDA = 1


@shows_arguments
class Surface(MotionQueries, RayQueries):
    """A mesh prepared once for many queries on one device.

    A pickle or a copy carries the mesh and prepares it again, on the same device if there is one of that name.

    On a CPU queries walk a tree with eight children per node; on a GPU with two. On either device the answers
    are those of float64 triangles.

    Arrays of a mesh that was made on the same GPU are used in place. Of faces that lie back to back on a closed
    component, one counts for signs and winding numbers (:meth:`signed_distance`); all other queries take both.

    Args:
        mesh: The triangles; at least one. Of a pair (vertices, faces), vertices that are a torch tensor with gradients
            are kept as such, as by :class:`geokit.torch.Surface`; so is an array of warp that requires gradients, for
            a ``wp.Tape``.
        device: "cpu", "cuda:0", a device of warp, torch, JAX or CuPy, or None for the first GPU, else the CPU. A list
            of devices, or ``"cuda:*"`` for all GPUs, has the mesh on each: they share queries of points and rays of
            65,536 rows or more (in arrays on a GPU 2 million points, 8 million rays), and the first does all else.
    Attributes:
        mesh: The triangles.
        bounds: Bounding box of the vertices that faces use [world], shape (2, 3).
    Raises:
        InputError: The mesh has no faces, more than 107 million on a GPU, or there is no such device.
        DeviceMemoryError: The device cannot hold the mesh.
    """

    # Holds recordings of small queries.
    _cache = CacheAttribute()

    def __new__(cls, *_: Any, device: Devices = None, **__: Any) -> Surface:
        shared = cls is Surface and launcher.is_several(device)
        return object.__new__(_SurfaceOnDevices if shared else cls)

    @needs(lambda self, mesh, **_: BYTES_PER_FACE * mesh.face_count)
    def __init__(self, mesh: MeshLike, *, device: Devices = None) -> None:
        # Of a pair (vertices, faces) whose vertices are a tensor, or an array of warp, with gradients.
        given: Any = mesh
        tracked = None
        if isinstance(given, tuple) and len(given) == 2:
            plain, tracked = split(given[0])
            given = plain, given[1]
        mesh = require_mesh(given, "mesh", images=False)
        if mesh.face_count == 0:
            raise InputError(f"mesh: {mesh.name or 'it'} has no faces; queries need at least one triangle")
        self._device = launcher.resolve_device(device)
        _require_numbered(mesh.face_count, self._device)
        self._set_mesh(mesh)
        size = (BYTES_PER_FACE if self._device.is_cpu else BYTES_PER_FACE_CUDA) * mesh.face_count
        try:
            # Sums and sorts of warp do not check what they allocate.
            if self._device.is_cuda and size > available_memory.available(self._device):
                raise MemoryError("to allocate")
            self._upload()
            if self._device.is_cpu:
                self._build_wide_tree()
            else:
                self._build_binary_tree()
        except (RuntimeError, MemoryError) as error:
            if "allocat" not in str(error).lower():
                raise
            raise DeviceMemoryError(
                f"mesh: {mesh.face_count} faces need about {size >> 20} MiB on {self.device}; "
                "free some there or use another device",
                need=size,
            ) from error
        if tracked is not None:
            hold(self, vertices=tracked)

    def _set_mesh(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self.bounds = mesh.bounds
        self._frame = Frame.around(*self.bounds)

    def _upload(self) -> None:
        self._vertices, self._faces = arrays_on(self.mesh, self._device)

    def _build_wide_tree(self) -> None:
        from geokit.mesh.bvh.bvh8 import build_wide_trees
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        begin = np.array([0, self.mesh.face_count])
        built = build_wide_trees(self._vertices, self._faces, begin, *self._frames)
        self._tree = SurfaceTree()
        self._tree.boxes, self._tree.children, self._tree.slot_triangle = built[:3]
        self._place_blocks()

    def _refit_wide_tree(self) -> None:
        from geokit.mesh.bvh.bvh8 import refit_wide_tree
        from geokit.mesh.bvh.tree_kernels import SurfaceTree

        former, self._tree = self._tree, SurfaceTree()
        self._tree.slot_triangle, self._tree.children = former.slot_triangle, former.children
        self._tree.boxes = wp.clone(former.boxes)
        self._place_blocks()
        refit_wide_tree(self._tree, self._frame)

    def _build_binary_tree(self) -> None:
        from geokit.mesh.bvh.bvh2 import build_binary_tree

        self._tree = build_binary_tree(self._vertices, self._faces, self._frame)

    @property
    def _frames(self) -> tuple[np.ndarray, np.ndarray]:
        """The local frame as one of many: origins (1, 3) and scales (1,)."""
        return np.asarray(self._frame.origin)[None], np.array([self._frame.scale])

    def _place_blocks(self) -> None:
        """Store the frame, and the triangles in slot order: world corners in float64, and planes in float32."""
        from geokit.mesh.bvh.bvh8 import place_triangles

        tree = self._tree
        tree.origin = wp.vec3d(*map(float, self._frame.origin))
        tree.scale = wp.float64(self._frame.scale)
        slots, mesh = np.array([0, len(tree.slot_triangle)]), (self._vertices, self._faces)
        tree.corners, tree.leaves = place_triangles(tree.slot_triangle, slots, *mesh, *self._frames)

    @classmethod
    def _over(cls, mesh: TriangleMesh, device: Any, tree: Any) -> Surface:
        """The surface of a mesh whose tree exists."""
        surface = cls.__new__(cls)
        surface._device, surface._tree = device, tree
        surface._set_mesh(mesh)
        surface._upload()
        return surface

    @staticmethod
    def _of(mesh: TriangleMesh, *, device: Any) -> Surface:
        """A surface of another mesh; classes derived from this one may be made of something else than a mesh."""
        return Surface(mesh, device=device)

    @property
    def _warp_mesh(self) -> "wp.Mesh":
        """The mesh in local coordinates for warp's own queries, built when it is asked for.

        A handle does not keep its mesh alive, so the surface must; threads that come together keep the same one.
        """
        kept = self.__dict__
        return kept.get("_made_warp_mesh") or kept.setdefault("_made_warp_mesh", self._make_warp_mesh(self._faces))

    def _make_warp_mesh(self, faces: "wp.array") -> "wp.Mesh":
        from geokit.core.frame_kernels import local_kernel

        # Vertices that no face uses may lie anywhere: in the frame of the faces they could overflow float32.
        local = wp.empty(len(self._vertices), dtype=wp.vec3, device=self._device)
        corners = [wp.vec3d(*corner.tolist()) for corner in (*self.bounds, self._frame.origin)]
        inputs = [self._vertices, *corners, wp.float64(self._frame.scale)]
        launcher.launch(local_kernel, len(local), inputs, [local], self._device)
        with allocating(self._device, WARP_BYTES_PER_FACE * (len(faces) // 3), fatal=True):
            return wp.Mesh(
                points=local,
                indices=faces,
                support_winding_number=True,
                bvh_leaf_size=LEAF_SIZE_CPU if self._device.is_cpu else LEAF_SIZE_CUDA,
            )

    @needs(lambda self, *_, **__: BYTES_PER_FACE * self.mesh.face_count)
    def update(self, vertices: ArrayLike) -> None:
        """Move the vertices and refit the tree, which takes a fraction of the time of building it.

        Attributes of the mesh stay as they are, also its normals.

        Afterwards answers equal those of a new Surface to the last bit, except for winding numbers: their clusters
        depend on the tree, and they stay within the error bound of :meth:`winding_number`. The tree of a new Surface
        fits the new shape and may be faster; build one after large deformations.

        Queries that run in other threads meanwhile answer for the vertices that the surface had when they began.

        Args:
            vertices: New vertex positions [world], shape (V, 3), with the same number of vertices V.
        Raises:
            InputError: The number of vertices differs, or a row is not finite; the surface is unchanged then.
        Example:
            >>> triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
            >>> surface = gk.mesh.Surface(triangle, device="cpu")
            >>> surface.update(triangle.vertices + [0, 0, 5])
            >>> surface.closest_point([[0.25, 0.25, 7.0]]).distance
            array([2.])
        """
        vertices, tracked = split(vertices)
        vertices, expected = read_array(vertices, "vertices"), self.mesh.vertex_count
        if vertices.ndim == 2 and len(vertices) != expected:
            raise InputError(
                f"vertices: {len(vertices)} rows for a mesh of {expected} vertices; make a new Surface for another mesh"
            )
        moving = TriangleMesh(vertices, self.mesh.faces)
        mesh = derived(self.mesh, moving.vertices, moving.faces)
        cached = [*self._cached_names(), "_cache", "_made_warp_mesh", "_turned_mesh"]
        moved = Surface.__new__(type(self))
        moved.__dict__.update((name, value) for name, value in self.__dict__.items() if name not in cached)
        moved._set_mesh(mesh)
        moved._upload()
        if moved._device.is_cpu:
            moved._refit_wide_tree()
        else:
            # On a GPU a new build takes little longer than a refit.
            moved._build_binary_tree()
        hold(moved, **({} if tracked is None else {"vertices": tracked}))
        self.__dict__ = moved.__dict__  # at once: see snapshot

    def __reduce__(self) -> Any:
        # Trees hold addresses: the surface is prepared again where it arrives.
        return _restored, (self.mesh, self.device)

    @classmethod
    def _cached_names(cls) -> list[str]:
        """Names of the cached properties, all of which are derived from the vertices."""
        return [
            name for base in cls.__mro__ for name, value in vars(base).items() if isinstance(value, cached_property)
        ]

    @property
    def device(self) -> str:
        """Alias of the surface's device: "cpu", "cuda:0", ..."""
        return self._device.alias

    @property
    def id(self) -> int:
        """Handle of the warp ``Mesh`` for the user's own kernels: pass it as ``wp.uint64`` to warp's ``mesh_query_*``.

        This mesh is in local coordinates: ``(world - origin) / scale``. It is built at the first access.
        :meth:`update` replaces it, so that the handle changes.
        """
        return int(self._warp_mesh.id)

    @needs(lambda self, *_, **__: 325 * self.mesh.face_count)
    def on_kernel(self, sign: str | None = "auto") -> InKernels:
        """The surface for the user's own kernels, which call :mod:`geokit.kernels` on it: exact, with the calls' bits.

        Unlike :attr:`id` it keeps what it refers to alive, and shows the surface as it is now: ask again after
        :meth:`update`. It is one of ``device``.

        Args:
            sign: How signs are decided, as in :meth:`signed_distance`; "parity" is not for kernels. None prepares no
                signs, which saves time and memory.
        Returns:
            A ``geokit.kernels.Surface``, for a parameter of that type.
        Raises:
            InputError: There is no such sign, or the mesh is smaller than 1e-70 or larger than 1e70.
        """
        from geokit.mesh.queries.gradients import sloped_faces
        from geokit.mesh.surfaces import user_kernels as kernels

        require_measurable(self.mesh, self._frame)
        found: Any = kernels.Surface()
        found.tree, found.faces = self._any_hit_tree, sloped_faces(self, sign is not None)
        if sign is not None:
            method, judge = self._method(sign), self._signs
            if method == "parity":
                raise InputError("sign: 'parity' casts rays through the whole mesh; use 'winding' in kernels")
            found.is_trimmed, found.sign = judge is not self, kernels.BY_WINDING
            found.judge, found.winding, found.empty = judge._winding_arguments_of_all()
            if method == "pseudonormal":
                found.sign, found.pseudonormals = kernels.BY_PSEUDONORMALS, judge._pseudonormals
                found.outside = wp.float64(FAR * judge._frame.scale if judge.is_closed else np.inf)
        return handed_out(found, self._device, self)

    @property
    def origin(self) -> np.ndarray:
        """Origin of the local frame, the center of ``bounds`` in float64 [world], shape (3,).

        ``local = (world - origin) / scale``; the mesh lies in [-1, 1] there. Kernels that use :attr:`id` work in this
        frame.
        """
        return self._frame.origin.copy()

    @property
    def scale(self) -> float:
        """Length of one local unit [world]; ``local = (world - origin) / scale``."""
        return self._frame.scale

    @cached_property
    def audit(self) -> MeshAudit:
        """The :func:`geokit.mesh.audit` of this mesh, computed at the first access."""
        from geokit.mesh.topology.audit import audit_topology

        return audit_topology(self.mesh, self._topology)

    _repr_html_ = repr_html

    def __repr__(self) -> str:
        return f"Surface({self.mesh!r}, device={self.device!r})"


def _require_numbered(face_count: int, device: "wp.Device") -> None:
    if device.is_cuda and face_count > MOST_FACES_CUDA:
        raise InputError(
            f"mesh: {face_count} faces are more than the {MOST_FACES_CUDA} that one Surface numbers on {device.alias}; "
            "split the mesh, or use device='cpu'"
        )


class _SurfaceOnDevices(OnDevices, Surface):
    """A surface with a replica on each of several devices."""

    def __init__(self, mesh: MeshLike, *, device: Devices = None) -> None:
        self._parts = replicas(lambda one: Surface(mesh, device=one), device)

    def update(self, vertices: ArrayLike) -> None:
        self._update(vertices)

    def __reduce__(self) -> Any:
        return _restored, (self.mesh, self._aliases)

    def __repr__(self) -> str:
        return f"Surface({self.mesh!r}, device={self._aliases!r})"


def _restored(mesh: TriangleMesh, device: str | list[str]) -> Surface:
    if isinstance(device, list):
        return Surface(mesh, device=[launcher.device_or_default(one) for one in device])
    return Surface(mesh, device=launcher.device_or_default(device))
