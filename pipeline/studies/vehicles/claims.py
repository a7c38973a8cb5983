"""What Zhang et al. 2016 claim of cooperative vehicles, each tried with the estimators there are.

Labels are those of the shipped experiments; a claim is left out where an experiment lacks its estimators
or its cases.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.output.claims import Claim, judged
from pipeline.studies.vehicles.cases import NUMBER_BYTES, Case, Scores

Table = Mapping[str, Scores]

# Ratios of total errors to the Kalman filter's, measured with another implementation (200 runs).
TOPOLOGY_RATIO, FREE_RATIO, STATIC_RATIO = 0.959, 0.72, 0.58
RATIO_TOLERANCE = 0.003
# Total errors that differ by less are the same.
SAME = 0.02
STRAIGHT = "straight"


class Tried(NamedTuple):
    """What a claim needs of the estimators, and what is made of a case's scores."""

    needs: tuple[str, ...]
    judge: Callable[[Table], Claim]


def claims(cases: Sequence[Case], few: Table) -> list[Claim]:
    """All claims that the experiment can try: on every case, on the few runs, and between cases."""
    found = []
    for case in cases:
        if case.has_losses or case.name == STRAIGHT:
            continue
        runs = len(case.sources)
        found += [_of(claim, f"{case.name}, {runs} runs") for claim in _tried(IN_A_CASE, case.scores)]
    first = cases[0]
    runs = len(next(iter(few.values())).fixed) if few else 0
    found += [_of(claim, f"{first.name}, {runs} runs") for claim in _tried(IN_FEW_RUNS, few)]
    found += [_of(claim, first.name) for claim in _bandwidth(first)]
    found += _turning(cases)
    return found


def _of(claim: Claim, case: str) -> Claim:
    return Claim(f"{claim.claim} [{case}]", claim.paper, claim.ours, claim.verdict, claim.why)


def _tried(trials: Sequence[Tried], scores: Table) -> Iterator[Claim]:
    for trial in trials:
        if set(trial.needs) <= set(scores):
            yield trial.judge(scores)


def _median(scores: Scores) -> float:
    return float(np.nanmedian(scores.fixed))


def _assigned(scores: Scores) -> float:
    return float(np.nanmean(scores.assigned))


def _medians(scores: Table, *labels: str) -> str:
    return ", ".join(f"{label} {_median(scores[label]):.3f}" for label in labels) + " m (medians)"


def _topology_helps(scores: Table) -> Claim:
    before, after = scores["kf"].fixed, scores["kf-topology"].fixed
    ratio, better = float(after.mean() / before.mean()), float((after < before).mean())
    return judged(
        "the topology of the sensor's detections improves the estimate, whatever the sensor's pose",
        "the high performance is mainly from the topology",
        f"KF {before.mean():.3f}, with topology {after.mean():.3f} m: ratio {ratio:.4f}, better in "
        f"{100 * better:.1f} % of the runs",
        abs(ratio - TOPOLOGY_RATIO) < RATIO_TOLERANCE and better > 0.95,
        f"expected {TOPOLOGY_RATIO} +- {RATIO_TOLERANCE}: one of ten combinations becomes precise",
    )


def _sums_beat_kalman(scores: Table) -> Claim:
    own, kalman = _median(scores["axes-topology"]), _median(scores["kf"])
    return judged(
        "separate sums of x and of y with topology (the paper's SME filter, done exactly) beat the KF",
        "smaller total error in all scenarios of Fig. 3",
        _medians(scores, "axes-topology", "axes", "kf"),
        own < kalman,
        "vehicles that start with equal x or y are averaged in that axis; it helps only as long as "
        "they stay alike",
    )


def _set_beats_kalman(scores: Table) -> Claim:
    own, kalman = _median(scores["set-topology"]), _median(scores["kf"])
    return judged(
        "unordered fixes with topology beat the KF with known association",
        "the SME filter needs no association and is better",
        _medians(scores, "set", "set-topology", "kf"),
        own < kalman - RATIO_TOLERANCE,
        "the exact collapse over all associations of (x, y) pairs, not the paper's sums",
    )


def _information_is_lost(scores: Table) -> Claim:
    apart, together = _median(scores["axes"]), _median(scores["set"])
    return judged(
        "no information is lost by the symmetric transformation",
        "measurements are recovered uniquely",
        _medians(scores, "axes", "set"),
        abs(apart / together - 1.0) < SAME,
        "all pairings of the x with the y have the same separate sums: an error as long as vehicles "
        "share coordinates helps, then not; sums of (x + iy)^k keep the pairs",
    )


def _registration(label: str, words: str, expected: float) -> Tried:
    def judge(scores: Table) -> Claim:
        kalman, topology = scores["kf"].fixed.mean(), _assigned(scores["hungarian-topology"])
        own = _assigned(scores[label])
        gain = 1.0 - own / kalman
        return judged(
            f"the sensor's pose need not be known: topology does without it; the pose {words}",
            "coordinate transformation not required; its estimate would over-converge",
            f"{own:.3f} m assigned, {own / kalman:.3f} of the KF (other implementation {expected}); "
            f"topology {topology / kalman:.3f}",
            own > topology,
            f"estimated along with its correlations, the pose gains {100 * gain:.0f} %",
        )

    return Tried(("kf", "hungarian-topology", label), judge)


def _phd_is_worse(scores: Table) -> Claim:
    kalman, phd = scores["kf"], scores["gm-phd"]
    gospa = [float(np.nanmean(each.gospa_by_step)) for each in (kalman, phd)]
    own, other = _assigned(phd), _assigned(kalman)
    return judged(
        "the PHD filter is worse than the KF with known association",
        "Fig. 3",
        f"assigned {own:.3f} (median {np.nanmedian(phd.assigned):.3f}) against {other:.3f} m; GOSPA "
        f"{gospa[1]:.3f} against {gospa[0]:.3f} m",
        own > other and gospa[1] > gospa[0],
        "mostly where vehicles meet",
    )


def _bootstrap_beats_kalman(scores: Table) -> Claim:
    own, kalman = scores["particles-axes-topology"], scores["kf"]
    return judged(
        "the paper's SME filter, 1000 particles on sums of powers with topology, beats the KF",
        "smaller total error in all scenarios of Fig. 3",
        f"{own.fixed.mean():.1f}, assigned {own.assigned.mean():.1f} m; KF {kalman.fixed.mean():.3f} m",
        own.fixed.mean() < kalman.fixed.mean(),
        "1000 particles do not fill 20 dimensions, and lost pairings are not found again",
    )


def _figure_3(scores: Table) -> Claim:
    errors = {label: _assigned(scores[label]) for label in ("particles-axes-topology", "kf", "gm-phd")}
    own, kalman, phd = errors.values()
    return Claim(
        "Fig. 3: the total errors of SME filter, KF and PHD filter, in this order",
        "bars without numbers",
        ", ".join(f"{label} {error:.3f}" for label, error in errors.items()) + " m, assigned",
        "confirmed" if own < kalman < phd else "not reproducible",
        "number of particles, resampling, R and the PHD filter's parameters are not stated",
    )


def _linearising_is_unsatisfactory(scores: Table) -> Claim:
    return judged(
        "EKF and UKF on sums of powers do not satisfy",
        "strong nonlinearities, numerical instabilities",
        f"{_medians(scores, 'powers', 'unscented-powers', 'kf')}; failed runs of the EKF: "
        f"{scores['powers'].failed}",
        min(_median(scores["powers"]), _median(scores["unscented-powers"]))
        > 1.5 * _median(scores["kf"]),
    )


def _powers_equal_products(scores: Table) -> Claim:
    powers, products = _median(scores["powers"]), _median(scores["products"])
    same = abs(powers / products - 1.0) < SAME and scores["powers"].failed == scores["products"].failed
    return judged(
        "sums of powers and sums of products perform the same",
        "no difference",
        f"{_medians(scores, 'powers', 'products')}; failed runs {scores['powers'].failed} and "
        f"{scores['products'].failed}",
        same,
        "both lose the vehicles" if same else "the same exactly; linearised, their noise is not",
    )


def _pairing_helps(scores: Table) -> Claim:
    own, kalman = _median(scores["complex"]), _median(scores["kf"])
    return judged(
        "sums of powers need the particle filter",
        "only the particle filter is utilized",
        f"{_medians(scores, 'complex', 'powers', 'kf')}",
        own > 1.5 * kalman,
        "linearised sums of (x + iy)^k, which keep the pairs, come close to the KF",
    )


def _associations_are_drawn(scores: Table) -> Claim:
    own, kalman = _assigned(scores["associations"]), _assigned(scores["kf"])
    return judged(
        "particles over associations, with Kalman filters, reach the KF with known association",
        "(not in the paper)",
        f"60 particles, the best one: {own:.3f} m assigned; KF {kalman:.3f} m",
        own < 1.03 * kalman,
    )


def _bandwidth(case: Case) -> Iterator[Claim]:
    """Of the methods with fixes without identity and topology."""
    sent = case.bytes_per_step
    if {"set-topology", "registration"} <= set(sent):
        yield judged(
            "2 N measurements per step are the least that must be sent",
            "2 N",
            f"topology {sent['set-topology']:.0f}, all detections {sent['registration']:.0f} bytes",
            sent["set-topology"] >= sent["registration"],
            f"the sensor need send only the topology itself, one number of {NUMBER_BYTES} bytes",
        )


def _turning(cases: Sequence[Case]) -> Iterator[Claim]:
    """Cases with turning vehicles against the same filters where all drive straight on."""
    named = {case.name: case for case in cases}
    first = cases[0]
    if STRAIGHT not in named or first.name == STRAIGHT:
        return
    run = first.sources[0].run
    assert run is not None
    turning = sum(rate != 0.0 for rate in run.parameters["turn_rate_radps"])
    ratio = {
        label: _median(scores) / _median(named[STRAIGHT].scores[label])
        for label, scores in first.scores.items()
        if label in ("kf-topology", "set-topology", "axes-topology")
    }
    ours = ", ".join(f"{label} {each:.3f}" for label, each in ratio.items())
    alike = all(abs(each - 1.0) < SAME for each in ratio.values())
    degraded = all(each > 1.0 + SAME for each in ratio.values())
    two = turning == 2
    words = "almost the same as with constant velocity" if two else "degraded a lot"
    yield Claim(
        f"{turning} vehicles turn: the SME filter is {words}",
        "Fig. 3",
        f"medians by those with constant velocity: {ours}",
        "confirmed" if (alike if two else degraded) else "not reproducible",
        "the noise is the same on every path; only what takes x and y apart feels how vehicles meet",
    )


IN_A_CASE = (
    Tried(("kf", "kf-topology"), _topology_helps),
    Tried(("kf", "axes", "axes-topology"), _sums_beat_kalman),
    Tried(("kf", "set", "set-topology"), _set_beats_kalman),
    Tried(("axes", "set"), _information_is_lost),
    Tried(("kf", "gm-phd"), _phd_is_worse),
    _registration("registration", "is another one in every scan", FREE_RATIO),
    _registration("static", "stays", STATIC_RATIO),
)
IN_FEW_RUNS = (
    Tried(("kf", "particles-axes-topology"), _bootstrap_beats_kalman),
    Tried(("kf", "particles-axes-topology", "gm-phd"), _figure_3),
    Tried(("kf", "powers", "unscented-powers"), _linearising_is_unsatisfactory),
    Tried(("kf", "powers", "products"), _powers_equal_products),
    Tried(("kf", "powers", "complex"), _pairing_helps),
    Tried(("kf", "associations"), _associations_are_drawn),
)
