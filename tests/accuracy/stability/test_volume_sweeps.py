"""Sweeps of volumes: their structure, and that each detects a method made worse on purpose."""

from __future__ import annotations

import re
from importlib import import_module

import numpy as np
import pytest

from geokit import native
from geokit.accuracy.stability import fields
from geokit.accuracy.stability import volume_change as change
from geokit.accuracy.stability import volume_mesh as meshes
from geokit.accuracy.stability import volume_rays as rays
from geokit.accuracy.stability import volume_sample as samples
from geokit.accuracy.stability.follow_sweeps import sweeps_of
from geokit.errors import InputError
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.volume.model.sparse_volume import SparseVolume

SWEEPS = {sweep.name: sweep for sweep in sweeps_of("volume", "cpu")}
NO_FAILURE = "no failure found"
# Of these the first values are asked in other tests here, or they take longer than the rest together.
ASKED = [name for name in SWEEPS if not name.startswith(("renormalize", "smooth", "offset")) and "thin" not in name]


def test_names():
    assert len(SWEEPS) == len(sweeps_of("volume", "cpu"))
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", name) for name in SWEEPS)
    assert ("smooth_gaussian_radius" in SWEEPS) == native.available()


def test_without_openvdb_there_is_no_smoothing(monkeypatch):
    monkeypatch.setattr(native, "available", lambda: False)
    assert {sweep.name for sweep in sweeps_of("volume", "cpu")} == set(SWEEPS) - {"smooth_gaussian_radius"}


@pytest.mark.parametrize("name", SWEEPS)
def test_values_lead_through_the_envelope(name):
    sweep = SWEEPS[name]
    steps = np.sign(np.diff(sweep.values))
    assert (steps == steps[0]).all()
    assert steps[0] != 0
    last = sweep.values.index(sweep.envelope.last)
    assert last >= 1
    assert (last + 1 < len(sweep.values)) != (NO_FAILURE in sweep.envelope.statement)
    errors = [sweep.envelope.error(v) if callable(sweep.envelope.error) else sweep.envelope.error for v in sweep.values]
    assert np.isfinite(errors).all()
    assert min(errors) > 0.0
    assert sweep.envelope.statement.endswith(".")
    assert not sweep.logarithmic or min(sweep.values) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ASKED)
def test_answers_are_the_same_every_time(name):
    sweep = SWEEPS[name]
    judgement, again = (sweep.ask(sweep.values[0]) for _ in range(2))
    assert judgement.errors.shape == judgement.wrong.shape
    assert judgement.positions.shape == (len(judgement.errors), 3)
    assert (judgement.errors >= 0.0).all()
    np.testing.assert_array_equal(judgement.errors, again.errors)
    np.testing.assert_array_equal(judgement.wrong, again.wrong)
    np.testing.assert_array_equal(judgement.positions, again.positions)


def worst(judgement):
    return judgement.errors[~judgement.wrong].max()


class TestFields:
    def test_level_set_is_its_function_up_to_the_cut(self):
        grid = fields.level_set(fields.ball(4.0), 4.0, cut=2.0)
        points = np.array([[4.0, 0.0, 0.0], [6.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
        expected = np.clip(np.linalg.norm(points - fields.MIDDLE, axis=1) - 4.0, -2.0, 2.0)
        np.testing.assert_allclose(grid.sample(points, order=0, device="cpu"), expected, atol=1e-6)
        assert (grid.info.grid_class, grid.info.background) == ("level set", 2.0)

    def test_field_keeps_every_voxel(self):
        grid = fields.field(lambda p: p @ np.array([1.0, 10.0, 100.0]), 2)
        assert grid.info.active_voxel_count == 124  # the one that is 0 is the background
        assert grid.sample([[2.0, -1.0, 1.0]], device="cpu") == [92.0]

    def test_unit_vectors(self):
        vectors = fields.unit_vectors(50, 1)
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)
        assert not np.array_equal(vectors, fields.unit_vectors(50, 2))


class TestNotices:
    """Each method is replaced by a worse one."""

    @pytest.fixture
    def shifted_samples(self, monkeypatch):
        sample = SparseVolume.sample
        monkeypatch.setattr(SparseVolume, "sample", lambda *given, **named: sample(*given, **named) + 0.25)

    def test_samples(self, shifted_samples):
        assert worst(samples.waves(64.0, order=3, device="cpu")) > 0.249
        assert worst(samples.band_distances(1.0, order=1, device="cpu")) > 0.2
        assert worst(samples.far_values(1.0, order=1, device="cpu")) == pytest.approx(0.25 / np.sqrt(0.875))
        assert worst(samples.quantized_distances(64.0, codec="fp16", device="cpu")) > 0.24
        assert worst(meshes.far_distances(1.0, device="cpu")) > 0.05
        assert worst(meshes.wall_distances(4.0, device="cpu")) > 0.6

    def test_points_in_a_wall_that_are_outside(self, monkeypatch):
        sample = SparseVolume.sample
        monkeypatch.setattr(SparseVolume, "sample", lambda *given, **named: abs(sample(*given, **named)))
        assert meshes.wall_distances(4.0, device="cpu").wrong.all()

    def test_codecs(self, monkeypatch):
        quantize = import_module("geokit.volume.retyped.quantize")
        coarse = quantize.quantize
        monkeypatch.setattr(quantize, "quantize", lambda volume, codec, **_: coarse(volume, "fp4"))
        assert worst(samples.quantized_distances(64.0, codec="fp16", device="cpu")) > 0.1
        assert worst(samples.kept_tolerances(0.01, device="cpu")) > 10.0

    def test_a_tolerance_that_cannot_be_kept_is_refused(self):
        with pytest.raises(InputError, match="fpn reaches"):
            samples.kept_tolerances(1e-6, device="cpu")

    def test_surfaces(self, monkeypatch):
        module = import_module("geokit.mesh.volumes.from_volume")
        exact = module.from_volume

        def shifted(*given, **named):
            mesh = exact(*given, **named)
            return TriangleMesh(mesh.vertices + np.array([0.5, 0.0, 0.0]), mesh.faces)

        monkeypatch.setattr(module, "from_volume", shifted)
        assert worst(meshes.wall_surfaces(4.0, device="cpu")) > 0.2
        assert worst(meshes.offset_surfaces(1.0, device="cpu")) > 0.4
        assert worst(meshes.ball_surfaces(4.0, method="marching_cubes", device="cpu")) > 0.4

    def test_surfaces_with_a_hole(self, monkeypatch):
        module = import_module("geokit.mesh.volumes.from_volume")
        exact = module.from_volume

        def half(*given, **named):
            mesh = exact(*given, **named)
            return TriangleMesh(mesh.vertices, mesh.faces[: len(mesh.faces) // 2])

        monkeypatch.setattr(module, "from_volume", half)
        assert worst(meshes.wall_surfaces(4.0, device="cpu")) > 1.0
        assert worst(meshes.ball_surfaces(8.0, method="marching_cubes", device="cpu")) > 1.0

    def test_surfaces_that_are_lost(self, monkeypatch):
        module = import_module("geokit.mesh.volumes.from_volume")
        nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
        monkeypatch.setattr(module, "from_volume", lambda *given, **named: nothing)
        assert meshes.wall_surfaces(4.0, device="cpu").wrong.all()
        assert meshes.offset_surfaces(1.0, device="cpu").wrong.all()
        assert meshes.ball_surfaces(4.0, method="surface_nets", device="cpu").wrong.all()

    @pytest.mark.parametrize(
        "ask",
        [
            lambda: rays.steep_hits(1.0, device="cpu"),
            lambda: rays.banded_hits(3.0, device="cpu"),
            lambda: rays.power_hits(1.0, device="cpu"),
            lambda: rays.grazing_hits(60.0, device="cpu"),
            lambda: rays.scaled_hits(1.0, device="cpu"),
        ],
        ids=["steep", "banded", "power", "grazing", "scaled"],
    )
    def test_hits(self, monkeypatch, ask):
        raycast = SparseVolume.raycast

        def worse(*given, **named):
            hits = raycast(*given, **named)
            t = hits.t + 0.2
            t[:400] = np.inf
            return hits._replace(t=t)

        monkeypatch.setattr(SparseVolume, "raycast", worse)
        judgement = ask()
        assert judgement.wrong[:400].all()
        assert worst(judgement) > 0.15

    def test_fog(self, monkeypatch):
        module = import_module("geokit.volume._integrate")
        exact = module.integrate

        def worse(*given, **named):
            found = exact(*given, **named)
            return found._replace(transmittance=found.transmittance * 1.1, emission=found.emission * (1.0 + 1e-6))

        monkeypatch.setattr(module, "integrate", worse)
        assert worst(rays.slab_transmittances(256.0, device="cpu")) > 0.09
        assert worst(rays.emissions(1.0, device="cpu")) == pytest.approx(1e-6, rel=1e-3)

    def test_level_sets_that_stay_as_they_are(self, monkeypatch):
        from geokit.volume import _filters as filters
        from geokit.volume import _morphology as morphology

        for module, name in ((morphology, "renormalize"), (morphology, "offset"), (filters, "smooth")):
            monkeypatch.setattr(module, name, lambda volume, *given, **named: volume)
        assert worst(change.evened_slopes(0.3, device="cpu")) > 1.0
        assert worst(change.evened_waves(0.02, device="cpu")) > 0.1
        assert worst(change.evened_balls(10.0, device="cpu")) > 0.5
        assert worst(change.shrunk_balls(8.0, device="cpu")) > 2.0
        assert worst(change.smoothed_balls(8.0, device="cpu")) > 0.3

    def test_level_sets_that_are_turned_inside_out(self, monkeypatch):
        from geokit.volume import _morphology as morphology

        body = fields.level_set(lambda p: -fields.ball(10.0)(p), 10.0)
        monkeypatch.setattr(morphology, "renormalize", lambda volume, **named: body)
        assert change.evened_balls(10.0, device="cpu").wrong.mean() > 0.5
