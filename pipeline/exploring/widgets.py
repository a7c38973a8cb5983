"""The sliders, buttons, choices and time axis of the page as Bokeh widgets, and its texts as HTML."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from bokeh.layouts import row
from bokeh.models import Button, Range1d, Select
from bokeh.models import Slider as SliderWidget

from fuselog.pipeline.exploring.curves import LINES, Case
from fuselog.pipeline.exploring.plots import COLOURS, PINNED, QUIET, RED
from fuselog.pipeline.exploring.session import LIKELIHOOD, Played, Summary, numbers_of
from fuselog.pipeline.exploring.sliders import STEPS, Slider, in_words
from fuselog.pipeline.output.pages import templates
from fuselog.pipeline.output.words import MINUS, number
from fuselog.recorders.recording import SIMULATION_EPOCH_NS

NONE = "none"
A_ROW = 2  # number of buttons in a row
YEAR_2000_NS = 946_684_800_000_000_000  # clocks before this do not show the date
# Bokeh's sliders have no name for screen readers, and their value is a position from 0 to 1. Tags
# contain both as words.
NAME_SLIDERS = """
const view = Bokeh.Models.get("Slider").prototype.default_view.prototype;
const render = view.render;
view.render = function () {
  render.call(this);
  const say = () => {
    const handle = this.slider_el.querySelector(".noUi-handle");
    const [name, words] = this.model.tags;
    handle.setAttribute("aria-label", name);
    handle.setAttribute("aria-valuetext", words);
  };
  this._noUiSlider.on("update", say);
  this.on_change(this.model.properties.tags, say);
};
"""

SIDE = 300  # the width of the sliders' column, in pixels
SLOW_S = 1.0  # a replay that takes longer than this, in s, is reported


def widget_of(slider: Slider, value: float) -> Any:
    """Make the slider of a parameter, with positions from 0 to 1."""
    return SliderWidget(
        start=0.0,
        end=1.0,
        step=1.0 / STEPS,
        value=min(max(slider.place(value), 0.0), 1.0),
        title="",
        show_value=False,
        tooltips=False,
        width=SIDE - 20,
        margin=(0, 5, 0, 5),
        name=slider.name,
        tags=tags_of(slider, value),
        bar_color=COLOURS[0],
    )


def tags_of(slider: Slider, value: float) -> list[str]:
    """Return the text of a slider for screen readers, with its group, name and value."""
    return [f"{slider.title}, {slider.group}", slider.words(value)]


def time_range(epoch_ns: int) -> Range1d:
    """Make the range of all plots over time; its label states the zero of time."""
    if epoch_ns == SIMULATION_EPOCH_NS or epoch_ns < YEAR_2000_NS:
        return Range1d(0.0, 1.0, name="time since the log began (s)")
    began = datetime.fromtimestamp(epoch_ns // 10**9, UTC)
    return Range1d(0.0, 1.0, name=f"seconds since {began:%Y-%m-%d %H:%M:%S} UTC")


def filter_choices(filters: Iterable[str], names: Sequence[str]) -> list[Any]:
    """Make the menus of both filters; the second one may be "none"."""
    width = (SIDE - 20) // 2
    first, second = [*filters, NONE][:2]
    return [
        Select(title="Filter", name="filter", options=names, value=first, width=width),
        Select(title="Second", name="second", options=[NONE, *names], value=second, width=width),
    ]


def buttons(acts: Mapping[str, Callable[[], None]]) -> list[Any]:
    """Make rows of buttons from actions by label."""
    made = []
    for label, act in acts.items():
        button = Button(label=label, name=label, width=(SIDE - 10 * A_ROW) // A_ROW)
        button.on_click(act)
        made.append(button)
    return [row(*made[first : first + A_ROW]) for first in range(0, len(made), A_ROW)]


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
