"""Streams for the tests of the log contract, by Hypothesis or from a seed, and how to compare them."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fuselog.recorders.log import Schema, Stream, make_stream, schemas

# From 16 doubles on the length before a vector takes two bytes.
WIDTHS = [0, 1, 2, 3, 9, 15, 16, 17, 40]
LARGEST_TIME = 2**63 - 1


@st.composite
def streams(
    draw, schema: Schema, topic: str = "/topic", times=None, least: int = 0, most: int = 12
) -> Stream:
    """Any stream that the schema allows; `times` is a strategy of stamps."""
    count = draw(st.integers(least, most))
    times = st.integers(0, LARGEST_TIME) if times is None else times

    def stamps():
        return draw(arrays(np.int64, count, elements=times))

    def column(field):
        if field.kind == "identifier":
            return draw(arrays(np.uint32, count))
        if field.kind == "time_ns":
            return draw(arrays(np.int64, count))
        shape = (count, draw(st.sampled_from(WIDTHS))) if field.kind == "vector" else count
        return draw(arrays(np.float64, shape, elements=st.floats(allow_nan=field.may_be_nan)))

    columns = {field.name: column(field) for field in schema}
    return make_stream(
        topic, schema, stamps(), log_time_ns=stamps(), metadata={"frame": "map"}, **columns
    )


def some_streams(seed: int, count: int = 60, latest_delay_ns: int = 400) -> list[Stream]:
    """Four interleaved topics of different layouts with late messages and equal stamps."""
    generator = np.random.default_rng(seed)
    made = []
    for schema, columns in {
        schemas.BEARING: {"target_id": 1, "bearing_rad": 1},
        schemas.POSITION_FIX: {"position_m": 2, "covariance_m2": 4},
        schemas.SCAN: {"scan_id": 1, "detections": 1},
        schemas.TRUTH_STATE: {"state": 16},
    }.items():
        published = np.sort(generator.integers(1000, 1000 + 4 * count, count))
        kinds = {field.name: field.kind for field in schema}
        made.append(
            make_stream(
                f"/{schema.name.lower()}",
                schema,
                published,
                log_time_ns=published + generator.integers(0, latest_delay_ns + 1, count),
                metadata={"components": "x_m,y_m"},
                **{
                    name: generator.integers(0, 1 << 32, count)
                    if kinds[name] == "identifier"
                    else generator.normal(size=(count, width) if kinds[name] == "vector" else count)
                    for name, width in columns.items()
                },
            )
        )
    return made


def assert_same(found: Stream, expected: Stream, rows=slice(None)) -> None:
    """The stream has exactly the given rows of the other, bit for bit, and means the same."""
    assert found.topic == expected.topic
    assert found.schema.full_name == expected.schema.full_name
    assert [field.kind for field in found.schema] == [field.kind for field in expected.schema]
    assert dict(found.metadata) == dict(expected.metadata)
    assert found.publish_time_ns.tolist() == expected.publish_time_ns[rows].tolist()
    assert found.log_time_ns.tolist() == expected.log_time_ns[rows].tolist()
    for name, column in expected.columns.items():
        assert found[name].dtype == column.dtype
        assert found[name].tobytes() == column[rows].tobytes(), name


def rows_in_file(stream: Stream) -> np.ndarray:
    """The order in which a log writes the rows: by log time, ties in the order given."""
    return np.argsort(stream.log_time_ns, kind="stable")


def rows_read(stream: Stream, clock: str = "publish_time") -> np.ndarray:
    """The order in which a log is read: by the clock, ties in file order; two plain sorts."""
    in_file = rows_in_file(stream)
    return in_file[np.argsort(stream.times(clock)[in_file], kind="stable")]
