"""Score fusion against exact counts, closed forms and an independent mixture; and its evaluation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from fuselog.pipeline.families.biometrics.study import PAPER_FUSED, SINGLE
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.pipeline.runs.recorded import replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import import_run, record_run
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.families.biometrics.estimators import ClassifierParameters, learn_classifier
from fuselog.replay.families.biometrics.mixture_hmm import Fit, MixtureHmm, fit, log_likelihood
from fuselog.replay.families.biometrics.pairs import (
    RULES,
    all_pairs,
    cross_validate,
    normalise,
    trimmed_pairs,
    user_folds,
)
from fuselog.replay.families.biometrics.verification import (
    Fused,
    _rates,
    bootstrap_users,
    cost_of_ratio,
    equal_error_rate,
    genuine_accept_at,
    relative_rate_increase,
    roc,
    verification_rate,
)
from fuselog.replay.judging.metrics.measuring import find_metrics, measure
from tests.replay.engine.processes import printed

pytestmark = pytest.mark.paper

# Mean and standard deviation over seeds, of the specification; cases as in PAPER_FUSED.
TRIMMED = {
    "qda": ((94.15, 97.36, 97.16, 99.27, 99.12), (0.55, 0.33, 0.21, 0.21, 0.22)),
    "knn": ((96.96, 96.87, 99.27, 99.55, 99.72), (0.41, 0.31, 0.13, 0.11, 0.07)),
    "hmm": ((97.31, 97.97, 99.05, 99.60, 99.68), (0.37, 0.23, 0.13, 0.06, 0.13)),
}


@pytest.fixture(scope="module")
def bssr1(real_data, tmp_path_factory):
    import tarfile

    folder = tmp_path_factory.mktemp("bssr1")
    with tarfile.open(real_data / "bssr1_set1.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    parameters = load_experiment("biometrics-bssr1", {}, {})[1].import_.parameters
    return memory_source(*import_run("score-matrices", folder / "bssr1", parameters))


def values_of(source, *labels, **changes):
    """Metrics of fusions of the shipped experiment."""
    settings = load_experiment("biometrics-bssr1", {}, {})[1].estimators
    chosen = {label: {**settings[label], **changes} for label in labels}
    replayed = replay_ensemble([source], chosen, gap_limit_s=1)
    return measure(replayed.judged, find_metrics(["verification"]))


def test_real_counts_and_verification_rates_are_exact(bssr1):
    """Any slip in reading, ties, normalisation or ROC moves one of these numbers."""
    values = values_of(bssr1, "single", "mean", "z-sum")
    [real, *_] = load_experiment("biometrics-simulated", {}, {})[1].claims
    assert len(real.each["of"]) == 9
    for row in real.each["of"]:
        assert values["{label}.identified_users.{case}".format_map(row)] == row["real"]
    z_counts = [values[f"z-sum.identified_users.{case}"] for case in PAPER_FUSED["mean"]]
    assert z_counts == [470, 494, 492, 511, 515]
    expected = {
        "single.face-C": (74.27, 83.95, 91.49, 4.45),
        "single.face-G": (68.28, 77.76, 89.17, 5.80),
        "single.finger-left": (76.98, 83.17, 87.43, 8.51),
        "single.finger-right": (85.30, 89.94, 92.65, 5.04),
        "z-sum.all": (96.71, 98.45, 99.81, 0.43),
    }
    names = [f"gar_at_far_{far}_percent" for far in ("0p01", "0p1", "1")] + ["eer_percent"]
    for key, rates in expected.items():
        label, case = key.split(".")
        ours = [values[f"{label}.{name}.{case}"] for name in names]
        np.testing.assert_allclose(ours, rates, atol=0.0051)


@pytest.mark.parametrize("label", TRIMMED)
def test_cross_validated_rates_are_within_three_standard_deviations(bssr1, label):
    """Seed 0. Per-matcher impostors, empirical priors or leaking users are further off than that."""
    values = values_of(bssr1, label)
    means, spreads = TRIMMED[label]
    for case, mean, spread in zip(PAPER_FUSED[label], means, spreads, strict=True):
        assert abs(values[f"{label}.verification_rate_percent.{case}"] - mean) <= 3 * spread, case


def test_logistic_likelihood_ratios_of_all_pairs(bssr1):
    """Calibrated with the failure to enrol as missing: Cllr .0119, GAR 97.87 at FAR .01 %."""
    values = values_of(bssr1, "logistic")
    assert abs(values["logistic.gar_at_far_0p01_percent.all"] - 97.87) <= 0.6
    assert abs(values["logistic.gar_at_far_0p1_percent.all"] - 99.61) <= 0.6
    assert 0.0119 / 2 <= values["logistic.cllr_bits.all"] <= 0.0119 * 2


def test_relative_rate_increase_of_the_printed_rates():
    """Table 3b, M1: mean, LDA, KNN, HMM; Table 2b: all four matchers."""
    for case, singles, expected in (
        ("face", ("face-C", "face-G"), (0.2845, 0.5811, 0.7713, 0.8053)),
        ("all", tuple(SINGLE), (0.9671, 0.9240, 0.9620, 0.9730)),
    ):
        rates = [SINGLE[name] / 100 for name in singles]
        ours = [relative_rate_increase(of[case] / 100, rates)[1] for of in PAPER_FUSED.values()]
        np.testing.assert_allclose(ours, expected, atol=1.01e-4)


def test_one_state_is_a_gaussian_mixture():
    """Started alike, Baum-Welch with one state reaches scikit-learn's mixture."""
    from sklearn.mixture import GaussianMixture  # slow to import

    rng = np.random.default_rng(5)
    vectors = np.concatenate([rng.normal(size=(300, 2)), rng.normal(4, 2, size=(200, 2))])
    model = fit(vectors[:, None], Fit(2, False, 1e-6, 2000, 1e-10), rng)
    peer = GaussianMixture(2, reg_covar=1e-6, tol=1e-10, max_iter=2000, random_state=0).fit(vectors)
    ours = log_likelihood(model, vectors[:, None])
    np.testing.assert_allclose(ours, peer.score_samples(vectors), atol=1e-3)


def test_left_to_right_is_a_product_of_mixtures_of_its_vectors():
    rng = np.random.default_rng(6)
    sequences = rng.normal(size=(400, 2, 2)) * [[1.0], [3.0]]
    how = Fit(1, True, 0.0, 5, 0.0)
    both = log_likelihood(fit(sequences, how, rng), sequences)
    single = sum(
        multivariate_normal(part.mean(axis=0), np.cov(part.T, ddof=0)).logpdf(part)
        for part in (sequences[:, 0], sequences[:, 1])
    )
    np.testing.assert_allclose(both, single, rtol=1e-9)


def test_the_forward_recursion_sums_over_all_paths_and_missing_scores_integrate_out():
    """Three states, two vectors: against the sum of all nine paths written out."""
    rng = np.random.default_rng(7)
    means = rng.normal(size=(3, 1, 2))
    model = MixtureHmm(
        rng.dirichlet(np.ones(3)),
        rng.dirichlet(np.ones(3), 3),
        np.ones((3, 1)),
        means,
        np.broadcast_to(np.array([[2.0, 0.5], [0.5, 1.0]]), (3, 1, 2, 2)),
    )
    sequence = np.array([[[0.3, np.nan], [1.0, -1.0]]])
    first = [np.exp(-((0.3 - m[0, 0]) ** 2) / 4) / np.sqrt(4 * np.pi) for m in means]
    second = [multivariate_normal(m[0], model.covariances[0, 0]).pdf([1.0, -1.0]) for m in means]
    total = (model.initial * first) @ model.transition @ second
    np.testing.assert_allclose(log_likelihood(model, sequence), np.log(total))


def test_a_vector_of_which_all_is_missing_says_nothing():
    model = MixtureHmm(
        np.ones(1), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1))
    )
    found = log_likelihood(model, np.array([[[np.nan]], [[1.0]]]))
    np.testing.assert_allclose(found, [0.0, -0.5 - 0.5 * np.log(2.0 * np.pi)])


def test_whole_numbers_halfway_between_two_means_do_not_hang_on_rounding():
    """Of scores that are few whole numbers many are as near to one mean of the start as to another."""
    how, scores = Fit(3, True, 0.01, 3, 0.0), np.random.default_rng(1).integers(0, 7, (200, 1, 1))
    for seed in range(20):
        fitted = [
            fit(scores * scale, how, np.random.default_rng(seed)).means
            for scale in (1.0 / 3.0, (1.0 + 1e-15) / 3.0, (1.0 - 1e-15) / 3.0)
        ]
        np.testing.assert_allclose(fitted[1:], fitted[:1] * 2, rtol=1e-9)


LEARNT_WITH = """
import numpy as np
from threadpoolctl import threadpool_info
from fuselog.recorders.families.biometrics.models import Comparisons, Matcher
from fuselog.replay.families.biometrics import estimators as biometrics

def threads(vectors, *_):
    print(*(each["num_threads"] for each in threadpool_info() if each["user_api"] == "openmp"))
    return np.zeros(len(vectors))

biometrics.cross_validate = threads
scores = np.random.default_rng(0).normal(size=(20, 20, 1))
matchers = (Matcher(name="a", modality="face", score="similarity"),)
compared = Comparisons(matchers, scores, np.zeros(scores.shape, bool), np.zeros(20, np.int64))
biometrics._learnt(compared, [0], biometrics.ClassifierParameters(), None, True)
"""


@pytest.mark.paper
def test_a_process_learns_by_one_thread_from_the_first_time_on(tmp_path):
    """Scikit-learn brings its threads when it is imported: who limits them before limits nothing."""
    [said] = printed([LEARNT_WITH], tmp_path, {}, "ignore")
    assert {*said.split()} == {"1"}


def test_ergodic_likelihood_never_falls():
    """More steps of Baum-Welch without a floor cannot be worse."""
    rng = np.random.default_rng(8)
    sequences = rng.normal(size=(300, 2, 1)) + rng.integers(0, 2, (300, 1, 1)) * 3
    means = [
        log_likelihood(
            fit(sequences, Fit(2, False, 0.0, steps, -np.inf), np.random.default_rng(0)), sequences
        ).mean()
        for steps in range(1, 8)
    ]
    assert np.all(np.diff(means) > -1e-12)


@settings(max_examples=20)
@given(st.integers(20, 80), st.integers(0, 2**32))
def test_trimmed_pairs_are_one_genuine_and_two_different_impostors_per_user(users, seed):
    pairs = trimmed_pairs(users, np.random.default_rng(seed))
    assert np.array_equal(pairs.probe[:users], pairs.gallery[:users])
    impostors = pairs.probe[users:].reshape(users, 2)
    assert np.all(impostors != np.arange(users)[:, None])
    assert np.all(impostors[:, 0] != impostors[:, 1])


@given(st.integers(12, 25), st.integers(2, 5), st.integers(0, 2**32))
def test_nothing_is_learnt_from_the_users_who_are_judged(users, folds, seed):
    """Neither as a probe nor as a gallery entry; every comparison is judged, by its gallery's fold."""
    rng = np.random.default_rng(seed)
    fold = user_folds(users, folds, rng)
    pairs = all_pairs(users)._replace(fold=fold)
    vectors = np.stack([pairs.probe, pairs.gallery], axis=1).astype(float)

    def learner(learnt, genuine, _):
        known = learnt.astype(int)
        assert np.array_equal(genuine, known[:, 0] == known[:, 1])
        assert np.count_nonzero(~genuine) == min(30, (~genuine).sum())
        assert len(np.unique(known, axis=0)) == len(known)

        def score(judged):
            (number,) = set(fold[judged[:, 1].astype(int)])
            assert number not in fold[known]
            return judged @ [1000.0, 1.0]

        return score

    fused = cross_validate(vectors, pairs, learner, 30, rng)
    np.testing.assert_array_equal(fused, vectors @ [1000.0, 1.0])


def test_column_min_max_makes_a_failed_column_zero_and_every_other_span_the_unit():
    scores = np.random.default_rng(1).normal(size=(6, 6, 1))
    scores[:, 2] = -1
    scaled = normalise(scores, "column-min-max")
    assert np.all(scaled[:, 2] == 0)
    others = np.delete(scaled, 2, axis=1)
    assert np.all(others.min(axis=0) == 0)
    assert np.all(others.max(axis=0) == 1)


def test_roc_of_tied_scores_by_hand():
    """Ties are accepted together: no threshold lies between equal scores."""
    score = np.array([3.0, 2.0, 2.0, 1.0, 1.0, 0.0])
    genuine = np.array([True, True, False, True, False, False])
    curve = roc(score, genuine)
    np.testing.assert_allclose(curve.false_accept, [0, 0, 1 / 3, 2 / 3, 1])
    np.testing.assert_allclose(curve.genuine_accept, [0, 1 / 3, 2 / 3, 1, 1])
    assert genuine_accept_at(curve, 0.5) == pytest.approx(2 / 3)
    assert genuine_accept_at(curve, curve.false_accept[3]) == 1.0, "a rate that is met is not above"
    assert equal_error_rate(curve) == pytest.approx(1 / 3)
    assert cost_of_ratio(np.zeros(6), genuine) == pytest.approx(1.0)


def test_fusions_of_some_pairs_and_of_all_share_their_error_rates():
    """Of 100 impostors 1 is above 3 of 4 genuine pairs: 1 % of false matches costs one of these."""
    users = np.arange(101)
    probe = np.concatenate([users[:4], users[1:]])
    gallery = np.concatenate([users[:4], np.zeros(100, int)])
    score = np.concatenate([[9.0, 8.0, 7.0, 2.0], [8.5], np.linspace(3.0, 0.0, 99)])
    found = _rates(Fused(score, probe, gallery, None, 0.0, False))
    assert found["fnmr_at_fmr_1_percent"] == 25.0
    assert "fnmr_at_fmr_0p1_percent" not in found  # 100 do not tell one in 1000
    assert found["eer_percent"] == pytest.approx(25.0)
    pairs = np.indices((20, 20)).reshape(2, -1)
    complete = _rates(Fused(1.0 * (pairs[0] == pairs[1]), *pairs, None, None, False))
    assert complete["eer_percent"] == complete["fnmr_at_fmr_1_percent"] == 0.0
    assert complete["gar_at_far_1_percent"] == 100.0


def test_bootstrap_covers_the_rate_of_independent_users():
    """GAR of n users has the binomial's standard deviation; drawing pairs would make it smaller."""
    rng = np.random.default_rng(2)
    users = 120
    probe, gallery = np.divmod(np.arange(users**2), users)
    score = rng.normal(size=users**2) + 3.0 * (probe == gallery)
    drawn = bootstrap_users(Fused(score, probe, gallery, None, None, True), 200, rng)[:, 2]
    rate = genuine_accept_at(roc(score, probe == gallery), 0.01)
    assert drawn.std() == pytest.approx(np.sqrt(rate * (1 - rate) / users), rel=0.35)


def test_verification_rate_is_the_mean_of_the_folds():
    score, user = np.array([1.0, -1.0, 1.0]), np.array([0, 1, 2])
    fused = Fused(score, user, user, np.array([0, 0, 1]), 0.0, True)
    assert verification_rate(fused) == pytest.approx(0.75)
    tied = Fused(np.full(3, 0.5), user, user[::-1], None, 0.5, True)
    assert verification_rate(tied) == pytest.approx(2 / 3), "at the threshold is not above it"


def test_normalisations_and_rules_by_hand():
    """One slip in a scale, an axis or a missing score changes these."""
    scores = np.array([[[0.0, 10.0], [1.0, np.nan]], [[2.0, 30.0], [5.0, 20.0]]])
    deviation = np.sqrt(((np.array([0, 1, 2, 5]) - 2.0) ** 2).sum() / 3)
    z = normalise(scores, "z")
    np.testing.assert_allclose(z[:, :, 0], (scores[:, :, 0] - 2) / deviation)
    np.testing.assert_allclose(normalise(scores, "tanh"), 0.5 * (np.tanh(0.01 * z) + 1))
    np.testing.assert_allclose(normalise(scores, "min-max")[:, :, 1], [[0, np.nan], [1, 0.5]])
    np.testing.assert_allclose(normalise(scores, "column-min-max")[:, :, 0], [[0, 0], [1, 1]])
    fused = {name: rule(scores, axis=2) for name, rule in RULES.items()}
    assert {name: values[1, 0] for name, values in fused.items()} == {
        "mean": 16.0, "sum": 32.0, "product": 60.0, "minimum": 2.0, "maximum": 30.0, "median": 16.0,
    }  # fmt: skip
    assert all(values[0, 1] == 1.0 for values in fused.values()), "a missing score counts for nothing"


@pytest.mark.parametrize(
    ("classifier", "calibrated"),
    [
        ("qda", False),
        ("lda", False),
        ("logistic", False),
        ("svm", True),
        ("knn", True),
        ("lda", True),
    ],
)
def test_classifiers_find_the_likelihood_ratio_of_gaussians(classifier, calibrated):
    """Two Gaussians of one covariance: log ratio 2 x - 2 by hand, whatever the shares of the classes.

    A calibration that keeps the prior of 1 : 4 in it would be off by 1.4.
    """
    rng = np.random.default_rng(3)
    count = 2000 if classifier == "svm" else 5000  # whose time grows with the square
    genuine = np.arange(count) % 5 == 0
    vectors = rng.normal(size=(count, 1)) + 2.0 * genuine[:, None]
    parameters = ClassifierParameters(classifier=classifier, calibrated=calibrated, neighbours=151)
    score = learn_classifier(parameters, vectors, genuine, rng)
    at = np.array([[0.3], [1.0], [1.7]])
    tolerance = 0.3 if classifier in ("qda", "lda", "logistic") else 0.9  # outputs that are not straight
    np.testing.assert_allclose(score(at), 2 * at[:, 0] - 2, atol=tolerance)


def test_too_few_users_for_the_folds_and_unknown_subsets_are_refused():
    source = memory_source(*record_run("biometric-scores", {"users": 20, "low_galleries": 1}, 0))
    with pytest.raises(
        BadInput, match="20 users are too few for 11 folds; give at least 22 users, or at most 10 folds"
    ):
        user_folds(20, 11, np.random.default_rng(0))
    with pytest.raises(BadInput, match="no subset 'fase' of matchers; did you mean 'face'"):
        replay_ensemble([source], {"score-rule": {"subsets": ["fase"]}}, gap_limit_s=1)
    with pytest.raises(BadInput, match="give more users or fewer components"):
        replay_ensemble([source], {"score-mixture": {"genuine_components": 19}}, gap_limit_s=1)
    with pytest.raises(BadInput, match="no subset 'al' of matchers; did you mean 'all'"):
        replay_ensemble([source], {"score-mixture": {"components_of": {"al": 2}}}, gap_limit_s=1)


def test_runs_of_different_users_are_refused():
    """The folds stand in the metadata of the topic, which all runs share."""
    settings = ({"users": users, "low_galleries": 1} for users in (20, 30))
    sources = [memory_source(*record_run("biometric-scores", each, 0)) for each in settings]
    with pytest.raises(BadInput, match="the logs have 20 to 30 users; replay them separately"):
        replay_ensemble(sources, {"score-rule": {}}, gap_limit_s=1)


def test_scores_that_cannot_be_scaled_or_learnt_from_are_refused_in_words():
    with pytest.raises(BadInput, match="matcher 2 of 2 have a standard deviation of 0"):
        normalise(np.arange(18.0).reshape(3, 3, 2) * [1, 0], "z")
    with pytest.raises(BadInput, match="matcher 1 of 1 have a standard deviation of inf"):
        normalise(1e300 * np.arange(9.0).reshape(3, 3, 1), "tanh")
    rng = np.random.default_rng(0)
    alike = np.repeat(rng.normal(size=(30, 1)), 2, axis=1)
    for parameters in (ClassifierParameters(), ClassifierParameters(classifier="knn", neighbours=31)):
        with pytest.raises(BadInput, match="cannot be fitted to 30 score vectors"):
            learn_classifier(parameters, alike, np.arange(30) < 15, rng)


def test_a_fusion_of_two_runs_is_that_of_each():
    """The engine's promise: ensemble and single results are equal bit for bit."""
    settings = {"users": 40, "low_galleries": 1}
    sources = [memory_source(*record_run("biometric-scores", settings, 0, run)) for run in range(2)]
    estimators = {"score-mixture": {"subsets": ["face"]}, "score-rule": {"subsets": ["all"]}}
    together = replay_ensemble(sources, estimators, gap_limit_s=1).outputs
    for run, source in enumerate(sources):
        for topic, alone in replay_ensemble([source], estimators, gap_limit_s=1).outputs.items():
            for name, column in alone.stream.columns.items():
                np.testing.assert_array_equal(together[topic].of_run(run)[name], column)
