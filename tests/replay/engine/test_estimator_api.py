"""Estimators from plain functions: blocks, runs and failures, with a filter that is solved by hand."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.api.functions import batch, each_run, recursive
from fuselog.replay.engine.api.inputs import Floats, Given, Integers, Messages
from fuselog.replay.engine.api.outputs import Estimates, Results, Solution
from fuselog.replay.engine.replaying.estimator import Estimator
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Block, Ragged, gather, merge_events
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

STREAMS = {"heading": schemas.BEARING}
STATIC = {"prior": schemas.GAUSSIAN_ESTIMATE}


class MeanParameters(Parameters):
    """None takes what the channel states."""

    sigma_rad: float | None = None


class State(NamedTuple):
    """The mean of the headings so far."""

    mean: Floats
    information: Floats
    looks: Integers


def start(given: Given[MeanParameters]) -> tuple[tuple[float], State]:
    _, mean, covariance = given.prior("prior")
    settings = (given.stated("heading", "sigma_rad"),)
    return settings, State(mean, 1 / covariance[:, :, 0], np.zeros(len(mean), np.int64))


def follow(run: int, settings: tuple[float], messages: Messages, state: State, results: Results) -> None:
    """A static state: the posterior is the weighted mean of prior and measurements."""
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        heading = messages.value[row, 1]
        weight = 1.0 / settings[0] ** 2
        state.looks[run] += 1
        if heading > 900.0:
            state.mean[run, 0] = math.inf
        innovation = heading - state.mean[run, 0]
        state.information[run, 0] += weight
        state.mean[run, 0] += weight / state.information[run, 0] * innovation
        results.mean[row, 0] = state.mean[run, 0]
        results.covariance[row, 0, 0] = 1.0 / state.information[run, 0]
        results.innovation[row, 0] = innovation
        results.innovation_covariance[row, 0, 0] = 1.0
        results.squared[row] = innovation**2
        results.target[row] = int(messages.value[row, 0])


def make_mean(*, compiled: bool = False) -> Estimator[MeanParameters]:
    return recursive(
        "mean heading",
        parameters=MeanParameters,
        streams=STREAMS,
        static=STATIC,
        components={"heading_rad": "angle"},
        truth="truth",
        measured={"heading_rad": "angle"},
        start=start,
        follow=follow,
        compiled=compiled,
    )


def solve(streams: Mapping[str, Stream], parameters: MeanParameters) -> Estimates:
    heading = streams["heading"]["bearing_rad"]
    if len(heading) == 0:
        raise BadInput("no headings")
    variance = np.full((1, 1, 1), (parameters.sigma_rad or 1.0) ** 2 / len(heading))
    one = np.ones(1, np.int64)
    end = streams["heading"].publish_time_ns[-1:]
    return Estimates(end, np.array([[heading.mean()]]), variance, Solution(one, one, one, np.zeros(1)))


MEAN_OF_ALL = batch(
    "mean heading of all",
    parameters=MeanParameters,
    streams=STREAMS,
    static=STATIC,
    components={"heading_rad": "angle"},
    solve=each_run(solve),
)


def make_run(
    headings: list[float], *, prior: bool = True, names: tuple[str, ...] = ("/a",)
) -> MemorySource:
    streams = []
    priors = 1 if prior else 0
    for name in names:
        times_ns = 100 + 10 * (np.arange(len(headings)) // 2)  # two at every stamp
        streams += [
            make_stream(
                f"{name}/heading",
                schemas.BEARING,
                times_ns,
                metadata={"sigma_rad": "0.5"},
                target_id=np.arange(len(headings)),
                bearing_rad=np.array(headings, float),
            ),
            make_stream(
                f"{name}/prior",
                schemas.GAUSSIAN_ESTIMATE,
                np.zeros(priors, np.int64),
                metadata={"components": "heading_rad", "kinds": "angle"},
                mean=np.zeros((priors, 1)),
                covariance=np.ones((priors, 1)),
            ),
        ]
    return memory_source(Recording(streams, 0), RunMetadata("test"))


def run(estimator: Estimator, runs: list[MemorySource], **values: float) -> dict[str, Ragged]:
    bound = estimator.bind("m", runs[0].topics, estimator.parameters(**values))
    return collect(replay(runs, bound))


@pytest.mark.parametrize("compiled", [False, True])
def test_a_recursion_says_what_the_weighted_mean_is(compiled: bool) -> None:
    """Prior 0 of variance 1 and headings of variance 1/4; of two at a stamp the last estimate stands."""
    out = run(
        make_mean(compiled=compiled), [make_run([1.0, 2.0, 3.0, 4.0]), make_run([]), make_run([1.0])]
    )
    state = out["/estimates/m/a/state"]
    assert state.offsets.tolist() == [0, 2, 2, 3]
    assert state["mean"][:, 0] == pytest.approx([4 * 3 / 9, wrapped(4 * 10 / 17), 4 / 5])
    assert state["covariance"][:, 0] == pytest.approx([1 / 9, 1 / 17, 1 / 5])
    assert state.stream.publish_time_ns.tolist() == [100, 110, 100]
    assert state.stream.metadata == {
        "components": "heading_rad",
        "kinds": "angle",
        "truth": "/a/truth",
    }
    innovation = out["/estimates/m/a/innovation"]
    assert innovation.offsets.tolist() == [0, 4, 4, 5]
    assert innovation["target_id"].tolist() == [0, 1, 2, 3, 0]
    assert innovation["accepted"].tolist() == [1] * 5
    assert len(out["/estimates/m/a/failure"]) == 0


def wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def test_parameters_stand_above_what_the_channel_states() -> None:
    out = run(make_mean(), [make_run([1.0])], sigma_rad=1.0)
    assert out["/estimates/m/a/state"]["mean"][0, 0] == pytest.approx(0.5)


def test_every_prefix_that_has_all_topics_is_estimated() -> None:
    runs = [make_run([1.0], names=("/a", "", "/b/c"))]
    assert sorted(run(make_mean(), runs)) == sorted(
        f"/estimates/m{prefix}/{leaf}"
        for prefix in ("/a", "", "/b/c")
        for leaf in ("state", "failure", "innovation")
    )
    topics = dict(runs[0].topics)
    del topics["/b/c/prior"]
    names = [each.name for each in make_mean().bind("m", topics, MeanParameters())]
    assert sorted(names) == ["m", "m/a"]


def test_a_state_is_a_value_that_blocks_do_not_change() -> None:
    """Block after block gives what one block gives, and the state before a block can be used again."""
    source = make_run([1.0, 2.0, 3.0, 4.0])
    (bound,) = make_mean().bind("m", source.topics, MeanParameters())
    whole = run(make_mean(), [source])["/estimates/m/a/state"]
    prior = {"/a/prior": Ragged(source.streams["/a/prior"], np.array([0, 1]))}
    first = bound.start(prior)

    def block(rows: slice) -> Block:
        streams = {"/a/heading": gather([source.streams["/a/heading"].take(rows)])}
        return Block(streams, merge_events(streams, "publish_time"))

    second, _ = bound.run(first, block(slice(0, 2)))
    _, made = bound.run(second, block(slice(2, 4)))
    _, again = bound.run(second, block(slice(2, 4)))
    assert made[0]["mean"].tolist() == again[0]["mean"].tolist() == whole["mean"][1:].tolist()


def test_failed_runs_are_told_when_and_the_others_go_on() -> None:
    """A run whose mean is no longer finite, and one without a prior; each is told once."""
    bad, good, blind = (
        make_run([1.0, 1.0, 999.0, 1.0]),
        make_run([1.0, 2.0]),
        make_run([1.0], prior=False),
    )
    out = run(make_mean(), [bad, good, blind])
    failure = out["/estimates/m/a/failure"]
    assert failure.offsets.tolist() == [0, 1, 1, 2]
    assert failure.stream.publish_time_ns.tolist() == [110, 100]
    assert out["/estimates/m/a/state"].offsets.tolist() == [0, 1, 2, 2]
    with pytest.raises(BadInput, match="topic /a/prior: no usable prior of 1 components"):
        run(make_mean(), [blind])


def test_a_batch_tells_of_its_solutions_and_of_runs_without_one() -> None:
    out = run(MEAN_OF_ALL, [make_run([1.0, 2.0]), make_run([]), make_run([2.0, 4.0, 3.0])])
    assert out["/estimates/m/a/state"]["mean"][:, 0] == pytest.approx([1.5, 3.0])
    assert out["/estimates/m/a/state"].offsets.tolist() == [0, 1, 1, 2]
    assert out["/estimates/m/a/solution"]["converged"].tolist() == [1, 1]
    failure = out["/estimates/m/a/failure"]
    assert failure.offsets.tolist() == [0, 0, 1, 1]
    assert sentences_of(failure.stream) == ["no headings"]
    with pytest.raises(BadInput, match="no messages on /a/heading"):
        run(MEAN_OF_ALL, [make_run([])])
