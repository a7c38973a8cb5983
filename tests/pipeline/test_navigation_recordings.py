"""Recordings as a user meets them: imported by the mapping that ships, replayed as the messages say."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

CORRECTIONS = 2


@pytest.mark.paper
@pytest.mark.parametrize(
    ("mapping", "folder"),
    [
        ("quadrotor", "quad_mimu/path_1"),
        ("walk", "gnss_imu_rtk/walk_0827"),
        ("uwb-lias", "uwb_lias"),
        ("uwb-outdoor", "uwb_outdoor/LOS/Trajectory_A/Case_1"),
    ],
)
def test_each_message_leads_on_to_a_run_that_works(
    fuselog: Callable[..., Any], navigation: Path, tmp_path: Path, mapping: str, folder: str
) -> None:
    """The options that a message of `replay` names are all that is added, at most twice."""
    log, options = tmp_path / "own.mcap", []
    place = str(navigation / folder)
    assert fuselog("import", "table", place, "--mapping", mapping, "-o", str(log)).code == 0
    for _ in range(CORRECTIONS):
        said = fuselog("replay", str(log), "-e", "ekf", "-o", str(tmp_path / "e.mcap"), *options)
        if said.code == 0:
            break
        assert said.code == 2
        named = re.findall(r"--(?:set|model) [\w.-]+(?:=[^\s,]+)?", said.err)
        assert named, said.err
        alternatives = named[:1] if "--model" in named[0] else named
        options += [word for each in alternatives for word in shlex.split(each)]
    else:
        said = fuselog("replay", str(log), "-e", "ekf", "-o", str(tmp_path / "e.mcap"), *options)
    assert said.code == 0, said.err
