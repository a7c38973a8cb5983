"""Study of several inertial units with clock offsets on one body, to find the benefit of more units.

Each recording is replayed with one unit, with the mean of all units, and with one filter per unit. The
estimates of the filters of single units are fused by covariance intersection, because all these filters
use the same fixes. The stamps of the units are corrected with a known offset, with the most likely
offset, or not at all.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import NonNegativeFloat, PositiveFloat
from scipy.spatial.transform import Rotation

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import rms_length
from fuselog.recorders.common_streams import prior_stream, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.mapping import read_mapping, recordings_in
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.orientation import compose, heading
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.models.states import NAVIGATION
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import difference
from fuselog.replay.families.networks.covariance_intersection import fuse

# Position, velocity and orientation, which all filters share; biases belong to their units.
POSE, POSE_TANGENT = 10, 9
POSE_KINDS = ("linear",) * 6 + ("quaternion",) * 4
# Largest gain of the logarithm of the generalized variance that may remain.
_CI_TOLERANCE = 1e-3
FARTHEST_S = 5.0  # width at which the search for an offset ends
ONE, MEAN, INTERSECTION = "one", "mean", "intersection"
KNOWN, ESTIMATED, IGNORED = "known", "estimated", "ignored"
PRIOR_SIGMA = np.concatenate(
    [[0.5] * 3, [1.0] * 3, np.radians([10.0, 10.0, 5.0]), np.radians([2.0] * 3), [0.5] * 3]
)


class QuadInertialOptions(Parameters):
    """Known properties of the recordings, and the search for clock offsets.

    Attributes:
        filter: label of the filter.
        smoother: label of the smoother.
        offsets_s: offset to add to the stamps of the units, in s, by the recording's folder; for other
            folders, the most likely offset is used.
        search_s: smallest offset, largest offset and step of the first search, in s; the search range is
            extended if the best offset is at one of its ends.
        truth_sigma_m: standard deviation of the truth's positions if these are used as fixes in the
            search for offsets.
        scored_from_s: time in s after which errors are evaluated.
    """

    filter: str = "ekf"
    smoother: str = "smoother"
    offsets_s: dict[str, float] = {}
    search_s: tuple[float, float, PositiveFloat] = (-1.0, 0.2, 0.1)
    truth_sigma_m: PositiveFloat = 0.1
    scored_from_s: NonNegativeFloat = 5.0


class Flight(NamedTuple):
    """A recording: its name, truth, fixes, and each unit's samples.

    Attributes:
        time_ns: stamps of the truth (n,).
        state: (n, 10), position, velocity by finite differences, orientation.
        units: inertial samples, in the order of their topics.
    """

    name: str
    source: MemorySource
    time_ns: Integers
    state: Floats
    fix: Stream
    units: list[Stream]


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: QuadInertialOptions = setting.options
    flights = _flights(experiment, setting)
    filter_alone = {options.filter: experiment.estimators[options.filter]}
    found = {
        how: _offsets(flights, filter_alone, options, of_truth=how == "truth")
        for how in ("truth", "fixes")
    }
    cases: dict[tuple[str, str, str], MemorySource] = {}
    for flight in flights:
        offsets = {
            KNOWN: options.offsets_s.get(flight.name, found["truth"][flight.name]),
            ESTIMATED: found["truth"][flight.name],
            IGNORED: 0.0,
        }
        for offset, offset_s in offsets.items():
            for number, unit in enumerate(flight.units, start=1):
                cases[flight.name, offset, f"unit-{number}"] = log_of(flight, unit, offset_s)
            cases[flight.name, offset, MEAN] = log_of(flight, mean_of(flight.units), offset_s)
    sources = Ensemble(cases.values())
    runner = Runner(experiment, setting)
    outputs = replay_in_memory(sources, experiment.estimators, progress=setting.progress)
    runner.keep(sources, outputs)
    outcome = Outcome(input_sha256=hash_streams(flight.source for flight in flights))
    for flight in flights:
        for how, offsets_s in found.items():
            outcome.metrics[f"{options.filter}.offset_from_{how}_s.{flight.name}"] = offsets_s[
                flight.name
            ]
        known_s = options.offsets_s.get(flight.name, found["truth"][flight.name])
        outcome.metrics[f"{options.filter}.known_offset_s.{flight.name}"] = known_s
    runs = {case: run for run, case in enumerate(cases)}
    rows = [
        {"recording": flight.name, "offset": offset, "units": units, "estimator": label, **errors}
        for flight in flights
        for offset in (KNOWN, ESTIMATED, IGNORED)
        for label in experiment.estimators
        for units, errors in _judged(flight, offset, outputs, label, runs, options)
    ]
    table = pd.DataFrame(rows)
    for recording, offset, units, label, *values in table.itertuples(index=False):
        for name, value in zip(table.columns[4:], values, strict=True):
            outcome.metrics[f"{label}.{name}.{recording}-{offset}-{units}"] = value
    outcome.tables |= {"summary": summary_table(outcome.metrics), "flights": table}
    outcome.figures["units"] = _chart(table, options)
    return outcome


def _flights(experiment: Experiment, setting: Setting) -> list[Flight]:
    """Read all recordings at or below --data; the number in a folder's name is the seed of its fixes."""
    assert setting.data is not None
    assert experiment.import_ is not None
    source, values = experiment.import_.source, experiment.import_.parameters
    folders = recordings_in(read_mapping(str(values.get("mapping", ""))), setting.data)
    return [
        flight_of(folder.name, memory_source(*import_run(source, folder, {"seed": number, **values})))
        for folder in folders
        for number in [int((re.findall(r"\d+", folder.name) or ["0"])[-1])]
    ]


def flight_of(name: str, source: MemorySource) -> Flight:
    """Read a recording of the mapping `quadrotor`; raise BadInput if it has no units or no truth."""
    topics = sorted(topic for topic in source.topics if re.fullmatch(r"/imu\w+/inertial", topic))
    if not topics or not {"/truth", "/fix"} <= source.topics.keys():
        raise BadInput(
            f"{name}: has no /truth, no /fix or no inertial unit such as /imu1/inertial; give a log "
            "that has all of them"
        )
    truth = source["/truth"]
    time_ns, place = truth.publish_time_ns, truth["state"][:, :3]
    velocity = np.gradient(place, (time_ns - time_ns[0]) * 1e-9, axis=0)
    state = np.hstack([place, velocity, truth["state"][:, 3:]])
    return Flight(name, source, time_ns, state, source["/fix"], [source[topic] for topic in topics])


def log_of(flight: Flight, samples: Stream, offset_s: float, fix: Stream | None = None) -> MemorySource:
    """Make a log of one unit with shifted stamps, beginning at the first fix within its samples."""
    fix = flight.fix if fix is None else fix
    moved = np.int64(round(1e9 * offset_s))
    unit_ns = samples.publish_time_ns + moved
    fix = fix.take((fix.publish_time_ns >= unit_ns[0]) & (fix.publish_time_ns <= unit_ns[-1]))
    row = int(np.searchsorted(flight.time_ns, fix.publish_time_ns[0]))
    mean = np.concatenate([fix["position_m"][0], flight.state[row, 3:], np.zeros(6)])
    inertial = replace(samples, topic="/inertial", publish_time_ns=unit_ns, log_time_ns=unit_ns)
    streams = [
        prior_stream("/prior", fix.publish_time_ns[0], NAVIGATION, mean, np.diag(PRIOR_SIGMA**2)),
        inertial,
        fix,
        truth_stream("/truth", flight.time_ns, NAVIGATION[:POSE], flight.state),
    ]
    return MemorySource(
        {stream.topic: stream for stream in streams}, flight.source.run, flight.source.name
    )


def mean_of(units: Sequence[Stream]) -> Stream:
    """Average all units at the stamps of the first, after averaging samples with equal stamps."""
    first = units[0]
    columns = {}
    for name in ("specific_force_mps2", "turn_rate_radps"):
        parts = [first[name]]
        for unit in units[1:]:
            stamps, row = np.unique(unit.publish_time_ns, return_inverse=True)
            counts = np.bincount(row)
            for_times = [np.bincount(row, column) / counts for column in unit[name].T]
            parts.append(
                np.stack([np.interp(first.publish_time_ns, stamps, each) for each in for_times], axis=1)
            )
        columns[name] = np.mean(parts, axis=0)
    return replace(first, columns={**first.columns, **columns})


def _offsets(
    flights: Sequence[Flight],
    estimator: Mapping[str, Mapping[str, Any]],
    options: QuadInertialOptions,
    *,
    of_truth: bool,
) -> dict[str, float]:
    """Find the most likely clock offset of each recording's first unit, given positions.

    The positions are those of the truth at all its stamps, or those of the fixes.
    """
    return {
        flight.name: _offset(
            flight,
            _truth_as_fixes(flight, options.truth_sigma_m) if of_truth else flight.fix,
            estimator,
            options.search_s,
        )
        for flight in flights
    }


def _offset(
    flight: Flight,
    fix: Stream,
    estimator: Mapping[str, Mapping[str, Any]],
    search_s: tuple[float, float, float],
) -> float:
    """Find the first unit's most likely clock offset; extend the range if the offset is at its end."""
    (low, high, step), [label] = search_s, estimator
    tried = np.arange(low, high + 0.5 * step, step)
    # use the same fixes for all offsets: likelihoods of different data are not comparable
    unit_ns = flight.units[0].publish_time_ns
    begin_ns, end_ns = unit_ns[0] + round(1e9 * max(high, 0)), unit_ns[-1] + round(1e9 * min(low, 0))
    inside = fix.take((fix.publish_time_ns >= begin_ns) & (fix.publish_time_ns <= end_ns))
    sources = Ensemble(log_of(flight, flight.units[0], offset_s, inside) for offset_s in tried)
    outputs = replay_in_memory(sources, {label: {**estimator[label], "every_s": None}})
    innovation = outputs[f"/estimates/{label}/innovation"]
    likelihood = [float(innovation.of_run(run)["log_likelihood"].sum()) for run in range(len(sources))]
    best, width = int(np.argmax(likelihood)), high - low
    if best in (0, len(tried) - 1) and width < FARTHEST_S:
        further = (low - width, high, step) if best == 0 else (low, high + width, step)
        return _offset(flight, fix, estimator, further)
    return _highest(tried, np.array(likelihood))


def _highest(places: Floats, values: Floats) -> float:
    """Find the peak of the parabola through the largest of equidistant values and its neighbours."""
    best = int(np.argmax(values))
    if best in (0, len(values) - 1):
        return float(places[best])
    left, here, right = values[best - 1 : best + 2]
    shift = 0.5 * (left - right) / (left - 2.0 * here + right)
    return float(places[best] + shift * (places[1] - places[0]))


def _truth_as_fixes(flight: Flight, sigma_m: float) -> Stream:
    """Return all positions of the truth as fixes."""
    count = len(flight.time_ns)
    return make_stream(
        "/fix",
        schemas.POSITION_FIX,
        flight.time_ns,
        metadata=flight.fix.metadata,
        position_m=flight.state[:, :3],
        covariance_m2=np.tile(sigma_m**2 * np.eye(3).reshape(9), (count, 1)),
    )


def _judged(
    flight: Flight,
    offset: str,
    outputs: Mapping[str, Ragged],
    label: str,
    runs: Mapping[tuple[str, str, str], int],
    options: QuadInertialOptions,
) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the errors with one unit, the mean of all units, and the fused filters of all units."""
    estimates = outputs[f"/estimates/{label}/state"]
    innovation = outputs[f"/estimates/{label}/innovation"]
    late_ns = flight.time_ns[0] + round(1e9 * options.scored_from_s)
    of_units = [runs[flight.name, offset, f"unit-{1 + number}"] for number in range(len(flight.units))]
    fused = fused_poses([estimates.of_run(run) for run in of_units])
    for units, run in (
        (ONE, of_units[0]),
        (MEAN, runs[flight.name, offset, MEAN]),
        (INTERSECTION, None),
    ):
        time_ns, pose = fused if run is None else _poses(estimates.of_run(run))
        errors = pose_errors(flight, time_ns, pose, late_ns)
        if run is not None:
            own = innovation.of_run(run)
            late = own.publish_time_ns >= late_ns
            errors["nis"] = float(own["normalised_innovation_squared"][late].mean())
        yield units, errors


def _poses(states: Stream) -> tuple[Integers, Floats]:
    return states.publish_time_ns, states["mean"][:, :POSE]


def fused_poses(units: Sequence[Stream]) -> tuple[Integers, Floats]:
    """Fuse poses (n, 10) of several filters by covariance intersection, at their common stamps.

    The orientations are so similar that the tangent space of the first can be used for all.
    """
    time_ns = units[0].publish_time_ns
    for each in units[1:]:
        time_ns = np.intersect1d(time_ns, each.publish_time_ns)
    rows = [np.searchsorted(each.publish_time_ns, time_ns) for each in units]
    poses = [each["mean"][row, :POSE] for each, row in zip(units, rows, strict=True)]
    size = round(units[0]["covariance"].shape[1] ** 0.5)
    covariances = [
        each["covariance"][row].reshape(-1, size, size)[:, :POSE_TANGENT, :POSE_TANGENT]
        for each, row in zip(units, rows, strict=True)
    ]
    apart = np.stack([difference(pose, poses[0], POSE_KINDS) for pose in poses], axis=1)
    # the same result for nearly equal weights; a finer tolerance takes long
    change = fuse("ci-determinant", apart, np.stack(covariances, axis=1), tolerance=_CI_TOLERANCE).mean
    turn = Rotation.from_rotvec(change[:, 6:]).as_quat(scalar_first=True)
    return time_ns, np.hstack([poses[0][:, :6] + change[:, :6], compose(poses[0][:, 6:], turn)])


def pose_errors(flight: Flight, time_ns: Integers, pose: Floats, late_ns: int) -> dict[str, float]:
    """Compute the RMSE of a flight's poses at the stamps of the truth.

    Args:
        flight: the recording with the truth.
        time_ns: (m,), the poses' stamps.
        pose: (m, 10), position in m, velocity in m/s, orientation as a quaternion.
        late_ns: stamp in ns from which errors are evaluated.

    Returns:
        RMSE by name: position, horizontal position, velocity, and heading in deg.
    """
    _, own, true = np.intersect1d(time_ns, flight.time_ns, return_indices=True)
    late = flight.time_ns[true] >= late_ns
    estimate, truth = pose[own[late]], flight.state[true[late]]
    moved = estimate[:, :6] - truth[:, :6]
    turned = wrap_angle(heading(estimate[:, 6:]) - heading(truth[:, 6:]))
    return {
        "position_rmse_m": rms_length(moved[:, :3]),
        "horizontal_rmse_m": rms_length(moved[:, :2]),
        "velocity_rmse_mps": rms_length(moved[:, 3:]),
        "heading_rmse_deg": float(np.degrees(rms_length(turned[:, None]))),
    }


def _chart(table: pd.DataFrame, options: QuadInertialOptions) -> Chart:
    """Draw the smoother's position and heading errors by recording, per choice of units and offset."""
    rows = table[table["estimator"] == options.smoother]
    panels = []
    for name, label in (
        ("position_rmse_m", "position RMSE (m)"),
        ("heading_rmse_deg", "heading RMSE (deg)"),
    ):
        series = curves(rows, ["units", "offset"], "recording", name, "line+markers")
        panels.append(Panel(x=Axis(label="recording"), y=Axis(label=label, log=True), series=series))
    return Chart(title=f"{options.smoother}: units and offset of their clock", panels=panels, columns=2)


QUAD_INERTIAL = Study(
    "several inertial units with clock offsets on one body", study, QuadInertialOptions
)
