"""Generalised cross-correlation: delays to a fraction of a sample, and how sure they are."""

import numpy as np
import pytest
from scipy import fft
from scipy.stats import chi2

from fuselog.recorders.families.acoustic.arrivals import Arrivals, arrivals, delay_between

RATE_HZ, BAND_HZ = 8000.0, (500.0, 3000.0)


def delayed(signal: np.ndarray, delay_s: float) -> np.ndarray:
    """The signal so much later, to a fraction of a sample."""
    frequency_hz = fft.rfftfreq(len(signal), 1.0 / RATE_HZ)
    spectrum = fft.rfft(signal) * np.exp(-2j * np.pi * frequency_hz * delay_s)
    return fft.irfft(spectrum, len(signal))


def sound(rng: np.random.Generator, samples: int = 1024) -> np.ndarray:
    return np.hanning(samples) * rng.normal(size=samples)


@pytest.mark.parametrize("weighting", ["phat", "none"])
def test_a_delay_is_found_to_a_fraction_of_a_sample(weighting):
    heard = sound(np.random.default_rng(1))
    for delay_s in (-3.3e-3, 0.0, 1.23456e-3):
        found = delay_between(delayed(heard, delay_s), heard, RATE_HZ, BAND_HZ, 0.01, weighting)
        assert found.delay_s == pytest.approx(delay_s, abs=1e-2 / RATE_HZ)
        assert found.likeness > 0.95


def test_delays_err_as_their_variances_say():
    """Over 80 sounds in noise: squared errors by their variances are 1 on average, within chi-square."""
    rng = np.random.default_rng(2)
    squared = []
    for _ in range(80):
        heard = sound(rng)
        noise = 0.1 * rng.normal(size=(2, len(heard)))
        late, early = delayed(heard, 5.5 / RATE_HZ) + noise[0], heard + noise[1]
        found = delay_between(late, early, RATE_HZ, BAND_HZ, 0.01)
        squared.append((found.delay_s - 5.5 / RATE_HZ) ** 2 / found.variance_s2)
    low, high = chi2.ppf([0.005, 0.995], 80) / 80
    assert low < np.mean(squared) < high


def test_no_delay_is_longer_than_sound_travels():
    heard = sound(np.random.default_rng(3))
    found = delay_between(delayed(heard, 8e-3), heard, RATE_HZ, BAND_HZ, 2e-3)
    assert abs(found.delay_s) < 2.2e-3
    assert found.likeness < 0.5


def several(rng: np.random.Generator, noise: float, echo: float = 0.0) -> Arrivals:
    """Four microphones of which the third is the noisiest, each with an echo of its own."""
    heard, delays_s = sound(rng), np.array([0.0, 10.4, -7.7, 3.2]) / RATE_HZ
    recordings = np.array(
        [delayed(heard, each) + echo * delayed(heard, each + rng.uniform(0, 2e-3)) for each in delays_s]
    )
    scale = noise * np.array([1.0, 1.0, 6.0, 1.0])[:, None]
    longest_s = np.full((4, 4), 0.01)
    return arrivals(recordings + scale * rng.normal(size=recordings.shape), RATE_HZ, BAND_HZ, longest_s)


def test_arrivals_say_which_microphone_is_unsure():
    found = several(np.random.default_rng(4), 0.05)
    assert found.reference != 2
    assert found.delay_s[found.reference] == 0.0
    assert np.argmax(found.variance_s2) == 2
    expected = np.array([0.0, 10.4, -7.7, 3.2])
    off = (found.delay_s * RATE_HZ - expected) - (found.delay_s * RATE_HZ - expected)[0]
    assert np.abs(off).max() < 0.3
    # no clock is better than its samples
    assert found.variance_s2.min() >= 1.0 / (12.0 * RATE_HZ**2)


def test_echoes_make_arrivals_unsure_which_no_noise_does():
    rounding_s2 = 1.0 / (12.0 * RATE_HZ**2)
    clear, echoing = (several(np.random.default_rng(5), 1e-3, echo) for echo in (0.0, 0.9))
    assert clear.variance_s2.max() < 1.2 * rounding_s2
    assert echoing.variance_s2.min() > 2.0 * rounding_s2
