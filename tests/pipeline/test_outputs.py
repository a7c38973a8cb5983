"""An audit: every command and every output option, in every place where something may be lost.

No file of the user is changed or deleted. The tables are the audit; the test goes through all pairs.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
import rerun as rr
from mcap.writer import Writer
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from replay.timeline.viewer import SOFTWARE
from tests.pipeline.conftest import MRCLAM, Said, run_here

pytestmark = pytest.mark.paper

resource = pytest.importorskip("resource")

AIS = (
    "Time,MMSI,Latitude_degrees,Longitude_degrees,COG_degrees,SOG_knots\n"
    "2016-01-12 13:02:11.218,235070762,50.77,-1.09,90,10\n"
)
EXPERIMENT = """
title = "Dead reckoning"
[record]
scenario = "landmarks"
parameters = { duration_s = 1.0 }
[estimators.dead-reckoning]
"""


class Command(NamedTuple):
    """A command with one output OUT: its suffix (none for a folder) and the inputs that it reads."""

    arguments: str
    suffix: str
    inputs: tuple[str, ...] = ()


COMMANDS = {
    "record -o": Command("record landmarks --set duration_s=1 -o OUT", ".mcap"),
    "record --again -o": Command("record --again log.mcap -o OUT", ".mcap", ("log.mcap",)),
    "import file -o": Command("import ais ais.csv -o OUT", ".mcap", ("ais.csv",)),
    "import folder -o": Command("import mrclam mrclam -o OUT", ".mcap", ("mrclam/Barcodes.dat",)),
    "replay -o": Command("replay log.mcap -e dead-reckoning -o OUT", ".mcap", ("log.mcap",)),
    "replay --start-from -o": Command(
        "replay log.mcap -e dead-reckoning --start 0.5 --start-from log.estimates.mcap -o OUT",
        ".mcap",
        ("log.mcap", "log.estimates.mcap"),
    ),
    "replay --save": Command(
        "replay log.mcap -e dead-reckoning -o new.mcap --save OUT", ".rrd", ("log.mcap",)
    ),
    "evaluate --out": Command(
        "evaluate log.estimates.mcap --out OUT", "", ("log.estimates.mcap", "log.mcap")
    ),
    "evaluate in a result --out": Command(
        "evaluate result/estimates/run-0000.mcap --out OUT", "", ("result/estimates/run-0000.mcap",)
    ),
    "evaluate --truth --out": Command("evaluate line.tum --truth line.tum --out OUT", "", ("line.tum",)),
    "cut -o": Command("cut log.mcap --end 0.5 -o OUT", ".mcap", ("log.mcap",)),
    "merge -o": Command(
        "merge log.mcap log.estimates.mcap -o OUT", ".mcap", ("log.mcap", "log.estimates.mcap")
    ),
    "relabel -o": Command("relabel log.mcap --component x_m=a -o OUT", ".mcap", ("log.mcap",)),
    "view --save": Command("view log.mcap --save OUT", ".rrd", ("log.mcap",)),
    "view --screenshot": Command("view log.mcap --screenshot OUT", ".png", ("log.mcap",)),
    "view a timeline --screenshot": Command(
        "view result/timeline.rrd --screenshot OUT", ".png", ("result/timeline.rrd",)
    ),
    "run --out": Command("run dead.toml --runs 1 --out OUT", "", ("dead.toml",)),
    "run --data --out": Command("run ais --data ais.csv --out OUT", "", ("ais.csv",)),
    "report -o": Command("report result -o OUT", ".html", ("result/result.json", "result/timeline.rrd")),
}


def _foreign(path: Path) -> None:
    """What another program wrote, in the very format that fuselog writes there."""
    if path.suffix == ".mcap":
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start(library="the user's")
            writer.finish()
    elif path.suffix == ".rrd":
        with rr.RecordingStream("theirs") as recording:
            recording.save(path)
            recording.log("a", rr.TextLog("mine"))
    elif path.suffix == ".png":
        _picture(path, "another program")
    elif path.suffix == ".html":
        path.write_text("<!doctype html><title>mine</title>")
    else:
        path.mkdir()
        (path / "result.json").write_text("{}")
        (path / "thesis.tex").write_text("years of work")


def _picture(path: Path, software: str) -> None:
    said = PngInfo()
    said.add_text("Software", software)
    Image.new("RGB", (2, 2)).save(path, pnginfo=said)


def _text(path: Path) -> None:
    path.write_text("mine")


def _link(path: Path) -> None:
    place = Path("user") / path.name
    _foreign(place)
    path.symlink_to(place.absolute())


def _link_to_ours(path: Path) -> None:
    shutil.move(path, "user")
    path.symlink_to(Path("user", path.name).absolute())


def _dangling(path: Path) -> None:
    path.symlink_to("nowhere")


def _folder(path: Path) -> None:
    path.mkdir()
    (path / "notes.txt").write_text("mine")


def _note(result: Path) -> None:
    (result / "notes.txt").write_text("mine")


def _edit(result: Path) -> None:
    """One letter of the title."""
    said = result / "result.json"
    said.write_text(said.read_text().replace("title", "Title", 1))


def _neighbours(path: Path) -> None:
    """Names that were temporary names once, a folder and a link to the user's file among them."""
    for ending in (".old", ".part"):
        path.with_name(path.name + ending).mkdir()
        (path.with_name(path.name + ending) / "notes.txt").write_text("mine")
    path.with_name(f".{path.name}.part").symlink_to(Path("user/notes.txt").absolute())
    path.with_name(f".{path.name}.mine.part").write_text("mine")


class Situation(NamedTuple):
    """What is in the place: a preparation, whether our own output is there first, and the exit code."""

    prepare: Callable[[Path], None]
    over_ours: bool = False
    code: int = 2


SITUATIONS = {
    "nothing": Situation(lambda _: None, code=0),
    "our own": Situation(lambda _: None, over_ours=True, code=0),
    "names like temporary ones": Situation(_neighbours, code=0),
    "the same over our own": Situation(_neighbours, over_ours=True, code=0),
    "a text": Situation(_text),
    "the format, of another program": Situation(_foreign),
    "a folder with foreign files": Situation(_folder),
    "a symbolic link": Situation(_link),
    "a symbolic link to our own": Situation(_link_to_ours, over_ours=True),
    "a symbolic link to nothing": Situation(_dangling),
}


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of inputs, and in `ours` what every command writes where nothing is in the place."""
    folder = tmp_path_factory.mktemp("audit")
    with chdir(folder):
        Path("dead.toml").write_text(EXPERIMENT)
        Path("line.tum").write_text("".join(f"{time} {time} 0 0 0 0 0 1\n" for time in range(9)))
        Path("ais.csv").write_text(AIS)
        Path("mrclam").mkdir()
        for name, text in MRCLAM.items():
            Path("mrclam", name).write_text(text)
        Path("user").mkdir()
        Path("user/notes.txt").write_text("mine")
        for command in (
            "record landmarks --set duration_s=1 -o log.mcap",
            "replay log.mcap -e dead-reckoning",
            "run dead.toml --out result",
        ):
            assert run_here(*command.split()).code == 0
    ours = folder / "ours"
    ours.mkdir()
    for name, command in COMMANDS.items():
        place = ours / (name.replace(" ", "_") + command.suffix)
        with chdir(folder):
            said = _run(command, place)
        if "Vulkan" in said.err:
            _picture(place, SOFTWARE)
        else:
            assert said.code == 0, said.err
        Path(folder, "new.mcap").unlink(missing_ok=True)
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
    ours = before / "ours" / (command.replace(" ", "_") + place.suffix)
    (shutil.copytree if ours.is_dir() else shutil.copy2)(ours, place)


def _run(command: Command, out: Path) -> Said:
    return run_here(*(str(out) if each == "OUT" else each for each in command.arguments.split()))


def _state(folder: Path) -> dict[str, str]:
    """Everything in a folder: links by their targets, files by their bytes."""
    return {
        str(path.relative_to(folder)): f"link {path.readlink()}"
        if path.is_symlink()
        else hashlib.sha256(path.read_bytes()).hexdigest()
        if path.is_file()
        else "folder"
        for path in folder.rglob("*")
    }


def _without(state: dict[str, str], place: Path) -> dict[str, str]:
    """The state without an output, and without the other one that `replay --save` writes."""
    return {
        name: what
        for name, what in state.items()
        if place not in (Path(name), *Path(name).parents) and name != "new.mcap"
    }


def _check_refusal(said: Said, folder: Path, expected: dict[str, str], words: str = "") -> None:
    assert said.code == 2, said.out
    assert said.err.startswith("fuselog: ")
    assert said.err.count("\n") == 1
    assert words in said.err
    assert _state(folder) == expected


@pytest.mark.paper
@pytest.mark.parametrize("situation", SITUATIONS)
@pytest.mark.parametrize("command", COMMANDS)
def test_no_file_of_the_user_is_changed(command: str, situation: str, here: Path, before: Path) -> None:
    what, where = COMMANDS[command], SITUATIONS[situation]
    place = Path("out" + what.suffix)
    if where.over_ours:
        _place_ours(before, command, place)
    where.prepare(place)
    earlier = _state(here)
    said = _run(what, place)
    if where.code == 2 or "Vulkan" in said.err:
        _check_refusal(said, here, earlier)
        return
    assert said.code == 0, said.err
    assert _without(_state(here), place) == _without(earlier, place)
    assert place.exists()


@pytest.mark.parametrize("command", [name for name, each in COMMANDS.items() if not each.suffix])
@pytest.mark.parametrize("change", [_note, _edit])
def test_a_result_with_notes_or_edits_stays(
    command: str, change: Callable[[Path], None], here: Path, before: Path
) -> None:
    _place_ours(before, command, Path("out"))
    change(Path("out"))
    _check_refusal(_run(COMMANDS[command], Path("out")), here, _state(here), "out")


def test_a_page_with_notes_stays(here: Path, before: Path) -> None:
    _place_ours(before, "report -o", Path("out.html"))
    page = Path("out.html")
    page.write_text(page.read_text().replace("<h1>", "<p>mine</p><h1>"))
    _check_refusal(_run(COMMANDS["report -o"], page), here, _state(here), "a report of fuselog")


@pytest.mark.parametrize(
    ("command", "given"), [(name, given) for name, each in COMMANDS.items() for given in each.inputs]
)
def test_an_input_is_never_an_output(command: str, given: str, here: Path) -> None:
    """By its name, by a way around, by a second name of the same file with the right suffix."""
    what = COMMANDS[command]
    if what.suffix:
        os.link(given, "second" + what.suffix)
        places = [Path(given), Path("user", "..", given), Path("second" + what.suffix)]
    else:
        shutil.copytree("result", "whole")  # valid, with the input in it
        shutil.copytree("whole", "inside")
        shutil.move(given, f"inside/{Path(given).name}")
        Path(given).symlink_to(Path(f"inside/{Path(given).name}").absolute())
        places = [Path("inside"), Path(given).parent]
    for place in places:
        earlier = _state(here)
        _check_refusal(_run(what, place), here, earlier)


@pytest.mark.parametrize("command", [name for name, each in COMMANDS.items() if each.suffix])
def test_a_suffix_says_what_is_written(command: str, here: Path) -> None:
    for name in (
        "out.csv",
        "out.toml",
        "out" + (".rrd" if COMMANDS[command].suffix == ".mcap" else ".mcap"),
    ):
        _check_refusal(_run(COMMANDS[command], Path(name)), here, _state(here))


def test_what_belongs_to_a_result_is_no_output(here: Path) -> None:
    for arguments in (
        "record landmarks -o result/logs/run-0000.mcap",
        "replay log.mcap -e ekf -o result/estimates/run-0000.mcap",
        "view log.mcap --save result/timeline.rrd",
    ):
        _check_refusal(run_here(*arguments.split()), here, _state(here), "is part of the result")


def test_two_outputs_are_two_files(here: Path) -> None:
    Path("dir").mkdir()
    shutil.copy("log.estimates.mcap", "dir")
    os.link("dir/log.estimates.mcap", "same.rrd")
    for arguments in (
        "replay log.mcap -e dead-reckoning -o x.mcap --save x.mcap",
        "replay log.mcap -e dead-reckoning -o dir --save same.rrd",
        "view log.mcap --save x.rrd --screenshot x.rrd",
    ):
        _check_refusal(run_here(*arguments.split()), here, _state(here))


@contextmanager
def _full_disk() -> Iterator[None]:
    """The limit on the size of files stands in for the disk's."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (700, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("over_ours", [False, True])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_loses_nothing(command: str, over_ours: bool, here: Path, before: Path) -> None:
    what = COMMANDS[command]
    place = Path("out" + what.suffix)
    if over_ours:
        _place_ours(before, command, place)
    earlier = _state(here)
    with _full_disk():
        said = _run(what, place)
    _check_refusal(said, here, earlier)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_place_that_takes_nothing_is_said(command: str, here: Path) -> None:
    """A file for a folder, a folder of the system, one without permission (which does not stop root)."""
    what = COMMANDS[command]
    Path("closed").mkdir(mode=0o500)
    places = [Path("user/notes.txt/out" + what.suffix), Path("/proc/out" + what.suffix)]
    if os.geteuid() != 0:
        places.append(Path("closed/out" + what.suffix))
    for place in places:
        said = _run(what, place)
        Path("new.mcap").unlink(missing_ok=True)
        _check_refusal(said, here, _state(here))
        assert "Vulkan" in said.err or str(place.parent) in said.err
