"""What tests of recorders share: imports whose numbers are kept, and derivatives without rounding."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from fuselog.recorders import recording
from fuselog.recorders.log import RunMetadata
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Blocks, Recording
from tests.goldens import keeping, numbers

STEP = 1e-30


@pytest.fixture(scope="module", autouse=True)
def kept_numbers() -> Iterator[None]:
    """Hold what is imported to its kept numbers; `test_scenario_options.py` holds what is simulated."""
    describe = recording._metadata

    def described(
        name: str, parameters: Parameters, seed: int | None, run: int, found: Recording | Blocks
    ) -> RunMetadata:
        if isinstance(found, Recording) and seed is None:
            settings = parameters.model_dump(mode="json", exclude_defaults=True)
            keeping.hold(name, settings, numbers.of_recording(found))
        return describe(name, parameters, seed, run, found)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "_metadata", described)
        yield


class ComplexStep(np.ndarray):
    """Complex numbers that also know arctan2 and hypot; NumPy's do not.

    A step of 1e-30 in the imaginary direction gives derivatives to machine precision.
    """

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [np.asarray(value) for value in inputs]
        if ufunc is np.arctan2:
            y, x = plain
            turn = (x.real * y.imag - y.real * x.imag) / (x.real**2 + y.real**2)
            result = np.arctan2(y.real, x.real) + 1j * turn
        elif ufunc is np.hypot:
            result = np.sqrt(plain[0] ** 2 + plain[1] ** 2)
        else:
            result = getattr(ufunc, method)(*plain, **options)
        return np.asarray(result).view(ComplexStep)


def derivative(function: Callable[[Any], Any], x: np.ndarray) -> np.ndarray:
    """Derivatives (outputs, inputs, ...) of a component-first function at x (inputs, ...)."""
    columns = []
    for component in range(len(x)):
        shifted = x.astype(complex)
        shifted[component] += 1j * STEP
        columns.append([np.imag(np.asarray(out)) / STEP for out in function(shifted.view(ComplexStep))])
    return np.stack([np.stack(np.broadcast_arrays(*column)) for column in columns], axis=1)


@pytest.fixture
def complex_step() -> Callable[[Callable[[Any], Any], np.ndarray], np.ndarray]:
    """The function `derivative`: test modules cannot import from one another."""
    return derivative
