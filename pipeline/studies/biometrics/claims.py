"""What Zheng & Blasch print of NIST BSSR1 set 1, and how it compares with what we measure.

Their rates of R1 and R2 stand with the face rates swapped in Table 3a: R1 is face-C and finger-left.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.output.claims import Claim, judged, listed
from replay.judging.consistency.verification import relative_rate_increase

Values = Mapping[str, float]
Counts = Mapping[str, Sequence[float]]

METHODS, MODALITIES = ("face", "finger"), ("matcher-1", "matcher-2")
CASES = (*METHODS, *MODALITIES, "all")
SINGLE = {"face-C": 89.17, "face-G": 84.33, "finger-left": 86.46, "finger-right": 92.65}
PAPER_FUSED = {
    label: dict(zip(CASES, rates, strict=True))
    for label, rates in {
        "mean": (90.52, 94.78, 94.78, 96.71, 99.61),
        "qda": (94.45, 97.23, 97.16, 99.16, 99.10),
        "knn": (96.97, 97.48, 99.22, 99.42, 99.55),
        "hmm": (97.42, 98.06, 99.22, 99.42, 99.68),
    }.items()
}
PRINTED_MEAN_RATE = {"matcher-1": 85.39, "matcher-2": 90.91}
MEMBERS = {
    "face": ("face-C", "face-G"),
    "finger": ("finger-left", "finger-right"),
    "matcher-1": ("face-C", "finger-left"),
    "matcher-2": ("face-G", "finger-right"),
    "all": tuple(SINGLE),
}
# Users that a matcher or mean fusion identifies in the real data, of 517.
REAL_COUNTS = {
    "single.face-C": 461, "single.face-G": 436, "single.finger-left": 447, "single.finger-right": 479,
    "mean.face": 468, "mean.finger": 490, "mean.matcher-1": 490, "mean.matcher-2": 500, "mean.all": 515,
}  # fmt: skip
ROUNDING = 0.005
NAMES = {"qda": "LDA with quadratic kernel (QDA)", "knn": "KNN", "hmm": "HMM"}


def claims_of_bssr1(values: Values) -> list[Claim]:
    """The claims on the real data; none where other fusions were run."""
    singles = {name: values.get(f"single.identified_percent.{name}", np.nan) for name in SINGLE}
    mean = _rates(values, "mean", "identified_percent")
    claims = [
        _exact("Table 2a: rates of the single matchers (%)", SINGLE, singles),
        _exact(
            "Tables 2a, 3a: mean fusion, min-max within each gallery column (%)",
            PAPER_FUSED["mean"],
            mean,
        ),
        _exact(
            "Eq. 2: mean fusion of z scores gives the printed rates (%)",
            PAPER_FUSED["mean"],
            _rates(values, "z-sum", "identified_percent"),
        ),
    ]
    for label, name in NAMES.items():
        claims += [_within_spread(values, label, name, case) for case in CASES]
    claims += [_swapped(singles, case) for case in PRINTED_MEAN_RATE]
    increases = _increases(values, singles)
    claims += [_modality_dominates(increases), *_hmm_is_best(values), _process_before_method(increases)]
    why = "the data are not public, or not among ours"
    claims.append(
        Claim(
            "Tables 2a to 4b: NIST-Face, NIST-Finger-Finger, ASUMS",
            "as printed",
            "-",
            "not reproducible",
            why,
        )
    )
    return claims


def claims_of_simulation(values: Values, counts: Counts) -> list[Claim]:
    """The claims on simulated data: alike to the real ones, and modality dominates."""
    claims = []
    for key, real in REAL_COUNTS.items():
        label, case = key.split(".")
        found = counts.get(f"{label}.identified_users.{case}", ())
        if len(found) > 1:
            mean, spread = float(np.mean(found)), float(np.std(found, ddof=1))
            claims.append(
                judged(
                    f"{label} {case}: the real count of identified users is as a simulated run's",
                    str(real),
                    f"{mean:.1f} ± {spread:.1f} ({len(found)} runs)",
                    abs(real - mean) <= 3 * spread,
                    "within 3 standard deviations of a run",
                )
            )
    singles = {name: values.get(f"single.identified_percent.{name}", np.nan) for name in SINGLE}
    claims.append(_modality_dominates(_increases(values, singles)))
    return claims


def _rates(values: Values, label: str, quantity: str) -> dict[str, float]:
    return {case: values.get(f"{label}.{quantity}.{case}", np.nan) for case in CASES}


def _exact(claim: str, paper: Mapping[str, float], ours: Mapping[str, float]) -> Claim:
    off = [key for key in paper if not abs(ours[key] - paper[key]) <= ROUNDING]
    why = f"differ: {', '.join(off)}" if off else "equal to the last printed digit"
    return judged(
        claim,
        listed([*paper.values()], between=", "),
        listed([*ours.values()], between=", "),
        not off,
        why,
    )


def _within_spread(values: Values, label: str, name: str, case: str) -> Claim:
    paper = PAPER_FUSED[label][case]
    ours = values.get(f"{label}.verification_rate_percent.{case}", np.nan)
    spread = values.get(f"{label}.verification_rate_sd_percent.{case}", np.nan)
    off = abs(ours - paper) / spread
    why = f"{off:.1f} standard deviations of a seed apart; the paper's seeds and folds are unknown"
    claim = f"Tables 2a, 3a: {name}, {case} (%)"
    return judged(claim, f"{paper:.2f}", f"{ours:.2f} ± {spread:.2f}", off <= 3, why)


def _swapped(singles: Mapping[str, float], case: str) -> Claim:
    paper, ours = PRINTED_MEAN_RATE[case], float(np.mean([singles[name] for name in MEMBERS[case]]))
    why = "the face rates of R1 and R2 are swapped in Table 3a"
    holds = abs(ours - paper) <= 2 * ROUNDING
    return judged(
        f"Table 3b: mean rate of {case} (%)",
        f"{paper:.2f}",
        f"{ours:.2f}",
        holds,
        "" if holds else why,
    )


def _increases(values: Values, singles: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Relative rate increases by fusion and subset."""
    rates = {"mean": _rates(values, "mean", "identified_percent")}
    rates |= {label: _rates(values, label, "verification_rate_percent") for label in NAMES}
    return {
        label: {
            case: relative_rate_increase(rate / 100, [singles[name] / 100 for name in MEMBERS[case]])[1]
            for case, rate in of_label.items()
        }
        for label, of_label in rates.items()
    }


def _modality_dominates(increases: Mapping[str, Mapping[str, float]]) -> Claim:
    known = [of for of in increases.values() if np.isfinite(list(of.values())).all()]
    modalities = float(np.mean([of[case] for of in known for case in MODALITIES]))
    methods = float(np.mean([of[case] for of in known for case in METHODS]))
    return judged(
        "Table 5: fusing modalities gains more than fusing matchers of one (mean RRI)",
        "0.8449 against 0.6563",
        f"{modalities:.4f} against {methods:.4f}",
        modalities > methods,
        f"over {len(known)} processes; the comparison, with the swapped rates put right",
    )


def _process_before_method(increases: Mapping[str, Mapping[str, float]]) -> Claim:
    one = [increases["hmm"][case] - increases["qda"][case] for case in METHODS]
    two = [increases["hmm"][case] - increases["qda"][case] for case in MODALITIES]
    gain, rest = float(np.mean(one)), float(np.mean(two))
    return judged(
        "4.2: the process matters more within one modality (RRI of HMM less LDA)",
        "0.1518 against 0.0848",
        f"{gain:.4f} against {rest:.4f}",
        gain > rest,
    )


def _hmm_is_best(values: Values) -> list[Claim]:
    """Per subset: HMM ahead of KNN and LDA, told only where the difference exceeds the seeds' spread."""
    claims = []
    for case in CASES:
        rates = {
            label: values.get(f"{label}.verification_rate_percent.{case}", np.nan) for label in NAMES
        }
        spreads = {
            label: values.get(f"{label}.verification_rate_sd_percent.{case}", np.nan) for label in NAMES
        }
        rival = "knn" if rates["knn"] >= rates["qda"] else "qda"
        ahead, spread = rates["hmm"] - rates[rival], float(np.hypot(spreads["hmm"], spreads[rival]))
        ours = f"{rates['hmm']:.2f} against {rates[rival]:.2f} ({NAMES[rival]})"
        why = f"the seeds' spread of the difference is {spread:.2f}"
        paper = max(PAPER_FUSED["qda"][case], PAPER_FUSED["knn"][case])
        printed = f"{PAPER_FUSED['hmm'][case]:.2f} against {paper:.2f}"
        claim = judged(f"HMM is the best learnt process, {case} (%)", printed, ours, ahead > 0, why)
        is_told = abs(ahead) > spread
        claims.append(claim if is_told else replace(claim, verdict="not reproducible"))
    return claims
