"""Moments of the worst estimates: the largest NEES and the largest error."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from fuselog.replay.judging.errors.evaluation import Errors, Floats

NEES = "nees"


class Moment(NamedTuple):
    """Moment at which a quantity of an estimator is largest.

    Attributes:
        estimator: the estimator's label, such as `ekf`.
        case: name of the estimated object, such as `robot1`; may be empty.
        quantity: `nees`, or the main error: the error of the position, or else of the orientation, or
            else of all components that have the first component's unit, such as `error_m` of several
            targets.
        value: the quantity at this moment.
        run: the number of the run.
        time_ns: stamp in ns.
        elapsed_s: time since the run's epoch in s.
    """

    estimator: str
    case: str
    quantity: str
    value: float
    run: int
    time_ns: int
    elapsed_s: float

    @property
    def words(self) -> str:
        """Return the quantity and its value in words."""
        name = "NEES" if self.quantity == NEES else self.quantity
        return f"{name} {self.value:.3g}"

    def sentence(self, run: str = "") -> str:
        """Return a sentence on when the estimator is worst, with the name of the run if it is given."""
        where = "".join(f" of {each}" for each in (self.case, run) if each)
        return f"{self.estimator}: worst at {self.elapsed_s:.3f} s{where}: {self.words}"


class Moments:
    """Worst moments of each estimator and case, for any number of runs."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str, str], Moment] = {}

    def add(self, errors: Errors) -> None:
        """Add a block of errors."""
        if not errors.is_bound:
            name, columns, scale = _main(errors)
            length = scale * np.sqrt(errors.squared[:, columns].sum(axis=1))
            self._add(errors, NEES, errors.nees)
            self._add(errors, name, length)

    def _add(self, errors: Errors, quantity: str, values: Floats) -> None:
        known = np.isfinite(values)  # an infinite NEES is ignored
        if not known.any():
            return
        row = int(np.argmax(np.where(known, values, -np.inf)))
        value, run, time_ns = float(values[row]), int(errors.run[row]), int(errors.time_ns[row])
        elapsed_s = float(errors.elapsed_s[row])
        self._keep(Moment(errors.estimator, errors.case, quantity, value, run, time_ns, elapsed_s))

    def _keep(self, moment: Moment) -> None:
        key = moment.estimator, moment.case, moment.quantity
        kept = self._found.get(key)
        if kept is None or _size(moment) > _size(kept):
            self._found[key] = moment

    def merge(self, other: "Moments") -> None:
        """Add the moments of other runs."""
        for moment in other.found:
            self._keep(moment)

    @property
    def found(self) -> list[Moment]:
        """Return the largest NEES and the largest error of each estimator and case."""
        return list(self._found.values())


def worst_of(moments: Iterable[Moment]) -> Moment | None:
    """Return the moment of the largest NEES or, if there is no NEES, of the largest error."""
    return max(moments, key=lambda each: (each.quantity == NEES, _size(each)), default=None)


def _main(errors: Errors) -> tuple[str, list[int], float]:
    """Return the name of the main error of estimates, its columns, and the factor to its unit."""
    name, columns, scale = errors.main
    if errors.position or errors.rotation:
        return name.replace("rmse", "error"), columns, scale
    unit = errors.components[0].rpartition("_")[2]
    alike = [index for index, each in enumerate(errors.components) if each.endswith(f"_{unit}")]
    if len(alike) > 1:
        return f"error_{unit}", alike, scale
    return f"error_{errors.components[0]}", columns, scale


def _size(moment: Moment) -> tuple[float, int, int]:
    """Return the sort key for moments of one quantity; of equal values, the earliest sorts last."""
    return moment.value, -moment.run, -moment.time_ns
