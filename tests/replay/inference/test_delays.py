"""What a log's stamps do not say: measurements that were older, gates that have to open again."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import Recursive
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.replay.inference.replays import bound, outputs

pytestmark = pytest.mark.usefixtures("uncompiled")

EPOCH_NS = 10**9
STATE = {"x_m": "linear", "vx_mps": "linear"}


class TrolleyParameters(ModelParameters):
    """A trolley that an accelerometer drives; its antenna is in front by so many m per m/s2."""

    fix_delay_s: float = 0.0
    unit_delay_s: float = 0.0
    give_s2: float = 0.0
    unit_gap_s: float = 1.0


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    half = 0.5 * duration_s * control[0]
    return state[0] + duration_s * (state[1] + half), state[1] + duration_s * control[0]


def move_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return 0.0, 0.01 * duration_s


def see(state: Any, control: Any, parameters: Any) -> Any:
    return (state[0] + parameters.give_s2 * control[0],)


def see_noise(parameters: Any) -> Any:
    return (0.01,)


UNIT = Control(
    "unit",
    schemas.VECTOR_MEASUREMENT,
    ("ax_mps2",),
    lambda stream: stream["value"],
    interpolated=True,
    gap="unit_gap_s",
    delay="unit_delay_s",
)
TROLLEY = Model(
    "a trolley on a rail",
    STATE,
    TrolleyParameters,
    (
        Sensor(
            "fix",
            schemas.VECTOR_MEASUREMENT,
            {"x_m": "linear"},
            see,
            see_noise,
            read=lambda stream: stream["value"],
            delay="fix_delay_s",
            control=UNIT,
        ),
    ),
    Motion(move, move_noise),
    control=UNIT,
)


def trolley(
    fix_late_s: float = 0.0,
    unit_late_s: float = 0.0,
    jump_s: float = np.inf,
    give_s2: float = 0.0,
    silent_s: tuple[float, float] = (np.inf, np.inf),
) -> MemorySource:
    """Five seconds of it: late stamps, a jump of a kilometre at a time, a unit that is silent."""
    unit_s, fix_s = np.arange(0.0, 5.0, 0.1), np.arange(0.25, 4.8, 0.25)
    unit_s = unit_s[(unit_s <= silent_s[0]) | (unit_s >= silent_s[1])]
    push, place = np.sin(unit_s), fix_s - np.sin(fix_s) + 1000.0 * (fix_s > jump_s)

    def vectors(topic: str, times_s: Any, values: Any) -> Any:
        stamps_ns = EPOCH_NS + np.rint(1e9 * times_s).astype(np.int64)
        return make_stream(topic, schemas.VECTOR_MEASUREMENT, stamps_ns, value=values[:, None])

    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata={"components": ",".join(STATE), "kinds": ",".join(STATE.values())},
        mean=[[0.0, 0.0]],
        covariance=[[0.01, 0.0, 0.0, 0.01]],
    )
    moved = give_s2 * np.interp(fix_s, unit_s, push)
    fixes = vectors("/fix", fix_s + fix_late_s, place + moved)
    streams = [prior, vectors("/unit", unit_s + unit_late_s, push), fixes]
    run = RunMetadata(scenario="trolley", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run)


@pytest.mark.parametrize("block_messages", [1 << 18, 7, 1])
def test_a_stated_delay_is_as_if_stamps_were_those_of_the_measurement(block_messages: int):
    right = outputs(TROLLEY, "ekf", [trolley()])
    late = trolley(fix_late_s=0.32, unit_late_s=0.17)
    delays = {"fix_delay_s": 0.32, "unit_delay_s": 0.17}
    found = outputs(TROLLEY, "ekf", [late], block_messages, **delays)
    for topic in ("state", "innovation"):
        assert_array_equal(found[topic].stream.publish_time_ns, right[topic].stream.publish_time_ns)
        for column in right[topic].stream.schema:
            assert_array_equal(found[topic][column.name], right[topic][column.name])
    exact, ignored = (
        np.abs(each["innovation"]["innovation"]).max()
        for each in (right, outputs(TROLLEY, "ekf", [late]))
    )
    assert ignored > 10 * exact


def test_delays_serve_smoothers_and_refuse_to_rewind():
    right = outputs(TROLLEY, "smoother", [trolley()], 7)["state"]
    found = outputs(TROLLEY, "smoother", [trolley(fix_late_s=0.32)], 7, fix_delay_s=0.32)["state"]
    assert_array_equal(found["mean"], right["mean"])
    sensor = replace(TROLLEY.sensors[0], control=None, measure=lambda state, *_: (state[0],))
    held = replace(TROLLEY, control=replace(UNIT, interpolated=False), sensors=(sensor,))
    [given] = bound(held, "ekf", [trolley()])
    assert isinstance(given, Recursive)
    assert given.out_of_sequence is not None
    given.out_of_sequence(10**9)
    [delayed] = bound(held, "ekf", [trolley()], fix_delay_s=0.1)
    assert isinstance(delayed, Recursive)
    assert delayed.out_of_sequence is not None
    with pytest.raises(BadInput, match=r"moved to their times of measurement.*--late wait"):
        delayed.out_of_sequence(10**9)


def test_a_sensor_may_read_what_the_control_says_at_its_stamp():
    found = outputs(TROLLEY, "ekf", [trolley(give_s2=0.5)], give_s2=0.5)
    assert_allclose(found["innovation"]["innovation"], 0.0, atol=0.01)
    assert (
        np.abs(outputs(TROLLEY, "ekf", [trolley(give_s2=0.5)])["innovation"]["innovation"]).max() > 0.1
    )


def test_a_gate_opens_again_after_a_time():
    """Without that, what would bring the filter back is kept out for ever."""
    log = trolley(jump_s=2.0)
    shut = outputs(TROLLEY, "ekf", [log], gate_probability=0.999)["innovation"]
    assert_array_equal(shut["accepted"] == 0, shut.stream.publish_time_ns > EPOCH_NS + 2 * 10**9)
    opened = outputs(TROLLEY, "ekf", [log], gate_probability=0.999, gate_reopens_s=1.1)["innovation"]
    # the fix at 2 s was let in: those at 2.25 to 3 s are not, and that at 3.25 s is
    rejected = (opened.stream.publish_time_ns - EPOCH_NS)[opened["accepted"] == 0] * 1e-9
    assert rejected[:4] == pytest.approx([2.25, 2.5, 2.75, 3.0])
    assert opened["accepted"][12] == 1


@pytest.mark.parametrize("block_messages", [1 << 18, 5])
@pytest.mark.parametrize("end_s", [3.5, 100.0])
def test_where_the_control_is_silent_for_too_long_all_is_unknown(block_messages: int, end_s: float):
    """In a gap, and where it ends for good."""
    log = trolley(silent_s=(2.0, end_s))
    found = outputs(TROLLEY, "ekf", [log], block_messages)
    last_ns = found["state"].stream.publish_time_ns[-1] - EPOCH_NS
    assert last_ns <= (2.0 if end_s == 3.5 else 3.0) * 1e9
    [failed] = found["failure"].stream["reason"]
    reasons = json.loads(found["failure"].stream.metadata["reasons"])
    assert reasons[failed] == "the control is missing for too long"
    allowed = outputs(TROLLEY, "ekf", [log], block_messages, unit_gap_s=5.0)
    assert len(allowed["failure"].stream) == 0
    assert allowed["state"].stream.publish_time_ns[-1] - EPOCH_NS == 4.75e9


def test_a_sample_that_is_not_finite_is_as_if_it_had_not_come_and_counted():
    whole = trolley()
    streams = whole.read(list(whole.topics))
    value = streams["/unit"]["value"].copy()
    value[[7, 20]] = np.nan
    columns = {**streams["/unit"].columns, "value": value}
    holed = [*(each for each in streams.values() if each.topic != "/unit")]
    holed.append(replace(streams["/unit"], columns=columns))
    run = RunMetadata(scenario="trolley", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    found = outputs(TROLLEY, "ekf", [memory_source(Recording(holed), run)])
    assert len(found["failure"].stream) == 0
    assert np.abs(found["innovation"]["innovation"]).max() < 0.02
    skipped = found["skipped"].stream
    assert len(skipped) == 2
    assert "topic /unit: the control is not finite" in skipped.metadata["reasons"]
