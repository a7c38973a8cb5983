"""Study of sensor networks: the accuracy, consistency and bytes of each fusion rule.

Claims: Jin, Lee, Hashimoto, DIND networks. RMSE (over all runs and steps) and NEES are computed after
`settle_s`, when every node has measured. A ratio is the nodes' mean RMSE divided by the RMSE of one
filter with all sensors. Over all steps, ratios are larger, because a node initially knows little more
than its own measurement.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from pydantic import NonNegativeFloat

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summarise
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.blocks import gather, run_of_rows
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.networks.covariance_intersection import fuse
from fuselog.replay.families.networks.estimator import CENTRALISED, NetworkParameters, message_bytes
from fuselog.replay.judging.errors.evaluation import Errors
from fuselog.replay.judging.judge import Judge

CI = "ci-trace"


class NetworkOptions(Parameters):
    """Additional settings of the study.

    Attributes:
        settle_s: time in s from the beginning of a run after which errors are evaluated.
        losses: probabilities of message loss to try.
        loss_rules: labels of the estimators that are tried at each loss probability.
    """

    settle_s: NonNegativeFloat = 1.0
    losses: tuple[float, ...] = (0.0, 0.5, 0.9)
    loss_rules: tuple[str, ...] = ("naive", CI)


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: NetworkOptions = setting.options
    runner = Runner(experiment, setting)
    replayed = runner.run()
    settled = replace(replayed, errors=[_after(each, options.settle_s) for each in replayed.errors])
    judge = Judge(replayed.sources, gap_limit_s=experiment.gap_limit_s, burn_in_s=options.settle_s)
    judge.add(replayed.outputs)
    outcome = summarise(judge)
    outcome.metrics |= _loads(experiment, replayed.sources)
    by_loss = _by_loss(runner, options, settled)
    table = network_table(settled.errors)
    for row in table.to_dict("records"):
        for quantity in ("rmse_ratio", "nees"):
            outcome.metrics[f"{row['estimator']}.{quantity}"] = row[quantity]
    for row in network_table(replayed.errors).to_dict("records"):
        outcome.metrics[f"{row['estimator']}.rmse_ratio.all-steps"] = row["rmse_ratio"]
    for row in by_loss.to_dict("records"):
        outcome.metrics[f"{row['estimator']}.nees.loss-{row['loss']}"] = row["nees"]
    outcome.tables |= {"network": table, "loss": by_loss}
    outcome.figures["loss"] = _loss_chart(by_loss)
    outcome.metrics |= traces_of_equation_17()
    outcome.input_sha256 = hash_streams(replayed.sources)
    return outcome


def _after(errors: Errors, settle_s: float) -> Errors:
    """Select the errors from `settle_s` after the epoch on; raise BadInput if there are no errors."""
    kept = errors.elapsed_s > settle_s + 1e-9
    if not kept.any():
        raise BadInput(
            f"{errors.estimator} {errors.case} has no estimates after settle_s = {settle_s:g} s; "
            "record more steps"
        )
    columns = ("run", "step", "time_ns", "elapsed_s", "error", "covariance", "nees")
    return replace(errors, **{name: getattr(errors, name)[kept] for name in columns})


def network_table(found: Sequence[Errors]) -> pd.DataFrame:
    """Tabulate the first node's RMSE, the mean RMSE relative to the centralised filter, and NEES."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for errors in found:
        squared = np.sum(errors.error[:, errors.position] ** 2, axis=1)
        rows.setdefault(errors.estimator, []).append(
            (float(np.sqrt(squared.mean())), float(np.nanmean(errors.nees)))
        )
    best = rows[CENTRALISED][0][0] if CENTRALISED in rows else np.nan
    return pd.DataFrame(
        {
            "estimator": list(rows),
            "rmse_first_node_m": [nodes[0][0] for nodes in rows.values()],
            "rmse_ratio": [
                float(np.mean([rmse for rmse, _ in nodes])) / best for nodes in rows.values()
            ],
            "nees": [float(np.mean([nees for _, nees in nodes])) for nodes in rows.values()],
        }
    )


def _loads(experiment: Experiment, sources: Sequence[MemorySource]) -> dict[str, float | None]:
    """Count the bytes per run on a directed link, including lost messages."""
    links = gather([source.streams["/links"] for source in sources])
    run = run_of_rows(links.offsets)
    ends = np.stack([run, links["sender_id"], links["receiver_id"]])
    messages = ends.shape[1] / max(1, np.unique(ends, axis=1).shape[1])
    states = len(sources[0].streams["/prior"].components)
    return {
        f"{label}.load_bytes_per_link": messages * message_bytes(_rule(label, values), states)
        for label, values in experiment.estimators.items()
        if _rule(label, values) != CENTRALISED
    }


def _rule(label: str, values: Mapping[str, Any]) -> str:
    """Return the fusion rule of an experiment's estimator."""
    variant = str(values.get("kind", label)).partition(":")[2]
    return variant or str(values.get("rule", NetworkParameters().rule))


def _by_loss(runner: Runner, options: NetworkOptions, settled: Replayed) -> pd.DataFrame:
    """Tabulate NEES and RMSE ratio of the rules in `loss_rules` by the share of lost messages."""
    experiment = runner.experiment
    labels = [label for label in experiment.estimators if label in options.loss_rules]
    chosen = {
        label: experiment.estimators[label]
        for label in (*labels, CENTRALISED)
        if label in experiment.estimators
    }
    own = settled.sources[0].run
    assert own is not None
    found = {own.parameters["loss_probability"]: network_table(settled.errors)}
    for loss in options.losses:
        errors = runner.replay(runner.obtain({"loss_probability": loss}), chosen).errors
        found[loss] = network_table([_after(each, options.settle_s) for each in errors])
    parts = [found[loss].assign(loss=loss) for loss in sorted(found)]
    table = pd.concat(parts, ignore_index=True)
    return table[table["estimator"].isin(labels)]


def _loss_chart(table: pd.DataFrame) -> Chart:
    series = [
        curve(str(estimator), part["loss"], part["nees"], "line+markers")
        for estimator, part in table.groupby("estimator")
    ]
    panel = Panel(
        x=Axis(label="share of messages lost"),
        y=Axis(label="mean NEES (4 states)", log=True),
        series=[*series, level("consistent", np.sort(table["loss"]), 4)],
    )
    return Chart(panels=[panel])


def traces_of_equation_17() -> dict[str, float]:
    """Compute the trace of (17) as printed and of the fused covariance, for independent errors.

    The paper equates P_c^-1 with the expression in brackets, B; the fused error has the covariance P B P
    instead, where P is the covariance that covariance intersection states.
    """
    stated = np.array([np.diag([1.0, 4.0]), [[3.0, 1.0], [1.0, 1.0]]])
    fused = fuse(CI, np.zeros((2, 2)), stated)
    # with P_ab = 0
    inner = sum(w**2 * np.linalg.inv(p) for w, p in zip(fused.weights, stated, strict=True))
    return {
        "equation-17.printed_trace": float(np.trace(np.linalg.inv(inner))),
        "equation-17.fused_trace": float(np.trace(fused.covariance @ inner @ fused.covariance)),
    }


NETWORKS = Study(
    "sensor networks: cost of each fusion rule in accuracy, consistency and bytes",
    study,
    NetworkOptions,
)
