"""Replay as a function, which returns an object with all estimates, tables and figures.

Estimates are stored in a temporary folder for as long as the replay or one of its estimates is
referenced. Memory holds only the sums of the metrics and the tables that were requested.
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
from fuselog.recorders.processes import in_notebook
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
    """Replay estimators over logs, and judge the estimates if there is truth.

    Args:
        logs: one or several logs with the same topics: paths, opened logs, or recordings.
        estimators: registered names; an `Estimator` made by `recursive`, `batch` or `modelled`; or
            labels of your own, mapped to an `Estimator` or to settings whose `kind` is a name or an
            `Estimator`: `["ekf", {"mine": LOCATE, "wide": {"kind": "ekf", "sigma_range_m": 0.2}}]`.
        start_s: start of the replayed span, in seconds since each run's epoch.
        end_s: end of the span.
        start_from: initial state of filters at `start_s`: "truth", or for each log the estimates log of
            an earlier replay.
        start_sigma: standard deviations by component for a start from the truth; by default those of the
            prior.
        gap_limit_s: the longest gap over which the truth is interpolated.
        arrival_order: process messages in order of log time, as they arrived.
        late: handling of messages that arrive out of sequence: "drop", "wait:0.5" (in seconds) or
            "rewind:0.5"; by default, they are treated as if measured on arrival.
        set: parameters of all estimators that have them, and changes of topics before the replay:
            `{"gate_probability": 1.0, "/fix.delay_s": 0.3}`.
        metrics: names of the metrics to compute; all by default.

    Returns:
        The estimates of every run, with tables of metrics, errors and innovations.

    Raises BadInput if an estimator cannot replay any run.

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
    """A token for a temporary folder, which is removed with the last reference to the token."""


@dataclass(frozen=True, repr=False)
class _Estimated(LogSource):
    """The estimates of a run, whose file exists as long as this object."""

    scratch: _Scratch = field(default_factory=_Scratch)


@dataclass(frozen=True, eq=False, repr=False)
class Replay(Showing):
    """The result of a replay.

    Attributes:
        logs: the runs.
        estimates: for each run a log of its estimates, by topic.
        settings: the estimators by label, as given.
        done: the result of the pass over the logs: the judge, all parameters, and each estimator's time.
        gap_limit_s: the longest gap over which the truth is interpolated.
        arrival_order, late: as given.
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
        """Return the judge, which contains the sums of all metrics."""
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
        """Return a table with a row per metric: estimator, quantity, case, value, low, high.

        A metric of a consistent estimator is between `low` and `high` with a probability of 95 %; both
        are NaN if the interval is unknown.
        """
        metrics, bounds = in_order(self.judge.metrics, self.settings), self.judge.bounds
        intervals = np.array([bounds.get(key, (np.nan, np.nan)) for key in metrics]).reshape(-1, 2)
        return summary_table(metrics).assign(low=intervals[:, 0], high=intervals[:, 1])

    @property
    def runs(self) -> pd.DataFrame:
        """Return a table with a row per estimator, case and run: estimates, RMSE, mean NEES."""
        return self.judge.runs_table

    @property
    def steps(self) -> pd.DataFrame:
        """Return a table by estimator, case and step: RMSE, mean NEES and the NEES's 95 % interval."""
        return joined(self.judge.steps.values())

    @property
    def times(self) -> pd.DataFrame:
        """Return a table with a row per estimator, case, run and time span."""
        return self.judge.times

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Compute a table with a row per estimate with truth: error and sigma by component, NEES."""
        tables: list[pd.DataFrame] = []

        def keep(errors: Errors) -> None:
            tables.append(error_table(errors))

        judge_logs(self.estimates, self.logs, {}, gap_limit_s=self.gap_limit_s, on_errors=keep)
        return joined(tables)

    @cached_property
    def innovations(self) -> pd.DataFrame:
        """Read a table with a row per predicted measurement: NIS, components, and acceptance."""
        found = [
            innovations_of(gather([log.read([topic])[topic]]), run)
            for run, log in enumerate(self.estimates)
            for topic in topics_of(log.topics, schemas.INNOVATION)
        ]
        tables = [pd.DataFrame(each._asdict()).rename(columns={"squared": "nis"}) for each in found]
        return joined(tables)

    @property
    def failures(self) -> list[str]:
        """Return a sentence for every run that an estimator did not complete."""
        return self.judge.failures

    @property
    def losses(self) -> list[str]:
        """Return sentences on spans without estimates and on measurements that were not used."""
        return [*self.judge.notes_of_coverage, *sentences(self.done.coverage)]

    @cached_property
    def alarms(self) -> list[Finding]:
        """Return the warnings about the metrics and the replay, the worst first."""
        return alarms_of(self.judge, self.done.parameters, self.done.coverage)

    @property
    def coverage(self) -> pd.DataFrame:
        """Return a table of used, gated and skipped messages per topic and estimator, with reasons."""
        return coverage_table(self.done.coverage)

    def figure(self, case: str | None = None) -> "Figure":
        """Draw RMSE and NEES over time for a `case` such as `robot1`, by default for the first case.

        Raises BadInput if there is no such case, or nothing was judged.
        """
        charts = error_charts(self.judge)
        if not charts:
            raise BadInput("nothing to draw: no estimate has a truth")
        case = next(iter(charts)) if case is None else case
        if case not in charts:
            raise BadInput(f"no case '{case}' was judged; {choices(case, charts)}")
        return draw(charts[case])

    def view(self, run: int = 0, *, focus: str | None = None, save: str | Path | None = None) -> None:
        """Show the timeline of a run in the notebook or in the viewer, or write it to an .rrd file.

        Args:
            run: the number of the run.
            focus: the case to show first, such as `robot3`.
            save: the file to write, instead of showing the timeline.

        Raises BadInput if there is no such run or case, no viewer, or the file cannot be written.
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
            show = viewer.view_inline if in_notebook() else viewer.view
            show(rrd)

    def _draw(self, run: int, focus: str | None, rrd: Path) -> None:
        from fuselog.replay.timeline.show import Drawing

        log = self.logs[run]
        identity = json.dumps([str(log.start_ns), self.settings], default=str)
        with Drawing(log.whole(), identity=identity, focus=focus, save=rrd) as drawing:
            judge_logs([self.estimates[run]], [log], {}, gap_limit_s=self.gap_limit_s, drawing=drawing)

    def save(self, folder: str | Path) -> ResultFolder:
        """Write metrics, tables and figures to the result folder `folder`, for `fuselog report`.

        Raises BadInput if the folder exists and is not a result of fuselog.
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
        """Compute the SHA-256 of the input, from the files of logs and the columns of recordings."""
        digest = hashlib.sha256()
        for log in self.logs:
            if isinstance(log, MemorySource):
                add_to_hash(digest, log)
            else:
                with log.log.path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()
