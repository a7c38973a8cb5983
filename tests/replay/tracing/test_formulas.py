"""Formulas of models read as one would write them, and as Python they give what the model gives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.formulas import formulas_by_function
from fuselog.replay.inference.model.parameters import number_fields, settings_type
from fuselog.replay.inference.model.validation import trial_state
from fuselog.replay.tracing.formulas import formulas_of
from fuselog.replay.tracing.functions import traced


class Text(NamedTuple):
    """Lines of formulas, and the numbers that they are given."""

    lines: list[str]
    given: dict[str, float]

    def values(self, **changed: float) -> dict[str, float]:
        """All that the lines define."""
        scope: dict[str, Any] = {**vars(np), **self.given, **changed, "abs": abs}
        for line in self.lines:
            name, _, formula = line.partition(" = ")
            scope[name] = eval(formula, scope)
        return scope


def lines_of(function: Callable[..., Any], *names: str) -> list[str]:
    """The lines of a function of numbers."""
    made = traced(function, len(names))
    outputs = {"f": made.result.returned[0]}
    return formulas_of(made, {(0, k): name for k, name in enumerate(names)}, outputs, {})


def test_the_robot_moves_as_one_would_write_it() -> None:
    lines = formulas_by_function("robot")["motion, move"]
    assert lines[:3] == [
        "v1 = turn_scale * turn_radps + turn_bias_radps",
        "v2 = 0.5 * v1 * duration_s",
        "v3 = forward_scale * forward_mps * duration_s",
    ]
    assert "next_heading_rad = heading_rad + v1 * duration_s" in lines
    derivatives = [line for line in lines if line.startswith("d next_heading_rad")]
    assert derivatives == [
        "d next_heading_rad / d heading_rad = 1",
        "d next_heading_rad / d turn_radps = duration_s * turn_scale",
    ]
    seen = formulas_by_function("robot")["sensor range (range_m), measure"]
    assert not [line for line in seen if "heading_rad" in line]  # of which a range does not depend
    assert formulas_by_function("robot")["sensor range (range_m), noise"] == [
        "variance of range_m = sigma_range_m ** 2"
    ]


@pytest.mark.parametrize("name", ["robot", "orientation", "batch-reactor", "ranging-pose"])
def test_formulas_are_python_of_the_model(name: str) -> None:
    model = registered_models()[name]
    names = number_fields(model.parameters)
    values = dict(zip(names, np.linspace(0.3, 0.9, len(names)).tolist(), strict=True))
    control = model.control.components if model.control else ()
    driven = dict(zip(control, np.linspace(0.5, 1.1, len(control)).tolist(), strict=True))
    state = dict(zip(model.state, trial_state(model.kinds), strict=True))
    text = Text(
        formulas_by_function(name)["motion, move"], {**values, **driven, **state, "duration_s": 0.7}
    )
    found = text.values()
    parameters = settings_type(names)(**values)
    moved = model.motion.move(tuple(state.values()), tuple(driven.values()), 0.7, parameters)
    assert_allclose([found[f"next_{each}"] for each in state], moved, rtol=1e-14)
    step = 1e-6
    for by, value in {**state, **driven}.items():
        after, before = text.values(**{by: value + step}), text.values(**{by: value - step})
        for each in state:
            difference = (after[f"next_{each}"] - before[f"next_{each}"]) / (2.0 * step)
            assert_allclose(found.get(f"d next_{each} / d {by}", 0.0), difference, rtol=1e-7, atol=1e-9)


def test_parentheses_stand_where_python_needs_them() -> None:
    for function, line in (
        (lambda x: (x[0] - (x[1] - x[2]),), "f = a - (b - c)"),
        (lambda x: (x[0] - x[1] - x[2],), "f = a - b - c"),
        (lambda x: (-(x[0] % x[1]) * x[2],), "f = -(a % b) * c"),
        (lambda x: (x[0] % (x[1] * x[2]),), "f = a % (b * c)"),
        (lambda x: ((-x[0]) ** 2 / (x[1] * x[2]),), "f = (-a) ** 2 / (b * c)"),
        (lambda x: (np.where(x[0] > 0.0, x[1], -0.5) + x[2],), "f = (b if a > 0 else -0.5) + c"),
        (
            lambda x: (np.where((x[0] > 0.0) & ((x[1] < 1.0) | (x[2] == np.pi)), 1.0, x[0]),),
            "f = 1 if a > 0 and (b < 1 or c == pi) else a",
        ),
    ):
        assert lines_of(function, "a", "b", "c") == [line]


def test_a_model_of_ones_own_with_a_condition() -> None:
    class Own(fl.ModelParameters):
        drag_per_m: float = 0.1

    def fall(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
        height_m, speed_mps = state
        if height_m < 0.0:
            return 0.0, 0.0
        drag_mps2 = parameters.drag_per_m * speed_mps**2
        return height_m + duration_s * speed_mps, speed_mps + duration_s * (drag_mps2 - 9.81)

    state = {"height_m": "linear", "speed_mps": "linear"}

    def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
        return 0.0, duration_s

    text = fl.formulas(fl.Model("what falls", state, Own, (), fl.Motion(fall, noise)))  # type: ignore[arg-type]
    assert text.splitlines() == [
        "motion, move:",
        "  next_height_m = 0 if height_m < 0 else height_m + duration_s * speed_mps",
        "  next_speed_mps = 0 if height_m < 0 else speed_mps + duration_s * "
        "(drag_per_m * speed_mps ** 2 - 9.81)",
        "  d next_height_m / d height_m = 0 if height_m < 0 else 1",
        "  d next_height_m / d speed_mps = 0 if height_m < 0 else duration_s",
        "  d next_speed_mps / d speed_mps = 0 if height_m < 0 else 1 + duration_s * "
        "(drag_per_m * (2 * speed_mps))",
        "",
        "motion, noise:",
        "  variance of height_m = 0",
        "  variance of speed_mps = duration_s",
    ]


def test_names_of_inputs_are_not_given_to_what_stands_between():
    def function(given: Any) -> Any:
        x, y = given
        long = np.sin(x * y + x / y) + np.exp(-x * y) * np.cos(x - 3.0 * y)
        return (long * long + np.sqrt(1.0 + long * long),)

    assert any(line.startswith("v1 = ") for line in lines_of(function, "a", "b"))
    assert not any(line.startswith(("v1 = ", "v2 = ")) for line in lines_of(function, "v1", "v2"))
