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
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.gradients.library import Library, cross, dot, length
from geokit.core.gradients.rules import Asked, Deferred, Rule
from geokit.core.interop import user_arrays
from geokit.mesh.queries.foot_slopes_kernels import DISTANCE_SLOPES, FOOT_SLOPES, ROUNDING, SHORT

__all__ = [
    "CLOSEST_POINT",
    "CLOSEST_POINT_OF_MANY",
    "RAYCAST",
    "RAYCAST_OF_MANY",
    "SIGNED_DISTANCE",
    "SIGNED_DISTANCE_OF_MANY",
    "corners_of",
]

# ROUNDING for what is computed in float32, as jax may be set to: 64 roundings.
ROUNDING_SINGLE = 2.0**-17


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


def _near_slopes(
    library: Library, asked: Asked, point: Any, triangle_id: Any, weights: Any, distance: Any, *, bands: Any
) -> tuple[Any, Any]:
    """The derivative of distances by the points, and the weights of the feet; those of :func:`_closest`."""
    wide = {name: library.wide(library.detach(tensor)) for name, tensor in asked.tensors.items()}
    asked = asked._replace(tensors=wide)
    a, b, c, _ = corners_of(library, asked, triangle_id)
    foot, shares, height, is_face = _foot(library, point, (a, b, c), weights)
    along, side = _sides(library, asked, triangle_id, distance, height, is_face, bands)
    outside = library.where(distance < 0.0, -1.0, 1.0)
    normal = cross(library, b - a, c - a)
    over_face = _ratio(library, side, length(library, normal))[:, None] * normal
    over_edge = _ratio(library, outside, length(library, point - foot))[:, None] * (point - foot)
    return library.where(along[:, None], over_face, over_edge), shares


def _quick_distance(place: int) -> Any:
    """The derivative of distances alone: the direction from the surface; ``place`` is that of the distance."""

    def quick(library: Library, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> Any:
        # Of the distance alone.
        if [slope is None for slope in slopes] != [number != place for number in range(4)]:
            return None
        (triangle_id, weights), distance, feet = answer[2:], answer[place], answer[1 - place]
        if distance.dtype != weights.dtype or "float64" not in str(distance.dtype):
            return None
        point = library.detach(asked.tensors["points"])
        found = triangle_id >= 0
        away = library.where(found, slopes[place] / distance, 0.0)[:, None] * library.where(
            found[:, None], point - feet, 0.0
        )
        weights = library.where(found[:, None], weights, 0.0)
        bands = _bands(library, point, asked.arguments["self"].scale)
        short = library.rows(found & (abs(distance) <= bands[1]))
        if len(short):
            near = (part[short] for part in (point, triangle_id, weights, distance))
            near_bands = tuple(band[short] for band in bands) if place == 0 else None
            direction, weights[short] = _near_slopes(library, asked, *near, bands=near_bands)
            away[short] = slopes[place][short][:, None] * direction
        result = {"points": away}
        if "vertices" in wanted:
            faces = _faces(library, asked, away)[library.where(found, triangle_id, 0)]
            shares = weights[:, :, None] * -away[:, None]
            result["vertices"] = library.add(shares, faces, len(asked.tensors["vertices"]))
        return result

    return quick


def _on_device(place: int) -> Any:
    """The derivatives by points where they are; ``place`` is that of the distance."""

    def on_device(asked: Asked, answer: Any, slopes: Any, totals: dict[str, Any]) -> bool:
        surface, points = asked.arguments["self"], asked.tensors["points"]
        if list(totals) != ["points"] or surface._device != points.device:
            return False
        triangle_id, weights = answer[2:]
        inputs = [*_arrays_of(surface, place), points, answer[place], triangle_id, weights]
        by = [slopes[place], slopes[1 - place], slopes[3]]
        kernel: Any = FOOT_SLOPES[answer[place].dtype]
        launcher.launch(kernel, len(points), [*inputs, *by], [totals["points"]], points.device)
        return True

    return on_device


def _on_tensors(place: int) -> Any:
    """The derivatives by points in one kernel; ``place`` is that of the distance."""

    def on_tensors(asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> Any:
        surface, points = asked.arguments["self"], asked.tensors["points"]
        alone = [slope is None for slope in slopes] == [number != place for number in range(4)]
        beside = _are_beside(surface, [points, answer[place]], wanted, ("points",))
        if not beside or (alone and _is_quick_in_torch(points)):
            return None
        import warp as wp

        from geokit.core.gradients.tensor_rows import TensorRows, launch, number_of

        (triangle_id, weights), distance, feet = answer[2:], answer[place], answer[1 - place]
        number = number_of(points)
        if alone:
            # Feet of float32 are too near to their points to tell the direction between them.
            short = math.inf if points.element_size() == 4 else SHORT * surface.scale
            out, kernel, options = points.new_empty(points.shape), DISTANCE_SLOPES[number], [wp.float64(short)]
            given = [points, distance, feet, triangle_id, weights, slopes[place]]
        else:
            out, kernel, options = points.new_zeros(points.shape), FOOT_SLOPES[number], []
            none = points.new_zeros(3)
            by = slopes[place], slopes[1 - place], slopes[3]
            whole = [
                (none[0] if like.ndim == 1 else none).expand(like.shape) if slope is None else slope
                for slope, like in zip(by, (distance, points, points), strict=True)
            ]
            given = [points, distance, triangle_id, weights, *whole]
        inputs = [*_arrays_of(surface, place), *options, *map(TensorRows, given)]
        launch(kernel, len(points), inputs, [TensorRows(out)], surface._device)
        return {"points": out}

    return on_tensors


def _is_quick_in_torch(rows: Any) -> bool:
    """Whether the few passes of :func:`_quick_distance` take no longer than a launch: for float64 rows on a CPU."""
    return bool(rows.is_cpu) and rows.element_size() == 8


def _are_beside(surface: Any, tensors: list[Any], wanted: list[str], known: tuple[str, ...]) -> bool:
    """Whether tensors lie where the surface is, are of one precision, and a kernel knows the derivatives wanted."""
    if not set(known).issuperset(wanted) or any(tensor.dtype != tensors[0].dtype for tensor in tensors):
        return False
    from geokit.core.gradients.tensor_rows import device_of

    return bool(surface._device == device_of(tensors[0]))


def _arrays_of(surface: Any, place: int) -> list[Any]:
    """What the kernels of closest points take of a surface; ``place`` is that of the distance, which is signed at 0."""
    import warp as wp

    # Without signs the outward sides are not read.
    sides = surface._outward_sides if place == 0 else surface._faces
    return [surface._vertices, surface._faces, wp.float64(surface.scale), place == 0, sides]


def _quick_hit(library: Library, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> Any:
    """The derivative of t alone: a hit stays on the plane of its triangle."""
    if slopes[0] is None or slopes[2] is not None or "float64" not in str(answer[0].dtype):
        return None
    t, triangle_id, weights = answer
    a, b, c, found = corners_of(library, asked, triangle_id)
    normal = cross(library, b - a, c - a)
    steep = dot(library.detach(asked.tensors["directions"]), normal)
    some = found & (steep != 0.0)
    back = library.where(some, slopes[0] / library.where(some, steep, 1.0), 0.0)[:, None] * normal
    result = {"origins": -back}
    if "directions" in wanted:
        result["directions"] = library.where(some, t, 0.0)[:, None] * -back
    if "vertices" in wanted:
        faces = _faces(library, asked, back)[library.where(found, triangle_id, 0)]
        shares = library.where(some[:, None], weights, 0.0)[:, :, None] * back[:, None]
        result["vertices"] = library.add(shares, faces, len(asked.tensors["vertices"]))
    return result


def _hit_on_tensors(asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> Any:
    """The derivatives of t by rays in one kernel."""
    surface, directions = asked.arguments["self"], asked.tensors.get("directions")
    if slopes[0] is None or slopes[2] is not None or directions is None:
        return None
    given = [directions, asked.tensors.get("origins", directions), answer[0]]
    if not _are_beside(surface, given, wanted, ("origins", "directions")):
        return None
    from geokit.core.gradients.tensor_rows import TensorRows, launch, number_of
    from geokit.mesh.queries.hit_slopes_kernels import HIT_SLOPES

    t, triangle_id, _ = answer
    count = len(directions)
    out = {name: directions.new_empty((count if name in wanted else 0, 3)) for name in ("origins", "directions")}
    inputs = [surface._vertices, surface._faces, *map(TensorRows, (directions, t, triangle_id, slopes[0]))]
    outputs = list(map(TensorRows, out.values()))
    launch(HIT_SLOPES[number_of(directions)], count, inputs, outputs, surface._device)
    return {name: out[name] for name in wanted}


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
    quick=_quick_distance(1),
    on_device=_on_device(1),
    on_tensors=_on_tensors(1),
    shapes=_shapes_of_points((3, "float"), (1, "float"), (1, "int32"), (3, "float")),
)
SIGNED_DISTANCE = Rule(
    (True, True, False, True),
    _signed_distance,
    quick=_quick_distance(0),
    on_device=_on_device(0),
    on_tensors=_on_tensors(0),
    shapes=_shapes_of_points((1, "float"), (3, "float"), (1, "int32"), (3, "float")),
)
RAYCAST = Rule(
    (True, False, True),
    _raycast,
    quick=_quick_hit,
    on_tensors=_hit_on_tensors,
    shapes=_shapes_of_points((1, "float"), (1, "int32"), (3, "float")),
)


def _of_many(rule: Rule) -> Rule:
    """The rule of a query of :class:`geokit.mesh.Surfaces`: that of one surface of all the meshes."""

    def packed(library: Library, asked: Asked, answer: Any) -> tuple[Asked, list[Any]]:
        surfaces, offsets = asked.arguments["self"], asked.arguments["offsets"]
        name = "points" if "points" in asked.arguments else "origins"
        like, lead = asked.tensors[name], _lead(asked, name)
        bounds = np.arange(len(surfaces) + 1) * lead[-1] if offsets is None else user_arrays.read_numbers(offsets, "")
        where: NDArray[np.int64] = np.asarray(bounds, np.int64)
        owner = np.repeat(np.arange(len(surfaces)), where[1:] - where[:-1])
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

    def quick(library: Library, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> Any:
        of_one: Any = rule.quick
        flat, rows = packed(library, asked, answer)
        steep = [None if slope is None else slope.reshape(part.shape) for slope, part in zip(slopes, rows, strict=True)]
        found = of_one(library, flat, rows, steep, wanted)
        return found and {name: part.reshape(asked.tensors[name].shape) for name, part in found.items()}

    return rule._replace(build=build, quick=quick, on_device=None, on_tensors=None)


CLOSEST_POINT_OF_MANY = _of_many(CLOSEST_POINT)
SIGNED_DISTANCE_OF_MANY = _of_many(SIGNED_DISTANCE)
RAYCAST_OF_MANY = _of_many(RAYCAST)
