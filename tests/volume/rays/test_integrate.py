"""Light through fog, checked against sums over the cells of each ray in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.catalog.typed_grids import TypedGrid
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._integrate import integrate
from geokit.volume.nanovdb.header import TREE_OFFSET, tree_header
from geokit.volume.nanovdb.layout import layout_of
from tests.support import reference
from tests.support.volume_rays import Field, rays_through

# Depths are sums over some tens of cells, each of some tens of roundings.
ROUNDING = 1e-12
SHEARED = np.array([[0.3, 0.05, 0.0, 2.0], [0.0, -0.2, 0.04, -1.0], [0.02, 0.0, 0.5, 3.0], [0.0, 0.0, 0.0, 1.0]])


def _fog(seed, shape=(24, 16, 16), lower=(-8, 0, 8), transform=None, holes=True):
    rng = np.random.default_rng(seed)
    stored = rng.random(np.array(shape) // 8) < 0.7 if holes else None
    return Field(rng.uniform(0.0, 0.3, shape), lower, 0.0, transform, stored)


def _rays(field, count, seed):
    return rays_through(field.lower - 1.0, field.lower + np.array(field.dense.shape), count, seed)


def _depth(field, start, toward, first=0.0, last=80.0):
    return reference.optical_depth(field.at, start, toward, reference.borders_along(start, toward, first, last))[-1]


class TestTransmittance:
    @pytest.mark.parametrize("transform", [None, SHEARED], ids=["voxels", "sheared"])
    def test_random_fog(self, transform):
        field = _fog(0, transform=transform)
        start, toward = _rays(field, 40, 1)
        origins, directions = field.to_world(start, toward)
        found = integrate(field.volume, origins, directions, extinction=0.7, device="cpu")
        length = np.linalg.norm(directions, axis=1)
        depth = [0.7 * _depth(field, o, d) for o, d in zip(start, toward, strict=True)] * length
        np.testing.assert_allclose(found.transmittance, np.exp(-depth), rtol=ROUNDING)
        assert (found.transmittance < 0.9).sum() > 20
        np.testing.assert_array_equal(found.emission, 0.0)

    def test_even_fog_between_planes(self):
        # From 0 to 1 within a voxel on each side: the depth is that of 16 voxels.
        field = Field(np.full((16, 16, 16), 0.25), background=0.0)
        origins = np.array([[-50.0, 7.3, 8.1], [8.0, 8.0, 90.0]])
        found = integrate(field.volume, origins, [[1.0, 0, 0], [0, 0, -3.0]], extinction=0.5, device="cpu")
        np.testing.assert_allclose(found.transmittance, math.exp(-0.5 * 0.25 * 16), rtol=1e-15)

    @pytest.mark.parametrize("t_min", [0.0, 9.25])
    def test_part_of_a_ray(self, t_min):
        field = _fog(2)
        start, toward = _rays(field, 20, 3)
        length = np.linalg.norm(toward, axis=1)
        found = integrate(field.volume, start, toward, t_min=t_min, max_distance=20.0, device="cpu").transmittance
        depth = [
            _depth(field, o, d, t_min, max(t_min, 20.0 / n)) * n for o, d, n in zip(start, toward, length, strict=True)
        ]
        np.testing.assert_allclose(found, np.exp(-np.array(depth)), rtol=ROUNDING)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_along_borders_and_from_within(self, axis):
        field = _fog(4, holes=False)
        start = np.stack(np.meshgrid([-8.0, 0.0, 7.0], [0.0, 8.0, 9.0], [8.0, 16.0, 15.0], indexing="ij"), axis=-1)
        start = start.reshape(-1, 3)
        toward = np.tile(np.eye(3)[axis], (len(start), 1))
        for sign in (1.0, -1.0):
            found = integrate(field.volume, start, sign * toward, device="cpu").transmittance
            depth = [_depth(field, o, sign * d) for o, d in zip(start, toward, strict=True)]
            np.testing.assert_allclose(found, np.exp(-np.array(depth)), rtol=ROUNDING)

    def test_tiles(self):
        # Of the grid's lower node the slot of (16, 0, 0), and of its upper node that of (0, 0, 128).
        field = _fog(0, shape=(8, 8, 8), lower=(0, 0, 0), holes=False)
        buffer, layout = field.volume.nanovdb, layout_of(1, "test")
        for level, table, slot, value in ((1, layout.lower_table, 2 << 8, 0.5), (2, layout.upper_table, 1, 0.2)):
            begin = TREE_OFFSET + int(tree_header(buffer)["node_offset"][level]) + table
            buffer[begin + 8 * slot :][:4] = np.array([value], "<f4").view(np.uint8)

        def at(ijk):
            out = field.at(ijk)
            out[((ijk >= [16, 0, 0]) & (ijk < [24, 8, 8])).all(axis=1)] = 0.5
            out[((ijk >= [0, 0, 128]) & (ijk < [128, 128, 256])).all(axis=1)] = np.float32(0.2)
            return out

        start = np.array([[64.0, 64.0, 500.0], [64.0, 64.0, 200.0], [40.0, 3.0, 3.0], [20.0, 3.5, 300.5], [3.2, 3, -9]])
        toward = np.array([[0.0, 0, -1.0], [0, 0, 1.0], [-1.0, 0.01, 0.02], [0.0, 0.0, -1.0], [0.01, 0.01, 1.0]])
        depth = [
            reference.optical_depth(at, o, d, reference.borders_along(o, d, 0.0, 600.0))[-1]
            for o, d in zip(start, toward, strict=True)
        ] * np.linalg.norm(toward, axis=1)
        found = integrate(field.volume, start, toward, extinction=0.1, device="cpu").transmittance
        np.testing.assert_allclose(found, np.exp(-0.1 * depth), rtol=ROUNDING)
        # The tiles as light: in clear air, and in themselves.
        clear = Field(np.zeros((8, 8, 8)), background=0.0).volume
        light = integrate(clear, start, toward, emission=field.volume, device="cpu").emission
        np.testing.assert_allclose(light, depth, rtol=ROUNDING)
        both = integrate(field.volume, start, toward, extinction=0.1, emission=field.volume, device="cpu").emission
        np.testing.assert_allclose(both, (1.0 - np.exp(-0.1 * depth)) / 0.1, rtol=1e-11)
        assert depth[0] > 25.0
        assert depth[2] > 4.0

    def test_no_fog_and_no_rays(self):
        empty = Field(np.zeros((8, 8, 8)), background=0.0, stored=np.zeros((1, 1, 1), bool)).volume
        assert integrate(empty, [[0.0, 0, 0]], [[1.0, 0, 0]], device="cpu").transmittance[0] == 1.0
        assert integrate(empty, np.empty((0, 3)), np.empty((0, 3)), device="cpu").transmittance.shape == (0,)
        assert integrate(_fog(0).volume, [[0.0, 0, 99.0]], [[1.0, 0, 0]], device="cpu").transmittance[0] == 1.0

    def test_opaque_fog_lets_nothing_through(self):
        found = integrate(_fog(0).volume, [[-20.0, 3, 12]], [[1.0, 0, 0]], extinction=1e9, device="cpu")
        assert found.transmittance[0] == 0.0


class TestEmission:
    @pytest.mark.slow
    @pytest.mark.parametrize("extinction", [0.0, 0.4, 5.0])
    @pytest.mark.parametrize("transform", [None, SHEARED], ids=["voxels", "sheared"])
    def test_random_emission(self, extinction, transform):
        # Other leaves than the density's: emission in clear air, and fog without emission.
        fog = _fog(5, transform=transform)
        glow = _fog(6, shape=(16, 24, 16), lower=(0, -8, 0), transform=transform)
        start, toward = _rays(fog, 25, 7)
        origins, directions = fog.to_world(start, toward)
        found = integrate(fog.volume, origins, directions, extinction=extinction, emission=glow.volume, device="cpu")
        length = np.linalg.norm(directions, axis=1)
        for i, (o, d) in enumerate(zip(start, toward, strict=True)):
            borders = reference.borders_along(o, d, 0.0, 80.0)
            # Twenty Gauss points in each cell are exact to the last digits at these depths.
            share, weight = np.polynomial.legendre.leggauss(20)
            inner = borders[:-1, None] + np.diff(borders)[:, None] * (0.5 * share + 0.5)
            t = np.append(np.concatenate([borders[:-1, None], inner], axis=1).ravel(), borders[-1])
            depth = extinction * length[i] * reference.optical_depth(fog.at, o, d, t)
            light = (reference.interpolant_along(glow.at, o, d, t) * np.exp(-depth))[:-1].reshape(-1, 21)[:, 1:]
            wanted = length[i] * (np.diff(borders) * (light @ weight) / 2).sum()
            assert found.emission[i] == pytest.approx(wanted, rel=1e-9, abs=1e-15)
            assert found.transmittance[i] == pytest.approx(math.exp(-depth[-1]), rel=1e-11)
        assert (found.emission > 1e-4).sum() > 8

    @pytest.mark.parametrize("extinction", [1.0, 300.0, 1e5, 1e9])
    def test_even_emission_in_even_fog(self, extinction):
        # Deep within, emission over density is what comes out.
        fog = Field(np.full((16, 8, 8), 1.0), background=0.0).volume
        glow = Field(np.full((16, 8, 8), 3.0), background=0.0).volume
        found = integrate(fog, [[1.5, 4, 4]], [[1.0, 0, 0]], extinction=extinction, emission=glow, device="cpu")
        if extinction == 1.0:
            # 13.5 voxels of full density, then a ramp down that emits a little more.
            assert found.emission[0] == pytest.approx(3.0, rel=1e-5)
        else:
            assert found.emission[0] == pytest.approx(3.0 / extinction, rel=1e-13)

    def test_part_of_a_ray(self):
        glow = Field(np.full((16, 8, 8), 3.0), background=0.0).volume
        clear = Field(np.zeros((8, 8, 8)), background=0.0).volume
        found = integrate(clear, [[1.0, 4, 4]], [[2.0, 0, 0]], emission=glow, t_min=1.0, max_distance=7.0, device="cpu")
        assert found.emission[0] == pytest.approx(3.0 * 5.0, rel=1e-14)
        assert found.transmittance[0] == 1.0


class TestErrors:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"origins": np.zeros((2, 2))}, "origins: shape"),
            ({"origins": [[0.0, 0, 0], [np.nan, 0, 0]]}, "origins: row 1 is not finite"),
            ({"directions": [[1.0, 0, 0], [0.0, 0, 0]]}, "directions: row 1 is zero"),
            ({"directions": [[1.0, 0, 0]]}, "directions: 1 rows for 2 origins"),
            ({"extinction": -1.0}, "extinction"),
            ({"extinction": np.inf}, "extinction"),
            ({"t_min": -1.0}, "t_min"),
            ({"max_distance": np.nan}, "max_distance"),
            ({"emission": _fog(1, transform=SHEARED).volume}, "emission: its transform"),
            ({"emission": Field(np.zeros((8, 8, 8)), background=0.5).volume}, "emission: the background"),
            ({"volume": Field(np.zeros((8, 8, 8)), background=0.5).volume}, "volume: the background"),
        ],
    )
    @pytest.mark.parametrize("glow", [False, True])
    def test_bad_arguments(self, change, message, glow):
        arguments = {"volume": _fog(0).volume, "origins": np.zeros((2, 3)), "directions": np.ones((2, 3)), **change}
        if glow:
            arguments.setdefault("emission", _fog(1).volume)
        with pytest.raises(InputError, match=message):
            integrate(**arguments, device="cpu")

    def test_vectors_are_refused(self):
        with pytest.raises(UnsupportedGridError, match="vec3f"):
            integrate(TypedGrid("vec3f").volume, np.zeros((1, 3)), np.ones((1, 3)), device="cpu")
        with pytest.raises(UnsupportedGridError, match="vec4f"):
            integrate(_fog(0).volume, [[0.0, 0, 0]], [[1.0, 0, 0]], emission=TypedGrid("vec4f").volume, device="cpu")
