"""The command `fuselog calibrate`: it prints what was found, and writes the result folder."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.calibrating.calibrating import calibrate
from pipeline.tuning.command import tune_logs


def calibrate_logs(
    logs: Sequence[Path], *, fixed: Sequence[str], next_motion: bool, **options: Any
) -> None:
    """Search a model's calibration; `fixed`, `next_motion` as of `calibrate`, others of `tune_logs`."""
    tune_logs(logs, search=partial(calibrate, fixed=fixed, next_motion=next_motion), **options)
