"""Study of samplings of N(0, I): their distance to N(0, I), pictures, and the cost of LCD sets.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section V, Figs. 1 and 5. No filter runs here; the logs contain the sample sets.
"""

import hashlib
from time import process_time
from typing import Annotated

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pydantic import Field, PositiveInt
from scipy.spatial.distance import pdist

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.recorders.log import LogWriter, RunMetadata, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import SIMULATION_EPOCH_NS
from fuselog.replay.engine import chi2
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.inference.sampling import (
    Samples,
    lcd_distance,
    lcd_samples,
    moment_corrected,
    parse_sampling,
)
from fuselog.replay.inference.sampling.samplers import unscented
from fuselog.replay.timeline.show import show

Size = Annotated[tuple[PositiveInt, ...], Field(min_length=2, max_length=2)]


class LcdOptions(Parameters):
    """The sets to optimize, and the samplings to draw.

    Attributes:
        sizes: dimension and count of each set to optimize.
        starts: number of starts of each optimization.
        contained: dimensions in which the sigma points of the UKF are compared with an optimized set.
        drawn: names of the samplings to draw.
    """

    sizes: Annotated[tuple[Size, ...], Field(min_length=1)] = ((2, 5), (2, 12), (2, 50))
    starts: PositiveInt = 4
    contained: tuple[PositiveInt, ...] = (2, 3)
    drawn: tuple[str, ...] = ("s2kf-12", "ukf", "gf-7", "rukf-3")


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: LcdOptions = setting.options
    # compile first, so that the time of the first set does not include the compilation
    optimised(2, 3, 1, experiment.seed)
    rows = [
        optimised(dimension, count, options.starts, experiment.seed)
        for dimension, count in setting.progress(options.sizes, "optimising", len(options.sizes))
    ]
    sets = pd.DataFrame(rows)
    drawn = {name: draw(name, experiment.seed) for name in options.drawn}
    distances = {name: lcd_distance(*samples) for name, samples in drawn.items()}
    outcome = Outcome(tables={"sets": sets}, figures={"samplings": sample_figure(drawn, distances)})
    for row in sets.to_dict("records"):
        case = f"n{row['dimension']}-l{row['count']}"
        for name in sets.columns[2:].drop("cpu_per_start_s"):  # the time differs between runs
            outcome.metrics[f"lcd.{name}.{case}"] = float(row[name])
    outcome.metrics |= {f"{name}.distance.drawn": value for name, value in distances.items()}
    for dimension in options.contained:
        unlike = unlikeness_to_ukf(dimension, options.starts, experiment.seed)
        for kind, value in zip(("optimised", "corrected"), unlike, strict=True):
            outcome.metrics[f"lcd.unlike_ukf.n{dimension}-{kind}"] = value
    outcome.input_sha256 = _write(experiment, setting, drawn)
    return outcome


def optimised(dimension: int, count: int, starts: int, seed: int) -> dict[str, float]:
    """Find the best set of several starts; return its D / pi^(N/2), covariance eigenvalues, run time."""
    begin = process_time()
    points = lcd_samples(dimension, count, np.random.default_rng(seed), starts=starts)
    seconds = process_time() - begin
    eigenvalues = np.linalg.eigvalsh(np.cov(points.T, bias=True).reshape(dimension, dimension))
    return {
        "dimension": dimension,
        "count": count,
        "distance": lcd_distance(points),
        "corrected_distance": lcd_distance(moment_corrected(points)),
        "least_eigenvalue": float(eigenvalues[0]),
        "largest_eigenvalue": float(eigenvalues[-1]),
        "cpu_per_start_s": seconds / starts,
    }


def draw(name: str, seed: int) -> Samples:
    """Draw one set in the plane."""
    return parse_sampling(name).at(2).draw(np.random.default_rng(seed), ())


def unlikeness_to_ukf(dimension: int, starts: int, seed: int) -> tuple[float, float]:
    """Compare 2N+1 LCD samples, raw and moment-corrected, with the UKF's samples, up to a rotation.

    In each set, the distances between samples and the distances from the origin are sorted; a rotation
    does not change them. Returns the largest difference from the UKF's distances, for both sets.
    """
    points = lcd_samples(dimension, 2 * dimension + 1, np.random.default_rng(seed), starts=starts)
    wanted = _invariants(unscented(dimension).points)
    raw, corrected = (
        float(np.max(np.abs(_invariants(each) - wanted))) for each in (points, moment_corrected(points))
    )
    return raw, corrected


def _invariants(points: np.ndarray) -> np.ndarray:
    return np.concatenate([np.sort(pdist(points)), np.sort(np.linalg.norm(points, axis=1))])


def sample_figure(drawn: dict[str, Samples], distances: dict[str, float]) -> Figure:
    """Draw the sets, with point areas as weights, and the circle that contains 95 %, Fig. 1."""
    figure = Figure(figsize=(2.6 * len(drawn), 3.2), layout="compressed")
    angle = np.linspace(0, 2 * np.pi, 100)
    radius = np.sqrt(chi2.ppf(0.95, 2))
    axes = np.atleast_1d(figure.subplots(1, len(drawn), sharex=True, sharey=True))
    for each, (name, (points, weights)) in zip(axes, drawn.items(), strict=True):
        each.plot(radius * np.cos(angle), radius * np.sin(angle), color="0.6", lw=1)
        colours = np.where(weights < 0, "tab:red", "tab:blue")
        each.scatter(*points.T, s=250 * np.abs(weights), c=colours)
        each.set(title=f"{name}, {len(points)} samples", aspect="equal")
        each.set_xlabel(f"D {distances[name]:.1e}")
    return figure


def _write(experiment: Experiment, setting: Setting, drawn: dict[str, Samples]) -> str:
    """Write the sets as a log with its timeline; return a hash of all samples."""
    digest = hashlib.sha256()
    streams = []
    for name, (points, weights) in drawn.items():
        digest.update(np.ascontiguousarray(points).tobytes())
        streams.append(
            make_stream(
                f"/estimates/{name}/samples",
                schemas.DENSITY_ESTIMATE,
                np.full(len(points), SIMULATION_EPOCH_NS),
                metadata={"components": "first,second", "kinds": "linear,linear"},
                weight=weights,
                mean=points,
                covariance=np.zeros((len(points), 4)),
            )
        )
    run = RunMetadata("lcd-sampling", dict(experiment.options), experiment.seed, 0, SIMULATION_EPOCH_NS)
    with LogWriter(setting.folder / "logs" / "samples.mcap", run) as writer:
        writer.write(streams)
    outputs: dict[str, Ragged] = {stream.topic: gather([stream]) for stream in streams}
    source = MemorySource({}, run, "samples of N(0, I)")
    show(source, outputs, [], save=setting.folder / "timeline.rrd")
    return digest.hexdigest()


LCD_SAMPLING = Study(
    "sample sets for N(0, I): their distance from it, and the cost of LCD sets",
    study,
    LcdOptions,
    runs="",
)
