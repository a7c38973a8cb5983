"""Search for logs in folders."""

from pathlib import Path

from fuselog.recorders.errors import BadInput


def logs_in(path: Path) -> list[Path]:
    """List a folder's logs by name, without the estimates beside them; of another path that path.

    Raises BadInput where a folder has none.
    """
    if not path.is_dir():
        return [path]
    files = recordings_in(path)
    if not files:
        raise BadInput(f"{path}: has no logs to replay; give a log, or a folder or result with some")
    return files


def recordings_in(folder: Path) -> list[Path]:
    """List a folder's logs by name, without the estimates beside them; none where it is no folder."""
    return [each for each in sorted(folder.glob("*.mcap")) if not each.match("*.estimates.mcap")]
