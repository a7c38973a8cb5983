"""Shows one run of a replay in Rerun: in a file, in a live viewer, or both from one pass."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from recorders.errors import BadInput, choices, printable
from recorders.registry import available, load
from replay.engine.blocks import Ragged, gather
from replay.engine.sources import Source
from replay.judging.evaluation import Errors
from replay.timeline.canvas import Canvas, Scene, Timeline
from replay.timeline.generic import TIMELINE as GENERIC
from replay.timeline.sinks import open_recording


def show(
    source: Source,
    outputs: Mapping[str, Ragged],
    errors: Sequence[Errors],
    *,
    run: int = 0,
    focus: str | None = None,
    save: Path | None = None,
    connect: str | None = None,
) -> None:
    """Draw one run of an ensemble with all its estimators, as its scenario's family draws it.

    Args:
        source: the run.
        outputs: the estimators' streams of the ensemble, by topic; none shows the log alone.
        errors: the errors of the ensemble's estimates.
        run: which run of the ensemble `source` is.
        focus: the case that is seen first, such as `robot3`.
        save: the .rrd file to write.
        connect: the receiver to send to, rerun+http://HOST:PORT/proxy.

    Raises BadInput where there is no such run or focus, or a sink fails (see `open_recording`).
    """
    runs = max((ragged.runs for ragged in outputs.values()), default=1)
    if not 0 <= run < runs:
        raise BadInput(f"no run {run} to show; the runs are 0 to {runs - 1}")
    of_run = {topic: ragged.of_run(run) for topic, ragged in outputs.items()}
    scene = Scene(source, of_run, [_errors_of_run(each, run) for each in errors], focus)
    if focus is not None and focus not in scene.cases:
        raise BadInput(f"nothing called '{focus}' to show; {choices(focus, scene.cases)}")
    scenario = source.run.scenario if source.run else ""
    timeline: Timeline = load("timelines", scenario) if scenario in available("timelines") else GENERIC
    application = f"fuselog-{scenario}" if scenario else "fuselog"
    with open_recording(application, _identity(scene), save=save, connect=connect) as recording:
        recording.send_recording_name(printable(source.name))
        layout = timeline.draw(_canvas(scene, recording), scene)
        recording.send_blueprint(
            rrb.Blueprint(
                layout,
                rrb.TimePanel(timeline="sim_time", state="collapsed"),
                collapse_panels=True,
            )
        )


def recorded_outputs(source: Source) -> dict[str, Ragged]:
    """The estimates that a log itself holds, as a replay's outputs of one run."""
    topics = [topic for topic in source.topics if topic.startswith("/estimates/")]
    return {topic: gather([stream]) for topic, stream in source.read(topics).items()}


def _errors_of_run(errors: Errors, run: int) -> Errors:
    rows = errors.run == run
    per_row = ("run", "step", "time_ns", "elapsed_s", "error", "covariance", "nees")
    return replace(errors, **{name: getattr(errors, name)[rows] for name in per_row})


def _canvas(scene: Scene, recording: rr.RecordingStream) -> Canvas:
    epoch_ns = scene.source.epoch_ns
    none = np.empty(0, np.int64)
    steps_ns = np.unique(
        np.concatenate([none, *(each.publish_time_ns for each in scene.outputs.values())])
    )
    truths = [truth.publish_time_ns[-1:] for case in scene.cases for truth in scene.truths_of(case)]
    end_ns = int(np.concatenate([[epoch_ns], steps_ns[-1:], *truths]).max())
    return Canvas(recording, epoch_ns, end_ns, steps_ns)


def _identity(scene: Scene) -> str:
    """A recording's id: the run and what was estimated, so that a viewer never mixes two replays."""
    digest = hashlib.sha256(repr(scene.source.run or scene.source.name).encode())
    for topic, stream in scene.outputs.items():
        digest.update(topic.encode())
        for column in (stream.publish_time_ns, *stream.columns.values()):
            digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()[:16]
