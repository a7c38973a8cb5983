"""What `run` prints of claims."""

from collections.abc import Iterator

from fuselog.pipeline.output.claims import Claim
from fuselog.pipeline.output.terminal import print_claims
from tests.words.made.printing import printed


def claims() -> Iterator[str]:
    """Claims: decided, and of another recording."""
    made = [
        Claim("A is 1", "1 m", "1 m", "confirmed"),
        Claim("B is 2", "2 m", "3 m", "refuted", "by 1 m"),
    ]
    elsewhere = Claim("C is 3", "3 m", "4 m", "no verdict", "claimed for first, not for these data")
    yield from printed(print_claims, made)
    yield from printed(print_claims, [*made, elsewhere])


CLAIMED = (claims,)
