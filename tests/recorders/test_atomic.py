"""Files and folders appear whole or not at all, and nothing that somebody else made is touched."""

import errno
import logging
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from filelock import FileLock

from fuselog.recorders import atomic
from fuselog.recorders.atomic import scratch_folder, whole_file, whole_folder
from fuselog.recorders.errors import BadInput


def contents(folder: Path) -> dict[str, str]:
    """All files and links below a folder, and what they say."""
    return {
        str(path.relative_to(folder)): str(path.readlink()) if path.is_symlink() else path.read_text()
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }


def refuse(_: Path) -> None:
    raise BadInput("it stays")


def accept(_: Path) -> None:
    pass


def fill(place: Path, check=accept) -> None:
    with whole_folder(place, check) as new:
        (new / "a").write_text("new")


@pytest.mark.unix
def test_what_a_user_calls_part_or_old_is_left_alone(tmp_path):
    """Not emptied, not deleted, not followed where it is a link."""
    target = tmp_path / "thesis"
    target.write_text("years")
    for name in ("r.old", "r.part"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "notes").write_text("mine")
    (tmp_path / "f.part").symlink_to(target)
    (tmp_path / "r").mkdir()
    before = contents(tmp_path)
    fill(tmp_path / "r")
    with whole_file(tmp_path / "f") as new:
        new.write_text("new")
    assert contents(tmp_path) == {**before, "r/a": "new", "f": "new"}


def test_a_place_beyond_a_folder_that_is_missing_is_the_one_beside_it(tmp_path):
    """`missing/../out` is `out`, for files and folders, before and after `missing` is there."""
    for number in (1, 2):
        with whole_file(tmp_path / "missing" / ".." / "file") as new:
            new.write_text(f"file {number}")
        with whole_folder(tmp_path / "other" / ".." / "folder", lambda _: None) as new:
            (new / "in it").write_text(f"folder {number}")
        assert (tmp_path / "file").read_text() == f"file {number}"
        assert (tmp_path / "folder" / "in it").read_text() == f"folder {number}"


def test_the_last_whole_one_of_two_writers_wins(tmp_path):
    place = tmp_path / "f"
    with whole_file(place) as first:
        with whole_file(place) as second:
            assert first != second
            second.write_text("second")
            first.write_text("first")
        assert place.read_text() == "second"
    assert contents(tmp_path) == {"f": "first"}
    with (
        pytest.raises(BadInput, match="another fuselog command is writing it"),
        whole_folder(tmp_path / "r", refuse),
    ):
        fill(tmp_path / "r")
    assert contents(tmp_path) == {"f": "first"}


def test_a_folder_that_must_stay_stays_whenever_that_is_found(tmp_path):
    """At the beginning, and also when it is so only at the end."""
    place = tmp_path / "r"
    fill(place)
    (place / "a").write_text("old")
    with pytest.raises(BadInput, match="it stays"):
        fill(place, refuse)

    def refuse_at_the_end(found: Path) -> None:
        if found != place:
            refuse(found)

    with pytest.raises(BadInput, match="it stays"):
        fill(place, refuse_at_the_end)
    assert contents(tmp_path) == {"r/a": "old"}
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


KILLED = """
    import os, signal, sys
    from pathlib import Path
    import filelock
    from fuselog.recorders import atomic
    from fuselog.recorders.atomic import whole_file, whole_folder
    for moment in range(0, 200, 5):
        child = os.fork()
        if not child:
            break
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(moment, code, flush=True)
        if code == 0:
            break
    if child:
        sys.exit()
    place = Path(sys.argv[1]) / str(moment) / sys.argv[2]
    def trace(frame, event, argument):
        global moment
        if event == "line" and frame.f_code.co_filename == atomic.__file__:
            moment -= 1
            if moment < 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return trace
    sys.settrace(trace)
    if place.suffix:
        with whole_file(place) as new:
            new.write_text("new")
    else:
        with whole_folder(place, lambda found: None) as new:
            (new / "a").write_text("new")
    sys.settrace(None)
    os._exit(0)
"""


@pytest.mark.paper
@pytest.mark.unix
@pytest.mark.parametrize(("name", "inside"), [("f.txt", "f.txt"), ("r", "r/a")])
def test_killed_at_any_line_nothing_is_lost_and_the_next_one_clears(tmp_path, name, inside):
    """SIGKILL before every fifth line: the place holds the old or the new, or gets it back."""
    for moment in range(0, 200, 5):
        folder = tmp_path / str(moment)
        (folder / inside).parent.mkdir(parents=True)
        (folder / inside).write_text("old")
        (folder / "mine").write_text("mine")
    # one process, forked before each moment: importing takes longer than what is done here
    command = [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path), name]
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    for line in said.stdout.splitlines():
        moment, code = map(int, line.split())
        folder = tmp_path / str(moment)
        assert code in (0, -9), said.stderr
        found = [
            path.read_text()
            for path in (folder / inside, *folder.glob(".*.part/old/a"))
            if path.exists()
        ]
        assert found[0] in ("old", "new")
        if name == "r":
            fill(folder / name)
        else:
            with whole_file(folder / name) as new:
                new.write_text("new")
        assert contents(folder) == {inside: "new", "mine": "mine"}
        assert len(list(folder.iterdir())) == 2
        if code == 0:
            return
    raise AssertionError("never came to the end")


def test_places_whose_names_go_on_are_others(tmp_path):
    """`r` is not `r.v2`: neither its writer nor what one left is taken for that of the other."""
    with whole_folder(tmp_path / "r.v2", refuse):
        fill(tmp_path / "r")
    left = tmp_path / ".r.v2.leftover.part"
    for name in ("old", "new"):
        (left / name).mkdir(parents=True)
        (left / name / "a").write_text(name)
    (left / "fuselog.lock").touch()
    fill(tmp_path / "r")
    assert contents(tmp_path / "r") == {"a": "new"}
    assert left.exists()
    with pytest.raises(BadInput, match="it stays"):
        fill(tmp_path / "r.v2", refuse)
    assert contents(tmp_path) == {"r/a": "new", "r.v2/a": "old"}


@pytest.mark.unix
def test_a_leftover_is_known_by_more_than_its_name(tmp_path, caplog):
    """What only looks like one stays, and that is said."""
    place = tmp_path / "f"
    user = tmp_path / ".f.user.part"
    user.mkdir()
    (user / "fuselog.lock").touch()
    (user / "notes").write_text("mine")
    (tmp_path / ".f.text.part").write_text("mine")
    link = tmp_path / ".f.link.part"
    link.symlink_to(user)
    before = contents(tmp_path)
    with caplog.at_level(logging.WARNING), whole_file(place) as new:
        new.write_text("new")
    assert contents(tmp_path) == {**before, "f": "new"}
    assert len(caplog.messages) == 3
    assert all("it is not removed" in message for message in caplog.messages)


def test_errors_of_the_disk_say_where_and_others_go_through(tmp_path):
    place = tmp_path / "new" / "f"

    def fail(error: Exception) -> None:
        with whole_file(place) as new:
            new.write_text("half")
            raise error

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(BadInput, match=r"new/f: cannot be written \(No space left on device\)"):
        fail(full)
    with pytest.raises(FileNotFoundError):
        fail(FileNotFoundError(errno.ENOENT, "No such file", "/elsewhere"))
    with pytest.raises(OSError, match="the caller's"):
        fail(OSError("the caller's"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.unix
def test_a_scratch_folder_of_a_killed_process_is_cleared(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic.tempfile, "tempdir", str(tmp_path))
    program = (
        "import os, sys, tempfile; tempfile.tempdir = sys.argv[1]\n"
        "from fuselog.recorders.atomic import scratch_folder\n"
        "with scratch_folder('work') as folder:\n"
        "    (folder / 'half').touch()\n"
        "    os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    assert len(list(tmp_path.iterdir())) == 1
    with scratch_folder("work") as folder:
        assert list(tmp_path.iterdir()) == [folder.parent]
        assert folder.stat().st_mode & 0o777 == 0o700
    assert list(tmp_path.iterdir()) == []


def test_a_working_folder_that_goes_while_it_is_looked_at_is_none(tmp_path, monkeypatch, caplog):
    """Its maker, who works beside, removes it before every line of the look in turn."""
    monkeypatch.setattr(atomic.tempfile, "tempdir", str(tmp_path))
    gone = list[bool]()
    for moment in range(100):
        left = tmp_path / ".work.other.part"
        (left / "new").mkdir(parents=True)
        (left / "fuselog.lock").touch()
        lines = iter(range(moment, -1, -1))

        def trace(frame, event, _, lines=lines, left=left):
            if frame.f_code.co_filename == atomic.__file__:
                if event == "line" and next(lines, None) == 0:
                    gone.append(left.exists())
                    shutil.rmtree(left, ignore_errors=True)
                return trace
            return None

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            with caplog.at_level(logging.WARNING), scratch_folder("work") as folder:
                (folder / "mine").touch()
        finally:
            sys.settrace(before)
        assert list(tmp_path.iterdir()) == []
    assert True in gone
    assert caplog.messages == []


def test_a_folder_that_was_taken_for_a_leftover_is_made_again(tmp_path, monkeypatch):
    """By another writer, before it was locked: its folder is gone, or filelock was making it again."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    errors = iter([FileExistsError(), FileNotFoundError()])
    acquire = FileLock.acquire

    def fail_first(lock, *given, **options):
        for error in errors:
            raise error
        return acquire(lock, *given, **options)

    monkeypatch.setattr(FileLock, "acquire", fail_first)
    with scratch_folder("mine") as folder:
        assert folder.is_dir()
