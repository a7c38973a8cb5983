"""Search for the most likely causes of a filter's inconsistency: the faults with the largest gains.

Faults that a log does not distinguish are treated as different names of one cause.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.diagnosing.advice import number
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import (
    NOISES,
    GainsOf,
    Hypothesis,
    Number,
    gains_over,
    inflation_over,
    is_spike,
    noise_gain_over,
)
from fuselog.pipeline.diagnosing.hypotheses.listing import hypotheses
from fuselog.pipeline.diagnosing.joint import Fit, Supposed, corrected, fit, promised
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.diagnosing.search import NUMBER_COST, Peak, peak, rival
from fuselog.pipeline.optimise import DROP_95, QUANTILE, curvature, end, side_by_side
from fuselog.pipeline.runs.trials import Trial
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.intervals import Interval

FALSE_ALARMS = 0.01  # share of logs without a fault in which a cause may be found by chance
# a rival is also named if its gain is less than this below the best: odds of 20 to 1
RIVAL = 3.0
# a nearly equal name replaces another only if its gain is larger by this; avoids endless swaps
CLEARLY = 0.5
# largest relative differences of delay and gain between the "early" and "late" names of one fault
SAME_SIZE, SAME_GAIN = 0.1, 0.8
# logarithm of a factor: a noise that is stated more than 20 times too small indicates another fault
GROSS = float(np.log(20.0))
SPREADS = 4.0  # a cause must exceed this many standard deviations of its gain by control noise
# share of the largest gain above which a fault stays a contender while others are corrected
CONTENDS = 0.5
# share of the least gain above which a fault is tried together with a new fit of the others
HIDDEN = 0.3
LEADING = 10  # number of the most likely faults that are tried together with all faults of smaller gain

Named = tuple[Peak, Hypothesis]
Names = list[Named]  # the names of one cause that the log does not distinguish


class Cause(NamedTuple):
    """A hypothesis, with the value at which its gain is largest.

    Attributes:
        hypothesis: the assumed fault.
        value: its size.
        ends: the ends of the 95 % interval of the size.
        gain: the gain in log-likelihood after all preceding causes are corrected.
        others: causes that explain the log equally well, or nearly so.
        of_halves: the gain over each half of the measurements, with all other causes corrected.
    """

    hypothesis: Hypothesis
    value: Number
    ends: tuple[Number, Number]
    gain: float
    others: tuple["Cause", ...] = ()
    of_halves: tuple[float, float] = (np.inf, np.inf)

    @property
    def has_ends(self) -> bool:
        """Test whether the value's interval has two finite ends, as far as the fit determines them."""
        return not np.isinf(self.ends).any()

    @property
    def statement(self) -> str:
        """Describe the fault and its size, without an interval if the fit did not converge."""
        words = self.hypothesis.words(self.value, *self.ends)
        if not np.isnan(self.ends).any():
            return words
        without = re.sub(r" \(nan[^)]*\)", "", words)
        return f"{without} (no interval: the joint fit of all causes did not converge)"

    @property
    def numbers(self) -> list[Interval]:
        """Return the values by component as they are reported, with factors instead of logarithms."""
        of, (low, high) = self.hypothesis, self.ends
        if not isinstance(self.value, tuple):
            return [Interval(self.value, low, high, name=of.part).rising(of.reported)]
        names = [of.topic, *of.part.split(", ")][-of.size :]
        numbers = zip(self.value, low, high, names, strict=True)
        return [Interval(value, low, high, name=name) for value, low, high, name in numbers]

    @property
    def words(self) -> str:
        """Describe the fault, its size, the alternatives and the gain."""
        or_else = "".join(
            f"; this log does not determine the value; equally likely: {each.statement}"
            if each.hypothesis is self.hypothesis
            else f"; or, indistinguishable in this log, {each.statement}"
            for each in self.others
        )
        first, second = self.of_halves
        half, worst = ("first", first) if first < second else ("second", second)
        but = f"; but decreases it by {number(-worst, 4)} over the {half} half, so it is not valid"
        gained = f"; correcting this increases the log-likelihood by {number(self.gain, 4)}"
        return f"{self.statement}{or_else}{gained}{but if worst < -DROP_95 else ''}"


class Tried(NamedTuple):
    """A hypothesis that was tried on the unaltered log, and its largest gain."""

    hypothesis: Hypothesis
    at: Peak

    @property
    def row(self) -> tuple[str, str, str, str, float]:
        """Return kind, topic and part of the fault, its values with the largest gain, and the gain."""
        of, at = self.hypothesis, self.at.value
        values = at if isinstance(at, tuple) else (of.reported(at),)
        return of.kind, of.topic, of.part, ", ".join(number(each) for each in values), self.at.gain


def tried_table(tried: Sequence[Tried]) -> pd.DataFrame:
    """Tabulate hypotheses in descending order of gain minus the cost of their values."""
    ranked = sorted(tried, key=lambda each: -each.at.score(each.hypothesis))
    names = ("kind", "topic", "part", "value", "gain")
    return pd.DataFrame([each.row for each in ranked], columns=names)


def least_gain(count: int, size: int = 1) -> float:
    """Compute the gain that the best of `count` hypotheses exceeds by chance at the rate FALSE_ALARMS.

    Twice the gain is chi-square distributed with `size` degrees of freedom, one for each estimated value
    (Wilks); the probability is divided by `count` (Bonferroni).
    """
    return float(chi2.isf(FALSE_ALARMS / max(count, 1), size)) / 2.0


class Found(NamedTuple):
    """A cause, as represented during the search.

    Attributes:
        names: faults that the log does not distinguish, with their values; the first one is corrected.
        over: the trial to which gains are relative, as long as this is the only cause.
        contenders: faults that gained nearly as much before other causes were corrected.
    """

    names: Names
    over: Trial
    contenders: Sequence[Hypothesis] = ()

    @property
    def supposed(self) -> Supposed:
        """Return the fault that is corrected, which is the first of the names, with its value."""
        at, of = self.names[0]
        return Supposed(of, at.value)


class Look(NamedTuple):
    """The gains of faults that are tried in addition to the causes already found.

    Attributes:
        found: the causes.
        now: the log in which the causes already found are corrected.
        ranked: every fault that may be added, with its largest gain.
    """

    found: Sequence[Found]
    now: Trial
    ranked: Names

    @property
    def physical(self) -> Names:
        """Return the faults of measured quantities."""
        return [pair for pair in self.ranked if _is_physical(pair[1])]


def find_causes(
    likelihood: Likelihood, base: Trial, tried: Sequence[Hypothesis], most: int
) -> tuple[list[Cause], list[Tried], list[Cause]]:
    """Find at most `most` causes, the gain of each hypothesis, and a cause in doubt.

    Each cause is the fault with the largest gain in log-likelihood minus the cost of its values, after
    all causes before it are corrected. Several causes are fitted together. The gains of hypotheses are
    computed in the unaltered log. A cause that would be the next one, or that gains more than the last
    one, is in doubt if the parts of the log disagree about its value.
    """
    search = _Search(likelihood, base, most, len(tried))
    peaks = search.peaks(base, tried)
    found, doubtful = search.more(tried, peaks, [])
    now = search.without(found)
    in_doubt = _causes(gains_over(likelihood, now), doubtful[:1])
    listed = [Tried(each, at) for each, at in zip(tried, peaks, strict=True)]
    return search.causes(found), listed, _over_halves(likelihood, now, in_doubt) if in_doubt else []


@dataclass(frozen=True)
class _Search:
    """A search that finds causes one by one and fits them together.

    Attributes:
        likelihood: function that computes the log-likelihoods of trials.
        base: the unaltered log, and the settings.
        most: the largest number of causes.
        count: the number of hypotheses.
    """

    likelihood: Likelihood
    base: Trial
    most: int
    count: int

    def peaks(self, now: Trial, candidates: Sequence[Hypothesis], least: float = 0.0) -> list[Peak]:
        """Find the largest gain of each candidate, only roughly if all gains are below `least`."""
        return _peaks(gains_over(self.likelihood, now), candidates, self.count, least)

    def without(self, found: Sequence[Found]) -> Trial:
        """Correct the causes in the log."""
        return corrected(self.base, [each.supposed for each in found])

    def more(
        self,
        tried: Sequence[Hypothesis],
        peaks: Sequence[Peak],
        found: Sequence[Found],
        *,
        target: float = -np.inf,
    ) -> tuple[list[Found], list[Named]]:
        """Add significant causes to those found, and return the cause in doubt after them.

        `peaks` contains the gains of the hypotheses in addition to the causes found. With a `target`,
        the search ends if the allowed number of causes cannot reach that log-likelihood. Without a
        target, the search also considers causes whose gain is significant only after a new fit of the
        others.
        """
        found, doubtful, tried = list(found), list[Named](), list(tried)
        for _ in range(2 * self.most):  # because a cause may be removed again
            look = self._look(tried, peaks, found, target)
            if look is None:
                break
            peaks = []
            alike, doubtful = _likeliest(self.likelihood, look.now, look.ranked, self.count)
            if not alike and np.isfinite(target):  # the parts may agree once other causes are corrected
                alike = doubtful[:1]
            noises = [each for each in (*alike[:1], *doubtful) if _takes_all(*each)]
            if self._is_gross(look, noises):
                look, alike, noises = self._beside_gross(look, alike, noises)
            other = self._without_noise(look, noises)
            if not other and alike:
                other, first = self._with(look, alike), alike[0][1]
                if all(of is not first for each in other for _, of in each.names):
                    tried = [each for each in tried if each is not first]
            if not other and np.isinf(target):
                other = self._with_less_noise(look.found, tried) or self._hidden(look)
            if not other:
                break
            found = other
        return found, doubtful

    def _look(
        self,
        tried: Sequence[Hypothesis],
        peaks: Sequence[Peak],
        found: Sequence[Found],
        target: float,
    ) -> Look | None:
        """Compute gains of hypotheses in addition to the causes found; None if no cause can follow."""
        named = {id(of) for each in found for _, of in each.names}
        candidates = [each for each in tried if id(each) not in named]
        if not candidates or len(found) >= self.most:
            return None
        now = self.without(found)
        lacking = target - self.likelihood([now])[0]
        peaks = peaks or self.peaks(now, candidates, lacking / self.most)
        look = Look(found, now, list(zip(peaks, candidates, strict=True)))
        return look if self._reaches(look, lacking) else None

    def _reaches(self, look: Look, gain: float) -> bool:
        """Estimate from single gains whether the allowed number of causes could gain at least `gain`.

        The causes found are included, because they gain more if they are fitted again with others.
        """
        best = max((at.score(of) for at, of in look.physical), default=0.0)
        return best * self.most >= gain

    def _is_gross(self, look: Look, noises: Sequence[Named]) -> bool:
        """Test whether two gross faults may look like noise or outliers, so that pairs must be tried."""
        if any(of.kind in NOISES and at.value > GROSS for at, of in noises):
            return True
        outliers = max((at.gain for at, of in noises if of.kind == "outliers"), default=np.inf)
        return self._reaches(look, outliers)

    def _beside_gross(self, look: Look, alike: Names, noises: Names) -> tuple[Look, Names, Names]:
        """Correct one of two gross faults that together gain more than a noise, and find the other."""
        gross = _companion(self.likelihood, look.now, look.ranked)
        if gross is None:
            return look, alike, noises
        now, others = gross.without(look.now), [of for _, of in look.ranked if of is not gross.of]
        beside = Look(look.found, now, list(zip(self.peaks(now, others), others, strict=True)))
        return beside, _likeliest(self.likelihood, now, beside.ranked, self.count)[0] or alike, []

    def _with_less_noise(self, found: Sequence[Found], tried: Sequence[Hypothesis]) -> list[Found]:
        """Remove a noise if the other causes, or faults of the same kinds, explain as much without it.

        For example, speeds that are too small may explain positions that seem to be scaled and
        imprecise.
        """
        for noise in found:
            rest = [self._widened(each, tried) for each in found if each is not noise]
            if noise.supposed.of.kind in NOISES and rest:
                instead = self._together(rest) if len(rest) > 1 else [self._alone(rest[0])]
                if self._score(instead) > self._score(found):
                    return instead
        return []

    @staticmethod
    def _widened(found: Found, tried: Sequence[Hypothesis]) -> Found:
        """Add all faults of the same kind to the contenders of each cause."""
        kind = found.supposed.of.kind
        alike = [of for of in tried if of.kind == kind and _is_physical(of)]
        return found._replace(contenders=[*found.contenders, *alike])

    def _score(self, found: Sequence[Found]) -> float:
        """Compute the log-likelihood of the corrected log minus the cost of all estimated values."""
        [explained] = self.likelihood([self.without(found)])
        return explained - NUMBER_COST * sum(len(each.supposed.numbers) for each in found)

    def _with(self, look: Look, alike: Names) -> list[Found]:
        """Add the most likely cause and fit it together with the others."""
        (at, of), *_ = alike
        contenders = [
            other
            for gained, other in look.physical
            if gained.gain > CONTENDS * at.gain and other is not of
        ]
        rivals = _with_rival(gains_over(self.likelihood, look.now), alike[0], least_gain(self.count))
        return self._together([*look.found, Found([*rivals, *alike[1:]], look.now, contenders)])

    def _without_noise(self, look: Look, noises: Sequence[Named]) -> list[Found]:
        """Find causes that explain as much as a noise or outliers; [] if there are no such causes.

        Errors of a model look like a noise that is larger than stated, and large errors look like
        outliers.
        """
        if not noises:
            return []
        noise = max(at.score(of) for at, of in noises)
        [before] = self.likelihood([self.without(look.found)])
        peaks, faults = [at for at, _ in look.physical], [of for _, of in look.physical]
        instead, _ = self.more(faults, peaks, look.found, target=before + noise)
        if self._score(instead) < self._score(look.found) + noise:
            return []
        # with the others corrected, a noise or a fault of the same kind may explain more than a cause
        # does
        own = [of for _, of in noises]
        wide = [self._widened(each, faults) for each in instead]
        return self._together([each._replace(contenders=[*each.contenders, *own]) for each in wide])

    def _hidden(self, look: Look) -> list[Found]:
        """Add a cause whose gain is significant only after a new fit together with the causes found."""
        if not look.found:
            return []
        known = [each.names[0] for each in look.found]
        some = [
            (promised(self.likelihood, self.base, [*known, (at, of)]), at, of)
            for at, of in look.physical
            if of.tried and at.gain > HIDDEN * least_gain(self.count, of.size)
        ]
        for most, at, of in sorted(some, key=lambda each: -each[0])[:1]:
            if most < least_gain(self.count, of.size):
                continue
            faults = [*(each.supposed for each in look.found), Supposed(of, at.value)]
            fitted = fit(self.likelihood, self.base, faults)
            *others, own = fitted.faults
            [before] = self.likelihood([self.without(look.found)])
            gains = Peak(own.value, fitted.log_likelihood - before)
            now = corrected(self.base, others)
            alike, _ = _likeliest(self.likelihood, now, [(gains, of)], self.count)
            if alike:
                return self._together([*look.found, Found(alike, now)])
        return []

    def _together(self, found: Sequence[Found]) -> list[Found]:
        """Fit causes together, remove superfluous ones, and adopt contenders that explain more."""
        if len(found) < 2:
            return list(found)
        fitted = fit(self.likelihood, self.base, [each.supposed for each in found])
        found = [
            each._replace(names=[(each.names[0][0]._replace(value=own.value), own.of), *each.names[1:]])
            for each, own in zip(found, fitted.faults, strict=True)
        ]
        if (rest := self._needed(found, fitted)) != found:
            return self._together(rest) if len(rest) > 1 else [self._alone(rest[0])]
        for place, each in enumerate(found):
            found[place] = self._likelier(found, place, fitted.log_likelihood)
            if found[place].supposed.of is not each.supposed.of:  # it is added after the likelier causes
                return self._together([*found[:place], *found[place + 1 :], found[place]])
        return found

    def _needed(self, found: list[Found], fitted: Fit) -> list[Found]:
        """Remove a cause that the others make superfluous, or whose value is not an estimate."""
        if False in fitted.are_estimates:
            place = fitted.are_estimates.index(False)
            return [*found[:place], *found[place + 1 :]]
        place = int(np.argmin(fitted.losses))
        rest = [*found[:place], *found[place + 1 :]]
        enough = least_gain(self.count, fitted.faults[place].of.size)
        if fitted.losses[place] >= 2.0 * enough:  # estimated from a parabola
            return found
        of_rest = fit(self.likelihood, self.base, [each.supposed for each in rest])
        return rest if fitted.log_likelihood - of_rest.log_likelihood < enough else found

    def _likelier(self, found: Sequence[Found], place: int, log_likelihood: float) -> Found:
        """Replace a cause by a contender that explains more when all causes are fitted again.

        `log_likelihood` is the log-likelihood of the log with all causes corrected.
        """
        each, before, after = found[place], found[:place], found[place + 1 :]
        others = [*before, *after]
        taken = {id(of) for other in others for _, of in other.names}
        (at, main), *known = each.names
        free = [(Peak(0.0, 0.0), of) for of in each.contenders if id(of) not in taken]
        own = [of for of in _faults([*known, *free]) if of is not main]
        if not own:
            return each
        now = self.without(others)
        [without] = self.likelihood([now])
        near = [(at._replace(gain=log_likelihood - without), main)]
        least = near[0][0].score(main) - RIVAL
        for most, of in zip(self.peaks(now, own), own, strict=True):
            beside = [*(other.names[0] for other in others), (most, of)]
            reached = promised(self.likelihood, self.base, beside) if most.gain > 0.0 else -np.inf
            if most._replace(gain=reached).score(of) < least:
                continue
            faults = [other.supposed for other in others]
            faults.insert(place, Supposed(of, most.value))
            fitted = fit(self.likelihood, self.base, faults)
            if fitted.are_estimates[place]:
                value, gain = fitted.faults[place].value, fitted.log_likelihood - without
                near.append((most._replace(value=value, gain=gain), of))
        alike = _alike(sorted(near, key=lambda pair: -pair[0].score(pair[1])))
        (best, first), least = alike[0], near[0][0].score(main) + CLEARLY
        if all(of is not main for _, of in alike) or best.score(first) > least:
            return Found(alike, self.base, [main, *own])
        rivals = [pair for pair in known if pair[1] is main]
        different = [pair for pair in alike if pair[1] is not main]
        return each._replace(names=[near[0], *rivals, *different])

    def _nearest(self, now: Trial, faults: Sequence[Hypothesis]) -> Names:
        ranked = zip(self.peaks(now, faults), faults, strict=True)
        return _alike(sorted(ranked, key=lambda pair: -pair[0].score(pair[1])))

    def _alone(self, found: Found) -> Found:
        """Fit a cause without the other causes."""
        known = [(Peak(0.0, 0.0), of) for of in found.contenders]
        faults = _faults([*found.names, *known])
        return Found(self._nearest(self.base, faults), self.base, faults)

    def causes(self, found: Sequence[Found]) -> list[Cause]:
        """Compute gains and intervals of the causes, and omit causes without a bounded interval."""
        causes = self._estimated(found)
        ended = [each for each, cause in zip(found, causes, strict=True) if cause.has_ends]
        if len(ended) < len(found):
            return self.causes(self._together(ended) if len(ended) > 1 else [*map(self._alone, ended)])
        return [
            each._replace(others=tuple(other for other in each.others if other.has_ends))
            for each in causes
        ]

    def _estimated(self, found: Sequence[Found]) -> list[Cause]:
        """Compute gains and intervals of the causes, from joint fits if there are several."""
        if len(found) < 2:
            alone = [_causes(gains_over(self.likelihood, each.over), each.names) for each in found]
            return [first._replace(others=tuple(others)) for first, *others in alone]
        main = fit(self.likelihood, self.base, [each.supposed for each in found], has_ends=True)
        causes = []
        for place, each in enumerate(found):
            before, after = main.faults[:place], main.faults[place + 1 :]
            [without] = self.likelihood([corrected(self.base, [*before, *after])])
            gain, others = main.log_likelihood - without, []
            for at, of in each.names[1:]:
                faults = [*before, Supposed(of, at.value), *after]
                other = fit(self.likelihood, self.base, faults, has_ends=True)
                less = main.log_likelihood - other.log_likelihood
                others.append(Cause(of, other.faults[place].value, other.ends[place], gain - less))
            own = main.faults[place]
            causes.append(Cause(own.of, own.value, main.ends[place], gain, tuple(others)))
        return causes


def _faults(names: Names) -> list[Hypothesis]:
    """List the faults among names, without repetitions."""
    return list({id(of): of for _, of in names}.values())


def _alike(ranked: Sequence[Named]) -> Names:
    """Select the likeliest fault and those that the log does not distinguish from it; sort by name.

    A delay setting that is too large comes first, and unusual names (see `_is_early`) come last.
    """
    least = ranked[0][0].score(ranked[0][1]) - RIVAL
    near = [
        pair for pair in ranked if pair[0].score(pair[1]) >= least or _is_other_name(pair, ranked[0])
    ]
    return sorted(near, key=lambda pair: (not _takes_back(pair), _is_early(pair)))


def _is_physical(of: Hypothesis) -> bool:
    """Test whether a fault concerns a measured quantity, not noise or outliers."""
    return of.kind not in NOISES and of.kind != "outliers"


def _likeliest(
    likelihood: Likelihood, now: Trial, pairs: Names, count: int
) -> tuple[Names, list[Named]]:
    """Find the hypothesis with the largest significant gain, its alternatives, and doubtful ones.

    Disagreement between parts is a property of the whole log. If the parts disagree about a larger
    gain, the smaller gains are therefore reduced as well. Burnham and Anderson, Model Selection and
    Multimodel Inference, 2nd ed. 2002, section 2.5, also divide all gains by one factor.
    """
    gains_of, inflation_of = gains_over(likelihood, now), inflation_over(likelihood, now)
    noise_gain_of = noise_gain_over(likelihood, now)
    doubtful, inflation = list[Named](), 1.0

    def is_sure(pair: Named) -> bool:
        nonlocal inflation
        at, of = pair
        if _is_at_end(gains_of, at, of) or (
            not at.is_special and is_spike(likelihood, now, of, at.value, at.gain)
        ):
            return False
        by_noise, spread = noise_gain_of(of, at.value)
        if at.gain < least_gain(count, of.size) + by_noise + SPREADS * spread:
            return False
        inflation = max(inflation, inflation_of(of, at.value, at.gain))
        if at.gain > least_gain(count, of.size) * inflation:
            return True
        doubtful.append(pair)
        return False

    ranked = sorted(
        ((at, of) for at, of in pairs if _is_named(at, of, count)),
        key=lambda pair: -pair[0].score(pair[1]),
    )
    place = next((place for place, pair in enumerate(ranked) if is_sure(pair)), None)
    if place is None:
        return [], doubtful
    first, before = ranked[place], list(doubtful)
    return [each for each in _alike(ranked[place:]) if each is first or is_sure(each)], before


def _takes_all(at: Peak, of: Hypothesis) -> bool:
    """Test whether a fault is understated noise or outliers, which explain part of any other fault."""
    return of.kind == "outliers" or (of.kind in NOISES and at.value > 0.0)


def _companion(likelihood: Likelihood, now: Trial, ranked: Names) -> Supposed | None:
    """Find one of two gross faults that together gain more than any noise; None if there is no pair.

    One of two gross faults may gain little while the other is not corrected. Therefore, the most likely
    faults are tried together with all others, and special values, such as factors of units, are tried
    together with each other.
    """
    supposed, most = list[Supposed](), 0.0
    for at, of in ranked:
        if not _is_physical(of):
            most = max(most, at.gain)
        else:
            values = dict.fromkeys([at.value, *of.specials] if at.gain > 0.0 else of.specials)
            supposed += [Supposed(of, value) for value in values]
    alone = np.array(gains_over(likelihood, now)(supposed))
    order = np.argsort(-alone, kind="stable").tolist()
    best, found = most, None
    for rank, place in enumerate(order):
        leading = supposed[place]
        others = [supposed[each] for each in order[rank + 1 :]]
        if rank >= LEADING:
            others = [each for each in others if each.is_special] if leading.is_special else []
        others = [each for each in others if each.of is not leading.of]
        gains = gains_over(likelihood, leading.without(now))(others) if others else []
        together = alone[place] + max(gains, default=-np.inf)
        if together > best:
            best, found = float(together), leading
    return found


def _is_other_name(pair: Named, first: Named) -> bool:
    """Test whether a delay is opposite to the likeliest cause, which is a delay of another topic.

    Except at the ends of the log, both delays describe the same fault.
    """
    (at, of), (best, early) = pair, first
    if of.kind != early.kind or of.topic == early.topic or not (_is_early(first) or _takes_back(pair)):
        return False
    return abs(at.value + best.value) < SAME_SIZE * abs(best.value) and at.gain > SAME_GAIN * best.gain


def _is_early(pair: Named) -> bool:
    """Test whether a fault makes a topic early or its clock slow (usually, another topic is late)."""
    at, of = pair
    is_of_stamps = of.kind in ("delay", "clock drift") and isinstance(at.value, float)
    return is_of_stamps and of.already + at.value < 0.0


def _takes_back(pair: Named) -> bool:
    """Test whether a fault means that a delay in the settings is too large."""
    at, of = pair
    return of.already > 0.0 > at.value and not _is_early(pair)


def _peaks(gains_of: GainsOf, candidates: Sequence[Hypothesis], count: int, least: float) -> list[Peak]:
    """Find the largest gain of each candidate with one parallel search."""
    greatest = 0.0

    def noting(asked: Sequence[tuple[int, Number]]) -> Sequence[float]:
        nonlocal greatest
        found = gains_of([(candidates[place], at) for place, at in asked])
        greatest = max([greatest, *found])
        return found

    floors = [max(least_gain(count, each.size), least) for each in candidates]
    searches = [
        peak(each, floor, lambda: greatest) for each, floor in zip(candidates, floors, strict=True)
    ]
    return side_by_side(searches, noting)


def _is_named(at: Peak, of: Hypothesis, count: int) -> bool:
    """Test whether the gain is significant and the value is large enough for a fault."""
    is_small = isinstance(at.value, float) and abs(at.value) <= of.floor
    return at.gain > least_gain(count, of.size) and at.score(of) > 0.0 and not is_small


def _is_at_end(gains_of: GainsOf, at: Peak, of: Hypothesis) -> bool:
    """Test whether the 95 % interval of the value extends beyond the range that is searched."""
    if not of.has_end or at.is_special:
        return False
    [last] = gains_of([(of, float(np.copysign(of.limit, at.value)))])
    return last > at.gain - DROP_95


def _with_rival(gains_of: GainsOf, pair: Named, apart: float) -> list[Named]:
    """Return the value of a delay or angle, and a rival value whose gain may be less only by chance.

    The likelier value comes first.
    """
    at, of = pair
    may_come_again = of.limit == np.pi or of.kind == "delay"
    if not of.tried or of.size > 1 or not may_come_again:
        return [pair]
    [found] = side_by_side(
        [rival(of, at, at.gain - apart)], lambda asked: gains_of([(of, value) for _, value in asked])
    )
    both = [at] if found is None else sorted((at, found), key=lambda each: -each.gain)
    return [(each, of) for each in both if each.gain >= both[0].gain - apart]


def _causes(gains_of: GainsOf, pairs: Sequence[Named]) -> list[Cause]:
    """Make causes with the intervals of their values."""
    asking = [(at, of) for at, of in pairs if of.tried and of.size == 1]  # others have no value
    searches = []
    for at, _ in asking:
        # the gain falls by DROP_95 at about sqrt(DROP_95 / gain) of the way to zero
        scale = abs(at.value) * min(1.0, (DROP_95 / at.gain) ** 0.5)
        searches += [end(at.value, at.gain, -scale), end(at.value, at.gain, scale)]
    ends = side_by_side(
        searches, lambda asked: gains_of([(asking[place // 2][1], value) for place, value in asked])
    )
    of_one = iter(zip(ends[::2], ends[1::2], strict=True))
    found = []
    for at, of in pairs:
        if of.size > 1:
            between = _intervals(gains_of, at, of)
        else:
            between = next(of_one) if of.tried else (at.value, at.value)
        found.append(Cause(of, at.value, between, at.gain))
    return found


def _intervals(gains_of: GainsOf, at: Peak, of: Hypothesis) -> tuple[Number, Number]:
    """Compute the 95 % intervals of several values from the curvature of the gain at its maximum."""
    values, steps = np.array(at.value), np.array(of.tried[0])

    def cost(points: Floats) -> Floats:
        asked = values + points * steps
        return -np.array(gains_of([(of, tuple(map(float, each))) for each in asked]))

    _, bent = curvature(cost, np.zeros(of.size), range(of.size), 2.0)
    spread = QUANTILE * np.sqrt(np.abs(np.diag(np.linalg.pinv(bent)))) * steps
    return tuple(map(float, values - spread)), tuple(map(float, values + spread))


def _over_halves(likelihood: Likelihood, base: Trial, causes: Sequence[Cause]) -> list[Cause]:
    """Add to the causes their gains over each half of the log; a real fault is in both halves."""
    trials = [base] * (len(causes) + 1)
    for place, cause in enumerate(causes):
        trials = [
            each if own == place else cause.hypothesis.without(each, cause.value)
            for own, each in enumerate(trials)
        ]
    *lacking, mended = likelihood.over_parts(trials, 2)
    gains = [(mended - without).tolist() for without in lacking]
    return [cause._replace(of_halves=(a, b)) for cause, (a, b) in zip(causes, gains, strict=True)]


class Sought(NamedTuple):
    """The result of the search for causes.

    Attributes:
        causes: the causes, the most likely first.
        tried: every hypothesis, with its gain on the unaltered log.
        in_doubt: a cause that would be the most likely, but about which the parts of the log disagree.
        log_likelihood: log-likelihood of the unaltered log; NaN if it is unknown, in which case no
            hypothesis is tried.
    """

    causes: Sequence[Cause] = ()
    tried: Sequence[Tried] = ()
    in_doubt: Sequence[Cause] = ()
    log_likelihood: float = np.nan


def seek(source: MemorySource, label: str, settings: Mapping[str, Any], most: int) -> Sought:
    """Find the most likely causes.

    Args:
        source: the log.
        label: the estimator's label.
        settings: the estimator's parameters with its `kind`, and an open gate.
        most: the largest number of causes.

    Raises BadInput if the estimator cannot be replayed.
    """
    likelihood, base = Likelihood(), Trial(label, [source], settings)
    seen = likelihood.begin(base)
    [before] = likelihood([base])
    if not np.isfinite(before):
        return Sought()
    causes, tried, in_doubt = find_causes(
        likelihood, base, hypotheses(base.bind(), base, seen, likelihood.readings), most
    )
    return Sought(_over_halves(likelihood, base, causes), tried, in_doubt, before)
