"""Names of foreign programs, `lib:PATH` and `exec:COMMAND`, and rules on which of them may run.

A program runs only if a person names it: in a command, in a Python call, or in the experiment file of a
command. The name is then marked as `Allowed`. A name that was read from goldens, results, settings files
or logs is plain text, and the program does not run; the mark is never saved in a file.
"""

import re
import shlex
from collections.abc import Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from fuselog.recorders.errors import BadInput

KINDS = {"lib": "path", "exec": "command"}  # with the setting for the path or command of the program
_INTERPRETER = re.compile(
    r"(python|pypy|ruby|perl|node|julia|java|Rscript|octave|bash|sh)[\d.]*(\.exe)?"
)


class Allowed(str):
    """Path or command of a program that may be run."""

    __slots__ = ()


def shorthand(name: str) -> tuple[str, dict[str, Any]]:
    """Expand the abbreviated name of an estimator to its label and settings.

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
        raise BadInput(f"-e {name}: no {KINDS[kind]} is given; give it after the colon")
    return _label(kind, rest), {"kind": kind, KINDS[kind]: Allowed(rest)}


def name_of(label: str, settings: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the abbreviated name of an estimator, and the settings that are not part of it.

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
    """Return the stem of the file name of a library, a program, or an interpreter's script."""
    words = [rest]
    if kind == "exec":
        words = split_command(rest)
        behind = [word for word in words[1:] if not word.startswith("-")]
        words = behind[:1] if behind and _INTERPRETER.fullmatch(Path(words[0]).name) else words[:1]
    return re.sub(r"[^\w=-]+", "-", Path(words[0]).name.partition(".")[0]).strip("-") or kind


def split_command(command: str) -> list[str]:
    """Split a command into words; raise BadInput if a quote is not closed."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise BadInput(
            f"exec:{command}: is not a valid command ({error}); close the quotation mark"
        ) from None
    if not words:
        raise BadInput("exec: no command is given; give it after the colon")
    return words


def allowed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Mark the programs in the settings of one estimator, or of several by label, as allowed.

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
    """Mark the programs in settings of an experiment file; library paths are relative to `folder`."""
    found = allowed(settings)
    for own in found.values():
        if isinstance(own, dict) and own.get("kind") == "lib" and isinstance(own.get("path"), str):
            own["path"] = Allowed(folder / own["path"])
    return found


# Whether programs named in files (goldens, results, settings) may run; each command sets this.
_FILES_MAY: ContextVar[bool] = ContextVar("_FILES_MAY", default=False)


def allow_programs_of_files(may: bool) -> None:
    """Set whether programs named in goldens, results and settings files may run."""
    _FILES_MAY.set(may)


def of_file(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Mark the programs in settings from a file as allowed, if the command allows programs of files."""
    return allowed(settings) if _FILES_MAY.get() else dict(settings)


def without_named(settings: Mapping[str, Any], named: Mapping[str, Any]) -> dict[str, Any]:
    """Remove a program from settings, for example from `fuselog tune`, if it was also named directly."""
    return {
        name: value
        for name, value in settings.items()
        if name not in KINDS.values() or isinstance(value, Allowed) or value != named.get(name)
    }


def refuse_programs(tables: Mapping[str, Any], where: object) -> None:
    """Raise BadInput if settings (by label) from a file name a program that is not allowed to run."""
    for label, own in tables.items():
        for entry in KINDS.values() if isinstance(own, Mapping) else ():
            if entry in own and not isinstance(own[entry], Allowed):
                raise BadInput(
                    f"{where}: {label} has {entry} = {own[entry]}, and a program that is named in a "
                    "file does not run; give it with -e, or add --allow-programs"
                )


def what_runs(label: str, kind: str, settings: Mapping[str, Any]) -> str:
    """Return the program of an estimator; raise BadInput if it is not named or may not run."""
    text = settings.get(KINDS[kind])
    if not isinstance(text, str) or not text:
        raise BadInput(
            f"estimator {label}: kind = {kind} needs {KINDS[kind]}; on the command line -e {kind}:..."
        )
    if not isinstance(text, Allowed):
        raise BadInput(
            f"estimator {label}: the program {text} is named in a file and therefore does not run; "
            f"give -e {kind}:{text}, or add --allow-programs"
        )
    return text


def program_files(settings: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Return the files in settings by label: libraries, and words of commands that are file names."""
    found = []
    for label, own in settings.items():
        kind = own.get("kind", label)
        if kind in KINDS and isinstance(stated := own.get(KINDS[kind]), str):
            found += [stated] if kind == "lib" else split_command(stated)
    return [path for path in map(Path, found) if path.is_file()]
