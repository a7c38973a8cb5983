"""Score fusion of all pairs of 517 users and four matchers, against scikit-learn's ROC."""

import numpy as np
from sklearn.metrics import roc_curve

from fuselog.replay.families.biometrics.pairs import RULES, normalise
from fuselog.replay.families.biometrics.verification import Floats, genuine_accept_at, roc
from tests.bench.timing import median_seconds

USERS, MATCHERS = 517, 4
FALSE_ACCEPT = 1e-3

Row = tuple[str, float, float, float]


def main() -> list[Row]:
    """Rows of (what, our time in ms, scikit-learn's, how many times faster); the rates must be equal."""
    rng = np.random.default_rng(0)
    same = np.eye(USERS, dtype=bool)
    scores = rng.normal(size=(USERS, USERS, MATCHERS)) + 2.0 * same[:, :, None]
    genuine = same.ravel()

    def fused() -> Floats:
        return RULES["mean"](normalise(scores, "column-min-max"), axis=2).ravel()

    mean = fused()

    def ours() -> float:
        return float(genuine_accept_at(roc(mean, genuine), FALSE_ACCEPT))

    def theirs() -> float:
        false_accept, accepted, _ = roc_curve(genuine, mean, drop_intermediate=False)
        return float(accepted[np.searchsorted(false_accept, FALSE_ACCEPT, side="right") - 1])

    assert ours() == theirs()
    fusion, curve, peer = (1000.0 * median_seconds(work) for work in (fused, ours, theirs))
    return [
        (f"ROC of {USERS}^2 pairs, ms; scikit-learn", curve, peer, peer / curve),
        (
            "mean fusion and ROC of the same, ms; at most 1000",
            fusion + curve,
            1000.0,
            1000.0 / (fusion + curve),
        ),
    ]
