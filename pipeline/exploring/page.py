"""The page with its sliders, plots and texts, connected to a session. Replays run in the background."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.events import MouseMove
from bokeh.layouts import column, row
from bokeh.models import Div, Select, Span
from bokeh.models import Slider as SliderWidget

from fuselog.pipeline.exploring.curves import instant_of, true_path
from fuselog.pipeline.exploring.plots import (
    PINNED,
    QUIET,
    Plot,
    error_plot,
    fit_errors,
    lens_plot,
    likelihood_plot,
    ratio_plot,
    scene_plot,
    show_lens,
    show_likelihood,
    show_played,
    whiteness_plot,
)
from fuselog.pipeline.exploring.session import Played, Session
from fuselog.pipeline.exploring.sliders import Slider
from fuselog.pipeline.exploring.widgets import (
    MACROS,
    NONE,
    SIDE,
    buttons,
    filter_choices,
    head_html,
    tags_of,
    time_range,
    widget_of,
)
from fuselog.pipeline.output.words import label_of as label_of_quantity
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import schemas, topics_of

WRAP = {"flex-wrap": "wrap"}  # contents that do not fit move below, as on a phone
# The sliders are to the left of the plots, or below them on narrow screens.
SIDE_LAST = WRAP | {"flex-direction": "row-reverse", "justify-content": "flex-end"}
GROW = {"flex": "1 1 350px"}

Work = Callable[[Callable[[], bool]], None]


class Page:
    """A page that shows a session.

    Attributes:
        session: the session.
        values: values of parameters that differ from those of the log.
        played: the newest replays, by filter (0, 1, or `PINNED`).
    """

    def __init__(self, session: Session, document: Document) -> None:
        """Add the page to a document, and replay for the first time."""
        self.session, self._document = session, document
        self.values: dict[str, float] = {}
        self.played: dict[int | str, Played] = {}
        self._work = NewestFirst(self._say_error)
        self._active = session.sliders[0] if session.sliders else None
        self._at_s: float | None = None
        self._known = dict(session.filters)  # filters given by the user can be chosen again
        self._is_setting = False
        self._along: Callable[..., None] = lambda **_: None
        self._make()
        self._first()

    def end(self) -> None:
        """Stop replaying."""
        self._work.end()

    # Contents of the page.

    def _make(self) -> None:
        log = self.session.log
        status = {"role": "status"}  # screen readers announce changes
        self._head = Div(name="verdict", sizing_mode="stretch_width", html_attributes=status)
        self._sentences = Div(name="said", sizing_mode="stretch_width", html_attributes=status)
        self._command = Div(name="command", sizing_mode="stretch_width")
        self._saved = Div(name="saved", width=SIDE)
        self._cursor = Span(dimension="height", line_dash="dotted", line_color=QUIET, location=0.0)
        # its ends are set when the first estimates exist
        self._time = time = time_range(self.session.source.epoch_ns)
        self.truths = topics_of(log.topics, schemas.TRUTH_STATE)
        self.plots: dict[str, Plot] = {
            "scene": scene_plot(log, self.truths),
            "lens": lens_plot(),
            "whiteness": whiteness_plot(),
            "likelihood": likelihood_plot(),
            "error": error_plot(time, self._cursor),
            "nees": ratio_plot("nees", "NEES", time, self._cursor),
            "nis": ratio_plot("nis", "NIS per component", time, self._cursor),
        }
        for name in ("error", "nees", "nis"):
            self.plots[name].figure.on_event(MouseMove, self._move_cursor)
        self._case_choice = Select(title="Of", name="case", width=SIDE // 2 - 10)
        self._component = Select(title="Error of", name="component", width=SIDE // 2 - 10)
        self._case_choice.on_change("value", self._choose)
        self._component.on_change("value", self._choose)
        self._side = column(width=SIDE, name="side")
        self._side.html_attributes = {"role": "form", "aria-label": "Settings"}
        figures = {name: plot.figure for name, plot in self.plots.items()}
        plane = row(figures["scene"], figures["lens"], sizing_mode="stretch_width", styles=WRAP)
        left = column(plane, figures["whiteness"], figures["likelihood"], sizing_mode="stretch_width")
        right = column(figures["error"], figures["nees"], figures["nis"], sizing_mode="stretch_width")
        left.styles = right.styles = {"flex": "1 1 330px"}
        both = row(left, right, sizing_mode="stretch_width", styles=WRAP)
        words = (self._head, self._command, self._sentences)
        main = column(*words, both, sizing_mode="stretch_width", styles=GROW)
        main.html_attributes = {"role": "main"}
        self._document.add_root(row(main, self._side, sizing_mode="stretch_width", styles=SIDE_LAST))
        self._document.title = f"fuselog explore: {self.session.source.name}"
        self._fill_side()

    def _fill_side(self) -> None:
        """Fill the left column with filters, buttons and sliders."""
        session = self.session
        heading = Div(text=MACROS.heading(session.source.name), width=SIDE)
        names = list(dict.fromkeys([*self._known, *session.methods]))
        choices = filter_choices(session.filters, names)
        for choice in choices:
            choice.on_change("value", partial(self._choose_filters, choices))
        acts: dict[str, Callable[[], None]] = {
            "Tune": self._tune,
            "Diagnose": self._diagnose,
            "Pin": self._pin,
            "Reset": self._reset,
            "Estimate": self._estimate,
            "Timeline": self._timeline,
            "Save as TOML": self._save,
        }
        self._widgets: dict[str, tuple[Slider, SliderWidget, Div]] = {}
        shown: list[Any] = [
            heading,
            row(*choices),
            row(self._case_choice, self._component),
            *buttons(acts),
        ]
        group = ""
        for slider in session.sliders:
            if slider.group != group:
                group = slider.group
                shown.append(Div(text=MACROS.group(group), width=SIDE, styles={"color": QUIET}))
            label = Div(width=SIDE, name=f"label-{slider.name}", margin=(0, 5, 0, 5))
            widget = widget_of(slider, self.values.get(slider.name, slider.default))
            widget.on_change("value", partial(self._dragged, slider))
            self._widgets[slider.name] = slider, widget, label
            shown += [label, widget]
            self._label(slider)
        shown.append(self._saved)
        self._side.children = shown

    def _label(self, slider: Slider) -> None:
        """Write a slider's name, value and ends, with a mark at the value from the log."""
        value = self.values.get(slider.name, slider.default)
        _, widget, label = self._widgets[slider.name]
        label.text = MACROS.label(slider, value, slider.name in self.session.estimated)
        widget.tags = tags_of(slider, value)

    # Actions of the user.

    def _choose(self, attr: str, old: str, new: str) -> None:  # noqa: ARG002
        """Show another case or component."""
        if 0 in self.played:
            self._show()
            self._along(case=self._chosen_case())

    def _choose_filters(self, choices: list[Any], attr: str, old: str, new: str) -> None:  # noqa: ARG002
        """Replace the filters, and keep the values of parameters."""
        first, second = (each.value for each in choices)
        labels = [first] if second in (NONE, first) else [first, second]
        try:
            chosen = {each: self._known.get(each) or self.session.like_first(each) for each in labels}
            session = self.session.with_filters(chosen)
        except BadInput as error:
            self._fill_side()  # restore the choices of the filters that are shown
            self._tell(str(error))
            return
        self._tell()
        self.session = session
        self.played = {place: each for place, each in self.played.items() if place == PINNED}
        self.values = {name: self.values[name] for name in self.values if session.has(name)}
        for plot in self.plots.values():
            plot.clear(1)
        self._first()
        self._fill_side()

    def _dragged(self, slider: Slider, attr: str, old: float, new: float) -> None:  # noqa: ARG002
        if self._is_setting:
            return
        value = slider.value(new)
        if value == slider.default:
            self.values.pop(slider.name, None)
        else:
            self.values[slider.name] = value
        self._active = slider
        self._label(slider)
        self._replay()

    def _move_cursor(self, event: MouseMove) -> None:
        self._at_s = event.x
        self._cursor.location = event.x
        self._show_lens()

    def _pin(self) -> None:
        if 0 in self.played:
            self.played[PINNED] = self.played[0]
            self._show()

    def _reset(self) -> None:
        self._tell()
        self.session = self.session.with_estimated([])
        self._set({})

    def _tune(self) -> None:
        moved = list(self.values) or ([self._active.name] if self._active else [])
        free = [name for name in moved if name not in self.session.estimated]
        values, label = dict(self.values), self._label_of(0)
        self._tell(f"tuning {', '.join(free)} ...")

        def work(_: Callable[[], bool]) -> None:
            found, by = self.session.tuned(label, values, free)
            sliders = [self.session.slider(name) for name in free]
            said = ", ".join(f"{each.title} {each.words(found[each.name])}" for each in sliders)

            def show() -> None:
                self._set(found)
                self._tell(f"tuned by {by}: {said}")

            self._later(show)

        self._work.ask(work)

    def _diagnose(self) -> None:
        values, label = dict(self.values), self._label_of(0)
        self._tell("diagnosing ...")

        def work(_: Callable[[], bool]) -> None:
            sentences = self.session.diagnosed(label, values)
            self._later(lambda: self._tell(*sentences))

        self._work.ask(work)

    def _estimate(self) -> None:
        """Add the parameter that was dragged last to the state, or remove it from the state."""
        if self._active is None:
            return
        name = self._active.name
        names = {*self.session.estimated} ^ {name}
        try:
            self.session = self.session.with_estimated(sorted(names))
        except BadInput as error:
            self._tell(str(error))
            return
        self._tell(*([] if names else ["No parameter is estimated in the state now."]))
        self._label(self._widgets[name][0])
        self._replay()

    def _save(self) -> None:
        try:
            self._saved.text = MACROS.copied(self.session.toml(self.values), SIDE - 20)
        except BadInput as error:
            self._tell(str(error))

    def _timeline(self) -> None:
        values = dict(self.values)
        self._tell("drawing the timeline ...")

        def work(_: Callable[[], bool]) -> None:
            self.session.view(values, self._at_s)
            self._later(lambda: self._tell(""))

        self._work.ask(work)

    def _set(self, values: Mapping[str, float]) -> None:
        """Set the sliders to values, and replay."""
        self.values = dict(values)
        self._is_setting = True
        try:
            for slider, widget, _ in self._widgets.values():
                widget.value = min(
                    max(slider.place(self.values.get(slider.name, slider.default)), 0.0), 1.0
                )
                self._label(slider)
        finally:
            self._is_setting = False
        self._replay()

    # Reactions.

    def _first(self) -> None:
        played: dict[int | str, Played] = {
            place: self.session.play(label, self.values)
            for place, label in enumerate(self.session.filters)
        }
        self._take(played)
        self._at_s = instant_of(self.played[0].cases.get(self._chosen_case()))
        self._cursor.location = self._at_s
        times = [case.time_s for case in self.played[0].cases.values() if len(case.time_s)]
        if times:
            self._time.update(start=min(each[0] for each in times), end=max(each[-1] for each in times))
        self._show()
        self._replay()

    def _replay(self) -> None:
        """Replay with the current values; a newer request replaces this one."""
        values, session, active = dict(self.values), self.session, self._active
        self._saved.text = ""  # the text belongs to other values

        def work(is_newer: Callable[[], bool]) -> None:
            played: dict[int | str, Played] = {}
            for place, label in enumerate(session.filters):
                played[place] = session.play(label, values)
                if is_newer():
                    break
            else:
                self._later(lambda: self._take_and_show(played))
            if active is None:
                return
            points: list[tuple[float, Mapping[str, float]]] = []
            for point in session.likelihoods(self._label_of(0), values, active.name):
                if is_newer():
                    return
                points.append(point)
            now = values.get(active.name, active.default)
            along = partial(show_likelihood, self.plots["likelihood"], active, points, now=now)
            self._later(lambda: self._rest(along))

        self._work.ask(work)

    def _rest(self, along: Callable[..., None]) -> None:
        """Show the likelihood and update the plots' accessible names when a slider stops moving."""
        self._along = along
        self._along(case=self._chosen_case())
        self.plots["likelihood"].show_if_drawn()
        for plot in self.plots.values():
            plot.name()

    def _take_and_show(self, played: Mapping[int | str, Played]) -> None:
        self._take(played)
        self._show()

    def _take(self, played: Mapping[int | str, Played]) -> None:
        self.played |= played
        names = list(self.played[0].cases)
        self._case_choice.options = [(each, each or "the run") for each in names]
        if names and self._case_choice.value not in names:
            self._case_choice.value = names[0]
        case = self.played[0].cases.get(self._chosen_case())
        components = list(case.components) if case else []
        self._component.options = [(each, label_of_quantity(each)) for each in components]
        if components and self._component.value not in components:
            self._component.value = components[0]

    def _show(self) -> None:
        """Draw the newest replays and the verdicts."""
        case = self._chosen_case()
        component = str(self._component.value or "")
        for place, played in self.played.items():
            show_played(self.plots, place, played, case, component)
        if self.played[0].cases:
            fit_errors(self.plots["error"], self.played, case, component)
        self._show_lens()
        for name in ("scene", "lens", "whiteness", "likelihood", "nees", "nis"):
            self.plots[name].show_if_drawn()
        self._show_head()

    def _show_lens(self) -> None:
        if self._at_s is None:
            return
        case = self._chosen_case()
        one = self.played[0].cases.get(case)
        topics = [each for each in self.truths if one is not None and each.strip("/").startswith(case)]
        truth = true_path(self.session.log, topics[0]) if topics else None
        show_lens(self.plots["lens"], self.plots["scene"], self.played, case, truth, self._at_s)
        self.plots["lens"].say(f"Lens at {self._at_s:.1f} s (m)")

    def _show_head(self) -> None:
        estimated = {name: self.session.slider(name) for name in self.session.estimated}
        case = self._chosen_case()
        self._head.text = head_html(self.session.filters, self.played, case, estimated)
        try:
            self._command.text = MACROS.copied(self.session.command(self.played[0].values))
        except BadInput as error:  # an estimator defined in Python has no command
            self._command.text = MACROS.paragraphs([str(error)])

    def _chosen_case(self) -> str:
        return str(self._case_choice.value or "")

    def _label_of(self, place: int) -> str:
        return list(self.session.filters)[place]

    def _tell(self, *sentences: str) -> None:
        self._sentences.text = MACROS.paragraphs(sentences)

    def _say_error(self, error: Exception) -> None:
        message = str(error) if isinstance(error, BadInput) else f"this action failed: {error!r}"
        self._later(lambda: self._tell(message))

    def _later(self, act: Callable[[], object]) -> None:
        """Schedule a change of the page on its own thread."""
        self._document.add_next_tick_callback(act)


class NewestFirst:
    """A thread that does the newest task and drops older ones that have not begun.

    A task receives a function that tests whether a newer task is waiting, so that it can give up. `ask`
    and `end` must be called from a single thread. At exit, Python waits for the current task, because
    interrupting a thread in NumPy's C++ code aborts the process.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._pool = ThreadPoolExecutor(1, "fuselog explore")
        self._newest = 0
        self._on_error = on_error

    def ask(self, work: Work) -> None:
        """Do this task next instead of the waiting one; do nothing after `end`."""
        self._newest += 1
        with suppress(RuntimeError):  # the worker has ended, or Python is ending
            self._pool.submit(self._do, work, self._newest)

    def end(self) -> None:
        """Stop, and let the current task end early."""
        self._newest += 1
        self._pool.shutdown(wait=False)

    def _do(self, work: Work, number: int) -> None:
        def is_newer() -> bool:
            return self._newest > number

        if not is_newer():
            try:
                work(is_newer)
            except Exception as error:
                self._on_error(error)
