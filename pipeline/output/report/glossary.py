"""The glossary at the end of a page, with two sentences and a link for each word."""

import re
from typing import NamedTuple

from fuselog.replay.judging.intervals import FEWEST_RUNS


class Term(NamedTuple):
    """A word, its meaning, and a page about it."""

    name: str
    meaning: str
    link: str = ""


_WIKI = "https://en.wikipedia.org/wiki"
# By a pattern of the quantities that need the word.
_TERMS = {
    "rmse": Term(
        "RMS error",
        "Root mean square: the typical distance from the truth. Large errors count more than small "
        "ones.",
        f"{_WIKI}/Root_mean_square_deviation",
    ),
    "nees": Term(
        "NEES",
        "Normalised estimation error squared: the squared error, normalised by the covariance that the "
        "estimator claims. Its expected value is the number of components of the state; a larger value "
        "means overconfident, a smaller one conservative.",
        f"{_WIKI}/Mahalanobis_distance",
    ),
    "^nis": Term(
        "NIS",
        "Normalised innovation squared: the squared difference between measured and predicted values, "
        "normalised by the covariance that the filter predicts. It needs no truth; 1 per component is "
        "ideal.",
        f"{_WIKI}/Innovation_(signal_processing)",
    ),
    "": Term(
        "95 % from ... to ...",
        "The range that contains the true value with 95 % confidence. The unit is a run, because errors "
        f"within a run are correlated. Fewer than {FEWEST_RUNS} runs give no interval.",
        f"{_WIKI}/Bootstrapping_(statistics)",
    ),
    "tie": Term(
        "Tie",
        "Two estimators that cannot be distinguished with these runs: chance explains the difference, "
        "or it is less than 2 %. Take the simpler one, or make more runs.",
        f"{_WIKI}/Paired_difference_test",
    ),
    "^log_likelihood$": Term(
        "Log-likelihood",
        "The logarithm of the probability density that the filter assigned to the measurements before "
        "using them. Higher is better; its absolute value has no meaning.",
        f"{_WIKI}/Likelihood_function",
    ),
    "gospa": Term(
        "GOSPA",
        "Generalised optimal sub-pattern assignment: the distances to the detected targets, plus a "
        "penalty for each missed or false one. Lower is better.",
        "https://arxiv.org/abs/1601.05585",
    ),
    "hota": Term(
        "HOTA",
        "Higher order tracking accuracy: combines how well targets are detected and how long each keeps "
        "its identity. 1 is best.",
        "https://arxiv.org/abs/2009.07736",
    ),
    "idf1": Term(
        "IDF1",
        "The share of detections with the correct identity; missed and false detections count as "
        "errors. 1 is best.",
        "https://arxiv.org/abs/1609.01775",
    ),
    "^gated_share$": Term(
        "Gate",
        "A filter rejects measurements that are too unlikely. A few rejections are expected; many mean "
        "that the measurement noise is understated or the measurements are wrong.",
        "https://stonesoup.readthedocs.io/en/latest/stonesoup.gater.html",
    ),
}


def glossary(keys: set[str], *, draws: bool) -> list[Term]:
    """Select the entries for a page with these quantities; `draws` adds the entry on ties."""
    return [
        term
        for pattern, term in _TERMS.items()
        if (draws if pattern == "tie" else any(re.search(pattern, key) for key in keys))
    ]
