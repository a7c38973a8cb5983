"""What the goldens are of: the first log of every shipped experiment, with all of its estimators.

Where an experiment is large, its recipe shortens it. Where one of its cases, or another scenario of its
family, reaches code that the first log does not, that is a golden of its own.
"""

import json
import tarfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import click
import numpy as np

from fuselog.pipeline.families.los.moving import unknowns
from fuselog.pipeline.runs.experiment import Experiment, load_experiment
from fuselog.pipeline.runs.inputs import load_scenario, shipped
from fuselog.recorders.families.los.moving import MovingOpticalParameters
from fuselog.recorders.log import RunMetadata
from fuselog.recorders.parameters import merge
from fuselog.recorders.recording import Recording, import_run, record_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

# Of each importer, or mapping of tables: what to give it in the folder of real data, and the archive
# that this is in.
DATA = {
    "ais": ("solent_ais.csv.xz", ""),
    "autoferry": ("autoferry", "autoferry.tar.xz"),
    "broad": ("broad", ""),
    "mrclam": ("mrclam6", "mrclam6.tar.xz"),
    "score-matrices": ("bssr1", "bssr1_set1.tar.xz"),
    **dict.fromkeys(
        ("walk", "quadrotor", "uwb-lias", "uwb-outdoor"), ("navigation", "navigation.tar.xz")
    ),
    "sound-recordings": ("acoustic", "acoustic.tar.xz"),
    "torus": ("torus", "torus.tar.xz"),
}


@dataclass(frozen=True)
class Recipe:
    """How a golden comes about.

    Attributes:
        experiment: a shipped one; its estimators are replayed.
        scenario: recorded in place of the experiment's.
        parameters: over those of the scenario.
        estimators: settings by label, over the experiment's.
        alone: whether these are all estimators.
        run: which run of the experiment's seed.
        span_s: so many seconds of the log.
        part: of the imported data, the folder that is one log.
        late: what is done about late messages, in the order of their arrival.
        over: entries over those of an experiment without logs; its metrics are the golden.
    """

    experiment: str
    scenario: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    estimators: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    alone: bool = False
    run: int = 0
    span_s: float = np.inf
    part: str = ""
    late: str = ""
    over: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def loaded(self) -> Experiment:
        """The experiment, with what the recipe puts over it."""
        return load_experiment(self.experiment, {}, self.over)[1]

    @property
    def settings(self) -> dict[str, dict[str, Any]]:
        """Every estimator's settings by label; those that the experiment keeps for few runs as well."""
        if self.alone:
            return {label: dict(values) for label, values in self.estimators.items()}
        experiment = self.loaded
        return merge(experiment.estimators | experiment.options.get("few", {}), self.estimators)

    @property
    def importer(self) -> str:
        """Whose real data it needs, an importer's or a mapping's; empty for one that is simulated."""
        return importer_of(self.loaded)

    @property
    def has_log(self) -> bool:
        """Whether estimators are replayed."""
        return bool(self.settings and (self.loaded.record or self.loaded.import_))


def importer_of(experiment: Experiment) -> str:
    """Whose real data an experiment needs, an importer's or a mapping's; empty where it needs none."""
    given = experiment.import_
    return given.parameters.get("mapping", given.source) if given else ""


SHORT = {"duration_s": 40.0}
# of vehicles and of sets, whose steps are dear
SHORTER = {"duration_s": 15.0}
AUGMENTED = {
    "estimate": ["bias_range_m"],
    "estimate_sigma": {"bias_range_m": 0.5},
    "estimate_drift": {"bias_range_m": 0.02},
}
# by which messages overtake one another, some by more than a window of 0.4 s
OVERTAKING = {
    "duration_s": 20.0,
    "odometry_latency_s": 0.03,
    "range_bearing": {"latency_s": 0.2, "latency_jitter_s": 0.3},
}
# the studies take them from other robots of a log
SET_BOUNDS = {
    "bound_deg": 2.5,
    "bearing_bound_rad": 0.05,
    "position_error_m": 0.1,
    "position_error_mps": 0.03,
    "heading_error_rad": 0.4,
    "heading_error_radps": 0.02,
}
SET_FILTERS = {
    name: {"kind": "set-filter:exact", "most_edges": edges, **SET_BOUNDS}
    for name, edges in (("filter", 400), ("filter-l8", 4))
}
BIASES = {"model": "moving-sights", **unknowns(MovingOpticalParameters())}
MIXTURES = ("hmm", "ergodic", "density-joint", "density-by-modality")
TORUS = load_experiment("torus-filter", {}, {})[1].options["cases"]

# searches, which their own tests hold to what is known
SEARCHES = ("calibration", "diagnosis", "ellipsoid", "false-causes", "faults-together", "sensor-noise")
RECIPES = {name: Recipe(name) for name in shipped("experiments") if name not in SEARCHES} | {
    # of all scores together; `biometrics-simulated` has each modality and matcher by itself
    "biometrics-bssr1": Recipe(
        "biometrics-bssr1",
        estimators={
            **{label: {"folds": 2, "subsets": ["all"]} for label in ("qda", "knn", "logistic")},
            **{label: {"folds": 2, "iterations": 5, "subsets": ["all"]} for label in MIXTURES},
        },
    ),
    "biometrics-sequential": Recipe("biometrics-sequential", estimators={"ratio": {"pairs": "trimmed"}}),
    "biometrics-sequential-simulated": Recipe(
        "biometrics-sequential-simulated",
        parameters={"users": 120},
        estimators={"ratio": {"folds": 2, "iterations": 5}},
    ),
    "biometrics-simulated": Recipe("biometrics-simulated", parameters={"users": 120}),
    "broad-peers": Recipe("broad-peers", part="07_undisturbed_fast_rotation_B.hdf5", span_s=30.0),
    # echoes and wrong associations
    "acoustic-sequence": Recipe(
        "acoustic-sequence",
        parameters={
            "shots": 6,
            "echo_probability": 0.2,
            "wrong_association_probability": 0.2,
            "dropout_probability": 0.2,
        },
    ),
    # of the modes alone, one; both are in `modes`
    "crossing": Recipe(
        "crossing",
        estimators={
            label: values
            for label, values in load_experiment("crossing", {}, {})[1].estimators.items()
            if label != "manoeuvre"
        },
        alone=True,
    ),
    # scans that come late, and vessels that go side by side
    "autoferry": Recipe("autoferry", part="scenario22"),
    # rukf-10 fails
    "extended-target-failing": Recipe("extended-target", run=117),
    "imu-grades": Recipe("imu-grades", span_s=12.0),
    "gnss-ins": Recipe("gnss-ins", part="gnss_imu_rtk/walk_0827", span_s=30.0),
    "quad-inertial": Recipe(
        "quad-inertial",
        estimators={
            label: {"topics": {"inertial": "/imu1/inertial"}, "inertial_delay_s": 0.45}
            for label in ("ekf", "smoother")
        },
        part="quad_mimu/path_9",
        span_s=20.0,
    ),
    # delays, outliers, outages; ranges and bearings alone; the gate that the estimators have by default
    "landmarks-adverse": Recipe(
        "landmarks",
        "landmarks-adverse",
        {**SHORT, "range": {"rate_hz": 2.0}, "bearing": {"rate_hz": 2.0}},
        {label: {"gate_probability": 0.999} for label in ("ekf", "iekf", "ukf")},
    ),
    # the ranges' bias as a part of the state
    "landmarks-augmented": Recipe(
        "landmarks",
        parameters=SHORT,
        estimators={"ekf": AUGMENTED},
        alone=True,
    ),
    # factors in place of covariances
    "landmarks-square-root": Recipe(
        "landmarks", parameters=SHORT, estimators={"sqrt:ekf": {}, "smoother:sqrt:ukf": {}}, alone=True
    ),
    **{
        f"landmarks-late-{late.partition(':')[0]}": Recipe(
            "landmarks", parameters=OVERTAKING, estimators={"ekf": {}, "ukf": {}}, alone=True, late=late
        )
        for late in ("rewind:0.4", "wait:0.4")
    },
    "landmarks-particles": Recipe(
        "landmarks",
        parameters={"duration_s": 10.0},
        estimators={label: {} for label in ("particles:200", "bound", "bound:smoother")},
    ),
    "landmarks-smoothed": Recipe(
        "landmarks",
        parameters=SHORT,
        estimators={
            label: {"gate_probability": 0.999}
            for label in ("smoother:ekf", "smoother:ukf:lag=500ms", "smoother:iterated")
        },
    ),
    # a node that lies, is refused, and sends what is new alone
    "ispace-stress": Recipe(
        "ispace-stress",
        estimators={"ci": {"liar": 2, "gate_probability": 0.999, "send_divergence": 0.3}},
    ),
    "lcd-sampling": Recipe(
        "lcd-sampling",
        over={"options": {"sizes": [[2, 5], [2, 12], [4, 9]], "starts": 1, "contained": [2]}},
    ),
    # a manoeuvre, biases and clocks in the state
    "los-moving": Recipe(
        "los-moving",
        parameters={"duration_s": 6.0, "weave_m": [0.0, 0.0, 1000.0]},
        estimators={"ekf": BIASES, "smoother": {"kind": "smoother:ekf", **BIASES}},
        alone=True,
    ),
    "lrkf-dimension": Recipe(
        "lrkf-dimension",
        over={
            "runs": 2,
            "options": {
                "dimensions": [2, 5],
                "functions": 3,
                "drives": {"robot": {"scenario": "landmarks", "parameters": {"duration_s": 4.0}}},
            },
        },
    ),
    "mrclam": Recipe("mrclam", span_s=300.0),
    "mrclam-cooperative": Recipe("mrclam-cooperative", span_s=300.0),
    "mrclam-set-filter": Recipe("mrclam-set-filter", estimators=SET_FILTERS, alone=True, span_s=30.0),
    "mrclam-sets": Recipe("mrclam-sets", span_s=30.0),
    "mrclam-stress": Recipe("mrclam-stress", span_s=60.0),
    "set-filter": Recipe("set-filter", parameters=SHORTER, estimators=SET_FILTERS, alone=True),
    "uwb-outdoor": Recipe("uwb-outdoor", part="uwb_outdoor/LOS/Trajectory_B/Case_3", span_s=20.0),
    "uwb-pose": Recipe(
        "uwb-pose",
        estimators={"ekf": load_experiment("uwb-pose", {}, {})[1].estimators["ekf"]},
        alone=True,
        part="uwb_lias",
        span_s=5.0,
    ),
    "warehouse-uwb": Recipe("warehouse-uwb", parameters={"duration_s": 5.0}),
    "tuning-mrclam": Recipe("tuning-mrclam", span_s=60.0),
    "torus-filter-noise-03": Recipe("torus-filter", parameters=TORUS["noise-03"]),
    "torus-filter-strong-coupling": Recipe("torus-filter", parameters=TORUS["strong-coupling"]),
    "torus-propagation": Recipe(
        "torus-propagation",
        over={"runs": 3, "options": {"correlations": [-0.9, 0.0, 0.5], "couplings_rad": [0.1, 1.0]}},
    ),
    "torus-real": Recipe(
        "torus-real", over={"options": {"folds": 2, "most_components": 2, "grid_cells": 24}}
    ),
    "vehicles-cv": Recipe("vehicles-cv", parameters=SHORTER),
    "vehicles-cv-losses-10": Recipe(
        "vehicles-cv",
        parameters={**SHORTER, "network": {"detection_probability": 0.9, "clutter_per_scan": 5.0}},
    ),
    "vehicles-ctm2": Recipe("vehicles-ctm2", parameters=SHORTER),
    "vehicles-ctm4": Recipe("vehicles-ctm4", parameters=SHORTER),
}


data_option = click.option(
    "--data",
    type=click.Path(path_type=Path, exists=True),
    envvar="FUSELOG_DATA",
    required=True,
    help="The folder of real data [default: FUSELOG_DATA of the environment].",
)


def unpack(data: Path, importers: Iterable[str], scratch: Path) -> dict[str, Path]:
    """Where each importer's data lie: in the folder `data` as published, or unpacked into `scratch`."""
    places = {}
    for importer in importers:
        name, archive = DATA[importer]
        places[importer] = data / name
        if archive:
            places[importer] = scratch / name
            if not places[importer].exists():
                with tarfile.open(data / archive) as packed:
                    packed.extractall(scratch, filter="data")
    return places


@cache
def _imported(source: str, place: Path, parameters: str) -> tuple[Recording, RunMetadata]:
    """A recording, once for all recipes that it serves; its parameters as JSON."""
    return import_run(source, place, json.loads(parameters))


def first_log(recipe: Recipe, places: Mapping[str, Path]) -> MemorySource:
    """The log of a recipe: recorded from the experiment's seed, or imported from its place."""
    experiment = recipe.loaded
    if experiment.import_:
        given = experiment.import_
        place = places[recipe.importer] / recipe.part
        recording, run = _imported(given.source, place, json.dumps(given.parameters))
    else:
        assert experiment.record
        [own, *_] = experiment.options.get("scenarios", [experiment.record.scenario])
        recorder, values, _ = load_scenario(recipe.scenario or own)
        values = merge(merge(values, experiment.record.parameters), recipe.parameters)
        recording, run = record_run(recorder, values, experiment.seed, recipe.run)
    source = memory_source(recording, run)
    end_ns = source.epoch_ns + recipe.span_s * 1e9
    kept = {
        topic: stream.take(stream.publish_time_ns <= end_ns) for topic, stream in source.streams.items()
    }
    return MemorySource(kept, source.run, source.name)


def covered() -> dict[str, list[str]]:
    """The goldens of every estimator's name, with its variant where it has one."""
    found: dict[str, list[str]] = {}
    for name, recipe in sorted(RECIPES.items()):
        for kind in {str(values.get("kind", label)) for label, values in recipe.settings.items()}:
            found.setdefault(kind, []).append(name)
    return dict(sorted(found.items()))


def index() -> str:
    """Which goldens an estimator is in, as Markdown."""
    rows = [f"| `{kind}` | {', '.join(names)} |" for kind, names in covered().items()]
    return "\n".join(
        [
            "# Goldens",
            "",
            "What the estimators gave when these were made: `tests/replay/test_goldens.py` replays",
            "and compares, as `fuselog check` does. `recipes.py` says what each is of, `store.py`",
            "what may differ. `python -m tests.goldens --data FOLDER [NAME ...]` makes them anew, and",
            "this page. `numbers` has what other tests find, see `CONTRIBUTING.md`.",
            "",
            "| estimator | goldens |",
            "|---|---|",
            *rows,
            "",
        ]
    )
