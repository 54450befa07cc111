"""Audits of meshes that do not fit into memory."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.blocks.chunked_queries import Progress, in_percent
from geokit.core.content_limit import working_memory
from geokit.core.equal_rows import merge_equal_points, repeated_triples
from geokit.core.files import require_room
from geokit.core.memory.needs import needs
from geokit.core.require import require_path
from geokit.formats.blocks.boxes import Boxes
from geokit.formats.blocks.records import AT_A_TIME, BYTES_AT_A_TIME, Buckets, Known, survey, work_folder
from geokit.formats.blocks.triangles import TriangleFile, open_triangles
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.audit import (
    ASPECT_QUANTILES,
    MeshAudit,
    area_and_volume,
    aspect_ratios,
    audit_topology,
    diagonal_of,
)
from geokit.mesh.topology.connectivity import connected_components, mesh_topology, next_half_edge
from geokit.mesh.topology.doubled_faces import back_to_back_pairs
from geokit.mesh.topology.measures import measure_faces

# Triangles that stand for all where these are divided.
SAMPLE_SIZE = 1 << 16
# Bits of a number that one pass decides, and numbers that are read at a time.
BITS, NUMBERS_AT_A_TIME = 16, 1 << 20

# Memory for each triangle of a part.
BYTES_PER_TRIANGLE = 700
# Parts of the work: the first pass, sorting, the audit of the parts.
SURVEYED, SORTED = 0.15, 0.5


@needs()
def audit_file(
    path: str | os.PathLike[str],
    *,
    memory_limit: int | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> MeshAudit:
    """Defects, topology and measures of a mesh in a file that need not fit into memory.

    The audit is that of :func:`audit` after equal positions have become one vertex and unused vertices are gone:
    ``vertex_count`` is the number of positions that faces use, ``coincident_count`` and ``unreferenced_count`` are 0.
    All other counts and the aspect ratios are the same; area and volume are summed in another order.

    Triangles are sorted into boxes with about equally many, in temporary files of 44 bytes a triangle (80 in a .ply of
    doubles), and a tenth more for triangles in several boxes. A box has all triangles with a corner in it, so that all
    there is around its vertices and edges is known.

    Args:
        path: A mesh of triangles in a binary .stl or .ply file. Vertices of a .ply file are mapped into memory, and
            read fast where faces refer to vertices that lie near each other in the file.
        memory_limit: Bytes that may be taken beyond those of the running process, at least 2^28; None for half of the
            free memory.
        folder: Where the temporary files go; None for the folder of the source. They are removed.
        progress: Called as ``progress(percent, 100)``.
    Returns:
        MeshAudit. Its ``self_intersection_count`` is None.
    Raises:
        InputError: An argument is out of range.
        FileAccessError: The file is missing, or the folder cannot be written or has no room for the temporary files.
        FileFormatError: The mesh file is text, damaged, or has other faces than triangles.
    Example:
        >>> gk.mesh.save("ball.ply", gk.mesh.sphere())
        >>> gk.mesh.audit_file("ball.ply").watertight
        True
    """
    path = require_path(path)
    memory = max(working_memory(memory_limit) - BYTES_AT_A_TIME, BYTES_AT_A_TIME)
    place = path.parent if folder is None else require_path(folder, "folder")
    report = in_percent(progress)
    source = open_triangles(path)
    if source.count == 0:
        empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
        return audit_topology(empty, mesh_topology(empty))
    known = survey_triangles(source)
    bounds = np.stack([known.lower, known.upper])
    report(SURVEYED)
    boxes = Boxes(known.sample, -(-source.count * BYTES_PER_TRIANGLE // memory))
    bytes_on_disk = source.count * (9 * source.dtype.itemsize + 16)
    require_room(place / path.name, bytes_on_disk, "the temporary files of its audit", "give another folder")
    with work_folder(place) as private:
        tiles, done = Tiles(boxes, private, source.dtype), 0
        for count in tiles.add(source.blocks(AT_A_TIME)):
            done += count
            report(SURVEYED + (SORTED - SURVEYED) * done / source.count)
        sums = _Sums(tiles, bounds, private / "aspects")
        for tile in range(tiles.count):
            sums.add(tile)
            report(SORTED + (1.0 - SORTED) * (tile + 1) / tiles.count)
        return sums.audit(source)


class _Sums:
    """What adds up over the parts of a mesh: each vertex, edge and face counts in one of them.

    Args:
        tiles: The parts.
        bounds: The box around all.
        path: A file for the aspect ratios.
    """

    def __init__(self, tiles: Tiles, bounds: NDArray[np.float64], path: Path) -> None:
        self._tiles, self._bounds, self._aspects = tiles, bounds, OrderStatistics(path)
        self._position_count = self._vertex_count = self._edge_count = self._spread_count = 0
        self._boundary = self._non_manifold = self._split = self._duplicates = self._back_to_back = self._flat = 0
        self._oriented, self._area, self._volume = True, 0.0, 0.0
        # Components of single parts, numbered; the one of each triangle that lies in several, and those which it joins.
        self._pieces, self._piece_of = 0, np.full(tiles.shared_count, -1, np.int64)
        self._joined: list[NDArray[np.int64]] = [np.zeros((0, 2), np.int64)]

    def add(self, tile: int) -> None:
        """Add what belongs to one part."""
        corners, shared = self._tiles.take(tile)
        if not len(corners):
            return
        first, group = merge_equal_points(corners.reshape(-1, 3))
        positions = corners.reshape(-1, 3)[first] + 0.0
        del corners
        faces = group.astype(np.int32).reshape(-1, 3)
        mesh = TriangleMesh(positions, faces)
        _, _, collapsed, topology = mesh_topology(mesh)
        here = self._tiles.of(positions) == tile
        # What has several vertices belongs where the first of them does, in an order that all parts share.
        rank = np.empty(len(positions), np.int64)
        rank[np.lexsort(positions.T)] = np.arange(len(positions))

        def is_here(ends: NDArray[Any]) -> NDArray[np.bool_]:
            return here[np.take_along_axis(ends, rank[ends].argmin(axis=1)[:, None], axis=1)[:, 0]]

        half_edge = topology.order[topology.starts]
        edges = is_here(topology.start[np.stack([half_edge, next_half_edge(half_edge)], axis=1)])
        self._edge_count += int(np.count_nonzero(edges))
        self._boundary += int(np.count_nonzero(edges & (topology.uses == 1)))
        self._non_manifold += int(np.count_nonzero(edges & (topology.uses > 2)))
        self._oriented &= bool(topology.opposed[edges[topology.uses == 2]].all())
        self._position_count += int(np.count_nonzero(here))
        self._vertex_count += int(np.count_nonzero(here & (topology.face_counts > 0)))
        self._split += int(np.count_nonzero(here[topology.split_vertices()]))
        own = is_here(faces)
        self._spread_count += int(np.count_nonzero(own & ~collapsed))
        repeats, repeated = repeated_triples(faces)
        repeats, repeated = repeats[own[repeats]], repeated[own[repeats]]
        self._duplicates += len(repeats)
        spread = ~collapsed[repeats]
        if spread.any():
            self._back_to_back += int(back_to_back_pairs(faces, repeats[spread], repeated[spread])[1].sum())
        self._measure(TriangleMesh(positions, faces[own]), collapsed[own])
        self._join(topology.pieces(faces[collapsed])[faces[:, 0]], shared)

    def _measure(self, mesh: TriangleMesh, collapsed: NDArray[np.bool_]) -> None:
        measures = measure_faces(mesh, self._bounds)
        flat = measures.flat | collapsed
        area, volume = area_and_volume(measures)
        self._flat += int(np.count_nonzero(flat))
        self._area, self._volume = self._area + area, self._volume + volume
        self._aspects.add(aspect_ratios(measures, flat))

    def _join(self, label: NDArray[np.int32], shared: NDArray[np.int64]) -> None:
        """Number the components of a part, given for each face, and note which of other parts they continue."""
        kinds, number = np.unique(label, return_inverse=True)
        rows = np.flatnonzero(shared >= 0)
        piece, at = self._pieces + number[rows], shared[rows]
        before = self._piece_of[at]
        links = np.stack([before, piece], axis=1)[before >= 0]
        self._joined.append(np.unique(links, axis=0) if len(links) else links)
        self._piece_of[at] = piece
        self._pieces += len(kinds)

    def _component_count(self) -> int:
        joined = np.concatenate(self._joined)
        pieces, ends = np.unique(joined, return_inverse=True)
        ends = ends.reshape(-1, 2)
        label = connected_components(len(pieces), ends[:, 0], ends[:, 1])
        return self._pieces - len(pieces) + int(np.count_nonzero(label == np.arange(len(pieces))))

    def audit(self, source: TriangleFile) -> MeshAudit:
        """The audit of the whole mesh."""
        watertight = self._boundary == 0 and self._non_manifold == 0
        oriented = self._spread_count > 0 and self._oriented
        ranks = [round(quantile * (source.count - 1)) for quantile in ASPECT_QUANTILES]
        return MeshAudit(
            vertex_count=self._position_count,
            face_count=source.count,
            component_count=self._component_count(),
            boundary_edge_count=self._boundary,
            non_manifold_edge_count=self._non_manifold,
            watertight=watertight,
            manifold=self._spread_count > 0 and self._non_manifold == 0 and self._split == 0,
            oriented=oriented,
            non_manifold_vertex_count=self._split,
            degenerate_count=self._flat,
            duplicate_count=self._duplicates,
            back_to_back_count=self._back_to_back,
            coincident_count=0,
            unreferenced_count=0,
            signed_volume=self._volume,
            inside_out=watertight and oriented and self._volume < 0.0,
            area=self._area,
            bounds=self._bounds,
            diagonal=diagonal_of(self._bounds),
            euler_number=self._vertex_count - self._edge_count + self._spread_count,
            aspect_ratio_quantiles=self._aspects.at(ranks),
            self_intersection_count=None,
        )


def survey_triangles(source: TriangleFile) -> Known:
    """What one pass over the corners of all triangles tells; the sample has first corners."""
    none: dict[str, NDArray[Any]] = {}
    corners = ((block.reshape(-1, 3), none) for block in source.blocks(AT_A_TIME))
    return survey(corners, 3 * max(1, source.count // SAMPLE_SIZE))


class Tiles:
    """The files of the boxes.

    Args:
        boxes: Where corners belong.
        folder: Where the files are made.
        dtype: Type of the coordinates.
    """

    def __init__(self, boxes: Boxes, folder: Path, dtype: np.dtype[Any]) -> None:
        self._boxes = boxes
        # A triangle in several files has a number there, else -1.
        self._record = np.dtype([("corners", dtype, (3, 3)), ("shared", np.int64)])
        self._buckets = Buckets(folder / "tile", self._record, boxes.count)
        self.shared_count = 0

    @property
    def count(self) -> int:
        """Number of boxes."""
        return self._boxes.count

    def of(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """The box of each point (N, 3)."""
        return self._boxes.of(points)

    def add(self, blocks: Iterable[NDArray[Any]]) -> Iterator[int]:
        """Sort triangles (N, 3, 3) into the files; yields how many were sorted."""
        for block in blocks:
            box = self.of(block.reshape(-1, 3).astype(np.float64)).reshape(-1, 3)
            records = np.empty(len(block), self._record)
            records["corners"], records["shared"] = block, -1
            shared = np.flatnonzero((box != box[:, :1]).any(axis=1))
            records["shared"][shared] = self.shared_count + np.arange(len(shared))
            self.shared_count += len(shared)
            # Each triangle once in each box.
            new = np.ones((len(box), 3), bool)
            new[:, 1] = box[:, 1] != box[:, 0]
            new[:, 2] = (box[:, 2] != box[:, 0]) & (box[:, 2] != box[:, 1])
            row, column = np.nonzero(new)
            self._buckets.add(records, box[row, column], row)
            yield len(block)

    def take(self, box: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Corners (N, 3, 3) of a box's triangles, and the numbers of shared ones (N,); its file is removed."""
        records = self._buckets.file(box).take()
        return records["corners"].astype(np.float64), records["shared"].copy()


class OrderStatistics:
    """Numbers from 0 to infinity, in a file that grows, whose order statistics are found without sorting them.

    The bits of such numbers, taken as integers, have their order. Each of four passes counts 16 more bits of those that
    begin like the number which is looked for.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._count = path, 0

    def add(self, numbers: NDArray[np.float64]) -> None:
        """Add numbers, none of them negative or NaN."""
        with open(self._path, "ab") as file:
            file.write(np.ascontiguousarray(numbers).data)
        self._count += len(numbers)

    def at(self, ranks: Sequence[int]) -> NDArray[np.float64]:
        """The numbers at some ranks, counted from 0."""
        found, left = np.zeros(len(ranks), np.uint64), list(ranks)
        for shift in range(64 - BITS, -1, -BITS):
            # Ranks that begin alike share a count.
            prefixes = sorted({int(number) >> (shift + BITS) for number in found})
            counts = {prefix: np.zeros(1 << BITS, np.int64) for prefix in prefixes}
            for first in range(0, self._count, NUMBERS_AT_A_TIME):
                bits = np.fromfile(self._path, np.uint64, NUMBERS_AT_A_TIME, offset=8 * first)
                next_bits = (bits >> np.uint64(shift)) & np.uint64((1 << BITS) - 1)
                for prefix, count in counts.items():
                    begun = next_bits if shift + BITS == 64 else next_bits[bits >> np.uint64(shift + BITS) == prefix]
                    count += np.bincount(begun.astype(np.int64), minlength=1 << BITS)
            for k, rank in enumerate(left):
                ends = np.cumsum(counts[int(found[k]) >> (shift + BITS)])
                digit = int(np.searchsorted(ends, rank, side="right"))
                left[k] = rank - (int(ends[digit - 1]) if digit else 0)
                found[k] |= np.uint64(digit << shift)
        return found.view(np.float64)
