"""Checksums for fuselog's metadata records, which MCAP does not protect."""

import json
import zlib
from collections.abc import Mapping

from fuselog.recorders.log.container.chunks import Damaged, Span

OWN_NAMES = "fuselog."
# The publish times of each chunk; MCAP's index only has log times.
PUBLISH_SPANS = f"{OWN_NAMES}publish_spans"
_SEAL = "crc32"


def seal(pairs: Mapping[str, str]) -> dict[str, str]:
    """Add a checksum to the pairs of one of fuselog's records."""
    return {**pairs, _SEAL: _checksum(pairs)}


def unseal(name: str, pairs: Mapping[str, str]) -> dict[str, str]:
    """Verify and remove the checksum of one of fuselog's records; return other records unchanged.

    Raises Damaged if the checksum is wrong.
    """
    if not name.startswith(OWN_NAMES):
        return dict(pairs)
    bare = {key: value for key, value in pairs.items() if key != _SEAL}
    if pairs.get(_SEAL) != _checksum(bare):
        raise Damaged(f"its metadata record '{name}' is damaged (the checksum is wrong)")
    return bare


def note_span(offset: int, length: int, span: Span) -> tuple[str, str]:
    """Make the pair in `PUBLISH_SPANS` that notes the span of the chunk at these bytes of the file."""
    return f"{offset}+{length}", f"{span.first_ns} {span.last_ns}"


def noted_span(pairs: Mapping[str, str], offset: int, length: int) -> Span | None:
    """Return the span noted by `note_span`; None if it is missing, as in files of other tools."""
    noted = pairs.get(f"{offset}+{length}")
    return None if noted is None else Span(*map(int, noted.split()))


def _checksum(pairs: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(pairs.items())).encode()):08x}"
