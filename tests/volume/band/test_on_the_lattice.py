"""Bodies whose faces and edges lie on the lattice: rounding decides no sign, and there are no crumbs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from geokit.mesh import TriangleMesh, box, cylinder
from tests.support.effort import of_all

SIZES = st.sampled_from([0.05, 0.1, 0.02, 0.025, 1.0 / 3.0, 0.03, 0.7])


def pieces(mesh: TriangleMesh, voxel_size: float, method: str, **options: object) -> int:
    field = gk.volume.from_mesh(mesh, voxel_size, device="cpu", **options)  # type: ignore[arg-type]
    return len(gk.mesh.split(gk.mesh.from_volume(field, method=method, device="cpu")))


@pytest.mark.slow
@settings(max_examples=of_all(20, 40), deadline=None)
@given(
    voxel_size=SIZES,
    counts=st.lists(st.integers(3, 20), min_size=3, max_size=3),
    begin=st.lists(st.integers(-30, 30), min_size=3, max_size=3),
    method=st.sampled_from(["surface_nets", "marching_cubes", "dual_contouring"]),
    sign=st.sampled_from(["auto", "winding", "parity"]),
)
def test_a_box_is_one_piece(voxel_size: float, counts: list[int], begin: list[int], method: str, sign: str) -> None:
    size = np.array(counts) * voxel_size
    block = box(size, center=np.array(begin) * voxel_size + size / 2.0)
    assert pieces(block, voxel_size, method, sign=sign) == 1


@pytest.mark.parametrize("method", ["surface_nets", "marching_cubes"])
def test_so_is_a_cylinder_whose_ends_are_on_it(method: str) -> None:
    assert pieces(cylinder(1.0, 2.0), 0.05, method) == 1


def test_voxels_on_the_surface_are_outside() -> None:
    block = box((1.0, 1.0, 2.0), center=(0.5, 0.5, 1.0))
    voxels = gk.volume.active_voxels(gk.volume.from_mesh(block, 0.05, device="cpu"))
    upper = np.array([20, 20, 40])
    on = ((voxels.coordinates == 0) | (voxels.coordinates == upper)).any(axis=1)
    on &= ((voxels.coordinates >= 0) & (voxels.coordinates <= upper)).all(axis=1)
    assert np.count_nonzero(on) > 3000
    assert (voxels.values[on] >= 0.0).all()
    assert np.abs(voxels.values[on]).max() < 1e-15
