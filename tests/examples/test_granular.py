"""The granular example: its contacts against closed forms, and the script from another folder."""

from __future__ import annotations

import ast
import sys

import numpy as np
import pytest

import geokit as gk
from tests.support.scripts import EXAMPLES, import_example, run_script

# Forces are float32: 24 bits of positions of 0.1 m leave 1e-8 m, which is 1e-2 of the overlaps at rest of soft grains
# and less of all others.
OVERLAP_TOLERANCE = 0.02
# A box's floor is a plane, which linear interpolation keeps: to the rounding of a float32.
STEP = 2e-5


@pytest.fixture(scope="module")
def granular():
    return import_example("granular")


def floor(radius):
    """The solid below z = 0 as a signed distance."""
    edge = 8.0 * radius
    return gk.volume.from_function(lambda p: p[:, 2], [[-edge] * 3, [edge] * 3], radius, half_width=4.0)


def slab(radius, *, middle):
    """A flat box around z = middle as a mesh."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
    corners = signs * [8.0 * radius, 8.0 * radius, radius] + [0.0, 0.0, middle]
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[a, b, c] for q in quads for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    return gk.mesh.Surface(gk.mesh.TriangleMesh(corners, faces), device="cpu")


def go_on(scene, seconds):
    while scene.time < seconds:
        scene.advance(50)
    return scene.x.numpy().astype(np.float64), scene.v.numpy().astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [1.0, 0.8, 0.5, 0.2])
def test_collision_has_the_restitution_of_the_damped_spring(granular, restitution):
    w = granular.grains(restitution=restitution, bond=0.0, gravity=0.0)
    x = np.array([[-1.01, 0.0, 0.0], [1.01, 0.0, 0.0]]) * w.radius
    scene = granular.Scene(x, w, v=np.array([[0.1, 0, 0], [-0.1, 0, 0]]), step=1e-6, device="cpu")
    _, v = go_on(scene, 3e-3)
    # A hundredth of the contact's 0.88 ms is a quarter of a percent of phase at most.
    np.testing.assert_allclose(v[:, 0], [-0.1 * restitution, 0.1 * restitution], rtol=0.01)
    assert np.all(v[:, 1:] == 0.0)


def test_friction_slides_or_sticks_by_coulomb(granular):
    # A grain pressed onto the floor by its weight, sliding: it loses friction times gravity, whatever its speed.
    w = granular.grains(friction=0.3, bond=0.0)
    rest = w.radius - w.mass * w.gravity / w.stiffness
    start = np.array([[0.0, 0.0, rest]])
    scene = granular.Scene(start, w, v=np.array([[0.2, 0, 0]]), volume=floor(w.radius), step=STEP, device="cpu")
    x, v = go_on(scene, 0.04)
    t = scene.time
    assert v[0, 0] == pytest.approx(0.2 - 0.3 * w.gravity * t, rel=0.01)
    assert x[0, 0] == pytest.approx(0.2 * t - 0.15 * w.gravity * t * t, rel=0.01)
    _, v = go_on(scene, 0.1)
    assert abs(v[0, 0]) < 1e-4


@pytest.mark.parametrize("body", ["volume", "mesh"])
@pytest.mark.parametrize("bond", [0.0, 4.0])
def test_grain_rests_at_the_overlap_of_its_weight(granular, body, bond):
    w = granular.grains(bond=bond, stiffness=500.0)
    solid = {"volume": floor(w.radius)} if body == "volume" else {"surface": slab(w.radius, middle=-w.radius)}
    scene = granular.Scene(np.array([[0.001, 0.002, w.radius]]), w, step=STEP, device="cpu", **solid)
    x, v = go_on(scene, 0.15)
    overlap = (w.mass * w.gravity + w.cohesion) / w.stiffness
    assert w.radius - x[0, 2] == pytest.approx(overlap, rel=OVERLAP_TOLERANCE)
    assert np.abs(v).max() < 1e-4


def test_grain_rides_on_a_turning_mesh(granular):
    # Friction drags it along until it moves as the mesh below it: on a circle, for as long as it does not slip.
    w = granular.grains(friction=1.0, bond=20.0)
    surface = slab(w.radius, middle=-w.radius)
    start = np.array([[3.0 * w.radius, 0.0, w.radius]])
    v = np.array([[0.0, 3.0 * w.radius * 2.0, 0.0]])
    scene = granular.Scene(start, w, v=v, surface=surface, turn=2.0, step=STEP, device="cpu")
    x, v = go_on(scene, 0.3)
    angle = 2.0 * scene.time
    assert np.hypot(*x[0, :2]) == pytest.approx(3.0 * w.radius, rel=0.02)
    assert np.arctan2(x[0, 1], x[0, 0]) == pytest.approx(angle, abs=0.02)
    np.testing.assert_allclose(v[0, :2], 2.0 * np.array([-x[0, 1], x[0, 0]]), atol=2e-3)


def test_momentum_of_a_closed_system_stays(granular):
    random = np.random.default_rng(5)
    w = granular.grains(gravity=0.0)
    x = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3) * 2.0 * w.radius
    v = random.normal(0.0, 0.1, x.shape)
    scene = granular.Scene(x, w, v=v, device="cpu")
    _, after = go_on(scene, 0.05)
    assert np.abs(after - v).max() > 0.1
    # Forces are equal and opposite to the bit; adding them to float32 velocities rounds.
    np.testing.assert_allclose(after.sum(axis=0), v.sum(axis=0), atol=1e-5)


def ceiling(radius):
    edge = 8.0 * radius
    return gk.volume.from_function(lambda p: -p[:, 2], [[-edge] * 3, [edge] * 3], radius, half_width=4.0)


def test_cohesion_holds_a_hanging_pair(granular):
    w = granular.grains(bond=4.0)
    weight = w.mass * w.gravity
    hung = np.array([[0.0, 0.0, -w.radius], [0.0, 0.0, -3.0 * w.radius]])
    scene = granular.Scene(hung, w, volume=ceiling(w.radius), step=STEP, device="cpu")
    x, v = go_on(scene, 0.2)
    upper, lower = (w.cohesion - 2.0 * weight) / w.stiffness, (w.cohesion - weight) / w.stiffness
    assert x[0, 2] + w.radius == pytest.approx(upper, rel=OVERLAP_TOLERANCE)
    assert 2.0 * w.radius - (x[0, 2] - x[1, 2]) == pytest.approx(lower, rel=OVERLAP_TOLERANCE)
    assert np.abs(v).max() < 1e-4


@pytest.mark.parametrize(("bond", "falls"), [(1.9, True), (2.1, False)])
def test_the_ceiling_lets_go_of_two_grains_below_two_weights(granular, bond, falls):
    w = granular.grains(bond=bond)
    hung = np.array([[0.0, 0.0, -w.radius], [0.0, 0.0, -3.0 * w.radius]])
    scene = granular.Scene(hung, w, volume=ceiling(w.radius), step=STEP, device="cpu")
    x, _ = go_on(scene, 0.1)
    assert (x[0, 2] < -1.2 * w.radius) == falls


@pytest.mark.slow
def test_grains_settle_inside_the_bowl(granular):
    w = granular.grains()
    scene, size = granular.stirred_bowl(300, w, turn=0.0, device="cpu")
    x, v = go_on(scene, 0.4)
    assert np.linalg.norm(v, axis=1).max() < 0.05
    assert 0.5 * w.mass * np.sum(v**2) < 1e-4 * w.mass * w.gravity * size * len(x)
    # None within the wall by more than a twentieth of its radius, and none left behind or above.
    assert scene.volume.sample(x).min() > 0.95 * w.radius
    assert np.linalg.norm(x, axis=1).max() < size
    # None within the ring.
    assert scene.surface.signed_distance(x).distance.min() > 0.95 * w.radius
    overlap = 2.0 * w.radius - gk.points.NeighborGrid(x, 2.0 * w.radius, device="cpu").pairs().distance
    assert 0.0 < overlap.max() < 0.05 * w.radius


@pytest.mark.slow
def test_the_ring_stirs_and_two_runs_are_equal(granular):
    ends = []
    for _ in range(2):
        scene, _ = granular.stirred_bowl(200, granular.grains(), turn=2.0 * np.pi, device="cpu")
        start = scene.x.numpy().copy()
        ends.append(go_on(scene, 0.25))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    np.testing.assert_array_equal(ends[0][1], ends[1][1])
    moved = np.linalg.norm(ends[0][0] - start, axis=1)
    assert np.quantile(moved, 0.9) > 2.0 * scene.w.radius
    assert scene.volume.sample(ends[0][0]).min() > 0.9 * scene.w.radius


def test_lists_are_renewed_when_grains_speed_up(granular):
    # The lists of grains at rest last for many steps. These are pressed together, and shoot apart.
    w = granular.grains(gravity=0.0, bond=0.0, restitution=1.0)
    x = np.array([[-0.9, 0, 0], [0.9, 0, 0], [-4.0, 0, 0], [4.0, 0, 0]]) * w.radius
    scene = granular.Scene(x, w, step=STEP, device="cpu")
    scene.every = 1024
    scene.advance(1024)
    assert scene.every < 1024
    v = scene.v.numpy()[:, 0]
    # Each inner grain has given its velocity to the outer one on its side, which has not been missed.
    fast = 0.1 * w.radius * 2.0 / np.sqrt(2.0 * w.mass / w.stiffness)
    np.testing.assert_allclose(v, [0.0, 0.0, -fast, fast], atol=0.02 * fast)


@pytest.mark.parametrize(("x", "v"), [(np.zeros((30, 3)), 0.0), (np.eye(3), [np.nan, 0.0, 0.0])])
def test_grains_that_fit_no_list_and_nan_are_refused(granular, x, v):
    scene = granular.Scene(x, granular.grains(), v=v, device="cpu")
    with pytest.raises(RuntimeError, match="unstable: a grain has"):
        scene.advance(2)


def stirred(granular):
    """Positions and velocities of a scene that the ring stirs quickly, and the scene."""
    scene, _ = granular.stirred_bowl(200, granular.grains(), turn=4.0 * np.pi, device="cpu")
    return *go_on(scene, 0.04), scene


@pytest.fixture(scope="module")
def alone(granular):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GEOKIT_THREADS", "1")
        return stirred(granular)


@pytest.mark.slow
def test_threads_do_not_change_a_bit(granular, alone, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "3")
    together = stirred(granular)
    assert (alone[2].team.threads, together[2].team.threads) == (1, 3)
    np.testing.assert_array_equal(together[0], alone[0])
    np.testing.assert_array_equal(together[1], alone[1])


@pytest.mark.slow
def test_bodies_that_are_not_asked_touch_nothing(granular, alone, monkeypatch):
    # A scene that asks volume and mesh for all grains in each step: what the other leaves out would have been zero.
    asked = []

    def always(scene, steps):
        calls = []
        for k in range(steps):
            given = k, 1, scene.xs, scene.vs, scene.w, scene.angle, scene.step, *scene.lists, scene.clear
            calls += [scene.clear.zero_, scene.team.record(granular.step_kernel, len(scene.x), given)]
            calls += [lambda k=k: asked.append(k)]
            calls += scene._list((k + 1) % 2) if (k + 1) % scene.every == 0 or k + 1 == steps else []
        return scene.team.sequence(calls)

    monkeypatch.setattr(granular.Scene, "_frame", always)
    thorough = stirred(granular)
    assert len(asked) > 300
    np.testing.assert_array_equal(alone[0], thorough[0])
    np.testing.assert_array_equal(alone[1], thorough[1])
    # Most grains are left alone by either, and some are not.
    assert np.all((alone[2].clear.numpy() > 0.0).mean(axis=0) > 0.5)
    assert np.all((alone[2].clear.numpy() < 0.0).mean(axis=0) > 0.01)


@pytest.mark.slow
def test_what_was_clear_is_forgotten_when_a_frame_is_done_again(granular):
    # A grain falls on the floor and comes up again, higher than it began: taken back, it must not trust in that height.
    w = granular.grains(bond=0.0)
    start = np.array([[0.0, 0.0, 1.1 * w.radius], [3.0 * w.radius, 0.0, 2.0 * w.radius]])
    v, ends = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]), []
    for every in (4, 512):
        scene = granular.Scene(start, w, v=v, volume=floor(w.radius), step=STEP, device="cpu")
        scene.every = every
        scene.advance(512)
        assert scene.every < 512
        ends.append(scene.x.numpy())
    np.testing.assert_array_equal(*ends)
    assert ends[0][0, 2] > 1.5 * w.radius


@pytest.mark.slow
def test_soft_grains_overlap_as_told(granular):
    # The lowest of a heap at rest, which carry the others, to a factor of two: it is an estimate by layers.
    w = granular.soft_grains(300, overlap=0.02)
    assert w.stiffness < granular.soft_grains(3000, overlap=0.02).stiffness < granular.soft_grains(3000, 0.01).stiffness
    scene, _ = granular.stirred_bowl(300, w, turn=0.0, device="cpu")
    x, _ = go_on(scene, 0.4)
    overlap = 2.0 * w.radius - gk.points.NeighborGrid(x, 2.0 * w.radius, device="cpu").pairs().distance
    assert 0.01 * w.radius < np.quantile(overlap, 0.99) < 0.04 * w.radius


@pytest.mark.slow
def test_kernels_compile_for_sm_90(granular, tmp_path):
    import warp as wp

    wp.compile_aot_module(sys.modules["granular_kernels"], arch=90, module_dir=tmp_path, use_ptx=True)
    text = "".join(file.read_text() for file in tmp_path.rglob("*.ptx"))
    assert "list_kernel" in text
    assert "step_kernel" in text


@pytest.mark.slow
def test_script(tmp_path):
    from PIL import Image

    arguments = ["--grains", "150", "--seconds", "0.1", "--frames", "3", "--device", "cpu", "--out", "bowl"]
    said = run_script(EXAMPLES / "granular.py", *arguments, folder=tmp_path)
    assert "150 grains" in said
    assert "contacts each" in said
    with Image.open(tmp_path / "bowl.png") as still:
        assert np.asarray(still.convert("RGB"), dtype=float).std() > 20.0
    with Image.open(tmp_path / "bowl.gif") as moving:
        assert moving.n_frames == 3


@pytest.mark.slow
def test_script_without_pictures(tmp_path):
    arguments = ["--grains", "20", "--seconds", "0.05", "--frames", "0", "--device", "cpu", "--step", "5e-5"]
    said = run_script(EXAMPLES / "granular.py", *arguments, folder=tmp_path)
    assert "of 334 steps" in said
    assert not list(tmp_path.iterdir())


def test_the_scene_stays_under_200_lines():
    assert len((EXAMPLES / "granular.py").read_text().splitlines()) < 200


def code_lines(path):
    """Lines of code: no blank ones, comments or docstrings."""
    tree = ast.parse(path.read_text())
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef
    texts = [node.body[0] for node in ast.walk(tree) if isinstance(node, kinds) and ast.get_docstring(node)]
    left_out = {line for text in texts for line in range(text.lineno, text.end_lineno + 1)}
    lines = path.read_text().splitlines()
    return sum(bool(line.strip()) and not line.strip().startswith("#") and k not in left_out
               for k, line in enumerate(lines, 1))  # fmt: skip


@pytest.mark.parametrize("names", [("granular.py", "granular_kernels.py"), ("ocean.py",)], ids=lambda names: names[0])
def test_the_scene_stays_under_200_lines_of_code(names):
    assert sum(code_lines(EXAMPLES / name) for name in names) < 200
