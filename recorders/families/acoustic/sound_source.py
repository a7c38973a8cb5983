"""Simulator of a sound in noise at microphones: recordings, and arrival-time differences from them.

The sound is band-limited Gaussian noise that swells and fades. The sound gets weaker with distance; its
delay follows from the speed of sound, with sub-sample resolution. Clocks are off by up to half a sample.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat
from scipy import fft

from fuselog.recorders.common_streams import truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic.arrival_streams import (
    HeardSound,
    difference_stream,
    microphone_stream,
)
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
Point = tuple[float, float, float]


class SoundSourceParameters(Parameters):
    """A sound and the microphones that record it.

    Attributes:
        microphones_m: positions of the microphones (x, y, z).
        reach_m: half the side length of the box that contains the source, centred on the microphones'
            mean position; if all microphones have the same height, the source has this height too.
        sound_s: length of the sound.
        rate_hz: sampling rate.
        band_hz: lowest and highest frequency of the sound, in Hz.
        snr_db: signal-to-noise ratio at the nearest microphone, in the band.
        speed_of_sound_mps: speed of sound in the air.
    """

    microphones_m: Annotated[list[Point], Field(min_length=3)] = [
        (0, 50, 0),
        (50, 0, 0),
        (20, 30, 0),
        (30, 20, 0),
        (-10, -15, 0),
    ]
    reach_m: PositiveFloat = 25.0
    sound_s: PositiveFloat = 0.3
    rate_hz: PositiveFloat = 32000.0
    band_hz: tuple[PositiveFloat, PositiveFloat] = (1000.0, 6000.0)
    snr_db: float = 20.0
    speed_of_sound_mps: PositiveFloat = 343.0


def simulate(parameters: SoundSourceParameters, rng: np.random.Generator) -> Recording:
    """Record one sound; raise BadInput if the band does not fit the sampling rate."""
    low, high = parameters.band_hz
    if not low < high <= 0.5 * parameters.rate_hz:
        raise BadInput(
            f"band_hz = [{low:g}, {high:g}]: give a lower and a higher frequency, the higher one "
            f"at most half of rate_hz = {parameters.rate_hz:g}"
        )
    places = np.array(parameters.microphones_m)
    source = places.mean(axis=0) + parameters.reach_m * rng.uniform(-1.0, 1.0, 3)
    components = ["x_m", "y_m", "z_m"]
    if np.ptp(places[:, 2]) == 0.0:
        source[2] = places[0, 2]
        components.pop()
    time_ns = int(simulation_stamps_ns(0.0))
    truth = truth_stream("/sound/truth", [time_ns], components, source[None, : len(components)])
    recordings, numbers = _recordings(parameters, places, source, rng), np.arange(1, len(places) + 1)
    differences = difference_stream(
        "/sound",
        HeardSound(time_ns, recordings, parameters.rate_hz, places, numbers),
        band_hz=parameters.band_hz,
        speed_of_sound_mps=parameters.speed_of_sound_mps,
    )
    return Recording([microphone_stream(time_ns, places), differences, truth])


def _recordings(
    parameters: SoundSourceParameters, places: Floats, source: Floats, rng: np.random.Generator
) -> Floats:
    """Simulate simultaneous recordings (n, samples) of microphones at positions (n, 3)."""
    rate_hz, distance_m = parameters.rate_hz, np.linalg.norm(places - source, axis=1)
    arrival_s = distance_m / parameters.speed_of_sound_mps
    sounding = round(parameters.sound_s * rate_hz)
    size = fft.next_fast_len(round((2.0 * arrival_s.max() + parameters.sound_s) * rate_hz), real=True)
    frequency_hz = fft.rfftfreq(size, 1.0 / rate_hz)
    low, high = parameters.band_hz

    def in_band(signal: Floats) -> Floats:
        return np.where((frequency_hz >= low) & (frequency_hz <= high), fft.rfft(signal), 0.0)

    sound = np.zeros(size)
    sound[:sounding] = np.hanning(sounding) * rng.normal(size=sounding)
    spectrum = in_band(sound)
    spectrum /= np.sqrt(np.mean(fft.irfft(spectrum, size)[:sounding] ** 2))
    off_s = rng.uniform(-0.5, 0.5, len(places)) / rate_hz
    delays = np.exp(-2j * np.pi * frequency_hz * (arrival_s + off_s)[:, None])
    clean = fft.irfft(spectrum * delays, size) * (distance_m.min() / distance_m)[:, None]
    noise = fft.irfft(in_band(rng.normal(size=size)), size).std()
    sigma = 10.0 ** (-parameters.snr_db / 20.0) / noise
    return clean + sigma * rng.normal(size=clean.shape)


SOUND_SOURCE = Simulator(
    "a sound in noise recorded by microphones, and its arrival differences by cross-correlation",
    SoundSourceParameters,
    simulate,
)
