"""Batch estimators that fuse biometric scores: rules, classifiers and mixture models.

Zheng & Blasch, "An exploration of the impacts of three factors in multimodal biometric score fusion",
JAIF 2014. Each estimator fuses subsets of the matchers (`subsets_of`), one case per subset, into the
stream `/estimates/NAME/CASE/fused`. An estimator that learns never scores users from its training data.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveInt
from threadpoolctl import threadpool_limits

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.extras import extra
from fuselog.recorders.families.biometrics.models import (
    TOPIC,
    Comparisons,
    Matcher,
    comparisons_of,
    matchers_of,
)
from fuselog.recorders.log import Stream, Topic, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import batch
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Booleans, Floats
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.families.biometrics.mixture_hmm import Fit, fit, log_likelihood
from fuselog.replay.families.biometrics.pairs import (
    RULES,
    Learner,
    Pairs,
    Scorer,
    all_pairs,
    cross_validate,
    normalise,
    subsets_of,
    trimmed_pairs,
    user_folds,
)

NEEDS = f"a stream {TOPIC} with score vectors of at least two matchers"
LEAST_PROBABILITY = 1e-300
LOG_LIKELIHOOD_RATIO = "log_likelihood_ratio"
LIKELIHOOD_RATIOS = ("qda", "lda", "logistic")


class Subsets(Parameters):
    """The subsets of matchers to fuse.

    Attributes:
        subsets: names of the subsets of matchers to fuse; all subsets if empty.
    """

    subsets: list[str] = []


class RuleParameters(Subsets):
    """Settings of the normalization and fusion of scores.

    Attributes:
        normalisation: normalization of scores over all comparisons or, for column-min-max, per gallery
            entry.
        rule: function that computes the fused score from the normalized scores.
    """

    normalisation: Literal["none", "z", "min-max", "tanh", "column-min-max"] = "column-min-max"
    rule: Literal["mean", "sum", "product", "minimum", "maximum", "median"] = "mean"


class LearnerParameters(Subsets):
    """Training data of a learned fusion, and the pairs of users that it scores.

    Attributes:
        seed: seed of the random folds and impostors.
        folds: number of folds of users for cross-validation.
        pairs: pairs to score: the paper's trimmed database (all genuine pairs and two random impostor
            pairs per user), or all pairs.
        failures: whether the scores of failed enrolments are kept, as in the paper, or treated as
            missing.
        logarithmic: modalities whose scores are replaced by log(1 + score).
        impostor_limit: largest number of impostor pairs in the training data.
    """

    seed: Annotated[int, Field(ge=0)] = 0
    folds: Annotated[int, Field(ge=2)] = 10
    pairs: Literal["trimmed", "all"] = "trimmed"
    failures: Literal["as-scored", "missing"] = "as-scored"
    logarithmic: list[str] = []
    impostor_limit: PositiveInt = 20_000


class ClassifierParameters(LearnerParameters):
    """A classifier of scikit-learn, and its training data.

    Attributes:
        classifier: name of the classifier.
        neighbours: number of neighbours of knn.
        calibrated: whether the output is calibrated by a logistic curve.
    """

    classifier: Literal["qda", "lda", "knn", "svm", "logistic"] = "qda"
    neighbours: PositiveInt = 3
    calibrated: bool = False


class MixtureParameters(LearnerParameters):
    """The model HMM(m, n, g): m matchers of each of n modalities, g Gaussians per state and class.

    Attributes:
        topology: transitions between states; joint is a single state whose vector has all scores.
        genuine_components: number of Gaussians per state in the model of genuine pairs.
        impostor_components: number of Gaussians per state in the model of impostor pairs.
        components_of: number of Gaussians per state by name of subset, instead of the two numbers above.
        covariance_floor: value added to the diagonal of every covariance, in squared z units.
        iterations: largest number of steps of expectation maximization.
        tolerance: increase of the log-likelihood below which expectation maximization ends.
    """

    topology: Literal["left-right", "ergodic", "joint"] = "left-right"
    genuine_components: PositiveInt = 3
    impostor_components: PositiveInt = 3
    components_of: dict[str, PositiveInt] = {}
    covariance_floor: NonNegativeFloat = 0.01
    iterations: PositiveInt = 20
    tolerance: NonNegativeFloat = 0.0


def learn_classifier(
    parameters: ClassifierParameters,
    vectors: Floats,
    genuine: Booleans,
    rng: np.random.Generator,
) -> Scorer:
    """Fit a classifier with genuine pairs as positive class; the mean replaces missing training scores.

    QDA, LDA, logistic regression and all calibrated classifiers compute a log-likelihood ratio for equal
    priors.

    Args:
        parameters: the classifier and its settings.
        vectors: the training scores (rows, matchers), in z units, NaN if missing.
        genuine: (rows,), whether each row compares two samples of the same user.
        rng: random number generator for classifiers that need them.

    Raises BadInput if the classifier cannot be fitted to these scores.
    """
    with extra("papers", f"classifier {parameters.classifier}"):
        from sklearn.calibration import CalibratedClassifierCV  # slow to import

    vectors = np.nan_to_num(vectors)
    model = _classifier(parameters, int(rng.integers(2**31)))
    if parameters.calibrated:
        model = CalibratedClassifierCV(model, method="sigmoid", cv=3)
    try:
        if parameters.classifier == "knn" and parameters.neighbours > len(vectors):
            raise ValueError(f"{parameters.neighbours} neighbours")
        model.fit(vectors, genuine)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise BadInput(
            f"classifier {parameters.classifier} cannot be fitted to {len(vectors)} score vectors "
            f"({error}); give more users, other matchers, or another classifier"
        ) from error
    if parameters.calibrated or parameters.classifier == "logistic":
        prior = np.log(genuine.sum() / (~genuine).sum())
        return lambda scores: _log_odds(model.predict_proba(np.nan_to_num(scores))) - prior
    if parameters.classifier == "knn":
        return lambda scores: model.predict_proba(np.nan_to_num(scores))[:, 1] - 0.5
    return lambda scores: model.decision_function(np.nan_to_num(scores))


def _log_odds(probabilities: Floats) -> Floats:
    """Compute the finite log odds of the second class from the probabilities (n, 2) of both classes."""
    logarithms = np.log(np.maximum(probabilities, LEAST_PROBABILITY))
    return logarithms[:, 1] - logarithms[:, 0]


def _classifier(parameters: ClassifierParameters, seed: int) -> Any:
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
    from sklearn.linear_model import LogisticRegression
    from sklearn.neighbors import KNeighborsClassifier
    from sklearn.svm import SVC

    match parameters.classifier:
        case "qda":
            return QuadraticDiscriminantAnalysis(priors=[0.5, 0.5])
        case "lda":
            return LinearDiscriminantAnalysis(priors=[0.5, 0.5])
        case "knn":
            return KNeighborsClassifier(parameters.neighbours)
        case "svm":
            return SVC(class_weight="balanced", random_state=seed)
    return LogisticRegression(max_iter=1000)


def learn_mixture(
    parameters: MixtureParameters,
    components: tuple[int, int],
    sequence: tuple[int, int],
    vectors: Floats,
    genuine: Booleans,
    rng: np.random.Generator,
) -> Scorer:
    """Fit the log-likelihood ratio of two HMMs, eq. 5 with eta 0.

    Args:
        parameters: settings of the fit.
        components: number of Gaussians per state of the genuine and of the impostor model.
        sequence: (n, m): each vector of n * m scores is a sequence of n vectors with m scores.
        vectors: the training scores, (rows, n * m).
        genuine: (rows,), whether each row compares two samples of the same user.
        rng: random number generator for k-means.
    """
    models = []
    for of_class, count in zip((genuine, ~genuine), components, strict=True):
        is_left_right = parameters.topology == "left-right"
        how = Fit(
            count,
            is_left_right,
            parameters.covariance_floor,
            parameters.iterations,
            parameters.tolerance,
        )
        models.append(fit(vectors[of_class].reshape(-1, *sequence), how, rng))
    same, other = models

    def ratio(scores: Floats) -> Floats:
        cut = scores.reshape(-1, *sequence)
        return log_likelihood(same, cut) - log_likelihood(other, cut)

    return ratio


def _by_rule(parameters: RuleParameters, compared: Comparisons, case: str, chosen: list[int]) -> Stream:
    values = normalise(compared.scores[:, :, chosen], parameters.normalisation)
    fused = RULES[parameters.rule](values, axis=2)
    return fused_stream(compared, all_pairs(len(fused)), fused.ravel(), {})


def _by_classifier(
    parameters: ClassifierParameters, compared: Comparisons, case: str, chosen: list[int]
) -> Stream:
    is_ratio = parameters.calibrated or parameters.classifier in LIKELIHOOD_RATIOS
    return _learnt(compared, chosen, parameters, partial(learn_classifier, parameters), is_ratio)


def _by_mixture(
    parameters: MixtureParameters, compared: Comparisons, case: str, chosen: list[int]
) -> Stream:
    sequence = _sequence(compared.matchers, chosen, parameters)
    both = parameters.components_of.get(case)
    components = (both or parameters.genuine_components, both or parameters.impostor_components)
    learner = partial(learn_mixture, parameters, components, sequence)
    return _learnt(compared, chosen, parameters, learner, True)


def _sequence(
    matchers: tuple[Matcher, ...], chosen: list[int], parameters: MixtureParameters
) -> tuple[int, int]:
    """Return (n, m) of a subset; raise BadInput if modalities have different numbers of matchers."""
    modalities = [matchers[index].modality for index in chosen]
    counts = {modalities.count(each) for each in modalities}
    if parameters.topology == "joint":
        return 1, len(chosen)
    if len(counts) > 1:
        raise BadInput(
            f"{', '.join(modalities)}: an HMM needs the same number of matchers for every modality; "
            'choose another subset, or topology = "joint"'
        )
    return len(chosen) // counts.pop(), modalities.count(modalities[0])


def _learnt(
    compared: Comparisons,
    chosen: list[int],
    parameters: LearnerParameters,
    learner: Learner,
    is_ratio: bool,
) -> Stream:
    """Fuse the chosen matchers with cross-validation."""
    users = len(compared.scores)
    rng = np.random.default_rng(parameters.seed)
    fold = user_folds(users, parameters.folds, rng)
    chosen_pairs = trimmed_pairs(users, rng) if parameters.pairs == "trimmed" else all_pairs(users)
    pairs = chosen_pairs._replace(fold=fold)
    scores = _prepared(compared, parameters)[:, :, chosen]
    vectors = scores[pairs.probe, pairs.gallery]
    with extra("papers", "a learnt fusion"):
        import sklearn.cluster  # noqa: F401  # only libraries that are loaded are limited below
    # these problems are small; on a busy machine, threads of the libraries would only wait for each
    # other
    with threadpool_limits(1):
        fused = cross_validate(vectors, pairs, learner, parameters.impostor_limit, rng)
    metadata = {"fold_of_user": ",".join(map(str, fold)), "threshold": "0"}
    if is_ratio:
        metadata["components"] = LOG_LIKELIHOOD_RATIO
    return fused_stream(compared, pairs, fused, metadata)


def _prepared(compared: Comparisons, parameters: LearnerParameters) -> Floats:
    """Return z-normalized scores (users, users, matchers); for some modalities, log scores are used."""
    scores = compared.scores
    if parameters.failures == "missing":
        scores = np.where(compared.failed, np.nan, scores)
    known = {matcher.modality for matcher in compared.matchers}
    for name in parameters.logarithmic:
        if name not in known:
            raise BadInput(f"logarithmic: no modality '{name}'; {choices(name, known)}")
    of_logarithm = [matcher.modality in parameters.logarithmic for matcher in compared.matchers]
    if np.nanmin(scores[:, :, of_logarithm], initial=0.0) < 0:
        raise BadInput(
            f"logarithmic: {', '.join(parameters.logarithmic)} has negative scores; leave it out"
        )
    shifted = np.where(of_logarithm, scores, 0.0)
    return normalise(np.where(of_logarithm, np.log1p(shifted), scores), "z")


def fused_stream(
    compared: Comparisons, pairs: Pairs, fused: Floats, metadata: Mapping[str, str]
) -> Stream:
    """Make a stream of fused scores as score vectors with one component, in arrival order.

    Args:
        compared: the comparisons, which state the arrival times of the probes.
        pairs: the n pairs that were fused.
        fused: (n,), the fused scores of the pairs.
        metadata: metadata of the channel in addition to its component.
    """
    order = np.lexsort((pairs.gallery, pairs.probe, compared.arrival_ns[pairs.probe]))
    return make_stream(
        "",
        schemas.SCORE_VECTOR,
        compared.arrival_ns[pairs.probe[order]],
        metadata={"components": "score", **metadata},
        probe_id=pairs.probe[order],
        gallery_id=pairs.gallery[order],
        scores=fused[order, None],
    )


def _find(name: str, topics: Mapping[str, Topic], parameters: Subsets) -> Iterator[Binding]:
    """Find the scores and, by case, the matchers to fuse; yield nothing if the log has no scores."""
    if TOPIC not in topics or topics[TOPIC].schema_name != schemas.SCORE_VECTOR.full_name:
        return
    subsets = subsets_of(matchers_of(topics[TOPIC].metadata))
    for case in (*parameters.subsets, *getattr(parameters, "components_of", ())):
        if case not in subsets:
            raise BadInput(f"estimator {name}: no subset '{case}' of matchers; {choices(case, subsets)}")
    cases = parameters.subsets or [case for case, chosen in subsets.items() if len(chosen) > 1]
    if cases:
        yield Binding({TOPIC: topics[TOPIC]}, setup={case: subsets[case] for case in cases})


def _solve(fuse: Callable[..., Stream], given: Given[Any]) -> list[Ragged]:
    """Fuse all chosen subsets of matchers."""
    compared = [comparisons_of(given[TOPIC].of_run(run)) for run in range(given.runs)]
    users = {len(each.scores) for each in compared}
    if len(users) > 1:
        raise BadInput(
            f"topic {TOPIC}: the logs have {min(users)} to {max(users)} users; replay them separately"
        )

    def fused(case: str, chosen: list[int]) -> Ragged:
        topic = f"/estimates/{given.name}/{case}/fused"
        found = (fuse(given.parameters, each, case, chosen) for each in compared)
        return gather([replace(each, topic=topic) for each in found])

    return [fused(case, chosen) for case, chosen in given.setup.items()]


_fusing = partial(batch, find=_find, requirements=NEEDS)
RULE = _fusing(
    "scores normalized and combined by a rule",
    parameters=RuleParameters,
    variant="rule",
    solve=partial(_solve, _by_rule),
)
CLASSIFIER = _fusing(
    "classifier of score vectors, cross-validated by user",
    parameters=ClassifierParameters,
    variant="classifier",
    solve=partial(_solve, _by_classifier),
)
MIXTURE = _fusing(
    "likelihood ratio of HMMs with Gaussian mixtures, cross-validated by user",
    parameters=MixtureParameters,
    variant="topology",
    solve=partial(_solve, _by_mixture),
)
