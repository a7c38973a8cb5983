"""Pairs of probes and gallery entries: normalized scores, fusion rules, and folds of users."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.biometrics.models import TOPIC, Matcher
from fuselog.replay.engine.arrays import Booleans, Floats, Integers

Scorer = Callable[[Floats], Floats]


Learner = Callable[[Floats, Booleans, np.random.Generator], Scorer]


TANH_SCALE = 0.01
IMPOSTORS_PER_USER = 2


class Pairs(NamedTuple):
    """Comparisons to fuse: their probe and gallery users (n,), and the folds (users,) of the users.

    If `fold` is None, the fusion does not learn.
    """

    probe: Integers
    gallery: Integers
    fold: Integers | None = None


def normalise(scores: Floats, how: str) -> Floats:
    """Convert scores to a common scale; missing scores (NaN) stay missing.

    `tanh` is the normalisation of Jain, Nandakumar & Ross 2005, with mean and standard deviation instead
    of Hampel's estimates. `column-min-max` sets a gallery column of equal scores to 0. Raises BadInput
    if a standard deviation is zero or not finite.

    Args:
        scores: (users, users, matchers), NaN if missing.
        how: the name of the normalisation.
    """
    match how:
        case "z" | "tanh":
            z = (scores - np.nanmean(scores, axis=(0, 1))) / _deviations(scores)
            return z if how == "z" else 0.5 * (np.tanh(TANH_SCALE * z) + 1)
        case "min-max" | "column-min-max":
            over = (0, 1) if how == "min-max" else (0,)
            low = np.nanmin(scores, axis=over, keepdims=True)
            width = np.nanmax(scores, axis=over, keepdims=True) - low
            return np.where(width > 0, (scores - low) / np.where(width > 0, width, 1.0), 0.0)
    return scores


def _deviations(scores: Floats) -> Floats:
    """Compute the standard deviation (matchers,) of each matcher's scores, ignoring missing scores."""
    with np.errstate(over="ignore", invalid="ignore"):
        deviations = np.nanstd(scores, axis=(0, 1), ddof=1)
    unusable = ~(np.isfinite(deviations) & (deviations > 0))
    if unusable.any():
        raise BadInput(
            f"topic {TOPIC}: the scores of matcher {np.argmax(unusable) + 1} of {len(unusable)} have a "
            f"standard deviation of {deviations[unusable][0]:g}; remove the matcher or rescale it"
        )
    return deviations


RULES: dict[str, Callable[..., Floats]] = {
    "mean": np.nanmean,
    "sum": np.nansum,
    "product": np.nanprod,
    "minimum": np.nanmin,
    "maximum": np.nanmax,
    "median": np.nanmedian,
}


def all_pairs(users: int) -> Pairs:
    """Pair every probe with every gallery entry."""
    return Pairs(np.repeat(np.arange(users), users), np.tile(np.arange(users), users))


def trimmed_pairs(users: int, rng: np.random.Generator) -> Pairs:
    """Draw the paper's trimmed database: genuine pairs, and two random impostor probes per gallery user.

    The probes are the same for all matchers; different probes for each matcher would inflate the
    results.
    """
    gallery = np.repeat(np.arange(users), IMPOSTORS_PER_USER)
    step = np.argsort(rng.random((users, users - 1)), axis=1)[:, :IMPOSTORS_PER_USER] + 1
    impostor = (gallery + step.ravel()) % users
    return Pairs(
        np.concatenate([np.arange(users), impostor]), np.concatenate([np.arange(users), gallery])
    )


def user_folds(users: int, folds: int, rng: np.random.Generator) -> Integers:
    """Assign users to folds (users,); raise BadInput if a fold would have fewer than two users."""
    if users < 2 * folds:
        fewer = f", or at most {users // 2} folds" if users >= 4 else ""
        raise BadInput(
            f"{users} users are too few for {folds} folds; give at least {2 * folds} users{fewer}"
        )
    return rng.permutation(users) % folds


def cross_validate(
    vectors: Floats, pairs: Pairs, learner: Learner, limit: int, rng: np.random.Generator
) -> Floats:
    """Fuse scores (n,); the fusion of a pair is learned without the users in its gallery user's fold.

    Args:
        vectors: (n, m), for each pair the scores of m matchers.
        pairs: the users of each vector, and the folds of users.
        learner: fits a fusion to training vectors.
        limit: largest number of impostor vectors to learn from.
        rng: random number generator that selects these vectors.
    """
    fused = np.empty(len(vectors))
    genuine = pairs.probe == pairs.gallery
    assert pairs.fold is not None
    for fold in range(pairs.fold.max() + 1):
        judged = pairs.fold[pairs.gallery] == fold
        learnt = ~judged & (pairs.fold[pairs.probe] != fold)
        impostors = rng.permutation(np.flatnonzero(learnt & ~genuine))[:limit]
        rows = np.concatenate([np.flatnonzero(learnt & genuine), np.sort(impostors)])
        fused[judged] = learner(vectors[rows], genuine[rows], rng)(vectors[judged])
    return fused


def subsets_of(matchers: tuple[Matcher, ...]) -> dict[str, list[int]]:
    """List subsets: the matchers of a modality, the k-th of every modality, all, and single matchers.

    A subset of a single matcher has that matcher's name. The larger subsets are the paper's: M1, M2, R1,
    R2 and all.
    """
    by_modality: dict[str, list[int]] = {}
    for index, matcher in enumerate(matchers):
        by_modality.setdefault(matcher.modality, []).append(index)
    subsets = {name: indices for name, indices in by_modality.items() if len(indices) > 1}
    if len(by_modality) > 1:
        ranks = min(map(len, by_modality.values()))
        if ranks > 1:
            for rank in range(ranks):
                subsets[f"matcher-{rank + 1}"] = [of[rank] for of in by_modality.values()]
        subsets["all"] = list(range(len(matchers)))
    return subsets | {matcher.name: [index] for index, matcher in enumerate(matchers)}
