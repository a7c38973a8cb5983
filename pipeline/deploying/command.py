"""The command `fuselog deploy`, which writes a filter as C and prints how to build it."""

import json
from collections.abc import Sequence
from pathlib import Path

from fuselog.pipeline.deploying.certificate import CERTIFICATE
from fuselog.pipeline.deploying.deploying import deploy
from fuselog.pipeline.deploying.folder import lost_sentence
from fuselog.pipeline.output.terminal import print_json, say
from fuselog.pipeline.runs.settings import settings_of_estimators


def deploy_filter(
    name: str,
    settings_file: Path | None,
    settings: Sequence[str],
    *,
    log: Path,
    model: str | None,
    out: Path,
    single: bool,
    as_json: bool,
) -> None:
    """Write a filter to a folder, and print the contents of the folder or, as JSON, its certificate."""
    chosen = settings_of_estimators([name], settings, settings_file, model=model)
    folder = deploy(log, chosen, out, single=single)
    certificate = json.loads((folder / CERTIFICATE).read_text(encoding="utf-8"))
    if as_json:
        print_json(certificate)
        return
    say(f"{folder}: {', '.join(sorted(each.name for each in folder.iterdir()))}")
    say(f"{folder / 'README.md'} explains how to build, test and replay it")
    cost = certificate["single"]
    if cost and cost["lost_event"] is not None:
        say(lost_sentence(cost, is_root=certificate["is_root"]))
