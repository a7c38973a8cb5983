"""The result of a check: its location, evidence, severity and correction."""

import warnings
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from fuselog.recorders.log import Stream

Kind = Literal[
    # Findings about a log, without a filter.
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
    # Findings about a filter's innovations and estimates.
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
    # Findings about a judged replay.
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
# Names of the previous release: in lint's findings, in sentences of a diagnosis, in warnings.
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
    """One fault of a log, of a filter, or of its estimates.

    Attributes:
        kind: kind of fault.
        where: topic or parameter; for a judged replay the estimator.
        part: field of the topic; for a judged replay the case.
        value: size of the fault, as in the evidence: a factor, seconds, radians or a share; for a judged
            replay the ratio of a statistic to its bound for a consistent filter.
        evidence: what was found, in a sentence.
        setting: value for `--set` that corrects the fault in a replay, such as `/fix.delay_s=0.3`; empty
            if no setting corrects it.
        otherwise: another correction, such as a line of the import's mapping.
        severity: whether the finding is a fact, likely, or only a hint.
        time_ns: when the fault began, if known.
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
        """Describe the correction; return "" if no correction is known."""
        return " or ".join(filter(None, (self.setting and f"--set {self.setting}", self.otherwise)))

    @property
    def sentence(self) -> str:
        """Join the evidence and the correction."""
        return "; ".join(filter(None, (self.evidence, self.fix)))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> object:
            """Return the attribute for a name of the previous release, with a FutureWarning."""
            if name == "cause":  # only findings of a likelihood have one
                return None
            if name not in _OLD:
                raise AttributeError(f"'{type(self).__name__}' has no '{name}'")
            warnings.warn(
                f"Finding: '{name}' was renamed to '{_OLD[name]}'; the old name will be removed in the "
                "next release",
                FutureWarning,
                stacklevel=2,
            )
            return getattr(self, _OLD[name])

    @property
    def as_json(self) -> dict[str, Any]:
        """Return the finding as `--json` prints it, with the fix in words."""
        return {**asdict(self), "fix": self.fix}


def since_first(stream: "Stream", stamp_ns: int) -> str:
    """Describe a stamp by the time since the topic's first stamp."""
    since_ns = int(stamp_ns) - int(stream.publish_time_ns.min())
    return f"{since_ns * 1e-9:.4g} s after its first stamp"


def digits(value: float) -> float:
    """Round a number to four digits, for use in a setting."""
    return float(f"{value:.4g}")
