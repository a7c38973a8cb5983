"""What a replay says of its own numbers: alarms, and measurements that were not used."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from fuselog.pipeline.output.alarming import NIS, alarms_of
from fuselog.pipeline.output.coverage import sentences
from fuselog.pipeline.output.terminal import print_others, print_worst
from fuselog.recorders.checks.finding import Finding
from fuselog.replay.engine.replaying.usage import EARLY, SILENT, UNTAKEN, Row
from fuselog.replay.judging.consistency.conditioning import Conditioning
from fuselog.replay.judging.errors.constant import Constant
from fuselog.replay.judging.errors.evaluation import chi_square_interval, split_topic
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.metrics.measuring import metric_key
from fuselog.replay.judging.verdicts import Squares
from tests.words.made.printing import printed

POSE = "/estimates/ekf/robot1/pose"
GATES = {"ekf": {"gate_probability": 0.99}}


def innovations() -> Iterator[str]:
    """A gate and NIS: within what a consistent filter leaves, just beyond, and far beyond."""
    for messages, accepted, squared in (
        (1000, 990, 990),
        (1000, 979, 979),
        (1000, 978, 978),
        (1000, 1000, 860),
        (1000, 1000, 840),
        (1000, 1000, 1150),
        (1000, 1000, 1160),
        (10000, 9900, 10700),
        (1000, 0, 9e6),
        (0, 0, 0),
    ):
        yield f"{accepted} of {messages}, squares {squared:g}:"
        yield from _words(_judge(innovations={POSE: _sums(messages, accepted, squared)}), GATES)
    yield "10 of 1000, the gate open:"
    open_ = {"ekf": {"gate_probability": 1.0}}
    yield from _words(_judge(innovations={POSE: _sums(1000, 990, 1000)}), open_)


def errors() -> Iterator[str]:
    """NEES, and errors that stay."""
    bounds = {"ekf.nees.robot1": (2.0, 4.0), "ekf.position_nees.robot1": (1.0, 3.0)}
    origin = Constant(False, np.array([1.0, -2.0]), share=0.9, nees=100.0, rest=4.0)
    lever = Constant(True, np.array([1.0, -2.0, 0.5]), share=0.5, nees=100.0, rest=4.0)
    flat = Constant(True, np.array([1.0, -2.0]), share=0.5, nees=100.0, rest=4.0)
    for nees, of_position, constant in (
        (3.0, 2.0, None),
        (4.0, 2.0, None),
        (4.1, 2.0, None),
        (1.9, 2.0, None),
        (4.1, 3.1, origin),
        (4.1, 3.1, lever),
        (4.1, 2.0, flat),
        (1.9, 0.5, origin),
    ):
        yield f"NEES {nees:g}, of the position {of_position:g}:"
        metrics = {"ekf.nees.robot1": nees, "ekf.position_nees.robot1": of_position}
        constants = {("ekf", "robot1"): constant} if constant else {}
        yield from _words(_judge(metrics=metrics, bounds=bounds, constants=constants))
    metrics = {"ekf.nees.robot1": 9.0, "ekf.position_nees.robot1": 2.0}
    judge = _judge(metrics=metrics, bounds=bounds, innovations={POSE: _sums(100, 100, 100)})
    yield "of a filter that gives innovations:"
    yield from _words(judge)


def costs() -> Iterator[str]:
    """A search that ended at the least cost, at more, and at more with noise that is too small."""
    for cost, squared in ((50.0, 100), (70.0, 100), (80.0, 100), (80.0, 130)):
        yield f"cost {cost:g} per run, squares {squared}:"
        judge = _judge(
            metrics={"ekf.cost.robot1": cost}, innovations={POSE: _sums(200, 200, 2 * squared)}
        )
        judge.runs = 2
        yield from _words(judge, {"ekf": {"gate_probability": 1.0}})


def gates() -> Iterator[str]:
    """Gates that are the same, that differ, and that differ but kept nothing out."""
    for gate, accepted in ((0.99, 999), (0.999, 999), (0.999, 1000)):
        both = {
            POSE: _sums(1000, accepted, accepted),
            POSE.replace("ekf", "ukf"): _sums(1000, 1000, 1000),
        }
        yield f"{gate:g}, {accepted} of 1000:"
        parameters = {
            **GATES,
            "ukf": {"gate_probability": gate},
            "dead-reckoning": {"gate_probability": 1.0},
        }
        yield from _words(_judge(innovations=both), parameters)


def measurements() -> Iterator[str]:
    """What became of a topic: the sentence, and whether it is an alarm."""
    for used, gated, skipped, why in (
        (100, 0, 0, ""),
        (90, 10, 0, ""),
        (95, 0, 0, EARLY),
        (94, 0, 0, EARLY),
        (50, 10, 40, "no landmark"),
        (0, 0, 100, "no landmark"),
        (0, 0, 0, UNTAKEN),
        (0, 0, 0, f"{UNTAKEN}; with rolling it does"),
        (0, 0, 0, SILENT),
        (None, None, 0, "not counted"),
        (None, None, 0, ""),
    ):
        row = Row("ekf", "/fix", 100, used, gated, skipped, why)
        of_others = [Row("ekf", "/range", 5, 5, 0, 0, "")]
        yield f"used {used}, gated {gated}, skipped {skipped}, {why or 'no reason'}:"
        for sentence in sentences([row, *of_others]):
            yield f"  {sentence}"
        yield from _words(_judge(), coverage=[row, *of_others])
    yield "of one that takes no measurements at all:"
    alone = [Row("dead-reckoning", "/fix", 100, 0, 0, 0, UNTAKEN)]
    yield from [*sentences(alone), *_words(_judge(), coverage=alone)]


def many() -> Iterator[str]:
    """How many alarms are printed."""
    for count in (0, 1, 5, 6):
        alarms = [Finding("errors", "ekf", "", 1.0, f"alarm {number}") for number in range(1, count + 1)]
        yield f"{count}:"
        yield from printed(lambda given: (print_worst(given), print_others(given)), alarms)


def _words(judge: Any, parameters: Any = None, coverage: Any = ()) -> Iterator[str]:
    for alarm in alarms_of(judge, parameters or {}, coverage):
        yield f"  {alarm.kind}, {alarm.value:.4g} times: {alarm.sentence}"


def _sums(messages: int, accepted: int, squared: float) -> Any:
    total = SimpleNamespace(
        messages=messages,
        accepted=accepted,
        degrees=messages,
        accepted_degrees=accepted,
        squared=float(squared),
    )
    return SimpleNamespace(total=total)


def digits() -> Iterator[str]:
    """Covariances, as rounding leaves them."""
    innovation = POSE.replace("pose", "innovation")
    for topic, lost, failed, least in (
        (POSE, 0, 0, 2e-12),
        (POSE, 3, 0, 2e-13),
        (innovation, 3, 0, -1e-16),
        (POSE, 3, 1, -0.5),
    ):
        yield f"{lost} lost, {failed} failed:"
        found = Conditioning(100, lost, failed, least, 0, 12.34)
        yield from _words(_judge(conditioning={topic: found}))


def _judge(
    *,
    innovations: Any = None,
    metrics: Any = None,
    bounds: Any = None,
    constants: Any = None,
    conditioning: Any = None,
) -> Any:
    totals = {topic: each.total for topic, each in (innovations or {}).items() if each.total.degrees}
    sizes = {metric_key(split_topic(topic)[0], NIS, "robot1"): each for topic, each in totals.items()}
    metrics = {**{key: each.squared / each.degrees for key, each in sizes.items()}, **(metrics or {})}

    def intervals(probability: float) -> dict[str, tuple[float, float]]:
        ends = {key: chi_square_interval(each.degrees, 1, probability) for key, each in sizes.items()}
        of_nis = {
            key: (low / sizes[key].degrees, high / sizes[key].degrees)
            for key, (low, high) in ends.items()
        }
        return of_nis | (bounds or {})

    def squares(estimator: str, quantity: str, case: str) -> Squares:
        key = metric_key(estimator, quantity, case)
        aim = {"nees": 3.0, "position_nees": 2.0, NIS: 1.0}[quantity]
        return Squares(quantity, Interval(metrics[key]), aim, intervals(0.95)[key])

    return SimpleNamespace(
        conditioning=conditioning or {},
        uninformed={},
        unestimated={},
        innovations=innovations or {},
        metrics=metrics,
        intervals=intervals,
        squares=squares,
        constants=constants or {},
        judged=[POSE],
        runs=1,
    )


ALARMED = (innovations, errors, costs, digits, gates, measurements, many)
