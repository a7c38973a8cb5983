"""Logs cut, merged and relabelled: what stays is the same, and what refers to it follows."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from numpy.testing import assert_array_equal

import fuselog as fl
from fuselog.pipeline.logs import rewriting
from fuselog.recorders.log import LogWriter, read_span

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
ODOMETRY, RANGES, TRUTH = "/robot1/odometry", "/robot1/range_bearing", "/robot1/truth"
PRIOR, LANDMARKS = "/robot1/prior", "/landmarks"
ESTIMATE = "/estimates/ekf/robot1/pose"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of few messages, so that every log has many."""
    monkeypatch.chdir(tmp_path)
    read = rewriting.read_blocks
    monkeypatch.setattr(rewriting, "read_blocks", lambda *a, **b: read(*a, **b, block_messages=20))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log whose chunks hold few messages, and whose epoch is not its first stamp."""
    recording = fl.record("landmarks", seed=3, duration_s=4.0)
    with LogWriter(tmp_path / "run.mcap", recording.run, chunk_bytes=1 << 11) as writer:
        writer.write(recording.streams.values())
    return Path("run.mcap")


def assert_same(found: fl.Stream, expected: fl.Stream) -> None:
    """Clocks, columns and metadata, bit for bit."""
    assert_array_equal(found.publish_time_ns, expected.publish_time_ns)
    assert_array_equal(found.log_time_ns, expected.log_time_ns)
    for name, column in expected.columns.items():
        assert_array_equal(found[name], column)
    assert dict(found.metadata) == dict(expected.metadata)


def test_a_span_keeps_what_was_said_once(log: Path, fuselog: Fuselog) -> None:
    """Replayed from the same time, the part gives what the whole log gives there."""
    said = fuselog("cut", log, "--start", "1", "--end", "3", "-o", "part.mcap")
    assert said.code == 0
    assert f"copied completely, regardless of the span: {LANDMARKS}, {PRIOR}\n" in said.err
    assert "--start 1 --start-from truth" in said.err
    whole, part = fl.open(log), fl.open("part.mcap")
    assert part.run is not None
    assert whole.run is not None
    notes = {"changes": "cut run.mcap from 1 s to 3 s", "changed by": "cut"}
    assert part.run == replace(whole.run, notes=notes)
    for topic, stream in whole.items():
        seconds = (stream.publish_time_ns - whole.epoch_ns) * 1e-9
        stays = (seconds >= 1) & (seconds < 3) | (topic in (LANDMARKS, PRIOR))
        assert_same(part[topic], stream.take(stays))
    assert fuselog("record", "landmarks", "-o", "part.mcap").code == 2  # it is no recording any more
    span = {"start_s": 1.0, "end_s": 3.0, "start_from": "truth"}
    of_whole, of_part = (fl.replay(path, "ekf", **span) for path in (log, "part.mcap"))
    assert_same(of_part.estimates[0][ESTIMATE], of_whole.estimates[0][ESTIMATE])


def test_nothing_cut_is_a_copy(log: Path) -> None:
    """The order of equal stamps of several topics stays too: estimates are equal bit for bit."""
    done = fl.cut(log, "copy.mcap")
    assert done.notes == []
    assert done.messages == {topic: each.messages for topic, each in fl.open(log).topics.items()}
    first, second = (fl.replay(path, "ekf") for path in (log, "copy.mcap"))
    assert_same(second.estimates[0][ESTIMATE], first.estimates[0][ESTIMATE])


def test_topics_and_decimation(log: Path, fuselog: Fuselog) -> None:
    """Whole stamps stay, counted on over the blocks; a rate is kept against the run's time zero."""
    arguments = ["--topics", "/robot1/*", "--decimate", "*/odometry=5", "--decimate", f"{TRUTH}=2Hz"]
    assert fuselog("cut", log, *arguments, "--decimate", f"{RANGES}=3", "-o", "few.mcap").code == 0
    whole, few = fl.open(log), fl.open("few.mcap")
    assert list(few) == [ODOMETRY, PRIOR, RANGES, TRUTH]
    assert_same(few[ODOMETRY], whole[ODOMETRY].take(slice(0, None, 5)))
    stamps = np.unique(whole[RANGES].publish_time_ns)
    assert len(stamps) < len(whole[RANGES])  # several landmarks are seen at once
    assert_same(few[RANGES], whole[RANGES].take(np.isin(whole[RANGES].publish_time_ns, stamps[::3])))
    assert_array_equal(np.diff(few[TRUTH].publish_time_ns), 500_000_000)
    assert few.run is not None
    assert f"decimated */odometry=5 {TRUTH}=2Hz {RANGES}=3" in few.run.notes["changes"]


def test_estimates_are_cut_and_still_find_their_log(log: Path, fuselog: Fuselog) -> None:
    """The place of the log is told from where the part lies."""
    assert fuselog("replay", log, "-e", "ekf").code == 0
    done = fl.cut("run.estimates.mcap", "parts/late.mcap", start_s=2, topics=["/estimates/*"])
    assert 0 < done.messages[ESTIMATE] < fl.open("run.estimates.mcap").topics[ESTIMATE].messages
    found = fuselog("evaluate", "parts/late.mcap", "--json")
    assert found.code == 0, found.err
    assert "ekf.position_rmse_m.robot1" in found.json["metrics"]


def test_logs_are_merged_by_their_offsets(log: Path, fuselog: Fuselog) -> None:
    """Two computers, one two seconds behind: the merged log replays as the log that was parted."""
    whole = fl.open(log)
    fl.cut(log, "robot.mcap", topics=[ODOMETRY, PRIOR, TRUTH])
    fl.cut(log, "camera.mcap", topics=[RANGES, LANDMARKS])
    assert fuselog("merge", "robot.mcap", "camera.mcap", "-o", "again.mcap").code == 0
    again = fl.open("again.mcap")
    assert again.run is not None
    assert whole.run is not None
    assert replace(again.run, notes={}) == replace(whole.run, notes={})
    done = "cut run.mcap topics /robot1/range_bearing /landmarks"
    assert again.run.notes["changes (camera.mcap)"] == done
    assert again.run.notes["changes"].endswith("; merged robot.mcap, camera.mcap")
    assert set(again) == set(whole)
    for topic, stream in whole.items():
        assert_same(again[topic], stream)

    camera = fl.open("camera.mcap")
    outage = fl.make_stream("/outage", fl.schemas.OUTAGE, [7_000_000_000], end_time_ns=[8_000_000_000])
    fl.write("behind.mcap", [camera[RANGES], outage])
    said = fuselog("merge", "robot.mcap", "behind.mcap", "--offset", "behind.mcap=2", "-o", "both.mcap")
    assert said.code == 0, said.err
    both = fl.open("both.mcap")
    assert_array_equal(both[RANGES].publish_time_ns, whole[RANGES].publish_time_ns + 2_000_000_000)
    assert_array_equal(both[RANGES].log_time_ns, whole[RANGES].log_time_ns + 2_000_000_000)
    assert_array_equal(both[RANGES]["sensor_time_ns"], whole[RANGES]["sensor_time_ns"])
    assert both["/outage"]["end_time_ns"] == both["/outage"].publish_time_ns + 1_000_000_000
    assert both.run is not None
    assert (both.run.seed, both.epoch_ns) == (None, whole.epoch_ns)
    assert both.run.notes["changes"].endswith("merged robot.mcap, behind.mcap +2 s")
    fl.write("early.mcap", [outage])
    with pytest.raises(fl.BadInput, match=r"early.mcap: an offset of -8 s .* years 1970 to 2262"):
        fl.merge(["robot.mcap", "early.mcap"], "none.mcap", offsets_s={"early.mcap": -8})
    assert not Path("none.mcap").exists()


def test_references_follow_new_names(log: Path, fuselog: Fuselog) -> None:
    """The truth that estimates name, here and in their own log; components of all streams."""
    before = fl.replay(log, "ekf").metrics["value"].to_numpy()
    assert fuselog("replay", log, "-e", "ekf").code == 0
    for name in ("run", "run.estimates"):
        topics = ["--topic", f"{TRUTH}=/mocap/pose"]
        said = fuselog("relabel", f"{name}.mcap", *topics, "-o", f"new/{name}.mcap")
        assert said.code == 0, said.err
    assert fl.open("new/run.estimates.mcap")[ESTIMATE].metadata["truth"] == "/mocap/pose"
    found = fuselog("evaluate", "new/run.estimates.mcap", "--log", "new/run.mcap", "--json")
    assert found.code == 0, found.err
    assert_array_equal(found.json["metrics"]["ekf.position_rmse_m.robot1"], before[0])

    done = fl.relabel(
        log, "b.mcap", topics={"/robot1/": "/b/", LANDMARKS: "/map"}, components={"x_m": "e_m"}
    )
    assert set(done.messages) == {"/b/odometry", "/b/prior", "/b/range_bearing", "/b/truth", "/map"}
    renamed = fl.open("b.mcap")
    for topic in ("/b/prior", "/b/truth"):
        assert renamed[topic].components == ["e_m", "y_m", "heading_rad"]
    assert_array_equal(renamed["/b/truth"]["state"], fl.open(log)[TRUTH]["state"])
    assert len(fl.merge([log, "b.mcap"], "pair.mcap").messages) == 10


def test_what_is_no_column_is_counted_and_said(log: Path, fuselog: Fuselog) -> None:
    """A topic of texts beside one of numbers; asked for alone, it is refused."""
    stream = fl.open(log)[ODOMETRY]
    with Path("foreign.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = stream.schema
        number = writer.register_schema(schema.full_name, "protobuf", schema.descriptor_set)
        columns = writer.register_channel("/odometry", "protobuf", number)
        texts = writer.register_channel("/texts", "json", 0)
        for time_ns, forward in zip(stream.publish_time_ns.tolist(), stream["forward_mps"], strict=True):
            values = {"sensor_time_ns": time_ns, "forward_mps": forward, "turn_radps": 0.0}
            message = schema.message_class(**values).SerializeToString()
            writer.add_message(columns, time_ns, message, time_ns)
            writer.add_message(texts, time_ns, b"{}", time_ns)
        writer.add_metadata("vendor", {"firmware": "7"})
        writer.add_attachment(0, 0, "camera.yaml", "text/plain", b"focal length")
        writer.finish()
    said = fuselog("cut", "foreign.mcap", "--start", "1", "-o", "part.mcap")
    assert said.code == 0, said.err
    assert "metadata of other programs is not copied: vendor" in said.err
    assert "attachments, which fuselog does not read, are not copied: 1 (camera.yaml)" in said.err
    assert "topic /texts is without a schema" in said.err
    assert f"its {len(stream)} messages are not copied" in said.err
    part, whole = fl.open("part.mcap"), fl.open("foreign.mcap")
    assert part.epoch_ns == whole.epoch_ns == read_span(whole.log, "publish_time")[0]
    assert part["/odometry"].publish_time_ns[0] == whole.epoch_ns + 1_000_000_000
    refused = fuselog("cut", "foreign.mcap", "--topics", "/texts", "-o", "texts.mcap")
    assert refused.code == 2
    assert not Path("texts.mcap").exists()


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
def test_a_body_that_stands_does_not_drift(tmp_path: Path, fuselog: Fuselog) -> None:
    """A person waits for 10 s without fixes: the unit knows, and where they walk it says nothing."""
    unit, gnss = {"rate_hz": 10.0}, {"outages_s": [[5.0, 14.9]], "rate_hz": 1.0, "velocity_rate_hz": 1.0}
    person = {"carrier": "pedestrian", "speed_mps": 1.4, "rest_s": 15.0, "duration_s": 20.0}
    recording = fl.record("navigation", seed=2, unit=unit, gnss=gnss, **person)
    fl.write(tmp_path / "walk.mcap", recording)
    said = fuselog("constrain", "walk.mcap", "-o", "known.mcap", "--set", "rolling_hz=2")
    assert said.code == 0
    assert "/body/rolling: true at 41 of 41 stamps" in said.err
    known = fl.open("known.mcap")
    assert known.run is not None
    assert known.run.notes["changes"].endswith("by /body/inertial: /body/standing /body/rolling")
    standing = known["/body/standing"]
    since_s = (standing.publish_time_ns - known.epoch_ns) * 1e-9
    stands = standing["value"][:, 0] == 1.0
    assert stands[(since_s > 1.0) & (since_s < 15.0)].all()
    assert not stands[since_s > 17.0].any()
    drift = {}
    for path in ("walk.mcap", "known.mcap"):
        replayed = fl.replay(path, {"ekf": {"topics": {"rolling": ""}, "every_s": 1.0}})
        states = replayed.estimates[0]["/estimates/ekf/body/state"]
        waiting_s = (states.publish_time_ns - known.epoch_ns) * 1e-9
        inside = states["mean"][(waiting_s > 5.5) & (waiting_s < 14.5)]
        drift[path] = np.hypot(*(inside[-1] - inside[0])[:2])
    assert drift["known.mcap"] < 0.02
    assert drift["walk.mcap"] > 10.0 * drift["known.mcap"]


def test_a_log_without_a_unit_or_with_several_is_refused(tmp_path: Path, log: Path) -> None:
    with pytest.raises(fl.BadInput, match="has no inertial unit"):
        fl.constrain(log, "out.mcap")
    drive = fl.record("navigation", seed=2, duration_s=12.0)
    fl.write(tmp_path / "one.mcap", drive)
    fl.relabel("one.mcap", "two.mcap", topics={"/body/": "/other/"})
    fl.merge(["one.mcap", "two.mcap"], "both.mcap")
    with pytest.raises(fl.BadInput, match=r"choose one with --unit: /body/inertial, /other/inertial"):
        fl.constrain("both.mcap", "out.mcap")
    fl.constrain("both.mcap", "out.mcap", unit="/other/inertial")
    with pytest.raises(fl.BadInput, match=r"out.mcap: already has a topic /other/standing"):
        fl.constrain("out.mcap", "again.mcap", unit="/other/inertial")
    with pytest.raises(fl.BadInput, match="standing_hz and rolling_hz are both zero"):
        fl.constrain("one.mcap", "none.mcap", settings={"standing_hz": 0.0})
    assert not Path("none.mcap").exists()
