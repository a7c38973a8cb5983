"""The terms of a sensor's noise in IEEE Std 952-1997, annex C; their Allan variances add up.

The terms are white noise N, random walk K, Gauss-Markov noise with standard deviation s and time T, and
a quantised angle Q. If the samples have the unit u, N is in u/sqrt(Hz), K in u/sqrt(s), s in u, T in s,
and Q in u s.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# relative variance at which an autocovariance has decayed, because only its square matters
_DECAYED = 1e-7


class Terms(NamedTuple):
    """The noise of one column; a term of zero is absent."""

    white: float = 0.0
    walk: float = 0.0
    markov: float = 0.0
    markov_time_s: float = 1.0
    quantisation: float = 0.0

    def allan_variance(self, taus_s: Floats, step_s: float) -> Floats:
        """Compute the exact expected Allan variance (n,) at times (n,) of samples every `step_s`."""
        multiples = np.rint(taus_s / step_s)
        return self._second_differences(multiples, step_s) / (2 * taus_s**2)

    def autocovariance(self, multiple: int, step_s: float, count: int) -> Floats:
        """Compute the autocovariance of second differences, at lags 0, 1, ... below `count`.

        The second differences are taken of the phases (sums of samples times `step_s`), at a distance of
        `multiple` samples. Their mean square is 2 (`multiple` x `step_s`)^2 times the Allan variance. At
        lags beyond twice this distance only the Gauss-Markov term remains; the result ends where this
        term has decayed.
        """
        near = np.arange(min(count, 2 * multiple + 2), dtype=float)
        found = self._second_differences(multiple, step_s, near)
        if not self.markov:
            return found
        a, power = self._decay(step_s)
        # all four differences of an exponential, without cancellation
        tail = -power * np.expm1(multiple * np.log(a)) ** 4
        lasts = math.log(max(abs(tail) / (_DECAYED * found[0]), 1.0)) * self.markov_time_s / step_s
        beyond = np.arange(len(near), min(count, len(near) + int(lasts)), dtype=float)
        return np.concatenate([found, tail * a ** (beyond - 2 * multiple)])

    def _second_differences(
        self, multiple: Floats | int, step_s: float, lags: Floats | float = 0.0
    ) -> Floats:
        """Compute the autocovariance of second differences as differences of a double sum."""
        far = 2 * np.asarray(multiple)
        ends = (lags + far, lags - far), (lags + far / 2, lags - far / 2)
        outer, inner = (sum(self._summed_twice(np.abs(end), step_s) for end in pair) for pair in ends)
        return np.atleast_1d(-outer + 4 * inner - 6 * self._summed_twice(np.abs(lags), step_s))

    def _summed_twice(self, lag: Floats | float, step_s: float) -> Floats:
        """Compute a function whose second differences are the samples' autocovariance times step_s^2."""
        lag = np.asarray(lag, dtype=float)
        white = self.white**2 / step_s * lag / 2
        walk = -(self.walk**2) * step_s * (lag * lag * lag - lag) / 12
        quantised = -((self.quantisation / step_s) ** 2) * (lag == 0)
        found = (white + walk + quantised) * step_s**2
        if self.markov:
            a, power = self._decay(step_s)
            slope = (self.markov * step_s) ** 2 * (1 + a) / (2 * (1 - a))
            found = found + power * a**lag + slope * lag
        return found

    def _decay(self, step_s: float) -> tuple[float, float]:
        a = float(np.exp(-step_s / self.markov_time_s))
        return a, (self.markov * step_s) ** 2 * a / (1 - a) ** 2
