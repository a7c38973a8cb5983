"""Predicted measurements of tracks, and updates of tracks by a scan.

A kind of sensor defines its measurement of a target, the probability of detection and the density of
clutter. If the detections of a scan have the probabilities b_j, and a miss has the probability b_0, the
update uses the mean v of the innovations v_j, and the covariance of the track becomes

    P - (1 - b_0) K S K' + K (sum_j b_j v_j v_j' - v v') K',   v = sum_j b_j v_j

(Bar-Shalom, Fortmann, Tracking and Data Association, 1988, 6.4). If one assignment is chosen, this is
the covariance of the Kalman filter. A track with several modes has one Gaussian for each mode. The
density of a detection is the mean of the modes' densities, weighted by the probabilities of the modes. A
detection of the track changes these probabilities by Bayes' rule: the probability of mode i becomes

    mu_i b_0 + sum_j b_j mu_i g_ij / sum_k mu_k g_kj,

and the normalised terms of this sum are the probabilities for the update of the mode's Gaussian (Blom,
Bloem, IEEE TAC 45(2), 2000).
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.states import PLANE_MOTION
from fuselog.replay.engine.arrays import Booleans, Floats, Integers, Numbers, Settings, varying
from fuselog.replay.families.tracking.association.clusters import AssociationMemory, Weights, memory_for
from fuselog.replay.families.tracking.association.scans import Scans, ScanSensor
from fuselog.replay.families.tracking.association.shared_bias import Pool, pool_of
from fuselog.replay.families.tracking.association.tracks import Tracks
from fuselog.replay.inference.kalman.steps import CoreMemory, Workspace, workspace
from fuselog.replay.inference.kalman.update import sensor_derivative
from fuselog.replay.inference.linear_algebra.gaussian import Innovation, kalman_step, whiten, wrap
from fuselog.replay.inference.linear_algebra.tuples import adding_noise, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel, traced_sensor
from fuselog.replay.inference.model.corrections import correcting, sloping
from fuselog.replay.inference.model.functions import OfParameters
from fuselog.replay.inference.model.model import Model, Sensor


@varying(1, probability=2, white=3, likelihood=3, after=0, moment=0, shift=0)
class ScanMemory(NamedTuple):
    """Scratch memory of one core; axes are tracks, their modes, and the detections of a scan.

    Attributes:
        motion: memory of the motion of tracks, see `fuselog.replay.inference.kalman.steps.Steps`.
        step: memory of the derivatives of sensors.
        pool: memory of the errors that all tracks share.
        place: (detections, 2), the detections of a scan after those close to each other are joined.
        group: (detections,), the group with which each detection is joined.
        clutter: (detections,), density of clutter and of targets that were never detected.
        undetected: (detections,), density of targets that were never detected.
        difference, spread, cross: (tracks, modes, ...), terms of the innovations; see `Innovation`.
        predicted: (tracks, modes, 2), predicted measurements.
        detectable: (tracks,), probability that each track is detected.
        white: (tracks, modes, detections, 2), whitened innovations.
        likelihood: (tracks, modes, detections), joint likelihood of a mode and a detection.
        weights, probability, association: see `association.association`.
        is_free: (detections,), whether a detection is outside all gates; left: (detections,),
            probability that a detection belongs to no track.
        given: (1 + detections,), probabilities of a track's associations in one mode.
        after: (modes,), the probability of each mode of a track after these associations.
        moment: (2, 2), second moment of the weighted innovations; `shift` (2,) is their mean.
    """

    motion: CoreMemory
    step: Workspace
    pool: Pool
    place: Floats
    group: Integers
    clutter: Floats
    undetected: Floats
    difference: Floats
    spread: Floats
    cross: Floats
    predicted: Floats
    detectable: Floats
    white: Floats
    likelihood: Floats
    weights: Weights
    probability: Floats
    association: AssociationMemory
    is_free: Booleans
    left: Floats
    given: Floats
    after: Floats
    moment: Floats
    shift: Floats


def memory_of(
    bound_model: BoundModel, motion: CoreMemory, shared: int, places: int, detections: int
) -> ScanMemory:
    """Make memory for the given numbers of shared errors, tracks, and detections in a scan."""
    modes, size = max(1, len(bound_model.modes)), bound_model.model.tangent
    return ScanMemory(
        motion=motion,
        step=workspace(bound_model),
        pool=pool_of(shared, size, places),
        place=np.empty((detections, 2)),
        group=np.empty(detections, np.int64),
        clutter=np.empty(detections),
        undetected=np.empty(detections),
        difference=np.empty((places, modes, 2)),
        spread=np.empty((places, modes, 2, 2)),
        cross=np.empty((places, modes, size, 2)),
        predicted=np.empty((places, modes, 2)),
        detectable=np.empty(places),
        white=np.empty((places, modes, detections, 2)),
        likelihood=np.empty((places, modes, detections)),
        weights=Weights(np.empty((places, detections)), np.empty(places)),
        probability=np.empty((places, 1 + detections)),
        association=memory_for(places, detections),
        is_free=np.empty(detections, bool),
        left=np.empty(detections),
        given=np.empty(1 + detections),
        after=np.empty(modes),
        moment=np.empty((2, 2)),
        shift=np.empty(2),
    )


def target_of(model: Model) -> Callable[[Numbers], Numbers]:
    """Make `target(state)`: (x_m, vx_mps, y_m, vy_mps); a velocity that the state lacks is zero."""
    names = list(model.state)
    places = tuple(names.index(name) if name in names else -1 for name in PLANE_MOTION)

    def target(state: Numbers) -> Numbers:
        return tuple(state[place] if place >= 0 else 0.0 for place in places)

    return target


@lru_cache(maxsize=64)
def measuring(model: Model, kind: ScanSensor, names: tuple[str, ...]) -> Sensor:
    """Make the model's sensor for a kind of scan sensor; its functions may read parameters `names`."""
    target, inner = target_of(model), kind.measure

    def measure(state: Numbers, reference: Numbers, parameters: Settings) -> Numbers:
        return inner(target(state), reference, parameters)

    own = Sensor(kind.leaf, kind.schema, kind.measured, measure, fields={"origin": 2})
    return traced_sensor(model, own, names)


def errors_at(component: int) -> OfParameters:
    """Make `errors(parameters)`, which returns the state indices of a measured component's errors.

    An index of -1 means that there is no such error.
    """
    names = (f"registration_at_{component}", f"correlated_at_{component}")

    def errors(parameters: Settings) -> tuple[float, ...]:
        return tuple(getattr(parameters, name) for name in names)

    return errors


def adding_errors(components: int) -> Callable[[Floats, Floats, Floats, Settings], None]:
    """Make `add(rows, predicted, mean, parameters)`, which adds sensor errors to a prediction."""
    errors = tuple(errors_at(component) for component in range(components))

    def add(rows: Floats, predicted: Floats, mean: Floats, parameters: Settings) -> None:
        for i, errors_of in enumerate(errors):
            for place in errors_of(parameters):
                if place >= 0.0:
                    rows[i, int(place)] += 1.0
                    predicted[i] += mean[int(place)]

    return add


# (track, mode, mean, covariance, origin, parameters, memory), see `observing`.
Observe = Callable[[int, int, Floats, Floats, Floats, Settings, ScanMemory], float]
# (mean, covariance, origin, parameters, work), see `correlating`.
Correlate = Callable[[Floats, Floats, Floats, Settings, Workspace], None]
# (track, mode, detections, mean, covariance, memory), see `updating`.
UpdateTrack = Callable[[int, int, int, Floats, Floats, ScanMemory], None]


def observing(model: Model, kind: ScanSensor, names: tuple[str, ...]) -> Observe:
    """Make `observe(track, mode, mean, covariance, origin, parameters, memory)`, to predict detections.

    `observe` fills the prediction and the whitened innovation covariance of a mode. It returns the
    factor of exp(-d2 / 2) in the density, or NaN if the covariance is not positive definite.
    """
    m, read_state, read_origin = len(kind.measured), tuple_of(model.size), tuple_of(2)
    linearise, noise = sensor_derivative(model, measuring(model, kind, names)), kind.noise
    add_noise, target, add_errors = adding_noise(m), target_of(model), adding_errors(m)

    def observe(
        track: int,
        mode: int,
        mean: Floats,
        covariance: Floats,
        origin: Floats,
        parameters: Settings,
        memory: ScanMemory,
    ) -> float:
        state, here = read_state(mean), read_origin(origin)
        linearise(state, here, parameters, memory.step)
        rows, predicted = memory.step.rows, memory.step.predicted
        add_errors(rows, predicted, mean, parameters)
        innovation = Innovation(
            memory.difference[track, mode], memory.spread[track, mode], memory.cross[track, mode]
        )
        spread, cross = innovation.covariance, innovation.cross_covariance
        for i in range(m):
            memory.predicted[track, mode, i], innovation.difference[i] = predicted[i], 0.0
            for row in range(len(covariance)):
                cross[row, i] = 0.0
                for k in range(len(covariance)):
                    cross[row, i] += covariance[row, k] * rows[i, k]
        for i in range(m):
            for j in range(m):
                spread[i, j] = 0.0
                for k in range(len(covariance)):
                    spread[i, j] += rows[i, k] * cross[k, j]
        add_noise(spread, noise(target(state), here, parameters))
        _, determinant = whiten(innovation, m)
        kalman_step(innovation, m, memory.step.step)
        factor: float = np.exp(-0.5 * determinant) / (2.0 * np.pi) ** (0.5 * m)
        return factor

    return observe


def correlating(
    model: Model, kind: ScanSensor, corner: tuple[int, int], names: tuple[str, ...]
) -> Correlate:
    """Make `correlate(mean, covariance, origin, parameters, work)`, for new tracks with sensor errors.

    An error db of a detection shifts the position by -H^-1 db, where H is the derivative of the
    measurement with respect to the position. The position has the indices `corner` in the state.
    """
    x, y = corner
    read_state, read_origin = tuple_of(model.size), tuple_of(2)
    of_first, of_second = errors_at(0), errors_at(1)
    linearise = sensor_derivative(model, measuring(model, kind, names))

    def shift(mean: Floats, covariance: Floats, error: int, by_x: float, by_y: float) -> None:
        """Move the position by the error at index `error`, multiplied by `by_x` and `by_y`."""
        mean[x] += by_x * mean[error]
        mean[y] += by_y * mean[error]
        for k in range(len(covariance)):
            covariance[x, k] += by_x * covariance[error, k]
            covariance[y, k] += by_y * covariance[error, k]
        for k in range(len(covariance)):
            covariance[k, x] += by_x * covariance[k, error]
            covariance[k, y] += by_y * covariance[k, error]

    def correlate(
        mean: Floats, covariance: Floats, origin: Floats, parameters: Settings, work: Workspace
    ) -> None:
        linearise(read_state(mean), read_origin(origin), parameters, work)
        a, b, c, d = work.rows[0, x], work.rows[0, y], work.rows[1, x], work.rows[1, y]
        determinant = a * d - b * c
        for place in of_first(parameters):
            if place >= 0.0:
                shift(mean, covariance, int(place), -d / determinant, c / determinant)
        for place in of_second(parameters):
            if place >= 0.0:
                shift(mean, covariance, int(place), b / determinant, -a / determinant)

    return correlate


def comparing(kind: ScanSensor) -> Callable[[int, int, int, ScanMemory], float]:
    """Make `compare(track, mode, detection, memory)`, which whitens an innovation and returns d2."""
    m, angular = len(kind.measured), tuple(each == "angle" for each in kind.measured.values())

    def compare(track: int, mode: int, detection: int, memory: ScanMemory) -> float:
        factor, white = memory.spread[track, mode], memory.white[track, mode, detection]
        squared = 0.0
        for i in range(m):
            entry = wrap(memory.place[detection, i] - memory.predicted[track, mode, i], angular[i])
            for k in range(i):
                entry -= factor[i, k] * white[k]
            white[i] = entry / factor[i, i]
            squared += white[i] * white[i]
        return squared

    return compare


def updating(model: Model, kind: ScanSensor) -> UpdateTrack:
    """Make `update(track, mode, detections, mean, covariance, memory)`, which updates one mode."""
    m, correct = len(kind.measured), correcting(model.kinds, model.correct)
    find_slope = sloping(model.kinds, model.correct)

    def update(
        track: int, mode: int, detections: int, mean: Floats, covariance: Floats, memory: ScanMemory
    ) -> None:
        given, moment, shift, step = memory.given, memory.moment, memory.shift, memory.step.step
        for i in range(m):
            shift[i] = 0.0
            for j in range(m):
                moment[i, j] = 1.0 - given[0] if i == j else 0.0
        for detection in range(detections):
            weight, white = given[1 + detection], memory.white[track, mode, detection]
            if weight == 0.0:
                continue
            for i in range(m):
                shift[i] += weight * white[i]
                for j in range(m):
                    moment[i, j] -= weight * white[i] * white[j]
        for i in range(m):
            for j in range(m):
                moment[i, j] += shift[i] * shift[j]
        gain = memory.cross[track, mode]
        for row in range(len(covariance)):
            step[row] = 0.0
            for i in range(m):
                step[row] += gain[row, i] * shift[i]
            for column in range(row + 1):
                entry = covariance[row, column]
                for i in range(m):
                    for j in range(m):
                        entry -= gain[row, i] * moment[i, j] * gain[column, j]
                covariance[row, column] = covariance[column, row] = entry
        find_slope(mean, covariance, memory.step.slope)
        correct(mean, covariance, memory.step)

    return update


def split_by_mode(
    run: int, track: int, mode: int, detections: int, tracks: Tracks, memory: ScanMemory
) -> float:
    """Fill the association probabilities of a track in one mode; return the mode's new probability."""
    probability, given = memory.probability[track], memory.given
    given[0] = probability[0] * tracks.mode[run, track, mode]
    after: float = given[0]
    for detection in range(detections):
        given[1 + detection] = 0.0
        if probability[1 + detection] > 0.0:
            total = 0.0
            for each in range(tracks.mode.shape[2]):
                total += memory.likelihood[track, each, detection]
            share = memory.likelihood[track, mode, detection] / total
            given[1 + detection] = probability[1 + detection] * share
            after += given[1 + detection]
    for entry in range(1 + detections if after > 0.0 else 0):
        given[entry] /= after
    return after


def join_near(first: int, end: int, scans: Scans, within: float, memory: ScanMemory) -> int:
    """Copy the detections of a scan to `memory`; replace each chain of near detections by its mean.

    Chains are in the order of their first detections. Returns the number of joined detections.
    """
    count = end - first
    for each in range(count):
        memory.group[each] = each
    for each in range(count if within > 0.0 else 0):
        for other in range(each):
            apart = np.hypot(
                scans.detection[first + each, 0] - scans.detection[first + other, 0],
                scans.detection[first + each, 1] - scans.detection[first + other, 1],
            )
            if apart <= within and memory.group[each] != memory.group[other]:
                first_of_both = min(memory.group[each], memory.group[other])
                joining = max(memory.group[each], memory.group[other])
                for member in range(each + 1):
                    if memory.group[member] == joining:
                        memory.group[member] = first_of_both
    joined = 0
    for group in range(count):
        members, x, y = 0, 0.0, 0.0
        for member in range(count):
            if memory.group[member] == group:
                members += 1
                x += scans.detection[first + member, 0]
                y += scans.detection[first + member, 1]
        if members:
            memory.place[joined, 0], memory.place[joined, 1] = x / members, y / members
            joined += 1
    return joined
