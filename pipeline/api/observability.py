"""Observability of logs, as a table in Python and as the output of the command."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from fuselog.pipeline.api.planning import Log, sources_of
from fuselog.pipeline.output.terminal import print_json, print_table
from fuselog.pipeline.runs.initial_states import span_of
from fuselog.pipeline.runs.settings import sigmas_of
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.log import open_log
from fuselog.recorders.parameters import parse_settings
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.observability import OBSERVABILITY, Spectrum, in_words, observability_of

NAME = "observability"


@without_warnings_of_numbers()
def observability(
    logs: Log | Iterable[Log],
    model: str | Model | None = None,
    *,
    window_s: float | None = None,
    scales: Mapping[str, float] | None = None,
    end_s: float | None = None,
    **parameters: Any,
) -> pd.DataFrame:
    """Measure how well a log's measurements determine a model's state, relative to the prior.

    Args:
        logs: one or several logs with the same topics: paths, opened logs, or recordings.
        model: a registered name, or a model of your own; by default the registered model that fits the
            logs.
        window_s: length of the windows in seconds; by default each run is one window.
        scales: unit of each component, instead of the prior's standard deviation.
        end_s: end of the evaluated span, in seconds since each run's epoch.
        parameters: parameters of the model.

    Returns:
        A row per run, case and window: the window's span, the number of measurements, the rank and the
        eigenvalues of the local Gramian in ascending order, the unit direction of the smallest one in
        state units, and a description of what the measurements determine least.

    Raises BadInput if no model fits, or if the sensors of the model have no measurements.

    >>> from fuselog.pipeline.api.api import record
    >>> table = observability(record("landmarks", duration_s=2.0), window_s=1.0)
    >>> table["rank"].tolist()
    [3, 3]
    """
    sources = [span_of(source, None, end_s, "publish_time") for source in sources_of(logs)]
    given = {"model": model, "window_s": window_s, "scales": dict(scales or {}) or None}
    kind: Any = OBSERVABILITY
    if isinstance(model, Model):
        kind = observability_of(model)
        del given["model"]
    settings = {name: value for name, value in given.items() if value is not None} | parameters
    bound = bind(NAME, sources, {"kind": kind, **settings})
    rows: list[dict[str, Any]] = []
    for topic, ragged in collect(replay(sources, bound)).items():
        if topic.endswith(f"/{NAME}"):
            case = topic.removeprefix(f"/estimates/{NAME}").removesuffix(f"/{NAME}").strip("/")
            rows += _rows(sources, case, ragged)
    if not any(row["measurements"] for row in rows):
        raise BadInput(
            f"{sources[0].name}: no sensor of the model has measurements in this span; give another span"
        )
    return pd.DataFrame(rows)


def _rows(
    sources: Sequence[LogSource | MemorySource], case: str, ragged: Ragged
) -> Iterable[dict[str, Any]]:
    components = ragged.stream.metadata["components"].split(",")
    for run, source in enumerate(sources):
        stream, zero_ns = ragged.of_run(run), source.zero_ns("publish_time")
        for row, end_ns in enumerate(stream.publish_time_ns):
            values, direction = stream["eigenvalues"][row], stream["direction"][row]
            spectrum = Spectrum(values, int(stream["rank"][row]), direction)
            measured = int(stream["measurements"][row])
            yield {
                "run": run,
                "case": case,
                "begin_s": (int(stream["begin_time_ns"][row]) - zero_ns) * 1e-9,
                "end_s": (int(end_ns) - zero_ns) * 1e-9,
                "measurements": measured,
                "rank": spectrum.rank,
                "eigenvalues": values.tolist(),
                "direction": dict(zip(components, direction.tolist(), strict=True)),
                "weakest": in_words(spectrum, components) if measured else "nothing was measured",
            }


def show_observability(
    logs: Sequence[Path],
    *,
    model: str | None,
    window_s: float | None,
    scales: Sequence[str],
    end_s: float | None,
    recover: bool,
    as_json: bool,
    settings: Sequence[str],
) -> None:
    """Print the table of `observability`."""
    if window_s is not None and window_s <= 0:
        raise BadInput(f"--window {window_s:g}: expected a positive number of seconds, such as 10")
    found = observability(
        [LogSource(open_log(path, recover=recover)) for path in logs],
        model,
        window_s=window_s,
        scales=sigmas_of(scales, "--scale"),
        end_s=end_s,
        **parse_settings(settings),
    )
    rows = found.to_dict("records")
    if as_json:
        print_json(rows)
        return
    columns = ["run", "case", "from (s)", "to (s)", "measurements", "rank", "eigenvalues", "weakest"]
    shown = [
        [
            logs[row["run"]].name,
            row["case"],
            row["begin_s"],
            row["end_s"],
            row["measurements"],
            f"{row['rank']} of {len(row['eigenvalues'])}",
            ", ".join(f"{value:.3g}" for value in row["eigenvalues"]),
            row["weakest"],
        ]
        for row in rows
    ]
    print_table(columns, shown)
