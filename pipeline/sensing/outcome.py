"""The result of a noise analysis, with tables, curves, sentences and a result folder."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.output.charts import Axis, Chart, Panel, band, curve
from fuselog.pipeline.output.outputs import check_folder
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.pipeline.sensing.allan import Curve, interval
from fuselog.pipeline.sensing.exports import FILES, Densities, Density
from fuselog.pipeline.sensing.fitting import Fit
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.judging.intervals import Interval

MISFIT = "misfit: "  # prefix of a sentence that users of the numbers should read first
_TERMS = {  # names of the values in a table; {} is replaced by the unit of the column
    "white": "white noise N ({}/sqrt(Hz))",
    "walk": "random walk K ({}/sqrt(s))",
    "markov": "Gauss-Markov s ({})",
    "markov_time_s": "Gauss-Markov T (s)",
    "quantisation": "quantised angle Q ({} s)",
    "ramp": "ramp R ({}/s)",
}


@dataclass(frozen=True, eq=False)
class ColumnNoise:
    """The noise of one column.

    Attributes:
        topic, field, component: the column; `component` is empty for a scalar.
        step_s: the mean time between samples.
        block: the number of samples averaged before the likelihood.
        numbers: values by the names of `Terms`, and `ramp`; 0 for a walk that was not found.
        fitted: the chosen model.
        curve: the measured Allan deviation.
        degrees: (n,) degrees of freedom of the Allan deviation.
        notes: remarks on the column, one sentence each.
    """

    topic: str
    field: str
    component: str
    step_s: float
    block: int
    numbers: Mapping[str, Interval]
    fitted: Fit
    curve: Curve
    degrees: Floats
    notes: Sequence[str]

    @property
    def name(self) -> str:
        """Return the column's name for sentences."""
        return f"{self.topic}.{self.field}" + (f".{self.component}" if self.component else "")

    @property
    def model_deviations(self) -> Floats:
        """Return the Allan deviation (n,) of the fitted model at the curve's times."""
        return np.sqrt(self.fitted.terms.allan_variance(self.curve.taus_s, self.step_s))


@dataclass(frozen=True, eq=False, repr=False)
class SensorNoise:
    """The noise of a log's columns.

    Attributes:
        name: the name of the log.
        columns: the columns.
    """

    name: str
    columns: Sequence[ColumnNoise] = field(default_factory=list)

    def __repr__(self) -> str:
        return "\n".join([self.table.to_string(index=False), *self.notes])

    @property
    def table(self) -> pd.DataFrame:
        """Return a table with a row per value: column, term with its unit, value, 95 % interval."""
        rows = [
            (column.name, _TERMS[name].format(unit_of(column.field) or "unit"), *number[:3])
            for column in self.columns
            for name, number in column.numbers.items()
        ]
        return pd.DataFrame(rows, columns=["column", "term", "value", "low", "high"])

    @property
    def notes(self) -> list[str]:
        """Return the sentences on all columns."""
        return [note for column in self.columns for note in column.notes]

    @property
    def densities(self) -> Densities:
        """Return the densities for other programs: the largest N and K among each field's axes.

        Gauss-Markov noise without a walk is replaced by the walk with the same initial growth: s sqrt(2
        / T). If no axis has a walk, K is the upper limit of the walk, because Kalibr refuses a zero, and
        a covariance of zero cannot be inverted.
        """
        found: dict[str, Density] = {}
        bounds: dict[str, float] = {}
        for column in self.columns:
            terms = column.fitted.terms
            walk = max(terms.walk, terms.markov * math.sqrt(2 / terms.markov_time_s))
            before = found.get(column.field, Density(0.0, 0.0, column.step_s))
            largest = max(before.white, terms.white), max(before.walk, walk)
            found[column.field] = Density(*largest, column.step_s)
            if not walk:
                below = column.numbers["walk"].high
                bounds[column.field] = max(bounds.get(column.field, 0.0), below)
        doubts = [note for note in self.notes if MISFIT in note]
        for name, below in bounds.items():
            if not found[name].walk:
                found[name] = found[name]._replace(walk=below)
                doubts.append(f"{name}: no walk was found; K is its 95 % upper limit")
        return Densities(self.columns[0].topic, found, doubts)

    @property
    def curves(self) -> pd.DataFrame:
        """Return a table with a row per column and time: deviation, 95 % interval, model deviation."""
        tables = []
        for column in self.columns:
            low, high = interval(column.curve.deviations, column.degrees)
            values = {
                "tau_s": column.curve.taus_s,
                "deviation": column.curve.deviations,
                "low": low,
                "high": high,
                "model": column.model_deviations,
                "degrees_of_freedom": column.degrees,
            }
            tables.append(pd.DataFrame({"column": column.name, **values}))
        return pd.concat(tables, ignore_index=True)

    @property
    def chart(self) -> Chart:
        """Draw the measured curves with their intervals, and the curves of the models."""
        panels = []
        for column in self.columns:
            low, high = interval(column.curve.deviations, column.degrees)
            taus_s = column.curve.taus_s
            panels.append(
                Panel(
                    title=column.name,
                    x=Axis(label="averaging time (s)", log=True),
                    y=Axis(label=f"Allan deviation ({unit_of(column.field) or 'unit'})", log=True),
                    bands=[band("95 %", taus_s, low, high)],
                    series=[
                        curve("measured", taus_s, column.curve.deviations, "line+markers"),
                        curve("fitted model", taus_s, column.model_deviations, "dashed"),
                    ],
                )
            )
        title = "slopes: -1 quantised angle, -1/2 white noise, 0 minimum, +1/2 random walk, +1 ramp"
        return Chart(title=title, panels=panels, columns=min(3, len(panels)))

    def draw(self, rrd: Path) -> None:
        """Write the curves to the .rrd file `rrd`, for the viewer."""
        from fuselog.replay.timeline.drawing.canvas import MUTED, PALETTE
        from fuselog.replay.timeline.drawing.curves import CurvePanel, save_curves
        from fuselog.replay.timeline.drawing.plane import Stroke

        strokes = {
            "measured": ("deviation", Stroke(PALETTE[0], 1.5)),
            "95 % from": ("low", Stroke(MUTED, 1.0)),
            "95 % to": ("high", Stroke(MUTED, 1.0)),
            "fitted model": ("model", Stroke(PALETTE[1], 1.0)),
        }
        panels = [
            CurvePanel(
                f"{name}: Allan deviation over averaging time (s)",
                {label: rows[["tau_s", key]].to_numpy() for label, (key, _) in strokes.items()},
                {label: stroke for label, (_, stroke) in strokes.items()},
            )
            for name, rows in self.curves.groupby("column", sort=False)
        ]
        save_curves(f"noise of {self.name}", panels, rrd)

    def save(self, folder: str | Path) -> ResultFolder:
        """Write tables, curves and the settings of other programs to the folder `folder`.

        Raises BadInput if the folder exists and is not a fuselog result.
        """
        place = Path(folder)
        check_folder(place, {"log": [Path(self.name)]})
        outcome = Outcome(tables={"noise": self.table, "curves": self.curves}, kind="noise")
        outcome.figures["allan"] = self.chart
        for column in self.columns:
            for name, number in column.numbers.items():
                outcome.measure(f"noise.{name}.{column.name.replace('.', '_')}", number)
        settings = {"title": f"Noise of {self.name}", "logs": [self.name], "notes": self.notes}
        with result_folder(place) as part:
            self.draw(part / "timeline.rrd")
            for name, text in FILES.items():
                written = text(self.densities)
                if written:
                    (part / name).write_text(written, encoding="utf-8")
            return ResultFolder(place, write_outcome(part, "noise", settings, outcome))
