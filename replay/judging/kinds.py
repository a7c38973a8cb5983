"""Defines how a family judges outputs of a kind of its own, such as tracks, in addition to estimates.

The class registers as an entry point `fuselog.judges`. Metrics that judge the type of what it returns
make numbers of that.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.errors.truths import Truths


class JudgedRuns(NamedTuple):
    """Holds the runs of an ensemble, or of a part of one, and their truths.

    Attributes:
        sources: the runs.
        truths: of each run.
        gap_limit_s: the truth is not interpolated over longer gaps.
        first_run: the number of the first run in the whole ensemble.
    """

    sources: Sequence[Source]
    truths: Sequence[Truths]
    gap_limit_s: float
    first_run: int


class KindJudge(ABC):
    """Judges outputs of one kind, block by block.

    Attributes:
        runs: whose outputs these are.
        unjudged: by topic, why the truths cannot judge it; empty if they can.
        notes: what to say about these truths.
    """

    def __init__(self, runs: JudgedRuns) -> None:
        self.runs = runs
        self.unjudged: dict[str, str] = {}
        self.notes: list[str] = []

    @abstractmethod
    def add(self, outputs: Mapping[str, Ragged]) -> list[tuple[str, Any]]:
        """Judge a block of a replay's outputs: what metrics judge, with the topic that it is of."""
