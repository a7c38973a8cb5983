"""Runs with estimates that are made, not replayed, drawn and read back."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.judging.errors.evaluation import Errors, Floats
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.show import show
from tests.replay.timeline.reading import Picture, Titles, Wanted, check_clocks, picture_of, quality

ESTIMATORS = ("one", "two")
PLANE = ("x_m", "y_m")
LATE_NS = 3_700_000_000


class Drawn(NamedTuple):
    """A run, what is made of it, its errors, and the file read back."""

    source: MemorySource
    made: dict[str, Stream]
    errors: list[Errors]
    picture: Picture

    def truth(self, case: str = "") -> Stream:
        """The true states of a case."""
        return self.source.streams[f"/{case}/truth".replace("//", "/")]

    def tracks(self, case: str = "") -> list[tuple[str, Stream, str]]:
        """Truth and estimates of a case: whose, the stream, and the field that has the states."""
        return [("truth", self.truth(case), "state"), *self.estimates(case)]

    def estimates(self, case: str = "") -> list[tuple[str, Stream, str]]:
        """The same without the truth."""
        return [(name, self.made[state_topic(name, case)], "mean") for name in ESTIMATORS]

    def quality(self, case: str = "") -> tuple[dict[str, Wanted], Titles]:
        """The plots of errors and NEES, and the titles of their views."""
        return quality(self.errors, case)


def state_topic(name: str, case: str) -> str:
    """Where an estimator says what it estimates."""
    return "/".join(filter(None, ["/estimates", name, case, "state"]))


def estimate(name: str, case: str, truth: Stream, rows: slice = slice(1, None)) -> Stream:
    """Estimates at some stamps of the truth, a component about as far off as its deviation says."""
    kinds = truth.metadata["kinds"].split(",")
    size = len(tangent_components(truth.components, kinds))
    mean = truth["state"][rows].copy()
    root = np.diag(0.05 * (1.0 + np.arange(size))) @ (np.eye(size) + 0.4 * np.tri(size, k=-1))
    rng = np.random.default_rng(ESTIMATORS.index(name))
    error = rng.uniform(-1, 1, (len(mean), size)) @ root.T
    if kinds[0] == "quaternion":
        turned = Rotation.from_quat(mean, scalar_first=True) * Rotation.from_rotvec(error)
        mean = turned.as_quat(scalar_first=True)
    elif kinds[0] == "axis":
        angle = np.arctan2(mean[:, 1], mean[:, 0]) + error[:, 0]
        mean = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        mean += error
    return make_stream(
        state_topic(name, case),
        schemas.GAUSSIAN_ESTIMATE,
        truth.publish_time_ns[rows],
        metadata={**truth.metadata, "truth": truth.topic},
        mean=mean,
        covariance=np.tile((root @ root.T).ravel(), (len(mean), 1)),
    )


def drawn(folder: Path, source: MemorySource, made: list[Stream]) -> Drawn:
    """The timeline of a run and of what is made of it."""
    outputs: dict[str, Ragged] = {each.topic: gather([each]) for each in made}
    found = Judge([source], {}, gap_limit_s=2.0).add(outputs).errors
    errors = [each for each in found if each is not None]
    show(source, outputs, errors, save=folder / "run.rrd")
    picture = picture_of(folder / "run.rrd")
    check_clocks(picture.moving, source.epoch_ns, made)
    return Drawn(source, {each.topic: each for each in made}, errors, picture)


def record(scenario: str, **parameters: Any) -> MemorySource:
    """A run of a scenario in memory, logged after it was measured."""
    return logged_late(memory_source(*record_run(scenario, parameters, 5, 0)))


def logged_late(source: MemorySource) -> MemorySource:
    """The same run, each message of which reaches the log 3.7 s after its stamp: stamps are drawn."""
    late = {
        topic: replace(stream, log_time_ns=stream.publish_time_ns + LATE_NS)
        for topic, stream in source.streams.items()
    }
    return replace(source, streams=late)


def of_both(source: MemorySource, *cases: str, rows: slice = slice(1, None)) -> list[Stream]:
    """Estimates of each case by both."""
    truths = {case: source.streams[f"/{case}/truth".replace("//", "/")] for case in cases}
    return [estimate(name, case, truth, rows) for name in ESTIMATORS for case, truth in truths.items()]


def columns(stream: Stream, field: str, *names: str) -> Floats:
    """Some components (n, k)."""
    return stream[field][:, [stream.components.index(name) for name in names]]


def block(stream: Stream, *names: str) -> Floats:
    """The rows and columns of a covariance that are of these components (n, k, k)."""
    size, at = len(stream.components), [stream.components.index(name) for name in names]
    found: Floats = stream["covariance"].reshape(-1, size, size)[:, at][:, :, at]
    return found


def path(stream: Stream, places: Floats) -> Wanted:
    """A segment for each row, from the place before."""
    return Wanted("lines", stream.publish_time_ns[1:], np.stack([places[:-1], places[1:]], axis=1))


def ellipses(stream: Stream, centres: Floats, covariances: Floats) -> Wanted:
    """The 95 % ellipse of each row."""
    spread = covariances.reshape(len(stream), -1)
    return Wanted("ellipses", stream.publish_time_ns, np.concatenate([centres, spread], axis=1))


def unit(angle: Floats) -> Floats:
    """Unit vectors (n, 2)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def rays(time_ns: Any, begin: Floats, way: Floats, how: str = "rays") -> Wanted:
    """Lines from places (n, d) along unit vectors (n, d)."""
    return Wanted(how, time_ns, np.concatenate([np.broadcast_to(begin, way.shape), way], axis=1))
