"""Study of orientation by filters and common methods, for each trial of the BROAD benchmark.

Laidig, Caruso, Cereatti, Seel, "BROAD", Data 6(7), 2021, section 4: only samples marked as movement are
evaluated. The error is the rotation from the true to the estimated orientation in the earth's axes; its
parts are heading, about the vertical, and inclination, the smallest remaining rotation. Every trial is
replayed a second time with the added field of a magnet that is near the unit for some time.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field

from fuselog.pipeline.families.directional.inertial import is_moving
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.directional.disturbances import COMPONENTS, disturbances
from fuselog.replay.judging.intervals import mean_interval

KINDS = ("undisturbed", "disturbed", "slow", "fast", "rotation", "translation", "combined")
PARTS = ("total", "heading", "inclination")
AS_RECORDED, WITH_MAGNET = "all", "magnet-added"
FEWEST_TRIALS = 3  # fewest trials for an interval of the mean; the experiment's recording has no more


class OrientationOptions(Parameters):
    """The added magnet, and the limit of a disturbance.

    Attributes:
        magnet_ut: field of the magnet in µT, in the unit's axes (x, y, z).
        magnet_s: time spans of a trial, in s, in which the magnet is near.
        limit_ut: difference from the local field, in µT, above which the field counts as disturbed.
        estimator: label of the estimator to compare with the others.
    """

    magnet_ut: tuple[float, float, float] = (20.0, -15.0, 15.0)
    magnet_s: list[tuple[float, float]] = [(60.0, 80.0), (110.0, 140.0)]
    limit_ut: Annotated[float, Field(gt=0)] = 8.0
    estimator: str = "ekf"


class ErrorAngles(NamedTuple):
    """Errors (n,) in rad."""

    total: Floats
    heading: Floats
    inclination: Floats


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: OrientationOptions = setting.options
    missing = [label for label in experiment.estimators if label == "vqf" and not find_spec("vqf")]
    experiment = experiment.model_copy(
        update={"estimators": {k: v for k, v in experiment.estimators.items() if k not in missing}}
    )
    notes = [(label, "not installed: pip install vqf") for label in missing]
    if options.estimator not in experiment.estimators:
        raise BadInput(f"options.estimator: no estimator '{options.estimator}' in the experiment")
    rows: list[dict[str, Any]] = []
    found: list[dict[str, Any]] = []
    sources: dict[str, MemorySource] = {}
    runner = Runner(experiment, setting)
    for number, (name, source) in enumerate(trials(experiment, setting)):
        recorded = runner.replay([source])
        near = with_magnet(source, name, options)
        disturbed = runner.replay([near])
        if not number:  # keep only the first trial, because the others can be imported again
            runner.keep([source], recorded.outputs)
            runner.draw([near], disturbed.outputs, WITH_MAGNET)
        for case, replayed in ((AS_RECORDED, recorded), (WITH_MAGNET, disturbed)):
            rows += errors_of(replayed, name, case)
            found += disturbed_spans(replayed, name, case, options)
        notes += [(name, f"{what}: {text}") for what, text in source.run.notes.items()]
        sources[name] = source
    table = pd.DataFrame(rows)
    spans = pd.DataFrame(found, columns=["trial", "case", "estimator", "begin_s", "end_s", "largest_ut"])
    kinds = by_kind(table)
    outcome = Outcome(input_sha256=hash_streams(list(sources.values())))
    outcome.tables = {
        "trials": table,
        "kinds": kinds,
        "disturbances": spans,
        "notes": pd.DataFrame(notes, columns=["of", "what"]),
    }
    for row in kinds.to_dict("records"):
        for part in PARTS:
            outcome.metrics[f"{row['estimator']}.{part}_rmse_deg.{row['kind']}"] = row[f"{part}_deg"]
    _compare(table, options.estimator, outcome)
    _measure_disturbances(spans, sources, options, outcome)
    outcome.figures["kinds"] = _chart(kinds)
    return outcome


def trials(experiment: Experiment, setting: Setting) -> Iterator[tuple[str, MemorySource]]:
    """Yield the trials of a folder, or the trial of a file, with their names."""
    assert experiment.import_ is not None
    assert setting.data is not None
    files = sorted(setting.data.glob("*.hdf5")) if setting.data.is_dir() else [setting.data]
    if not files:
        raise BadInput(f"{setting.data}: has no .hdf5 files; give a BROAD trial, or a folder of them")
    for path in setting.progress(files, "replaying trials", len(files)):
        given = experiment.import_
        yield path.stem, memory_source(*import_run(given.source, Path(path), given.parameters))


def with_magnet(source: MemorySource, trial: str, options: OrientationOptions) -> MemorySource:
    """Return the same trial with the added field of a magnet that is near for some time."""
    topic = f"/{trial}/inertial"
    stream = source.streams[topic]
    elapsed_s = (stream.publish_time_ns - source.epoch_ns) * 1e-9
    near = np.zeros(len(stream), bool)
    for begin_s, end_s in options.magnet_s:
        near |= (elapsed_s >= begin_s) & (elapsed_s < end_s)
    field = stream["magnetic_field_ut"] + near[:, None] * np.array(options.magnet_ut)
    changed = replace(stream, columns={**stream.columns, "magnetic_field_ut": field})
    return MemorySource({**source.streams, topic: changed}, source.run, source.name)


def states_of(replayed: Replayed, trial: str) -> Iterator[tuple[str, Stream]]:
    """Yield every estimator's label with its estimates of a trial."""
    for topic, rows in replayed.outputs.items():
        label, _, leaf = topic.removeprefix("/estimates/").partition("/")
        if leaf == f"{trial}/state":
            yield label, rows.of_run(0)


def errors_of(replayed: Replayed, trial: str, case: str) -> Iterator[dict[str, Any]]:
    """Yield every estimator's RMSE over the movement of a trial, in deg, and its missing samples."""
    [source] = replayed.sources
    truth = source.streams[f"/{trial}/truth"]
    truth = truth.take(is_moving(source, trial, truth.publish_time_ns))
    for label, states in states_of(replayed, trial):
        row, known = same_stamps(states.publish_time_ns, truth.publish_time_ns)
        places = [states.components.index(name) for name in COMPONENTS[:4]]
        angles = error_angles(states["mean"][row[known]][:, places], truth["state"][known])
        yield {
            "trial": trial,
            "case": case,
            "estimator": label,
            **{
                f"{part}_deg": float(np.degrees(np.sqrt(np.mean(angle**2))))
                for part, angle in angles._asdict().items()
            },
            "samples": int(known.sum()),
            "not_estimated": int((~known).sum()),
        }


def same_stamps(time_ns: Integers, wanted_ns: Integers) -> tuple[Integers, Any]:
    """Find the rows with the wanted stamps.

    Args:
        time_ns: (m,), ascending.
        wanted_ns: (n,).

    Returns:
        Row indices (n,) into `time_ns`, and a mask (n,) that is True if the wanted stamp exists; other
        row indices are invalid.
    """
    row = np.searchsorted(time_ns, wanted_ns).clip(0, max(len(time_ns) - 1, 0))
    known = time_ns[row] == wanted_ns if len(time_ns) else np.zeros(len(wanted_ns), bool)
    return row, known


def error_angles(estimate: Floats, truth: Floats) -> ErrorAngles:
    """Compute the angle between the true and the estimated orientation, and its two parts.

    Args:
        estimate: (n, 4), quaternions from the body's axes to the earth's.
        truth: (n, 4), quaternions from the body's axes to the earth's.

    Returns:
        The total angle, and its parts heading and inclination, (n,) each in rad, all nonnegative.
    """
    w, x, y, z = np.abs(compose(estimate, conjugate(truth)).T)
    return ErrorAngles(
        2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), w),
        2.0 * np.arctan2(z, w),
        2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)),
    )


def disturbed_spans(
    replayed: Replayed, trial: str, case: str, options: OrientationOptions
) -> Iterator[dict[str, Any]]:
    """Yield the spans in which estimators that model the local field consider it disturbed."""
    [source] = replayed.sources
    for label, states in states_of(replayed, trial):
        if not set(COMPONENTS) <= set(states.components):
            continue
        spans = disturbances(source.streams[f"/{trial}/inertial"], states, options.limit_ut)
        for begin_ns, end_ns, largest_ut in zip(*spans, strict=True):
            yield {
                "trial": trial,
                "case": case,
                "estimator": label,
                "begin_s": (begin_ns - source.epoch_ns) * 1e-9,
                "end_s": (end_ns - source.epoch_ns) * 1e-9,
                "largest_ut": largest_ut,
            }


def by_kind(table: pd.DataFrame) -> pd.DataFrame:
    """Average over the trials of each kind of movement, by estimator."""
    words = table["trial"].str.split("_")
    recorded = table["case"] == AS_RECORDED
    chosen = {AS_RECORDED: recorded, WITH_MAGNET: ~recorded}
    chosen |= {kind: recorded & words.map(lambda of, kind=kind: kind in of) for kind in KINDS}
    angles = [f"{part}_deg" for part in PARTS]
    parts = []
    for kind, rows in chosen.items():
        of_kind = table[rows].groupby("estimator", sort=False)
        if len(of_kind):
            means = of_kind[angles].mean().assign(trials=of_kind.size()).reset_index()
            parts.append(means.assign(kind=kind))
    return pd.concat(parts, ignore_index=True)


def _compare(table: pd.DataFrame, own: str, outcome: Outcome) -> None:
    """Measure the excess errors of the other estimators, and the excess errors due to a magnet."""
    totals = table.pivot_table(index="trial", columns=["case", "estimator"], values="total_deg")
    for case in (AS_RECORDED, WITH_MAGNET):
        for other in totals[case].columns.drop(own):
            more = totals[case, other] - totals[case, own]
            outcome.measure(f"{other}.excess_deg.{case}", mean_interval(more, FEWEST_TRIALS))
    more = totals[WITH_MAGNET, own] - totals[AS_RECORDED, own]
    outcome.measure(f"{own}.cost_deg.{WITH_MAGNET}", mean_interval(more, FEWEST_TRIALS))


def _measure_disturbances(
    spans: pd.DataFrame,
    sources: Mapping[str, MemorySource],
    options: OrientationOptions,
    outcome: Outcome,
) -> None:
    """Measure false detections in undisturbed trials, and the timing errors of the magnet's spans."""
    own = spans[spans["estimator"] == options.estimator]
    quiet = [name for name in sources if "undisturbed" in name.split("_")]
    if not quiet:
        return
    false_alarms = own[(own["case"] == AS_RECORDED) & own["trial"].isin(quiet)]
    stamps = [sources[name].streams[f"/{name}/inertial"].publish_time_ns for name in quiet]
    added = own[own["case"] == WITH_MAGNET]
    late_s = [
        _noticed_late(added[added["trial"] == name], span) for name in quiet for span in options.magnet_s
    ]
    outcome.metrics |= {
        f"{options.estimator}.falsely_disturbed_s": float(
            (false_alarms["end_s"] - false_alarms["begin_s"]).sum()
        ),
        f"{options.estimator}.undisturbed_s": sum(float(each[-1] - each[0]) * 1e-9 for each in stamps),
        f"{options.estimator}.magnet_noticed_late_s": late_s,
    }


def _noticed_late(spans: pd.DataFrame, near: tuple[float, float]) -> float:
    """Compute how far (s) the nearest detected span is from the time span of the magnet."""
    off = np.maximum((spans["begin_s"] - near[0]).abs(), (spans["end_s"] - near[1]).abs())
    return float(off.min()) if len(off) else np.inf


def _chart(kinds: pd.DataFrame) -> Chart:
    """Draw the mean RMSE of every estimator by kind of movement, one panel per part."""
    panels = [
        Panel(
            x=Axis(label="trials"),
            y=Axis(label=f"{part} RMSE (deg)", log=True),
            series=curves(kinds, ["estimator"], "kind", f"{part}_deg", "markers"),
        )
        for part in PARTS
    ]
    return Chart(panels=panels)


ORIENTATION = Study(
    "orientation by filters and common methods, by kind of movement", study, OrientationOptions
)
