"""Names of quantities and formats of numbers for readers: `position_rmse_m` becomes "position error"."""

import math
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from fuselog.recorders.units import parted, written

DIGITS = 3
MOST_APART = 30.0  # largest ratio between numbers that are written with the same number of decimals
# Typographic characters.
MISSING, MINUS, TIMES = "\u2013", "\u2212", "\u00d7"


class Quantity(NamedTuple):
    """The name and description of a quantity.

    Attributes:
        name: the usual name.
        meaning: a sentence that explains the quantity.
        group: the group of table rows to which the quantity belongs.
        unit: the unit in which the quantity is stored; empty if it has no unit.
        aim: the ideal value, if it is the same number for all estimators.
    """

    name: str
    meaning: str
    group: str
    unit: str = ""
    aim: str = ""


ACCURACY, CONSISTENCY, COST = "Accuracy", "Consistency", "Cost and failures"
TRACKING, OTHER = "Targets and tracks", "Other quantities"
_RMS = "Root mean square over all steps of all runs."
# By key, in the order of the table.
QUANTITIES: dict[str, Quantity] = {
    "position_rmse_m": Quantity("position error, RMS", f"Distance to the truth. {_RMS}", ACCURACY, "m"),
    "orientation_rmse_deg": Quantity(
        "orientation error, RMS", f"Angle to the truth. {_RMS}", ACCURACY, "deg"
    ),
    "gospa_m": Quantity(
        "GOSPA",
        "Distances to the detected targets, and a penalty for missed and false ones.",
        TRACKING,
        "m",
    ),
    "hota": Quantity("HOTA", "Detection and association accuracy combined; 1 is best.", TRACKING),
    "idf1": Quantity("IDF1", "Share of detections with the correct identity; 1 is best.", TRACKING),
    "referenced_hota": Quantity(
        "HOTA near known targets",
        "HOTA without tracks that never come near a target with a truth.",
        TRACKING,
    ),
    "referenced_idf1": Quantity(
        "IDF1 near known targets",
        "IDF1 without tracks that never come near a target with a truth.",
        TRACKING,
    ),
    "missed_targets": Quantity(
        "missed targets on average", "Number of targets without a track, mean over time.", TRACKING
    ),
    "false_targets": Quantity(
        "false targets on average", "Number of tracks without a target, mean over time.", TRACKING
    ),
    "switches": Quantity("identity switches per run", "A track switches to another target.", TRACKING),
    "breaks": Quantity("track breaks per run", "A target is lost and found again.", TRACKING),
    "total_error_m": Quantity(
        "summed error of all targets", "Distances to the truths, summed.", TRACKING, "m"
    ),
    "heading_rmse_rad": Quantity(
        "heading error, RMS", f"Angle to the true heading. {_RMS}", ACCURACY, "rad"
    ),
    "estimate_age_s": Quantity(
        "age of an estimate", "Time from the stamp of an estimate until it was available.", ACCURACY, "s"
    ),
    "nees": Quantity(
        "NEES", "Squared errors, normalised by the covariance that the estimator claims.", CONSISTENCY
    ),
    "position_nees": Quantity("NEES of the position", "NEES of the position only.", CONSISTENCY),
    "nees_steps_within_95": Quantity(
        "steps with NEES in its interval",
        "Share of steps at which the mean NEES over the runs is in its 95 % interval.",
        CONSISTENCY,
        "share",
        "95 %",
    ),
    "nis_per_component": Quantity(
        "NIS per component",
        "Squared innovations, normalised by the covariance that the filter predicts.",
        CONSISTENCY,
        "",
        "1",
    ),
    "log_likelihood": Quantity(
        "log-likelihood per run",
        "How probable the measurements were according to the filter's predictions; higher is better.",
        CONSISTENCY,
    ),
    "gated_share": Quantity(
        "measurements gated out", "Share of measurements that a gate rejected.", COST, "share"
    ),
    "failed_runs": Quantity("failed runs", "Runs that the estimator did not complete.", COST),
    "estimated_share": Quantity(
        "share of the time estimated", "Share of the duration of a run.", COST, "share"
    ),
    "estimates_without_truth": Quantity(
        "estimates without truth", "Estimates at times without truth in the log.", COST
    ),
    "skipped_measurements": Quantity("measurements skipped", "Measurements that had no effect.", COST),
}
LESS_IS_BETTER = ("*rmse*", "*gospa*", "*ospa*", "*error*", "ape_*", "rpe_*", "localisation_m2")


def quantity(key: str) -> Quantity:
    """Describe a quantity of a result; make a readable name for an unknown one.

    >>> quantity("turn_rmse_radps").name, quantity("turn_rmse_radps").unit
    ('turn error, RMS', 'rad/s')
    """
    if key in QUANTITIES:
        return QUANTITIES[key]
    stem, unit = parted(key)
    if stem.endswith("_rmse") or stem.startswith("rmse_"):
        what = stem.removesuffix("_rmse").removeprefix("rmse_").replace("_", " ")
        return Quantity(f"{what} error, RMS", _RMS, ACCURACY, unit)
    if stem.endswith("_share"):
        return Quantity(stem.replace("_", " "), "", OTHER, "share")
    return Quantity(stem.replace("_", " "), "", OTHER, unit)


def label_of(key: str, meaning: str = "") -> str:
    """Label a quantity or a parameter for an axis, with the unit in which a result stores it.

    >>> label_of("position_rmse_m"), label_of("sigma_range_m", "standard deviation of a range")
    ('position error, RMS (m)', 'standard deviation of a range (m)')
    """
    words = quantity(key)
    sign, name = _sign(words.unit), meaning or words.name
    return f"{name} ({sign})" if sign else name


def is_error(key: str) -> bool:
    """Test whether lower values of a quantity are better, so that estimators can be compared by it."""
    is_less_better = any(fnmatchcase(key, pattern) for pattern in LESS_IS_BETTER)
    return is_less_better and not key.startswith("standard_error")  # which is the precision of a number


def meaning_alone(text: str) -> str:
    """Replace a parameter's name at the beginning of a sentence by its meaning.

    >>> meaning_alone("sigma_range_m (standard deviation of a range) is too small")
    'the standard deviation of a range is too small'
    """
    return re.sub(r"^[\w.]+ \(([^()]+)\)", r"the \1", text)


class Scale(NamedTuple):
    """A unit for the display of numbers, with its sign and the factor that converts them."""

    factor: float = 1.0
    sign: str = ""

    def text(self, value: float | None, digits: int = DIGITS) -> str:
        """Format a number in this unit, without the unit."""
        return number(None if value is None else value * self.factor, digits)

    def with_unit(self, value: float | None, digits: int = DIGITS) -> str:
        """Format a number with the unit."""
        text = self.text(value, digits)
        return text if text == MISSING else self.signed(text)

    def signed(self, text: str) -> str:
        """Append the unit to a number that was formatted in this unit."""
        return f"{text}{self.sign}" if self.sign in ("", "°", "°/s") else f"{text} {self.sign}"


def scale(unit: str, *values: float | None) -> Scale:
    """Choose a common unit in which even the smallest value has a digit before the decimal point.

    >>> scale("m", 0.0162, 0.414).with_unit(0.414), scale("rad", 0.00544).with_unit(0.00544)
    ('41.4 cm', '0.312°')
    """
    known = [abs(value) for value in values if value is not None and math.isfinite(value) and value]
    least = min(known, default=1.0)
    if unit == "m":
        for floor, factor, sign in (
            (2000.0, 1e-3, "km"),
            (0.5, 1.0, "m"),
            (0.002, 100.0, "cm"),
            (0.0, 1e3, "mm"),
        ):
            if least >= floor:
                return Scale(factor, sign)
    if unit == "s" and least < 0.0005:
        return Scale(1e6, "µs")
    if unit == "s" and least < 0.5:
        return Scale(1000.0, "ms")
    if unit in ("rad", "rad/s"):
        return Scale(math.degrees(1.0), unit.replace("rad", "°"))
    return Scale(100.0, "%") if unit == "share" else Scale(1.0, _sign(unit))


def _sign(unit: str) -> str:
    return "°" if unit == "deg" else written(unit)


def number(value: float | None, digits: int = DIGITS) -> str:
    """Format a number with `digits` digits, without an exponent "e", with commas in thousands.

    >>> [number(each) for each in (0.0266714, -7514.7, 3.0, 1e-7, 0.99999, None)]
    ['0.0267', '−7,515', '3', '1 × 10⁻⁷', '1', '–']
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0.0:
        return "0"
    exponent = _exponent(value, digits)
    if not -4 <= exponent < 9:
        mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{_bare(mantissa)} {TIMES} 10{raised}".replace("-", MINUS)
    return _bare(f"{value:,.{max(digits - 1 - exponent, 0)}f}").replace("-", MINUS)


def stated(value: float) -> str:
    """Format a number as a person wrote it in a setting: 0.05, not 0.0500."""
    return f"{value:.4g}".replace("-", MINUS) if 1e-4 <= abs(value) < 1e6 else number(value)


def _exponent(value: float, digits: int) -> int:
    """Return the power of ten of a number after rounding to `digits` digits."""
    return math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))


def _bare(text: str) -> str:
    """Remove trailing zeros after the decimal point of a whole number."""
    return re.sub(r"\.0+$", "", text)


def interval(low: float, high: float, own: Scale, digits: int = DIGITS) -> str:
    """Format the two ends of an interval in the same unit, without writing the unit."""
    return " to ".join(alike([low, high], own, digits))


def alike(values: Sequence[float], own: Scale, digits: int = DIGITS) -> list[str]:
    """Format numbers with the same decimals as the largest, or separately if they differ greatly.

    >>> alike([24.0, 23.81, 24.14], Scale()), alike([0.004, 0.73], Scale())
    (['24.0', '23.8', '24.1'], ['0.00400', '0.730'])
    """
    scaled = [value * own.factor for value in values]
    sizes = [abs(each) for each in scaled if each]
    if not all(map(math.isfinite, scaled)) or not sizes or max(sizes) > MOST_APART * min(sizes):
        return [number(each, digits) for each in scaled]
    exponent = _exponent(max(sizes), digits)
    if not -4 <= exponent < 9:
        return [number(each, digits) for each in scaled]
    decimals = max(digits - 1 - exponent, 0)
    texts = [f"{each:,.{decimals}f}".replace("-", MINUS) if each else "0" for each in scaled]
    bare = [_bare(text) for text in texts]
    return texts if any("." in text for text in bare) else bare


def count(number_of: int, one: str, many: str = "") -> str:
    """Format a number with the singular or plural of a noun.

    >>> count(1, "run"), count(1200, "run")
    ('1 run', '1,200 runs')
    """
    return f"{number_of:,} {one if number_of == 1 else many or one + 's'}"


def listed(words: list[str]) -> str:
    """Join words with commas, and with `and` before the last."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
