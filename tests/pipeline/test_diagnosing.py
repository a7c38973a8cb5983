"""Diagnosing: the reference sheet's gains, faults that are named, what is unusual, what is refused."""

import json
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

import fuselog as fl
from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering import sources as altering
from fuselog.pipeline.diagnosing import diagnosis, study
from fuselog.pipeline.diagnosing import likelihood as trials_of
from fuselog.pipeline.diagnosing.causes import Sought, find_causes, least_gain
from fuselog.pipeline.diagnosing.consistency import of_each_component, unseen_errors
from fuselog.pipeline.diagnosing.findings import of_estimates, of_innovations
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis
from fuselog.pipeline.diagnosing.hypotheses.listing import hypotheses
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.diagnosing.search import Gains, Peak, peak
from fuselog.pipeline.diagnosing.sentences import cause_of
from fuselog.pipeline.optimise import end, side_by_side
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.outcome import Tuning
from fuselog.recorders.checks.lint import lint
from fuselog.replay.engine.replaying.estimator import bind
from tests.claims.pages import stored
from tests.replay.inference.sheet_robot import FREE, of_sigmas, recorded

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
OPEN = {"gate_probability": 1.0}
SEEN = "/robot1/range_bearing"


def gains_of(source: fl.MemorySource, settings: dict[str, float]) -> dict[str, Peak]:
    """What scaling each noise alone gains, and by how much (logarithms)."""
    given = {"kind": "ekf", **settings, **OPEN}
    base, likelihood = Trial("ekf", [source], given), Likelihood()
    seen = likelihood.begin(base)
    tried = hypotheses(bind("ekf", [source], given), base, seen, likelihood.readings)
    [before] = likelihood([base])

    def gains(each: Hypothesis) -> Gains:
        return lambda values: [
            found - before for found in likelihood([each.without(base, value) for value in values])
        ]

    return {each.topic: found_by(each, gains(each)) for each in tried if each.topic in FREE}


def found_by(of: Hypothesis, gains: Gains, floor: float = 0.0) -> Peak:
    """The peak of a single search."""
    [found] = side_by_side([peak(of, floor)], lambda asked: gains([value for _, value in asked]))
    return found


def parabola(*tried: float, limit: float = np.inf) -> Hypothesis:
    """A fault of one number, that no log has."""
    return Hypothesis("delay", "/fix", "", tried, limit, lambda _, at: at, *[str, str])  # type: ignore[arg-type,return-value]


def test_the_largest_gain_of_the_sheet_names_the_sensor_not_the_largest_scale() -> None:
    """Section 9, a bearing's sigma 3 times too small: the speed's scale is larger, its gain is not."""
    found = gains_of(recorded(600, 300.0), of_sigmas(0.1, 0.05, 0.2, 0.01))
    scales = [np.exp(found[name].value) for name in FREE]
    assert scales == pytest.approx([11.97, 3.63, 1.00, 3.0763], abs=0.006)
    assert [found[name].gain for name in FREE] == pytest.approx([184.6, 650.1, 0.004, 758.9], abs=0.06)
    clean = gains_of(recorded(600, 300.0), of_sigmas(0.1, 0.05, 0.2, 0.03))
    assert max(each.gain for each in clean.values()) < 1.8


def test_a_peak_far_from_where_the_search_begins_has_its_interval() -> None:
    """A parabola of standard error 0.1 about 30: the interval is 1.96 errors to each side."""

    def gain(values: Sequence[float]) -> list[float]:
        return [0.5 * ((30.0 / 0.1) ** 2 - ((value - 30.0) / 0.1) ** 2) for value in values]

    def little(values: Sequence[float]) -> list[float]:
        return [0.1 * value - value**2 for value in values]

    found = found_by(parabola(-1.0, 1.0), gain, 5.0)
    assert found[:2] == pytest.approx((30.0, 45000.0), rel=1e-6)
    searches = [end(found.value, found.gain, way) for way in (-1.0, 1.0)]
    ends = side_by_side(searches, lambda asked: gain([value for _, value in asked]))
    assert ends == pytest.approx((29.804, 30.196), abs=2e-3)
    assert found_by(parabola(-1.0, 1.0, limit=10.0), gain, 5.0).value == pytest.approx(10.0, abs=0.02)
    assert found_by(parabola(-1.0, 1.0), little, 5.0)[:2] == (0.0, 0.0)


GAINS_WITHOUT_A_PEAK = {
    "flat": lambda x: 0.0 * x,
    "spike at the start": lambda x: 100.0 if x == 0.0 else -1e3,
    "spike elsewhere": lambda x: 100.0 if x == 1.0 else -1e3,
    "narrow": lambda x: 100.0 - abs(x - 1.0) / 1e-14,
    "step": lambda x: 100.0 if x >= 0.5 else 0.0,
    "rise": lambda x: x,
    "never known": lambda x: np.nan * x,
    "unknown beyond 1": lambda x: 50.0 * x if x <= 1.0 else np.nan,
    "infinite": lambda x: np.inf if x > 0.5 else -np.inf,
    "underflow": lambda x: 100.0 * np.exp(-((x / 1e-3) ** 2)),
    "least number": lambda x: 100.0 if abs(x) < 5e-324 else 0.0,
}


@pytest.mark.parametrize("name", GAINS_WITHOUT_A_PEAK)
def test_every_search_ends(name: str) -> None:
    """A search asks for a bounded number of values whatever the gain is; an end is beyond its peak."""
    asked_for = 0

    def gain(values: Sequence[float]) -> list[float]:
        nonlocal asked_for
        asked_for += len(values)
        assert asked_for < 1000
        return [GAINS_WITHOUT_A_PEAK[name](value) for value in values]

    def ends(at: Peak, scale: float) -> list[float]:
        searches = [end(at.value, at.gain, way * scale) for way in (-1.0, 1.0)]
        return side_by_side(searches, lambda asked: gain([value for _, value in asked]))

    found = found_by(parabola(-1.0, 1.0, 0.5, limit=1e3), gain, 5.0)
    assert not np.isnan(found.gain)
    for at, scale in ((found, 1.0), (Peak(0.0, 100.0), 1.0), (Peak(1.0, 100.0), 1e-3), (found, 5e-324)):
        low, high = ends(at, scale)
        assert low <= at.value <= high


@pytest.fixture(scope="module")
def run() -> fl.MemorySource:
    """A robot for half a minute, without a fault."""
    return fl.record("landmarks", seed=3, duration_s=30.0, speed_mps=2.0)


def test_trials_with_other_numbers_are_replayed_together(
    run: fl.MemorySource, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has exactly the likelihood that it has by itself; another gate is another filter."""
    late = replace(run, streams={**run.streams, SEEN: alter.delayed(run.streams[SEEN], 0.2)})
    given = {"kind": "ekf", "sigma_range_m": 0.1}
    tried = [
        Trial("ekf", [run], given),
        Trial("ekf", [run], {**given, "sigma_bearing_rad": 0.05}),
        Trial("ekf", [late], {**given, "bias_range_m": 0.1}),
        Trial("ekf", [run], {**given, "gate_probability": 0.9}),
    ]
    told, replay, runs = Likelihood(), trials_of.replay, list[int]()
    told.begin(tried[0])
    alone = [told([each])[0] for each in tried]

    def counting(sources: Sequence[Any], *others: Any, **named: Any) -> Any:
        runs.append(len(sources))
        return replay(sources, *others, **named)

    monkeypatch.setattr(trials_of, "replay", counting)
    assert told(tried) == alone
    assert len({*alone}) == 4
    assert runs == [3, 1]


def first(source: fl.MemorySource, **settings: float) -> Any:
    """The first sentence of a diagnosis, which seeks no second cause."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosis, "MOST_SENTENCES", 1)
        return fl.diagnose(source, "ekf", set={**OPEN, **settings}).sentences[0]


@pytest.fixture(scope="module")
def found(run: fl.MemorySource) -> fl.Diagnosis:
    """What is said of it."""
    return fl.diagnose(run, "ekf")


def test_nothing_is_found_where_nothing_is_wrong(found: fl.Diagnosis) -> None:
    assert found.sentences == []
    told = f"nothing found: none of the {found.hypotheses} faults tried reaches"
    assert found.told[0].startswith(told)
    assert found.least_gain == least_gain(found.hypotheses)
    assert found.components["mean_square"].between(0.8, 1.2).all()


@pytest.mark.paper
def test_noise_that_is_stated_too_small_is_named_with_its_scale(run: fl.MemorySource) -> None:
    told = first(run, sigma_range_m=0.025)
    assert (told.kind, told.where) == ("measurement noise", "sigma_range_m")
    low, high = np.exp(told.cause.ends)
    assert 3.5 < low < 4.0 < high < 4.5
    assert "so that R is too small" in told.sentence
    assert "try --set sigma_range_m=0.09" in told.sentence
    assert "fuselog tune LOG -e ekf --free sigma_range_m" in told.sentence
    told = first(run, turn_noise_density=0.1)
    assert (told.kind, told.where) == ("process noise", "turn_noise_density")
    assert "so that Q is too large" in told.sentence


@pytest.mark.parametrize(
    ("steps", "is_lossy"),
    [
        (lambda rng: rng.integers(1, 6, 600), False),
        (lambda rng: rng.choice([1, 2, 5], 600), False),
        (lambda rng: rng.geometric(0.3, 600), False),
        (lambda rng: rng.geometric(0.95, 600), True),
        (lambda rng: rng.geometric(0.6, 600), True),
        (lambda rng: 1 + 9 * (rng.random(600) < 0.03), True),
    ],
)
def test_messages_are_lost_of_a_regular_topic_alone(
    steps: Callable[[np.random.Generator], Any], is_lossy: bool
) -> None:
    """Lost at random or in a row; not of an irregular topic whose stamps are of a clock's ticks."""
    rng = np.random.default_rng(3)
    stamps_ns = fl.simulation_stamps_ns(0.02 * np.cumsum(steps(rng)))
    stream = fl.make_stream(
        "/odometry",
        fl.schemas.ODOMETRY,
        stamps_ns,
        forward_mps=rng.normal(size=600),
        turn_radps=rng.normal(size=600),
    )
    told = [each.evidence for each in lint([{"/odometry": stream}]) if each.kind == "lost messages"]
    assert bool(told) == is_lossy, told


@pytest.mark.paper
@pytest.mark.parametrize(
    ("alteration", "by", "kind", "topic", "said"),
    [
        (alter.shifted("range_m"), 0.2, "bias or turned frame", SEEN, "range_m is too large by"),
        (
            alter.shifted("bearing_rad"),
            0.05,
            "bias or turned frame",
            SEEN,
            "or equivalently the sensor's frame is",
        ),
        (alter.thinned(5), 0.3, "lost messages", SEEN, "loses 27 % of its messages"),
        (alter.shifted("mean", 2), 0.6, "start", "/robot1/prior", "heading_rad at the start is"),
        (
            alter.renumbered("landmark_id", 3, 9),
            0,
            "exchanged numbers",
            "/landmarks",
            "3 and 9 are swapped",
        ),
    ],
)
def test_a_fault_of_the_log_is_named_first(
    run: fl.MemorySource, alteration: alter.Alteration, by: float, kind: str, topic: str, said: str
) -> None:
    told = first(alter.altered(run, topic, alteration, by))
    assert (told.kind, told.where) == (kind, topic)
    assert said in told.sentence
    cause = cause_of(told)
    if cause is not None and len(cause.hypothesis.tried) > 1:
        low, high = cause.ends
        assert low - 0.02 < by < high + 0.02


@pytest.mark.paper
def test_a_delay_outliers_and_a_drifting_clock_are_named() -> None:
    """The odometry is so good that the stamps of the sightings matter."""
    scenario = {"duration_s": 30.0, "speed_mps": 2.0, "forward_noise_density": 0.002}
    scenario["turn_noise_density"] = 0.001
    exact = {"rate_hz": 5.0, "maximum_range_m": 60.0}
    late = fl.record("landmarks", seed=5, **scenario, range_bearing={**exact, "stamp_offset_s": 0.05})
    told = first(late)
    assert (told.kind, told.where) == ("delay", SEEN)
    assert told.cause.ends[0] < 0.05 < told.cause.ends[1]
    assert told.setting == f"{SEEN}.delay_s={told.cause.value:.4g}"
    assert told.sentence.endswith(f"try --set {told.setting}")
    wild = fl.record(
        "landmarks", seed=5, **scenario, range_bearing={**exact, "outlier_probability": 0.02}
    )
    assert first(wild).kind == "outliers"
    clean = fl.record("landmarks", seed=5, **scenario, range_bearing=exact)
    clock = alter.drifted(clean.extent("publish_time")[0])
    told = first(alter.altered(clean, SEEN, clock, 2e-3))
    assert (told.kind, told.where) == ("clock drift", SEEN)


@pytest.mark.paper
def test_a_stretch_of_fixes_that_are_off_is_outliers_and_no_noise() -> None:
    """No noise explains it: the likelihood of a noise that lets the filter follow is a spike."""
    fix, seen = {"rate_hz": 5.0, "sigma_m": 0.3}, {"rate_hz": 0.0}
    log = fl.record("landmarks", seed=3, duration_s=60.0, fix=fix, range_bearing=seen)
    right = log.streams["/robot1/fix"]
    since_s = 1e-9 * (right.publish_time_ns - right.publish_time_ns[0])
    moved = right["position_m"] + np.outer((since_s > 25.0) & (since_s < 33.0), (6.0, -4.0))
    glitch = replace(right, columns={**right.columns, "position_m": moved})
    found = fl.diagnose(replace(log, streams={**log.streams, right.topic: glitch}), "ekf").sentences
    assert [(each.kind, each.where) for each in found] == [
        ("outliers", "gate_probability"),
        ("place", "/robot1/fix"),
    ]
    assert not found[0].setting
    assert "the gate in the settings rejects these" in found[0].sentence


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_fixes_at_the_limit_of_what_is_possible_are_outliers() -> None:
    """A larger scale would leave them out, as impossible, and gain by that."""
    fix, seen = {"rate_hz": 2.0, "sigma_m": 0.3}, {"rate_hz": 0.0}
    log = fl.record("landmarks", seed=3, duration_s=30.0, fix=fix, range_bearing=seen)
    right = log.streams["/robot1/fix"]
    wild = right["position_m"].copy()
    wild[5::12] = 1e12
    faulty = replace(right, columns={**right.columns, "position_m": wild})
    found = fl.diagnose(replace(log, streams={**log.streams, right.topic: faulty}), "ekf")
    assert found.sentences[0].kind == "outliers"
    assert not any("left out" in note for note in found.notes)


@pytest.mark.paper
def test_two_faults_are_named_one_after_the_other(run: fl.MemorySource) -> None:
    """The second gains what it gains after the first is undone."""
    faulty = alter.altered(run, SEEN, alter.shifted("range_m"), 0.2)
    found = fl.diagnose(faulty, "ekf", set={**OPEN, "sigma_bearing_rad": 0.01}).sentences
    assert {each.kind for each in found[:2]} == {"bias or turned frame", "measurement noise"}
    assert found[0].cause.gain > found[1].cause.gain
    assert len(found) == 2


BESIDE_ITS_PLACE = {"/robot1/fix.origin": "1.0,-2.0"}


@pytest.mark.paper
@pytest.mark.parametrize(
    ("wrong", "part", "right"),
    [
        ({"/robot1/fix.delay_s": -0.25}, {"fix_delay_s": 0.15}, {"fix_delay_s": 0.25}),
        (
            {"/robot1/odometry.turn_bias": 0.02},
            {"turn_bias_radps": 0.008},
            {"turn_bias_radps": 0.02},
        ),
        (
            {"/robot1/range_bearing.range_scale": 1.25},
            {"/robot1/range_bearing.range_scale": 0.9},
            {"/robot1/range_bearing.range_scale": 0.8},
        ),
        (BESIDE_ITS_PLACE, {"/robot1/fix.origin": "0.5,0"}, {"/robot1/fix.origin": (-1.0, 2.0)}),
    ],
)
@pytest.mark.usefixtures("first_cause_alone")
def test_advice_is_the_total_to_set_where_part_of_it_is_set(
    wrong: dict[str, Any], part: dict[str, Any], right: dict[str, Any]
) -> None:
    """The first advice gives the right value, and the likelihood rises with it, in place of the part."""
    fix = {"rate_hz": 2.0, "sigma_m": 0.1}
    log = fl.record("landmarks", seed=3, duration_s=30.0, speed_mps=2.0, fix=fix)
    damaged = altering.alter(log, wrong)
    streams = {topic: replace(damaged.streams[topic]) for topic in damaged.streams}
    recording = replace(log, streams=streams)

    def likelihood(settings: dict[str, Any]) -> float:
        of_topics, own = altering.split_settings({**OPEN, **settings})
        metrics = fl.replay(
            altering.alter(recording, of_topics), {"ekf": {"kind": "ekf", **own}}
        ).metrics
        return float(metrics.set_index("quantity")["value"]["log_likelihood"])

    setting = fl.diagnose(recording, "ekf", set=part).sentences[0].setting
    key, _, value = setting.partition("=")
    [(wanted_key, wanted)] = right.items()
    assert key == wanted_key
    assert np.array(value.split(","), float) == pytest.approx(np.atleast_1d(wanted), abs=0.04)
    assert likelihood({**part, key: value if "," in value else float(value)}) > likelihood(part) + 5.0


def test_causes_that_explain_nearly_as_much_are_said_to() -> None:
    """A robot with a single sighting: what is wrong with it may be its range or the start."""
    source = fl.record("landmarks", seed=4, duration_s=2.0, landmarks=3)
    faulty = alter.altered(source, "/robot1/prior", alter.shifted("mean", 0), 2.0)
    given = {"kind": "ekf", **OPEN}
    base, likelihood = Trial("ekf", [faulty], given), Likelihood()
    seen = likelihood.begin(base)
    tried = hypotheses(bind("ekf", [faulty], given), base, seen, likelihood.readings)
    alike = [each for each in tried if each.part == "x_m"]
    [cause], listed, _ = find_causes(likelihood, base, [*alike, replace(alike[0])], 5)
    assert len(cause.others) == 1
    assert "; or, indistinguishable in this log, /robot1/prior: x_m at the start" in cause.words
    assert [each.at.gain for each in listed] == pytest.approx([cause.gain] * 2)


def innovations(nis: np.ndarray, accepted: np.ndarray) -> dict[str, fl.Stream]:
    """Innovations of one component, one a second."""
    count = len(nis)
    stream = fl.make_stream(
        "/estimates/ekf/robot1/innovation",
        fl.schemas.INNOVATION,
        np.arange(count) * 10**9,
        metadata={"components": "range_m", "kinds": "linear"},
        target_id=np.full(count, 7),
        accepted=accepted.astype(int),
        innovation=np.sqrt(nis)[:, None],
        covariance=np.ones((count, 1)),
        normalised_innovation_squared=nis,
        log_likelihood=-0.5 * nis,
    )
    return {stream.topic: stream}


def test_divergence_and_a_gate_that_locks_the_filter_out_have_their_time() -> None:
    rng = np.random.default_rng(1)
    nis = rng.chisquare(1, 400)
    well = np.ones(400, bool)
    assert not list(of_innovations(innovations(nis, well), 0.999, 0, has_outliers=False))
    nis[250:] *= 50.0
    [found] = of_innovations(innovations(nis, well), 1.0, 0, has_outliers=False)
    assert found.kind == "divergence"
    assert found.time_ns is not None
    assert 245e9 < found.time_ns < 260e9
    assert "after range_m of 7" in found.sentence
    locked = well & ~((np.arange(400) >= 100) & (np.arange(400) < 160))
    told = list(of_innovations(innovations(rng.chisquare(1, 400), locked), 0.999, 0, has_outliers=True))
    assert [each.kind for each in told] == ["gate"]
    assert "rejects all 60 measurements from 100 s to 159 s" in told[0].sentence
    rare = np.arange(400) % 10 > 0
    told = list(of_innovations(innovations(rng.chisquare(1, 400), rare), 0.999, 0, has_outliers=False))
    assert "rejects 10 % of the measurements (0.1 % expected)" in told[0].sentence


def fixes(position: np.ndarray, **stamps: Any) -> fl.Stream:
    """Position fixes, one a second."""
    count = len(position)
    return fl.make_stream(
        "/robot1/fix",
        fl.schemas.POSITION_FIX,
        **{"publish_time_ns": np.arange(count) * 10**9, **stamps},
        position_m=position,
        covariance_m2=np.tile(np.eye(2).ravel(), (count, 1)),
    )


def test_what_is_wrong_with_messages_is_said() -> None:
    rng = np.random.default_rng(2)
    place = np.cumsum(rng.normal(size=(300, 2)), axis=0)
    assert not lint([{"/robot1/fix": fixes(place)}])

    def told(stream: fl.Stream) -> str:
        [found] = lint([{stream.topic: stream}])
        return found.sentence

    twice = np.repeat(np.arange(300), 1 + (np.arange(300) % 30 == 0))
    assert "10 of its 310 messages are duplicates" in told(fixes(place).take(twice))
    clipped = np.minimum(place, [np.quantile(place[:, 0], 0.9), 99.0])
    assert "position_m x is saturated: 30 of 300 messages are at" in told(fixes(clipped))
    rounded = np.cumsum(rng.normal(size=(3000, 2)), axis=0)
    rounded[:, 0] = np.round(rounded[:, 0] / 2.0) * 2.0
    assert "position_m x is rounded to 2, but its noise is" in told(fixes(rounded))
    late_ns = np.arange(300) * 10**9 + (np.arange(300) % 10 == 0) * 2_500_000_000
    late = told(fixes(place, log_time_ns=late_ns))
    assert late.endswith("and are up to 2 s behind; replay them with --arrival-order --late rewind:2")
    silent = np.arange(300) + 60 * (np.arange(300) > 100)
    assert "is silent for 61 s from 100 s after its first stamp on" in told(
        fixes(place, publish_time_ns=silent * 10**9)
    )

    def ranges(stamps_ns: np.ndarray) -> fl.Stream:
        ids = {"anchor_id": np.ones(300, int), "tag_id": np.ones(300, int)}
        return fl.make_stream(
            "/r", fl.schemas.ANCHOR_RANGE, stamps_ns, **ids, range_m=50.0 + place[:, 0]
        )

    for step_ns in (200_000_000, 10**6):  # bursts of a sensor, as ranges to four anchors
        bursts_ns = np.arange(300) // 4 * 10**9 + np.arange(300) % 4 * step_ns
        assert not lint([{"/r": ranges(bursts_ns)}])
    bursts_ns[160:] += 60 * 10**9
    assert "is silent for 61 s from 39 s after its first stamp on, where the usual step is 0.997 s" in (
        told(ranges(bursts_ns))
    )


def test_components_of_which_the_same_is_true_are_one_sentence() -> None:
    """A recorded filter's fixes: x and y half as large as stated, z biased; w is well."""
    rng = np.random.default_rng(2)
    innovation = 0.5 * rng.normal(size=(400, 3)) + np.array([0.0, 0.0, 3.0])
    innovation = np.column_stack([innovation, rng.normal(size=400)])
    names = {"components": "x_m,y_m,z_m,w_m", "kinds": ",".join(["linear"] * 4)}
    stream = fl.make_stream(
        "/estimates/ekf2/vehicle/fix/innovation",
        fl.schemas.INNOVATION,
        np.arange(400) * 10**9,
        metadata={**names, "noise": "EKF2_GPS_P"},
        target_id=np.zeros(400, int),
        accepted=np.ones(400, int),
        innovation=innovation,
        covariance=np.tile(np.eye(4).ravel(), (400, 1)),
        normalised_innovation_squared=np.sum(innovation**2, axis=1),
        log_likelihood=np.zeros(400),
    )
    small, biased = of_each_component({stream.topic: stream})
    assert small.evidence == (
        "vehicle/fix: the innovations of x_m and y_m are 1.92 to 1.96 times smaller than their "
        "variances state (NIS is 0.26 to 0.27, consistent from 0.784 to 1.25): its noise "
        "(EKF2_GPS_P) is stated too large"
    )
    assert biased.evidence == (
        "vehicle/fix: the innovations of z_m are 2.98 times larger than their variances state (NIS "
        "is 8.9, consistent from 0.784 to 1.25): their mean is 2.94 standard deviations: "
        "the sensor is biased"
    )


def test_a_floor_of_the_covariance_is_told_from_a_steady_state() -> None:
    """A variance that settles comes ever closer to its least; one with a floor stops there."""

    def estimates(variance: np.ndarray) -> dict[str, fl.Stream]:
        count = len(variance)
        stream = fl.make_stream(
            "/estimates/ekf/robot1/pose",
            fl.schemas.GAUSSIAN_ESTIMATE,
            np.arange(count),
            metadata={"components": "x_m", "kinds": "linear"},
            mean=np.zeros((count, 1)),
            covariance=variance[:, None],
        )
        return {stream.topic: stream}

    settles = 1.0 + np.exp(-0.5 * np.arange(200))
    assert not list(of_estimates(estimates(settles)))
    [found] = of_estimates(estimates(np.maximum(0.97 ** np.arange(200), 0.2)))
    assert found.kind == "covariance floor"
    assert "is 0.2 in 7" in found.sentence


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_the_command_the_report_and_the_timeline_say_the_same(
    tmp_path: Path, run: fl.MemorySource, fuselog: Fuselog
) -> None:
    log, estimates = tmp_path / "run.mcap", tmp_path / "est.mcap"
    fl.write(log, run)
    wrong = ["--set", "sigma_range_m=0.025"]
    fuselog("replay", log, "-e", "ekf", *wrong, "-o", estimates)
    told = fuselog("diagnose", log, "-e", "ekf", *wrong, "--out", tmp_path / "out", "--json")
    found = json.loads(told.out)
    sentence = found["sentences"][0]["sentence"]
    assert found["sentences"][0]["low"] < 4.0 < found["sentences"][0]["high"]
    of_estimates = fuselog("diagnose", estimates).out  # the label and its settings are stated there
    assert f"1. {sentence}" in " ".join(of_estimates.split())
    fuselog("report", tmp_path / "out", "-o", tmp_path / "page.html")
    assert sentence in (tmp_path / "page.html").read_text(encoding="utf-8")
    marks = fl.diagnose(log, "ekf", set={"sigma_range_m": 0.025}).marks
    [stream] = marks.values()
    assert stream.topic == "/estimates/ekf/robot1/diagnosis"
    assert sentence in stream.metadata["reasons"]
    chunks = RrdReader(str(tmp_path / "out" / "timeline.rrd")).stream()
    drawn = " ".join(
        str(chunk.to_record_batch().to_pydict()) for chunk in chunks if "event" in chunk.entity_path
    )
    assert sentence in drawn


def test_bad_input_is_refused_with_a_sentence(tmp_path: Path, run: fl.MemorySource) -> None:
    with pytest.raises(
        fl.BadInput, match="dead-reckoning gives no innovations, which a diagnosis needs"
    ):
        fl.diagnose(run, "dead-reckoning")
    with pytest.raises(fl.BadInput, match="name the estimator to diagnose with -e"):
        fl.diagnose(run)
    with pytest.raises(fl.BadInput, match="give one estimator; only one can be diagnosed at a time"):
        fl.diagnose(run, {"ekf": {}, "ukf": {}})
    with pytest.raises(fl.BadInput, match="2 logs: give one log, such as"):
        fl.diagnose([run, run], "ekf")  # type: ignore[arg-type]
    log = tmp_path / "run.mcap"
    fl.write(log, run)


def test_without_truth_errors_are_left_out_and_that_is_said(
    run: fl.MemorySource, found: fl.Diagnosis
) -> None:
    streams = {topic: each for topic, each in run.streams.items() if not topic.endswith("/truth")}
    without = fl.diagnose(replace(run, streams=streams), "ekf")
    assert any(note.startswith("no truth: errors and NEES are missing") for note in without.notes)
    assert any(note.startswith("there is only one run") for note in found.notes)


@pytest.mark.parametrize(("bias_rad", "sides"), [(0.0, 0), (0.006, 1)])
def test_diagnose_and_tune_agree_on_errors_that_innovations_do_not_show(
    bias_rad: float, sides: int
) -> None:
    """A small bias, where NEES is 4 times what is expected, and NIS 1.08: both say the same."""
    seen = {"range_bearing": {"bias_bearing_rad": bias_rad}}
    done = fl.replay(fl.record("landmarks", seed=7, duration_s=20.0, **seen), {"tuned": {"kind": "ekf"}})
    made: Any = SimpleNamespace(replays=[done])
    tuned, told = [*Tuning._notes_of_truth(made)], [*unseen_errors(done, has_causes=False)]
    assert len(tuned) == len(told) == sides
    for note, each in zip(tuned, told, strict=True):
        evidence = each.sentence.removesuffix(f"; {each.otherwise}")
        assert note.startswith(f"tuned {evidence}; ")


def test_a_prior_that_states_no_kinds_is_diagnosed() -> None:
    """Angles are those in rad, as for a filter."""
    run = fl.record("landmarks", seed=3, duration_s=5.0)
    prior = run.streams["/robot1/prior"]
    bare = replace(prior, metadata={"components": prior.metadata["components"]})
    found = fl.diagnose(replace(run, streams={**run.streams, bare.topic: bare}), "ekf")
    assert found.sentences == fl.diagnose(run, "ekf").sentences


@pytest.mark.paper
def test_a_log_without_a_prior_is_diagnosed() -> None:
    """The filter began at the first fixes; there is no prior whose sigma could be wrong."""
    run = fl.record("landmarks", seed=3, duration_s=6.0, fix={"rate_hz": 2.0})
    streams = {topic: each for topic, each in run.streams.items() if not topic.endswith("/prior")}
    found = fl.diagnose(replace(run, streams=streams), "ekf")
    assert not any("prior" in each.sentence for each in found.sentences)
    assert set(found.components["component"]) >= {"x_m", "y_m", "range_m", "bearing_rad"}


@pytest.mark.paper
def test_the_worked_example_of_the_page(
    fuselog: Fuselog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its commands give its sentences; what they say to try leaves nothing to be found."""
    page = (Path(__file__).parents[2] / "docs" / "diagnose.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^fuselog (record|diagnose) (.*)$", page, re.MULTILINE)
    told = [fuselog(command, *shlex.split(options)) for command, options in commands]
    assert [(each.code, each.err) for each in told] == [(0, "")] * 3
    block = re.search(r"^1\. .*?(?=```)", page, re.MULTILINE | re.DOTALL)
    assert block is not None
    assert " ".join(block[0].split()) in " ".join(told[1].out.split())
    assert "nothing found" in told[2].out


@pytest.mark.paper
def test_the_study_counts_what_is_named_and_what_a_removal_gains(
    tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs each: a bias that is named, one too small to be counted, and runs without a fault."""
    landmarks = study.SCENARIOS["landmarks"]
    small = study.Fault(
        "bias or turned frame", SEEN, 0.002, record={"range_bearing": {"bias_range_m": 0.002}}
    )
    short = landmarks._replace(
        parameters={"duration_s": 12.0}, faults={"bias": landmarks.faults["bias"], "small": small}
    )
    monkeypatch.setattr(study, "SCENARIOS", {"landmarks": short})
    file = tmp_path / "few.toml"
    file.write_text('title = "few"\nstudy = "diagnosis"\nruns = 2\nseed = 3\n')
    said = fuselog("run", file, "--out", tmp_path / "out", "--json")
    assert said.code == 0, said.err
    told = said.json["metrics"]
    options = study.Options(battery_seed=5, battery_runs=9)
    assert study.battery_seeds(options, 2) == range(5, 7)  # so `--runs` makes all of it smaller
    assert told["diagnosis.worth.landmarks-bias"] > 50.0
    assert told["diagnosis.first_share.landmarks-bias"] == 1.0
    assert told["diagnosis.covered_share.landmarks-bias"] == 1.0
    assert told["diagnosis.counted.landmarks-small"] == 0.0
    assert told["diagnosis.first_share.landmarks-small"] is None
    assert told["diagnosis.first.landmarks-bias"] == told["diagnosis.first_two.landmarks-bias"] == 2.0
    assert told["diagnosis.nothing_share"] == 1.0
    assert told["diagnosis.counted"] == 2.0


def test_each_fault_of_the_study_changes_what_it_says_and_is_kept_by_its_name() -> None:
    """Of a log the messages of one topic alone, or the estimator's settings."""
    kept = stored()["diagnosis"].metrics
    for name, scenario in study.SCENARIOS.items():
        short = scenario._replace(parameters={**scenario.parameters, "duration_s": 12.0})
        for label, fault in scenario.faults.items():
            assert f"diagnosis.worth.{name}-{label}" in kept
            before, after = study._recorded(short, fault, 3, 0)
            changed = {
                topic
                for topic, stream in before.streams.items()
                if _bits(stream) != _bits(after.streams[topic])
            }
            altered = {fault.altered or fault.topic} if fault.alteration else set()
            recorded = {fault.topic or SEEN} if fault.record else set()
            assert changed == altered | {*(fault.exchanged or recorded)}, label
            assert bool(changed) != bool(fault.settings), label
    assert len([each for each in kept if each.startswith("diagnosis.worth.")]) == 3 + 10 + 9 + 10


def _bits(stream: fl.Stream) -> tuple:
    """All that a stream holds."""
    columns = (each.tobytes() for each in stream.columns.values())
    return stream.publish_time_ns.tobytes(), stream.log_time_ns.tobytes(), stream.metadata, *columns


def test_what_the_gate_keeps_out_names_no_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    """NIS outside what a consistent filter leaves is said beside it."""
    monkeypatch.setattr(diagnosis, "seek", lambda *_: Sought())
    log = fl.record("landmarks", seed=2, duration_s=20.0)
    found = fl.diagnose(log, "ekf", set={"sigma_range_m": 0.03})
    assert {"gate", "unnamed"} <= {each.kind for each in found.sentences}
