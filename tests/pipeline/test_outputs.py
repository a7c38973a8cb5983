"""An audit: every command and every output option, in every place where something may be lost.

No file of the user is changed or deleted. The tables are the audit; the test goes through all pairs.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace

import pytest
from PIL import Image

from fuselog.pipeline.command_line.group import fuselog
from fuselog.pipeline.command_line.options import Output
from fuselog.pipeline.deploying import certificate
from fuselog.replay.timeline import viewer
from tests.pipeline.conftest import Said, run_here, shadowed
from tests.pipeline.outputs_audit import (
    COMMANDS,
    SETTINGS,
    SITUATIONS,
    Command,
    neighbours,
    output_options,
    prepare,
)

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]

resource = pytest.importorskip("resource")

ALL = {**COMMANDS, **SETTINGS}
# The same place by its name, and by a way through a folder that is not there.
WAYS = {"straight": Path(), "through a missing folder": Path("missing", "..")}


def _note(result: Path) -> None:
    (result / "notes.txt").write_text("mine")


def _edit(result: Path) -> None:
    """One letter of the title."""
    said = result / "result.json"
    said.write_text(said.read_text().replace("title", "Title", 1))


class Painter:
    """In place of the viewer, whose start takes seconds: it opens anything, and all is black."""

    def open(self, rrd: str) -> None:
        """Nothing is looked at."""

    def get_state(self) -> SimpleNamespace:
        """Loaded, and without complaints."""
        return SimpleNamespace(loading=False, recordings=[], views=[])

    def save_screenshot(self, png: str) -> None:
        """A picture of less than a hundred bytes, as long as it does not say who made it."""
        Image.new("RGB", (64, 64)).save(png)


@pytest.fixture(scope="module", autouse=True)
def _painted() -> Iterator[None]:
    """The viewer itself is for tests/replay/timeline; `test_deploying.py` has a filter's memory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "_memory", lambda *_: None)
        patch.setattr(viewer, "listen", lambda *_: nullcontext(SimpleNamespace(url="")))
        patch.setattr(viewer, "ViewerClient", SimpleNamespace(connect=lambda _: Painter()))
        yield


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of inputs, and in `ours` what every command writes where nothing is in the place.

    There each writes nothing else, and imports no module of the folder.
    """
    folder = tmp_path_factory.mktemp("audit")
    ours = folder / "ours"
    with shadowed(folder):
        prepare()
        earlier = _state(folder)
        ours.mkdir()
        for name, command in COMMANDS.items():
            place = ours / (name.replace(" ", "_") + command.suffix)
            said = _run(command, place)
            assert said.code == 0, said.err
            assert place.exists()
            assert _without(_state(folder), Path("ours")) == earlier
            Path("new.mcap").unlink(missing_ok=True)
    return folder


@pytest.fixture
def here(before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder to work in."""
    folder = tmp_path / "here"
    shutil.copytree(before, folder, ignore=shutil.ignore_patterns("ours"))
    monkeypatch.chdir(folder)
    return folder


def _place_ours(before: Path, command: str, place: Path) -> None:
    """What the command wrote earlier."""
    ours = before / "ours" / (command.replace(" ", "_") + COMMANDS[command].suffix)
    (shutil.copytree if ours.is_dir() else shutil.copy2)(ours, place)


def _run(command: Command, out: Path) -> Said:
    return run_here(*command.to(out))


def _state(folder: Path) -> dict[str, str]:
    """Everything in a folder: links by their targets, files by their bytes."""
    found = dict[str, str]()
    waiting = [""]
    while waiting:
        below = waiting.pop()
        for each in os.scandir(folder / below):
            name = below + each.name
            if each.is_symlink():
                found[name] = f"link {Path(each.path).readlink()}"
            elif each.is_dir():
                found[name] = "folder"
                waiting.append(f"{name}/")
            else:
                found[name] = f"file {hash(Path(each.path).read_bytes())}"
    return found


def _without(state: dict[str, str], place: Path) -> dict[str, str]:
    """The state without an output, and without the other one that `replay --save` writes."""
    return {
        name: what
        for name, what in state.items()
        if place not in (Path(name), *Path(name).parents) and name not in ("new.mcap", "team/missing")
    }


def _check_refusal(
    said: Said, folder: Path, expected: dict[str, str], words: str = "", *, situation: str = ""
) -> None:
    assert said.code == 2, (situation, said.out)
    assert said.err.startswith("fuselog: ")
    assert said.err.count("\n") == 1
    assert words in said.err
    assert _state(folder) == expected, situation


def test_every_output_of_a_command_is_in_the_audit() -> None:
    """As click knows them: a new command is there by itself."""
    assert {"cut --out", "sweep --out", "compare --save", "check --junit"} <= COMMANDS.keys()
    assert {name for name, *_ in output_options()} <= COMMANDS.keys()
    flags = {"-o", "--out", "--save", "--junit", "--screenshot", "--against"}
    for name, command in fuselog.commands.items():
        for option in command.params:
            if flags & {*option.opts}:
                assert isinstance(option.type, Output), f"{name}: {option.opts} is an output"


@pytest.mark.parametrize(
    ("command", "mode", "umask"),
    [(name, *way) for name, way in zip(COMMANDS, cycle([(0o775, 0o002), (0o1777, 0o000)]))],
)
def test_its_own_output_alone_is_replaced(
    command: str, mode: int, umask: int, here: Path, before: Path
) -> None:
    """In a folder that others write to, by a way through a folder that is not there.

    Beside names that temporary files have; what writes new files only leaves that one, too.
    """
    what = COMMANDS[command]
    place = Path("team/out" + what.suffix)
    Path("team").mkdir()
    Path("team").chmod(mode)
    neighbours(place)
    empty = _state(here)
    _place_ours(before, command, place)
    earlier, way = _state(here), Path("team/missing/..", place.name)
    own_umask = os.umask(umask)
    try:
        if not what.replaces:
            _check_refusal(_run(what, way), here, earlier)
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink()
            earlier = empty
        if what.suffix in (".rrd", ".png"):  # for a timeline and a picture no folder is made
            _check_refusal(_run(what, way), here, earlier)
            way = place
        said = _run(what, way)
    finally:
        os.umask(own_umask)
    assert said.code == 0, said.err
    assert _without(_state(here), place) == _without(earlier, place)
    assert place.exists()


@pytest.mark.parametrize(("command", "by_turns"), [*zip(COMMANDS, cycle(SITUATIONS))])
def test_no_file_of_the_user_is_changed(command: str, by_turns: str, here: Path, before: Path) -> None:
    """Straight in every situation, and by turns in one of them by the other way."""
    what = COMMANDS[command]
    place = Path("out" + what.suffix)
    for situation, where in SITUATIONS.items():
        if where.over_ours:
            _place_ours(before, command, place)
        where.prepare(place)
        earlier = _state(here)
        for way in WAYS if situation == by_turns else ["straight"]:
            _check_refusal(_run(what, WAYS[way] / place), here, earlier, situation=situation)
        for each in (place, Path("user", place.name)):
            if each.is_symlink() or each.is_file():
                each.unlink()
            elif each.exists():
                shutil.rmtree(each)


@pytest.mark.parametrize(
    "command", [name for name, each in COMMANDS.items() if not each.suffix and each.replaces]
)
@pytest.mark.parametrize("change", [_note, _edit])
def test_a_result_with_notes_or_edits_stays(
    command: str, change: Callable[[Path], None], here: Path, before: Path
) -> None:
    """And that is said first, not after work that is lost then."""
    _place_ours(before, command, Path("out"))
    change(Path("out"))
    said = _run(COMMANDS[command], Path("out"))
    _check_refusal(said, here, _state(here), "out")
    assert said.out == ""


def test_a_page_with_notes_stays(here: Path, before: Path) -> None:
    _place_ours(before, "report --out", Path("out.html"))
    page = Path("out.html")
    page.write_text(page.read_text().replace("<main>", "<p>mine</p><main>"))
    _check_refusal(
        _run(COMMANDS["report --out"], page), here, _state(here), "a report that fuselog wrote"
    )


@pytest.mark.parametrize(
    ("command", "given"), [(name, given) for name, each in ALL.items() for given in each.inputs]
)
def test_an_input_is_never_an_output(command: str, given: str, here: Path) -> None:
    """By its name, by a way around, by a second name of the same file with the right suffix."""
    what = ALL[command]
    if what.suffix:
        os.link(given, "second" + what.suffix)
        ways = [Path("user", ".."), *WAYS.values()]
        places = [Path("second" + what.suffix), *(way / given for way in ways)]
    else:
        shutil.copytree("result", "whole")  # valid, with the input in it
        shutil.copytree("whole", "inside")
        shutil.move(given, f"inside/{Path(given).name}")
        Path(given).symlink_to(Path(f"inside/{Path(given).name}").absolute())
        places = [Path("inside"), Path("missing", "..", "inside"), Path(given).parent]
    for place in places:
        earlier = _state(here)
        _check_refusal(_run(what, place), here, earlier)


@pytest.mark.parametrize("command", [name for name, each in COMMANDS.items() if each.suffix])
def test_a_suffix_says_what_is_written(command: str, here: Path) -> None:
    written = {COMMANDS[command].suffix, *(".mcap", ".toml") * (command == "import --guess")}
    for suffix in {".csv", ".toml", ".rrd", ".mcap"} - written:
        _check_refusal(_run(COMMANDS[command], Path("out" + suffix)), here, _state(here))


def test_what_belongs_to_a_result_is_no_output(here: Path) -> None:
    for arguments in (
        "record landmarks -o result/logs/run-0000.mcap",
        "replay run.mcap -e ekf -o result/estimates/run-0000.mcap",
        "view run.mcap --save result/timeline.rrd",
    ):
        _check_refusal(run_here(*arguments.split()), here, _state(here), "is part of the result")


def test_two_outputs_are_two_files(here: Path) -> None:
    Path("dir").mkdir()
    shutil.copy("est.mcap", "dir")
    os.link("dir/est.mcap", "same.rrd")
    for arguments in (
        "replay run.mcap -e dead-reckoning -o x.mcap --save x.mcap",
        "replay run.mcap -e dead-reckoning -o dir --save same.rrd",
        "view run.mcap --save x.rrd --screenshot x.rrd",
    ):
        _check_refusal(run_here(*arguments.split()), here, _state(here))


@contextmanager
def _full_disk() -> Iterator[None]:
    """The limit on the size of files stands in for the disk's."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_loses_nothing(command: str, here: Path, before: Path) -> None:
    what = COMMANDS[command]
    place = Path("out" + what.suffix)
    if what.replaces:
        _place_ours(before, command, place)
    earlier = _state(here)
    with _full_disk():
        said = _run(what, place)
    is_record_or_run = command in ("record --out", "run --out")
    _check_refusal(said, here, earlier, "cannot be written (File too large)" * is_record_or_run)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_place_that_takes_nothing_is_said(command: str, here: Path) -> None:
    """Before the work: a file for a folder, and one without permission (which does not stop root).

    `test_bad_input.py` has a folder of the system, which refuses what is written to it.
    """
    what = COMMANDS[command]
    Path("closed").mkdir(mode=0o500)
    places = [Path("user/notes.txt/out" + what.suffix)]
    if os.geteuid() != 0:
        places.append(Path("closed/out" + what.suffix))
    earlier = _state(here)
    for place in places:
        said = _run(what, place)
        _check_refusal(said, here, earlier, f"{place}: cannot be written, as ")
        assert str(place.parent) in said.err
        assert said.out == ""


@pytest.mark.parametrize("verb", ["cut", "merge", "relabel", "constrain"])
def test_commands_on_logs_replace_only_their_own(verb: str, here: Path, before: Path) -> None:
    for other in ("cut", "merge", "relabel", "constrain"):
        place = Path(f"{other}.mcap")
        _place_ours(before, f"{other} --out", place)
        said = _run(COMMANDS[f"{verb} --out"], place)
        assert said.code == (0 if other == verb else 2), said.err
    assert "a log that fuselog" in said.err or verb == other


def test_two_outputs_are_no_part_of_each_other(here: Path) -> None:
    for command in ("compare run.mcap -e dead-reckoning -e ekf", "diagnose run.mcap -e ekf"):
        said = run_here(*command.split(), "--out", "new", "--save", "new/timeline.rrd")
        _check_refusal(said, here, _state(here), "the output new/timeline.rrd is in it")


def test_the_root_is_no_result_folder(here: Path) -> None:
    for command in ("run dead.toml", "sweep dead.toml --over duration_s=1,2", "evaluate est.mcap"):
        _check_refusal(run_here(*command.split(), "--out", "/"), here, _state(here), "is the root")


# Starts a worker as `--workers` does, then runs commands one after another, with the path that the
# console script has.
DRIVER = """
import json, sys
from matplotlib.figure import Figure
from fuselog.pipeline.command_line import main
from fuselog.pipeline.runs.executors import processes
if __name__ == "__main__":
    Figure.draw = lambda *_: None
    with processes(1)() as pool:
        assert pool.executor.submit(abs, -1).result() == 1
    print(json.dumps([main(words) for words in json.load(sys.stdin)]))
"""
# Commands without an output, and those that start processes: filters of others, and the viewer.
OTHERS = """
cache
estimators
experiments
header
info run.mcap
lint run.mcap
metrics
models
scenarios
observability run.mcap
replay run.mcap -e exec:/bin/true -o a.mcap
replay run.mcap -e lib:./junk.so -o b.mcap
report result --viewer --out viewer.html
view result/timeline.rrd --screenshot view.png
"""
# The viewer where there is no graphics driver, and filters that are none.
MAY_FAIL = {"view", "report", "replay"}


def test_no_command_imports_a_module_of_the_current_folder(here: Path, tmp_path: Path) -> None:
    """Nor do the processes that commands start; `before` has the commands with an output.

    `test_campaigns.py` has the workers of Dask, `test_exploring.py` the explorer.
    """
    (here / "junk.so").write_bytes(b"no library")
    lines = [*map(str.split, OTHERS.strip().splitlines())]
    with_output = {each.words[0] for each in COMMANDS.values()}
    assert with_output | {words[0] for words in lines} == fuselog.commands.keys() - {"explore"}
    driver = tmp_path / "driver.py"
    driver.write_text(DRIVER)
    with shadowed(here):
        done = subprocess.run(
            [sys.executable, driver], input=json.dumps(lines), capture_output=True, text=True
        )
        failed = zip(lines, json.loads(done.stdout.splitlines()[-1]), strict=True)
        assert {words[0] for words, code in failed if code} <= MAY_FAIL, done.stderr


def test_settings_of_numba_in_the_current_folder_are_refused(here: Path) -> None:
    (here / ".numba_config.yaml").write_text("cache_dir: mine")
    _check_refusal(run_here("lint", "run.mcap"), here, _state(here), ".numba_config.yaml: ")


MATPLOTLIB_SETTINGS = """
import sys
from fuselog.pipeline.command_line import main
from fuselog.pipeline.runs.executors import processes

if __name__ == "__main__":
    assert main(["--version"]) == 0
    asked = "__import__('matplotlib').rcParams['text.usetex']"
    with processes(1)() as pool:
        print(eval(asked), pool.executor.submit(eval, asked).result())
"""


def test_settings_of_matplotlib_in_the_current_folder_are_not_read(tmp_path: Path) -> None:
    """Neither by a command nor by its workers, though Matplotlib itself would read them."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: True")
    (tmp_path / "asks.py").write_text(MATPLOTLIB_SETTINGS)
    asked = subprocess.run(
        [sys.executable, "-P", "asks.py"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert asked.stdout.splitlines()[-1] == "False False"
