"""Every parameter of every estimator, model and method changes the estimates, or a reason says why not.

Parameters are values at run time, so that all of a model's share one kernel.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameter, Parameters, merge, nested
from fuselog.recorders.recording import record_run
from fuselog.recorders.registry import available
from fuselog.replay.engine.replaying.estimator import configure, find_estimator
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.kalman.methods import MethodParameters
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.pipeline import estimator_cases as cases
from tests.pipeline.estimator_cases import Case, Situation
from tests.pipeline.moves import moved, settable

COMMON = {*ModelParameters.model_fields, *MethodParameters.model_fields}
ELSEWHERE = {
    "analytic": "it has the common options alone",
    "dead-reckoning": "it is the filter of a robot without its sensors",
    "exec": "what a program does with its parameters is its own",
    "lib": "what a library does with its parameters is its own",
    "vehicle-kalman": "it is the filter of a vehicle that drives",
    **dict.fromkeys(("ekf", "iekf"), "they have the common options alone"),
    **dict.fromkeys(
        ("bingham-inertial", "gyro", "madgwick", "mahony", "triad", "vqf"),
        "no scenario has a magnetometer; their tests are of recordings",
    ),
    "report-tracker": "no scenario has reports of ships; its tests are of recordings",
}
MODELS_ELSEWHERE = {"orientation": "no scenario has a magnetometer; its tests are of recordings"}


class Tried(NamedTuple):
    """Parameters of an estimator that are tried together; all of them where none are named."""

    label: str
    case: Case
    names: frozenset[str] | None = None
    model: str = ""


def all_tried() -> Iterator[Tried]:
    """A model's own parameters, those that all have in common, a method's own, or an estimator's."""
    for name in registered_models().keys() - MODELS_ELSEWHERE.keys():
        own = registered_models()[name].parameters.model_fields.keys() - COMMON
        yield Tried(f"model {name}", cases.MODELS[name], frozenset(own), name)
    yield Tried("common", cases.METHODS["common"], frozenset(COMMON))
    for name, case in cases.METHODS.items():
        if name != "common":
            yield Tried(f"method {name}", case, frozenset(own_of(name)))
    for name, case in cases.OWN.items():
        yield Tried(name, case)


def own_of(name: str) -> set[str]:
    """The parameters that a method has beside those that all have, with any variant."""
    return METHODS[name.partition(":")[0]].parameters.model_fields.keys() - COMMON


def parameters_of(tried: Tried) -> tuple[type[Parameters], dict[str, Parameter]]:
    """The type of the parameters, and those of them that are tried."""
    estimator, variant = find_estimator(tried.case.kind)
    by_model = estimator.parameters_by_model(tried.case.kind, variant)
    kind = by_model.get(tried.model) or estimator.parameters_with(tried.case.kind, variant)
    found = {each.name: each for each in settable(kind)}
    if tried.names is not None:
        found = {name: each for name, each in found.items() if name.partition(".")[0] in tried.names}
    return kind, found


TRIED = sorted(all_tried(), key=lambda each: each.label)


@cache
def recorded(scenario: str, settings: str) -> MemorySource:
    return memory_source(*record_run(scenario, json.loads(settings), seed=3))


def fingerprint(situation: Situation, settings: Mapping[str, Any]) -> str:
    """Of all that is estimated."""
    return fingerprint_of(situation.scenario, json.dumps(situation.recorded), json.dumps(settings))


@cache
def fingerprint_of(scenario: str, recorded_as: str, settings: str) -> str:
    """Once for all parameters that are tried against the same usual values."""
    outputs = replay_in_memory([recorded(scenario, recorded_as)], {"tried": json.loads(settings)})
    digest = hashlib.sha256()
    for topic, ragged in outputs.items():
        digest.update(repr((topic, sorted(ragged.stream.metadata.items()))).encode())
        for column in (ragged.stream.publish_time_ns, *ragged.stream.columns.values()):
            digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()


def counts(tried: Tried, kind: type[Parameters], parameter: Parameter) -> bool:
    """Whether another value of a parameter gives other estimates; it does not where it is refused."""
    case, name = tried.case, parameter.name
    situation = case.under.get(name, case.usual)
    base = dict(situation.settings)
    if name in case.values:
        other = merge(base, nested(name, case.values[name]))
    else:
        other = moved(kind, base, parameter)
    chosen = {"kind": case.kind, **({"model": tried.model} if tried.model else {})}
    usual = fingerprint(situation, {**chosen, **base})
    try:
        return fingerprint(situation, {**chosen, **other}) != usual
    except BadInput:
        return False


@pytest.mark.parametrize("tried", TRIED, ids=lambda tried: tried.label)
@pytest.mark.paper
def test_every_parameter_changes_the_estimates(tried: Tried):
    kind, parameters = parameters_of(tried)
    nothing = {name for name, each in parameters.items() if not counts(tried, kind, each)}
    assert nothing == set(tried.case.nothing)
    assert {*tried.case.values, *tried.case.under} <= parameters.keys()


def test_no_estimator_is_left_out():
    methods = {name.partition(":")[0] for name in cases.METHODS}
    assert {*cases.OWN, *methods, *ELSEWHERE} - {"common"} == set(available("estimators"))
    assert {*cases.MODELS, *MODELS_ELSEWHERE} == set(available("models"))


def test_no_parameter_of_a_method_is_left_out():
    """Some count only with a variant, which has a case of its own."""
    found: dict[str, set[str]] = {}
    for tried in TRIED:
        if tried.label.startswith("method "):
            name = tried.label.removeprefix("method ").partition(":")[0]
            found.setdefault(name, set()).update(parameters_of(tried)[1])
    for name, method in METHODS.items():
        assert own_of(name) - {method.variant} <= found.get(name, set())


def test_a_start_without_a_prior_is_of_the_models_own_states_and_parameters():
    starts = {name: model for name, model in registered_models().items() if model.start}
    for name, model in starts.items():
        assert model.start.sigmas.keys() <= model.state.keys(), name
        assert model.start.parameters.keys() <= model.parameters.model_fields.keys(), name
    assert len(starts) > 5


def test_a_name_and_a_setting_that_differ_are_refused():
    """What the name says stood, and the setting did nothing."""
    with pytest.raises(BadInput, match="jipda sets association = jipda, but a setting says nearest;"):
        configure("tracker:jipda", {"association": "nearest"})
    configure("tracker:jipda", {"association": "jipda"})
    configure("particles:50", {"particles": 50})
