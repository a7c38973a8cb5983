"""What is kept of a long run for its timeline, and what a receiver sees while a replay goes on."""

import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun.chunk as rc
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from fuselog.pipeline.runs.ensemble import RunGroup, replay_parts
from fuselog.recorders.log import make_stream, open_log, schemas, write_log
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.judging.errors.evaluation import errors_at
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline import show
from fuselog.replay.timeline.drawing import thinning
from fuselog.replay.timeline.drawing.canvas import thin_curve
from fuselog.replay.timeline.drawing.thinning import thinned_stream
from fuselog.replay.timeline.show import Drawing
from fuselog.replay.timeline.sinks import open_recording
from fuselog.replay.timeline.viewer import listen
from tests.replay.timeline.making import of_both, record
from tests.replay.timeline.test_timeline import read


@given(
    st.lists(st.integers(0, 10**6), min_size=1, max_size=200)
    | st.lists(st.integers(0, 99).map(lambda n: 10_000 * n), min_size=1, max_size=200),
    st.lists(st.integers(0, 200), max_size=4),
)
@example([*range(0, 10**6, 10**4), *[10**6] * 3, 10**6 + 1, 10**6 + 2], [101])  # cut within a stamp
def test_what_is_kept_is_the_same_in_any_blocks(stamps: list[int], cuts: list[int]) -> None:
    """At most so many rows, whole stamps, the last one among them, though peaks lie where blocks end."""
    times = np.sort(stamps)
    value = np.sin(7919.0 * np.arange(len(times)))[:, None]
    value[[min(cut, len(times)) - 1 for cut in cuts if cut]] = 2.0
    stream = make_stream("/x", schemas.VECTOR_MEASUREMENT, times, value=value)
    whole, parts = thinned_stream("x", 20), thinned_stream("x", 20)
    whole.add(stream)
    for rows in np.split(np.arange(len(times)), sorted(min(cut, len(times)) for cut in cuts)):
        parts.add(stream.take(rows))
    for kept in (whole.rows, parts.rows):
        assert len(kept) <= max(40, np.unique(times, return_counts=True)[1].max())
        assert kept.publish_time_ns[-1] == times[-1]
        for stamp in np.unique(kept.publish_time_ns):
            assert np.sum(kept.publish_time_ns == stamp) == np.sum(times == stamp)
    if len(times) <= 40:
        assert_array_equal(whole.rows.publish_time_ns, times)


@pytest.mark.paper
@given(st.lists(st.integers(1, 5000), max_size=4), st.integers(1, 4999), st.integers(0, 5))
def test_peaks_stay_in_any_blocks(cuts: list[int], peak: int, missing: int) -> None:
    """The least and the greatest of each curve are kept, NaN beside them or not; nothing is made up."""
    times = np.arange(5000) * 10**6
    value = np.stack([np.sin(times * 1e-9), np.zeros(len(times))], axis=1)
    value[peak] += [7.0, -9.0]
    value[peak - missing : peak] = np.nan
    stream = make_stream("/x", schemas.SCORE_VECTOR, times, **_scores(value))
    kept = thinned_stream("x", 100)
    for rows in np.split(np.arange(len(times)), sorted(cuts)):
        kept.add(stream.take(rows))
    assert len(kept.rows) <= 200
    found = kept.rows["scores"]
    assert_array_equal(found, value[np.searchsorted(times, kept.rows.publish_time_ns)])
    assert np.nanmax(found[:, 0]) == np.nanmax(value[:, 0])
    assert np.nanmin(found[:, 1]) == -9.0


def _scores(value: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Columns of a schema whose numbers may be missing."""
    numbers = np.zeros(len(value), np.uint32)
    return {"probe_id": numbers, "gallery_id": numbers, "scores": value}


@given(st.integers(0, 2**32 - 1), st.integers(10, 60))
def test_a_curve_keeps_its_peaks(seed: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    times, values = np.sort(rng.integers(0, 10**6, 500)), rng.normal(size=500)
    values[rng.integers(0, 500, 100)] = np.nan
    kept = thin_curve(times, values, rows)
    assert len(kept) <= rows
    assert np.all(np.diff(kept) > 0)
    assert np.nanmin(values[kept]) == np.nanmin(values)
    assert np.nanmax(values[kept]) == np.nanmax(values)


@pytest.mark.parametrize("parts", [1, 3])
def test_a_receiver_gets_what_a_file_gets(
    parts: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once the same rows, those of sensors after the last estimate too; in parts the same plots."""
    source = record("landmarks", duration_s=4.0, robots=1, landmarks=3)
    made = of_both(source, "robot1", rows=slice(1, -20))
    judged = Judge([source], {}, gap_limit_s=2.0).add({each.topic: gather([each]) for each in made})
    log, live, whole = (tmp_path / name for name in ("log.mcap", "live.rrd", "whole.rrd"))
    write_log(log, source.streams.values(), source.run)

    def into_a_file(*names: str, save: Path | None = None, connect: str | None = None) -> Any:
        return open_recording(*names, save=save or live)

    monkeypatch.setattr(show, "open_recording", into_a_file)
    monkeypatch.setattr(show, "LIVE_MESSAGES", 10)
    monkeypatch.setattr(thinning, "BLOCK_MESSAGES", 10)
    with Drawing(LogSource(open_log(log)), identity="made", save=whole, connect="a receiver") as drawing:
        for stamps in np.array_split(made[0].publish_time_ns, parts):
            errors = [
                errors_at(each, np.isin(each.time_ns, stamps))
                for each in judged.errors
                if each is not None
            ]
            drawing.add(
                {each.topic: each.take(np.isin(each.publish_time_ns, stamps)) for each in made}, errors
            )
    found, wanted = read(live), read(whole)
    if parts == 1:
        assert found == wanted
        return
    assert set(found) == set(wanted)
    drawn = [name for name in wanted if name.startswith("/plots/") and not name.endswith("bounds")]
    assert len(drawn) >= 6
    assert {name: found[name] for name in drawn} == {name: wanted[name] for name in drawn}


@pytest.mark.paper
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_receiver_sees_estimates_before_the_replay_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log of several blocks: errors and their plots are there while blocks are still to come."""
    monkeypatch.setattr("fuselog.replay.timeline.show.LIVE_MESSAGES", 250)
    log, live = tmp_path / "log.mcap", tmp_path / "live.rrd"
    recording, run = record_run("landmarks", {"duration_s": 900.0}, 3, 0)
    write_log(log, recording.streams, run)
    plot, blocks = "/plots/robot1/nees_3/ekf", list[int]()  # rows drawn after each block

    def drawn(wanted: int) -> int:
        """Rows in the receiver's file once it has as many as wanted, or after two minutes."""
        end, rows = time.monotonic() + 120.0, 0
        while rows < wanted and time.monotonic() < end:
            with suppress(RuntimeError, FileNotFoundError):  # the receiver is still writing
                chunks = rc.RrdReader(str(live)).stream()
                rows = sum(each.num_rows for each in chunks if each.entity_path == plot)
            if rows < wanted:
                time.sleep(0.5)  # reading takes long
        return rows

    def watched(items: Iterable[Any], title: str, total: int | None) -> Iterator[Any]:
        for item in items:
            yield item
            blocks.append(drawn(1) if len(blocks) == 2 else 0)

    with listen(tmp_path, "--save", str(live)) as receiver:
        part = RunGroup([LogSource(open_log(log))])
        replay_parts(
            [part],
            {"ekf": {}},
            gap_limit_s=0.2,
            connect=receiver.url,
            block_messages=1500,
            progress=watched,
        )
        assert len(blocks) > 6
        assert 0 < blocks[2] < 15_000
        assert drawn(10_000) >= 10_000
