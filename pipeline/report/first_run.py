"""What the first run of a result looks like: a plan of its paths, or its timeline in the viewer."""

import io
from pathlib import Path

from PIL import Image

from pipeline.charts import Axis, Chart, Panel, Series, path, thinned
from recorders.atomic import scratch_folder
from recorders.log import Stream, open_log, schemas
from replay.engine.sources import LogSource, Source
from replay.judging.evaluation import split_topic

PLANE = ("x_m", "y_m")
PICTURE_PX = (1280, 800)


def plan_of_first_run(folder: Path) -> Chart | None:
    """Truth and estimates of the first run over the plane; None where its logs hold none.

    Of several things that are estimated, such as robots, it shows the first. Raises BadInput where a log
    is damaged.
    """
    for log in sorted(folder.rglob("logs/run-0000.mcap")):
        estimates = log.parent.parent / "estimates" / log.name
        if estimates.is_file() and (
            plan := _plan(LogSource(open_log(log)), LogSource(open_log(estimates)))
        ):
            return plan
    return None


def _plan(source: Source, output: Source) -> Chart | None:
    places = [
        topic
        for topic, found in output.topics.items()
        if found.schema_name == schemas.GAUSSIAN_ESTIMATE.full_name
        and set(PLANE) <= set(output.empty(topic).components)
    ]
    if not places:
        return None
    case = split_topic(places[0])[1]
    streams = output.read([topic for topic in places if split_topic(topic)[1] == case])
    paths = [_path_of(split_topic(topic)[0], stream, "mean") for topic, stream in streams.items()]
    truth = streams[places[0]].metadata.get("truth", "")
    if truth in source.topics:
        whole = _path_of("truth", source.read([truth])[truth], "state")
        paths.append(whole.model_copy(update={"style": "dashed", "reference": True}))
    panel = Panel(x=Axis(label="x (m)"), y=Axis(label="y (m)"), series=paths, plane=True)
    return Chart(title=f"{case or 'paths'}, first run from above", panels=[panel])


def _path_of(label: str, stream: Stream, column: str) -> Series:
    columns = [stream.components.index(name) for name in PLANE]
    return path(label, stream[column][thinned(len(stream))][:, columns])


def picture_of_timeline(timeline: Path) -> bytes:
    """The viewer's picture of a timeline, as WebP.

    Raises BadInput where there is no timeline, or no Vulkan driver to draw it with.
    """
    from replay.timeline.viewer import screenshot

    with scratch_folder("fuselog-report") as folder:
        png = folder / "timeline.png"
        screenshot(timeline, png)
        with Image.open(png) as picture:
            small = io.BytesIO()
            picture.convert("RGB").resize(PICTURE_PX).save(small, "WEBP", quality=85)
    return small.getvalue()
