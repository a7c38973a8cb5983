"""Defines what a check finds: where, a sentence with its evidence, how severe it is, and its fix."""

import warnings
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

Kind = Literal[
    # Of a log: what it says without a filter.
    "stamps",
    "lost messages",
    "gap",
    "clock drift",
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
    # Of a filter's innovations and estimates.
    "measurement noise",
    "process noise",
    "factor or sign",
    "bias or turned frame",
    "drifting bias",
    "parameter",
    "exchanged axes",
    "convention",
    "exchanged numbers",
    "start",
    "outliers",
    "gate",
    "covariance floor",
    "divergence",
    "unseen error",
    "unnamed",
    # Of a judged replay.
    "innovations",
    "errors",
    "uninformed",
    "origin",
    "lever arm",
    "minimum",
    "digits",
    "unused",
    "gates",
]
# What the release before called them: in lint's findings, in a diagnosis' sentences, in alarms.
_OLD = {
    "words": "sentence",
    "mended": "sentence",
    "topic": "where",
    "estimator": "where",
    "field": "part",
    "case": "part",
    "excess": "value",
    "mapping": "otherwise",
    "sure": "severity",
}
Severity = Literal["fact", "likely", "hint"]  # counted in the data; far from chance; may be intended


@dataclass(frozen=True)
class Finding:
    """Represents one thing that is wrong with a log, with a filter, or with what it estimates.

    Attributes:
        kind: what is wrong.
        where: the topic or parameter; of a judged replay the estimator.
        part: the field of the topic; of a judged replay the case.
        value: by how much, in the words of the evidence: a factor, seconds, radians or a share; of a
            judged replay how many times a number is beyond what a consistent filter leaves.
        evidence: a sentence.
        setting: what `--set` takes to undo it in a replay, such as `/fix.delay_s=0.3`; empty if nothing
            does.
        otherwise: what else to do, such as a line of the import's mapping.
        severity: whether it is a fact, likely, or only a hint.
        time_ns: when it began, if it began at some time.
    """

    kind: Kind
    where: str
    part: str
    value: float
    evidence: str
    setting: str = ""
    otherwise: str = ""
    severity: Severity = "likely"
    time_ns: int | None = None

    @property
    def fix(self) -> str:
        """Return what to do, in words; empty if nothing is known."""
        return " or ".join(filter(None, (self.setting and f"--set {self.setting}", self.otherwise)))

    @property
    def sentence(self) -> str:
        """Return the evidence, with what to do."""
        return "; ".join(filter(None, (self.evidence, self.fix)))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> object:
            """Return what the release before called so, with a FutureWarning."""
            if name == "cause":  # only what a likelihood names has one
                return None
            if name not in _OLD:
                raise AttributeError(f"'{type(self).__name__}' has no '{name}'")
            warnings.warn(
                f"Finding: '{name}' is called '{_OLD[name]}' now; the old name goes in the next release",
                FutureWarning,
                stacklevel=2,
            )
            return getattr(self, _OLD[name])

    @property
    def as_json(self) -> dict[str, Any]:
        """Return it as `--json` prints it, with the fix in words."""
        return {**asdict(self), "fix": self.fix}


def digits(value: float) -> float:
    """Return a number in four digits, as a setting states it."""
    return float(f"{value:.4g}")
