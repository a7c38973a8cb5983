"""The tracker of many targets, put together from parts that do not know each other.

A motion moves every track; sensors say what a scan measures of a track, how probable its detection is
and how dense clutter is; an association (see `replay.inference.association`) says how probable it is
that each track has each detection; what is left over may begin tracks. With probabilities b_j of the
detections and b_0 of none, a track's mean moves by the mean of the innovations, and its covariance is

    P - (1 - b_0) K S K' + K (sum_j b_j v_j v_j' - v v') K',   v = sum_j b_j v_j

(Bar-Shalom, Fortmann, Tracking and Data Association, 1988, 6.4), which is the Kalman filter's where one
map is chosen. Tracks are managed by how probable it is that they exist (Musicki and Evans), or by how
often they were hit at first: `hits_needed` times in as many chances as `chances`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from recorders.log import Schema
from replay.engine.arrays import Booleans, Floats, Function, Integers
from replay.engine.compile import compile_over_runs
from replay.engine.components import Components
from replay.inference.association import ASSOCIATIONS, Weights, existence_after, memory_for
from replay.inference.association import Memory as AssociationMemory
from replay.inference.binding import reading_settings
from replay.inference.gaussian import Innovation, copy_gaussian, kalman_step, whiten, wrap
from replay.inference.generate import adding_noise, filling, function_of, tuple_of
from replay.inference.model import Model, Sensor
from replay.inference.steps import Stage, Workspace, linear_motion, sensor_derivative, workspace

# A miss says nothing of a young track where the sensor sees less than every second thing.
CHANCE = 0.5
NEVER = -1


@dataclass(frozen=True, eq=False)
class ScanSensor:
    """A kind of sensor of unordered scans; `origin` is where it is when it scans.

    Attributes:
        leaf, schema, fields: of the topic with its detections, beside that of its scans.
        measured: the components of a detection.
        measure: (state, origin, parameters) -> what it measures of a thing.
        noise: (state, origin, parameters) -> variances, or the rows of a lower triangle.
        detection: (state, origin, parameters) -> how probable it is that the thing is detected.
        clutter: (parameters) -> how many false detections there are per unit of what is measured.
        birth: (detection, origin, parameters) -> the state of a thing that is there, and the rows of the
            lower triangle of its covariance; None where a detection does not say enough.
    """

    leaf: str
    schema: Schema
    field: str
    measured: Components
    measure: Function
    noise: Function
    detection: Function
    clutter: Function
    birth: Function | None = None


class Tracker(NamedTuple):
    """A tracker put together.

    `names` are the parameters that its parts read, in the order of the columns of the settings.
    """

    model: Model
    kinds: tuple[ScanSensor, ...]
    association: str
    names: tuple[str, ...]

    @property
    def stage(self) -> Stage:
        """The model with what the sensors measure of it."""
        return Stage(self.model, self.model.motion, tuple(map(measuring, self.kinds)))


class Scans(NamedTuple):
    """The scans of all runs in time order: run r owns offsets[r]:offsets[r + 1].

    Attributes:
        offsets: (runs + 1,).
        time_ns, sensor, kind, number: (scans,), whose each is: of which sensor, of which kind of
            sensors, and its number there.
        first, end: (scans,), its detections.
        origin: (scans, 2), where the sensor is.
        detection: (detections, 2), what is measured.
    """

    offsets: Integers
    time_ns: Integers
    sensor: Integers
    kind: Integers
    number: Integers
    first: Integers
    end: Integers
    origin: Floats
    detection: Floats


class Tracks(NamedTuple):
    """The tracks of all runs, the oldest first: axes run and place, of which `used` are taken.

    Attributes:
        used, met: (runs,), how many there are, and ever were, which numbers them.
        time_ns: (runs,), of all states; NEVER before the first scan.
        number, mean, covariance, existence, is_confirmed: (runs, places, ...).
        hits, chances: (runs, places), scans since its birth in which it was, or could have been, seen.
        seen_ns: (runs, places), when a sensor that begins tracks saw it last.
        updated_ns: (runs, places, sensors), when each sensor updated it last.
    """

    used: Integers
    met: Integers
    time_ns: Integers
    number: Integers
    mean: Floats
    covariance: Floats
    existence: Floats
    is_confirmed: Booleans
    hits: Integers
    chances: Integers
    seen_ns: Integers
    updated_ns: Integers


def no_tracks(runs: int, places: int, size: int, sensors: int) -> Tracks:
    """Runs in which nothing was met yet, with room for so many tracks."""
    return Tracks(
        used=np.zeros(runs, np.int64),
        met=np.zeros(runs, np.int64),
        time_ns=np.full(runs, NEVER),
        number=np.zeros((runs, places), np.int64),
        mean=np.zeros((runs, places, size)),
        covariance=np.zeros((runs, places, size, size)),
        existence=np.zeros((runs, places)),
        is_confirmed=np.zeros((runs, places), bool),
        hits=np.zeros((runs, places), np.int64),
        chances=np.zeros((runs, places), np.int64),
        seen_ns=np.zeros((runs, places), np.int64),
        updated_ns=np.zeros((runs, places, sensors), np.int64),
    )


class Told(NamedTuple):
    """What is said after every scan; scan s of run r has the rows of that number.

    Attributes:
        end: (runs, 2), how many rows of tracks and of associations a run has filled.
        confirmed: (scans,), how many tracks there are; NEVER where the scan was too old to be used.
        approximated: (scans,), tracks in clusters too large to go through.
        turned_away: (scans,), detections that begin no track because there is no room.
        number, mean, covariance, existence: (runs, rows, ...), of confirmed tracks.
        pair: (runs, rows, 3), track, scan and detection; probability: (runs, rows).
        white, factor: (runs, rows, 2) and (runs, rows, 2, 2), a pair's whitened innovation, and
            Cholesky's factor of the innovation covariance; a bearing's stand first.
    """

    end: Integers
    confirmed: Integers
    approximated: Integers
    turned_away: Integers
    number: Integers
    mean: Floats
    covariance: Floats
    existence: Floats
    pair: Integers
    probability: Floats
    white: Floats
    factor: Floats


class Memory(NamedTuple):
    """What one core works in.

    Attributes:
        step: of the motion and the derivatives of sensors.
        place: (detections, 2), those of a scan, joined.
        group: (detections,), which ones are joined.
        difference, spread, cross: (places, ...), of each track's innovation; see `Innovation`.
        predicted: (places, 2), what a sensor should measure of each track.
        detectable: (places,), how probable each track's detection is.
        white: (places, detections, 2), whitened innovations.
        weights, probability, association: see `replay.inference.association`.
        is_free: (detections,), outside all gates.
        moment: (2, 2), and `shift` (2,), of the weighted innovations.
    """

    step: Workspace
    place: Floats
    group: Integers
    difference: Floats
    spread: Floats
    cross: Floats
    predicted: Floats
    detectable: Floats
    white: Floats
    weights: Weights
    probability: Floats
    association: AssociationMemory
    is_free: Booleans
    moment: Floats
    shift: Floats


def memory_of(stage: Stage, places: int, detections: int) -> Memory:
    """Memory for so many tracks, and detections in a scan."""
    size = stage.model.tangent
    return Memory(
        step=workspace(stage),
        place=np.empty((detections, 2)),
        group=np.empty(detections, np.int64),
        difference=np.empty((places, 2)),
        spread=np.empty((places, 2, 2)),
        cross=np.empty((places, size, 2)),
        predicted=np.empty((places, 2)),
        detectable=np.empty(places),
        white=np.empty((places, detections, 2)),
        weights=Weights(np.empty((places, detections)), np.empty(places)),
        probability=np.empty((places, 1 + detections)),
        association=memory_for(places, detections),
        is_free=np.empty(detections, bool),
        moment=np.empty((2, 2)),
        shift=np.empty(2),
    )


def join_near(first: int, end: int, scans: Scans, within: float, memory: Memory) -> int:
    """Fill the detections of a scan, each chain of those within a distance as their mean.

    Chains are in the order of their first detections.
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


def measuring(kind: ScanSensor) -> Sensor:
    """What of a kind of sensors is as a model's sensor is."""
    return Sensor(kind.leaf, kind.schema, kind.measured, kind.measure)


def observing(model: Model, kind: ScanSensor) -> Function:
    """`observe(track, mean, covariance, origin, parameters, memory)`: what a scan should say of a track.

    Fills its prediction, its whitened innovation covariance and the probability of its detection.
    Returns the density's factor before exp(-d2 / 2), NaN where the covariance is none.
    """
    m, read_state, read_origin = len(kind.measured), tuple_of(model.size), tuple_of(2)
    linearise, noise = sensor_derivative(model, measuring(kind)), kind.noise
    add_noise = adding_noise(m)
    detection = kind.detection

    def observe(
        track: int, mean: Floats, covariance: Floats, origin: Floats, parameters: Any, memory: Memory
    ) -> float:
        state, here = read_state(mean), read_origin(origin)
        linearise(state, here, parameters, memory.step)
        rows, predicted = memory.step.rows, memory.step.predicted
        innovation = Innovation(memory.difference[track], memory.spread[track], memory.cross[track])
        spread, cross = innovation.covariance, innovation.cross_covariance
        for i in range(m):
            memory.predicted[track, i], innovation.difference[i] = predicted[i], 0.0
            for row in range(len(covariance)):
                cross[row, i] = 0.0
                for k in range(len(covariance)):
                    cross[row, i] += covariance[row, k] * rows[i, k]
        for i in range(m):
            for j in range(m):
                spread[i, j] = 0.0
                for k in range(len(covariance)):
                    spread[i, j] += rows[i, k] * cross[k, j]
        add_noise(spread, noise(state, here, parameters))
        memory.detectable[track] = detection(state, here, parameters)
        _, determinant = whiten(innovation, m)
        kalman_step(innovation, m, memory.step.step)
        return np.exp(-0.5 * determinant) / (2.0 * np.pi) ** (0.5 * m)

    return observe


def comparing(kind: ScanSensor) -> Function:
    """`compare(track, detection, memory)`: whitens the innovation of a pair; returns d2."""
    m, angular = len(kind.measured), tuple(each == "angle" for each in kind.measured.values())

    def compare(track: int, detection: int, memory: Memory) -> float:
        factor, white = memory.spread[track], memory.white[track, detection]
        squared = 0.0
        for i in range(m):
            entry = wrap(memory.place[detection, i] - memory.predicted[track, i], angular[i])
            for k in range(i):
                entry -= factor[i, k] * white[k]
            white[i] = entry / factor[i, i]
            squared += white[i] * white[i]
        return squared

    return compare


def updating(kind: ScanSensor) -> Function:
    """`update(track, detections, mean, covariance, memory)`: by its detections' probabilities."""
    m = len(kind.measured)

    def update(track: int, detections: int, mean: Floats, covariance: Floats, memory: Memory) -> None:
        probability, moment, shift = memory.probability[track], memory.moment, memory.shift
        for i in range(m):
            shift[i] = 0.0
            for j in range(m):
                moment[i, j] = 1.0 - probability[0] if i == j else 0.0
        for detection in range(detections):
            weight, white = probability[1 + detection], memory.white[track, detection]
            if weight == 0.0:
                continue
            for i in range(m):
                shift[i] += weight * white[i]
                for j in range(m):
                    moment[i, j] -= weight * white[i] * white[j]
        for i in range(m):
            for j in range(m):
                moment[i, j] += shift[i] * shift[j]
        gain = memory.cross[track]
        for row in range(len(mean)):
            for i in range(m):
                mean[row] += gain[row, i] * shift[i]
            for column in range(row + 1):
                entry = covariance[row, column]
                for i in range(m):
                    for j in range(m):
                        entry -= gain[row, i] * moment[i, j] * gain[column, j]
                covariance[row, column] = covariance[column, row] = entry

    return update


def choosing(functions: list[Function], arguments: str) -> Function:
    """`call(kind, ...)`: the function of this number."""
    lines = [f"def call(kind, {arguments}):"]
    lines += [
        f"    if kind == {k}:\n        return function_{k}({arguments})"
        for k in range(1, len(functions))
    ]
    lines.append(f"    return function_0({arguments})\n")
    return function_of("\n".join(lines), **{f"function_{k}": each for k, each in enumerate(functions)})


def drop(run: int, place: int, tracks: Tracks) -> None:
    """Take a track out; those after it move up."""
    tracks.used[run] -= 1
    for at in range(place, tracks.used[run]):
        for whole in (tracks.number, tracks.hits, tracks.chances, tracks.seen_ns):
            whole[run, at] = whole[run, at + 1]
        tracks.existence[run, at] = tracks.existence[run, at + 1]
        tracks.is_confirmed[run, at] = tracks.is_confirmed[run, at + 1]
        mean, covariance = tracks.mean[run, at], tracks.covariance[run, at]
        copy_gaussian(tracks.mean[run, at + 1], tracks.covariance[run, at + 1], mean, covariance)
        for sensor in range(tracks.updated_ns.shape[2]):
            tracks.updated_ns[run, at, sensor] = tracks.updated_ns[run, at + 1, sensor]


def judge_track(run: int, place: int, detectable: float, none: float, tracks: Tracks, p: Any) -> None:
    """What a scan says of a track's existence; `none` is how probable it is that it has no detection."""
    is_hit = none < 0.5
    if is_hit or detectable >= CHANCE:
        tracks.chances[run, place] += 1
    if is_hit:
        tracks.hits[run, place] += 1
        tracks.seen_ns[run, place] = tracks.time_ns[run]
    if p.hits_needed > 0:
        if tracks.hits[run, place] >= p.hits_needed:
            tracks.is_confirmed[run, place], tracks.existence[run, place] = True, 1.0
        return
    before = tracks.existence[run, place]
    tracks.existence[run, place] = existence_after(before, none, detectable)
    if tracks.existence[run, place] >= p.confirming_existence:
        tracks.is_confirmed[run, place] = True


def is_over(run: int, place: int, tracks: Tracks, p: Any) -> bool:
    """Whether a track ends: silent too long, improbable, or not hit often enough at first."""
    silent_s = (tracks.time_ns[run] - tracks.seen_ns[run, place]) * 1e-9
    is_young = not tracks.is_confirmed[run, place]
    return (
        silent_s > (p.tentative_silence_s if is_young else p.silence_s)
        or tracks.existence[run, place] < p.ending_existence
        or (is_young and p.hits_needed > 0 and tracks.chances[run, place] >= p.chances)
    )


def is_another(run: int, place: int, tracks: Tracks, at: tuple[int, ...], p: Any) -> bool:
    """Whether an older confirmed track is about where this confirmed one is, and moves about alike."""
    x, y, vx, vy = at
    mean = tracks.mean[run, place]
    for other in range(place if tracks.is_confirmed[run, place] else 0):
        older = tracks.mean[run, other]
        if (
            tracks.is_confirmed[run, other]
            and np.hypot(mean[x] - older[x], mean[y] - older[y]) < p.same_within_m
            and np.hypot(mean[vx] - older[vx], mean[vy] - older[vy]) < p.same_within_mps
        ):
            return True
    return False


def tracking(tracker: Tracker, read: Function) -> Function:
    """The loop over the scans of one run, for `replay.engine.compile.compile_over_runs`.

    `read(settings, sensor)` makes the parameters of motion, tracker and sensor.
    """
    model, kinds = tracker.model, tracker.kinds
    components = list(model.state)
    at = tuple(components.index(name) for name in ("x_m", "y_m", "vx_mps", "vy_mps"))
    predict, associate = linear_motion(tracker.stage), ASSOCIATIONS[tracker.association]
    observe = choosing(
        [observing(model, kind) for kind in kinds], "track, mean, covariance, origin, parameters, memory"
    )
    compare = choosing([comparing(kind) for kind in kinds], "track, detection, memory")
    update = choosing([updating(kind) for kind in kinds], "track, detections, mean, covariance, memory")
    clutter_of = choosing([kind.clutter for kind in kinds], "parameters")
    begins = tuple(kind.birth is not None for kind in kinds)
    births = [kind.birth for kind in kinds if kind.birth is not None]
    birth_number = tuple(sum(begins[:k]) for k in range(len(kinds)))
    birth = choosing(births, "detection, origin, parameters")
    read_pair, fill, add_covariance = tuple_of(2), filling(model.size), adding_noise(model.tangent)

    def advance(run: int, time_ns: int, tracks: Tracks, p: Any, memory: Memory) -> None:
        """Predict all tracks."""
        duration_s = (time_ns - tracks.time_ns[run]) * 1e-9
        if tracks.time_ns[run] != NEVER and duration_s > 0.0:
            for place in range(tracks.used[run]):
                mean, covariance = tracks.mean[run, place], tracks.covariance[run, place]
                predict(mean, covariance, memory.shift, duration_s, p, 0, memory.step)
                if p.hits_needed == 0:
                    tracks.existence[run, place] *= np.exp(-duration_s / p.survival_s)
        tracks.time_ns[run] = time_ns

    def weigh(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Any, memory: Memory
    ) -> None:
        """Fill the weights of all pairs, and which detections are outside all gates."""
        kind, weights = scans.kind[scan], memory.weights
        clutter = clutter_of(kind, p)
        for detection in range(count):
            memory.is_free[detection] = True
        for place in range(tracks.used[run]):
            for detection in range(count):
                weights.detected[place, detection] = 0.0
            weights.missed[place] = 1.0
            if not (begins[kind] or tracks.is_confirmed[run, place]):
                continue
            mean, covariance = tracks.mean[run, place], tracks.covariance[run, place]
            factor = observe(kind, place, mean, covariance, scans.origin[scan], p, memory)
            factor *= memory.detectable[place] * tracks.existence[run, place] / clutter
            inside = memory.detectable[place] * p.gate_probability
            weights.missed[place] = 1.0 - inside * tracks.existence[run, place]
            for detection in range(count):
                squared = compare(kind, place, detection, memory)
                if squared <= p.gate:
                    weights.detected[place, detection] = factor * np.exp(-0.5 * squared)
                    memory.is_free[detection] = False

    def correct(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Any, memory: Memory
    ) -> None:
        """Update all tracks by the associations, and what is known of their existence."""
        kind, sensor = scans.kind[scan], scans.sensor[scan]
        for place in range(tracks.used[run]):
            none = memory.probability[place, 0]
            waited_s = (tracks.time_ns[run] - tracks.updated_ns[run, place, sensor]) * 1e-9
            if none < 1.0 and waited_s >= p.interval_s:
                mean, covariance = tracks.mean[run, place], tracks.covariance[run, place]
                update(kind, place, count, mean, covariance, memory)
                tracks.updated_ns[run, place, sensor] = tracks.time_ns[run]
            if begins[kind]:
                judge_track(run, place, memory.detectable[place] * p.gate_probability, none, tracks, p)

    def end_tracks(run: int, tracks: Tracks, p: Any) -> None:
        """Take out the tracks that are over, and second ones of a thing."""
        place = 0
        while place < tracks.used[run]:
            if is_over(run, place, tracks, p) or is_another(run, place, tracks, at, p):
                drop(run, place, tracks)
            else:
                place += 1

    def begin_tracks(
        run: int, scan: int, count: int, scans: Scans, tracks: Tracks, p: Any, memory: Memory
    ) -> int:
        """Begin a track with each detection far enough from all; returns how many had no room."""
        kind, turned_away = scans.kind[scan], 0
        for detection in range(count if begins[kind] else 0):
            if not memory.is_free[detection]:
                continue
            measured, origin = read_pair(memory.place[detection]), read_pair(scans.origin[scan])
            state, triangle = birth(birth_number[kind], measured, origin, p)
            place = tracks.used[run]
            is_near = False
            for other in range(place):
                x, y = tracks.mean[run, other, at[0]], tracks.mean[run, other, at[1]]
                apart = np.hypot(state[at[0]] - x, state[at[1]] - y)
                is_near = is_near or (tracks.is_confirmed[run, other] and apart < p.birth_distance_m)
            if is_near:
                continue
            if place == tracks.number.shape[1]:
                turned_away += 1
                continue
            tracks.used[run] += 1
            tracks.met[run] += 1
            tracks.number[run, place] = tracks.met[run]
            fill(tracks.mean[run, place], state)
            for row in range(len(state)):
                for column in range(len(state)):
                    tracks.covariance[run, place, row, column] = 0.0
            add_covariance(tracks.covariance[run, place], triangle)
            tracks.existence[run, place] = p.birth_existence
            tracks.is_confirmed[run, place] = False
            tracks.hits[run, place] = tracks.chances[run, place] = 1
            tracks.seen_ns[run, place] = tracks.time_ns[run]
            for sensor in range(tracks.updated_ns.shape[2]):
                tracks.updated_ns[run, place, sensor] = NEVER
        return turned_away

    def tell_pairs(run: int, scan: int, count: int, tracks: Tracks, told: Told, memory: Memory) -> None:
        """Tell which detections went to confirmed tracks."""
        for place in range(tracks.used[run]):
            for detection in range(count if tracks.is_confirmed[run, place] else 0):
                if memory.probability[place, 1 + detection] > 0.0:
                    row = told.end[run, 1]
                    told.pair[run, row, 0] = tracks.number[run, place]
                    told.pair[run, row, 1], told.pair[run, row, 2] = scan, detection
                    told.probability[run, row] = memory.probability[place, 1 + detection]
                    white, factor = memory.white[place, detection], memory.spread[place]
                    copy_gaussian(white, factor, told.white[run, row], told.factor[run, row])
                    told.end[run, 1] = row + 1

    def tell_tracks(run: int, scan: int, tracks: Tracks, told: Told) -> None:
        """Tell the confirmed tracks as they are now."""
        told.confirmed[scan] = 0
        for place in range(tracks.used[run]):
            if tracks.is_confirmed[run, place]:
                row = told.end[run, 0]
                told.number[run, row] = tracks.number[run, place]
                mean, covariance = told.mean[run, row], told.covariance[run, row]
                copy_gaussian(tracks.mean[run, place], tracks.covariance[run, place], mean, covariance)
                told.existence[run, row] = tracks.existence[run, place]
                told.end[run, 0] = row + 1
                told.confirmed[scan] += 1

    def follow(
        run: int, scans: Scans, settings: Floats, tracks: Tracks, told: Told, memory: Memory
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
            told.approximated[scan] = associate(
                memory.weights, used, count, memory.probability, memory.association
            )
            tell_pairs(run, scan, count, tracks, told, memory)
            correct(run, scan, count, scans, tracks, p, memory)
            end_tracks(run, tracks, p)
            told.turned_away[scan] = begin_tracks(run, scan, count, scans, tracks, p, memory)
            tell_tracks(run, scan, tracks, told)

    return follow


# So many scans of a run go through the loop at once, which bounds the room for what is said of them.
BATCH = 1000
BY_SCAN = ("time_ns", "sensor", "kind", "number", "first", "end", "origin")
BY_TRACK = ("number", "mean", "covariance", "existence")
BY_PAIR = ("probability", "white", "factor")


@lru_cache(maxsize=16)
def _compiled(tracker: Tracker) -> Callable[..., None]:
    follow = tracking(tracker, reading_settings(tracker.names))
    return compile_over_runs(follow, allocates=False)


def track_scans(
    tracker: Tracker, scans: Scans, settings: Floats, before: Tracks
) -> tuple[Tracks, list[tuple[Scans, Told]]]:
    """The tracks after the scans; and by batch, its scans and what was said of them.

    `settings` (sensors, names) are the parameters for each sensor.
    """
    columns: Any = before
    tracks = Tracks(*(column.copy() for column in columns))
    runs, places, size = tracks.mean.shape
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
        told = _no_told(batch, runs, places, size)
        memory = partial(memory_of, tracker.stage, places, largest)
        _compiled(tracker)(runs, batch, settings, tracks, told, scratch=memory)
        said.append((batch, told))
    return tracks, said


def _no_told(scans: Scans, runs: int, places: int, size: int) -> Told:
    """Room for all that could be said: memory that is not written takes none."""
    counts = np.diff(scans.offsets)
    detections = np.add.reduceat(np.append(scans.end - scans.first, 0), scans.offsets[:-1])
    rows = places * int(counts.max(initial=0))
    pairs = places * int(np.where(counts > 0, detections, 0).max(initial=0))
    return Told(
        end=np.zeros((runs, 2), np.int64),
        confirmed=np.full(len(scans.time_ns), NEVER),
        approximated=np.zeros(len(scans.time_ns), np.int64),
        turned_away=np.zeros(len(scans.time_ns), np.int64),
        number=np.empty((runs, rows), np.int64),
        mean=np.empty((runs, rows, size)),
        covariance=np.empty((runs, rows, size, size)),
        existence=np.empty((runs, rows)),
        pair=np.empty((runs, pairs, 3), np.int64),
        probability=np.empty((runs, pairs)),
        white=np.empty((runs, pairs, 2)),
        factor=np.empty((runs, pairs, 2, 2)),
    )


def take_scans(scans: Scans, rows: Integers) -> Scans:
    """Some of the scans, in this order, as those of one run."""
    own = {name: getattr(scans, name)[rows] for name in BY_SCAN}
    counts = own["end"] - own["first"]
    ends = np.cumsum(counts)
    detections = np.arange(int(counts.sum())) + np.repeat(own["first"] - ends + counts, counts)
    own |= {"first": ends - counts, "end": ends}
    return Scans(np.array([0, len(rows)]), **own, detection=scans.detection[detections])


def in_time(first: Scans, second: Scans) -> Scans:
    """The scans of both, of one run, in time order; of equal stamps those of the first come first."""
    shifted = second._replace(
        first=second.first + len(first.detection), end=second.end + len(first.detection)
    )
    own = {name: np.concatenate([getattr(first, name), getattr(shifted, name)]) for name in BY_SCAN}
    detection = np.concatenate([first.detection, second.detection])
    both = Scans(np.array([0, len(own["time_ns"])]), **own, detection=detection)
    return take_scans(both, np.argsort(both.time_ns, kind="stable"))


def of_last(scans: Scans, told: Told) -> tuple[Scans, Told]:
    """The last scan of one run, and what was said of it."""
    last = len(scans.time_ns) - 1
    count, (end, paired) = max(int(told.confirmed[last]), 0), told.end[0]
    is_of_it = told.pair[0, :paired, 1] == last
    by_scan = {name: getattr(told, name)[last:] for name in ("confirmed", "approximated", "turned_away")}
    by_track = {name: getattr(told, name)[:, end - count : end] for name in BY_TRACK}
    return take_scans(scans, np.array([last])), Told(
        end=np.array([[count, int(is_of_it.sum())]]),
        **by_scan,
        **by_track,
        pair=told.pair[:, :paired][:, is_of_it] - np.array([0, last, 0]),
        **{name: getattr(told, name)[:, :paired][:, is_of_it] for name in BY_PAIR},
    )
