"""Preparation of recordings at rest, as samples on a grid without motion and warm-up drift."""

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from fuselog.pipeline.sensing.fitting import fit
from fuselog.pipeline.sensing.likelihood import Samples, likelihood, residuals
from fuselog.recorders.errors import BadInput
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.arrays import Floats, Integers

FEWEST, SHORTEST_S = 500, 20.0
MOST = 1 << 16  # largest number of samples in a likelihood; longer recordings are averaged in blocks
_GAP = 1.75  # a step that is longer than this multiple of the median is a gap
_MOST_LOST = 0.4
# Largest spread of one-second means of a unit at rest, by unit; no sensor drifts this far.
_STILL = {"rad/s": 0.03, "m/s^2": 0.3}
# gain in log-likelihood of a line and an exponential that chance exceeds in 1 of 100 recordings
_DRIFT_GAIN = 4.6
_IMPROBABLE = 1e-4
_DRIFT_SAMPLES = 4096


class Grid(NamedTuple):
    """A grid for a topic's stamps: its step, and each message's grid index (n,) and row (n,)."""

    step_s: float
    places: Integers
    rows: Integers

    @property
    def size(self) -> int:
        """Return the number of grid points."""
        return int(self.places[-1]) + 1

    @property
    def lost(self) -> float:
        """Return the share of lost messages."""
        return 1 - len(self.places) / self.size


class Drift(NamedTuple):
    """The drift of a column, as a rate and a decaying offset, and the gain in log-likelihood."""

    rate: float
    rate_sigma: float
    offset: float
    time_s: float
    gain: float

    def over(self, times_s: Floats) -> Floats:
        """Compute the drift (n,) at times since the first sample."""
        return self.rate * times_s + self.offset * np.exp(-times_s / self.time_s)


def grid_of(topic: str, stamps: Integers, position: Integers) -> Grid:
    """Fit a grid to a topic's stamps; its step is the mean of all steps that are not gaps.

    Args:
        topic: name of the topic.
        stamps: (n,), stamps in ns, in order.
        position: (n,), position of each message in the file.

    Raises BadInput if there are too few messages, stamps decrease in the file, or too many messages are
    lost.
    """
    span_s = (stamps[-1] - stamps[0]) * 1e-9 if len(stamps) else 0.0
    if len(stamps) < FEWEST or span_s < SHORTEST_S:
        raise BadInput(
            f"{topic}: has {len(stamps)} messages in {span_s:.3g} s; an estimate of noise needs "
            f"at least {FEWEST} in {SHORTEST_S:.0f} s, and that of a random walk an hour at rest"
        )
    if (np.diff(position) < 0).any():
        back = int((np.diff(stamps[np.argsort(position, kind="stable")]) < 0).sum())
        if back:
            raise BadInput(
                f"{topic}: its stamps go backwards {back} times; record it with one clock, or write it "
                "in order with fuselog cut"
            )
    rows = np.flatnonzero(np.diff(stamps, prepend=stamps[0] - 1) > 0)
    steps = np.diff(stamps[rows]) * 1e-9
    median_s = float(np.median(steps))
    is_gap = steps > _GAP * median_s
    step_s = float(steps[~is_gap].mean())
    places = np.ones(len(rows), np.int64)
    places[0], places[1:][is_gap] = 0, np.maximum(np.rint(steps[is_gap] / step_s), 2)
    np.cumsum(places, out=places)
    grid = Grid(step_s, rows if np.array_equal(places, rows) else places, rows)  # one array, if equal
    if grid.lost > _MOST_LOST:
        raise BadInput(
            f"{topic}: {100 * grid.lost:.0f} % of the messages are lost, in "
            f"{int(is_gap.sum())} gaps; record again, or select a complete part with fuselog cut"
        )
    return grid


def on_grid(values: Floats, grid: Grid) -> Floats:
    """Arrange samples at their points on the grid.

    Args:
        values: (n,), the values of all messages, in the order of the stream.
        grid: the grid of the stream.

    Returns:
        The samples (grid.size,), NaN where a sample was lost.
    """
    found = np.full(grid.size, np.nan)
    found[grid.places] = values[grid.rows]
    return found


def check_at_rest(name: str, field: str, values: Floats, step_s: float) -> None:
    """Raise BadInput if samples are too few or constant, or if the unit moves.

    Args:
        name: the name of the samples in messages.
        field: the field's name, which ends with its unit.
        values: (n,), on a grid, NaN where a sample was lost.
        step_s: the grid's step.
    """
    there = values[np.isfinite(values)]
    if len(there) < FEWEST:
        raise BadInput(f"{name}: has {len(there)} numbers; an estimate of noise needs at least {FEWEST}")
    if np.ptp(there) == 0:
        raise BadInput(f"{name}: is constant, {there[0]:.6g}; an active sensor has noise")
    del there
    means = block_means(values, max(1, round(1 / step_s)))
    spread, most = float(np.nanstd(means)), _STILL.get(unit_of(field), math.inf)
    size = max(20, len(values) // 200)
    blocks = np.diff(values)[: (len(values) - 1) // size * size].reshape(-1, size)
    is_there, activity = np.isfinite(blocks).any(axis=1), np.zeros(len(blocks))
    activity[is_there] = np.sqrt(np.nanmean(blocks[is_there] ** 2, axis=1))
    busiest = int(np.argmax(activity))
    if spread > most or activity[busiest] > 4 * np.median(activity[is_there]) > 0:
        at_s = busiest * size * step_s
        raise BadInput(
            f"{name}: the unit moves, most at {at_s:.0f} s into the log; record it at rest, or select "
            "the part at rest with fuselog cut"
        )


def block_means(values: Floats, block: int) -> Floats:
    """Average blocks of samples on a grid.

    Args:
        values: (n,), NaN where a sample was lost.
        block: the number of grid points in a block.

    Returns:
        The means (n // block,), NaN if more than half of a block is lost.
    """
    if block == 1:
        return values
    blocks = values[: len(values) // block * block].reshape(-1, block)
    is_there = np.isfinite(blocks)
    counts = is_there.sum(axis=1)
    sums = np.where(is_there, blocks, 0.0).sum(axis=1)
    return np.where(2 * counts >= block, sums / np.maximum(counts, 1), np.nan)


def samples_of(values: Floats, step_s: float, regressors: Floats | None = None) -> Samples:
    """Convert samples on a grid to the form that the likelihood accepts.

    Args:
        values: (n,), NaN where a sample was lost.
        step_s: the grid's step.
        regressors: (n, k), quantities on which the samples may depend; by default there are no
            regressors.

    Returns:
        The samples that were not lost, relative to the first one.
    """
    rows = np.flatnonzero(np.isfinite(values))
    columns = values[rows, None] if regressors is None else np.column_stack([values, regressors])[rows]
    # the first value is subtracted to reduce rounding errors
    return Samples(np.ascontiguousarray(columns - columns[0]), np.diff(rows, prepend=rows[0]), step_s)


def find_drift(values: Floats, step_s: float) -> Drift | None:
    """Find the drift of a sensor that warms up, as a line, or as a line and an exponential.

    Args:
        values: (n,), on a grid, NaN where a sample was lost.
        step_s: the grid's step.

    Returns:
        The drift; None if the samples are not explained significantly better than without drift.
    """
    block = -(-len(values) // _DRIFT_SAMPLES)
    means, step_s = block_means(values, block), step_s * block
    times_s = (np.arange(len(means)) + 0.5 * (1 - 1 / block)) * step_s
    span_s = float(times_s[-1])
    best = fit(samples_of(means, step_s), ("walk",))
    found = None
    for share in (math.inf, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4):
        decay = np.exp(-times_s / (share * span_s))
        columns = np.stack([times_s] if share == math.inf else [times_s, decay], axis=1)
        samples = samples_of(means, step_s, columns)
        drifting = fit(samples, ("walk",))
        gain = drifting.log_likelihood - best.log_likelihood - (found.gain if found else 0.0)
        if gain > (_DRIFT_GAIN if found is None or not found.offset else 0.0):
            fitted = likelihood(samples, drifting.terms)
            offset = float(fitted.coefficients[1]) if share < math.inf else 0.0
            gain += found.gain if found else 0.0
            rate, sigma = float(fitted.coefficients[0]), float(fitted.sigmas[0])
            found = Drift(rate, sigma, offset, share * span_s, gain)
    return found


def fewest_block(count: int) -> int:
    """Compute how many samples to average so that a likelihood uses at most `MOST` means."""
    return -(-count // MOST)


def white_block(values: Floats, step_s: float) -> int:
    """Find how many samples to average so that the noise is white apart from drift.

    If a sensor filters its output, neighbouring samples are correlated, and a likelihood of all samples
    underestimates the noise. The correlation appears in the residuals of a fit of white noise and a
    walk.

    Args:
        values: (n,), on a grid, NaN where a sample was lost.
        step_s: the grid's step.

    Returns:
        The number of samples in a block, for `block_means`.
    """
    block = fewest_block(len(values))
    while len(values) // (2 * block) >= FEWEST:
        samples = samples_of(block_means(values, block), step_s * block)
        white = residuals(samples, fit(samples, ("walk",)).terms)
        correlation = float(white[1:] @ white[:-1] / (white @ white))
        if correlation < max(3 / math.sqrt(len(white)), 0.02):
            break
        block *= 2
    return block


def find_vibration(values: Floats, step_s: float) -> tuple[float, float] | None:
    """Find a line in the spectrum, for example from vibration.

    Args:
        values: (n,), on a grid, NaN where a sample was lost; only the first `MOST` are used.
        step_s: the grid's step.

    Returns:
        The frequency of the line in Hz and its amplitude in the unit of the samples; None if there is no
        line.
    """
    part = values[:MOST]
    part = np.where(np.isfinite(part), part - np.nanmean(part), 0.0)
    window = np.hanning(len(part))
    power = np.abs(np.fft.rfft(part * window)) ** 2
    width = min(201, len(power) // 4 * 2 + 1)
    usual = median_filter(power, width) / math.log(2)
    first = width // 2  # lower frequencies are drifts
    line = first + int(np.argmax(power[first:] / usual[first:]))
    if power[line] < 1.5 * usual[line] * math.log(len(power) / _IMPROBABLE):
        return None
    amplitude = 2 * math.sqrt(power[line]) / window.sum()
    return line / (len(part) * step_s), amplitude
