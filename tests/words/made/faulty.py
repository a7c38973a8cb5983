"""Topics with one fault, of which there is more or less, for `edges`."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.body import Body, PlaceSeries, Series
from fuselog.recorders.checks.motion import BodyMotion, Forces, Lag, Slope
from fuselog.recorders.checks.timing import Timing
from fuselog.recorders.log import Stream, make_stream, schemas

BEGIN_NS = 1_700_000_000 * 10**9

ROWS = 200

NOISE = np.random.default_rng(3).standard_normal((10_000, 3))

UPRIGHT = np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))
UNKNOWN = np.full((ROWS, 9), np.nan)


def inertial(
    count: int = ROWS, *, force: Any = None, rate: Any = None, step_ns: Any = 10**7, ahead_ns: Any = 0
) -> Stream:
    """A unit at rest with noise, on the recorder's clock or ahead of it."""
    steps_ns = np.broadcast_to(np.asarray(step_ns), count - 1)
    logged_ns = BEGIN_NS + np.append(0, np.cumsum(steps_ns)).astype(np.int64)
    return make_stream(
        "/imu",
        schemas.INERTIAL_SAMPLE,
        logged_ns + np.asarray(ahead_ns).astype(np.int64),
        log_time_ns=logged_ns,
        specific_force_mps2=NOISE[:count] + np.array([0.0, 0.0, 9.8]) if force is None else force,
        turn_rate_radps=0.1 * NOISE[:count] if rate is None else rate,
        magnetic_field_ut=np.empty((count, 0)),
    )


def fixes(topic: str = "/fix", count: int = ROWS, step_ns: int = 10**8, **given: Any) -> Stream:
    """A receiver at rest."""
    return make_stream(
        topic,
        schemas.GEODETIC_FIX,
        BEGIN_NS + step_ns * np.arange(count),
        latitude_deg=given.get("latitude_deg", 49.0 + 1e-6 * NOISE[:count, 0]),
        longitude_deg=given.get("longitude_deg", 8.4 + 1e-6 * NOISE[:count, 1]),
        altitude_m=given.get("altitude_m", 115.0 + NOISE[:count, 2]),
        covariance_m2=given.get("covariance_m2", np.tile(np.eye(3).ravel(), (count, 1))),
    )


def changed(values: NDArray, rows: Any, value: Any, axis: Any = slice(None)) -> NDArray:
    """The same but for some entries."""
    made = values.copy()
    made[rows, axis] = value
    return made


def field(share: float, wide: float = 1.0, count: int = 60, turn: float = 2.0 * np.pi) -> Stream:
    """A compass that turns: its centre off by a share of the radius, its axes of different lengths."""
    angle = turn * np.arange(count) / count
    circle = 20.0 * np.stack([wide * np.cos(angle) + share, np.sin(angle), 0.0 * angle - 1.5], axis=1)
    stamps_ns = BEGIN_NS + 10**8 * np.arange(count)
    return make_stream(
        "/mag",
        schemas.MAGNETIC_FIELD,
        stamps_ns,
        magnetic_field_ut=circle,
        covariance_ut2=UNKNOWN[:count],
    )


def inertial_b(ahead_s: float) -> Stream:
    stream = inertial(ahead_ns=1e9 * ahead_s)
    return make_stream(
        "/second",
        stream.schema,
        stream.publish_time_ns,
        log_time_ns=stream.log_time_ns,
        **{name: stream[name] for name in stream.columns if not name.endswith("_ns")},
    )


def gaining(gain: float, span_s: float = 300.0, count: int = ROWS) -> Stream:
    """A unit whose clock gains."""
    step_ns = int(1e9 * span_s / (count - 1))
    return inertial(count, step_ns=step_ns, ahead_ns=gain * step_ns * np.arange(count))


def lossy(lost: int, count: int = 1000) -> Stream:
    """Single messages lack."""
    made = np.full(count - 1, 10**7)
    made[3 : 3 + 2 * lost : 2] *= 2
    return inertial(count, step_ns=made)


def thinned_out(every: int) -> Stream:
    made = np.full(999, 10**7)
    made[:: max(int(every), 1)] *= 2
    return inertial(1000, step_ns=made)


def gap(lost: int) -> Stream:
    """Messages lack at once."""
    made = np.full(999, 10**7)
    made[500] *= int(lost) + 1
    return inertial(1000, step_ns=made)


def steps(longest: int) -> NDArray[np.int64]:
    """Every fifth step is a message's, others are longer."""
    made = np.full(ROWS - 1, 10**7 * int(longest))
    made[::5] = 10**7
    return made


def uneven(rows: int) -> NDArray[np.int64]:
    """Some steps are one and a half, and others two."""
    made = np.full(ROWS - 1, 10**7)
    made[: int(rows)] = 15 * 10**6
    made[-20:] *= 2
    return made


def grid() -> NDArray:
    return np.tile(np.arange(8.0), 25)


def off_grid(share: float) -> NDArray:
    return changed(grid()[:, None], slice(3, None, 8), 3.0 + share)[:, 0]


def stuck(length: int, repeated: int = 1, moving: float = 1.0, count: int = ROWS) -> Stream:
    """One axis stays; others move in a share of the rows meanwhile."""
    length = int(length)
    force = np.repeat(NOISE[:count], repeated, axis=0)[:count]
    others = force.copy()
    still = round((1.0 - moving) * length)
    others[9 : 9 + still + 1] = others[9]
    others[9 : 9 + length, 0] = 0.25
    rate = np.zeros((count, 3))
    return inertial(count, force=others, rate=rate)


def rounded_to(share: float) -> Stream:
    return inertial(force=share * np.round(NOISE[:ROWS] / share))


def stepping(rows: int) -> Stream:
    """A column on a grid that seldom changes."""
    force = NOISE[:ROWS].copy()
    force[:, 0] = np.repeat(np.arange(int(rows) + 1) % 3, -(-ROWS // (int(rows) + 1)))[:ROWS]
    return inertial(force=force)


def levels(number: int) -> Stream:
    force = NOISE[:ROWS].copy()
    force[:, 0] = np.argsort(NOISE[:ROWS, 1]) % int(number)
    return inertial(force=force)


def saturated(rows: int, share: float = 1.0, count: int = ROWS) -> Stream:
    end = share * np.radians(250.0)
    rate = 0.1 * NOISE[:count]
    return inertial(count, rate=changed(rate, slice(1, 1 + 2 * int(rows), 2), end, 2))


def counted(end: int) -> Stream:
    """Forces in counts of an analogue converter, some at its end."""
    force = 0.001 * np.round(3.0 * NOISE[:ROWS])
    force[::7, 0] = 0.001 * int(end)
    force[1::7, 0] = 0.001 * (int(end) - 1)
    return inertial(force=force)


def both(degrees: float) -> Stream:
    return fixes(latitude_deg=np.full(ROWS, 0.9 * degrees), longitude_deg=np.full(ROWS, 2.1 * degrees))


def second(lower_m: float, scatter_m: float = 0.0) -> Stream:
    """Another receiver's heights."""
    heights = 115.0 + NOISE[:ROWS, 2] - lower_m + scatter_m * NOISE[:ROWS, 0]
    return fixes("/second", altitude_m=heights)


def climbing(metres: float, count: int = ROWS) -> Stream:
    return fixes(count=count, altitude_m=115.0 + metres * np.linspace(0.0, 1.0, count))


def placed(metres: float, noise: float = 0.0) -> Stream:
    """A z that falls as one climbs."""
    z = metres * np.linspace(0.0, -1.0, ROWS) + noise * NOISE[:ROWS, 2]
    return make_stream(
        "/place",
        schemas.POSITION_FIX,
        BEGIN_NS + 10**8 * np.arange(ROWS),
        position_m=np.stack([0.0 * z, 0.0 * z, z], axis=1),
        covariance_m2=UNKNOWN[:ROWS],
    )


def leaning(share: float, count: int = ROWS, axis: int = 0) -> Stream:
    """A unit one of whose axes is up by a share."""
    force = 9.8 * np.roll([share, np.sqrt(1.0 - share**2), 0.0], axis)
    return inertial(count, force=np.tile(force, (count, 1)))


def spread(above: float, below: float) -> Stream:
    """A covariance with a correlation near 1, or not symmetric."""
    matrix = np.eye(3)
    matrix[0, 1], matrix[1, 0] = (1.0 + above, 1.0 + below) if below else (above, 0.0)
    return fixes(covariance_m2=np.tile(matrix.ravel(), (ROWS, 1)))


def motion(**known: Any) -> Any:
    """What comparing topics in pairs tells, as given."""
    times_s = 0.01 * np.arange(ROWS)
    rate = Series("/imu", "turn_rate_radps", times_s, known.pop("rate", np.ones(ROWS)))
    force = Series("/imu", "specific_force_mps2", times_s, known.pop("force", np.zeros((ROWS, 3))))
    heading = Series("/compass", "quaternion", times_s, known.pop("heading", UPRIGHT))
    speed = Series("/wheels", "forward_mps", times_s, np.ones(ROWS))
    body = Body(turns=[rate], forces=[force], orientations=[heading], speeds=[speed])
    along = Series("/fix", "position_m", times_s, times_s)
    made = {"body": body, "courses": along, "places": along, "aligned": lambda series: series}
    made |= {name: (lambda *_, value=value: value) for name, value in known.items()}
    return SimpleNamespace(**made)


def resting(ratio: float, count: int = 40) -> Any:
    """A receiver at rest, then one that moves: its scatter as a multiple of what it states."""
    rows, moving = int(count), 60
    speed = np.append(np.zeros(10 * rows), np.ones(10 * moving))
    place = np.sqrt(ratio) * NOISE[: rows + moving, :2] * [1.0, 0.9]
    place[rows:] += np.arange(moving)[:, None]
    told = motion()
    stamps_s = np.arange(float(rows + moving))
    told.body.fixes = [PlaceSeries("/fix", "position_m", stamps_s, place, False, np.ones(rows + moving))]
    told.body.speeds = [Series("/wheels", "forward_mps", 0.1 * np.arange(len(speed)), speed)]
    return told


def turning(rate: float, share: float = 0.01) -> Any:
    """A unit that turns, and quaternions in another order that turn a hundredth faster."""
    times_s = 0.01 * np.arange(1000)
    half = 0.5 * rate * (1.0 + share) * times_s
    quaternion = np.stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)], axis=1)
    heading = quaternion[:, [1, 2, 3, 0]]
    told = motion()
    told.body.orientations = [Series("/compass", "quaternion", times_s, heading)]
    told.body.rates = [Series("/imu", "turn_rate_radps", times_s, np.tile([0.0, 0.0, rate], (1000, 1)))]
    return told


def mirrored(ratio: float) -> Any:
    """A course that turns the other way round than a rate and a heading do."""
    return motion(turn=alike(-ratio), heading_course=alike(1.0), heading_turn=alike(1.0))


def alike(value: float, likeness: float = 0.99, spread_: float = 0.1, windows: int = 40) -> Slope:
    return Slope(value, likeness, spread_, windows)


def off_course(mean: float, wide: float = 0.01, count: int = 40) -> Any:
    offsets = mean + wide * np.tile([-1.0, 1.0], count)[: int(count)]
    return motion(heading_course=alike(1.0), heading_offsets=offsets)


def turned(angle: float, fit: float = 0.95, mirrored: float = 0.1) -> Any:
    return motion(forces=Forces(angle, fit, mirrored))


def weighing(norm: float, share: float = 0.0) -> Any:
    """At rest; of its length a share points down."""
    force = norm * np.array([np.sqrt(1.0 - share**2), 0.0, -share])
    return motion(force=np.tile(force, (ROWS, 1)), turn=None)


def fast(rate: float, share: float = 1.0) -> Any:
    return motion(rate=np.where(np.arange(ROWS) < share * ROWS, rate, 0.0), turn=None)


def by_velocities(factor: float) -> BodyMotion:
    """A body without places, whose velocities are summed, and wheels in another unit."""
    times_s = 0.2 * np.arange(60)
    speed = 10.0 + 5.0 * np.sin(times_s)
    velocity = np.stack([0.8 * speed, 0.6 * speed], axis=1)
    source = Series("/velocity", "velocity_mps", times_s, velocity)
    return BodyMotion(
        Body(velocities=[source], speeds=[Series("/wheels", "forward_mps", times_s, factor * speed)])
    )


def late(seconds: float) -> Any:
    told = motion()
    told.delays_s, told.turn_lags = {"/wheels": seconds}, []
    told.speed_lags = [Lag("/wheels", "/fix", Timing(seconds, 0.0, 0.987, 9.0, True, 0.1, 0.05, True))]
    return told
