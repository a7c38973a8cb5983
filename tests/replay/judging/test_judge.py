"""The judge: the same numbers whatever the blocks and parts that it gets, and truths read along."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from fuselog.recorders.log import Clock, Schema, Stream, make_stream, schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import Report, collect, replay
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.judging.diagnostics import Diagnostics
from fuselog.replay.judging.errors.constant import _add_sums
from fuselog.replay.judging.errors.evaluation import chi_square_interval, rmse_interval
from fuselog.replay.judging.errors.moments import Moments, worst_of
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.sums import BinnedSums

Floats = NDArray[np.float64]
GAP_S = 0.2


@pytest.fixture(scope="module")
def sources() -> list[MemorySource]:
    return [memory_source(*record_run("landmarks", {"duration_s": 8.0}, 5, run)) for run in range(3)]


@pytest.fixture(scope="module")
def outputs(sources: list[MemorySource]) -> dict[str, Ragged]:
    report = Report()
    bound = [each for label in ("ekf", "dead-reckoning") for each in bind(label, sources, {})]
    found = collect(replay(sources, bound, report=report))
    return found | collect([report.coverage])


def judged(sources: list[MemorySource], blocks: list[dict[str, Ragged]], first_run: int = 0) -> Judge:
    judge = Judge(sources, gap_limit_s=GAP_S, first_run=first_run)
    for block in blocks:
        judge.add(block)
    return judge


def cut(outputs: dict[str, Ragged], time_ns: int) -> list[dict[str, Ragged]]:
    """The outputs up to a stamp, and from there on."""
    sides = []
    for is_early in (True, False):
        sides.append(
            {
                topic: gather(
                    [
                        rows.of_run(run).take((rows.of_run(run).publish_time_ns <= time_ns) == is_early)
                        for run in range(rows.runs)
                    ]
                )
                for topic, rows in outputs.items()
            }
        )
    return sides


def assert_alike(one: Judge, other: Judge) -> None:
    """Sums of sums round otherwise, and nothing else differs."""
    assert one.metrics == pytest.approx(other.metrics, rel=1e-12)
    assert one.metrics.keys() == other.metrics.keys()
    for table in ("runs_table", "times"):
        pd.testing.assert_frame_equal(getattr(one, table), getattr(other, table), rtol=1e-12)
    for topic, steps in one.steps.items():
        pd.testing.assert_frame_equal(steps, other.steps[topic], rtol=1e-12)
    assert one.bounds == other.bounds
    assert one.worst == other.worst
    assert (one.failures, one.notes_of_coverage, one.components_without_truth) == (
        other.failures,
        other.notes_of_coverage,
        other.components_without_truth,
    )


@pytest.mark.parametrize("at_s", [0.01, 1.0, 4.03, 7.99])
def test_blocks_change_no_number(
    sources: list[MemorySource], outputs: dict[str, Ragged], at_s: float
) -> None:
    blocks = cut(outputs, sources[0].epoch_ns + round(at_s * 1e9))
    assert_alike(judged(sources, blocks), judged(sources, [outputs]))


def test_parts_of_the_runs_merge_to_the_whole(
    sources: list[MemorySource], outputs: dict[str, Ragged]
) -> None:
    def of_runs(runs: list[int]) -> dict[str, Ragged]:
        return {topic: gather([rows.of_run(run) for run in runs]) for topic, rows in outputs.items()}

    parts = judged(sources[:2], [of_runs([0, 1])])
    assert set(parts.runs_table["run"]) == {0, 1}
    parts.merge(judged(sources[2:], [of_runs([2])], first_run=2))
    assert_alike(parts, judged(sources, [outputs]))
    assert set(parts.runs_table["run"]) == {0, 1, 2}


def test_the_worst_moment_is_that_of_the_largest_nees_else_of_the_largest_error(
    sources: list[MemorySource], outputs: dict[str, Ragged]
) -> None:
    judge = Judge(sources, gap_limit_s=GAP_S)
    blocks, counts = [], []
    for block in cut(outputs, sources[0].epoch_ns + 2 * 10**9):
        blocks.append(judge.add(block).errors)
        table = judge.runs_table
        counts.append(table["estimates"].sum())
        table["estimates"] = 0  # of a copy
    assert 0 < counts[0] < counts[1] == judge.runs_table["estimates"].sum()
    assert set(judge.worst) == {"ekf", "dead-reckoning"}
    for estimator, found in judge.worst.items():
        errors = [each for block in blocks for each in block if each.estimator == estimator]
        nees, run, time_ns = (
            np.concatenate([getattr(each, name) for each in errors])
            for name in ("nees", "run", "time_ns")
        )
        row = int(np.argmax(nees))
        assert found[:6] == (estimator, "robot1", "nees", nees[row], run[row], time_ns[row])
        assert found.elapsed_s == pytest.approx((time_ns[row] - sources[0].epoch_ns) * 1e-9)
    moments = Moments()
    assert worst_of(moments.found) is None
    errors = blocks[0][0]
    moments.add(replace(errors, nees=np.full(len(errors.nees), np.nan)))
    length = np.hypot(*errors.error[:, errors.position].T)
    worst = worst_of(moments.found)
    assert worst is not None
    assert (worst.quantity, worst.time_ns) == ("position_error_m", errors.time_ns[np.argmax(length)])
    assert worst.value == pytest.approx(length.max())


def test_probabilities_of_modes_are_means_over_the_runs(sources: list[MemorySource]) -> None:
    """At every stamp, of the runs that have it; blocks and parts change no number."""
    rng = np.random.default_rng(3)
    counts, modes = (40, 40, 25), ("drive", "stand")
    probability = [rng.dirichlet([1.0, 2.0], count) for count in counts]

    def of(runs: slice, rows: slice, leaf: str = "modes") -> dict[str, Ragged]:
        topic = f"/estimates/imm/robot1/{leaf}"
        streams = [
            make_stream(
                topic,
                schemas.MODE_PROBABILITIES,
                source.epoch_ns + np.arange(len(each))[rows] * 100_000_000,
                metadata={"components": ",".join(modes)},
                probability=each[rows],
            )
            for source, each in zip(sources[runs], probability[runs], strict=True)
        ]
        return {topic: gather(streams)}

    everything = slice(None)
    whole = judged(sources, [of(everything, everything)]).modes
    assert_allclose(whole.groupby("elapsed_s")["probability"].sum(), 1.0, rtol=1e-12)
    mean = [np.mean([each[step] for each in probability if step < len(each)], 0) for step in range(40)]
    assert_allclose(whole["probability"], np.ravel(mean), rtol=1e-12)
    assert_allclose(whole["elapsed_s"], np.repeat(np.arange(40) * 0.1, 2), atol=1e-9)
    assert whole["estimates"].tolist() == [3] * 50 + [2] * 30
    assert whole["mode"].tolist() == [*modes] * 40
    blocks = judged(sources, [of(everything, slice(0, 17)), of(everything, slice(17, None))])
    parts = judged(sources[:2], [of(slice(0, 2), everything)])
    parts.merge(judged(sources[2:], [of(slice(2, 3), everything)], first_run=2))
    for other in (blocks.modes, parts.modes):
        pd.testing.assert_frame_equal(other, whole, rtol=1e-12)
    smoothed = judged(sources, [of(everything, everything, "smoothed_modes")]).modes
    assert (bool(whole["smoothed"].any()), bool(smoothed["smoothed"].all())) == (False, True)


def test_the_runs_add_up_to_the_metrics(sources: list[MemorySource], outputs: dict[str, Ragged]) -> None:
    """Every table comes from the same errors: weighted by its estimates, each gives the RMSE again."""
    judge = judged(sources, [outputs])
    expected = judge.metrics["ekf.position_rmse_m.robot1"]
    for table in (judge.runs_table, judge.times):
        own = table[table["estimator"] == "ekf"]
        rmse = np.sqrt(np.average(own["position_rmse_m"] ** 2, weights=own["estimates"]))
        assert rmse == pytest.approx(expected, rel=1e-12)
        assert np.average(own["nees"], weights=own["estimates"]) == pytest.approx(
            judge.metrics["ekf.nees.robot1"], rel=1e-12
        )


def test_nees_and_nis_have_the_bounds_of_what_is_independent(
    sources: list[MemorySource], outputs: dict[str, Ragged]
) -> None:
    """NEES those of a mean over the three runs, NIS those of all innovations; chi-squares of a table."""
    judge = judged(sources, [outputs])
    bounds = judge.bounds
    assert bounds.keys() <= judge.metrics.keys()
    assert bounds["ekf.nees.robot1"] == pytest.approx((2.70039 / 3, 19.02277 / 3), rel=1e-5)  # 9 degrees
    position = (1.23734 / 3, 14.44938 / 3)  # 6 degrees
    assert bounds["ekf.position_nees.robot1"] == pytest.approx(position, rel=1e-5)
    degrees = 2 * len(outputs["/estimates/ekf/robot1/innovation"])
    expected = tuple(bound / degrees for bound in chi_square_interval(degrees, 1))
    assert bounds["ekf.nis_per_component.robot1"] == pytest.approx(expected, rel=1e-12)
    assert "dead-reckoning.nis_per_component.robot1" not in bounds


def test_the_rmse_of_a_step_stands_beside_what_its_covariances_promise(
    sources: list[MemorySource], outputs: dict[str, Ragged]
) -> None:
    """At step 5, from the covariances themselves."""
    steps = judged(sources, [outputs]).steps["/estimates/ekf/robot1/pose"]
    rows = outputs["/estimates/ekf/robot1/pose"]
    blocks = [rows.of_run(run)["covariance"][5].reshape(3, 3)[:2, :2] for run in range(3)]
    trace, squared = (
        np.array([np.mean([np.trace(each) for each in of])])
        for of in (blocks, [block @ block for block in blocks])
    )
    low, high = rmse_interval(np.array([3.0]), trace, squared)
    assert_allclose(steps["position_rmse_m_low"][5], low[0], rtol=1e-12)
    assert_allclose(steps["position_rmse_m_high"][5], high[0], rtol=1e-12)


class InBlocks(MemorySource):
    """A recording that is read sixteen messages of a topic at a time."""

    def blocks(
        self,
        topics: Sequence[str],
        order: Clock,  # noqa: ARG002
        block_messages: int,  # noqa: ARG002
    ) -> Iterator[dict[str, Stream]]:
        """Of a truth, whose messages are in order."""
        for first in range(0, max(len(self.streams[topic]) for topic in topics), 16):
            rows = slice(first, first + 16)
            yield {topic: self.streams[topic].take(rows) for topic in topics}


def test_truths_are_read_along_and_again_for_who_comes_late(sources: list[MemorySource]) -> None:
    """What all readers have passed is forgotten, but read anew for one that begins from the start."""
    [topic, *_] = [topic for topic in sources[0].streams if topic.endswith("truth")]
    whole = sources[0].streams[topic].publish_time_ns
    truths = Truths(InBlocks(sources[0].streams, sources[0].run, "run"))

    def held(rows: slice, reader: str) -> int:
        found = truths.around(topic, whole[rows] + 1, GAP_S, reader)
        needed = slice(rows.start, rows.stop + 1)  # a neighbour on each side
        assert set(whole[needed]) <= set(found.publish_time_ns)
        return len(found)

    rows = [slice(at, at + 10) for at in range(0, len(whole) - 11, 10)]
    assert max(held(each, "one") for each in rows) <= 10 + 2 * 16
    assert held(rows[0], "two") < len(whole)
    assert held(rows[-1], "one") >= len(whole) - 16  # the second reader is still at the beginning


@given(
    st.lists(
        st.tuples(st.integers(0, 5000), st.integers(0, 3), st.floats(-9, 9)), min_size=1, max_size=60
    ),
    st.integers(1, 60),
    st.sampled_from([None, 4, 32]),
)
def test_binned_sums_are_the_same_in_any_cut(
    rows: list[tuple[int, int, float]], at: int, limit: int | None
) -> None:
    position, group, value = (np.array(each) for each in zip(*rows, strict=True))

    def summed(part: slice) -> BinnedSums:
        sums = BinnedSums(1, limit=limit)
        sums.add(position[part], value[part, None].astype(float), group[part])
        return sums

    whole, merged, added = summed(slice(None)), summed(slice(0, at)), summed(slice(0, at))
    merged.merge(summed(slice(at, None)))
    added.add(position[at:], value[at:, None].astype(float), group[at:])
    for sums in (merged, added):
        assert sums.width == whole.width
        for one, other in zip(sums.filled(), whole.filled(), strict=True):
            assert_allclose(one, other, atol=1e-12)
    cells, count, _ = whole.filled()
    assert limit is None or len(np.unique(cells[:, 1])) <= limit
    assert count.sum() == len(rows)
    for (number, at_bin), n in zip(cells.tolist(), count.tolist(), strict=True):
        assert n == np.sum((group == number) & (position // whole.width == at_bin))
    assert_array_equal(np.unique(cells[:, 0]), np.unique(group))


def test_what_a_replay_says_of_itself_adds_up_over_its_parts(sources: list[MemorySource]) -> None:
    """Failures, what was skipped, how runs began and what was covered: of two parts as of the whole."""
    epoch_ns = sources[0].epoch_ns

    def told(schema: Schema, reasons: list[list[int]]) -> Ragged:
        texts = ["one", "two", "three"]
        topic = f"/estimates/x/{schema.name.lower()}"
        return gather(
            [
                reason_stream(
                    topic, schema, np.full(len(each), epoch_ns + 10**9), np.array(each, int), texts
                )
                for each in reasons
            ]
        )

    given = {
        "/estimates/x/failure": told(schemas.FAILURE, [[], [0], [1]]),
        "/estimates/x/skipped": told(schemas.SKIPPED, [[0, 0], [1], [0]]),
        "/estimates/x/started": told(schemas.STARTED, [[2], [2, 1], [2]]),
    }

    def of(runs: range) -> Diagnostics:
        part = Diagnostics(runs.start)
        for topic, ragged in given.items():
            part.add(topic, gather([ragged.of_run(run) for run in runs]), [sources[run] for run in runs])
        return part

    whole, parts = of(range(3)), of(range(1))
    parts.merge(of(range(1, 3)))
    names = {run: f"run {run}" for run in range(3)}
    assert parts.failures(names) == whole.failures(names)
    assert len(whole.failures(names)) == 2
    assert parts.notes() == whole.notes()
    assert whole.notes() == [
        "x: three (in 3 runs)",
        "x: two",
        "x: 3 not used: one",
        "x: 1 not used: two",
    ]


@pytest.mark.parametrize("axes", [2, 3])
def test_an_infinite_variance_weighs_nothing(axes: int) -> None:
    """Of two axes whatever stands beside it; the rest is the inverse of what is finite."""
    covariance = np.array([[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 4.0]])[:axes, :axes]
    for axis, beside in product(range(axes), (0.0, np.inf, np.nan)[: 3 if axes == 2 else 1]):
        given, wanted = covariance.copy(), np.zeros((axes, axes))
        given[axis], given[:, axis] = beside, beside
        given[axis, axis] = np.inf
        rest = np.ix_(*2 * [np.arange(axes) != axis])
        wanted[rest] = np.linalg.inv(covariance[rest])
        weight = constant_sums(np.zeros((1, axes)), given[None], np.zeros(1), np.zeros(1))[0][-1]
        assert_allclose(weight[:axes, :axes], wanted, atol=1e-12)


@pytest.mark.parametrize("axes", [2, 3])
def test_sums_of_a_constant_error_are_those_of_errors_in_both_frames(axes: int) -> None:
    rng = np.random.default_rng(2)
    error, heading_rad, time_s = rng.normal(size=(6, axes)), rng.uniform(-3, 3, 6), rng.uniform(0, 9, 6)
    factor = rng.normal(size=(6, axes, axes))
    covariance = factor @ factor.swapaxes(1, 2) + 0.1 * np.eye(axes)
    for headings, found in zip(
        (np.zeros(6), heading_rad), constant_sums(error, covariance, heading_rad, time_s), strict=True
    ):
        turn = np.tile(np.eye(axes), (6, 1, 1))
        turn[:, :2, :2] = np.moveaxis(
            [[np.cos(headings), np.sin(headings)], [-np.sin(headings), np.cos(headings)]], 2, 0
        )
        own = np.einsum("nij,nj->ni", turn, error)
        weight = turn @ np.linalg.inv(covariance) @ turn.swapaxes(1, 2)
        weighted = np.einsum("nij,nj->ni", weight, own)
        numbers = np.vdot(own, own), np.vdot(own, weighted), time_s.sum(), time_s @ time_s
        assert_allclose(found[0], numbers, rtol=1e-9)
        assert_allclose(found[1][:axes], own.sum(axis=0), rtol=1e-9)
        assert_allclose(found[2][:axes], weighted.sum(axis=0), rtol=1e-9)
        assert_allclose(found[3][:axes], time_s @ own, rtol=1e-9)
        assert_allclose(found[4][:axes, :axes], weight.sum(axis=0), rtol=1e-9)


def constant_sums(
    error: Floats, covariance: Floats, heading_rad: Floats, time_s: Floats
) -> list[tuple[Floats, ...]]:
    """The numbers and the sums of e, W e, t e and W in the fixed frame and in the body's frame."""
    numbers, frames = np.zeros(4), np.zeros((2, 15))
    place = np.arange(error.shape[1])
    turn = np.cos(heading_rad), np.sin(heading_rad)
    _add_sums(error, covariance, *turn, time_s, place, numbers, frames)
    places = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
    return [(numbers, *each[:9].reshape(3, 3), each[9:][places]) for each in frames]
