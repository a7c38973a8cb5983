"""Recordings as a user meets them: imported by the mapping that ships, replayed as the messages say."""

import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.diagnosing import diagnosis
from fuselog.pipeline.diagnosing.causes import Sought
from fuselog.recorders.checks.lint import compared

CORRECTIONS = 2


@pytest.mark.paper
@pytest.mark.parametrize(
    ("mapping", "folder"),
    [
        ("quadrotor", "quad_mimu/path_1"),
        ("walk", "gnss_imu_rtk/walk_0827"),
        ("uwb-lias", "uwb_lias"),
        ("uwb-outdoor", "uwb_outdoor/LOS/Trajectory_A/Case_1"),
    ],
)
def test_each_message_leads_on_to_a_run_that_works(
    fuselog: Callable[..., Any], navigation: Path, tmp_path: Path, mapping: str, folder: str
) -> None:
    """The options that a message of `replay` names are all that is added, at most twice."""
    log, options = tmp_path / "own.mcap", []
    place = str(navigation / folder)
    assert fuselog("import", "table", place, "--mapping", mapping, "-o", str(log)).code == 0
    for _ in range(CORRECTIONS):
        said = fuselog("replay", str(log), "-e", "ekf", "-o", str(tmp_path / "e.mcap"), *options)
        if said.code == 0:
            break
        assert said.code == 2
        named = re.findall(r"--(?:set|model) [\w.-]+(?:=[^\s,]+)?", said.err)
        assert named, said.err
        alternatives = named[:1] if "--model" in named[0] else named
        options += [word for each in alternatives for word in shlex.split(each)]
    else:
        said = fuselog("replay", str(log), "-e", "ekf", "-o", str(tmp_path / "e.mcap"), *options)
    assert said.code == 0, said.err


# What is planted into the walk, and the setting that is to undo it.
PLANTED = {
    "nothing": ({}, []),
    "turn rate's sign": ({"/inertial.turn_rate_scale": -1}, ["/inertial.turn_rate_z_scale=-1"]),
    "degrees": ({"/inertial.turn_rate_scale": 57.29578}, ["/inertial.turn_rate_scale=0.01745"]),
    "velocity x 3.6": ({"/velocity.velocity_scale": 3.6}, ["/velocity.velocity_scale=0.2778"]),
    "18 s, fixes": ({"/fix.delay_s": -18}, ["/fix.delay_s=18.0"]),
    "18 s, velocities": ({"/velocity.delay_s": -18}, ["/velocity.delay_s=18.0"]),
    "18 s, unit": ({"/inertial.delay_s": -18}, ["/inertial.delay_s=18.0"]),
}


@pytest.mark.paper
def test_what_is_planted_into_a_walk_is_found_without_a_filter(navigation: Path) -> None:
    """Where the course is not the heading, its lag of .58 s is no delay."""
    walk = fl.import_("table", navigation / "gnss_imu_rtk" / "walk_0827", mapping="walk")
    topics = ["/fix", "/velocity", "/inertial"]
    for planted, wanted in PLANTED.values():
        assert [each.setting for each in compared(alter(walk, planted).read(topics))] == wanted


@pytest.mark.paper
def test_a_walk_that_no_filter_follows_is_diagnosed(
    navigation: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fault that the log says itself stands first; what else there is, is sought without it."""
    sought = list[fl.MemorySource]()

    def seek(source: fl.MemorySource, *_: Any) -> Sought:
        sought.append(source)
        return Sought()

    monkeypatch.setattr(diagnosis, "seek", seek)
    walk = fl.import_("table", navigation / "gnss_imu_rtk" / "walk_0827", mapping="walk")
    for name, words in (
        ("degrees", "^/inertial: turn_rate_radps is in deg/s"),
        ("18 s, fixes", "^/fix: its stamps are 18 s late"),
    ):
        planted, [setting] = PLANTED[name]
        found = fl.diagnose(walk, "ekf", set=planted)
        assert found.sentences[0].setting == setting
        assert re.search(words, found.sentences[0].sentence)
        assert found.replay.failures == []
        assert found.notes[0].startswith("all other findings are about the log with --set /")
    for mended in sought:
        assert mended.streams["/fix"].publish_time_ns[0] == walk.streams["/fix"].publish_time_ns[0]
        rates, right = (each.streams["/inertial"]["turn_rate_radps"] for each in (mended, walk))
        assert np.allclose(rates[:1000], right[:1000], rtol=1e-3)
    assert len(sought) == 2


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_what_is_planted_into_a_walk_is_named_first(navigation: Path) -> None:
    """And nothing of a walk as it is, whose receiver's covariances fit one solution, not the other.

    Seconds from 12 on, with every sixth or tenth sample of the unit: what is named is that of the whole
    walk.
    """
    whole = fl.import_("table", navigation / "gnss_imu_rtk" / "walk_0827", mapping="walk")
    first_ns = whole.streams["/fix"].publish_time_ns[0]
    first = {}
    for name, end_s, step in (
        ("nothing", 30.0, 6),
        ("turn rate's sign", 22.0, 10),
        ("velocity x 3.6", 22.0, 10),
    ):
        streams = {}
        for topic, stream in whole.streams.items():
            since_s = 1e-9 * (stream.publish_time_ns - first_ns)
            part = stream.take((since_s >= 12.0) & (since_s < end_s))
            streams[topic] = part.take(slice(None, None, step)) if topic == "/inertial" else part
        walk = replace(whole, streams=streams)
        first[name] = fl.diagnose(walk, "ekf", set=PLANTED[name][0]).sentences[0]
    assert first["nothing"].kind == "unnamed"
    assert first["turn rate's sign"].setting == "/inertial.turn_rate_scale=1.0"
    assert "turn_rate_radps has the wrong sign" in first["turn rate's sign"].sentence
    assert re.search(
        r"/velocity: velocity_mps is 3\.[56]\d* times .* too large", first["velocity x 3.6"].sentence
    )


@pytest.mark.paper
def test_the_delay_of_a_receiver_is_found(navigation: Path) -> None:
    """The mapping's own delay is taken back. The velocity is late, so the search starts above zero.

    The first half a minute of the walk.
    """
    walk = fl.import_("table", navigation / "gnss_imu_rtk" / "walk_0827", mapping="walk")
    end_ns = walk.streams["/fix"].publish_time_ns[0] + 30_000_000_000
    part = {
        topic: stream.take(stream.publish_time_ns < end_ns) for topic, stream in walk.streams.items()
    }
    walk = replace(walk, streams=part)
    start = {"/velocity.delay_s": -0.125, "velocity_delay_s": 0.05}
    [found] = fl.tune(walk, "ekf", "velocity_delay_s", set=start).parameters.to_dict("records")
    assert 0.125 <= found["value"] <= 0.15
    assert found["low"] < found["value"] < found["high"] < 0.15


DENSITIES = {
    "force_noise_density": 0.12,
    "gyro_noise_density": 0.002,
    "force_bias_density": 0.02,
    "gyro_bias_density": 1e-4,
}
PLACE = {"origin_latitude_deg": 32.805, "origin_altitude_m": 0.0}


@pytest.mark.paper
@pytest.mark.parametrize(("path", "offset_s"), [(1, -0.75), (3, -0.10)])
def test_the_clock_of_a_unit_is_found_from_zero(navigation: Path, path: int, offset_s: float) -> None:
    """By the true positions; 2 s at both ends are left out, that all delays explain the same ones."""
    log = fl.import_("table", navigation / "quad_mimu" / f"path_{path}", mapping="quadrotor", seed=1)
    truth = log.streams["/truth"]
    stamps_ns = truth.publish_time_ns
    inside = (stamps_ns > stamps_ns[0] + 2e9) & (stamps_ns < stamps_ns[-1] - 2e9)
    fix = fl.make_stream(
        "/fix",
        fl.schemas.POSITION_FIX,
        stamps_ns[inside],
        metadata=log.streams["/fix"].metadata,
        position_m=truth["state"][inside, :3],
        covariance_m2=np.tile(0.25 * np.eye(3).ravel(), (int(inside.sum()), 1)),
    )
    given = {"topics": {"inertial": "/imu1/inertial"}, **DENSITIES, **PLACE}
    log = replace(log, streams={**log.streams, "/fix": fix})
    found = fl.tune(log, "ekf", "inertial_delay_s", set=given).parameters["value"].iloc[0]
    assert -found == pytest.approx(offset_s, abs=0.075)
