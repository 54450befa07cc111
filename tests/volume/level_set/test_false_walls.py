"""Level sets whose operands touch: the result has no wall, and its depths are those of the whole."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

import geokit as gk
from geokit.mesh import TriangleMesh, box, sphere
from geokit.volume import SparseVolume
from tests.support.assemblies import concatenated, turned
from tests.support.effort import spread

pytest.importorskip("geokit.native.operations")
LOW, HIGH = box(center=(0.5, 0.5, 0.5)), box(center=(0.5, 0.5, 1.5))


def field(mesh: TriangleMesh, voxel_size: float) -> SparseVolume:
    return gk.volume.from_mesh(mesh, voxel_size, device="cpu")


def off_by(found: SparseVolume, expected: SparseVolume, voxel_size: float) -> NDArray[np.float64]:
    """Differences at the active voxels of both [voxels]."""
    at = np.concatenate([gk.volume.active_voxels(each).coordinates for each in (found, expected)])
    values = [gk.volume.sample(each, at, order=0, space="index", device="cpu") for each in (found, expected)]
    return np.abs(values[0] - values[1]) / voxel_size


@pytest.mark.slow
@pytest.mark.parametrize(("voxel_size", "seed"), spread(itertools.product([0.05, 0.047, 0.0331], [None, 1, 2]), 2))
def test_a_union_of_bodies_that_touch_is_one_body(voxel_size: float, seed: int | None) -> None:
    low, high = (LOW, HIGH) if seed is None else (turned(LOW, seed), turned(HIGH, seed))
    whole = field(gk.mesh.union(concatenated(low, high)), voxel_size)
    found = gk.volume.union(field(low, voxel_size), field(high, voxel_size))
    off = off_by(found, whole, voxel_size)
    assert off.max() < 0.8
    assert np.mean(off > 0.3) < 0.02
    # Outside nothing has changed.
    at = gk.volume.active_voxels(found).coordinates
    outside = gk.volume.sample(whole, at, order=0, space="index", device="cpu") > 1e-6
    values = gk.volume.active_voxels(found).values[outside]
    least = np.min(
        [
            gk.volume.sample(field(each, voxel_size), at[outside], order=0, space="index", device="cpu")
            for each in (low, high)
        ],
        axis=0,
    )
    assert np.array_equal(values, least.astype(np.float32))
    inner = gk.mesh.from_volume(gk.volume.offset(found, -0.1), device="cpu")
    largest = max(gk.mesh.split(inner), key=lambda piece: piece.volume)
    assert largest.volume == pytest.approx(0.8 * 0.8 * 1.8, rel=0.03)
    assert inner.volume == pytest.approx(largest.volume, rel=1e-3)


@pytest.mark.parametrize("overlap", [0.02, 0.06, 0.1])
def test_a_thin_overlap_is_no_wall(overlap: float) -> None:
    high = box(center=(0.5, 0.5, 1.5 - overlap))
    whole = field(gk.mesh.union(concatenated(LOW, high)), 0.05)
    found = gk.volume.union(field(LOW, 0.05), field(high, 0.05))
    if overlap < 0.1:
        assert off_by(found, whole, 0.05).max() < 0.8
    assert gk.volume.sample(found, [[0.5, 0.5, 1.0 - 0.5 * overlap]], device="cpu")[0] < -0.5 * overlap + 1e-6


@pytest.mark.slow
def test_cavities_that_touch_are_one_in_a_difference() -> None:
    block = box((2.0, 2.0, 3.0), center=(0.5, 0.5, 1.0))
    whole = field(gk.mesh.union(concatenated(LOW, HIGH)), 0.05)
    expected = gk.volume.difference(field(block, 0.05), whole)
    found = gk.volume.difference(field(block, 0.05), field(LOW, 0.05), field(HIGH, 0.05))
    assert off_by(found, expected, 0.05).max() < 0.8
    narrower = gk.mesh.from_volume(gk.volume.offset(found, 0.1), device="cpu")
    assert len(gk.mesh.split(narrower)) == 2
    assert narrower.volume == pytest.approx(2.2 * 2.2 * 3.2 - 0.8 * 0.8 * 1.8, rel=0.01)


@pytest.mark.slow
def test_an_intersection_of_complements_is_one_cavity() -> None:
    block = field(box((3.0, 3.0, 4.0), center=(0.5, 0.5, 1.0)), 0.05)
    shells = [gk.volume.difference(block, field(each, 0.05)) for each in (LOW, HIGH)]
    found = gk.volume.intersection(*shells)
    expected = gk.volume.difference(block, field(gk.mesh.union(concatenated(LOW, HIGH)), 0.05))
    assert off_by(found, expected, 0.05).max() < 0.8


GAPPED = [box(center=(0.5, 0.5, 1.5 + gap)) for gap in (0.03, 0.06)]


@pytest.mark.parametrize("other", [*GAPPED, sphere(center=(0.9, 0.2, 0.3), segments=24)])
def test_operands_that_do_not_touch_have_the_minimum_bit_for_bit(other: TriangleMesh) -> None:
    a, b = field(LOW, 0.05), field(other, 0.05)
    united = gk.volume.union(a, b)
    at = gk.volume.active_voxels(united).coordinates
    values = [gk.volume.sample(each, at, order=0, space="index", device="cpu") for each in (a, b)]
    assert np.array_equal(gk.volume.active_voxels(united).values, np.minimum(*values).astype(np.float32))


@pytest.mark.slow
def test_two_widths_and_three_operands() -> None:
    sizes = [gk.volume.from_mesh(each, 0.05, half_width=(3.0, 5.0), device="cpu") for each in (LOW, HIGH)]
    found = gk.volume.union(*sizes, field(box(center=(0.5, 0.5, 2.5)), 0.05))
    assert gk.volume.sample(found, [[0.5, 0.5, 1.0], [0.5, 0.5, 2.0]], device="cpu") == pytest.approx([-0.25, -0.25])
