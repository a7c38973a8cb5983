"""What every command says of a fault that the log shows by itself: the same, in the same words."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.diagnosing import diagnosis
from fuselog.pipeline.diagnosing.battery.car import faulty, recorded
from fuselog.pipeline.diagnosing.causes import Sought
from tests.goldens import keeping

ODOMETRY, FIX = "/car/odometry", "/car/fix"
Change = Callable[[fl.Stream], fl.Stream]
Fuselog = Callable[..., Any]
pytestmark = pytest.mark.usefixtures("blank_figures")


def column(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda stream: replace(stream, columns={**stream.columns, name: change(stream[name])})


def rows(taken: Callable[[int], np.ndarray]) -> Change:
    return lambda stream: stream.take(taken(len(stream)))


def clipped(values: np.ndarray) -> np.ndarray:
    """Both ends, as of a gyroscope with too small a range."""
    return np.clip(values, *np.quantile(values, [0.1, 0.9]))


# Of values, losses, stamps, factors and delays, which a diagnosis treats in different ways, one each.
# What is planted: into which topic, how, or by which fault of the car; and what is to be told.
PLANTED: dict[str, tuple[str, Change | str, str, str]] = {
    "clipped": (ODOMETRY, column("turn_radps", clipped), "values", "turn_radps is saturated"),
    "lost": (
        ODOMETRY,
        rows(lambda n: np.flatnonzero(np.random.default_rng(1).random(n) > 0.2)),
        "lost messages",
        "loses 19 % of its messages",
    ),
    "repeated": (FIX, rows(lambda n: np.sort([*range(n), 40, 90])), "stamps", "are duplicates"),
    "a sign": (ODOMETRY, "turn rate's sign", "sign", "turn_radps has the wrong sign"),
    "a delay": (FIX, "fixes 18 s late", "delay", "its stamps are 18 s late"),
}
ON_A_PAGE = "clipped", "lost", "a sign"  # the page does not depend on what is told


def planted(name: str) -> fl.MemorySource:
    """A car's log with a fault."""
    topic, fault, *_ = PLANTED[name]
    log = recorded(faulty(2003, fault if isinstance(fault, str) else "nothing"), has_prior=True)
    made = log.streams[topic] if isinstance(fault, str) else fault(log.streams[topic])
    return replace(log, streams={**log.streams, topic: made})


@pytest.fixture(autouse=True)
def _keeps_no_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Words are compared here, and other tests keep the numbers of results."""
    monkeypatch.setattr(keeping.SESSION, "finders", [""])


@pytest.mark.paper
@pytest.mark.parametrize("name", PLANTED)
def test_every_command_says_of_a_log_what_lint_says(
    name: str, tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without causes, which name a fault in words of their own; a page quotes the evidence."""
    monkeypatch.setattr(diagnosis, "seek", lambda *_: Sought())
    monkeypatch.setattr(diagnosis.Diagnosis, "_draw", lambda *_: None)
    topic, _, kind, words = PLANTED[name]
    log = tmp_path / "log.mcap"
    fl.write(log, planted(name))
    [found] = [each for each in fl.lint(log) if (each.kind, each.where) == (kind, topic)]
    assert words in found.evidence
    assert found.sentence in " ".join(fuselog("info", log).out.split())
    told = fl.diagnose(log, "ekf")
    assert any(found.sentence in each for each in [*told.told, *told.notes])
    if name not in ON_A_PAGE:
        return
    told.save(tmp_path / "diagnosis")
    fuselog("report", tmp_path / "diagnosis", "-o", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert found.evidence.replace("'", "&#39;") in page


@pytest.mark.paper
def test_a_clipped_log_is_said_to_be_by_replay_run_and_with_causes(
    tmp_path: Path, fuselog: Fuselog
) -> None:
    log = tmp_path / "log.mcap"
    fl.write(log, planted("clipped"))
    [found] = fl.lint(log)
    command = ("replay", log, "-e", "ekf", "-o", tmp_path / "estimates.mcap")
    assert f"implausible: {found.sentence}" in " ".join(fuselog(*command).out.split())
    assert fuselog(*command, "--json").json["findings"] == [found.as_json]
    told = fl.diagnose(log, "ekf")
    assert found in told.sentences
    fl.replay(log, "ekf").save(tmp_path / "replay")
    fuselog("run", log, "-e", "ekf", "--out", tmp_path / "run")
    for folder in ("replay", "run"):
        result = json.loads((tmp_path / folder / "result.json").read_text(encoding="utf-8"))
        assert result["settings"]["notes"] == [found.sentence]


def test_wheels_that_turn_backwards_are_named_beside_the_compass() -> None:
    """A heading that is 180 deg off the course may be right, if the speeds have the wrong sign."""
    log = fl.record("car", seed=5)
    wheels = column("forward_mps", np.negative)(log.streams[ODOMETRY])
    [found] = fl.lint(replace(log, streams={**log.streams, ODOMETRY: wheels}))
    assert found.where == "/car/heading"
    assert "or of a wrong sign of speeds" in found.evidence
    assert "or change the sign of the speeds with `factors`" in found.fix
    with pytest.warns(FutureWarning, match="Finding: 'words' was renamed to 'sentence'"):
        assert found.words == found.sentence  # what scripts of the release before ask for


def test_lint_denies_no_more_than_it_looked_at(tmp_path: Path, fuselog: Fuselog) -> None:
    fl.write(tmp_path / "log.mcap", recorded(faulty(2003, "nothing")))
    assert (
        fuselog("lint", tmp_path / "log.mcap").out.strip().endswith("no errors found in the log itself")
    )
