"""Statistical linear regression: what a function does to a Gaussian, from samples of the Gaussian.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
(19)-(24). Every linear regression Kalman filter is this with samples of its own.
"""

from typing import Any

import numpy as np

from replay.estimators.gaussian import Floats, Function, wrap


def regression(function: Function, angular: tuple[bool, ...]) -> Function:
    """Make the kernel for a component-first `function(z, *arguments)`, whose values may be `angular`.

    The kernel's z (N,) is Gaussian: the state, and after it whatever noise enters other than by addition
    (additive noise is added to the covariance afterwards). Samples `points` (L, N) of N(0, I) with
    `weights` (L,), of zero mean, are moved by z's `mean` and the lower `factor` (N, N) of its
    covariance. It fills mean (m,) and covariance (m, m) of the values, and their covariance (n, m) with
    the first n components of z. Values count as differences from that at the mean, so angles need no
    mean of their own. (24) prints y_{k,i} where the noise sample is meant.
    """

    def regress(
        mean: Floats,
        factor: Floats,
        arguments: tuple[Any, ...],
        points: Floats,
        weights: Floats,
        value_mean: Floats,
        value_covariance: Floats,
        cross_covariance: Floats,
    ) -> None:
        size, values, states = len(mean), len(value_mean), len(cross_covariance)
        centre = function(mean, *arguments)
        sample, change = np.empty(size), np.empty(values)
        value_mean[:] = 0.0
        value_covariance[:] = 0.0
        cross_covariance[:] = 0.0
        for index in range(len(weights)):
            weight = weights[index]
            for row in range(size):
                sample[row] = mean[row]
                for k in range(row + 1):
                    sample[row] += factor[row, k] * points[index, k]
            value = function(sample, *arguments)
            for i in range(values):
                change[i] = wrap(value[i] - centre[i], angular[i])
                weighted = weight * change[i]
                value_mean[i] += weighted
                for j in range(i + 1):
                    value_covariance[i, j] += weighted * change[j]
                for row in range(states):
                    cross_covariance[row, i] += weighted * (sample[row] - mean[row])
        for i in range(values):
            for j in range(i + 1):
                value_covariance[i, j] -= value_mean[i] * value_mean[j]
                value_covariance[j, i] = value_covariance[i, j]
        for i in range(values):
            value_mean[i] += centre[i]

    return regress
