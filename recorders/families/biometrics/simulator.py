"""Simulated scores of two face and two finger matchers, similar to NIST BSSR1 set 1.

A standard normal number per comparison is mapped to a score by a table of knots. Each normal number is
the sum of a term for the probe's user, a term for the gallery's user and a remainder. The tables were
fitted to the real scores.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeInt, PositiveFloat

from fuselog.recorders.families.biometrics.models import Matcher, score_stream
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
FAILURE = -1.0
MATCHERS = (
    Matcher(name="face-C", modality="face", failure=FAILURE),
    Matcher(name="face-G", modality="face"),
    Matcher(name="finger-left", modality="finger"),
    Matcher(name="finger-right", modality="finger"),
)
C, G, L, R = range(4)
FINGERS = (L, R)

GENUINE_Z = np.array([-3, -2.5, -2, -1.75, -1.5, -1.25, -1, -0.75, -0.5, 0, 0.5, 1, 1.5, 2, 2.5, 3])
IMPOSTOR_Z = np.arange(-4.5, 4.6, 0.5)


def _knots(text: str) -> Floats:
    return np.array(text.split(), float)


GENUINE_SCORES = (
    _knots(".521 .547 .575 .587 .602 .625 .645 .662 .683 .716 .755 .798 .826 .859 .876 .890"),
    _knots("65.6 66 69.8 72 72.9 73.7 74.3 74.9 75.7 77.1 78.2 79.4 80.5 81.8 82.8 83.5"),
    _knots("4.7 5 6 7 10 15.5 22.9 30 39 64 94 119.1 149.5 189 226.4 234.9"),
    _knots("3.7 5.2 8.7 12.6 18 26 37 47 56 82 107 135.5 171 201.3 227.8 245.9"),
)
IMPOSTOR_SCORES = (
    _knots(
        ".406 .418 .432 .446 .460 .473 .487 .501 .515 .530 .546 .563 .581 .599 .619 .641 .664 .692 .716"
    ),
    _knots("60.4 60.6 61.4 62 62.8 63.6 64.3 65 65.6 66.2 66.8 71.4 72.5 73.3 74.1 74.8 75.5 76.2 76.4"),
    _knots("0 0 0 0 3 3 4 5 5 7 8 10 12 15 19 23 29 33 39.6"),
    _knots("0 0 0 0 3 3 4 4 5 6 8 10 12 15 19 24 28 34 38.5"),
)
LOW_GALLERY_SCORES = _knots(
    "54.8 55 55.7 56.5 57.3 57.9 58.5 59.1 59.7 60.3 61.9 70.9 72.2 73 73.8 74.6 75.2 75.5 75.6"
)

# By matcher: variances of the parts of probe, gallery and remainder; corr(e_ij, e_ji).
PROBE_VARIANCE = np.array([0.11, 0.26, 0.15, 0.17])
GALLERY_VARIANCE = np.array([0.10, 0.08, 0.145, 0.175])
REST_VARIANCE = np.array([0.79, 0.66, 0.705, 0.655])
REST_SYMMETRY = np.array([0.39, 0.51, 0.18, 0.19])
REST_CORRELATION = {"CG": 0.41, "LR": 0.10}
OTHER_REST_CORRELATION = 0.01
REST_SPREAD = 0.25

# Correlations of a user's effects: g on the genuine score, a as a probe, b as a gallery entry.
USER_CORRELATION = {
    "gC gG": 0.74, "gC gL": -0.11, "gC gR": -0.04, "gG gL": -0.13, "gG gR": -0.06, "gL gR": 0.45,
    "gC aC": 0.11, "gG aG": 0.24, "gL aL": 0.37, "gR aR": 0.38, "gR aL": 0.22,
    "gC bC": 0.21, "gG bG": 0.07, "gL bL": 0.30, "gR bR": 0.40, "gL bR": 0.14, "gR bL": 0.21,
    "aC bC": 0.63, "aG bG": 0.13, "aL bL": 0.42, "aR bR": 0.48, "aC bG": 0.37, "aL bR": 0.24,
    "aR bL": 0.15, "aL aR": 0.33, "bL bR": 0.29, "bC bG": 0.37,
}  # fmt: skip
LOWEST = 0.1


class BiometricScoresParameters(Parameters):
    """Numbers of users, and of special users among them; the 517 real users define the defaults.

    Attributes:
        users: number of users.
        probe_interval_s: mean time between probes (exponential).
        failures_to_enrol: number of gallery users that the first face matcher fails to enrol.
        low_galleries: number of gallery users with low scores of the second face matcher.
        poor_fingers_share: share of the users with poor fingers.
        broken_probes: number of probes whose fingers match no user.
    """

    users: Annotated[int, Field(ge=20, le=5000)] = 517
    probe_interval_s: PositiveFloat = 1.0
    failures_to_enrol: NonNegativeInt = 1
    low_galleries: NonNegativeInt = 27
    poor_fingers_share: Annotated[float, Field(ge=0, le=LOWEST)] = 0.02
    broken_probes: NonNegativeInt = 2


class Users(NamedTuple):
    """Effects of each user on every matcher: standard normal numbers (users, matchers)."""

    genuine: Floats
    probe: Floats
    gallery: Floats


def simulate(parameters: BiometricScoresParameters, rng: np.random.Generator) -> Recording:
    """Record one run: probes arrive at random times and are compared with the whole gallery."""
    users = _users(parameters, rng)
    count = parameters.users
    scores = np.empty((count, count, len(MATCHERS)))
    impostor_z = _impostors(users, rng)
    low = rng.permutation(count)[: parameters.low_galleries]
    for matcher in range(len(MATCHERS)):
        z = impostor_z[:, :, matcher]
        scores[:, :, matcher] = np.interp(z, IMPOSTOR_Z, IMPOSTOR_SCORES[matcher])
        if matcher == G:
            scores[:, low, G] = np.interp(z[:, low], IMPOSTOR_Z, LOW_GALLERY_SCORES)
        genuine = np.interp(users.genuine[:, matcher], GENUINE_Z, GENUINE_SCORES[matcher])
        np.fill_diagonal(scores[:, :, matcher], genuine)
    for probe in rng.permutation(count)[: parameters.broken_probes]:
        scores[probe, :, R] = rng.binomial(8, 0.25, count)
        scores[probe, probe, R] = rng.integers(0, 13)
    scores[:, :, FINGERS] = np.rint(scores[:, :, FINGERS])
    scores[:, rng.permutation(count)[: parameters.failures_to_enrol], C] = FAILURE
    arrival_s = np.cumsum(rng.exponential(parameters.probe_interval_s, count))
    arrival_ns = simulation_stamps_ns(arrival_s)
    return Recording([score_stream(MATCHERS, scores, arrival_ns)])


def _users(parameters: BiometricScoresParameters, rng: np.random.Generator) -> Users:
    """Draw users' effects: a few users get poor fingers, others better ones, to keep the marginals."""
    from scipy.special import ndtr, ndtri  # slow to import

    effects = rng.multivariate_normal(np.zeros(12), _user_correlation(), parameters.users, method="eigh")
    genuine, probe, gallery = np.split(effects, 3, axis=1)
    share = parameters.poor_fingers_share
    quantile = ndtr(genuine[:, FINGERS])
    low = (LOWEST - share) / (1 - share)
    below = quantile * LOWEST / (low or 1.0)  # zero users at the greatest share
    others = np.where(quantile < low, below, LOWEST + (quantile - low) * (1 - share))
    poor = np.zeros((parameters.users, 1), bool)
    poor[rng.permutation(parameters.users)[: round(share * parameters.users)]] = True
    mixed = np.where(poor, rng.uniform(0, LOWEST, quantile.shape), others)
    genuine[:, FINGERS] = ndtri(mixed)
    return Users(genuine, probe, gallery)


def _impostors(users: Users, rng: np.random.Generator) -> Floats:
    """Draw standard normal numbers (users, users, matchers) of all comparisons, normalized by rank."""
    from scipy.special import ndtri  # slow to import

    count = len(users.probe)
    correlation = _rest_correlation()
    rest, other = (
        rng.multivariate_normal(np.zeros(4), correlation, (count, count), method="eigh") for _ in "12"
    )
    upper = np.triu_indices(count, 1)
    other[upper[1], upper[0]] = other[upper]
    rest = np.sqrt(1 - REST_SYMMETRY) * rest + np.sqrt(REST_SYMMETRY) * other
    variability = rng.normal(size=count)
    rest[:, :, : FINGERS[0]] *= np.exp(REST_SPREAD * (variability[:, None] + variability))[:, :, None]
    z = (
        np.sqrt(PROBE_VARIANCE) * users.probe[:, None]
        + np.sqrt(GALLERY_VARIANCE) * users.gallery
        + np.sqrt(REST_VARIANCE) * rest
    )
    different = ~np.eye(count, dtype=bool)
    ranks = np.argsort(np.argsort(z[different], axis=0), axis=0)  # from 0; no two numbers are equal
    z[different] = ndtri((ranks + 0.5) / len(ranks))
    return z


def _user_correlation() -> Floats:
    """Return the correlation (12, 12) of the users' effects, projected to be positive semidefinite."""
    names = [effect + matcher for effect in "gab" for matcher in "CGLR"]
    correlation = np.eye(len(names))
    for pair, value in USER_CORRELATION.items():
        row, column = (names.index(name) for name in pair.split())
        correlation[row, column] = correlation[column, row] = value
    values, vectors = np.linalg.eigh(correlation)
    projected = vectors * np.maximum(values, 0) @ vectors.T
    scale = np.sqrt(np.diag(projected))
    return projected / np.outer(scale, scale)


def _rest_correlation() -> Floats:
    """Compute the correlation (4, 4) of each of the remainder's two terms from that of their sum."""
    correlation = np.full((4, 4), OTHER_REST_CORRELATION)
    for pair, value in REST_CORRELATION.items():
        row, column = ("CGLR".index(name) for name in pair)
        correlation[row, column] = correlation[column, row] = value
    shared = np.sqrt(np.outer(REST_SYMMETRY, REST_SYMMETRY))
    own = np.sqrt(np.outer(1 - REST_SYMMETRY, 1 - REST_SYMMETRY))
    correlation /= shared + own
    np.fill_diagonal(correlation, 1.0)
    return correlation


BIOMETRIC_SCORES = Simulator(
    "two face and two finger matchers compare every probe with every user of a gallery",
    BiometricScoresParameters,
    simulate,
)
