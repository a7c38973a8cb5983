"""Fixtures shared by all tests."""

import os
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest

DEFAULT_DATA = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A real data set's folder by its name, unpacked once; skips the test where it is not at hand."""
    unpacked: dict[str, Path] = {}

    def folder(name: str) -> Path:
        if name not in unpacked:
            home = Path(os.environ.get("FUSELOG_DATA", DEFAULT_DATA))
            archive = home / f"{name}.tar.xz"
            if not archive.exists():
                pytest.skip(f"{archive} is not here; set FUSELOG_DATA to the folder of the real data")
            place = tmp_path_factory.mktemp("data")
            with tarfile.open(archive) as opened:
                opened.extractall(place, filter="data")
            unpacked[name] = place / name
        return unpacked[name]

    return folder
