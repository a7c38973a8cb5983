"""Differences between the arrival times of a sound at microphones, by cross-correlation.

Knapp and Carter, "The Generalized Correlation Method for Estimation of Time Delay", IEEE Transactions on
Acoustics, Speech, and Signal Processing 24(4), 1976. The phase of the cross-spectrum is the sum of a
part due to the delay and a part due to noise and echoes. The estimated delay maximizes the sum of the
cosines of the phases that remain after the delay's part is subtracted. With the phase transform, all
frequencies have the same weight.
"""

from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import nnls
from scipy.special import gammaincinv

Floats = NDArray[np.float64]
Weighting = Literal["phat", "none"]

# Number of points per sample on which the correlation is evaluated.
FINER = 4
# Number of Newton steps from the best point; they converge quadratically.
STEPS = 5


class Delay(NamedTuple):
    """Delay of one signal relative to another; `likeness` is 1 if all phases agree."""

    delay_s: float
    variance_s2: float
    likeness: float


class Arrivals(NamedTuple):
    """Arrival times of a sound at each microphone, relative to the microphone that hears it best.

    Attributes:
        reference: index of that reference microphone.
        delay_s: (n,), delays relative to the reference; zero for the reference.
        variance_s2: (n,), variance of each microphone's own arrival time; the variance of a difference
            is the sum of two of these.
        likeness: (n,), similarity of the signals, see `Delay`.
    """

    reference: int
    delay_s: Floats
    variance_s2: Floats
    likeness: Floats


def delay_between(
    late: Floats,
    early: Floats,
    rate_hz: float,
    band_hz: tuple[float, float],
    longest_s: float,
    weighting: Weighting = "phat",
) -> Delay:
    """Measure the delay of `late` (samples,) relative to `early`, from -`longest_s` to `longest_s`.

    The delay is the root of the equation sum w omega sin(remaining phase) = 0. Its variance is estimated
    from the remaining phases (the sandwich estimator of Huber, "The behavior of maximum likelihood
    estimates under nonstandard conditions", 1967). The estimated variance is valid for noise that is
    independent between frequencies, with any spectrum. The variance does not include the risk of a wrong
    peak.

    Args:
        late: (samples,), the signal of the microphone that the sound reaches later.
        early: (samples,), the signal of the other microphone, over the same time.
        rate_hz: sampling rate.
        band_hz: lowest and highest frequency to use.
        longest_s: longest possible delay, in s.
        weighting: weights of frequencies, see `Weighting`.

    Returns:
        The delay in s, its variance in s^2, and the similarity of the phases.

    >>> rng = np.random.default_rng(1)
    >>> sound, noise = rng.normal(size=2000), 0.1 * rng.normal(size=(2, 1900))
    >>> late, early = sound[93:1993] + noise[0], sound[100:] + noise[1]
    >>> found = delay_between(late, early, 8000.0, (100.0, 3000.0), 0.01)
    >>> round(float(found.delay_s) * 8000.0, 1), found.variance_s2**0.5 * 8000.0 < 0.02
    (7.0, True)
    """
    samples = max(len(late), len(early))
    size = fft.next_fast_len(2 * samples, real=True)
    cross = fft.rfft(late, size) * np.conj(fft.rfft(early, size))
    frequency_hz = fft.rfftfreq(size, 1.0 / rate_hz)
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    strength = np.abs(cross)
    weight = np.where(inside & (strength > 0.0), strength if weighting == "none" else 1.0, 0.0)
    weighted = weight * np.divide(cross, strength, out=np.zeros_like(cross), where=strength > 0.0)

    fine = fft.irfft(weighted, FINER * size)
    reach = min(int(np.ceil(longest_s * FINER * rate_hz)), FINER * samples - 1)
    lags = np.arange(-reach, reach + 1)
    delay_s = lags[np.argmax(fine[lags])] / (FINER * rate_hz)
    omega, weighted, weight = 2.0 * np.pi * frequency_hz[inside], weighted[inside], weight[inside]
    for _ in range(STEPS):
        left = weighted * np.exp(1j * omega * delay_s)
        bend = float(omega**2 @ left.real)
        if bend <= 0.0:  # no maximum: the signals are only noise
            return Delay(delay_s, np.inf, 0.0)
        delay_s -= float(omega @ left.imag) / bend
    repeated = size / samples  # padding interpolates the spectrum by this factor
    variance_s2 = repeated * float(omega**2 @ left.imag**2) / bend**2
    return Delay(delay_s, variance_s2, float(left.real.sum() / weight.sum()))


def arrivals(
    recordings: Floats,
    rate_hz: float,
    band_hz: tuple[float, float],
    longest_s: Floats,
    weighting: Weighting = "phat",
) -> Arrivals:
    """Measure arrival times of a sound at n microphones from simultaneous recordings (n, samples).

    The delay of each pair is at most its entry in `longest_s` (n, n). A microphone's variance has three
    parts. The first is due to noise; it is fitted so that the parts of two microphones add up to the
    variance of their delay. The second is due to echoes and neighbouring peaks; it follows from the
    median closure error of the delays of three microphones. The third is due to a clock offset of up to
    half a sample. The reference is the microphone whose delays to all others have the smallest total
    variance.

    Args:
        recordings: (n, samples), simultaneous recordings.
        rate_hz: sampling rate.
        band_hz: lowest and highest frequency to use.
        longest_s: (n, n), longest possible delay of each pair, in s.
        weighting: weights of frequencies, see `Weighting`.

    Returns:
        The arrival times at each microphone, relative to the reference.
    """
    count = len(recordings)
    pairs, triples = (np.array(list(combinations(range(count), size))) for size in (2, 3))
    found = [
        delay_between(recordings[i], recordings[k], rate_hz, band_hz, longest_s[i, k], weighting)
        for i, k in pairs
    ]
    delays, likeness = np.zeros((count, count)), np.ones((count, count))
    noise_s2 = np.zeros((count, count))
    for (i, k), each in zip(pairs, found, strict=True):
        delays[i, k], delays[k, i] = each.delay_s, -each.delay_s
        likeness[i, k] = likeness[k, i] = each.likeness
        noise_s2[i, k] = noise_s2[k, i] = min(each.variance_s2, longest_s[i, k] ** 2)
    first, second, third = triples.T
    open_s = delays[first, second] + delays[second, third] + delays[third, first]
    # three delays have six parts; the median of a squared Gaussian is 0.455 of its variance
    of_peaks_s2 = np.median(open_s**2) / (12.0 * gammaincinv(0.5, 0.5))
    belongs = np.zeros((len(pairs), count))
    np.put_along_axis(belongs, pairs, 1.0, axis=1)
    of_noise_s2, _ = nnls(belongs, noise_s2[tuple(pairs.T)])
    reference = int(np.argmin(noise_s2.sum(axis=1)))
    variance_s2 = of_noise_s2 + of_peaks_s2 + 1.0 / (12.0 * rate_hz**2)
    return Arrivals(reference, delays[:, reference], variance_s2, likeness[:, reference])
