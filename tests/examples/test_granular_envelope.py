"""The granular example pushed towards its unstable step, and what holds below it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.effort import of_all
from tests.support.scripts import import_example

# A packing that has settled still creeps, and how fast it does varies by less than this factor.
CREEP = 2.0
# By so much an unstable mode exceeds the creep, before friction bounds it: far enough from CREEP to tell them apart.
GROWTH = 5.0
# Shares of the predicted step that are told apart. The packing changes while it runs, and its modes by about 1%.
STABLE, UNSTABLE = 0.95, 1.2


@pytest.fixture(scope="module")
def modules():
    return import_example("granular"), import_example("granular_charts")


def pair(granular, *, speed=0.1, gap=0.02, **kinds):
    """Two grains that meet head-on."""
    w = granular.grains(**{"gravity": 0.0, "bond": 0.0, **kinds})
    x = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]) * (1.0 + gap / 2.0) * w.radius
    return w, x, np.array([[speed, 0.0, 0.0], [-speed, 0.0, 0.0]])


def critical(w):
    return np.sqrt(2.0 * w.mass / w.stiffness)


@pytest.fixture(scope="module")
def settled(modules):
    """Positions of 200 grains at rest in the bowl, and the step that theory allows them."""
    granular, charts = modules
    w = granular.grains()
    scene, _ = granular.stirred_bowl(200, w, turn=0.0, step=0.1 * critical(w), device="cpu")
    for _ in range(40):
        scene.advance(120)
    return scene, charts.stable_step(scene)


def kinetic_after(modules, settled, share, steps=1000):
    """Kinetic energy after so many steps of a share of the predicted one; infinite where the scene gave up."""
    granular, charts = modules
    before, stable = settled
    x, v = before.x.numpy().copy(), before.v.numpy().copy()
    scene = granular.Scene(
        x, before.w, v=v, volume=before.volume, surface=before.surface, step=share * stable, device="cpu"
    )
    try:
        for _ in range(steps // 50):
            scene.advance(50)
    except RuntimeError:
        return np.inf
    return charts.energy(scene).kinetic


@pytest.mark.slow
def test_packing_is_unstable_where_theory_says(modules, settled):
    quiet = kinetic_after(modules, settled, 0.3)
    assert kinetic_after(modules, settled, STABLE) < CREEP * quiet
    assert kinetic_after(modules, settled, UNSTABLE) > GROWTH * quiet


def test_default_step_has_a_margin(modules, settled):
    granular, _ = modules
    assert granular.STEP_SHARE * critical(settled[0].w) < 0.8 * settled[1]


@pytest.mark.slow
@pytest.mark.parametrize("overlap", of_all([0.06], [0.03, 0.06]))
def test_default_step_has_a_margin_where_soft_grains_are_stirred(modules, overlap):
    granular, charts = modules
    w = granular.soft_grains(1000, overlap)
    scene, _ = granular.stirred_bowl(1000, w, device="cpu")
    least = np.inf
    for _ in range(6):
        scene.advance(400)
        least = min(least, charts.stable_step(scene) / critical(w))
    assert 0.9 * least > granular.STEP_SHARE


def test_packing_stands_less_than_a_pair(modules, settled):
    w = settled[0].w
    ratio = w.damping / np.sqrt(2.0 * w.stiffness * w.mass)
    alone = (np.sqrt(1.0 + ratio**2) - ratio) * critical(w)
    assert 0.4 * alone < settled[1] < 0.7 * alone


@pytest.mark.parametrize("share", [0.5, 0.9, 0.97, 1.03, 1.2])
def test_bound_pair_vibrates_up_to_the_critical_step(modules, share):
    # Pressed together the two stay in contact: a spring that pulls as well, for which the critical step is exact.
    granular, _ = modules
    w, x, v = pair(granular, restitution=1.0, bond=2000.0, speed=0.01)
    rest = 2.0 * w.radius - w.cohesion / w.stiffness
    x = np.array([[-0.5 * rest, 0.0, 0.0], [0.5 * rest, 0.0, 0.0]])
    scene = granular.Scene(x, w, v=v, step=share * critical(w), device="cpu")
    speeds = []
    try:
        for _ in range(100):
            scene.advance(2)
            speeds.append(np.abs(scene.v.numpy()).max())
    except RuntimeError:
        speeds.append(np.inf)
    # Below, the discrete orbit is an ellipse: 1 / sqrt(1 - share^2) times the amplitude at most.
    bound = 1.05 * 0.01 / np.sqrt(max(1.0 - share**2, 1e-9))
    assert (max(speeds) < bound) == (share < 1.0)


@pytest.mark.parametrize(("share", "most"), [(0.02, 0.002), (0.1, 0.02), (0.25, 0.06)])
def test_collisions_gain_little_below_the_critical_step(modules, share, most):
    # A contact opens and closes between steps: its phase decides how much is gained or lost.
    granular, _ = modules
    rebounds = []
    for gap in np.linspace(0.01, 0.01 + 0.2 * share, 9):
        w, x, v = pair(granular, restitution=1.0, gap=gap)
        scene = granular.Scene(x, w, v=v, step=share * critical(w), device="cpu")
        scene.advance(2 * int(6.0 / share))
        rebounds.append(scene.v.numpy()[1, 0] / 0.1)
    assert np.abs(np.array(rebounds) - 1.0).max() < most


@pytest.mark.slow
def test_energy_is_accounted_for(modules):
    # Falling, colliding, sliding: what the grains no longer have, the dashpots took. The account is a float64 sum by
    # other code over the same states.
    granular, charts = modules
    errors = []
    for share in (0.1, 0.2):
        w = granular.grains()
        bowl, _ = granular.stirred_bowl(40, w, device="cpu")
        w = granular.grains()
        scene = granular.Scene(bowl.x.numpy(), w, volume=bowl.volume, step=share * critical(w), device="cpu")
        first = before = charts.energy(scene)
        lost = 0.0
        while scene.time < 0.03:
            scene.advance(2)
            now = charts.energy(scene)
            lost += (before.dissipation + now.dissipation) * scene.step
            before = now
        errors.append(abs(now.total + lost - first.total) / lost)
    # Contacts begin and end between the samples, and the bowl's normals are those of a field that is linear in cells.
    assert max(errors) < 0.05


@pytest.mark.slow
def test_a_step_far_too_long_is_refused(modules):
    granular, _ = modules
    w = granular.grains()
    scene, _ = granular.stirred_bowl(100, w, step=3.0 * critical(w), device="cpu")
    with pytest.raises(RuntimeError, match="unstable: a grain has"):
        scene.advance(400)
