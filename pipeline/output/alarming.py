"""Warnings about the results of a replay, the worst first, each with advice.

For a filter with correct covariances, NIS, NEES and the share of rejected measurements are within their
limits in 999 of 1,000 logs. A value outside its limits causes a warning, as does a constant error. The
class `fuselog.replay.judging.verdicts.Squares` explains what the values mean for the filter.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fuselog.pipeline.output.results import split_metric
from fuselog.recorders.checks.finding import Finding
from fuselog.replay.engine import chi2
from fuselog.replay.engine.replaying.usage import SILENT, UNTAKEN, Row
from fuselog.replay.judging.consistency.conditioning import LOST
from fuselog.replay.judging.consistency.consistency import CONSISTENT
from fuselog.replay.judging.errors.constant import Constant
from fuselog.replay.judging.errors.differences import FEWEST_DOMINATED, dominating
from fuselog.replay.judging.errors.evaluation import chi_square_interval, split_topic
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import metric_key
from fuselog.replay.judging.verdicts import MATERIAL, Consistency, Squares

if TYPE_CHECKING:
    import pandas as pd

USUAL_GATE = 0.99  # gate probability if it is unknown
RARE = 0.01  # share of rejected measurements that serves as the unit of excess
LARGEST = 1e300  # replaces infinity, which JSON does not have
NIS = "nis_per_component"
OF_DIVERGENCE = "it diverged, or its covariances are in another unit"
REASONS = {
    Consistency.OVERCONFIDENT: "its covariances are too small",
    Consistency.CONSERVATIVE: "its covariances are too large",
    Consistency.CONSISTENT: f"its covariances are off by less than {MATERIAL:.0%}".replace("%", " %"),
}
SEEN = 1.5  # NIS per component from which innovations show an error
UNSEEN = 2.0  # ratio of normalised squared errors to innovations from which the error is material
UNUSED = 0.05  # share of a topic's messages; if more are unused, there is a warning


class _Range(NamedTuple):
    """NIS or NEES outside the limits of a consistent filter."""

    of: Squares
    low: float
    high: float

    @property
    def excess(self) -> float:
        """Return the factor by which the value exceeds its limit."""
        value = self.of.found.value
        beyond = value / self.high if value > self.high else self.low / max(value, 1e-9)
        return min(beyond, LARGEST)

    @property
    def fact(self) -> str:
        """Format the value and its limits as a phrase."""
        limits = f"where a consistent filter is between {self.low:.3g} and {self.high:.3g}"
        return f"is {self.of.found.value:.3g}{' per component' * (self.of.name == NIS)}, {limits}"

    @property
    def reason(self) -> str:
        """Return what the value means for the estimator."""
        return OF_DIVERGENCE if self.of.has_diverged else REASONS[self.of.verdict]


def unseen(judge: Judge) -> Iterator[Finding]:
    """Find errors that innovations do not show: the NEES is too large, also in relation to the NIS."""
    for key, (_, high) in judge.bounds.items():
        estimator, quantity, case = split_metric(key)
        nees, nis = judge.metrics[key], judge.metrics.get(metric_key(estimator, NIS, case), np.inf)
        if quantity != "nees" or nees <= high or nis >= SEEN:
            continue
        if nees > UNSEEN * nis * judge.squares(estimator, quantity, case).aim:
            evidence = (
                f"NEES is {nees:.3g} (consistent up to {high:.3g}), but NIS is only {nis:.3g} per "
                "component: the state follows an error that the innovations do not show"
            )
            yield Finding("unseen error", estimator, case, nees, evidence)


def alarms_of(
    judge: Judge, parameters: Mapping[str, Mapping[str, Any]], coverage: Sequence[Row] = ()
) -> list[Finding]:
    """Find the warnings of a judged replay, the worst first.

    Args:
        judge: judge of all runs.
        parameters: parameters of the estimators by label, if known.
        coverage: how many measurements of each topic were used.
    """
    uninformed = [*_of_components(judge)]
    explained = {(each.where, each.part) for each in uninformed}
    nis, nees = _beyond(judge, NIS), _beyond(judge, "nees")
    diverged = {
        what: nees[what]
        for what in nis.keys() & nees.keys()
        if nis[what].of.has_diverged or nees[what].of.has_diverged
    }
    inconsistent = [
        *_of_innovations(judge, parameters, nis, diverged),
        *_of_errors(judge, nees, diverged),
    ]
    found = [
        *uninformed,
        *(each for each in inconsistent if (each.where, each.part) not in explained),
        *_of_costs(judge),
        *_of_digits(judge),
        *_of_measurements(coverage),
    ]
    return [*sorted(found, key=lambda each: -each.value), *_of_gates(judge, parameters)]


def _of_components(judge: Judge) -> Iterator[Finding]:
    """Find components of the state on which an estimator's measurements have no influence."""
    for (estimator, case), names in judge.uninformed.items():
        them, keep = ("it", "keeps its") if len(names) == 1 else ("them", "keep their")
        words = (
            f"{_name(estimator, case)}: {', '.join(names)} {keep} initial value and prior uncertainty, "
            f"because no measurement informs this method about {them}"
        )
        other = "use another method that fits the log; fuselog info LOG lists them"
        yield Finding("uninformed", estimator, case, LARGEST, words, otherwise=other)


def _beyond(judge: Judge, quantity: str) -> dict[tuple[str, str], _Range]:
    """Find NIS or NEES outside its limits, by estimator and case."""
    metrics, found = judge.metrics, dict[tuple[str, str], _Range]()
    for key, (low, high) in judge.intervals(CONSISTENT).items():
        estimator, own, case = split_metric(key)
        if own == quantity and (metrics[key] < low or metrics[key] > high):
            found[estimator, case] = _Range(judge.squares(estimator, quantity, case), low, high)
    return found


def _of_innovations(
    judge: Judge,
    parameters: Mapping[str, Mapping[str, Any]],
    nis: Mapping[tuple[str, str], _Range],
    diverged: Mapping[tuple[str, str], _Range],
) -> Iterator[Finding]:
    """Find gates that reject too many measurements, and NIS outside its interval.

    The NEES of a diverged estimator is reported together with its NIS.
    """
    for topic, innovations in judge.innovations.items():
        sums = innovations.total
        estimator, case = split_topic(topic)
        gate = float(parameters.get(estimator, {}).get("gate_probability", USUAL_GATE))
        facts, excess = [], 1.0
        gated = sums.messages - sums.accepted
        expected = (1.0 - gate) * sums.messages
        # a count of rare events is Poisson distributed, with the tail of a chi-square distribution
        if gated and chi2.sf(2.0 * expected, 2 * gated) > CONSISTENT:
            share = gated / sums.messages
            excess = max(1.0, gated / max(expected, RARE * sums.messages))
            facts.append(
                f"the gate rejects {_percent(share)} of {sums.messages} measurements, where "
                f"{_percent(1.0 - gate)} {'is' if gate < 1.0 else 'are'} expected"
            )
        if not sums.accepted and sums.messages:
            facts.append("its log-likelihood includes no measurement")
        if own := nis.get((estimator, case)):
            excess = max(excess, own.excess)
            facts.append(f"NIS {own.fact}")
            if nees := diverged.get((estimator, case)):
                excess = max(excess, nees.excess)
                facts.append(f"NEES {nees.fact}")
            facts[-1] += f": {OF_DIVERGENCE if nees else own.reason}"
        if facts:
            words = f"{_name(estimator, case)}: {'; '.join(facts)}"
            yield Finding("innovations", estimator, case, excess, words, otherwise=_why(estimator))


def _of_errors(
    judge: Judge,
    nees: Mapping[tuple[str, str], _Range],
    diverged: Mapping[tuple[str, str], _Range],
) -> Iterator[Finding]:
    """Find constant position errors, and NEES outside its interval if the estimator did not diverge."""
    constants, positions = judge.constants, _beyond(judge, "position_nees")
    for topic in judge.judged:
        what = estimator, case = split_topic(topic)
        own, either = nees.get(what), (nees.get(what), positions.get(what))
        if what in constants and any(each and each.of.found.value > each.high for each in either):
            yield _of_constant(estimator, case, constants[what])
        elif own and what not in diverged:
            words = f"{_name(*what)}: NEES {own.fact}: {own.reason}"
            words += _of_one_run(judge, estimator, case)
            if (lacking := judge.unestimated.get(what)) and own.of.found.value > own.high:
                more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
                words += (
                    f"; the truth contains {lacking[0]}{more}, which the estimator does not estimate; "
                    "if the model supports it, add them to the state with the setting `estimate`"
                )
            has_innovations = any(split_topic(each)[0] == estimator for each in judge.innovations)
            why = _why(estimator) if has_innovations else ""
            yield Finding("errors", estimator, case, own.excess, words, otherwise=why)


def _of_one_run(judge: Judge, estimator: str, case: str) -> str:
    """Name the run that dominates the mean NEES; return "" if no run does."""
    if judge.runs < FEWEST_DOMINATED:
        return ""
    table = judge.runs_table
    own = table[(table["estimator"] == estimator) & (table["case"] == case)]
    found = dominating_run(own.set_index("run")["nees"].dropna())
    return f"; {found}" if found else ""


def dominating_run(nees: "pd.Series[float]") -> str:
    """Describe a run that contributes more to the mean NEES than all others together, or return ""."""
    values = np.asarray(nees, np.float64)
    place = dominating(values)
    if place is None:
        return ""
    rest = float(np.delete(values, place).mean())
    return (
        f"run {nees.index[place]} dominates the mean with {values[place]:.3g}; the other runs average "
        f"{rest:.3g}"
    )


def _of_constant(estimator: str, case: str, constant: Constant) -> Finding:
    """Describe a constant error, in the axes of the body or of the local tangent plane."""
    offset = ", ".join(f"{each:.3g}" for each in constant.offset_m)
    name, excess = _name(estimator, case), constant.nees / max(constant.rest, 1e-9)
    words = f"{name}: {_percent(constant.share)} of the squared error is constant, "
    if constant.turns:
        axes = "forward, left, up" if len(constant.offset_m) > 2 else "forward, left"
        words += (
            f"({offset}) m {axes}: the truth may refer to another point of the body (a lever arm), or a "
            "sensor may have an offset"
        )
        state = "add the lever arm or the offset to the model"
        return Finding("lever arm", estimator, case, excess, words, otherwise=state)
    words += (
        f"({offset}) m: truth and estimate may have different origins; try fuselog evaluate --align se2"
    )
    return Finding("origin", estimator, case, excess, words)


def _of_costs(judge: Judge) -> Iterator[Finding]:
    """Find trajectory searches whose final cost is higher than measurement noise explains."""
    metrics = judge.metrics
    for topic, innovations in judge.innovations.items():
        sums = innovations.total
        estimator, case = split_topic(topic)
        cost = metrics.get(metric_key(estimator, "cost", case))
        numbers = sums.accepted_degrees
        if cost is None or not np.isfinite(cost) or not numbers:
            continue
        _, high = chi_square_interval(numbers, 1, CONSISTENT)
        high *= 0.5 / judge.runs
        # noise parameters that are too small raise both the cost and the NIS
        if cost > high * max(1.0, sums.squared / sums.degrees):
            words = (
                f"{_name(estimator, case)}: the search ended at a cost of {cost:.4g}, where "
                f"{numbers / judge.runs:.4g} measured numbers explain at most {high:.4g}: probably a "
                "local minimum"
            )
            starts = "try other starts, such as --set start=motion"
            yield Finding("minimum", estimator, case, cost / high, words, otherwise=starts)


def _of_digits(judge: Judge) -> Iterator[Finding]:
    """Find covariances of estimates or innovations that rounding has made almost singular."""
    for topic, found in judge.conditioning.items():
        if not found.lost:
            continue
        estimator, case = split_topic(topic)
        whose = "innovation's covariance" if topic.endswith("/innovation") else "covariance"
        when = f"at {found.elapsed_s:.1f} s" + (f" of run {found.run}" if judge.runs > 1 else "")
        words = f"{_name(estimator, case)}: the {whose} "
        if found.failed:
            words += (
                f"is not positive definite in {found.failed} of {found.sampled} samples, worst {when}"
            )
        else:
            words += (
                f"has lost its precision in {found.lost} of {found.sampled} samples: {when} a pivot of "
                f"its Cholesky factor is {max(found.least, 0.0):.2g} of a variance; {LOST:g} would "
                "leave four digits"
            )
        surer = "use a tighter prior, add noise to states that are known too well, or try sqrt:ekf"
        share = found.lost / found.sampled
        yield Finding("digits", estimator, case, 1.0 + share / RARE, words, otherwise=surer)


def _of_measurements(coverage: Sequence[Row]) -> Iterator[Finding]:
    """Find measurements left unused for a stated reason, such as rejection by a gate."""
    measuring = {row.estimator for row in coverage if row.used}
    for row in coverage:
        is_by_choice = row.why.startswith(UNTAKEN) and (row.why == UNTAKEN or row.estimator in measuring)
        if not row.sentence or row.why == SILENT or is_by_choice:
            continue
        if row.unused > UNUSED * row.messages:
            excess = row.unused / (UNUSED * row.messages)
            yield Finding("unused", row.estimator, "", excess, row.sentence)


def _of_gates(judge: Judge, parameters: Mapping[str, Mapping[str, Any]]) -> Iterator[Finding]:
    """Find estimators that cannot be compared because different gates rejected measurements."""
    gates = {
        label: float(values["gate_probability"])
        for label, values in parameters.items()
        if "gate_probability" in values
        and any(split_topic(topic)[0] == label for topic in judge.innovations)
    }
    is_closed = any(each.total.accepted < each.total.messages for each in judge.innovations.values())
    if is_closed and len({*gates.values()}) > 1:
        own = ", ".join(f"{gate:g} for {label}" for label, gate in gates.items())
        words = f"gate_probability is {own}: their likelihoods are based on different measurements"
        yield Finding("gates", "", "", 1.0, words, otherwise="compare with --set gate_probability=1")


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _name(estimator: str, case: str) -> str:
    return f"{estimator} {case}".strip()


def _why(estimator: str) -> str:
    return f"fuselog diagnose LOG -e {estimator} explains why"
