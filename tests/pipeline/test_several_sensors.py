"""Several sensors of a kind: each topic has its own parameters, by the same names in every command."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.altering.changes import changes_of, is_parameter
from fuselog.pipeline.deploying.deploying import deploy
from fuselog.pipeline.exploring.session import Session
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log.streams import empty_stream
from fuselog.recorders.parameters import parse_settings
from fuselog.replay.engine import chi2
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.model.own_parameters import read_by
from fuselog.replay.inference.run import events
from fuselog.replay.tracing import functions

pytestmark = pytest.mark.usefixtures("blank_figures")

FIXES, COMPASSES = ("/gps1/fix", "/gps2/fix"), ("/compass1/heading", "/compass2/heading")
LEVERS = {
    "/gps1/fix.lever_x_m": 0.5,
    "/gps1/fix.lever_y_m": 0.2,
    "/gps2/fix.lever_x_m": -0.5,
    "/gps2/fix.lever_y_m": 0.2,
}
OFFSETS = {"/compass1/heading.bias_heading_rad": 0.3, "/compass2/heading.bias_heading_rad": -0.2}
TAKEN = {"topics": {"fix": ",".join(FIXES), "heading": list(COMPASSES)}}
SIGMA_M, SIGMA_RAD = 0.05, 0.03
OPEN = {"gate_probability": 1.0}


@pytest.fixture(scope="module")
def drive() -> fl.MemorySource:
    return driven(1)


def driven(seed: int) -> fl.MemorySource:
    """A robot with two receivers 1 m apart, and two compasses that are mounted turned."""
    run, rng = fl.record("landmarks", seed=seed, duration_s=120.0), np.random.default_rng(seed)
    truth = run["/robot1/truth"]
    streams = [run[f"/robot1/{name}"] for name in ("truth", "odometry", "prior")]
    x, y, heading = truth["state"].T
    for number, topic in enumerate(FIXES, start=1):
        ahead, left = (LEVERS[f"{topic}.lever_{axis}_m"] for axis in "xy")
        cosine, sine, rows = np.cos(heading), np.sin(heading), np.arange(6 * number, len(x), 12)
        place = np.stack([x + ahead * cosine - left * sine, y + ahead * sine + left * cosine], axis=1)
        streams.append(
            fl.make_stream(
                topic,
                fl.schemas.POSITION_FIX,
                truth.publish_time_ns[rows],
                position_m=place[rows] + rng.normal(0.0, SIGMA_M, (len(rows), 2)),
                covariance_m2=np.tile(SIGMA_M**2 * np.eye(2).ravel(), (len(rows), 1)),
            )
        )
    for number, (topic, offset) in enumerate(zip(COMPASSES, OFFSETS.values(), strict=True), start=1):
        rows = np.arange(6 * number - 3, len(x), 12)
        half = 0.5 * (heading[rows] + offset + rng.normal(0.0, SIGMA_RAD, len(rows)))
        zero = np.zeros(len(rows))
        streams.append(
            fl.make_stream(
                topic,
                fl.schemas.ORIENTATION,
                truth.publish_time_ns[rows],
                metadata={"covariance_rad2": ",".join(map(str, SIGMA_RAD**2 * np.eye(3).ravel()))},
                quaternion=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
            )
        )
    return fl.MemorySource({each.topic: each for each in streams}, run.run, "drive")


def nis_of(source: fl.MemorySource, topic: str, innovations: Any) -> tuple[float, int]:
    """Mean NIS of a topic's innovations, which have stamps of their own, and how many there are."""
    nis = innovations.loc[innovations["time_ns"].isin(source.streams[topic].publish_time_ns), "nis"]
    return float(nis.mean()), len(nis)


def test_each_topic_has_its_own_parameters(drive: fl.MemorySource) -> None:
    """Two lever arms and two offsets: NIS of all four topics is within its interval, and only then."""
    found = fl.replay(drive, "ekf", set={**TAKEN, **OPEN, **LEVERS, **OFFSETS}).innovations
    for topics, size in ((FIXES, 2), (COMPASSES, 1)):
        for topic in topics:
            mean, count = nis_of(drive, topic, found)
            low, high = np.asarray(chi2.ppf(np.array([0.005, 0.995]), size * count)) / count
            assert low < mean < high, topic
    every = [f"{kind}ekf" for kind in ("", "smoother:", "sqrt:")]  # of which some have parameters apart
    table = fl.replay(drive, every, set={**TAKEN, **OPEN, **LEVERS, **OFFSETS}).metrics
    likelihoods = table.query("quantity == 'log_likelihood'")["value"].to_numpy()
    np.testing.assert_allclose(likelihoods, likelihoods[0], rtol=1e-9)
    assert len(likelihoods) == len(every)
    one = {**TAKEN, **OPEN, **OFFSETS, "lever_x_m": 0.5, "lever_y_m": 0.2}  # of all that have no own
    found = fl.replay(drive, "ekf", set=one).innovations
    assert nis_of(drive, "/gps2/fix", found)[0] > 20.0
    same = {**one, "/gps2/fix.lever_x_m": -0.5}
    found = fl.replay(drive, "ekf", set=same).innovations
    assert nis_of(drive, "/gps2/fix", found)[0] < 3.0


def test_other_values_are_replayed_with_the_same_trace_and_tables(
    drive: fl.MemorySource, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `tune` replays a log hundreds of times; a sigma of fixes that state none is in the tables."""
    fix = drive.streams[FIXES[0]]
    unstated = replace(fix, columns={**fix.columns, "covariance_m2": np.full((len(fix), 4), np.nan)})
    source = replace(drive, streams={**drive.streams, FIXES[0]: unstated})
    moved, unsure = {f"{FIXES[1]}.lever_x_m": 0.5}, {"sigma_fix_m": 1.0}

    def end(ensemble: Ensemble[fl.MemorySource], values: dict[str, float]) -> list[float]:
        settings = {"topics": {"fix": list(FIXES)}, "sigma_fix_m": 0.1, **OPEN, **values}
        outputs = collect(replay(ensemble, bind("ekf", ensemble, settings)))
        last: list[float] = outputs["/estimates/ekf/robot1/pose"]["mean"][-1].tolist()
        return last

    expected = [end(Ensemble([source]), values) for values in ({}, moved, unsure)]
    assert len({*map(tuple, expected)}) == 3
    ensemble = Ensemble([source])
    assert [end(ensemble, values) for values in ({}, unsure)] == [expected[0], expected[2]]
    monkeypatch.setattr(functions, "trace", None)
    monkeypatch.setattr(events, "filter_events", None)
    assert [end(ensemble, values) for values in (moved, {})] == [expected[1], expected[0]]


@pytest.mark.paper
def test_lever_arms_and_offsets_are_found(drive: fl.MemorySource) -> None:
    """By `calibrate`, each with an interval that holds the true value; none that nothing reads here.

    The first minute of the drive.
    """
    planted = {**LEVERS, **OFFSETS}
    end_ns = drive.extent("publish_time")[0] + 60_000_000_000
    minute = {
        topic: stream.take(stream.publish_time_ns < end_ns) for topic, stream in drive.streams.items()
    }
    drive = replace(drive, streams=minute)
    fixed = [
        "forward_scale",
        "turn_scale",
        "turn_bias_radps",
        *(f"{each}.fix_delay_s" for each in FIXES),
    ]
    found = fl.calibrate(drive, "ekf", set=TAKEN, fixed=fixed).parameters.set_index("parameter")
    assert {*found.index} == planted.keys()
    for name, true in planted.items():
        assert found.loc[name, "low"] < true < found.loc[name, "high"], found


def test_offsets_become_part_of_the_state(drive: fl.MemorySource) -> None:
    names = list(OFFSETS)
    sigmas = {"estimate": names, "estimate_sigma": dict.fromkeys(names, 0.5)}
    replay = fl.replay(drive, "ekf", set={**TAKEN, **LEVERS, **sigmas})
    [pose] = [log[topic] for log in replay.estimates for topic in log if topic.endswith("/pose")]
    assert pose.components[3:] == [
        "compass1_heading_bias_heading_rad",
        "compass2_heading_bias_heading_rad",
    ]
    sigma = np.sqrt(np.diag(pose["covariance"][-1].reshape(5, 5)))[3:]
    error = pose["mean"][-1, 3:] - list(OFFSETS.values())
    assert np.all(np.abs(error) < 2.6 * sigma)
    assert np.all(sigma < 0.005)


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_what_is_wrong_is_named_by_its_topic(drive: fl.MemorySource) -> None:
    """The advice is the topic's own parameter, and can be set as it stands."""
    wrong = {**TAKEN, **LEVERS, **OFFSETS, "/gps2/fix.lever_x_m": 0.0}
    told = fl.diagnose(drive, "ekf", set=wrong).sentences[0]
    advised = parse_settings(told.setting.split())
    assert advised == {
        "/gps2/fix.lever_x_m": pytest.approx(-0.5, abs=0.03),
        "/gps2/fix.lever_y_m": pytest.approx(0.2, abs=0.03),
    }
    session = Session(drive, {"ekf": {**TAKEN, **LEVERS, **OFFSETS}})
    own = {slider.name: slider.default for slider in session.sliders}
    assert own["/gps1/fix.lever_x_m"] == 0.5
    assert own["/gps2/fix.lever_x_m"] == -0.5
    right, worse = (session.play("ekf", values) for values in ({}, {"/gps2/fix.lever_x_m": 0.0}))
    assert right.cases["robot1"].log_likelihood > worse.cases["robot1"].log_likelihood + 100.0


def test_commands_and_c_have_the_same_names(
    fuselog: Callable[..., Any], drive: fl.MemorySource, tmp_path: Path
) -> None:
    """--set on the command line, a result, and the parameters of the deployed filter."""
    log = tmp_path / "drive.mcap"
    fl.write(log, list(drive.streams.values()))
    given = [each for key, value in LEVERS.items() for each in ("--set", f"{key}={value}")]
    taken = ["--set", f"topics.fix={','.join(FIXES)}", "--set", "topics.heading="]
    done = fuselog(
        "replay", log, "-e", "ekf", *taken, *given, "-o", tmp_path / "estimates.mcap", "--json"
    )
    settings = {"topics": {"fix": list(FIXES), "heading": ""}, **LEVERS}
    metrics = fl.replay(drive, "ekf", set=settings).metrics.set_index("quantity")["value"]
    assert done.json["metrics"]["ekf.log_likelihood.robot1"] == pytest.approx(metrics["log_likelihood"])
    stated = fl.replay(drive, "ekf", set=settings).done.parameters["ekf"]
    assert stated["/gps2/fix"] == {"fix_delay_s": 0.0, "lever_x_m": -0.5, "lever_y_m": 0.2}
    notes = fl.open(tmp_path / "estimates.mcap").run.notes
    stated = json.loads(notes["estimators"])["ekf"]
    assert stated["/gps2/fix"] == {"lever_x_m": -0.5, "lever_y_m": 0.2}
    assert "alterations" not in notes
    deploy(log, {"ekf": settings}, tmp_path / "c")
    header = next((tmp_path / "c").glob("[!f]*.h")).read_text()
    assert "gps2_fix_lever_x_m; /* position of the antenna" in header
    assert "_update_gps1_fix(" in header


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        (
            {"/gps2/fix.lever_z_m": 1.0},
            "/gps2/fix.lever_z_m: its sensor has no such parameter; did you",
        ),
        (
            {"/gps3/fix.lever_x_m": 1.0},
            "parameters are set for /gps3/fix, but no sensor uses this topic; did you",
        ),
        ({"/gps2/fix.lever_x_m": "far"}, "parameter '/gps2/fix.lever_x_m' is 'far'"),
        ({"/gps2/fix.sigma_fix_m": -1.0}, "/gps2/fix: parameter 'sigma_fix_m' is -1.0"),
        (
            {"topics": {"fix": "/gps1/fix,/gps3/fix"}},
            "topics.fix = /gps3/fix: the log has no such topic",
        ),
        ({"topics": {"fix": "/gps1/fix,/compass1/heading"}}, "no such topic that can serve as fix"),
    ],
)
def test_what_makes_no_sense_is_refused(
    drive: fl.MemorySource, setting: dict[str, Any], said: str
) -> None:
    with pytest.raises(BadInput, match=said.replace(".", r"\.")):
        fl.replay(drive, "ekf", set={**TAKEN, **setting})


def test_no_name_is_a_parameter_and_an_alteration() -> None:
    """What a sensor reads cannot be done to the messages of its topic, so that a key means one thing."""
    for name, model in registered_models().items():
        for sensor in model.all_sensors:
            stream = empty_stream("/topic", sensor.schema, {})
            source = fl.MemorySource({"/topic": stream}, fl.RunMetadata("made"), "made")
            for parameter in read_by(model, sensor):
                key = f"/topic.{parameter}"
                assert is_parameter(key), (name, key)
                with pytest.raises(BadInput):
                    changes_of(source, {key: 1.0})


def test_topics_whose_names_differ_in_their_marks_alone_are_refused(drive: fl.MemorySource) -> None:
    """In C and as components of the state, their parameters would have one name."""
    alike = {"/a/b_c": drive.streams["/gps1/fix"], "/a_b/c": drive.streams["/gps2/fix"]}
    streams = {topic: replace(stream, topic=topic) for topic, stream in alike.items()}
    source = replace(drive, streams={**drive.streams, **streams})
    with pytest.raises(BadInput, match="would have the same names; rename one of the topics"):
        fl.replay(source, "ekf", set={"topics": {"fix": list(alike), "heading": ""}})
