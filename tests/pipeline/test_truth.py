"""No filter reads the truth that it is judged by, whichever way it is asked to."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog import BadInput, make_stream, schemas
from fuselog.recorders.importers.tables.guessing import guess
from fuselog.recorders.log import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.recorders.registry import load
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from tests.pipeline.test_planes import POSE, STAMPS_NS, car, driven
from tests.recorders.test_ros import Maker, write_bag
from tests.replay.foreign.conftest import compile_filter
from tests.replay.foreign.test_programs import program, python
from tests.replay.foreign.test_what_filters_are_told import DESCRIPTION

__all__ = ["compile_filter"]
TRUTH, REFUSED = "/car/truth", r"{} is a truth.*filters must not read it.*under another name"
ORIGIN = {"origin_latitude_deg": "48", "origin_longitude_deg": "11", "origin_altitude_m": "500"}


def drive(*others: fl.Stream, without: str = "") -> MemorySource:
    """A car with wheels, fixes and truth, and what else there is."""
    own = [each for each in car(ORIGIN, ORIGIN) if each.topic != without]
    return memory_source(Recording([*own, *others]), RunMetadata("drive"))


def surveyed(topic: str) -> fl.Stream:
    """The true path as measured positions."""
    poses, _ = driven()
    spread = np.tile([0.01, 0.01], (len(poses), 1))
    columns = {"position_m": poses[:, :2], "covariance_m2": spread}
    return make_stream(topic, schemas.POSITION_FIX, STAMPS_NS, metadata=ORIGIN, **columns)


@pytest.mark.parametrize("role", ["odometry", "fix", "pose", "turn_rate", "prior", "/landmarks"])
def test_a_setting_makes_no_sensor_control_or_prior_of_the_truth(role: str) -> None:
    for kind in ("ekf", "smoother", "particles", "bound"):
        with pytest.raises(BadInput, match=REFUSED.format(TRUTH)):
            fl.replay(drive(), {kind: {"topics": {role: "truth"}}})


def test_nor_is_what_something_names_as_its_truth_read() -> None:
    """By the setting for the role, by a topic's name beside the model's, by a channel."""
    with pytest.raises(BadInput, match=REFUSED.format("/car/fix")):
        fl.replay(drive(), {"ekf": {"topics": {"truth": "/car/fix"}}})
    by_name = drive(surveyed(TRUTH), without=TRUTH)
    done = fl.replay(by_name, "ekf")
    assert len(done.estimates[0]["/estimates/ekf/car/pose"])
    with pytest.raises(BadInput, match=REFUSED.format(TRUTH)):
        fl.replay(by_name, {"ekf": {"topics": {"fix": TRUTH}}})
    judged = make_stream(
        "/estimates/own/car/state",
        schemas.GAUSSIAN_ESTIMATE,
        [STAMPS_NS[0]],
        metadata={**POSE, "truth": "/survey/places"},
        mean=[[0.0, 0.0, 0.0]],
        covariance=[np.eye(3).ravel()],
    )
    survey = surveyed("/survey/places")
    settings = {"ekf": {"topics": {"fix": "/survey/places"}}}
    done = fl.replay(drive(survey), settings)
    assert len(done.estimates[0]["/estimates/ekf/car/pose"])
    with pytest.raises(BadInput, match=REFUSED.format("/survey/places")):
        fl.replay(drive(survey, judged), settings)


def estimators_of_ones_own() -> dict[str, Any]:
    """A recursion, a batch and a model that read the truth as a sensor."""

    def start(given: Any) -> Any:
        return (), (np.zeros((given.runs, 1)),)

    def follow(*_: Any) -> None:
        raise AssertionError

    own: dict[str, Any] = {"components": {"x_m": "linear"}, "truth": "truth"}
    streams = {"truth": schemas.TRUTH_STATE}
    recursion = fl.recursive("cheats", streams=streams, start=start, follow=follow, **own)
    odometry = {"odometry": schemas.ODOMETRY}
    batch = fl.batch("cheats", streams=odometry, static=streams, solve=follow, **own)
    robot = load("models", "robot", fl.Model)
    sees = fl.Sensor(
        "truth",
        schemas.TRUTH_STATE,
        robot.state,
        lambda state, *_: state,
        lambda _: (1.0, 1.0, 1.0),
        vector="state",
    )
    model = replace(robot, sensors=(*robot.sensors, sees))
    return {"recursive": recursion, "batch": batch, "model": fl.modelled(model, "ekf")}


@pytest.mark.parametrize("kind", ["recursive", "batch", "model"])
def test_an_estimator_of_ones_own_may_not_read_it(kind: str) -> None:
    with pytest.raises(BadInput, match=REFUSED.format(TRUTH)):
        fl.replay(drive(), {"mine": estimators_of_ones_own()[kind]})


@pytest.mark.paper
@pytest.mark.parametrize("way", ["here", "apart", "program"])
def test_a_foreign_filter_may_not_read_it(
    compile_filter: Callable[..., Path], tmp_path: Path, way: str
) -> None:
    read = [{"topic": "odometry", "fields": ["forward_mps"]}, {"topic": "truth", "fields": ["state[3]"]}]
    state = {f"told{number}_m": "linear" for number in range(9)}
    own = {"topics": read, "state": state, "prior": "", "truth": "truth", "protocol": 2}
    text = json.dumps({**DESCRIPTION, **own})
    if way == "program":
        (tmp_path / "description.json").write_text(text, encoding="utf-8")
        telling = Path(__file__).parents[1] / "replay" / "foreign" / "telling.py"
        mine = program(python(telling, f"'{tmp_path / 'description.json'}'"))
    else:
        source = Path(__file__).parents[1] / "replay" / "foreign" / "telling.c"
        path = compile_filter(source, name="cheats", DESCRIPTION=json.dumps(text))
        mine = {"kind": "lib", "path": str(path), "in_process": way == "here"}
    with pytest.raises(BadInput, match=REFUSED.format(TRUTH)):
        fl.replay(drive(), {"mine": mine})


def test_tuning_and_diagnosing_refuse_it_too() -> None:
    settings = {"ekf": {"topics": {"fix": TRUTH}}}
    with pytest.raises(BadInput, match=REFUSED.format(TRUTH)):
        fl.diagnose(drive(), settings)
    with pytest.raises(BadInput, match=REFUSED.format(TRUTH)):
        fl.tune(drive(), settings, ["forward_noise_density"])


@pytest.mark.paper
def test_a_truth_of_another_name_is_diagnosed_by(tmp_path: Path) -> None:
    """By the setting that a replay takes as well."""
    log, settings = tmp_path / "log.mcap", {"topics": {"truth": "/survey/places"}}
    odometry, fix, truth = car(ORIGIN, ORIGIN)
    fl.write(log, [odometry, fix, replace(truth, topic="/survey/places")])
    found = fl.diagnose(log, "ekf", set=settings)
    assert not any("no truth" in note for note in found.notes)
    judged = fl.replay(log, "ekf", set=settings).metrics
    assert "position_rmse_m" in set(judged["quantity"])


def test_a_bound_may_know_it_and_a_replay_may_start_from_it() -> None:
    first = driven()[0][:1]
    spread = np.diag([1.0, 1.0, 0.01]).ravel()
    prior = make_stream(
        "/car/prior",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS_NS[:1],
        metadata={**POSE, **ORIGIN},
        mean=first,
        covariance=[spread],
    )
    for kind in ("bound", "ekf"):
        done = fl.replay(drive(prior), kind, start_s=2.0, start_from="truth")
        assert len(done.estimates[0][f"/estimates/{kind}/car/pose"])


@pytest.mark.parametrize("truth", [None, "/ground_truth/odom"])
def test_the_truth_of_a_bag_is_no_wheel(tmp_path: Path, truth: str | None) -> None:
    """Its twist is left out and said so, and the wheels drive; without a truth there are two robots."""
    make, sent = Maker(), []
    for step in range(50):
        stamp_ns = 1_700_000_000_000_000_000 + 50_000_000 * step
        for topic, speed in (("/ground_truth/odom", 1.0), ("/wheel/odom", 1.25)):
            turned = {"twist__twist__linear__x": speed, "pose__pose__orientation": [0.0, 0, 0, 1]}
            sent.append((topic, stamp_ns, make("nav_msgs/msg/Odometry", stamp_ns, **turned)))
    path = write_bag(tmp_path / "bag", "mcap", sent, make.store)
    source = fl.import_("ros", path, **({"truth": truth} if truth else {}))
    robots = [each for each in source.topics if each.endswith("/odometry")]
    assert robots == (["/wheel/odometry"] if truth else ["/ground_truth/odometry", "/wheel/odometry"])
    if truth:
        assert {each for each in source.topics if "ground" in each} == {"/ground_truth/truth"}
        note = "/ground_truth/odom: odometry left out, since filters must not use data from the truth"
        assert source.run.notes[note] == "50"
        done = fl.replay(source, "ekf")
        assert len(done.estimates[0]["/estimates/ekf/wheel/pose"])


def test_true_columns_of_a_table_become_the_truth_alone(tmp_path: Path) -> None:
    """Of a struct or a name that begins so, and of a file that is named so."""
    own = {"t": 1.7e9, "speed": 1.0, "yaw_rate": 0.02}
    cases: dict[str, tuple[str, dict[str, float], set[str]]] = {
        "heading alone": ("log", {"truth.yaw": 0.3}, {"/odometry", "/truth"}),
        "velocities": ("log", {"gt_x": 1.0, "gt_y": 2.0, "gt_speed": 1.0, "gt_yaw_rate": 0.0},
                       {"/odometry", "/truth"}),
        "latitudes": ("log", {"ground_truth_lat": 48.1, "ground_truth_lon": 11.5},
                      {"/odometry", "/truth"}),
        "a whole file": ("vicon", {"x": 1.0, "y": 2.0, "yaw": 0.2}, {"/truth"}),
    }  # fmt: skip
    for name, (stem, true, topics) in cases.items():
        rows = [{**own, **true, "t": 1.7e9 + 0.1 * step} for step in range(30)]
        table, mapping = tmp_path / f"{stem}.csv", tmp_path / "own.toml"
        lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
        table.write_text("\n".join(lines))
        mapping.write_text(guess([table]))
        found = fl.import_("table", table, mapping=str(mapping))
        assert set(found.topics) == topics, name
    table.write_text("t,speed\n" + "\n".join(f"{1.7e9 + step},1" for step in range(30)))
    with pytest.raises(BadInput, match="mark it as the truth, but it has no position or heading"):
        guess([table])
