"""Metadata of a run in its log, sufficient to record the run again."""

import json
from dataclasses import dataclass, field
from textwrap import shorten
from types import NoneType
from typing import Any

from fuselog.recorders.errors import BadInput, check_format
from fuselog.recorders.parsing import parse_json

RECORD_NAME = "fuselog.run"
# Raised if a change would be misread by this reader; a log without a format has the first one.
FORMAT = 1


@dataclass(frozen=True)
class RunMetadata:
    """The facts from which one run can be recorded again.

    Attributes:
        scenario: name of the scenario or importer.
        parameters: parameters of the scenario or importer.
        seed: seed of the random numbers; None for imported data.
        run: number of the run among those with this seed.
        epoch_ns: time zero of the log: simulated time plus the epoch gives the stamps.
        notes: facts that the recorder reports (such as unknown barcodes), each with a short text.
    """

    scenario: str
    parameters: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    run: int = 0
    epoch_ns: int = 0
    notes: dict[str, str] = field(default_factory=dict)

    def to_record(self) -> dict[str, str]:
        """Return the text pairs of the MCAP metadata record."""
        return {
            "format": str(FORMAT),
            "scenario": self.scenario,
            "parameters": json.dumps(self.parameters, sort_keys=True),
            "seed": json.dumps(self.seed),
            "run": str(self.run),
            "epoch_ns": str(self.epoch_ns),
            "notes": json.dumps(self.notes, sort_keys=True),
        }

    @classmethod
    def from_record(cls, record: dict[str, str], path: object) -> "RunMetadata":
        """Parse the MCAP metadata `record` of the file `path`.

        Raises BadInput if it is damaged or has another format.
        """
        try:
            written_in = _stated({"format": "1", **record}, "format", int)
            check_format(path, written_in, FORMAT)
            epoch_ns = _stated(record, "epoch_ns", int)
            notes = _stated(record, "notes", dict)
            if epoch_ns >= 2**63:
                raise ValueError("epoch_ns is after the year 2262")
            if not all(isinstance(note, str) for note in notes.values()):
                raise ValueError("some notes are not texts")
            return cls(
                scenario=record["scenario"],
                parameters=_stated(record, "parameters", dict),
                seed=_stated(record, "seed", int, NoneType),
                run=_stated(record, "run", int),
                epoch_ns=epoch_ns,
                notes=notes,
            )
        except (KeyError, ValueError) as error:
            reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise BadInput(
                f"{path}: the metadata record '{RECORD_NAME}' is damaged ({reason}); "
                "record or import the run again"
            ) from error


_WANTED = {dict: "an object", int: "a whole number", NoneType: "null"}


def _stated(record: dict[str, str], name: str, *kinds: type) -> Any:
    """Parse the JSON under `name`, which must have one of these types; numbers must not be negative."""
    value = parse_json(record[name])
    if type(value) not in kinds:
        wanted = " or ".join(_WANTED[kind] for kind in kinds)
        raise ValueError(f"{name} is {shorten(record[name], 40)}, expected {wanted}")
    if isinstance(value, int) and value < 0:
        raise ValueError(f"{name} is negative")
    return value
