"""Corner attributes moved to vertices: every corner keeps its position and its values, and vertices their numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh.attributes.seams import split_seams
from tests.support.attributed import numbered
from tests.support.effort import of_all


@settings(max_examples=of_all(20, 40), deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from([np.uint8, np.int64, np.float16, np.float64]))
def test_corners_keep_their_values(seed, kinds, dtype):
    random = np.random.default_rng(seed)
    mesh = mesh_catalog.join(mesh_catalog.torus(5, 4), mesh_catalog.unreferenced_vertices())
    values = random.integers(0, kinds, (mesh.face_count, 3, 3)).astype(dtype)
    if np.dtype(dtype).kind == "f":
        values[values == 0] = random.choice([np.nan, -0.0, np.inf])
    given_data = {"a": values, "b": values[..., 0]}
    vertex = {"n": np.arange(mesh.vertex_count), "a": np.zeros(mesh.vertex_count)}
    mesh = gk.mesh.TriangleMesh(mesh.vertices, mesh.faces, vertex_data=vertex, corner_data={**given_data, "c": values})
    split = split_seams(mesh, ["a", "b"])
    np.testing.assert_array_equal(split.vertices[split.faces], mesh.vertices[mesh.faces])
    assert split.vertex_data["n"][split.faces].tolist() == mesh.faces.tolist()
    for name, expected in given_data.items():
        assert split.vertex_data[name].dtype == dtype
        np.testing.assert_array_equal(split.vertex_data[name][split.faces], expected)
    assert list(split.corner_data) == ["c"]
    # Vertices keep their numbers, and there is one for each set of values.
    np.testing.assert_array_equal(split.vertices[: mesh.vertex_count], mesh.vertices)
    rows = {(int(v), values[f, k].tobytes()) for f, face in enumerate(mesh.faces) for k, v in enumerate(face)}
    unused = mesh.vertex_count - len(np.unique(mesh.faces))
    assert split.vertex_count == len(rows) + unused
    if kinds == 1:
        np.testing.assert_array_equal(split.faces, mesh.faces)


def test_split_and_merged_is_the_same_mesh():
    mesh = numbered(mesh_catalog.torus(6, 5))
    split = split_seams(mesh, ["c", "c2"])
    assert split.vertex_count == 3 * mesh.face_count
    merged = gk.mesh.merge_vertices(split)
    assert merged.vertex_count == mesh.vertex_count
    np.testing.assert_array_equal(merged.vertices[merged.faces], mesh.vertices[mesh.faces])
    for name, values in mesh.corner_data.items():
        np.testing.assert_array_equal(merged.corner_data[name], values)
    for name, values in mesh.vertex_data.items():
        np.testing.assert_array_equal(merged.vertex_data[name], values)
    assert split_seams(mesh, []) is mesh
