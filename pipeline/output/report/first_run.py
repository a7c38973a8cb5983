"""The first run of a result, and a picture of its timeline."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.log import open_log, schemas, topics_of
from fuselog.replay.engine.replaying.replaying import BLOCK_MESSAGES
from fuselog.replay.engine.streams.ensembles import ensemble_of
from fuselog.replay.engine.streams.sources import LogSource, Source
from fuselog.replay.judging.errors.evaluation import Floats, Innovations, split_topic
from fuselog.replay.judging.judge import Judge

PLANE = ("x_m", "y_m")
PICTURE_PX = (1280, 800)
# Innovations of at most this many runs are read; more would hardly change their mean over time.
RUNS = "estimates/run-*.mcap"
MOST_RUNS = 20
GAP_LIMIT_S = 0.2


@dataclass(frozen=True)
class Followed:
    """The position errors of an estimator over time, together with the truth.

    Attributes:
        time_s: (n,) time since the first estimate.
        truth, error: (n, 2) in the plane; the estimate is the sum of truth and error.
        covariance: (n, 2, 2) as claimed by the estimator.
    """

    time_s: Floats
    truth: Floats
    error: Floats
    covariance: Floats

    @property
    def estimate(self) -> Floats:
        """Return the estimated positions (n, 2)."""
        return self.truth + self.error

    @property
    def squared(self) -> Floats:
        """Return the normalised squared errors, (n,); NaN if a covariance is singular."""
        found = np.full(len(self.error), np.nan)
        sound = np.linalg.det(self.covariance) > 0.0
        solved = np.linalg.solve(self.covariance[sound], self.error[sound, :, None])[..., 0]
        found[sound] = np.sum(self.error[sound] * solved, axis=1)
        return found


@dataclass(frozen=True)
class FirstRun:
    """The first run of a result: its log, its estimates, and the errors in its first case."""

    source: Source
    output: Source
    case: str
    followed: Mapping[str, Followed]


def first_run(folder: Path, gap_limit_s: float = GAP_LIMIT_S) -> FirstRun | None:
    """Find the first run whose log has a truth and estimates in the plane; return None if no log does.

    If the log has several objects, such as robots, the first is used. Raises BadInput if a log is
    damaged.
    """
    for log in sorted(folder.rglob("logs/run-0000.mcap")):
        estimates = log.parent.parent / "estimates" / log.name
        if estimates.is_file():
            run = seen_from_above(LogSource(open_log(log)), LogSource(open_log(estimates)), gap_limit_s)
            if run is not None:
                return run
    return None


def seen_from_above(source: Source, output: Source, gap_limit_s: float) -> FirstRun | None:
    """Read a run from its log and estimates; return None if either has no positions in the plane."""
    found = _followed(source, output, gap_limit_s)
    if not found:
        return None
    case = next(iter(found))[1]
    own = {label: each for (label, of), each in found.items() if of == case}
    return FirstRun(source, output, case, own)


def _followed(source: Source, output: Source, gap_limit_s: float) -> dict[tuple[str, str], Followed]:
    """Compute errors in the plane by estimator and case."""
    topics = {
        topic: each.metadata.get("truth", "")
        for topic, each in ((topic, output.empty(topic)) for topic in output.topics)
        if each.schema.full_name == schemas.GAUSSIAN_ESTIMATE.full_name
        and set(PLANE) <= {*each.components}
    }
    judge = Judge([source], {}, gap_limit_s=gap_limit_s)
    parts: dict[tuple[str, str], list[Followed]] = {}
    truths = {topics[topic] for topic in topics} & source.topics.keys()
    paths = {truth: source.read([truth])[truth] for truth in truths}
    named = {split_topic(topic): truth for topic, truth in topics.items() if truth in paths}
    for block in (
        ensemble_of([output]).blocks([*topics], "publish_time", BLOCK_MESSAGES) if named else ()
    ):
        for errors in judge.add(block).errors:
            what = errors.estimator, errors.case
            if errors.is_bound or what not in named or not set(PLANE) <= {*errors.components}:
                continue
            path = paths[named[what]]
            at = [path.components.index(name) for name in PLANE]
            of = [errors.components.index(name) for name in PLANE]
            times = errors.time_ns.astype(float)
            truth = np.column_stack(
                [
                    np.interp(times, path.publish_time_ns.astype(float), path["state"][:, each])
                    for each in at
                ]
            )
            covariance = errors.covariance[:, of][:, :, of]
            parts.setdefault(what, []).append(
                Followed(errors.elapsed_s, truth, errors.error[:, of], covariance)
            )
    return {what: _joined(each) for what, each in parts.items()}


def _joined(parts: list[Followed]) -> Followed:
    columns = ("time_s", "truth", "error", "covariance")
    return Followed(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


def innovations_of_runs(folder: Path) -> dict[tuple[str, str], list[tuple[Floats, Innovations]]]:
    """Read the innovations of the kept runs by estimator and case, with their times in s."""
    found: dict[tuple[str, str], list[tuple[Floats, Innovations]]] = {}
    for path in sorted(folder.glob(RUNS))[:MOST_RUNS]:
        output = LogSource(open_log(path))
        topics = topics_of(output.topics, schemas.INNOVATION)
        judge = Judge([output], {}, gap_limit_s=GAP_LIMIT_S)
        for block in (
            ensemble_of([output]).blocks(topics, "publish_time", BLOCK_MESSAGES) if topics else ()
        ):
            for each in judge.add(block).innovations:
                elapsed_s: Floats = 1e-9 * (each.time_ns - output.epoch_ns).astype(np.float64)
                found.setdefault((each.estimator, each.case), []).append((elapsed_s, each))
    return found


def picture_of_timeline(timeline: Path) -> bytes:
    """Draw a timeline with the viewer, and return the picture as WebP.

    Raises BadInput if there is no timeline, or no Vulkan driver.
    """
    from fuselog.replay.timeline.viewer import screenshot

    with scratch_folder("fuselog-report") as folder:
        png = folder / "timeline.png"
        screenshot(timeline, png)
        with Image.open(png) as picture:
            small = io.BytesIO()
            picture.convert("RGB").resize(PICTURE_PX).save(small, "WEBP", quality=85)
    return small.getvalue()
