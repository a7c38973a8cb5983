"""Interface for families that judge outputs other than estimates, such as tracks.

A judge is registered as an entry point `fuselog.judges`. Metrics that are registered for the type of the
judge's results compute numbers from these results.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.errors.truths import Truths


class JudgedRuns(NamedTuple):
    """Runs of an ensemble, or of a part of one, and their truths.

    Attributes:
        sources: the runs.
        truths: truths of each run.
        gap_limit_s: longest gap in s over which the truth is interpolated.
        first_run: number of the first run in the whole ensemble.
    """

    sources: Sequence[Source]
    truths: Sequence[Truths]
    gap_limit_s: float
    first_run: int


class KindJudge(ABC):
    """Judge of outputs of one kind, block by block.

    Attributes:
        runs: the judged runs.
        unjudged: by topic, the reason why the output cannot be judged; empty if it can be judged.
        notes: sentences about the truths.
    """

    def __init__(self, runs: JudgedRuns) -> None:
        self.runs = runs
        self.unjudged: dict[str, str] = {}
        self.notes: list[str] = []

    @abstractmethod
    def add(self, outputs: Mapping[str, Ragged]) -> list[tuple[str, Any]]:
        """Judge a block of a replay's outputs, and return the inputs of metrics, each with its topic."""
