"""Advice after a diagnosis, as settings that correct a fault."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, NamedTuple


class Advice(NamedTuple):
    """Settings that correct a fault.

    Attributes:
        key: the setting to change, a parameter or `/TOPIC.WHAT`.
        value: its new value.
        free: the parameter that can be tuned instead.
        otherwise: what else can be done, in words.
        more: further settings that are needed together with `key`.
        is_moved: whether the value is a shift in metres along several axes, which is added to a shift
            that is already set.
    """

    key: str
    value: float | str
    free: str = ""
    otherwise: str = ""
    more: tuple[tuple[str, float | str], ...] = ()
    is_moved: bool = False

    @classmethod
    def of(cls, setting: str) -> "Advice":
        """Parse a setting in the form that `--set` accepts."""
        key, _, text = setting.partition("=")
        try:
            return cls(key, float(text))
        except ValueError:
            return cls(key, text)

    @property
    def settings(self) -> dict[str, float | str]:
        """Return all settings by key."""
        return {self.key: self.value, **dict(self.more)}

    @property
    def setting(self) -> str:
        """Return the settings in the form that `--set` accepts, separated by blanks."""
        return " ".join(f"{key}={value}" for key, value in self.settings.items())


@dataclass(frozen=True)
class Trying:
    """The replay for which advice is given.

    Attributes:
        label: the label of the estimator, or its name in a command.
        applied: the alterations that the log already has.
        is_own: whether no command can name the estimator because a Python program defines it.
        gate: the probability of the gate in the settings.
    """

    label: str
    applied: Mapping[str, Any]
    is_own: bool
    gate: float = 1.0

    def is_set(self, advice: Advice) -> bool:
        """Test whether the advice is a gate, and a gate that is at least as narrow is already set."""
        return advice.key == "gate_probability" and self.gate <= float(advice.value)

    def over(self, advice: Advice) -> Advice:
        """Combine the advice with the value that is already set and would be replaced."""
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
        """Return the command or setting to type."""
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
    """Round a number to three digits, as is done for parameters."""
    return float(f"{value:.3g}")


def precise(value: float) -> float:
    """Round a number to four digits, as is done for settings of topics."""
    return float(f"{value:.4g}")


def number(value: float, digits: int = 3) -> str:
    """Format a number with `digits` digits, without an exponent if it is readable without one.

    >>> number(1912.3), number(-0.25), number(2.4e12)
    ('1,910', '-0.25', '2.4e+12')
    """
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if 10.0**digits <= abs(rounded) < 1e9 else f"{value:.{digits}g}"
