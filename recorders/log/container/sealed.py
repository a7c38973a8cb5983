"""Seals our own metadata records with a checksum, since MCAP gives a metadata record none."""

import json
import zlib
from collections.abc import Mapping

from fuselog.recorders.log.container.chunks import Damaged, Span

OWN_NAMES = "fuselog."
# When the messages of each chunk were published: what MCAP's index has of log times only.
PUBLISH_SPANS = f"{OWN_NAMES}publish_spans"
_SEAL = "crc32"


def seal(pairs: Mapping[str, str]) -> dict[str, str]:
    """Return the pairs of a record of ours with their checksum beside them."""
    return {**pairs, _SEAL: _checksum(pairs)}


def unseal(name: str, pairs: Mapping[str, str]) -> dict[str, str]:
    """Return the pairs without their checksum, which is compared; a foreign record as it is.

    Raises Damaged where the checksum is wrong.
    """
    if not name.startswith(OWN_NAMES):
        return dict(pairs)
    bare = {key: value for key, value in pairs.items() if key != _SEAL}
    if pairs.get(_SEAL) != _checksum(bare):
        raise Damaged(f"its metadata record '{name}' is damaged (the checksum is wrong)")
    return bare


def note_span(offset: int, length: int, span: Span) -> tuple[str, str]:
    """Return the pair of `PUBLISH_SPANS` that tells of the chunk at these bytes of the file."""
    return f"{offset}+{length}", f"{span.first_ns} {span.last_ns}"


def noted_span(pairs: Mapping[str, str], offset: int, length: int) -> Span | None:
    """Return what `note_span` noted; None where it did not, as in a file that another tool rewrote."""
    noted = pairs.get(f"{offset}+{length}")
    return None if noted is None else Span(*map(int, noted.split()))


def _checksum(pairs: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(pairs.items())).encode()):08x}"
