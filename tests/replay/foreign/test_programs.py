"""Programs as filters: those that stream, and those that read a log and write estimates."""

import re
import sys
import time
from dataclasses import replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from threadpoolctl import threadpool_limits

import fuselog as fl
from fuselog import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, schemas, write_log
from fuselog.recorders.log.opening import Topic
from fuselog.recorders.processes import limit_libraries, safe_spawning
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.foreign.description import TopicRead
from fuselog.replay.foreign.naming import Allowed
from fuselog.replay.foreign.processes.isolation import Program
from fuselog.replay.foreign.programs import read_estimates
from tests.replay.foreign.conftest import EXAMPLES
from tests.replay.foreign.test_isolation import AT, MESSAGES, SANE, run_with

HALF, PRINT, LEAVE, OTHER_SIZE, MUTE, FAIL, TWICE, SKIP, STATUS, FLAG = range(-1, -11, -1)
PROGRAM = Path(__file__).with_name("program.py")  # which has the same commands
RUNS = {
    SANE: "",
    HALF: "the filter ended within a frame at message 500 (/range)",
    PRINT: "the filter wrote 'hello from the filter' to standard output, which is not a frame, at",
    LEAVE: "the filter ended with exit code 1: no more at message 500 (/range)",
    OTHER_SIZE: "sent a reply of 18 bytes with flags 1 instead of 26 bytes at message 500",
    MUTE: "the filter took longer than 3 s (time_limit_s) at message 500 (/range)",
    FAIL: "it was told to fail",
    TWICE: "answered frame 500 instead of 501",
    SKIP: "answered frame 501 instead of 500",
    STATUS: "answered with status -1 and flags 1, which this protocol does not define",
    FLAG: "answered with status 0 and flags 9, which this protocol does not define",
}


def program(command: str, **settings: Any) -> dict[str, Any]:
    return {"kind": "exec", "command": Allowed(command), **settings}


def python(path: Path, *arguments: str) -> str:
    return " ".join([f"'{sys.executable}'", f"'{path}'", *arguments])


@pytest.mark.paper
@pytest.mark.usefixtures("nothing_left")
def test_programs_that_fail_end_their_own_runs() -> None:
    mine = program(python(PROGRAM), time_limit_s=3.0)
    done = fl.replay([run_with(float(each)) for each in RUNS], {"mine": mine})
    for (command, reason), estimates in zip(RUNS.items(), done.estimates, strict=True):
        assert sum(reason in each for each in done.failures) == (1 if reason else len(RUNS) - 1), reason
        assert len(estimates["/estimates/mine/failure"]) == bool(reason)
        states = AT + (command == TWICE) if reason else MESSAGES
        assert len(estimates["/estimates/mine/state"]) == states, command


def test_an_answer_too_many_at_the_end_is_an_error() -> None:
    """The last message is answered twice: nothing comes after it that could be out of step."""
    log = run_with(float(TWICE))
    whole = {topic: stream.take(slice(0, AT + 1)) for topic, stream in log.streams.items()}
    done = fl.replay(
        memory_source(Recording(list(whole.values())), log.run), {"mine": program(python(PROGRAM))}
    )
    assert ["one answer too many" in each for each in done.failures] == [True]


def test_nobody_waits_for_what_a_program_leaves_behind(tmp_path: Path) -> None:
    """A child that it started holds its output open, after the program has ended."""
    leaving = tmp_path / "leaving.py"
    child = "import subprocess\nsubprocess.Popen(['sleep', '20'])\n"
    leaving.write_text(PROGRAM.read_text() + child)
    began = time.monotonic()
    done = fl.replay(run_with(SANE), {"mine": program(python(leaving))})
    assert not done.failures
    assert time.monotonic() - began < 15.0


@pytest.mark.usefixtures("nothing_left")
def test_a_program_that_does_not_describe_itself_as_this_version_is_refused(tmp_path: Path) -> None:
    old = tmp_path / "old.py"
    old.write_text(PROGRAM.read_text().replace('"protocol": 2,', ""))
    with pytest.raises(
        BadInput, match=r'states protocol 1, but this version uses 2: add "protocol": 2 to it, and'
    ):
        fl.replay(run_with(SANE), {"mine": program(python(old))})
    silent = tmp_path / "silent.py"
    silent.write_text("import time; time.sleep(600)")
    mine = program(python(silent), time_limit_s=0.5)
    with pytest.raises(BadInput, match=r"took longer than 0\.5 s \(time_limit_s\) before it sent its"):
        fl.replay(run_with(SANE), {"mine": mine})


def test_a_program_cannot_go_back() -> None:
    with pytest.raises(
        BadInput, match=r"a program cannot be copied.*give --late drop or --late wait:SEC"
    ):
        fl.replay(
            run_with(SANE), {"mine": program(python(PROGRAM))}, arrival_order=True, late="rewind:1"
        )


@pytest.mark.paper
def test_filterpy_as_a_program() -> None:
    """Its own numbers, and those of our filter of the same model; so the verdicts are alike."""
    filterpy = pytest.importorskip("filterpy.kalman", reason="FilterPy is not installed")
    log = fl.record("vehicles", seed=2, duration_s=20.0, vehicles=1)
    settings = {"model": "vehicle", "turn_rate_radps": 0.0, "acceleration_sigma_mps2": 0.5}
    given = {"ekf": settings, "walker": program(python(EXAMPLES / "walker.py"))}
    done = fl.replay(log, given)
    made = done.estimates[0]
    [ekf, walker] = (made[f"/estimates/{label}/vehicle1/state"] for label in given)
    np.testing.assert_array_equal(ekf.publish_time_ns, walker.publish_time_ns)
    own = filterpy.KalmanFilter(dim_x=4, dim_z=2)
    prior, fixes = log["/vehicle1/prior"], log["/vehicle1/fix"]
    own.x, own.P = prior["mean"][0], prior["covariance"][0].reshape(4, 4)
    own.H = np.eye(4)[[0, 2]]
    time_ns, means = prior.publish_time_ns[0], []
    for row, stamp_ns in enumerate(fixes.publish_time_ns):
        if (s := (stamp_ns - time_ns) * 1e-9) > 0.0:
            noise = np.kron(np.eye(2), [[s**4 / 4, s**3 / 2], [s**3 / 2, s**2]]) * 0.25
            own.predict(F=np.kron(np.eye(2), [[1.0, s], [0.0, 1.0]]), Q=noise)
        own.update(fixes["position_m"][row], R=fixes["covariance_m2"][row].reshape(2, 2))
        means.append(own.x.copy())
        time_ns = stamp_ns
    size = np.abs(means).max()
    np.testing.assert_allclose(walker["mean"], means, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(walker["mean"], ekf["mean"], rtol=0, atol=1e-12 * size)
    nis = [
        made[f"/estimates/{label}/vehicle1/innovation"]["normalised_innovation_squared"]
        for label in given
    ]
    np.testing.assert_allclose(*nis, rtol=1e-9)
    judged = done.metrics.set_index(["quantity", "case"])
    ours, theirs = (judged[judged["estimator"] == label].drop(columns="estimator") for label in given)
    assert len(theirs) > 10
    pd.testing.assert_frame_equal(theirs, ours.loc[theirs.index], rtol=1e-9)


WRITES = """
import json, sys
from pathlib import Path

log, out, how, sigma = sys.argv[1:]
if how == "fail":
    sys.exit("no such road")
if how == "table":
    Path(out).write_text("time_ns,z_m\\n0,1\\n")
if how == "gap":
    Path(out).write_text("time_ns,x_m\\n0,1\\n1,\\n2,nan\\n")
if how in ("table", "gap", "nothing"):
    sys.exit()

import numpy as np
from mcap.reader import make_reader

if Path(log).is_dir():
    topics = {path.name for path in Path(log).iterdir()}
    assert "robot1-odometry.csv" in topics and not any("truth" in each for each in topics)
    rows = np.genfromtxt(Path(log) / "robot1-odometry.csv", delimiter=",", names=True, dtype=None)
    stamps = rows["time_ns"]
else:
    with open(log, "rb") as file:
        found = [m.publish_time for _, c, m in make_reader(file).iter_messages(["/robot1/odometry"])]
    stamps = np.array(found)
variance = float(sigma) ** 2
if how == "csv":
    names = "time_ns,x_m,y_m,heading_rad,cov_x_m_x_m,cov_y_m_y_m,cov_heading_rad_heading_rad,cov_x_m_y_m"
    lines = [f"{t},{k},0,3.0,{variance},{variance},0.01,0.0" for k, t in enumerate(stamps)]
    Path(out).write_text("\\n".join([names, *lines]))
elif how == "tum":
    lines = [f"{t // 10**9}.{t % 10**9:09d} {k} 0 0 0 0 0 1" for k, t in enumerate(stamps)]
    Path(out).write_text("\\n".join(lines))
"""


@pytest.mark.paper
@pytest.mark.parametrize(("place", "how"), [("{log}", "csv"), ("{csv}", "tum")])
def test_a_program_that_reads_a_log(tmp_path: Path, place: str, how: str) -> None:
    """It gets the log without truth, and parameters; what it writes is judged run by run."""
    script = tmp_path / "writes.py"
    script.write_text(WRITES)
    mine = program(python(script, place, "{out}", how, "{sigma_m=0.5}"), sigma_m=0.25)
    logs = [fl.record("landmarks", seed=1, run=run, duration_s=2.0) for run in range(2)]
    done = fl.replay(logs, {"writes": mine})
    for log, estimates in zip(logs, done.estimates, strict=True):
        made = estimates["/estimates/writes/robot1/state"]
        np.testing.assert_array_equal(made.publish_time_ns, log["/robot1/odometry"].publish_time_ns)
        np.testing.assert_array_equal(made["mean"][:, 0], np.arange(len(made)))
        assert made["covariance"][0, 0] == (0.0625 if how == "csv" else 0.0)
    assert done.metrics["quantity"].isin(["nees"]).any() == (how == "csv")
    assert done.done.parameters["writes"]["sigma_m"] == 0.25


def test_what_holds_for_a_whole_run_is_read_whatever_the_span() -> None:
    """Priors and maps, of landmarks or of the points of a body; never the truth or others' estimates."""
    kinds = {
        "/landmarks": schemas.LANDMARK,
        "/tags": schemas.BODY_POINT,
        "/a/prior": schemas.GAUSSIAN_ESTIMATE,
        "/a/fix": schemas.POSITION_FIX,
        "/a/priority": schemas.GAUSSIAN_ESTIMATE,
        "/a/truth": schemas.TRUTH_STATE,
        "/estimates/b/state": schemas.GAUSSIAN_ESTIMATE,
    }
    topics = {name: Topic(name, kind.full_name, "protobuf", (), {}, 1) for name, kind in kinds.items()}
    topics["/other"] = replace(topics["/a/fix"], name="/other", encoding="json")
    estimator, values = configure("mine", program("x {log} {out}"))
    [bound] = estimator.bind("mine", topics, values)
    assert bound.static == ("/landmarks", "/tags", "/a/prior")
    assert bound.streams == ("/a/fix", "/a/priority")


def test_of_two_truths_one_is_named() -> None:
    kinds = {"/a/truth": schemas.TRUTH_STATE, "/b/truth": schemas.TRUTH_STATE, "/fix": schemas.RANGE}
    topics = {name: Topic(name, kind.full_name, "protobuf", (), {}, 1) for name, kind in kinds.items()}
    for named, sentence in (
        ("", "the log has the truths /a/truth, /b/truth; choose one with --set mine.truth=..."),
        ("/c/truth", "truth = /c/truth: the log has no such truth"),
        ("/b/truth", ""),
    ):
        estimator, values = configure("mine", program("x {log} {out}", truth=named))
        if sentence:
            with pytest.raises(BadInput, match=re.escape(sentence)):
                estimator.bind("mine", topics, values)
        else:
            assert len(estimator.bind("mine", topics, values)) == 1


def test_a_program_that_writes_mcap(tmp_path: Path) -> None:
    """Its estimates and innovations, with their topics' ends, are judged like those that it wrote."""
    log, written = fl.record("landmarks", seed=1, duration_s=2.0), tmp_path / "written.mcap"
    first = fl.replay(log, "ekf")
    fl.write(
        written, [each for name, each in first.estimates[0].items() if name.startswith("/estimates/")]
    )
    copies = (
        f"'{sys.executable}' -c 'import shutil, sys; shutil.copy(*sys.argv[1:])' '{written}' {{out}}"
    )
    done = fl.replay(log, {"ekf": {}, "mine": program(copies)})
    judged = done.metrics.set_index("quantity")
    ours, theirs = (judged.loc[judged["estimator"] == label, "value"] for label in ("ekf", "mine"))
    assert {"nees", "log_likelihood", "position_rmse_m"} <= set(theirs.index)
    pd.testing.assert_series_equal(theirs, ours, rtol=1e-12)


@pytest.mark.paper
@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ("fail", "the program ended with exit code 1: no such road"),
        ("nothing", "the program wrote no estimates"),
        ("gap", r"no number in column x_m, row 2 \(2 such rows in total\); write a number, or leave"),
        ("table", "have a column z_m, which /robot1/truth does not have; it has x_m, y_m, heading_rad"),
    ],
)
def test_a_program_that_writes_no_estimates(tmp_path: Path, how: str, sentence: str) -> None:
    script = tmp_path / "writes.py"
    script.write_text(WRITES)
    log = fl.record("landmarks", duration_s=1.0)
    with pytest.raises(BadInput, match=sentence):
        fl.replay(log, {"mine": program(python(script, "{log}", "{out}", how, "1"))})


def _answer(letter: str) -> str:
    """A program that sends a frame of this letter and nothing else."""
    return f"'{sys.executable}' -c 'import os; os.write(1, bytes([1, 0, 0, 0, {ord(letter)}]))'"


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("./no_such_filter", "exec:./no_such_filter: cannot be started"),
        ("x {log} {out} {speed}", "{speed} in its command is not a placeholder"),
        ("x {log}", "a program that streams has no placeholders"),
        ("x 'open", "close the quotation mark"),
        (f"'{sys.executable}' -c 'print(12345)'", "wrote '12345' to standard output, which is not a"),
        *(
            (_answer(letter), f"sent a frame b'{letter}' instead of b'D'")
            for letter in "CE"  # either side of it
        ),
    ],
)
def test_commands_that_cannot_be_used(command: str, sentence: str) -> None:
    with pytest.raises(BadInput) as raised:
        fl.replay(fl.record("landmarks", duration_s=1.0), {"mine": program(command)})
    assert sentence in str(raised.value)


@pytest.mark.parametrize("field", ["", "[3]", "x[", "x[3", "x[a]", "x[-1]"])
def test_a_field_is_a_name_with_a_size_or_without(field: str) -> None:
    with pytest.raises(ValueError, match=r"is not a field; give its name, or name\[SIZE\] for a vector"):
        TopicRead(topic="/x", fields=("y", "z[3]", field))


def test_seconds_of_a_table_are_the_nearest_nanoseconds(tmp_path: Path) -> None:
    """Of a millisecond each, of which floats are now above and now below."""
    milliseconds = np.arange(2000)
    path = tmp_path / "estimates.csv"
    path.write_text("time_s,x_m\n" + "".join(f"{each / 1000},0\n" for each in milliseconds))
    truth = make_stream(
        "/truth",
        schemas.TRUTH_STATE,
        [0],
        metadata={"components": "x_m", "kinds": "linear"},
        state=[[0.0]],
    )
    topic = memory_source(Recording([truth]), RunMetadata("own", epoch_ns=0)).topics["/truth"]
    [read] = read_estimates(path, "mine", topic).values()
    np.testing.assert_array_equal(read.publish_time_ns, milliseconds * 10**6)


def test_a_tables_covariance_has_every_entry_in_its_place(tmp_path: Path) -> None:
    """Named in either order, of a state with an orientation, whose tangent space has three."""
    kinds = {
        "x_m": "linear",
        **{f"orientation_{each}": "quaternion" for each in "wxyz"},
        "v_mps": "linear",
    }
    stated = {"components": ",".join(kinds), "kinds": ",".join(kinds.values())}
    truth = make_stream("/truth", schemas.TRUTH_STATE, [0], metadata=stated, state=[[0, 1, 0, 0, 0, 0]])
    topic = memory_source(Recording([truth]), RunMetadata("own", epoch_ns=0)).topics["/truth"]
    names = [name for name, _ in tangent_components(list(kinds), list(kinds.values()))]
    root = np.random.default_rng(3).normal(size=(2, len(names), len(names)))
    covariance = root @ root.transpose(0, 2, 1)
    columns = {"time_ns": [7, 9], **{name: [0.5, 0.5] for name in kinds}}
    for i, j in combinations_with_replacement(range(len(names)), 2):
        of = names[i], names[j]
        columns["cov_" + "_".join(of if (i + j) % 2 else of[::-1])] = covariance[:, i, j]
    pd.DataFrame(columns).to_csv(tmp_path / "estimates.csv", index=False)
    [read] = read_estimates(tmp_path / "estimates.csv", "mine", topic).values()
    assert len(names) == 5
    np.testing.assert_allclose(read["covariance"].reshape(covariance.shape), covariance, rtol=1e-15)


def test_a_log_of_a_program_needs_estimates_and_nothing_else(tmp_path: Path) -> None:
    stamps = np.arange(3) * 10**9
    state = make_stream(
        "/state",
        schemas.GAUSSIAN_ESTIMATE,
        stamps,
        metadata={"components": "x_m", "kinds": "linear"},
        mean=np.zeros((3, 1)),
        covariance=np.ones((3, 1)),
    )
    other = make_stream("/fix", schemas.POSITION_FIX, stamps, position_m=np.zeros((3, 2)),
                        covariance_m2=np.ones((3, 4)))  # fmt: skip
    for streams, words in (([state, other], ""), ([other], "wrote a log without estimates")):
        write_log(tmp_path / "log.mcap", streams, RunMetadata("made"))
        if words:
            with pytest.raises(BadInput, match=words):
                read_estimates(tmp_path / "log.mcap", "own", None)
        else:
            found = read_estimates(tmp_path / "log.mcap", "own", None)
            assert [each.schema.name for each in found.values()] == ["GaussianEstimate"]


def test_a_program_has_the_environment_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though workers keep the current folder off the path of Python, and use one core."""
    monkeypatch.setattr("fuselog.recorders.processes._threads_of_user", {})
    for name in ("OPENBLAS", "BLIS", "OMP", "MKL"):
        monkeypatch.setenv(f"{name}_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS")
    says = (
        "import os; cores = [os.environ.get(f'{each}_NUM_THREADS') for each in ('OMP', 'MKL')]; "
        "raise SystemExit('PYTHONSAFEPATH' in os.environ or cores != ['3', None])"
    )
    with safe_spawning(), threadpool_limits(None):  # what is limited here is free again afterwards
        limit_libraries()
        started = Program([sys.executable, "-c", says])
        assert started.process.wait() == 0
    started.end()
