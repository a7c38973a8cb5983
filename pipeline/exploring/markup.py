"""The texts of the page as escaped HTML: verdicts, numbers, labels of sliders."""

from collections.abc import Iterable, Mapping
from html import escape

from fuselog.pipeline.exploring.curves import LINES, Case
from fuselog.pipeline.exploring.plots import COLOURS, PINNED, QUIET, RED
from fuselog.pipeline.exploring.session import Played
from fuselog.pipeline.exploring.sliders import Slider, in_words
from fuselog.pipeline.exploring.verdict import LIKELIHOOD, Summary, numbers_of
from fuselog.pipeline.output.words import MINUS, number

MARKS = {"good": "✓", "doubtful": "✕", "failed": "✕"}
SIDE = 300  # the width of the sliders' column, in pixels
SLOW_S = 1.0  # a replay that takes longer than this, in s, is reported
SPREAD = '<div style="display:flex;justify-content:space-between">'


def label_of(slider: Slider, value: float, *, is_estimated: bool = False) -> str:
    """Write a slider's name, value and ends as HTML, with a mark at the value from the log.

    For a parameter in the state, the value is the initial estimate.
    """
    name = f"{slider.title}, estimated from" if is_estimated else slider.title
    changed = "" if value == slider.default else f"color:{COLOURS[0]};"
    mark = 100.0 * min(max(slider.place(slider.default), 0.0), 1.0)
    return (
        f'<div title="{escape(f"{slider.name}: {slider.meaning}")}" style="width:{SIDE - 20}px">'
        f"{SPREAD}<span>{escape(name)}</span>"
        f'<b style="{changed}">{escape(slider.words(value))}</b></div>'
        f'<div style="display:flex;justify-content:space-between;font-size:11px;color:{QUIET};'
        f'position:relative"><span>{escape(slider.words(slider.low))}</span>'
        f'<span style="position:absolute;top:9px;left:{mark:.1f}%;transform:translateX(-50%)" '
        f"title=\"the log's own, "
        f'{escape(slider.words(slider.default))}">▾</span>'
        f"<span>{escape(slider.words(slider.high))}</span></div></div>"
    )


def pre_html(text: str, width: int | None = None) -> str:
    """Format a text to copy as HTML, with this width in pixels if it is given."""
    fixed = f";width:{width}px" if width else ""
    return f'<pre style="white-space:pre-wrap;margin:4px 0{fixed}">{escape(text)}</pre>'


def heading_html(log: str) -> str:
    """Write the page's heading with the name of the log."""
    return f'<h1 style="font:inherit;margin:0"><b>fuselog</b> explore<br>{escape(log)}</h1>'


def head_html(
    labels: Iterable[str], played: Mapping[int | str, Played], case: str, estimated: Mapping[str, Slider]
) -> str:
    """Write the text above the plots: verdicts, numbers, and estimates of parameters."""
    parts = []
    for place, label in enumerate(labels):
        one = played[place]
        verdict = one.verdicts.get(case, Summary("failed", "The filter returned no estimates.", ""))
        parts.append(_verdict_html(label, verdict, COLOURS[min(place, 1)]))
        if case in one.cases:
            parts.append(_numbers_html(one, played.get(PINNED), case))
            parts += [f"<p>{escape(each)}</p>" for each in in_the_state(one.cases[case], estimated)]
        if one.seconds > SLOW_S:
            parts.append(f"<p>One replay takes {one.seconds:.1f} s.</p>")
    if case in played[0].cases and len(played[0].cases[case].time_s) > LINES:
        parts.append("<p>This long log is drawn by the minimum and maximum of each span.</p>")
    return "".join(parts)


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


def _verdict_html(label: str, verdict: Summary, colour: str) -> str:
    """Write a filter's verdict in the filter's colour."""
    mark = MARKS[verdict.level]
    red = "" if verdict.level == "good" else f"color:{RED};"
    return (
        f'<h2 style="margin:4px 0;font-weight:400"><b style="color:{colour}">{escape(label)}</b> '
        f'<b class="headline" style="{red}">{mark} {escape(verdict.headline)}</b> '
        f"{escape(verdict.detail)}</h2>"
    )


def _numbers_html(played: Played, pinned: Played | None, case: str) -> str:
    """Write the numbers of a filter, and below them those of the pinned result."""
    cells = []
    before = numbers_of(pinned.cases[case]) if pinned is not None and case in pinned.cases else {}
    for name, (value, unit) in numbers_of(played.cases[case]).items():
        was = before.get(name)
        ghost = f'<br><small style="color:{QUIET}">pinned {_number(name, *was)}</small>' if was else ""
        cells.append(
            f'<div><small style="color:{QUIET}">{escape(name)}</small><br>'
            f'<b style="font-size:18px">{_number(name, value, unit)}</b>{ghost}</div>'
        )
    return (
        f'<div class="numbers" style="display:flex;flex-wrap:wrap;gap:4px 32px">{"".join(cells)}</div>'
    )


def _number(name: str, value: float, unit: str) -> str:
    if name == LIKELIHOOD:
        return f"{value:,.0f}".replace("-", MINUS)
    return escape(in_words(value, unit) if unit else number(value))
