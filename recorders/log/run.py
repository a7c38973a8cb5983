"""What a run was: enough, in the log itself, to record it again."""

import json
from dataclasses import dataclass, field
from typing import Any

from recorders.errors import BadInput

RECORD_NAME = "fuselog.run"


@dataclass(frozen=True)
class RunMetadata:
    """Scenario, parameters, seed and epoch of one run; `seed` is None for imported data.

    `epoch_ns` is the log's time zero: simulated time plus the epoch gives the stamps.
    `notes` are facts that the recorder met (unknown barcodes, say), one short text each.
    """

    scenario: str
    parameters: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    run: int = 0
    epoch_ns: int = 0
    notes: dict[str, str] = field(default_factory=dict)

    def to_record(self) -> dict[str, str]:
        """The text pairs of the MCAP metadata record."""
        return {
            "scenario": self.scenario,
            "parameters": json.dumps(self.parameters, sort_keys=True),
            "seed": json.dumps(self.seed),
            "run": str(self.run),
            "epoch_ns": str(self.epoch_ns),
            "notes": json.dumps(self.notes, sort_keys=True),
        }

    @classmethod
    def from_record(cls, record: dict[str, str], path: object) -> "RunMetadata":
        """Read the MCAP metadata record back; raises BadInput where it is damaged."""
        try:
            return cls(
                scenario=record["scenario"],
                parameters=json.loads(record["parameters"]),
                seed=json.loads(record["seed"]),
                run=int(record["run"]),
                epoch_ns=int(record["epoch_ns"]),
                notes=json.loads(record["notes"]),
            )
        except (KeyError, ValueError) as error:
            raise BadInput(
                f"{path}: the metadata record '{RECORD_NAME}' is damaged ({error}); "
                "record or import the run again"
            ) from error
