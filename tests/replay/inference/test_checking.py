"""The checks of a model for who writes one: right ones pass, every wrong one is found and named."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.model.checking import _over_states, check_model
from fuselog.replay.inference.model.model import Correction, Model, Motion
from fuselog.replay.tracing.functions import traced
from tests.replay.inference import attitude, vehicle_a
from tests.replay.inference.attitude import ATTITUDE
from tests.replay.inference.vehicle_a import RANGE_BEARING, SPEED, VEHICLE_A
from tests.replay.inference.wheel import make_wheel

# Parameters with which a model is tried where ones make no sense: nobody is faster than sound.
PARAMETERS = {
    "moving-shooter": {"speed_of_sound_mps": 342.0, "mach_number": 2.0},
    "inertial": {"origin_latitude_deg": 40.0},
    "sound-source": {"speed_of_sound_mps": 343.0},
}
MODELS = {**registered_models(), "vehicle A": VEHICLE_A, "attitude": ATTITUDE, "wheel": make_wheel()}


@pytest.mark.paper
@pytest.mark.filterwarnings("ignore:.* is not additive")
@pytest.mark.parametrize("name", MODELS)
def test_right_models_pass(name: str) -> None:
    """All that are registered, and those of the tests: angles, an axis, a quaternion, all noises."""
    check_model(MODELS[name], PARAMETERS.get(name), seed=5)


def branched(state: Any, width: Any) -> Any:
    x, y = state
    outside = x * x + y * y > width
    first = np.sinc(x) if outside & ~(y > 0.0) else x**3
    return first, width, y**-2


def test_a_function_of_many_states_together_is_that_of_each() -> None:
    states = np.random.default_rng(1).normal(size=(2, 50))
    together = _over_states(traced(branched, 2, None), (tuple(states), 1.5))
    each = [branched(state, 1.5) for state in states.T]
    assert np.transpose(together) == pytest.approx(np.array(each), rel=1e-12)
    assert 0 < np.sum(np.isclose(together[0], states[0] ** 3)) < 50  # either way is taken


def test_what_was_checked_is_said() -> None:
    said = check_model(VEHICLE_A)
    assert len(said) == 2 + len(VEHICLE_A.sensors)
    assert said[0].endswith(f"{1 + len(VEHICLE_A.sensors)} functions at 20 states")
    assert ": derivatives by state" in said[1]
    assert "variances" in said[1]
    assert repr(said) == "\n".join(said)


def by_hand(
    state: Any, control: Any, duration_s: Any, parameters: Any, by_state: Any, by_control: Any
) -> None:
    _, _, heading, speed, turn = state
    half, T = 0.5 * turn * duration_s, duration_s
    chord, c, s = np.sinc(half / np.pi), np.cos(heading + half), np.sin(heading + half)
    slope = 0.5 * T * (np.cos(half) - chord) / half  # of sinc by the turn
    by_state[:] = np.eye(5)
    by_state[0, 2:] = (
        -speed * T * chord * s,
        T * chord * c,
        speed * T * (slope * c - chord * s * 0.5 * T),
    )
    by_state[1, 2:] = speed * T * chord * c, T * chord * s, speed * T * (slope * s + chord * c * 0.5 * T)
    by_state[2, 4] = T


def by_a_wrong_hand(*arguments: Any) -> None:
    by_hand(*arguments)
    arguments[4][1, 3] *= -1.0


def test_a_jacobian_by_hand_is_compared() -> None:
    motion = replace(VEHICLE_A.motion, jacobians=by_hand)
    check_model(replace(VEHICLE_A, motion=motion))
    wrong = replace(VEHICLE_A.motion, jacobians=by_a_wrong_hand)
    with pytest.raises(AssertionError, match=r"move \(vehicle_a.py, line \d+\): .* of y_m by speed_mps"):
        check_model(replace(VEHICLE_A, motion=wrong))


def rows_by_hand(state: Any, reference: Any, parameters: Any, rows: Any) -> None:
    rows[:] = 0.0
    rows[0, 4] = 1.0  # the turn rate, where the speed is


def half_wrapped(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading, speed, turn = vehicle_a.move(state, control, duration_s, parameters)
    return x, y, heading - 2 * np.pi * np.round(heading / (2 * np.pi)), speed, turn


def as_if_linear(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading, speed, turn = state
    return x + heading * duration_s, y, heading, speed, turn


def growing(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return (*(1.001 * part for part in state[:4]), *state[4:])


def by_math(state: Any, reference: Any, parameters: Any) -> Any:
    return (math.sqrt(abs(state[3])),)


def squared(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[3] * state[3],)


def first_of_quaternion(state: Any, reference: Any, parameters: Any) -> Any:
    return state[0], state[1], state[2]


def pair(state: Any, reference: Any, parameters: Any) -> Any:
    return state[3], state[3]


def negative(parameters: Any) -> Any:
    return (-(parameters.sigma_speed_mps**2),)


def indefinite(state: Any, duration_s: Any, parameters: Any) -> Any:
    return (1.0, 2.0, 1.0, *(0.0, 0.0, 1.0), *(0.0,) * 3, 1.0, *(0.0,) * 4, 1.0)


def with_speed(**changes: Any) -> Model:
    return replace(VEHICLE_A, sensors=(RANGE_BEARING, replace(SPEED, **changes)))


def moving(function: Any, **changes: Any) -> Model:
    return replace(VEHICLE_A, motion=Motion(function, vehicle_a.noise), **changes)


LINEAR_HEADING = {**vehicle_a.STATE, "heading_rad": "linear"}
LINEAR_BEARING = replace(RANGE_BEARING, measured={"range_m": "linear", "bearing_rad": "linear"})
COMPASS = (replace(ATTITUDE.sensors[0], measure=first_of_quaternion),)


def along_heading(state: Any) -> Any:
    return 0.0, 0.0, 1.0, 0.0, 0.0


def moved_well(state: Any, step: Any, slope: Any) -> Any:
    return tuple(x + d for x, d in zip(state, step, strict=True))


def stepped(state: Any, target: Any, slope: Any) -> Any:
    return tuple(x - y for x, y in zip(target, state, strict=True))


def stepped_twice(state: Any, target: Any, slope: Any) -> Any:
    return tuple(2.0 * d for d in stepped(state, target, slope))


def moved_by(state: Any, step: Any, slope: Any) -> Any:
    x, y, heading, speed, turn = state
    return x + step[0], y + step[1], heading + step[2], speed + step[3] + step[2] * turn, turn + step[4]


WRONG: dict[str, tuple[Model, str]] = {
    "a Jacobian of a sensor": (with_speed(jacobian=rows_by_hand), "read_speed .* as written by hand"),
    "a measured angle declared linear": (
        replace(VEHICLE_A, sensors=(LINEAR_BEARING,)),
        "see .*bearing_rad is declared linear, but jumps by a full turn",
    ),
    "a state's angle declared linear": (
        replace(VEHICLE_A, state=LINEAR_HEADING),
        "heading_rad is declared linear, but a full turn of it changes nothing",
    ),
    "a state's angle declared linear, wrapped by its motion": (
        moving(half_wrapped, state=LINEAR_HEADING),
        "half_wrapped .*heading_rad is declared linear, but jumps",
    ),
    "a number declared an angle": (
        moving(as_if_linear),
        "as_if_linear .*heading_rad is of kind angle, but x_m differs after a full turn",
    ),
    "a quaternion with a sign": (
        replace(ATTITUDE, sensors=COMPASS),
        "orientation_w is of kind quaternion, but force_x differs at its negative",
    ),
    "a quaternion that grows": (
        replace(ATTITUDE, motion=Motion(growing, attitude.noise)),
        "orientation_w and its neighbours .*length 1.001",
    ),
    "a square declared linear": (
        with_speed(measure=squared),
        "squared .* declared linear, but the derivative of speed_mps by speed_mps changes",
    ),
    "an arc declared linear": (
        replace(VEHICLE_A, motion=replace(VEHICLE_A.motion, linear=True)),
        "move .* declared linear",
    ),
    "no derivative": (
        with_speed(measure=by_math),
        "by_math .* it uses math.* on a number that is only known later; write np",
    ),
    "too many components": (with_speed(measure=pair), "pair .* returns 2 components; 1 are needed"),
    "a negative variance": (with_speed(noise=negative), "negative .* a negative variance, -0.01"),
    "an indefinite covariance": (
        replace(VEHICLE_A, motion=Motion(vehicle_a.move, indefinite)),
        "indefinite .* returns a negative variance, -1",
    ),
    "a kind that does not exist": (
        replace(VEHICLE_A, state={**vehicle_a.STATE, "x_m": "metres"}),
        "give linear",
    ),
    "a correction that is none for small steps": (
        replace(VEHICLE_A, correct=Correction(along_heading, moved_by, stepped, moved_well)),
        "moved_by .* a small step of heading_rad moves other components too",
    ),
    "a step that is not found again": (
        replace(VEHICLE_A, correct=Correction(along_heading, moved_well, stepped_twice, moved_well)),
        "stepped_twice .* does not return the step that moved_well",
    ),
    "estimable without kinds": (
        replace(VEHICLE_A, augmentable=("sigma_speed_mps",)),
        "augmentable is a tuple; expected a mapping from parameter to kind, such as",
    ),
    "an estimable that is no parameter": (
        replace(VEHICLE_A, augmentable={"sigma_sped_mps": "linear"}),
        "'sigma_sped_mps' is not a parameter of the model; did you mean 'sigma_speed_mps'",
    ),
    "an estimable orientation": (
        replace(VEHICLE_A, augmentable={"sigma_speed_mps": "axis"}),
        "sigma_speed_mps is of kind 'axis'; expected linear or angle",
    ),
    "a wrong mode": (
        replace(VEHICLE_A, modes={"odd": Motion(as_if_linear, vehicle_a.noise)}),
        "as_if_linear .*heading_rad is of kind angle",
    ),
}


@pytest.mark.paper
@pytest.mark.parametrize("case", WRONG)
def test_wrong_models_are_found(case: str) -> None:
    model, words = WRONG[case]
    with pytest.raises(AssertionError, match=words) as caught:
        check_model(model)
    assert "\n" not in str(caught.value)


def test_states_and_parameters_may_be_given() -> None:
    """Where a model is used; here a number is an angle only beyond what is tried at random."""
    with pytest.raises(AssertionError, match="negative"):
        check_model(with_speed(noise=negative), {"sigma_speed_mps": 2.0})
    with pytest.raises(BadInput, match="no parameter 'sigma'"):
        check_model(VEHICLE_A, {"sigma": 2.0})
    check_model(VEHICLE_A, states=[[0.0, 0.0, np.pi, 0.0, 0.0]])  # no speed, no turn, at the cut


GIVEN = VEHICLE_A.motion.noise
assert GIVEN is not None
SHARES: dict[str, Any] = {
    "fixed": lambda duration_s: 1.0 + 0.0 * duration_s,
    "root": lambda duration_s: duration_s**0.5,
    "square": lambda duration_s: duration_s**2,
}


@pytest.mark.parametrize("case", SHARES)
def test_noise_of_the_step_is_noticed(case: str) -> None:
    """Noise over a step has to be that of its halves, or estimates depend on the number of messages."""

    def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
        return tuple(SHARES[case](duration_s) for _ in range(VEHICLE_A.tangent))

    with pytest.warns(UserWarning, match=r"noise \(test_checking.py, line \d+\): .* is not additive"):
        said = check_model(replace(VEHICLE_A, motion=replace(VEHICLE_A.motion, noise=noise)))
    assert "not additive" in said[-1]


def test_noise_of_the_control_is_looked_at_too() -> None:
    """A variance of the control per message loses weight as messages get more."""
    robot = MODELS["robot"]
    check_model(robot)
    motion = replace(robot.motion, control_noise=lambda *_: (1.0, 1.0))
    with pytest.warns(UserWarning, match="variance of x_m, y_m, heading_rad is 2 times"):
        check_model(replace(robot, motion=motion))
