"""Fields of open meshes: what is said of them, and what closes their surfaces."""

from __future__ import annotations

import warnings

import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog

BOWL = mesh_catalog.box_without_a_lid()


@pytest.mark.slow
@pytest.mark.parametrize("asked", [{"voxel_size": 0.1}, {"tolerance": 0.05}])
def test_an_open_field_is_said_to_be_open(asked: dict[str, float]) -> None:
    with pytest.warns(UserWarning, match=r"is open \(4 boundary edges\), and so is its field.*half_width.*thickness"):
        gk.volume.from_mesh(BOWL, **asked, device="cpu")


@pytest.mark.parametrize("asked", [{"sign": "winding"}, {"sign": "none"}, {"thickness": 0.3}])
def test_who_asks_for_it_is_not_told(asked: dict[str, object]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gk.volume.from_mesh(BOWL, 0.1, **asked, device="cpu")  # type: ignore[arg-type]


def test_closed_meshes_are_not_said_to_be_open() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gk.volume.from_mesh(mesh_catalog.box(), 0.1, device="cpu")


def test_the_surface_ends_with_the_band_and_a_wider_band_closes_it() -> None:
    """What the documents promise of from_volume, and on what condition."""
    ends = gk.mesh.from_volume(gk.volume.from_mesh(BOWL, 0.1, half_width=2.0, device="cpu"), device="cpu")
    closed = gk.mesh.from_volume(gk.volume.from_mesh(BOWL, 0.1, half_width=8.0, device="cpu"), device="cpu")
    assert gk.mesh.audit(ends).boundary_edge_count > 0
    assert gk.mesh.audit(closed).watertight
