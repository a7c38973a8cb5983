"""The study of Autoferry scenarios: what each sensor adds to tracks of vessels, and each association.

Tracks are judged as `replay.judging.track_errors` says. Quays, marks and other craft have no reference:
GOSPA leaves out what is farther than 50 m from both vessels (in the sheet's words, G50).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from pydantic import PositiveFloat
from scipy.stats import t as student

from pipeline.charts import Axis, Chart, Panel, curve
from pipeline.claims import Claim, judged, listed
from pipeline.ensemble import hash_streams
from pipeline.experiment import Experiment, Setting, Study
from pipeline.results import Outcome
from pipeline.runner import Runner
from pipeline.studies.localization import summary_table
from recorders.errors import BadInput
from recorders.parameters import Parameters
from recorders.recording import import_run
from replay.engine.arrays import Floats
from replay.engine.blocks import Ragged
from replay.engine.sources import MemorySource, memory_source
from replay.judging.track_distances import hota, idf1
from replay.judging.track_errors import (
    CUTOFF_M,
    Judged,
    as_trajectories,
    instants_of,
    track_errors,
    track_figures,
    tracks_at,
)


class AutoferryOptions(Parameters):
    """What mean GOSPA (m) is held to: of the best tracker, and of radar and lidar."""

    best_gospa_m: PositiveFloat = 9.3
    radar_lidar_gospa_m: PositiveFloat = 9.5


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.experiment.Study`."""
    names, sources = _scenarios(experiment, setting)
    runner = Runner(experiment, setting)
    replayed = runner.replay(sources)
    runner.keep(sources, replayed.outputs)
    instants = [instants_of(source) for source in sources]
    rows = [
        {"estimator": label, "scenario": name, **_figures(replayed.outputs, label, run, instants[run])}
        for label in experiment.estimators
        for run, name in enumerate(names)
    ]
    table = pd.DataFrame(rows)
    outcome = Outcome(input_sha256=hash_streams(sources))
    means = table.drop(columns="scenario").groupby("estimator", sort=False).mean()
    for label, figures in means.iterrows():
        outcome.metrics |= {f"{label}.{name}": float(value) for name, value in figures.items()}
    for label, name, value in table[["estimator", "scenario", "gospa_m"]].itertuples(index=False):
        outcome.metrics[f"{label}.gospa_m.{name}"] = float(value)
    outcome.tables |= {"scenarios": table, "summary": summary_table(outcome.metrics)}
    notes = [
        (name, what, count)
        for name, source in zip(names, sources, strict=True)
        for what, count in source.run.notes.items()
    ]
    outcome.tables["notes"] = pd.DataFrame(notes, columns=["scenario", "what", "count"])
    outcome.figures["gospa"] = _chart(table)
    outcome.claims = _claims(table, means, setting.options)
    return outcome


def _scenarios(experiment: Experiment, setting: Setting) -> tuple[list[str], list[MemorySource]]:
    """The scenarios in the data's folder by the numbers in their names, or the folder itself."""
    assert setting.data is not None
    assert experiment.import_ is not None
    found = sorted(setting.data.glob("*/*_detections.json")) if setting.data.is_dir() else []
    folders = sorted(
        [path.parent for path in found] or [setting.data], key=lambda each: (len(each.name), each.name)
    )
    source, values = experiment.import_.source, experiment.import_.parameters
    sources = [memory_source(*import_run(source, folder, values)) for folder in folders]
    return [folder.name for folder in folders], sources


def _figures(outputs: Mapping[str, Ragged], label: str, run: int, at: Judged) -> dict[str, float]:
    """What the tracks of one estimator are worth in one scenario."""
    leaves = [f"/estimates/{label}/{leaf}" for leaf in ("set", "track")]
    if not all(leaf in outputs for leaf in leaves):
        raise BadInput(f"estimator {label} tells no tracks; this study takes trackers alone")
    sizes, tracks = (outputs[leaf].of_run(run) for leaf in leaves)
    told = tracks_at(sizes, tracks, at.time_ns)
    figures = track_figures(track_errors(told, at.truths))
    followed = as_trajectories(told)
    away = np.linalg.norm(followed[:, None] - at.truths[None], axis=3)
    near = np.nanmin(away, axis=(1, 2), initial=np.inf) < CUTOFF_M
    return figures | {
        "hota": float(hota(followed[near], at.truths, CUTOFF_M).hota.mean()),
        "idf1": idf1(followed[near], at.truths, CUTOFF_M),
    }


def _chart(table: pd.DataFrame) -> Chart:
    """GOSPA of every estimator by scenario."""
    panel = Panel(x=Axis(label="scenario"), y=Axis(label="mean GOSPA (m), c = 20 m"))
    for label, rows in table.groupby("estimator", sort=False):
        panel.series.append(curve(str(label), rows["scenario"], rows["gospa_m"], "line+markers"))
    return Chart(panels=[panel])


def mean_interval(values: Sequence[float], probability: float = 0.95) -> tuple[float, float, float]:
    """The mean of independent values, and where it lies by Student's distribution; NaN for one value."""
    count, mean = len(values), float(np.mean(values))
    if count < 2:
        return mean, np.nan, np.nan
    half = student.ppf(0.5 + probability / 2, count - 1) * np.std(values, ddof=1) / np.sqrt(count)
    return mean, mean - float(half), mean + float(half)


def _claims(table: pd.DataFrame, means: pd.DataFrame, options: AutoferryOptions) -> list[Claim]:
    """The reference trackers' statements, where the estimators that they are of were run."""
    needed = {
        "jipda-radar-lidar",
        "jipda-radar-lidar-no-lag",
        "jipda-all",
        "jipda-radar",
        "jipda-radar-no-lag",
        "jipda-lidar",
        "hungarian-radar-lidar",
        "hungarian-all",
    }
    if not needed <= set(means.index):
        return []
    gospa_m = table.pivot_table("gospa_m", "scenario", "estimator", sort=False)
    mean: Any = means.to_dict("index")
    mean_m = {str(label): figures["gospa_m"] for label, figures in mean.items()}
    best = min(mean_m, key=lambda label: mean_m[label])
    both, alone = mean["jipda-radar-lidar"], mean["jipda-lidar"]
    no_lag = mean["jipda-radar-lidar-no-lag"]
    scenarios = len(gospa_m)
    lag_m = gospa_m["jipda-radar-no-lag"] - gospa_m["jipda-radar"]
    claims = [
        judged(
            f"the best tracker has a GOSPA of at most {options.best_gospa_m:g} m",
            "own target; best reference 9.07 m",
            f"{mean_m[best]:.2f} m, {best}, mean of {scenarios} scenarios",
            mean_m[best] <= options.best_gospa_m,
            "settings are the reference trackers', which were picked on these scenarios",
        ),
        judged(
            f"radar and lidar have at most {options.radar_lidar_gospa_m:g} m, with either association",
            "reference: GNN 9.32 m, JIPDA 9.16 m",
            f"hungarian {mean_m['hungarian-radar-lidar']:.2f} m, jipda {both['gospa_m']:.2f} m",
            max(mean_m["hungarian-radar-lidar"], both["gospa_m"]) <= options.radar_lidar_gospa_m,
        ),
        judged(
            "JIPDA with radar and lidar is as accurate as the reference, and covers as much",
            "RMSE 4.89 and 3.92 m, coverage .92 and .81",
            f"RMSE {listed([both['target1_rmse_m'], both['target2_rmse_m']], 2, ' and ')} m, coverage "
            f"{listed([both['target1_coverage'], both['target2_coverage']], 2, ' and ')}",
            both["target1_rmse_m"] <= 4.89 + 0.7
            and both["target2_rmse_m"] <= 3.92 + 0.7
            and both["target1_coverage"] >= 0.90
            and both["target2_coverage"] >= 0.79,
        ),
        judged(
            "a radar that lags is better modelled as one: GOSPA of radar alone",
            "12.0 m without, 9.1 m with a lag of 1.5 s",
            f"{mean_m['jipda-radar-no-lag']:.2f} m without, {mean_m['jipda-radar']:.2f} m with; "
            f"better in {int((lag_m > 0).sum())} of {scenarios}",
            mean_m["jipda-radar"] < mean_m["jipda-radar-no-lag"],
        ),
        judged(
            "with lidar, too, a lag sharpens tracks",
            "localisation 65 m^2 without, 41 m^2 with; GOSPA 9.53 and 9.16 m",
            f"localisation {no_lag['localisation_m2']:.0f} m^2 without, "
            f"{both['localisation_m2']:.0f} m^2 with; GOSPA "
            f"{listed([no_lag['gospa_m'], both['gospa_m']], 2, ' and ')} m",
            both["localisation_m2"] < no_lag["localisation_m2"],
        ),
        judged(
            "lidar sharpens what radar sees, and alone covers less",
            "RMSE smaller by .5 to 1.4 m; coverage .63 and .59 alone",
            f"RMSE {listed(_rmse(means, 'jipda-radar'), 2, ' and ')} m to "
            f"{listed(_rmse(means, 'jipda-radar-lidar'), 2, ' and ')} m; coverage "
            f"{listed([alone['target1_coverage'], alone['target2_coverage']], 2, ' and ')} alone",
            bool(np.all(_rmse(means, "jipda-radar-lidar") < _rmse(means, "jipda-radar")))
            and alone["target1_coverage"] < both["target1_coverage"],
        ),
    ]
    for association, theirs in (("hungarian", ".3"), ("jipda", ".6")):
        added = gospa_m[f"{association}-all"] - gospa_m[f"{association}-radar-lidar"]
        more, low, high = mean_interval(added.tolist())
        claims.append(
            judged(
                f"bearings of cameras improve radar and lidar ({association})",
                f"they do not: {theirs} m more GOSPA",
                f"{more:+.2f} m of GOSPA, 95 % over scenarios {low:+.2f} to {high:+.2f} m",
                more < 0.0,
                "errors of bearings stay alike for seconds, and boxes move on long hulls",
            )
        )
    return claims


def _rmse(means: pd.DataFrame, label: str) -> Floats:
    return means.loc[label, ["target1_rmse_m", "target2_rmse_m"]].to_numpy(float)


AUTOFERRY = Study(
    "what each sensor adds to tracks of vessels from a moving one", study, AutoferryOptions
)
