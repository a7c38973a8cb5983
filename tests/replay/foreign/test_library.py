"""Filters of shared libraries: what they give, and what is said of those that cannot be used."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog import BadInput
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.foreign.naming import Allowed, allowed
from tests.goldens.recipes import RECIPES, first_log
from tests.replay.foreign.conftest import EXAMPLES, MISBEHAVING, Compile

GATE = {"gate_probability": 0.999}


def library(path: Path, **settings: Any) -> dict[str, Any]:
    return {"kind": "lib", "path": Allowed(path), **settings}


@pytest.mark.parametrize(
    ("golden", "in_process"), [("landmarks", False), ("landmarks", True), ("landmarks-adverse", True)]
)
@pytest.mark.paper
def test_our_ekf_by_hand_in_c(compile_filter: Compile, golden: str, in_process: bool) -> None:
    """Estimates, covariances, innovations and NIS are ours on the goldens' logs."""
    own = library(compile_filter(EXAMPLES / "robot_ekf.c"), in_process=in_process, **GATE)
    made = replay_in_memory([first_log(RECIPES[golden], {})], {"ekf": GATE, "c": own})
    for leaf in ("pose", "innovation"):
        ours, theirs = (made[f"/estimates/{label}/robot1/{leaf}"] for label in ("ekf", "c"))
        assert len(ours) > 100
        assert dict(ours.stream.metadata) == dict(theirs.stream.metadata)
        for name, column in ours.stream.columns.items():
            size = np.nanmax(np.abs(column.astype(float)), initial=1.0)
            np.testing.assert_allclose(theirs[name], column, rtol=0, atol=1e-12 * size, err_msg=name)
    assert not len(made["/estimates/c/robot1/failure"])


def test_blocks_and_estimates_between_messages(compile_filter: Compile) -> None:
    """However it is cut into blocks; `--every` gives more; of equal stamps the last counts."""
    path = compile_filter(EXAMPLES / "robot_ekf.c")
    log = fl.record("landmarks", seed=3, duration_s=5.0)
    settings = {label: library(path, in_process=label == "c", every_s=0.03) for label in ("c", "apart")}
    whole = replay_in_memory([log], settings | {"ekf": {"every_s": 0.03, "gate_probability": 1.0}})
    pose = whole["/estimates/c/robot1/pose"]
    np.testing.assert_array_equal(pose["mean"], whole["/estimates/apart/robot1/pose"]["mean"])
    np.testing.assert_allclose(pose["mean"], whole["/estimates/ekf/robot1/pose"]["mean"], atol=1e-12)
    bound = [each for label in settings for each in bind(label, [log], settings[label])]
    cut = collect(replay([log], bound, block_messages=50))
    for label in settings:
        for name, column in pose.stream.columns.items():
            np.testing.assert_array_equal(cut[f"/estimates/{label}/robot1/pose"][name], column)


@pytest.mark.parametrize("late", ["rewind:0.5", "wait:0.1"])
def test_late_messages(compile_filter: Compile, late: str) -> None:
    """It goes back for them as our filter does, says when it knew what, and in order at the end."""
    path = compile_filter(EXAMPLES / "robot_ekf.c")
    slow = {"latency_s": 0.02, "latency_jitter_s": 0.1}
    log = fl.record("landmarks", seed=3, duration_s=5.0, range_bearing=slow)
    given = {
        "c": library(path, in_process=True),
        "apart": library(path),
        "ekf": {"gate_probability": 1.0},
    }
    done = fl.replay(log, allowed(given), arrival_order=True, late=late)
    [made] = done.estimates
    ours = {topic: each for topic, each in made.items() if topic.startswith("/estimates/ekf/")}
    assert len(made["/estimates/ekf/robot1/" + ("rewound" if "rewind" in late else "waited")]) > 40
    for topic, stream in ours.items():
        for label in ("c", "apart"):
            own = made[topic.replace("/ekf/", f"/{label}/")]
            np.testing.assert_array_equal(own.log_time_ns, stream.log_time_ns, err_msg=topic)
            for name, column in stream.columns.items():
                np.testing.assert_allclose(own[name], column, rtol=1e-12, atol=1e-12, err_msg=topic)


def ranges(*values: float) -> MemorySource:
    stamps = np.arange(len(values)) * 1_000_000
    stream = make_stream("/range", schemas.RANGE, stamps, target_id=np.ones(len(values)), range_m=values)
    return memory_source(Recording([stream]), RunMetadata("ranges"))


REFUSED = {
    "is not there": ({}, "no_such.so: no such file"),
    "is no library": ({}, "text.so: cannot be loaded (file too short"),
    "of another version": (
        {"VERSION": 2},
        "was compiled with version 2 of fuselog_filter.h; this fuselog has",
    ),
    "lacks a function": (
        {"WITHOUT_TAKE": 1},
        "lacks the function fuselog_filter_take; it must export all functions of fuselog_filter.h "
        "except fuselog_filter_innovation",
    ),
    "no JSON": ({"DESCRIPTION": '"\\"{nothing"'}, "its description is not valid JSON"),
    "no topics": ({"DESCRIPTION": '"{}"'}, "entry 'description.summary' is missing"),
    "of another log": (
        {"TOPIC": '"/sonar"'},
        "does not fit this log: it needs /sonar; the log has /range",
    ),
    "of another CPU": ({}, "cannot be loaded (it was compiled for another CPU or system); compile it"),
}
"""What a library is, and the sentence on it."""


@pytest.mark.paper
@pytest.mark.parametrize("case", REFUSED)
def test_libraries_that_cannot_be_used(compile_filter: Compile, tmp_path: Path, case: str) -> None:
    defined, sentence = REFUSED[case]
    path = tmp_path / "no_such.so"
    if case == "is no library":
        path = tmp_path / "text.so"
        path.write_text("no library")
    elif case == "of another CPU":
        made = bytearray(compile_filter(MISBEHAVING).read_bytes())
        if not made.startswith(b"\x7fELF"):
            pytest.skip("libraries are no ELF files here")
        made[18:20] = (0xFFFE).to_bytes(2, "little")  # e_machine, a processor that there is not
        path.write_bytes(made)
    elif defined:
        path = compile_filter(MISBEHAVING, case.replace(" ", "-"), **defined)
    with pytest.raises(BadInput) as raised:
        fl.replay(ranges(1.0, 2.0), {"mine": {"kind": "lib", "path": str(path)}})
    assert sentence in str(raised.value)
    assert "\n" not in str(raised.value)


def test_bounds_of_its_parameters(compile_filter: Compile) -> None:
    path = compile_filter(MISBEHAVING)
    for value in (0.0, 11.0):
        with pytest.raises(
            BadInput, match=f"estimator mine: parameter 'sigma_m' is {value}; it should be"
        ):
            fl.replay(
                ranges(1.0), allowed({"mine": {"kind": "lib", "path": str(path), "sigma_m": value}})
            )
    with pytest.raises(BadInput, match="no parameter 'sigma'; did you mean 'sigma_m'"):
        fl.replay(ranges(1.0), allowed({"mine": {"kind": "lib", "path": str(path), "sigma": 1.0}}))
