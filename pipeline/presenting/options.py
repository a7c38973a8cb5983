"""Options of the command `fuselog view`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Options of the command `fuselog view`; its help describes them."""

    runs: str | None
    port: int | None
    screenshot: Path | None
    at: float | str | None
    start_s: float | None
    end_s: float | None
    focus: str | None
    save: Path | None
    connect: str | None
    web: bool
    gap_limit_s: float
    recover: bool

    @property
    def is_of_one(self) -> bool:
        """Test whether an option is about the timeline of one run."""
        own = (self.at, self.start_s, self.end_s, self.focus, self.connect)
        is_file = self.save is not None and self.save.suffix == ".rrd"
        return is_file or any(each is not None for each in own)
