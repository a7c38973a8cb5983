"""One experiment in several cases: ensembles of one scenario with different parameters, judged alike."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.ensemble import Replayed, record_ensemble, replay_ensemble
from pipeline.experiment import Experiment, Setting, load_scenario
from pipeline.studies.localization import write_logs
from recorders.errors import BadInput
from recorders.parameters import merge
from replay.judging.evaluation import Errors
from replay.timeline.show import show


def replay_cases(
    experiment: Experiment, setting: Setting, cases: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[str, Replayed]]:
    """Record and replay every case, given by name and what differs in its scenario's parameters.

    Logs and estimates go to a folder of the case, as does its timeline; that of the first case is the
    experiment's. Raises BadInput where the experiment does not say what to record.
    """
    if not experiment.record:
        raise BadInput(f"experiment '{experiment.title}': give the scenario to [record]")
    recorder, values, _ = load_scenario(experiment.record.scenario)
    stated = merge(values, experiment.record.parameters)
    for number, (name, differing) in enumerate(cases.items()):
        parameters = merge(stated, differing)
        sources = record_ensemble(
            recorder, parameters, experiment.seed, experiment.runs, setting.progress
        )
        replayed = replay_ensemble(
            sources,
            experiment.estimators,
            gap_limit_s=experiment.gap_limit_s,
            progress=setting.progress,
        )
        folder = setting.folder / name
        write_logs(experiment, replace(setting, folder=folder), sources, replayed)
        place = folder if number else setting.folder
        place.mkdir(parents=True, exist_ok=True)
        show(sources[0], replayed.outputs, replayed.errors, save=place / "timeline.rrd")
        yield name, replayed


def rmse_of_runs(errors: Errors, runs: int) -> NDArray[np.float64]:
    """The root mean square length of every run's errors (runs,); NaN for a run without any."""
    squared = np.sum(errors.error**2, axis=1)
    count = np.bincount(errors.run, minlength=runs)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.bincount(errors.run, squared, runs) / count)
