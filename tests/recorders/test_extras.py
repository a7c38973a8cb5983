"""What an extra brings is missed in one sentence, by whoever asks for it."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.broad import _datasets
from fuselog.recorders.importers.tables.rows import _onto_map
from fuselog.replay.families.directional.distributions.torus_mixtures import fit_wrapped_mixture
from fuselog.replay.families.sets.regions.moving_sets import from_rings


@pytest.mark.parametrize(
    ("package", "extra", "use"),
    [
        ("h5py", "papers", lambda: _datasets(Path("trial.hdf5"))),
        ("sklearn", "papers", lambda: fit_wrapped_mixture(np.zeros((40, 2)), 2)),
        ("shapely", "papers", lambda: from_rings([np.eye(3, 2)])),
        ("pyproj", "maps", lambda: _onto_map.__wrapped__("EPSG:25832")),
    ],
)
def test_what_is_missing_is_said(
    package: str, extra: str, use: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [each for each in sys.modules if each.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(BadInput, match=rf"needs {package}, .* pip install 'fuselog\[{extra}\]'"):
        use()
