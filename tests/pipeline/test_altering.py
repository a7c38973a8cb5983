"""Altering: advice that can be run, on any log, the same everywhere; what makes no sense is refused."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.altering import alterations as put
from fuselog.pipeline.altering.changes import bare
from fuselog.pipeline.altering.entries import _columns
from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.diagnosing.battery.car import car
from fuselog.recorders.log.streams import concatenate
from fuselog.recorders.models.orientation import heading
from fuselog.recorders.parameters import parse_settings
from tests.pipeline.test_python import robot

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
ODOMETRY, PRIOR, SEEN = "/robot1/odometry", "/robot1/prior", "/robot1/range_bearing"
OPEN = {"gate_probability": 1.0}


@pytest.fixture(scope="module")
def run() -> fl.MemorySource:
    """A robot for half a minute, without a fault; its odometry is so good that stamps matter."""
    exact = {"rate_hz": 5.0, "maximum_range_m": 60.0}
    noise = {"forward_noise_density": 0.002, "turn_noise_density": 0.001}
    return fl.record("landmarks", seed=5, duration_s=60.0, speed_mps=2.0, **noise, range_bearing=exact)


def nis(log: fl.MemorySource, **settings: Any) -> tuple[float, float, float]:
    """NIS per component, and the interval of a consistent filter."""
    metrics = fl.replay(log, "ekf", set={**OPEN, **settings}, metrics="innovation").metrics
    [row] = metrics.query("quantity == 'nis_per_component'").to_dict("records")
    return row["value"], row["low"], row["high"]


def drifting(stream: fl.Stream, rate: float) -> fl.Stream:
    first_ns = int(stream.publish_time_ns[0])
    return put.drifted(first_ns)(stream, rate)


@pytest.mark.paper
@pytest.mark.parametrize(
    ("topic", "fault", "by", "corrected"),
    [
        (SEEN, put.shifted("range_m"), 0.2, "bias_range_m"),
        (SEEN, put.delayed, 0.3, f"{SEEN}.delay_s"),
        (SEEN, drifting, 2e-3, f"{SEEN}.clock_gain"),
        ("/landmarks", put.renumbered("landmark_id", 3, 9), 0.0, "/landmarks.exchanged"),
        (PRIOR, put.shifted("mean", 2), 2.0, f"{PRIOR}.heading_bias"),
    ],
)
@pytest.mark.usefixtures("first_cause_alone")
def test_what_a_diagnosis_says_to_set_makes_the_filter_consistent(
    run: fl.MemorySource, topic: str, fault: put.Alteration, by: float, corrected: str
) -> None:
    faulty = put.altered(run, topic, fault, by)
    value, _, high = nis(faulty)
    assert value > high
    told = fl.diagnose(faulty, "ekf", set=OPEN).sentences[0]
    assert told.setting.partition("=")[0] == corrected
    assert f"; try --set {told.setting}" in told.sentence
    value, low, high = nis(faulty, **parse_settings([told.setting]))
    assert low < value < high


@pytest.mark.paper
@pytest.mark.parametrize(
    ("topic", "fault", "by", "setting", "undoes"),
    [
        (ODOMETRY, put.scaled("turn_radps"), -1.0, "turn_scale", -1),
        (ODOMETRY, put.scaled("turn_radps"), 180.0 / np.pi, "turn_radps_scale", "0.0174532925"),
        (ODOMETRY, put.scaled("forward_mps"), 3.6, "forward_scale", 0.27777778),
        (SEEN, put.shifted("bearing_rad"), np.pi / 40, "bearing_bias", "4.5 deg"),
        (SEEN, put.delayed, 18.0, "delay_s", "18000 ms"),
        ("/landmarks", put.turned("position_m"), np.pi / 2, "position_turn", "90 deg"),
        ("/landmarks", put.shifted("position_m", 0), 7.0, "position_x_bias", "700 cm"),
        ("/landmarks", put.shifted("position_m", 1), 7.0, "origin", "0, -7"),
    ],
)
def test_units_signs_axes_and_clocks_are_mended_as_people_write_them(
    run: fl.MemorySource, topic: str, fault: put.Alteration, by: float, setting: str, undoes: object
) -> None:
    faulty = put.altered(run, topic, fault, by)
    assert nis(faulty)[0] > nis(run)[2]
    assert nis(faulty, **{f"{topic}.{setting}": undoes}) == pytest.approx(nis(run), rel=1e-5)


# Readings with two rows, 2 s apart: of every kind that can be set.
BEGIN_NS, PLACES = 10**18, np.array([[1.0, 2.0, 3.0], [4.0, 6.0, 5.0]])
SPREAD = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.2], [0.5, 0.2, 1.0]])
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # by a quarter, clockwise
SWAP = np.eye(3)[[1, 0, 2]]


def _readings() -> fl.MemorySource:
    stamps = BEGIN_NS + np.array([0, 2 * 10**9])
    covariances = np.tile(SPREAD.ravel(), (2, 1))
    headings = np.array([0.3, 3.0])
    turned = np.stack([np.cos(headings / 2), 0 * headings, 0 * headings, np.sin(headings / 2)], axis=1)
    identifiers = {"target_id": [3, 9], "range_m": [10.0, 20.0], "bearing_rad": [0.5, -0.5]}
    made = [
        fl.make_stream(
            "/fix", fl.schemas.POSITION_FIX, stamps, position_m=PLACES, covariance_m2=covariances
        ),
        fl.make_stream(
            "/compass",
            fl.schemas.ORIENTATION,
            stamps,
            metadata={"covariance_rad2": "0.5"},
            quaternion=turned,
        ),
        fl.make_stream("/seen", fl.schemas.RANGE_BEARING, stamps, **identifiers),
    ]
    run = fl.record("landmarks", duration_s=1.0).run
    return fl.MemorySource({each.topic: each for each in made}, run, "readings")


@pytest.mark.parametrize(
    ("what", "value", "field", "wanted"),
    [
        ("/fix.position_m_scale", 2, "position_m", 2.0 * PLACES),
        ("/fix.position_x_bias", "50 cm", "position_m", PLACES - [0.5, 0.0, 0.0]),
        ("/fix.position_y_drift", 0.25, "position_m", PLACES - [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]),
        ("/fix.position_axes", "yxz", "position_m", PLACES @ SWAP.T),
        ("/fix.position_axes", "yxz", "covariance_m2", SWAP @ SPREAD @ SWAP.T),
        ("/fix.position_turn", "90 deg", "position_m", PLACES @ TURN.T),
        ("/fix.position_turn", "90 deg", "covariance_m2", TURN @ SPREAD @ TURN.T),
        (
            "/fix.position_matrix",
            "1,2,3,0,1,0,0,0,1",
            "position_m",
            PLACES @ [[1, 0, 0], [2, 1, 0], [3, 0, 1]],
        ),
        ("/fix.origin", "1,2,3", "position_m", np.add(PLACES, [1.0, 2.0, 3.0])),
        ("/fix.covariance_scale", 4, "covariance_m2", 4.0 * SPREAD),
        ("/seen.range_bias", 1.5, "range_m", [8.5, 18.5]),
        ("/seen.bearing_scale", -1, "bearing_rad", [-0.5, 0.5]),
        ("/seen.exchanged", "3,9", "target_id", [9, 3]),
        ("/compass.heading_bias", "0.2", "heading", [0.1, 2.8]),
        ("/compass.heading_scale", -1, "heading", [-0.3, -3.0]),
        ("/compass.heading_drift", 0.1, "heading", [0.3, 2.8]),
        ("/compass.heading_convention", "north", "heading", [np.pi / 2 - 0.3, np.pi / 2 - 3.0]),
        ("/fix.delay_s", "300 ms", "stamps", [-300_000_000, 1_700_000_000]),
        ("/fix.clock_gain", 0.25, "stamps", [0, 1_600_000_000]),
    ],
)
def test_what_is_set_undoes_its_fault_in_the_columns(
    what: str, value: Any, field: str, wanted: Any
) -> None:
    """By hand, with units, and nothing else of the topic changes."""
    topic = what.partition(".")[0]
    before = _readings().streams[topic]
    after = alter(_readings(), {what: value}).read([topic])[topic]
    found = {
        **after.columns,
        "stamps": after.publish_time_ns - BEGIN_NS,
        **({"heading": heading(after["quaternion"])} if "quaternion" in after.columns else {}),
    }
    wanted = np.reshape(np.broadcast_to(wanted, (2, 3, 3)), (2, 9)) if "covariance" in field else wanted
    np.testing.assert_allclose(found[field], wanted, rtol=1e-9, atol=1e-9)
    moved = {"heading": "quaternion"}.get(field, field)
    turns = ("position_m", "covariance_m2") if "axes" in what or "turn" in what else ()
    for name, column in before.columns.items():
        if name not in (moved, "sensor_time_ns", *turns):
            np.testing.assert_array_equal(after[name], column)


@pytest.mark.parametrize(
    ("components", "names"),
    [("left_mps,right_mps", ["left_mps", "right_mps"]), ("", ["value_x", "value_y"])],
)
def test_entries_of_a_measured_vector_have_names(components: str, names: list[str]) -> None:
    """Those that its channel states, for settings and in what a diagnosis says."""
    stamps_ns = BEGIN_NS + np.arange(4) * 10**9
    stream = fl.make_stream(
        "/wheels",
        fl.schemas.VECTOR_MEASUREMENT,
        stamps_ns,
        metadata={"components": components} if components else {},
        value=np.ones((4, 2)),
    )
    assert [name for _, _, name in _columns(stream)] == names
    source = fl.MemorySource({"/wheels": stream}, fl.RunMetadata("wheels", {}, 0, BEGIN_NS), "wheels")
    for place, name in enumerate(names):
        found = alter(source, {f"/wheels.{bare(name)}_scale": 3.0}).read(["/wheels"])["/wheels"]["value"]
        assert found[:, place].tolist() == [3.0] * 4
        assert found[:, 1 - place].tolist() == [1.0] * 4


def test_stated_variances_and_exchanged_topics() -> None:
    scaled = alter(_readings(), {"/compass.covariance_scale": 4})
    assert scaled.read(["/compass"])["/compass"].metadata["covariance_rad2"] == "2.0"
    source = _readings()
    other = replace(source.streams["/fix"], topic="/other")
    both = replace(source, streams={**source.streams, "/other": put.shifted("position_m")(other, 7.0)})
    found = alter(both, {"/fix.exchanged": "/other"}).read(["/fix", "/other"])
    np.testing.assert_array_equal(found["/fix"]["position_m"], PLACES + 7.0)
    np.testing.assert_array_equal(found["/other"]["position_m"], PLACES)


def test_a_setting_says_that_truths_cover_some_targets() -> None:
    """As the metadata of a truth does, and the other way; the result names it."""
    log = fl.record("crossing", duration_s=20.0)
    counts = {}
    for value in (None, "some", "all"):
        key = "/target1/truth.covers"
        replay = fl.replay(log, "tracker", set={} if value is None else {key: value})
        counts[value] = set(replay.metrics["quantity"])
        assert any("only some of the targets" in each for each in replay.losses) == (value == "some")
    assert "unreferenced_targets" in counts["some"]
    assert counts["all"] == counts[None]
    assert "unreferenced_targets" not in counts["all"]


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_covariances_of_fixes_are_scaled() -> None:
    """Stated 4 times too large, and mended by what the diagnosis says."""
    run = fl.record("landmarks", seed=3, duration_s=60.0, fix={"rate_hz": 5.0})
    fix = "/robot1/fix"
    faulty = put.altered(run, fix, put.spread("covariance_m2"), np.log(2.0))
    told = fl.diagnose(faulty, "ekf", set=OPEN).sentences[0]
    key, _, advised = told.setting.partition("=")
    assert key == f"{fix}.covariance_scale"
    assert float(advised) == pytest.approx(0.25, rel=0.15)
    value, low, _ = nis(faulty)
    assert value < low
    value, low, high = nis(faulty, **{key: advised})
    assert low < value < high


def test_a_log_is_altered_block_by_block_as_a_recording_is(tmp_path: Path, run: fl.MemorySource) -> None:
    """Stamps that move by more than a block, in spans: no message is lost, twice or out of turn."""
    fl.write(tmp_path / "run.mcap", run)
    settings = {f"{SEEN}.delay_s": "7.25 s", f"{ODOMETRY}.clock_gain": 0.05, f"{SEEN}.range_bias": 0.2}
    topics = [SEEN, ODOMETRY, "/robot1/truth"]
    log, memory = alter(fl.open(tmp_path / "run.mcap"), settings), alter(run, settings)
    for span_s in ((None, None), (5.0, None), (10.0, 20.0)):
        begin_ns, end_ns = (
            None if time_s is None else run.epoch_ns + round(time_s * 1e9) for time_s in span_s
        )
        blocks = list(replace(log, start_ns=begin_ns, end_ns=end_ns).blocks(topics, "publish_time", 50))
        spans = [
            (
                min(stream.publish_time_ns[0] for stream in block.values()),
                max(stream.publish_time_ns[-1] for stream in block.values()),
            )
            for block in blocks
        ]
        assert all(before[1] < after[0] for before, after in pairwise(spans))
        [whole] = replace(memory, start_ns=begin_ns, end_ns=end_ns).blocks(topics, "publish_time", 50)
        for topic in topics:
            found = concatenate([block[topic] for block in blocks if topic in block])
            assert np.array_equal(found.publish_time_ns, whole[topic].publish_time_ns)
            for name, column in whole[topic].columns.items():
                assert np.array_equal(found[name], column, equal_nan=True)


def test_advice_works_on_stamps_that_begin_at_zero(
    tmp_path: Path, fuselog: Fuselog, caplog: pytest.LogCaptureFixture
) -> None:
    """The fix that would be before 1970 is left out, in memory and of a file; all others are moved."""
    run, log = car(1), tmp_path / "run.mcap"
    fl.write(log, run)
    setting = {"/car/fix.delay_s": 0.3}
    kept_ns = run.streams["/car/fix"].publish_time_ns[1:] - 300_000_000
    for source in (alter(run, setting), alter(fl.open(log), setting)):
        assert source.extent("publish_time")[0] == 0
        assert np.array_equal(source.read(["/car/fix"])["/car/fix"].publish_time_ns, kept_ns)
    told = fuselog("replay", log, "-e", "ekf", "--set", "/car/fix.delay_s=.3", "--json")
    assert told.code == 0, told.err
    counted = f"{log}: 1 of 201 messages of /car/fix would be before 1970 and are left out"
    assert caplog.messages == [counted]
    for source in (run, fl.open(log)):
        with pytest.raises(
            fl.BadInput, match="all 201 messages of /car/fix would be before 1970; set a"
        ):
            alter(source, {"/car/fix.delay_s": 200.0})


@pytest.mark.paper
def test_every_command_alters_alike_and_says_so(tmp_path: Path, fuselog: Fuselog) -> None:
    log, estimates = tmp_path / "run.mcap", tmp_path / "est.mcap"
    run = fl.record("landmarks", seed=3, duration_s=8.0, speed_mps=2.0)
    fl.write(log, put.altered(run, SEEN, put.shifted("range_m"), 0.2))
    key = f"{SEEN}.range_bias"
    remedy = ["-e", "ekf", "--set", f"{key}=.2"]
    told = fuselog("replay", log, *remedy, "-o", estimates, "--json").json["metrics"]
    stated = fl.open(estimates).run.notes["alterations"]  # type: ignore[union-attr]
    assert json.loads(stated) == {key: 0.2}
    in_python = fl.replay(log, "ekf", set={key: 0.2})
    clean = fl.replay(run, "ekf").metrics.query("quantity == 'nis_per_component'")["value"].tolist()
    assert clean == pytest.approx([told["ekf.nis_per_component.robot1"]], rel=1e-9)
    rows = in_python.metrics.query("quantity == 'nis_per_component'")["value"].tolist()
    assert rows == [told["ekf.nis_per_component.robot1"]]
    judged = fuselog("evaluate", estimates, "--out", tmp_path / "judged", "--json").json["metrics"]
    same = [name for name in judged if judged[name] == pytest.approx(told.get(name), rel=1e-9)]
    assert "ekf.nees.robot1" in same
    tuned = ["--free", "sigma_range_m", "--out", tmp_path / "tuned"]
    for command in (
        ["run", log, *remedy, "--out", tmp_path / "ran"],
        ["tune", log, *remedy, *tuned],
        ["diagnose", log, *remedy, "--out", tmp_path / "diagnosed"],
        ["compare", log, *remedy, "-e", "ukf"],
    ):
        assert fuselog(*command).code == 0
    for folder in ("ran", "tuned", "diagnosed", "judged"):
        stated = json.loads((tmp_path / folder / "result.json").read_text(encoding="utf-8"))
        assert stated["settings"]["alterations"] == {key: 0.2}
    ran = json.loads((tmp_path / "ran" / "result.json").read_text(encoding="utf-8"))["metrics"]
    assert ran["ekf.nis_per_component.robot1"] == told["ekf.nis_per_component.robot1"]
    assert "nothing found" in fuselog("diagnose", estimates).out
    golden = tmp_path / "ran.golden.xz"
    assert fuselog("check", tmp_path / "ran", "--against", golden, "--update").code == 0
    notes = fuselog("compare", tmp_path / "ran", tmp_path / "ran", "--json").json["notes"]
    assert not any("without other metrics" in note for note in notes)  # it was replayed as it ran
    swept = ["--over", f"{key}=0,.2", "--out", tmp_path / "swept"]
    at = fuselog("sweep", log, "-e", "ekf", *swept, "--json").json["metrics"]
    assert at["ekf.nis_per_component.robot1"][1] == told["ekf.nis_per_component.robot1"]


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_of_a_model_that_is_not_registered_the_line_is_python(run: fl.MemorySource) -> None:
    """No command knows its name; and what is set already is counted in."""
    faulty = put.altered(run, SEEN, put.delayed, 0.3)
    mine = {"mine": fl.modelled(robot(), "ekf")}
    before = {f"{SEEN}.delay_s": 0.1}
    told = fl.diagnose(faulty, mine, set={**OPEN, **before}).sentences[0]
    found = re.search(r"try set=(\{.*\})", told.sentence)
    assert found is not None
    settings = json.loads(found[1])
    assert settings == {f"{SEEN}.delay_s": pytest.approx(0.3, abs=0.01)}
    assert fl.diagnose(faulty, mine, set={**OPEN, **settings}).sentences == []


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("/robot1/fix.delay_s=1", "has no topic /robot1/fix; did you mean"),
        (f"{SEEN}=1", "expected /TOPIC.WHAT=VALUE, such as /fix.delay_s=0.3"),
        (f"{SEEN}.delay=soon", "expected seconds, such as 0.3 or 300 ms"),
        (f"{SEEN}.delay_s=3 kg", "unknown unit 'kg'"),
        (f"{SEEN}.delay_s=3 m", "the unit 'm' does not fit"),
        (f"{SEEN}.speed_scale=2", "has no field speed; available: range_m, bearing_rad"),
        (f"{SEEN}.range_scale=inf", "expected a factor, such as -1 or 3.6"),
        (f"{SEEN}.range_matrix=1", "range_m is not a vector of three entries"),
        (f"{SEEN}.range_sign=2", "settings of a topic are"),
        ("/robot1/truth.covers=most", "expected some or all"),
        (f"{SEEN}.covers=some", "this setting applies only to truths"),
        (f"{SEEN}.origin=1,2", "only positions and geodetic fixes have an origin"),
        (f"{SEEN}.exchanged={ODOMETRY}", "only topics of the same type can be swapped"),
        ("/landmarks.exchanged=3", "expected two numbers, such as 3,9, or another topic"),
        ("/landmarks.origin=here", "expected a position in m, such as -0.65,0.3"),
    ],
)
def test_what_makes_no_sense_is_refused_with_a_sentence(
    tmp_path: Path, run: fl.MemorySource, fuselog: Fuselog, setting: str, said: str
) -> None:
    log = tmp_path / "run.mcap"
    fl.write(log, run)
    told = fuselog("replay", log, "-e", "ekf", "--set", setting)
    assert told.code == 2
    assert said in " ".join(told.err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
