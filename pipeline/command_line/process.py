"""The command line as a process: exit codes, signals, and messages for errors."""

import atexit
import io
import logging
import math
import os
import shlex
import signal
import sys
import threading
import time
from _thread import interrupt_main
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

import click

from fuselog.pipeline.command_line.group import fuselog
from fuselog.recorders import environment
from fuselog.recorders.compiling.trial import require_processor
from fuselog.recorders.errors import BadInput, printable, without_warnings_of_numbers
from fuselog.recorders.processes import collect_garbage_seldom, keep_off_settings_here
from fuselog.recorders.remote.backends import masked


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code, which is 2 after a user's mistake.

    FUSELOG_TRACEBACK=1 shows the traceback of an error, for authors of estimators.

    Args:
        arguments: arguments of the command; by default those of this process. With the default, the
            function collects garbage less often, and ends the process.
    """
    if arguments is None:
        collect_garbage_seldom()
        try:
            code = _code_of(arguments)
        except Exception:
            sys.excepthook(*sys.exc_info())
            code = 1
        _end(code)
    return _code_of(arguments)


def _end(code: int) -> NoReturn:
    """End the process as Python does, but without freeing objects, which takes 20 % of short runs.

    Threads are left running: Python up to 3.13 terminates them, which aborts the process if a thread
    is in NumPy's C++ code or holds the lock of standard error.
    """
    for act in (atexit._run_exitfuncs, sys.stdout.flush):
        with suppress(KeyboardInterrupt, OSError):
            act()
    os._exit(code)


def _code_of(arguments: Sequence[str] | None) -> int:
    """Run the command line, print any error as one sentence, and return the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file name may not fit the encoding
    logging.basicConfig(format="fuselog: %(message)s")
    if sys.stderr.isatty():  # standard error is a terminal
        logging.getLogger("fuselog").setLevel(logging.INFO)
    try:
        with _stopped_by_signals(), without_warnings_of_numbers():
            keep_off_settings_here()
            environment.check()
            require_processor()
            code = fuselog(arguments, prog_name="fuselog", standalone_mode=False)
            print(end="", flush=True)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return 2
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        return _fail(error.format_message().rstrip(".") + hint)
    except (click.Abort, KeyboardInterrupt) as error:
        click.echo("fuselog: stopped", err=True)
        cause = error.__cause__ or error  # click wraps the interrupt
        return 128 + (cause.number if isinstance(cause, Stopped) else signal.SIGINT)
    except BrokenPipeError:
        _drop_output()
        return 1
    except (BadInput, OSError, MemoryError) as error:
        if environment.is_set(environment.TRACEBACK):
            raise
        place = "" if _drop_output() else "standard output"
        return _fail(_sentence(error, place or f"fuselog {shlex.join(arguments or sys.argv[1:])}"))
    return code or 0


# The longest message in characters; a path alone may have 4096.
_LONGEST = 10_000


class Stopped(KeyboardInterrupt):
    """The exception for a signal that asks the process to end; it is treated like Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Convert signals that end the process to exceptions, so that unfinished files are removed.

    A signal that arrives in a finalizer is sent again, because Python ignores exceptions there.
    """
    last_s = -math.inf
    report = sys.unraisablehook

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal last_s
        while frame is not None:
            if frame.f_code is again.__code__:  # on a busy machine the hook may still be running
                send_soon(number)
                return
            frame = frame.f_back
        before_s, last_s = last_s, time.monotonic()
        if number == signal.SIGINT or last_s - before_s > 1.0:  # `timeout` signals process and group
            raise Stopped(number)

    def again(lost: "sys.UnraisableHookArgs") -> None:
        nonlocal last_s
        if isinstance(lost.exc_value, Stopped):
            last_s = -math.inf
            send_soon(lost.exc_value.number)
        else:
            report(lost)

    def send_soon(number: int) -> None:
        threading.Timer(0.01, interrupt_main, [number]).start()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = {"SIGTERM": signal.SIG_DFL, "SIGHUP": signal.SIG_DFL, "SIGINT": signal.default_int_handler}
    asked = {
        getattr(signal, name): handler
        for name, handler in usual.items()
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is handler
    }
    for number in asked:
        signal.signal(number, stop)
    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = report
        for number, handler in asked.items():
            signal.signal(number, handler)


def _sentence(error: Exception, place: str) -> str:
    """Describe an error and where it happened; `place` is used if the error names no place."""
    if isinstance(error, OSError):
        place = os.fsdecode(error.filename) if error.filename else place
        return f"{place}: {error.strerror or error}"
    if isinstance(error, MemoryError):
        why = f" ({error})" if str(error) else ""
        return f"not enough memory; use fewer runs or a shorter duration{why}"
    return str(error)


def _fail(sentence: str) -> int:
    line = masked(printable(sentence.strip().replace("\n", " ")))
    if len(line) > _LONGEST:
        line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"
    click.echo(f"fuselog: {line}", err=True)
    return 2


def _drop_output() -> bool:
    """Test whether standard output can be written to; if not, discard all further output."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True
