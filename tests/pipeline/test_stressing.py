"""Stress: the sheet's linear example and unobservable heading, a theorem, withheld verdicts."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from pipeline.stressing.partings import Parting, partings, undetermined
from pipeline.stressing.verdicts import NOT_TESTED
from recorders.log import Stream

VECTOR = fl.schemas.VECTOR_MEASUREMENT
LINEAR = {"p_m": "linear", "v_mps": "linear"}
EPOCH_NS = 10**18


class LinearParameters(fl.ModelParameters):
    """What the line's noise is.

    Attributes:
        process: factor of the process noise.
        variance: of a measurement.
    """

    process: float = 1.0
    variance: float = 1.0


LINE = fl.Model(
    "a point on a line",
    LINEAR,
    LinearParameters,
    (
        fl.Sensor(
            "seen",
            VECTOR,
            {"p": "linear"},
            lambda state, _reference, _parameters: (state[0],),
            lambda parameters: (parameters.variance,),
            vector="value",
        ),
    ),
    fl.Motion(
        lambda state, _control, duration_s, _parameters: (state[0] + duration_s * state[1], state[1]),
        lambda _state, _duration_s, parameters: (
            0.01 * parameters.process / 3.0,
            0.01 * parameters.process / 2.0,
            0.01 * parameters.process,
        ),
    ),
)


def line(y: Sequence[float], start: tuple[float, float] = (0.0, 0.0), lost: int = 0) -> fl.Recording:
    """The sheet's linear example: a measurement a second, one of them lost perhaps."""
    stated = {"components": ",".join(LINEAR), "kinds": ",".join(LINEAR.values())}
    at = np.array([each for each in range(1, len(y) + 1) if each != lost])
    stamps_ns = EPOCH_NS + at * 10**9
    covariance = [np.eye(2).ravel()]
    prior = fl.schemas.GAUSSIAN_ESTIMATE
    streams = [
        fl.make_stream(
            "/car/prior", prior, [EPOCH_NS], metadata=stated, mean=[start], covariance=covariance
        ),
        fl.make_stream(
            "/car/seen", VECTOR, stamps_ns, metadata={"components": "p"}, value=np.array(y)[at - 1, None]
        ),
    ]
    return fl.Recording(streams, epoch_ns=EPOCH_NS)


def states(done: fl.Replay, run: int = 0) -> dict[str, Stream]:
    """The Gaussian estimates of a run."""
    log = done.estimates[run]
    return {topic: log[topic] for topic in log if topic.endswith("/state")}


def sheet_line() -> list[float]:
    """What the sheet measures of its line."""
    rng = np.random.Generator(np.random.Philox(key=41))
    factor = np.linalg.cholesky(0.01 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))
    state, y = np.zeros(2), []
    for _ in range(100):
        state = np.array([[1.0, 1.0], [0.0, 1.0]]) @ state + factor @ rng.standard_normal(2)
        y.append(float(state[0] + rng.standard_normal()))
    return y


def parted(sources: Sequence[fl.Recording], **settings: float) -> Parting:
    """The second run against the first; or the first with other settings."""
    ekf = fl.modelled(LINE, "ekf")
    done = fl.replay(list(sources), {"ekf": ekf})
    other = states(done, 1)
    if settings:
        other = states(fl.replay(sources[0], {"ekf": {"kind": ekf, **settings}}))
    [found] = partings(states(done), other, 0)
    return found


def test_linear_example() -> None:
    y = sheet_line()
    assert sum(y) == pytest.approx(-817.558860458, abs=1e-8)
    [last] = states(fl.replay(line(y), {"ekf": fl.modelled(LINE, "ekf")})).values()
    assert last["mean"][-1] == pytest.approx([-18.31244731603, -0.01280709640312], rel=1e-9)
    assert last["covariance"][-1][[0, 1, 3]] == pytest.approx(
        [0.360591664527, 0.079963012417, 0.040094807415], rel=1e-9
    )
    both = parted([line(y), line(y, (0.1, 0.1))]).amplification
    expected = [0.05765590213, 0.04073578301, 0.02906865332, 0.008797830662, 0.001010924702]
    assert both[[0, 1, 4, 9, 19]] == pytest.approx(expected, rel=1e-9)
    assert both[49] == pytest.approx(1.19603e-6, rel=1e-5)
    first = parted([line(y), line(y, (0.1, 0.0))]).amplification
    assert first[[0, 1, 4, 9]] == pytest.approx(
        [0.05760811383, 0.05663470914, 0.0368578249, 0.01026367805], rel=1e-9
    )


@pytest.mark.parametrize(
    ("settings", "largest"), [({"variance": 1.01}, 0.005153006), ({"process": 1.01}, 0.0051814767)]
)
def test_linear_parameters(settings: dict[str, float], largest: float) -> None:
    y = sheet_line()
    found = parted([line(y), line(y)], **settings)
    assert found.amplification.max() == pytest.approx(largest, rel=1e-6)


def test_a_moved_start_never_grows_in_a_linear_filter() -> None:
    """Deyst and Price: whatever is measured, however the start is moved."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        y = rng.normal(0.0, 10.0, 30).tolist()
        found = parted([line(y), line(y, tuple(rng.normal(size=2)))]).amplification
        assert np.all(np.diff(found) <= 1e-9 * found[:-1])


HEADING = dict.fromkeys(
    ("x_m", "y_m", "yaw_rad", "v_mps", "rate_radps", "gyro_radps", "wheels_radps"), "linear"
)
NOISE = (0.01, 0.01, 1e-9, 0.1, 0.1, 1e-5, 1e-7)


def drive(state: Any, _control: Any, duration_s: float, _parameters: Any) -> Any:
    """How the sheet's robot moves."""
    x, y, yaw, v, rate, gyro, wheels = state
    way = v * duration_s
    return x + way * np.cos(yaw), y + way * np.sin(yaw), yaw + rate * duration_s, v, rate, gyro, wheels


def sensor(name: str, variances: tuple[float, ...], measure: Callable[[Any], Any]) -> fl.Sensor:
    """A sensor of a vector whose noise is known."""
    kinds = {f"c{place}": "linear" for place in range(len(variances))}
    return fl.Sensor(
        name, VECTOR, kinds, lambda s, _r, _p: measure(s), lambda _: variances, vector="value"
    )


def robot(noise: Callable[[Any, float, Any], Any]) -> fl.Model:
    """The sheet's robot: two biases, so that its turn rate is not determined."""
    sensors = (
        sensor("gyro", (0.005**2,), lambda s: (s[4] + s[5],)),
        sensor("wheels", (0.05**2, 0.02**2), lambda s: (s[3], s[4] + s[6])),
        sensor("gps", (1.0, 1.0), lambda s: (s[0], s[1])),
    )
    return fl.Model("a robot", HEADING, fl.ModelParameters, sensors, fl.Motion(drive, noise))


PER_PREDICTION = robot(lambda _state, _duration_s, _parameters: NOISE)
PER_SECOND = robot(lambda _state, duration_s, _parameters: tuple(100.0 * duration_s * q for q in NOISE))


def drive_of(fixes: int, end_s: int, seed: int | None = None) -> fl.Recording:
    """A straight drive at 1 m/s, with fixes for so long; noise where there is a seed."""
    at = {"gyro": np.arange(1, 100 * end_s + 1) * 10**7}
    at["wheels"], at["gps"] = at["gyro"][1::2], np.arange(1, fixes + 1) * 10**9
    values = {name: np.zeros((len(stamps), 1 if name == "gyro" else 2)) for name, stamps in at.items()}
    values["wheels"][:, 0], values["gps"][:, 0] = 1.0, np.arange(1, fixes + 1)
    if seed is not None:
        rng = np.random.Generator(np.random.Philox(key=seed))
        for name, sigmas in {"gyro": [0.005], "wheels": [0.05, 0.02], "gps": [1.0, 1.0]}.items():
            values[name] = values[name] + sigmas * rng.standard_normal(values[name].shape)
    stated = {"components": ",".join(HEADING), "kinds": ",".join(HEADING.values())}
    prior = fl.make_stream(
        "/car/prior",
        fl.schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata=stated,
        mean=[np.zeros(7)],
        covariance=[0.01 * np.eye(7).ravel()],
    )
    names = {
        name: ",".join(f"c{place}" for place in range(each.shape[1])) for name, each in values.items()
    }
    streams = [
        fl.make_stream(
            f"/car/{name}",
            VECTOR,
            EPOCH_NS + at[name],
            metadata={"components": names[name]},
            value=values[name],
        )
        for name in at
        if len(at[name])
    ]
    return fl.Recording([prior, *streams], epoch_ns=EPOCH_NS)


def rows_at(stream: Stream, seconds: Sequence[int]) -> Any:
    """The rows of whole seconds."""
    stamps_ns = EPOCH_NS + np.array(seconds) * 10**9
    return np.searchsorted(stream.publish_time_ns, stamps_ns, side="right") - 1


def test_heading_without_fixes() -> None:
    methods = {name: fl.modelled(PER_PREDICTION, name) for name in ("ekf", "ukf")}
    found = states(fl.replay(drive_of(0, 60), methods))
    ekf, ukf = (next(s for t, s in found.items() if f"/{name}/" in t) for name in methods)
    rows = rows_at(ukf, [5, 10, 20, 30, 60])
    expected = [4.8655, 9.2117, 15.6330, 22.6400]
    assert ukf["mean"][rows[:4], 0] == pytest.approx(expected, abs=1e-4)
    assert [each["mean"][rows[4], 0] for each in (ukf, ekf)] == pytest.approx(
        [43.920, 59.9855], rel=1e-2
    )
    for each in (ukf, ekf):
        yaw = np.degrees(np.sqrt(each["covariance"][rows, 2 * 7 + 2]))
        assert yaw == pytest.approx([20.67, 40.24, 80.18, 120.52, 243.29], abs=0.01)
    worst = undetermined(ekf)
    assert worst is not None
    assert worst.direction == pytest.approx([0.5796, -0.5791, -0.5734], abs=1e-4)
    assert worst.sigma == pytest.approx(0.1277, abs=1e-4)


def test_noise_per_prediction_is_a_discontinuity() -> None:
    stressed = fl.stress(drive_of(20, 80), {"ukf": fl.modelled(PER_PREDICTION, "ukf")}).stressed[0]
    stamps = stressed.tried["stamps"].parting
    assert stamps is not None
    assert stressed.worst == stressed.verdict("stamps") == "discontinuous or chaotic"
    assert stressed.ratio("stamps") == pytest.approx(1.0, abs=0.01)
    assert stamps.metres[-1] == pytest.approx(4.07, rel=0.05)  # the sheet moves the gyro alone
    said = " ".join(stressed.sentences)
    assert "noise per prediction, not per second" in said
    assert (
        "from 20.0 s on 0.59 rate_radps - 0.58 gyro_radps - 0.56 wheels_radps is not determined" in said
    )
    mended = fl.stress(drive_of(20, 80), {"ukf": fl.modelled(PER_SECOND, "ukf")}).stressed[0]
    assert mended.verdict("stamps") == "harmless"
    assert not mended.is_per_prediction


def test_planted_direction_and_onset() -> None:
    sources = [drive_of(20, 60, seed) for seed in range(5000, 5020)]
    done = fl.replay(sources, {"ekf": fl.modelled(PER_PREDICTION, "ekf")})
    for run in range(len(sources)):
        [stream] = states(done, run).values()
        found = undetermined(stream)
        assert found is not None
        cosine = abs(found.direction @ [0.5796, -0.5791, -0.5734])
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 5.0
        assert abs((found.since_ns - EPOCH_NS) * 1e-9 - 20.0) <= 2.0


def test_verdicts_are_withheld(fuselog: Callable[..., Any], tmp_path: Any) -> None:
    logs = []
    for seed in range(5):
        logs.append(str(tmp_path / f"{seed}.mcap"))
        fl.write(logs[-1], fl.record("landmarks", seed=seed, duration_s=3.0))
    near = [{"one": {"kind": "ekf"}, "other": {"kind": "ekf", "sigma_range_m": 0.1005}}]
    plain, tested = (fl.compare(*logs, estimators=near, margin=0.0, stress=on) for on in (False, True))
    verdicts = [each.table.set_index("quantity")["verdict"] for each in (plain, tested)]
    assert verdicts[0]["position_rmse_m"] in ("better", "worse")
    assert verdicts[1]["position_rmse_m"] == "withheld"
    assert not any("is better" in each for each in tested.sentences)
    assert NOT_TESTED in fuselog("compare", logs[0], "-e", "ekf", "-e", "ukf").out
