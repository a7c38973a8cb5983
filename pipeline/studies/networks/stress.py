"""The study of networks under stress: what lateness, absence, lies and silence cost CI.

Each run gives one mean NEES and one mean squared error over its nodes after `settle_s`; intervals are
over the runs. The claims are ours, and were set before their numbers were seen: a filter of n states
counts as consistent where the mean NEES is, with 95 %, not above n by more than 10 %, as in the study of
networks.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from pipeline.output.charts import Axis, Chart, Panel, curve, level
from pipeline.output.claims import Claim, judged
from pipeline.output.results import Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.recorded import Replayed
from pipeline.runs.runner import Runner
from pipeline.studies.toolkit.repetitions import Interval, mean_interval
from recorders.errors import BadInput
from recorders.parameters import Parameters
from replay.engine.streams.blocks import Ragged
from replay.estimators.networks.networks import message_bytes

CALM, CI, NAIVE = "calm", "ci", "naive"
INTERVAL, NEWS = "at most once in an interval", "when it has news"
OWN = "(own claim)"
BEYOND = 1.1  # times the number of states: NEES of what is not consistent


class StressOptions(Parameters):
    """What the network is put under.

    Attributes:
        settle_s: errors count from so long after the beginning on.
        cases: what differs in the scenario, by the name of a case.
        intervals_s: least times between two messages of a node that are tried, in s.
        divergences: differences from its last message, in nats, from which on a node sends, that are
            tried.
        liar: number of the node that lies.
        lie_after_s: from when on it lies.
        lies_m: what it adds to its estimates, in m; all are tried.
        great_lie_m: the lie that the claims are about.
        gate_probability: honest estimates pass the gate with at least this probability.
    """

    settle_s: NonNegativeFloat = 1.0
    cases: dict[str, dict[str, Any]] = {}
    intervals_s: tuple[PositiveFloat, ...] = (0.1, 0.2, 0.5, 1.0, 2.0)
    divergences: tuple[PositiveFloat, ...] = (0.1, 0.3, 1.0, 3.0)
    liar: PositiveInt = 2
    lie_after_s: NonNegativeFloat = 3.0
    lies_m: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0)
    great_lie_m: float = 1.0
    gate_probability: Annotated[float, Field(gt=0, lt=1)] = 0.999


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
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
        outcome.metrics[f"{estimator}.nees.{case}"] = float(rows["nees"].mean())
        outcome.metrics[f"{estimator}.position_rmse_m.{case}"] = float(
            np.sqrt(rows["squared_m2"].mean())
        )
    outcome.tables |= {
        "stressed": stressed,
        "sending": summarised(sending, ["estimator", "policy", "limit"]),
        "lying": summarised(lying, ["estimator", "lie_m"]),
    }
    for row in outcome.tables["sending"].to_dict("records"):
        case = ("every" if row["policy"] == INTERVAL else "news") + f"-{row['limit']:g}"
        for quantity in ("position_rmse_m", "nees", "bytes_per_s"):
            outcome.metrics[f"{row['estimator']}.{quantity}.{case.replace('.', '_')}"] = row[quantity]
    for row in outcome.tables["lying"].to_dict("records"):
        case = f"lie-{row['lie_m']:g}m".replace(".", "_")
        for quantity in ("position_rmse_m", "nees", "liar_refused", "honest_refused"):
            outcome.metrics[f"{row['estimator']}.{quantity}.{case}"] = row[quantity]
    outcome.claims = [
        *(_consistent(name, stressed) for name in options.cases),
        _naive(stressed),
        *_economy(sending),
        *_lie_claims(lying, options),
    ]
    outcome.figures |= {
        "bandwidth": _bandwidth_chart(outcome.tables["sending"]),
        "lies": _lie_chart(outcome.tables["lying"]),
    }
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def of_runs(replayed: Replayed, settle_s: float, without: int | None = None) -> pd.DataFrame:
    """Mean NEES and squared error of the position, by estimator and run; of all nodes but one."""
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
    """Means over the runs."""
    found = rows.groupby(by, sort=False).mean(numeric_only=True).drop(columns="run").reset_index()
    return found.assign(position_rmse_m=np.sqrt(found["squared_m2"]))


def _sending(runner: Runner, calm: Replayed, options: StressOptions) -> pd.DataFrame:
    """Errors and bytes a second and node, by run, estimator and how it is decided when to send."""
    policies = [
        ("at most once in an interval", "send_interval_s", value) for value in options.intervals_s
    ]
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
    """What a node sends a second, on the average."""
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
    """Errors of the honest nodes while one lies, by run, size of the lie, without a gate and with it."""
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
    """What share of the liar's and of the others' messages honest nodes refuse while it lies, by run."""
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


def _nees(rows: pd.DataFrame) -> Interval:
    return mean_interval(rows["nees"].to_list())


def _told(interval: Interval) -> str:
    return f"{interval.mean:.3g}, 95 % {interval.low:.3g} to {interval.high:.3g}"


STATES = 4
LIMIT = BEYOND * STATES
TITLES = {
    "late": "messages are late and overtake each other",
    "joining": "nodes join and leave",
    "all": "messages are late, lost and doubled, and nodes join and leave",
}


def _consistent(case: str, table: pd.DataFrame) -> Claim:
    found = _nees(table[(table["case"] == case) & (table["estimator"] == CI)])
    return judged(
        f"CI is consistent where {TITLES.get(case, case)}",
        OWN,
        f"mean NEES of 4 states {_told(found)}",
        found.high <= LIMIT,
        f"confirmed if the interval's upper end is {LIMIT:g} or less",
    )


def _naive(table: pd.DataFrame) -> Claim:
    found = [_nees(rows) for _, rows in table[table["estimator"] == NAIVE].groupby("case", sort=False)]
    return judged(
        "fusing as if estimates were independent is inconsistent in all of these cases",
        OWN,
        f"mean NEES of 4 states from {min(each.mean for each in found):.3g} on",
        min(each.low for each in found) > LIMIT,
        f"confirmed if all intervals' lower ends are above {LIMIT:g}",
    )


def _economy(table: pd.DataFrame) -> list[Claim]:
    """Whether sending news beats sending in intervals, and whether CI stays consistent."""
    own = table[table["estimator"] == CI]
    by_interval, by_news = (own[own["policy"] == policy] for policy in (INTERVAL, NEWS))
    grid = by_interval.pivot_table(index="bytes_per_s", columns="run", values="squared_m2").sort_index()
    gains = []
    for _, rows in by_news.groupby("limit", sort=False):
        bytes_per_s = float(rows["bytes_per_s"].iloc[0])
        if grid.index[0] <= bytes_per_s <= grid.index[-1]:
            place = np.log(bytes_per_s)
            usual = [np.interp(place, np.log(grid.index), np.log(grid[run])) for run in rows["run"]]
            difference = 0.5 * (np.log(rows["squared_m2"].to_numpy()) - np.array(usual))
            gains.append(
                (float(bytes_per_s), Interval(*np.exp(mean_interval(difference.tolist())).tolist()))
            )
    told = "; ".join(f"{at:.0f} B/s: {_told(gain)}" for at, gain in gains)
    nees = [_nees(rows) for _, rows in own.groupby(["policy", "limit"], sort=False)]
    worst = max(nees, key=lambda each: each.high)
    return [
        judged(
            "at equal bandwidth sending news has smaller errors than sending in intervals",
            OWN,
            f"RMSE over that of intervals at {told}",
            bool(gains) and all(gain.high < 1.0 for _, gain in gains),
            "confirmed if all intervals are below 1",
        ),
        judged(
            "CI is consistent at any bandwidth",
            OWN,
            f"largest mean NEES of 4 states {_told(worst)}",
            worst.high <= LIMIT,
            f"confirmed if the interval's upper end is {LIMIT:g} or less",
        ),
    ]


def _lie_claims(table: pd.DataFrame, options: StressOptions) -> list[Claim]:
    """What a great lie does without a gate and with one, and what the gate keeps out."""
    great = table[table["lie_m"] == options.great_lie_m]
    plain, gated = (great[great["estimator"] == name] for name in (CI, "gated"))
    misled, guarded = _nees(plain), _nees(gated)
    noticed = mean_interval(gated["liar_refused"].to_list())
    honest = table[(table["lie_m"] == 0.0) & (table["estimator"] == "gated")]
    false = mean_interval((honest["honest_refused"] + honest["liar_refused"]).to_list())
    allowed = 2.0 * (1.0 - options.gate_probability)
    lie = f"a node that lies by {options.great_lie_m:g} m"
    return [
        judged(
            f"{lie} makes honest nodes inconsistent where they fuse all that they hear",
            OWN,
            f"mean NEES of 4 states {_told(misled)}",
            misled.low > LIMIT,
            f"confirmed if the interval's lower end is above {LIMIT:g}",
        ),
        judged(
            f"{lie} is noticed by the gate",
            OWN,
            f"share of its messages refused {_told(noticed)}",
            noticed.low >= 0.9,
            "confirmed if the interval's lower end is .9 or more",
        ),
        judged(
            f"with the gate honest nodes stay consistent beside {lie}",
            OWN,
            f"mean NEES of 4 states {_told(guarded)}",
            guarded.high <= LIMIT,
            f"confirmed if the interval's upper end is {LIMIT:g} or less",
        ),
        judged(
            "where nobody lies the gate refuses no more than it says",
            OWN,
            f"share of messages refused {_told(false)}; allowed {allowed:.2g}",
            false.high <= allowed,
            "the sum of the shares of the node that could lie and of the others",
        ),
    ]


def _bandwidth_chart(table: pd.DataFrame) -> Chart:
    """Error and NEES over what a node sends a second."""
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
    """Error and NEES of the honest nodes, and what is refused, over the size of the lie."""
    labels = {
        "position_rmse_m": "RMSE of honest nodes (m)",
        "nees": "mean NEES of honest nodes",
        "liar_refused": "share of the liar's messages refused",
    }
    panels = [
        Panel(
            x=Axis(label="lie (m)"),
            y=Axis(label=label, log=quantity != "liar_refused"),
            series=[
                curve(str(name), rows["lie_m"], rows[quantity], "line+markers")
                for name, rows in table.groupby("estimator", sort=False)
            ],
        )
        for quantity, label in labels.items()
    ]
    return Chart(columns=3, panels=panels)


NETWORK_STRESS = Study(
    "sensor networks with late messages, nodes that come, go or lie, and little bandwidth",
    study,
    StressOptions,
)
