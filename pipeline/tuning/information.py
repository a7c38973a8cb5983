"""The information that the motion in logs contains about a calibration, computed before any search.

With the innovations v and their covariances S, I = sum dv' S^-1 dv over all measurements, where dv are
the derivatives of v with respect to the parameters. In useful units, a direction with an eigenvalue
below one is not determined. A pseudo-inverse is not used, because it would assign a small standard error
to such a direction. Yang et al., arXiv 2201.09170, list such directions by kind of motion; Censi et al.,
IEEE T-RO 2013, list those for wheels.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.optimise import QUANTILE
from fuselog.pipeline.tuning.objective import Objective, Run, innovations_in
from fuselog.pipeline.tuning.search import MOVES
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameter
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.judging.consistency.whiteness import whitened

STEP = 0.01  # step of the finite differences, in useful units
LEAST = 1.0  # eigenvalue at which the standard error equals the useful error
INVOLVED = 0.3  # component of an undetermined direction above which a parameter is involved
FURTHEST = float(MOVES[-1])  # largest error of a fixed parameter that is considered, in useful units
NAMED = 0.1  # component of a direction, relative to its largest, above which a parameter is named


class Undetermined(NamedTuple):
    """Directions of m parameters that the motion does not determine.

    Attributes:
        eigenvalues: (m,) eigenvalues of the information in useful units, in ascending order.
        directions: (d, m) undetermined directions in useful units, each with few parameters.
        places: indices of the parameters that are involved in these directions.
    """

    eigenvalues: Floats
    directions: Floats
    places: list[int]


def information(objective: Objective, values: Floats, useful: Floats, places: Sequence[int]) -> Floats:
    """Compute the information of all logs on some of the parameters.

    A measurement that is missing on one side of a difference contributes nothing.

    Args:
        objective: the cost, which replays the logs.
        values: (k,), the point at which derivatives are taken.
        useful: (k,), each parameter's useful unit.
        places: the indices of m of the k parameters.

    Returns:
        The information (m, m) in useful units.
    """
    found = np.zeros((len(places), len(places)))
    values = values + 2.0 * STEP * useful  # not at a delay of zero, at which stamps are equal
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
    """Find the directions that an information matrix (m, m) in useful units leaves undetermined.

    At a constant speed of 8 m/s, a sensor that is 0.2 m further ahead looks like one that is 0.025 s
    late:

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
    """Describe undetermined parameters (m,), combinations of them, and the fixed values."""
    alone: list[str] = []
    together: list[str] = []
    for direction in lacking.directions:
        parts = [
            names[place] for place in np.argsort(-np.abs(direction)) if abs(direction[place]) > NAMED
        ]
        (together if len(parts) > 1 else alone).append(" with ".join(parts))
    stay = ", ".join(f"{each.name} = {each.default:g}" for each in free if each.name in held)
    return (
        f"the motion in the logs does not determine {', '.join([*alone, *together])}: fixed at the "
        f"start values ({stay}), without an interval; record turns in both directions at varying speed"
    )


def conditions(
    scaled: Floats, places: Sequence[int], free: Sequence[Parameter], held: Sequence[str]
) -> Iterator[str]:
    """Yield a sentence for each parameter whose interval is valid only if a fixed parameter is right.

    Fixed parameters may be wrong by as much as the logs allow, but at most by `FURTHEST` useful units.

    Args:
        scaled: (m, m), the information in useful units.
        places: the indices of these m parameters among the free ones.
        free: all free parameters.
        held: the names of the parameters that are fixed at their start.
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
                f"{name}: the value and its interval hold only if the fixed parameters are right: it "
                f"changes by {', by '.join(moves)}"
            )


def _innovations(objective: Objective, values: Floats, run: Run) -> dict[str, Stream]:
    return dict(innovations_in(objective.outputs(values, run)))


def _whitened_difference(here: Stream, ahead: Stream | None, behind: Stream | None) -> Floats:
    """Compute differences of innovations (n m,), ahead minus behind, whitened like those in `here`.

    A delay changes the order of messages between topics, but never within one.
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
    """Rewrite directions (d, m) by elimination, with the same span and few parameters each."""
    rows = directions.copy()
    for number in range(len(rows)):
        rest = np.abs(rows[number:])
        row, column = divmod(int(np.argmax(rest)), rest.shape[1])
        rows[[number, number + row]] = rows[[number + row, number]]
        rows[number] /= rows[number, column]
        others = np.arange(len(rows)) != number
        rows[others] -= np.outer(rows[others, column], rows[number])
    return rows
