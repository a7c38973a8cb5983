"""Makes the page's sliders, buttons and choices, as Bokeh has them."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from bokeh.layouts import row
from bokeh.models import Button, Select
from bokeh.models import Slider as SliderWidget

from pipeline.exploring.markup import SIDE
from pipeline.exploring.plots import COLOURS
from pipeline.exploring.sliders import STEPS, Slider
from replay.inference.all_methods import METHODS

NONE = "none"
A_ROW = 2  # buttons
NO_FILTERS = ("bound",)  # methods that estimate nothing


def widget_of(slider: Slider, value: float) -> Any:
    """Return the slider of a parameter, from 0 to 1, at its value."""
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
        bar_color=COLOURS[0],
    )


def filter_choices(filters: Iterable[str]) -> list[Any]:
    """Choices of the first filter and of the second, which may be none: those at hand, and methods."""
    width = (SIDE - 20) // 2
    names = list(dict.fromkeys([*filters, *(each for each in METHODS if each not in NO_FILTERS)]))
    first, second = [*filters, NONE][:2]
    return [
        Select(title="Filter", name="filter", options=names, value=first, width=width),
        Select(title="Second", name="second", options=[NONE, *names], value=second, width=width),
    ]


def buttons(acts: Mapping[str, Callable[[], None]]) -> list[Any]:
    """Rows of buttons, by label."""
    made = []
    for label, act in acts.items():
        button = Button(label=label, name=label, width=(SIDE - 10 * A_ROW) // A_ROW)
        button.on_click(act)
        made.append(button)
    return [row(*made[first : first + A_ROW]) for first in range(0, len(made), A_ROW)]
