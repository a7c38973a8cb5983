"""Posterior Cramer-Rao bound of the errors over an ensemble of true trajectories, step by step.

Let F be the transition, Q the process noise and H' R^-1 H the information of the measurements at the
true states of a step, and let E denote the mean of a whole product over the trajectories. Then

    J_(k+1) = D22 - D21 (J_k + D11)^-1 D12,  D11 = E F'Q^-1F,  D12 = -E F'Q^-1,  D22 = E Q^-1 + E H'R^-1H

is the bound of filters. With the information L_k = D11 - D12 (D22 + L_(k+1))^-1 D21 from later steps
about step k, J_k + L_k are the blocks of the joint information, which is the bound of smoothers. If Q is
singular, or if runs have different stamps, these means do not exist: the bounds along the trajectories
are then averaged, and the result states this. Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal
Processing 46(5), 1998.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fuselog.recorders.log import schemas
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.judging.errors.evaluation import BOUND as BOUND_OF
from fuselog.replay.judging.metrics.measuring import Metric, Output
from fuselog.replay.judging.metrics.metrics import squares_by_name
from fuselog.replay.judging.metrics.sums import BinnedSums

SINGULAR = "the process noise is singular"
UNALIKE = "the runs have different stamps"
LONG = "there are too many steps"
# Noise counts as singular if its correlation matrix has a smaller eigenvalue.
LEAST_EIGENVALUE = 1e-10
MOST_BYTES = 1 << 28  # largest size of the sums


class Products(NamedTuple):
    """F'Q^-1F, F'Q^-1, Q^-1 and H'R^-1H of steps, or their means: (steps, t, t) each."""

    before: Floats
    across: Floats
    after: Floats
    measured: Floats


@dataclass
class Bounds:
    """Sums over the runs of a stream of steps, from which the bound is computed.

    Attributes:
        components: names and kinds of the tangent space.
        is_smoother: whether the bound is for smoothers.
        sums: sums of the products by step, rows of 4 t^2.
        stamps: (steps,) ns since the epoch.
        steps: number of steps of every run, by run number.
        reason: reason why the mean over the ensemble does not exist; empty if it exists.
    """

    components: list[tuple[str, str]] = field(default_factory=list)
    is_smoother: bool = False
    sums: BinnedSums | None = None
    stamps: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    steps: dict[int, int] = field(default_factory=dict)
    reason: str = ""

    @property
    def size(self) -> int:
        """Return the number of components of the tangent space."""
        return len(self.components)

    def add(self, output: Output) -> "Bounds":
        """Add a block of steps."""
        rows = output.rows
        names, kinds = (rows.stream.metadata[name].split(",") for name in ("components", "kinds"))
        self.components = tangent_components(names, kinds)
        self.is_smoother = rows.stream.metadata[BOUND_OF] == "smoother"
        if self.reason or not len(rows):
            return self
        step = self._steps_of(output)
        products = products_of(rows, self.size)
        if products is None:
            self.reason = SINGULAR
        if products is None or self.reason:
            self.sums = None
            return self
        flat = np.concatenate([each.reshape(len(step), -1) for each in products], axis=1)
        if self.sums is None:
            width = flat.shape[1]
            self.sums = BinnedSums(width, limit=max(MOST_BYTES // (8 * width), 2))
        self.sums.add(step, flat)
        return self

    def _steps_of(self, output: Output) -> Integers:
        """Return the number of each step in its run; set `reason` if the stamps of runs differ."""
        rows, numbers = output.rows, []
        for run in range(rows.runs):
            begin, end = rows.offsets[run], rows.offsets[run + 1]
            stamps = rows.stream.publish_time_ns[begin:end] - output.sources[run].epoch_ns
            first = self.steps.get(output.first_run + run, 0)
            last = self.steps[output.first_run + run] = first + len(stamps)
            known = self.stamps[first:last]
            if not np.array_equal(known, stamps[: len(known)]):
                self.reason = UNALIKE
            self.stamps = np.append(self.stamps, stamps[len(known) :])
            numbers.append(np.arange(first, last))
        return np.concatenate(numbers)

    def merge(self, other: "Bounds") -> "Bounds":
        """Add the sums of other runs."""
        self.reason = self.reason or other.reason
        shared = min(len(self.stamps), len(other.stamps))
        if not np.array_equal(self.stamps[:shared], other.stamps[:shared]):
            self.reason = self.reason or UNALIKE
        if len(other.stamps) > len(self.stamps):
            self.stamps = other.stamps
        self.steps |= other.steps
        self.components = self.components or other.components
        self.is_smoother = self.is_smoother or other.is_smoother
        if self.reason or self.sums is None or other.sums is None:
            self.sums = None if self.reason else self.sums or other.sums
        else:
            self.sums.merge(other.sums)
        return self

    @property
    def complaint(self) -> str:
        """Return the reason why there is no mean over the ensemble; empty if there is a mean."""
        if self.reason or self.sums is None:
            return self.reason
        if self.sums.width > 1:
            return LONG
        return UNALIKE if len(set(self.steps.values())) > 1 else ""

    def covariances(self) -> Floats | None:
        """Compute the bounds (steps, t, t) after the prior; None if the ensemble has no common bound."""
        if self.complaint or self.sums is None:
            return None
        _, count, sums = self.sums.filled()
        mean = (sums / count[:, None]).reshape(len(sums), 4, self.size, self.size)
        products = Products(*np.moveaxis(mean, 1, 0))
        information = filter_information(products)
        if self.is_smoother:
            information += later_information(products)
        found = np.asarray(np.linalg.inv(information), float)
        return found if products.measured[0].any() else found[1:]


def products_of(rows: Ragged, size: int) -> Products | None:
    """Compute the products of every step; None if noise is singular or a measurement is exact."""
    transition, noise, information = (
        rows[name].reshape(-1, size, size) for name in ("transition", "noise", "information")
    )
    sigma = np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    if not (np.isfinite(information).all() and (sigma > 0).all()):
        return None
    scale = sigma[:, :, None] * sigma[:, None, :]
    if np.linalg.eigvalsh(noise / scale).min() < LEAST_EIGENVALUE:
        return None
    after = np.linalg.inv(noise / scale) / scale
    across = np.swapaxes(transition, 1, 2) @ after
    return Products(across @ transition, across, after, information)


def filter_information(mean: Products) -> Floats:
    """Compute J (steps, t, t) by recursion from the first step, starting without information."""
    found = mean.after + mean.measured
    for step in range(1, len(found)):
        left = mean.across[step].T @ np.linalg.solve(
            found[step - 1] + mean.before[step], mean.across[step]
        )
        found[step] -= left
    return found


def later_information(mean: Products) -> Floats:
    """Compute L (steps, t, t), the information from all later steps about each step."""
    found = np.zeros_like(mean.after)
    for step in range(len(found) - 2, -1, -1):
        after = mean.after[step + 1] + mean.measured[step + 1] + found[step + 1]
        across = mean.across[step + 1]
        found[step] = mean.before[step + 1] - across @ np.linalg.solve(after, across.T)
    return found


def _add(state: Bounds, output: Output) -> Bounds:
    is_step = output.rows.stream.schema.full_name == schemas.BOUND_STEP.full_name
    return state.add(output) if is_step else state


def root_mean_squares(state: Bounds) -> dict[str, float]:
    """Compute the lower bounds of RMSE over all steps, by the name of the RMSE.

    They are returned only if the bound over the ensemble exists, as indicated by `over_ensemble`, which
    is 1 or 0. Otherwise, `metrics.ACCURACY` averages the bounds along the trajectories, as it does with
    errors.
    """
    if not state.components:
        return {}
    covariances = state.covariances()
    if covariances is None or not len(covariances):
        return {"over_ensemble": 0.0}
    squared = np.diagonal(covariances, axis1=1, axis2=2)
    sums = squares_by_name(squared, *zip(*state.components, strict=True))
    found = {name: float(np.sqrt(total / len(squared))) for name, total in sums.items()}
    return {**found, "over_ensemble": 1.0}


BOUND = Metric(
    "posterior Cramer-Rao bound over an ensemble, for comparison with the RMSE",
    Output,
    Bounds,
    _add,
    Bounds.merge,
    root_mean_squares,
)
