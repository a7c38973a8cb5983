"""The logs in a folder, for commands that accept folders."""

from pathlib import Path

from fuselog.recorders.errors import BadInput


def logs_in(path: Path) -> list[Path]:
    """List the logs in a folder by name, without estimates logs; return any other path as it is.

    Raises BadInput if a folder has no logs.
    """
    if not path.is_dir():
        return [path]
    files = recordings_in(path)
    if not files:
        raise BadInput(f"{path}: has no logs to replay; give a log, or a folder or result with logs")
    return files


def recordings_in(folder: Path) -> list[Path]:
    """List the logs in a folder by name, without estimates logs; return [] for any other path."""
    return [each for each in sorted(folder.glob("*.mcap")) if not each.match("*.estimates.mcap")]
