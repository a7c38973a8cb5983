"""Study of biometric score fusion by modality, method and process, with verification of all pairs.

Zheng & Blasch, JAIF 2014, Tables 2a to 5. Fusions of the trimmed database are repeated with several
seeds. Fusions of all pairs have confidence intervals, which are computed by resampling users.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pydantic import PositiveInt
from scipy.stats import norm

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, thinned
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.families.biometrics.models import TOPIC, comparisons_of, matchers_of
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.biometrics.estimators import LearnerParameters
from fuselog.replay.families.biometrics.pairs import subsets_of
from fuselog.replay.families.biometrics.verification import (
    FALSE_ACCEPT_RATES,
    Fused,
    bootstrap_users,
    fused_of,
    relative_rate_increase,
    roc,
)
from fuselog.replay.judging.errors.evaluation import split_topic

# Results of Zheng & Blasch for NIST BSSR1 set 1, in percent.
METHODS, MODALITIES = ("face", "finger"), ("matcher-1", "matcher-2")
CASES = (*METHODS, *MODALITIES, "all")
SINGLE = {"face-C": 89.17, "face-G": 84.33, "finger-left": 86.46, "finger-right": 92.65}
PAPER_FUSED = {
    label: dict(zip(CASES, rates, strict=True))
    for label, rates in {
        "mean": (90.52, 94.78, 94.78, 96.71, 99.61),
        "qda": (94.45, 97.23, 97.16, 99.16, 99.10),
        "knn": (96.97, 97.48, 99.22, 99.42, 99.55),
        "hmm": (97.42, 98.06, 99.22, 99.42, 99.68),
    }.items()
}
RATE, SPREAD, COUNT = "verification_rate_percent", "verification_rate_sd_percent", "identified_percent"
# False rates at the ticks of both axes, which are scaled by normal deviates.
TICKS = (1e-4, 1e-3, 0.01, 0.05, 0.2)


class BiometricsOptions(Parameters):
    """Numbers of repetitions of random steps.

    Attributes:
        seeds: number of repetitions of the cross-validations.
        replicates: number of times that users are resampled.
    """

    seeds: PositiveInt = 5
    replicates: PositiveInt = 100


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    runner = Runner(experiment, setting)
    replayed = runner.run()
    sources = replayed.sources
    values = replayed.metrics(experiment.metrics)
    values |= _repeated(runner, sources, values)
    outcome = Outcome(metrics=dict(values), input_sha256=hash_streams(sources))
    outcome.tables["summary"] = summary_table(outcome.metrics)
    outcome.tables["factors"] = factor_table(values, sources[0])
    outcome.tables["impact"] = impact_table(outcome.tables["factors"])
    outcome.tables["confidence"] = confidence_table(replayed, setting.options.replicates)
    outcome.figures["distributions"] = distribution_figure(sources[0])
    outcome.figures["roc"] = curve_chart(replayed, deviates=False)
    outcome.figures["det"] = curve_chart(replayed, deviates=True)
    for row in outcome.tables["factors"].to_dict("records"):
        outcome.metrics[f"{row['fusion']}.relative_increase.{row['subset']}"] = row["rri"]
    if experiment.import_:
        outcome.metrics |= printed_metrics()
    else:
        for key, counts in _counts(replayed).items():
            if ".identified_users." in key:
                by_run = key.replace("identified_users", "identified_users_by_run")
                outcome.metrics[by_run] = counts
    return outcome


def _repeated(
    runner: Runner, sources: Sequence[MemorySource], first: Mapping[str, float]
) -> dict[str, float]:
    """Compute means and standard deviations over seeds for fusions of a trimmed database."""
    drawn = {}
    for label, settings in runner.experiment.estimators.items():
        _, parameters = configure(label, settings)
        if isinstance(parameters, LearnerParameters) and parameters.pairs == "trimmed":
            drawn[label] = (dict(settings), parameters.seed)
    rates = [{key: value for key, value in first.items() if f".{RATE}" in key}]
    more = range(1, runner.setting.options.seeds if drawn else 1)
    for step in runner.setting.progress(more, "repeating with other seeds", len(more)):
        estimators = {label: {**values, "seed": seed + step} for label, (values, seed) in drawn.items()}
        rates.append(runner.replay(sources, estimators).metrics(["verification"]))
    values: dict[str, float] = {}
    for key in rates[0]:
        over_seeds = [rate[key] for rate in rates]
        values[key] = float(np.mean(over_seeds))
        if len(over_seeds) > 1:
            values[key.replace(RATE, SPREAD)] = float(np.std(over_seeds, ddof=1))
    return values


def printed_metrics() -> dict[str, float]:
    """Return the paper's rates, for comparison with ours."""
    fused = {
        f"printed-{label}.rate_percent.{case}": rate
        for label, rates in PAPER_FUSED.items()
        for case, rate in rates.items()
    }
    return {f"printed-single.rate_percent.{name}": rate for name, rate in SINGLE.items()} | fused


def factor_table(values: Mapping[str, float], source: MemorySource) -> pd.DataFrame:
    """Tabulate our and the paper's rates and relative increases, by subset and fusion, tables 2-4.

    Rates of single matchers and of arithmetic fusion are identification rates, as in the paper. The
    paper's relative increases are computed from its printed rates, with the swapped rates corrected.
    """
    matchers = matchers_of(source.streams[TOPIC].metadata)
    rows = []
    for case, chosen in subsets_of(matchers).items():
        single = [values.get(f"single.{COUNT}.{matchers[index].name}", np.nan) for index in chosen]
        for key in values if len(chosen) > 1 else ():
            label, quantity, of = (*key.split(".", 2), "")[:3]  # failures have no case
            has_rate = f"{label}.{RATE}.{case}" in values
            if of != case or quantity != (RATE if has_rate else COUNT):
                continue
            printed = PAPER_FUSED.get(label, {}).get(case, np.nan)
            alone = [SINGLE.get(matchers[index].name, np.nan) / 100 for index in chosen]
            increase, relative = relative_rate_increase(values[key] / 100, np.array(single) / 100)
            rows.append(
                {
                    "subset": case,
                    "fusion": label,
                    "paper_percent": printed,
                    "ours_percent": values[key],
                    "sd_percent": values.get(f"{label}.{SPREAD}.{case}", np.nan),
                    "mean_single_percent": np.mean(single),
                    "ari": increase,
                    "paper_rri": relative_rate_increase(printed / 100, alone)[1],
                    "rri": relative,
                }
            )
    return pd.DataFrame(rows)


def impact_table(factors: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the mean relative increase due to fusion of one, two or all modalities, table 5."""
    kinds = {case: "one modality" if case in METHODS else "two modalities" for case in CASES[:-1]}
    judged = factors[factors["fusion"].isin(PAPER_FUSED) & factors["subset"].isin(CASES)]
    kind = judged["subset"].map(kinds).fillna("all").rename("fused")
    return judged.groupby([kind, judged["fusion"]])[["paper_rri", "rri"]].mean().reset_index()


def confidence_table(replayed: Replayed, replicates: int) -> pd.DataFrame:
    """Compute 95 % intervals of the first run's GAR at FAR, and of its EER, from resampled users."""
    names = [*(f"gar_at_far_{100 * rate:g}_percent" for rate in FALSE_ACCEPT_RATES), "eer_percent"]
    rows = []
    for topic, fused in _complete(replayed).items():
        label, case = split_topic(topic)
        drawn = 100 * bootstrap_users(fused, replicates, np.random.default_rng(0))
        bounds = np.quantile(drawn, [0.025, 0.975], axis=0).T
        rows += [(label, case, name, low, high) for name, (low, high) in zip(names, bounds, strict=True)]
    return pd.DataFrame(rows, columns=["fusion", "case", "quantity", "low", "high"])


def _complete(replayed: Replayed) -> dict[str, Fused]:
    """Return the first run's fusions of all pairs, for single matchers and for all matchers."""
    found = {
        topic: fused_of(rows.of_run(0))
        for topic, rows in replayed.outputs.items()
        if topic.endswith("/fused")
        and (split_topic(topic)[1] == "all" or split_topic(topic)[0] == "single")
    }
    return {topic: fused for topic, fused in found.items() if fused.is_complete}


def _counts(replayed: Replayed) -> dict[str, list[float]]:
    """Count identified users in every run, by fusion and case."""
    counts: dict[str, list[float]] = {}
    for run in range(len(replayed.sources)):
        of_run = {
            topic: Ragged(rows.of_run(run), np.array([0, len(rows.of_run(run))]))
            for topic, rows in replayed.outputs.items()
        }
        alone = Replayed(replayed.sources[run : run + 1], of_run, [], [], [])
        values = alone.metrics(["verification"])
        for key, value in values.items():
            counts.setdefault(key, []).append(value)
    return counts


def distribution_figure(source: MemorySource) -> Figure:
    """Draw histograms of genuine and impostor scores, one plot per matcher."""
    compared = comparisons_of(source.streams[TOPIC])
    same = np.eye(len(compared.scores), dtype=bool)
    figure = Figure(figsize=(8, 5), layout="constrained")
    plots = figure.subplots(2, -(-len(compared.matchers) // 2)).ravel()
    for index, (plot, matcher) in enumerate(zip(plots, compared.matchers, strict=False)):
        score, valid = compared.scores[:, :, index], ~compared.failed[:, :, index]
        edges = np.linspace(score[valid].min(), score[valid].max(), 80)
        for name, rows in (("impostor", ~same & valid), ("genuine", same & valid)):
            plot.hist(score[rows], edges, density=True, alpha=0.6, label=name)
        plot.set(title=matcher.name, xlabel="score", yscale="log")
    plots[0].legend()
    return figure


def curve_chart(replayed: Replayed, *, deviates: bool) -> Chart:
    """Draw the ROC or, on axes of normal deviates, the detection error trade-off."""
    series = []
    for topic, fused in _complete(replayed).items():
        found = roc(fused.score, fused.genuine)
        label = " ".join(split_topic(topic))
        accept, reject = found.false_accept, 1 - found.genuine_accept
        inside = np.flatnonzero((accept > 0) & (accept < 1))
        rows = inside[thinned(len(inside))]
        if deviates:
            x, y = norm.ppf(accept[rows]), norm.ppf(np.maximum(reject[rows], 1e-4))
        else:
            x, y = accept[rows], found.genuine_accept[rows]
        series.append(curve(label, x, y))
    if deviates:
        low, high = norm.ppf([5e-5, 0.4])
        limits = float(low), float(high)
        ticks = {float(norm.ppf(rate)): f"{100 * rate:g}" for rate in TICKS}
        x, y = (Axis(label=f"{rate} (%)", limits=limits, ticks=ticks) for rate in ("FAR", "FRR"))
        panel = Panel(x=x, y=y, series=series)
        return Chart(title="DET", panels=[panel])
    y = Axis(label="GAR", limits=(0.65, 1.005))
    return Chart(title="ROC", panels=[Panel(x=Axis(label="FAR", log=True), y=y, series=series)])


BIOMETRICS = Study(
    "fusion of biometric scores: rates by modality, method and process; ROC, EER, Cllr",
    study,
    BiometricsOptions,
)
