"""Attributes at closest points, on other meshes, on simplified ones and on samples, against a float64 reference."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.mesh.attributes.interpolation import closest_weights, weights_within
from tests.support.attributed import numbered, painted

TORUS = mesh_catalog.torus(24, 12)
RANDOM = np.random.default_rng(5)


def closest_by_hand(mesh, points):
    """The face and the weights of its corners at the closest point, by all edges and faces in float64."""
    found = []
    for point in points:
        best = (np.inf, -1, None)
        for number, (a, b, c) in enumerate(mesh.vertices[mesh.faces]):
            candidates = []
            normal = np.cross(b - a, c - a)
            w = np.linalg.solve(np.column_stack([b - a, c - a, normal]), point - a)
            if w[0] >= 0 and w[1] >= 0 and w[0] + w[1] <= 1:
                candidates.append((1 - w[0] - w[1], w[0], w[1]))
            for i, j in ((0, 1), (1, 2), (2, 0)):
                p, q = (a, b, c)[i], (a, b, c)[j]
                t = np.clip(np.dot(point - p, q - p) / np.dot(q - p, q - p), 0, 1)
                weights = [0.0, 0.0, 0.0]
                weights[i], weights[j] = 1 - t, t
                candidates.append(tuple(weights))
            for weights in candidates:
                distance = np.linalg.norm(weights @ np.stack([a, b, c]) - point)
                if distance < best[0] - 1e-14:
                    best = (distance, number, np.array(weights))
        found.append(best[1:])
    return np.array([number for number, _ in found]), np.array([weights for _, weights in found])


@pytest.mark.parametrize("kind", [np.asarray, list, lambda point: pytest.importorskip("torch").tensor(point)])
def test_one_point_has_one_answer(kind):
    values = RANDOM.normal(size=(TORUS.vertex_count, 2))
    data = {"values": values, "heat": values[:, 0]}
    mesh = gk.mesh.TriangleMesh(
        TORUS.vertices, TORUS.faces, vertex_data=data, face_data={"id": range(len(TORUS.faces))}
    )
    surface, point = gk.mesh.Surface(mesh, device="cpu"), RANDOM.normal(size=3)
    found, expected = surface.sample_attributes(kind(point)), surface.sample_attributes(point[None])
    assert {name: np.shape(value) for name, value in found.items()} == {"values": (2,), "heat": (), "id": ()}
    for name, rows in expected.items():
        np.testing.assert_array_equal(found[name], rows[0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.asarray, lambda points: points.astype(np.float32)])
def test_samples_are_those_of_the_reference(kind):
    mesh = mesh_catalog.torus(10, 6)
    values = RANDOM.normal(size=(mesh.vertex_count, 2))
    corner = RANDOM.normal(size=(mesh.face_count, 3)).astype(np.float32)
    color = RANDOM.integers(0, 256, (mesh.vertex_count, 3)).astype(np.uint8)
    label, face = np.arange(mesh.vertex_count), np.arange(mesh.face_count) * 7
    data = {"values": values, "color": color, "label": label, "face": np.zeros(mesh.vertex_count)}
    mesh = gk.mesh.TriangleMesh(
        mesh.vertices,
        mesh.faces,
        vertex_data=data,
        corner_data={"corner": corner},
        face_data={"row": face, "label": face},
    )
    points = kind(RANDOM.normal(size=(60, 3)))
    found = gk.mesh.Surface(mesh, device="cpu").sample_attributes(points)
    rows, weights = closest_by_hand(mesh, points.astype(np.float64))
    corners = mesh.faces[rows]
    np.testing.assert_allclose(found["values"], np.einsum("nc,nck->nk", weights, values[corners]), atol=1e-11)
    # On edges and at vertices several faces are closest.
    inside = weights.min(axis=1) > 1e-9
    assert inside.sum() > 15
    expected = np.einsum("nc,nc->n", weights, corner[rows])
    np.testing.assert_allclose(found["corner"][inside], expected[inside], atol=3e-7)
    assert found["corner"].dtype == np.float32
    expected = np.einsum("nc,nck->nk", weights, color[corners].astype(float))
    assert found["color"].dtype == np.uint8
    assert np.abs(found["color"] - expected).max() <= 0.5 + 1e-9
    np.testing.assert_array_equal(found["row"][inside], rows[inside] * 7)
    # A label is that of the corner with the largest weight, wherever one is clearly the largest.
    ordered = np.sort(weights, axis=1)
    clear = ordered[:, 2] - ordered[:, 1] > 1e-9
    assert clear.sum() > 30
    np.testing.assert_array_equal(found["label"][clear], corners[np.arange(60), weights.argmax(axis=1)][clear])


def test_misses_names_and_containers():
    import warp as wp

    mesh = numbered(TORUS)
    surface = gk.mesh.Surface(mesh, device="cpu")
    points = np.concatenate([mesh.vertices[:3], [[50.0, 0, 0]]])
    found = surface.sample_attributes(points, max_distance=1.0)
    assert list(found) == ["v", "v2", "f", "f2", "c", "c2"]
    assert found["v"].tolist() == [0, 1, 2, 0]
    assert np.isnan(found["v2"][3]).all()
    assert list(surface.sample_attributes(points, names=["v"])) == ["v"]
    at = wp.array(points, dtype=wp.vec3d, device="cpu")
    for name, values in surface.sample_attributes(at, max_distance=1.0).items():
        np.testing.assert_array_equal(values, found[name])
    with pytest.raises(gk.InputError, match=r"has no 'w'; it has 'v', 'v2', 'f', 'f2', 'c', 'c2'"):
        surface.sample_attributes(points, names=["w"])
    material = gk.mesh.TriangleMesh(TORUS.vertices, TORUS.faces, face_data={"material": np.zeros(len(TORUS), int)})
    far = gk.mesh.Surface(material, device="cpu").sample_attributes([[9.0, 0, 0]], max_distance=1.0)
    assert far["material"].tolist() == [-1]


def test_a_missing_value_matters_only_where_it_has_weight():
    values = [1.0, 2.0, np.nan]
    triangle = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], vertex_data={"a": values})
    surface = gk.mesh.Surface(triangle, device="cpu")
    found = surface.sample_attributes([[0.5, 0, 0], [0.5, -1, 0], [0.2, 0.2, 0]])["a"]
    assert found[:2].tolist() == [1.5, 1.5]
    assert np.isnan(found[2])


def test_normals_have_unit_length():
    mesh = painted(TORUS)
    normal = gk.mesh.Surface(mesh, device="cpu").sample_attributes(RANDOM.normal(size=(200, 3)))["normal"]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=2e-7)


@pytest.mark.parametrize("make", [numbered, painted])
def test_transfer_to_the_same_mesh_is_the_same(make):
    mesh = make(TORUS)
    bare = gk.mesh.TriangleMesh(TORUS.vertices, TORUS.faces, vertex_data={"own": np.zeros(TORUS.vertex_count)})
    again = gk.mesh.transfer_attributes(bare, mesh, device="cpu")
    for kind in ("vertex_data", "face_data", "corner_data"):
        for name, values in getattr(mesh, kind).items():
            found = getattr(again, kind)[name]
            assert found.dtype == values.dtype
            # Normals get unit length again.
            np.testing.assert_allclose(found, values, rtol=0, atol=1e-7 if name == "normal" else 0, err_msg=name)
    assert "own" in again.vertex_data
    assert again.materials == (mesh.materials if "material" in mesh.face_data else ())
    assert not gk.mesh.transfer_attributes(bare, mesh, names=[], device="cpu").face_data


def test_corners_stay_on_their_side_of_a_crease():
    box = mesh_catalog.box()
    normal = np.repeat(np.asarray(box.face_normals)[:, None], 3, axis=1)
    sharp = gk.mesh.TriangleMesh(box.vertices, box.faces, corner_data={"normal": normal})
    fine = gk.mesh.box(center=(0.5, 0.5, 0.5))
    found = gk.mesh.transfer_attributes(fine, sharp, device="cpu").corner_data["normal"]
    np.testing.assert_allclose(found, np.repeat(fine.face_normals[:, None], 3, axis=1), atol=1e-15)


def sided(thickness):
    """A hollow ball with a thin wall; its attributes are 1 outside and 2 inside."""
    ball = gk.mesh.sphere(radius=1.0, segments=40)
    side, n = np.repeat([1.0, 2.0], ball.face_count), ball.vertex_count
    return gk.mesh.TriangleMesh(
        np.concatenate([ball.vertices, (1.0 - thickness) * ball.vertices]),
        np.concatenate([ball.faces, ball.faces[:, ::-1] + n]),
        vertex_data={"v": np.repeat([1.0, 2.0], n)},
        face_data={"f": side.astype(int)},
        corner_data={"c": np.repeat(side[:, None], 3, axis=1)},
    )


@pytest.mark.parametrize("arguments", [{"tolerance": 0.02}, {"tolerance": 0.1}, {"face_count": 400}])
@pytest.mark.parametrize("thickness", [0.02, 0.008, 1e-4])
def test_nothing_comes_from_the_other_side_of_a_thin_wall(thickness, arguments):
    mesh = sided(thickness)
    simple = gk.mesh.simplify(mesh, device="cpu", **arguments).mesh
    bare = gk.mesh.TriangleMesh(simple.vertices, simple.faces)
    side = np.where(np.einsum("ij,ij->i", simple.face_normals, simple.vertices[simple.faces[:, 0]]) > 0, 1, 2)
    at_vertices = np.zeros(simple.vertex_count)
    at_vertices[simple.faces] = side[:, None]
    for found in (simple, gk.mesh.transfer_attributes(bare, mesh, device="cpu")):
        np.testing.assert_array_equal(found.face_data["f"], side)
        np.testing.assert_allclose(found.vertex_data["v"], at_vertices, atol=1e-9)
        np.testing.assert_allclose(found.corner_data["c"], np.repeat(side[:, None], 3, axis=1), atol=1e-9)


def test_where_nothing_faces_the_same_way_the_closest_point_counts():
    mesh = numbered(TORUS)
    back = gk.mesh.TriangleMesh(TORUS.vertices, TORUS.faces[:, ::-1])
    found = gk.mesh.transfer_attributes(back, mesh, names=["f"], device="cpu")
    np.testing.assert_array_equal(found.face_data["f"], mesh.face_data["f"])


def test_closest_weights_are_those_of_the_reference():
    triangle = gk.mesh.TriangleMesh(RANDOM.normal(size=(3, 3)), [[0, 1, 2]])
    points = RANDOM.normal(size=(200, 3)) * 2
    weights, distance = closest_weights(np.repeat(triangle.vertices[None], 200, axis=0), points)
    np.testing.assert_allclose(weights, closest_by_hand(triangle, points)[1], atol=1e-12)
    np.testing.assert_allclose(distance, np.linalg.norm(weights @ triangle.vertices - points, axis=1), atol=1e-12)


def test_weights_are_within_the_triangle():
    corners = RANDOM.normal(size=(300, 3, 3))
    corners[0] = corners[0, :1]
    weights = RANDOM.dirichlet([1, 1, 1], 300)
    points = np.einsum("nc,nck->nk", weights, corners)
    found = weights_within(corners, points)
    np.testing.assert_allclose(found[1:], weights[1:], atol=1e-9)
    assert found[0].tolist() == [1.0, 0.0, 0.0]
    outside = weights_within(corners, RANDOM.normal(size=(300, 3)) * 9)
    assert outside.min() >= 0.0
    np.testing.assert_allclose(outside.sum(axis=1), 1.0, atol=1e-15)
    assert (weights_within(corners[1:], corners[1:, 1]) == [0.0, 1.0, 0.0]).all()


def test_simplified_meshes_keep_their_attributes():
    sphere = gk.mesh.sphere(segments=40)
    parts = {
        "vertex_data": {"height": sphere.vertices[:, 2].astype(np.float32), "normal": sphere.vertices},
        "face_data": {"material": (sphere.vertices[sphere.faces].mean(axis=1)[:, 0] > 0).astype(int)},
        "materials": [gk.mesh.Material("left"), gk.mesh.Material("right")],
        "meters_per_unit": 0.01,
    }
    mesh = gk.mesh.TriangleMesh(sphere.vertices, sphere.faces, **parts)
    simple = gk.mesh.simplify(mesh, tolerance=0.03, device="cpu").mesh
    assert len(simple) < len(mesh) / 4
    np.testing.assert_allclose(simple.vertex_data["height"], simple.vertices[:, 2], atol=0.03)
    assert simple.vertex_data["height"].dtype == np.float32
    cosine = np.einsum("ij,ij->i", simple.vertex_data["normal"], simple.vertices)
    assert (cosine / np.linalg.norm(simple.vertices, axis=1)).min() > np.cos(0.1)
    middle = simple.vertices[simple.faces].mean(axis=1)[:, 0]
    sure = np.abs(middle) > 0.05
    np.testing.assert_array_equal(simple.face_data["material"][sure], middle[sure] > 0)
    assert (simple.materials, simple.meters_per_unit) == (mesh.materials, 0.01)
    plain = gk.mesh.simplify(sphere, tolerance=0.03, device="cpu").mesh
    assert plain == gk.mesh.TriangleMesh(simple.vertices, simple.faces, name="sphere")


def test_seams_of_a_soup_survive_simplification():
    """Texture coordinates on duplicated vertices: after simplification they are on corners, on both sides right."""
    box = gk.mesh.box()
    fine = gk.mesh.TriangleMesh(*subdivided(box.vertices, box.faces, 3))
    soup = mesh_catalog.soup(fine)
    normal = np.repeat(soup.face_normals, 3, axis=0)
    assert (soup.faces.ravel() == np.arange(3 * len(soup))).all()
    mesh = gk.mesh.TriangleMesh(soup.vertices, soup.faces, vertex_data={"normal": normal})
    simple = gk.mesh.simplify(mesh, tolerance=0.01, device="cpu").mesh
    assert len(simple) < len(mesh) / 4
    expected = np.repeat(simple.face_normals[:, None], 3, axis=1)
    assert np.einsum("fck,fck->fc", simple.corner_data["normal"], expected).min() > 0.99


def subdivided(vertices, faces, times):
    for _ in range(times):
        corners = vertices[faces]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c = np.moveaxis(corners, 1, 0)
        ab, bc, ca = np.moveaxis(middles, 1, 0)
        soup = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        vertices, inverse = np.unique(soup.reshape(-1, 3), axis=0, return_inverse=True)
        faces = inverse.reshape(-1, 3)
    return vertices, faces


def test_clouds_on_a_mesh_have_its_attributes():
    mesh = painted(TORUS)
    found = gk.mesh.sample_surface(mesh, 300, seed=4)
    cloud = gk.points.sample(mesh, 300, seed=4)
    np.testing.assert_array_equal(cloud.points, found.points)
    assert set(cloud.data) == {"normals", "rgba", "uv", "material"}
    corners = mesh.corner_data["uv"][found.triangle_id].astype(np.float64)
    expected = np.einsum("nc,nck->nk", found.barycentric, corners)
    np.testing.assert_allclose(cloud.data["uv"], expected, atol=1e-7)
    np.testing.assert_array_equal(cloud.data["material"], mesh.face_data["material"][found.triangle_id])
    plain = gk.points.sample(TORUS, 300, seed=4)
    np.testing.assert_allclose(plain.data["normals"], TORUS.face_normals[found.triangle_id], atol=1e-15)
    assert len(gk.points.sample(TORUS, 0)) == 0


def test_transfer_refuses_what_is_no_mesh():
    with pytest.raises(gk.InputError, match="source: str is not a TriangleMesh"):
        gk.mesh.transfer_attributes(TORUS, "torus.ply")
    with pytest.raises(gk.InputError, match="has no 'a'; it has none"):
        gk.mesh.transfer_attributes(TORUS, TORUS, names=["a"], device="cpu")
