"""What a filter breaks ends its own run: the others are judged, and nothing is left running."""

import subprocess
import sys

import numpy as np
import psutil
import pytest

import fuselog as fl
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.foreign.processes.isolation import Ended, Workers
from tests.replay.foreign.conftest import MISBEHAVING, Compile

COMMANDS = (float(-each) for each in range(1, 10))
CRASH, LOOP, LEAK, PRINT, NOT_A_NUMBER, NEGATIVE, FAIL, LEAVE, UNDEFINED = COMMANDS
MESSAGES, AT = 600, 499
SANE = 1.0
LIMITS = {"time_limit_s": 2.0, "memory_limit_mb": 400}
# what is asked of a run at message 500, and the reason that is given
RUNS = {
    SANE: "",
    PRINT: "",
    CRASH: "the filter crashed (SIGSEGV) at message 500 (/range)",
    LOOP: "the filter took longer than 2 s (time_limit_s) at message 500 (/range)",
    LEAK: "the filter took more than 400 MB of memory (memory_limit_mb) at message 500 (/range)",
    LEAVE: "the filter ended with exit code 3 at message 500 (/range)",
    NOT_A_NUMBER: "the filter's estimate or covariance is not finite",
    NEGATIVE: "a variance of the filter's covariance is negative",
    FAIL: "it was told to fail",
    UNDEFINED: "returned a negative number that fuselog_filter.h does not define",
}


def run_with(command: float) -> MemorySource:
    """A run with a command among its ranges."""
    ranges = np.full(MESSAGES, SANE)
    ranges[AT] = command
    stamps_ns = np.arange(MESSAGES) * 1_000_000
    seen = make_stream("/range", schemas.RANGE, stamps_ns, target_id=np.ones(MESSAGES), range_m=ranges)
    return memory_source(Recording([seen]), RunMetadata("ranges", epoch_ns=0))


@pytest.mark.paper
@pytest.mark.unix
@pytest.mark.usefixtures("nothing_left")
def test_a_run_ends_with_its_filter_and_the_others_go_on(compile_filter: Compile) -> None:
    mine = {"kind": "lib", "path": str(compile_filter(MISBEHAVING)), **LIMITS}
    done = fl.replay([run_with(each) for each in RUNS], {"mine": mine})
    said = dict(zip(RUNS, done.estimates, strict=True))
    for command, reason in RUNS.items():
        failures = said[command]["/estimates/mine/failure"]
        told = [each for each in done.failures if reason and reason in each]
        assert len(failures) == bool(reason), reason
        assert len(told) == bool(reason), (reason, done.failures)
        assert failures.publish_time_ns.tolist() == [AT * 1_000_000] * bool(reason)
        estimates = said[command]["/estimates/mine/state"]
        assert len(estimates) == (AT if reason else MESSAGES)  # what it said before counts
    sane = said[SANE]["/estimates/mine/state"]
    np.testing.assert_allclose(sane["mean"][AT + 1 :], SANE, atol=1e-5)


def test_failures_in_this_process(compile_filter: Compile) -> None:
    """Those that leave the process as it is are told alike."""
    mine = {"kind": "lib", "path": str(compile_filter(MISBEHAVING)), "in_process": True}
    commands = [SANE, NOT_A_NUMBER, NEGATIVE, FAIL, UNDEFINED]
    done = fl.replay([run_with(each) for each in commands], {"mine": mine})
    for command, estimates in zip(commands, done.estimates, strict=True):
        assert len(estimates["/estimates/mine/failure"]) == bool(RUNS[command])
        assert sum(RUNS[command] in each for each in done.failures) == (1 if RUNS[command] else 4)


@pytest.mark.paper
@pytest.mark.unix
def test_a_program_ends_when_we_are_killed() -> None:
    """It reads nothing and listens to no signal; a program that it started ends with it."""
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
    starts = (
        "import subprocess, sys; "
        f"child = subprocess.Popen([sys.executable, '-c', {deaf!r}]); "
        f"print(child.pid, flush=True); {deaf}"
    )
    ours = (
        "import sys, time; from fuselog.replay.foreign.processes.isolation import Program; "
        f"program = Program([sys.executable, '-c', {starts!r}]); "
        "print(program.process.pid, int(program.process.stdout.readline()), flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", ours], stdout=subprocess.PIPE) as killed:
        assert killed.stdout is not None
        started = [psutil.Process(int(pid)) for pid in killed.stdout.readline().split()]
        assert [each.is_running() for each in started] == [True, True]
        killed.kill()
    gone, left = psutil.wait_procs(started, timeout=20.0)
    for each in left:
        each.kill()
    assert len(gone) == 2


def test_no_process_is_taken_out_once_they_were_ended() -> None:
    workers = Workers()
    workers.end()
    with pytest.raises(Ended, match="was stopped"), workers.one():
        pass
