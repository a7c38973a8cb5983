"""The study of sensor networks: what each fusion rule costs in accuracy, consistency and bytes.

Claims: Jin, Lee, Hashimoto, DIND networks. RMSE, over all runs and steps, and NEES are those after
`settle_s`, when every node has measured; ratios are the nodes' mean RMSE over that of one filter with
all sensors. Over all steps ratios are larger: at first a node knows little but its own measurement.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from pydantic import NonNegativeFloat

from pipeline.output.charts import Axis, Chart, Panel, curve, level
from pipeline.output.claims import Claim, judged
from pipeline.output.results import Outcome
from pipeline.output.summary import summarise
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.recorded import Replayed
from pipeline.runs.runner import Runner
from recorders.errors import BadInput
from recorders.parameters import Parameters
from replay.engine.streams.blocks import gather
from replay.engine.streams.sources import MemorySource
from replay.estimators.networks.covariance_intersection import fuse
from replay.estimators.networks.networks import ALONE, CENTRALISED, NetworkParameters, message_bytes
from replay.judging.errors.evaluation import Errors
from replay.judging.judge import Judge

CI = "ci-trace"


class NetworkOptions(Parameters):
    """What the study looks at besides the experiment's own runs.

    Attributes:
        settle_s: errors count from so long after the beginning on.
        losses: probabilities of losing a message that are tried.
        loss_rules: labels of the estimators that are tried at each of them.
    """

    settle_s: NonNegativeFloat = 1.0
    losses: tuple[float, ...] = (0.0, 0.5, 0.9)
    loss_rules: tuple[str, ...] = ("naive", CI)


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
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
    outcome.claims = _claims(table, by_loss, options.settle_s)
    outcome.input_sha256 = hash_streams(replayed.sources)
    return outcome


def _after(errors: Errors, settle_s: float) -> Errors:
    """The errors from more than `settle_s` after the epoch on; raises BadInput where there are none."""
    kept = errors.elapsed_s > settle_s + 1e-9
    if not kept.any():
        raise BadInput(
            f"{errors.estimator} {errors.case} has no estimates after settle_s = {settle_s:g} s; "
            "record more steps"
        )
    columns = ("run", "step", "time_ns", "elapsed_s", "error", "covariance", "nees")
    return replace(errors, **{name: getattr(errors, name)[kept] for name in columns})


def network_table(found: Sequence[Errors]) -> pd.DataFrame:
    """Per estimator: RMSE of the first node, ratio of the nodes' mean to the centralised one's, NEES."""
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
    """Bytes a directed link carries per run: what is sent, lost or not."""
    links = gather([source.streams["/links"] for source in sources])
    run = np.repeat(np.arange(links.runs), np.diff(links.offsets))
    ends = np.stack([run, links["sender_id"], links["receiver_id"]])
    messages = ends.shape[1] / max(1, np.unique(ends, axis=1).shape[1])
    states = len(sources[0].streams["/prior"].components)
    return {
        f"{label}.load_bytes_per_link": messages * message_bytes(_rule(label, values), states)
        for label, values in experiment.estimators.items()
        if _rule(label, values) != CENTRALISED
    }


def _rule(label: str, values: Mapping[str, Any]) -> str:
    """The fusion rule of an experiment's estimator."""
    variant = str(values.get("kind", label)).partition(":")[2]
    return variant or str(values.get("rule", NetworkParameters().rule))


def _by_loss(runner: Runner, options: NetworkOptions, settled: Replayed) -> pd.DataFrame:
    """NEES and ratio of some rules over the share of messages that are lost."""
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


def _claims(table: pd.DataFrame, by_loss: pd.DataFrame, settle_s: float) -> list[Claim]:
    """The paper's statements against the measured numbers; only those whose rules were run."""
    nees = dict(zip(table["estimator"], table["nees"], strict=True))
    ratio = dict(zip(table["estimator"], table["rmse_ratio"], strict=True))
    claims: list[Claim] = [_claim_of_equation_17()]
    if CI in nees:
        claims.append(
            judged(
                "CI keeps the nodes' estimates consistent in a network with cycles and lost messages",
                "provably guaranteed (section 4.2)",
                f"mean NEES {nees[CI]:.2f} of 4 states",
                nees[CI] <= 4.4,
            )
        )
        claims.append(
            judged(
                "CI is non-conservative",
                "'yields a non-conservative estimate' (section 5.2)",
                f"mean NEES {nees[CI]:.2f}: not above 4 by more than 10 %",
                nees[CI] > 4.4,
                "the text means the opposite: the paper's own section 4 calls it guaranteed",
            )
        )
    if CI in nees and ALONE in nees and CENTRALISED in nees:
        claims.append(
            judged(
                "nodes get the union of the accurate information of their neighbours",
                "section 4.2, no numbers",
                f"RMSE {ratio[CI]:.3f} times the centralised filter's, {ratio[ALONE]:.2f} alone",
                ratio[CI] < 1.11,
                f"without the first {settle_s:g} s, in which nodes start from one prior; "
                "'confirmed' is a ratio below 1.11, a limit of ours",
            )
        )
    if "naive" in nees:
        claims.append(
            judged(
                "fusing as if estimates were independent is inconsistent",
                "section 5, no numbers",
                f"mean NEES {nees['naive']:.3g} of 4 states",
                nees["naive"] > 1000,
            )
        )
    if CI in nees and "own-again" in nees:
        claims.append(
            judged(
                "the node's measurement enters once, after CI of the prediction",
                "steps 1-4 of section 4.2",
                f"NEES {nees[CI]:.2f}; {nees['own-again']:.2f} where x* itself is fused, then z again",
                nees[CI] <= 4.4 < nees["own-again"],
            )
        )
    most = by_loss[(by_loss["estimator"] == CI) & (by_loss["loss"] >= 0.9)]
    for row in most.to_dict("records"):
        claims.append(
            judged(
                "communication need not be guaranteed",
                "section 4.2, no numbers",
                f"mean NEES {row['nees']:.2f} with {row['loss']:.0%} of the messages lost",
                row["nees"] <= 4.4,
            )
        )
    return claims


def _claim_of_equation_17() -> Claim:
    """(17) as printed equates P_c^-1 with the bracket that belongs between two factors P."""
    stated = np.array([np.diag([1.0, 4.0]), [[3.0, 1.0], [1.0, 1.0]]])
    fused = fuse(CI, np.zeros((2, 2)), stated)
    # with P_ab = 0
    inner = sum(w**2 * np.linalg.inv(p) for w, p in zip(fused.weights, stated, strict=True))
    printed = float(np.trace(np.linalg.inv(inner)))
    actual = float(np.trace(fused.covariance @ inner @ fused.covariance))
    return judged(
        "(17) is the covariance of the fused error",
        "P_c^-1 = w^2 P_a^-1 + ...; Fig. 8 is drawn from it",
        f"for independent errors its trace is {printed:.3f}, the fused error's {actual:.3f}",
        bool(np.isclose(printed, actual, rtol=1e-3)),
        "the right side belongs between two factors P of (14); with P_ab unknown there is no Fig. 8",
    )


NETWORKS = Study(
    "sensor networks: what each fusion rule costs in accuracy, consistency and bytes",
    study,
    NetworkOptions,
)
