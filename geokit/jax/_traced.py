"""Meshes whose vertices are an array of jax, and volumes whose active values are one: queries carry their gradients."""

from __future__ import annotations

from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from geokit import mesh
from geokit import volume as verbs
from geokit.core.gradients.rules import held_by, hold
from geokit.core.gradients.with_jax import Traced
from geokit.core.interop.types import Array, Device, Rows
from geokit.core.require import described, read_array
from geokit.errors import InputError


class _Faces(NamedTuple):
    faces: NDArray[np.int32]


class Surface(Traced):
    """A mesh prepared for queries, whose answers carry gradients with respect to its vertices.

    The queries are those of :class:`geokit.mesh.Surface`, under ``jax.grad``, ``jax.jit`` and ``jax.vmap`` (over
    points, rays and vertices). They run in a callback, where the tree is built, and refitted for the next vertices;
    several queries of the same vertices share it. Winding numbers take ``as_given=True``: whether faces flip is not
    known while jax traces.

    Args:
        vertices: Positions [world], an array (V, 3) of jax (or NumPy), float32 or float64.
        faces: Three vertices of each face, whole numbers (F, 3); NumPy or a list, not traced.
        device: Where queries run; None for the first GPU, else the CPU.
    Raises:
        InputError: ``vertices`` is no array, or not (V, 3) of float32 or float64; or ``faces`` is not (F, 3),
            not whole, or beyond the vertices.
    Example:
        >>> def height(vertices):
        ...     surface = gk.jax.Surface(vertices, [[0, 1, 2]], device="cpu")
        ...     return surface.closest_point(np.array([[0.25, 0.25, 2.0]])).distance.sum()
        >>> jax.grad(height)(jax.numpy.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))[:, 2].tolist()
        [-0.5, -0.25, -0.25]
    """

    closest_point = mesh.Surface.closest_point
    signed_distance = mesh.Surface.signed_distance
    raycast = mesh.Surface.raycast

    def __init__(self, vertices: jax.Array | np.ndarray, faces: Rows, *, device: Device = None) -> None:
        vertices = read_jax(vertices, "vertices")
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise InputError(f"vertices: shape {tuple(vertices.shape)} is not (V, 3); use vmap for batches")
        if isinstance(faces, jax.core.Tracer):
            raise InputError("faces: a traced array; whole numbers have no gradients, give a NumPy array")
        # Checks the faces; positions are checked where they are known.
        checked = mesh.TriangleMesh(np.zeros(vertices.shape), read_array(faces, "faces"))
        self.mesh, self._device, self._cache = _Faces(checked.faces), device, None
        self._kept: dict[str, mesh.Surface] = {}
        hold(self, vertices=vertices)

    def winding_number(self, points: Rows, *, as_given: bool = False) -> Array:
        """Winding numbers as of :meth:`geokit.mesh.Surface.winding_number`, with ``as_given=True``.

        Args:
            points: Query points [world], shape (N, 3).
            as_given: True: faces keep their winding.
        Returns:
            Winding numbers (N,).
        Raises:
            InputError: ``as_given`` is not True, or as :meth:`geokit.mesh.Surface.winding_number`.
        """
        if as_given is not True:
            raise InputError("as_given: which faces flip is not known while jax traces; give True, or use geokit.torch")
        return mesh.Surface.winding_number(self, points, as_given=True)  # type: ignore[arg-type]

    @property
    def bounds(self) -> jax.Array:
        """Bounding box of the vertices [world], shape (2, 3)."""
        vertices = jax.lax.stop_gradient(held_by(self)["vertices"])
        return jnp.stack([vertices.min(0), vertices.max(0)])

    @property
    def scale(self) -> jax.Array:
        """Half of the longest side of the bounding box [world]."""
        return jnp.ptp(self.bounds, axis=0).max() * 0.5

    def made(self, **arrays: NDArray[np.floating]) -> mesh.Surface:
        """The surface of known vertices; see :class:`geokit.core.gradients.rules.Deferred`."""
        vertices = arrays["vertices"].astype(np.float64)
        kept = self._kept.get("surface")
        if kept is None:
            kept = self._kept["surface"] = mesh.Surface(
                mesh.TriangleMesh(vertices, self.mesh.faces), device=self._device
            )
        elif not np.array_equal(kept.mesh.vertices, vertices):
            kept.update(vertices)
        return kept


def read_jax(values: Any, name: str) -> Any:
    """Real numbers as an array of jax.

    Raises:
        InputError: They are neither an array of jax nor of NumPy, or not float32 or float64.
    """
    if not isinstance(values, (jax.Array, np.ndarray)):
        raise InputError(f"{name}: {described(values)} is not an array of jax; make one with jax.numpy.asarray")
    if not jnp.issubdtype(values.dtype, jnp.floating):
        raise InputError(f"{name}: {values.dtype} has no gradients; give float32 or float64")
    return jnp.asarray(values)


class Volume(Traced):
    """Result of :func:`with_values`. ``sample``, ``gradient``, ``raycast`` and ``integrate`` take it, also as methods.

    Attributes:
        template: The volume whose tree, transform and constant values it has.
        info: What is known of the template.
    """

    sample = verbs.sample
    gradient = verbs.gradient
    raycast = verbs.raycast
    integrate = verbs.integrate

    def __init__(self, template: verbs.SparseVolume, values: jax.Array | np.ndarray) -> None:
        self.template, self.info = template, template.info
        self._kept: dict[str, tuple[NDArray[np.floating], verbs.SparseVolume]] = {}
        hold(self, values=values)

    def hessian(self, points: Rows, **_: object) -> NoReturn:
        """Second derivatives of samples are not known here.

        Raises:
            InputError: Always.
        """
        raise InputError("order: gradients of order 2 and 3 have no derivative in jax; take order 1, or torch")

    def made(self, **arrays: NDArray[np.floating]) -> verbs.SparseVolume:
        """The volume of known values; see :class:`geokit.core.gradients.rules.Deferred`."""
        values = arrays["values"]
        kept = self._kept.get("volume")
        if kept is None or not np.array_equal(kept[0], values):
            kept = self._kept["volume"] = values.copy(), verbs.with_values(self.template, values)
        return kept[1]


def with_values(volume: verbs.SparseVolume, values: jax.Array | np.ndarray) -> Volume:
    """The same voxels with active values that are an array of jax: :func:`geokit.volume.with_values` with gradients.

    Samples of orders 1 to 3, gradients of order 1, hits, transmittances and emissions carry gradients with respect to
    points or rays and to the values, under ``jax.grad``, ``jax.jit`` and ``jax.vmap`` (also over values).

    Args:
        volume: A float or double grid.
        values: One value for each row of :func:`geokit.volume.active_voxels`, an array (A,) of jax (or NumPy).
    Returns:
        A Volume.
    Raises:
        InputError: ``values`` is no array, or not (A,) of float32 or float64.
        UnsupportedGridError: The grid is neither float nor double.
        FileFormatError: The buffer is not a valid grid.
    """
    values = read_jax(values, "values")
    count = len(verbs.active_voxels(volume).values)
    if tuple(values.shape) != (count,):
        raise InputError(f"values: shape {tuple(values.shape)} is not ({count},); give one for each active voxel")
    return Volume(volume, values)
