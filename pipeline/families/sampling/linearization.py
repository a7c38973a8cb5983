"""Common parts of the S2KF paper's studies, which compare filters with a filter that uses exact moments.

An experiment's runs are replayed for several seeds, because errors differ more between seeds than
between sample sets of one kind; each seed is a separate ensemble.
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field, PositiveInt

from fuselog.pipeline.output.charts import Axis, Panel, curve
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource

Floats = NDArray[np.float64]
REFERENCE = "analytic"


class Options(Parameters):
    """Numbers of seeds and rotations.

    Attributes:
        data_seeds: number of seeds of the data to average over.
        rotations: number of additional rotations of the S2KF's sets to try.
    """

    data_seeds: PositiveInt = 4
    rotations: Annotated[int, Field(ge=0)] = 0


class Track(NamedTuple):
    """One filter's estimates of an ensemble; NaN after a run failed."""

    mean: Floats
    """(runs, steps, n)"""
    covariance: Floats
    """(runs, steps, n, n)"""

    @property
    def failed(self) -> int:
        """Count the runs that did not reach the last step."""
        return int(np.isnan(self.mean[:, -1, 0]).sum())


class Ensemble(NamedTuple):
    """The runs of a seed, with the truth (runs, steps, n) after the start and each filter's track."""

    sources: list[MemorySource]
    truth: Floats
    tracks: dict[str, Track]


def ensembles(
    experiment: Experiment,
    setting: Setting,
    options: Options,
    extra: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    written: bool = True,
) -> Iterator[Ensemble]:
    """Record and replay the experiment for every seed; keep the logs of the first seed.

    The `extra` estimators are replayed too, but their estimates are not written; nothing is written if
    `written` is False. Raises BadInput if the reference is not among the estimators.
    """
    if REFERENCE not in experiment.estimators:
        raise BadInput(
            f"this study compares with the estimator '{REFERENCE}'; add that estimator to the experiment"
        )
    for number in range(options.data_seeds):
        again = experiment.model_copy(update={"seed": experiment.seed + number})
        runner = Runner(again, setting)
        sources = runner.obtain()
        outputs = replay_in_memory(sources, experiment.estimators, progress=setting.progress)
        if number == 0 and written:
            runner.keep(sources, outputs)
        outputs |= replay_in_memory(sources, extra or {}, progress=setting.progress)
        truth = np.stack([source.streams["/truth"]["state"][1:] for source in sources])
        labels = [*experiment.estimators, *(extra or {})]
        yield Ensemble(
            sources,
            truth,
            {label: track(outputs[f"/estimates/{label}/state"], truth.shape[1]) for label in labels},
        )


def track(estimates: Ragged, steps: int) -> Track:
    """Arrange the estimates of all runs in arrays, which are NaN after a run failed."""
    counts = np.diff(estimates.offsets)
    there = np.arange(steps) < counts[:, None]
    size = estimates["mean"].shape[1]
    mean = np.full((len(counts), steps, size), np.nan)
    covariance = np.full((len(counts), steps, size, size), np.nan)
    mean[there] = estimates["mean"]
    covariance[there] = estimates["covariance"].reshape(-1, size, size)
    return Track(mean, covariance)


def rmse(difference: Floats) -> Floats:
    """Compute the RMS of differences (runs, steps, ...) at each step, ignoring NaN."""
    squared = np.sum(difference**2, axis=tuple(range(2, difference.ndim)))
    return np.sqrt(np.nanmean(squared, axis=0))


def error_panel(steps: pd.DataFrame, quantity: str, label: str) -> Panel:
    """Draw one line per estimator over the steps, averaged over the seeds."""
    mean = steps.groupby(["estimator", "step"], sort=False)[quantity].mean()
    lines = {str(name): mean[name] for name in mean.index.get_level_values("estimator").unique()}
    return Panel(
        x=Axis(label="step"),
        y=Axis(label=label),
        series=[curve(name, line.index, line) for name, line in lines.items()],
    )
