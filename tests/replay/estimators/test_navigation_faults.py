"""What is wrong with a log is said, and a run goes on where it can: gaps, clocks, no numbers."""

import json
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import build
from fuselog.recorders.recording import Recording, record_run
from fuselog.replay.engine.replaying.estimator import find_estimator
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import difference
from fuselog.replay.estimators.navigation.alignment import align
from fuselog.replay.estimators.navigation.navigation import INERTIAL, NavigationParameters
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.test_imm import twins


def drive(change: Any, run: int = 0, **values: Any) -> MemorySource:
    """A simulated drive, each of whose streams `change` may change."""
    recording, metadata = record_run("navigation", {"duration_s": 40.0, **values}, 1, run)
    return memory_source(Recording([change(stream) for stream in recording.streams]), metadata)


def since_s(stream: Stream) -> Any:
    """Seconds since its first message."""
    return (stream.publish_time_ns - stream.publish_time_ns[0]) * 1e-9


def silent(stream: Stream, begin_s: float = 20.0) -> Stream:
    """The inertial unit without its samples for 3 s."""
    if not stream.topic.endswith("/inertial"):
        return stream
    return stream.take(np.flatnonzero((since_s(stream) <= begin_s) | (since_s(stream) >= begin_s + 3.0)))


def spoiled(stream: Stream) -> Stream:
    """The inertial unit with a sample that is no number, and the fixes with one that is none."""
    columns = dict(stream.columns)
    for name, row in (("specific_force_mps2", 1500), ("position_m", 70)):
        if name in columns:
            columns[name] = columns[name].copy()
            columns[name][row] = np.nan
    return replace(stream, columns=columns)


def skipped(found: Any) -> dict[str, int]:
    """How many messages were passed over, by the reason."""
    stream = found["skipped"].stream
    reasons = json.loads(stream.metadata["reasons"])
    names, counts = np.unique(stream["reason"], return_counts=True)
    return {reasons[name]: int(count) for name, count in zip(names, counts, strict=True)}


@pytest.mark.paper
@pytest.mark.parametrize("method", ["ekf", "smoother"])
def test_after_a_gap_of_the_unit_all_but_its_biases_is_found_again(method: str):
    """No estimate in it, the fixes in it are counted, and what is known afterwards is known as before.

    Of six drives the mean NEES, of 15 components, has a standard deviation of 2.2.
    """
    sources = [drive(silent, run) for run in range(6)]
    found = outputs(INERTIAL, method, sources)
    assert len(found["failure"].stream) == 0
    counted = skipped(found)
    assert len(counted) == 2  # fixes and velocities
    for reason, count in counted.items():
        assert "the state is unknown while inertial is missing for longer than inertial_gap_s" in reason
        assert count == pytest.approx(6 * 15, abs=6)
    early, late = [], []
    for run, source in enumerate(sources):
        truth, own = source.read(["/body/truth"])["/body/truth"], found["state"].of_run(run)
        stamp_s = (own.publish_time_ns - truth.publish_time_ns[0]) * 1e-9
        assert not ((stamp_s > 20.01) & (stamp_s < 22.99)).any()
        assert stamp_s[-1] == pytest.approx(40.0)
        row = np.searchsorted(truth.publish_time_ns, own.publish_time_ns)
        error = difference(own["mean"], truth["state"][row], INERTIAL.kinds)
        spread = own["covariance"].reshape(-1, 15, 15)
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(spread), error)
        early.append(nees[(stamp_s > 23.0) & (stamp_s < 25.0)].mean())
        late.append(np.linalg.norm(error[stamp_s > 30.0, :3], axis=1).mean())
    assert np.mean(early) < 22.0
    assert np.mean(late) < 0.5


@pytest.mark.paper
def test_what_is_no_number_is_passed_over_and_counted():
    found = outputs(INERTIAL, "ekf", [drive(spoiled)])
    assert len(found["failure"].stream) == 0
    counted = skipped(found)
    assert counted["topic /body/inertial: the control is not finite"] == 1
    assert sum(count for reason, count in counted.items() if "/body/fix" in reason) == 1
    assert np.isfinite(found["state"]["mean"]).all()


@pytest.mark.parametrize("shift_s", [18, -18, 0])
def test_a_shift_by_leap_seconds_is_told(shift_s: int):
    """The unit's clock against the receiver's; a body rests long enough for both to overlap."""
    recording, _ = record_run("navigation", {"duration_s": 60.0, "rest_s": 25.0}, seed=2)
    streams = {stream.topic.removeprefix("/body/"): stream for stream in recording.streams}
    unit = streams["inertial"]
    moved = {
        **streams,
        "inertial": replace(unit, publish_time_ns=unit.publish_time_ns + shift_s * 10**9),
    }
    how = align(moved, NavigationParameters()).how
    assert ("leap seconds" in how) == (shift_s != 0)
    if shift_s:
        assert f"give inertial_delay_s={shift_s}" in how
        mended = align(moved, NavigationParameters(inertial_delay_s=float(shift_s)))
        assert "leap seconds" not in mended.how


UPSIDE_DOWN = np.array([1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    ("scales", "words"),
    [
        ({"specific_force_mps2": 1 / 9.80665}, "specific force is 1.0.* looks like g"),
        ({"turn_rate_radps": 180 / np.pi}, "turn rate at rest is .* looks like deg/s"),
        (
            {"specific_force_mps2": UPSIDE_DOWN, "turn_rate_radps": UPSIDE_DOWN},
            "points down .* mounting_roll_rad=3.14159",
        ),
        ({}, ""),
    ],
)
def test_wrong_units_and_axes_are_said_of_a_log_with_a_prior_too(scales: dict[str, Any], words: str):
    """On the topic of what was assumed; the run begins at its prior all the same."""
    recording, metadata = record_run("navigation", {"duration_s": 12.0}, 1, 0)
    streams = [
        replace(
            each, columns={name: column * scales.get(name, 1.0) for name, column in each.columns.items()}
        )
        if each.topic.endswith("/inertial")
        else each
        for each in recording.streams
    ]
    source = memory_source(Recording(streams), metadata)
    [filtered] = bound(INERTIAL, "ekf", [source])
    assert filtered.initialization is not None
    first = {name: gather([source[name]]) for name in filtered.initialization.topics}
    told = filtered.initialization.find(first, {}, "publish_time").outputs
    said = [text for ragged in told for text in sentences_of(ragged.stream)]
    if words:
        assert len(said) == 1
        assert re.search(f"topic /body/inertial: .*{words}", said[0])
    else:
        assert said == []


def test_several_units_are_told_apart_before_another_model_is_taken():
    """A prior of the inertial model and no unit of its name: which units there are is said."""
    recording, metadata = record_run("navigation", {"duration_s": 12.0}, 1, 0)
    streams = [
        replace(each, topic=each.topic.replace("/body/inertial", f"/body/imu{number}/inertial"))
        for each in recording.streams
        for number in ((1, 2) if each.topic.endswith("/inertial") else (0,))
    ]
    topics = memory_source(Recording(streams), metadata).topics
    estimator, _ = find_estimator("ekf")
    with pytest.raises(
        BadInput,
        match=r"/body/prior belongs to model inertial, which needs /body/inertial .* the log has "
        r"/body/imu1/inertial, /body/imu2/inertial of that type: .*topics.inertial=/body/imu1/inertial",
    ):
        estimator.bind("ekf", topics, build(estimator.parameters, {}, "test"))


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(("method", "goes_on"), [("bank", True), ("particles", False)])
def test_in_a_gap_a_bank_waits_and_particles_end_with_a_sentence(method: str, goes_on: bool):
    """A bank goes on after it as its filters do; a cloud of particles has no such step, and says so."""
    slow = {"unit": {"rate_hz": 5.0}, "gnss": {"rate_hz": 1.0, "velocity_rate_hz": 1.0}}
    count = {} if goes_on else {"particles": 8}
    source = drive(partial(silent, begin_s=6.0), duration_s=12.0, **slow)
    found = outputs(INERTIAL, method, [source], **count)
    times_s = since_s(found["state"].stream)
    last_s = times_s[-1]
    failures = sentences_of(found["failure"].stream)
    if goes_on:
        assert failures == []
        assert last_s == pytest.approx(12.0)
        assert not ((times_s > 6.01) & (times_s < 8.99)).any()
    else:
        assert failures == ["the control is missing for too long"]
        assert last_s == pytest.approx(6.0)


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
def test_modes_go_on_after_a_gap_of_the_unit_as_one_filter_does():
    """Of three equal modes, which mix while nothing is known, the estimates are those of one."""
    slow = {"unit": {"rate_hz": 5.0}, "gnss": {"rate_hz": 1.0, "velocity_rate_hz": 1.0}}
    source = drive(partial(silent, begin_s=6.0), duration_s=10.5, **slow)
    alone = outputs(INERTIAL, "ekf", [source])
    together = outputs(twins(INERTIAL), "imm", [source])
    assert len(together["failure"].stream) == 0
    assert len(together["skipped"]) == len(alone["skipped"]) > 0
    for field, column in alone["state"].stream.columns.items():
        assert_allclose(together["state"][field], column, rtol=1e-7, atol=1e-9, err_msg=field)
