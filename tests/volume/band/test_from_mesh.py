"""Narrow bands: every active voxel against brute force, the fill around it, and every error it promises."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog import mesh_catalog
from geokit import DeviceMemoryError, InputError, native, volume
from geokit.core import launcher
from geokit.mesh import Surface, TriangleMesh
from geokit.volume.band.band import BandShape, make_band
from geokit.volume.band.tiles import Lattice
from geokit.volume.distance_fields.from_mesh import from_mesh_with_triangles
from geokit.volume.model.sparse_volume import made_on_device
from geokit.volume.nanovdb.header import tree_header
from tests.support import reference

# float32 keeps distances to half of 2^-23 of themselves; the reference is off by far less.
ROUNDING = 2.0**-24


def dense(grid, lower, upper):
    """Values at all voxels of the index box, by nearest-voxel sampling at their centers."""
    axes = [np.arange(a, b + 1) for a, b in zip(lower, upper, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    world = index @ grid.info.transform[:3, :3].T + grid.info.transform[:3, 3]
    return world, volume.sample(grid, world, order=0, device="cpu")


@pytest.mark.slow
@pytest.mark.parametrize("half_width", [1.0, 3.0, 4.5])
@pytest.mark.parametrize(
    "mesh",
    [
        mesh_catalog.tetrahedron(),
        mesh_catalog.icosphere(1),
        mesh_catalog.torus(16, 8),
        mesh_catalog.l_profile(),
        mesh_catalog.nested_boxes(),
        mesh_catalog.inside_out_box(),
    ],
    ids=lambda mesh: mesh.name,
)
def test_every_voxel_is_exact(mesh, half_width):
    size = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 17.3
    grid = volume.from_mesh(mesh, size, half_width=half_width, device="cpu")
    lower = np.floor(mesh.bounds[0] / size).astype(int) - 6
    upper = np.ceil(mesh.bounds[1] / size).astype(int) + 6
    world, found = dense(grid, lower, upper)
    rng = np.random.default_rng(51)
    some = rng.choice(len(world), min(len(world), 1500), replace=False)
    expected = reference.signed_distance(mesh.vertices, mesh.faces, world[some])
    if mesh.name == "inside_out_box":
        inside = reference.winding_number(mesh.vertices, mesh.faces, world[some]) < -0.5
        expected = np.where(inside, -1, 1) * np.abs(expected)
    band = float(np.float32(half_width * size))
    np.testing.assert_allclose(found[some], np.clip(expected, -band, band), rtol=0, atol=2e-7 * band)
    distance = np.abs(reference.closest_point(mesh.vertices, mesh.faces, world[some]).distance)
    assert grid.info.background == pytest.approx(band)
    assert grid.info.grid_class == "level set"
    assert grid.info.grid_type == "float"
    # Counted over all voxels, not only over some: what is inside the band is active, and nothing else.
    assert grid.info.active_voxel_count == int((np.abs(found) < np.float32(band)).sum())
    assert (distance < 0.999 * band).any()


@pytest.mark.slow
def test_a_large_inside_is_negative_at_every_level_of_the_tree():
    # 500 voxels across: whole tables of lower nodes lie inside.
    mesh = mesh_catalog.icosphere(2)
    grid = volume.from_mesh(mesh, 2.0 / 500, half_width=2.0, device="cpu")
    rng = np.random.default_rng(52)
    points = rng.uniform(-1.2, 1.2, (20000, 3))
    found = volume.sample(grid, points, order=0, device="cpu")
    radius = np.linalg.norm(points, axis=1)
    assert (found[radius < 0.94] == -grid.info.background).all()
    assert (found[radius > 1.02] == grid.info.background).all()


def test_only_tiles_near_the_surface_are_touched():
    # Halving the voxel size makes four times the surface, not eight times the space.
    mesh = mesh_catalog.icosphere(3)
    small, large = (volume.from_mesh(mesh, 2.0 / n, device="cpu").info.byte_count for n in (100, 200))
    assert large < 5.0 * small


def test_far_from_the_origin_the_band_is_the_same():
    mesh = mesh_catalog.icosphere(2)
    size = 2.0**-5
    near = volume.from_mesh(mesh, size, device="cpu")
    offset = np.array([2.0**20, -(2.0**20), 2.0**19])
    far = volume.from_mesh(TriangleMesh(mesh.vertices + offset, mesh.faces), size, device="cpu")
    points = np.random.default_rng(53).uniform(-1.2, 1.2, (3000, 3))
    # Coordinates at 2^20 keep 2^-33: the mesh itself moved by that much.
    np.testing.assert_allclose(far.sample(points + offset), near.sample(points), rtol=0, atol=1e-8)
    assert np.abs(far.info.index_bounds).max() < 1 << 12
    np.testing.assert_array_equal(far.info.transform[:3, 3] % (8 * size), 0.0)


def test_a_surface_is_taken_as_it_is():
    surface = Surface(mesh_catalog.box(), device="cpu")
    grid = volume.from_mesh(surface, 0.1, name="cube")
    np.testing.assert_array_equal(
        grid.nanovdb[700:], volume.from_mesh(mesh_catalog.box(), 0.1, device="cpu").nanovdb[700:]
    )
    assert grid.info.name == "cube"


def test_open_meshes_have_exact_magnitudes_and_winding_signs():
    mesh = mesh_catalog.holed_sphere()
    surface = Surface(mesh, device="cpu")
    grid = volume.from_mesh(surface, 0.06)
    rng = np.random.default_rng(54)
    index = rng.integers(-18, 19, (3000, 3))
    found = grid.sample(index * 0.06, order=0)
    expected = surface.signed_distance(index * 0.06).distance
    band = np.abs(expected) < 0.999 * grid.info.background
    assert band.sum() > 300
    np.testing.assert_allclose(found[band], expected[band], rtol=0, atol=1e-7)


def test_threads_do_not_change_a_byte(monkeypatch):
    mesh = mesh_catalog.torus(32, 16)
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    one = from_mesh_with_triangles(mesh, 0.04, device="cpu")
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    three = from_mesh_with_triangles(mesh, 0.04, device="cpu")
    np.testing.assert_array_equal(three.distance.nanovdb, one.distance.nanovdb)
    np.testing.assert_array_equal(three.triangle_id.nanovdb, one.triangle_id.nanovdb)


def widened(grid, by=2):
    """First and last voxel of the box around the active ones, and some more."""
    return grid.info.index_bounds + np.array([[-by], [by]])


def voxels_of(mesh, size, margin, count, seed):
    """Random voxels in the mesh's box and some more, and where they are."""
    rng = np.random.default_rng(seed)
    lower = np.floor(mesh.bounds[0] / size).astype(int) - margin
    upper = np.ceil(mesh.bounds[1] / size).astype(int) + margin
    index = rng.integers(lower, upper + 1, (count, 3))
    return index, index * size


@pytest.mark.slow
@pytest.mark.parametrize("half_width", [(1.5, 4.0), (5.0, 1.5), (1.0, 2.0)])
def test_bands_may_be_wider_on_one_side(half_width):
    mesh = mesh_catalog.torus(24, 12)
    size = 0.05
    grid = volume.from_mesh(mesh, size, half_width=half_width, device="cpu")
    _, world = voxels_of(mesh, size, 8, 1500, 55)
    exterior, interior = (float(np.float32(width * size)) for width in half_width)
    expected = reference.signed_distance(mesh.vertices, mesh.faces, world)
    found = grid.sample(world, order=0, device="cpu")
    np.testing.assert_allclose(found, np.clip(expected, -interior, exterior), rtol=2 * ROUNDING, atol=1e-12 * size)
    assert grid.info.background == pytest.approx(exterior)
    every = dense(grid, *widened(grid))[1]
    inside_band = (every > -np.float32(interior)) & (every < np.float32(exterior))
    assert grid.info.active_voxel_count == int(inside_band.sum())
    if min(half_width) > 1.0:
        # No leaf is kept for voxels of the wider side that are not active on the narrower one.
        lower, upper = widened(grid)
        tiles = np.stack(np.nonzero(inside_band.reshape(upper - lower + 1)), axis=1) + lower >> 3
        assert int(tree_header(grid.nanovdb)["node_count"][0]) == len(np.unique(tiles, axis=0))


def test_a_shell_is_solid_around_open_and_closed_surfaces():
    for mesh, seed in ((mesh_catalog.open_shell(), 56), (mesh_catalog.torus(24, 12), 57)):
        size = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 30
        for thickness in (1.5 * size, 9.0 * size, 40.0 * size):
            grid = volume.from_mesh(mesh, size, thickness=thickness, device="cpu")
            _, world = voxels_of(mesh, size, 24, 800, seed)
            distance = reference.closest_point(mesh.vertices, mesh.faces, world).distance
            band = float(np.float32(3.0 * size))
            expected = np.clip(distance - 0.5 * thickness, -band, band)
            found = grid.sample(world, order=0, device="cpu")
            # Rounded once, after half the thickness is taken off.
            np.testing.assert_allclose(found, expected, rtol=2 * ROUNDING, atol=1e-12 * size)
            assert (found < 0).any()
            # Deep within there are no leaves: tiles of the nodes, and of the root, say so.
            assert (found[distance < 0.5 * thickness - band] == -band).all()
            assert grid.info.grid_class == "level set"
            assert grid.info.metadata["geokit:sign_method"] == "shell"


def test_unsigned_fields_are_positive_everywhere():
    mesh = mesh_catalog.icosphere(2)
    grid = volume.from_mesh(mesh, 0.05, sign="none", device="cpu")
    _, world = voxels_of(mesh, 0.05, 6, 1500, 58)
    expected = np.minimum(reference.closest_point(mesh.vertices, mesh.faces, world).distance, grid.info.background)
    np.testing.assert_allclose(grid.sample(world, order=0, device="cpu"), expected, rtol=2 * ROUNDING, atol=0)
    assert grid.info.grid_class == "unknown"
    assert grid.sample([[0.0, 0.0, 0.0]], order=0, device="cpu")[0] == grid.info.background


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mesh", "sign"),
    [
        (mesh, sign)
        for mesh in (mesh_catalog.l_profile(), mesh_catalog.nested_boxes(), mesh_catalog.torus(20, 10))
        for sign in ("auto", "winding", "pseudonormal", "parity")
    ]
    # That a mesh is clean, as pseudonormals need it, would be the caller's promise.
    + [(mesh_catalog.overlapping_spheres(), sign) for sign in ("auto", "winding", "parity")],
    ids=lambda value: getattr(value, "name", value),
)
def test_signs_are_those_of_the_surface(mesh, sign):
    surface = Surface(mesh, device="cpu")
    size = float((mesh.bounds[1] - mesh.bounds[0]).max()) / 23.7
    grid = volume.from_mesh(surface, size, sign=sign, interior="keep")
    lower, upper = np.floor(mesh.bounds[0] / size).astype(int) - 4, np.ceil(mesh.bounds[1] / size).astype(int) + 4
    for made in (grid, volume.from_mesh(surface, size, sign=sign)):
        world, found = dense(made, lower, upper)
        expected = surface.signed_distance(world, sign=sign).distance
        off = np.abs(expected) > 1e-6 * mesh.diagonal
        np.testing.assert_array_equal(np.signbit(found[off]), np.signbit(expected[off]))
    method = surface.sign_method if sign == "auto" else sign
    assert grid.info.metadata["geokit:sign_method"] == method
    assert grid.info.metadata["geokit:sign_reason"] == (surface.sign_reason if sign == "auto" else "asked for")
    assert grid.info.metadata["geokit:source"] == mesh.name
    assert grid.info.metadata["geokit:voxel_size"] == size


def test_values_may_be_quantized():
    mesh = mesh_catalog.icosphere(2)
    grid = volume.from_mesh(mesh, 0.05, codec="fp8", device="cpu")
    plain = volume.from_mesh(mesh, 0.05, device="cpu")
    assert (grid.info.grid_type, grid.info.active_voxel_count) == ("fp8", plain.info.active_voxel_count)
    _, world = voxels_of(mesh, 0.05, 6, 2000, 65)
    # Half a step of 2^8 - 1 over the six voxels that a leaf's values may differ by.
    step = 0.5 * 6 * 0.05 / 255
    apart = np.abs(grid.sample(world, order=0, device="cpu") - plain.sample(world, order=0, device="cpu"))
    assert 0.0 < apart.max() <= 1.001 * step


def test_open_meshes_are_labeled():
    grid = volume.from_mesh(mesh_catalog.holed_sphere(1), 0.1, device="cpu")
    assert grid.info.metadata["geokit:sign_method"] == "winding"
    assert grid.info.metadata["geokit:sign_reason"] == "boundary edges: 3"


def test_triangles_are_the_nearest_of_each_active_voxel():
    mesh = mesh_catalog.icosphere(2)
    found = from_mesh_with_triangles(mesh, 0.06, half_width=2.0, device="cpu")
    plain = volume.from_mesh(mesh, 0.06, half_width=2.0, device="cpu")
    np.testing.assert_array_equal(found.distance.nanovdb, plain.nanovdb)
    ids = found.triangle_id
    assert (ids.info.grid_type, ids.info.background) == ("int32", -1)
    assert ids.info.active_voxel_count == plain.info.active_voxel_count
    np.testing.assert_array_equal(ids.info.index_bounds, plain.info.index_bounds)
    world, values = dense(found.distance, *widened(plain))
    chosen = ids.sample(world, order=0, device="cpu")
    active = np.abs(values) < np.float32(plain.info.background)
    np.testing.assert_array_equal(chosen >= 0, active)
    nearest = Surface(mesh, device="cpu").closest_point(world[active])
    np.testing.assert_array_equal(chosen[active], nearest.triangle_id)


def wall(lower, upper):
    return mesh_catalog.box(tuple(lower), tuple(upper))


def test_pieces_thinner_than_a_voxel_are_named():
    # Voxel centers lie at multiples of 0.1: none of them within the second box, some within the others.
    mesh = mesh_catalog.join(
        wall((0, 0, 0), (1, 1, 1)), wall((2, 0.02, 0), (3, 0.06, 1)), wall((4, 0, 0), (5, 0.25, 1))
    )
    with pytest.warns(UserWarning, match="1 of its pieces are too thin"):
        grid = volume.from_mesh(mesh, 0.1, device="cpu")
    assert grid.info.metadata["geokit:lost_components"].split() == ["1"]
    assert (grid.sample([[2.5, 0.04, 0.5]], order=0, device="cpu") > 0).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fine = volume.from_mesh(mesh, 0.01, device="cpu")
        shell = volume.from_mesh(mesh, 0.1, thickness=0.3, device="cpu")
    assert "geokit:lost_components" not in fine.info.metadata
    assert "geokit:lost_components" not in shell.info.metadata
    with pytest.warns(UserWarning, match="too thin"):
        alone = volume.from_mesh(wall((0, 0.02, 0), (1, 0.06, 1)), 0.1, device="cpu")
    assert alone.info.metadata["geokit:lost_components"] == "0"
    with pytest.warns(UserWarning, match="too thin"):
        uneven = volume.from_mesh(wall((0, 0.02, 0), (1, 0.06, 1)), 0.1, half_width=(3.0, 2.0), device="cpu")
    assert uneven.info.metadata["geokit:lost_components"] == "0"


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_changes_nothing_but_the_scale(scale):
    mesh = mesh_catalog.torus(20, 10)
    # Powers of two keep every bit of the numbers behind the point.
    factor = 2.0 ** round(np.log2(scale))
    plain = volume.from_mesh(mesh, 0.05, device="cpu")
    scaled = volume.from_mesh(mesh_catalog.scaled(mesh, factor), 0.05 * factor, device="cpu")
    index = np.random.default_rng(59).integers(*widened(plain), (5000, 3))
    expected = plain.sample(index * 0.05, order=0, device="cpu") * factor
    np.testing.assert_array_equal(scaled.sample(index * 0.05 * factor, order=0, device="cpu"), expected)
    assert scaled.info.active_voxel_count == plain.info.active_voxel_count


def test_whole_tiles_of_translation_move_the_field():
    mesh = mesh_catalog.icosphere(1)
    size = 2.0**-4
    shift = np.array([24, -8 * 517, 8])
    moved = mesh_catalog.moved(mesh, tuple(shift * size))
    near, far = (volume.from_mesh(each, size, device="cpu") for each in (mesh, moved))
    np.testing.assert_array_equal(near.info.index_bounds + shift, far.info.index_bounds)
    index = np.random.default_rng(60).integers(*widened(near), (4000, 3))
    a = near.sample(index * size, order=0, device="cpu")
    b = far.sample((index + shift) * size, order=0, device="cpu")
    # The mesh is rounded where it is moved to: by 2^-53 of 260 units.
    np.testing.assert_allclose(a, b, rtol=0, atol=2.0**-24 * near.info.background + 2.0**-44)


def distances_by(kernels, lattice, shape):
    """Distances and slots of the band's tiles by the kernels of a GPU, on the CPU."""
    band = make_band(lattice, shape, with_slots=True)
    tiles, device = band.leaves.tiles, lattice.device
    count = len(tiles)
    where = [tiles, *lattice.arguments, lattice.surface._tree, wp.float64(shape.reach)]
    bricks = wp.empty(8 * count, dtype=wp.int32, device=device)
    launcher.launch(kernels.brick_kernel, 8 * count, where, [bricks], device)
    distance = wp.zeros((count, 512), dtype=wp.float32, device=device)
    slots = wp.zeros((count, 512), dtype=wp.int32, device=device)
    inputs = [*where, wp.float64(shape.offset), bricks, 0]
    launcher.launch(kernels.voxel_kernel, 512 * count, inputs, [distance, slots], device)
    return band, distance.numpy(), slots.numpy()


@pytest.mark.parametrize("voxel_size", [0.04, 0.3, 2.0])
def test_the_kernels_of_a_gpu_find_the_same_distances(voxel_size):
    from geokit.volume.band import distances_cuda_kernels as kernels

    # At 0.3 and 2.0 a tile sees more triangles than its list holds, and is searched voxel by voxel.
    surface = Surface(mesh_catalog.icosphere(4), device="cpu")
    width = float(np.float32(3.0 * voxel_size))
    for offset in (0.0, 0.1):
        shape = BandShape(width, width, offset, "none" if offset else "winding")
        band, distance, slots = distances_by(kernels, Lattice(surface, voxel_size, shape.reach), shape)
        np.testing.assert_array_equal(distance, band.distance.numpy())
        found = slots >= 0
        np.testing.assert_array_equal(slots[found], band.slots.numpy()[found])
        np.testing.assert_array_equal(found[distance < np.float32(width)], True)


@pytest.mark.parametrize("radius", [1.0, 0.1, 1e-6, 1e-30])
def test_the_band_of_a_speck_is_exact(radius):
    # Voxels larger than the mesh: single precision of its frame reaches nowhere near.
    mesh = mesh_catalog.scaled(mesh_catalog.icosphere(2), radius)
    grid = volume.from_mesh(mesh, 1.0, sign="none", device="cpu")
    index = np.stack(np.meshgrid(*3 * [np.arange(-3, 4)], indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    expected = np.minimum(reference.closest_point(mesh.vertices, mesh.faces, index).distance, 3.0)
    np.testing.assert_allclose(grid.sample(index, order=0, device="cpu"), expected, rtol=2 * ROUNDING, atol=0)


def test_a_grid_that_stays_on_its_device_is_fetched_when_asked_for():
    volume_made = volume.from_mesh(mesh_catalog.box(), 0.1, device="cpu")
    there = wp.array(volume_made.nanovdb, dtype=wp.uint8, device="cpu")
    kept = made_on_device(there, volume_made.info)
    assert "nanovdb" not in vars(kept)
    np.testing.assert_array_equal(kept.sample([[0.5, 0.5, 0.02]], device="cpu"), volume_made.sample([[0.5, 0.5, 0.02]]))
    assert "nanovdb" not in vars(kept)
    np.testing.assert_array_equal(kept.nanovdb, volume_made.nanovdb)
    assert kept.nanovdb is kept.nanovdb
    assert kept.nanovdb.ctypes.data % 32 == 0
    with pytest.raises(AttributeError, match="color"):
        kept.color  # noqa: B018


@pytest.mark.skipif(not native.available(), reason="the OpenVDB extension is not built")
def test_openvdbs_own_field_can_be_had_for_comparison():
    mesh = mesh_catalog.torus(24, 12)
    theirs = volume.from_mesh(mesh, 0.05, method="openvdb", device="cpu")
    ours = volume.from_mesh(mesh, 0.05, device="cpu")
    expected = native.mesh_to_level_set(mesh.vertices, mesh.faces, voxel_size=0.05, half_width=3.0)
    np.testing.assert_array_equal(theirs.nanovdb, expected)
    assert theirs.info.metadata["geokit:sign_method"] == "openvdb"
    index = np.random.default_rng(64).integers(*ours.info.index_bounds, (3000, 3)) * 0.05
    # OpenVDB's band is up to half a voxel off.
    np.testing.assert_allclose(theirs.sample(index, order=0), ours.sample(index, order=0), rtol=0, atol=0.5 * 0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": -1.0}, "voxel_size"),
        ({"voxel_size": np.nan}, "voxel_size"),
        ({"voxel_size": np.inf}, "voxel_size"),
        ({"voxel_size": "fine"}, "voxel_size"),
        ({"voxel_size": 0.1, "half_width": 0.5}, "half_width"),
        ({"voxel_size": 0.1, "half_width": np.inf}, "half_width"),
        ({"voxel_size": 0.1, "half_width": (3.0, 0.9)}, "half_width"),
        ({"voxel_size": 0.1, "half_width": (3.0, 2.0, 1.0)}, "half_width"),
        ({"voxel_size": 0.1, "half_width": (3.0, np.nan)}, "half_width"),
        ({"voxel_size": 0.1, "sign": "guess"}, "sign"),
        ({"voxel_size": 0.1, "thickness": 0.0}, "thickness"),
        ({"voxel_size": 0.1, "thickness": np.nan}, "thickness"),
        ({"voxel_size": 0.1, "thickness": 1e9}, r"thickness: 1e\+09 is more than 1e\+06 times the size of the mesh"),
        ({"tolerance": 0.1, "thickness": 1e9}, "thickness"),
        ({"voxel_size": 0.1, "method": "magic"}, "method"),
        ({"voxel_size": 0.1, "method": "openvdb", "half_width": (2.0, 3.0)}, "method"),
        ({"voxel_size": 0.1, "method": "openvdb", "thickness": 0.2}, "method"),
        ({"voxel_size": 0.1, "codec": "zip"}, "codec"),
        ({"voxel_size": 0.1, "name": "n" * 256}, "name"),
    ],
)
def test_bad_options_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        volume.from_mesh(mesh_catalog.box(), device="cpu", **arguments)


def test_an_empty_mesh_is_refused():
    with pytest.raises(InputError, match="no faces"):
        volume.from_mesh(TriangleMesh([], []), 0.1, device="cpu")


@pytest.mark.parametrize("voxel_size", [1e-5, 1e-7, 1e-12, 1e-300])
def test_voxels_too_small_for_the_memory_name_a_size_that_fits(voxel_size):
    with pytest.raises(DeviceMemoryError, match=r"use (at least )?[0-9.e+-]+"):
        volume.from_mesh(mesh_catalog.icosphere(1), voxel_size, device="cpu")


@pytest.mark.slow
def test_a_half_width_beyond_counting_is_named():
    """Larger voxels would make the band no smaller."""
    message = r"half_width: the band reaches 1e\+09 voxels far.*; use a smaller half_width"
    with pytest.raises(DeviceMemoryError, match=message):
        volume.from_mesh(mesh_catalog.torus(12, 8), 0.1, half_width=1e9, device="cpu")


def test_a_grid_has_at_most_2_33_bytes(monkeypatch):
    from geokit.core.memory import available_memory

    monkeypatch.setattr(available_memory, "available", lambda device: 1 << 50)
    monkeypatch.setattr(available_memory, "available_host", lambda: 1 << 50)
    refusal = r"of the 179\d\d MiB that cpu and a grid can hold; use 0\.00"
    with pytest.raises(DeviceMemoryError, match=refusal) as caught:
        volume.from_mesh(mesh_catalog.box(), 1.0 / 12000, device="cpu")
    assert "smaller half_width" in str(caught.value)
