"""Import of the autopilot's own filter, EKF2: states, innovations, and a simulator's truth.

PX4's innovations are prediction minus measurement; fuselog's have the opposite sign. EKF2 fuses
components one by one, and logs the variance of each, so the covariances here are diagonal.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.importers.ulog.file import Rows
from fuselog.recorders.importers.ulog.sensors import BODY, Fields, Part, orientations, to_enu
from fuselog.recorders.log import schemas
from fuselog.recorders.models.orientation import conjugate, left_matrix, rotate
from fuselog.recorders.models.states import NAVIGATION, state_metadata

Floats = NDArray[np.float64]
TRUTH = f"{BODY}/truth"
_POSE = NAVIGATION[:10]
# The number of states with logged variances if an orientation has three of them.
_TANGENT_STATES = 23
_UNIT_TOLERANCE = 1e-2
_INNOVATIONS = (
    "estimator_innovations",
    "estimator_innovation_variances",
    "estimator_innovation_test_ratios",
)
_LOCAL, _ATTITUDE = "vehicle_local_position_groundtruth", "vehicle_attitude_groundtruth"
TOPICS = (*_INNOVATIONS, _LOCAL, _ATTITUDE, "estimator_states", "estimator_status", "ekf2_innovations")


class _Sensor(NamedTuple):
    """The innovations of a sensor: fields, fuselog's component names, and signs relative to PX4's.

    For each component, `bits` lists bits of the filter's status; at least one of them is set while the
    component is in use. A component without such bits has an empty tuple.
    """

    fields: tuple[str, ...]
    components: tuple[str, ...]
    signs: tuple[float, ...]
    bits: tuple[tuple[int, ...], ...]


def _enu(what: str, unit: str, fields: tuple[str, str], bits: tuple[int, int]) -> _Sensor:
    """Describe a sensor of north, east and down; `fields` and `bits` are (horizontal, vertical)."""
    (horizontal, vertical), (level, height) = fields, bits
    names = tuple(f"{what}{axis}_{unit}" for axis in "xyz")
    every = (f"{horizontal}[1]", f"{horizontal}[0]", vertical)
    return _Sensor(every, names, (-1.0, -1.0, 1.0), ((level,), (level,), (height,)))


def _flu(name: str, unit: str, bits: tuple[int, ...], axes: str = "xyz") -> _Sensor:
    """Describe a sensor along the body's forward, right and down axes, or the first two of them."""
    fields = tuple(f"{name}[{index}]" for index in range(len(axes)))
    names = tuple(f"{name}_{axis}_{unit}" for axis in axes)
    return _Sensor(fields, names, (-1.0, 1.0, 1.0)[: len(axes)], (bits,) * len(axes))


def _single(field: str, name: str, sign: float, *bits: int) -> _Sensor:
    return _Sensor((field,), (name,), (sign,), (bits,))


# Signs and order follow PX4's src/modules/ekf2/EKF: `_state.vel(i) - gps_sample.vel(i)` and
# `_state.pos(i) -
# position(i)`, north, east, down (gps_fusion.cpp; of heights baro_height_control.cpp); `getEulerYaw -
# measured_hdg`, clockwise (mag_control.cpp); `mag_I_body - mag_observation`; `predicted_flow -
# opt_flow_rate` about forward and right (optflow_fusion.cpp); `pred_acc - mea_acc` (drag_fusion.cpp);
# `v_tas_pred - true_airspeed` (airspeed_fusion.cpp). Bits by `filter_control_status_u` (common.h), the
# same up to version 1.15. Without a fix, EKF2 holds its position, and logs innovations of that in the
# fields of fixes: `_gps_pos_innov.xy() = Vector2f(_state.pos) - _last_known_posNE` (control.cpp).
_SENSORS = {
    "gnss_velocity": _enu("v", "mps", ("gps_hvel", "gps_vvel"), (2, 2)),
    "gnss_position": _enu("", "m", ("gps_hpos", "gps_vpos"), (2, 11)),
    "vision_velocity": _enu("v", "mps", ("ev_hvel", "ev_vvel"), (24, 24)),
    "vision_position": _enu("", "m", ("ev_hpos", "ev_vpos"), (12, 14)),
    "barometer": _single("baro_vpos", "z_m", 1.0, 9),
    "range": _single("rng_vpos", "z_m", 1.0, 10),
    "heading": _single("heading", "heading_rad", 1.0, 4, 13, 22),
    "magnetometer": _flu("mag_field", "gauss", (5, 35)),
    "gravity": _flu("gravity", "mps2", (34,)),
    "flow": _flu("flow", "radps", (3,), "xy"),
    "drag": _flu("drag", "mps2", (), "xy"),
    "airspeed": _single("airspeed", "airspeed_mps", -1.0, 19),
    "sideslip": _single("beta", "sideslip_rad", -1.0, 15),
}
# The parameters of a sensor's noise and of its gate, in standard deviations: EKF2_*_NOISE, EKF2_*_GATE.
_PARAMETERS = {
    "gnss_velocity": ("GPS_V", "GPS_V"), "gnss_position": ("GPS_P", "GPS_P"),
    "vision_velocity": ("EVV", "EVV"), "vision_position": ("EVP", "EVP"), "barometer": ("BARO", "BARO"),
    "range": ("RNG", "RNG"), "heading": ("HEAD", "HDG"), "magnetometer": ("MAG", "MAG"),
    "gravity": ("GRAV", ""), "flow": ("OF_N_MIN", "OF"), "drag": ("DRAG", ""),
    "airspeed": ("EAS", "TAS"), "sideslip": ("BETA", "BETA"),
}  # fmt: skip
# Names in old firmware, which has innovations and variances in one topic: "0-2 vel, 3-5 pos"
# (estimator_interface.h). The height is that of the sensor in use.
_OLD = {
    "gps_hvel[0]": "vel_pos_innov{}[0]", "gps_hvel[1]": "vel_pos_innov{}[1]",
    "gps_vvel": "vel_pos_innov{}[2]", "gps_hpos[0]": "vel_pos_innov{}[3]",
    "gps_hpos[1]": "vel_pos_innov{}[4]",
    **dict.fromkeys(("gps_vpos", "baro_vpos"), "vel_pos_innov{}[5]"),
    "heading": "heading_innov{}", "airspeed": "airspeed_innov{}", "beta": "beta_innov{}",
    **{f"mag_field[{index}]": f"mag_innov{{}}[{index}]" for index in range(3)},
    **{f"flow[{index}]": f"flow_innov{{}}[{index}]" for index in range(2)},
}  # fmt: skip
_FIELDS = tuple(dict.fromkeys(name for sensor in _SENSORS.values() for name in sensor.fields))


class _Table(NamedTuple):
    """Rows (n,) of numbers (n, k), the keys (us) that join them with other topics, and their stamps."""

    key_us: NDArray[np.int64]
    time_us: NDArray[np.int64]
    logged_us: NDArray[np.int64]
    values: Floats

    def take(self, which: NDArray | slice) -> "_Table":
        return _Table._make(each[which] for each in self)

    def then(self, other: "_Table") -> "_Table":
        return _Table._make(map(np.concatenate, zip(self, other, strict=True)))


def label_of(instance: int) -> str:
    """Return the estimator name of an instance of the filter."""
    return f"ekf2_{instance}" if instance else "ekf2"


class Autopilot:
    """A maker of estimates and truth from the topics of EKF2 and of a simulator, block by block.

    `left_out` counts what is left out, by reason. The gates come from the autopilot's `parameters`.
    """

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self._gates = {
            sensor: parameters.get(f"EKF2_{gate}_GATE", np.inf)
            for sensor, (_, gate) in _PARAMETERS.items()
        }
        self.left_out: Counter[str] = Counter()
        self._waiting: dict[tuple[str, int], _Table] = {}
        self._last: dict[tuple[int, str], Floats] = {}
        self._status: dict[int, _Table] = {}

    def parts(self, rows: list[Rows]) -> Iterator[Part]:
        """Yield the parts of a block's rows; rows without their counterpart wait for the next block."""
        for each in rows:
            fields = Fields(each)
            if fields.has("control_mode_flags"):
                status = _table(fields, ["control_mode_flags"])
                known = self._status.get(each.instance, status.take(slice(0)))
                self._status[each.instance] = known.take(slice(-1, None)).then(status)
        for each in rows:
            fields = Fields(each)
            if each.topic in ("estimator_states", "estimator_status") and fields.has("states[9]"):
                yield _state(fields)
            elif each.topic == "ekf2_innovations":
                value, variance = (
                    _table(fields, [_OLD.get(name, "").format(of) for name in _FIELDS])
                    for of in ("", "_var")
                )
                yield from self._innovations(each.instance, value, variance, None)
            elif each.topic in _INNOVATIONS:
                self._add(each, _table(fields, _FIELDS))
            elif each.topic == _ATTITUDE:
                self._add(each, _table(fields, [f"q[{index}]" for index in range(4)]))
            elif each.topic == _LOCAL:
                self._add(each, _table(fields, ("x", "y", "z", "vx", "vy", "vz")))
        for instance in sorted({key[1] for key in self._waiting if key[0] in _INNOVATIONS}):
            yield from self._joined(instance)
        yield from self._truth()

    def _add(self, rows: Rows, table: _Table) -> None:
        key = rows.topic, rows.instance
        self._waiting[key] = self._waiting[key].then(table) if key in self._waiting else table

    def _joined(self, instance: int) -> Iterator[Part]:
        """Join innovations with their variances, as soon as both are known."""
        tables = [self._waiting.get((topic, instance)) for topic in _INNOVATIONS]
        innovations, variances, ratios = tables
        if innovations is None or variances is None:
            return
        common, first, second = np.intersect1d(innovations.key_us, variances.key_us, return_indices=True)
        if not len(common):
            return
        tested = None
        if ratios is not None:
            places = np.searchsorted(ratios.key_us, common)
            places = np.minimum(places, len(ratios.key_us) - 1)
            is_there = ratios.key_us[places] == common
            tested = np.where(is_there[:, None], ratios.values[places], np.nan)
        yield from self._innovations(instance, innovations.take(first), variances.take(second), tested)
        for topic in _INNOVATIONS:
            table = self._waiting.get((topic, instance))
            if table is not None:
                self._waiting[topic, instance] = table.take(table.key_us > common[-1])

    def _innovations(
        self, instance: int, innovations: _Table, variances: _Table, ratios: Floats | None
    ) -> Iterator[Part]:
        """Yield the new innovations of every sensor that was fused."""
        for name, sensor in _SENSORS.items():
            columns = [_FIELDS.index(each) for each in sensor.fields]
            value, variance = innovations.values[:, columns], variances.values[:, columns]
            before = self._last.get((instance, name), np.full((1, len(columns)), np.nan))
            self._last[instance, name] = value[-1:]
            is_new = (np.diff(value, axis=0, prepend=before) != 0.0).any(axis=1)
            is_there = np.isfinite(value) & np.isfinite(variance) & (variance > 0.0)
            is_fused = is_there & self._is_in_use(instance, sensor, innovations.time_us)
            is_new &= is_there.any(axis=1)
            unused = int((is_new & ~is_fused.any(axis=1)).sum())
            if unused:
                what = f"{label_of(instance)}: left out innovations of {name}, which was not in use"
                self.left_out[what] += unused
            which = np.flatnonzero(is_new & is_fused.any(axis=1))
            if not len(which):
                continue
            kept = np.where(is_fused, value, np.nan)[which] * sensor.signs
            spread = np.where(is_fused, variance, np.nan)[which]
            # As in setEstimatorAidStatusTestRatio; the logged ratios may belong to other samples.
            tested = kept**2 / spread / self._gates[name] ** 2
            if ratios is not None:
                stated = ratios[which][:, columns]
                tested = np.where(np.isfinite(stated), stated, tested)
            is_accepted = np.logical_not((tested > 1.0).any(axis=1))
            yield _innovation(
                f"/estimates/{label_of(instance)}{BODY}/{name}/innovation",
                sensor.components,
                innovations.take(which),
                (kept, spread, is_accepted),
            )

    def _is_in_use(
        self, instance: int, sensor: _Sensor, time_us: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Test from the filter's status whether it used the components (n, m) of a sensor."""
        is_used = np.ones((len(time_us), len(sensor.fields)), bool)
        status = self._status.get(instance)
        if status is None:
            return is_used
        rows = np.searchsorted(status.time_us, time_us, side="right") - 1
        flags = np.where(rows >= 0, status.values[np.maximum(rows, 0), 0], 0.0).astype(np.int64)
        for column, bits in enumerate(sensor.bits):
            if bits:
                is_used[:, column] = (flags & sum(1 << bit for bit in bits)) != 0
        return is_used

    def _truth(self) -> Iterator[Part]:
        """Yield the simulator's truth: positions and velocities at the stamps of its attitudes."""
        attitude, local = self._waiting.get((_ATTITUDE, 0)), self._waiting.get((_LOCAL, 0))
        if attitude is None or local is None or not len(local.time_us) or not len(attitude.time_us):
            return
        inside = (local.time_us[0] <= attitude.time_us) & (attitude.time_us <= local.time_us[-1])
        self._waiting[_ATTITUDE, 0] = attitude.take(attitude.time_us > local.time_us[-1])
        now = attitude.take(inside)
        if not len(now.time_us):
            return
        begin = local.time_us[0]
        moved = np.stack(
            [np.interp(now.time_us - begin, local.time_us - begin, each) for each in local.values.T],
            axis=1,
        )
        self._waiting[_LOCAL, 0] = local.take(slice(len(local.time_us) - 1, None))
        state = np.hstack([to_enu(moved[:, :3]), to_enu(moved[:, 3:]), orientations(_unit(now.values))])
        columns = {"state": state}
        yield Part(
            TRUTH, schemas.TRUTH_STATE, now.time_us, now.logged_us, columns, state_metadata(_POSE)
        )


def _table(fields: Fields, names: list[str] | tuple[str, ...]) -> _Table:
    """Read fields by name as numbers; NaN for missing fields."""
    values = fields.vector(*names)
    key = "timestamp_sample" if fields.has("timestamp_sample") else "timestamp"
    key_us = fields.rows.data[key].astype(np.int64)
    return _Table(key_us, fields.measured_us, fields.rows.time_us, values)


def _innovation(
    topic: str,
    components: tuple[str, ...],
    at: _Table,
    found: tuple[Floats, Floats, NDArray[np.bool_]],
) -> Part:
    """Make innovations (n, m) with their variances (n, m), and flags (n,) for the accepted ones."""
    innovation, variance, accepted = found
    size, width = innovation.shape
    is_known = np.isfinite(innovation)
    squared = np.where(is_known, innovation**2 / variance, 0.0)
    logs = np.where(is_known, np.log(2.0 * np.pi * variance), 0.0)
    covariance = np.zeros((size, width, width))
    covariance[:, range(width), range(width)] = variance
    covariance[~(is_known[:, :, None] & is_known[:, None, :])] = np.nan
    columns = {
        "target_id": np.zeros(size, np.uint32),
        "accepted": accepted.astype(np.uint32),
        "innovation": innovation,
        "covariance": covariance.reshape(size, width * width),
        "normalised_innovation_squared": squared.sum(axis=1),
        "log_likelihood": -0.5 * (squared + logs).sum(axis=1),
    }
    metadata = {**state_metadata(components), "truth": TRUTH}
    noise = _PARAMETERS[topic.split("/")[-2]][0]
    metadata["noise"] = f"EKF2_{noise}" if noise.startswith("OF_") else f"EKF2_{noise}_NOISE"
    return Part(topic, schemas.INNOVATION, at.time_us, at.logged_us, columns, metadata)


def _unit(quaternions: Floats) -> Floats:
    """Scale quaternions (n, 4) to unit length; NaN for those whose length is far from one."""
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.where(np.abs(length - 1.0) < _UNIT_TOLERANCE, quaternions, np.nan) / length


def _state(fields: Fields) -> Part:
    """Make the filter's position, velocity and orientation from its states and their variances.

    Biases are left out, because in old firmware they are increments over a step of the filter.
    """
    states = fields.vector("states", width=10)
    count = sum(name.startswith("covariances[") for name in fields.rows.data.dtype.names or ())
    # A quaternion's four variances, or with newer firmware those of a rotation about north, east, down.
    turns = 3 if count == _TANGENT_STATES else 4
    variances = fields.vector("covariances", width=turns + 6)
    quaternion = orientations(_unit(states[:, :4]))
    covariance = np.zeros((len(states), 9, 9))
    for row, variance in ((3, variances[:, turns : turns + 3]), (0, variances[:, turns + 3 :])):
        covariance[:, range(row, row + 3), range(row, row + 3)] = np.abs(to_enu(variance))
    covariance[:, 6:, 6:] = _tilts(quaternion, _unit(states[:, :4]), variances[:, :turns])
    is_old = np.isnan(quaternion).any(axis=1)
    mean = np.hstack([to_enu(states[:, 7:10]), to_enu(states[:, 4:7]), quaternion])
    part = Part(
        f"/estimates/{label_of(fields.rows.instance)}{BODY}/state",
        schemas.GAUSSIAN_ESTIMATE,
        fields.measured_us,
        fields.rows.time_us,
        {"mean": mean, "covariance": covariance.reshape(len(states), 81)},
        {**state_metadata(_POSE), "truth": TRUTH},
        {"left out states without a unit quaternion, as firmware of 2016 wrote them": int(is_old.sum())},
    )
    return part.take(np.flatnonzero(~is_old))


def _tilts(quaternion: Floats, logged: Floats, variances: Floats) -> Floats:
    """Compute the covariances (n, 3, 3) of rotations about the body's forward, left and up axes.

    Args:
        quaternion: (n, 4) from the body to east, north, up.
        logged: (n, 4) as logged, from forward, right, down to north, east, down.
        variances: (n, 4) of the logged quaternion, or (n, 3) of rotations about north, east, down.
    """
    if variances.shape[1] == 4:
        # A small rotation is twice the vector part of conj(q) dq, here about forward, right, down.
        by = 2.0 * left_matrix(conjugate(logged))[:, 1:] * np.array([1.0, -1.0, -1.0])[:, None]
    else:
        variances = np.abs(to_enu(variances))
        by = rotate(quaternion[:, None], np.eye(3))  # rows: the body's axes in the local tangent plane
    return np.einsum("nij,nj,nkj->nik", by, variances, by)
