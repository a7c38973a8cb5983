"""The tables of the audit of outputs: every command with every option that names an output.

They are walked as click has them. A command of which `QUICK` says nothing is run as its help shows it,
so that a new one is in the audit by itself.
"""

import lzma
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import rerun as rr
from mcap.writer import Writer
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from fuselog.pipeline.calibrating.ellipsoid_study import recorded
from fuselog.pipeline.command_line.group import fuselog
from fuselog.pipeline.command_line.options import Output
from fuselog.recorders.log import make_stream, schemas, write_log
from tests.pipeline.conftest import MRCLAM, run_here

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
# What makes a command quick, by its name or with one of its options: all but that option.
QUICK = {
    "record": "record landmarks --set duration_s=1",
    "import": "import ais ais.csv",
    "replay": "replay run.mcap -e dead-reckoning",
    "replay --save": "replay run.mcap -e dead-reckoning -o new.mcap",
    "tune": "tune run.mcap -e ekf --free sigma_range_m",
    "calibrate": "calibrate run.mcap -e ekf --fixed forward_scale --fixed turn_scale "
    "--fixed turn_bias_radps --fixed bias_bearing_rad",
    "check --against": "check run.mcap -e dead-reckoning --update",
    "check --junit": "check run.mcap --against dead.golden.xz",
    "check --out": "check run.mcap --against dead.golden.xz --workers 1",
    "lint": "lint run.mcap nav.mcap",
    "catalog": "catalog run.mcap",
    "evaluate": "evaluate est.mcap --log run.mcap",
    "compare": "compare run.mcap -e dead-reckoning -e ekf",
    "diagnose": "diagnose run.mcap -e ekf",
    "run": "run dead.toml --runs 1",
    "sweep": "sweep dead.toml --over duration_s=1,2 --runs 1",
    "noise": "noise rest.mcap",
    "ellipsoid": "ellipsoid turned.mcap --field /imu.magnetic_field_ut",
    "report": "report result",
    "view": "view run.mcap",
    "export": "export run.mcap --to csv",
    "cut": "cut run.mcap --end 0.5",
    "merge": "merge run.mcap est.mcap",
    "constrain": "constrain nav.mcap --set rolling_hz=10",
    "relabel": "relabel run.mcap --component x_m=a",
}
# Other suffixes than the option states.
SUFFIXES = {"check --against": ".golden.xz", "export --out": ""}
MORE = {
    "record --again": "record --again run.mcap -o OUT.mcap",
    "import a folder": "import mrclam mrclam -o OUT.mcap",
    "import --guess": "import table table.csv --guess -o OUT.toml",
    "replay --start-from": "replay run.mcap -e dead-reckoning --start 0.5 --start-from est.mcap "
    "-o OUT.mcap",
    "evaluate in a result": "evaluate result/estimates/run-0000.mcap --out OUT",
    "evaluate --truth": "evaluate line.tum --truth line.tum --out OUT",
    "view a timeline": "view result/timeline.rrd --screenshot OUT.png",
    "run --data": "run ais --data ais.csv --out OUT",
    "run logs": "run run.mcap -e dead-reckoning --out OUT",
    "export a topic": "export run.mcap --to csv --topic /robot1/odometry -o OUT.csv",
    "export --to foxglove": "export est.mcap --to foxglove -o OUT.mcap",
}
# These write new files only; what is in the place stays, whatever it is.
NEW_ONLY = ("deploy --out", "import --guess", "export --out", "export a topic", "export --to foxglove")


class Command(NamedTuple):
    """A command with one output OUT: its suffix (none for a folder), and whether it replaces its own."""

    words: list[str]
    suffix: str
    replaces: bool

    @property
    def inputs(self) -> list[str]:
        """The files that it names."""
        named = re.compile(r"\w\S*\.(mcap|csv|toml|tum|rrd|xz)")
        return sorted({word for word in self.words if named.fullmatch(word)} - {"new.mcap"})

    def with_settings(self) -> "Command":
        """The same with a file of settings."""
        return self._replace(words=[*self.words, "--settings", "settings.toml"])

    def to(self, place: Path) -> list[str]:
        """Its words with a place for the output."""
        return [str(place) if word == "OUT" else word for word in self.words]


def output_options() -> Iterator[tuple[str, click.Command, click.Option]]:
    """Every option of every command that names an output, by `COMMAND --OPTION`."""
    for name, command in fuselog.commands.items():
        for option in command.params:
            if isinstance(option, click.Option) and isinstance(option.type, Output):
                yield f"{name} {option.opts[-1]}", command, option


def _commands() -> Iterator[tuple[str, Command]]:
    for name, command, option in output_options():
        assert isinstance(option.type, Output)
        quick = QUICK.get(name) or QUICK.get(name.partition(" ")[0]) or _shown(command)
        words = [*shlex.split(quick), option.opts[-1], "OUT"]
        suffix = SUFFIXES.get(name, option.type.suffix)
        yield name, Command(words, suffix, name not in NEW_ONLY)
    for name, text in MORE.items():
        *words, out = text.split()
        yield name, Command([*words, "OUT"], Path(out).suffix, name not in NEW_ONLY)


def _shown(command: click.Command) -> str:
    """The first example of a command's help, without the outputs that it names."""
    example = re.search(r"^ +fuselog (.*)$", command.help or "", re.MULTILINE)
    assert example is not None, f"{command.name}: has no example"
    words = shlex.split(example[1])
    for option in command.params:
        if isinstance(option.type, Output):
            for flag in set(option.opts) & set(words):
                place = words.index(flag)
                del words[place : place + 2]
    return shlex.join(words)


COMMANDS = dict(_commands())
# Commands that read settings, with a file of them.
SETTINGS = {
    f"{name} --settings": COMMANDS[name].with_settings()
    for name, command, _ in output_options()
    if any("--settings" in option.opts for option in command.params) and name != "check --junit"
}


def prepare() -> None:
    """Write the inputs of all commands here."""
    noise = np.random.default_rng(1).normal(size=500)
    write_log(
        "rest.mcap",
        [
            make_stream(
                "/range",
                schemas.RANGE,
                range(0, 25 * 10**9, 5 * 10**7),
                target_id=[1] * 500,
                range_m=noise,
            )
        ],
    )
    # every tenth reading: a search over all takes most of the audit's time
    turned = [each.take(slice(None, None, 10)) for each in recorded("magnetometer", 1).streams.values()]
    write_log("turned.mcap", turned)
    Path("dead.toml").write_text(EXPERIMENT)
    Path("settings.toml").write_text("")
    Path("line.tum").write_text("".join(f"{time} {time} 0 0 0 0 0 1\n" for time in range(9)))
    Path("ais.csv").write_text(AIS)
    Path("table.csv").write_text("t,x\n" + "".join(f"{time},{time}\n" for time in range(9)))
    Path("mrclam").mkdir()
    for name, text in MRCLAM.items():
        Path("mrclam", name).write_text(text)
    Path("user").mkdir()
    Path("user/notes.txt").write_text("mine")
    for command in (
        "record landmarks --set duration_s=1 -o run.mcap",
        "record navigation --set duration_s=11 -o nav.mcap",
        "replay run.mcap -e dead-reckoning -o est.mcap",
        "run dead.toml --out result",
        "check run.mcap -e dead-reckoning --update --against dead.golden.xz",
    ):
        said = run_here(*command.split())
        assert said.code == 0, said.err


# What may be in the place of an output.


def foreign(path: Path) -> None:
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
        picture(path, "another program")
    elif path.suffix == ".html":
        path.write_text("<!doctype html><title>mine</title>")
    elif path.suffix == ".xml":
        path.write_text("<testsuites name='mine'/>")
    elif path.suffix == ".xz":
        path.write_bytes(lzma.compress(b"mine"))
    elif path.suffix:
        path.write_text("mine")
    else:
        path.mkdir()
        (path / "result.json").write_text("{}")
        (path / "thesis.tex").write_text("years of work")


def picture(path: Path, software: str) -> None:
    said = PngInfo()
    said.add_text("Software", software)
    Image.new("RGB", (2, 2)).save(path, pnginfo=said)


def _text(path: Path) -> None:
    path.write_text("mine")


def _link(path: Path) -> None:
    place = Path("user") / path.name
    foreign(place)
    path.symlink_to(place.absolute())


def _link_to_ours(path: Path) -> None:
    shutil.move(path, "user")
    path.symlink_to(Path("user", path.name).absolute())


def _dangling(path: Path) -> None:
    path.symlink_to("nowhere")


def _folder(path: Path) -> None:
    path.mkdir()
    (path / "notes.txt").write_text("mine")


def neighbours(path: Path) -> None:
    """Names that were temporary names once, a folder and a link to the user's file among them."""
    for ending in (".old", ".part"):
        path.with_name(path.name + ending).mkdir()
        (path.with_name(path.name + ending) / "notes.txt").write_text("mine")
    path.with_name(f".{path.name}.part").symlink_to(Path("user/notes.txt").absolute())
    path.with_name(f".{path.name}.mine.part").write_text("mine")


class Situation(NamedTuple):
    """What no command takes for its own: a preparation, and whether our own output is there first."""

    prepare: Callable[[Path], None]
    over_ours: bool = False


SITUATIONS = {
    "a text": Situation(_text),
    "the format, of another program": Situation(foreign),
    "a folder with foreign files": Situation(_folder),
    "a symbolic link": Situation(_link),
    "a symbolic link to our own": Situation(_link_to_ours, over_ours=True),
    "a symbolic link to nothing": Situation(_dangling),
}
