"""What lint, info, diagnose and the report say of one log: the same findings, in the same words."""

from collections.abc import Callable
from typing import Any

import numpy as np

ODOMETRY, FIX = "/car/odometry", "/car/fix"
Fuselog = Callable[..., Any]


def column(topic: str, name: str, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    return {"topic": topic, "columns": {name: change}}


def clipped(rate: np.ndarray) -> np.ndarray:
    end = np.quantile(np.abs(rate), 0.9)
    return np.clip(rate, -end, end)
