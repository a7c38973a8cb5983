"""Comparison of a run with its changed copies, by the estimates, metrics and failures of replays."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.runs.ensemble import parameters_of, stated_of
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.stressing.changes import (
    DROPPED,
    SHIFT_NS,
    parameters_changed,
)
from fuselog.pipeline.stressing.partings import Parting, partings
from fuselog.pipeline.stressing.verdicts import MARGIN, Tried
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream, schemas
from fuselog.recorders.parameters import merge
from fuselog.replay.engine.replaying.late import Late
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.judging.judge import Judge


class How(NamedTuple):
    """Options of the replays of a run and its copies.

    Attributes:
        seed: the seed of random signs and of dropped messages.
        gap_limit_s: longest gap over which the truth is interpolated.
        order: the clock that orders messages.
        late: how out-of-sequence messages are treated if messages are in order of log time.
    """

    seed: int = 0
    gap_limit_s: float = 0.2
    order: Clock = "publish_time"
    late: Late | None = None


@dataclass(frozen=True)
class Replayed:
    """Runs and copies that one estimator has replayed.

    trial: the estimator, the runs and the copies.
    outputs: outputs of the estimator, by topic.
    how: how they were replayed.
    """

    trial: Trial
    outputs: Mapping[str, Ragged]
    how: How

    def estimates(self, run: int) -> dict[str, Stream]:
        """Return the Gaussian estimates of a run, by topic, in the order of their stamps."""
        wanted = schemas.GAUSSIAN_ESTIMATE.full_name
        found = {
            topic: rows.of_run(run)
            for topic, rows in self.outputs.items()
            if rows.stream.schema.full_name == wanted
        }
        return {
            topic: each.take(np.argsort(each.publish_time_ns, kind="stable"))
            for topic, each in found.items()
        }

    def failure(self, run: int) -> str:
        """Describe when and why a run ends early; return "" if the run is complete."""
        for rows in self.outputs.values():
            if rows.stream.schema.full_name == schemas.FAILURE.full_name:
                own = rows.of_run(run)
                if len(own):
                    at_s = (int(own.publish_time_ns[0]) - self.trial.runs[run].epoch_ns) * 1e-9
                    return f"at {at_s:.3f} s: {sentences_of(own)[0]}"
        return ""

    @cached_property
    def _metrics(self) -> Mapping[int, Mapping[tuple[str, str], float]]:
        judge = Judge(self.trial.runs, {}, gap_limit_s=self.how.gap_limit_s)
        judge.add(self.outputs)
        found: dict[int, dict[tuple[str, str], float]] = defaultdict(dict)
        for row in judge.runs_table.to_dict("records"):
            found[row["run"]] |= {
                (str(row["case"]), str(quantity)): float(value)
                for quantity, value in row.items()
                if quantity != "run" and isinstance(value, int | float) and np.isfinite(value)
            }
        return found

    def metrics(self, run: int) -> Mapping[tuple[str, str], float]:
        """Return the known metrics of a run, by case and quantity."""
        return self._metrics.get(run, {})


def replayed(trial: Trial, how: How) -> Replayed:
    """Replay runs with one estimator; raise BadInput if it cannot replay any run."""
    settings = {trial.label: trial.settings}
    return Replayed(trial, replay_in_memory(trial.runs, settings, order=how.order, late=how.late), how)


def compared(
    name: str, before: Replayed, row: int, done: Replayed, run: int, base: Mapping[str, Stream]
) -> Tried:
    """Compare a copy with its run.

    Args:
        name: the name of the change.
        before: the replay that contains the unchanged run.
        row: index of the run in `before`.
        done: the replay that contains the copy.
        run: index of the copy in `done`.
        base: estimates of the run in `before`, by topic.
    """
    within_ns = SHIFT_NS if name == "stamps" else 0
    found = partings(base, done.estimates(run), within_ns, has_less=name == DROPPED)
    largest = max(found, key=lambda each: each.amplification.max(initial=0.0), default=None)
    failed = done.failure(run)
    if before.failure(row):
        if largest is None:
            return Tried(name, why=f"it fails {before.failure(row)}", failed=before.failure(row))
        failed = ""
    one, other = before.metrics(row), done.metrics(run)
    moved = {key: other[key] - value for key, value in one.items() if key in other}
    main = _main([key[1] for key in one])
    if largest is None and not main and not failed:
        return Tried(name, why="no estimate is a single Gaussian, and no error is known")
    reach = _reach(found, main)
    shares = [
        min(abs(by), reach) / abs(one[key])
        for key, by in moved.items()
        if key[1] == main and one[key] != 0.0
    ]
    share = max(shares, default=0.0)
    beyond = f"{main} changes by {100 * share:.2g} %" if share > MARGIN else ""
    return Tried(name, largest, moved, beyond, failed=failed)


def _reach(found: Sequence[Parting], main: str) -> float:
    """Return the largest distance between estimates; an RMSE at common stamps cannot change by more.

    If a message is lost, the copy has no estimate at that message's stamp. The RMSEs of run and copy
    then also differ because run and copy cover different stamps, which must not count as a change.
    """
    unit = main.rpartition("_")[2]
    if unit not in ("m", "deg", "rad"):
        return np.inf
    apart = [each.metres if unit == "m" else each.degrees for each in found]
    known = [float(np.nanmax(each)) for each in apart if np.isfinite(each).any()]
    return np.radians(max(known)) if known and unit == "rad" else max(known, default=np.inf)


def _main(quantities: Sequence[str]) -> str:
    """Choose the metric of a verdict: the RMSE of position or orientation, else the first error."""
    errors = [each for each in quantities if "rmse" in each]
    main = [each for each in ("position_rmse_m", "orientation_rmse_deg") if each in errors]
    return next(iter([*main, *errors]), "")


def _parameters(trial: Trial) -> dict[str, Any]:
    """Return an estimator's own parameters, and those with a single value in the log's channels."""
    bound, stated = trial.bind(), {}
    for name, words in stated_of(bound, trial.source).get(trial.label, {}).items():
        number, _, topics = words.partition(" (")
        if "(" in topics:  # channels with different values
            continue
        try:
            stated[name] = float(number)
        except ValueError:
            continue
    return stated | parameters_of(bound).get(trial.label, {})


def with_parameters(trial: Trial, how: How, size: float) -> Replayed | str:
    """Replay runs with changed parameters; return the reason if this is not possible."""
    known = _parameters(trial)
    changed = parameters_changed(known, size, np.random.default_rng(how.seed))
    changed = {name: value for name, value in changed.items() if value != known[name]}
    if not changed:
        return "all numeric parameters are zero"
    refused = ""

    def having(values: Mapping[str, Any]) -> Trial:
        return replace(trial, settings=merge(trial.settings, values))

    for name in [*changed]:
        try:
            having({name: changed[name]}).bind()
        # for example, a setting that the method fixes and does not use
        except BadInput as error:
            refused = str(error)
            del changed[name]
    if not changed:
        return refused
    try:
        return replayed(having(changed), how)
    except BadInput as error:
        return str(error)
