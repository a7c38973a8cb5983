"""Advice on the next manoeuvre to record, from the information that it would add to a calibration.

Manoeuvres of a wheeled robot are simulated without noise to compute their information. The simulation
uses the sensors, time steps and noise levels of the log, and the estimated values. The best manoeuvre
depends on the criterion: the determinant takes all parameters into account, whereas the widest interval
depends only on the least accurate one. A parameter's useful unit is the standard error that a
calibration should reach.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.information import information
from fuselog.pipeline.tuning.objective import Run
from fuselog.pipeline.tuning.outcome import TUNED, Tuning
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Schema, Stream, schemas, topics_of
from fuselog.recorders.recording import Recording
from fuselog.recorders.simulators.car import MOTIONS, Car, CarParameters, philox, streams_of
from fuselog.recorders.simulators.car import drive as simulated
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import MemorySource, Source, memory_source

DURATION_S = 20.0
PRIOR = 10.0  # standard deviation of a parameter before anything is recorded, in useful units
SIMULATED = {
    "/car/odometry": schemas.ODOMETRY,
    "/car/fix": schemas.POSITION_FIX,
    "/car/heading": schemas.ORIENTATION,
}

# factors of speed and turn rate, bias of the turn rate, lever arm, delay of fixes, compass angle
TRUTH = np.array([1.03, 0.98, 0.01, 1.2, -0.4, 0.15, 0.05])
# the same in the model's convention
OURS = np.array([1.0 / TRUTH[0], 1.0 / TRUTH[1], -TRUTH[2] / TRUTH[1], *TRUTH[3:]])
ERRORS = (
    *("forward_factor", "turn_factor", "turn_error_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "compass_error_rad"),
)
NAMES = (
    *("forward_scale", "turn_scale", "turn_bias_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "bias_heading_rad"),
)
WIDE = {
    "prior_sigma_m": 1000.0,
    "prior_sigma_rad": 1.0,
}  # a prior so wide that it has no influence on the start


class Gain(NamedTuple):
    """The information that a manoeuvre adds.

    Attributes:
        nats: half the logarithm of the ratio of determinants with and without the manoeuvre.
        sigmas: (m,) the standard deviations with the manoeuvre, in useful units.
    """

    nats: float
    sigmas: Floats

    @property
    def widest(self) -> float:
        """Return the largest standard deviation, in useful units."""
        return float(self.sigmas.max())


def gain(known: Floats, added: Floats) -> Gain:
    """Compute how much information a manoeuvre adds to the known information.

    Args:
        known: (m, m), in useful units.
        added: (m, m), in useful units; its sum with `known` is positive definite.

    Returns:
        The information gained, and the remaining standard deviations (m,).

    >>> found = gain(np.diag([4.0, 1.0]), np.diag([0.0, 3.0]))
    >>> round(found.nats, 3), found.sigmas.tolist()
    (0.693, [0.5, 0.5])
    """
    before, after = np.linalg.slogdet(known)[1], np.linalg.slogdet(known + added)[1]
    return Gain(0.5 * float(after - before), np.sqrt(np.diag(np.linalg.inv(known + added))))


def manoeuvres(found: Tuning) -> pd.DataFrame:
    """Tabulate manoeuvres of 20 s, in ascending order of the widest interval that would remain.

    The columns are the manoeuvre, the information that it adds in nats, the largest remaining standard
    deviation in useful units, and each parameter's remaining standard deviation in the parameter's unit.
    The row "none" describes the logs without another manoeuvre.

    Raises BadInput if the logs are not those of a robot with wheels.
    """
    free = [each for each in found.found.coordinates.free if each.name in NAMES]
    objective, values = found.objective, found.found.optimum
    places = [objective.names.index(each.name) for each in free]
    useful = np.zeros(len(values))
    useful[places] = [each.useful for each in free]
    scale = useful[places]
    log = found.logs[0]
    known = information(objective, values, useful, places) + np.eye(len(places)) / PRIOR**2
    gains = {"none": gain(known, 0.0 * known)}
    for name in MOTIONS:
        run = _simulated(found, log, name)
        simulated = replace(objective, runs=[run], pool=None)
        simulated.begin(values)
        gains[name] = gain(known, information(simulated, values, useful, places))
    rows = [(name, each.nats, each.widest, *each.sigmas * scale) for name, each in gains.items()]
    columns = ["manoeuvre", "nats", "widest", *(each.name for each in free)]
    return pd.DataFrame(rows, columns=columns).sort_values("widest", ignore_index=True)


def advice(found: Tuning) -> list[str]:
    """Recommend the manoeuvres that are best for the widest interval and for the determinant."""
    table = manoeuvres(found)
    names = list(table.columns[3:])
    before, best = table[table["manoeuvre"] == "none"].iloc[0], table.iloc[0]
    if best["manoeuvre"] == "none":
        return ["next: no manoeuvre would add to the information in the logs"]
    useful = {each.name: each.useful for each in found.found.coordinates.free}
    widest = max(names, key=lambda name: before[name] / useful[name])
    by_determinant = table.iloc[int(table["nats"].argmax())]
    return [
        f"next, record {best['manoeuvre']}: of {len(MOTIONS)} manoeuvres of {DURATION_S:g} s, it "
        f"narrows the widest interval most: the standard error of {widest} becomes {best[widest]:.3g} "
        f"({before[widest]:.3g} without it)",
        "judged by the determinant, which counts all parameters together, the best manoeuvre is "
        f"{by_determinant['manoeuvre']} ({by_determinant['nats']:.1f} nats; {best['manoeuvre']}: "
        f"{best['nats']:.1f})",
    ]


def _simulated(found: Tuning, log: Source, motion: str) -> Run:
    """Simulate a manoeuvre with the estimated values, as a log with the same topics."""
    streams = _of_kinds(log)
    odometry_s, fix_s, compass_s = (_step_s(streams.get(topic)) for topic in SIMULATED)
    usual = dict.fromkeys(NAMES, 0.0) | {"forward_scale": 1.0, "turn_scale": 1.0}
    held = {name: found.settings[TUNED].get(name) or value for name, value in usual.items()}
    car = drive(
        None,
        _errors(held),
        motion=motion,
        duration_s=DURATION_S,
        odometry_step_s=odometry_s,
        fix_step_s=fix_s,
        first_fix_s=2.0 * fix_s,
        compass_step_s=compass_s,
        **WIDE,
    )
    source = recorded(car)
    made: dict[str, Stream] = {}
    for topic, stream in source.streams.items():
        if topic in streams:
            made[streams[topic].topic] = _alike(stream, streams[topic])
        elif topic not in SIMULATED:
            prior = _first_of(log, stream.schema)
            name = topic if prior is None else prior.topic
            made[name] = replace(stream, topic=name)
    simulated = replace(source, streams=made)
    return Run(Trial(found.label, Ensemble([simulated]), found.settings[TUNED]))


def _first_of(log: Source, schema: Schema) -> Stream | None:
    """Read a schema's first topic outside /estimates/, or return None if there is no such topic."""
    for name in topics_of(log.topics, schema):
        if not name.startswith("/estimates/"):
            return log.read([name])[name]
    return None


def _of_kinds(log: Source) -> dict[str, Stream]:
    """Return the log's streams that the simulation imitates, keyed by the simulation's topics."""
    streams = {topic: _first_of(log, schema) for topic, schema in SIMULATED.items()}
    found = {topic: stream for topic, stream in streams.items() if stream is not None}
    if "/car/odometry" not in found or "/car/fix" not in found:
        raise BadInput(
            f"--next: {log.name} has no odometry with fixes; manoeuvres are for a robot with wheels"
        )
    return found


def _step_s(stream: Stream | None) -> float:
    """Compute the median time between messages, in s."""
    if stream is None or len(stream) < 2:
        return 1.0
    return float(np.median(np.diff(stream.publish_time_ns))) * 1e-9


def _errors(values: Mapping[str, Any]) -> Floats:
    """Convert a model's values to the errors (7,) of a car's readings relative to the motion."""
    forward, turn, bias, *others = (float(values[name]) for name in NAMES)
    return np.array([1.0 / forward, 1.0 / turn, -bias / turn, *others])


def _alike(stream: Stream, like: Stream) -> Stream:
    """Give a simulated stream the name, metadata and covariance of a recorded stream."""
    columns = {
        name: np.repeat(like[name][:1], len(stream), axis=0) if "covariance" in name else column
        for name, column in stream.columns.items()
    }
    return replace(stream, topic=like.topic, metadata=like.metadata, columns=columns)


def drive(seed: int | None, errors: Floats = TRUTH, **changed: Any) -> Car:
    """Simulate a drive of the car and the measurements of its sensors.

    Args:
        seed: the seed of the noise and of the first pose. Without a seed, there is no noise, and the
            car starts at zero.
        errors: (7,), the sensors' errors, in the order of `TRUTH`.
        changed: parameters of the car that differ from their defaults.

    Returns:
        The measurements with their stamps.
    """
    wrong = dict(zip(ERRORS, errors.tolist(), strict=True))
    return simulated(CarParameters(**{**wrong, **changed}), None if seed is None else philox(seed))


def recorded(car: Car) -> MemorySource:
    """Make a log of a drive, with a prior around the origin."""
    return memory_source(Recording(streams_of(car)), RunMetadata("car C", epoch_ns=0))
