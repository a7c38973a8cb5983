"""Tables that any program can read: a CSV file for each topic."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from fuselog.recorders.log import Stream


def write_tables(folder: Path, streams: Sequence[Stream]) -> None:
    """Write each topic to a file such as `robot1-odometry.csv`, with `time_ns` and all fields.

    A vector has a column for each number, `position_m_0` and so on. The metadata of the channel is in
    `robot1-odometry.json`.
    """
    folder.mkdir()
    for stream in streams:
        columns = {"time_ns": stream.publish_time_ns}
        for field in stream.schema:
            values = stream[field.name]
            if values.ndim == 1:
                columns[field.name] = values
            else:
                columns |= {f"{field.name}_{place}": column for place, column in enumerate(values.T)}
        name = stream.topic.strip("/").replace("/", "-")
        pd.DataFrame(columns).to_csv(folder / f"{name}.csv", index=False)
        stated = pd.Series(dict(stream.metadata), dtype=object)
        (folder / f"{name}.json").write_text(stated.to_json(), encoding="utf-8")
