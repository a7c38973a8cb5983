"""Study of orientation from inertial samples: the total error over the movement of each trial.

BROAD: Laidig, Caruso, Cereatti, Seel, Data 6(7), 2021. Only the samples that its authors marked as
movement are evaluated. An error is the total angle from the true to the estimated orientation.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.errors.evaluation import Errors


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    replayed = Runner(experiment, setting).run()
    trials = movement_table(replayed.errors, replayed.sources)
    means = {
        str(name): float(rows["movement_rmse_deg"].mean())
        for name, rows in trials.groupby("estimator", sort=False)
    }
    if not means:
        raise BadInput("there are no estimates during movement with truth; give a trial that has both")
    outcome = Outcome(input_sha256=hash_streams(replayed.sources))
    outcome.metrics.update({f"{name}.movement_rmse_deg": value for name, value in means.items()})
    for trial, estimator, rmse_deg, _ in trials.to_numpy():
        outcome.metrics[f"{estimator}.movement_rmse_deg.{trial}"] = rmse_deg
    outcome.metrics.update(replayed.metrics(experiment.metrics))
    outcome.tables["trials"] = trials
    outcome.figures["trials"] = trials_figure(trials)
    return outcome


def movement_table(found: Sequence[Errors], sources: Sequence[Source]) -> pd.DataFrame:
    """Tabulate the total RMSE over movement (deg) and the number of samples by trial and estimator."""
    rows = []
    for errors in found:
        moving = np.concatenate(
            [
                is_moving(source, errors.case, errors.time_ns[errors.run == run])
                for run, source in enumerate(sources)
            ]
        )
        total = np.linalg.norm(errors.error[moving][:, errors.rotation], axis=1)
        if len(total):
            rmse_deg = float(np.degrees(np.sqrt(np.mean(total**2))))
            rows.append((errors.case, errors.estimator, rmse_deg, len(total)))
    return pd.DataFrame(rows, columns=["trial", "estimator", "movement_rmse_deg", "samples"])


def is_moving(source: Source, case: str, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Test at which stamps a trial is marked as movement; a message in the log marks every change.

    Args:
        source: the log.
        case: name of the trial, with which the topic's name begins.
        time_ns: (n,), the stamps to test.

    Returns:
        The value (n,) of the last message at or before each stamp; False before the first message.
    """
    stream = source.read([f"/{case}/movement"])[f"/{case}/movement"]
    row = np.searchsorted(stream.publish_time_ns, time_ns, side="right") - 1
    return (row >= 0) & (stream["value"][row.clip(0), 0] != 0.0)


def trials_figure(trials: pd.DataFrame) -> Figure:
    """Draw the total RMSE over movement of every trial and estimator on a logarithmic axis."""
    figure = Figure(figsize=(8, 1.5 + 0.5 * trials["trial"].nunique()), layout="constrained")
    axes = figure.subplots()
    table = trials.pivot_table(index="trial", columns="estimator", values="movement_rmse_deg")
    table = table[trials["estimator"].drop_duplicates().tolist()].iloc[::-1]
    table.plot.barh(ax=axes, logx=True, legend=False)
    axes.set(xlabel="total orientation RMSE over movement (deg)", ylabel="")
    figure.legend(loc="outside upper center", ncols=table.shape[1])
    return figure


INERTIAL = Study("orientation from inertial samples: error over movement, trial by trial", study)
