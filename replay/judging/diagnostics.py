"""Collects what a replay says of itself: failures, what was skipped and assumed, what was covered."""

from collections import Counter
from dataclasses import dataclass, field

from replay.judging.metrics.measuring import Sums, plus


@dataclass
class StreamDiagnostics:
    """Collects what a stream says of the replay itself, for sentences."""

    failed: dict[int, str] = field(default_factory=dict)
    speaking: set[int] | None = None
    skipped: Counter[str] = field(default_factory=Counter)
    started: Counter[str] = field(default_factory=Counter)
    covered: Sums = field(default_factory=dict)

    def merge(self, other: "StreamDiagnostics") -> None:
        """Take in what was said of other runs."""
        self.failed |= other.failed
        self.skipped.update(other.skipped)
        self.started.update(other.started)
        if other.speaking is not None:
            self.speaking = other.speaking | (self.speaking or set())
        self.covered = plus(self.covered, other.covered)
