"""Study of sounds in recordings: arrival differences by cross-correlation, positions, covariances.

Results are compared with the truth or with published differences, if these are known. The estimators'
covariances are tested on simulated recordings at several noise levels, with sounds at many positions.
"""

from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field, PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.errors.evaluation import Errors


class Published(Parameters):
    """Published arrival differences of a sound.

    Attributes:
        delay_s: delays of all microphones relative to the first, in the order of the microphones'
            numbers.
    """

    delay_s: Annotated[list[float], Field(min_length=2)]


class Simulated(Parameters):
    """Simulated recordings of the scenario `sound-source`.

    Attributes:
        runs: number of runs at each noise level.
        seed: seed of the runs.
        snr_db: signal-to-noise ratios; if empty, nothing is simulated.
        parameters: changes to the scenario's default parameters, by name.
    """

    runs: PositiveInt = 100
    seed: Annotated[int, Field(ge=0)] = 1
    snr_db: list[float] = [20.0, 10.0, 0.0]
    parameters: dict[str, object] = {}


class Options(Parameters):
    """Published differences of sounds, and the simulated recordings.

    Attributes:
        published: published arrival differences, by the name of a sound.
        simulated: simulated recordings.
    """

    published: dict[str, Published] = {}
    simulated: Simulated = Simulated()


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    label = next(iter(experiment.estimators), None)
    if label is None:
        raise BadInput("study acoustic-recordings needs an estimator such as ekf")
    runner = Runner(experiment, setting)
    sources = runner.obtain()
    replayed = runner.replay(sources)
    runner.keep(replayed.sources, replayed.outputs)
    outcome = Outcome(metrics=dict(replayed.metrics()), input_sha256=hash_streams(sources))
    table = differences_of(sources[0])
    outcome.tables["differences"] = table
    for errors in replayed.errors:
        if errors.estimator == label:
            outcome.metrics |= known_place(errors)
    outcome.metrics |= delays_of(table, options)
    for each in replayed.innovations:
        if each.estimator == label:
            outcome.metrics |= _explained(each.case, each.squared, table)
    if options.simulated.snr_db:
        _judge_simulated(simulate(runner, options.simulated, label), label, outcome)
    return outcome


def _judge_simulated(simulated: pd.DataFrame, label: str, outcome: Outcome) -> None:
    outcome.tables["simulated"] = simulated
    outcome.figures["simulated"] = _chart(simulated)
    for snr_db, rows in simulated.groupby("snr_db", sort=False):
        outcome.metrics |= {
            f"{label}.median_error_m.snr-{snr_db:g}": float(rows["error_m"].median()),
            f"{label}.nees.snr-{snr_db:g}": float(rows["nees"].mean()),
            f"{label}.median_nees.snr-{snr_db:g}": float(rows["nees"].median()),
            f"{label}.coverage_share.snr-{snr_db:g}": float(rows["inside"].mean()),
            f"simulated.sounds.snr-{snr_db:g}": float(len(rows)),
            f"simulated.coordinates.snr-{snr_db:g}": float(rows["coordinates"].iloc[0]),
        }


def differences_of(source: MemorySource) -> pd.DataFrame:
    """Tabulate the differences of all sounds relative to their first microphone, with their sigmas."""
    tables = []
    points = source.streams["/microphones"]
    places = pd.DataFrame(points["position_m"], points["landmark_id"].astype(int), ["x_m", "y_m", "z_m"])
    for topic, stream in source.streams.items():
        if topic.endswith("/differences"):
            microphone = np.append(stream["reference_id"][0], stream["microphone_id"]).astype(int)
            delay_s = np.append(0.0, stream["difference_s"])
            variance_s2 = np.append(stream["reference_variance_s2"][0], stream["variance_s2"])
            order = np.argsort(microphone)
            tables.append(
                pd.DataFrame(
                    {
                        "sound": topic.split("/")[1],
                        "microphone": microphone[order],
                        "delay_s": delay_s[order] - delay_s[order[0]],
                        "sigma_s": np.sqrt(variance_s2[order]),
                        **places.loc[microphone[order]].reset_index(drop=True),
                    }
                )
            )
    if not tables:
        raise BadInput(
            "the log has no arrival differences (fuselog.ArrivalDifference); give recordings of sounds"
        )
    return pd.concat(tables, ignore_index=True)


def known_place(errors: Errors) -> dict[str, MetricValue]:
    """Compute the largest error and NEES of a sound at a known position, and count its coordinates."""
    axes = [errors.components.index(name) for name in ("x_m", "y_m", "z_m") if name in errors.components]
    away_m = np.linalg.norm(errors.error[:, axes], axis=1)
    found = {
        "largest_error_m": float(away_m.max()),
        "largest_nees": float(errors.nees.max()),
        "known_coordinates": float(len(axes)),
    }
    return {f"{errors.estimator}.{name}.{errors.case}": value for name, value in found.items()}


def delays_of(table: pd.DataFrame, options: Options) -> dict[str, MetricValue]:
    """Return the delays of every sound, and their deviations from the published ones."""
    delays = {name: rows["delay_s"].to_numpy() for name, rows in table.groupby("sound", sort=False)}
    found: dict[str, MetricValue] = {
        f"sound.delay_s.{name!s}": of.tolist() for name, of in delays.items()
    }
    for name, known in options.published.items():
        if name not in delays:
            continue
        if len(delays[name]) != len(known.delay_s):
            raise BadInput(
                f"options.published.{name} has {len(known.delay_s)} delays for {len(delays[name])} "
                "microphones that heard the sound; give one for each"
            )
        found[f"published.delay_s.{name}"] = known.delay_s
        found[f"published.off_s.{name}"] = float(np.abs(delays[name] - np.array(known.delay_s)).max())
    return found


def _explained(name: str, squared: Floats, table: pd.DataFrame) -> dict[str, MetricValue]:
    """Compute how well one position explains a sound's arrival differences, and how many are redundant.

    The estimator's start uses as many differences as the position has coordinates. The sum of the other
    squared innovations has one degree of freedom per redundant difference.
    """
    heights_m = table["z_m"][table["sound"] == name]
    extra = len(squared) - (2 if np.ptp(heights_m) == 0.0 else 3)
    total = float(np.sum(squared)) if extra > 0 else np.nan
    return {f"sound.misfit.{name}": total, f"sound.spare_differences.{name}": float(extra)}


def simulate(runner: Runner, asked: Simulated, label: str) -> pd.DataFrame:
    """Simulate sounds; tabulate errors (m), NEES, and whether the 95 % region contains the position."""
    tables = []
    for snr_db in asked.snr_db:
        parameters = {**asked.parameters, "snr_db": snr_db}
        runs = record_ensemble(
            "sound-source", parameters, asked.seed, asked.runs, runner.setting.progress
        )
        replayed = runner.replay(runs, {label: runner.experiment.estimators[label]})
        (errors,) = replayed.errors
        size = runs[0].streams["/sound/truth"]["state"].shape[1]
        error_m = np.linalg.norm(errors.error[:, :size], axis=1)
        inside = errors.nees < chi2.ppf(0.95, size)
        tables.append(
            pd.DataFrame(
                {
                    "snr_db": snr_db,
                    "run": errors.run,
                    "error_m": error_m,
                    "nees": errors.nees,
                    "inside": inside,
                    "coordinates": size,
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


def _chart(simulated: pd.DataFrame) -> Chart:
    """Draw the cumulative distribution of errors of the simulated sounds, by noise level."""
    panel = Panel(
        x=Axis(label="error (m)", log=True), y=Axis(label="share of sounds with a smaller error")
    )
    for snr_db, rows in simulated.groupby("snr_db", sort=False):
        error_m = np.sort(rows["error_m"])
        share = np.arange(1, len(error_m) + 1) / len(error_m)
        panel.series.append(curve(f"{snr_db:g} dB", error_m, share))
    return Chart(panels=[panel])


ACOUSTIC_RECORDINGS = Study(
    "positions of sounds in recordings, compared with known positions and published differences",
    study,
    Options,
)
