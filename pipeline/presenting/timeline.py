"""One timeline: of a log, an estimates log, a result or one of its runs; shown, written or streamed."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote

from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.output.outputs import PICTURE, TIMELINE, check_files
from fuselog.pipeline.output.terminal import say, status, warn, warn_of_losses
from fuselog.pipeline.presenting.drawing import differing, open_run
from fuselog.pipeline.presenting.making import MARKER
from fuselog.pipeline.presenting.options import Options
from fuselog.pipeline.presenting.runs import Segment
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.estimates import source_of_estimates
from fuselog.pipeline.runs.initial_states import span_of
from fuselog.recorders.atomic import scratch_folder, whole_file
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.timeline import viewer
from fuselog.replay.timeline.show import Drawing, read_moments, worst_at


def view_timeline(path: Path, segment: Segment | None, options: Options) -> None:
    """Show, write or stream the timeline of a log, a result or one of its runs (`segment`)."""
    is_shown = options.save is None and options.connect is None and not options.web
    at, save, screenshot = options.at, options.save, options.screenshot
    if at is not None and screenshot is None and not is_shown:
        raise BadInput(
            f"--at {at}: sets the time cursor of the viewer and of --screenshot; leave it out with "
            "--save, --connect and --web"
        )
    rrd = path / "timeline.rrd" if path.is_dir() else path
    outputs = [(save, TIMELINE), (screenshot, PICTURE)]
    check_files([(out, kind) for out, kind in outputs if out is not None], {"input": [path, rrd]})
    with scratch_folder("fuselog-view") as folder:
        if segment is not None or rrd.suffix != ".rrd":
            rrd = save or folder / "timeline.rrd"
            with status() as told:
                told("drawing the timeline")
                _draw(path, segment, rrd, options)
        elif {None} != {options.start_s, options.end_s, options.focus, options.connect}:
            raise BadInput(
                f"{rrd}: this is a finished timeline; --start, --end, --focus and --connect need a log, "
                "or one run with --runs NUMBER"
            )
        elif (path / MARKER).is_file():
            raise BadInput(
                f"{path}: is a dataset that fuselog saved; to serve it: rerun server --host 127.0.0.1 "
                f"-d {quote(str(path))}"
            )
        elif not rrd.is_file():
            raise BadInput(
                f"{rrd}: no such file; give a result with a timeline, a log, or a folder of *.mcap"
            )
        elif save is not None:
            with whole_file(save) as new:
                shutil.copyfile(rrd, new)
        if isinstance(at, str):
            moments = [each for each in read_moments(rrd) if options.focus in (None, each.case)]
            worst = worst_at(moments, at)
            say(worst.sentence())
            at = worst.elapsed_s
        if screenshot is not None:
            with status() as told:
                complaints = viewer.screenshot(rrd, screenshot, at_s=at, progress=told)
            for complaint in complaints:
                warn(complaint)
        for written in (save, screenshot):
            if written is not None:
                say(str(written))
        if options.web:
            viewer.serve(rrd, lambda url: say(f"viewing {path} at {url}; press Ctrl-C to end"))
        elif is_shown and screenshot is None:
            viewer.view(rrd, at_s=at)


def _draw(path: Path, segment: Segment | None, rrd: Path, options: Options) -> None:
    """Draw a span of a log or a segment, with its estimates if there are any."""
    source: LogSource | MemorySource
    estimates: Sequence[LogSource | MemorySource]
    if segment is None:
        name = str(path)
        source, estimates = _read_log(path, recover=options.recover)
    else:
        name = f"{path} {segment.name}"
        source, own, _ = open_run(segment)
        estimates = [own] if own.topics else []
    span = (options.start_s, options.end_s)
    shown = span_of(source, *span, "publish_time")
    worst = options.at if isinstance(options.at, str) else None
    with Drawing(
        shown,
        identity=f"{name} {span}",
        focus=options.focus,
        save=rrd,
        connect=options.connect,
        at=worst,
    ) as drawing:
        judged = [replace(each, start_ns=shown.start_ns, end_ns=shown.end_ns) for each in estimates]
        judge = judge_logs(judged, [source], {}, gap_limit_s=options.gap_limit_s, drawing=drawing)
    is_whole = span == (None, None)
    for sentence in [
        *judge.components_without_truth,
        *(differing(segment, judge) if segment is not None and is_whole else []),
    ]:
        warn(sentence)
    for topic in source.rejections:
        say(f"{topic}: {source.rejections.sentence(topic)}")


def _read_log(path: Path, *, recover: bool) -> tuple[LogSource, list[LogSource]]:
    """Open a log, or an estimates log together with its source log; return the run and its estimates."""
    log = open_log(path, recover=recover)
    estimates = source = LogSource(log)
    is_estimates = any(topic.startswith("/estimates/") for topic in log.topics)
    if is_estimates and log.run is not None and "log" in log.run.notes:
        source = source_of_estimates(log, recover=recover)
    elif not is_estimates:
        source = alter(source, {})  # draws a log with several local tangent planes in one of them
    warn_of_losses([log, source.log])
    return source, [estimates] if is_estimates else []
