"""Late messages: dropped, waited for, gone back for; the sheet's section 8 to its digits."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.replay.engine.replaying.estimator import Batch, Recursive
from fuselog.replay.engine.replaying.late import parse_late, taking_late
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.replay.inference import vehicle_a, wheel
from tests.replay.inference.replays import bound
from tests.replay.inference.test_imm import SWITCHING_A
from tests.replay.inference.vehicle_a import VEHICLE_A
from tests.replay.inference.wheel import make_wheel

Floats = Any
EPOCH_NS = 10**9
STATE = {"x_m": "linear", "y_m": "linear", "vx_mps": "linear", "vy_mps": "linear"}
SIGMAS = {"a": 0.5, "b": 0.2}
Q = 0.1
MEAN, VARIANCES = np.array([0.0, 0.0, 1.0, 0.0]), np.array([1.0, 1.0, 0.25, 0.25])


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return state[0] + duration_s * state[2], state[1] + duration_s * state[3], state[2], state[3]


def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    """The lower triangle, row by row."""
    near, mixed, fast = duration_s**3 / 3, duration_s**2 / 2, duration_s
    near, mixed, fast = 0.1 * near, 0.1 * mixed, 0.1 * fast
    return near, 0.0, near, mixed, 0.0, fast, 0.0, mixed, 0.0, fast


def place(state: Any, reference: Any, parameters: Any) -> Any:
    return state[0], state[1]


def noise_a(parameters: Any) -> Any:
    return 0.25, 0.25


def noise_b(parameters: Any) -> Any:
    return 0.04, 0.04


PLACE = {"x_m": "linear", "y_m": "linear"}
MODEL = Model(
    "a point that moves",
    STATE,
    ModelParameters,
    tuple(
        Sensor(
            name,
            schemas.VECTOR_MEASUREMENT,
            PLACE,
            place,
            of,
            read=lambda stream: stream["value"],
            linear=True,
        )
        for name, of in (("a", noise_a), ("b", noise_b))
    ),
    Motion(move, noise, linear=True),
)


@cache
def messages(seed: int = 41) -> tuple[Floats, Floats, Floats, dict[int, Floats], Floats]:
    """Stamps in ns, sensors (0 is a), values, truth by stamp, and delays in ns, in the file's order."""
    stamps = [(100_000_000 * k, 0) for k in range(1, 601)] + [
        (250_000_000 * k, 1) for k in range(1, 241)
    ]
    stamps.sort()
    rng = np.random.default_rng(seed)
    x, now, truth, values = MEAN + np.sqrt(VARIANCES) * rng.standard_normal(4), 0, {}, []
    for stamp, sensor in stamps:
        if stamp > now:
            dt = (stamp - now) * 1e-9
            lower = np.zeros((4, 4))
            lower[np.tril_indices(4)] = noise(None, dt, None)
            full = lower + np.tril(lower, -1).T
            x = np.array(move(x, (), dt, None)) + np.linalg.cholesky(full) @ rng.standard_normal(4)
            now = stamp
            truth[stamp] = x
        values.append(x[:2] + (0.5, 0.2)[sensor] * rng.standard_normal(2))
    u, d = rng.random(840), rng.random(840)
    delay = np.where(u < 0.1, np.floor(5e8 * d), 0).astype(np.int64)
    stamp, sensor = np.array(stamps).T
    return stamp, sensor, np.array(values), truth, delay


def source_of(seed: int = 41, *, order: str = "measured", apart_ns: int = 0) -> MemorySource:
    """The log; its messages stand in it as they were `measured`, or as they `arrived`.

    Those of b arrive so much later than the sheet says, which tells messages of one moment apart.
    """
    stamp, sensor, values, _, delay = messages(seed)
    arrival = stamp + delay + apart_ns * sensor
    position = np.arange(len(stamp))
    if order == "arrived":
        position[np.argsort(arrival, kind="stable")] = np.arange(len(stamp))
    streams = {}
    for number, name in enumerate("ab"):
        own = sensor == number
        made = make_stream(
            f"/{name}",
            schemas.VECTOR_MEASUREMENT,
            EPOCH_NS + stamp[own],
            log_time_ns=EPOCH_NS + arrival[own],
            value=values[own],
        )
        made.position[:] = position[own]
        streams[made.topic] = made
    metadata = {"components": ",".join(STATE), "kinds": ",".join(STATE.values())}
    streams["/prior"] = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata=metadata,
        mean=MEAN[None],
        covariance=np.diag(VARIANCES).reshape(1, 16),
    )
    return MemorySource(streams, RunMetadata("point", epoch_ns=EPOCH_NS), "point")


class Cut(MemorySource):
    """A recording that comes in blocks of so many messages, no stamp split between them."""

    messages = 50

    def blocks(self, topics: Sequence[str], order: Any, block_messages: int) -> Any:
        """Blocks by either clock."""
        del block_messages
        (whole,) = super().blocks(topics, order, 0)
        stamps = np.unique(np.concatenate([each.times(order) for each in whole.values()]))
        for first in range(0, len(stamps), self.messages):
            until = stamps[first : first + self.messages]
            yield {
                topic: stream.take(np.isin(stream.times(order), until))
                for topic, stream in whole.items()
            }

    @property
    def is_whole(self) -> bool:
        """Else an ensemble would take it in one block."""
        return False


def cut(source: MemorySource) -> Cut:
    return Cut(source.streams, source.run, source.name)


def replayed(
    late: str | None,
    sources: Sequence[MemorySource],
    model: Model = MODEL,
    method: str = "ekf",
    **values: Any,
) -> dict[str, Ragged]:
    """The outputs by the last parts of their topics; in the order of the stamps for None."""
    policy = None if late is None else parse_late(late, arrival_order=True)
    order: Any = "publish_time" if late is None else "log_time"
    found = collect(replay(sources, bound(model, method, sources, **values), order=order, late=policy))
    return {topic.rpartition("/")[2]: ragged for topic, ragged in found.items()}


def rmse_at_arrivals(states: Stream, source: MemorySource, seed: int = 41) -> float:
    """Of the current estimate after each arrival, against the truth at its own stamp."""
    _, _, _, truth, _ = messages(seed)
    arrivals = np.sort(np.concatenate([source.streams[f"/{name}"].log_time_ns for name in "ab"]))
    current = np.searchsorted(states.log_time_ns, arrivals, side="right") - 1
    there = np.array([truth[stamp - EPOCH_NS][:2] for stamp in states.publish_time_ns[current].tolist()])
    return float(np.sqrt(((states["mean"][current, :2] - there) ** 2).sum(axis=1).mean()))


def summary(outputs: dict[str, Ragged]) -> tuple[Floats, float, float, int]:
    """The last mean, its trace, the log-likelihood, and how many messages were left out."""
    states = outputs["state"].stream
    covariance = states["covariance"][-1].reshape(4, 4)
    likelihood = outputs["innovation"]["log_likelihood"].sum()
    return states["mean"][-1], np.trace(covariance), likelihood, len(outputs.get("skipped", ()))


@pytest.mark.paper
def test_the_sheets_numbers() -> None:
    """The data themselves, what is dropped, and the estimates at the arrivals."""
    stamp, _, values, _, delay = messages()
    assert values.sum() == pytest.approx(-6092.64152597, rel=1e-11)
    assert (len(stamp), (delay > 0).sum()) == (840, 94)
    source = source_of()
    mean, trace, likelihood, _ = summary(replayed(None, [source]))
    in_order = [-53.1785901495, 12.2282140294, -0.738656933794, -0.0376529069749]
    assert_allclose(mean, in_order, rtol=1e-11)
    assert_allclose([trace, likelihood], [0.156979307345, -920.450834719], rtol=1e-11)
    mean, trace, likelihood, dropped = summary(replayed("drop", [source]))
    assert dropped == 73
    expected = [-53.1746720377, 12.2348859916, -0.727934819418, -0.0181481518698]
    assert_allclose(mean, expected, rtol=1e-11)
    assert_allclose([trace, likelihood], [0.157583351268, -851.044011376], rtol=1e-11)
    for wait, dropped, likelihood in ((0.1, 48, -866.894086789), (0.3, 13, -907.624717514)):
        found = summary(replayed(f"wait:{wait}", [source]))
        assert found[3] == dropped
        assert found[2] == pytest.approx(likelihood, rel=1e-11)
    apart = source_of(apart_ns=1)
    for late, expected_m in (("drop", 0.19899017634), ("rewind:0.5", 0.188077045289)):
        states = replayed(late, [apart])["state"].stream
        assert rmse_at_arrivals(states, apart) == pytest.approx(expected_m, rel=1e-11)


@pytest.mark.parametrize(("order", "insertions"), [("measured", (74, 224)), ("arrived", (73, None))])
def test_going_back_is_the_replay_in_order_bit_for_bit(order: str, insertions: Any) -> None:
    """All innovations, and every estimate after the last late message; so is waiting long enough."""
    source = source_of(order=order)
    in_order, back, waited = (replayed(late, [source]) for late in (None, "rewind:0.5", "wait:0.5"))
    for name, column in (("innovation", "log_likelihood"), ("innovation", "covariance")):
        assert_array_equal(back[name][column], in_order[name][column])
    for name in ("mean", "covariance"):
        assert_array_equal(waited["state"][name], in_order["state"][name])
    rewound, states = back["rewound"].stream, back["state"].stream
    assert len(rewound) == insertions[0]
    assert insertions[1] is None or rewound["repeated"].sum() == insertions[1]
    after = states.take(states.log_time_ns > rewound.log_time_ns.max())
    same = np.isin(in_order["state"].stream.publish_time_ns, after.publish_time_ns)
    assert len(after) == same.sum() > 0
    assert_array_equal(after["mean"], in_order["state"]["mean"][same])
    assert_array_equal(after["covariance"], in_order["state"]["covariance"][same])
    given = states.take(states.log_time_ns == states.publish_time_ns)  # as they were issued
    there = np.isin(in_order["state"].stream.publish_time_ns, given.publish_time_ns)
    assert (given["mean"] != in_order["state"]["mean"][there]).any()


@pytest.mark.parametrize("late", ["drop", "wait:0.3", "rewind:0.2", "rewind:0.5"])
def test_blocks_and_ensembles_make_no_difference(late: str) -> None:
    """Bit for bit: what waits and what is gone back to survive the borders; runs do not mix."""
    sources = [source_of(seed) for seed in (41, 42, 43)]
    together = replayed(late, [cut(each) for each in sources])
    for run, source in enumerate(sources):
        alone = replayed(late, [source])
        assert alone.keys() == together.keys()
        for topic, ragged in alone.items():
            stream, own = ragged.stream, together[topic].of_run(run)
            for column in ("publish_time_ns", "log_time_ns"):
                assert_array_equal(getattr(own, column), getattr(stream, column), err_msg=topic)
            for name in stream.columns:
                assert_array_equal(own[name], stream[name], err_msg=topic)


def test_what_is_too_late_to_go_back_for_is_left_out() -> None:
    """And what is left is the replay in order of the others."""
    source = source_of()
    back = replayed("rewind:0.2", [source])
    skipped = back["skipped"].stream
    assert (skipped.log_time_ns - skipped.publish_time_ns > 200_000_000).all()
    assert 0 < len(skipped) < 73
    assert set(sentences_of(skipped)) <= {
        f"topic /{name}: it is more than 0.2 s older than what was used before" for name in "ab"
    }
    gone = {
        topic: skipped.publish_time_ns[skipped["reason"] == n] for n, topic in enumerate(("/a", "/b"))
    }
    kept = {
        topic: stream.take(~np.isin(stream.publish_time_ns, gone.get(topic, [])))
        for topic, stream in source.streams.items()
    }
    others = replayed(None, [MemorySource(kept, source.run, "others")])
    assert_array_equal(back["state"]["mean"][-1], others["state"]["mean"][-1])
    assert_array_equal(back["innovation"]["log_likelihood"], others["innovation"]["log_likelihood"])


def delayed(source: MemorySource, seed: int, *topics: str) -> MemorySource:
    """A recording whose messages on these topics come up to half a second late, some of them."""
    rng = np.random.default_rng(seed)
    streams = dict(source.streams)
    for topic in topics:
        stream = streams[topic]
        late = np.where(rng.random(len(stream)) < 0.3, rng.integers(0, 500_000_000, len(stream)), 0)
        made = make_stream(
            topic,
            stream.schema,
            stream.publish_time_ns,
            log_time_ns=stream.publish_time_ns + late,
            metadata=stream.metadata,
            **{name: column for name, column in stream.columns.items() if name != "sensor_time_ns"},
        )
        made.position[:] = stream.position
        streams[topic] = made
    return MemorySource(streams, source.run, source.name)


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(
    ("model", "method", "values"),
    [
        (VEHICLE_A, "ukf", {"gate_probability": 0.9}),
        (VEHICLE_A, "lrkf", {"sampling": "s2kf-11"}),
        (SWITCHING_A, "imm", {"filter": "ekf"}),
        (SWITCHING_A, "imm", {"filter": "sqrt:ekf"}),
    ],
)
def test_angles_maps_gates_and_missing_components(
    model: Model, method: str, values: dict[str, Any]
) -> None:
    """The final estimate and all innovations of a model with all of that, of several modes too."""
    source = delayed(vehicle_a.source(vehicle_a.simulate(7)[0][:50]), 3, "/sighting", "/speed")
    in_order = replayed(None, [source], model, method, **values)
    back = replayed("rewind:0.5", [cut(source)], model, method, **values)
    assert len(back["rewound"]) > 10
    assert_array_equal(back["state"]["mean"][-1], in_order["state"]["mean"][-1])
    if "modes" in in_order:
        assert_array_equal(back["modes"]["probability"][-1], in_order["modes"]["probability"][-1])
    for name in back["innovation"].stream.columns:
        assert_array_equal(back["innovation"][name], in_order["innovation"][name])


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("method", ["ekf", "smoother"])
def test_waiting_with_an_interpolated_control_and_smoothers(method: str) -> None:
    """Long enough it is the replay in order; what waits for a control does so after its own wait."""
    source = delayed(driven_wheel(), 5, "/dial", "/tacho", "/drive")
    in_order = replayed(None, [source], make_wheel(), method, every_s=0.05)
    waited = replayed("wait:0.5", [cut(source)], make_wheel(), method, every_s=0.05)
    for name in ("mean", "covariance"):
        assert_array_equal(waited["state"][name], in_order["state"][name])
    assert len(replayed("drop", [source], make_wheel(), method)["skipped"]) > 5


def driven_wheel() -> MemorySource:
    return wheel.source(wheel.simulate(4, np.arange(-1, 20) * 0.07))


def test_who_cannot_go_back_says_why() -> None:
    """What has no order, or would not get the same again."""
    source = vehicle_a.source(vehicle_a.simulate(7)[0])
    batch = Batch("all", ("/speed",), (), lambda _: [])
    other = Recursive("mine", ("/speed",), (), lambda _: None, lambda state, _: (state, []))
    assert isinstance(taking_late(other, parse_late("drop", arrival_order=True)), Recursive)
    random = bound(VEHICLE_A, "lrkf", [source], sampling="rukf-12")
    cloud = bound(VEHICLE_A, "particles", [source], particles=50)
    (driven,) = bound(make_wheel(), "ekf", [driven_wheel()])
    for refused, late, words in (
        (batch, "drop", "all messages together"),
        (other, "rewind:1", "a model and a method"),
        (random[0], "rewind:1", "random"),
        (cloud[0], "rewind:1", "all particles"),
        (driven, "rewind:1", "drive is interpolated"),
    ):
        with pytest.raises(BadInput, match=f"estimator {refused.name}: .*{words}"):
            taking_late(refused, parse_late(late, arrival_order=True))
