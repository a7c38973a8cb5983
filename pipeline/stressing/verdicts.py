"""Verdicts on the effects of changes that should not matter: harmless, sensitive, discontinuous."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.output.alarms import Verdict
from fuselog.pipeline.output.outputs import TIMELINE, check_files
from fuselog.pipeline.stressing.changes import CHANGES, DROPPED
from fuselog.pipeline.stressing.partings import Parting, Undetermined, undetermined
from fuselog.recorders.log import Stream
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.judge import Judge

ORDER: Sequence[Verdict] = ("not tried", "harmless", "sensitive", "discontinuous or chaotic")
HARMLESS = 0.1  # upper limit of A
MARGIN = 0.02  # relative change of a metric that is considered irrelevant, as in compare
# range of the ratio of an effect to that of half the change, if the effect is proportional
HALVES = (1.9, 2.1)
BENT = 1.2  # half the change has less effect, but more than half of it: a quarter is tried
# upper limit of the ratio for an effect that is quadratic in the change; a larger ratio is a jump
SQUARED = 4.2
ONE_SIGMA = 1.0  # for a change without a half: results are different if A is larger than this
PER_PREDICTION = 1e-4  # half the change is tried if moved stamps change a sigma by more than this share
SHRINKS = 1.5  # ratio of a sigma's changes: 1 for noise per prediction, 2 for noise per second


class Tried(NamedTuple):
    """The effect of one change on one run.

    Attributes:
        name: a key of `CHANGES`.
        parting: the distance of the estimate with the largest change; None if no estimate is Gaussian.
        moved: by (case, metric), the change of a metric from the unchanged replay.
        beyond: the change of the main metric, in words; "" if it is within the margin.
        why: the reason why the change was not tried; "" if it was.
        failed: when and why the copy fails although the unchanged replay does not. For a change that was
            not tried, when and why the unchanged replay fails before its first estimate.
    """

    name: str
    parting: Parting | None = None
    moved: Mapping[tuple[str, str], float] = {}
    beyond: str = ""
    why: str = ""
    failed: str = ""

    @property
    def largest(self) -> float:
        """Return the largest A."""
        return float(self.parting.amplification.max(initial=0.0)) if self.parting else 0.0

    @property
    def size(self) -> float:
        """Return the largest A or, without covariances, the largest distance in m or degrees."""
        if self.parting is None or self.parting.has_sigmas:
            return self.largest
        return float(np.nanmax([self.parting.metres, self.parting.degrees], initial=0.0))

    @property
    def far(self) -> str:
        """Describe how far the estimate moves."""
        if self.parting is None:
            return f"the metric changes: {self.beyond}" if self.beyond else "the metric does not change"
        sizes = [(self.parting.metres, "m"), (self.parting.degrees, "deg")]
        words = [f"{self.largest:.3g} sigma"] if self.parting.has_sigmas else []
        words += [f"{_largest(size):.3g} {unit}" for size, unit in sizes if np.any(size >= 0.0)]
        more = f"; {self.beyond}" if self.beyond and self.largest < HARMLESS else ""
        return f"at most {', '.join(words)}{more}"

    @property
    def is_wider(self) -> bool:
        """Test whether moved stamps change a covariance more than noise growing with time explains."""
        return (
            self.name == "stamps" and self.parting is not None and self.parting.spread > PER_PREDICTION
        )


@dataclass(frozen=True, eq=False, repr=False)
class Stressed:
    """The effects of all changes on one run with one estimator.

    Attributes:
        source: the run.
        estimator: the label.
        tried: the effect of each change at full size, by name.
        halves, quarters: the effects of the changes that were halved, and of those that were also
            quartered.
        sensors: the stamps of each sensor's topic.
        estimates: the estimates of the unchanged replay, by topic.
        copies: the estimates of each change at full size.
        is_recursive: whether the estimator alternates predictions and updates.
    """

    source: MemorySource
    estimator: str
    tried: Mapping[str, Tried]
    halves: Mapping[str, Tried]
    quarters: Mapping[str, Tried]
    sensors: Mapping[str, Any]
    estimates: Mapping[str, Stream]
    copies: Mapping[str, Mapping[str, Stream]]
    is_recursive: bool

    @property
    def failed(self) -> str:
        """Return when and why the unchanged replay fails before its first estimate; "" otherwise."""
        said = [each.failed for each in self.tried.values() if each.why]
        return next(filter(None, said), "")

    @property
    def run(self) -> str:
        """Return the run's name."""
        return self.source.name

    def _is_explained(self, name: str) -> bool:
        """Test whether a change that cannot be halved moves the estimate no further than allowed.

        The limit is one sigma or, for lost messages, the largest distance due to chance if that is
        larger.
        """
        parting = self.tried[name].parting
        if name != DROPPED or parting is None:
            return self.tried[name].largest < ONE_SIGMA
        limit = np.maximum(parting.explained + HARMLESS, ONE_SIGMA)
        return bool(np.all(parting.amplification <= limit))

    def ratio(self, name: str) -> float:
        """Divide the effect of a change, in A, by the effect of half of it; NaN if it was not halved.

        If the change was also quartered, this is the ratio of the half's effect to the quarter's.
        """
        half, quarter = self.halves.get(name), self.quarters.get(name)
        more, less = (half, quarter) if half and quarter else (self.tried[name], half)
        return more.size / less.size if less and less.size > 0.0 else np.nan

    def verdict(self, name: str) -> Verdict:
        """Return the verdict on a change."""
        each = self.tried[name]
        if each.why:
            return "not tried"
        if each.failed:
            return "discontinuous or chaotic"
        if each.largest < HARMLESS and not each.beyond:
            return "harmless"
        if CHANGES[name].is_scaled and name in self.halves:
            shrinks = HALVES[0] <= self.ratio(name) <= SQUARED
            return "sensitive" if shrinks else "discontinuous or chaotic"
        return "sensitive" if self._is_explained(name) else "discontinuous or chaotic"

    @property
    def worst(self) -> Verdict:
        """Return the worst of all verdicts."""
        return max((self.verdict(name) for name in self.tried), key=ORDER.index)

    @property
    def deciding(self) -> str:
        """Return the change with the largest effect among those with the worst verdict."""
        own = [name for name in self.tried if self.verdict(name) == self.worst]
        return max(own, key=lambda name: (bool(self.tried[name].failed), self.tried[name].size))

    @property
    def is_per_prediction(self) -> bool:
        """Test whether noise is added per prediction, so that a moved stamp changes a covariance."""
        return self.is_recursive and self._jumps

    @property
    def _jumps(self) -> bool:
        """Test whether moving stamps by 1 us and by 0.5 us changes a sigma about equally."""
        whole, half = self.tried["stamps"], self.halves.get("stamps")
        if not whole.is_wider or whole.parting is None or half is None or half.parting is None:
            return False
        return whole.parting.spread < SHRINKS * half.parting.spread and not self.is_redrawn

    @property
    def is_redrawn(self) -> bool:
        """Test whether one ulp in the inputs changes a covariance; if so, stamps are not the cause."""
        ulp = self.tried["ulp"].parting
        return ulp is not None and ulp.spread > PER_PREDICTION

    @cached_property
    def undetermined(self) -> Undetermined | None:
        """Return the undetermined direction of the estimate that changes most."""
        moved = max(self.tried.values(), key=lambda each: each.largest).parting
        return None if moved is None else undetermined(self.estimates[moved.topic])

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return table rows, one per change."""
        found = []
        for name, each in self.tried.items():
            row: dict[str, Any] = {
                "run": self.run,
                "estimator": self.estimator,
                "change": name,
                "verdict": self.verdict(name),
                "amplification": each.largest if each.parting and each.parting.has_sigmas else np.nan,
                **dict.fromkeys(("metres", "degrees", "growth", "parted_s"), np.nan),
                "halved": self.ratio(name),
                "topic": "",
                "note": each.why or (f"fails {each.failed}" if each.failed else ""),
            }
            if each.parting is not None:
                row["metres"] = _largest(each.parting.metres)
                row["degrees"] = _largest(each.parting.degrees)
                row["growth"] = each.parting.growth
                if (at := each.parting.parted) is not None:
                    stamp_ns = int(each.parting.stamps_ns[at])
                    row["parted_s"] = (stamp_ns - self.source.epoch_ns) * 1e-9
                    row["topic"] = self._message_at(stamp_ns)
            found.append(row)
        return found

    def _message_at(self, stamp_ns: int) -> str:
        """Return the topic of the last message up to a stamp."""
        last = {
            topic: int(stamps_ns[np.searchsorted(stamps_ns, stamp_ns, side="right") - 1])
            for topic, stamps_ns in self.sensors.items()
            if len(stamps_ns) and stamps_ns[0] <= stamp_ns
        }
        return max(last, key=lambda topic: last[topic], default="")

    @property
    def sentence(self) -> str:
        """Return the verdict with the numbers of the change that decides it."""
        if self.worst == "not tried":
            return f"{self.estimator} of {self.run}: not tried: {next(iter(self.tried.values())).why}"
        name = self.deciding
        each = self.tried[name]
        begin = f"{self.worst}: {self.estimator} of {self.run}: {CHANGES[name].words}: "
        if each.failed:
            return f"{begin}the copy fails {each.failed}"
        begin += each.far
        if self.worst == "harmless":
            return f"{begin}; every other change that was tried has less effect"
        if not np.isfinite(self.ratio(name)):
            return begin
        return f"{begin}; {self._shrinking(name)}"

    def _shrinking(self, name: str) -> str:
        """Describe the effect of half of a change, and of a quarter if that was tried."""
        share, ratio = self.halves[name].size / self.tried[name].size, self.ratio(name)
        half = f"half the change has {share:.2g} of this effect"
        if name in self.quarters:
            half += f", and a quarter of the change has {1.0 / ratio:.2g} of the effect of half"
        if self.worst == "sensitive":
            return f"{half}: the effect shrinks faster than the change" if ratio > HALVES[1] else half
        return f"{half}: the effect {'jumps' if ratio > SQUARED else 'does not shrink with the change'}"

    @property
    def sentences(self) -> list[str]:
        """Return the verdict, followed by explanations."""
        sentences = [self.sentence]
        if self.is_per_prediction:
            sentences.append(
                "noise is added per prediction, not per second: a microsecond splits one prediction "
                "into two, which changes the covariance; scale the noise with the duration"
            )
        elif self._jumps:
            sentences.append(
                "a microsecond decides which messages are processed together: those with the same "
                "stamp form one step, and a later message belongs to the next step"
            )
        if self.is_redrawn:
            sentences.append(
                "a change of the inputs by one ulp changes the covariance: other samples are drawn, or "
                "a decision changes; an estimator with samples needs more of them"
            )
        if self.worst not in ("harmless", "not tried") and self.undetermined is not None:
            least = self.undetermined
            since_s = (least.since_ns - self.source.epoch_ns) * 1e-9
            sentences.append(
                f"from {since_s:.1f} s on, {least.words} is not determined: its sigma is "
                f"{least.sigma:.3g}, and {least.next_sigma:.3g} in the next least determined direction"
            )
        return sentences


def _largest(values: Any) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else np.nan


@dataclass(frozen=True, eq=False, repr=False)
class Stress:
    """The effects of changes on runs, for several estimators.

    Attributes:
        stressed: one `Stressed` per run and estimator.
        gap_limit_s: longest gap over which the truth is interpolated.
    """

    stressed: Sequence[Stressed]
    gap_limit_s: float = 0.2

    @property
    def table(self) -> pd.DataFrame:
        """Return a table with a row per run, estimator and change: A, metres, degrees, and so on."""
        return pd.DataFrame([row for each in self.stressed for row in each.rows])

    @property
    def sentences(self) -> list[str]:
        """Return the verdicts in words, the worst first."""
        by_weight = sorted(self.stressed, key=lambda each: -ORDER.index(each.worst))
        return list(dict.fromkeys(sentence for each in by_weight for sentence in each.sentences))

    def draw(self, save: str | Path) -> None:
        """Draw the first run's timeline to the .rrd file `save`, with the estimates of the copies.

        Raises BadInput if the file cannot be written.
        """
        from fuselog.replay.timeline.show import (
            Drawing,
            Fan,  # slow to import
        )

        check_files([(Path(save), TIMELINE)], {})
        source, outputs, fans = self.stressed[0].source, dict[str, Stream](), list[Fan]()
        for each in (each for each in self.stressed if each.source is source):
            outputs |= each.estimates
            for name, copies in each.copies.items():
                for topic, stream in copies.items():
                    renamed = topic.replace(f"/{each.estimator}/", f"/{each.estimator}, {name}/", 1)
                    outputs[renamed] = replace(stream, topic=renamed)
                if (parting := each.tried[name].parting) is not None:
                    fans.append(Fan(each.estimator, name, parting.stamps_ns, parting.amplification))
        judge = Judge([source], {}, gap_limit_s=self.gap_limit_s)
        judged = judge.add({topic: gather([stream]) for topic, stream in outputs.items()})
        identity = "; ".join(each.estimator for each in self.stressed)
        with Drawing(source, identity=identity, save=Path(save), fans=fans) as drawing:
            drawing.add(outputs, judged.errors)

    def __repr__(self) -> str:
        return "\n".join(self.sentences)
