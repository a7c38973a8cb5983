"""Calibration of a rotated magnetometer or accelerometer: offsets, scales, cross terms.

The magnetic field and gravity have a constant length in all orientations of a unit. Therefore, corrected
readings are on a sphere, and raw readings are on an ellipsoid; see `ellipsoid_fit`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.api.planning import Log, sources_of
from fuselog.pipeline.calibrating.ellipsoid_fit import AXES, NAMES, Fit, fit, matrix_of, middle
from fuselog.pipeline.optimise import QUANTILE
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.outputs import check_folder
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.recorders.errors import BadInput, choices, without_warnings_of_numbers
from fuselog.recorders.units import STANDARD_GRAVITY_MPS2, unit_of
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.intervals import Interval

FEWEST, MOST = 30, 20_000  # largest number of readings; larger sets are thinned
_STILL_S = 0.5  # an accelerometer reading is a mean over this time, in which the sensor is still
_STILL = 3.0  # limit on the spread of a still sensor, as a multiple of that of the quietest tenth
_DRAWN = 500


@dataclass(frozen=True, eq=False, repr=False)
class Ellipsoid:
    """The calibration of a sensor that was rotated: corrected = matrix (reading - offset).

    Attributes:
        topic, field: the topic and field of the readings.
        logs: the names of the logs.
        length: the length of corrected readings.
        is_assumed: whether the length was computed from the readings, because none was given.
        unit: the length that the fit uses as its unit.
        readings: (n, 3) the fitted readings.
        fitted: the ellipsoid.
    """

    topic: str
    field: str
    logs: Sequence[str]
    length: float
    is_assumed: bool
    unit: float
    readings: Floats
    fitted: Fit

    def __repr__(self) -> str:
        return "\n".join([self.table.to_string(index=False), *self.notes])

    @property
    def offset(self) -> Floats:
        """Return the offset (3,) in the field's unit: hard iron, or an accelerometer's bias."""
        return self.unit * self.fitted.numbers[:3]

    @property
    def matrix(self) -> Floats:
        """Return the symmetric matrix (3, 3) of scales and cross terms; soft iron for a magnetometer."""
        return matrix_of(self.fitted.numbers) * self.length / self.unit

    @property
    def left_open(self) -> list[str]:
        """List undetermined parameters, or all of them if the orientations are too few for a fit."""
        places = self.fitted.lacking.places
        return [NAMES[place] for place in places] if self.fitted.turned_about or not places else [*NAMES]

    @property
    def table(self) -> pd.DataFrame:
        """Return a table with each parameter's value and 95 % interval, or NaN if not determined."""
        factors = np.where(np.arange(len(NAMES)) < 3, self.unit, self.length / self.unit)
        values = self.fitted.numbers * factors
        reach = QUANTILE * np.sqrt(np.diagonal(self.fitted.covariance)) * factors
        is_open = np.isin(NAMES, self.left_open)
        numbers = {"value": values, "low": values - reach, "high": values + reach}
        known = {name: np.where(is_open, np.nan, column) for name, column in numbers.items()}
        return pd.DataFrame({"parameter": NAMES, **known})

    @property
    def settings(self) -> dict[str, str]:
        """Return settings that correct a log's readings, or {} if a parameter is not determined."""
        if self.left_open:
            return {}
        stem, _, unit = self.field.rpartition("_")
        corrected = {
            f"{self.topic}.{stem}_{axis}_{unit}_bias": f"{value:.6g}"
            for axis, value in zip(AXES, self.offset, strict=True)
        }
        rows = ",".join(f"{value:.6g}" for value in self.matrix.ravel())
        return corrected | {f"{self.topic}.{self.field}_matrix": rows}

    @property
    def lengths(self) -> tuple[Floats, Floats]:
        """Return the lengths (n,) of uncorrected and corrected readings."""
        corrected = (self.readings - self.offset) @ self.matrix
        return np.linalg.norm(self.readings, axis=1), np.linalg.norm(corrected, axis=1)

    @property
    def notes(self) -> list[str]:
        """Return sentences on undetermined parameters, the fit's quality, and how to correct a log."""
        unit, fitted = unit_of(self.field), self.fitted
        before, after = (float(np.sqrt(np.mean((each - self.length) ** 2))) for each in self.lengths)
        sentences = []
        if self.left_open:
            axis = fitted.turned_about
            turned = f"about one axis only, near {axis}" if axis else "to too few sides"
            others = f"about {' or '.join(AXES.replace(axis, ''))} as well" if axis else "to all sides"
            sentences.append(
                f"the unit was rotated {turned}, which does not determine {', '.join(self.left_open)}, "
                f"so no value is given; rotate it {others}"
            )
        else:
            sentences.append(
                f"{len(self.readings)} readings: their lengths differ from {self.length:.5g} {unit} by "
                f"{before:.3g} {unit} uncorrected, {after:.3g} {unit} corrected (root mean square)"
            )
        if self.is_assumed:
            sentences.append(
                f"no --length was given: {self.length:.5g} {unit} is assumed, which makes the mean "
                "scale one, and only the ratios of the scales are meaningful"
            )
        if fitted.correlation:
            sentences.append(
                f"errors of successive readings have a correlation of {fitted.correlation:.2g}, which "
                "widens the intervals"
            )
        if self.settings:
            words = " ".join(f"--set {name}={value}" for name, value in self.settings.items())
            sentences.append(f"corrected = matrix (reading - offset): fuselog replay {words}")
        return sentences

    @property
    def chart(self) -> Chart:
        """Draw the lengths of uncorrected and corrected readings."""
        rows = np.linspace(0, len(self.readings) - 1, min(_DRAWN, len(self.readings))).astype(int)
        before, after = (each[rows] for each in self.lengths)
        panel = Panel(
            x=Axis(label="reading"),
            y=Axis(label=f"length ({unit_of(self.field) or 'unit'})"),
            series=[
                curve("uncorrected", rows, before, "markers"),
                curve("corrected", rows, after, "markers"),
                level("stated", rows, self.length),
            ],
        )
        return Chart(title=f"{self.topic}.{self.field}", panels=[panel])

    def save(self, folder: str | Path) -> ResultFolder:
        """Write the table and the figure to the result folder `folder`.

        Raises BadInput if the folder exists and is not a fuselog result.
        """
        place = Path(folder)
        check_folder(place, {"log": [Path(name) for name in self.logs]})
        outcome = Outcome(figures={"lengths": self.chart}, kind="ellipsoid")
        outcome.tables["ellipsoid"] = self.table
        for row in self.table.dropna().to_dict("records"):
            number = Interval(row["value"], row["low"], row["high"])
            outcome.measure(f"ellipsoid.{row['parameter']}", number)
        settings = {
            "title": f"Ellipsoid of {self.topic}.{self.field}",
            "logs": list(self.logs),
            "alterations": self.settings,
            "notes": self.notes,
        }
        with result_folder(place) as part:
            return ResultFolder(place, write_outcome(part, "ellipsoid", settings, outcome))


@without_warnings_of_numbers()
def ellipsoid(logs: Log | Iterable[Log], field: str, *, length: float | None = None) -> Ellipsoid:
    """Estimate offsets, scales and cross terms of a magnetometer or an accelerometer that was rotated.

    For an accelerometer, only readings while the unit is stationary are used, because it then measures
    only gravity. The matrix is symmetric, because readings do not determine the rotation between the
    sensor's and the body's axes.

    Args:
        logs: paths, opened logs, or recordings of one sensor unit that was rotated through many
            orientations.
        field: the field, such as `/imu.magnetic_field_ut`.
        length: the vector's length in the field's unit. The default is gravity for a specific force,
            otherwise the length for which the mean of the scales is one.

    Returns:
        Offset (3,) and matrix (3, 3) with 95 % intervals, and the quality of the fit.

    Raises BadInput if a log has no such field, or too few readings.
    """
    sources = sources_of(logs)
    readings = np.concatenate([_readings(source, field) for source in sources])
    if len(readings) < FEWEST:
        raise BadInput(
            f"{field}: has {len(readings)} readings; an ellipsoid needs at least {FEWEST}; a reading of "
            "an accelerometer is its mean over half a second at rest"
        )
    if np.ptp(readings, axis=0).max() == 0.0:
        raise BadInput(f"{field}: its {len(readings)} readings are all equal; rotate the unit")
    readings = readings[:: -(-len(readings) // MOST)]
    topic, _, name = field.rpartition(".")
    _, unit = middle(readings)
    fitted = fit(readings / unit)
    stated = STANDARD_GRAVITY_MPS2 if length is None and unit_of(name) == "m/s^2" else length
    return Ellipsoid(
        topic,
        name,
        [source.name for source in sources],
        unit / float(np.mean(fitted.numbers[3:6])) if stated is None else stated,
        stated is None,
        unit,
        readings,
        fitted,
    )


def _readings(source: LogSource | MemorySource, field: str) -> Floats:
    """Return the readings (n, 3) of a field; average an accelerometer's over stationary periods."""
    topic, _, name = field.rpartition(".")
    if not topic:
        raise BadInput(f"--field {field}: expected TOPIC.FIELD, such as /imu.magnetic_field_ut")
    if topic not in source.topics:
        raise BadInput(f"{source.name}: has no topic {topic}; {choices(topic, source.topics)}")
    stream = source.read([topic])[topic]
    known = [each for each, column in stream.columns.items() if column.shape[1:] == (3,)]
    if name not in known:
        raise BadInput(f"{topic}: has no vector {name}; {choices(name, known)}")
    is_there = np.isfinite(stream[name]).all(axis=1)
    readings, times_s = stream[name][is_there], 1e-9 * stream.publish_time_ns[is_there]
    return _still(readings, times_s) if unit_of(name) == "m/s^2" else readings


def _still(readings: Floats, times_s: Floats) -> Floats:
    """Average readings (n, 3) over each half second in which the unit is stationary; return (m, 3)."""
    if len(readings) < FEWEST:
        return readings[:0]
    size = max(2, round(_STILL_S / float(np.median(np.diff(times_s)))))
    windows = readings[: len(readings) // size * size].reshape(-1, size, 3)
    spread = windows.std(axis=1).max(axis=1)
    return windows.mean(axis=1)[spread <= _STILL * np.quantile(spread, 0.1)]
