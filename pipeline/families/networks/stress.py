"""Study of covariance intersection with delays, absent nodes, false estimates or rare messages.

Each run has one mean NEES and one mean squared error over its nodes after `settle_s`; intervals are over
the runs. The claims are ours and were made before the results were known. As in the study of networks, a
filter with n states is consistent if its mean NEES exceeds n by at most 10 %, with 95 % confidence.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, curves, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.families.networks.estimator import message_bytes
from fuselog.replay.judging.intervals import mean_interval

CALM, CI, NAIVE = "calm", "ci", "naive"
INTERVAL, NEWS = "at most once in an interval", "when it has news"


class StressOptions(Parameters):
    """The stress on the network.

    Attributes:
        settle_s: time in s from the beginning of a run after which errors are evaluated.
        cases: changes to the scenario's parameters, by the name of a case.
        intervals_s: minimum times in s between two messages of a node, one case for each.
        divergences: differences in nats between a node's estimate and its last message at which the node
            sends a new message; one case for each.
        liar: number of the node that sends false estimates.
        lie_after_s: time in s after which this node sends false estimates.
        lies_m: offsets in m that this node adds to its estimates, one case for each.
        gate_probability: consistent estimates pass the gate with at least this probability.
    """

    settle_s: NonNegativeFloat = 1.0
    cases: dict[str, dict[str, Any]] = {}
    intervals_s: tuple[PositiveFloat, ...] = (0.1, 0.2, 0.5, 1.0, 2.0)
    divergences: tuple[PositiveFloat, ...] = (0.1, 0.3, 1.0, 3.0)
    liar: PositiveInt = 2
    lie_after_s: NonNegativeFloat = 3.0
    lies_m: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0)
    gate_probability: Annotated[float, Field(gt=0, lt=1)] = 0.999


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: StressOptions = setting.options
    for name in (CI, NAIVE):
        if name not in experiment.estimators:
            raise BadInput(
                f"study network-stress: experiment '{experiment.title}' needs an estimator '{name}'"
            )
    runner, outcome = Runner(experiment, setting), Outcome()
    calm = runner.run()
    found = [of_runs(calm, options.settle_s).assign(case=CALM)]
    sources = list(calm.sources)
    for name, parameters in options.cases.items():
        replayed = runner.replay(runner.obtain(parameters))
        found.append(of_runs(replayed, options.settle_s).assign(case=name))
        sources += replayed.sources
    stressed = pd.concat(found, ignore_index=True)
    sending = _sending(runner, calm, options)
    lying = _lying(runner, calm, options)
    for (case, estimator), rows in stressed.groupby(["case", "estimator"], sort=False):
        _measure(rows, f"{estimator}.{{}}.{case}", outcome)
    outcome.tables |= {
        "stressed": stressed,
        "sending": summarised(sending, ["estimator", "policy", "limit"]),
        "lying": summarised(lying, ["estimator", "lie_m"]),
    }
    for (estimator, policy, limit), rows in sending.groupby(
        ["estimator", "policy", "limit"], sort=False
    ):
        case = ("every" if policy == INTERVAL else "news") + f"-{limit:g}".replace(".", "_")
        _measure(rows, f"{estimator}.{{}}.{case}", outcome)
        outcome.metrics[f"{estimator}.bytes_per_s.{case}"] = float(rows["bytes_per_s"].mean())
    _measure_economy(sending[sending["estimator"] == CI], outcome)
    lying["refused"] = lying["liar_refused"] + lying["honest_refused"]
    for (estimator, lie_m), rows in lying.groupby(["estimator", "lie_m"], sort=False):
        case = f"lie-{lie_m:g}m".replace(".", "_")
        _measure(rows, f"{estimator}.{{}}.{case}", outcome)
        for share in ("liar_refused", "honest_refused", "refused"):
            outcome.measure(f"{estimator}.{share}.{case}", mean_interval(rows[share]))
    outcome.figures |= {
        "bandwidth": _bandwidth_chart(outcome.tables["sending"]),
        "lies": _lie_chart(outcome.tables["lying"]),
    }
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _measure(rows: pd.DataFrame, key: str, outcome: Outcome) -> None:
    """Measure mean NEES and RMSE over the runs; `key` has a placeholder for the quantity."""
    outcome.measure(key.format("nees"), mean_interval(rows["nees"]))
    outcome.metrics[key.format("position_rmse_m")] = float(np.sqrt(rows["squared_m2"].mean()))


def _measure_economy(rows: pd.DataFrame, outcome: Outcome) -> None:
    """Measure the RMSE of sending on change relative to sending at intervals, at equal bandwidth."""
    by_interval, by_news = (rows[rows["policy"] == policy] for policy in (INTERVAL, NEWS))
    grid = by_interval.pivot_table(index="bytes_per_s", columns="run", values="squared_m2").sort_index()
    for limit, own in by_news.groupby("limit", sort=False):
        bytes_per_s = float(own["bytes_per_s"].iloc[0])
        if grid.index[0] <= bytes_per_s <= grid.index[-1]:
            place = np.log(bytes_per_s)
            usual = [np.interp(place, np.log(grid.index), np.log(grid[run])) for run in own["run"]]
            difference = 0.5 * (np.log(own["squared_m2"].to_numpy()) - np.array(usual))
            ratio = mean_interval(difference).rising(np.exp)
            case = f"news-{float(str(limit)):g}".replace(".", "_")
            outcome.measure(f"{CI}.rmse_ratio_to_intervals.{case}", ratio)


def of_runs(replayed: Replayed, settle_s: float, without: int | None = None) -> pd.DataFrame:
    """Compute mean NEES and squared position error by estimator and run; skip node `without`."""
    parts = []
    for errors in replayed.errors:
        if errors.case != f"node{without}":
            kept = errors.elapsed_s > settle_s + 1e-9
            squared = np.sum(errors.error[:, errors.position] ** 2, axis=1)
            columns = {"run": errors.run, "nees": errors.nees, "squared_m2": squared}
            parts.append(pd.DataFrame(columns)[kept].assign(estimator=errors.estimator))
    rows = pd.concat(parts, ignore_index=True)
    return rows.groupby(["estimator", "run"], sort=False).mean().reset_index()


def summarised(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Average over the runs."""
    found = rows.groupby(by, sort=False).mean(numeric_only=True).drop(columns="run").reset_index()
    return found.assign(position_rmse_m=np.sqrt(found["squared_m2"]))


def _sending(runner: Runner, calm: Replayed, options: StressOptions) -> pd.DataFrame:
    """Tabulate errors, and bytes per second per node, by run, estimator and sending policy."""
    policies = [(INTERVAL, "send_interval_s", value) for value in options.intervals_s]
    policies += [("when it has news", "send_divergence", value) for value in options.divergences]
    parts = []
    for policy, parameter, value in policies:
        estimators = {
            name: {**runner.experiment.estimators[name], parameter: value} for name in (CI, NAIVE)
        }
        replayed = runner.replay(calm.sources, estimators)
        rows = of_runs(replayed, options.settle_s)
        bytes_per_s = {name: _bytes_per_s(replayed, name) for name in (CI, NAIVE)}
        parts.append(
            rows.assign(policy=policy, limit=value, bytes_per_s=rows["estimator"].map(bytes_per_s))
        )
    return pd.concat(parts, ignore_index=True)


def _bytes_per_s(replayed: Replayed, estimator: str) -> float:
    """Compute the mean number of bytes that a node sends per second."""
    first = replayed.sources[0]
    begin_ns, end_ns = first.extent("publish_time")
    sent = _of(replayed.outputs, estimator, "/sent")
    span_s = (end_ns - begin_ns) * 1e-9 * len(replayed.sources) * len(sent)
    size = message_bytes(estimator, len(first.streams["/prior"].components))
    return sum(map(len, sent)) * size / span_s


def _of(outputs: Mapping[str, Ragged], estimator: str, leaf: str) -> list[Ragged]:
    start = f"/estimates/{estimator}/"
    return [rows for topic, rows in outputs.items() if topic.startswith(start) and topic.endswith(leaf)]


def _lying(runner: Runner, calm: Replayed, options: StressOptions) -> pd.DataFrame:
    """Tabulate errors of the other nodes while one lies, by run and offset, with and without a gate."""
    parts = []
    own = runner.experiment.estimators[CI]
    for lie_m in (0.0, *options.lies_m):
        lying = {**own, "liar": options.liar, "lie_m": lie_m, "lie_after_s": options.lie_after_s}
        estimators = {CI: lying, "gated": {**lying, "gate_probability": options.gate_probability}}
        replayed = runner.replay(calm.sources, estimators)
        rows = of_runs(replayed, options.lie_after_s, options.liar).assign(lie_m=lie_m)
        shares = _refused(replayed, options)
        is_gated = rows["estimator"] == "gated"
        for name, share in shares.items():
            rows[name] = np.where(is_gated, rows["run"].map(share), 0.0)
        parts.append(rows)
    return pd.concat(parts, ignore_index=True)


def _refused(replayed: Replayed, options: StressOptions) -> dict[str, dict[int, float]]:
    """Compute the shares of the liar's and of other nodes' messages that were rejected, by run."""
    [refused] = _of(replayed.outputs, "gated", "/refused")
    shares: dict[str, dict[int, float]] = {"liar_refused": {}, "honest_refused": {}}
    for run, source in enumerate(replayed.sources):
        arrived = source.streams["/links"]
        counts = []
        for links in (refused.of_run(run), arrived.take(arrived["lost"] == 0)):
            heard = links["receiver_id"] != options.liar
            heard &= links.publish_time_ns >= source.epoch_ns + round(options.lie_after_s * 1e9)
            is_liar = links["sender_id"] == options.liar
            counts.append([int((heard & is_liar).sum()), int((heard & ~is_liar).sum())])
        for name, out, of in zip(shares, *counts, strict=True):
            shares[name][run] = out / of
    return shares


STATES = 4


def _bandwidth_chart(table: pd.DataFrame) -> Chart:
    """Draw error and NEES over the bytes that a node sends per second."""
    panels = []
    for quantity, label in (
        ("position_rmse_m", "RMSE of the position (m)"),
        ("nees", "mean NEES (4 states)"),
    ):
        panel = Panel(x=Axis(label="sent by a node (B/s)", log=True), y=Axis(label=label, log=True))
        for (estimator, policy), rows in table.groupby(["estimator", "policy"], sort=False):
            rows = rows.sort_values("bytes_per_s")
            panel.series.append(
                curve(f"{estimator}, {policy}", rows["bytes_per_s"], rows[quantity], "line+markers")
            )
        panels.append(panel)
    panels[1].series.append(level("consistent", np.sort(table["bytes_per_s"]), STATES))
    return Chart(columns=2, panels=panels)


def _lie_chart(table: pd.DataFrame) -> Chart:
    """Draw error and NEES of the other nodes, and the share of rejected messages, over the offset."""
    labels = {
        "position_rmse_m": "RMSE of the other nodes (m)",
        "nees": "mean NEES of the other nodes",
        "liar_refused": "share of the liar's messages rejected",
    }
    panels = [
        Panel(
            x=Axis(label="lie (m)"),
            y=Axis(label=label, log=quantity != "liar_refused"),
            series=curves(table, ["estimator"], "lie_m", quantity, "line+markers"),
        )
        for quantity, label in labels.items()
    ]
    return Chart(columns=3, panels=panels)


NETWORK_STRESS = Study(
    "sensor networks with delayed messages, absent or faulty nodes, and little bandwidth",
    study,
    StressOptions,
)
