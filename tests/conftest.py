"""What tests of all rooms share."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run: a red test is red for everyone, and stays so until it is mended.
settings.register_profile("fuselog", deadline=None, derandomize=True)
settings.load_profile("fuselog")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real data sets that are not part of the project; tests without it are skipped."""
    beside_the_checkout = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FUSELOG_DATA", beside_the_checkout))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set FUSELOG_DATA to its folder")
    return folder
