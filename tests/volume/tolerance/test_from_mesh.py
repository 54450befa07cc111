"""``from_mesh`` with a tolerance, and ``plan``: arguments, what is on the result, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.errors import DeviceMemoryError, InputError
from geokit.mesh import Surface
from geokit.volume import from_mesh, load, plan, save
from geokit.volume.tolerance import checked_fields
from geokit.volume.tolerance.checked_fields import checked_errors
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.interpolation_errors import interpolation_errors, quantization_step, stencils_of
from geokit.volume.tolerance.search import quickest

DEVICE = "cpu"
TORUS = Surface(mesh_catalog.torus(), device=DEVICE)
ASKED = {"within": None, "order": None, "half_width": None, "sign": "auto", "thickness": None, "codec": None}


@pytest.mark.slow
def test_the_order_that_was_chosen_is_the_one_that_samples_take():
    field = from_mesh(TORUS, tolerance=0.01)
    assert field.info.order == 3
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3))
    np.testing.assert_array_equal(field.sample(points), field.sample(points, order=3))
    np.testing.assert_array_equal(field.gradient(points), field.gradient(points, order=3))
    assert np.abs(field.sample(points) - field.sample(points, order=1)).max() > 0.0
    # A field that was not made for an order is sampled linearly.
    plain = from_mesh(TORUS, 0.1)
    assert plain.info.order is None
    np.testing.assert_array_equal(plain.sample(points), plain.sample(points, order=1))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nvdb", "vdb"])
def test_what_was_achieved_goes_through_files(tmp_path, kind):
    field = from_mesh(TORUS, tolerance=0.02, codec="float")
    path = tmp_path / f"torus.{kind}"
    save(path, field)
    info = load(path).info
    assert (info.tolerance, info.order) == (0.02, field.info.order)
    assert info.achieved_error == field.info.achieved_error
    assert info.achieved_error_999 == field.info.achieved_error_999


@pytest.mark.slow
@pytest.mark.parametrize(("order", "codec"), [(1, "float"), (2, "fp16"), (3, "fp8"), (1, "fpn"), (1, "fp4")])
def test_what_is_asked_for_is_not_chosen(order, codec):
    field = from_mesh(TORUS, tolerance=0.02, order=order, codec=codec)
    assert (field.info.order, field.info.grid_type) == (order, codec)
    assert field.info.achieved_error <= 0.02


@pytest.mark.slow
def test_a_wider_zone_needs_a_wider_band():
    near, far = (from_mesh(TORUS, tolerance=0.02, within=within, codec="float", order=1) for within in (0.0, 0.2))
    widths = [field.info.background / field.info.voxel_size[0] for field in (near, far)]
    assert widths[0] == pytest.approx(3.0**0.5, rel=1e-5)
    assert far.info.background > 0.2
    away = TORUS.mesh.vertices * 1.1
    exact = TORUS.signed_distance(away).distance
    kept = np.abs(exact) < 0.2
    assert kept.mean() > 0.9
    assert np.abs(far.sample(away[kept]) - exact[kept]).max() <= 0.02


@pytest.mark.slow
def test_shells_and_unsigned_distances_keep_it_too():
    points = TORUS.mesh.vertices[::7]
    shell = from_mesh(TORUS, tolerance=0.02, thickness=0.1)
    random = np.random.default_rng(2)
    moved = points + random.normal(size=points.shape) * 0.05
    exact = TORUS.closest_point(moved).distance - 0.05
    kept = np.abs(exact) < 0.02
    assert kept.sum() > 20
    assert np.abs(shell.sample(moved[kept]) - exact[kept]).max() <= 0.02
    unsigned = from_mesh(TORUS, tolerance=0.03, sign="none")
    assert unsigned.info.grid_class == "unknown"
    assert np.abs(unsigned.sample(points)).max() <= 0.03


@pytest.mark.slow
def test_foreseen_errors_are_those_of_the_grid():
    search = tolerance_search(TORUS, 0.02, **ASKED, device=None)
    points, exact = search.zone.draw(2000, 5)
    for order, codec in ((1, "float"), (2, "float"), (3, "float"), (3, "fp8")):
        setting = next(s for s in search.settings() if s.option.order == 3)
        setting = setting._replace(option=setting.option._replace(order=order, codec=codec, share=0.0))
        field = make_setting(search, setting)
        size, limit = setting.voxel_size, setting.half_width * setting.voxel_size
        step = quantization_step(codec, setting.half_width, size)
        foreseen = interpolation_errors(stencils_of(search.zone, points, exact, size, 3), order, limit, step)
        errors = np.abs(field.sample(points, order=order) - exact)
        if codec == "float":
            np.testing.assert_allclose(foreseen, errors, atol=1e-12)
        else:
            assert foreseen.max() == pytest.approx(errors.max(), rel=0.3)


@pytest.mark.slow
def test_a_field_that_is_worse_than_the_search_believes_is_noticed():
    search = tolerance_search(TORUS, 0.02, **ASKED, device=None)
    setting = next(quickest(search.settings()))
    honest = checked_errors(search.zone, make_setting(search, setting), setting, 3)
    coarse = setting._replace(voxel_size=2.0 * setting.voxel_size)
    spoiled = checked_errors(search.zone, make_setting(search, coarse), coarse, 3)
    assert honest.p999 < honest.largest < 1.3 * setting.error
    assert spoiled.largest > 2.0 * honest.largest


@pytest.mark.slow
def test_a_search_looks_where_it_was_told_of_errors():
    cone = Surface(mesh_catalog.cone(24, 2.0), device=DEVICE)
    search = tolerance_search(cone, 0.02, **ASKED, device=None)
    tip = cone.mesh.vertices[cone.mesh.vertices[:, 2].argmax()]
    told, exact = search.zone.kept(tip - np.linspace(0.0, 0.01, 50)[:, None] * (0.0, 0.0, 1.0))
    assert len(told) > 10
    before = next(quickest(search.settings()))
    search.correct(before, 0.03, told)
    for level in search.levels:
        trusted = [option for option, error in level.errors.items() if error <= search.aim]
        found = search._errors(told, exact, level.voxel_size, trusted) if trusted else {}
        assert all(found[option].max() <= level.errors[option] for option in trusted)
    points, _ = search._points(0.1, 1000)
    assert all((np.abs(points - place).max(axis=1) == 0.0).any() for place in told)
    after = next(quickest(search.settings()))
    assert after != before
    assert after.error <= search.aim


@pytest.mark.slow
def test_a_refusal_names_an_error_above_the_tolerance(monkeypatch):
    # Whatever the search believes: what was made is what can be reached.
    found = checked_fields.Achieved(0.05, 0.01, TORUS.mesh.vertices[:10])
    monkeypatch.setattr(checked_fields, "checked_errors", lambda *_: found)
    with pytest.raises(InputError, match=r"0.02 cannot be kept: errors do not fall below about 0.05"):
        from_mesh(TORUS, tolerance=0.02)


@pytest.mark.slow
def test_rows_of_a_plan_are_built_by_their_own_numbers():
    rows = [row for row in plan(TORUS, 0.02) if row.level_count == 1]
    assert {row.codec for row in rows} >= {"float", "fp16", "fpn"}
    for row in rows:
        field = from_mesh(TORUS, row.voxel_size, half_width=row.half_width, compact=True)
        if row.codec != "float":
            field = gk.volume.quantize(field, row.codec, tolerance=row.codec_tolerance)
        assert 0.75 < field.info.byte_count / row.byte_count < 1.25, row
    with pytest.raises(InputError, match="compact: only of use with method='geokit'"):
        from_mesh(TORUS, 0.1, method="openvdb", compact=True)


def test_a_compact_field_is_the_same_field_in_fewer_nodes():
    plain, compact = from_mesh(TORUS, 0.05, device="cpu"), from_mesh(TORUS, 0.05, compact=True, device="cpu")
    # Of eight upper nodes of 270 kB one is left.
    assert plain.info.byte_count - compact.info.byte_count > 1_800_000
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 3))
    np.testing.assert_allclose(compact.sample(points), plain.sample(points), atol=1e-6)


def test_a_plan_says_what_comes():
    tolerance = 0.015
    fields = [field for field in plan(TORUS, tolerance) if field.method == "from_mesh"]
    assert len({(field.order, field.codec) for field in fields}) == len(fields) > 1
    made = from_mesh(TORUS, tolerance=tolerance)
    best = fields[0]
    assert (made.info.order, made.info.grid_type) == (best.order, best.codec)
    assert made.info.achieved_error <= tolerance
    assert made.info.byte_count == pytest.approx(best.byte_count, rel=0.25)
    search = tolerance_search(TORUS, tolerance, **ASKED, device=None)
    for setting in search.settings():
        field = make_setting(search, setting)
        assert field.info.byte_count == pytest.approx(setting.byte_count, rel=0.25)
        # What was not checked may turn out a little worse, and from_mesh would then take another.
        assert checked_errors(search.zone, field, setting, 4).largest <= 1.3 * tolerance
    assert all(field.error <= tolerance and field.seconds > 0.0 for field in fields)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give either"),
        ({"voxel_size": 0.1, "tolerance": 0.1}, "give either"),
        ({"voxel_size": 0.1, "within": 0.1}, "within: only of use with tolerance"),
        ({"voxel_size": 0.1, "order": 1}, "order: only of use with tolerance"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"tolerance": 0.1, "order": 0}, "order: 0"),
        ({"tolerance": 0.1, "order": True}, "order: True"),
        ({"tolerance": 0.1, "codec": "fp7"}, "codec: 'fp7'"),
        ({"tolerance": 0.1, "within": -1.0}, "within"),
        ({"tolerance": 0.1, "half_width": (3.0, 4.0)}, "half_width: a pair"),
        ({"tolerance": 0.1, "half_width": 0.5}, "half_width"),
        ({"tolerance": 0.1, "method": "openvdb"}, "method"),
        ({"tolerance": 0.1, "sign": "guess"}, "sign"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        from_mesh(TORUS, **options)


@pytest.mark.slow
def test_what_memory_cannot_hold_is_refused_with_what_it_can():
    with pytest.raises(DeviceMemoryError, match=r"can \(.* times as much") as refused:
        from_mesh(TORUS, tolerance=1e-9, order=1, codec="float")
    reachable = float(str(refused.value).split("about ")[1].split(" can")[0])
    assert 1e-8 < reachable < 1e-4


@pytest.mark.slow
def test_a_band_too_narrow_for_the_zone_is_refused_with_what_it_reaches():
    # The zone begins where the band has ended: what is sampled there is the background.
    with pytest.raises(InputError, match="errors do not fall below about"):
        from_mesh(TORUS, tolerance=0.001, within=0.2, half_width=1.0, order=1, codec="float")


@pytest.mark.slow
def test_a_zone_without_width_is_checked_on_the_whole_surface():
    mesh = mesh_catalog.l_profile()
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    mesh = gk.mesh.TriangleMesh(mesh.vertices @ turn.T + [3.0, -7.0, 5.0], mesh.faces)
    field = gk.volume.from_mesh(mesh, tolerance=0.03, within=0.0, order=1, device="cpu")
    points = gk.mesh.sample_surface(mesh, 20_000, seed=9).points
    errors = np.abs(field.sample(points, order=1, device="cpu"))
    # Were only points kept whose rounded distance is 0, the quantile would be that of a few corners.
    assert errors.max() <= 1.03 * field.info.achieved_error
    assert np.quantile(errors, 0.999) <= 1.1 * field.info.achieved_error_999
