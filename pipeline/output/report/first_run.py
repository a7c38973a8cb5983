"""Shows the first run of a result: a plan of its paths and particles, or its timeline."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.output.charts import Axis, Chart, Panel, Series, path, thinned
from recorders.atomic import scratch_folder
from recorders.log import Stream, open_log, read_streams, schemas
from replay.engine.streams.sources import LogSource
from replay.judging.errors.evaluation import split_topic

PLANE = ("x_m", "y_m")
PICTURE_PX = (1280, 800)
# Particles are drawn at so many times, and of each cloud so many of equal weight.
CLOUDS, CLOUD_POINTS = 6, 150


def plan_of_first_run(folder: Path) -> Chart | None:
    """Truth, estimates and particles of the first run over the plane; None where its logs hold none.

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


def _plan(source: LogSource, output: LogSource) -> Chart | None:
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
    clouds = [
        cloud
        for topic, found in output.topics.items()
        if found.schema_name == schemas.DENSITY_ESTIMATE.full_name
        and split_topic(topic)[1] == case
        and set(PLANE) <= set(output.empty(topic).components)
        and (cloud := _cloud_of(output, topic))
    ]
    panel = Panel(x=Axis(label="x (m)"), y=Axis(label="y (m)"), series=[*clouds, *paths], plane=True)
    drawn = f", with particles at {CLOUDS} times" if clouds else ""
    return Chart(title=f"{case or 'paths'}, first run from above{drawn}", panels=[panel])


def _path_of(label: str, stream: Stream, column: str) -> Series:
    columns = [stream.components.index(name) for name in PLANE]
    return path(label, stream[column][thinned(len(stream))][:, columns])


def _cloud_of(output: LogSource, topic: str) -> Series | None:
    """Particles of a density at a few times spread over the run; None where it has none.

    They are drawn systematically, so that a particle's chance to be shown is its weight.
    """
    estimator, case = split_topic(topic)
    sizes = [
        name
        for name, found in output.topics.items()
        if found.schema_name == schemas.ESTIMATE_SIZE.full_name
        and split_topic(name) == (estimator, case)
    ]
    stamps = [time for each in output.read(sizes).values() for time in each.publish_time_ns.tolist()]
    if not stamps:
        return None
    points = []
    for row in np.linspace(0, len(stamps) - 1, CLOUDS).round().astype(int).tolist():
        time_ns = stamps[row]
        [cloud] = read_streams(output.log, [topic], start_ns=time_ns, end_ns=time_ns + 1).values()
        if len(cloud):
            ends = np.cumsum(cloud["weight"])
            positions = (np.arange(CLOUD_POINTS) + 0.5) / CLOUD_POINTS * ends[-1]
            columns = [cloud.components.index(name) for name in PLANE]
            points.append(cloud["mean"][np.searchsorted(ends, positions)][:, columns])
    return path(f"{estimator}, particles", np.concatenate(points), "dots") if points else None


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
