"""Study of how computing times and errors of filters grow with the number of vehicles.

Vehicles start at random in a square. Either the square's area grows with the number of vehicles, so that
the density is constant, or the square is so small that any fix may belong to any vehicle. Growth is
stated as a factor per vehicle for exponential methods, and as a power for all others.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from pydantic import PositiveFloat, PositiveInt

from fuselog.pipeline.families.vehicles.cases import scores_of
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import judge, replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.sources import MemorySource

TICKS = (2, 5, 10, 20, 50, 100)


class Swept(Parameters):
    """The largest number of vehicles for a method, and the expected growth of its computing time.

    Attributes:
        most: largest number of vehicles.
        place: whether vehicles start apart, or together in one square.
        growth: expected growth of the computing time with the number of vehicles.
    """

    most: PositiveInt
    place: Literal["apart", "together"] = "apart"
    growth: Literal["polynomial", "exponential"] = "polynomial"


class ScalingOptions(Parameters):
    """The numbers of vehicles, and the areas in which they start.

    Attributes:
        vehicles: numbers of vehicles.
        area_per_vehicle_m2: area per vehicle if the vehicles start apart.
        together_m: side of the square if the vehicles start together.
        methods: largest number of vehicles and expected growth of each method, by label.
    """

    vehicles: tuple[PositiveInt, ...] = (2, 3, 4, 5, 6, 7, 8, 10, 12, 20, 35, 50)
    area_per_vehicle_m2: PositiveFloat = 2000.0
    together_m: PositiveFloat = 4.0
    methods: dict[str, Swept] = {}


class Growth(NamedTuple):
    """Growth of computing time with the number N of vehicles, fitted to the larger half of all N."""

    power: float
    factor: float


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: ScalingOptions = setting.options
    if not experiment.record or set(options.methods) != set(experiment.estimators):
        raise BadInput(
            f"experiment '{experiment.title}': add [record], and options.methods for every estimator"
        )
    rows, sources = [], []
    for count in setting.progress(options.vehicles, "numbers of vehicles", len(options.vehicles)):
        for place in ("apart", "together"):
            chosen = {
                label: settings
                for label, settings in experiment.estimators.items()
                if options.methods[label].place == place and count <= options.methods[label].most
            }
            if chosen:
                recorded = _record(Runner(experiment, setting), options, count, place)
                rows += [(label, place, count, *_timed(recorded, label, chosen)) for label in chosen]
                sources += recorded
    columns = ["estimator", "place", "vehicles", "step_ms", "position_rmse_m", "failed_runs"]
    table = pd.DataFrame(rows, columns=columns)
    growth = {label: growth_of(own) for label, own in table.groupby("estimator", sort=False)}
    outcome = Outcome(tables={"scaling": table, "growth": _table(growth, options)})
    for label, own in table.groupby("estimator", sort=False):
        name = str(label)
        for row in own.to_dict("records"):
            case = f"{row['vehicles']:02d}-vehicles"
            outcome.metrics[f"{name}.step_ms.{case}"] = row["step_ms"]
            outcome.metrics[f"{name}.position_rmse_m.{case}"] = row["position_rmse_m"]
        outcome.metrics[f"{name}.most_vehicles"] = float(own["vehicles"].max())
        outcome.metrics[f"{name}.growth_power"] = growth[name].power
        outcome.metrics[f"{name}.growth_factor_per_vehicle"] = growth[name].factor
    outcome.figures["scaling"] = _chart(table)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _record(runner: Runner, options: ScalingOptions, count: int, place: str) -> list[MemorySource]:
    side = np.sqrt(options.area_per_vehicle_m2 * count) if place == "apart" else options.together_m
    square = (-0.5 * side, 0.5 * side) * 2
    return runner.obtain({"vehicles": count, "field_m": square})


def _timed(
    sources: Sequence[MemorySource], label: str, estimators: Mapping[str, Mapping[str, Any]]
) -> tuple[float, float, int]:
    """Measure CPU time per step (ms), RMSE per vehicle with the best labels (m), and failed runs."""
    chosen = {label: estimators[label]}
    replay_in_memory(sources[:1], chosen)  # compile first
    begin = time.process_time()
    outputs = replay_in_memory(sources, chosen)
    taken = time.process_time() - begin
    others = judge(sources, outputs, 0.2).others
    [found] = scores_of(sources, outputs, [label], others).values()
    steps = sum(len(source.streams["/network/scan"]) for source in sources)
    vehicles = sum(topic.endswith("/prior") for topic in sources[0].streams)
    well = np.isfinite(found.assigned)
    error = float(np.median(found.assigned[well])) if well.any() else np.nan
    return 1e3 * taken / steps, error / np.sqrt(vehicles), found.failed


def growth_of(table: pd.DataFrame) -> Growth:
    """Fit the growth to the larger half of the vehicle numbers, where constant costs are small.

    Steps that are too short for the clock, with a measured time of 0, are ignored.
    """
    own = table[(table["vehicles"] >= table["vehicles"].median()) & (table["step_ms"] > 0)]
    if len(own) < 2:
        return Growth(np.nan, np.nan)
    logs = np.log(own["step_ms"])
    power = np.polyfit(np.log(own["vehicles"]), logs, 1)[0]
    factor = np.exp(np.polyfit(own["vehicles"], logs, 1)[0])
    return Growth(float(power), float(factor))


def _table(growth: Mapping[Any, Growth], options: ScalingOptions) -> pd.DataFrame:
    rows = [(label, options.methods[label].growth, *each) for label, each in growth.items()]
    return pd.DataFrame(rows, columns=["estimator", "work", "power", "factor_per_vehicle"])


def _chart(table: pd.DataFrame) -> Chart:
    """Draw the time per step and the error per vehicle over the number of vehicles."""
    ticks = {float(count): str(count) for count in TICKS if count <= table["vehicles"].max()}
    x = Axis(label="vehicles", log=True, ticks=ticks)
    axes = {
        "step_ms": Axis(label="CPU time per step (ms)", log=True),
        "position_rmse_m": Axis(label="error per vehicle (m)", limits=(0, 3)),
    }
    panels = []
    for quantity, y in axes.items():
        series = curves(table, ["estimator"], "vehicles", quantity, "line+markers")
        panels.append(Panel(x=x, y=y, series=series))
    return Chart(columns=2, panels=panels)


VEHICLES_SCALING = Study(
    "time and error of cooperative vehicles' filters by the number of vehicles", study, ScalingOptions
)
