"""One table of grid types: it is NanoVDB's, and every place that must know a type takes it from there or agrees.

A type that is added to the table and forgotten elsewhere fails here by its name.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import geokit
from benchmarks.catalog.index_grids import IndexGrid
from benchmarks.catalog.typed_grids import TypedGrid
from geokit import native
from geokit.cli._storage import QUANTIZATIONS
from geokit.errors import GeokitError, InputError, UnsupportedGridError
from geokit.native import VdbGrid
from geokit.volume._dense import from_dense, to_dense
from geokit.volume.at_points.sample import sample
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import GRID_CLASSES, aligned_buffer, info_of
from geokit.volume.nanovdb.layout import INDEX_LAYOUTS, LAYOUTS
from geokit.volume.nanovdb.read_voxel_kernels import FLOAT_TYPE
from geokit.volume.nanovdb.types import (
    BY_NAME,
    CHANNEL_TYPES,
    CLASS_TYPES,
    COMPONENTS,
    FIXED_BITS,
    FLOAT,
    GRID_TYPES,
    INDEX_TYPES,
    ISOSURFACE_TYPES,
    QUANTIZED,
    SCALAR_TYPES,
    TYPES,
    WHOLE_TYPES,
    WHOLE_VECTOR_TYPES,
)
from geokit.volume.retyped.quantize import CODECS, SOURCES, quantize
from geokit.volume.tolerance import search

PACKAGE = Path(geokit.__file__).parent
HEADER = Path(wp.__file__).parent / "native" / "nanovdb" / "PNanoVDB.h"
NAMES = [kind.name for kind in TYPES]
with_openvdb = pytest.mark.skipif(not native.available(), reason="built without OpenVDB")

# Lists of type names that are a choice and no list of types: where they stand, and what they choose.
CHOICES = {
    "volume/nanovdb/read_voxel_kernels.py": "C++ for each type, compared with the table below",
    "native/_metadata.py": "types of metadata values",
    "native/_points.py": "types of the attributes of points",
    "accuracy/charts/volume_setup.py": "the codecs of a chart",
    "accuracy/stability/volume_sample.py": "the codecs of an envelope",
    "cli/_storage.py": "compared below: a command line must not wait for NumPy",
    "formats/images/nrrd.py": "names of NRRD, of which some are the same",
    "volume/images/stage.py": "names of USD, which knows the types of OpenVDB only",
    "volume/_resample.py": "types whose values are interpolated",
}


def require_known(name: str) -> None:
    """Kernels index PNanoVDB's tables by the number of the type: one that is not there must not reach them."""
    last = re.search(r"#define PNANOVDB_GRID_TYPE_END (\d+)", HEADER.read_text())
    assert last is not None
    assert BY_NAME[name].number < int(last[1]), f"{name}: warp's PNanoVDB.h has no such type"


def values_in(text: str, name: str) -> list[int]:
    table = re.search(rf"{name}\[PNANOVDB_GRID_TYPE_END\]\s*=\s*\{{([\d\s,]+)\}}", text)
    assert table is not None
    return [int(number) for number in table[1].split(",")]


def test_numbers_and_sizes_are_those_of_the_header_that_warp_brings():
    text = HEADER.read_text()
    numbers = {
        name: int(number) for name, number in re.findall(r"#define PNANOVDB_GRID_TYPE_([A-Z0-9]+) (\d+)\n", text)
    }
    end = numbers.pop("END")
    numbers["BOOL"] = numbers.pop("BOOLEAN")
    assert {kind.name.upper(): kind.number for kind in TYPES} == numbers
    assert end == len(TYPES)
    assert [BY_NAME[name].number for name in GRID_TYPES] == list(range(len(TYPES)))
    bits = values_in(text, "pnanovdb_grid_type_value_strides_bits")
    for kind in TYPES:
        if kind.has_values:
            assert max(kind.leaf_bits, 0) == bits[kind.number], kind.name


def test_each_type_is_described_once_and_consistently():
    assert len(BY_NAME) == len(TYPES)
    for kind in TYPES:
        assert (kind.value is None) == (kind.family in ("none", "point")), kind.name
        assert kind.has_values == (kind.name in LAYOUTS), kind.name
        assert (kind.family == "index") == (kind.name in INDEX_LAYOUTS), kind.name
        assert set(kind.classes) <= set(GRID_CLASSES) - {"unknown"}, kind.name
        if kind.value is None:
            continue
        letter = {"float": "f", "quantized": "f", "bool": "b", "mask": "b", "index": "u"}.get(kind.family, "iuf")
        assert kind.value.base.kind in letter, kind.name
        assert bool(kind.value.shape) == (kind.family in ("vector", "color")), kind.name
        assert kind.components in (1, 3, 4), kind.name
    assert set(COMPONENTS) == set(LAYOUTS)
    assert list(INDEX_TYPES) == list(INDEX_LAYOUTS)
    assert set(SCALAR_TYPES) == {name for name, layout in LAYOUTS.items() if not layout.background.shape}
    assert set(ISOSURFACE_TYPES) == {"half", "float", "double", *QUANTIZED}
    assert set(CHANNEL_TYPES) == set(LAYOUTS) - set(QUANTIZED) - {"bool", "mask"}
    assert FLOAT == BY_NAME["float"].number == int(FLOAT_TYPE)


def test_codecs_are_the_quantized_types_and_float():
    assert CODECS == ("float", *QUANTIZED) == QUANTIZATIONS
    assert set(SOURCES) == {*CODECS, "double"}
    assert sorted(search.CODECS) == sorted(CODECS)
    widths = [FIXED_BITS.get(codec, 0) for codec in search.CODECS[1:]]
    assert widths == sorted(widths, reverse=True)


@pytest.mark.parametrize("name", sorted(COMPONENTS))
def test_kernels_read_every_type_with_values(name):
    require_known(name)
    grid = TypedGrid(name)
    # A voxel of each leaf, a tile of each level, the background.
    voxels = np.array([[3, 5, 7], [-8, 0, 0], [0, 0, 8], [0, 0, 128], [4096, 0, 0], [100, -9000, 5]])
    found = sample(grid.volume, voxels.astype(float), order=0, space="index", device="cpu")
    assert found.shape == (len(voxels), *([COMPONENTS[name]] if COMPONENTS[name] > 1 else []))
    np.testing.assert_allclose(found, grid.at(voxels), rtol=1e-6, err_msg=f"read_voxel_kernels does not know {name}")


@pytest.mark.parametrize("name", sorted(set(NAMES) - set(COMPONENTS)))
def test_other_types_are_refused(name):
    buffer = (IndexGrid(name, []) if name in INDEX_TYPES else TypedGrid("float")).volume.nanovdb.copy()
    buffer[636:640].view("<u4")[0] = BY_NAME[name].number
    aligned = aligned_buffer(len(buffer))
    aligned[:] = buffer
    with pytest.raises(UnsupportedGridError):
        sample(SparseVolume(aligned, info_of(aligned)), np.zeros((1, 3)), device="cpu")


@pytest.mark.parametrize("code", ["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"])
@pytest.mark.parametrize("components", [1, 3, 4])
def test_arrays_of_whole_numbers_become_the_smallest_type_that_holds_them(code, components):
    dtype = np.dtype(code)
    ends = [0, 1] if code == "b1" else [np.iinfo(dtype).min, np.iinfo(dtype).max]
    values = np.resize(np.array(ends, dtype), (2, 2, 2, *([components] if components > 1 else [])))
    name = WHOLE_TYPES.get(code) if components == 1 else WHOLE_VECTOR_TYPES.get((code, components))
    if name is None:
        with pytest.raises(InputError, match="name a grid_type"):
            from_dense(values, transform=np.eye(4))
        return
    volume = from_dense(values, transform=np.eye(4))
    assert volume.info.grid_type == name
    require_known(name)
    dense = to_dense(volume, bounds=[[0, 0, 0], [1, 1, 1]], device="cpu")
    np.testing.assert_array_equal(dense.values, values)


def test_classes_have_types_that_hold_what_they_mean():
    assert set(CLASS_TYPES) == set(GRID_CLASSES) - {"unknown"}
    for name in ("level set", "fog volume"):
        assert set(CLASS_TYPES[name]) == set(ISOSURFACE_TYPES)
    assert all(BY_NAME[name].family == "vector" for name in CLASS_TYPES["staggered"])
    assert CLASS_TYPES["topology"] == ("mask",)
    grid = from_dense(np.ones((2, 2, 2), np.float32), transform=np.eye(4), grid_class="voxel volume")
    with pytest.raises(UnsupportedGridError, match="voxel volume"):
        quantize(grid, "fp8")


@with_openvdb
@pytest.mark.parametrize("name", NAMES)
def test_openvdb_writes_what_the_table_says(tmp_path, name):
    kind = BY_NAME[name]
    if kind.has_values:
        buffer = TypedGrid(name).volume.nanovdb
    else:
        buffer = TypedGrid("float").volume.nanovdb.copy()
        buffer[636:640].view("<u4")[0] = kind.number
    path = tmp_path / "grid.vdb"
    if kind.openvdb is None:
        with pytest.raises(GeokitError, match=r"has no OpenVDB counterpart|cannot be converted"):
            native.write_vdb(path, [VdbGrid(buffer, {})])
        return
    native.write_vdb(path, [VdbGrid(buffer, {})])
    (header,) = native.inspect_vdb(path)
    wanted = "float" if kind.family == "quantized" else name
    assert (header["grid_type"], header["convertible"]) == (wanted, True)
    (grid,) = native.read_vdb(path)
    assert int(grid.nanovdb[636:640].view("<u4")[0]) == BY_NAME[wanted].number
    assert f"Tree_{kind.openvdb}_5_4_3".encode() in path.read_bytes()


def test_the_extensions_list_of_types_is_the_table():
    # From its source: the dispatch of the bridge names each type with NanoVDB's own spelling.
    text = (PACKAGE / "native" / "src" / "nano_types.h").read_text()
    known = {name.lower() for name in re.findall(r"case GridType::(\w+):", text)}
    known = {"bool" if name == "boolean" else name for name in known}
    assert known == {kind.name for kind in TYPES if kind.openvdb}


def lists_of_types(path: Path) -> list[tuple[int, list[str]]]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.Tuple, ast.List, ast.Set, ast.Dict)):
            parts = [*node.keys, *node.values] if isinstance(node, ast.Dict) else node.elts
            constants = {part.value for part in parts if isinstance(part, ast.Constant)}
            names = sorted(constants & (set(NAMES) - {"unknown", "index"}))
            if len(names) > 2:
                found.append((node.lineno, names))
    return found


@pytest.mark.slow
def test_no_other_module_lists_grid_types():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).as_posix()
        if place not in (*CHOICES, "volume/nanovdb/types.py") and (lists := lists_of_types(path)):
            found[place] = lists
    assert not found, f"take these from nanovdb/types.py: {found}"


def test_the_page_of_formats_lists_the_types():
    text = " ".join((Path(__file__).parents[3] / "docs" / "formats.md").read_text().split())
    for names in (COMPONENTS, INDEX_TYPES):
        assert f"`{' '.join(names)}`" in text, f"docs/formats.md must list the grids `{' '.join(names)}`"
