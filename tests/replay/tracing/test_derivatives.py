"""Exact derivatives of traced functions, compiled and in plain Python, against central differences."""

import math
import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.families.acoustic import models as acoustic
from fuselog.recorders.families.directional import headings
from fuselog.recorders.families.los import models as optical
from fuselog.recorders.families.sampling import extended_target, reactor
from fuselog.recorders.families.sets import models as relative_bearing
from fuselog.recorders.families.vehicles import models as vehicles
from fuselog.recorders.models import constant_velocity, geodesy, planar
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.tracing import traced
from fuselog.replay.tracing.functions import Derivative
from tests.bench.reference.landmarks import drive_jacobians, range_bearing_jacobian
from tests.replay.tracing.calls import by_compiler, by_python, linearised

# --- one function at a time ------------------------------------------------------------------------

# Smooth at every x in (0.1, 0.9) and y in (1.1, 1.9), but for isolated points.
SMOOTH_TABLE = """
    +x
    -x
    x + y
    x - y
    x * y
    x / y
    1 + x
    2.5 - x
    3 * x
    x * True
    2.0 / x
    x / 4
    x // y
    7.0 // y
    x % y
    7.5 % x
    x % 0.3
    divmod(y, x)[0]
    divmod(y, x)[1]
    x ** y
    x ** 2
    x ** 3
    x ** -2
    x ** 0
    x ** 2.5
    2 ** x
    2.5 ** x
    pow(x, y)
    np.power(x, y)
    np.power(x, 2)
    np.square(x)
    np.reciprocal(x)
    np.negative(x)
    np.add(x, y)
    np.subtract(1.0, y)
    np.multiply(x, 2)
    np.divide(x, y)
    np.floor_divide(y, x)
    np.mod(y, x)
    np.fmod(-y, x)
    np.sqrt(x)
    np.cbrt(-x)
    np.hypot(x, y)
    np.hypot(3.0, y)
    np.exp(x)
    np.exp2(x)
    np.expm1(x)
    np.log(x)
    np.log2(x)
    np.log10(x)
    np.log1p(x)
    np.sin(x)
    np.cos(y)
    np.tan(x)
    np.arcsin(x)
    np.arccos(x)
    np.arctan(x)
    np.arctan2(x, y)
    np.arctan2(-x, -y)
    np.arctan2(1.0, x)
    np.arctan2(y, 2)
    np.sinc(x)
    np.sinc(0.001 * x)
    np.sinh(x)
    np.cosh(x)
    np.tanh(x)
    np.arcsinh(x)
    np.arccosh(y)
    np.arctanh(x)
    np.deg2rad(x)
    np.radians(x)
    np.rad2deg(x)
    np.degrees(x)
    abs(-x)
    np.abs(x)
    np.absolute(-y)
    np.fabs(-x)
    np.sign(-x)
    np.copysign(x, -y)
    np.copysign(-2.0, x)
    np.floor(3 * x)
    np.ceil(x)
    np.trunc(-y)
    np.rint(x)
    np.around(x)
    np.round(4 * x, decimals=1)
    np.logical_xor(x, y) * x
    np.round(x, 1)
    round(x)
    round(y, 1)
    np.minimum(x, y)
    np.minimum(1.0, y)
    np.maximum(x, y)
    np.maximum(x, 0.05)
    min(x, y)
    min(1.0, y, x)
    max(x, y)
    max(x, 0.0, y, 1)
    sum((x, y, x * y))
    (x + np.pi) % (2 * np.pi) - np.pi
    x - 2 * np.pi * np.round(x / (2 * np.pi))
    np.arctan2(np.sin(4 * x), np.cos(4 * x))
    x if x < y else y
    y if x else x
    np.isnan(x) + np.isfinite(x) * x + np.isinf(x) + np.signbit(x)
    (x < y) + (x <= 1.0) * y + (2 > x) + (x >= y) + (x == y) + (x != 1) + (not x)
    np.clip(x, 0.05, y)
    np.clip(y, -1, 1)
    np.where(x < y, x, y)
    np.where(x > 0.0, np.sqrt(x), 0)
    np.where(y > x, 1.0, x)
    np.where(True, x, 0.0)
    np.where(x, y, x)
    np.clip(x, None, 0.5)
    np.clip(3.0 * x, max=y, min=0.2)
    np.divmod(y, x)[0]
    np.positive(x)
    np.floor(x) + np.equal(x, y) + np.not_equal(x, y) * x + np.less(x, y) + np.greater(x, y)
    np.less_equal(x, y) * x + np.greater_equal(x, y) * y
    np.where(np.logical_and(x > 0.5, y > 1.5), x, np.where(np.logical_or(x > 0.3, y > 1.2), y, 1.0))
    np.where(np.logical_not(x > 0.5) & np.invert(y > 1.5) | (x < 0.2), x, y)
    np.where(np.bitwise_xor(np.bitwise_and(x > 0.5, y > 1.5), np.bitwise_or(x > 0.3, y > 2)), x, y)
    np.logaddexp(x, y)
    np.logaddexp(800.0 * x, y)
    np.interp(x, (0.0, 0.4, 0.7), (1.0, 3.0, -2.0))
    np.interp(y, (0.0, 1.0), (1.0, 3.0), left=0.0, right=7.0)
    x * np.choose(np.searchsorted((0.3, 0.6), x), (1.0, -2.0, y))
    np.choose(np.searchsorted((0.3, 0.6), x, side="right"), (1.0, -2.0, y))
    (np.array([[x, 1.0], [y, x]]) @ np.array([y, x]))[1]
    np.sin(np.array([x, y]))[0] * np.sqrt(np.array([x, y]) @ np.array([x, y]))
    np.linalg.norm([x, y])
    np.cross([x, y, 1.0], [y, x, 2.0])[2]
    (np.ones(2) * x + [y, 0.0])[0]
"""
POINTS = [
    ("np.sqrt(x * x + y * y)", (0.0, 0.0), 0.0, (0.0, 0.0)),  # a rotation by 0
    ("np.sqrt(x)", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.cbrt(x)", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.hypot(x, y)", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.arctan2(y, x)", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.arctan2(y, x)", (-2.0, 0.0), np.pi, (-0.0, -0.5)),
    ("np.arctan2(y, x)", (-2.0, -0.0), -np.pi, (0.0, -0.5)),
    ("np.sinc(x)", (0.0, 0.0), 1.0, (0.0, 0.0)),
    ("abs(x)", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("abs(x)", (-0.0, 0.0), 0.0, (0.0, 0.0)),
    ("min(x, y)", (2.0, 2.0), 2.0, (1.0, 0.0)),
    ("np.minimum(y, x)", (2.0, 2.0), 2.0, (0.0, 1.0)),
    ("np.maximum(x, y)", (2.0, 2.0), 2.0, (1.0, 0.0)),
    ("np.clip(x, y, 3.0)", (2.0, 2.0), 2.0, (1.0, 0.0)),
    ("x ** 0", (0.0, 0.0), 1.0, (0.0, 0.0)),
    ("x ** 0.0", (0.0, 0.0), 1.0, (0.0, 0.0)),
    ("x ** 1", (0.0, 0.0), 0.0, (1.0, 0.0)),
    ("x ** 2", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("x ** 3", (-2.0, 0.0), -8.0, (12.0, 0.0)),
    ("0.0 ** x", (2.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.where(x > 0.0, np.sqrt(x), 0.0)", (-1.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.where(x > 0.0, np.log(x), 0.0)", (0.0, 0.0), 0.0, (0.0, 0.0)),
    ("np.minimum(x, np.sqrt(y))", (1.0, -1.0), np.nan, (0.0, np.nan)),
    ("(x + np.pi) % (2 * np.pi) - np.pi", (np.pi, 0.0), -np.pi, (1.0, 0.0)),
    ("(x + np.pi) % (2 * np.pi) - np.pi", (-np.pi, 0.0), -np.pi, (1.0, 0.0)),
    ("5.0 % x", (2.0, 0.0), 1.0, (-2.0, 0.0)),
    ("-5.0 % x", (2.0, 0.0), 1.0, (3.0, 0.0)),
    ("np.fmod(-5.0, x)", (2.0, 0.0), -1.0, (2.0, 0.0)),
    ("1.0 / x", (0.0, 0.0), np.inf, (-np.inf, 0.0)),
    ("np.log(x)", (0.0, 0.0), -np.inf, (np.inf, 0.0)),
    ("np.sqrt(x)", (-1.0, 0.0), np.nan, (np.nan, 0.0)),
]


SMOOTH = [line.strip() for line in SMOOTH_TABLE.split("\n")[1:-1]]
EXPRESSIONS = [*SMOOTH, *(point[0] for point in POINTS)]


def of(expression: str) -> Callable[[Any], Any]:
    return eval(f"lambda given: (lambda x, y: ({expression},))(*given)", {"np": np})


def differences(function: Callable[[Any], Any], x: Floats, step: float = 1e-6) -> Floats:
    """Values and slopes (rows, 1 + variables) of a function as it stands."""
    value = np.array(function(tuple(x)), dtype=float)
    ends = [[function(tuple(x + way * each)) for way in (1, -1)] for each in step * np.eye(len(x))]
    slopes = [np.subtract(*np.array(each, dtype=float)) / (2.0 * step) for each in ends]
    return np.stack([value, *slopes], axis=1)


def test_every_function_has_the_slopes_of_central_differences_compiled_and_plain():
    functions = [linearised(of(expression), 2) for expression in SMOOTH]
    points = np.random.default_rng(1).uniform((0.1, 1.1), (0.9, 1.9), (20, 2))
    compiled, plain = by_compiler(functions, points), by_python(functions, points)
    for k, expression in enumerate(SMOOTH):
        expected = np.array([differences(of(expression), x) for x in points])
        assert_allclose(compiled[k], plain[k], rtol=1e-12, atol=1e-15, err_msg=expression)
        assert_allclose(plain[k][..., 0], expected[..., 0], rtol=1e-15, err_msg=expression)
        assert_allclose(plain[k], expected, rtol=1e-6, atol=1e-8, err_msg=expression)


def test_no_function_that_a_graph_holds_is_left_out():
    told = " ".join(EXPRESSIONS)
    every = (*traced.PRIMITIVES, *traced._COMPOSED, *traced._OPERATORS)
    names = {each: [name for name in dir(np) if getattr(np, name) is each] for each in every}
    assert [own for own in names.values() if not any(f"np.{name}(" in told for name in own)] == []


@pytest.mark.parametrize("k", range(len(POINTS)), ids=lambda k: f"{POINTS[k][0]} at {POINTS[k][1]}")
def test_at_kinks_poles_and_zeros_the_slopes_are_as_stated(k: int):
    expression, point, value, slopes = POINTS[k]
    assert_allclose(at_points()[k], [value, *slopes], rtol=1e-15, atol=1e-15)
    (plain,) = by_python([linearised(of(expression), 2)], np.array([point]))
    assert_allclose(plain[0, 0], [value, *slopes], rtol=1e-15, atol=1e-15)


@cache
def at_points() -> list[Floats]:
    functions = [linearised(of(expression), 2) for expression, *_ in POINTS]
    found = by_compiler(functions, np.array([point for _, point, *_ in POINTS]))
    return [each[k, 0] for k, each in enumerate(found)]


def test_the_slope_of_sinc_keeps_its_digits_near_zero():
    """Against its power series, on both sides of the switch of formulas."""
    points = np.geomspace(1e-9, 1.0, 300)
    (found,) = by_compiler([linearised(lambda x: (np.sinc(x[0]),), 1)], points[:, None] / np.pi)
    for u, slope in zip(points, found[:, 0, 1], strict=True):
        series = [(-1) ** k * 2 * k * u ** (2 * k - 1) / math.factorial(2 * k + 1) for k in range(1, 12)]
        assert_allclose(slope, np.pi * math.fsum(series), rtol=2e-12)


# --- what is zero, and what is not taken ------------------------------------------------------------


def test_only_what_can_differ_from_zero_is_computed():
    """The pattern of a Jacobian is known: of steps, constants, what cancels and what is not used."""

    def function(x: Any) -> Any:
        step = np.floor(x[2]) + np.sign(x[1]) + np.round(x[0])
        chosen = np.where(x[0] > 0.0, x[1] * 2.0, x[1] + 1.0)
        return x[0] + step, 0.0 * x[1] + 3.0, x[1] * x[2], x[2] ** 0, chosen, x[0] - x[0] + (x[2] > 1.0)

    assert linearised(function, 3).places == ((0, 0), (2, 1), (2, 2), (4, 1))
    (slope,) = linearised(lambda x: (x[0] - 2.0 * x[0],), 1).entries.values()
    assert slope.is_number(-1.0)


WILD = st.sampled_from([0.0, -0.0, 1.0, -1.5, 0.3, 1e-200, 1e300, math.inf, -math.inf, math.nan])
# Each takes x where it is in (0, 1) and y elsewhere; the other side is infinite or NaN there.
TAKEN = [
    lambda x, y: np.where((x > 0.0) & (x < 1.0), np.sqrt(x) * np.log(x), y),
    lambda x, y: np.sqrt(x) * np.log(x) if 0.0 < x < 1.0 else y,
    lambda x, y: np.where(x > 0.0, np.where(x < 1.0, np.sqrt(x) * np.log(x), y), y),
]


@given(WILD, WILD)
def test_what_is_not_taken_reaches_neither_values_nor_derivatives(x: float, y: float):
    expected = [np.sqrt(x) * np.log(x), 1, 0] if 0.0 < x < 1.0 else [y, 0.0, 1.0]
    found = by_kept_kernel("taken", x, y)
    plain = by_python(kept_functions("taken"), np.array([(x, y)]))
    for each in (*found, *(part[0, 0] for part in plain)):
        if 0.0 < x < 1.0:
            expected[1] = each[1]
            assert np.isfinite(each[1])
        assert_allclose(each, expected, rtol=1e-12)


BOUNDS = [
    lambda x, y: np.minimum(x, y),
    lambda x, y: np.maximum(x, y),
    lambda x, y: np.clip(x, y, 2.0),
    lambda x, y: min(x, y),
    lambda x, y: max(x, y, 0.5),
    lambda x, y: np.fmod(x, y),
    lambda x, y: x % y,
    lambda x, y: x // y,
    lambda x, y: np.copysign(x, y) + np.sign(x) + np.isnan(y) + np.signbit(x),
    lambda x, y: np.interp(x, (-1.0, 0.0, 1.0), (5.0, 1.0, 2.0)) if y < 0.0 else 1.0,
    lambda x, y: (x < y) + 2.0 * (x <= y) + 4.0 * (x == y) + 8.0 * (x != y),
]


@given(WILD, WILD)
def test_bounds_steps_and_comparisons_of_nan_and_infinity_are_those_of_python(x: float, y: float):
    found = by_kept_kernel("bounds", x, y)
    with np.errstate(all="ignore"):
        expected = [each(np.float64(x), np.float64(y)) for each in BOUNDS]
    assert_array_equal([each[0] for each in found], expected)


@cache
def kept_functions(name: str) -> list[Derivative]:
    chosen = {"taken": TAKEN, "bounds": BOUNDS, "powers": POWERS}[name]
    count = chosen[0].__code__.co_argcount
    return [linearised(lambda given, own=each: (own(*given),), count) for each in chosen]


def by_kept_kernel(name: str, *point: float) -> list[Floats]:
    """Value and slopes of every function at one point; the kernel is compiled once."""
    return [each[0, 0] for each in by_compiler(kept_functions(name), np.array([point]))]


POWERS = [
    lambda x: x**3 - x * x * x,
    lambda x: x**4 - (x * x) * (x * x),
    lambda x: x**-3 - 1.0 / (x * x * x),
    lambda x: np.power(x, 2) - x * x,
    lambda x: np.square(x) - x * x,
]


@given(st.floats(-1e6, 1e6).filter(lambda x: abs(x) > 1e-6))
def test_a_power_of_an_integer_is_a_product_in_every_bit(x: float):
    assert [each[0] for each in by_kept_kernel("powers", x)] == [0.0] * len(POWERS)


# --- models ----------------------------------------------------------------------------------------

# Each model with the number of its variables x, which are standard normal, and of its components.
MODELS = [
    ("planar.drive((x[0], x[1], x[2]), (x[3], x[4]), 0.1)", 5, 3),
    ("planar.range_bearing((x[0], x[1], x[2]), (x[3], x[4]))", 5, 2),
    ("(planar.wrap_angle(x[0]),)", 1, 1),
    ("vehicles.turn((x[0], x[1], x[2], x[3]), x[4], 0.7)", 5, 4),
    ("planar.into_frame((x[0], x[1], x[2]), (x[3], x[4]))", 5, 2),
    ("planar.out_of_frame((x[0], x[1], x[2]), (x[3], x[4]))", 5, 2),
    ("vehicles.noise_moments(x[0], x[1])", 2, 3),
    ("constant_velocity.noise_moments(x[0], x[1])", 2, 3),
    ("reactor.react((x[0], x[1]), x[2])", 3, 2),
    ("reactor.total_pressure((x[0], x[1]))", 2, 1),
    (
        "extended_target.quadratic(extended_target.surface_point((x[0], x[1], x[2], x[3]), x[4:6]))",
        6,
        4,
    ),
    ("(extended_target.area_m2((x[0], x[1])),)", 2, 1),
    ("headings.turn_together(x[0], x[1], x[2], 0.1, 0.2)", 3, 2),
    ("(relative_bearing.relative_bearing((x[0], x[1]), (2.0, 3.0), (x[2], x[3])),)", 4, 1),
    ("optical.azimuth_elevation((x[0], x[1], x[2]))", 3, 2),
    ("optical.line_of_sight((x[0], x[1], x[2]), (2.0, 3.0, 5.0), (x[3], x[4], x[5]))", 6, 2),
    ("optical.direction(x[0], x[1], (x[2], x[3], x[4]))", 5, 3),
    ("optical.turning_vector((x[0], x[1], x[2]), (x[3], x[4], x[5]))", 6, 3),
    ("acoustic.azimuth_range((x[0], x[1]), (x[2], x[3]))", 4, 2),
    ("(acoustic.time_difference(x[0], x[1], medium),)", 2, 1),
    ("(acoustic.range_from_time_difference(x[0], x[1], medium),)", 2, 1),
    ("acoustic.local_estimate_covariances(x[0], x[1], noise, medium)", 2, 3),
    ("geodesy.earth_centred(x[0], x[1])", 2, 3),
]
NOISE, MEDIUM = acoustic.Noise(0.02, 0.03, 0.001, 1.0), acoustic.Medium()
NAMES = {
    "acoustic": acoustic,
    "constant_velocity": constant_velocity,
    "extended_target": extended_target,
    "geodesy": geodesy,
    "headings": headings,
    "optical": optical,
    "planar": planar,
    "reactor": reactor,
    "relative_bearing": relative_bearing,
    "vehicles": vehicles,
}


@cache
def models() -> list[Derivative]:
    return [
        linearised(eval(f"lambda x: {call}", {**NAMES, "noise": NOISE, "medium": MEDIUM}), 6)
        for call, _, _ in MODELS
    ]


def test_every_model_has_the_slopes_of_central_differences_compiled_and_plain():
    points = np.random.default_rng(3).normal(size=(20, 6))
    for (call, variables, rows), derivative, compiled, plain in zip(
        MODELS, models(), by_compiler(models(), points), by_python(models(), points), strict=True
    ):
        expected = np.array([differences(derivative.function.function, x) for x in points])
        scale = np.max(np.abs(compiled), axis=(1, 2), keepdims=True)
        assert compiled.shape == (20, rows, 7)
        assert not compiled[:, :, 1 + variables :].any()
        assert_allclose(compiled / scale, plain / scale, rtol=0.0, atol=1e-12, err_msg=call)
        assert_allclose(plain / scale, expected / scale, rtol=0.0, atol=1e-6, err_msg=call)


# At rest, straight ahead; on the negative x axis, where angles jump; nothing is 0 by 0 there.
SPECIAL = [
    (1.0, 2.0, 0.3, 1.0, 0.0, 0.5),  # no turn rate, in drive and in turn
    (1.0, 2.0, 0.3, 0.0, 0.0, 0.5),  # at rest
    (3.0, 2.0, np.pi, 1.0, 2.0, 0.5),  # the target on the negative x axis, and headings of pi
    (3.0, 2.0, -np.pi, 1.0, 2.0, 0.5),
]


def test_models_agree_at_zero_rates_and_half_turns():
    points = np.array(SPECIAL)
    compiled, plain = by_compiler(models(), points), by_python(models(), points)
    names = [call.split("(")[0] for call, _, _ in MODELS]
    for name in ("planar.drive", "vehicles.turn", "planar.out_of_frame", "headings.turn_together"):
        k = names.index(name)
        expected = np.array([differences(models()[k].function.function, x) for x in points])
        assert_allclose(compiled[k], plain[k], rtol=1e-12, atol=1e-12, err_msg=name)
        assert_allclose(plain[k], expected, rtol=1e-6, atol=1e-8, err_msg=name)
    bearing = compiled[names.index("planar.range_bearing")][2:, 1, 1:6]
    assert_allclose(bearing, [[0.0, 0.5, -1.0, 0.0, -0.5]] * 2, atol=1e-15)


def test_no_distance_apart_has_no_direction_and_no_nan():
    """Range and bearing of the own place: all slopes 0, but for the bearing's by the heading."""
    point = np.array([[1.0, 2.0, 0.3, 1.0, 2.0, 0.5]])
    for found in (by_compiler(models()[1:2], point), by_python(models()[1:2], point)):
        assert_array_equal(found[0][0, :, 0], [0.0, -0.3])
        assert_array_equal(found[0][0, :, 1:6], [[0, 0, 0, 0, 0], [0, 0, -1, 0, 0]])


def test_jacobians_by_hand_are_those_of_the_graph():
    points = np.random.default_rng(4).normal(size=(20, 6))
    names = [re.match(r"\(?([\w.]+)", call).group(1) for call, _, _ in MODELS]  # type: ignore[union-attr]
    compiled = dict(zip(names, by_compiler(models(), points), strict=True))
    for run, x in enumerate(points):
        slopes = {name: found[run, :, 1:] for name, found in compiled.items()}
        by_hand = drive_jacobians(x[:3], x[3:5], 0.1)
        assert_allclose(slopes["planar.drive"][:2, 2:5].T, by_hand, rtol=1e-15, atol=1e-15)
        rows = range_bearing_jacobian(x[:3], x[3:5])
        assert_allclose(slopes["planar.range_bearing"][:2, :3], rows, rtol=1e-12, atol=1e-12)
        gradients = optical.line_of_sight_gradients(x[:3], (2.0, 3.0, 5.0), x[3:])
        assert_allclose(slopes["optical.line_of_sight"], gradients, rtol=1e-12, atol=1e-12)
        delay = acoustic.time_difference_gradient(x[0], x[1], MEDIUM)
        assert_allclose(slopes["acoustic.time_difference"][0, :2], delay, rtol=1e-12, atol=1e-15)
        spread = acoustic.local_estimate_covariance_gradients(x[0], x[1], NOISE, MEDIUM)
        assert_allclose(slopes["acoustic.local_estimate_covariances"][:, :2], spread, rtol=1e-9)
