"""A traced function is reused only where nothing that it reads can have changed; see `tracing.reads`."""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.model.bound_model import bound_model_of
from fuselog.replay.tracing import functions
from fuselog.replay.tracing.functions import TracedFunction, traced

Function = Callable[[Any], Any]
Change = Callable[[], None]

GAIN, PAIR, LIST, TABLE, ARRAY = 2.0, (2.0, 1.0), [2.0], {"gain": 2.0}, np.array([2.0])
MODULE = ModuleType("tests_own")
OBJECT = SimpleNamespace(gain=2.0)
HERE = sys.modules[__name__]


class Named(NamedTuple):
    """A record with a method."""

    gain: float

    def of(self, x: Any) -> Any:
        """Scaled."""
        return self.gain * x


RECORD = Named(2.0)


def twice(x: Any) -> Any:
    return 2.0 * x


def thrice(x: Any) -> Any:
    return 3.0 * x


def through(x: Any) -> Any:
    return twice(x)


def attributed(x: Any) -> Any:
    return attributed.gain * x  # type: ignore[attr-defined]


def with_default(x: Any, gain: float = 2.0) -> Any:
    return gain * x


def with_keyword(x: Any, *, gain: float = 2.0) -> Any:
    return gain * x


def with_import(x: Any) -> Any:
    from tests.replay.tracing import test_reads

    return test_reads.GAIN * x


def with_names(x: Any) -> Any:
    return twice.__globals__["GAIN"] * x


def enclosed() -> tuple[Function, Change]:
    gain = 2.0

    def function(x: Any) -> Any:
        return gain * x

    def change() -> None:
        nonlocal gain
        gain = 3.0

    return function, change


def counting() -> Function:
    """Another function from its fourth call on: what it keeps is its own."""
    calls = 0

    def function(x: Any) -> Any:
        nonlocal calls
        calls += 1
        return x if calls < 4 else 2.0 * x

    return function


def written(text: str, **names: Any) -> Function:
    """A function with globals of its own."""
    scope = {"np": np, **names}
    exec(f"def function(x):\n    {text}", scope)
    return scope["function"]


def globals_of(function: Function, **names: Any) -> Change:
    assert isinstance(function, FunctionType)
    return partial(function.__globals__.update, names)


def cases() -> Iterator[tuple[str, Function, Change]]:
    """Functions whose gain is 2, and what makes another of it."""
    here = partial(setattr, HERE)
    yield "a global", lambda x: GAIN * x, partial(here, "GAIN", 3.0)
    yield (
        "a global within a function within",
        lambda x: sum(GAIN * y for y in (x,)),
        partial(here, "GAIN", 3.0),
    )
    yield "a tuple", lambda x: PAIR[0] * x, partial(here, "PAIR", (3.0, 1.0))
    yield "a list", lambda x: LIST[0] * x, partial(LIST.__setitem__, 0, 3.0)
    yield (
        "a list in a tuple",
        written("return t[0][0] * x", t=(LIST,)),
        partial(LIST.__setitem__, 0, 3.0),
    )
    yield "a dict", lambda x: TABLE["gain"] * x, partial(TABLE.__setitem__, "gain", 3.0)
    yield "an array", lambda x: ARRAY[0] * x, partial(ARRAY.__setitem__, 0, 3.0)
    yield "an object", lambda x: OBJECT.gain * x, partial(setattr, OBJECT, "gain", 3.0)
    yield "a module", lambda x: MODULE.gain * x, partial(setattr, MODULE, "gain", 3.0)
    aliased = written("m = module\n    return m.gain * x", module=MODULE)
    yield "a module by another name", aliased, partial(setattr, MODULE, "gain", 3.0)
    yield (
        "a function of a module",
        lambda x: MODULE.scaled(x),
        partial(setattr, MODULE, "scaled", thrice),
    )
    yield "a class", lambda x: RECORD.of(x), partial(setattr, Named, "of", lambda _, x: 3.0 * x)
    yield "a helper", through, partial(here, "twice", thrice)
    yield "a helper's code", through, partial(setattr, twice, "__code__", thrice.__code__)
    yield "the code", twice, partial(setattr, twice, "__code__", thrice.__code__)
    yield "a default", with_default, partial(setattr, with_default, "__defaults__", (3.0,))
    yield (
        "a default by keyword",
        with_keyword,
        partial(setattr, with_keyword, "__kwdefaults__", {"gain": 3.0}),
    )
    yield "a default that is a list", lambda x, own=LIST: own[0] * x, partial(LIST.__setitem__, 0, 3.0)
    yield "an attribute of a function", attributed, partial(setattr, attributed, "gain", 3.0)
    yield "what is enclosed", *enclosed()
    yield "an import", with_import, partial(here, "GAIN", 3.0)
    yield "the globals of a function", with_names, partial(here, "GAIN", 3.0)
    by_name = written("return getattr(m, 'gain') * x", m=MODULE)
    yield "getattr", by_name, partial(setattr, MODULE, "gain", 3.0)
    yield "globals()", lambda x: globals()["GAIN"] * x, partial(here, "GAIN", 3.0)
    shadowed = written("return abs(x)")
    yield "a name of Python's", shadowed, globals_of(shadowed, abs=thrice)
    replaced = written("return np.sin(x)")
    yield "a name of NumPy's", replaced, globals_of(replaced, np=SimpleNamespace(sin=thrice))
    yield "a function of NumPy's", written("return np.sin(x)"), partial(setattr, np, "sin", np.cos)
    yield (
        "a function made of Python",
        written("return f(1.0) * x", f=np.frompyfunc(through, 1, 1)),
        partial(here, "twice", thrice),
    )
    yield "a partial", partial(lambda own, x: own[0] * x, LIST), partial(LIST.__setitem__, 0, 3.0)


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the cases change is put back."""
    for name in ("GAIN", "PAIR", "twice"):
        monkeypatch.setattr(HERE, name, getattr(HERE, name))
    for function in (twice, with_default):
        monkeypatch.setattr(function, "__code__", function.__code__)
    monkeypatch.setattr(with_default, "__defaults__", (2.0,))
    monkeypatch.setattr(with_keyword, "__kwdefaults__", {"gain": 2.0})
    monkeypatch.setattr(Named, "of", Named.of)
    monkeypatch.setattr(np, "sin", np.sin)
    monkeypatch.setattr(attributed, "gain", 2.0, raising=False)
    monkeypatch.setattr(MODULE, "gain", 2.0, raising=False)
    monkeypatch.setattr(MODULE, "scaled", twice, raising=False)
    OBJECT.gain = LIST[0] = TABLE["gain"] = ARRAY[0] = 2.0


@pytest.mark.parametrize("name", [name for name, _, _ in cases()])
def test_what_has_changed_is_traced_anew(name: str):
    function, change = next(each for own, *each in cases() if own == name)
    before = traced(function, None)
    assert traced(function, None) is before
    change()
    after = traced(function, None)
    assert after.kernel_identity() == TracedFunction(function, (None,)).kernel_identity()
    assert after.kernel_identity() != before.kernel_identity()


def test_what_changes_itself_is_not_taken_for_the_same():
    function = counting()
    first = traced(function, None)  # which calls it twice
    assert traced(function, None) is first
    assert traced(function, None) is not first


def test_models_are_traced_once(monkeypatch: pytest.MonkeyPatch):
    """All functions of most shipped models: what they read is seen."""
    again = {name for name, model in registered_models().items() if _traces(model, monkeypatch)}
    assert again == {"moving-sights"}  # which uses getattr


def _traces(model: Any, monkeypatch: pytest.MonkeyPatch) -> int:
    """How often functions of a model are called when it is bound again."""
    parts = model, model.motion, model.all_sensors, tuple((model.modes or {}).values())
    first, calls = bound_model_of(*parts), []
    with monkeypatch.context() as patched:
        own = functions.trace
        patched.setattr(functions, "trace", lambda *given: calls.append(given) or own(*given))
        assert bound_model_of(*parts) == first
    return len(calls)
