"""Tables that were made to trouble end in a sentence, in bounded time and memory."""

import gzip
import json
import os
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.files import open_table
from fuselog.recorders.importers.tables.mapping import fitted, names_in


@pytest.mark.paper
def test_json_that_is_nested_deeply_is_refused(tmp_path: Path) -> None:
    """Arrow recurses: it would take the process with it."""
    nested = {
        "objects": '{"a":' * 100_000 + "1" + "}" * 100_000,
        "over lines": '{"t": 1, "a":' + "\n[" * 100_000 + "1" + "]" * 100_000 + "}",
        # brackets in strings close nothing
        "with strings": '{"t": 1, "x": "]]]\\"", "a":' + '["]]]",' * 1000 + "1" + "]" * 1000 + "}",
    }
    for name, text in nested.items():
        (tmp_path / f"{name}.jsonl").write_text('{"t": 0}\n' + text)
    program = (
        "import sys; from pathlib import Path\n"
        "from fuselog.recorders.errors import BadInput\n"
        "from fuselog.recorders.importers.tables.files import open_table\n"
        "for name in sys.argv[1:]:\n"
        "    try: open_table(Path(f'{name}.jsonl'))\n"
        "    except BadInput as error: print(error)"
    )
    command = [sys.executable, "-c", program, *nested]
    environment = {**os.environ, "PYTHONPATH": str(Path.cwd())}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    for name, said in zip(nested, done.stdout.splitlines(), strict=True):
        assert said.startswith(f"{name}.jsonl: "), done.stderr
        assert said.endswith("(it is nested more than 50 levels deep)")
    shallow = tmp_path / "shallow.jsonl"
    shallow.write_text('{"t": 0, "x": "' + "[{" * 1000 + '", "y": [[1, 2]]}\n')
    assert open_table(shallow).columns == ["t", "x", "y.0"]


@pytest.mark.paper
@pytest.mark.parametrize("suffix", ["csv", "jsonl", "npz", "parquet"])
def test_more_columns_than_can_be_read_are_refused(suffix: str, tmp_path: Path) -> None:
    path, names = tmp_path / f"wide.{suffix}", [f"c{number}" for number in range(10_001)]
    if suffix == "csv":
        path.write_text("\n".join([",".join(names), ",".join("1" * 10_001)]))
    elif suffix == "jsonl":
        path.write_text(json.dumps(dict.fromkeys(names, 1)))
    elif suffix == "npz":
        np.savez(path, wide=np.zeros((2, 10_001)))
    else:
        pyarrow.parquet.write_table(pa.table({"wide": [[1.0] * 10_001]}), path)
    with pytest.raises(BadInput, match=r"wide\.\w+: .*at most 10000 can be read"):
        open_table(path)


def test_a_line_that_is_too_long_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.csv.gz"
    with gzip.open(path, "wb", compresslevel=1) as file:
        file.write(b"t,x\n" + bytes(1 << 24))
    with pytest.raises(BadInput, match="a line of more than 8 MB"):
        open_table(path)


@pytest.mark.paper
def test_what_unpacks_to_much_is_known_at_once(tmp_path: Path) -> None:
    """Of an array of 64 MB its shape."""
    bomb = tmp_path / "bomb.npz"
    np.savez_compressed(bomb, t=np.broadcast_to(np.zeros(1), 8_000_000))
    tracemalloc.start()
    try:
        assert open_table(bomb).columns == ["t"]
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()


@pytest.mark.paper
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_read_block_by_block(order: str, tmp_path: Path) -> None:
    """Every row of an array of several blocks is as it was."""
    path = tmp_path / "long.npz"
    pairs = np.asarray(np.arange(600_000).reshape(-1, 2), ">i4", order=order)
    np.savez(path, pairs=pairs, t=np.arange(300_000.0), word=np.full(300_000, "a"))
    table = open_table(path)
    batches = list(table.batches(["pairs.0", "pairs.1", "t"], ["word"]))
    assert len(batches) > 1
    for number in range(2):
        column = np.concatenate([batch[f"pairs.{number}"] for batch in batches])
        assert np.array_equal(column, pairs[:, number])
    assert np.array_equal(np.concatenate([batch["t"] for batch in batches]), np.arange(300_000.0))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(BadInput, match="cannot be read as npz"):
        open_table(path)


def test_text_that_is_not_utf_8_is_refused_where_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "latin.csv"
    path.write_bytes(b"t,x,note\n1,2,ab\n2,3,\xe9\n3,\xe9\n")
    table = open_table(path)
    (batch,) = table.batches(["t", "x"])
    assert batch["x"].to_pylist() == [2.0, 3.0]
    assert table.left_out == {"with a number of cells other than 3": 1}
    with pytest.raises(BadInput, match="column note holds text that is not UTF-8"):
        list(table.batches(["t"], ["note"]))


@pytest.mark.parametrize(
    ("pattern", "name", "found"),
    [
        ("imu_{unit}.csv", "imu_left.csv", {"unit": "left"}),
        ("{a}/{b}_*.csv", "x/y_z_1.csv", {"a": "x", "b": "y_z"}),
        ("{a}{b}?", "xyz", {"a": "x", "b": "y"}),
        ("*.csv", "a/b.csv", None),
        ("{a}.csv", ".csv", None),
        ("[a].csv", "[a].csv", {}),
        ("*", "", {}),
        ("*a" * 100 + "*b", "a" * 4000, None),
        ("".join(f"{{v{number}}}" for number in range(12)) + "b", "a" * 4000, None),
    ],
)
def test_patterns_of_names_fit_without_trying_all_ways(
    pattern: str, name: str, found: dict[str, str] | None
) -> None:
    begin_s = time.process_time()
    assert fitted(pattern, name) == found
    assert time.process_time() - begin_s < 2.0
    assert found is None or names_in(pattern) == list(found)
