"""Gradients through jax: queries inside grad, jit and vmap."""

from __future__ import annotations

import functools
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from geokit.core.gradients.library import Library
from geokit.core.gradients.rules import Asked, Call, Deferred, is_warp_array, owner_of
from geokit.core.gradients.with_numpy import pulled
from geokit.errors import InputError

_Same = TypeVar("_Same", bound="Traced")


class Traced(Deferred):
    """An object that holds arrays of jax."""

    def constant(self: _Same, held: dict[str, jax.Array]) -> _Same:
        """The same, of constants."""
        return self.holding({name: jax.lax.stop_gradient(value) for name, value in held.items()})


def attach(call: Call) -> Any:
    """Answer a call with arrays that carry gradients."""
    tensors = [jnp.asarray(call.asked.tensors[name]) for name in call.names]
    for name, tensor in zip(call.names, tensors, strict=True):
        if not jnp.issubdtype(tensor.dtype, jnp.floating):
            raise InputError(f"{name}: {tensor.dtype} has no gradients; give float32 or float64")
    # Tracers must not outlive their trace.
    others = {name: _stripped(value) for name, value in call.asked.arguments.items() if name not in call.names}
    plain = call._replace(asked=Asked({}, others))
    answer = _query(plain, *tensors)
    return answer[0] if call.query.kind is None else call.query.kind(*answer)


def _stripped(value: Any) -> Any:
    return value.holding({}) if isinstance(value, Deferred) else value


def _asked(call: Call, tensors: Any) -> Asked:
    given = dict(zip(call.names, tensors, strict=True))
    arguments = {**call.asked.arguments, **{name: given[name] for name in call.query.inputs if name in given}}
    for owner, held in _held(call, given).items():
        arguments[owner] = arguments[owner].holding(held)
    return Asked(given, arguments)


def _held(call: Call, given: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tensors that objects hold, by the object's parameter and by name."""
    found: dict[str, dict[str, Any]] = {}
    for name, value in given.items():
        if name not in call.query.inputs:
            owner, key = owner_of(call.query, name)
            found.setdefault(owner, {})[key] = value
    return found


def _answer(call: Call, rows: tuple[Any, ...]) -> tuple[Any, ...]:
    """The answer for NumPy arrays."""
    asked = _asked(call, rows)
    for owner, held in _held(call, asked.tensors).items():
        asked.arguments[owner] = asked.arguments[owner].made(**held)
    answer = call.query.run(asked.arguments)
    return answer if isinstance(answer, tuple) else (answer,)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _query(call: Call, *tensors: Any) -> Any:
    rule = call.query.rule()
    if rule.shapes is None:
        raise InputError(f"{', '.join(call.names)}: jax needs the answer's shape before it is known; use torch")
    kind = tensors[0].dtype
    specs = [
        jax.ShapeDtypeStruct(shape, kind if name == "float" else np.dtype(name))
        for shape, name in rule.shapes(_asked(call, tensors))
    ]
    ranks = [tensor.ndim for tensor in tensors]
    # Rows that do not depend on each other are rows of one call, whatever batch they are of.
    one_by_one = not call.query.is_single or any(name not in call.query.inputs for name in call.names)

    def run(*rows: Any) -> Any:
        given = [np.asarray(row) for row in rows]
        # vmap puts its axes first.
        batch = given[0].shape[: given[0].ndim - ranks[0]]
        flat = [row.reshape(-1, *row.shape[len(batch) :]) for row in given]
        if one_by_one:
            parts = [_answer(call, tuple(part)) for part in zip(*flat, strict=True)]
            answer: Any = [np.stack([np.asarray(part) for part in outputs]) for outputs in zip(*parts, strict=True)]
        else:
            answer = _answer(call, tuple(row.reshape(-1, *row.shape[2:]) for row in flat))
        return tuple(
            np.asarray(out).astype(spec.dtype).reshape(*batch, *spec.shape)
            for out, spec in zip(answer, specs, strict=True)
        )

    found: Any = jax.pure_callback(run, tuple(specs), *tensors, vmap_method="broadcast_all")
    return found


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _pulled_on_host(call: Call, tensors: Any, answer: Any, slopes: Any) -> Any:
    """The derivatives of a rule that jax cannot trace."""
    counts = len(tensors), len(tensors) + len(answer)
    specs = tuple(jax.ShapeDtypeStruct(tensor.shape, tensor.dtype) for tensor in tensors)

    def run(*rows: Any) -> Any:
        given = [np.asarray(row) for row in rows]
        asked, found = _asked(call, given[: counts[0]]), given[counts[0] : counts[1]]
        pulls = pulled(call.query, asked, found, given[counts[1] :], list(call.names))
        parts = [pulls[name].numpy() if is_warp_array(pulls[name]) else pulls[name] for name in call.names]
        return tuple(np.asarray(part, spec.dtype) for part, spec in zip(parts, specs, strict=True))

    return jax.pure_callback(run, specs, *tensors, *answer, *slopes, vmap_method="sequential")


@_pulled_on_host.defjvp
def _(call: Call, primals: Any, tangents: Any) -> Any:
    raise InputError(f"{', '.join(call.names)}: second derivatives are not known in jax; use torch")


def _forward(call: Call, *tensors: Any) -> Any:
    answer = _query(call, *tensors)
    return answer, (tensors, answer)


def _backward(call: Call, kept: Any, slopes: Any) -> Any:
    tensors, answer = kept
    asked, rule = _asked(call, tensors), call.query.rule()
    if not rule.is_traced:
        if rule.check is not None:
            rule.check(asked)  # errors of a callback have another type
        return _pulled_on_host(call, tensors, answer, slopes)
    if rule.pull is not None:
        found = rule.pull(LIBRARY, asked, answer, slopes)
        return tuple(found[name].astype(tensor.dtype) for name, tensor in zip(call.names, tensors, strict=True))
    build: Any = rule.build

    def outputs(*some: Any) -> Any:
        given = {name: _wide(tensor) for name, tensor in zip(call.names, some, strict=True)}
        return tuple(out for out in build(LIBRARY, asked._replace(tensors=given), answer) if out is not None)

    outs, pull = jax.vjp(outputs, *tensors)
    some = [slope for slope, has in zip(slopes, rule.has_slope, strict=True) if has]
    return pull(tuple(slope.astype(out.dtype) for slope, out in zip(some, outs, strict=True)))


_query.defvjp(_forward, _backward)


def _wide(tensor: Any) -> Any:
    """In float64, where jax is set to have it."""
    return tensor.astype(jnp.result_type(float))


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _add(rows: Any, index: Any, count: int) -> Any:
    shape = rows.shape[index.ndim :]
    return jnp.zeros((count, *shape), rows.dtype).at[index.reshape(-1)].add(rows.reshape(-1, *shape))


def _add_forward(rows: Any, index: Any, count: int) -> Any:
    return _add(rows, index, count), index


def _add_backward(count: int, index: Any, slope: Any) -> Any:
    return _take(slope, index), None


_add.defvjp(_add_forward, _add_backward)


@jax.custom_vjp
def _take(table: Any, index: Any) -> Any:
    return table[index]


def _take_forward(table: Any, index: Any) -> Any:
    return table[index], (index, table.shape[0])


def _take_backward(kept: Any, slope: Any) -> Any:
    index, count = kept
    return _add(slope, index, count), None


_take.defvjp(_take_forward, _take_backward)


def _constant(values: Any, like: Any) -> Any:
    array = jnp.asarray(values)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return _wide(array)
    return array if array.dtype == bool else array.astype(jnp.result_type(int))


def _ask(query: Any, points: Any, shape: tuple[int, ...], *beside: Any) -> Any:
    kind = jax.ShapeDtypeStruct((len(points), *shape), points.dtype)

    # Within jit the points are not known yet.
    def run(*arrays: Any) -> Any:
        return np.asarray(query(*map(np.asarray, arrays)), kind.dtype)

    given = map(jax.lax.stop_gradient, (points, *beside))
    found: Any = jax.pure_callback(run, kind, *given, vmap_method="sequential")
    return found


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _unknown(message: str, tensor: Any, *of: Any) -> Any:
    return tensor


@_unknown.defjvp
def _(message: str, primals: Any, tangents: Any) -> Any:
    raise InputError(message)


LIBRARY = Library(
    where=jnp.where,
    sqrt=jnp.sqrt,
    floor=jnp.floor,
    stack=jnp.stack,
    take=_take,
    add=_add,
    constant=_constant,
    # In a traced function it may be a tracer, which must not outlive the trace.
    kept=lambda cache, name, values, like: _constant(values, like),
    wide=_wide,
    whole=lambda tensor: tensor.astype(jnp.result_type(int)),
    detach=jax.lax.stop_gradient,
    ask=_ask,
    once=lambda tensor, message, of: _unknown(message, tensor, *of.values()),
)
