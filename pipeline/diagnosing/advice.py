"""Describes what to try after a diagnosis: a setting that undoes a fault."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, NamedTuple


class Advice(NamedTuple):
    """Describes what undoes a fault.

    Attributes:
        key: of the setting, a parameter or `/TOPIC.WHAT`.
        value: of the setting.
        free: the parameter that may be tuned instead.
        otherwise: what may be done instead, in words.
        more: what is set beside it, by its key.
        is_moved: whether the value is metres along several axes, to which those that are set are added.
    """

    key: str
    value: float | str
    free: str = ""
    otherwise: str = ""
    more: tuple[tuple[str, float | str], ...] = ()
    is_moved: bool = False

    @classmethod
    def of(cls, setting: str) -> "Advice":
        """Return a setting as `--set` takes it."""
        key, _, text = setting.partition("=")
        try:
            return cls(key, float(text))
        except ValueError:
            return cls(key, text)

    @property
    def settings(self) -> dict[str, float | str]:
        """Return what is set, by its key."""
        return {self.key: self.value, **dict(self.more)}

    @property
    def setting(self) -> str:
        """Return the settings as `--set` takes them, one or several."""
        return " ".join(f"{key}={value}" for key, value in self.settings.items())


@dataclass(frozen=True)
class Trying:
    """Describes how advice is followed.

    Attributes:
        label: the estimator's; in a command, what names it there.
        applied: how the log is altered already.
        is_own: whether no command can name the estimator, as one of a Python program.
        gate: the probability of the gate that is set.
    """

    label: str
    applied: Mapping[str, Any]
    is_own: bool
    gate: float = 1.0

    def is_set(self, advice: Advice) -> bool:
        """Tell whether the advice is a gate, and one as narrow is set already."""
        return advice.key == "gate_probability" and self.gate <= float(advice.value)

    def over(self, advice: Advice) -> Advice:
        """Return the advice as the total to set: with what is set already, which it would replace."""
        before, now = self.applied.get(advice.key), advice.value
        if advice.is_moved and before is not None:
            both = zip_longest(
                *(map(float, str(each).split(",")) for each in (before, now)), fillvalue=0.0
            )
            return advice._replace(value=",".join(f"{precise(sum(each))}" for each in both))
        if isinstance(before, bool) or not isinstance(before, int | float) or isinstance(now, str):
            return advice
        is_factor = advice.key.endswith("_scale")
        return advice._replace(value=precise(before * now if is_factor else before + now))

    def words(self, advice: Advice) -> str:
        """Return what to type."""
        if self.is_own:
            line = f"set={json.dumps(advice.settings)}"
            tuning = f'fl.tune(LOG, {{"{self.label}": ...}}, "{advice.free}")'
        else:
            given = [f"{key}={value}" for key, value in advice.settings.items()]
            quoted = [f"'{each}'" if set(each) & set(" $&;()") else each for each in given]
            line = " ".join(f"--set {each}" for each in quoted)
            tuning = f"fuselog tune LOG -e {self.label} --free {advice.free}"
        instead = tuning if advice.free else advice.otherwise
        return f"{line}, or {instead}" if instead else line


def rounded(value: float) -> float:
    """Return a number in three digits, as a setting states it."""
    return float(f"{value:.3g}")


def precise(value: float) -> float:
    """Return a number in four digits, as a setting of a topic states it."""
    return float(f"{value:.4g}")


def number(value: float, digits: int = 3) -> str:
    """Write a number in so many digits, without an exponent where it is read without.

    >>> number(1912.3), number(-0.25), number(2.4e12)
    ('1,910', '-0.25', '2.4e+12')
    """
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if 10.0**digits <= abs(rounded) < 1e9 else f"{value:.{digits}g}"
