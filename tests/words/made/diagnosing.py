"""Sentences of `fuselog diagnose`: what may be wrong, what to try, and what is seen without a replay."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from fuselog.pipeline.api.api import record
from fuselog.pipeline.diagnosing.advice import Advice, Trying, number
from fuselog.pipeline.diagnosing.battery.car import faulty, recorded
from fuselog.pipeline.diagnosing.causes import Cause
from fuselog.pipeline.diagnosing.consistency import unnamed, unseen_errors
from fuselog.pipeline.diagnosing.diagnosis import Diagnosis
from fuselog.pipeline.diagnosing.findings import of_estimates, of_innovations
from fuselog.pipeline.diagnosing.hypotheses.components import of_components
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis
from fuselog.pipeline.diagnosing.hypotheses.listing import hypotheses, of_numbers
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.diagnosing.sentences import notes_of, ranked
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.lint import lint
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.verdicts import Squares

TRYING = Trying("ekf", {}, is_own=False)
SECOND_NS = 1_000_000_000


def all_faults() -> Iterator[str]:
    """Every fault of a car with a compass, too large and too small, and what to try."""
    source = recorded(faulty(2000, "nothing"), has_prior=True)
    settings = {"kind": "ekf", "gate_probability": 1.0}
    bound = bind("ekf", [source], settings)
    likelihood, base = Likelihood(), Trial("ekf", [source], settings)
    innovations = likelihood.begin(base)
    for each in hypotheses(bound, base, innovations, likelihood.readings):
        yield from _both_ways(each)


def exchanged() -> Iterator[str]:
    """Numbers of a map that may be exchanged: of innovations as they should be, and of larger ones."""
    source = record("landmarks", duration_s=2.0, landmarks=3)
    bound = bind("ekf", [source], {"kind": "ekf"})
    for nis in (1.9, 2.1):
        yield f"NIS {nis:g}:"
        seen = _innovations(np.full(200, nis), np.ones(200), np.arange(200) % 2 + 2)
        for each in of_numbers(bound, source, {"/estimates/ekf/robot1/innovation": seen}):
            yield from _both_ways(each)


def unread() -> Iterator[str]:
    """Faults of fixes by an estimator of which is not known what it reads."""
    fixes = recorded(faulty(2000, "nothing")).streams["/car/fix"]
    for each in of_components(fixes, None, None, 0):
        yield from _both_ways(each)


def _both_ways(each: Hypothesis) -> Iterator[str]:
    """A fault with numbers on either side of nothing."""
    values = [*each.tried[2:4], *each.specials] if each.size == 1 else [tuple(each.tried[0])]
    for at in dict.fromkeys(values):
        near = np.array(at)
        low, high = (tuple(end) if each.size > 1 else float(end) for end in (0.9 * near, 1.1 * near))
        remedy = each.remedy(at)
        advice = "no advice" if remedy is None else TRYING.words(remedy)
        told = "" if each.size > 1 else f" [{each.reported(at):.4g}]"
        yield f"{each.name}{told}: {each.words(at, low, high)}; try {advice}"


def advice() -> Iterator[str]:
    """What to try: over what is set, in a program of one's own, and with what to do instead."""
    scale, delay = Advice("/fix.x_scale", 2.0), Advice("/fix.delay_s", 0.5)
    for applied in (
        {},
        {"/fix.x_scale": 3.0, "/fix.delay_s": 0.25},
        {"/fix.x_scale": True, "/fix.delay_s": True},
    ):
        for is_own in (False, True):
            trying = Trying("mine", applied, is_own)
            yield from (trying.words(trying.over(each)) for each in (scale, delay))
    tuned = Advice("sigma_m", 0.2, free="sigma_m")
    wider = Advice("a b", "x", otherwise="a wider prior", more=(("lever_x_m", 1.0),))
    for is_own in (False, True):
        yield from (Trying("ekf", {}, is_own).words(each) for each in (tuned, wider))
    yield "; ".join(
        f"{value:g} is {number(value)}" for value in (999.4, 999.6, 1912.3, -0.25, 2.4e12, 0.0)
    )


def order() -> Iterator[str]:
    """What stands before what: stamps, then causes, or what they are a consequence of, then the rest."""
    stamps = Finding("stamps", "/fix", "", 1.0, "/fix: stamps")
    unit = Finding("unit", "/odometry", "x", 2.0, "/odometry: a unit", "/odometry.x_scale=2.0")
    known = Finding("values", "/odometry", "x", 1.0, "/odometry: a value")
    other = Finding("values", "/other", "x", 1.0, "/other: a value")
    for kind in ("measurement noise", "process noise", "delay", "factor or sign", "outliers"):
        hypothesis = Hypothesis(
            kind,
            "/odometry",
            "x",
            (-1.0, 1.0),
            9.0,
            lambda trial, _: trial,
            lambda at, low, high, kind=kind: f"{kind} of {at:g} ({low:g} to {high:g})",
            lambda at, kind=kind: None if kind == "outliers" else Advice(f"{kind}", at, free="x"),
        )
        rival = Cause(hypothesis, 2.0, (1.5, 2.5), 90.0)
        cause = Cause(hypothesis, 1.0, (0.5, 1.5), 1234.5, (rival,))
        for of_log in ([other, known, unit, stamps], [other]):
            yield f"{kind}, beside {len(of_log)}:"
            rest = None if len(of_log) > 1 else lambda _: ", and 12 over the rest of the log"
            said = ranked([cause], of_log, TRYING, rest)
            yield from (
                f"  {place}. {each.sentence} [{each.setting}]" for place, each in enumerate(said, 1)
            )
    yield "in one half alone:"
    for of_halves in ((-11.6, 250.0), (250.0, -1.93), (250.0, -1.91)):
        yield f"  {Cause(hypothesis, 1.0, (0.5, 1.5), 238.0, (), of_halves).words}"
    yield "in doubt:"
    judge: Any = SimpleNamespace(judge=SimpleNamespace(components_without_truth=[], bounds={}), logs=[])
    doubt = Cause(hypothesis, 1.0, (0.5, 1.5), 238.0, (), (-30.6, 268.6))
    yield from (f"  {each}" for each in notes_of(judge, [], [doubt]))
    yield "advised already:"
    found = ranked([], [unit, other], TRYING, None)
    yield from (f"  {each.sentence}" for each in found)


def told() -> Iterator[str]:
    """Nothing found: with faults that were tried, and with none; something found."""
    for tried, sentences in (
        (range(28), []),
        ([], []),
        ([], [SimpleNamespace(sentence="a sentence")] * 2),
    ):
        made: Any = SimpleNamespace(sentences=sentences, tried=tried, least_gain=6.37)
        made.hypotheses = Diagnosis.hypotheses.fget(made)  # type: ignore[attr-defined]
        yield from Diagnosis.told.fget(made)  # type: ignore[attr-defined]


def innovations() -> Iterator[str]:
    """Gates that keep out too much and filters that diverge, and those that nearly do."""
    rows = np.arange(400)
    well = np.where(rows % 2, 0.5, 1.5)
    for name, nis, kept, has_outliers in (
        ("all well", well, rows >= 0, False),
        ("19 kept out in a row", well, (rows < 100) | (rows >= 119), False),
        ("20 kept out in a row", well, (rows < 100) | (rows >= 120), False),
        ("20 kept out twice", well, (rows % 200 < 100) | (rows % 200 >= 120), False),
        ("one in 20 kept out", well, rows % 20 > 0, False),
        ("one in 19 kept out", well, rows % 19 > 0, False),
        ("one in 19 kept out, outliers", well, rows % 19 > 0, True),
        ("diverges", np.where(rows < 250, well, 50.0), rows >= 0, False),
        ("diverges at the end", np.where(rows < 350, well, 50.0), rows >= 0, False),
        ("was never well", np.full(400, 50.0), rows >= 0, False),
    ):
        stream = _innovations(nis, kept, np.full(400, 7))
        found = of_innovations({stream.topic: stream}, 0.999, -SECOND_NS, has_outliers=has_outliers)
        yield f"{name}: {' / '.join(each.sentence for each in found) or 'nothing'}"


def messages() -> Iterator[str]:
    """Messages that are lost, late, there twice, saturated or coarse, and nearly so."""
    rows, place = np.arange(300), _walk(300)
    times_ns = rows * SECOND_NS
    for name, stream in (
        ("all well", _fixes(place)),
        ("one in 50 lost", _fixes(place).take(rows % 50 != 49)),
        ("one in 40 lost", _fixes(place).take(rows % 40 != 39)),
        ("half lost", _fixes(place).take(np.random.default_rng(2).random(300) < 0.5)),
        ("20 s of silence", _fixes(place, publish_time_ns=times_ns + 19 * SECOND_NS * (rows > 99))),
        ("21 s of silence", _fixes(place, publish_time_ns=times_ns + 20 * SECOND_NS * (rows > 99))),
        ("one twice", _fixes(place).take(np.repeat(rows, 1 + (rows == 7)))),
        ("arrives late", _fixes(place, log_time_ns=times_ns + 2_500_000_000 * (rows % 10 == 0))),
        ("saturates above", _fixes(np.minimum(place, [np.quantile(place[:, 0], 0.9), 99.0]))),
        ("saturates below", _fixes(np.maximum(place, [-99.0, np.quantile(place[:, 1], 0.1)]))),
        ("coarse", _fixes(np.round(_walk(3000) / 2.0) * 2.0)),
        ("fine", _fixes(np.round(_walk(3000) * 20.0) / 20.0)),
    ):
        found = lint([{stream.topic: stream}])
        yield f"{name}: {' / '.join(each.sentence for each in found) or 'nothing'}"


def floors() -> Iterator[str]:
    """A variance with a floor, and one that settles."""
    for name, variance in (
        ("floor", np.maximum(0.97 ** np.arange(200), 0.2)),
        ("settles", 1.0 + np.exp(-0.5 * np.arange(200))),
    ):
        stream = make_stream(
            "/estimates/ekf/robot1/pose",
            schemas.GAUSSIAN_ESTIMATE,
            np.arange(200),
            metadata={"components": "x_m", "kinds": "linear"},
            mean=np.zeros((200, 1)),
            covariance=variance[:, None],
        )
        said = [each.sentence for each in of_estimates({stream.topic: stream})]
        yield f"{name}: {' / '.join(said) or 'nothing'}"


def unexplained() -> Iterator[str]:
    """NEES and NIS that nothing explains, and those that need no explanation."""
    for nees, nis in ((3.0, 1.0), (4.1, 1.4), (4.1, 1.6), (1.9, 1.0)):
        judge = SimpleNamespace(
            metrics={"ekf.nees.robot1": nees, "ekf.nis_per_component.robot1": nis},
            bounds={"ekf.nees.robot1": (2.0, 4.0)},
            intervals=lambda _: {"ekf.nees.robot1": (2.0, 4.0)},
            squares=lambda *_, nees=nees: Squares("nees", Interval(nees), 1.0, (2.0, 4.0)),
        )
        done: Any = SimpleNamespace(judge=judge)
        yield f"NEES {nees:g}, NIS {nis:g}:"
        for has_causes in (False, True):
            yield from (f"  {each.sentence}" for each in unseen_errors(done, has_causes=has_causes))
        stream = _innovations(np.full(400, nis), np.ones(400), np.full(400, 7))
        for tried in (28, 0):
            yield from (
                f"  {each.sentence}" for each in unnamed(done, {stream.topic: stream}, tried, [])
            )
        yield from (f"  no judge: {each.sentence}" for each in unnamed(done, {}, 28, ["/robot1/truth"]))


def _walk(count: int) -> Any:
    return np.cumsum(np.random.default_rng(2).normal(size=(count, 2)), axis=0)


def _innovations(nis: Any, accepted: Any, targets: Any) -> Stream:
    """Innovations of one component, one a second."""
    return make_stream(
        "/estimates/ekf/robot1/innovation",
        schemas.INNOVATION,
        np.arange(len(nis)) * SECOND_NS,
        metadata={"components": "range_m", "kinds": "linear"},
        target_id=targets,
        accepted=np.asarray(accepted).astype(int),
        innovation=np.sqrt(nis)[:, None],
        covariance=np.ones((len(nis), 1)),
        normalised_innovation_squared=nis,
        log_likelihood=-0.5 * nis,
    )


def _fixes(position: Any, **stamps: Any) -> Stream:
    """Position fixes, one a second."""
    count = len(position)
    return make_stream(
        "/robot1/fix",
        schemas.POSITION_FIX,
        **{"publish_time_ns": np.arange(count) * SECOND_NS, **stamps},
        position_m=position,
        covariance_m2=np.tile(np.eye(2).ravel(), (count, 1)),
    )


DIAGNOSED = (
    *(all_faults, exchanged, unread, advice, order, told),
    *(innovations, messages, floors, unexplained),
)
