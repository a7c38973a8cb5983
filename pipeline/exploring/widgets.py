"""The sliders, buttons, choices and time axis of the page, as Bokeh widgets."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from bokeh.layouts import row
from bokeh.models import Button, Range1d, Select
from bokeh.models import Slider as SliderWidget

from fuselog.pipeline.exploring.markup import SIDE
from fuselog.pipeline.exploring.plots import COLOURS
from fuselog.pipeline.exploring.sliders import STEPS, Slider
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
    """Make the range of all plots over time, whose label states its zero."""
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
