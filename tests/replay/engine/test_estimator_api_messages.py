"""What estimators of third parties can ask for: outputs, topics, random numbers, small matrices."""

import logging
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from fuselog.recorders.compiling import notices
from fuselog.recorders.compiling.compile import compile_over_runs, compiled
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Field, RunMetadata, Schema, Stream, Topic, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.api.functions import batch, each_run, recursive
from fuselog.replay.engine.api.inputs import Binding, Floats, Given, Messages, OneRun
from fuselog.replay.engine.api.outputs import Diagnostics, Estimates, Measured, Results
from fuselog.replay.engine.replaying.estimator import Estimator
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Block, Ragged, gather, merge_events
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.through_numba import numba_over_runs
from fuselog.replay.inference.linear_algebra.small_matrices import predict, solve, update, update_memory

DETOUR = Schema(
    "Detour",
    "How far it was.",
    (Field("sensor_time_ns", "time_ns"), Field("by", "identifier"), Field("metres", "real")),
    package="test",
)
X = {"x_m": "linear"}


class SeededParameters(Parameters):
    """None takes what the channel states."""

    seed: int = 0
    sigma_m: float | None = None


class State(NamedTuple):
    """Where it is, (runs, 1)."""

    x: Floats


def make_run(values: list[float], *, odometry: bool = True) -> MemorySource:
    times_ns = np.arange(len(values)) * 10 + 100
    streams: list[Stream] = [
        make_stream(
            "/a/range",
            schemas.RANGE,
            times_ns,
            target_id=np.arange(len(values)),
            range_m=np.array(values),
        ),
        make_stream(
            "/a/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [0],
            metadata={"components": "y_m,x_m", "kinds": "linear,linear", "sigma_m": "0.5"},
            mean=[[7.0, values[0]]],
            covariance=np.diag([2.0, 3.0]).reshape(1, 4),
        ),
    ]
    if odometry:
        streams.append(
            make_stream(
                "/a/odometry",
                schemas.ODOMETRY,
                times_ns + 5,
                forward_mps=times_ns * 1.0,
                turn_radps=times_ns,
            )
        )
    return memory_source(Recording(streams, 0), RunMetadata("test"))


def run(estimator: Estimator[Any], runs: list[MemorySource], **values: Any) -> dict[str, Ragged]:
    block = values.pop("block_messages", 1 << 18)
    bound = estimator.bind("m", runs[0].topics, estimator.parameters(**values))
    return collect(replay(runs, bound, block_messages=block))


def start(given: Given[Any]) -> tuple[tuple[()], State]:
    return (), State(given.prior("prior")[1])


def walk(
    run: int, settings: Any, messages: Messages, state: State, results: Results, generator: Any
) -> None:
    """Draws; tells of every second message."""
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        state.x[run, 0] += generator.standard_normal()
        results.mean[row, 0] = state.x[run, 0]
        results.covariance[row, 0, 0] = 1.0
        if messages.topic[row] == 1:
            results.further[row, 0] = 3
            results.further[row, 1] = messages.value[row, 0]


def walking(**more: Any) -> Estimator[Any]:
    return recursive(
        "walks at random",
        parameters=SeededParameters,
        streams={"range": schemas.RANGE, "odometry": schemas.ODOMETRY},
        static={"prior": schemas.GAUSSIAN_ESTIMATE},
        components=X,  # type: ignore[arg-type]
        optional=("odometry",),
        outputs={"detour": DETOUR},
        draws=True,
        start=start,
        follow=walk,
        **more,
    )


def test_random_numbers_are_a_runs_own() -> None:
    """Neither other runs nor blocks nor the compiler change them; the seed does."""
    runs = [make_run([1.0, 2.0, 5.0]), make_run([4.0]), make_run([2.0, 1.0])]
    together = run(walking(), runs)["/estimates/m/a/state"]
    for number, source in enumerate(runs):
        alone = run(walking(compiled=False), [source])["/estimates/m/a/state"]
        assert np.array_equal(together.of_run(number)["mean"], alone["mean"])
    in_blocks = run(walking(), runs, block_messages=1)["/estimates/m/a/state"]
    assert np.array_equal(together["mean"], in_blocks["mean"])
    steps = [np.diff(together.of_run(number)["mean"][:, 0], prepend=0.0) for number in range(3)]
    assert len(np.unique(np.concatenate(steps))) == 12
    other = run(walking(), runs, seed=1)["/estimates/m/a/state"]
    assert not np.any(other["mean"] == together["mean"])


def test_further_outputs_and_topics_that_may_be_absent() -> None:
    told = run(walking(), [make_run([1.0, 2.0]), make_run([3.0])])["/estimates/m/a/detour"]
    assert told.offsets.tolist() == [0, 2, 3]
    assert told["by"].tolist() == [3, 3, 3]
    assert told["metres"].tolist() == [100.0, 110.0, 100.0]
    assert told.stream.publish_time_ns.tolist() == [105, 115, 105]
    without = run(walking(), [make_run([1.0, 2.0], odometry=False)])
    assert len(without["/estimates/m/a/state"]) == 2
    assert len(without["/estimates/m/a/detour"]) == 0
    assert "odometry (fuselog.Odometry, optional)" in walking().requirements
    vector = Schema("V", "v", (Field("sensor_time_ns", "time_ns"), Field("v", "vector")), package="t")
    with pytest.raises(BadInput, match="field v of its output extra is a vector"):
        recursive(
            "v",
            parameters=Parameters,
            streams={},
            static={},
            components=X,  # type: ignore[arg-type]
            outputs={"extra": vector},
            start=start,
            follow=walk,
        )


def careless(run: int, values: Floats) -> None:
    values[run] = np.random.normal()  # noqa: NPY002


def slips(run: int, settings: Any, messages: Messages, state: State, results: Results) -> None:
    state.x[run, 0] = 0.0
    results.mean[0, 0] = messages.nothing  # type: ignore[attr-defined]


def test_what_cannot_be_compiled_is_named_with_its_line() -> None:
    """A generator that is nobody's own, and what numba complains of."""
    if os.environ.get("FUSELOG_UNCOMPILED"):
        return
    with pytest.raises(BadInput, match=rf"careless uses np.random \({__file__}, line \d+\)"):
        numba_over_runs(careless)(1, np.zeros(1))
    wrong = recursive(
        "wrong",
        parameters=Parameters,
        streams={"range": schemas.RANGE},
        static={"prior": schemas.GAUSSIAN_ESTIMATE},
        components=X,  # type: ignore[arg-type]
        start=start,
        follow=slips,
    )
    line = slips.__code__.co_firstlineno + 2
    expected = (
        rf"estimator m/a: kernel 'slips' does not compile: .*nothing.* \({__file__}, line {line}\)"
    )
    with pytest.raises(BadInput, match=expected):
        run(wrong, [make_run([1.0])])


def solved(shape: tuple[int, ...]) -> Estimator[Any]:
    def solve_one(streams: OneRun, parameters: SeededParameters) -> Estimates:
        _, mean, covariance = streams.prior("prior")
        assert streams.stated("prior", "sigma_m") == 0.5
        seen = streams["range"]
        mean = mean + streams.generator.normal()
        innovation = seen["range_m"][:, None] - mean
        told = Diagnostics(seen.publish_time_ns[:1], {"by": np.array([2]), "metres": np.array([0.5])})
        spread = np.full((len(seen), 1, 1), 4.0)
        return Estimates(
            seen.publish_time_ns[-1:],
            mean[None],
            np.broadcast_to(covariance[0, 0], shape),
            innovations=Measured(seen.publish_time_ns, innovation, spread, seen["target_id"]),
            further={"detour": told},
        )

    return batch(
        "solves",
        parameters=SeededParameters,
        streams={"range": schemas.RANGE},
        static={"prior": schemas.GAUSSIAN_ESTIMATE},
        components=X,  # type: ignore[arg-type]
        measured={"range_m": "linear"},
        outputs={"detour": DETOUR},
        solve=each_run(solve_one),
    )


def test_a_batch_has_priors_generators_innovations_and_further_outputs() -> None:
    runs = [make_run([1.0, 2.0]), make_run([5.0])]
    out: Mapping[str, Ragged] = run(solved((1, 1, 1)), runs)
    assert out["/estimates/m/a/state"]["covariance"].tolist() == [[3.0], [3.0]]
    mean = out["/estimates/m/a/state"]["mean"][:, 0]
    assert mean[0] - 1.0 != mean[1] - 5.0
    alone = run(solved((1, 1, 1)), runs[1:])["/estimates/m/a/state"]
    assert alone["mean"][0, 0] == mean[1]
    innovation = out["/estimates/m/a/innovation"]
    assert innovation.offsets.tolist() == [0, 2, 3]
    assert innovation["target_id"].tolist() == [0, 1, 0]
    squared = (np.array([1.0, 2.0, 5.0]) - mean[[0, 0, 1]]) ** 2 / 4.0
    np.testing.assert_allclose(innovation["normalised_innovation_squared"], squared)
    assert out["/estimates/m/a/detour"]["by"].tolist() == [2, 2]


def test_a_batch_of_the_wrong_shape_is_told_in_one_sentence() -> None:
    words = r"estimator m/a: covariance has the shape \(1, 2, 2\); \(1, 1, 1\) is needed"
    with pytest.raises(BadInput, match=words):
        run(solved((1, 2, 2)), [make_run([1.0])])


def test_small_matrices_are_numpys() -> None:
    """The filter's two steps and Cholesky's solution, beside linear algebra; a component is missing."""
    rng = np.random.default_rng(1)

    def definite(size: int) -> Floats:
        root = rng.normal(size=(size, size))
        return root @ root.T + 0.1 * np.eye(size)

    x, p, f, q = rng.normal(size=3), definite(3), rng.normal(size=(3, 3)), definite(3)
    h, r, v = rng.normal(size=(2, 3)), definite(2), np.array([0.5, np.nan])
    mean, covariance = x.copy(), p.copy()
    predict(mean, covariance, f, q, np.empty((3, 3)))
    np.testing.assert_allclose(mean, f @ x)
    np.testing.assert_allclose(covariance, f @ p @ f.T + q)
    squared = update(mean, covariance, v, h, r, update_memory(3, 2))
    before = f @ p @ f.T + q
    s = h[0] @ before @ h[0] + r[0, 0]
    gain = before @ h[0] / s
    np.testing.assert_allclose(mean, f @ x + gain * v[0])
    np.testing.assert_allclose(covariance, before - s * np.outer(gain, gain))
    assert squared == pytest.approx(v[0] ** 2 / s)
    right = rng.normal(size=3)
    expected = np.linalg.solve(q, right)
    assert solve(q, right, 3)
    np.testing.assert_allclose(right, expected)
    assert not solve(-np.eye(3), right, 3)
    assert np.isnan(update(mean, covariance, v, h, -1e6 * np.eye(2), update_memory(3, 2)))


def tracked(run: int, mean: Floats, covariance: Floats, noise: Floats, squared: Floats) -> None:
    memory, product = update_memory(2, 2), np.empty((2, 2))
    transition, rows, difference = np.eye(2), np.eye(2), np.ones(2)
    for _ in range(3):
        predict(mean[run], covariance[run], transition, noise, product)
        squared[run] += update(mean[run], covariance[run], difference, rows, noise, memory)


@pytest.mark.paper
def test_small_matrices_compile() -> None:
    compiled, plain = (
        (np.ones((2, 2)), np.stack([np.eye(2)] * 2), 0.5 * np.eye(2), np.zeros(2)) for _ in range(2)
    )
    numba_over_runs(tracked)(2, *compiled)
    tracked(0, *plain)
    np.testing.assert_allclose(compiled[0][0], plain[0][0])
    np.testing.assert_allclose(compiled[1][1], plain[1][0])
    assert compiled[3][1] == pytest.approx(plain[3][0])


def test_all_runs_at_once_are_one_call() -> None:
    """`follow_all` sees the whole ensemble; neither it nor `follow` is bad input."""
    seen: list[int] = []

    def settle(settings: Any, messages: Messages, state: State, results: Results) -> None:
        seen.append(len(messages.offsets) - 1)
        results.mean[:, 0], results.covariance[:] = messages.value[:, 1], 1.0

    given: dict[str, Any] = {
        "parameters": Parameters,
        "streams": {"range": schemas.RANGE},
        "static": {"prior": schemas.GAUSSIAN_ESTIMATE},
        "components": X,
        "start": start,
    }
    out = run(recursive("all", follow_all=settle, **given), [make_run([1.0, 2.0]), make_run([3.0])])
    assert seen == [2]
    assert out["/estimates/m/a/state"]["mean"][:, 0].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(BadInput, match="give exactly one of follow, follow_all and advance"):
        recursive("none", **given)
    with pytest.raises(BadInput, match="out_of_sequence and finish need advance"):
        recursive("late", follow_all=settle, finish=told, **given)


def find_ranges(
    name: str, topics: Mapping[str, Topic], parameters: SeededParameters
) -> Iterator[Binding]:
    """Whatever has ranges, from a number on that the name of the estimator is long."""
    for topic in topics.values():
        if topic.schema_name == schemas.RANGE.full_name:
            yield Binding({"seen": topic}, suffix="/found", setup=parameters.seed + len(name))


def start_counting(given: Given[SeededParameters]) -> tuple[Given[SeededParameters], list[int]]:
    return given, [given.setup] * given.runs


def count(
    given: Given[SeededParameters], before: list[int], block: Block
) -> tuple[list[int], list[Ragged]]:
    """How many ranges came so far, after every block: a state of any type, and an output of any kind."""
    seen = block.streams[given.topics["seen"].name]
    after = [known + int(new) for known, new in zip(before, np.diff(seen.offsets), strict=True)]
    return after, told(given, after)


def told(given: Given[SeededParameters], counts: list[int]) -> list[Ragged]:
    topic = f"/estimates/{given.name}/size"
    sizes = [make_stream(topic, schemas.ESTIMATE_SIZE, [100], elements=[each]) for each in counts]
    return [gather(sizes)]


def test_topics_and_outputs_may_be_any() -> None:
    """Found by a function, and bound under a name of their own; of two runs."""
    counting = recursive(
        "counts",
        parameters=SeededParameters,
        find=find_ranges,
        requirements="ranges",
        variant="seed",
        start=start_counting,
        advance=count,
    )
    assert (counting.requirements, counting.variant) == ("ranges", "seed")
    out = run(counting, [make_run([1.0] * 4), make_run([2.0] * 4)], seed=10)
    assert out["/estimates/m/found/size"]["elements"].tolist() == [15, 15]
    at_the_end = recursive(
        "counts",
        parameters=SeededParameters,
        find=find_ranges,
        start=start_counting,
        advance=lambda given, before, block: (count(given, before, block)[0], []),
        finish=told,
    )
    out = run(at_the_end, [make_run([1.0] * 4), make_run([2.0])], block_messages=2)
    assert out["/estimates/m/found/size"]["elements"].tolist() == [5, 2]

    def solve(given: Given[SeededParameters]) -> list[Ragged]:
        return count(given, [given.setup] * given.runs, all_of(given))[1]

    def all_of(given: Given[SeededParameters]) -> Block:
        streams = {given.topics["seen"].name: given["seen"]}
        return Block(streams, merge_events(streams, "publish_time"))

    counted = batch("counts", parameters=SeededParameters, find=find_ranges, solve=solve)
    out = run(counted, [make_run([1.0] * 4), make_run([2.0])])
    assert out["/estimates/m/found/size"]["elements"].tolist() == [5, 2]


def halve(run: int, values: Floats) -> None:
    values[run] *= 0.5


def doubled(value: float) -> float:
    return 2.0 * value


@pytest.mark.paper
@pytest.mark.skipif(os.environ.get("FUSELOG_UNCOMPILED") == "1", reason="nothing is compiled")
def test_long_compiling_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """While it happens, and not where the code was kept."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path))
    monkeypatch.setattr("fuselog.recorders.compiling.notices._PATIENCE_S", 0.0)
    caplog.set_level(logging.INFO, logger="fuselog")
    for _ in range(2):
        compile_over_runs(halve)(2, np.ones(2))
    said = [record.getMessage() for record in caplog.records]
    name = f"{halve.__module__}.halve"
    assert said[0] == f"compiling {name}, once"
    assert re.fullmatch(rf"compiled {name} in \d+\.\d s", said[1])
    assert len(said) == 2


@pytest.mark.skipif(os.environ.get("FUSELOG_UNCOMPILED") == "1", reason="nothing is compiled")
def test_python_says_what_it_compiles_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """On standard error, as nothing else is there; not where the program logs in its own way."""
    monkeypatch.setattr(notices, "_PATIENCE_S", 0.0)
    said = []
    for cache, handlers in (("plain", []), ("logs", [logging.StreamHandler()])):
        monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / cache))
        monkeypatch.setattr(logging.getLogger(), "handlers", handlers)
        notices._print_once.cache_clear()
        for value in (1.0, 1):
            compiled(doubled)(value)
        said.append(capsys.readouterr().err)
    name = rf"{re.escape(__name__)}\.doubled"
    assert re.match(
        rf"fuselog: compiling {name}, once\nfuselog: compiled {name} in \d+\.\d s\n", said[0]
    )
    assert said[0].count("compiling") == 1
    assert said[1] == ""
