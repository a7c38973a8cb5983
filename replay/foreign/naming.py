"""Says how programs of others are named: `lib:PATH` and `exec:COMMAND`, and where they may be named.

What runs has to be named where a person speaks: in a command, a Python call, the experiment's file that
is given. There the text becomes `Allowed`. What is read of goldens, results, settings files and logs is
mere text, and so is refused; nothing that writes and reads keeps the mark.
"""

import re
import shlex
from collections.abc import Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from fuselog.recorders.errors import BadInput

KINDS = {"lib": "path", "exec": "command"}  # and the entry that says what is run
_INTERPRETER = re.compile(
    r"(python|pypy|ruby|perl|node|julia|java|Rscript|octave|bash|sh)[\d.]*(\.exe)?"
)


class Allowed(str):
    """Represents the path or command of a program that may be run."""

    __slots__ = ()


def shorthand(name: str) -> tuple[str, dict[str, Any]]:
    """Return the label and the settings that an estimator's name stands for.

    >>> shorthand("lib:./filters/libmine.so")
    ('libmine', {'kind': 'lib', 'path': './filters/libmine.so'})
    >>> shorthand("exec:python my.py {log} {out}")[0], shorthand("ekf")
    ('my', ('ekf', {}))
    >>> shorthand("exec:./mine --at host:80")[1]["command"]
    './mine --at host:80'
    """
    kind, colon, rest = name.partition(":")
    if not colon or kind not in KINDS:
        return name, {}
    if not rest.strip():
        raise BadInput(f"-e {name}: names no {KINDS[kind]}; give it behind the colon")
    return _label(kind, rest), {"kind": kind, KINDS[kind]: Allowed(rest)}


def name_of(label: str, settings: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the name that stands for an estimator, and the settings that it does not stand for.

    >>> name_of("mine", {"kind": "lib", "path": "./mine.so", "speed": 2.0})
    ('lib:./mine.so', {'speed': 2.0})
    >>> name_of("other", {"kind": "ekf"}), name_of("ekf", {"kind": "ekf"})
    (('other', {'kind': 'ekf'}), ('ekf', {}))
    """
    kind = settings["kind"]
    if kind == label:
        return label, {name: value for name, value in settings.items() if name != "kind"}
    if isinstance(kind, str) and kind in KINDS:
        name = f"{kind}:{settings[KINDS[kind]]}"
        if shorthand(name)[0] == label:
            stood_for = ("kind", KINDS[kind])
            return name, {key: value for key, value in settings.items() if key not in stood_for}
    return label, dict(settings)


def _label(kind: str, rest: str) -> str:
    """Take the stem of a library or program; of a script where an interpreter comes first."""
    words = [rest]
    if kind == "exec":
        words = split_command(rest)
        behind = [word for word in words[1:] if not word.startswith("-")]
        words = behind[:1] if behind and _INTERPRETER.fullmatch(Path(words[0]).name) else words[:1]
    return re.sub(r"[^\w=-]+", "-", Path(words[0]).name.partition(".")[0]).strip("-") or kind


def split_command(command: str) -> list[str]:
    """Return the words of a command; raises BadInput where a quote is open."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise BadInput(f"exec:{command}: is no command ({error}); close the quote") from None
    if not words:
        raise BadInput("exec: names no command; give it behind the colon")
    return words


def allowed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings, of one estimator or by label, as a person stated them: programs may be run.

    >>> isinstance(allowed({"mine": {"kind": "lib", "path": "mine.so"}})["mine"]["path"], Allowed)
    True
    """
    return {
        name: allowed(value)
        if isinstance(value, Mapping)
        else Allowed(value)
        if isinstance(value, str) and name in KINDS.values()
        else value
        for name, value in settings.items()
    }


def allowed_in(settings: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return settings by label as an experiment's file states them: paths count from its folder."""
    found = allowed(settings)
    for own in found.values():
        if isinstance(own, dict) and own.get("kind") == "lib" and isinstance(own.get("path"), str):
            own["path"] = Allowed(folder / own["path"])
    return found


# Whether what files name may be run: goldens, results, settings. A command says so for itself.
_FILES_MAY: ContextVar[bool] = ContextVar("_FILES_MAY", default=False)


def allow_programs_of_files(may: bool) -> None:
    """Say whether programs may run that goldens, results and settings files name."""
    _FILES_MAY.set(may)


def of_file(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as a file has them: programs may be run only where the command says so."""
    return allowed(settings) if _FILES_MAY.get() else dict(settings)


def without_named(settings: Mapping[str, Any], named: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings without the program that was named as well, as those of `fuselog tune` have it."""
    return {
        name: value
        for name, value in settings.items()
        if name not in KINDS.values() or isinstance(value, Allowed) or value != named.get(name)
    }


def refuse_programs(tables: Mapping[str, Any], where: object) -> None:
    """Raise BadInput where settings by label, which were read of a file, name a program."""
    for label, own in tables.items():
        for entry in KINDS.values() if isinstance(own, Mapping) else ():
            if entry in own and not isinstance(own[entry], Allowed):
                raise BadInput(
                    f"{where}: {label} has {entry} = {own[entry]}, a program, which runs only where you "
                    "name it; give it with -e, or add --allow-programs"
                )


def what_runs(label: str, kind: str, settings: Mapping[str, Any]) -> str:
    """Return what is run of an estimator; raises BadInput where it may not be, or is not named."""
    text = settings.get(KINDS[kind])
    if not isinstance(text, str) or not text:
        raise BadInput(
            f"estimator {label}: kind = {kind} needs {KINDS[kind]}; on the command line -e {kind}:..."
        )
    if not isinstance(text, Allowed):
        raise BadInput(
            f"estimator {label}: a file that was read names the program {text}, which runs only where "
            f"you name it; give -e {kind}:{text}, or add --allow-programs"
        )
    return text


def program_files(settings: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Return the files of programs that settings by label name: libraries, and words of commands."""
    found = []
    for label, own in settings.items():
        kind = own.get("kind", label)
        if kind in KINDS and isinstance(stated := own.get(KINDS[kind]), str):
            found += [stated] if kind == "lib" else split_command(stated)
    return [path for path in map(Path, found) if path.is_file()]
