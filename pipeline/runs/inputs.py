"""Names where the runs of an experiment come from: a scenario, real data, or logs."""

from typing import Any

from recorders.parameters import Parameters


class Record(Parameters):
    """What to simulate.

    Attributes:
        scenario: a scenario by name or TOML file.
        parameters: what differs from its defaults, by name.
    """

    scenario: str
    parameters: dict[str, Any] = {}


class Import(Parameters):
    """What to import; the data's place comes from --data.

    Attributes:
        source: name of the importer.
        parameters: what differs from its defaults, by name.
    """

    source: str
    parameters: dict[str, Any] = {}


class Logs(Parameters):
    """Logs to replay, one run each.

    Attributes:
        files: files or patterns such as `drive-*.mcap`, from the folder of the experiment's file on;
            estimates that lie beside the logs are left out.
    """

    files: list[str] = []
