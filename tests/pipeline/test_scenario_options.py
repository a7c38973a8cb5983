"""Every parameter of every scenario changes what is recorded, or a reason says why it does not.

The bounds that a parameter declares are tried: what lies on them records, what lies beyond is refused.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import build, merge, nested
from fuselog.recorders.recording import Recorder, Recording, Simulator, record_run
from fuselog.recorders.registry import available, load
from tests.goldens import keeping, numbers
from tests.pipeline.moves import bounds_of, moved, settable, switched_on, value_of

SCENARIOS = {
    name: each
    for name in available("recorders")
    if isinstance(each := load("recorders", name, Recorder), Simulator)
}


@dataclass(frozen=True)
class Case:
    """How a scenario is recorded in milliseconds so that nearly all of its parameters count.

    Attributes:
        base: its settings, over those that switch on what by default never happens.
        values: of parameters for which a number beside the base's is not enough.
        under: other settings over the base's, under which a parameter counts.
        nothing: parameters that change nothing here, and why.
        slow: parameters whose bounds take long to record.
    """

    base: Mapping[str, Any] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)
    under: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    nothing: Mapping[str, str] = field(default_factory=dict)
    slow: frozenset[str] = frozenset()


def _without_noise(size: int) -> dict[str, dict[str, Any]]:
    """A diagonal that each of the distributions takes."""
    noises = ("prior", "system", "measurement")
    return {f"{each}.distribution": {each: {"diagonal": [0.0] * size}} for each in noises}


CASES = {
    "acoustic-shots": Case({"shots": 2}),
    "axis": Case({"steps": 5}, {"start": [0.6, 0.8]}, _without_noise(2)),
    "biometric-scores": Case({"users": 40, "low_galleries": 4}, slow=frozenset({"users"})),
    "car": Case({"duration_s": 15.0}, {"rest_s": 2.0}),
    "ispace": Case(
        {"steps": 20},
        {
            "nodes": [{"components": ["x_m"], "sigmas": [0.1]}] * 4,
            "links": [[1, 2], [2, 3]],
            "outages": [{"node": 1, "start_s": 0.5, "end_s": 1.0}],
            "random_chords": 5,
        },
        {"random_chords": {"random_nodes": 8}},
    ),
    "landmarks": Case(
        {"duration_s": 10.0, "robots": 2, "robots_see_each_other": True},
        {"fix.origin_deg": [48.0, 11.0]},
        nothing={
            "range.bias_bearing_rad": "it measures no bearing",
            "bearing.bias_range_m": "it measures no range",
            "relative_bearing.bias_range_m": "it measures no range",
        },
    ),
    "moving-los": Case({"duration_s": 10.0, "weave_m": [100.0, 50.0, 20.0]}),
    "navigation": Case(
        {
            "duration_s": 15.0,
            "rest_s": 1.0,
            "leg_s": 2.0,
            "unit": {"rate_hz": 50.0},
            "gnss": {"floats_s": [[4, 6]], "multipath_s": [[7, 8]], "outages_s": [[9, 10]]},
            "carried": {"wheel_scale_sigma": 0.01},
        },
        {"way_points_m": [[0, 0, 0], [50, 0, 0], [50, 50, 0]]},
    ),
    "optical-los": Case(
        {"passes": 3},
        {
            "nominal_attitude_deg": [[1.0, 2.0, 3.0]] * 3,
            "bias_deg": [[0.1, 0.2, 0.3]] * 3,
            "field_of_view_deg": 20.0,
        },
    ),
    "orientation": Case({"steps": 5}, {"start": [0.0, 0.6, 0.8, 0.0]}, _without_noise(4)),
    "ranging": Case({"duration_s": 20.0, "error_sigma_m": 0.1}),
    "relative-bearings": Case(
        {"scene": "random", "looks": 3},
        under={"paper_pairs": {"scene": "section-v"}},
    ),
    "shot-sequence": Case({"shots": 5}),
    "vehicles": Case(
        {"duration_s": 20.0},
        {"turn_rate_radps": [0.1] * 5},
        {"speed_mps": {"vehicles": 6}},
    ),
}


def base_of(name: str) -> dict[str, Any]:
    """The settings of its case, with all on that by default never happens."""
    return merge(switched_on(SCENARIOS[name].parameters), CASES.get(name, Case()).base)


def recorded(name: str, settings: Mapping[str, Any]) -> Recording:
    """A run of the scenario."""
    return record_run(name, settings, seed=3)[0]


def fingerprint(recording: Recording) -> str:
    """Of all that a log would hold of a run but the parameters that its metadata repeats."""
    digest = hashlib.sha256(repr((recording.epoch_ns, dict(recording.notes))).encode())
    for stream in recording.streams:
        digest.update(repr((stream.topic, sorted(stream.metadata.items()))).encode())
        for column in (stream.publish_time_ns, stream.log_time_ns, *stream.columns.values()):
            digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()


@pytest.mark.paper
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_parameter_changes_what_is_recorded(name: str):
    case, kind, same = CASES.get(name, Case()), SCENARIOS[name].parameters, set()
    usual = base_of(name)
    as_it_is = recorded(name, usual)
    keeping.hold(name, {}, numbers.of_recording(as_it_is), name)
    for each in settable(kind):
        base = merge(usual, case.under.get(each.name, {}))
        if each.name in case.values:
            other = merge(base, nested(each.name, case.values[each.name]))
        else:
            other = moved(kind, base, each)
        found = recorded(name, other)
        value = value_of(other, each.name)
        keeping.hold(name, nested(each.name, value), numbers.of_recording(found), name)
        before = as_it_is if base == usual else recorded(name, base)
        if fingerprint(found) == fingerprint(before):
            same.add(each.name)
    assert same == set(case.nothing)


@pytest.mark.paper
@pytest.mark.parametrize("name", SCENARIOS)
def test_bounds_of_parameters_are_kept(name: str):
    slow, base, kind = CASES.get(name, Case()).slow, base_of(name), SCENARIOS[name].parameters
    for each in settable(kind):
        accepted, refused = bounds_of(each)
        for value in () if each.name in slow else accepted:
            recorded(name, merge(base, nested(each.name, value)))
        for value in refused:
            with pytest.raises(BadInput, match=f"^scenario: parameter '{each.name}' is .*; it should"):
                build(kind, merge(base, nested(each.name, value)), "scenario")


@pytest.mark.parametrize("name", SCENARIOS)
def test_one_entry_more_is_refused_or_recorded(name: str):
    """What has too many entries would be taken for something that was meant."""
    base, kind, ignored = base_of(name), SCENARIOS[name].parameters, []
    values = build(kind, base, "base").model_dump()
    for each in settable(kind):
        value = value_of(values, each.name)
        if isinstance(value, list | tuple) and value and isinstance(value[0], float):
            longer = merge(base, nested(each.name, [*value, value[-1]]))
            try:
                if fingerprint(recorded(name, longer)) == fingerprint(recorded(name, base)):
                    ignored.append(each.name)
            except BadInput:
                continue
    assert not ignored
