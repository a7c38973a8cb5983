"""Plans of replays (logs, estimators, spans, initial states, order), for Python and the commands.

Planning imports nothing slow, so `fuselog replay` starts quickly.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuselog.pipeline.altering.sources import alter_all, split_settings
from fuselog.pipeline.runs.ensemble import (
    Pass,
    Progress,
    Settings,
    cut_in_parts,
    no_progress,
    replay_parts,
)
from fuselog.pipeline.runs.initial_states import Origin, order_of, origins_of, span_of
from fuselog.pipeline.runs.settings import with_settings
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Mirrors, RunMetadata, open_log
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import Estimator
from fuselog.replay.engine.replaying.late import Late
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, memory_source
from fuselog.replay.foreign.naming import allowed, shorthand
from fuselog.replay.inference.model.model import Model
from fuselog.replay.judging.metrics.measuring import find_metrics

Log = str | Path | LogSource | MemorySource | Recording
Kind = str | Estimator[Any] | Mapping[str, Any]
Named = str | Estimator[Any] | Mapping[str, Kind]


@dataclass(frozen=True)
class Plan:
    """A replay that is ready to run.

    Attributes:
        sources: the runs, limited to the replayed span.
        estimators: settings by label.
        origins: the initial state of each run, or empty; see `origins_of`.
        order: the clock that orders the messages.
        late: how out-of-sequence messages are handled.
        gap_limit_s: the longest gap over which the truth is interpolated.
        metrics: names of the metrics to compute; all if empty.
    """

    sources: Sequence[LogSource | MemorySource]
    estimators: Settings
    origins: Sequence[Origin]
    order: Clock
    late: Late | None
    gap_limit_s: float
    metrics: Sequence[str]

    def replay(
        self,
        estimates: Sequence[tuple[Path, Path]],
        *,
        save: Path | None = None,
        connect: str | None = None,
        mirrors: Mirrors | None = None,
        progress: Progress = no_progress,
    ) -> Pass:
        """Replay the logs, write estimates logs, and judge the estimates if there is truth.

        Args:
            estimates: for each run, the path of its estimates and its source log.
            save: the file for the first run's timeline.
            connect: the Rerun viewer to stream the timeline to.
            mirrors: function that makes the Foxglove mirror, which is written next to the estimates.
            progress: function that reports progress after every block.

        Raises BadInput if an estimator cannot replay any run.
        """
        return replay_parts(
            cut_in_parts(self.sources, estimates, self.origins),
            self.estimators,
            gap_limit_s=self.gap_limit_s,
            metrics=self.metrics,
            order=self.order,
            late=self.late,
            save=save,
            connect=connect,
            mirrors=mirrors,
            progress=progress,
        ).check()


def plan_replay(
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
) -> Plan:
    """Check the arguments of a replay and open its logs; see `fuselog.pipeline.api.replays.replay`.

    Raises BadInput if a setting is invalid, or a log cannot be read or has no messages in the span.
    """
    for name, value in (("start_s", start_s), ("end_s", end_s), ("gap_limit_s", gap_limit_s)):
        if value is not None and not (abs(value) <= 1e9 and (value >= 0 or name != "gap_limit_s")):
            raise BadInput(f"{name} is {value}; expected seconds, such as 0.5")
    from_ = [start_from] if isinstance(start_from, str | Path) else start_from
    order, policy = order_of(arrival_order=arrival_order, late=late, origins=from_)
    alterations, given = split_settings(set or {})
    settings = settings_of(estimators)
    if given:
        settings = with_settings(settings, allowed(given))
    wanted = [metrics] if isinstance(metrics, str) else list(metrics or [])
    find_metrics(wanted)
    sources = [span_of(source, start_s, end_s, order) for source in sources_of(logs, alterations)]
    origins = origins_of(sources, from_, start_sigma or {}, order, gap_limit_s)
    return Plan(sources, settings, origins, order, policy, gap_limit_s, wanted)


def open(path: str | Path, *, recover: bool = False) -> LogSource:  # noqa: A001
    """Open a log as a mapping of its topics to their streams, which are read on demand.

    Args:
        path: an MCAP file, or its URL.
        recover: read the intact part of a truncated or damaged log; a warning states what is missing.

    Returns:
        The log, which maps every topic to its stream.

    Raises BadInput if the file is missing or not MCAP, or if it is damaged and `recover` is False.

    >>> from fuselog.pipeline.api.api import record, write
    >>> write("run.mcap", record("landmarks", seed=7, duration_s=2.0))
    >>> log = open("run.mcap")
    >>> log.run.scenario, len(log)
    ('landmarks', 5)
    >>> log["/robot1/odometry"]["forward_mps"].shape
    (40,)
    """
    log = open_log(path, recover=recover)
    if log.loss_statement:
        warnings.warn(log.loss_statement, stacklevel=2)
    return LogSource(log)


def sources_of(
    logs: Log | Iterable[Log], alterations: Mapping[str, Any] | None = None
) -> list[LogSource | MemorySource]:
    """Open one log or several as sources, with alterations of topics if requested.

    Raises BadInput if there are no logs, or if one cannot be read or altered.
    """
    found = [logs] if isinstance(logs, Log) else list(logs)
    if not found:
        raise BadInput("no logs to replay; give at least one")
    return alter_all(map(_source, found), alterations or {})


def _source(log: Log) -> LogSource | MemorySource:
    if isinstance(log, LogSource | MemorySource):
        return log
    if isinstance(log, Recording):
        return memory_source(log, RunMetadata("recording", epoch_ns=log.epoch_ns, notes=dict(log.notes)))
    if isinstance(log, str | Path):
        return open(log)
    raise BadInput(f"cannot replay a {type(log).__name__}; give a path, a log or a recording")


def settings_of(
    estimators: Named | Iterable[Named],
) -> dict[str, dict[str, Any]]:
    """Return the settings of each estimator by its label; raise BadInput if they are invalid."""
    are_several = isinstance(estimators, Iterable) and not isinstance(estimators, str | Mapping)
    listed: list[Any] = [*estimators] if are_several else [estimators]  # type: ignore[misc]
    chosen: dict[str, dict[str, Any]] = {}
    for each in listed:
        if isinstance(each, Model):
            raise BadInput('a model without a method is not an estimator; give modelled(model, "ekf")')
        if not isinstance(each, str | Mapping | Estimator):
            raise BadInput(
                f"expected an estimator, got {type(each).__name__}; give a name, or "
                '{"mine": estimator}'
            )
        if isinstance(each, Mapping) and "kind" in each:
            raise BadInput(
                f"{', '.join(each)}: these look like settings of one estimator; give them a label: "
                '{"mine": {...}}'
            )
        for label, what in _labelled(each).items():
            if label in chosen:
                raise BadInput(f"estimator {label} is given twice; give the second another label")
            chosen[label] = dict(what) if isinstance(what, Mapping) else {"kind": what}
            kind = chosen[label].get("kind", "")
            if isinstance(kind, Model):
                raise BadInput(
                    f'estimator {label} is a model without a method; give modelled(model, "ekf")'
                )
            if not isinstance(kind, str | Estimator):
                raise BadInput(
                    f"estimator {label} is a {type(kind).__name__}; make an estimator from it with "
                    "recursive, batch or modelled"
                )
    if not chosen:
        raise BadInput("no estimators to replay; give at least one")
    return chosen


def _labelled(named: Named) -> Mapping[str, Kind]:
    """Map labels to estimators; a name or an estimator without a label is its own label."""
    if isinstance(named, str):
        return dict([shorthand(named)])
    return {named.label: named} if isinstance(named, Estimator) else allowed(named)
