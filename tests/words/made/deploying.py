"""Made cases of `fuselog deploy`: the folders that it writes, and what it says of single precision."""

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from fuselog.pipeline.api.api import record, write
from fuselog.pipeline.deploying import certificate
from fuselog.pipeline.deploying.c_replay import why_no_replay
from fuselog.pipeline.deploying.deploying import deploy
from fuselog.pipeline.deploying.folder import lost_sentence
from tests.replay.estimators.test_attitude import carried

_DIGEST = re.compile(r"\b[0-9a-f]{16}\b")


def lost() -> Iterator[str]:
    """Single precision in which a covariance is lost, of a plain filter and of a square-root form."""
    for is_root in (False, True):
        yield lost_sentence({"lost_event": 111, "lost_s": 1.11}, is_root=is_root)


def written() -> Iterator[str]:
    """The sentences of the pages of three filters, those of an earlier one left out."""
    memory = certificate.Memory("a compiler", 1234, 567)
    single = certificate.Single(2.5e-6, 89, None, None)
    said: set[str] = set()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder / "robot.mcap", record("landmarks", seed=7, duration_s=1.0))
        write(folder / "carried.mcap", [carried()[0].take(slice(0, 200))])
        for place, log, label, model, found in (
            ("plain", "robot", "ekf", "robot", (memory, None)),
            ("root", "robot", "sqrt:ukf", "robot", (memory, single)),
            ("sampled", "carried", "ukf", "orientation", (None, None)),
        ):
            out, options = folder / place / "own", {"single": place == "root", "model": model}
            with patch.object(certificate, "_compiled", lambda *_, found=found: found):
                deploy(folder / f"{log}.mcap", label, out, **options)
            page = _DIGEST.sub("DIGEST", (out / "README.md").read_text(encoding="utf-8"))
            lines = dict.fromkeys(line for line in page.splitlines() if line and line[0] != "|")
            yield from (line for line in lines if line not in said)
            said |= lines.keys()


def unreplayed() -> Iterator[str]:
    """Why fuselog cannot replay a filter in C, and that it can."""
    plain = {"topic": "fix", "name": "fix", "read": None, "is_numbered": False}
    for name, interpolated, control, fallbacks, geodetic, sensor in (
        ("well", False, None, [], [], {}),
        ("interpolated", True, None, [], [], {}),
        ("of messages", False, None, ["fix"], [], {}),
        ("control", False, SimpleNamespace(read=len), [], [], {}),
        ("geodetic", False, None, [], [SimpleNamespace(name="fix")], {}),
        ("sensor", False, SimpleNamespace(read=None), [], [], {"read": len}),
        ("point", False, None, [], [], {"is_numbered": True}),
    ):
        sensors = [SimpleNamespace(**{**plain, **sensor})]
        filtering = SimpleNamespace(
            bound_model=SimpleNamespace(model=SimpleNamespace(control=control), sensors=sensors),
            found=SimpleNamespace(fallbacks=fallbacks, geodetic=geodetic),
        )
        made: Any = SimpleNamespace(filtering=filtering, is_interpolated=interpolated)
        yield f"{name}: {why_no_replay(made) or 'nothing'}"


DEPLOYED = (lost, unreplayed, written)
