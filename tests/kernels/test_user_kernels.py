"""Queries inside of kernels have the bits of the calls, on every device."""

from __future__ import annotations

import gc
from typing import Any

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog.typed_grids import QUANTIZED, SCALARS, VECTORS, TypedGrid
from tests.support.devices import DEVICES

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
wp.set_module_options({"fuse_fp": False})
COUNT = 400
RNG = np.random.default_rng(5)
BAD = np.array([[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [1e151, 0.0, 0.0]])


@wp.kernel
def closest_kernel(
    surface: gk.kernels.Surface,
    is_signed: bool,
    points: wp.array(dtype=wp.vec3d),
    reach: wp.float64,
    out_point: wp.array(dtype=wp.vec3d),
    out_distance: wp.array(dtype=wp.float64),
    out_triangle: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    if is_signed:
        found = gk.kernels.signed_distance(surface, points[i], reach)
    else:
        found = gk.kernels.closest_point(surface, points[i], reach)
    out_point[i] = found.point
    out_distance[i] = found.distance
    out_triangle[i] = found.triangle_id
    out_barycentric[i] = found.barycentric


@wp.kernel
def ray_kernel(
    surface: gk.kernels.Surface,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    t_min: wp.float64,
    reach: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_occluded: wp.array(dtype=wp.bool),
):
    i = wp.tid()
    hit = gk.kernels.raycast(surface, origins[i], directions[i], t_min, reach)
    out_t[i] = hit.t
    out_triangle[i] = hit.triangle_id
    out_barycentric[i] = hit.barycentric
    out_occluded[i] = gk.kernels.occluded(surface, origins[i], directions[i], t_min, reach)


# A function of the user's with the name of one of geokit's.
@wp.func
def sample(x: wp.float64) -> wp.float64:
    return wp.float64(2.0) * x


@wp.kernel
def sample_kernel(
    volume: gk.kernels.SparseVolume,
    points: wp.array(dtype=wp.vec3d),
    out_twice: wp.array(dtype=wp.float64),
    out_gradient: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    out_twice[i] = sample(gk.kernels.sample(volume, points[i]))
    out_gradient[i] = gk.kernels.gradient(volume, points[i])


@wp.kernel
def list_kernel(
    grid: gk.kernels.NeighborGrid,
    points: wp.array(dtype=wp.vec3d),
    radius: wp.float64,
    offsets: wp.array(dtype=wp.int64),
    out_count: wp.array(dtype=int),
    out_index: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.float64),
):
    i = wp.tid()
    count = int(0)
    near = gk.kernels.first_neighbor(grid, points[i], radius)
    while near.index >= 0:
        out_index[int(offsets[i]) + count] = near.index
        out_distance[int(offsets[i]) + count] = near.distance
        count += 1
        near = gk.kernels.next_neighbor(grid, near)
    out_count[i] = count


@wp.kernel
def loss_kernel(
    surface: gk.kernels.Surface,
    volume: gk.kernels.SparseVolume,
    points: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    weights: wp.array(dtype=wp.vec3d),
    what: int,
    out_loss: wp.array(dtype=wp.float64),
):
    i = wp.tid()
    two = wp.float64(2.0)
    if what == 0:
        found = gk.kernels.closest_point(surface, points[i])
        out_loss[i] = two * found.distance + wp.dot(weights[i], found.point) + wp.dot(weights[i], found.barycentric)
    elif what == 1:
        found = gk.kernels.signed_distance(surface, points[i])
        out_loss[i] = two * found.distance + wp.dot(weights[i], found.point) + wp.dot(weights[i], found.barycentric)
    elif what == 2:
        hit = gk.kernels.raycast(surface, points[i], directions[i])
        if hit.triangle_id >= 0:
            out_loss[i] = two * hit.t + wp.dot(weights[i], hit.barycentric)
    else:
        out_loss[i] = two * gk.kernels.sample(volume, points[i])


def there(rows: Any, device: str, dtype: Any = wp.vec3d, **options: Any) -> wp.array:
    return wp.array(np.asarray(rows), dtype=dtype, device=device, **options)


def empties(count: int, device: str, *kinds: Any) -> list[wp.array]:
    return [wp.empty(count, dtype=kind, device=device) for kind in kinds]


def closest_inside(
    handle: Any, points: np.ndarray, device: str, reach: float = np.inf, signed: bool = False
) -> list[np.ndarray]:
    out = empties(len(points), device, wp.vec3d, wp.float64, wp.int32, wp.vec3d)
    inputs = [handle, signed, there(points, device), wp.float64(reach)]
    wp.launch(closest_kernel, len(points), inputs=inputs, outputs=out, device=device)
    return [array.numpy() for array in out]


def meshes() -> dict[str, gk.mesh.TriangleMesh]:
    torus = gk.mesh.load("data/samples/torus.ply")
    both = gk.mesh.TriangleMesh(torus.vertices, np.concatenate([torus.faces, torus.faces[:, ::-1]]))
    ball = gk.mesh.sphere(1.0, segments=16)
    deck = gk.mesh.TriangleMesh([[-0.3, -0.3, 0], [0.3, -0.3, 0], [0, 0.3, 0]], [[0, 1, 2]])
    holed = gk.mesh.TriangleMesh(torus.vertices, torus.faces[::3])
    return {
        "closed": torus,
        "slivers": gk.mesh.load("data/samples/bracket.obj"),
        "open": holed,
        "sheet": gk.mesh.plane(segments=12),
        "doubled": both,
        "deck in a ball": gk.mesh.TriangleMesh(
            np.concatenate([ball.vertices, deck.vertices]), np.concatenate([ball.faces, deck.faces + ball.vertex_count])
        ),
        "one triangle": deck,
    }


MESHES = meshes()


@pytest.fixture(params=list(MESHES))
def mesh(request: pytest.FixtureRequest) -> gk.mesh.TriangleMesh:
    return MESHES[request.param]


def queries_of(mesh: gk.mesh.TriangleMesh) -> np.ndarray:
    """Points around a mesh, on it, on its vertices, and far away."""
    (lower, upper), size = mesh.bounds, mesh.diagonal
    around = RNG.uniform(lower - 0.3 * size, upper + 0.3 * size, (COUNT, 3))
    on = gk.mesh.sample_surface(mesh, 50, seed=0).points
    far = RNG.normal(size=(20, 3)) * 10.0 ** RNG.uniform(1.0, 12.0, (20, 1)) * size
    return np.concatenate([around, on, mesh.vertices[:50], far])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("share", [np.inf, 0.1])
def test_closest_points_and_signs_have_the_bits_of_the_calls(mesh, device, share):
    surface, points, reach = gk.mesh.Surface(mesh, device=device), queries_of(mesh), share * mesh.diagonal
    for sign in ("auto", "winding", "pseudonormal"):
        handle = surface.on_kernel(sign)
        found = surface.closest_point(points, max_distance=reach)
        for one, other in zip(closest_inside(handle, points, device, reach), found, strict=True):
            np.testing.assert_array_equal(one, other)
        signed = surface.signed_distance(points, sign=sign, max_distance=reach)
        _, distance, triangle, _ = closest_inside(handle, points, device, reach, signed=True)
        np.testing.assert_array_equal(triangle, signed.triangle_id)
        # On a GPU winding numbers are float32, and do not tell on which side a point on the surface is.
        told = np.abs(distance) > (1e-6 * mesh.diagonal if device != "cpu" else -1.0)
        np.testing.assert_array_equal(distance[told], signed.distance[told])
        np.testing.assert_array_equal(np.abs(distance), np.abs(signed.distance))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("limits", [(0.0, np.inf), (0.2, 0.7)])
def test_rays_have_the_bits_of_the_calls(mesh, device, limits):
    surface, (lower, upper) = gk.mesh.Surface(mesh, device=device), mesh.bounds
    aims = np.concatenate([gk.mesh.sample_surface(mesh, COUNT, seed=1).points, mesh.vertices[mesh.faces[:50]].mean(1)])
    # Some aim at vertices and edges exactly.
    aims[:60:2] = mesh.vertices[RNG.integers(0, mesh.vertex_count, 30)]
    origins = RNG.uniform(lower - mesh.diagonal, upper + mesh.diagonal, aims.shape)
    directions = (aims - origins) * RNG.uniform(0.1, 3.0, (len(aims), 1))
    t_min, reach = limits[0], limits[1] * mesh.diagonal
    out = empties(len(aims), device, wp.float64, wp.int32, wp.vec3d, wp.bool)
    inputs = [
        surface.on_kernel(None),
        there(origins, device),
        there(directions, device),
        wp.float64(t_min),
        wp.float64(reach),
    ]
    wp.launch(ray_kernel, len(aims), inputs=inputs, outputs=out, device=device)
    found = surface.raycast(origins, directions, t_min=t_min, max_distance=reach)
    for one, other in zip(out, found, strict=False):
        np.testing.assert_array_equal(one.numpy(), other)
    occluded = surface.occluded(origins, directions, t_min=t_min, max_distance=reach)
    np.testing.assert_array_equal(out[3].numpy(), occluded)
    assert 0 < np.isfinite(out[0].numpy()).sum()


@pytest.mark.parametrize("device", DEVICES)
def test_rows_that_are_not_finite_are_misses(device):
    surface = gk.mesh.Surface(MESHES["closed"], device=device)
    point, distance, triangle, _ = closest_inside(surface.on_kernel(), BAD, device, signed=True)
    assert np.isnan(point).all()
    assert (distance == np.inf).all()
    assert (triangle == -1).all()
    origins, directions = (
        np.array([[np.nan, 0, 0], [0, 0, 0], [0, 0, 0.0]]),
        np.array([[1, 0, 0], [0, 0, 0], [np.inf, 0, 0]]),
    )
    out = empties(3, device, wp.float64, wp.int32, wp.vec3d, wp.bool)
    inputs = [
        surface.on_kernel(None),
        there(origins, device),
        there(directions, device),
        wp.float64(0),
        wp.float64(np.inf),
    ]
    wp.launch(ray_kernel, 3, inputs=inputs, outputs=out, device=device)
    assert (out[1].numpy() == -1).all()
    assert not out[3].numpy().any()


@pytest.mark.parametrize("limit", [-1.0, -np.inf, np.nan])
@pytest.mark.parametrize("device", DEVICES)
def test_limits_that_are_none_are_misses(device, limit):
    surface = gk.mesh.Surface(MESHES["closed"], device=device)
    points = RNG.uniform(-1.0, 1.0, (20, 3))
    assert (closest_inside(surface.on_kernel(), points, device, signed=False, reach=limit)[2] == -1).all()
    for limits in ((limit, np.inf), (0.0, limit)):
        out = empties(20, device, wp.float64, wp.int32, wp.vec3d, wp.bool)
        rays = [there(points, device), there(-points, device)]
        inputs = [surface.on_kernel(None), *rays, *map(wp.float64, limits)]
        wp.launch(ray_kernel, 20, inputs=inputs, outputs=out, device=device)
        assert (out[1].numpy() == -1).all()
        assert not out[3].numpy().any()


def test_signs_are_those_that_were_asked_for():
    surface = gk.mesh.Surface(MESHES["closed"], device="cpu")
    assert np.isnan(closest_inside(surface.on_kernel(None), np.zeros((1, 3)), "cpu", signed=True)[1]).all()
    with pytest.raises(gk.InputError, match="sign: 'parity' .* use 'winding'"):
        surface.on_kernel("parity")
    with pytest.raises(gk.InputError, match="sign: 'best'"):
        surface.on_kernel("best")


def test_what_a_kernel_takes_keeps_the_surface_and_does_not_follow_it():
    torus, points = MESHES["closed"], RNG.uniform(-1.5, 1.5, (COUNT, 3))
    surface = gk.mesh.Surface(torus, device="cpu")
    before = surface.on_kernel()
    expected = surface.signed_distance(points).distance
    surface.update(torus.vertices + [0.0, 0.0, 1.0])
    moved = surface.signed_distance(points).distance
    np.testing.assert_array_equal(closest_inside(surface.on_kernel(), points, "cpu", signed=True)[1], moved)
    del surface
    gc.collect()
    np.testing.assert_array_equal(closest_inside(before, points, "cpu", signed=True)[1], expected)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", [*SCALARS, *QUANTIZED])
def test_samples_have_the_bits_of_the_calls(device, kind):
    volume = TypedGrid(kind).volume
    index = np.concatenate([RNG.uniform(-12.0, 12.0, (COUNT, 3)), RNG.uniform(-300.0, 300.0, (50, 3)), [[3e9, 0, 0]]])
    matrix = volume.info.transform
    points = index @ matrix[:3, :3].T + matrix[:3, 3]
    twice, slopes = empties(len(points), device, wp.float64, wp.vec3d)
    inputs = [volume.on_kernel(device), there(points, device)]
    wp.launch(sample_kernel, len(points), inputs=inputs, outputs=[twice, slopes], device=device)
    np.testing.assert_array_equal(twice.numpy(), 2.0 * volume.sample(points, order=1, device=device))
    np.testing.assert_array_equal(slopes.numpy(), volume.gradient(points, order=1, device=device))


def test_a_point_that_is_not_finite_has_the_background():
    volume = gk.volume.from_mesh(MESHES["closed"], voxel_size=0.1, device="cpu")
    twice, slopes = empties(3, "cpu", wp.float64, wp.vec3d)
    wp.launch(
        sample_kernel, 3, inputs=[volume.on_kernel("cpu"), there(BAD, "cpu")], outputs=[twice, slopes], device="cpu"
    )
    np.testing.assert_array_equal(twice.numpy(), 2.0 * float(volume.info.background))
    assert not slopes.numpy().any()


def test_vectors_are_refused():
    with pytest.raises(gk.UnsupportedGridError, match=r"does not hold numbers.*volume\.sample"):
        TypedGrid(VECTORS[0]).volume.on_kernel("cpu")


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("factor", [0.0, 0.4, 1.0, 3.0, 40.0])
def test_neighbors_are_those_of_the_search(device, factor):
    points = np.concatenate([RNG.uniform(0.0, 1.0, (500, 3)), RNG.normal(0.5, 0.01, (100, 3)), [[0.5, 0.5, 0.5]] * 70])
    queries = np.concatenate([points, RNG.uniform(-1.0, 2.0, (100, 3)), [[1e9, 0.0, 0.0], [np.nan, 0.0, 0.0]]])
    grid = gk.points.NeighborGrid(points, 0.1, device=device)
    found = grid.radius_search(queries[:-1], radius=0.1 * factor, order="index")
    offsets = np.append(found.offsets, found.offsets[-1])
    count, index, distance = (
        *empties(len(queries), device, wp.int32),
        *empties(len(found.indices), device, wp.int32, wp.float64),
    )
    inputs = [grid.on_kernel(), there(queries, device), wp.float64(0.1 * factor), there(offsets, device, wp.int64)]
    wp.launch(list_kernel, len(queries), inputs=inputs, outputs=[count, index, distance], device=device)
    np.testing.assert_array_equal(count.numpy()[:-1], np.diff(found.offsets))
    assert count.numpy()[-1] == 0
    order = np.lexsort((index.numpy(), np.repeat(np.arange(len(queries)), count.numpy())))
    np.testing.assert_array_equal(index.numpy()[order], found.indices)
    np.testing.assert_array_equal(distance.numpy()[order], found.distance)


def test_groups_and_cells_that_repeat_are_refused():
    with pytest.raises(gk.InputError, match="groups: kernels cannot tell them apart"):
        gk.points.NeighborGrid(np.zeros((4, 3)), 1.0, groups=[0, 2, 4], device="cpu").on_kernel()
    with pytest.raises(gk.InputError, match="periodic: not for on_kernel"):
        gk.points.NeighborGrid(np.zeros((4, 3)), 0.1, periodic=[1, 1, 1], device="cpu").on_kernel()


@pytest.mark.parametrize("device", DEVICES)
def test_slopes_on_a_tape_are_those_of_torch(device):
    torch = pytest.importorskip("torch")
    torus = MESHES["closed"]
    surface = gk.mesh.Surface(torus, device=device)
    volume = gk.volume.from_mesh(torus, voxel_size=0.05, half_width=6.0, device=device)
    rows = [RNG.uniform(-1.4, 1.4, (COUNT, 3)), RNG.normal(size=(COUNT, 3)), RNG.normal(size=(COUNT, 3))]
    for what in range(4):
        points, directions = (there(array, device, requires_grad=True) for array in rows[:2])
        loss = wp.zeros(COUNT, dtype=wp.float64, device=device, requires_grad=True)
        with wp.Tape() as tape:
            inputs = [surface.on_kernel(), volume.on_kernel(device), points, directions, there(rows[2], device), what]
            wp.launch(loss_kernel, COUNT, inputs=inputs, outputs=[loss], device=device)
        tape.backward(grads={loss: wp.full_like(loss, 1.0)})
        p, d = (torch.tensor(array, device=str(wp.device_to_torch(device)), requires_grad=True) for array in rows[:2])
        w = torch.tensor(rows[2], device=p.device)
        if what < 2:
            found = surface.signed_distance(p) if what else surface.closest_point(p)
            total = 2.0 * found.distance + (found.points * w).sum(1) + (found.barycentric * w).sum(1)
        elif what == 2:
            hit = surface.raycast(p, d)
            total = (2.0 * hit.t + (hit.barycentric * w).sum(1))[hit.triangle_id >= 0]
        else:
            total = 2.0 * volume.sample(p, order=1, device=device)
        total.sum().backward()
        np.testing.assert_allclose(points.grad.numpy(), p.grad.cpu().numpy(), rtol=1e-12, atol=1e-12)
        if what == 2:
            np.testing.assert_allclose(directions.grad.numpy(), d.grad.cpu().numpy(), rtol=1e-12, atol=1e-12)
        assert np.abs(points.grad.numpy()).max() > 0.0
