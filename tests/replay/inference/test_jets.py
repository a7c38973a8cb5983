"""Jets: exact derivatives of plain functions, the same in plain Python and compiled."""

import hashlib
import importlib.util
import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from recorders.errors import BadInput
from recorders.models.acoustic import (
    Medium,
    Noise,
    local_estimate_covariance_gradients,
    time_difference_gradient,
)
from recorders.models.optical import line_of_sight_gradients
from replay.engine.bundling import Bundle
from replay.engine.compile import compile_over_runs
from replay.inference import jets
from replay.inference.jets import jet, slope_of, value_of
from tests.bench.reference.landmarks import drive_jacobians, range_bearing_jacobian

pytestmark = pytest.mark.paper

# --- one function at a time ------------------------------------------------------------------------

# Smooth at every x in (0.1, 0.9) and y in (1.1, 1.9).
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
    np.round(x)
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
"""
# numba has no np.where and no np.clip that give a number: these have no counterpart without jets.
CHOICES_TABLE = """
    np.clip(x, 0.05, y)
    np.clip(y, -1, 1)
    np.where(x < y, x, y)
    np.where(x > 0.0, np.sqrt(x), 0)
    np.where(y > x, 1.0, x)
    np.where(True, x, 0.0)
    np.where(x, y, x)
"""
# At these points (x, y): the value, the slopes by x and y, and why.
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
    ("np.minimum(x, np.sqrt(y))", (1.0, -1.0), np.nan, (np.nan, np.nan)),
    ("(x + np.pi) % (2 * np.pi) - np.pi", (np.pi, 0.0), -np.pi, (1.0, 0.0)),
    ("(x + np.pi) % (2 * np.pi) - np.pi", (-np.pi, 0.0), -np.pi, (1.0, 0.0)),
    ("5.0 % x", (2.0, 0.0), 1.0, (-2.0, 0.0)),
    ("-5.0 % x", (2.0, 0.0), 1.0, (3.0, 0.0)),
    ("np.fmod(-5.0, x)", (2.0, 0.0), -1.0, (2.0, 0.0)),
    ("1.0 / x", (0.0, 0.0), np.inf, (-np.inf, np.nan)),
    ("np.log(x)", (0.0, 0.0), -np.inf, (np.inf, np.nan)),
    ("np.sqrt(x)", (-1.0, 0.0), np.nan, (np.nan, np.nan)),
]


SMOOTH = [line.strip() for line in SMOOTH_TABLE.strip().splitlines()]
CHOICES = [line.strip() for line in CHOICES_TABLE.strip().splitlines()]
EXPRESSIONS = [*SMOOTH, *CHOICES, *(point[0] for point in POINTS)]


def function_of(lines: list[str]) -> Callable[..., None]:
    body = "".join(f"    {line}\n" for line in lines)
    names: dict[str, Any] = {"np": np, "jet": jet, "value_of": value_of, "slope_of": slope_of}
    exec(f"def function(x, y, out):\n{body}", names)
    return names["function"]


@cache
def compiled_with_jets() -> Callable[..., None]:
    """Fills out (expressions, 3): value and slopes."""
    lines = ["a, b = x, y", "x, y = jet(a, (1.0, 0.0)), jet(b, (0.0, 1.0))"]
    for k, expression in enumerate(EXPRESSIONS):
        lines += [f"j{k} = {expression}", f"out[{k}, 0] = value_of(j{k})"]
        lines += [f"out[{k}, 1] = slope_of(j{k}, 0)", f"out[{k}, 2] = slope_of(j{k}, 1)"]
    return numba.njit(error_model="numpy")(function_of(lines))


def found(x: float, y: float) -> np.ndarray:
    """Value and slopes (expressions, 3) of every expression, compiled."""
    out = np.full((len(EXPRESSIONS), 3), np.nan)
    compiled_with_jets()(x, y, out)
    return out


def plain(expression: str, x: Any, y: Any) -> Any:
    return eval(expression, {"np": np, "x": x, "y": y})


def plain_jet(expression: str, x: float, y: float) -> list[float]:
    y_x = plain(expression, jet(x, (1.0, 0.0)), jet(y, (0.0, 1.0)))
    return [value_of(y_x), slope_of(y_x, 0), slope_of(y_x, 1)]


def test_every_function_has_the_slopes_of_central_differences_compiled_and_plain():
    rng = np.random.default_rng(1)
    step = 1e-6
    for x, y in zip(rng.uniform(0.1, 0.9, 20), rng.uniform(1.1, 1.9, 20), strict=True):
        out = found(x, y)
        for k, expression in enumerate((*SMOOTH, *CHOICES)):
            value, *slopes = plain_jet(expression, x, y)
            assert_allclose(out[k], [value, *slopes], rtol=1e-12, atol=1e-15, err_msg=expression)
            assert_allclose(value, plain(expression, x, y), rtol=1e-15, err_msg=expression)
            differences = [
                plain(expression, x + dx, y + dy) - plain(expression, x - dx, y - dy)
                for dx, dy in ((step, 0.0), (0.0, step))
            ]
            assert_allclose(slopes, np.divide(differences, 2 * step), 1e-6, 1e-8, err_msg=expression)


def test_values_are_those_without_jets_in_every_bit():
    """An estimator with jets has exactly the values of one with derivatives by hand."""
    lines = [f"out[{k}] = {expression}" for k, expression in enumerate(SMOOTH)]
    without = numba.njit(error_model="numpy")(function_of(lines))
    expected = np.empty(len(SMOOTH))
    for x, y in np.random.default_rng(2).uniform(-10.0, 10.0, size=(200, 2)):
        without(x, y, expected)
        assert_array_equal(found(x, y)[: len(SMOOTH), 0], expected)


@pytest.mark.parametrize("k", range(len(POINTS)), ids=lambda k: f"{POINTS[k][0]} at {POINTS[k][1]}")
def test_at_kinks_poles_and_zeros_the_slopes_are_as_stated(k: int):
    expression, (x, y), value, slopes = POINTS[k]
    compared = slice(2 if np.isinf(value) else 3)  # the compiler may fold 0 times infinity to 0
    expected = np.array([value, *slopes])[compared]
    assert_allclose(plain_jet(expression, x, y)[compared], expected, rtol=1e-15, atol=1e-15)
    assert_allclose(found(x, y)[k - len(POINTS)][compared], expected, rtol=1e-15, atol=1e-15)


def test_the_slope_of_sinc_keeps_its_digits_near_zero():
    """Against its power series, on both sides of the switch of formulas."""
    for u in np.geomspace(1e-9, 1.0, 300):
        series = [(-1) ** k * 2 * k * u ** (2 * k - 1) / math.factorial(2 * k + 1) for k in range(1, 12)]
        found = slope_of(np.sinc(jet(u / np.pi, (1.0,))), 0)
        assert_allclose(found, np.pi * math.fsum(series), rtol=2e-12)


# --- models ----------------------------------------------------------------------------------------

# Each model with the number of its variables x, which are standard normal, and of its components.
MODELS = [
    ("planar.drive((x[0], x[1], x[2]), (x[3], x[4]), 0.1)", 5, 3),
    ("planar.range_bearing((x[0], x[1], x[2]), (x[3], x[4]))", 5, 2),
    ("(planar.wrap_angle(x[0]),)", 1, 1),
    ("vehicles.turn((x[0], x[1], x[2], x[3]), x[4], 0.7)", 5, 4),
    ("vehicles.into_frame((x[0], x[1], x[2]), (x[3], x[4]))", 5, 2),
    ("vehicles.out_of_frame((x[0], x[1], x[2]), (x[3], x[4]))", 5, 2),
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
NOISE, MEDIUM = Noise(0.02, 0.03, 0.001, 1.0), Medium()
SHAPE = (len(MODELS), 4, 7)  # model, component, value and slopes


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    """A module whose `with_jets(run, x, noise, medium, out)` fills out[run], of SHAPE.

    Its `without_jets(x, noise, medium)` gives the components of each model.
    """
    lines = ["from replay.inference.jets import jet, slope_of, value_of"]
    kernel, floats = [], []
    for k, (call, variables, components) in enumerate(MODELS):
        for module, function in set(re.findall(r"(\w+)\.(\w+)\(", call)):
            lines += [f"from recorders.models.{module} import {function} as {module}_{function}"]
            call = call.replace(f"{module}.{function}(", f"{module}_{function}(")
        seeds = [
            f"jet(given[run, {i}], {tuple(row)})" for i, row in enumerate(np.eye(variables).tolist())
        ]
        kernel += [
            f"x = ({', '.join(seeds)},)",
            f"{''.join(f'y{i}, ' for i in range(components))} = {call}",
        ]
        for i in range(components):
            kernel += [f"out[run, {k}, {i}, 0] = value_of(y{i})"]
            kernel += [f"out[run, {k}, {i}, {j + 1}] = slope_of(y{i}, {j})" for j in range(variables)]
        floats += [f"{call},"]
    lines += ["def with_jets(run, given, noise, medium, out):", *(f"    {line}" for line in kernel)]
    lines += ["def without_jets(x, noise, medium):", "    return (", *floats, "    )", ""]
    path = tmp_path_factory.mktemp("models") / "models_with_jets.py"
    path.write_text("\n".join(lines))
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def plainly(models: ModuleType, given: np.ndarray) -> np.ndarray:
    out = np.full((len(given), *SHAPE), np.nan)
    for run in range(len(given)):
        models.with_jets(run, given, NOISE, MEDIUM, out)
    return out


def by_compiler(models: ModuleType, given: np.ndarray) -> np.ndarray:
    out = np.full((len(given), *SHAPE), np.nan)
    loop = compile_over_runs(models.with_jets, allocates=False)
    loop(len(given), given, NOISE, MEDIUM, out)
    return out


def by_differences(models: ModuleType, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    out = np.full(SHAPE, np.nan)
    for k, (value, (_, variables, components)) in enumerate(
        zip(models.without_jets(x, NOISE, MEDIUM), MODELS, strict=True)
    ):
        out[k, :components, 0] = value
        for j in range(variables):
            ends = [
                models.without_jets(x + sign * step * np.eye(6)[j], NOISE, MEDIUM)[k] for sign in (1, -1)
            ]
            out[k, :components, j + 1] = np.subtract(*ends) / (2.0 * step)
    return out


def test_every_model_has_the_slopes_of_central_differences_compiled_and_plain(models: ModuleType):
    given = np.random.default_rng(3).normal(size=(100, 6))
    compiled, plain = by_compiler(models, given), plainly(models, given)
    differences = np.array([by_differences(models, x) for x in given])
    assert np.isfinite(compiled).sum() == 100 * sum(m * (1 + n) for _, n, m in MODELS)
    for k, (call, _, _) in enumerate(MODELS):
        scale = np.nanmax(np.abs(compiled[:, k]), axis=(1, 2), keepdims=True)
        assert_allclose(compiled[:, k] / scale, plain[:, k] / scale, rtol=0.0, atol=1e-12, err_msg=call)
        assert_allclose(
            plain[:, k] / scale, differences[:, k] / scale, rtol=0.0, atol=1e-6, err_msg=call
        )


# At rest, straight ahead; on the negative x axis, where angles jump; nothing is 0 by 0 there.
SPECIAL = [
    (1.0, 2.0, 0.3, 1.0, 0.0, 0.5),  # no turn rate, in drive and in turn
    (1.0, 2.0, 0.3, 0.0, 0.0, 0.5),  # at rest
    (3.0, 2.0, np.pi, 1.0, 2.0, 0.5),  # the target on the negative x axis, and headings of pi
    (3.0, 2.0, -np.pi, 1.0, 2.0, 0.5),
]


def test_models_agree_at_zero_rates_and_half_turns(models: ModuleType):
    given = np.array(SPECIAL)
    compiled, plain = by_compiler(models, given), plainly(models, given)
    names = [call.split("(")[0] for call, _, _ in MODELS]
    for name in ("planar.drive", "vehicles.turn", "vehicles.out_of_frame", "headings.turn_together"):
        k = names.index(name)
        differences = np.array([by_differences(models, x)[k] for x in given])
        assert_allclose(compiled[:, k], plain[:, k], rtol=1e-12, atol=1e-12, err_msg=name)
        assert_allclose(plain[:, k], differences, rtol=1e-6, atol=1e-8, err_msg=name)
    bearing = compiled[2:, names.index("planar.range_bearing"), 1, 1:6]
    assert_allclose(bearing, [[0.0, 0.5, -1.0, 0.0, -0.5]] * 2, atol=1e-15)


def test_no_distance_apart_has_no_direction_and_no_nan(models: ModuleType):
    """Range and bearing of the own place: all slopes 0, but for the bearing's by the heading."""
    given = np.array([[1.0, 2.0, 0.3, 1.0, 2.0, 0.5]])
    for out in (by_compiler(models, given), plainly(models, given)):
        assert_array_equal(out[0, 1, :2, 0], [0.0, -0.3])
        assert_array_equal(out[0, 1, :2, 1:6], [[0, 0, 0, 0, 0], [0, 0, -1, 0, 0]])


def test_jacobians_by_hand_are_those_of_jets(models: ModuleType):
    given = np.random.default_rng(4).normal(size=(100, 6))
    compiled = by_compiler(models, given)
    names = [re.match(r"\(?([\w.]+)", call).group(1) for call, _, _ in MODELS]  # type: ignore[union-attr]
    for run, x in enumerate(given):
        slopes = {name: compiled[run, k, :, 1:] for k, name in enumerate(names)}
        by_hand = drive_jacobians(x[:3], x[3:5], 0.1)
        assert_allclose(slopes["planar.drive"][:2, 2:5].T, by_hand, rtol=1e-15, atol=1e-15)
        rows = range_bearing_jacobian(x[:3], x[3:5])
        assert_allclose(slopes["planar.range_bearing"][:2, :3], rows, rtol=1e-12, atol=1e-12)
        gradients = line_of_sight_gradients(x[:3], (2.0, 3.0, 5.0), x[3:])
        assert_allclose(slopes["optical.line_of_sight"][:2, :6], gradients, rtol=1e-12, atol=1e-12)
        delay = time_difference_gradient(x[0], x[1], MEDIUM)
        assert_allclose(slopes["acoustic.time_difference"][0, :2], delay, rtol=1e-12, atol=1e-15)
        spread = local_estimate_covariance_gradients(x[0], x[1], NOISE, MEDIUM)
        assert_allclose(slopes["acoustic.local_estimate_covariances"][:3, :2], spread, rtol=1e-9)


# --- in kernels ------------------------------------------------------------------------------------


def halved(x: Any) -> Any:
    if x > 0.5:
        return 0.25  # a branch without slopes
    return 0.5 * x


def nested(x: Any) -> Any:
    return (x, 1.0), (2 * x, (x * x,))


def language(run: int, given: np.ndarray, out: np.ndarray) -> None:
    """What a model may say: loops, branches, in-place operators, tuples, constants for jets."""
    x = jet(given[run], (1.0, 0))
    total = 0.0
    for k in range(4):
        total += k * x
        total -= 1
    for each in (x, 2.0 * x):
        total = total + each
    product = 1
    for _ in range(3):
        product *= x
    product /= 2.0
    product **= 2
    product //= 0.0123
    product %= 7.0
    (first, one), (second, (third,)) = nested(x)
    if not x:
        third = 5.0
    chosen = (x, 1.0) if x > 0.5 else (2.0, x)
    found = (total, product, halved(x), first * one, second, third, chosen[0] + 3.0 * chosen[1])
    for k in range(7):
        out[run, k, 0] = value_of(found[k])
        out[run, k, 1] = slope_of(found[k], 0)
        out[run, k, 2] = slope_of(found[k], 1)
    out[run, 7, 0] = value_of(given[run]) + value_of(2) + value_of(True)
    out[run, 7, 1] = slope_of(given[run], 0) + slope_of(1, 5)
    out[run, 7, 2] = x.value + x.slopes[0]


def test_loops_branches_and_tuples_compile_and_give_what_plain_python_gives():
    given = np.array([-1.0, 0.0, 0.3, 0.7])
    expected, out = np.empty((4, 8, 3)), np.empty((4, 8, 3))
    for run in range(4):
        language(run, given, expected)
    compile_over_runs(language, allocates=False)(4, given, out)
    assert_allclose(out, expected, rtol=1e-14)
    assert_allclose(expected[:, 0, 1], 9.0)
    assert_array_equal(expected[:, 2, 1], [0.5, 0.5, 0.5, 0.0])
    assert_array_equal(expected[:, 6, 1], [3.0, 3.0, 3.0, 1.0])


def test_a_kernel_names_the_source_of_what_it_imports():
    """The names in a kernel are its key: other derivatives are another kernel."""
    bundle = Bundle(allocates=False)
    bundle.add("language", language)
    source = hashlib.sha256(Path(jets.__file__).read_bytes()).hexdigest()
    assert any(source in definition for definition in bundle.definitions.values())


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda x: math.sin(x), r"uses np\.\* of scalars \(not math\.\*\)"),
        (lambda x: float(x), "value_of"),
        (lambda x: int(x), "value_of"),
        (lambda x: np.array([x, x]), r"returns tuples \(not arrays\)"),
        (lambda x: np.zeros(2).__setitem__(0, x), "value_of"),
        (lambda x: np.heaviside(x, 0.0), "heaviside"),
        (lambda x: np.linalg.norm(x), "norm"),
        (lambda x: np.add.reduce(x), "reduce"),
        (lambda x: np.ones(2) * x, "multiply"),
        (lambda x: np.sin(x, where=True), "sin"),
        (lambda x: np.clip(x, a_min=0.0, a_max=1.0), "clip"),
        (lambda x: x + jet(1.0, (1.0, 0.0)), "slopes"),
    ],
)
def test_what_jets_cannot_do_is_refused_by_name(refused: Callable[[Any], Any], message: str):
    with pytest.raises(TypeError, match=message):
        refused(jet(1.0, (1.0,)))


def with_math(x: float) -> float:
    return value_of(math.sin(jet(x, (1.0,))))


def with_two_numbers_of_slopes(x: float) -> float:
    return value_of(jet(x, (1.0,)) * jet(x, (1.0, 0.0)))


def with_no_such_slope(x: float) -> float:
    return slope_of(jet(x, (1.0,)), 1)


def with_float(x: float) -> float:
    return float(jet(x, (1.0,)))


def test_compiled_code_refuses_in_a_sentence():
    for function, message in (
        (with_math, r"math\.sin of a jet: .* uses np\.\* of scalars"),
        (with_float, r"builtins\.float of a jet: .* takes value_of"),
    ):
        with pytest.raises(BadInput, match=message):
            numba.njit(function)(1.0)
    for function, message in (
        (with_two_numbers_of_slopes, r"jets of \[1, 2\] slopes in one operation"),
        (with_no_such_slope, r"slope_of\(x, 1\) of a jet with 1 slopes"),
    ):
        with pytest.raises(numba.TypingError, match=message):
            numba.njit(function)(1.0)
