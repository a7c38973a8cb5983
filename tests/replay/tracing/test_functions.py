"""What a model's function may be and do: what is traced and refused, and that nothing stays stale."""

import linecache
import math
import random
import re
import time
from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.model.checking import check_model
from fuselog.replay.inference.model.model import Model
from fuselog.replay.tracing.functions import Shape, TracedFunction, traced
from fuselog.replay.tracing.graph import Graph
from fuselog.replay.tracing.traced import _LOGICAL, _OPERATORS, PRIMITIVES, where
from tests.replay.inference.replays import outputs
from tests.replay.inference.scalar import SCALAR, VALUE, source
from tests.replay.tracing.calls import by_compiler, by_python, linearised, over_points

# --- conditions --------------------------------------------------------------------------------------


def two_conditions(given: Any) -> Any:
    x, y = given
    found = 0.0
    if x > y:
        found = x * y
        if y > 0.0 and x < 3.0:
            found += 1.0
        elif not y < -1.0:
            found -= x
    if x > y:  # met before: no way more
        found *= 2.0
    return found, found if x else y


def rounds(given: Any) -> Any:
    """A loop that a known number ends, and one that is left early."""
    x, k = given[0], 0
    while k < 3:
        x, k = np.sin(x) + given[1], k + 1
    for _ in range(4):
        if x > 1.0:
            break
        x = 2.0 * x + 0.1
    return (x,)


@pytest.mark.parametrize("function", [two_conditions, rounds])
def test_every_way_through_conditions_is_joined(function: Callable[[Any], Any]):
    points = np.array([(x, y) for x in (-2.0, -0.5, 0.0, 0.3, 4.0) for y in (-2.0, -0.5, 0.0, 0.2, 3.5)])
    functions = [linearised(function, 2)]
    (compiled,), (plain,) = by_compiler(functions, points), by_python(functions, points)
    assert_allclose(compiled, plain, rtol=1e-14)
    assert_allclose(compiled[..., 0], [function(tuple(x)) for x in points], rtol=1e-14)


def test_a_condition_that_is_met_twice_is_one():
    function = TracedFunction(two_conditions, (2,))
    calls = []
    TracedFunction(lambda given: calls.append(given) or two_conditions(given), (2,)).result  # noqa: B018
    assert len(function.outputs) == 2
    assert len(calls) == 2 * (1 + 5)  # x or not; not x > y; x > y with y > 0 and x < 3, or not y < -1


def test_arrays_that_a_function_fills_are_what_it_gives():
    def fill(x: Any, array: Any, unused: Any) -> None:
        array[0] = x * array[1]
        if x > 1.0:
            array[1] += 1.0

    function = TracedFunction(fill, (None, Shape((2,)), Shape((3, 3))))
    assert [(argument, place) for argument, place, _ in function.result.written] == [
        (1, (0,)),
        (1, (1,)),
    ]
    assert function.result.returned == ()


# --- what is refused ---------------------------------------------------------------------------------

NUMBER, WHERE = "on a number that is only known later", "np.where"
TABLE = [1.0, 2.0]
CLOCK = time.perf_counter


def ends_never(x: Any) -> Any:
    while x > 0.0:
        x = x - 1.0
    return x


def in_many_ways(x: Any) -> Any:
    return sum(1.0 if x > k else x for k in range(300))


def into_floats(x: Any) -> Any:
    array = np.zeros(2)
    array[0] = x
    return array[0]


REFUSED = {
    "int()": (lambda x: int(x), rf"it uses int\(\) {NUMBER}; write np.floor or np.trunc"),
    "float()": (lambda x: float(x), rf"it uses float\(\) {NUMBER}; leave the number as it is"),
    "math.*": (lambda x: math.sin(x), rf"it uses math\.\* {NUMBER}; write np\.\* instead"),
    "an index": (lambda x: TABLE[x], rf"it uses an index {NUMBER}; write np\.interp"),
    "an index of an array": (lambda x: np.ones(3)[x], rf"it uses an index {NUMBER}; write np\.interp"),
    "np.take": (lambda x: np.take(TABLE, x), rf"it uses int\(\) {NUMBER}; .* np\.choose for an index"),
    "an array of float": (into_floats, rf"it uses an array of float {NUMBER}; .* np\.array\(\[a, b\]\)"),
    "no end": (
        ends_never,
        r"there are more than 256 paths through .*; write .* a fixed number of iterations",
    ),
    "many ways": (
        in_many_ways,
        r"there are more than 256 paths .*; write np\.clip or np\.where",
    ),
    "a reduction": (lambda x: np.add.reduce(x), r"it uses np\.add\.reduce; write it with operators"),
    "an option": (lambda x: np.sin(x, where=True), r"it uses np\.sin with where; write np\.where"),
    "a function": (lambda x: np.heaviside(x, 0.0), rf"it uses np\.heaviside {NUMBER}; write it with"),
    "a table": (lambda x: np.interp(x, [0.0, x], TABLE), r"it uses np\.interp on a table that is only"),
    "mixed arrays": (
        lambda x: np.sin(np.array([x, 1.0]))[0],
        r"it uses np\.sin on an array that has some",
    ),
    "two results": (
        lambda x: x if x > 0.0 else (x, x),
        r"it returns a number on one path and a tuple of 2",
    ),
    "a clock": (lambda x: x + CLOCK(), r"it returns another result when it is called again; clocks"),
    "chance": (lambda x: x + random.random(), r"it returns another result when it is called again"),
    "chance of a number": (lambda x: np.random.default_rng(1).normal(x), r"it uses .* on a number that"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_graph_holds_is_refused_in_one_sentence_with_its_line_and_the_mend(name: str):
    function, message = REFUSED[name]
    code = function.__code__
    with pytest.raises(BadInput) as refused:
        traced(function, None)
    said = str(refused.value)
    place = re.match(rf"{re.escape(function.__name__)} \(test_functions\.py, line (\d+)\): ", said)
    assert place, said
    assert 0 <= int(place[1]) - code.co_firstlineno <= 4
    assert re.match(message, said[place.end() :]), said


def measuring(function: Callable[[Any], Any], **changes: Any) -> Model:
    """The scalar model whose sensor measures this of its state."""

    def measure(state: Any, reference: Any, parameters: Any) -> Any:
        return (function(state[0]),)

    return replace(SCALAR, sensors=(replace(VALUE, measure=measure, linear=False, **changes),))


@pytest.mark.parametrize("name", ["math.*", "many ways", "a clock"])
def test_a_check_and_a_replay_refuse_in_the_same_sentence(name: str):
    function, message = REFUSED[name]
    model = measuring(function)
    with pytest.raises(AssertionError, match=rf"^\w+ \(test_functions\.py, line \d+\): {message}"):
        check_model(model)
    with pytest.raises(BadInput, match=rf"^[^\n]*\w+ \(test_functions\.py, line \d+\): {message}"):
        outputs(model, "ekf", [source([1.0, 2.0])])


# --- what a function may be --------------------------------------------------------------------------


class Scaled:
    """A callable that keeps a number, and has a method that does the same."""

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def __call__(self, *arguments: Any) -> Any:
        """The first number of the state, scaled."""
        return (self.gain * arguments[0][0],)

    def measure(self, *arguments: Any) -> Any:
        """The same."""
        return self(*arguments)


def scaled_by(gain: float, state: Any, reference: Any, parameters: Any) -> Any:
    return (gain * state[0],)


def typed(name: str) -> Callable[..., Any]:
    """A function without a source, as from a prompt; or with one in memory, as in a notebook."""
    text = "def measure(state, about, parameters):\n    return (2.0 * state[0],)\n"
    if name != "<stdin>":
        linecache.cache[name] = len(text), None, text.splitlines(keepends=True), name
    scope: dict[str, Any] = {}
    exec(compile(text, name, "exec"), scope)
    return scope["measure"]


KINDS: dict[str, Callable[..., Any]] = {
    "a lambda": lambda state, *_: (2.0 * state[0],),
    "typed": typed("<stdin>"),
    "in a notebook": typed("<ipython-input-1-abc>"),
    "partial": partial(scaled_by, 2.0),
    "an object": Scaled(2.0),
    "a method": Scaled(2.0).measure,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:.*the noise is not additive")  # which is that of a step
def test_any_callable_is_a_models_function(kind: str):
    model = replace(SCALAR, sensors=(replace(VALUE, measure=KINDS[kind]),))
    check_model(model)
    found = outputs(model, "ekf", [source([1.0, 2.0])])["state"]
    expected = outputs(measuring(lambda x: 2.0 * x), "ekf", [source([1.0, 2.0])])["state"]
    for column in ("mean", "covariance"):
        assert_array_equal(found[column], expected[column])


def test_a_callable_without_a_code_of_its_own_is_told_by_its_place():
    class Wrong(Scaled):
        def __call__(self, *arguments: Any) -> Any:
            return (math.sin(arguments[0][0]),)

    for function in (Wrong(1.0), partial(Wrong(1.0)), Wrong(1.0).__call__):
        with pytest.raises(BadInput, match=r"^\w+ \(test_functions\.py, line \d+\): it uses math"):
            traced(function, 1, 0, ())


# --- nothing stale -----------------------------------------------------------------------------------

GAIN = 2.0


def by_a_global(x: Any) -> Any:
    return GAIN * x


def test_a_constant_that_changes_between_two_replays_is_traced_anew(monkeypatch: pytest.MonkeyPatch):
    """A global, a closure's, an object's: not the number that it was when a model was first used."""
    scaled, kept = Scaled(2.0), {"gain": 2.0}
    for function in (by_a_global, lambda x: kept["gain"] * x, lambda x: scaled.gain * x):
        model, found = measuring(function), []
        for gain in (2.0, 3.0):
            monkeypatch.setitem(globals(), "GAIN", gain)
            scaled.gain = kept["gain"] = gain
            found.append(outputs(model, "ekf", [source([1.0, 2.0])])["state"]["mean"])
        expected = outputs(measuring(lambda x: 3.0 * x), "ekf", [source([1.0, 2.0])])["state"]
        assert_array_equal(found[1], expected["mean"])
        assert (found[0] != found[1]).any()


def test_what_has_not_changed_is_the_same_object_again(monkeypatch: pytest.MonkeyPatch):
    """So that nothing is put together twice."""
    first = traced(by_a_global, None)
    assert traced(by_a_global, None) is first
    monkeypatch.setitem(globals(), "GAIN", 3.0)
    second = traced(by_a_global, None)
    assert second is not first
    assert traced(by_a_global, None) is second
    assert traced(first, None) is first
    assert traced(None, None) is None


def test_functions_of_one_name_are_two_in_a_kernel():
    functions = tuple(TracedFunction(lambda given, k=k: (given[0] + k,), (1,)) for k in range(3))
    out = np.zeros((1, 3, 1))
    compile_over_runs(over_points(functions, 1))(1, np.array([[0.5]]), out)
    assert out.ravel().tolist() == [0.5, 1.5, 2.5]


def test_parameters_are_unpacked_in_the_order_in_which_they_stand():
    """As those of the NamedTuple are that a function gets where it is not traced."""

    def scaled(given: Any, parameters: Any) -> Any:
        offset, gain = parameters
        return (gain * given[0] + offset,)

    values = namedtuple("values", ["offset", "gain"])(7.0, 3.0)
    function = traced(scaled, 1, ("offset", "gain"))
    assert function((2.0,), values) == scaled((2.0,), values) == (13.0,)


def test_of_known_numbers_where_is_a_choice():
    assert (where(True, 1.0, 2.0), where(False, 1.0, 2.0)) == (1.0, 2.0)


def test_a_graph_holds_just_as_many_nodes_as_it_says(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("fuselog.replay.tracing.graph.MOST_NODES", 3)
    graph = Graph()
    for value in (1.0, 2.0, 3.0, 2.0):  # the last is known
        graph.constant(value)
    with pytest.raises(BadInput, match="more than 3 operations"):
        graph.constant(4.0)


def test_what_numpy_answers_with_yes_or_no_is_a_truth_and_nothing_else():
    """As a truth it is a condition, has no slope, and is an int in C."""
    graph = Graph()
    operations = {**{each: each for each in PRIMITIVES}, **_OPERATORS}
    for function, operation in operations.items():
        count = getattr(function, "nin", 1)
        given = [operation in _LOGICAL or 0.5] * count
        node = graph.apply(operation, *(graph.input(k) for k in range(count)))
        with np.errstate(all="ignore"):
            assert node.is_truth == (np.asarray(function(*given)).dtype == bool), function


@pytest.mark.parametrize("exponent", [-6, -5, -1, 1, 2, 3, 4, 7, 13])
def test_a_power_of_a_known_number_is_known(exponent: int):
    graph = Graph()
    assert graph.power(graph.constant(1.5), exponent).value == pytest.approx(1.5**exponent, rel=1e-15)
