"""Replays as a function: takes logs and estimators, and answers all that can be asked of the result.

The estimates are in a scratch folder for as long as the replay or one of its estimates is referred to:
memory holds the metrics' sums, and what is asked for.
"""

import hashlib
import json
import weakref
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from fuselog.pipeline.altering.sources import setting_of
from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.api.planning import Log, Named, plan_replay
from fuselog.pipeline.output.alarming import alarms_of
from fuselog.pipeline.output.charts import draw
from fuselog.pipeline.output.coverage import coverage_table, sentences
from fuselog.pipeline.output.outputs import TIMELINE, check_files, check_folder
from fuselog.pipeline.output.results import in_order, plain, result_folder, write_outcome
from fuselog.pipeline.output.showing import Showing, Shown, shown_metrics
from fuselog.pipeline.output.summary import error_charts, summarise, summary_table
from fuselog.pipeline.runs.ensemble import Pass, Settings, judge_logs
from fuselog.pipeline.runs.estimates import add_to_hash
from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput, choices, without_warnings_of_numbers
from fuselog.recorders.log import open_log, schemas, topics_of
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.linting import of_first_messages
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source
from fuselog.replay.judging.errors.evaluation import Errors, innovations_of
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.tables import error_table, joined

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@without_warnings_of_numbers()
def replay(
    logs: Log | Iterable[Log],
    estimators: Named | Iterable[Named],
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    start_from: str | Path | Sequence[str | Path] = (),
    start_sigma: Mapping[str, float] | None = None,
    gap_limit_s: float = 0.2,
    arrival_order: bool = False,
    late: str | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    metrics: str | Sequence[str] | None = None,
) -> "Replay":
    """Replay estimators over logs, and judge them where there is truth.

    Args:
        logs: paths, logs that were opened, or recordings: one, or several that hold the same topics.
        estimators: registered names, an `Estimator`, as `recursive`, `batch` and `modelled` make them,
            or labels of your own with what they stand for: an `Estimator`, or settings, whose `kind` is
            a name or an `Estimator`:
            `["ekf", {"mine": LOCATE, "wide": {"kind": "ekf", "sigma_range_m": 0.2}}]`.
        start_s: where the replayed span begins, in seconds since each run's epoch.
        end_s: where it ends.
        start_from: what filters begin with at `start_s`: "truth", or the estimates log of an earlier
            replay for each log.
        start_sigma: how well the truth is known, by component; by default as the log's prior has it.
        gap_limit_s: the truth is not interpolated over longer gaps.
        arrival_order: go by log time, as the messages arrived.
        late: what is done about messages that then come late, by their stamps: "drop", "wait:0.5" (in
            seconds), "rewind:0.5"; by default they count as measured when they arrived.
        set: parameters of all estimators that have them, and how topics are altered before they are
            replayed: `{"gate_probability": 1.0, "/fix.delay_s": 0.3}`.
        metrics: which ones; none stands for all.

    Returns:
        The estimates of every run, and as tables their metrics, errors and innovations.

    Raises BadInput where no run can be replayed by one of the estimators.

    >>> from fuselog.pipeline.api.api import record
    >>> done = replay(record("landmarks", duration_s=2.0), ["ekf", {"sure": {"kind": "ekf"}}])
    >>> sorted(done.metrics["estimator"].unique())
    ['ekf', 'sure']
    """
    plan = plan_replay(
        logs,
        estimators,
        start_s=start_s,
        end_s=end_s,
        start_from=start_from,
        start_sigma=start_sigma,
        gap_limit_s=gap_limit_s,
        arrival_order=arrival_order,
        late=late,
        set=set,
        metrics=metrics,
    )
    sources = plan.sources
    with ExitStack() as stack:
        folder = stack.enter_context(scratch_folder("fuselog-replay"))
        names = [f"run-{number:04d}.mcap" for number in range(len(sources))]
        places = [(folder / name, folder / "logs" / name) for name in names]
        done = plan.replay(places)
        scratch = _Scratch()
        estimates = [_Estimated(open_log(path), scratch=scratch) for path, _ in places]
        weakref.finalize(scratch, stack.pop_all().close)
    return Replay(sources, estimates, plan.estimators, done, gap_limit_s, arrival_order, late)


class _Scratch:
    """Is referred to by all that is read of a scratch folder, which is removed with the last of it."""


@dataclass(frozen=True, repr=False)
class _Estimated(LogSource):
    """Represents the estimates of a run, whose file lasts as long as this."""

    scratch: _Scratch = field(default_factory=_Scratch)


@dataclass(frozen=True, eq=False, repr=False)
class Replay(Showing):
    """Holds what estimators made of logs.

    Attributes:
        logs: the runs.
        estimates: for each of them a log of what was estimated, by topic.
        settings: the estimators by label, as they were given.
        done: the pass: its judge, all parameters, and how long each estimator worked.
        gap_limit_s: the truth is not interpolated over longer gaps.
        arrival_order, late: as they were given.
    """

    logs: Sequence[LogSource | MemorySource]
    estimates: Sequence[Source]
    settings: Settings
    done: Pass
    gap_limit_s: float
    arrival_order: bool = False
    late: str | None = None

    @property
    def judge(self) -> Judge:
        """Judge what the estimators are worth."""
        return self.done.judge

    @property
    def _shown(self) -> Shown:
        runs = self.logs[0].name if len(self.logs) == 1 else f"{len(self.logs)} runs"
        sentences = [each.sentence for each in self.alarms[:1]]
        sentences += [*self.judge.components_without_truth, *self.failures, *self.losses]
        metrics = in_order(plain(self.judge.metrics), self.settings)
        title = f"Replay of {runs} by {', '.join(self.settings)}"
        return shown_metrics(title, sentences, metrics, self.judge.bounds)

    @cached_property
    def metrics(self) -> pd.DataFrame:
        """Return a row per metric, by estimators: estimator, quantity, case, value, low, high.

        From `low` to `high` lie 95 % of the values of a consistent estimator; NaN where that is unknown.
        """
        metrics, bounds = in_order(self.judge.metrics, self.settings), self.judge.bounds
        intervals = np.array([bounds.get(key, (np.nan, np.nan)) for key in metrics]).reshape(-1, 2)
        return summary_table(metrics).assign(low=intervals[:, 0], high=intervals[:, 1])

    @property
    def runs(self) -> pd.DataFrame:
        """Return a row per estimator, case and run: estimates, RMSE of each quantity, mean NEES."""
        return self.judge.runs_table

    @property
    def steps(self) -> pd.DataFrame:
        """Return a row per estimator, case and step, over runs: RMSE, mean NEES, its 95 % interval."""
        return joined(self.judge.steps.values())

    @property
    def times(self) -> pd.DataFrame:
        """Return a row per estimator, case, run and span of time."""
        return self.judge.times

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Return a row per estimate that has truth: error and sigma of every component, NEES."""
        tables: list[pd.DataFrame] = []

        def keep(errors: Errors) -> None:
            tables.append(error_table(errors))

        judge_logs(self.estimates, self.logs, {}, gap_limit_s=self.gap_limit_s, on_errors=keep)
        return joined(tables)

    @cached_property
    def innovations(self) -> pd.DataFrame:
        """Return a row per predicted measurement: its NIS, its components, whether it was let in."""
        found = [
            innovations_of(gather([log.read([topic])[topic]]), run)
            for run, log in enumerate(self.estimates)
            for topic in topics_of(log.topics, schemas.INNOVATION)
        ]
        tables = [pd.DataFrame(each._asdict()).rename(columns={"squared": "nis"}) for each in found]
        return joined(tables)

    @property
    def failures(self) -> list[str]:
        """Return a sentence for every run that an estimator could not follow to the end, or at all."""
        return self.judge.failures

    @property
    def losses(self) -> list[str]:
        """Return a sentence for what was not estimated throughout, and for measurements not used."""
        return [*self.judge.notes_of_coverage, *sentences(self.done.coverage)]

    @cached_property
    def alarms(self) -> list[Finding]:
        """Return what makes the numbers doubtful, the worst first."""
        return alarms_of(self.judge, self.done.parameters, self.done.coverage)

    @property
    def coverage(self) -> pd.DataFrame:
        """Return what became of the logs' topics by estimator: messages, used, gated, skipped, why."""
        return coverage_table(self.done.coverage)

    def figure(self, case: str | None = None) -> "Figure":
        """Draw RMSE and NEES over time of a `case` such as `robot1`, by default of the first.

        Raises BadInput where there is no such case, or nothing was judged.
        """
        charts = error_charts(self.judge)
        if not charts:
            raise BadInput("nothing to draw: no estimate has a truth")
        case = next(iter(charts)) if case is None else case
        if case not in charts:
            raise BadInput(f"nothing with the name '{case}' was judged; {choices(case, charts)}")
        return draw(charts[case])

    def view(self, run: int = 0, *, focus: str | None = None, save: str | Path | None = None) -> None:
        """Show the timeline of a run: in the notebook, else in the viewer; or write it to an .rrd file.

        Args:
            run: which run.
            focus: the case that is seen first, such as `robot3`.
            save: the file to write; nothing is shown then.

        Raises BadInput where there is no such run or case, no viewer, or the file cannot be written.
        """
        from fuselog.replay.timeline import viewer

        if not 0 <= run < len(self.logs):
            raise BadInput(f"no run {run} to show; the runs are 0 to {len(self.logs) - 1}")
        if save is not None:
            check_files([(Path(save), TIMELINE)], {"log": self.paths})
            self._draw(run, focus, Path(save))
            return
        with scratch_folder("fuselog-view") as folder:
            rrd = folder / "timeline.rrd"
            self._draw(run, focus, rrd)
            show = viewer.view_inline if viewer.in_notebook() else viewer.view
            show(rrd)

    def _draw(self, run: int, focus: str | None, rrd: Path) -> None:
        from fuselog.replay.timeline.show import Drawing

        log = self.logs[run]
        identity = json.dumps([str(log.start_ns), self.settings], default=str)
        with Drawing(log.whole(), identity=identity, focus=focus, save=rrd) as drawing:
            judge_logs([self.estimates[run]], [log], {}, gap_limit_s=self.gap_limit_s, drawing=drawing)

    def save(self, folder: str | Path) -> ResultFolder:
        """Write metrics, tables and figures to the result folder `folder`, for `fuselog report`.

        Raises BadInput where something else than a result of ours is in the place.
        """
        place = Path(folder)
        check_folder(place, {"input": self.paths})
        settings = {
            "title": f"replay of {self.logs[0].name}",
            "logs": [log.name for log in self.logs],
            "estimators": json.loads(json.dumps(self.settings, default=str)),
            **setting_of(self.logs[0]),
            "parameters": self.done.parameters,
            "gap_limit_s": self.gap_limit_s,
        }
        stated = {"arrival_order": self.arrival_order or None, "late": self.late}
        settings |= {name: value for name, value in stated.items() if value is not None}
        settings |= {"notes": of_logs} if (of_logs := of_first_messages(self.logs)) else {}
        with result_folder(place) as part:
            outcome = summarise(self.judge, self.done.coverage, self.done.parameters)
            outcome.input_sha256, outcome.timings = self.input_sha256, self.done.timings
            outcome.kind = "replay"
            return ResultFolder(place, write_outcome(part, "replay", settings, outcome))

    @property
    def paths(self) -> list[Path]:
        """Return the files that were replayed."""
        return [log.log.path for log in self.logs if isinstance(log, LogSource)]

    @property
    def input_sha256(self) -> str:
        """Return the SHA-256 of what was replayed: of logs their files, of recordings their columns."""
        digest = hashlib.sha256()
        for log in self.logs:
            if isinstance(log, MemorySource):
                add_to_hash(digest, log)
            else:
                with log.log.path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()
