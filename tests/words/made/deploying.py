"""Made cases of what `fuselog deploy` says of single precision."""

from collections.abc import Iterator

from pipeline.deploying.folder import lost_sentence


def lost() -> Iterator[str]:
    """Single precision in which a covariance is lost, of a plain filter and of a square-root form."""
    for is_root in (False, True):
        yield lost_sentence({"lost_event": 111, "lost_s": 1.11}, is_root=is_root)


DEPLOYED = (lost,)
