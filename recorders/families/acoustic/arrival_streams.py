"""Streams of a sound heard by microphones: differences of arrival times, and microphone positions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.families.acoustic.arrivals import Weighting, arrivals
from fuselog.recorders.log import Stream, make_stream, schemas

Floats = NDArray[np.float64]


class HeardSound(NamedTuple):
    """Simultaneous recordings of one sound by n microphones.

    Attributes:
        time_ns: the stamp of the sound.
        recordings: (n, samples).
        rate_hz: sampling rate.
        places_m: positions of the microphones (n, 3).
        microphone_id: numbers of the microphones (n,).
    """

    time_ns: int
    recordings: Floats
    rate_hz: float
    places_m: Floats
    microphone_id: NDArray[np.int64]


def difference_stream(
    prefix: str,
    heard: HeardSound,
    *,
    band_hz: tuple[float, float],
    speed_of_sound_mps: float,
    weighting: Weighting = "phat",
) -> Stream:
    """Measure the differences of one sound's arrival times at several microphones; return a stream.

    Args:
        prefix: prefix of the topic, which ends with `/differences`.
        heard: recordings of the microphones.
        band_hz: lowest and highest frequency to use.
        weighting: see `fuselog.recorders.families.acoustic.arrivals`.
        speed_of_sound_mps: speed of sound, which bounds the delays and is written to the channel's
            metadata.
    """
    time_ns, recordings, rate_hz, places_m, microphone_id = heard
    away_m = np.linalg.norm(places_m[:, None] - places_m, axis=2)
    longest_s = away_m / speed_of_sound_mps + 2.0 / rate_hz
    found = arrivals(recordings, rate_hz, band_hz, longest_s, weighting)
    others = np.delete(np.arange(len(recordings)), found.reference)
    return make_stream(
        f"{prefix}/differences",
        schemas.ARRIVAL_DIFFERENCE,
        np.full(len(others), time_ns),
        metadata={"speed_of_sound_mps": repr(float(speed_of_sound_mps))},
        microphone_id=microphone_id[others],
        reference_id=np.full(len(others), microphone_id[found.reference]),
        difference_s=found.delay_s[others],
        variance_s2=found.variance_s2[others],
        reference_variance_s2=np.full(len(others), found.variance_s2[found.reference]),
        likeness=found.likeness[others],
    )


def microphone_stream(time_ns: int, places_m: Floats) -> Stream:
    """Make the stream of microphone positions, with microphones numbered from 1.

    Args:
        time_ns: stamp of all messages.
        places_m: positions (n, 3).
    """
    return make_stream(
        "/microphones",
        schemas.LANDMARK,
        np.full(len(places_m), time_ns),
        landmark_id=np.arange(1, len(places_m) + 1),
        position_m=places_m,
    )
