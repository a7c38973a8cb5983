"""The command in a shell: names are completed as the README says; progress is for who watches."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from click.shell_completion import BashComplete

from fuselog.pipeline.command_line import fuselog
from fuselog.pipeline.output import terminal
from tests.pipeline.conftest import Said

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash to complete in")
@pytest.mark.paper
def test_the_readmes_line_completes_commands_options_names_and_settings() -> None:
    """What bash offers after what was typed so far, once the line has been run.

    It asks a process each time, so most is asked of the class that answers in it.
    """
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^eval .*_FUSELOG_COMPLETE=bash_source.*$", page, re.MULTILINE)
    complete = BashComplete(fuselog, {}, "fuselog", "_FUSELOG_COMPLETE")
    for words, expected in {
        "re": {"record", "replay", "report"},
        "record landm": {"landmarks", "landmarks-adverse"},
        "replay run.mcap -e vehicle": {"vehicles", "vehicle-kalman", "vehicle-particles"},
        "record landmarks --set dur": {"duration_s"},
    }.items():
        *given, begun = words.split()
        assert expected <= {each.value for each in complete.get_completions(given, begun)}, words
    offered = {
        "fuselog cache --": {"--clear"},
        "fuselog replay run.mcap -e ekf --set ekf.sigma_ra": {"ekf.sigma_range_m"},
    }
    asked = "".join(
        f"COMP_WORDS=({words}); COMP_CWORD={len(words.split()) - 1}; COMPREPLY=()\n"
        '_fuselog_completion fuselog\necho "${COMPREPLY[*]}"\n'
        for words in offered
    )
    environment = {**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", f"{line}\n{asked}"], env=environment, capture_output=True, text=True
    )
    for expected, told in zip(offered.values(), done.stdout.splitlines(), strict=True):
        assert expected <= {*told.split()}, done


@pytest.mark.paper
def test_nothing_is_said_of_progress_where_nobody_watches(
    world: Path, tmp_path: Path, start_fuselog: Callable[..., Any]
) -> None:
    """Of kernels that are compiled neither: with --json the output is one document and nothing else."""
    fresh = {**os.environ, "FUSELOG_CACHE": str(tmp_path / "cache"), "NUMBA_DISABLE_JIT": "1"}
    replay = ("replay", str(world / "log.mcap"), "-e", "ekf", "--json", "-o", str(tmp_path / "est.mcap"))
    process = start_fuselog(*replay, env=fresh)
    out, err = process.communicate()
    assert err == ""
    assert "ekf.position_rmse_m.robot1" in json.loads(out)["metrics"]
    assert list((tmp_path / "cache").rglob("*.bin"))


@pytest.mark.paper
@pytest.mark.unix
def test_progress_is_shown_in_a_terminal(
    world: Path, tmp_path: Path, start_fuselog: Callable[..., Any]
) -> None:
    import pty

    ours, theirs = pty.openpty()
    with os.fdopen(ours, "rb", 0) as watched:
        replay = ("replay", str(world / "log.mcap"), "-e", "ekf", "--json", "-o", f"{tmp_path}/est.mcap")
        process = start_fuselog(*replay, stderr=theirs)
        os.close(theirs)
        shown = b""
        with suppress(OSError):  # Linux has no other end of a pseudo-terminal
            while part := watched.read(4096):
                shown += part
        out, _ = process.communicate()
    assert b"replaying" in shown
    assert "ekf.position_rmse_m.robot1" in json.loads(out)["metrics"]


def test_who_is_no_terminal_has_a_line_a_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the loops are that share the minute; nothing in the first one."""
    now_s = 100.0
    monkeypatch.setattr(terminal, "monotonic", lambda: now_s)
    monkeypatch.setattr(terminal, "once_a_minute", terminal.OnceAMinute())
    for _ in terminal.progress(range(5), "replaying", 5):
        now_s += 25.0
    with terminal.status() as show:
        for number in range(3):
            show(f"{number} evaluations")
            now_s += 25.0
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "fuselog: replaying: 3 of 5\nfuselog: 1 evaluations\n"


@pytest.mark.parametrize("count", [terminal.MOST_CASES, 142])
def test_many_cases_are_one_table(count: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Medians with the least and the greatest; a number that is missing is none of these."""
    metrics: dict[str, Any] = {f"ekf.rmse_m.trial{each}": float(each) for each in range(count)}
    metrics |= {"ukf.rmse_m.trial0": None, "ekf.rmse_m": 0.5, "ekf.by_noise.trial1": [1.0, 2.0]}
    terminal.print_metrics(metrics, {}, details="summary.csv")
    said = capsys.readouterr().out
    assert "0.5" in said
    if count == 142:
        assert "142 cases: median" in said
        assert re.search(r"rmse_m +70\.5 \(0 to 141\)", said)
        assert "each of the 142 cases separately: summary.csv" in said
        assert said.count("rmse_m") == 2
    else:
        assert said.count("rmse_m") == 1 + count
        assert "median" not in said


@pytest.mark.unix
def test_a_file_s_name_forges_no_line(
    world: Path, tmp_path: Path, fuselog: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of what a command says when all went well."""
    monkeypatch.chdir(tmp_path)
    name = "a\nfuselog: all is well\x1b[2J.mcap"
    shutil.copy(world / "log.mcap", name)
    for arguments in (
        ("cut", name, "--end", "1", "-o", f"cut {name}"),
        ("record", "landmarks", "--set", "duration_s=1", "-o", f"new {name}"),
        ("replay", name, "-e", "dead-reckoning", "-o", f"est {name}"),
        ("info", name),
        ("export", name, "--to", "csv", "--topic", "/robot1/odometry", "-o", f"{name}.csv"),
        ("report", name),
        ("replay", f"missing {name}", "-e", "ekf"),
    ):
        said = fuselog(*arguments)
        lines = (said.out + said.err).splitlines()
        assert not any(line.startswith("fuselog: all is well") for line in lines), arguments
        assert "\x1b" not in said.out + said.err


def test_of_very_many_names_some_are_said(tmp_path: Path, fuselog: Callable[..., Said]) -> None:
    table, mapping = tmp_path / "wide.csv", tmp_path / "map.toml"
    names = [f"c{number}" for number in range(9_000)]
    table.write_text("\n".join([",".join(names), ",".join("1" * len(names))]))
    mapping.write_text(
        '[[tables]]\ntime = { column = "time", unit = "s" }\n[[tables.streams]]\ntopic = "/x"\n'
        'becomes = "Odometry"\nfields = { forward_mps = "c1", turn_radps = "c2" }\n'
    )
    said = fuselog("import", "table", table, "--mapping", mapping, "-o", tmp_path / "new.mcap")
    assert said.code == 2
    assert said.err.endswith("and 8950 more\n")
    assert len(said.err) < 1000
