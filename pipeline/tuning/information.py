"""Measures what the motion in logs tells of a calibration before any search, and what it lacks.

With v the innovations and S their covariances, I = sum dv' S^-1 dv over all measurements, where dv are
the derivatives by the parameters. In units that are useful for each, a direction whose eigenvalue is
below one is not determined: no pseudo-inverse, which would give it a small standard error. Such
directions by motion: Yang et al., arXiv 2201.09170; wheels: Censi et al., IEEE T-RO 2013.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.optimise import QUANTILE
from fuselog.pipeline.tuning.objective import Objective, Run, innovations_in
from fuselog.pipeline.tuning.search import MOVES
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameter
from fuselog.replay.judging.consistency.whiteness import whitened

Floats = NDArray[np.float64]
STEP = 0.01  # of the differences, in useful units
LEAST = 1.0  # an eigenvalue: a standard error as large as is useful
INVOLVED = 0.3  # of a parameter's axis in what is not determined
FURTHEST = float(MOVES[-1])  # useful units that what is held may be wrong by
NAMED = 0.1  # of a direction, beside its largest part


class Undetermined(NamedTuple):
    """Holds what the motion does not determine of m parameters.

    Attributes:
        eigenvalues: (m,) of the information in useful units, the least first.
        directions: (d, m) that are not determined, in useful units, each of few parameters.
        places: of the parameters that take part in these.
    """

    eigenvalues: Floats
    directions: Floats
    places: list[int]


def information(objective: Objective, values: Floats, useful: Floats, places: Sequence[int]) -> Floats:
    """Compute the information that all logs hold on some of the parameters.

    Measurements that one side of a difference lacks tell nothing.

    Args:
        objective: replays the logs.
        values: (k,), where the derivatives are taken.
        useful: (k,), each parameter's useful unit.
        places: which m of the k parameters.

    Returns:
        (m, m), in useful units.
    """
    found = np.zeros((len(places), len(places)))
    values = values + 2.0 * STEP * useful  # beside a delay of zero, at which stamps are equal
    for run in objective.runs:
        here = _innovations(objective, values, run)
        columns = []
        for place in places:
            step = np.zeros(len(values))
            step[place] = STEP * useful[place]
            ahead, behind = (_innovations(objective, values + way * step, run) for way in (1.0, -1.0))
            columns.append(
                np.concatenate([
                    _whitened_difference(stream, ahead.get(topic), behind.get(topic))
                    for topic, stream in here.items()
                ])
            )  # fmt: skip
        derivatives = np.stack(columns, axis=1) / (2.0 * STEP)
        found += derivatives.T @ derivatives
    return found


def undetermined(scaled: Floats) -> Undetermined:
    """Return what an information (m, m) in useful units leaves open.

    At a constant speed of 8 m/s a sensor 0.2 m ahead is one that is 0.025 s late:

    >>> known = np.array([[1.0, -0.5, 0.0], [-0.5, 0.25, 0.0], [0.0, 0.0, 1.0]]) * 100.0
    >>> open_ = undetermined(known)
    >>> open_.places, open_.directions.round(1).tolist()
    ([0, 1], [[0.5, 1.0, 0.0]])
    """
    eigenvalues, vectors = np.linalg.eigh(scaled)
    spanned = vectors[:, eigenvalues < LEAST]
    share = np.sqrt(np.sum(spanned**2, axis=1))
    return Undetermined(eigenvalues, _sparse(spanned.T), np.flatnonzero(share > INVOLVED).tolist())


def in_words(
    names: Sequence[str], lacking: Undetermined, free: Sequence[Parameter], held: Sequence[str]
) -> str:
    """Name what the motion does not determine: parameters (m,), combinations of them; what stays."""
    alone: list[str] = []
    together: list[str] = []
    for direction in lacking.directions:
        parts = [
            names[place] for place in np.argsort(-np.abs(direction)) if abs(direction[place]) > NAMED
        ]
        (together if len(parts) > 1 else alone).append(" with ".join(parts))
    stay = ", ".join(f"{each.name} = {each.default:g}" for each in free if each.name in held)
    return (
        f"the motion in the logs does not determine {', '.join([*alone, *together])}: held where they "
        f"started ({stay}), without an interval; record turns in both senses at changing speed"
    )


def conditions(
    scaled: Floats, places: Sequence[int], free: Sequence[Parameter], held: Sequence[str]
) -> Iterator[str]:
    """Yield a sentence for each parameter whose interval is right only if one that is held is right.

    What is held may be wrong by as much as the logs leave open, at most by `FURTHEST` useful units.

    Args:
        scaled: (m, m), the information in useful units.
        places: of these m parameters among the free ones.
        free: all parameters.
        held: the names of those that stay where they started.
    """
    names, useful = np.array([(free[place].name, free[place].useful) for place in places], object).T
    stays = np.isin(names, held)
    if stays.all():
        return
    errors = np.sqrt(np.diagonal(np.linalg.inv(scaled + np.diag(stays / FURTHEST**2))))[stays]
    covariance = np.linalg.pinv(scaled[np.ix_(~stays, ~stays)])
    shifts = -covariance @ scaled[np.ix_(~stays, stays)]
    is_moved = np.abs(shifts) * errors > QUANTILE * np.sqrt(np.diagonal(covariance))[:, None]
    for name, unit, row, counts in zip(names[~stays], useful[~stays], shifts, is_moved, strict=True):
        moves = [
            f"{by * unit:+.2g} if {other} is larger by {step:g}"
            for other, step, by in zip(
                names[stays][counts], useful[stays][counts], row[counts], strict=True
            )
        ]
        if moves:
            yield (
                f"{name}: the value and its interval are right only if what is held is right: the value "
                f"changes by {', by '.join(moves)}"
            )


def _innovations(objective: Objective, values: Floats, run: Run) -> dict[str, Stream]:
    return dict(innovations_in(objective.outputs(values, run)))


def _whitened_difference(here: Stream, ahead: Stream | None, behind: Stream | None) -> Floats:
    """Compute a difference of innovations by message, by the covariances of those between (n m,).

    A delay changes the order among topics, never within one.
    """
    shape = here["innovation"].shape
    if (
        ahead is None
        or behind is None
        or {ahead["innovation"].shape, behind["innovation"].shape} != {shape}
    ):
        return np.zeros(shape).ravel()
    difference = {**here.columns, "innovation": ahead["innovation"] - behind["innovation"]}
    found = whitened(replace(here, columns=difference))
    return np.where(np.isfinite(found), found, 0.0).ravel()


def _sparse(directions: Floats) -> Floats:
    """Span the same (d, m) by directions of as few parameters each as elimination leaves."""
    rows = directions.copy()
    for number in range(len(rows)):
        rest = np.abs(rows[number:])
        row, column = divmod(int(np.argmax(rest)), rest.shape[1])
        rows[[number, number + row]] = rows[[number + row, number]]
        rows[number] /= rows[number, column]
        others = np.arange(len(rows)) != number
        rows[others] -= np.outer(rows[others, column], rows[number])
    return rows
