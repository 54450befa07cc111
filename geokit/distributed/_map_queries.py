"""Queries of dask arrays: block by block, with one copy of the mesh or volume on each worker."""

from __future__ import annotations

import hashlib
import pickle
import threading
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np

from geokit import volume
from geokit._packages import require_package
from geokit.core.base.query import Query, queries_of
from geokit.core.memory.needs import needs
from geokit.core.query.ask import transform_axes
from geokit.core.require import require_choice
from geokit.errors import InputError
from geokit.mesh.surfaces.surface import Surface
from geokit.points.neighbors.neighbor_grid import NeighborGrid
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    import dask.array as da

# What is asked if no query is named.
USUAL = {Surface: "closest_point", SparseVolume: "sample", NeighborGrid: "count"}


def _queries(thing: Any) -> dict[str, Query]:
    """The queries of an object with an answer for each row, by name."""
    # Methods of a volume are verbs of its room.
    found = queries_of(volume, vars(SparseVolume)) if isinstance(thing, SparseVolume) else queries_of(type(thing))
    return {name: query for name, query in found.items() if query.has_rows}


def _bytes(surface: Any, points: Any, *_: Any, **__: Any) -> int:
    """Of the pickle, its copy, and Dask's description of the blocks."""
    if isinstance(surface, Surface):
        held = surface.mesh.vertices.nbytes + surface.mesh.faces.nbytes
    elif isinstance(surface, SparseVolume):
        held = surface.nanovdb.nbytes
    else:
        held = 24 * len(surface)
    return 2 * held + 8000 * points.npartitions


@needs(_bytes)
def map_queries(
    surface: Surface | SparseVolume | NeighborGrid,
    points: da.Array,
    directions: da.Array | None = None,
    *,
    query: str | None = None,
    **options: Any,
) -> Any:
    """Ask a query of each block of a dask array, on the threads, processes or machines that Dask has.

    Nothing is computed here: the answer's arrays are dask arrays. What is asked travels to each worker once, as its
    mesh or grid; trees are built there, once for each process. Answers are those of the method, bit for bit.

    Args:
        surface: What is asked: a Surface, a SparseVolume or a NeighborGrid.
        points: Query points, or origins of rays [world], shape (N, 3). Its blocks of rows are the tasks.
        directions: Directions of rays, shape (N, 3); for queries of rays only.
        query: Name of a method that answers each row by itself, as closest_point (default) of a Surface, sample
            (default) of a SparseVolume and count (default) of a NeighborGrid do.
        **options: Further arguments of that method.
    Returns:
        What the method returns, with dask arrays (N, ...) in place of arrays; its rows have the blocks of ``points``.
    Raises:
        InputError: ``surface`` is none of these, ``points`` is no dask array of three columns, ``directions`` does not
            fit, there is no such query, or the query refuses an option.
        MissingDependencyError: Dask is not installed.
    Example:
        >>> import dask.array
        >>> surface = gk.mesh.Surface(gk.mesh.box(), device="cpu")
        >>> points = dask.array.from_array([[2.0, 0.0, 0.0], [0.0, 0.0, 1.0]], chunks=(1, 3))
        >>> gk.distributed.map_queries(surface, points, query="signed_distance").distance.compute()
        array([1.5, 0.5])
    """
    require_package("dask")
    array = require_package("dask.array")
    delayed = require_package("dask.delayed").delayed
    usual = next((name for kind, name in USUAL.items() if isinstance(surface, kind)), None)
    if usual is None:
        raise InputError(
            f"surface: a {type(surface).__name__} is no Surface, SparseVolume or NeighborGrid; prepare one of them"
        )
    known = _queries(surface)
    query = usual if query is None else require_choice(query, "query", tuple(known))
    rows = [_rows("points", points, array)]
    if (directions is not None) != ("directions" in known[query].rows):
        said = "is missing" if directions is None else "is for queries of rays only"
        raise InputError(f"directions: {said}; give it with rays and only there")
    if directions is not None:
        rows.append(_rows("directions", directions, array))
        if rows[1].shape != rows[0].shape:
            raise InputError(f"directions: has shape {directions.shape} and points {points.shape}; give one for each")
        rows[1] = rows[1].rechunk(rows[0].chunks)
    if len(transform_axes(options)) == 3:
        raise InputError("transform: several poses have an axis of their own, before the rows; ask for one at a time")
    # What the answers are: those of two rows.
    try:
        sample = getattr(surface, query)(*(np.ones((2, 3), each.dtype) for each in rows), **options)
    except TypeError as error:
        raise InputError(f"options: {query} does not take them ({error}); see its arguments") from error
    shared = _Shared(surface)
    # Named by its content: one value on a cluster, whoever asks.
    handle = delayed(shared, name=f"geokit-{type(surface).__name__.lower()}-{shared.token}", pure=True)
    blocks = zip(*(each.to_delayed().ravel() for each in rows), strict=True)
    ask = delayed(_ask, pure=True)
    answers = [ask(handle, query, list(block), options) for block in blocks]
    counts = rows[0].chunks[0]

    def joined(of: Any, field: str | None) -> da.Array:
        parts = [answer if field is None else ask_field(answer, field) for answer in answers]
        made = [
            array.from_delayed(part, (count, *of.shape[1:]), dtype=of.dtype)
            for part, count in zip(parts, counts, strict=True)
        ]
        return array.concatenate(made, allow_unknown_chunksizes=True)

    ask_field = delayed(getattr, pure=True)
    if isinstance(sample, tuple):
        return type(sample)(*(joined(of, field) for of, field in zip(sample, sample._fields, strict=True)))  # type: ignore[attr-defined]
    return joined(sample, None)


def _rows(name: str, given: Any, array: Any) -> Any:
    """A dask array of three columns, whole in its rows."""
    if not isinstance(given, array.Array):
        raise InputError(f"{name}: a {type(given).__name__} is no dask array; make one with dask.array.from_array")
    if given.ndim != 2 or given.shape[1] != 3 or given.dtype not in (np.float32, np.float64):
        raise InputError(f"{name}: has shape {given.shape} and type {given.dtype}; give (N, 3) of float32 or float64")
    return given.rechunk({1: 3})


class _Shared:
    """A mesh or grid that is prepared once in each process, however often its pickle arrives there."""

    def __init__(self, thing: Any) -> None:
        self.thing = thing
        self._pickle = pickle.dumps(thing, protocol=5)
        self.token = hashlib.sha256(self._pickle).hexdigest()

    def __reduce_ex__(self, protocol: Any) -> Any:
        # Beside the pickle, where it can: not copied.
        return _arrived, (self.token, pickle.PickleBuffer(self._pickle) if protocol >= 5 else self._pickle)

    def __dask_tokenize__(self) -> str:
        return self.token


_here: WeakValueDictionary[str, _Shared] = WeakValueDictionary()
_lock = threading.Lock()


def _arrived(token: str, content: Any) -> _Shared:
    # The lock: of two threads that get it at the same time, one builds the tree.
    with _lock:
        found = _here.get(token)
        if found is None:
            found = _here[token] = _Shared.__new__(_Shared)
            found.token, found._pickle = token, bytes(content)
            found.thing = pickle.loads(content)
        return found


def _ask(shared: _Shared, query: str, rows: list[np.ndarray], options: dict[str, Any]) -> Any:
    return getattr(shared.thing, query)(*rows, **options)
