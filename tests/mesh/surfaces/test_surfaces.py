"""Many surfaces in one call: every answer is that of a Surface of its mesh, to the last bit."""

import pickle
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.errors import InputError
from geokit.mesh import Surface, Surfaces, TriangleMesh
from tests.support.devices import DEVICES

# Of some meshes of the catalog.
pytestmark = pytest.mark.filterwarnings("ignore:.*signs of its distances mean nothing")


def _catalog() -> list[TriangleMesh]:
    """Clean, inside out, open, damaged, doubled and nested meshes, in several places and sizes."""
    ball = mesh_catalog.icosphere()
    traits = [make() for make in (*mesh_catalog.CLOSED, *mesh_catalog.OPEN, *mesh_catalog.DEFECTIVE)]
    broken = [damage(ball) for damage in mesh_catalog.BROKEN.values()]
    tiny = mesh_catalog.moved(mesh_catalog.scaled(mesh_catalog.inside_out(ball), 1e-5), (1e3, 0.0, 0.0))
    # The same positions again; more triangles than one thread builds a subtree of.
    return [*traits, *broken, tiny, ball, mesh_catalog.doubled(ball), mesh_catalog.icosphere(5)]


def _queries(meshes: list[TriangleMesh], each: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    counts = rng.integers(0, each, len(meshes))
    counts[2] = 0
    points = [
        mesh.bounds.mean(axis=0) + rng.uniform(-0.8, 0.8, (count, 3)) * mesh.diagonal
        for mesh, count in zip(meshes, counts, strict=True)
    ]
    return np.concatenate(points), np.concatenate([[0], np.cumsum(counts)])


def _loop(surfaces: list[Surface], offsets: np.ndarray, ask: Any) -> Any:
    answers = [
        ask(surface, slice(begin, end))
        for surface, begin, end in zip(surfaces, offsets[:-1], offsets[1:], strict=True)
        if end > begin
    ]
    if not isinstance(answers[0], tuple):
        return [np.concatenate(answers)]
    return [np.concatenate(outputs) for outputs in zip(*answers, strict=True)]


def _assert_same(found: Any, expected: list[np.ndarray]) -> None:
    for output, other in zip(found if isinstance(found, tuple) else [found], expected, strict=True):
        output = output if isinstance(output, np.ndarray) else output.numpy()
        assert output.dtype == other.dtype
        assert np.array_equal(output, other, equal_nan=other.dtype.kind == "f")


@pytest.fixture(scope="module", params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def meshes() -> list[TriangleMesh]:
    return _catalog()


@pytest.fixture(scope="module")
def loop(meshes: list[TriangleMesh], device: str) -> list[Surface]:
    return [Surface(mesh, device=device) for mesh in meshes]


@pytest.fixture(scope="module")
def many(meshes: list[TriangleMesh], device: str) -> Surfaces:
    return Surfaces(meshes, device=device)


@pytest.mark.parametrize("max_distance", [np.inf, 0.1])
def test_closest_points(many: Surfaces, loop: list[Surface], meshes: list[TriangleMesh], max_distance: float) -> None:
    points, offsets = _queries(meshes)
    found = many.closest_point(points, offsets, max_distance=max_distance)
    _assert_same(found, _loop(loop, offsets, lambda s, r: s.closest_point(points[r], max_distance=max_distance)))


@pytest.mark.parametrize("sign", ["auto", "winding", "pseudonormal", "parity"])
@pytest.mark.parametrize("max_distance", [np.inf, 0.1])
def test_signed_distances(
    many: Surfaces, loop: list[Surface], meshes: list[TriangleMesh], sign: str, max_distance: float
) -> None:
    points, offsets = _queries(meshes)
    options: dict[str, Any] = {"sign": sign, "max_distance": max_distance}
    found = many.signed_distance(points, offsets, **options)
    assert (found.distance < 0.0).any()
    assert (found.distance > 0.0).any()
    _assert_same(found, _loop(loop, offsets, lambda s, r: s.signed_distance(points[r], **options)))


@pytest.mark.parametrize("sign", ["auto", "winding", "pseudonormal", "parity"])
def test_contains(many: Surfaces, loop: list[Surface], meshes: list[TriangleMesh], sign: str) -> None:
    points, offsets = _queries(meshes)
    found = many.contains(points, offsets, sign=sign)
    _assert_same(found, _loop(loop, offsets, lambda s, r: s.contains(points[r], sign=sign)))


def test_first_hits(many: Surfaces, loop: list[Surface], meshes: list[TriangleMesh]) -> None:
    origins, offsets = _queries(meshes, 700)  # more rays than a thread takes at once
    owner = np.repeat(np.arange(len(meshes)), np.diff(offsets))
    aims = np.array([mesh.bounds.mean(axis=0) for mesh in meshes])[owner]
    directions = aims + np.random.default_rng(4).uniform(-0.1, 0.1, origins.shape) - origins
    found = many.raycast(origins, directions, offsets, t_min=0.01, max_distance=1e3)
    assert (found.triangle_id >= 0).any()
    expected = _loop(loop, offsets, lambda s, r: s.raycast(origins[r], directions[r], t_min=0.01, max_distance=1e3))
    _assert_same(found, expected)


def test_methods_are_those_of_single_surfaces(many: Surfaces, loop: list[Surface]) -> None:
    assert list(many._signs.by_pseudonormal) == [surface.sign_method == "pseudonormal" for surface in loop]


def test_as_many_rows_for_each_mesh(many: Surfaces, meshes: list[TriangleMesh]) -> None:
    count = len(meshes)
    points = np.random.default_rng(5).uniform(-1, 1, (count, 7, 3)).astype(np.float32)
    offsets = np.arange(count + 1) * 7
    found, packed = many.signed_distance(points), many.signed_distance(points.reshape(-1, 3), offsets)
    assert found.distance.shape == (count, 7)
    assert found.points.shape == (count, 7, 3)
    assert found.distance.dtype == np.float32
    flat = tuple(output.reshape(-1, *output.shape[2:]) for output in found)
    _assert_same(flat, list(packed))
    assert many.contains(points).shape == (count, 7)
    assert many.raycast(points, np.ones_like(points)).t.shape == (count, 7)


def test_packed_arrays_may_share_vertices(device: str) -> None:
    ball = gk.mesh.sphere(segments=12)
    half = ball.face_count // 2
    packed = Surfaces(
        (ball.vertices, np.concatenate([ball.faces, ball.faces[:half]]), [0, ball.face_count, half * 3]), device=device
    )
    parts = Surfaces([ball, TriangleMesh(ball.vertices, ball.faces[:half])], device=device)
    points = np.random.default_rng(6).uniform(-1.5, 1.5, (2, 50, 3))
    _assert_same(packed.signed_distance(points), list(parts.signed_distance(points)))
    assert packed.mesh(1).face_count == half
    assert len(packed) == 2


def test_a_copy_answers_the_same(many: Surfaces, meshes: list[TriangleMesh]) -> None:
    points, offsets = _queries(meshes)
    copy = pickle.loads(pickle.dumps(many))
    _assert_same(copy.signed_distance(points, offsets), list(many.signed_distance(points, offsets)))


def test_surface_of_one_mesh(many: Surfaces, loop: list[Surface], meshes: list[TriangleMesh]) -> None:
    points = np.random.default_rng(7).uniform(-1, 1, (50, 3))
    for index in (0, 10, 20):
        surface = many.surface(index)
        _assert_same(surface.signed_distance(points), list(loop[index].signed_distance(points)))
        _assert_same(surface.raycast(points, -points), list(loop[index].raycast(points, -points)))
        surface.update(meshes[index].vertices + 1.0)  # an object of its own from here on
    where = np.array([0, *[50] * len(meshes)])
    _assert_same(many.closest_point(points, where), list(loop[0].closest_point(points)))
    _assert_same(many.signed_distance(points, where), list(loop[0].signed_distance(points)))


BALL = gk.mesh.sphere(segments=8)


@pytest.mark.parametrize(
    ("meshes", "message"),
    [
        ([], "meshes: there are none"),
        ([BALL, 3], r"meshes\[1\]"),
        ([BALL, TriangleMesh(BALL.vertices, np.zeros((0, 3), int))], "mesh 1 has no faces"),
        ((BALL.vertices, BALL.faces, [0, 3, 2, BALL.face_count]), "ascending whole numbers"),
        ((BALL.vertices, BALL.faces, [0, 3]), f"from 0 to {BALL.face_count} faces"),
        ((BALL.vertices, BALL.faces, [0, 3, 3, BALL.face_count]), "mesh 1 has no faces"),
    ],
)
def test_bad_meshes(meshes: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Surfaces(meshes, device="cpu")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((4, 3)),), r"points: shape \(4, 3\) is not \(2, N, 3\)"),
        ((np.zeros((4, 3)), [0, 4]), "offsets: .* is not 3 ascending whole numbers from 0 to 4 points"),
        ((np.zeros((4, 3)), [0, 1.5, 4]), "offsets"),
        ((np.zeros((4, 3)), [0, np.nan, 4]), "offsets"),
        ((np.zeros((4, 3)), [1, 2, 4]), "offsets"),
        ((np.array([[0, 0, 0], [0, 0, np.nan]]), [0, 1, 2]), "points: row 1 is not finite"),
    ],
)
def test_bad_queries(arguments: Any, message: str) -> None:
    surfaces = Surfaces([BALL, BALL], device="cpu")
    for ask in (surfaces.closest_point, surfaces.signed_distance, surfaces.contains):
        with pytest.raises(InputError, match=message):
            ask(*arguments)


def test_bad_rays_and_numbers() -> None:
    surfaces = Surfaces([BALL, BALL], device="cpu")
    rows = np.ones((2, 1, 3))
    with pytest.raises(InputError, match="directions: row 1 is zero"):
        surfaces.raycast(rows, np.array([[[1, 0, 0]], [[0, 0, 0.0]]]))
    with pytest.raises(InputError, match="directions: shape"):
        surfaces.raycast(rows, np.ones((2, 2, 2)))
    with pytest.raises(InputError, match="give one for each"):
        surfaces.raycast(rows, np.ones((2, 2, 3)))
    with pytest.raises(InputError, match="index"):
        surfaces.mesh(2)
    huge = Surfaces([BALL, TriangleMesh(BALL.vertices * 1e80, BALL.faces)], device="cpu")
    with pytest.raises(InputError, match="scale it"):
        huge.closest_point(rows)
