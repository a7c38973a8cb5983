"""What is said of a sensor's noise, and in which order: recordings at rest of noises that are known."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.sensing import study
from fuselog.pipeline.sensing.noise import noise
from fuselog.pipeline.sensing.terms import Terms
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.replay.engine.streams.sources import MemorySource

STEP_S, SIZE = 0.04, 3000
TIMES_S = STEP_S * np.arange(SIZE)
SHEET = {"turn_rate_radps": "0.05 deg/s/sqrt(Hz)", "specific_force_mps2": "100 ug/sqrt(s)"}


def at_rest() -> Iterator[str]:
    """A unit whose axes walk, are steady, or forget; messages are lost; a sheet is given."""
    turn = _columns([Terms(1e-3, 3e-4), Terms(1e-3), Terms(1e-3, 0.0, 2e-3, 2.0)])
    force = np.full((SIZE, 3), np.nan)
    force[:, :1] = _columns([Terms(1e-2)])
    yield from _said(turn, force, lost=slice(200, 230))


def disturbed() -> Iterator[str]:
    """Another that warms up, drifts, vibrates, and whose neighbours are alike."""
    turn, force = _columns([Terms(1e-3)] * 3), _columns([Terms(1e-2)] * 3)
    turn[:, 0] += 0.02 * np.exp(-TIMES_S / 10.0)
    turn[:, 1] += 1e-4 * TIMES_S
    turn[:, 2] += 2e-3 * np.sin(0.25 * np.pi * TIMES_S)
    force[:, 0] = np.convolve(np.pad(force[:, 0], 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    force[:, 1] = np.nan
    force[:, 2] += 1e-4 * TIMES_S + 0.2 * np.exp(-TIMES_S / 4.0) + 0.03 * np.sin(44.0 * TIMES_S)
    yield from _said(turn, force, taus=[0.4, 4.0])


SENSED = (at_rest, disturbed)


def _columns(terms: list[Terms]) -> NDArray[np.float64]:
    return np.stack([study.unit(n, SIZE, each, STEP_S) for n, each in enumerate(terms)], axis=1)


def _said(
    turn: NDArray[np.float64],
    force: NDArray[np.float64],
    lost: slice = slice(0, 0),
    taus: list[float] | None = None,
) -> Iterator[str]:
    """The sentences of the command."""
    is_there = np.ones(SIZE, bool)
    is_there[lost] = False
    stream = make_stream(
        "/imu",
        schemas.INERTIAL_SAMPLE,
        np.rint(1e9 * TIMES_S).astype(np.int64),
        specific_force_mps2=force + np.array([0.0, 0.0, 9.81]),
        turn_rate_radps=turn,
        magnetic_field_ut=np.full((SIZE, 3), np.nan),
    ).take(is_there)
    source = MemorySource({stream.topic: stream}, RunMetadata("made", {}), "made")
    found = noise(source, sheet=SHEET, taus=taus or ())
    yield from (f"  {note}" for note in found.notes)
