"""The tracker of many targets, put together from parts that do not know each other.

A model's motion moves every track, that of each mode where it has several (an IMM inside); sensors say
what a scan measures of a track (see `replay.inference.association.scanning`); an association says how
probable it is that each track has each detection (`association`); what is left over may begin tracks;
and a management says which tracks are those of targets, and which end (`track_management`).
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from replay.engine.arrays import Floats, Function, Integers, varying
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.vectors.tangent import tangent_components
from replay.inference.association.association import ASSOCIATIONS
from replay.inference.association.scanning import (
    BY_SCAN,
    ScanMemory,
    Scans,
    ScanSensor,
    comparing,
    correlating,
    join_near,
    memory_of,
    observing,
    split_by_mode,
    take_scans,
    target_of,
    updating,
)
from replay.inference.association.shared_bias import pool_errors
from replay.inference.association.track_management import MANAGEMENTS, Evidence
from replay.inference.association.tracks import NEVER, Tracks, are_near, drop, expected
from replay.inference.kalman.predict import linear_motion, nothing
from replay.inference.kalman.steps import Gaussian, Steps, gaussian_filter
from replay.inference.linear_algebra.gaussian import copy_gaussian
from replay.inference.linear_algebra.tuples import range_of, tuple_of
from replay.inference.model.model import Model
from replay.inference.model.settings import reading_settings
from replay.inference.model.stage import Stage
from replay.inference.modes.imm import ModeBelief, interacting_steps


class Tracker(NamedTuple):
    """A tracker put together.

    Attributes:
        stage: the targets' model, with one of its motions or all modes.
        kinds: of sensors.
        association, management: by name, see `ASSOCIATIONS` and `MANAGEMENTS`.
        names: the parameters that the parts read, in the order of the columns of the settings.
        shared: where in the state the sensors' errors begin, and how many of them all tracks share, see
            `replay.inference.association.shared_bias`.
    """

    stage: Stage
    kinds: tuple[ScanSensor, ...]
    association: str
    management: str
    names: tuple[str, ...]
    shared: tuple[int, int]

    @property
    def sizes(self) -> tuple[int, int, int]:
        """How many modes the model has, and how many components its state and tangent space."""
        return max(1, len(self.stage.modes)), self.stage.model.size, self.stage.model.tangent


class Newborn(NamedTuple):
    """A target of which only the position is known.

    Attributes:
        mean, covariance: (n,), (t, t); their entries of the position stand for none.
        mode: (modes,), the modes' probabilities.
    """

    mean: Floats
    covariance: Floats
    mode: Floats


@varying(2)
class TrackOutputs(NamedTuple):
    """What is said after every scan; scan s of run r has the rows of that number.

    Attributes:
        end: (runs, 2), how many rows of tracks and of associations a run has filled.
        confirmed: (scans,), how many tracks there are; NEVER where the scan was too old to be used.
        approximated: (scans,), tracks in clusters too large to go through.
        turned_away: (scans,), detections that begin no track because there is no room.
        number, mean, covariance, probability, existence: (runs, rows, ...), of confirmed tracks;
            `probability` is that of their modes.
        pair: (runs, rows, 3), track, scan and detection; associated: (runs, rows), how probable.
        white, factor: (runs, rows, 2) and (runs, rows, 2, 2), a pair's whitened innovation in its
            likeliest mode, and Cholesky's factor of the innovation covariance; a bearing's stand first.
    """

    end: Integers
    confirmed: Integers
    approximated: Integers
    turned_away: Integers
    number: Integers
    mean: Floats
    covariance: Floats
    probability: Floats
    existence: Floats
    pair: Integers
    associated: Floats
    white: Floats
    factor: Floats


class Rows(NamedTuple):
    """Where one run's estimates go, as `replay.inference.kalman.steps.Steps.estimate` fills them in."""

    mean: Floats
    covariance: Floats
    probability: Floats


def moving(stage: Stage) -> Steps:
    """How tracks move: those of several modes as interacting multiple models do."""
    if not stage.modes:
        return gaussian_filter(stage, linear_motion(stage), ())
    alone = (stage._replace(motion=motion, modes=()) for motion in stage.modes)
    return interacting_steps(stage, [gaussian_filter(each, linear_motion(each), ()) for each in alone])


def believing(stage: Stage) -> Function:
    """`belief(run, tracks)`: the tracks of a run as the filters have them, first axis = place."""

    def of_one(run: int, tracks: Tracks) -> Gaussian:
        return Gaussian(tracks.mean[run, :, 0], tracks.covariance[run, :, 0])

    def of_modes(run: int, tracks: Tracks) -> ModeBelief:
        return ModeBelief(
            tracks.mean[run], tracks.covariance[run], tracks.mode[run], tracks.log_mode[run]
        )

    return of_modes if stage.modes else of_one


def choosing(functions: list[Function]) -> Function:
    """`call(kind, ...)`: the function of this number."""

    def call(kind: int, *arguments: Any) -> Any:
        for number in range_of(1, len(functions)):
            if kind == number:
                return functions[number](*arguments)
        return functions[0](*arguments)

    return call


class Births(NamedTuple):
    """How detections begin tracks, by kind of sensors.

    Attributes:
        begins: whether those of a kind do.
        number: of a kind that does, its number in `birth`.
        birth: (number, detection, origin, parameters) -> see `ScanSensor.birth`.
    """

    begins: tuple[bool, ...]
    number: tuple[int, ...]
    birth: Function


def births_of(kinds: Sequence[ScanSensor]) -> Births:
    """The births of these kinds of sensors."""
    begins = tuple(kind.birth is not None for kind in kinds)
    births = [kind.birth for kind in kinds if kind.birth is not None]
    number = tuple(sum(begins[:k]) for k in range(len(kinds)))
    return Births(begins, number, choosing(births))


def place_of(model: Model) -> tuple[int, int]:
    """Where the position stands in the state."""
    names = list(model.state)
    return names.index("x_m"), names.index("y_m")


def corner_of(model: Model) -> tuple[int, int]:
    """Where the position stands in the tangent space."""
    tangent = [name for name, _ in tangent_components(list(model.state), model.kinds)]
    return tangent.index("x_m"), tangent.index("y_m")


def tracking(tracker: Tracker, read: Function) -> Function:
    """The loop over the scans of one run, for `replay.engine.compiling.compile.compile_over_runs`.

    `read(settings, sensor)` makes the parameters of motion, tracker and sensor.
    """
    stage, associate = tracker.stage, ASSOCIATIONS[tracker.association]
    advance, weigh, process = advancing(tracker), association_weights(tracker), processing(tracker)
    end_tracks, begin_tracks = ending(tracker), beginning(tracker)
    write_pairs, write_tracks = writing_pairs(tracker.sizes[0]), writing_tracks(stage)

    def follow(
        run: int,
        scans: Scans,
        settings: Floats,
        newborn: Newborn,
        tracks: Tracks,
        outputs: TrackOutputs,
        memory: ScanMemory,
    ) -> None:
        """Take one run through its scans."""
        for scan in range(scans.offsets[run], scans.offsets[run + 1]):
            p = read(settings, scans.sensor[scan])
            if scans.time_ns[scan] < tracks.time_ns[run]:
                continue
            advance(run, scans.time_ns[scan], tracks, p, memory)
            count = join_near(scans.first[scan], scans.end[scan], scans, p.joined_within_m, memory)
            weigh(run, scan, count, scans, tracks, p, memory)
            used = tracks.used[run]
            outputs.approximated[scan] = associate(
                memory.weights, used, count, memory.probability, memory.association
            )
            for detection in range(count):
                memory.left[detection] = 1.0
                for place in range(used):
                    memory.left[detection] -= memory.probability[place, 1 + detection]
            write_pairs(run, scan, count, tracks, outputs, memory)
            process(run, scan, count, scans, tracks, p, memory)
            end_tracks(run, tracks, p)
            outputs.turned_away[scan] = begin_tracks(run, scan, count, scans, tracks, newborn, p, memory)
            write_tracks(run, scan, tracks, outputs, memory)

    return follow


def advancing(tracker: Tracker) -> Function:
    """`advance(run, time_ns, tracks, p, memory)`: the prediction of all tracks."""
    belief_of, predict = believing(tracker.stage), moving(tracker.stage).predict
    wait, _, _ = MANAGEMENTS[tracker.management]

    def advance(run: int, time_ns: int, tracks: Tracks, p: Any, memory: ScanMemory) -> None:
        """Predict all tracks."""
        duration_s = (time_ns - tracks.time_ns[run]) * 1e-9
        if tracks.time_ns[run] != NEVER and duration_s > 0.0:
            belief = belief_of(run, tracks)
            for place in range(tracks.used[run]):
                predict(place, belief, memory.shift, duration_s, p, 0, memory.motion)
                wait(run, place, duration_s, tracks, p)
        tracks.time_ns[run] = time_ns

    return advance


def association_weights(tracker: Tracker) -> Function:
    """`weigh(run, scan, count, scans, tracks, p, memory)`: how well detections go with tracks."""
    model, kinds, modes = tracker.stage.model, tracker.kinds, tracker.sizes[0]
    observe = choosing([observing(model, kind, tracker.names) for kind in kinds])
    compare = choosing([comparing(kind) for kind in kinds])
    detection_of = choosing([kind.detection for kind in kinds])
    clutter_of = choosing([kind.clutter for kind in kinds])
    begins, birth_number, birth = births_of(kinds)
    read_pair, read_state, target_in = tuple_of(2), tuple_of(model.size), target_of(model)

    def detectable(run: int, place: int, kind: int, origin: Any, tracks: Tracks, p: Any) -> float:
        """How probable it is that a sensor detects a track's target."""
        total = 0.0
        for mode in range(modes):
            target = target_in(read_state(tracks.mean[run, place, mode]))
            total += tracks.mode[run, place, mode] * detection_of(kind, target, origin, p)
        return total

    def weigh(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Any, memory: ScanMemory
    ) -> None:
        """Fill the weights of all pairs, and which detections are outside all gates."""
        kind, weights, origin = scans.kind[scan], memory.weights, read_pair(scans.origin[scan])
        for detection in range(count):
            measured = read_pair(memory.place[detection])
            undetected = 0.0
            if begins[kind] and p.undetected_per_m2 > 0.0:
                (at_x, at_y), _, area = birth(birth_number[kind], measured, origin, p)
                detected = detection_of(kind, (at_x, 0.0, at_y, 0.0), origin, p)
                undetected = detected * p.undetected_per_m2 * area
            memory.is_free[detection] = True
            memory.undetected[detection] = undetected
            memory.clutter[detection] = clutter_of(kind, measured, p) + undetected
        for place in range(tracks.used[run]):
            for detection in range(count):
                weights.detected[place, detection] = 0.0
            weights.missed[place] = 1.0
            if not (begins[kind] or tracks.is_confirmed[run, place]):
                continue
            memory.detectable[place] = detectable(run, place, kind, origin, tracks, p)
            share = memory.detectable[place] * tracks.existence[run, place]
            weights.missed[place] = 1.0 - share * p.gate_probability
            for mode in range(modes):
                mean, covariance = tracks.mean[run, place, mode], tracks.covariance[run, place, mode]
                factor = observe(kind, place, mode, mean, covariance, scans.origin[scan], p, memory)
                for detection in range(count):
                    squared = compare(kind, place, mode, detection, memory)
                    likelihood = tracks.mode[run, place, mode] * factor * np.exp(-0.5 * squared)
                    memory.likelihood[place, mode, detection] = likelihood
                    if squared <= p.gate:
                        memory.is_free[detection] = False
                        weights.detected[place, detection] = share / memory.clutter[detection]
            for detection in range(count):
                total = 0.0
                for mode in range(modes):
                    total += memory.likelihood[place, mode, detection]
                weights.detected[place, detection] *= total

    return weigh


def processing(tracker: Tracker) -> Function:
    """`process(run, scan, count, scans, tracks, p, memory)`: the update by a scan's associations."""
    model, kinds, modes = tracker.stage.model, tracker.kinds, tracker.sizes[0]
    update = choosing([updating(model, kind) for kind in kinds])
    _, judge, _ = MANAGEMENTS[tracker.management]
    begins, (shared_at, shared) = births_of(kinds).begins, tracker.shared

    def correct(run: int, place: int, count: int, kind: int, tracks: Tracks, memory: ScanMemory) -> None:
        """Update a track's Gaussians and the probabilities of its modes by its associations."""
        for mode in range(modes):
            after = split_by_mode(run, place, mode, count, tracks, memory)
            memory.after[mode] = after
            if after > 0.0:
                mean, covariance = tracks.mean[run, place, mode], tracks.covariance[run, place, mode]
                update(kind, place, mode, count, mean, covariance, memory)
        for mode in range(modes):
            after = memory.after[mode]
            tracks.mode[run, place, mode] = after
            tracks.log_mode[run, place, mode] = np.log(after) if after > 0.0 else -np.inf

    def process(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Any, memory: ScanMemory
    ) -> None:
        """Update all tracks by the associations, and what is known of their targets' existence."""
        kind, sensor, now_ns = scans.kind[scan], scans.sensor[scan], tracks.time_ns[run]
        for place in range(tracks.used[run]):
            probability = memory.probability[place, : 1 + count]
            memory.pool.is_updated[place] = False
            waited_s = (now_ns - tracks.updated_ns[run, place, sensor]) * 1e-9
            if probability[0] < 1.0 and waited_s >= p.interval_s:
                correct(run, place, count, kind, tracks, memory)
                memory.pool.is_updated[place] = True
                tracks.updated_ns[run, place, sensor] = now_ns
            if begins[kind]:
                if probability[0] < 0.5:
                    tracks.seen_ns[run, place] = now_ns
                inside = memory.detectable[place] * p.gate_probability
                judge(run, place, Evidence(inside, probability, memory.weights), tracks, p)
        if shared > 0:
            pool_errors(run, shared_at, tracks, memory.pool)

    return process


def ending(tracker: Tracker) -> Function:
    """`end_tracks(run, tracks, p)`: which tracks are over."""
    names = list(tracker.stage.model.state)
    x, y = place_of(tracker.stage.model)
    has_velocity = "vx_mps" in names and "vy_mps" in names
    velocity = (names.index("vx_mps"), names.index("vy_mps")) if has_velocity else (x, y)
    _, _, is_over = MANAGEMENTS[tracker.management]

    def is_another(run: int, place: int, tracks: Tracks, p: Any) -> bool:
        """Whether an older confirmed track is about where this confirmed one is, and moves alike."""
        for other in range(place if tracks.is_confirmed[run, place] else 0):
            if (
                tracks.is_confirmed[run, other]
                and are_near(run, place, other, (x, y), p.same_within_m, tracks)
                and (
                    not has_velocity or are_near(run, place, other, velocity, p.same_within_mps, tracks)
                )
            ):
                return True
        return False

    def end_tracks(run: int, tracks: Tracks, p: Any) -> None:
        """Take out the tracks that are over, and second ones of a target."""
        place = 0
        while place < tracks.used[run]:
            if is_over(run, place, tracks, p) or is_another(run, place, tracks, p):
                drop(run, place, tracks)
            else:
                place += 1

    return end_tracks


def beginning(tracker: Tracker) -> Function:
    """`begin_tracks(run, scan, count, scans, tracks, newborn, p, memory)`: which tracks begin."""
    model, kinds, modes = tracker.stage.model, tracker.kinds, tracker.sizes[0]
    (x, y), corner, (shared_at, shared) = place_of(model), corner_of(model), tracker.shared
    begins, birth_number, birth = births_of(kinds)
    correlate, read_pair = nothing, tuple_of(2)
    if shared_at < model.size:
        correlations = [
            correlating(model, kind, corner, tracker.names) for kind in kinds if kind.birth is not None
        ]
        correlate = choosing(correlations)

    def is_taken(run: int, at_x: float, at_y: float, tracks: Tracks, p: Any) -> bool:
        """Whether a confirmed track is too near for another one to begin."""
        for place in range(tracks.used[run]):
            apart = np.hypot(
                at_x - expected(run, place, x, tracks), at_y - expected(run, place, y, tracks)
            )
            if tracks.is_confirmed[run, place] and apart < p.birth_distance_m:
                return True
        return False

    def first_existence(
        run: int, detection: int, at_x: float, at_y: float, tracks: Tracks, p: Any, memory: ScanMemory
    ) -> float:
        """How probable it is that a detection is of a target that no track is of; 0 to begin none."""
        if p.undetected_per_m2 > 0.0:
            share = memory.undetected[detection] / memory.clutter[detection]
            existence = memory.left[detection] * share
            return existence if existence >= p.ending_existence else 0.0
        is_another = not memory.is_free[detection] or is_taken(run, at_x, at_y, tracks, p)
        return 0.0 if is_another else p.birth_existence

    def begin_tracks(
        run: int,
        scan: int,
        count: int,
        scans: Scans,
        tracks: Tracks,
        newborn: Newborn,
        p: Any,
        memory: ScanMemory,
    ) -> int:
        """Begin tracks with the detections that may be of no other; returns how many had no room."""
        kind, turned_away = scans.kind[scan], 0
        for detection in range(count if begins[kind] else 0):
            measured, origin = read_pair(memory.place[detection]), read_pair(scans.origin[scan])
            (at_x, at_y), triangle, _ = birth(birth_number[kind], measured, origin, p)
            existence = first_existence(run, detection, at_x, at_y, tracks, p, memory)
            if existence == 0.0:
                continue
            place = tracks.used[run]
            if place == tracks.number.shape[1]:
                turned_away += 1
                continue
            tracks.used[run] += 1
            tracks.met[run] += 1
            tracks.number[run, place] = tracks.met[run]
            for mode in range(modes):
                mean, covariance = tracks.mean[run, place, mode], tracks.covariance[run, place, mode]
                copy_gaussian(newborn.mean, newborn.covariance, mean, covariance)
                mean[x], mean[y] = at_x, at_y
                covariance[corner[0], corner[0]], covariance[corner[1], corner[1]] = (
                    triangle[0],
                    triangle[2],
                )
                covariance[corner[0], corner[1]] = covariance[corner[1], corner[0]] = triangle[1]
                for i in range(shared):
                    mean[shared_at + i] = tracks.shared_mean[run, i]
                    for j in range(shared):
                        known = tracks.shared_covariance[run, i, j]
                        covariance[shared_at + i, shared_at + j] = known
                number = birth_number[kind]
                correlate(number, mean, covariance, scans.origin[scan], p, memory.step)
                probability = newborn.mode[mode]
                tracks.mode[run, place, mode] = probability
                tracks.log_mode[run, place, mode] = np.log(probability) if probability > 0.0 else -np.inf
            tracks.existence[run, place] = existence
            tracks.is_confirmed[run, place] = existence >= p.confirming_existence
            tracks.hits[run, place] = tracks.chances[run, place] = 1
            tracks.score[run, place] = tracks.best_score[run, place] = 0.0
            tracks.seen_ns[run, place] = tracks.time_ns[run]
            for sensor in range(tracks.updated_ns.shape[2]):
                tracks.updated_ns[run, place, sensor] = NEVER
        return turned_away

    return begin_tracks


def writing_pairs(modes: int) -> Function:
    """`write_pairs(run, scan, count, tracks, outputs, memory)`: the associations of confirmed tracks."""

    def write_pairs(
        run: int, scan: int, count: int, tracks: Tracks, outputs: TrackOutputs, memory: ScanMemory
    ) -> None:
        """Tell which detections went to confirmed tracks."""
        for place in range(tracks.used[run]):
            for detection in range(count if tracks.is_confirmed[run, place] else 0):
                if memory.probability[place, 1 + detection] > 0.0:
                    row = outputs.end[run, 1]
                    outputs.pair[run, row, 0] = tracks.number[run, place]
                    outputs.pair[run, row, 1], outputs.pair[run, row, 2] = scan, detection
                    outputs.associated[run, row] = memory.probability[place, 1 + detection]
                    likeliest = 0
                    for mode in range(1, modes):
                        likelihood = memory.likelihood[place, mode, detection]
                        if likelihood > memory.likelihood[place, likeliest, detection]:
                            likeliest = mode
                    white = memory.white[place, likeliest, detection]
                    factor = memory.spread[place, likeliest]
                    copy_gaussian(white, factor, outputs.white[run, row], outputs.factor[run, row])
                    outputs.end[run, 1] = row + 1

    return write_pairs


def writing_tracks(stage: Stage) -> Function:
    """`write_tracks(run, scan, tracks, outputs, memory)`: the confirmed tracks."""
    belief_of, estimate = believing(stage), moving(stage).estimate

    def write_tracks(
        run: int, scan: int, tracks: Tracks, outputs: TrackOutputs, memory: ScanMemory
    ) -> None:
        """Tell the confirmed tracks as they are now."""
        belief = belief_of(run, tracks)
        rows = Rows(outputs.mean[run], outputs.covariance[run], outputs.probability[run])
        outputs.confirmed[scan] = 0
        for place in range(tracks.used[run]):
            if tracks.is_confirmed[run, place]:
                row = outputs.end[run, 0]
                outputs.number[run, row] = tracks.number[run, place]
                estimate(place, belief, rows, row, memory.motion)
                outputs.existence[run, row] = tracks.existence[run, place]
                outputs.end[run, 0] = row + 1
                outputs.confirmed[scan] += 1

    return write_tracks


# So many scans of a run go through the loop at once, which bounds the room for what is said of them.
BATCH = 1000
BY_TRACK = ("number", "mean", "covariance", "probability", "existence")
BY_PAIR = ("associated", "white", "factor")


@lru_cache(maxsize=16)
def _compiled(tracker: Tracker) -> Callable[..., None]:
    follow = tracking(tracker, reading_settings(tracker.names))
    return compile_over_runs(follow, allocates=False, title="a tracker")


def track_scans(
    tracker: Tracker, scans: Scans, settings: Floats, newborn: Newborn, before: Tracks
) -> tuple[Tracks, list[tuple[Scans, TrackOutputs]]]:
    """The tracks after the scans; and by batch, its scans and what was said of them.

    `settings` (sensors, names) are the parameters for each sensor.
    """
    columns: Any = before
    tracks = Tracks(*(column.copy() for column in columns))
    runs, places = tracks.number.shape
    begin, end = scans.offsets[:-1], scans.offsets[1:]
    largest = int((scans.end - scans.first).max(initial=0))
    said = []
    for first in range(0, int((end - begin).max(initial=0)), BATCH):
        bounds = np.minimum(begin + first, end), np.minimum(begin + first + BATCH, end)
        rows = np.concatenate([np.arange(*pair) for pair in zip(*bounds, strict=True)])
        batch = scans._replace(
            offsets=np.concatenate([[0], np.cumsum(bounds[1] - bounds[0])]),
            **{name: getattr(scans, name)[rows] for name in BY_SCAN},
        )
        outputs = _blank_outputs(batch, runs, places, tracker.sizes)
        memory = partial(_memory, tracker, places, largest)
        _compiled(tracker)(runs, batch, settings, newborn, tracks, outputs, scratch=memory)
        said.append((batch, outputs))
    return tracks, said


def _memory(tracker: Tracker, places: int, detections: int) -> ScanMemory:
    motion = moving(tracker.stage).memory(())
    return memory_of(tracker.stage, motion, tracker.shared[1], places, detections)


def _blank_outputs(scans: Scans, runs: int, places: int, sizes: tuple[int, int, int]) -> TrackOutputs:
    """Room for all that could be said: memory that is not written takes none."""
    modes, n, t = sizes
    counts = np.diff(scans.offsets)
    detections = np.add.reduceat(np.append(scans.end - scans.first, 0), scans.offsets[:-1])
    rows = places * int(counts.max(initial=0))
    pairs = places * int(np.where(counts > 0, detections, 0).max(initial=0))
    return TrackOutputs(
        end=np.zeros((runs, 2), np.int64),
        confirmed=np.full(len(scans.time_ns), NEVER),
        approximated=np.zeros(len(scans.time_ns), np.int64),
        turned_away=np.zeros(len(scans.time_ns), np.int64),
        number=np.empty((runs, rows), np.int64),
        mean=np.empty((runs, rows, n)),
        covariance=np.empty((runs, rows, t, t)),
        probability=np.empty((runs, rows, modes)),
        existence=np.empty((runs, rows)),
        pair=np.empty((runs, pairs, 3), np.int64),
        associated=np.empty((runs, pairs)),
        white=np.empty((runs, pairs, 2)),
        factor=np.empty((runs, pairs, 2, 2)),
    )


def of_last(scans: Scans, outputs: TrackOutputs) -> tuple[Scans, TrackOutputs]:
    """The last scan of one run, and what was said of it."""
    last = len(scans.time_ns) - 1
    count, (end, paired) = max(int(outputs.confirmed[last]), 0), outputs.end[0]
    is_of_it = outputs.pair[0, :paired, 1] == last
    by_scan = {
        name: getattr(outputs, name)[last:] for name in ("confirmed", "approximated", "turned_away")
    }
    by_track = {name: getattr(outputs, name)[:, end - count : end] for name in BY_TRACK}
    return take_scans(scans, np.array([last])), TrackOutputs(
        end=np.array([[count, int(is_of_it.sum())]]),
        **by_scan,
        **by_track,
        pair=outputs.pair[:, :paired][:, is_of_it] - np.array([0, last, 0]),
        **{name: getattr(outputs, name)[:, :paired][:, is_of_it] for name in BY_PAIR},
    )
