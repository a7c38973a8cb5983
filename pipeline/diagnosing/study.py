"""A study of diagnosing, which plants faults in logs and settings and counts how often they are named.

Faults that cannot be distinguished, such as a bearing's bias and its sensor's rotated frame, are treated
as one kind. A rotation is only visible between two frames, and a drift only between two clocks, so
either of the two may be named. The gain in log-likelihood from removing a fault shows whether it is
visible at all. Some faults are invisible, such as a delay of the only sensor of a vehicle without
controls.
"""

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import NonNegativeInt

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.diagnosing.battery import battery
from fuselog.pipeline.diagnosing.diagnosis import Diagnosis, diagnose
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.diagnosing.sentences import cause_of, names_of
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.tuning import OPEN
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters, merge
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

WORTH = 10.0  # a fault is not counted if its removal increases the log-likelihood by less than this
FIRST = 0.8  # share of the counted faults that should be named first
SIZED = ("R", "Q", "delay")  # kinds of faults whose size should be in its interval
DEGREE = np.pi / 180.0
CLEAN_RUN = "none"


class Options(Parameters):
    """Options of the study: the faults to plant, and the benchmark.

    Attributes:
        faults: the names of the faults to plant, such as `landmarks-bias`; `landmarks-none` is a log
            without a fault. By default all are planted.
        battery_seed: first seed of the benchmark, see `fuselog.pipeline.diagnosing.battery.battery`.
        battery_runs: number of runs of each benchmark cell, limited to the number of runs of each fault;
            0 by default.
    """

    faults: tuple[str, ...] = ()
    battery_seed: NonNegativeInt = 0
    battery_runs: NonNegativeInt = 0


class Fault(NamedTuple):
    """A fault, and the expected diagnosis.

    Attributes:
        kind, topic: the kind and topic to be named; any topic if `topic` is empty.
        value: its size, which the 95 % interval should cover; None for a fault without a size.
        record: recorder parameters that cause the fault.
        settings: estimator settings that cause the fault.
        alteration: function that takes the run and its number and returns an alteration. The alteration
            is applied to the topic `altered` (by default `topic`) with the value `by` (by default
            `value`).
        exchanged: two topics whose messages are swapped.
    """

    kind: Kind | None = None
    topic: str = ""
    value: float | None = None
    record: Mapping[str, Any] = {}
    settings: Mapping[str, Any] = {}
    altered: str = ""
    alteration: Callable[[MemorySource, int], alter.Alteration] | None = None
    by: float | None = None
    exchanged: tuple[str, str] | None = None


class Scenario(NamedTuple):
    """A recorder with its parameters, the estimator, and the faults by name."""

    recorder: str
    parameters: Mapping[str, Any]
    estimator: str
    faults: Mapping[str, Fault]


def _plain(alteration: alter.Alteration) -> Callable[[MemorySource, int], alter.Alteration]:
    return lambda _source, _seed: alteration


def _drift(source: MemorySource, _: int) -> alter.Alteration:
    return alter.drifted(source.extent("publish_time")[0])


def _landmark_numbers(source: MemorySource, seed: int) -> alter.Alteration:
    numbers = source.streams["/landmarks"]["landmark_id"]
    first, second = np.random.default_rng(seed).choice(numbers, 2, replace=False).tolist()
    return alter.renumbered("landmark_id", first, second)


def _loss(_: MemorySource, seed: int) -> alter.Alteration:
    return alter.thinned(seed)


def _outliers(_: MemorySource, seed: int) -> alter.Alteration:
    return alter.strayed(seed, "position_m")


OVERCONFIDENT = _plain(alter.spread("covariance_m2"))
SEEN, FIX, VELOCITY = "/robot1/range_bearing", "/body/fix", "/body/velocity"
OF_VEHICLE = "/vehicle2/fix"
NOISE: Kind = "measurement noise"
BIAS: Kind = "bias or turned frame"
LOST: Kind = "lost messages"
SCENARIOS = {
    "landmarks": Scenario(
        "landmarks",
        {"speed_mps": 2.0},
        "ekf",
        {
            "R": Fault(
                NOISE, "sigma_bearing_rad", np.log(3.0), settings={"sigma_bearing_rad": 0.02 / 3.0}
            ),
            "Q": Fault(
                "process noise",
                "turn_noise_density",
                np.log(3.0),
                settings={"turn_noise_density": 0.01 / 3.0},
            ),
            "bias": Fault(BIAS, SEEN, 0.1, record={"range_bearing": {"bias_range_m": 0.1}}),
            "delay": Fault("delay", SEEN, 0.05, record={"range_bearing": {"stamp_offset_s": 0.05}}),
            "outliers": Fault("outliers", record={"range_bearing": {"outlier_probability": 0.02}}),
            "drift": Fault("clock drift", altered=SEEN, alteration=_drift, by=1e-4),
            "numbers": Fault("exchanged numbers", "/landmarks", alteration=_landmark_numbers),
            "heading": Fault(
                "start", "/robot1/prior", alteration=_plain(alter.shifted("mean", 2)), by=0.5
            ),
            "frame": Fault(
                BIAS, SEEN, 2.0 * DEGREE, record={"range_bearing": {"bias_bearing_rad": 2.0 * DEGREE}}
            ),
            "loss": Fault(LOST, SEEN, alteration=_loss, by=0.2),
        },
    ),
    "navigation": Scenario(
        "navigation",
        {"duration_s": 40.0, "unit": {"rate_hz": 50.0, "force_noise_density": 0.02}},
        "ekf",
        {
            "R": Fault(NOISE, FIX, np.log(3.0), alteration=OVERCONFIDENT, by=-np.log(3.0)),
            "Q": Fault(
                "process noise",
                "force_noise_density",
                np.log(10.0),
                settings={"force_noise_density": 0.02 / 10.0},
            ),
            "bias": Fault(BIAS, VELOCITY, 0.3, alteration=_plain(alter.shifted("velocity_mps", 0))),
            "delay": Fault("delay", FIX, 0.05, record={"gnss": {"delay_s": 0.05}}),
            "outliers": Fault("outliers", altered=FIX, alteration=_outliers, by=0.02),
            "drift": Fault("clock drift", altered=FIX, alteration=_drift, by=1e-4),
            "heading": Fault("start", "/body/prior", alteration=_plain(alter.heading_turned), by=0.5),
            "frame": Fault(
                BIAS, altered=VELOCITY, alteration=_plain(alter.turned("velocity_mps")), by=2.0 * DEGREE
            ),
            "loss": Fault(LOST, FIX, alteration=_loss, by=0.2),
        },
    ),
    "vehicles": Scenario(
        "vehicles",
        {"stochastic": True},
        "vehicle-kalman",
        {
            "R": Fault(NOISE, OF_VEHICLE, np.log(3.0), alteration=OVERCONFIDENT, by=-np.log(3.0)),
            "Q": Fault(
                "process noise",
                "acceleration_sigma_mps2",
                np.log(4.0),
                settings={"acceleration_sigma_mps2": 0.5 / 4.0},
            ),
            "bias": Fault(BIAS, OF_VEHICLE, 3.0, alteration=_plain(alter.shifted("position_m", 0))),
            "delay": Fault("delay", OF_VEHICLE, 0.05, alteration=_plain(alter.delayed)),
            "outliers": Fault("outliers", altered=OF_VEHICLE, alteration=_outliers, by=0.02),
            "drift": Fault("clock drift", altered=OF_VEHICLE, alteration=_drift, by=1e-4),
            "numbers": Fault("exchanged numbers", exchanged=("/vehicle1/fix", OF_VEHICLE)),
            "heading": Fault(
                "start", "/vehicle3/prior", alteration=_plain(alter.shifted("mean", 3)), by=-6.0
            ),
            "frame": Fault(
                BIAS, OF_VEHICLE, 2.0 * DEGREE, alteration=_plain(alter.turned("position_m"))
            ),
            "loss": Fault(LOST, OF_VEHICLE, alteration=_loss, by=0.2),
        },
    ),
}


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    rows: list[dict[str, Any]] = []
    clean: dict[tuple[str, int], MemorySource] = {}
    for name, fault_name in _chosen(setting.options.faults):
        scenario = SCENARIOS[name]
        fault = scenario.faults.get(fault_name, Fault())
        for run in setting.progress(range(experiment.runs), f"{name}: {fault_name}", experiment.runs):
            source, faulty = _recorded(scenario, fault, experiment.seed, run)
            found = diagnose(faulty, scenario.estimator, set=merge(fault.settings, OPEN))
            row = {"scenario": name, "fault": fault_name, "run": run}
            rows.append(
                {**row, "worth": _worth(scenario, fault, source, faulty), **_named_by(fault, found)}
            )
            clean.setdefault((name, run), source)
    runs = pd.DataFrame(rows)
    faults = runs.groupby(["scenario", "fault"], sort=False).apply(_summary).reset_index()
    outcome = Outcome(tables={"faults": faults, "diagnosed": runs}, figures={"faults": _chart(faults)})
    for summary in faults.to_dict("records"):
        case = f"{summary['scenario']}-{summary['fault']}"
        outcome.metrics |= {f"diagnosis.{each}.{case}": summary[each] for each in [*summary][2:]}
    outcome.metrics |= {f"diagnosis.{name}": share for name, share in _overall(runs).items()}
    if seeds := battery_seeds(setting.options, experiment.runs):
        tables, metrics = battery.results(seeds, setting.progress)
        outcome.tables |= tables
        outcome.metrics |= metrics
    outcome.input_sha256 = hash_streams([*clean.values()])
    return outcome


def _chosen(names: Collection[str]) -> list[tuple[str, str]]:
    """Return the scenario and the fault of each name; all of them if no names are given."""
    known = {
        f"{name}-{fault}": (name, fault)
        for name, scenario in SCENARIOS.items()
        for fault in (CLEAN_RUN, *scenario.faults)
    }
    if unknown := [each for each in names if each not in known]:
        raise BadInput(
            f"options.faults: the diagnosis study has no fault {unknown[0]!r}; it has {', '.join(known)}"
        )
    return [where for name, where in known.items() if not names or name in names]


def battery_seeds(options: Options, runs: int) -> range:
    """Return the seeds of each benchmark cell; a cell has at most as many runs as each fault."""
    return range(options.battery_seed, options.battery_seed + min(options.battery_runs, runs))


def _recorded(
    scenario: Scenario, fault: Fault, seed: int, run: int
) -> tuple[MemorySource, MemorySource]:
    """Record a run without a fault, and the same run with the fault."""
    parameters = merge(scenario.parameters, fault.record)
    source = memory_source(*record_run(scenario.recorder, scenario.parameters, seed, run))
    faulty = memory_source(*record_run(scenario.recorder, parameters, seed, run))
    if fault.alteration is not None:
        alteration, by = fault.alteration(faulty, run), fault.value if fault.by is None else fault.by
        faulty = alter.altered(faulty, fault.altered or fault.topic, alteration, by or 0.0)
    if fault.exchanged is not None:
        faulty = alter.exchanged(faulty, *fault.exchanged)
    return source, faulty


def _worth(scenario: Scenario, fault: Fault, source: MemorySource, faulty: MemorySource) -> float:
    """Compute the gain in log-likelihood from removing the fault; 0 if measurements are lost."""
    likelihood, settings = Likelihood(), {"kind": scenario.estimator, **OPEN}
    with_fault = Trial(scenario.estimator, [faulty], merge(settings, fault.settings))
    likelihood.begin(with_fault)
    before, after = likelihood([with_fault, Trial(scenario.estimator, [source], settings)])
    return max(after - before, 0.0)


def _named_by(fault: Fault, found: Diagnosis) -> dict[str, Any]:
    """Summarise the reported causes, and test whether the planted fault is among them."""
    is_right = [
        any(kind == fault.kind and fault.topic in ("", topic) for kind, topic in names_of(each))
        for each in found.sentences
    ]
    first = found.sentences[0] if found.sentences else None
    named = next((each for each, right in zip(found.sentences, is_right, strict=True) if right), None)
    covers = np.nan
    cause = cause_of(named) if named else None
    if cause is not None and fault.value is not None:
        low, high = cause.ends
        covers = float(low <= fault.value <= high)
    return {
        "sentences": len(found.sentences),
        "first_kind": first.kind if first else "",
        "first_topic": first.where if first else "",
        "is_first": any(is_right[:1]),
        "is_in_first_two": any(is_right[:2]),
        "covers": covers,
    }


def _summary(rows: pd.DataFrame) -> pd.Series:
    """Count runs in which the fault matters, in which it is named, and in which its size is covered."""
    counted = rows[rows["worth"] >= WORTH]
    return pd.Series(
        {
            "worth": rows["worth"].median(),
            "counted": float(len(counted)),
            "first": float(counted["is_first"].sum()),
            "first_two": float(counted["is_in_first_two"].sum()),
            "first_share": counted["is_first"].mean(),
            "first_two_share": counted["is_in_first_two"].mean(),
            "covered_share": counted["covers"].mean(),
            "named_share": rows["is_in_first_two"].mean(),
            "nothing_share": (rows["sentences"] == 0).mean(),
        }
    )


def _overall(runs: pd.DataFrame) -> dict[str, float]:
    """Compute the shares of correct diagnoses and of covered sizes over all scenarios."""
    counted = runs[runs["worth"] >= WORTH]
    sized = counted[counted["fault"].isin(SIZED)].dropna(subset=["covers"])
    return {
        "counted": float(len(counted)),
        "first_share": counted["is_first"].mean(),
        "first_two_share": counted["is_in_first_two"].mean(),
        "nothing_share": (runs[runs["fault"] == CLEAN_RUN]["sentences"] == 0).mean(),
        "covered_share": sized["covers"].mean(),
    }


def _chart(faults: pd.DataFrame) -> Chart:
    """Draw how often each visible fault is named first."""
    names = list(dict.fromkeys(faults["fault"]))
    panel = Panel(
        x=Axis(label="fault: " + ", ".join(f"{place} {name}" for place, name in enumerate(names))),
        y=Axis(label="named first", limits=(0.0, 1.05)),
    )
    for scenario, rows in faults.groupby("scenario", sort=False):
        places = [names.index(name) for name in rows["fault"]]
        panel.series.append(curve(str(scenario), places, rows["first_share"], "line+markers"))
    panel.series.append(level("80 %", list(range(len(names))), FIRST))
    return Chart(
        title="faults named first, of those that gain at least 10 in log-likelihood", panels=[panel]
    )


DIAGNOSIS = Study(
    "how often a diagnosis names the fault planted in a log",
    study,
    options=Options,
    runs="runs per fault, and at most as many per cell of the benchmark",
)
