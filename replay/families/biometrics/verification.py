"""Performance measures of verification and identification: rates, ROC, equal error rate, Cllr.

Verification rate and relative rate increase: Zheng & Blasch, JAIF 2014, eq. 3. Cllr: Brummer & du Preez,
Computer Speech & Language 2006. A greater score means greater similarity; a comparison is accepted if
its score is not below the threshold.
"""

import operator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.streams import concatenate
from fuselog.replay.judging.metrics.measuring import Metric, Output

Floats = NDArray[np.float64]
FALSE_ACCEPT_RATES = (1e-4, 1e-3, 1e-2)  # also called false match rates (FMR), as FNMR is 1 - GAR


class Roc(NamedTuple):
    """Accept rates (n,) at falling thresholds, from nothing accepted to everything accepted."""

    threshold: Floats
    false_accept: Floats
    genuine_accept: Floats


class Fused(NamedTuple):
    """Fused scores (n,) of one run, and the users (n,) of probe and gallery entry.

    `fold` (users,) is the fold of each user in the cross-validation, and `threshold` is the decision
    threshold of the fusion; each is None if the fusion does not have it. `is_ratio` is true if the
    scores are log-likelihood ratios.
    """

    score: Floats
    probe: NDArray[np.int64]
    gallery: NDArray[np.int64]
    fold: NDArray[np.int64] | None
    threshold: float | None
    is_ratio: bool

    @property
    def genuine(self) -> NDArray[np.bool_]:
        """Test whether each comparison (n,) is of the same user."""
        return self.probe == self.gallery

    @property
    def is_complete(self) -> bool:
        """Test whether every probe is compared with every gallery entry."""
        return len(self.score) == (int(self.gallery.max()) + 1) ** 2


def fused_of(stream: Stream) -> Fused:
    """Read the fused scores of a fusion's output stream."""
    folds = stream.metadata.get("fold_of_user")
    threshold = stream.metadata.get("threshold")
    return Fused(
        stream["scores"][:, 0],
        stream["probe_id"].astype(np.int64),
        stream["gallery_id"].astype(np.int64),
        np.array(folds.split(","), np.int64) if folds else None,
        float(threshold) if threshold else None,
        stream.metadata.get("components") == "log_likelihood_ratio",
    )


def roc(score: Floats, genuine: NDArray[np.bool_], weight: Floats | None = None) -> Roc:
    """Compute the accept rates at every distinct score.

    Args:
        score: (n,), greater if more similar.
        genuine: (n,), whether probe and gallery entry are of the same person.
        weight: (n,), the weight of each comparison; 1 by default.

    Returns:
        Rates from nothing accepted to everything accepted.
    """
    order = np.argsort(-score, kind="stable")
    falling = score[order]
    counts = np.ones(len(score)) if weight is None else weight[order]
    accepted = np.stack([np.cumsum(counts * ~genuine[order]), np.cumsum(counts * genuine[order])])
    last = np.append(falling[1:] != falling[:-1], True)
    rates = np.concatenate([np.zeros((2, 1)), accepted[:, last]], axis=1) / accepted[:, -1:]
    return Roc(np.append(np.inf, falling[last]), *rates)


def genuine_accept_at(curve: Roc, false_accept: ArrayLike) -> Floats:
    """Find the greatest genuine accept rate at which the false accept rate does not exceed a limit.

    Args:
        curve: rates of a fusion.
        false_accept: rates (...), between 0 and 1.
    """
    last = np.searchsorted(curve.false_accept, false_accept, side="right") - 1
    return curve.genuine_accept[last]


def equal_error_rate(curve: Roc) -> float:
    """Return the mean of false accept and false reject rates at the threshold where they are closest."""
    reject = 1 - curve.genuine_accept
    closest = int(np.argmin(np.abs(curve.false_accept - reject)))
    return float(curve.false_accept[closest] + reject[closest]) / 2


def cost_of_ratio(ratio: Floats, genuine: NDArray[np.bool_]) -> float:
    """Compute Cllr in bits: 0 for perfect log-likelihood ratios, 1 for uninformative ones.

    Args:
        ratio: (n,), log-likelihood ratios.
        genuine: (n,), whether probe and gallery entry are of the same person.

    Returns:
        Cllr in bits, at least 0.
    """
    same = np.logaddexp(0, -ratio[genuine]).mean()
    other = np.logaddexp(0, ratio[~genuine]).mean()
    return float((same + other) / (2 * np.log(2)))


def identified(scores: Floats) -> int:
    """Count the columns of scores (probes, gallery) whose first greatest score is on the diagonal."""
    best = np.argmax(np.where(np.isnan(scores), -np.inf, scores), axis=0)
    return int(np.count_nonzero(best == np.arange(len(best))))


def verification_rate(fused: Fused) -> float:
    """Compute the share of correct decisions at the threshold, averaged over the folds.

    If the fusion has no threshold, 0 is used, as for a log-likelihood ratio.
    """
    right = (fused.score > (fused.threshold or 0.0)) == fused.genuine
    if fused.fold is None:
        return float(right.mean())
    fold = fused.fold[fused.gallery]
    rates = np.bincount(fold, weights=right.astype(float)) / np.bincount(fold)
    return float(rates.mean())


def relative_rate_increase(fused_rate: float, rates: ArrayLike) -> tuple[float, float]:
    """Compute the absolute and relative increase of a rate over the mean of single matchers (eq. 3).

    Args:
        fused_rate: rate of the fusion, between 0 and 1.
        rates: rates of the single matchers, (n,).
    """
    mean = float(np.mean(np.asarray(rates, float)))
    increase = fused_rate - mean
    return increase, increase / (1 - mean)


def bootstrap_users(fused: Fused, replicates: int, rng: np.random.Generator) -> Floats:
    """Compute the GAR at three FARs and the EER (replicates, 4) for users resampled with replacement.

    The weight of a comparison is the number of draws of the probe's user times the number of draws of
    the gallery user; for a genuine comparison, it is the number of draws of this user. This preserves
    the dependence of scores of the same user (Bolle, Ratha & Pankanti 2004).
    """
    users = int(fused.gallery.max()) + 1
    order = np.argsort(-fused.score, kind="stable")
    score, probe, gallery = fused.score[order], fused.probe[order], fused.gallery[order]
    genuine = probe == gallery
    results = np.empty((replicates, len(FALSE_ACCEPT_RATES) + 1))
    for replicate in range(replicates):
        drawn = np.bincount(rng.integers(0, users, users), minlength=users).astype(float)
        weight = np.where(genuine, drawn[probe], drawn[probe] * drawn[gallery])
        curve = roc(score, genuine, weight)
        results[replicate] = *genuine_accept_at(curve, FALSE_ACCEPT_RATES), equal_error_rate(curve)
    return results


Runs = dict[int, list[Stream]]


def _add(state: Runs, output: Output) -> Runs:
    """Collect the fused scores of every run; ignore other outputs."""
    if output.rows.stream.schema.full_name == schemas.SCORE_VECTOR.full_name and output.leaf == "fused":
        for run in range(output.rows.runs):
            state.setdefault(output.first_run + run, []).append(output.rows.of_run(run))
    return state


def _means(state: Runs) -> dict[str, float]:
    """Return the rates of a fusion, averaged over the runs."""
    runs = [_rates(fused_of(concatenate(parts))) for parts in state.values()]
    return {name: float(np.mean([run[name] for run in runs])) for name in runs[0]} if runs else {}


def _rates(fused: Fused) -> dict[str, float]:
    values: dict[str, float] = {}
    if fused.threshold is not None and not fused.is_complete:
        values["verification_rate_percent"] = 100 * verification_rate(fused)
    if fused.is_complete:
        users = int(fused.gallery.max()) + 1
        matrix = np.empty((users, users))
        matrix[fused.probe, fused.gallery] = fused.score
        values["identified_users"] = identified(matrix)
        values["identified_percent"] = 100 * values["identified_users"] / users
    if fused.genuine.all() or not fused.genuine.any():
        return values
    curve = roc(fused.score, fused.genuine)
    accepted = 100 * genuine_accept_at(curve, FALSE_ACCEPT_RATES)
    named = [f"{100 * rate:g}_percent".replace(".", "p") for rate in FALSE_ACCEPT_RATES]
    if fused.is_complete:
        values |= {f"gar_at_far_{name}": float(of) for name, of in zip(named, accepted, strict=True)}
    values["eer_percent"] = 100 * equal_error_rate(curve)
    impostors = np.count_nonzero(~fused.genuine)
    for rate, name, of in zip(FALSE_ACCEPT_RATES, named, accepted, strict=True):
        if impostors * rate >= 1.0:  # fewer impostors cannot resolve such a rate
            values[f"fnmr_at_fmr_{name}"] = 100 - float(of)
    if fused.is_complete and fused.is_ratio:
        values["cllr_bits"] = cost_of_ratio(fused.score, fused.genuine)
    return values


VERIFICATION = Metric(
    "verification and identification rates of fused scores", Output, dict, _add, operator.or_, _means
)
