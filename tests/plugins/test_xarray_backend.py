"""xarray opens volumes through geokit, and reads the voxels that it is asked for."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk

xarray = pytest.importorskip("xarray")

from geokit.plugins.xarray_backend import VolumeBackend  # noqa: E402 (needs xarray)

RANDOM = np.random.default_rng(1)
DENSITY = RANDOM.random((4, 5, 6)).astype(np.float32) + 1.0
WIND = RANDOM.random((2, 3, 4, 3)).astype(np.float32) + 1.0
TURNED = np.array([[0.0, -0.5, 0.0, 3.0], [0.5, 0.0, 0.0, 4.0], [0.0, 0.0, 0.5, 5.0], [0.0, 0.0, 0.0, 1.0]])


def opened(path: Path, **options: Any) -> Any:
    return xarray.open_dataset(path, engine=VolumeBackend, **options)


@pytest.fixture
def smoke(tmp_path: Path) -> Path:
    density = gk.volume.from_dense(DENSITY, voxel_size=0.5, origin=(10, 0, 0), name="density", grid_class="fog volume")
    wind = gk.volume.from_dense(WIND, voxel_size=0.5, origin=(8, 1, 0), background=(0, 0, 0), name="wind")
    gk.volume.save(tmp_path / "smoke.nvdb", density, wind)
    return tmp_path / "smoke.nvdb"


def test_grids_of_one_transform_share_a_box(smoke: Path) -> None:
    found = opened(smoke)
    assert dict(found.sizes) == {"x": 6, "y": 5, "z": 6, "component": 3}
    np.testing.assert_array_equal(found["x"], 0.5 * np.arange(8, 14))
    assert found["density"].attrs == {"grid_class": "fog volume"}
    density = np.zeros((6, 5, 6), np.float32)
    density[2:] = DENSITY
    np.testing.assert_array_equal(found["density"], density)
    wind = np.zeros((6, 5, 6, 3), np.float32)
    wind[:2, 1:4, :4] = WIND
    np.testing.assert_array_equal(found["wind"], wind)
    # In place of the world.
    assert found["density"].sel(x=6.0, y=1.0, z=2.0) == DENSITY[2, 2, 4]


@pytest.mark.parametrize(
    "key",
    [
        {"x": slice(1, 6, 2), "y": 3},
        {"x": slice(None, None, -2), "z": [5, 0, 1]},
        {"x": -1, "y": 0, "z": 2},
        {"x": slice(4, 4)},
        {"component": 1, "y": slice(1, 3)},
        {"component": slice(None, None, 2), "x": slice(2, None)},
    ],
)
def test_parts_are_those_of_the_whole(smoke: Path, key: dict[str, Any]) -> None:
    found = opened(smoke)
    name = "wind" if "component" in key else "density"
    whole = opened(smoke)[name].load()
    np.testing.assert_array_equal(found[name].isel(key), whole.isel(key))


def test_only_what_is_asked_for_is_made_dense(smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = []
    whole = gk.volume._dense.to_dense

    def to_dense(volume: Any, **options: Any) -> Any:
        boxes.append(options["bounds"].tolist())
        return whole(volume, **options)

    monkeypatch.setattr("geokit.volume._dense.to_dense", to_dense)
    found = opened(smoke, most_bytes=100)
    assert boxes == []
    found["density"][2:4, 1, 2:4].load()
    assert boxes == [[[10, 1, 2], [11, 1, 3]]]
    with pytest.raises(gk.DeviceMemoryError, match=r"grid 'density' has 180 voxels, 0 MiB; raise most_bytes, or ask"):
        found["density"].load()


def test_further_transforms_have_dimensions_of_their_own(tmp_path: Path) -> None:
    grids = [
        gk.volume.from_dense(DENSITY, name="density"),
        gk.volume.from_dense(DENSITY, transform=TURNED, origin=(1, 2, 3), name="turned"),
        gk.volume.from_dense(DENSITY, voxel_size=2.0, name="coarse"),
        gk.volume.from_dense(np.ones((2, 2, 2, 4)), voxel_size=2.0, background=(0, 0, 0, 0), name="four"),
        gk.volume.from_dense(np.ones((2, 2, 2, 3)), voxel_size=2.0, background=(0, 0, 0), name="three"),
    ]
    gk.volume.save(tmp_path / "a.nvdb", *grids)
    found = opened(tmp_path / "a.nvdb")
    assert found["turned"].dims == ("x_turned", "y_turned", "z_turned")
    # Not aligned with the world: indices, and the transform.
    np.testing.assert_array_equal(found["x_turned"], [1, 2, 3, 4])
    np.testing.assert_array_equal(found["turned"].attrs["transform"], TURNED.ravel())
    assert found["four"].dims == ("x_coarse", "y_coarse", "z_coarse", "component4")
    assert found["three"].dims[3] == "component"
    for grid in grids[:3]:
        back = gk.volume.from_dense(found[grid.info.name])
        np.testing.assert_array_equal(gk.volume.to_dense(back).values, DENSITY)
        center = [[3.0, 4.0, 5.0]]
        np.testing.assert_allclose(
            back.sample(back.info.transform[:3, :3] @ center[0] + back.info.transform[:3, 3], device="cpu"),
            back.sample(center, space="index", device="cpu")[0],
        )
        if grid.info.name == "turned":
            np.testing.assert_array_equal(back.info.transform, TURNED)


def test_variables_that_are_dropped_are_not_read(smoke: Path) -> None:
    assert set(opened(smoke, drop_variables="wind").data_vars) == {"density"}
    assert set(opened(smoke, drop_variables=["wind", "density"]).data_vars) == set()


def test_names_and_types(tmp_path: Path) -> None:
    grids = [gk.volume.from_dense(np.ones((2, 2, 2), kind), name=name) for kind, name in ((np.int64, "x"), (bool, ""))]
    empty = gk.volume.from_dense(np.zeros((2, 2, 2)), voxel_size=3.0, name="empty")
    gk.volume.save(tmp_path / "a.nvdb", *grids, empty)
    found = opened(tmp_path / "a.nvdb")
    assert {name: variable.dtype for name, variable in found.data_vars.items()} == {
        "x[1]": np.int64,
        "value": bool,
        "empty": np.float32,
    }
    assert found["empty"].load().shape == (0, 0, 0)
    assert set(opened(tmp_path / "a.nvdb", drop_variables=["x[1]", "value"]).data_vars) == {"empty"}


def test_it_says_which_files_it_opens() -> None:
    engine = VolumeBackend()
    known = {path: engine.guess_can_open(path) for path in ("a.vdb", Path("A.NVDB"), "a.nc", b"CDF", 3)}
    assert list(known.values()) == [True, True, False, False, False]


def test_xarray_finds_the_engine(smoke: Path) -> None:
    if "geokit" not in importlib.metadata.entry_points(group="xarray.backends").names:
        pytest.skip("installed before it had this entry point")
    assert xarray.open_dataset(smoke).equals(opened(smoke))
    assert set(xarray.open_dataset(smoke, engine="geokit").data_vars) == {"density", "wind"}


def test_refusals(tmp_path: Path) -> None:
    (tmp_path / "a.nvdb").write_bytes(b"no grid")
    with pytest.raises(gk.FileFormatError, match=r"a\.nvdb"):
        opened(tmp_path / "a.nvdb")
    with pytest.raises(gk.FileAccessError, match="no such file"):
        opened(tmp_path / "b.nvdb")
