"""Functions written out for one size: tuples, derivatives and differences without loops.

A model is component-first: its functions take and return tuples. numba cannot build a tuple in a loop,
and constants fold only where they stand in the text: constant seeds make jets three times as fast. So
the few pieces between arrays and tuples are written as text for the sizes and kinds at hand. Their
source stays available, so that `replay.engine.compile` bundles them as it does any other function.

Kinds and tangent space as in `replay.engine.tangent`: a quaternion q (Hamilton, w x y z) plus a rotation
vector d is q exp(d/2), an axis (a unit complex number) plus an angle is the product with exp(i angle).
Hertzberg et al., Information Fusion 14, 2013; Sola, arXiv 1711.02508.
"""

import hashlib
import linecache
import operator
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from recorders.models.planar import wrap_angle
from replay.engine.arrays import Function
from replay.engine.tangent import WIDTHS
from replay.tracing.functions import Derivative, TracedFunction
from replay.tracing.graph import Node
from replay.tracing.traced import Trace

TANGENT = {"linear": 1, "angle": 1, "axis": 1, "quaternion": 3}
# The basis of the imaginary units: e_i e_j = sign * e_k of Hamilton's product, as rows of `_product`.
_PRODUCT = (
    ((0, 0, 1), (1, 1, -1), (2, 2, -1), (3, 3, -1)),
    ((0, 1, 1), (1, 0, 1), (2, 3, 1), (3, 2, -1)),
    ((0, 2, 1), (1, 3, -1), (2, 0, 1), (3, 1, 1)),
    ((0, 3, 1), (1, 2, 1), (2, 1, -1), (3, 0, 1)),
)


def function_of(text: str, **names: Any) -> Function:
    """The function that `text` defines, with `names` as its globals; its source is kept."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    file = f"<generated {digest}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    scope: dict[str, Any] = {"np": np, "__name__": "generated", **names}
    known = set(scope)
    exec(compile(text, file, "exec"), scope)
    (name,) = [each for each in scope if each not in known and each != "__builtins__"]
    return scope[name]


def tangent_size(kinds: Sequence[str]) -> int:
    """How many components the tangent space of these components has."""
    return sum(width for _, _, _, width in things(kinds))


def things(kinds: Sequence[str]) -> list[tuple[str, int, int, int]]:
    """Every number, angle, axis and quaternion: kind, first component and tangent one, tangent size."""
    found, component, tangent = [], 0, 0
    while component < len(kinds):
        kind = kinds[component]
        found.append((kind, component, tangent, TANGENT[kind]))
        component += WIDTHS[kind]
        tangent += TANGENT[kind]
    return found


def is_flat(kinds: Sequence[str]) -> bool:
    """Whether the tangent space is the space itself, but for the wrapping of angles."""
    return set(kinds) <= {"linear", "angle"}


def _listed(entries: Sequence[str]) -> str:
    return f"({', '.join(entries)}{',' if len(entries) == 1 else ''})"


@lru_cache(maxsize=256)
def tuple_of(size: int, start: int = 0) -> Function:
    """`read(array)`: `size` entries of an array from `start` on, as a tuple."""
    entries = _listed([f"array[{start + index}]" for index in range(size)])
    return function_of(f"def read(array):\n    return {entries}\n")


@lru_cache(maxsize=256)
def filling(size: int) -> Function:
    """`fill(array, values)`: the entries of a tuple into an array."""
    lines = [f"    array[{index}] = values[{index}]" for index in range(size)]
    return function_of("\n".join(["def fill(array, values):", *(lines or ["    pass"]), ""]))


def _terms(left: str, right: str, row: int, conjugate: bool, first: int = 0) -> str:
    """Component `row` of Hamilton's product of two names of tuples, the left one conjugated or not."""
    parts = []
    for i, j, sign in _PRODUCT[row]:
        sign = -sign if conjugate and i > 0 else sign
        parts.append(f"{'+' if sign > 0 else '-'} {left}[{first + i}] * {right}[{j}]")
    return " ".join(parts).removeprefix("+ ")


@lru_cache(maxsize=64)
def retraction(kinds: tuple[str, ...]) -> Function:
    """`add(x, d)`: moves the state x (n,) by a tangent vector d (t,), in place."""
    lines = ["def add(x, d):"]
    for kind, c, t, _ in things(kinds):
        if kind in ("linear", "angle"):
            lines.append(f"    x[{c}] += d[{t}]")
        elif kind == "axis":
            lines += [
                f"    cosine, sine = np.cos(d[{t}]), np.sin(d[{t}])",
                f"    x[{c}], x[{c + 1}] = x[{c}] * cosine - x[{c + 1}] * sine, "
                f"x[{c}] * sine + x[{c + 1}] * cosine",
            ]
        else:
            q = [f"x[{c + index}]" for index in range(4)]
            lines += [
                f"    a, b, c = 0.5 * d[{t}], 0.5 * d[{t + 1}], 0.5 * d[{t + 2}]",
                "    half = np.sqrt(a * a + b * b + c * c)",
                "    ratio = np.sinc(half / np.pi)",
                "    turn = (np.cos(half), ratio * a, ratio * b, ratio * c)",
                f"    w, i, j, k = {', '.join(_terms('x', 'turn', row, False, c) for row in range(4))}",
                "    length = np.sqrt(w * w + i * i + j * j + k * k)",
                f"    {', '.join(q)} = w / length, i / length, j / length, k / length",
            ]
    return function_of("\n".join([*lines, ""]))


@lru_cache(maxsize=64)
def differencing(kinds: tuple[str, ...]) -> Function:
    """`subtract(a, b, d, k)`: row k of d (..., t) becomes the tangent vector from b to a, both (n,)."""
    lines = ["def subtract(a, b, d, k):"]
    for kind, c, t, _ in things(kinds):
        if kind == "linear":
            lines.append(f"    d[k, {t}] = a[{c}] - b[{c}]")
        elif kind == "angle":
            lines += [
                f"    change = a[{c}] - b[{c}]",
                f"    d[k, {t}] = change if abs(change) < np.pi else wrap_angle(change)",
            ]
        elif kind == "axis":
            lines += [
                f"    cosine = b[{c}] * a[{c}] + b[{c + 1}] * a[{c + 1}]",
                f"    sine = b[{c}] * a[{c + 1}] - b[{c + 1}] * a[{c}]",
                "    sign = -1.0 if cosine < 0.0 else 1.0",
                f"    d[k, {t}] = np.arctan2(sign * sine, sign * cosine)",
            ]
        else:
            lines += [
                f"    p = (b[{c}], b[{c + 1}], b[{c + 2}], b[{c + 3}])",
                f"    q = (a[{c}], a[{c + 1}], a[{c + 2}], a[{c + 3}])",
                f"    turn = to_vector({', '.join(_terms('p', 'q', row, True) for row in range(4))})",
                f"    d[k, {t}], d[k, {t + 1}], d[k, {t + 2}] = turn",
            ]
    return function_of("\n".join([*lines, ""]), wrap_angle=wrap_angle, to_vector=to_vector)


@lru_cache(maxsize=64)
def resetting(kinds: tuple[str, ...], *, back: bool = False) -> Function:
    """`reset(d, rows)`: multiplies the rows (t, m) of every rotation by its right Jacobian at d (t,).

    Applied from both sides, it carries a covariance from the old mean to the one moved by d: Jr P Jr'.
    Jr(d) = I - (1 - cos t)/t^2 [d]x + (t - sin t)/t^3 [d]x^2, t = |d|. Markley 2003; Mueller 2017.
    With `back` it multiplies by the inverse instead, I + [d]x/2 + (1 - t/2 cot t/2)/t^2 [d]x^2, which
    carries a covariance the other way; Sola, (144).
    """
    jacobian = [
        "    half = np.sinc(0.5 * angle / np.pi)",
        "    first = 0.5 * half * half",
        "    if angle < 0.05:",
        "        second = (1.0 - squared / 20.0 * (1.0 - squared / 42.0)) / 6.0",
        "    else:",
        "        second = (angle - np.sin(angle)) / (squared * angle)",
    ]
    inverse = [
        "    first = -0.5",
        "    if angle < 0.05:",
        "        second = (1.0 + squared / 60.0 * (1.0 + squared / 42.0)) / 12.0",
        "    else:",
        "        second = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / squared",
    ]
    lines = ["def reset(d, rows):"]
    for kind, _, t, _ in things(kinds):
        if kind != "quaternion":
            continue
        x, y, z = (f"d[{t + index}]" for index in range(3))
        lines += [
            f"    x, y, z = {x}, {y}, {z}",
            "    squared = x * x + y * y + z * z",
            "    angle = np.sqrt(squared)",
            *(inverse if back else jacobian),
            "    for column in range(rows.shape[1]):",
            f"        a, b, c = rows[{t}, column], rows[{t + 1}, column], rows[{t + 2}, column]",
            "        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a",
            f"        rows[{t}, column] = a - first * u + second * (y * w - z * v)",
            f"        rows[{t + 1}, column] = b - first * v + second * (z * u - x * w)",
            f"        rows[{t + 2}, column] = c - first * w + second * (x * v - y * u)",
        ]
    if len(lines) == 1:
        lines.append("    pass")
    return function_of("\n".join([*lines, ""]))


class Input(NamedTuple):
    """An argument of a function to differentiate: its name, its kinds, and where its Jacobian goes.

    `into` is the name of an array of the workspace, empty where the derivative is not wanted. An
    argument that is `zero` is not handed in: it is noise, of mean zero.
    """

    name: str
    kinds: tuple[str, ...]
    into: str = ""
    zero: bool = False


def derivative(
    function: Function, inputs: Sequence[Input], outputs: Sequence[str], values: str = ""
) -> Function:
    """The values and exact Jacobians of a component-first function, by its graph.

    Args:
        function: takes the inputs, tuples, and then others; returns a tuple. It is traced.
        inputs: its first arguments.
        outputs: the kinds of what it returns.
        values: the array of the workspace that gets the values (n,), if they are wanted.

    Returns `linearise(inputs..., others..., work)`, without the inputs that are zero. It fills the
    values and the wanted Jacobians (t of the outputs, t of the input), in the tangent spaces.
    """
    assert isinstance(function, TracedFunction)
    wanted = [(index, each) for index, each in enumerate(inputs) if each.into]
    sizes = [tangent_size(each.kinds) for _, each in wanted]
    firsts = [sum(sizes[:place]) for place in range(len(wanted))]
    columns = [
        (each.into, column)
        for (_, each), size in zip(wanted, sizes, strict=True)
        for column in range(size)
    ]

    def seeds(trace: Trace) -> dict[Node, dict[int, Node]]:
        found: dict[Node, dict[int, Node]] = {}
        for (index, each), first in zip(wanted, firsts, strict=True):
            found |= _seeded(trace, index, each.kinds, first)
        return found

    def combine(
        trace: Trace, returned: Sequence[Node], slopes: Sequence[Mapping[int, Node]]
    ) -> dict[Any, Node]:
        return {
            (columns[variable][0], row, columns[variable][1]): node
            for variable in range(len(columns))
            for row, node in _in_tangent_space(trace, outputs, returned, slopes, variable)
        }

    linearised = Derivative(function, seeds, combine)
    zeros = tuple((index, (0.0,) * len(each.kinds)) for index, each in enumerate(inputs) if each.zero)
    count, rows = len(outputs), tangent_size(outputs)
    written = tuple((len(outputs) + index, *place) for index, place in enumerate(linearised.places))
    known = set(linearised.places)
    empty = tuple(
        (into, row, column)
        for into, column in columns
        for row in range(rows)
        if (into, row, column) not in known
    )

    def linearise(*given: Any) -> None:
        work, arguments = given[-1], given[:-1]
        for place, zero in zeros:
            arguments = (*arguments[:place], zero, *arguments[place:])
        found = linearised(*arguments)
        if values:
            for index in range_of(count):
                getattr(work, values)[index] = found[index]
        for into, row, column in empty:
            getattr(work, into)[row, column] = 0.0
        for index, into, row, column in written:
            getattr(work, into)[row, column] = found[index]

    linearise.__dict__["known"] = {
        place: node.value if node.is_constant else None for place, node in linearised.entries.items()
    }
    return linearise


def known_entries(linearise: Function, into: str) -> dict[tuple[int, int], float | None] | None:
    """The entries of a Jacobian that may differ from zero, by row and column, and what is known of them.

    None where nothing is known, as of one written by hand.
    """
    known = linearise.__dict__.get("known")
    if known is None:
        return None
    return {(row, column): value for (name, row, column), value in known.items() if name == into}


def range_of(count: int) -> tuple[int, ...]:
    """The numbers below one, for a loop that is written out."""
    return tuple(range(count))


def _seeded(
    trace: Trace, argument: int, kinds: Sequence[str], first: int
) -> dict[Node, dict[int, Node]]:
    """How the components of an argument change with its tangent space, whose variables begin at one."""
    graph = trace.graph
    x = [graph.input((argument, index)) for index in range(len(kinds))]
    one, found = graph.constant(1.0), {}
    for kind, c, t, _ in things(kinds):
        at = first + t
        if kind in ("linear", "angle"):
            found[x[c]] = {at: one}
        elif kind == "axis":
            found[x[c]] = {at: graph.apply(operator.neg, x[c + 1])}
            found[x[c + 1]] = {at: x[c]}
        else:  # d(q exp(d/2))/dd at 0 is q times half a unit
            for row in range(4):
                found[x[c + row]] = {
                    at + j - 1: graph.apply(operator.mul, graph.constant(0.5 * sign), x[c + i])
                    for i, j, sign in _PRODUCT[row]
                    if j > 0
                }
    return found


def _in_tangent_space(
    trace: Trace,
    kinds: Sequence[str],
    returned: Sequence[Node],
    slopes: Sequence[Mapping[int, Node]],
    variable: int,
) -> Iterator[tuple[int, Node]]:
    """The slopes of what a function returns by one variable, by the row of the tangent space."""
    zero = trace.graph.constant(0.0)
    y = [trace.number(node) for node in returned]
    for kind, c, t, _ in things(kinds):
        by = [slopes[c + index].get(variable, zero) for index in range(WIDTHS[kind])]
        d = [trace.number(node) for node in by]
        if kind in ("linear", "angle"):
            yield t, by[0]
        elif kind == "axis":
            yield t, trace.node_of(y[c] * d[1] - y[c + 1] * d[0])
        else:
            for row in (1, 2, 3):
                total: Any = 0.0
                for i, j, sign in _PRODUCT[row]:
                    term = y[c + i] * d[j]
                    total = total + term if (sign > 0) == (i == 0) else total - term
                yield t + row - 1, trace.node_of(2.0 * total)


@lru_cache(maxsize=64)
def adding_noise(size: int, block: int = 0) -> Function:
    """`add(covariance, noise)`: adds variances, or the rows of a lower triangle, given as a tuple.

    The triangle is that of the first `block` components, behind which are variances of the others; of
    all components unless it is given.
    """
    diagonal = [f"        covariance[{row}, {row}] += noise[{row}]" for row in range(size)]
    triangle, entry = [], 0
    for row in range(block or size):
        for column in range(row + 1):
            triangle.append(f"        covariance[{row}, {column}] += noise[{entry}]")
            if column < row:
                triangle.append(f"        covariance[{column}, {row}] += noise[{entry}]")
            entry += 1
    for row in range(block or size, size):
        triangle.append(f"        covariance[{row}, {row}] += noise[{entry}]")
        entry += 1
    lines = [f"    if len(noise) == {size}:", *diagonal, "    else:", *triangle]
    return function_of("\n".join(["def add(covariance, noise):", *lines, ""]))


@lru_cache(maxsize=64)
def lower_of(size: int) -> Function:
    """`read(factor)`: the rows of a lower triangle as one tuple."""
    entries = [f"factor[{row}, {column}]" for row in range(size) for column in range(row + 1)]
    return function_of(f"def read(factor):\n    return {_listed(entries)}\n")


@lru_cache(maxsize=64)
def offset_of(size: int) -> Function:
    """`offset(lower, points, index)`: a triangle, as `lower_of` reads it, times one row of points."""
    entries, first = [], 0
    for row in range(size):
        terms = [f"lower[{first + k}] * points[index, {k}]" for k in range(row + 1)]
        entries.append(" + ".join(terms))
        first += row + 1
    return function_of(f"def offset(lower, points, index):\n    return {_listed(entries)}\n")


@lru_cache(maxsize=64)
def moments_of(states: int, values: int) -> Function:
    """`moments(weights, offsets, found, shift, spread, cross)`: weighted covariances, in one loop.

    Of the values `found` (L, v) less `shift` (v,) with themselves, and with the offsets (L, >= t). The
    sums stay in registers: arrays might overlap for all that the compiler knows.
    """
    pairs = [(i, j) for i in range(values) for j in range(i + 1)]
    mixed = [(row, i) for row in range(states) for i in range(values)]
    lines = ["def moments(weights, offsets, found, shift, spread, cross):"]
    lines += [f"    s{i} = shift[{i}]" for i in range(values)]
    lines += [f"    a{i}_{j} = 0.0" for i, j in pairs] + [f"    c{row}_{i} = 0.0" for row, i in mixed]
    lines.append("    for k in range(len(weights)):")
    for i in range(values):
        lines += [f"        y{i} = found[k, {i}] - s{i}", f"        w{i} = weights[k] * y{i}"]
    lines += [f"        a{i}_{j} += w{i} * y{j}" for i, j in pairs]
    for row in range(states):
        lines.append(f"        x = offsets[k, {row}]")
        lines += [f"        c{row}_{i} += x * w{i}" for i in range(values)]
    lines += [f"    spread[{i}, {j}] = spread[{j}, {i}] = a{i}_{j}" for i, j in pairs]
    lines += [f"    cross[{row}, {i}] = c{row}_{i}" for row, i in mixed]
    return function_of("\n".join([*lines, ""]))


@lru_cache(maxsize=64)
def weighted_mean_of(values: int) -> Function:
    """`fill(weights, found, mean)`: the weighted sums (v,) of values (L, v)."""
    lines = ["def fill(weights, found, mean):", *(f"    m{i} = 0.0" for i in range(values))]
    lines.append("    for k in range(len(weights)):")
    lines += [f"        m{i} += weights[k] * found[k, {i}]" for i in range(values)]
    lines += [f"    mean[{i}] = m{i}" for i in range(values)]
    return function_of("\n".join([*lines, ""]))


@lru_cache(maxsize=64)
def sum_of(size: int) -> Function:
    """`add(a, b)`: the sum of the first entries of two tuples, as a tuple."""
    entries = _listed([f"a[{index}] + b[{index}]" for index in range(size)])
    return function_of(f"def add(a, b):\n    return {entries}\n")


@lru_cache(maxsize=64)
def recentring(kinds: tuple[str, ...]) -> Function:
    """`recentre(values, shift)`: tangent vectors (L, t) from a centre become those from centre + shift.

    Returns whether the weighted sum of the values may still differ from zero: an angle was wrapped, or a
    rotation is not yet settled.
    """
    lines = ["def recentre(values, shift):", "    again = False"]
    for kind, _, t, _ in things(kinds):
        if kind == "linear":
            lines += [
                "    for index in range(len(values)):",
                f"        values[index, {t}] -= shift[{t}]",
            ]
        elif kind == "angle":
            lines += [
                "    for index in range(len(values)):",
                f"        change = values[index, {t}] - shift[{t}]",
                "        if not abs(change) < np.pi:",
                "            change = wrap_angle(change)",
                "            again = True",
                f"        values[index, {t}] = change",
            ]
        elif kind == "axis":
            lines += [
                "    for index in range(len(values)):",
                f"        change = values[index, {t}] - shift[{t}]",
                "        if not abs(change) < 0.5 * np.pi:",
                "            change = (change + 0.5 * np.pi) % np.pi - 0.5 * np.pi",
                "            again = True",
                f"        values[index, {t}] = change",
            ]
        else:
            d = [f"shift[{t + index}]" for index in range(3)]
            lines += [
                f"    if max(abs({d[0]}), abs({d[1]}), abs({d[2]})) > 1e-15:",
                "        again = True",
                f"    p = from_vector({', '.join(d)})",
                "    for index in range(len(values)):",
                f"        q = from_vector({', '.join(f'values[index, {t + row}]' for row in range(3))})",
                "        turn = to_vector("
                f"{', '.join(_terms('p', 'q', row, True) for row in range(4))})",
                *(f"        values[index, {t + row}] = turn[{row}]" for row in range(3)),
            ]
    lines.append("    return again")
    text = "\n".join([*lines, ""])
    return function_of(text, wrap_angle=wrap_angle, from_vector=from_vector, to_vector=to_vector)


def from_vector(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The unit quaternion of a rotation vector."""
    half = 0.5 * np.sqrt(x * x + y * y + z * z)
    scale = 0.5 * np.sinc(half / np.pi)
    return np.cos(half), scale * x, scale * y, scale * z


def to_vector(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The shortest rotation vector of a unit quaternion, which is that of its negative too."""
    sign = -1.0 if w < 0.0 else 1.0
    length = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(length, sign * w)
    scale = 2.0 * sign * (angle / length if length > 0.0 else 1.0)
    return scale * x, scale * y, scale * z
