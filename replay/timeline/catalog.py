"""Datasets of recordings, served by Rerun's catalog server on the loopback interface only.

A dataset has segments, one for each run. A segment consists of layers, each of which is a file. One
layer has the properties, which are columns of the dataset's table; one has the recording; and there is
one layer for each estimator.
"""

import errno
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint.table as rrt
import rerun.chunk as rc
from rerun.catalog import CatalogClient, OnDuplicateSegmentLayer
from rerun.server import Server

from fuselog.recorders.errors import BadInput
from fuselog.replay.timeline.sinks import TableLayout, write_layout

LOOPBACK = "127.0.0.1"
PROPERTIES, BASE = "properties", "base"
APPLICATION = "fuselog"
# The entity of a text about the run.
ABOUT = "about"
EXTRA = "a list of runs needs the extra catalog (DataFusion, 115 MB): pip install 'fuselog[catalog]'"
# Columns of Rerun's own that say nothing about a run.
_HIDDEN = (
    "rerun_storage_urls",
    "rerun_last_updated_at",
    "rerun_num_chunks",
    "rerun_size_bytes",
    "property:RecordingInfo:name",
)


class Dataset:
    """A dataset in a running server.

    Args:
        client: a client of the server.
        name: the dataset's name.
    """

    def __init__(self, client: CatalogClient, name: str) -> None:
        self._client = client  # tables that are read need it
        self._entry = client.create_dataset(name)
        self.url = f"{client.url}/dataset/{self._entry.id}"

    def add(self, layers: Sequence[tuple[Path, str]]) -> None:
        """Register files as layers, each with its name; each file states its segment.

        Raises BadInput if a file cannot be read.
        """
        if not layers:
            return
        files = [path.resolve().as_uri() for path, _ in layers]
        names = [name for _, name in layers]
        replacing = OnDuplicateSegmentLayer.REPLACE
        try:
            self._entry.register(files, layer_name=names, on_duplicate=replacing).wait()
        except Exception as error:  # rerun does not document its exceptions
            raise BadInput(f"{layers[0][0].parent}: cannot be served ({error}); remove it") from error

    def lay_out(self, blueprint: Path, *, table: bool = False) -> None:
        """Set the layout of all segments, or of the table of segments, from an .rbl file."""
        self._entry.register_blueprint(blueprint.resolve().as_uri(), segment_table=table)

    @property
    def has_layout(self) -> bool:
        """Test whether the segments have a layout."""
        return self._entry.default_blueprint() is not None

    def url_of(self, segment: str) -> str:
        """Return the address of a segment."""
        return self._entry.segment_url(segment)


@contextmanager
def serve_dataset(name: str, port: int | None = None) -> Iterator[Dataset]:
    """Serve an empty dataset to this machine.

    Args:
        name: its name.
        port: port of the server; by default, any free port.

    Raises BadInput if the extra is missing or the port is in use.
    """
    try:
        server = Server(host=LOOPBACK, port=port)
    except Exception as error:  # rerun does not document its exceptions
        raise BadInput(
            f"--port {port}: the server of the dataset cannot use it ({error}); give another port, or "
            "leave out --port"
        ) from error
    with server:
        try:
            client = server.client()
        except ImportError:
            raise BadInput(EXTRA) from None
        yield Dataset(client, name)


def column_of(group: str, name: str) -> str:
    """Return the name of a property's column in the table of segments."""
    return f"property:{_plain(group)}:{_plain(name)}"


def _plain(name: str) -> str:
    """Return a name with an underscore for each character that Rerun would replace or escape."""
    return re.sub(r"\W", "_", name)


def has_catalog() -> bool:
    """Test whether datasets can be served."""
    try:
        import datafusion  # noqa: F401
    except ImportError:
        return False
    return True


def write_properties(
    path: Path, name: str, properties: Mapping[str, Mapping[str, Any]], text: str
) -> None:
    """Write the layer of a segment's properties, with a text in Markdown."""
    plain: dict[str, str] = {}
    for group in properties:
        other = plain.setdefault(_plain(group), group)
        if other != group:
            raise BadInput(f"{other} and {group}: columns cannot tell these names apart; rename one")
    chunks = [properties_chunk(group, own) for group, own in properties.items() if own]
    about = rr.TextDocument.columns(text=[text], media_type=[rr.MediaType.MARKDOWN])
    write_chunks(path, name, [*chunks, rc.Chunk.from_columns(f"/{ABOUT}", [], about)])


def properties_chunk(group: str, values: Mapping[str, Any]) -> rc.Chunk:
    """Return a group of a segment's properties; those of several layers are combined."""
    columns: dict[str, Any] = {_plain(name): [value] for name, value in values.items()}
    return rc.Chunk.from_property(_plain(group), rr.AnyValues(**columns))


def write_chunks(path: Path, name: str, chunks: Sequence[rc.Chunk]) -> None:
    """Write chunks of a segment to an .rrd file; raises OSError if that fails."""
    try:
        stream = rc.LazyChunkStream.from_iter(chunks)
        stream.write_rrd(path, application_id=APPLICATION, recording_id=name)
    except Exception as error:  # rerun does not document its exceptions
        raise OSError(errno.EIO, str(error), str(path)) from error


def read_chunks(path: Path) -> list[rc.Chunk]:
    """Read the chunks of an .rrd file, except Rerun's own properties."""
    return [each for each in rc.RrdReader(str(path)).stream() if each.entity_path != "/__properties"]


def write_table_layout(path: Path, properties: Sequence[tuple[str, str]]) -> None:
    """Write the layout of a table of segments that shows `properties` first, sorted by the first one."""
    columns = [column_of(*each) for each in properties]
    shown = [rrt.Column("rerun_segment_id", name="run"), *map(rrt.Column, columns)]
    hidden = [rrt.Column(name, visible=False) for name in _HIDDEN]
    layout = rrt.TableLayout(columns=[*shown, *hidden])
    write_layout(path, APPLICATION, TableLayout(table_layout=layout, sort_by=columns[0]))
