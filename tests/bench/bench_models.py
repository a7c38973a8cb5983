"""Today's estimators beside the hand-specialised kernels of `reference`, frozen, in one run.

The kernels get columns that are ready, and fill arrays; the estimators start from columns in memory and
end with output streams, plumbing included. Where they are made of a model, their loop is timed alone as
well. That the estimates are equal is asserted. CPU time of all cores together, medians of turns; the
ratio is how many times the reference's an estimator takes. Run it with `python -m tests.bench models`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.families.directional.headings import equal_sigmas
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.recording import Recording, simulation_stamps_ns
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.directional.distributions import bingham
from fuselog.replay.families.directional.distributions.bingham import Bingham, make_bingham
from fuselog.replay.families.directional.distributions.wrapped_normal import WrappedNormal
from tests.bench.columns import Floats, column, copied, offsets, offsets_of, prior, stamps_ns
from tests.bench.loops import Call, calls_of
from tests.bench.reference import bingham as bingham_reference
from tests.bench.reference import inertial, landmarks, reactor, torus, vehicles
from tests.bench.reference.gaussian import ALL_WELL, unscented
from tests.bench.timing import cpu_seconds

TOLERANCE = 1e-9
Row = tuple[str, str, str, str]
# From the runs a call of the kernel, which returns the means of all runs end to end.
Prepare = Callable[[list[MemorySource]], Callable[[], Floats]]


class Case(NamedTuple):
    """One filter: what records it, its name, parameters and output topics, and the references.

    `one` and `many` are scenario parameters and the number of runs, of a long log and of an ensemble.
    """

    name: str
    record: Callable[..., list[MemorySource]]
    estimator: str
    settings: Mapping[str, Any]
    outputs: tuple[str, ...]
    references: Mapping[str, Prepare]
    one: tuple[dict[str, Any], int]
    many: tuple[dict[str, Any], int]


def main() -> list[Row]:
    """One log and an ensemble of every filter: microseconds per step, and the ratio."""
    return [
        row for case in CASES for parameters in (case.one, case.many) for row in timed(case, *parameters)
    ]


def timed(case: Case, parameters: dict[str, Any], runs: int) -> list[Row]:
    """The estimator beside each of its references."""
    sources = case.record(parameters, runs)
    ours: dict[str, Callable[[], Floats]] = {"": partial(estimated, case, sources)}
    calls = calls_of(bind(case.estimator, sources, case.settings), sources)
    if calls:
        ours[", its loop alone"] = partial(repeated, calls)
    ways = ours | {name: prepare(sources) for name, prepare in case.references.items()}
    means = {name: way() for name, way in ways.items()}  # compiles as well
    for name in means:
        apart = np.max(np.abs(means[name] - means[""]))
        assert apart < TOLERANCE, f"{case.name}: {name} and the estimator are {apart} apart"
    steps = len(means[""])
    us = {name: 1e6 * taken / steps for name, taken in cpu_seconds(ways).items()}
    what = f"{case.name}, {'one log' if runs == 1 else f'{runs} runs'}"
    return [
        (
            f"{what}{part}; {name}",
            f"{us[part]:.3g} us",
            f"{us[name]:.3g} us",
            f"{us[part] / us[name]:.2f} times",
        )
        for name in case.references
        for part in ours
    ]


def repeated(calls: list[Call]) -> Floats:
    """The means of the loops on columns that are ready, one output after the other."""
    means = [call() for call in calls]
    for mean in means:
        if mean.shape[1] == 3:  # a pose
            mean[:, 2] = wrap_angle(mean[:, 2])
    return np.concatenate(means)


def estimated(case: Case, sources: list[MemorySource]) -> Floats:
    """Means of all runs end to end, one output after the other."""
    outputs = collect(replay(sources, bind(case.estimator, sources, case.settings)))
    return np.concatenate(
        [outputs[f"/estimates/{case.estimator}/{name}"]["mean"] for name in case.outputs]
    )


# Landmarks.


def sightings(sources: list[MemorySource]) -> tuple[landmarks.Sightings, Floats]:
    """The events of all runs in time order, and the maps' positions."""
    parts, positions = [], []
    for source in sources:
        odometry, seen = source.streams["/robot1/odometry"], source.streams["/robot1/range_bearing"]
        known = source.streams["/landmarks"]
        row_of = {identity: row for row, identity in enumerate(known["landmark_id"].tolist())}
        target = [sum(map(len, positions)) + row_of[each] for each in seen["target_id"].tolist()]
        positions.append(known["position_m"])
        driven = np.column_stack([odometry["forward_mps"], odometry["turn_radps"]])
        time_ns = np.concatenate([odometry.publish_time_ns, seen.publish_time_ns])
        order = np.lexsort([np.concatenate([odometry.position, seen.position]), time_ns])
        time_ns = time_ns[order]
        parts.append(
            (
                time_ns,
                np.repeat([-1, 0], [len(odometry), len(seen)])[order],
                np.concatenate([driven, np.column_stack([seen["range_m"], seen["bearing_rad"]])])[order],
                np.concatenate([np.full(len(odometry), -1), target]).astype(np.int64)[order],
                np.append(time_ns[1:] != time_ns[:-1], True),
            )
        )
    time_ns, sensor, value, target, is_last = (np.concatenate(each) for each in zip(*parts, strict=True))
    counts = offsets_of([len(part[0]) for part in parts])
    events = landmarks.Sightings(counts, time_ns, sensor, value, target, target, is_last)
    return events, np.concatenate(positions)


def localization(kind: str, sources: list[MemorySource]) -> Callable[[], Floats]:
    events, positions = sightings(sources)
    runs, count = len(sources), len(events.time_ns)
    loop = landmarks.compiled(kind)
    start = landmarks.Carried(
        *prior(sources, "/robot1/prior", 3),
        np.zeros((runs, 2)),
        stamps_ns(sources, "/robot1/prior"),
        np.full(runs, ALL_WELL),
    )
    settings = landmarks.Settings(
        np.array([0.02, 0.01]), np.zeros(2), np.array([[0.1**2, 0.02**2]]), np.full(3, np.inf)
    )

    def work() -> Floats:
        begin, integers = events.offsets[:-1], partial(np.empty, count, np.int64)
        poses = landmarks.Poses(
            events.offsets, begin.copy(), integers(), np.empty((count, 3)), np.empty((count, 3, 3))
        )
        looks = landmarks.Looks(
            events.offsets,
            begin.copy(),
            integers(),
            np.empty((count, 2)),
            np.empty((count, 2, 2)),
            np.empty(count),
            integers(),
        )
        loop(runs, events, positions, settings, copied(start), poses, looks)
        filled = [slice(*each) for each in zip(begin.tolist(), poses.end.tolist(), strict=True)]
        mean = np.concatenate([poses.mean[rows] for rows in filled])
        mean[:, 2] = (mean[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        return mean

    return work


# The batch reactor.


def reactor_kernel(sources: list[MemorySource]) -> Callable[[], Floats]:
    measured, time_ns = column(sources, "/pressure", "value"), stamps_ns(sources, "/pressure")
    rows, runs, loop = len(measured), offsets(sources, "/pressure"), reactor.compiled()
    start = reactor.Carried(
        *prior(sources, "/prior", 2), stamps_ns(sources, "/prior"), np.full(len(sources), ALL_WELL)
    )
    noise, gate = np.array([0.1, 1e-5, 0.1]), np.full(2, np.inf)
    scratch = partial(reactor.scratch, unscented(2, 0.5))

    def work() -> Floats:
        shapes = [(2,), (2, 2), (1,), (1, 1), ()]
        results = reactor.Results(*(np.full((rows, *shape), np.nan) for shape in shapes))
        arguments = (runs, time_ns, measured, noise, gate, copied(start), results)
        loop(len(sources), *arguments, scratch=scratch)
        return results.mean

    return work


# Vehicles.

VEHICLES = range(1, 6)


def vehicle(number: int, sources: list[MemorySource]) -> Callable[[], Floats]:
    fix, start_topic = f"/vehicle{number}/fix", f"/vehicle{number}/prior"
    stated = sources[0].streams[start_topic].metadata
    motion = vehicles.Motion(*(float(stated[name]) for name in vehicles.Motion._fields))
    value = np.concatenate(
        [column(sources, fix, name) for name in ("position_m", "covariance_m2")], axis=1
    )
    messages = vehicles.Messages(offsets(sources, fix), stamps_ns(sources, fix), value)
    mean, covariance = prior(sources, start_topic, 4)
    start = vehicles.State(
        mean, covariance, stamps_ns(sources, start_topic), covariance * 0.0, covariance * 0.0
    )
    loop, rows = vehicles.compiled(), len(value)

    def work() -> Floats:
        shapes = [(4,), (4, 4), (2,), (2, 2), ()]
        results = vehicles.Results(*(np.full((rows, *shape), np.nan) for shape in shapes))
        loop(len(sources), motion, messages, copied(start), results)
        return results.mean

    return work


def all_vehicles(sources: list[MemorySource]) -> Callable[[], Floats]:
    each = [vehicle(number, sources) for number in VEHICLES]
    return lambda: np.concatenate([work() for work in each])


# Directions.


def bingham_kernel(topic: str, sources: list[MemorySource]) -> Callable[[], Floats]:
    assert sources[0].run
    stated = sources[0].run.parameters
    start, system, measurement = (
        make_bingham(np.eye(len(stated[name]["diagonal"])), stated[name]["diagonal"])
        for name in ("prior", "system", "measurement")
    )
    measured = column(sources, topic, sources[0].streams[topic].schema.fields[-1].name)
    rows, d = measured.shape
    identity = np.eye(d)[0]
    steps = bingham_reference.Steps(offsets(sources, topic), np.tile(identity, (rows, 1)), measured)
    noise = (
        bingham.covariance(system),
        bingham.parameter_matrix(bingham.likelihood(measurement, identity)),
    )
    states = Bingham(*(np.repeat(part[None], len(sources), axis=0) for part in start))

    def work() -> Floats:
        estimates = Bingham(np.empty((rows, d, d)), np.empty((rows, d)))
        bingham_reference.filter_runs(steps, *noise, copied(states), estimates)
        return estimates.mode

    return work


def torus_kernel(
    step: Callable[..., None], option: float, sources: list[MemorySource]
) -> Callable[[], Floats]:
    assert sources[0].run
    stated = sources[0].run.parameters
    model = torus.HeadingModel(
        stated["coupling_rad"],
        np.array([stated["drift1_rad"], stated["drift2_rad"]]),
        equal_sigmas(stated["system_sigma_rad"], stated["system_correlation"]),
        equal_sigmas(stated["measurement_sigma_rad"], stated["measurement_correlation"]),
    )
    measured, runs = column(sources, "/headings", "value"), offsets(sources, "/headings")
    start = WrappedNormal(*prior(sources, "/prior", 2))
    loop = torus.compiled(step)

    def work() -> Floats:
        estimates = WrappedNormal(np.empty(measured.shape), np.empty((*measured.shape, 2)))
        loop(len(sources), model, option, runs, measured, copied(start), estimates)
        return estimates.mean

    return work


def bodies(parameters: Mapping[str, int], runs: int) -> list[MemorySource]:
    """Inertial samples of bodies that rest for 2 s and then turn about; at 285 Hz."""
    rng, count = np.random.default_rng(1), parameters["samples"]
    time_s = np.arange(count) / 285.0
    found = []
    for run in range(runs):
        rate = np.where(time_s[:, None] < 2.0, 0.0, np.sin(time_s[:, None] * rng.uniform(0.5, 2.0, 3)))
        stream = make_stream(
            "/body/inertial",
            schemas.INERTIAL_SAMPLE,
            simulation_stamps_ns(time_s),
            specific_force_mps2=rng.normal((0.0, 0.0, 9.81), 0.5, (count, 3)),
            turn_rate_radps=rate + rng.normal(0.0, 0.01, (count, 3)),
            magnetic_field_ut=rng.normal((0.0, 20.0, -40.0), 0.5, (count, 3)),
        )
        found.append(memory_source(Recording([stream]), RunMetadata("bodies", run=run)))
    return found


def inertial_kernel(sources: list[MemorySource]) -> Callable[[], Floats]:
    topic = "/body/inertial"
    samples = inertial.InertialSamples(
        offsets(sources, topic),
        stamps_ns(sources, topic),
        *(
            column(sources, topic, name)
            for name in ("turn_rate_radps", "specific_force_mps2", "magnetic_field_ut")
        ),
    )
    rows, model = len(samples.time_ns), inertial.InertialModel(rest_s=2.0)

    def work() -> Floats:
        estimates = inertial.OrientationEstimates(
            np.full((rows, 4), np.nan), np.full((rows, 3, 3), np.nan)
        )
        inertial.filter_runs(model, inertial.start_inertial_filter(len(sources)), samples, estimates)
        return estimates.orientation[np.isfinite(estimates.orientation[:, 0])]

    return work


def recorded(scenario: str, parameters: Mapping[str, Any], runs: int) -> list[MemorySource]:
    return record_ensemble(scenario, parameters, 1, runs)


KERNEL = "the kernel by hand"
UNGATED = {"gate_probability": 1.0}
CASES = [
    *(
        Case(
            f"{kind.upper()} among landmarks",
            partial(recorded, "landmarks"),
            kind,
            UNGATED,
            ("robot1/pose",),
            {KERNEL: partial(localization, kind)},
            ({"duration_s": 300.0}, 1),
            ({"duration_s": 20.0}, 1000),
        )
        for kind in ("ekf", "ukf")
    ),
    Case(
        "UKF of the reactor",
        partial(recorded, "batch-reactor"),
        "lrkf:ukf",
        {},
        ("state",),
        {KERNEL: reactor_kernel},
        ({"steps": 2000}, 1),
        ({}, 1000),
    ),
    Case(
        "Kalman filters of 5 vehicles",
        partial(recorded, "vehicles"),
        "vehicle-kalman",
        {},
        tuple(f"vehicle{number}/state" for number in VEHICLES),
        {KERNEL: all_vehicles},
        ({"duration_s": 1000.0}, 1),
        ({}, 200),
    ),
    *(
        Case(
            f"Bingham filter of an {scenario}",
            partial(recorded, scenario),
            f"bingham-{scenario}",
            {},
            ("state",),
            {KERNEL: partial(bingham_kernel, topic)},
            ({"steps": 2000}, 1),
            ({}, 200),
        )
        for scenario, topic in (("axis", "/axis"), ("orientation", "/quaternion"))
    ),
    *(
        Case(
            f"{name} of two headings",
            partial(recorded, "torus-headings"),
            estimator,
            {},
            ("state",),
            {KERNEL: partial(torus_kernel, step, option)},
            ({"steps": 2000}, 1),
            ({}, 200),
        )
        for name, estimator, step, option in (
            ("toroidal filter", "torus", torus.toroidal_step, 0.2),
            ("UKF", "ukf-torus", torus.unscented_step, True),
        )
    ),
    Case(
        "Bingham filter of inertial samples",
        bodies,
        "bingham-inertial",
        {"rest_s": 2.0},
        ("body/state",),
        {KERNEL: inertial_kernel},
        ({"samples": 20_000}, 1),
        ({"samples": 2_000}, 50),
    ),
]
