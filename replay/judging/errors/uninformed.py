"""Detection of components that no measurement affects, which keep their initial mean and variance."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.vectors.components import stated_components
from fuselog.replay.engine.vectors.tangent import tangent_components

FEWEST = 10  # number of estimates of a run; with fewer, possibly no measurement has been processed yet
MOVED = 1e-9  # tolerances: in standard deviations, and as a fraction of the variance


@dataclass
class Uninformed:
    """Components of a stream of estimates whose mean never changed and whose variance never decreased.

    Attributes:
        names: components that are linear or angles.
        still: (names,), whether each component is unchanged in all runs.
        first: by run, the mean and variance (names,) of the run's first estimate.
        most: largest number of estimates of any run.
    """

    names: list[str] = field(default_factory=list)
    still: NDArray[np.bool_] = field(default_factory=lambda: np.ones(0, bool))
    first: dict[int, tuple[Floats, Floats]] = field(default_factory=dict)
    most: int = 0

    def add(self, estimates: Ragged, first_run: int) -> None:
        """Add a block of estimates of runs whose numbers begin at `first_run`."""
        stream = estimates.stream
        components = stated_components(stream.metadata, {}, f"topic {stream.topic}")
        tangent = [name for name, _ in tangent_components(list(components), list(components.values()))]
        if not self.names:
            self.names = [name for name in components if name in tangent]
            self.still = np.ones(len(self.names), bool)
        columns = [list(components).index(name) for name in self.names]
        rows = [tangent.index(name) for name in self.names]
        size = len(tangent)
        for run in np.flatnonzero(np.diff(estimates.offsets)).tolist():
            if not self.still.any():
                return
            own = estimates.of_run(run)
            mean = own["mean"].reshape(len(own), len(components))[:, columns]
            variance = own["covariance"].reshape(len(own), size, size)[:, rows, rows]
            mean_0, variance_0 = self.first.setdefault(first_run + run, (mean[0], variance[0]))
            moved = np.abs(mean - mean_0) > MOVED * np.sqrt(variance_0)
            surer = variance < (1.0 - MOVED) * variance_0
            self.still &= ~(moved | surer).any(axis=0) & (variance_0 > 0.0)
            self.most = max(self.most, len(own))

    def merge(self, other: "Uninformed") -> None:
        """Add the results of other runs."""
        self.still = self.still & other.still if self.names and other.names else other.still
        self.names, self.most = self.names or other.names, max(self.most, other.most)

    def found(self) -> list[str]:
        """Return the unchanged components, provided that other components are estimated."""
        if self.most < FEWEST or self.still.all():
            return []
        return [name for name, is_still in zip(self.names, self.still.tolist(), strict=True) if is_still]
