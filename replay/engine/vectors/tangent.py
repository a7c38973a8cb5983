"""Comparison and interpolation of angles, axes and orientations in their tangent space.

Every component of a state has a kind. The two components of an axis and the four of a quaternion are
adjacent; an axis or a quaternion equals its negative. The error of an axis or a quaternion is the
rotation from truth to estimate in the body's frame, as an angle or a rotation vector. The covariances of
estimates are covariances of this error. Kurz, Gilitschenski, Julier, Hanebeck, "Recursive Bingham
Filter", JAIF 9(2), 2014, sections 5.3 and 7.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.log import Stream
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.models.planar import wrap_angle

Floats = NDArray[np.float64]
Number = TypeVar("Number")
Kind = Literal["linear", "angle", "axis", "quaternion"]
# Number of components of each kind.
WIDTHS: dict[str, int] = {"linear": 1, "angle": 1, "axis": 2, "quaternion": 4}
# Number of components of the error of each kind.
TANGENT_WIDTHS: dict[str, int] = {"linear": 1, "angle": 1, "axis": 1, "quaternion": 3}


def are_kinds(kinds: Sequence[str]) -> bool:
    """Test whether all kinds exist and the components of every axis and quaternion are adjacent."""
    index = 0
    while index < len(kinds):
        width = WIDTHS.get(kinds[index])
        if width is None or tuple(kinds[index : index + width]) != (kinds[index],) * width:
            return False
        index += width
    return True


def manifold_blocks(kinds: Sequence[str]) -> Iterator[tuple[str, "slice[int, int, int]"]]:
    """Yield the kind and columns of every linear component, angle, axis and quaternion."""
    index = 0
    while index < len(kinds):
        width = WIDTHS[kinds[index]]
        yield kinds[index], slice(index, index + width)
        index += width


def tangent_components(components: Sequence[str], kinds: Sequence[str]) -> list[tuple[str, str]]:
    """Return names and kinds of error components: `heading_w`, ... become `heading_x_rad`, ...

    A linear component or an angle keeps its name; an axis becomes one component of kind "angle", a
    quaternion three components of kind "rotation". If the names have no common stem, as in `qw, qx, qy,
    qz`, the result is `rotation_x_rad`, ...

    Args:
        components: names.
        kinds: one for each name.
    """
    return list(_tangent_components(tuple(components), tuple(kinds)))


@lru_cache(maxsize=64)
def _tangent_components(
    components: tuple[str, ...], kinds: tuple[str, ...]
) -> tuple[tuple[str, str], ...]:
    found: list[tuple[str, str]] = []
    for kind, columns in manifold_blocks(kinds):
        name = components[columns.start]
        stem = name.rpartition("_")[0] or _common(components[columns])
        if (f"{stem}_x_rad", "rotation") in found or (f"{stem}_rad", "angle") in found:
            stem = name  # several rotations or angles have this stem
        if kind == "quaternion":
            found += [(f"{stem}_{axis}_rad", "rotation") for axis in "xyz"]
        else:
            found.append((f"{stem}_rad", "angle") if kind == "axis" else (name, kind))
    return tuple(found)


def _common(names: Sequence[str]) -> str:
    """Return the common prefix of a vector's component names, or `rotation` if it is too short."""
    stem = names[0]
    while not all(name.startswith(stem) for name in names):
        stem = stem[:-1]
    return stem if len(stem) > 1 else "rotation"


def named_now(
    given: Mapping[str, Number], components: Sequence[str], kinds: Sequence[str]
) -> dict[str, Number]:
    """Rename error components from the names of the previous release to the current ones.

    >>> named_now({"qw_x_rad": 0.1}, ("qw", "qx", "qy", "qz"), ("quaternion",) * 4)
    {'rotation_x_rad': 0.1}
    """
    names, before = [name for name, _ in tangent_components(components, kinds)], list[str]()
    for kind, columns in manifold_blocks(kinds):
        name = components[columns.start]
        stem = name.rpartition("_")[0] or name
        own = {"quaternion": [f"{stem}_{axis}_rad" for axis in "xyz"], "axis": [f"{stem}_rad"]}
        before += own.get(kind, [name])
    renamed = {old: new for old, new in zip(before, names, strict=True) if old not in names}
    return {renamed.get(name, name): number for name, number in given.items()}


def difference(estimate: Floats, truth: Floats, kinds: Sequence[str]) -> Floats:
    """Compute errors, estimate minus truth, in the tangent space (n, tangent components).

    Args:
        estimate: (n, components).
        truth: (n, components).
        kinds: one for each component.
    """
    error = np.empty((len(estimate), sum(TANGENT_WIDTHS[kind] for kind, _ in manifold_blocks(kinds))))
    scalars, row = [], 0
    for kind, columns in manifold_blocks(kinds):
        if kind in ("axis", "quaternion"):
            relative = compose(conjugate(truth[:, columns]), estimate[:, columns])
            error[:, row : row + TANGENT_WIDTHS[kind]] = rotation_vector(relative)
        else:
            scalars.append((columns.start, row, kind == "angle"))
        row += TANGENT_WIDTHS[kind]
    _subtract(estimate, truth, np.array(scalars, np.int64).reshape(-1, 3).T.copy(), error)
    return error


def between(
    state: Floats,
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    weight: Floats,
    kinds: Sequence[str],
) -> Floats:
    """Interpolate between pairs of states along the shortest way, with weights (n,).

    Args:
        state: (m, components).
        left, right: (n,), rows of the states.
        weight: (n,), from 0 for left to 1 for right.
        kinds: one for each component.
    """
    value, scalars = np.empty((len(weight), state.shape[1])), []
    for kind, columns in manifold_blocks(kinds):
        if kind in ("axis", "quaternion"):
            value[:, columns] = _slerp(state[left, columns], state[right, columns], weight)
        else:
            scalars.append((columns.start, kind == "angle"))
    _interpolate(state, left, right, weight, np.array(scalars, np.int64).reshape(-1, 2).T.copy(), value)
    return value


def subtract(estimate: Floats, truth: Floats, scalars: NDArray[np.int64], error: Floats) -> None:
    """Subtract linear components and angles; see `difference`.

    Args:
        estimate, truth: (n, components).
        scalars: (3, m), for each component, its column, the column of its error, and whether it is an
            angle.
        error: (n, tangent components), filled in these columns.
    """
    for row in range(len(error)):
        for each in range(scalars.shape[1]):
            change = estimate[row, scalars[0, each]] - truth[row, scalars[0, each]]
            error[row, scalars[1, each]] = wrap_angle(change) if scalars[2, each] else change


def interpolate(
    state: Floats,
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    weight: Floats,
    scalars: NDArray[np.int64],
    value: Floats,
) -> None:
    """Interpolate linear components and angles; see `between`.

    Args:
        state: (m, components).
        left, right: (n,).
        weight: (n,).
        scalars: (2, m), for each component, its column, and whether it is an angle.
        value: (n, components), filled in these columns.
    """
    for row in range(len(value)):
        for each in range(scalars.shape[1]):
            here = state[left[row], scalars[0, each]]
            change = state[right[row], scalars[0, each]] - here
            change = wrap_angle(change) if scalars[1, each] else change
            value[row, scalars[0, each]] = here + weight[row] * change


_subtract, _interpolate = compiled(subtract, for_sizes=True), compiled(interpolate, for_sizes=True)


def truth_at(
    truth: Stream, time_ns: NDArray[np.int64], kinds: Sequence[str], gap_limit_s: float
) -> Floats:
    """Interpolate the true state (n, d) at any stamps; see `states_at`.

    Args:
        truth: stream whose `state` is (m, d).
        time_ns: (n,), stamps in ns.
        kinds: one for each component.
        gap_limit_s: the longest gap in s to interpolate over.
    """
    return states_at(truth.publish_time_ns, truth["state"], time_ns, kinds, gap_limit_s)


def states_at(
    times: NDArray[np.int64],
    state: Floats,
    time_ns: NDArray[np.int64],
    kinds: Sequence[str],
    gap_limit_s: float,
) -> Floats:
    """Interpolate states (m, d) at times (m,) to states (n, d) at stamps (n,), along the shortest way.

    The result is NaN in gaps longer than the limit, except at the stamps of the states themselves.

    Args:
        times: (m,), in ns and in order.
        state: (m, d).
        time_ns: (n,), stamps in ns.
        kinds: one for each component.
        gap_limit_s: the longest gap in s to interpolate over.
    """
    return states_of_runs([(times, state)], time_ns, np.array([0, len(time_ns)]), kinds, gap_limit_s)


def states_of_runs(
    known: Sequence[tuple[NDArray[np.int64], Floats]],
    time_ns: NDArray[np.int64],
    offsets: NDArray[np.int64],
    kinds: Sequence[str],
    gap_limit_s: float,
) -> Floats:
    """Interpolate states of several runs to stamps (n,) of the same runs; see `states_at`.

    Args:
        known: for each run, times (m,) in ns and in order, and the states (m, d) at them.
        time_ns: (n,), stamps in ns, run by run.
        offsets: (runs + 1,), first stamp of each run.
        kinds: one for each component.
        gap_limit_s: the longest gap in s to interpolate over.
    """
    times, state = (np.concatenate(parts) for parts in zip(*known, strict=True))
    if not len(state):
        return np.full((len(time_ns), len(kinds)), np.nan)
    starts = np.cumsum([0, *(len(own) for own, _ in known)])
    left, right = np.zeros((2, len(time_ns)), np.int64)
    weight = np.empty(len(time_ns))
    _bracket(times, starts, time_ns, offsets, gap_limit_s * 1e9, left, right, weight)
    return between(state, left, right, weight, kinds)


def bracket(
    times: NDArray[np.int64],
    starts: NDArray[np.int64],
    time_ns: NDArray[np.int64],
    offsets: NDArray[np.int64],
    longest_ns: float,
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    weight: Floats,
) -> None:
    """Find the states before and after stamps, and the weight of the later one.

    Args:
        times: (m,), times of states in ns, run by run and in order.
        starts: (runs + 1,), first state of each run.
        time_ns: (n,), stamps in ns, run by run; the search is fast if they are in order.
        offsets: (runs + 1,), first stamp of each run.
        longest_ns: the longest gap to interpolate over.
        left, right: (n,), indices of the states before and after each stamp, filled unless a run has no
            states; they are equal if a state has this stamp.
        weight: (n,), weights of the later states, filled; NaN if the state at the stamp is unknown.
    """
    for run in range(len(offsets) - 1):
        begin, end = starts[run], starts[run + 1]
        at = begin
        for row in range(offsets[run], offsets[run + 1]):
            weight[row] = np.nan
            if begin < end:
                stamp_ns = time_ns[row]
                while at < end - 1 and times[at] < stamp_ns:
                    at += 1
                while at > begin and times[at - 1] >= stamp_ns:
                    at -= 1
                before = max(at - 1, begin) if times[at] > stamp_ns else at
                left[row], right[row] = before, at
                span_ns = times[at] - times[before]
                if times[before] <= stamp_ns <= times[at] and span_ns <= longest_ns:
                    weight[row] = (stamp_ns - times[before]) / max(span_ns, 1)


_bracket = compiled(bracket)


def rotation_vector(x: Floats) -> Floats:
    """Convert unit complex numbers (n, 2) to angles, or unit quaternions (n, 4) to rotation vectors.

    The results are in rad. x and -x are the same rotation, so the angle of an axis is in [-pi/2, pi/2].
    """
    folded = x * np.where(x[:, :1] < 0.0, -1.0, 1.0)
    length = np.linalg.norm(folded[:, 1:], axis=1, keepdims=True)
    angle = np.arctan2(length, folded[:, :1])
    small = length < 1e-12
    scale = np.where(small, 1.0, angle / np.where(small, 1.0, length))
    return (1.0 if x.shape[1] == 2 else 2.0) * scale * folded[:, 1:]


def _slerp(left: Floats, right: Floats, weight: Floats) -> Floats:
    """Interpolate along the great circle from left to the nearer of right and -right."""
    turn = rotation_vector(compose(conjugate(left), right))
    angle = (1.0 if left.shape[1] == 2 else 0.5) * weight[:, None] * turn
    length = np.linalg.norm(angle, axis=1, keepdims=True)
    step = np.concatenate([np.cos(length), angle * np.sinc(length / np.pi)], axis=1)
    return compose(left, step)
