"""The kept cells of a campaign: only what this very cell wrote enters the result, wherever they lie."""

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest

from fuselog.pipeline.output.results import TIMINGS
from fuselog.pipeline.runs.checkpoints import Checkpoints, checkpoints_of
from fuselog.pipeline.runs.executors import InlineExecutor, WorkerPool
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.recorders.errors import BadInput
from tests.pipeline.conftest import Said

pytestmark = pytest.mark.usefixtures("blank_figures")

# Three cells, of which the first writes logs, estimates and the timeline.
CELL, RUNS = 16, 36
SETTINGS = {"duration_s": 1.0, "estimators": {"dead-reckoning": {}}}


@pytest.fixture(scope="module", autouse=True)
def _small_cells() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", CELL)
        yield


def run(place: Path, seed: int = 3) -> dict[str, bytes]:
    """Run it, and return all files but the timeline."""
    name, experiment = load_experiment("landmarks", SETTINGS, {"runs": RUNS, "seed": seed})
    experiment = experiment.model_copy(update={"estimators": {"dead-reckoning": {}}})
    run_experiment(name, experiment, place, logs=2)
    return contents(place)


def contents(place: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(place)): path.read_bytes()
        for path in place.rglob("*")
        if path.is_file() and path.suffix != ".rrd" and path.name != TIMINGS
    }


def left_unfinished(place: Path, seed: int = 3) -> Path:
    """The folder of a campaign that is stopped when all of its cells are done."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoints, "hand_over", lambda *_: 1 / 0)
        with pytest.raises(BadInput, match="division by zero"):
            run(place, seed)
    return place.with_name(f"{place.name}.unfinished")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What an undisturbed campaign gives, its finished cells, and those of another seed."""
    folder = tmp_path_factory.mktemp("prepared")
    place = folder / "result"
    run(place)
    place.rename(folder / "whole")
    for name, seed in (("other", 4), ("kept", 3)):
        left_unfinished(place, seed).rename(folder / name)
    return {"place": place, **{name: folder / name for name in ("whole", "kept", "other")}}


def _cells(folder: Path) -> list[Path]:
    """What cells left: first the one that wrote files."""
    found = sorted(folder.glob("*.bin"))
    return sorted(found, key=lambda path: not path.with_suffix("").is_dir())


def _swapped(folder: Path, _: Path) -> None:
    first, second = _cells(folder)[1:]
    third = first.with_suffix(".third")
    first.rename(third)
    second.rename(first)
    third.rename(second)


def _doubled(folder: Path, _: Path) -> None:
    first, second = _cells(folder)[1:]
    shutil.copy(first, second)


def _of_another_seed(folder: Path, other: Path) -> None:
    mine, theirs = _cells(folder)[0], _cells(other)[0]
    shutil.copy(theirs, mine)
    shutil.rmtree(mine.with_suffix(""))
    shutil.copytree(theirs.with_suffix(""), mine.with_suffix(""))


def _cut(folder: Path, _: Path) -> None:
    log = next(folder.glob("*/logs/run-0000.mcap"))
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])


def _estimates_swapped(folder: Path, _: Path) -> None:
    first, second = sorted(folder.glob("*/estimates/*.mcap"))
    shutil.copy(first, second)


def _foreign_timeline(folder: Path, _: Path) -> None:
    next(folder.glob("*/timeline.rrd")).write_text("foreign")


def _file_added(folder: Path, _: Path) -> None:
    next(folder.glob("*/logs")).joinpath("mine.mcap").write_text("foreign")


def _file_added_to_another(folder: Path, _: Path) -> None:
    place = _cells(folder)[1].with_suffix("")
    place.mkdir()
    (place / "mine.mcap").write_text("foreign")


@pytest.mark.paper
@pytest.mark.parametrize(
    "changes",
    [
        (_swapped, _of_another_seed),
        (_doubled, _cut),
        (_estimates_swapped, _file_added_to_another),
        (_foreign_timeline,),
        (_file_added,),
    ],
)
def test_only_what_a_cell_wrote_enters_the_result(
    changes: tuple[Callable[[Path, Path], None], ...], prepared: dict[str, Path]
) -> None:
    """Two changes are of different cells, so that neither hides the other."""
    place = prepared["place"]
    unfinished = place.with_name(f"{place.name}.unfinished")
    shutil.copytree(prepared["kept"], unfinished)
    try:
        for change in changes:
            change(unfinished, prepared["other"])
        assert run(place) == contents(prepared["whole"])
        assert (place / "timeline.rrd").read_bytes() != b"foreign"
        assert not unfinished.exists()
    finally:
        shutil.rmtree(place, ignore_errors=True)
        shutil.rmtree(unfinished, ignore_errors=True)


@pytest.mark.paper
def test_a_cell_that_is_changed_while_others_are_worked_off_is_worked_off_again(
    prepared: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where a disk never gives back what was written, that is said."""
    place = prepared["place"]
    unfinished = place.with_name(f"{place.name}.unfinished")
    shutil.copytree(prepared["kept"], unfinished)
    begin = Checkpoints.read
    asked = []

    def damaging(kept: Checkpoints, key: str) -> Any:
        if not asked:
            (kept.folder / f"{key}.bin").write_bytes(b"")
        asked.append(key)
        return begin(kept, key)

    try:
        monkeypatch.setattr(Checkpoints, "read", damaging)
        assert run(place) == contents(prepared["whole"])
        shutil.rmtree(place)
        monkeypatch.setattr(Checkpoints, "read", lambda *_: None)
        with pytest.raises(
            BadInput, match="files there are being changed by another program or a faulty disk"
        ):
            run(place)
    finally:
        shutil.rmtree(place, ignore_errors=True)
        shutil.rmtree(unfinished, ignore_errors=True)


@pytest.mark.paper
@pytest.mark.unix
@pytest.mark.parametrize(("mode", "umask"), [(0o775, 0o002), (0o1777, 0o000)])
def test_a_campaign_runs_wherever_its_folder_is_the_users_own(
    mode: int, umask: int, tmp_path: Path, fuselog: Callable[..., Said]
) -> None:
    """In a team's folder, too, and with a umask that lets the group write."""
    team = tmp_path / "team"
    team.mkdir()
    team.chmod(mode)
    before = os.umask(umask)
    try:
        said = fuselog(
            *("sweep", "landmarks", "--over", "dead-reckoning.every_s=0.1,0.2", "--runs", "2"),
            *("--set", "duration_s=1", "--out", team / "new" / "result"),
        )
        assert said.code == 0, said.err
        left = left_unfinished(team / "kept")
        assert all(path.stat().st_mode & 0o022 == 0 for path in (left, *left.glob("*.bin")))
        left.chmod(0o777)
        with pytest.raises(BadInput, match=r"kept\.unfinished: another user owns it, or others may"):
            run(team / "kept")
    finally:
        os.umask(before)
    assert sorted(path.name for path in team.iterdir()) == ["kept.unfinished", "new"]
    assert [path.name for path in (team / "new").iterdir()] == ["result"]


@pytest.mark.unix
def test_what_another_user_wrote_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that was ours when it was looked at may be another one when it is read."""
    key = "0" * 64
    with checkpoints_of(tmp_path / "result") as checkpoints:
        checkpoints.begin()
        checkpoints.write(key, b"left")
        assert checkpoints.has(key)
        user = os.getuid()
        with monkeypatch.context() as another:
            another.setattr(os, "getuid", lambda: user + 1)
            assert not checkpoints.has(key)
        (checkpoints.folder / f"{key}.bin").chmod(0o620)
        assert not checkpoints.has(key)


def test_folders_made_for_a_campaign_that_fails_go_again(tmp_path: Path) -> None:
    with suppress(InterruptedError), checkpoints_of(tmp_path / "new" / "result") as checkpoints:
        checkpoints.begin()
        raise InterruptedError
    assert not list(tmp_path.iterdir())


def test_a_scheduler_that_ends_is_told(tmp_path: Path) -> None:
    """Its futures are cancelled, which is no error of the study that waits for them."""

    class Ended(InlineExecutor):
        def submit(self, *_: Any, **__: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    name, experiment = load_experiment("landmarks", SETTINGS, {"runs": RUNS})
    with pytest.raises(BadInput, match=r"runs 0 to 15: the process .* died 3 times \(the scheduler has"):
        run_experiment(
            name, experiment, tmp_path / "result", open_pool=lambda: nullcontext(WorkerPool(Ended(), 1))
        )
    assert not list(tmp_path.iterdir())
