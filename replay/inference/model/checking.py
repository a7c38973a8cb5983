"""Checks that a model's functions match its declarations, for the tests of the model's author.

`check_model` calls the functions at random states; a failure is one sentence with file and line.
"""

import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import build
from fuselog.replay.engine.arrays import AnyArgument, Floats, Settings
from fuselog.replay.engine.vectors.tangent import WIDTHS, tangent_components
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative
from fuselog.replay.inference.linear_algebra.manifold import (
    boxminus,
    boxplus,
    manifold_blocks,
    tangent_size,
)
from fuselog.replay.inference.linear_algebra.tuples import adding_noise
from fuselog.replay.inference.model.augmentation import check_augmentable
from fuselog.replay.inference.model.functions import ModelFunction
from fuselog.replay.inference.model.model import Correction, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import number_fields, settings_type
from fuselog.replay.inference.model.validation import (
    check_correction,
    check_motion,
    check_sensor,
    check_state,
    check_switching,
    switching_of,
)
from fuselog.replay.tracing.functions import TracedFunction, arguments_like, place_of, traced
from fuselog.replay.tracing.graph import CONSTANT, INPUT, POWER, SELECT, Node, needed

STATES, PATHS, STEPS = 20, 60, 200
DURATION_S = 0.1
# Test of additive noise: step, tolerance, and limit of the share of a variance from other components.
SHORT_S, ADDS_UP, FROM_OTHERS = 0.01, 0.1, 0.01
STEP = 1e-5  # of central differences
TURN = 2.0 * np.pi


# (state, other inputs) -> Jacobians by name of the input.
Derivatives = Callable[[Floats, Sequence[Floats]], dict[str, Floats]]


class _Call(NamedTuple):
    """Function of a model that a method calls with a state and other inputs.

    Attributes:
        what: its name, file and line, for messages.
        function: the function.
        state: names and kinds of the state's components.
        outputs: names and kinds of the returned components.
        inputs: further arguments with respect to which to differentiate: for each name, the number of
            components, and whether the argument is zero.
        rest: the remaining arguments.
    """

    what: str
    function: ModelFunction
    state: Mapping[str, str]
    outputs: Mapping[str, str]
    inputs: Mapping[str, tuple[int, bool]]
    rest: tuple[AnyArgument, ...]

    def value(self, state: Floats, *others: Floats) -> Floats:
        return np.array(self.function(tuple(state), *map(tuple, others), *self.rest), dtype=float)

    @property
    def traced(self) -> TracedFunction:
        """The function with its graph; tracing raises BadInput."""
        shapes = [(0.0,) * n for n in (len(self.state), *(n for n, _ in self.inputs.values()))]
        made: TracedFunction = traced(self.function, *arguments_like((*shapes, *self.rest)))
        return made

    def others(self, rng: np.random.Generator) -> list[Floats]:
        return [np.zeros(n) if zero else rng.normal(size=n) for n, zero in self.inputs.values()]


def check_model(
    model: Model,
    parameters: Mapping[str, object] | None = None,
    states: ArrayLike | None = None,
    seed: int = 0,
) -> "Checked":
    """Check all functions of a model against what the model declares.

    Process noise is not additive if two half steps add a different variance than one whole step. This
    only causes a warning, because published filters with a fixed rate use noise per step.

    Args:
        model: the model.
        parameters: values of the model's parameters; a parameter without a value and without a default
            is 1.
        states: states (n, components) at which the functions are called; by default, random states of
            order one.
        seed: seed of the random states, controls and points of a map.

    Returns:
        Sentences on the checks that were made, those that were not, and noise that is not additive.

    Raises AssertionError, with one sentence, if a function cannot be traced, if its derivatives differ
    from central differences or from those written by hand, if a number of components is wrong, if a
    function is declared linear but is not linear, if an angle is declared linear or the reverse, if a
    unit vector changes its length, or if a variance is negative. Raises BadInput if the model does not
    have a parameter.
    """
    values = build(model.parameters, parameters or {}, "check_model")
    names = number_fields(model.parameters)
    given = (getattr(values, name) for name in names)
    numbers = settings_type(names)(*(1.0 if value is None else float(value) for value in given))
    motions = {"motion": model.motion, **(model.modes or {})}
    try:
        check_state("check_model", model)
        check_augmentable("check_model", model)
        check_correction("check_model", model)
        for motion in motions.values():
            check_motion("check_model", model, motion, numbers)
        if model.modes and model.switching:
            check_switching("check_model", model, numbers)
            switching_of("check_model", model, numbers)
        for sensor in model.sensors:
            check_sensor("check_model", model, sensor, numbers)
    except BadInput as error:
        raise AssertionError(str(error)) from error
    rng = np.random.default_rng(seed)
    tried = _states(model.kinds, rng) if states is None else np.array(states, dtype=float)
    with np.errstate(all="ignore"):
        calls = [_motion_call(model, motion, numbers) for motion in motions.values()]
        calls += [_sensor_call(model, sensor, numbers, rng) for sensor in model.sensors]
        parts: Sequence[Motion | Sensor] = [*motions.values(), *model.sensors]
        for call, part in zip(calls, parts, strict=True):
            for state in tried:
                _check_length(call, call.value(state, *call.others(rng)))
            exact = _derivatives_of(call)
            by_state = [
                _check_derivatives(call, exact, state, call.others(rng), part) for state in tried
            ]
            _check_linear(call, part.linear, by_state)
            _check_jumps(call, tried, rng)
            _check_twins(call, tried, rng)
        if model.correct is not None:
            for state in tried:
                _check_correction(model.correct, model, state, rng)
        for index, name in enumerate(model.state):
            _check_period(name, index, model, calls, tried)
        for motion in motions.values():
            size = motion.noises or model.tangent
            for state in tried:
                arguments = (tuple(state), DURATION_S, numbers)
                _check_noise(motion.noise, arguments, size, motion.noise_block)
            _check_noise(motion.control_noise, (DURATION_S, numbers), model.controls)
        for sensor in model.sensors:
            if not sensor.covariance:
                _check_noise(sensor.noise, (numbers,), sensor.noises or len(sensor.measured))
        doubts = [
            doubt
            for motion in motions.values()
            for doubt in _not_additive(model, motion, numbers, tried, rng)
        ]
    for doubt in dict.fromkeys(doubts):
        warnings.warn(doubt, stacklevel=2)
    return Checked([*_checked(model, calls, parts, len(tried)), *dict.fromkeys(doubts)])


class Checked(tuple[str, ...]):
    """Sentences about the checks that were made; a notebook shows one per line."""

    def __repr__(self) -> str:
        return "\n".join(self)


def _checked(
    model: Model, calls: Sequence[_Call], parts: Sequence[Motion | Sensor], states: int
) -> Checked:
    """Describe the checks that were made of each function, and list what is not checked."""
    sentences = [f"{model.summary}: {len(calls)} functions at {states} states"]
    for call, part in zip(calls, parts, strict=True):
        by = ", ".join(["state", *(name for name, (size, _) in call.inputs.items() if size)])
        found = [f"derivatives by {by}", "angles, jumps and lengths"]
        found += ["linear"] if part.linear else []
        of_messages = isinstance(part, Sensor) and part.covariance
        found += ["variances"] if part.noise is not None and not of_messages else []
        sentences.append(f"{call.what}: {'; '.join(found)}")
    others = {"moments": any(part.moments for part in parts), "start": model.start is not None}
    return Checked([*sentences, *(f"{name}: not checked" for name, has in others.items() if has)])


def _motion_call(model: Model, motion: Motion, numbers: Settings) -> _Call:
    inputs = {"control": (model.controls, False)}
    if motion.noises:
        inputs["noise"] = (motion.noises, True)
    rest = (DURATION_S, numbers)
    return _Call(place_of(motion.move), motion.move, model.state, model.state, inputs, rest)


def _sensor_call(model: Model, sensor: Sensor, numbers: Settings, rng: np.random.Generator) -> _Call:
    reference = tuple(rng.normal(size=sensor.reference_size))
    inputs = {"noise": (sensor.noises, True)} if sensor.noises else {}
    rest = (reference, numbers)
    return _Call(place_of(sensor.measure), sensor.measure, model.state, sensor.measured, inputs, rest)


def _states(kinds: Sequence[str], rng: np.random.Generator) -> Floats:
    """Draw random states (n, components): numbers of order one, arbitrary angles, and unit vectors."""
    columns = []
    for kind, *_ in manifold_blocks(kinds):
        drawn = rng.normal(size=(STATES, WIDTHS[kind]))
        if kind == "angle":
            drawn = rng.uniform(-np.pi, np.pi, (STATES, 1))
        elif kind != "linear":
            drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        columns.append(drawn)
    return np.concatenate(columns, axis=1)


def _difference(end: Floats, start: Floats, kinds: tuple[str, ...]) -> Floats:
    found = np.empty((1, tangent_size(kinds)))
    boxminus(kinds)(tuple(end), tuple(start), found, 0)
    difference: Floats = found[0]
    return difference


def _derivatives_of(call: _Call) -> Derivatives:
    """Make a function that returns the exact Jacobians with respect to the state and other inputs."""
    kinds, outputs = tuple(call.state.values()), tuple(call.outputs.values())
    counts = {name: n for name, (n, _) in call.inputs.items()}
    inputs = [Input("state", kinds, "state")]
    inputs += [Input(name, ("linear",) * n, name if n else "") for name, n in counts.items()]
    try:
        linearise = derivative(call.traced, inputs, outputs)
    except BadInput as error:
        raise AssertionError(str(error)) from error
    rows, sizes = tangent_size(outputs), {"state": tangent_size(kinds), **counts}

    def exact(state: Floats, others: Sequence[Floats]) -> dict[str, Floats]:
        jacobians = {name: np.zeros((rows, size)) for name, size in sizes.items()}
        linearise(tuple(state), *map(tuple, others), *call.rest, SimpleNamespace(**jacobians))
        return jacobians

    return exact


def _check_derivatives(
    call: _Call, exact: Derivatives, state: Floats, others: list[Floats], part: Motion | Sensor
) -> Floats:
    """Compare derivatives with central differences and handwritten ones; return the state's Jacobian."""
    jacobians = exact(state, others)
    for index, (name, jacobian) in enumerate(jacobians.items()):
        for column, slopes in enumerate(_slopes(call, [state, *others], index).T):
            _compare(call, jacobian, slopes, (name, column), 1e-6, "by central differences")
    _check_by_hand(call, part, state, others, jacobians)
    return jacobians["state"]


def _slopes(call: _Call, arguments: Sequence[Floats], index: int) -> Floats:
    """Compute the Jacobian (outputs, size) for one argument, by central differences."""
    outputs = tuple(call.outputs.values())
    kinds = tuple(call.state.values()) if index == 0 else ("linear",) * len(arguments[index])
    add, size = boxplus(kinds), tangent_size(kinds)
    slopes = np.empty((tangent_size(outputs), size))
    for column in range(size):
        ends = []
        for sign in (1.0, -1.0):
            moved = [each.copy() for each in arguments]
            add(moved[index], sign * STEP * np.eye(size)[column])
            ends.append(call.value(*moved))
        slopes[:, column] = _difference(ends[0], ends[1], outputs) / (2.0 * STEP)
    return slopes


def _check_correction(
    correct: Correction, model: Model, state: Floats, rng: np.random.Generator
) -> None:
    """Check that a small correction changes only its own component, and that `step` inverts `back`."""
    at, direction = tuple(state), rng.normal(size=model.tangent)
    slope = tuple(direction / np.dot(direction, correct.along(at)))
    for moved in (correct.move, correct.back):
        for column, name in enumerate(_tangent(model.state)):
            small = STEP * np.eye(model.tangent)[column]
            end, start = (np.array(moved(at, tuple(step), slope)) for step in (small, -small))
            slopes = _difference(end, start, model.kinds) / (2.0 * STEP)
            if not np.allclose(slopes, small / STEP, atol=1e-6):
                place = place_of(moved)
                raise AssertionError(f"{place}: a small step of {name} moves other components too")
    step = 0.3 * rng.normal(size=model.tangent)
    again = correct.step(at, correct.back(at, tuple(step), slope), slope)
    if not np.allclose(again, step, atol=1e-9):
        both = f"{place_of(correct.step)} does not return the step that {place_of(correct.back)} took"
        raise AssertionError(both)


def _check_by_hand(
    call: _Call,
    part: Motion | Sensor,
    state: Floats,
    others: list[Floats],
    exact: Mapping[str, Floats],
) -> None:
    written: dict[str, Floats] = {}
    if isinstance(part, Motion) and part.jacobians is not None:
        control = others[0]
        written = {name: np.zeros_like(exact[name]) for name in ("state", "control")}
        jacobians: ModelFunction = part.jacobians
        jacobians(tuple(state), tuple(control), *call.rest, written["state"], written["control"])
        if part.control_noise is None:  # no method uses it
            del written["control"]
    elif isinstance(part, Sensor) and part.jacobian is not None:
        written = {"state": np.zeros_like(exact["state"])}
        by_state: ModelFunction = part.jacobian
        by_state(tuple(state), *call.rest, written["state"])
    for name, jacobian in written.items():
        for column in range(jacobian.shape[1]):
            _compare(call, exact[name], jacobian[:, column], (name, column), 1e-9, "as written by hand")


def _compare(
    call: _Call, exact: Floats, others: Floats, by: tuple[str, int], tolerance: float, how: str
) -> None:
    """Raise AssertionError if a column of a Jacobian differs between two computations."""
    name, column = by
    found = exact[:, column]
    allowed = tolerance * np.maximum(1.0, np.maximum(np.abs(found), np.abs(exact).max(initial=0.0)))
    wrong = np.flatnonzero(~(np.abs(found - others) <= allowed))
    if len(wrong):
        row = int(wrong[0])
        inner = _tangent(call.state)[column] if name == "state" else f"{name} {column}"
        raise AssertionError(
            f"{call.what}: the derivative of {_tangent(call.outputs)[row]} by {inner} is "
            f"{found[row]:.9g}, but {others[row]:.9g} {how}"
        )


def _tangent(components: Mapping[str, str]) -> list[str]:
    return [name for name, _ in tangent_components(list(components), list(components.values()))]


def _check_linear(call: _Call, is_linear: bool, by_state: list[Floats]) -> None:
    if not is_linear:
        return
    spread = np.ptp(by_state, axis=0)
    if not np.all(spread <= 1e-9 * np.maximum(1.0, np.abs(by_state[0]))):
        row, column = np.unravel_index(int(np.argmax(spread)), spread.shape)
        raise AssertionError(
            f"{call.what} is declared linear, but the derivative of {_tangent(call.outputs)[row]} by "
            f"{_tangent(call.state)[column]} changes from state to state"
        )


def _check_twins(call: _Call, states: Floats, rng: np.random.Generator) -> None:
    """Check that values do not change if an angle grows by a full turn or a unit vector is negated."""
    names, outputs = list(call.state), tuple(call.outputs.values())
    for kind, first, *_ in manifold_blocks(tuple(call.state.values())):
        if kind == "linear":
            continue
        for state in states:
            others, twin = call.others(rng), state.copy()
            columns = slice(first, first + WIDTHS[kind])
            twin[columns] = state[columns] + TURN if kind == "angle" else -state[columns]
            value = call.value(state, *others)
            away = _difference(call.value(twin, *others), value, outputs)
            wrong = np.flatnonzero(~(np.abs(away) <= 1e-8 * max(1.0, np.abs(value).max())))
            if len(wrong):
                same = (
                    "after a full turn"
                    if kind == "angle"
                    else "at its negative, which is the same state"
                )
                other = _tangent(call.outputs)[wrong[0]]
                raise AssertionError(
                    f"{call.what}: {names[first]} is of kind {kind}, but {other} differs {same}"
                )


def _check_length(call: _Call, value: Floats) -> None:
    for kind, first, *_ in manifold_blocks(tuple(call.outputs.values())):
        vector = value[first : first + WIDTHS[kind]]
        if kind in ("axis", "quaternion") and not abs(np.linalg.norm(vector) - 1.0) < 1e-9:
            raise AssertionError(
                f"{call.what}: {list(call.outputs)[first]} and its neighbours are of kind {kind}, but "
                f"have length {np.linalg.norm(vector):.6g}"
            )


def _over_states(function: TracedFunction, arguments: Sequence[AnyArgument]) -> list[Floats]:
    """Compute what a function returns (n,) for n states together: the state's components are (n,).

    NumPy may round functions of arrays in another way than functions of numbers.
    """
    found: dict[Node, Floats] = {}
    for node in needed(function.result.returned):
        values = [found[each] for each in node.arguments]
        if node.operation == INPUT:
            argument, entry = node.value
            given = arguments[argument]
            if entry is not None:
                given = getattr(given, entry) if isinstance(entry, str) else given[entry]
            found[node] = np.asarray(given)
        elif node.operation == CONSTANT:
            found[node] = np.asarray(node.value)
        elif node.operation == POWER:
            found[node] = np.power(values[0], float(node.value))
        elif node.operation == SELECT:
            found[node] = np.where(*values)
        elif node.operation == operator.not_:
            found[node] = np.logical_not(*values)
        else:
            found[node] = node.operation(*values)
    return [np.broadcast_to(found[each], len(arguments[0][0])) for each in function.result.returned]


def _check_jumps(call: _Call, states: Floats, rng: np.random.Generator) -> None:
    """Find components that are declared linear but jump by a full turn along a path, as angles do."""
    kinds = tuple(call.state.values())
    add, scales = boxplus(kinds), {"linear": 20.0, "angle": TURN, "axis": np.pi, "quaternion": TURN}
    linear = [index for index, kind in enumerate(call.outputs.values()) if kind == "linear"]
    function = call.traced
    for path in range(PATHS if linear else 0):
        others, direction = call.others(rng), np.empty(tangent_size(kinds))
        for kind, _, t, width in manifold_blocks(kinds):
            direction[t : t + width] = scales[kind] * rng.normal(size=width)
        along = np.repeat(states[path % len(states)][:, None], STEPS + 1, axis=1)
        add(along, np.outer(direction, np.arange(STEPS + 1) / STEPS - 0.5))
        values = _over_states(function, (tuple(along), *map(tuple, others), *call.rest))
        change = np.diff(np.stack([values[index] for index in linear], axis=1), axis=0)
        usual = np.abs(change)
        is_jump = np.abs(usual - TURN) < 0.5
        calm = np.minimum(np.roll(usual, 1, axis=0), np.roll(usual, -1, axis=0)) < 0.5
        if (is_jump & calm).any():
            column = int(np.flatnonzero((is_jump & calm).any(axis=0))[0])
            raise AssertionError(
                f"{call.what}: {list(call.outputs)[linear[column]]} is declared linear, but jumps by a "
                "full turn from one state to the next; its kind is angle"
            )


def _check_period(name: str, index: int, model: Model, calls: list[_Call], states: Floats) -> None:
    """Find components that are declared linear but are used only in sines and cosines, like angles."""
    if model.kinds[index] != "linear":
        return

    def changes(shift: float) -> bool:
        """Test whether a shift of the component changes anything except the component itself."""
        for call in calls:
            zeros = [np.full(n, 0.0 if zero else 0.5) for n, zero in call.inputs.values()]
            for state in states:
                moved = state.copy()
                moved[index] += shift
                value = call.value(state, *zeros)
                away = call.value(moved, *zeros) - value
                if name in call.outputs:
                    away[list(call.outputs).index(name)] -= shift
                angular = np.array([kind == "angle" for kind in call.outputs.values()])
                away = np.where(angular, wrap_angle(away), away)
                if not np.all(np.abs(away) <= 1e-8 * max(1.0, np.abs(value).max())):
                    return True
        return False

    if changes(1.0) and not changes(TURN):
        raise AssertionError(
            f"check_model: {name} is declared linear, but a full turn of it changes nothing; declare "
            "it as an angle"
        )


def _check_noise(
    noise: ModelFunction | None, arguments: tuple[AnyArgument, ...], size: int, block: int = 0
) -> None:
    """Check the variances, or the lower triangle of a covariance."""
    if noise is None or not size:
        return
    matrix = _matrix(noise, arguments, size, block)
    smallest, scale = float(np.linalg.eigvalsh(matrix)[0]), 1e-12 * float(np.abs(matrix).max())
    if not smallest >= -scale:
        raise AssertionError(f"{place_of(noise)} returns a negative variance, {smallest:.6g}")


def _matrix(
    noise: ModelFunction, arguments: tuple[AnyArgument, ...], size: int, block: int = 0
) -> Floats:
    """Make the covariance (size, size) from variances or from the rows of a lower triangle."""
    numbers, matrix = np.array(noise(*arguments), dtype=float), np.zeros((size, size))
    if len(numbers) == size:
        return np.diag(numbers)
    adding_noise(size, block)(matrix, numbers)
    return matrix


def _not_additive(
    model: Model, motion: Motion, numbers: Settings, states: Floats, rng: np.random.Generator
) -> list[str]:
    """Describe components for which one step and two half steps add different variances.

    Components that receive variance from other components during the step are left out, because their
    noise may be an approximation of limited order.
    """
    whole, half = (
        _motion_call(model, motion, numbers)._replace(rest=(step_s, numbers))
        for step_s in (SHORT_S, 0.5 * SHORT_S)
    )
    ratios = []
    for state in states:
        others = whole.others(rng)
        once, first = (_spread(each, motion, state, others) for each in (whole, half))
        middle = half.value(state, *others)
        transition = _slopes(half, [middle, *others], 0)
        kept = transition @ first @ transition.T
        twice = np.diagonal(kept + _spread(half, motion, middle, others))
        own = np.diagonal(transition) ** 2 * np.diagonal(first)
        is_own = np.abs(np.diagonal(kept) - own) <= FROM_OTHERS * twice
        ratios.append(np.where(is_own & (twice > 0.0), np.diagonal(once) / twice, 1.0))
    ratio = np.median(ratios, axis=0)
    wrong = np.abs(ratio - 1.0) > ADDS_UP
    if not wrong.any():
        return []
    names = ", ".join(
        name for name, is_wrong in zip(_tangent(model.state), wrong, strict=True) if is_wrong
    )
    return [
        f"{place_of(motion.noise or motion.control_noise or motion.move)}: the noise is not additive: "
        f"over {SHORT_S:g} s the variance of {names} is {ratio[wrong][0]:.3g} times that of two halves, "
        "so estimates depend on the number of messages; make the added variance "
        "proportional to duration_s"
    ]


def _spread(call: _Call, motion: Motion, state: Floats, others: list[Floats]) -> Floats:
    """Compute the covariance that a step adds, from additive noise, other noise and control noise."""
    (step_s, numbers), arguments = call.rest, [state, *others]
    size = tangent_size(tuple(call.state.values()))
    total = np.zeros((size, size))
    at = tuple(state), step_s, numbers
    if motion.noise is not None and not motion.noises:
        total += _matrix(motion.noise, at, size, motion.noise_block)
    entering = motion.noise if motion.noises else None
    for noise, given, index in ((entering, at, 2), (motion.control_noise, at[1:], 1)):
        if noise is None:
            continue
        slopes = _slopes(call, arguments, index)
        total += slopes @ _matrix(noise, given, slopes.shape[1]) @ slopes.T
    return total
