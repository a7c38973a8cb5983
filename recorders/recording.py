"""What a recorder is: something that turns parameters, or a folder of real data, into streams."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic

import numpy as np

from recorders.errors import BadInput
from recorders.log import RunMetadata, Stream
from recorders.parameters import ParametersType, build
from recorders.registry import load

# Simulated runs start at 2026-01-01T00:00:00Z: stamps are never negative and tools show a date.
SIMULATION_EPOCH_NS = 1_767_225_600_000_000_000


@dataclass(frozen=True)
class Recording:
    """Streams in memory, before they are a log.

    `epoch_ns` is the run's time zero; `notes` are facts the recorder met, one short text each.
    """

    streams: list[Stream]
    epoch_ns: int = SIMULATION_EPOCH_NS
    notes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Simulator(Generic[ParametersType]):
    """A scenario that can be recorded any number of times, each run from its own random stream."""

    summary: str
    parameters: type[ParametersType]
    simulate: Callable[[ParametersType, np.random.Generator], Recording]


@dataclass(frozen=True)
class Importer(Generic[ParametersType]):
    """Reads real data: a file or folder as its publishers lay it out."""

    summary: str
    parameters: type[ParametersType]
    read: Callable[[Path, ParametersType], Recording]


def record_run(
    scenario: str, values: Mapping[str, Any], seed: int, run: int = 0
) -> tuple[Recording, RunMetadata]:
    """Record run number `run` of a scenario; (scenario, values, seed, run) give the same streams.

    Raises BadInput for an unknown scenario or parameter, or one that only imports.
    """
    simulator = load("recorders", scenario)
    if not isinstance(simulator, Simulator):
        raise BadInput(f"'{scenario}' imports real data; use: fuselog import {scenario} FOLDER")
    parameters = build(simulator.parameters, values, f"scenario {scenario}")
    if seed < 0:
        raise BadInput(f"--seed {seed}: a seed is zero or positive")
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run,)))
    recording = simulator.simulate(parameters, generator)
    dumped = parameters.model_dump(mode="json")
    return recording, RunMetadata(scenario, dumped, seed, run, recording.epoch_ns, dict(recording.notes))


def import_run(source: str, path: Path, values: Mapping[str, Any]) -> tuple[Recording, RunMetadata]:
    """Import real data; raises BadInput for an unknown importer or parameter, or data it cannot read."""
    importer = load("recorders", source)
    if not isinstance(importer, Importer):
        raise BadInput(f"'{source}' simulates; use: fuselog record {source}")
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder; give the {source} data as published")
    parameters = build(importer.parameters, values, f"importer {source}")
    recording = importer.read(path, parameters)
    dumped = parameters.model_dump(mode="json")
    return recording, RunMetadata(source, dumped, None, 0, recording.epoch_ns, dict(recording.notes))
