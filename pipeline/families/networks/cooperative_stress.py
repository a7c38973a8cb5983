"""Study of robots that share estimates under stress, on recorded logs.

When a robot observes another, both receive a message. The study removes some of the robots' sightings of
each other from the log: all except one per interval, a random half, or those of a robot that leaves. In
another case, a robot has a wrong and overconfident prior. The estimators fuse immediately, so
`network-stress` tests out-of-sequence messages. Intervals are over the robots; for the wrong prior, they
exclude the robot that has it.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import PositiveFloat, PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.intervals import mean_interval

Booleans = NDArray[np.bool_]

MESSAGE_BYTES = 8 * (1 + 3 + 6)  # stamp, pose, triangle of its covariance
SEED = 1
# fewest robots for an interval of the mean NEES; a recording has no more correct robots
FEWEST_ROBOTS = 4


class CooperativeStressOptions(Parameters):
    """The stress on the robots.

    Attributes:
        intervals_s: minimum times in s between sightings at which two robots share estimates, one case
            for each.
        leaving: number of the robot that is absent in the middle third.
        liar: number of the robot whose prior is wrong.
        lie_m: error of the wrong prior along x, in m.
    """

    intervals_s: tuple[PositiveFloat, ...] = (2.0, 10.0, 30.0, 100.0, 300.0)
    leaving: PositiveInt = 5
    liar: PositiveInt = 1
    lie_m: PositiveFloat = 2.0


# (stream, robot that sees, rows that are sightings of robots) -> rows to keep.
Keep = Callable[[Stream, int, Booleans], Booleans]


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: CooperativeStressOptions = setting.options
    runner = Runner(experiment, setting)
    calm = runner.run()
    numbers = _robots(calm.sources[0], options)
    generator = np.random.default_rng(SEED)
    cases: dict[str, Callable[[MemorySource], MemorySource]] = {
        f"once in {interval_s:g} s": partial(
            _edited, keep=partial(_once_in, interval_s), numbers=numbers
        )
        for interval_s in options.intervals_s
    }
    cases["half lost"] = partial(_edited, keep=partial(_half, generator), numbers=numbers)
    cases["leaving"] = partial(_edited, keep=partial(_while_there, options.leaving), numbers=numbers)
    cases["lying"] = partial(_lying, options=options)
    parts = [_rows(calm, calm.sources, numbers).assign(case="calm")]
    for name, edit in cases.items():
        sources = [edit(source) for source in calm.sources]
        parts.append(_rows(runner.replay(sources), sources, numbers).assign(case=name))
    table = pd.concat(parts, ignore_index=True)
    outcome = Outcome(tables={"robots": table})
    for row in table.to_dict("records"):
        case = f"{row['case']}-{row['robot']}".replace(" ", "-").replace(".", "_")
        for quantity in ("position_rmse_m", "position_nees"):
            outcome.metrics[f"{row['estimator']}.{quantity}.{case}"] = row[quantity]
    others = table[(table["case"] != "lying") | (table["robot"] != f"robot{options.liar}")]
    for (label, stress), nees in others.groupby(["estimator", "case"], sort=False)["position_nees"]:
        key = f"{label}.mean_position_nees.{stress}".replace(" ", "-")
        outcome.measure(key, mean_interval(nees, FEWEST_ROBOTS))
    outcome.figures["bandwidth"] = _chart(table)
    outcome.input_sha256 = hash_streams(calm.sources)
    return outcome


def _robots(source: MemorySource, options: CooperativeStressOptions) -> list[int]:
    """List a log's robots; raise BadInput if the robot that leaves or the one that lies is missing."""
    topics = [topic.removeprefix("/robot").partition("/") for topic in source.streams]
    numbers = sorted(int(number) for number, _, leaf in topics if leaf == "range_bearing")
    for name in ("leaving", "liar"):
        if getattr(options, name) not in numbers:
            raise BadInput(
                f"options.{name} = {getattr(options, name)} is not one of the robots "
                f"{', '.join(map(str, numbers))} of {source.name}; give one of these"
            )
    return numbers


def _edited(source: MemorySource, keep: Keep, numbers: Sequence[int]) -> MemorySource:
    """Remove some of the sightings of robots from the log."""
    streams = dict(source.streams)
    for number in numbers:
        stream = streams[f"/robot{number}/range_bearing"]
        fellow = np.isin(stream["target_id"], numbers)
        streams[stream.topic] = stream.take(np.flatnonzero(~fellow | keep(stream, number, fellow)))
    return replace(source, streams=streams)


def _once_in(interval_s: float, stream: Stream, _: int, fellow: Booleans) -> Booleans:
    """Select at most one sighting of each other robot per interval."""
    kept = np.zeros(len(stream), bool)
    for target in np.unique(stream["target_id"][fellow]):
        last_ns = -np.inf
        for row in np.flatnonzero(stream["target_id"] == target).tolist():
            if stream.publish_time_ns[row] - last_ns >= interval_s * 1e9:
                kept[row], last_ns = True, stream.publish_time_ns[row]
    return kept


def _half(generator: np.random.Generator, stream: Stream, _: int, __: Booleans) -> Booleans:
    """Select a random half."""
    return generator.uniform(size=len(stream)) < 0.5


def _while_there(leaving: int, stream: Stream, robot: int, _: Booleans) -> Booleans:
    """Select all sightings except those of or by the leaving robot in the middle third of the log."""
    times = stream.publish_time_ns
    first, second = times[0] + (times[-1] - times[0]) * np.array([1, 2]) // 3
    is_away = (times >= first) & (times < second)
    return ~is_away | ((robot != leaving) & (stream["target_id"] != leaving))


def _lying(source: MemorySource, options: CooperativeStressOptions) -> MemorySource:
    """Shift one robot's prior without changing its covariance."""
    prior = source.streams[f"/robot{options.liar}/prior"]
    mean = prior["mean"].copy()
    mean[:, 0] += options.lie_m
    moved = replace(prior, columns={**prior.columns, "mean": mean})
    return replace(source, streams={**source.streams, prior.topic: moved})


def _rows(replayed: Replayed, sources: Sequence[MemorySource], numbers: Sequence[int]) -> pd.DataFrame:
    """Tabulate, by estimator and robot, position RMSE and NEES, and the bytes sent per second."""
    sightings, span_s = 0, 0.0
    for source in sources:
        seen = [source.streams[f"/robot{number}/range_bearing"] for number in numbers]
        sightings += sum(int(np.isin(each["target_id"], numbers).sum()) for each in seen)
        first_ns, last_ns = source.extent("publish_time")
        span_s += (last_ns - first_ns) * 1e-9
    rows = []
    for errors in replayed.errors:
        place = errors.position
        error, covariance = errors.error[:, place], errors.covariance[:, place][:, :, place]
        nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
        rows.append(
            {
                "estimator": errors.estimator,
                "robot": errors.case.partition("/")[0],
                "position_rmse_m": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
                "position_nees": float(np.mean(nees)),
                # a sighting is a message to each of the two robots
                "bytes_per_s": 2 * sightings * MESSAGE_BYTES / span_s / len(numbers),
            }
        )
    return pd.DataFrame(rows)


def _chart(table: pd.DataFrame) -> Chart:
    """Draw mean errors and NEES of the robots over the bytes that a robot sends per second."""
    chosen = table[table["case"].str.startswith("once") | (table["case"] == "calm")]
    means = chosen.groupby(["estimator", "case", "bytes_per_s"], sort=False).mean(numeric_only=True)
    panels = []
    for quantity, label in (
        ("position_rmse_m", "RMSE of the position (m)"),
        ("position_nees", "NEES of the position"),
    ):
        panel = Panel(x=Axis(label="sent by a robot (B/s)", log=True), y=Axis(label=label, log=True))
        for estimator, rows in means.reset_index().groupby("estimator", sort=False):
            rows = rows.sort_values("bytes_per_s")
            panel.series.append(
                curve(str(estimator), rows["bytes_per_s"], rows[quantity], "line+markers")
            )
        panels.append(panel)
    panels[1].series.append(level("consistent", np.sort(means.reset_index()["bytes_per_s"]), 2))
    return Chart(columns=2, panels=panels)


COOPERATIVE_STRESS = Study(
    "robots that rarely share, leave, or start at a wrong position: errors and consistency",
    study,
    CooperativeStressOptions,
)
