"""The texts of the page as HTML, by the macros of its template: verdicts, numbers, labels of sliders."""

from collections.abc import Iterable, Mapping
from typing import Any

from fuselog.pipeline.exploring.curves import LINES, Case
from fuselog.pipeline.exploring.plots import COLOURS, PINNED, QUIET, RED
from fuselog.pipeline.exploring.session import Played
from fuselog.pipeline.exploring.sliders import Slider, in_words
from fuselog.pipeline.exploring.verdict import LIKELIHOOD, Summary, numbers_of
from fuselog.pipeline.output.pages import templates
from fuselog.pipeline.output.words import MINUS, number

SIDE = 300  # the width of the sliders' column, in pixels
SLOW_S = 1.0  # a replay that takes longer than this, in s, is reported


def head_html(
    labels: Iterable[str], played: Mapping[int | str, Played], case: str, estimated: Mapping[str, Slider]
) -> str:
    """Write the text above the plots: verdicts, numbers, and estimates of parameters."""
    return str(MACROS.head(labels, played, case, estimated, SLOW_S))


def in_the_state(case: Case, estimated: Mapping[str, Slider]) -> list[str]:
    """Describe the final estimates of the parameters that are in a filter's state."""
    found = []
    for name, slider in estimated.items():
        if name in case.beside and len(case.time_s):
            sigma = float(case.sigma[-1, case.components.index(name)])
            value = slider.words(float(case.beside[name][-1]))
            found.append(f"Estimated in the state: {slider.title} is {value} at the end, "
                         f"±{slider.words(1.96 * sigma)} (95 %).")  # fmt: skip
    return found


def _numbers_of(played: Played | None, case: str) -> Mapping[str, tuple[float, str]]:
    return numbers_of(played.cases[case]) if played and case in played.cases else {}


def _with_unit(name: str, value: float, unit: str) -> str:
    if name == LIKELIHOOD:
        return f"{value:,.0f}".replace("-", MINUS)
    return in_words(value, unit) if unit else number(value)


_KNOWN = {
    "width": SIDE - 20,
    "colours": COLOURS,
    "quiet": QUIET,
    "red": RED,
    "pinned": PINNED,
    "most": LINES,
    "no_estimates": Summary("failed", "The filter returned no estimates.", ""),
}
_FILTERS = {"in_the_state": in_the_state, "numbers_of": _numbers_of, "with_unit": _with_unit}
MACROS: Any = (
    templates("fuselog.pipeline.exploring", _FILTERS).get_template("markup.html", None, _KNOWN).module
)
