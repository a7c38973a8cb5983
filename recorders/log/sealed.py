"""Our own metadata records, sealed with a checksum, since MCAP gives a metadata record none."""

import json
import zlib
from collections.abc import Mapping

from recorders.log.chunks import Damaged

OWN_NAMES = "fuselog."
# The span of publish time of every chunk, as "first last" in ns, by the region's key.
PUBLISH_SPANS = f"{OWN_NAMES}publish_spans"
_SEAL = "crc32"


def seal(pairs: Mapping[str, str]) -> dict[str, str]:
    """The pairs of a record of ours with their checksum beside them."""
    return {**pairs, _SEAL: _checksum(pairs)}


def unseal(name: str, pairs: Mapping[str, str]) -> dict[str, str]:
    """The pairs without their checksum, which is compared where the record is ours.

    Raises Damaged where it is wrong.
    """
    bare = {key: value for key, value in pairs.items() if key != _SEAL}
    if name.startswith(OWN_NAMES) and pairs.get(_SEAL) != _checksum(bare):
        raise Damaged(f"its metadata record '{name}' is damaged (the checksum is wrong)")
    return bare if name.startswith(OWN_NAMES) else dict(pairs)


def _checksum(pairs: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(pairs.items())).encode()):08x}"
