"""Interacting multiple models against the reference sheets, single filters, and their own formulas."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import rotation_vector
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.model.model import Model, Motion, Sensor, Switching
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.modes.mixing import MixtureMemory, mixing, transition_matrix
from fuselog.replay.inference.run import filtering
from tests.replay.inference import attitude, vehicle_a, wheel
from tests.replay.inference.attitude import ATTITUDE
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.test_recursion import assert_equal, in_blocks
from tests.replay.inference.vehicle_a import VEHICLE_A
from tests.replay.inference.vehicle_a import move as move_vehicle
from tests.replay.inference.vehicle_a import noise as vehicle_noise

pytestmark = pytest.mark.paper

EXACT = 1e-9


# The sheet's problem: a vehicle whose turn rate is steady, or changes fast


class SwitchingParameters(vehicle_a.VehicleParameters):
    """How often the vehicle changes its mode, and how probable the first one is at the start."""

    hurries_per_s: float = 0.1
    calms_per_s: float = 0.5
    steady_at_start: float = 0.9


def steady_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    a, b, c, d, turn = vehicle_noise(state, duration_s, parameters)
    return a, b, c, d, 0.02 * turn


def agile_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    a, b, c, d, turn = vehicle_noise(state, duration_s, parameters)
    return a, b, c, d, 4.0 * turn


def rates(parameters: Any) -> Any:
    return parameters.hurries_per_s, parameters.calms_per_s


def initial(parameters: Any) -> Any:
    return parameters.steady_at_start, 1.0 - parameters.steady_at_start


MODES = {
    "steady": Motion(move_vehicle, steady_noise),
    "agile": Motion(move_vehicle, agile_noise),
}
SWITCHING_A = replace(
    VEHICLE_A, parameters=SwitchingParameters, modes=MODES, switching=Switching(rates, initial)
)


@cache
def of_sheet(name: str, kappa: float) -> Any:
    """With an estimate at t = 0, which a tick of every second gives."""
    source = vehicle_a.source(vehicle_a.simulate(7)[0])
    settings = {"filter": name, "kappa": kappa, "smoothed_modes": True, "every_s": 1.0}
    return outputs(SWITCHING_A, "imm", [source], **settings)


def modes_at(found: Any, topic: str, time_s: float) -> Any:
    stream = found[topic].stream
    [row] = np.flatnonzero(stream.publish_time_ns == vehicle_a.EPOCH_NS + round(time_s * 1e9))
    return stream["probability"][row]


TABLE = {
    ("ekf", 0.0): (
        133.681346342,
        [0.555678800628, 0.444321199372],
        [0.879782962175, 0.120217037825],
        0.042827208502,
    ),
    ("ukf", 0.5): (
        133.430968546,
        [0.555787639283, 0.444212360717],
        [0.880424768863, 0.119575231137],
        0.0428036135963,
    ),
}


@pytest.mark.parametrize(("name", "kappa"), TABLE)
def test_the_sheets_numbers(name: str, kappa: float, uncompiled: None) -> None:
    """Section 3. Sixty messages have the stamp of one before: mixing there would change them all."""
    likelihood, middle, end, trace = TABLE[name, kappa]
    found = of_sheet(name, kappa)
    assert_allclose(found["innovation"]["log_likelihood"].sum(), likelihood, rtol=EXACT)
    assert found["modes"].stream.components == ["steady", "agile"]
    assert_array_equal(found["modes"].stream.publish_time_ns, found["state"].stream.publish_time_ns)
    assert_allclose(modes_at(found, "modes", 10.0), middle, rtol=EXACT)
    assert_allclose(modes_at(found, "modes", 20.0), end, rtol=EXACT)
    assert_allclose(np.trace(found["state"]["covariance"][-1].reshape(5, 5)), trace, rtol=EXACT)


def test_the_sheets_states_and_smoothed_modes(uncompiled: None) -> None:
    found = of_sheet("ekf", 0.0)
    state = found["state"]["mean"][-1]
    wanted = [1.62135210247, -1.94928495801, -11.6051291115, 0.897469398453, -0.795022115887]
    state[2] += 2 * np.pi * np.round((wanted[2] - state[2]) / (2 * np.pi))
    assert_allclose(state, wanted, rtol=EXACT)
    modes = found["modes"]["probability"]
    assert len(modes) == 161
    assert_allclose(modes[:, 1].sum(), 34.0535796162, rtol=EXACT)
    assert_allclose(modes_at(found, "smoothed_modes", 0.0), [0.908836644473, 0.091163355527], rtol=EXACT)
    assert_allclose(
        modes_at(found, "smoothed_modes", 10.0), [0.645676900245, 0.354323099755], rtol=EXACT
    )
    assert_array_equal(modes_at(found, "smoothed_modes", 20.0), modes[-1])


@pytest.mark.paper
@pytest.mark.parametrize("name", ["ekf", "ukf", "lrkf:s2kf-50"])
def test_compiled_loops_do_the_same(name: str, request: pytest.FixtureRequest) -> None:
    """Of filters that linearise, and that take samples."""
    source = vehicle_a.source(vehicle_a.simulate(8)[0][:60])
    settings = {"filter": name, "smoothed_modes": True, "gate_probability": 0.99}
    compiled = outputs(SWITCHING_A, "imm", [source], **settings)
    request.getfixturevalue("uncompiled")
    plain = outputs(SWITCHING_A, "imm", [source], **settings)
    for topic, field in (("state", "mean"), ("innovation", "covariance"), ("modes", "probability")):
        assert_allclose(compiled[topic][field], plain[topic][field], rtol=1e-7, atol=1e-10)
    smoothed = (each["smoothed_modes"]["probability"] for each in (compiled, plain))
    assert_allclose(*smoothed, atol=1e-10)


# The other sheet's: a target on a line, one of two accelerations


class LineParameters(ModelParameters):
    """Rates whose Pi over a second is [.95 .05; .10 .90]."""

    up_per_s: float = float(-np.log(0.85) / 3)
    down_per_s: float = float(-np.log(0.85) * 2 / 3)


def move_along(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return state[0] + duration_s * state[1], state[1]


def calm(state: Any, duration_s: Any, parameters: Any) -> Any:
    return 0.01 * duration_s**3 / 3.0, 0.01 * duration_s**2 / 2.0, 0.01 * duration_s


def wild(state: Any, duration_s: Any, parameters: Any) -> Any:
    return duration_s**3 / 3.0, duration_s**2 / 2.0, duration_s


def line_rates(parameters: Any) -> Any:
    return parameters.up_per_s, parameters.down_per_s


def read_place(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[0],)


def unit_noise(parameters: Any) -> Any:
    return (1.0,)


CALM = Motion(move_along, calm, linear=True)
LINE = Model(
    "a target on a line",
    {"x_m": "linear", "v_mps": "linear"},
    LineParameters,
    (
        Sensor(
            "place",
            schemas.VECTOR_MEASUREMENT,
            {"x_m": "linear"},
            read_place,
            unit_noise,
            read=lambda stream: stream["value"],
            linear=True,
        ),
    ),
    CALM,
    {"calm": CALM, "wild": Motion(move_along, wild, linear=True)},
    Switching(line_rates),
)
PLACES = (
    """1.2 1.9 3.4 3.8 5.3 6.1 6.6 8.2 10.9 14.5 19.1 24.2 30.6 36.1 40.9 44.0 46.3 48.1 49.6 51.2"""
)


def places(values: Any) -> MemorySource:
    metadata = {"components": "x_m,v_mps", "kinds": "linear,linear"}
    prior = {"mean": [[0.0, 1.0]], "covariance": [[4.0, 0.0, 0.0, 1.0]]}
    stamps = 10**9 * (1 + np.arange(1, len(values) + 1))
    streams = [
        make_stream("/prior", schemas.GAUSSIAN_ESTIMATE, [10**9], metadata=metadata, **prior),
        make_stream("/place", schemas.VECTOR_MEASUREMENT, stamps, value=np.reshape(values, (-1, 1))),
    ]
    run = RunMetadata(scenario="line", parameters={}, seed=0, run=0, epoch_ns=10**9)
    return memory_source(Recording(streams), run)


LINE_TABLE = {
    1: (0.5316241743944, [1.1674982180672, 1.0399857445375], [0.8374918406403, 0.1999347251220]),
    8: (0.8392154141053, [7.9933335648953, 0.9982731196261], [0.5282884013082, 0.1973117015792]),
    10: (0.3422303354676, [13.5011125459363, 2.5403896773598], [0.9400154504273, 0.6750001160513]),
    12: (0.1164581300248, [23.7863598191561, 4.8133806685022], [0.7593332480679, 0.4835469465026]),
    20: (0.2927017817657, [51.2994217419289, 1.5118805107072], [0.7349212996415, 0.4408051226284]),
}


@pytest.mark.parametrize("name", ["ekf", "analytic", "lrkf:s2kf-6"])
def test_the_line_of_the_tracking_sheet(name: str, uncompiled: None) -> None:
    found = outputs(LINE, "imm", [places([float(each) for each in PLACES.split()])], filter=name)
    assert_allclose(found["innovation"]["log_likelihood"].sum(), -38.45058171403506, rtol=1e-12)
    for step, (probability, mean, covariance) in LINE_TABLE.items():
        assert_allclose(found["modes"]["probability"][step - 1, 0], probability, rtol=1e-10)
        assert_allclose(found["state"]["mean"][step - 1], mean, rtol=1e-10)
        assert_allclose(found["state"]["covariance"][step - 1, :2], covariance, rtol=1e-10)


def test_the_told_innovation_is_that_of_the_mixture(uncompiled: None) -> None:
    """At step 10 the prediction is weighted by c: 11.388..., not by the old probabilities."""
    values = [float(each) for each in PLACES.split()]
    found = outputs(LINE, "imm", [places(values)])["innovation"]
    assert_allclose(values[9] - found["innovation"][9, 0], 11.3882603648781, rtol=1e-12)
    squares = found["innovation"][:, 0] ** 2 / found["covariance"][:, 0]
    assert_allclose(found["normalised_innovation_squared"], squares, rtol=1e-12)


def test_likelihoods_that_are_no_numbers(uncompiled: None) -> None:
    """Both lie below the smallest number, one of them far below the other."""
    found = outputs(LINE, "imm", [places([100.0])])
    assert_allclose(found["modes"]["probability"], [[3.82903e-19, 1.0]], rtol=1e-5)
    assert_allclose(
        found["innovation"]["log_likelihood"], -775.6050097731908 + np.log(0.475), rtol=1e-12
    )


def test_a_mode_that_nothing_leads_to_comes_back(uncompiled: None) -> None:
    """Without changes the modes are two hypotheses, and no number of nats is the end of one of them."""
    still = {"up_per_s": 0.0, "down_per_s": 0.0}
    source = places(np.append(np.arange(10.0), np.full(600, 60.0)))
    found = outputs(LINE, "imm", [source], **still)["modes"]["probability"][:, 0]
    calm, wild = (
        outputs(LINE, "ekf", [source], mode=mode)["innovation"]["log_likelihood"].cumsum()
        for mode in ("calm", "wild")
    )
    assert np.exp((calm - wild).min()) == found.min() == 0.0
    assert_allclose(np.log(found[-1]), (calm - wild)[-1], rtol=1e-9)


# Modes


@pytest.mark.parametrize("duration_s", [0.0, 1e-9, 0.05, 3.0, 1e4])
def test_the_chain_is_the_matrix_exponential(duration_s: float) -> None:
    found, wanted = np.empty((3, 3)), np.array([[-0.4, 0.3, 0.1], [0.0, -2.0, 2.0], [1.5, 0.5, -2.0]])
    transition_matrix(3)(wanted[~np.eye(3, dtype=bool)], duration_s, found)
    assert_allclose(found, expm(wanted * duration_s), rtol=1e-11, atol=1e-300)
    assert_allclose(found.sum(axis=1), 1.0, rtol=1e-14)
    if duration_s == 0.0:
        assert_array_equal(found, np.eye(3))


def test_the_chain_of_the_sheet() -> None:
    """Section 3: the probabilities after .05 s."""
    found = np.empty((2, 2))
    transition_matrix(2)(np.array([0.1, 0.5]), 0.05, found)
    wanted = [[0.995074255591, 0.00492574440858], [0.0246287220429, 0.975371277957]]
    assert_allclose(found, wanted, rtol=1e-11)


def test_smoothed_modes_by_their_formula(uncompiled: None) -> None:
    """Over uneven steps, from the filter's own probabilities; and a block at a time."""
    found = of_sheet("ekf", 0.0)
    chain = np.array([[-0.1, 0.1], [0.5, -0.5]])
    smoothed = found["modes"]["probability"].copy()
    times_s = found["modes"].stream.publish_time_ns * 1e-9
    for k in range(len(smoothed) - 2, -1, -1):
        change = expm(chain * (times_s[k + 1] - times_s[k]))
        smoothed[k] *= change @ (smoothed[k + 1] / (smoothed[k] @ change))
    assert_allclose(found["smoothed_modes"]["probability"], smoothed, rtol=1e-9)


# Equal modes, whatever the space


def twins(model: Model) -> Model:
    """The model with three modes that are all its motion."""
    modes = dict.fromkeys(("first", "second", "third"), model.motion)
    return replace(model, modes=modes, switching=Switching(twin_rates, twin_initial))


def twin_rates(parameters: Any) -> Any:
    return 0.3, 0.1, 0.2, 0.7, 0.5, 0.6


def twin_initial(parameters: Any) -> Any:
    return 0.5, 0.2, 0.3


def problem(name: str) -> tuple[Model, MemorySource]:
    if name == "vehicle":
        return VEHICLE_A, vehicle_a.source(vehicle_a.simulate(9, outlier=True)[0][:80])
    if name == "wheel":
        return wheel.make_wheel(), wheel.source(wheel.simulate(3, np.arange(0, 14) * 0.1))
    source, *_ = attitude.simulate(21)
    streams = [
        each.take(slice(0, np.searchsorted(each.publish_time_ns, attitude.EPOCH_NS + 10**9 // 2)))
        for each in source.streams.values()
    ]
    return ATTITUDE, memory_source(Recording(streams), source.run)


@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf"])
@pytest.mark.parametrize("what", ["vehicle", "wheel", "attitude"])
def test_equal_modes_are_one_filter(what: str, name: str, uncompiled: None) -> None:
    """Innovations, log-likelihoods and what the gate keeps out too; angles, axes and rotations."""
    model, source = problem(what)
    settings: dict[str, Any] = {"gate_probability": 0.999, "kappa": 0.5} if name == "ukf" else {}
    alone = outputs(model, name, [source], **settings)
    together = outputs(twins(model), "imm", [source], filter=name, **settings)
    for topic in ("state", "innovation"):
        for field, column in alone[topic].stream.columns.items():
            assert_allclose(together[topic][field], column, rtol=1e-12, atol=1e-12, err_msg=field)


# Mixtures on manifolds


def test_a_mixture_of_rotations_has_the_moments_of_its_samples() -> None:
    """Of two orientations half a radian apart with a bias, each with a covariance in its own tangent."""
    rng = np.random.default_rng(4)
    kinds = (*("quaternion",) * 4, "linear")
    weights, turn = np.array([0.65, 0.35]), np.array([0.3, -0.35, 0.2])
    mean = np.array([[0.8, 0.4, -0.4, 0.2, 1.0], [*[0.0] * 4, 1.3]])
    mean[1, :4] = compose(mean[0, :4], quaternion(turn[None])[0])
    roots = np.array([np.diag([0.25, 0.02, 0.02, 0.1]), np.diag([0.02, 0.25, 0.1, 0.1])])
    roots[:, 3, 0] = 0.05
    covariance = roots @ roots.swapaxes(1, 2)
    to_common_tangent, mix = mixing(kinds)
    memory = memory_of(5, 4, 2)
    found, spread = np.empty(5), np.empty((4, 4))
    to_common_tangent(mean, covariance, weights, memory)
    mix(weights, memory, found, spread)
    assert_allclose(spread, spread.T, rtol=1e-14)

    mode = (rng.uniform(size=400_000) > weights[0]).astype(int)
    drawn = np.einsum("kij,kj->ki", roots[mode], rng.standard_normal((len(mode), 4)))
    turned = compose(mean[mode, :4], quaternion(drawn[:, :3]))
    e = np.column_stack(
        [
            rotation_vector(compose(conjugate(found[None, :4]), turned)),
            mean[mode, 4] + drawn[:, 3] - found[4],
        ]
    )
    assert_allclose(e.mean(axis=0), 0.0, atol=0.01)
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    assert_allclose(np.cov(e.T) / scale, spread / scale, atol=0.02)


def quaternion(turns: Any) -> Any:
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / 2 / np.pi) * turns], axis=1)


def memory_of(n: int, t: int, modes: int) -> Any:
    """As much of a mixture's memory as mixing needs."""
    rest: dict[str, Any] = dict.fromkeys(MixtureMemory._fields)
    shapes = {"centre": (n,), "away": (modes, t), "carried": (modes, t, t), "shift": (t,)}
    return MixtureMemory(**rest | {name: np.empty(shape) for name, shape in shapes.items()})


# The gate


def test_what_no_mode_lets_in_changes_nothing(uncompiled: None) -> None:
    """The outlier is as a message that measured nothing."""
    told = vehicle_a.simulate(7, outlier=True)[0][:85]
    kept = outputs(SWITCHING_A, "imm", [vehicle_a.source(told)], gate_probability=0.999)
    shut = np.flatnonzero(kept["innovation"]["accepted"] == 0)
    assert len(shut) == 1
    assert kept["innovation"]["log_likelihood"][shut] == 0.0
    assert kept["innovation"]["normalised_innovation_squared"][shut] > 13.8
    sights = [index for index, each in enumerate(told) if each[1] == "rb"]
    told[sights[40]] = (*told[sights[40]][:3], np.full(2, np.nan))
    missing = outputs(SWITCHING_A, "imm", [vehicle_a.source(told)], gate_probability=0.999)
    for topic in ("state", "modes"):
        assert_equal(kept[topic].of_run(0), missing[topic].of_run(0))


def test_what_one_mode_lets_in_all_take(uncompiled: None) -> None:
    """A measurement that one mode left out would make the other less probable for explaining it."""
    values = [1.0, 2.0, 3.0, 9.0]
    gated = outputs(LINE, "imm", [places(values)], gate_probability=0.998)
    free = outputs(LINE, "imm", [places(values)])
    alone = outputs(LINE, "ekf", [places(values)], mode="calm", gate_probability=0.998)
    assert alone["innovation"]["accepted"].tolist() == [1, 1, 1, 0]
    assert gated["innovation"]["accepted"].tolist() == [1, 1, 1, 1]
    for topic in ("state", "modes", "innovation"):
        assert_equal(gated[topic].of_run(0), free[topic].of_run(0))


# As an estimator


def test_small_blocks_are_the_whole_log(tmp_path: Path, uncompiled: None) -> None:
    source = vehicle_a.source(vehicle_a.simulate(8)[0][:60])

    def replayed(each: Any, block_messages: int) -> Any:
        return outputs(SWITCHING_A, "imm", [each], block_messages, smoothed_modes=True)

    whole = replayed(source, 1 << 18)
    for found in in_blocks(source, tmp_path, replayed):
        for topic in ("state", "innovation", "modes", "smoothed_modes"):
            assert_equal(found[topic].of_run(0), whole[topic].of_run(0))


def test_rates_are_numbers_of_the_run_and_compile_nothing(uncompiled: None) -> None:
    source = vehicle_a.source(vehicle_a.simulate(8)[0][:60])
    ends, made = [], []
    for hurries_per_s in (0.1, 2.0):
        found = outputs(SWITCHING_A, "imm", [source], hurries_per_s=hurries_per_s)
        ends.append(found["modes"]["probability"][-1, 1])
        made.append(filtering._compiled.cache_info().misses)
    assert made[0] == made[1]
    assert ends[1] > 2 * ends[0]


BAD: dict[str, tuple[Mapping[str, Any], str]] = {
    "unknown filter": (
        {"filter": "ekff"},
        "'ekff' is not a filter for the modes of an imm; did you mean",
    ),
    "smoother": ({"filter": "smoother"}, "'smoother' is not a filter for the modes of an imm"),
    "variant": ({"filter": "ekf:9"}, "filter ekf has no variants; give 'imm:ekf' without ':9'"),
    "mode": ({"mode": "steady"}, "parameter 'mode' is 'steady'; imm uses all modes of a model"),
    "modes": ({"mode": ["steady", "agile"]}, "imm uses all modes of a model; leave out `mode`"),
    "rate": (
        {"calms_per_s": -0.5},
        "the rate from mode agile to steady is -0.5 per second; give zero or more",
    ),
    "initial": (
        {"steady_at_start": 1.5},
        "initial probabilities of the modes are steady 1.5, agile -0.5; give numbers of zero or more "
        "with sum one",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_imm_is_one_sentence(name: str) -> None:
    settings, sentence = BAD[name]
    with pytest.raises(BadInput) as error:
        bound(SWITCHING_A, "imm", [vehicle_a.source([])], **settings)
    assert sentence in str(error.value)
    assert str(error.value).startswith("test: " if "mode" in settings else "estimator test: ")
    assert "\n" not in str(error.value)


def test_a_model_says_what_it_lacks_for_it() -> None:
    lacks = METHODS["imm"].lacks
    assert lacks(SWITCHING_A) == ""
    assert lacks(VEHICLE_A) == "several modes"
    assert lacks(replace(SWITCHING_A, switching=None)).startswith("the rates")
