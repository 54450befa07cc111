"""Derivatives of closest points, signed distances and first hits, with respect to queries and to the mesh's vertices.

A search names the triangle, and zeros among its barycentric weights name the face, edge or vertex. The answer is then
the foot on that plane, line or point, which has a closed form. Where an answer jumps between features, the derivative
is that of the feature that was found; for a miss it is 0.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from geokit.core.gradients.library import Library, cross, dot, length
from geokit.core.gradients.rules import Asked, Deferred, Rule
from geokit.core.interop import user_arrays
from geokit.core.interop.arrays import lead_of
from geokit.mesh.queries.foot_slopes_kernels import FOOT_SLOPES, ROUNDING, SHORT, SlopedFaces
from geokit.mesh.queries.hit_slopes_kernels import HIT_SLOPES

# ROUNDING for what is computed in float32, as jax may be set to: 64 roundings.
ROUNDING_SINGLE = 2.0**-17
# Rows whose corners can be sorted: twice as many places as there are corners, numbered with 31 bits.
MOST_CORNERED = 2**31 // 6 - 1


def corners_of(library: Library, asked: Asked, triangle_id: Any) -> tuple[Any, Any, Any, Any]:
    """The corners (N, 3) of each answer's triangle, and whether there is one; misses get triangle 0."""
    queries = next(iter(asked.tensors.values()))
    surface = asked.arguments["self"]
    found = triangle_id >= 0
    rows = library.where(found, triangle_id, 0)
    faces = _faces(library, asked, queries)[rows]
    vertices = asked.tensors.get("vertices")
    if vertices is None:
        vertices = library.kept(surface._cache, "vertices", surface.mesh.vertices, queries)
    return (*(library.take(vertices, faces[..., corner]) for corner in range(3)), found)


def _faces(library: Library, asked: Asked, like: Any) -> Any:
    surface = asked.arguments["self"]
    return library.kept(surface._cache, "faces", surface.mesh.faces, like)


def _ratio(library: Library, top: Any, bottom: Any) -> Any:
    """A quotient; 0 where the divisor is."""
    some = bottom != 0.0
    return library.where(some, top / library.where(some, bottom, 1.0), 0.0)


def _foot(library: Library, point: Any, corners: Any, weights: Any) -> tuple[Any, Any, Any, Any]:
    """Foot and its weights (N, 3), height over the triangle's plane (N,), and whether the face is closest."""
    a, b, c = corners
    inside = [weights[..., corner] > 0.0 for corner in range(3)]
    normal = cross(library, b - a, c - a)
    area = dot(normal, normal)
    is_face = inside[0] & inside[1] & inside[2] & (area > 0.0)
    # On the plane.
    drop = _ratio(library, dot(point - a, normal), area)
    on_face = point - drop[..., None] * normal
    second = _ratio(library, dot(cross(library, on_face - a, c - a), normal), area)
    third = _ratio(library, dot(cross(library, b - a, on_face - a), normal), area)
    of_face = library.stack([1.0 - second - third, second, third], -1)
    # On the line through the two corners with weight; on the corner if there is only one.
    begin = library.where(inside[0][..., None], a, library.where(inside[1][..., None], b, c))
    end = library.where(inside[2][..., None], c, library.where(inside[1][..., None], b, a))
    share = _ratio(library, dot(point - begin, end - begin), dot(end - begin, end - begin))
    on_edge = begin + share[..., None] * (end - begin)
    first_is, last_is = (
        [inside[0], ~inside[0] & inside[1], ~inside[0] & ~inside[1]],
        [~inside[2] & ~inside[1], ~inside[2] & inside[1], inside[2]],
    )
    of_edge = library.stack(
        [
            library.where(is_first, 1.0 - share, 0.0) + library.where(is_last, share, 0.0)
            for is_first, is_last in zip(first_is, last_is, strict=True)
        ],
        -1,
    )
    foot = library.where(is_face[..., None], on_face, on_edge)
    height = drop * length(library, normal)
    return foot, library.where(is_face[..., None], of_face, of_edge), height, is_face


def _bands(library: Library, point: Any, scale: Any) -> tuple[Any, Any]:
    """Distances (N,) within which the direction from the foot is noise, and within which the sign may be."""
    share = ROUNDING if "float64" in str(point.dtype) else ROUNDING_SINGLE
    noise = share * (abs(library.detach(point)).sum(-1) + scale)
    return noise, SHORT * scale + noise


def _outward(library: Library, asked: Asked, triangle_id: Any) -> Any:
    """1 where the winding of a triangle shows outward, -1 where it shows inward."""
    surface, rows = asked.arguments["self"], library.where(triangle_id >= 0, triangle_id, 0)
    if not isinstance(surface, Deferred):
        return library.kept(surface._cache, "outward", surface._outward, triangle_id)[rows]
    # Which faces flip is known where the vertices are.
    bare = surface.holding({})
    return library.ask(
        lambda rows, vertices: bare.made(vertices=vertices)._outward[rows], rows, (), asked.tensors["vertices"]
    )


def _sides(
    library: Library, asked: Asked, triangle_id: Any, distance: Any, height: Any, is_face: Any, bands: Any
) -> tuple[Any, Any]:
    """Whether a distance goes on along the normal of its triangle (N,), and on which side of it: 1, -1, or 0 for none.

    A signed distance, which has ``bands``, goes on outward on both sides of a surface; so it does where edges and
    vertices are too near for a direction from them. An unsigned one has a kink there.
    """
    side = library.where((height < 0.0) == (distance < 0.0), 1.0, -1.0)
    if bands is None:
        on_surface = distance == 0.0
        return is_face | on_surface, library.where(on_surface | (height == 0.0), 0.0, side)
    noise, near = bands
    side = library.where(abs(distance) <= near, _outward(library, asked, triangle_id), side)
    return is_face | (abs(distance) <= noise), side


def _closest(library: Library, asked: Asked, triangle_id: Any, weights: Any, distance: Any, signed: bool) -> Any:
    """Foot, distance and weights of a closest point."""
    point = asked.tensors.get("points")
    if point is None:
        like = next(iter(asked.tensors.values()))
        point = library.constant(asked.arguments["points"], like)
    *corners, found = corners_of(library, asked, triangle_id)
    weights = library.where(found[..., None], weights, 1.0)
    foot, shares, height, is_face = _foot(library, point, corners, weights)
    bands = _bands(library, point, asked.arguments["self"].scale) if signed else None
    along, side = _sides(library, asked, triangle_id, distance, height, is_face, bands)
    outside = library.where(distance < 0.0, -1.0, 1.0)
    far = library.where(along, side * height, outside * length(library, point - foot))
    return (
        library.where(found[..., None], foot, 0.0),
        library.where(found, far, 0.0),
        library.where(found[..., None], shares, 0.0),
    )


def _closest_point(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    _, distance, triangle_id, barycentric = answer
    foot, far, shares = _closest(library, asked, triangle_id, barycentric, distance, False)
    return foot, far, None, shares


def _signed_distance(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    distance, _, triangle_id, barycentric = answer
    foot, far, shares = _closest(library, asked, triangle_id, barycentric, distance, True)
    return far, foot, None, shares


def _foot_adjoint(place: int) -> Any:
    """The derivatives by points and vertices in one kernel; ``place`` is that of the distance, which is signed at 0."""

    def adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
        # Feet of float32 are too near to their points to tell the direction between them.
        shortest = math.inf if arrays.number is wp.float32 else SHORT
        given = [asked.tensors["points"], answer[place], answer[1 - place], *answer[2:]]
        by = [slopes[place], slopes[1 - place], slopes[3]]
        inputs = [
            *(arrays.given(rows, width) for rows, width in zip(given, (3, 1, 3, 1, 3), strict=True)),
            *(arrays.given(slope, width) for slope, width in zip(by, (1, 3, 3), strict=True)),
        ]
        options = [place == 0, wp.float64(shortest)]
        return _pulled(asked, FOOT_SLOPES, place == 0, [*options, *inputs], ("points",), wanted, arrays)

    return adjoint


def _hit_adjoint(asked: Asked, answer: Any, slopes: Any, wanted: list[str], arrays: Any) -> dict[str, Any] | None:
    """The derivatives by rays and vertices in one kernel."""
    given = [asked.tensors["directions"], *answer, slopes[0], slopes[2]]
    inputs = [arrays.given(rows, width) for rows, width in zip(given, (3, 1, 1, 3, 1, 3), strict=True)]
    return _pulled(asked, HIT_SLOPES, False, inputs, ("origins", "directions"), wanted, arrays)


def _pulled(
    asked: Asked, kernels: Any, signed: bool, inputs: list[Any], rows: tuple[str, ...], wanted: list[str], arrays: Any
) -> dict[str, Any] | None:
    """Launch a kernel of :mod:`foot_slopes_kernels`: derivatives by ``rows`` and by the vertices of the corners."""
    surface, first = asked.arguments["self"], asked.tensors[rows[0]]
    if arrays.device != surface._device:
        return None
    offsets, is_cornered = asked.arguments.get("offsets", ()), "vertices" in wanted
    count = math.prod(lead_of(first))
    if is_cornered and count > MOST_CORNERED:
        return None
    corners = (3 * count, 3, wp.float64) if is_cornered else (0, 1, wp.int32)
    out = [*(arrays.made(count if name in wanted else 0, 3) for name in rows), arrays.made(*corners)]
    out.append(arrays.made(corners[0], 1, wp.int32))
    mesh, owner = sloped_faces(surface, signed), _owners(surface, offsets, lead_of(first), arrays.device)
    arrays.launch(kernels[is_cornered][arrays.number], count, [mesh, owner, *inputs], out)
    found = dict(zip(rows, out, strict=False))
    if is_cornered:
        found["vertices"] = arrays.added(*out[-2:], len(asked.tensors["vertices"]))
    return {name: found[name] for name in wanted}


def sloped_faces(surface: Any, signed: bool) -> Any:
    """What the kernels take of a surface, or of many; without signs the outward sides are not read."""

    def make() -> Any:
        def there(values: Any, kind: Any) -> Any:
            return wp.array(values, dtype=kind, device=surface._device)

        found: Any = SlopedFaces()
        if hasattr(surface, "_packed"):
            vertices, faces = surface._packed
            found.vertices, found.faces = there(vertices, wp.vec3d), there(faces.ravel(), wp.int32)
            found.begins, found.scales = there(surface._begin[:-1], wp.int32), there(surface._scales, wp.float64)
        else:
            found.vertices, found.faces, found.scale = surface._vertices, surface._faces, wp.float64(surface.scale)
        if signed:
            outward = surface._signs.outward if hasattr(surface, "_packed") else surface._outward
            found.outward = there(outward, wp.int32)
        return found

    return surface._cache.find(("sloped faces", signed), make)


def _owners(surface: Any, offsets: Any, lead: tuple[int, ...], device: Any) -> Any:
    """The mesh of each row on the device; without rows if there is one mesh."""
    if not hasattr(surface, "_packed"):
        return surface._cache.find("no owners", lambda: wp.empty(0, dtype=wp.int32, device=device))
    return wp.array(_owner(surface, offsets, lead), dtype=wp.int32, device=device)


def _owner(surfaces: Any, offsets: Any, lead: tuple[int, ...]) -> NDArray[np.int64]:
    """The mesh of each row that many surfaces are asked."""
    bounds = np.arange(len(surfaces) + 1) * lead[-1] if offsets is None else user_arrays.read_numbers(offsets, "")
    where: NDArray[np.int64] = np.asarray(bounds, np.int64)
    return np.repeat(np.arange(len(surfaces)), where[1:] - where[:-1])


def _raycast(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
    _, triangle_id, _ = answer
    like = next(iter(asked.tensors.values()))
    origin, direction = (
        asked.tensors[name] if name in asked.tensors else library.constant(asked.arguments[name], like)
        for name in ("origins", "directions")
    )
    a, b, c, found = corners_of(library, asked, triangle_id)
    normal = cross(library, b - a, c - a)
    t = _ratio(library, dot(a - origin, normal), dot(direction, normal))
    hit, area = origin + t[..., None] * direction, dot(normal, normal)
    second = _ratio(library, dot(cross(library, hit - a, c - a), normal), area)
    third = _ratio(library, dot(cross(library, b - a, hit - a), normal), area)
    shares = library.stack([1.0 - second - third, second, third], -1)
    return library.where(found, t, 0.0), None, library.where(found[..., None], shares, 0.0)


def _lead(asked: Asked, name: str) -> tuple[int, ...]:
    """The shape of the answer's rows: (N,), or (B, N) of many surfaces."""
    return tuple(map(int, asked.tensors.get(name, asked.arguments[name]).shape[:-1]))


def _shapes_of_points(*outputs: tuple[int, str]) -> Any:
    def shapes(asked: Asked) -> list[tuple[tuple[int, ...], str]]:
        lead = _lead(asked, "points" if "points" in asked.arguments else "origins")
        return [((*lead, 3) if width == 3 else lead, kind) for width, kind in outputs]

    return shapes


CLOSEST_POINT = Rule(
    (True, True, False, True),
    _closest_point,
    adjoint=_foot_adjoint(1),
    shapes=_shapes_of_points((3, "float"), (1, "float"), (1, "int32"), (3, "float")),
)
SIGNED_DISTANCE = Rule(
    (True, True, False, True),
    _signed_distance,
    adjoint=_foot_adjoint(0),
    shapes=_shapes_of_points((1, "float"), (3, "float"), (1, "int32"), (3, "float")),
)
RAYCAST = Rule(
    (True, False, True),
    _raycast,
    adjoint=_hit_adjoint,
    shapes=_shapes_of_points((1, "float"), (1, "int32"), (3, "float")),
)


def _of_many(rule: Rule) -> Rule:
    """The rule of a query of :class:`geokit.mesh.Surfaces`: that of one surface of all the meshes."""

    def packed(library: Library, asked: Asked, answer: Any) -> tuple[Asked, list[Any]]:
        surfaces, offsets = asked.arguments["self"], asked.arguments["offsets"]
        name = "points" if "points" in asked.arguments else "origins"
        like, lead = asked.tensors[name], _lead(asked, name)
        owner = _owner(surfaces, offsets, lead)
        vertices, faces = surfaces._packed
        whole = SimpleNamespace(
            mesh=SimpleNamespace(vertices=vertices, faces=faces),
            scale=library.constant(surfaces._scales[owner], like),
            _cache=surfaces._cache,
            _outward=surfaces._signs.outward if rule is SIGNED_DISTANCE else None,
        )
        begin = library.constant(surfaces._begin[owner], like)
        rows = [part.reshape(math.prod(lead), *part.shape[len(lead) :]) for part in answer]
        # Numbers of triangles are the only ones that are no floats.
        rows = [library.where(part >= 0, part + begin, part) if "int" in str(part.dtype) else part for part in rows]
        flat = {key: part if key == "vertices" else part.reshape(-1, 3) for key, part in asked.tensors.items()}
        return Asked(flat, {**asked.arguments, **flat, "self": whole}), rows

    def build(library: Library, asked: Asked, answer: Any) -> tuple[Any, ...]:
        of_one: Any = rule.build
        outputs = of_one(library, *packed(library, asked, answer))
        return tuple(
            None if out is None else out.reshape(part.shape) for out, part in zip(outputs, answer, strict=True)
        )

    return rule._replace(build=build)


CLOSEST_POINT_OF_MANY = _of_many(CLOSEST_POINT)
SIGNED_DISTANCE_OF_MANY = _of_many(SIGNED_DISTANCE)
RAYCAST_OF_MANY = _of_many(RAYCAST)
