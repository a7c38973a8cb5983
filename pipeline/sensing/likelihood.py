"""Likelihood of a sensor's noise from a Kalman filter: walk, Gauss-Markov noise, quantised angle.

A sample is y = b + g + (e_k - e_(k-1)) / step + v, with the walk b, the Gauss-Markov noise g, errors e
of a quantised angle and white noise v. The initial value of the walk is exactly diffuse, so the first
sample is not scored. Lost samples make a step longer. Columns after the samples are regressors, fitted
by least squares.
"""

import math
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.sensing.terms import Terms
from fuselog.recorders.compiling.compile import compiled
from fuselog.replay.engine.arrays import Floats, Integers


class Samples(NamedTuple):
    """The samples of one column, in the form that the likelihood accepts.

    Attributes:
        values: (n, 1 + regressors) the samples, and regressors on which the samples may depend.
        steps: (n,) the number of grid steps since the previous sample.
        step_s: the step of the grid.
    """

    values: Floats
    steps: Integers
    step_s: float


class Likelihood(NamedTuple):
    """The likelihood of some terms.

    Attributes:
        log_likelihood: the log-likelihood of these terms.
        mean_square: mean square of the normalised innovations; one if the terms have the right size.
        coefficients, sigmas: (regressors,) the best coefficients, and their standard deviations.
    """

    log_likelihood: float
    mean_square: float
    coefficients: Floats
    sigmas: Floats


def likelihood(samples: Samples, terms: Terms) -> Likelihood:
    """Compute the exact Gaussian log-likelihood of samples, with the best coefficients."""
    columns = samples.values.shape[1]
    moments = np.zeros((columns, columns))
    log_determinant = _filtered(samples, terms, moments, np.empty((0, columns)))
    squares, cross, normal = moments[0, 0], moments[1:, 0], moments[1:, 1:]
    inverse = np.linalg.pinv(normal)
    coefficients = inverse @ cross
    squares -= cross @ coefficients
    size = len(samples.values) - 1
    found = -0.5 * (log_determinant + squares + size * math.log(2 * math.pi))
    return Likelihood(found, squares / size, coefficients, np.sqrt(np.diag(inverse)))


def residuals(samples: Samples, terms: Terms) -> Floats:
    """Compute the normalised innovations (n - 1,) of samples, without the effect of the regressors."""
    columns = samples.values.shape[1]
    moments, found = np.zeros((columns, columns)), np.zeros(samples.values.shape)
    _filtered(samples, terms, moments, found)
    explained = found[1:, 1:] @ (np.linalg.pinv(moments[1:, 1:]) @ moments[1:, 0])
    return found[1:, 0] - explained


def _filtered(samples: Samples, terms: Terms, moments: Floats, found: Floats) -> float:
    noise = np.array(terms, dtype=float)
    means = np.zeros((samples.values.shape[1], 4))
    return _filter(samples.values, samples.steps, samples.step_s, noise, means, moments, found)


def filter_samples(
    values: Floats,
    steps: Integers,
    step_s: float,
    noise: Floats,
    means: Floats,
    moments: Floats,
    found: Floats,
) -> float:
    """Filter all columns with one gain; return the sum of the logarithms of innovation variances.

    Args:
        values: (n, m) the columns.
        steps: (n,) the number of grid steps since the previous sample.
        step_s: the step of the grid.
        noise: (5,) the terms.
        means: (m, 4) work memory, for b, g, e of the previous sample and the innovation of each column.
        moments: (m, m) filled with the sums of products of normalised innovations.
        found: (n, m) filled with the normalised innovations; without rows if they are not needed.
    """
    white = noise[0] * noise[0] / step_s
    walk = noise[1] * noise[1] * step_s
    markov = noise[2] * noise[2]
    angle = noise[4] * noise[4]
    into = angle / step_s  # covariance of e_k and y_k
    each = white + into / step_s
    decay_of_one = math.exp(-step_s / noise[3])
    columns = values.shape[1]
    for column in range(columns):
        means[column, 0] = values[0, column]
    bb, bg, be = markov + each + into / step_s, -markov, -into
    gg, ge, ee = markov, 0.0, angle
    total = 0.0
    for row in range(1, values.shape[0]):
        step = steps[row]
        decay = decay_of_one if step == 1 else math.exp(-step * step_s / noise[3])
        bb += walk * step
        bg *= decay
        gg = decay * decay * gg + (1.0 - decay * decay) * markov
        ge *= decay
        if step > 1:
            be, ge, ee = 0.0, 0.0, angle
        with_b = bb + bg - be / step_s
        with_g = bg + gg - ge / step_s
        with_e = be + ge - ee / step_s
        variance = with_b + with_g - with_e / step_s + each
        total += math.log(variance)
        scale = 1.0 / math.sqrt(variance)
        gain_b, gain_g, gain_e = with_b / variance, with_g / variance, into / variance
        for column in range(columns):
            before = means[column, 2] if step == 1 else 0.0
            predicted = decay * means[column, 1]
            error = values[row, column] - means[column, 0] - predicted + before / step_s
            means[column, 0] += gain_b * error
            means[column, 1] = predicted + gain_g * error
            means[column, 2] = gain_e * error
            error *= scale
            if found.shape[0] > 0:
                found[row, column] = error
            means[column, 3] = error
            for other in range(column + 1):
                moments[column, other] += error * means[other, 3]
        bb -= gain_b * with_b
        bg -= gain_b * with_g
        gg -= gain_g * with_g
        be, ge, ee = -gain_b * into, -gain_g * into, angle - gain_e * into
    for column in range(columns):
        for other in range(column):
            moments[other, column] = moments[column, other]
    return total


_filter = compiled(filter_samples)
