"""Hidden Markov models with Gaussian mixtures, fitted to many short sequences by Baum-Welch.

Zheng & Blasch, JAIF 2014, 3.2: HMM(m, n, g) models a sequence of n vectors of m scores; every state has
a mixture of g Gaussians. A model with one state is a mixture; a left-to-right model is a product of
mixtures, one per vector. The recursions are those of Rabiner, Proc. IEEE 1989, for all sequences in
parallel and with probabilities as logarithms.
"""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.extras import extra
from fuselog.replay.engine.arrays import Floats

UNEVEN = 1e-9  # far above rounding and far below differences of scores


class MixtureHmm(NamedTuple):
    """A model with s states of g components in m dimensions.

    `initial` (s,), `transition` (s, s), `weights` (s, g), `means` (s, g, m), `covariances`
    (s, g, m, m).
    """

    initial: Floats
    transition: Floats
    weights: Floats
    means: Floats
    covariances: Floats


class Fit(NamedTuple):
    """Settings of a fit; `floor` is added to the diagonal of every covariance."""

    components: int
    left_right: bool
    floor: float
    iterations: int
    tolerance: float


def fit(sequences: Floats, how: Fit, rng: np.random.Generator) -> MixtureHmm:
    """Fit a model to sequences (count, n, m), excluding sequences with a missing score (NaN).

    The initial means of a state are found by k-means of the vectors at its position in the sequences.

    Raises BadInput unless there are more sequences than components.

    Args:
        sequences: (count, n, m), NaN if a score is missing.
        how: sizes of the model, and settings of the fit.
        rng: random number generator for k-means.
    """
    whole = sequences[~np.isnan(sequences).any(axis=(1, 2))]
    if len(whole) <= how.components:
        raise BadInput(
            f"{len(whole)} score vectors for {how.components} mixture components; "
            "give more users or fewer components"
        )
    model = _start(whole, how, rng)
    before = -np.inf
    for _ in range(how.iterations):
        model, likelihood = _improve(model, whole, how.floor)
        if likelihood - before < how.tolerance:
            break
        before = likelihood
    return model


def log_likelihood(model: MixtureHmm, sequences: Floats) -> Floats:
    """Compute the log-likelihood (count,) of sequences, integrated over missing (NaN) scores.

    Args:
        model: the fitted model.
        sequences: (count, n, m), NaN if a score is missing.

    Returns:
        The log-likelihoods (count,).
    """
    count, length, size = sequences.shape
    vectors = sequences.reshape(-1, size)
    emission = np.empty((len(vectors), *model.weights.shape))
    missing, left = np.isnan(vectors), np.ones(len(vectors), bool)
    while left.any():
        pattern = missing[np.argmax(left)]
        rows, kept = (missing == pattern).all(axis=1), np.flatnonzero(~pattern)
        left &= ~rows
        seen = model._replace(
            means=model.means[..., kept], covariances=model.covariances[..., kept[:, None], kept]
        )
        emission[rows] = _log_components(seen, vectors[rows][:, kept])
    states = _log_sum(emission, axis=-1).reshape(count, length, -1)
    return _log_sum(_forward(model, states)[:, -1], axis=1)


def _start(sequences: Floats, how: Fit, rng: np.random.Generator) -> MixtureHmm:
    """Initialize a model by k-means of each state's vectors, with left-right or equal transitions."""
    with extra("papers", "a mixture of scores"):
        from sklearn.cluster import KMeans  # slow to import

    states = sequences.shape[1]
    initial, transition = np.full(states, 1 / states), np.full((states, states), 1 / states)
    if how.left_right:
        initial, transition = np.eye(states)[0], np.eye(states, k=1)
        transition[-1, -1] = 1.0
    responsibility = np.zeros((len(sequences), states, how.components))
    for state in range(states):
        clusters = KMeans(how.components, n_init=1, random_state=int(rng.integers(2**31)))
        labels = clusters.fit_predict(_uneven(sequences[:, state]))
        responsibility[np.arange(len(labels)), state, labels] = 1.0
    empty = np.zeros((states, how.components))
    model = MixtureHmm(initial, transition, empty, empty, empty)
    return _mixtures(model, sequences.transpose(1, 0, 2), responsibility.transpose(1, 0, 2), how.floor)


def _uneven(vectors: Floats) -> Floats:
    """Return vectors (count, m) with a slight quadratic distortion, which differs between dimensions.

    Integer scores are often equally far from two means, so rounding would decide to which mean a score
    belongs. With the distortion, the lower mean is nearer.
    """
    bend = UNEVEN * np.arange(1, vectors.shape[1] + 1)
    return vectors + bend * (vectors - vectors.min(axis=0)) ** 2


def _improve(model: MixtureHmm, sequences: Floats, floor: float) -> tuple[MixtureHmm, float]:
    """Take one step of Baum-Welch; also return the mean log-likelihood of the model before the step."""
    count, length, size = sequences.shape
    emission = _log_components(model, sequences.reshape(-1, size)).reshape(
        count, length, *model.weights.shape
    )
    states = _log_sum(emission, axis=-1)
    forward, backward = _forward(model, states), _backward(model, states)
    likelihood = _log_sum(forward[:, -1], axis=1)
    occupied = np.exp(forward + backward - likelihood[:, None, None])
    moved = np.zeros_like(model.transition)
    for time in range(length - 1):
        arriving = (states[:, time + 1] + backward[:, time + 1])[:, None, :]
        pairs = forward[:, time, :, None] + _log(model.transition) + arriving
        moved += np.exp(pairs - likelihood[:, None, None]).sum(axis=0)
    left = moved.sum(axis=1, keepdims=True)
    # A state that is never left keeps its transition probabilities.
    transition = np.where(left > 0, moved / np.where(left > 0, left, 1.0), model.transition)
    responsibility = occupied[..., None] * np.exp(emission - states[..., None])
    by_state = responsibility.transpose(2, 0, 1, 3).reshape(len(left), count * length, -1)
    vectors = np.broadcast_to(sequences.reshape(-1, size), (len(left), count * length, size))
    moved_model = model._replace(initial=occupied[:, 0].mean(axis=0), transition=transition)
    return _mixtures(moved_model, vectors, by_state, floor), float(likelihood.mean())


def _mixtures(model: MixtureHmm, vectors: Floats, responsibility: Floats, floor: float) -> MixtureHmm:
    """Fit the model's mixtures to vectors (s, count, m) with responsibilities (s, count, g)."""
    mass = responsibility.sum(axis=1) + np.finfo(float).tiny
    share = responsibility.swapaxes(1, 2)
    means = share @ vectors / mass[..., None]
    squares = (vectors[..., :, None] * vectors[..., None, :]).reshape(*vectors.shape[:2], -1)
    second = (share @ squares).reshape(*mass.shape, vectors.shape[-1], vectors.shape[-1])
    covariances = second / mass[..., None, None] - means[..., :, None] * means[..., None, :]
    covariances += floor * np.eye(vectors.shape[-1])
    weights = mass / mass.sum(axis=1, keepdims=True)
    return model._replace(weights=weights, means=means, covariances=covariances)


def _log_components(model: MixtureHmm, vectors: Floats) -> Floats:
    """Compute the log of weight × density (count, s, g) of vectors (count, m); m may be zero."""
    size = vectors.shape[-1]
    whiten = np.linalg.inv(np.linalg.cholesky(model.covariances))
    shape = (len(vectors), *model.weights.shape, size)
    white = (vectors @ whiten.reshape(model.weights.size * size, size).T).reshape(shape)
    white -= (whiten @ model.means[..., None])[..., 0]
    log_scale = np.log(np.diagonal(whiten, axis1=-2, axis2=-1)).sum(axis=-1)
    constant = _log(model.weights) + log_scale - 0.5 * size * np.log(2 * np.pi)
    return constant - 0.5 * np.einsum("...m,...m->...", white, white)


def _forward(model: MixtureHmm, states: Floats) -> Floats:
    """Compute the log of the joint probability (count, n, s) of the vectors so far and the state."""
    forward = np.empty_like(states)
    forward[:, 0] = _log(model.initial) + states[:, 0]
    transition = _log(model.transition)
    for time in range(1, states.shape[1]):
        reached = _log_sum(forward[:, time - 1, :, None] + transition, axis=1)
        forward[:, time] = reached + states[:, time]
    return forward


def _backward(model: MixtureHmm, states: Floats) -> Floats:
    """Compute the log of the probability (count, n, s) of the later vectors, given the state."""
    backward = np.zeros_like(states)
    transition = _log(model.transition)
    for time in range(states.shape[1] - 2, -1, -1):
        coming = states[:, time + 1] + backward[:, time + 1]
        backward[:, time] = _log_sum(transition + coming[:, None, :], axis=2)
    return backward


def _log(probability: Floats) -> Floats:
    """Compute the logarithm, which is minus infinity for zero."""
    with np.errstate(divide="ignore"):
        return np.log(probability)


def _log_sum(values: Floats, axis: int) -> Floats:
    """Compute the log of the sum of exponentials, several times faster than SciPy."""
    top = np.max(values, axis=axis, keepdims=True)
    top[np.isneginf(top)] = 0.0
    return _log(np.exp(values - top).sum(axis=axis)) + np.squeeze(top, axis)
