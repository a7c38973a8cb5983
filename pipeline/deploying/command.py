"""The command `fuselog deploy`: it writes a filter as C, and says how to build it."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.deploying.deploying import deploy
from pipeline.output.terminal import say
from pipeline.runs.settings import settings_of_estimators


def deploy_filter(
    name: str,
    settings_file: Path | None,
    settings: Sequence[str],
    *,
    log: Path,
    model: str | None,
    out: Path,
    single: bool,
) -> None:
    """Write a filter into a folder."""
    chosen = settings_of_estimators([name], settings, settings_file, model=model)
    folder = deploy(log, chosen, out, single=single)
    say(f"{folder}: {', '.join(sorted(each.name for each in folder.iterdir()))}")
    say(f"{folder / 'README.md'} says how to build, test and replay it")
