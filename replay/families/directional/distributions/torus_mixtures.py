"""Maximum-likelihood mixtures on the torus: wrapped normals and von Mises densities.

Angles are (n, 2) in rad. A mixture of wrapped normals is fitted by expectation maximization over the
components and the numbers of full turns. A mixture of bivariate von Mises densities is fitted by
L-BFGS-B, starting at the mixture of wrapped normals.
"""

from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import i0e, i1e, log_softmax, logsumexp
from threadpoolctl import threadpool_limits

from fuselog.recorders.errors import BadInput
from fuselog.recorders.extras import extra
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats

Interaction = Literal["sine", "cosine"]

# Standard deviations at which the density of a component is cut off.
_REACH = 6.0
# Added to every variance (rad^2), so that no component shrinks to a single sample; equals (1 deg)^2.
_LEAST_VARIANCE = np.radians(1.0) ** 2
_MOST_CONCENTRATION = 500.0
_NODES = 2.0 * np.pi / 1024 * np.arange(1024)


class WrappedMixture(NamedTuple):
    """Wrapped normals: weights (k,), means (k, 2), covariances (k, 2, 2) of the unwrapped angles."""

    weights: Floats
    mean: Floats
    covariance: Floats

    def log_density(self, angles: Floats) -> Floats:
        """Compute the logarithm of the density (n,) at every pair of angles."""
        return np.asarray(logsumexp(_log_parts(self, angles)[0], axis=(1, 2)))


class VonMisesMixture(NamedTuple):
    """A mixture of bivariate von Mises densities of one kind.

    The density is exp(k1 cos a + k2 cos b + k3 sin a sin b), normalized, where a and b are the
    deviations from the mean (Singh, Hnizdo, Demchuk, "Probabilistic model for two dependent circular
    variables", 2002). The second kind has k3 cos(a - b) in place of the product of sines (Mardia,
    Taylor, Subramaniam, "Protein bioinformatics and mixtures of bivariate von Mises distributions for
    angular data", 2007).

    Attributes:
        weights: (k,).
        mean: (k, 2).
        concentration: k1, k2, k3 of every component, (k, 3).
        interaction: "sine" for the first density, "cosine" for the second.
    """

    weights: Floats
    mean: Floats
    concentration: Floats
    interaction: Interaction

    def log_density(self, angles: Floats) -> Floats:
        """Compute the logarithm of the density (n,) at every pair of angles."""
        log_norm, _ = _normalisation(self.concentration, self.interaction)
        features = _features(angles, self.mean, self.interaction)[0]
        parts = np.log(self.weights) + (features * self.concentration).sum(axis=2) - log_norm
        return np.asarray(logsumexp(parts, axis=1))


def fit_wrapped_mixture(angles: Floats, components: int, iterations: int = 300) -> WrappedMixture:
    """Fit wrapped normals by maximum likelihood, starting at the clusters that k-means finds.

    With one component, this is the maximum-likelihood fit of a wrapped normal. Raises BadInput if there
    are fewer than ten pairs of angles for each component.

    Args:
        angles: (n, 2), in rad.
        components: number of wrapped normals in the mixture.
        iterations: maximum number of iterations.
    """
    if len(angles) < 10 * components:
        raise BadInput(
            f"{len(angles)} pairs of angles for {components} components; give at least 10 per component"
        )
    embedded = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    with extra("papers", "a mixture on the torus"):
        from sklearn.cluster import KMeans  # slow to import

    with threadpool_limits(1):  # with few points, a second core would only wait
        labels = KMeans(components, n_init=10, random_state=0).fit_predict(embedded)
    share = np.eye(components)[labels]
    mean = np.angle(share.T @ np.exp(1j * angles))
    now = WrappedMixture(share.mean(axis=0), mean, np.tile(np.eye(2), (components, 1, 1)))
    likelihood = -np.inf
    for _ in range(iterations):
        parts, deviations = _log_parts(now, angles)
        of_angle = logsumexp(parts, axis=(1, 2), keepdims=True)
        before, likelihood = likelihood, float(of_angle.sum())
        if likelihood - before < 1e-7 * len(angles):
            break
        share = np.exp(parts - of_angle)  # of component and turn, (n, k, turns)
        count = share.sum(axis=(0, 2))
        shift = np.stack([(share * each).sum(axis=(0, 2)) / count for each in deviations], axis=1)
        first, second = (each - of[:, None] for each, of in zip(deviations, shift.T, strict=True))
        c11, c12, c22 = (
            (share * product).sum(axis=(0, 2)) / count
            for product in (first * first, first * second, second * second)
        )
        covariance = np.moveaxis(np.array([[c11, c12], [c12, c22]]), 2, 0) + _LEAST_VARIANCE * np.eye(2)
        now = WrappedMixture(count / len(angles), wrap_angle(now.mean + shift), covariance)
    return now


def _log_parts(mixture: WrappedMixture, angles: Floats) -> tuple[Floats, tuple[Floats, Floats]]:
    """Return the logarithms of weighted densities (n, k, turns), and both angles' deviations."""
    (c11, c12), (_, c22) = np.moveaxis(mixture.covariance, 0, 2)[..., None]
    determinant = c11 * c22 - c12**2
    most = int(_REACH * np.sqrt(max(c11.max(), c22.max())) / (2.0 * np.pi) + 0.5)
    turns = 2.0 * np.pi * np.arange(-most, most + 1)
    offsets = np.stack(np.meshgrid(turns, turns, indexing="ij"), axis=-1).reshape(-1, 2)
    nearest = wrap_angle(angles[:, None] - mixture.mean)[:, :, None]
    first, second = nearest[..., 0] + offsets[:, 0], nearest[..., 1] + offsets[:, 1]
    square = (c22 * first**2 - 2.0 * c12 * first * second + c11 * second**2) / determinant
    norm = np.log(mixture.weights)[:, None] - np.log(2.0 * np.pi) - 0.5 * np.log(determinant)
    return norm - 0.5 * square, (first, second)


def fit_von_mises_mixture(
    angles: Floats, interaction: Interaction, start: WrappedMixture
) -> VonMisesMixture:
    """Fit one von Mises density for each wrapped normal of the start, by maximum likelihood.

    Args:
        angles: (n, 2), in rad.
        interaction: how the two angles of a density depend on each other.
        start: the mixture at which the search begins.
    """
    k = len(start.weights)
    precision = np.linalg.inv(start.covariance)
    third = -precision[:, 0, 1]
    own = np.diagonal(precision, axis1=1, axis2=2) - (third[:, None] if interaction == "cosine" else 0.0)
    own = np.clip(own, 0.05, 0.9 * _MOST_CONCENTRATION)
    scale = np.sqrt(own.prod(axis=1))
    low, high = (-0.99, 0.99) if interaction == "sine" else (-0.49, 4.0)
    begin = [np.log(start.weights), start.mean.ravel(), np.log(own).ravel()]
    begin.append(np.clip(third / scale, 0.9 * low, 0.9 * high))
    bounds = [
        *[(None, None)] * (3 * k),
        *[(np.log(0.01), np.log(_MOST_CONCENTRATION))] * (2 * k),
        *[(low, high)] * k,
    ]

    def unpacked(x: Floats) -> VonMisesMixture:
        logits, mean, logs, third = np.split(x, np.cumsum([k, 2 * k, 2 * k]))
        own = np.exp(logs.reshape(k, 2))
        third = third * np.sqrt(own.prod(axis=1))
        concentration = np.concatenate([own, third[:, None]], axis=1)
        weights = np.exp(log_softmax(logits))
        return VonMisesMixture(weights, wrap_angle(mean.reshape(k, 2)), concentration, interaction)

    def cost(x: Floats) -> tuple[float, Floats]:
        mixture = unpacked(x)
        kappa = mixture.concentration
        log_norm, expected = _normalisation(kappa, interaction)
        features, slopes = _features(angles, mixture.mean, interaction)
        parts = np.log(mixture.weights) + (features * kappa).sum(axis=2) - log_norm
        of_angle = logsumexp(parts, axis=1, keepdims=True)
        share = np.exp(parts - of_angle)  # (n, k)
        logits = share.sum(axis=0) - len(angles) * mixture.weights
        mean = -np.einsum("nk,nkfd,kf->kd", share, slopes, kappa)
        by_kappa = np.einsum("nk,nkf->kf", share, features - expected)
        # k3 = r sqrt(k1 k2): half of its derivative goes to the logarithm of each
        logs = by_kappa[:, :2] * kappa[:, :2] + 0.5 * (by_kappa[:, 2] * kappa[:, 2])[:, None]
        third = by_kappa[:, 2] * np.sqrt(kappa[:, 0] * kappa[:, 1])
        slope = np.concatenate([logits, mean.ravel(), logs.ravel(), third])
        return -float(of_angle.sum()), -slope

    found = minimize(cost, np.concatenate(begin), jac=True, method="L-BFGS-B", bounds=bounds)
    return unpacked(found.x)


def _features(angles: Floats, mean: Floats, interaction: Interaction) -> tuple[Floats, Floats]:
    """Return the factors of the concentrations (n, k, 3), and their derivatives (n, k, 3, 2)."""
    a, b = np.moveaxis(angles[:, None] - mean, -1, 0)
    none = np.zeros_like(a)
    if interaction == "sine":
        third, slope = np.sin(a) * np.sin(b), [np.cos(a) * np.sin(b), np.sin(a) * np.cos(b)]
    else:
        third, slope = np.cos(a - b), [-np.sin(a - b), np.sin(a - b)]
    slopes = [[-np.sin(a), none], [none, -np.sin(b)], slope]
    features = np.stack([np.cos(a), np.cos(b), third], axis=-1)
    return features, np.moveaxis(np.array(slopes), (0, 1), (2, 3))


def _normalisation(kappa: Floats, interaction: Interaction) -> tuple[Floats, Floats]:
    """Return log normalization integrals (k,), with derivatives (k, 3) for the concentrations.

    The integral over the second angle is a Bessel function. The integral over the first angle is a sum
    over equal steps, which is exact up to rounding for a smooth periodic function.
    """
    k1, k2, k3 = kappa.T[:, :, None]
    if interaction == "sine":
        along, across = k2 + 0.0 * _NODES, k3 * np.sin(_NODES)
    else:  # k2 cos b + k3 cos(a - b)
        along, across = k2 + k3 * np.cos(_NODES), k3 * np.sin(_NODES)
    radius = np.maximum(np.hypot(along, across), 1e-12)
    exponents = k1 * np.cos(_NODES) + radius + np.log(i0e(radius))
    log_norm = logsumexp(exponents, axis=1) + 2.0 * np.log(2.0 * np.pi) - np.log(len(_NODES))
    share = np.exp(exponents - logsumexp(exponents, axis=1, keepdims=True))
    length = i1e(radius) / i0e(radius) / radius  # E[(cos b, sin b)] = length (along, across)
    second, sine = length * along, length * across
    third = np.sin(_NODES) * sine
    if interaction == "cosine":
        third = np.cos(_NODES) * second + third
    slopes = [(share * each).sum(axis=1) for each in (np.cos(_NODES), second, third)]
    return log_norm, np.stack(slopes, axis=1)
