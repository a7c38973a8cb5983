"""The study of sounds in recordings: arrivals by cross-correlation, places by them, with covariances.

Where truth or published differences are known, they are held to them. What a stated covariance is worth
is tried on simulated recordings, over noise: there each of many sounds is somewhere else.
"""

from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.output.charts import Axis, Chart, Panel, curve
from pipeline.output.claims import Claim, judged
from pipeline.output.results import Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.recorded import record_ensemble
from pipeline.runs.runner import Runner
from pipeline.studies.toolkit.repetitions import share_holds
from recorders.errors import BadInput
from recorders.parameters import Parameters
from replay.distributions import chi2
from replay.engine.arrays import Floats
from replay.engine.streams.sources import MemorySource
from replay.judging.errors.evaluation import Errors, chi_square_interval

OWN = "(own limit)"


class Published(Parameters):
    """Differences that were published of a sound.

    Attributes:
        delay_s: how much later than the first microphone the others heard it, in their numbers' order.
        within_s: what ours are held to.
    """

    delay_s: Annotated[list[float], Field(min_length=2)]
    within_s: PositiveFloat = 1e-3


class Simulated(Parameters):
    """Simulated recordings of the scenario `sound-source`.

    Attributes:
        runs: number of runs at each noise.
        seed: seed of the runs.
        snr_db: signal-to-noise ratios; without any nothing is simulated.
        parameters: what differs from the scenario's defaults, by name.
    """

    runs: PositiveInt = 100
    seed: Annotated[int, Field(ge=0)] = 1
    snr_db: list[float] = [20.0, 10.0, 0.0]
    parameters: dict[str, object] = {}


class Options(Parameters):
    """What is known of sounds, and what is simulated.

    Attributes:
        published: differences that were published, by the name of a sound.
        same: pairs of sounds that are one, the second in files that begin later.
        error_m: error that is allowed where truth is known.
        simulated: simulated recordings.
    """

    published: dict[str, Published] = {}
    same: list[tuple[str, str]] = []
    error_m: PositiveFloat = 0.05
    simulated: Simulated = Simulated()


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    label = next(iter(experiment.estimators), None)
    if label is None:
        raise BadInput("study acoustic-recordings needs an estimator, such as ekf")
    runner = Runner(experiment, setting)
    sources = runner.obtain()
    replayed = runner.replay(sources)
    runner.keep(replayed.sources, replayed.outputs)
    outcome = Outcome(metrics=dict(replayed.metrics()), input_sha256=hash_streams(sources))
    table = differences_of(sources[0])
    outcome.tables["differences"] = table
    for errors in replayed.errors:
        if errors.estimator == label:
            outcome.claims += known_place(errors, options.error_m)
    outcome.claims += _published(table, options, outcome)
    for each in replayed.innovations:
        if each.estimator == label:
            outcome.claims.append(_explained(each.case, each.squared, table))
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
            f"{label}.coverage_share.snr-{snr_db:g}": float(rows["inside"].mean()),
        }
        outcome.claims += covariance_claims(float(str(snr_db)), rows)


def differences_of(source: MemorySource) -> pd.DataFrame:
    """The differences of all sounds: later than at the first of its microphones, and how sure."""
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


def known_place(errors: Errors, most_m: float) -> list[Claim]:
    """Whether a sound of known place is located, and its stated region has the place in it."""
    axes = [errors.components.index(name) for name in ("x_m", "y_m", "z_m") if name in errors.components]
    places = errors.error[:, axes]
    away_m = float(np.linalg.norm(places, axis=1).max())
    limit = float(chi2.ppf(0.95, len(axes)))
    nees = float(errors.nees.max())
    return [
        judged(f"{errors.case}: located within {most_m:g} m", OWN, f"{away_m:.4f} m", away_m < most_m),
        judged(
            f"{errors.case}: the stated 95 % region has the true place in it",
            f"NEES below {limit:.2f}",
            f"NEES {nees:.2f}",
            nees < limit,
        ),
    ]


def _published(table: pd.DataFrame, options: Options, outcome: Outcome) -> list[Claim]:
    """Whether differences are as published, and the same sound gives the same ones."""
    claims = []
    delays = {name: rows["delay_s"].to_numpy() for name, rows in table.groupby("sound", sort=False)}
    for name, known in options.published.items():
        if name not in delays:
            continue
        if len(delays[name]) != len(known.delay_s):
            raise BadInput(
                f"options.published.{name}: {len(known.delay_s)} delays for {len(delays[name])} "
                "microphones that heard it; give one for each"
            )
        off_s = float(np.abs(delays[name] - np.array(known.delay_s)).max())
        outcome.metrics[f"published.off_s.{name}"] = off_s
        claims.append(
            judged(
                f"{name}: all differences are within {1e3 * known.within_s:g} ms of the published ones",
                ", ".join(f"{1e3 * each:g}" for each in known.delay_s) + " ms",
                ", ".join(f"{1e3 * each:.2f}" for each in delays[name]) + " ms",
                off_s < known.within_s,
            )
        )
    for first, second in options.same:
        if first in delays and second in delays and len(delays[first]) == len(delays[second]):
            apart_s = float(np.abs(delays[first] - delays[second]).max())
            statement = f"{second}: a file that begins later gives the same differences as in {first}"
            claims.append(
                judged(statement, "within 1 us", f"{1e6 * apart_s:.3f} us apart", apart_s < 1e-6)
            )
    return claims


def _explained(name: str, squared: Floats, table: pd.DataFrame) -> Claim:
    """Whether the differences agree with one place as well as their variances say.

    The sum of squared innovations, less those that the start leaves nothing of, has as many degrees of
    freedom as there are differences beyond the coordinates.
    """
    heights_m = table["z_m"][table["sound"] == name]
    extra = len(squared) - (2 if np.ptp(heights_m) == 0.0 else 3)
    limit = float(chi2.ppf(0.95, extra)) if extra > 0 else np.nan
    total = float(np.sum(squared)) if extra > 0 else np.nan
    return judged(
        f"{name}: one place explains all differences within what their variances allow",
        f"chi-square below {limit:.2f}",
        f"{total:.2f}, {extra} more than are needed",
        total < limit,
    )


def simulate(runner: Runner, asked: Simulated, label: str) -> pd.DataFrame:
    """Errors (m), NEES and whether the 95 % region has the place in it, of every simulated sound."""
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


def covariance_claims(snr_db: float, rows: pd.DataFrame) -> list[Claim]:
    """Whether stated covariances are right over many sounds: mean NEES, and 95 % regions."""
    size, count = int(rows["coordinates"].iloc[0]), len(rows)
    low, high = chi_square_interval(size, count)
    nees, share = float(rows["nees"].mean()), float(rows["inside"].mean())
    return [
        judged(
            f"simulated, {snr_db:g} dB: the mean NEES is as of covariances that are right",
            f"{low:.2f} to {high:.2f}",
            f"{nees:.2f}, median {rows['nees'].median():.2f}, of {count} sounds",
            low <= nees <= high,
        ),
        judged(
            f"simulated, {snr_db:g} dB: 95 % regions have the true place in them",
            "95 %, less two standard errors",
            f"{share:.0%} of {count} sounds",
            share_holds(share, count),
        ),
    ]


def _chart(simulated: pd.DataFrame) -> Chart:
    """How large errors are in how many of the simulated sounds, by noise."""
    panel = Panel(x=Axis(label="error (m)", log=True), y=Axis(label="share of the sounds below it"))
    for snr_db, rows in simulated.groupby("snr_db", sort=False):
        error_m = np.sort(rows["error_m"])
        share = np.arange(1, len(error_m) + 1) / len(error_m)
        panel.series.append(curve(f"{snr_db:g} dB", error_m, share))
    return Chart(panels=[panel])


ACOUSTIC_RECORDINGS = Study(
    "where sounds in recordings came from, beside known places and published differences",
    study,
    Options,
)
