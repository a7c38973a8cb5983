"""A filter that tells what it was told: seed, parameters, prior, map and messages, until it fails.

What comes back, of a library in this process or in its own and of a program, is known number by number.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from tests.replay.foreign.conftest import Compile
from tests.replay.foreign.test_programs import program, python

STATE = {f"told{number}_m": "linear" for number in range(9)}
INNOVATION = {"range_m": "linear", "bearing_rad": "angle"}
DESCRIPTION = {
    "summary": "tells what it was told",
    "topics": [
        {"topic": "/marks", "fields": ["landmark_id", "position_m[2]"], "static": True},
        {"topic": "range", "fields": ["range_m"]},
        {"topic": "both", "fields": ["range_m", "bearing_rad", "target_id"], "target": "target_id"},
    ],
    "state": STATE,
    "innovation": INNOVATION,
    "parameters": {"late_s": {"default": 7}, "early_s": {"default": 8}},
    "prior": "prior",
    "failures": ["one", "it was told to fail"],
}
SETTINGS = {"seed": 2**52 - 3, "early_s": 0.25, "late_s": 0.5, "every_s": 1.0}
SECOND = 10**9
SPREAD = np.array([[2.0, 0.5], [0.5, 3.0]])
START_S, END_S = 1.5, 9.75
LATE_NS = 300_000_000


def a_run(run: int, failing: bool) -> MemorySource:
    """A run whose second topic has messages from before its prior to after its failure."""
    rng = np.random.default_rng(run)
    root = rng.normal(size=(9, 9))
    kinds = {"components": ",".join(STATE), "kinds": ",".join(STATE.values())}
    begin_ns = (run + 3) * 1000 * SECOND + SECOND // 8
    at_s = np.array([0.5, 2.0, 3.25, 4.125, 6.0, 7.0, END_S])
    range_m = np.array([1.0, 20.0, 60.0, 95.0, 30.0, 40.0 if not failing else -1.0, 12.5])
    stamps_ns = begin_ns + (at_s * SECOND).astype(np.int64)
    own: dict[str, Any] = {"range_m": range_m, "bearing_rad": 0.125 * np.arange(7) - 0.5}
    streams = [
        make_stream(
            "/marks",
            schemas.LANDMARK,
            [begin_ns] * 2,
            landmark_id=[4, 5],
            position_m=[[1.0, 2.0], [3.0, 6.0 + run]],
        ),
        make_stream(
            "/a/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [begin_ns + int(START_S * SECOND)],
            metadata=kinds,
            mean=[np.arange(9.0) + run],
            covariance=[(root @ root.T).ravel()],
        ),
        make_stream(
            "/a/range",
            schemas.RANGE,
            stamps_ns[1:] - SECOND // 4,
            target_id=np.zeros(6),
            range_m=np.arange(6.0),
        ),
        make_stream("/a/both", schemas.RANGE_BEARING, stamps_ns, target_id=np.arange(7), **own),
    ]
    # what others estimated is no sensor's
    others = [replace(each, topic=f"/estimates/old{each.topic}") for each in streams[1:]]
    return memory_source(Recording([*streams, *others]), RunMetadata("told", epoch_ns=begin_ns))


def expected(source: MemorySource, run: int) -> tuple[list[list[float]], list[list[float]]]:
    """Estimates and innovations up to a failure, each with its stamp in front."""
    prior, both, near = (source.streams[f"/a/{name}"] for name in ("prior", "both", "range"))
    start_ns = int(prior.publish_time_ns[0])
    told = [float(SETTINGS[name]) for name in ("seed", "late_s", "early_s")]
    told += [start_ns, np.arange(1, 10) @ prior["mean"][0], 10.0 * 4.12 + 5.36 + 0.01 * run]
    events = [(each, 2, row) for row, each in enumerate(both.publish_time_ns.tolist())]
    events += [(each, 1, row) for row, each in enumerate(near.publish_time_ns.tolist())]
    known = {each for each, _, _ in events}
    whole_ns = range(-(-start_ns // SECOND) * SECOND, max(known), SECOND)  # multiples of `every_s`
    events += [(each, -1, 0) for each in whole_ns if each not in known]
    estimates, innovations, last = [], [], 0.0
    for stamp_ns, topic, row in sorted(each for each in events if each[0] >= start_ns):
        if topic > 0:
            seen = [float((both if topic == 2 else near)["range_m"][row]), np.nan]
            if seen[0] < 0.0:
                break
            seen[1] = float(both["bearing_rad"][row]) if topic == 2 else np.nan
            last = seen[0] + (100.0 * seen[1] if topic == 2 else 0.0)
            if seen[0] <= 90.0:
                innovations.append([stamp_ns, *seen, row if topic == 2 else 0, seen[0] <= 50.0])
        estimates.append([stamp_ns, *told, topic, stamp_ns, last])
    return estimates, innovations


@pytest.mark.parametrize("way", ["here", "apart", "program"])
def test_what_a_filter_is_told_comes_back(compile_filter: Compile, tmp_path: Path, way: str) -> None:
    """Of two runs, the first of which fails at a message and keeps what was said before it."""
    text = json.dumps({**DESCRIPTION, "protocol": 2})
    if way == "program":
        (tmp_path / "description.json").write_text(text, encoding="utf-8")
        command = python(Path(__file__).with_name("telling.py"), f"'{tmp_path / 'description.json'}'")
        mine = program(command, **SETTINGS)
    else:
        path = compile_filter(Path(__file__).with_name("telling.c"), DESCRIPTION=json.dumps(text))
        mine = {"kind": "lib", "path": str(path), "in_process": way == "here", **SETTINGS}
    sources = [a_run(run, failing=run == 0) for run in range(2)]
    done = fl.replay(sources, {"mine": mine})
    for run, (source, made) in enumerate(zip(sources, done.estimates, strict=True)):
        wanted, innovations = expected(source, run)
        state = made["/estimates/mine/a/state"]
        np.testing.assert_array_equal(state.publish_time_ns, [each[0] for each in wanted])
        np.testing.assert_allclose(state["mean"], np.array(wanted)[:, 1:], rtol=1e-14)
        [covariance] = source.streams["/a/prior"]["covariance"]
        np.testing.assert_array_equal(state["covariance"], np.tile(covariance, (len(wanted), 1)))
        failure = made["/estimates/mine/a/failure"]
        failed_ns = source.streams["/a/both"].publish_time_ns[5]
        assert failure.publish_time_ns.tolist() == [failed_ns] * (run == 0)
        found = made["/estimates/mine/a/innovation"]
        stamps, *values, targets, used = np.array(innovations).T
        np.testing.assert_array_equal(found.publish_time_ns, stamps)
        np.testing.assert_array_equal(found["innovation"], np.transpose(values))
        np.testing.assert_array_equal(found["target_id"], targets)
        np.testing.assert_array_equal(found["accepted"], used)
        for row, seen in enumerate(np.transpose(values)):
            known = np.isfinite(seen)
            spread = np.where(known & known[:, None], SPREAD, np.nan)
            np.testing.assert_array_equal(found["covariance"][row].reshape(2, 2), spread)
            part = SPREAD[known][:, known]
            squared = seen[known] @ np.linalg.solve(part, seen[known])
            likelihood = -0.5 * (squared + np.log(np.linalg.det(2.0 * np.pi * part)))
            assert found["normalised_innovation_squared"][row] == pytest.approx(squared)
            assert found["log_likelihood"][row] == pytest.approx(likelihood * used[row])
    assert [each for each in done.failures if "told to fail" in each] == done.failures
    assert len(done.failures) == 1


@pytest.mark.parametrize("in_process", [True, False])
def test_a_filter_goes_back_until_it_fails(compile_filter: Compile, in_process: bool) -> None:
    """Ranges reach the log after what was measured behind them, which the filter is told again then."""
    text = json.dumps({**DESCRIPTION, "protocol": 2})
    path = compile_filter(Path(__file__).with_name("telling.c"), DESCRIPTION=json.dumps(text))
    mine = {"kind": "lib", "path": str(path), "in_process": in_process, **SETTINGS, "every_s": None}
    sources = []
    for source in (a_run(run, failing=run == 0) for run in range(2)):
        near = source.streams["/a/range"]
        late = replace(near, log_time_ns=near.publish_time_ns + LATE_NS)
        sources.append(replace(source, streams={**source.streams, "/a/range": late}))
    done = fl.replay(sources, {"mine": mine}, arrival_order=True, late="rewind:1")
    for run, (source, made) in enumerate(zip(sources, done.estimates, strict=True)):
        estimates, innovations = expected(source, run)
        wanted = [each for each in estimates if each[7] == 2 for _ in range(2)]
        state = made["/estimates/mine/a/state"]
        np.testing.assert_array_equal(state.publish_time_ns, [each[0] for each in wanted])
        np.testing.assert_allclose(state["mean"], np.array(wanted)[:, 1:], rtol=1e-14)
        known_ns = state.log_time_ns - state.publish_time_ns
        np.testing.assert_array_equal(known_ns, [0, LATE_NS - SECOND // 4] * (len(wanted) // 2))
        failure = made["/estimates/mine/a/failure"]
        failed_ns = source.streams["/a/both"].publish_time_ns[5]
        assert failure.publish_time_ns.tolist() == [failed_ns] * (run == 0)
        found = made["/estimates/mine/a/innovation"]
        told = sorted(zip(found.publish_time_ns.tolist(), found["innovation"][:, 0], strict=True))
        before = [(each[0], each[1]) for each in innovations]  # the last range comes after the failure
        assert told == before[: len(before) - (run == 0)]
