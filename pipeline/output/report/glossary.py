"""Glossary at the end of a page: two sentences per word, and a link for further reading."""

from typing import NamedTuple

from fuselog.replay.judging.intervals import FEWEST_RUNS


class Term(NamedTuple):
    """A word, its meaning, and a page about it."""

    name: str
    meaning: str
    link: str = ""


_WIKI = "https://en.wikipedia.org/wiki"
_TERMS = {
    "rmse": Term(
        "RMS error",
        "Root mean square: the typical distance from the truth. Large errors weigh more than small.",
        f"{_WIKI}/Root_mean_square_deviation",
    ),
    "nees": Term(
        "NEES",
        "Normalised estimation error squared: the true error over the one that the estimator claims, "
        "squared and summed over the state's components. Their number is right; above, the estimator is "
        "overconfident, below conservative.",
        f"{_WIKI}/Mahalanobis_distance",
    ),
    "nis": Term(
        "NIS",
        "Normalised innovation squared: how far measurements lie from what the filter expected, over "
        "what it allowed for. It needs no truth; 1 per component is right.",
        f"{_WIKI}/Innovation_(signal_processing)",
    ),
    "interval": Term(
        "95 % from ... to ...",
        "Where the value lies with 95 % if other runs were made. A run is the unit: errors within one "
        f"hang together. Fewer than {FEWEST_RUNS} runs have no interval.",
        f"{_WIKI}/Bootstrapping_(statistics)",
    ),
    "tie": Term(
        "Tie",
        "Two estimators that cannot be told apart on these runs: chance explains the difference, or it "
        "is less than 2 %. Take the simpler one, or make more runs.",
        f"{_WIKI}/Paired_difference_test",
    ),
    "likelihood": Term(
        "Log-likelihood",
        "How probable the measurements were to the filter before it saw them. Higher is better; zero "
        "means nothing.",
        f"{_WIKI}/Likelihood_function",
    ),
    "gospa": Term(
        "GOSPA",
        "Generalised optimal sub-pattern assignment: distances to the targets that were found, and a "
        "penalty for each that was missed or is false. Less is better.",
        "https://arxiv.org/abs/1601.05585",
    ),
    "hota": Term(
        "HOTA",
        "Higher order tracking accuracy: how well targets are found, and how long each keeps its "
        "identity, in one number. 1 is best.",
        "https://arxiv.org/abs/2009.07736",
    ),
    "idf1": Term(
        "IDF1",
        "The share of detections that bear the right identity, missed and false ones counted; 1 is "
        "best.",
        "https://arxiv.org/abs/1609.01775",
    ),
    "gate": Term(
        "Gate",
        "A filter leaves out a measurement that is too unlikely for it. Few are expected; many say that "
        "its noise is stated too small, or the measurement is wrong.",
        "https://stonesoup.readthedocs.io/en/latest/stonesoup.gater.html",
    ),
}


def glossary(keys: set[str], *, draws: bool) -> list[Term]:
    """Select the entries for a page with these quantities; `draws` adds the entry on ties."""
    needed = {
        "rmse": any("rmse" in key for key in keys),
        "nees": any("nees" in key for key in keys),
        "nis": any(key.startswith("nis") for key in keys),
        "interval": bool(keys),
        "tie": draws,
        "likelihood": "log_likelihood" in keys,
        "gospa": any("gospa" in key for key in keys),
        "hota": any("hota" in key for key in keys),
        "idf1": any("idf1" in key for key in keys),
        "gate": "gated_share" in keys,
    }
    return [term for name, term in _TERMS.items() if needed[name]]
