"""Rewrites a program over small arrays as one over scalars, with its constants propagated.

A simulator that serves every robot spends most of its time on what does not concern this one: gathers with indices
known beforehand, products with zeros, joints that cannot move. On a CPU each of those many small operations is a
kernel of its own. Taking the program apart into scalars leaves the few operations that matter, and a batch of them
fuses into one loop. The arithmetic that remains is the program's own, operation by operation; what is left out are
additions of zero, products with zero or one and the like, under the assumption that all values are finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

_CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"}


class CannotScalarizeError(NotImplementedError):
    """The program holds an operation that scalarization does not know."""


def scalarize(function: Callable[..., jax.Array], *examples: Any) -> Callable[..., jax.Array]:
    """A function that computes ``function`` by scalar operations.

    Args:
        function: pure, from arrays to one array; neither loops nor branches may depend on its arguments.
        *examples: arrays (or shapes with dtypes) like the arguments.

    Returns:
        The same function for arguments of those shapes and dtypes. The work of taking the program apart is done once,
        here; the compiler sees the result as if it had been written by hand.

    Raises:
        CannotScalarizeError: if the function holds an operation that is not known here.
    """
    program: Any = jax.make_jaxpr(function)(*examples)

    def by_scalars(*arguments: jax.Array) -> jax.Array:
        (result,) = _run(program, [_take_apart(argument) for argument in arguments])
        return _put_together(result, program.jaxpr.outvars[0].aval)

    simple = core.jaxpr_as_fun(jax.make_jaxpr(by_scalars)(*examples))
    return lambda *arguments: simple(*arguments)[0]


def _take_apart(array: jax.Array) -> np.ndarray:
    """The elements of an array as an array of objects."""
    apart = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        apart[index] = array[index]
    return apart


def _put_together(value: np.ndarray, aval: Any) -> jax.Array:
    if value.dtype != object:
        return jnp.asarray(value, aval.dtype)
    elements = [jnp.asarray(element, aval.dtype) for element in value.ravel()]
    return jnp.stack(elements).reshape(aval.shape)


def _run(program: Any, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Interprets a closed program.

    A value is an array of numbers where it is known, else an array of objects: numbers and tracers.
    """
    known: dict[Any, np.ndarray] = dict(zip(program.jaxpr.invars, arguments, strict=True))
    known.update(zip(program.jaxpr.constvars, map(np.asarray, program.consts), strict=True))

    def read(atom: Any) -> np.ndarray:
        if isinstance(atom, core.Literal):
            return np.asarray(atom.val, getattr(atom.aval, "dtype", None))
        return known[atom]

    for equation in program.jaxpr.eqns:
        results = _evaluate(equation, [read(atom) for atom in equation.invars])
        for variable, result in zip(equation.outvars, results, strict=True):
            known[variable] = _settle(result, variable.aval)
    return [read(atom) for atom in program.jaxpr.outvars]


def _settle(value: np.ndarray, aval: Any) -> np.ndarray:
    """An array of numbers, if that is what the objects are."""
    if value.shape != aval.shape:
        raise AssertionError(f"shape {value.shape} where {aval.shape} was expected")
    if value.dtype == object and not any(_is_unknown(element) for element in value.flat):
        return value.astype(aval.dtype)
    return value


def _is_unknown(element: Any) -> bool:
    return isinstance(element, jax.Array)


def _evaluate(equation: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    name = equation.primitive.name
    if name in _CALLS:
        program = equation.params["jaxpr"] if "jaxpr" in equation.params else equation.params["call_jaxpr"]
        return _run(program, values)
    if name in _REARRANGING:
        return _REARRANGING[name](values, equation.params)
    if all(value.dtype != object for value in values):
        return _compute(equation, values)
    if name in _SUMMING:
        return [_SUMMING[name](values, equation.params)]
    if all(out.aval.shape == equation.outvars[0].aval.shape for out in equation.outvars) and name in _ELEMENTWISE:
        return [_each(equation, values)]
    raise CannotScalarizeError(f"operation {name}")


def _compute(equation: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """The operation on numbers."""
    if equation.primitive.name in _ON_NUMBERS:
        return [np.asarray(_ON_NUMBERS[equation.primitive.name](*values), equation.outvars[0].aval.dtype)]
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*map(jnp.asarray, values), **equation.params)
    return [np.asarray(result) for result in (results if equation.primitive.multiple_results else [results])]


def _each(equation: Any, values: list[np.ndarray]) -> np.ndarray:
    """The operation on each element, simplified where numbers allow it."""
    primitive, shape = equation.primitive, equation.outvars[0].aval.shape
    dtypes = [atom.aval.dtype for atom in equation.invars]
    simplify = _SIMPLER.get(primitive.name)
    result = np.empty(shape, object)
    broadcast = [np.broadcast_to(value, shape) for value in values]
    for index in np.ndindex(shape):
        elements = [value[index] for value in broadcast]
        simple = simplify(*elements) if simplify else None
        if simple is None:
            arrays = [jnp.asarray(element, dtype) for element, dtype in zip(elements, dtypes, strict=True)]
            simple = primitive.bind(*arrays, **equation.params)
        result[index] = simple
    return result


def _is(element: Any, number: float) -> bool:
    return not _is_unknown(element) and bool(element == number)


def _multiply(x: Any, y: Any) -> Any:
    if _is(x, 0) or _is(y, 1):
        return x
    return y if _is(y, 0) or _is(x, 1) else None


def _add(x: Any, y: Any) -> Any:
    if _is(x, 0):
        return y
    return x if _is(y, 0) else None


def _subtract(x: Any, y: Any) -> Any:
    if _is(x, 0) and not _is(y, 0):
        return -y
    return x if _is(y, 0) else None


def _divide(x: Any, y: Any) -> Any:
    return x if _is(x, 0) or _is(y, 1) else None


def _select(which: Any, *cases: Any) -> Any:
    if not _is_unknown(which):
        return cases[int(which)]
    same = all(case is cases[0] or (not _is_unknown(case) and _is(cases[0], case)) for case in cases)
    return cases[0] if same else None


_SIMPLER: dict[str, Callable[..., Any]] = {
    "mul": _multiply,
    "add": _add,
    "sub": _subtract,
    "div": _divide,
    "select_n": _select,
    "copy": lambda x: x,
}

_ELEMENTWISE = set(_SIMPLER) | set(
    "neg sin cos max min abs sign sqrt rsqrt exp log tan tanh atan2 pow integer_pow floor ceil rem clamp square "
    "eq ne lt le gt ge and or not xor is_finite convert_element_type".split()
)

_ON_NUMBERS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "abs": np.abs,
    "sign": np.sign,
    "rem": np.fmod,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
    "copy": np.asarray,
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
}
"""Frequent operations on numbers; the others are left to JAX, which compiles each of them."""


def _plus(x: Any, y: Any) -> Any:
    simple = _add(x, y)
    return x + y if simple is None else simple


def _times(x: Any, y: Any) -> Any:
    simple = _multiply(x, y)
    return x * y if simple is None else simple


def _reduce_sum(values: list[np.ndarray], params: dict[str, Any]) -> np.ndarray:
    summed = len(params["axes"])
    value = np.moveaxis(values[0], params["axes"], range(summed))
    rest = value.shape[summed:]
    result = np.zeros(rest, object)
    for terms in value.reshape(math.prod(value.shape[:summed]), *rest):
        result = np.frompyfunc(_plus, 2, 1)(result, terms)
    return np.asarray(result, object)


def _dot_general(values: list[np.ndarray], params: dict[str, Any]) -> np.ndarray:
    (contract_left, contract_right), (batch_left, batch_right) = params["dimension_numbers"]

    def arrange(value: np.ndarray, batch: Sequence[int], contract: Sequence[int]) -> tuple[np.ndarray, tuple[int, ...]]:
        free = [axis for axis in range(value.ndim) if axis not in (*batch, *contract)]
        shape = [[value.shape[axis] for axis in axes] for axes in (batch, free, contract)]
        flat = (*shape[0], math.prod(shape[1]), math.prod(shape[2]))
        arranged = value.astype(object).transpose(*batch, *free, *contract).reshape(flat)
        return arranged, tuple(value.shape[axis] for axis in free)

    left, free_left = arrange(values[0], batch_left, contract_left)
    right, free_right = arrange(values[1], batch_right, contract_right)
    products = np.frompyfunc(_times, 2, 1)(left[..., :, None, :], right[..., None, :, :])
    result = _reduce_sum([np.asarray(products, object)], {"axes": (products.ndim - 1,)})
    return result.reshape(*left.shape[: len(batch_left)], *free_left, *free_right)


_SUMMING: dict[str, Callable[[list[np.ndarray], dict[str, Any]], np.ndarray]] = {
    "reduce_sum": _reduce_sum,
    "dot_general": _dot_general,
}


def _broadcast_in_dim(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    shape, axes = params["shape"], params["broadcast_dimensions"]
    expanded = [1] * len(shape)
    for axis, size in zip(axes, values[0].shape, strict=True):
        expanded[axis] = size
    return [np.broadcast_to(values[0].reshape(expanded), shape)]


def _slice(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    strides = params["strides"] or [1] * values[0].ndim
    ranges = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [values[0][tuple(slice(*one) for one in ranges)]]


def _concatenate(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    return [np.concatenate(values, axis=params["dimension"])]


def _split(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    return np.split(values[0], np.cumsum(params["sizes"])[:-1], axis=params["axis"])


def _iota(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    del values
    index = np.indices(params["shape"])[params["dimension"]]
    return [index.astype(params["dtype"])]


def _targets(numbers: Any, indices: np.ndarray, shape: tuple[int, ...], scatter: bool) -> Callable[[Any], Any]:
    """Where an element of a gather's result comes from, or an element of a scatter's updates goes to."""
    if indices.dtype == object:
        raise CannotScalarizeError("an index that is not known")
    if scatter:
        window_axes, missing = numbers.update_window_dims, numbers.inserted_window_dims
        index_map, index_batch = numbers.scatter_dims_to_operand_dims, numbers.scatter_indices_batching_dims
    else:
        window_axes, missing = numbers.offset_dims, numbers.collapsed_slice_dims
        index_map, index_batch = numbers.start_index_map, numbers.start_indices_batching_dims
    batch = numbers.operand_batching_dims
    inside = [axis for axis in range(len(shape)) if axis not in missing and axis not in batch]

    def target(position: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        outer = tuple(p for axis, p in enumerate(position) if axis not in window_axes)
        start, offset = np.zeros(len(shape), int), np.zeros(len(shape), int)
        start[list(index_map)] = indices[outer]
        for axis, index_axis in zip(batch, index_batch, strict=True):
            start[axis] = outer[index_axis]
        offset[inside] = [position[axis] for axis in window_axes]
        return start, offset

    return target


def _gather(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    operand, indices = values
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    target = _targets(numbers, indices, operand.shape, scatter=False)
    limit = np.array(operand.shape) - np.array(sizes)
    outer = list(indices.shape[:-1])
    window = [
        size
        for axis, size in enumerate(sizes)
        if axis not in numbers.collapsed_slice_dims and axis not in numbers.operand_batching_dims
    ]
    rank = len(outer) + len(window)
    shape = tuple(window.pop(0) if axis in numbers.offset_dims else outer.pop(0) for axis in range(rank))
    result = np.empty(shape, operand.dtype)
    clip = params["mode"] == jax.lax.GatherScatterMode.CLIP
    for position in np.ndindex(shape):
        start, offset = target(position)
        if clip:
            start = np.clip(start, 0, limit)
        if (start < 0).any() or (start > limit).any():
            raise CannotScalarizeError("a gather out of bounds")
        result[position] = operand[tuple(start + offset)]
    return [result]


def _scatter(combine: Callable[[Any, Any], Any]) -> Callable[[list[np.ndarray], dict[str, Any]], list[np.ndarray]]:
    def scatter(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
        operand, indices, updates = values
        numbers = params["dimension_numbers"]
        target = _targets(numbers, indices, operand.shape, scatter=True)
        missing = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        window = np.ones(operand.ndim, int)
        window[[axis for axis in range(operand.ndim) if axis not in missing]] = [
            updates.shape[axis] for axis in numbers.update_window_dims
        ]
        limit = operand.shape - window
        if params["mode"] == jax.lax.GatherScatterMode.CLIP:
            raise CannotScalarizeError("a scatter that clips its indices")
        result = operand.astype(object)
        for position in np.ndindex(updates.shape):
            start, offset = target(position)
            if (start < 0).any() or (start > limit).any():
                continue  # what lies outside is dropped
            place = start + offset
            result[tuple(place)] = combine(result[tuple(place)], updates[position])
        return [result]

    return scatter


def _pad(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    if any(inner or low < 0 or high < 0 for low, high, inner in params["padding_config"]):
        raise CannotScalarizeError("padding between elements, or negative")
    edges = [(low, high) for low, high, _ in params["padding_config"]]
    return [np.pad(values[0].astype(object), edges, constant_values=values[1].item())]


_REARRANGING: dict[str, Callable[[list[np.ndarray], dict[str, Any]], list[np.ndarray]]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "slice": _slice,
    "squeeze": lambda values, params: [np.squeeze(values[0], tuple(params["dimensions"]))],
    "expand_dims": lambda values, params: [np.expand_dims(values[0], tuple(params["dimensions"]))],
    "reshape": lambda values, params: [values[0].reshape(params["new_sizes"])],
    "transpose": lambda values, params: [values[0].transpose(params["permutation"])],
    "rev": lambda values, params: [np.flip(values[0], params["dimensions"])],
    "tile": lambda values, params: [np.tile(values[0], params["reps"])],
    "stack": lambda values, params: [np.stack(values, params["axis"])],
    "concatenate": _concatenate,
    "split": _split,
    "iota": _iota,
    "gather": _gather,
    "pad": _pad,
    "scatter": _scatter(lambda old, new: new),
    "scatter-add": _scatter(_plus),
}
