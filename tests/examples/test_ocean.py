"""The ocean: its waves against NumPy, its bodies against Archimedes and conservation laws, and the script."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import geokit as gk
from geokit import native
from tests.support.effort import of_all
from tests.support.scripts import EXAMPLES, import_example, run_script

CUBE, BALL = 1.1, 0.6

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")


@pytest.fixture(scope="module")
def ocean():
    return import_example("ocean")


def cube_and_ball(density):
    return [(gk.mesh.box((CUBE, CUBE, CUBE)), density), (gk.mesh.sphere(BALL, segments=64), density)]


def calm(ocean, shapes, kind, x, **options):
    return ocean.Ocean(shapes, kind, x, wind=0.0, cells=16, device="cpu", **options)


def go_on(scene, seconds):
    for _ in range(round(60 * seconds)):
        scene.frame()
    return scene.b.x.numpy().astype(np.float64), scene.b.v.numpy().astype(np.float64)


def turns(scene):
    """Rotation matrices (N, 3, 3) of the bodies."""
    x, y, z, w = scene.b.turn.numpy().astype(np.float64).T
    cross = np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]]).transpose(2, 0, 1)
    return np.eye(3) + 2.0 * w[:, None, None] * cross + 2.0 * cross @ cross


def energy(ocean, scene):
    """Of motion, weight and buoyancy in calm water [J], in float64; springs of contacts come on top."""
    x, v, spun = (a.numpy().astype(np.float64) for a in (scene.b.x, scene.b.v, scene.b.momentum))
    total = 0.0
    for i, turn in enumerate(turns(scene)):
        made = scene.made[scene.kind[i]]
        local = turn.T @ spun[i]
        total += 0.5 * made.mass * v[i] @ v[i] + 0.5 * local @ np.linalg.solve(made.inertia, local)
        total += made.mass * ocean.GRAVITY * x[i, 2]
        thick = np.abs(turn[2]) @ made.edges * made.thin
        depth = np.maximum(-(made.fill[:, :3] @ turn[2] + x[i, 2]) / thick, -0.5)
        lifted = thick * np.where(depth < 0.5, 0.5 * (depth + 0.5) ** 2, depth)
        total += 1000.0 * ocean.GRAVITY * made.fill[:, 3] @ lifted
    return total


def test_waves_are_the_inverse_transform_and_rise_at_their_rate(ocean):
    waves = ocean.Waves(gk.threads.Team(device="cpu"), wind=5.0, cells=64)
    waves.move(7.0)
    height, rate = np.moveaxis(waves.height.numpy().astype(np.float64), -1, 0)
    a = waves.given.numpy().astype(np.float64)
    turn = np.exp(1j * 7.0 * waves.frequency.numpy().astype(np.float64))
    spectrum = (a[..., 0] + 1j * a[..., 1]) * turn + (a[..., 2] + 1j * a[..., 3]) / turn
    exact = np.fft.ifft2(spectrum) * 64**2
    assert np.abs(exact.imag).max() < 1e-6 * np.abs(exact).max()
    assert np.abs(height - exact.real).max() < 1e-5 * np.abs(exact).max()
    waves.move(7.0 + 1e-3)
    later = waves.height.numpy()[..., 0].copy()
    waves.move(7.0 - 1e-3)
    slope = (later - waves.height.numpy()[..., 0]) / 2e-3
    assert np.abs(slope - rate).max() < 2e-3 * np.abs(rate).max()


def test_waves_keep_their_energy_and_have_the_height_of_their_wind(ocean):
    waves = ocean.Waves(gk.threads.Team(device="cpu"), wind=5.0, cells=128)
    number = np.hypot(*np.meshgrid(*[2.0 * np.pi * np.fft.fftfreq(128, ocean.SIDE / 128)] * 2))
    number[0, 0] = np.inf
    energies, heights = [], []
    for seconds in (0.0, 1.7, 60.0, 3600.0):
        waves.move(seconds)
        height, rate = np.moveaxis(waves.height.numpy().astype(np.float64), -1, 0)
        of_height, of_rate = (np.abs(np.fft.fft2(a) / 128**2) ** 2 for a in (height, rate))
        energies.append(np.sum(ocean.GRAVITY * of_height + of_rate / number))
        heights.append(4.0 * height.std())
    assert np.ptp(energies) < 1e-4 * energies[0]
    assert np.mean(heights) == pytest.approx(0.21 * 5.0**2 / ocean.GRAVITY, rel=0.15)


def test_no_wind_makes_no_waves(ocean):
    waves = ocean.Waves(gk.threads.Team(device="cpu"), wind=0.0, cells=32)
    waves.move(5.0)
    assert not waves.height.numpy().any()


@pytest.mark.slow
@pytest.mark.parametrize("density", of_all([0.15], [0.15, 0.5, 0.9]))
def test_cube_and_sphere_settle_at_archimedes_depth(ocean, density):
    """What is below the water, counted by winding numbers of points, is the density's share."""
    scene = calm(ocean, cube_and_ball(density), [0, 1], [[0.0, 0.0, 0.8], [4.0, 0.0, 0.8]])
    scene.b.turn.assign(np.array([[0.1, 0.05, 0.0, 0.99]] * 2, np.float32) / np.float32(0.9964))
    x, _ = go_on(scene, 30.0)
    cap = np.roots([1.0, -3.0, 0.0, 4.0 * density])  # draft^2 (3 - draft) = 4 density, in radii
    draft = BALL * float(cap[(cap > 0.0) & (cap < 2.0)][0].real)
    assert BALL - x[1, 2] == pytest.approx(draft, rel=0.02)
    for i in range(2):
        mesh = scene.posed(i)
        (low, high), random = mesh.bounds, np.random.default_rng(6)
        box = np.array([low, [*high[:2], 0.0]])
        points = random.uniform(*box, (200_000, 3))
        wet = gk.mesh.Surface(mesh, device="cpu").contains(points).mean() * np.prod(box[1] - box[0])
        assert wet / mesh.volume == pytest.approx(density, rel=0.02)


@pytest.mark.slow
def test_energy_does_not_grow_without_wind(ocean):
    solid = gk.mesh.Surface(ocean.harbor(wide=14.0), device="cpu")
    axis = np.arange(-4.0, 5.0, 2.7)
    x = np.stack(np.meshgrid(axis, axis, [2.0, 4.5]), axis=-1).reshape(-1, 3)
    x = x[solid.closest_point(x).distance > 1.6]
    scene = calm(ocean, ocean.kinds(), np.arange(len(x)) % 7, x, solid=solid)
    energies = [energy(ocean, scene)]
    for _ in range(of_all(40, 80)):
        go_on(scene, 0.1)
        energies.append(energy(ocean, scene))
    assert len(x) > 15
    assert max(energies) <= energies[0]
    assert energies[-1] < 0.4 * energies[0]
    # Without drag, dashpots and friction it stays, to the errors of steps through stiff collisions.
    scene = calm(ocean, ocean.kinds(), np.arange(len(x)) % 7, x, solid=solid)
    scene.w.drag, scene.w.damping, scene.w.friction = 0.0, 0.0, 0.0
    kept = []
    for _ in range(of_all(40, 80)):
        go_on(scene, 0.1)
        kept.append(energy(ocean, scene))
    assert max(kept) < 1.05 * energies[0]
    assert np.median(kept[-20:]) > 0.97 * energies[0]


@pytest.mark.slow
def test_collisions_keep_momentum(ocean):
    shapes = [(gk.mesh.box((1.0, 1.0, 1.0)), 0.5), (gk.mesh.torus(0.8, 0.28), 0.3)]
    scene = calm(ocean, shapes, [0, 1, 0], [[-1.0, 0.1, 50.0], [0.6, 0.0, 50.2], [0.5, 1.4, 50.1]])
    scene.w.gravity = 0.0
    scene.b.v.assign(np.array([[3.0, 0.0, 0.0], [-2.0, 0.5, 0.0], [0.0, -2.0, 0.0]], np.float32))
    mass = np.array([scene.made[k].mass for k in scene.kind])[:, None]

    def momenta():
        x, v, spun = (a.numpy().astype(np.float64) for a in (scene.b.x, scene.b.v, scene.b.momentum))
        return (mass * v).sum(axis=0), (np.cross(x, mass * v) + spun).sum(axis=0)

    before = momenta()
    _, v = go_on(scene, 1.0)
    after = momenta()
    assert np.abs(v[1] - [-2.0, 0.5, 0.0]).max() > 0.3
    assert np.abs(after[0] - before[0]).max() < 1e-5 * np.abs(mass * v).sum()
    assert np.abs(after[1] - before[1]).max() < 1e-5 * np.abs(mass * v).sum() * 50.0


@pytest.mark.slow
def test_waves_do_not_push_bodies_through_each_other_or_the_quay(ocean):
    wide = 14.0
    solid = gk.mesh.Surface(ocean.harbor(wide=wide), device="cpu")
    kind, x = ocean.fleet(400, solid)
    inside = (np.abs(x[:, :2]) < 0.5 * wide - 1.5).all(axis=1)
    kind, x = kind[inside][:40], x[inside][:40]
    scene = ocean.Ocean(ocean.kinds(), kind, x, wind=6.0, cells=64, solid=solid, device="cpu")
    x, _ = go_on(scene, 6.0)
    assert np.abs(x[:, :2]).max() < 0.5 * wide
    assert x[:, 2].min() > -3.0
    turn = turns(scene)
    worst = 0.0
    for i, made in enumerate(scene.made[k] for k in kind):
        points = made.skin @ turn[i].T + x[i]
        worst = max(worst, -solid.signed_distance(points).distance.min())
        for j in np.flatnonzero(np.linalg.norm(x - x[i], axis=1) < 4.0):
            if i != j:
                worst = max(worst, -scene.made[kind[j]].sdf.sample((points - x[j]) @ turn[j]).min())
    assert worst < 0.15  # soft contacts in a crowd


@pytest.mark.slow
def test_threads_and_runs_do_not_change_a_bit(ocean, monkeypatch):
    def state():
        solid = gk.mesh.Surface(ocean.harbor(), device="cpu")
        scene = ocean.Ocean(ocean.kinds(), *ocean.fleet(30, solid), cells=32, solid=solid, device="cpu")
        go_on(scene, 1.0)
        return [getattr(scene.b, name).numpy().copy() for name in ("x", "v", "turn", "momentum")]

    first = state()
    monkeypatch.setenv("GEOKIT_THREADS", "1")
    assert gk.threads.Team(device="cpu").threads == 1
    for a, b in zip(first, state(), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.slow
def test_kernels_compile_for_sm_90(ocean, tmp_path):
    import warp as wp

    wp.compile_aot_module(sys.modules["ocean_kernels"], arch=90, module_dir=tmp_path, use_ptx=True)
    text = "".join(file.read_text() for file in tmp_path.rglob("*.ptx"))
    for name in ("spectrum_kernel", "butterfly_kernel", "force_kernel", "move_kernel"):
        assert name in text


def test_contacts_of_bodies_are_as_deep_as_they_overlap(ocean):
    touching = import_example("ocean_contacts").touching
    x = [[0, 0, 20.0], [1.05, 0, 20.0], [9, 9, 20.0], [9, 9, 21.2]]  # two cubes, and a cube above a ball
    scene = calm(ocean, [(gk.mesh.box((1.0, 1.0, 1.0)), 0.5), (gk.mesh.sphere(0.6, segments=64), 0.5)], [0, 0, 1, 0], x)
    assert len(touching(scene)) == 0
    scene.b.x = type(scene.b.x)([[0, 0, 20.0], [0.95, 0, 20.0], [9, 9, 20.0], [9, 9, 20.97]], dtype=scene.b.x.dtype)
    np.testing.assert_allclose(np.sort(touching(scene)), [0.05, 0.13], atol=1e-3)


@pytest.mark.slow
def test_script_of_contacts(tmp_path):
    options = ["--bodies", 12, "--seconds", 0.2, "--device", "cpu"]
    assert "12 bodies, " in run_script(EXAMPLES / "ocean_contacts.py", *options, folder=tmp_path)


@pytest.mark.slow
def test_script(tmp_path):
    from PIL import Image

    options = ["--bodies", 12, "--seconds", 0.2, "--every", 6, "--device", "cpu", "--out", "sea"]
    assert "12 bodies" in run_script(EXAMPLES / "ocean.py", *options, folder=tmp_path)
    with Image.open(tmp_path / "sea.png") as still:
        assert np.asarray(still.convert("RGB"), dtype=float).std() > 20.0
    with Image.open(tmp_path / "sea.gif") as moving:
        assert moving.n_frames == 2
