"""Defines what a check finds: a sentence with its evidence, and what mends it."""

from typing import Literal, NamedTuple

Cause = Literal[
    "stamps",
    "lost messages",
    "clock",
    "delay",
    "unit",
    "scale",
    "sign",
    "gravity",
    "quaternion",
    "mounting",
    "covariance",
    "values",
    "magnetometer",
    "place",
    "name",
]
Surety = Literal["fact", "likely", "hint"]  # counted in the log; far from chance; may well be meant so


class Finding(NamedTuple):
    """Describes a fault that no filter is needed to see.

    Attributes:
        cause: what kind of fault it is.
        topic, field: where it is; of stamps the field is empty.
        value: by how much, in the words of the sentence: a factor, seconds, radians or a share.
        words: a sentence with the evidence.
        key, setting: what `--set KEY=SETTING` undoes it with when the log is replayed; empty where
            nothing does.
        mapping: what the import's mapping would have to say, or the log's writer to do.
        sure: whether it is a fact, likely, or a hint at what may be meant so.
    """

    cause: Cause
    topic: str
    field: str
    value: float
    words: str
    key: str = ""
    setting: float | str = ""
    mapping: str = ""
    sure: Surety = "likely"

    @property
    def mended(self) -> str:
        """Return the sentence, with what to do."""
        tries = [f"--set {self.key}={self.setting}"] * bool(self.key) + [self.mapping]
        return "; ".join(filter(None, (self.words, " or ".join(filter(None, tries)))))


def digits(value: float) -> float:
    """Return a number in four digits, as a setting states it."""
    return float(f"{value:.4g}")
