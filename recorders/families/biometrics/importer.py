"""Importer of biometric score matrices, one CSV per matcher, as in NIST's Biometric Scores Set.

The first row contains the gallery's user ids, the first column the probes' user ids. Matchers are listed
in the parameters, or in a file `matchers.toml` in the folder:

    [[matchers]]
    name = "face-C"          # the file is face-C.csv
    modality = "face"
    score = "similarity"     # or "distance"
    failure = -1             # the score of a failure to enrol
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import PositiveFloat, field_validator

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.biometrics.models import Matcher, score_stream
from fuselog.recorders.parameters import Parameters, build
from fuselog.recorders.parsing import read_toml
from fuselog.recorders.recording import Importer, Recording, simulation_stamps_ns


class Matchers(Parameters):
    """Content of matchers.toml.

    Attributes:
        matchers: the matchers, in the order of their files.
    """

    matchers: list[Matcher] = []

    @field_validator("matchers")
    @classmethod
    def _differ(cls, matchers: list[Matcher]) -> list[Matcher]:
        if len({each.name for each in matchers}) < len(matchers):
            raise ValueError("two matchers have the same name; give each its own")
        return matchers


class ScoreMatricesParameters(Matchers):
    """The matchers, and the times between probes, which the data do not contain.

    Attributes:
        probe_interval_s: time between probes.
    """

    probe_interval_s: PositiveFloat = 1.0


class Matrix(NamedTuple):
    """Content of one file: ids of probes and gallery, scores (probes, gallery)."""

    probes: list[str]
    gallery: list[str]
    scores: NDArray[np.float64]


def read(folder: Path, parameters: ScoreMatricesParameters) -> Recording:
    """Read one matrix per matcher; users are numbered in the order of the files.

    Raises BadInput, with the name of the file, if a file is missing or malformed, if its users differ
    from those of the first file, or if its scores are not similarities or distances as declared.
    """
    if not folder.is_dir():
        raise BadInput(f"{folder}: not a folder; give the folder with one CSV per matcher")
    matchers = parameters.matchers or _described(folder)
    matrices = [_matrix(folder / f"{each.name}.csv") for each in matchers]
    first = matrices[0]
    for matcher, matrix in zip(matchers, matrices, strict=True):
        path = folder / f"{matcher.name}.csv"
        if matrix.probes != matrix.gallery:
            raise BadInput(
                f"{path}: rows and columns must have the ids of the same users in the same order"
            )
        if matrix.gallery != first.gallery:
            raise BadInput(
                f"{path}: {len(matrix.gallery)} users, not the {len(first.gallery)} of "
                f"{matchers[0].name}.csv in the same order; give matrices of the same users"
            )
        _check_sense(path, matcher, matrix.scores)
    arrival_s = parameters.probe_interval_s * np.arange(len(first.probes))
    arrival_ns = simulation_stamps_ns(arrival_s)
    scores = np.stack([matrix.scores for matrix in matrices], axis=-1)
    notes = {"times": f"not in the data; assumed to be a probe every {parameters.probe_interval_s:g} s"}
    return Recording([score_stream(matchers, scores, arrival_ns)], notes=notes)


def _described(folder: Path) -> list[Matcher]:
    path = folder / "matchers.toml"
    if not path.exists():
        raise BadInput(f"{path}: no such file; list the matchers there, or in the parameter 'matchers'")
    matchers = build(Matchers, read_toml(path), str(path)).matchers
    if not matchers:
        raise BadInput(
            f"{path}: lists no matchers; add a [[matchers]] table with name and modality for each"
        )
    return matchers


def _matrix(path: Path) -> Matrix:
    try:
        table = pd.read_csv(path, index_col=0, dtype={0: str}, keep_default_na=False)
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; every matcher needs a matrix") from None
    except (OSError, ValueError, IndexError) as error:
        raise BadInput(f"{path}: cannot be read as a matrix with ids ({error})") from None
    if table.empty or table.shape[0] != table.shape[1]:
        raise BadInput(
            f"{path}: {table.shape[0]} rows and {table.shape[1]} columns; give a square matrix"
        )
    numbers = table.apply(pd.to_numeric, errors="coerce").to_numpy(float)
    bad = ~np.isfinite(numbers)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        found = table.iloc[row, column]
        raise BadInput(
            f"{path}: probe {row + 1}, gallery entry {column + 1} is {found!r}; expected a number"
        )
    return Matrix(table.index.astype(str).tolist(), table.columns.astype(str).tolist(), numbers)


def _check_sense(path: Path, matcher: Matcher, scores: NDArray[np.float64]) -> None:
    """Raise BadInput if scores are uninformative, or are not similarities or distances as declared."""
    valid = scores != matcher.failure if matcher.failure is not None else np.ones(scores.shape, bool)
    genuine = np.eye(len(scores), dtype=bool)
    if not valid.any() or np.ptp(scores[valid]) == 0:
        raise BadInput(f"{path}: all scores are equal and cannot distinguish users; remove this matcher")
    if not (valid & genuine).any() or not (valid & ~genuine).any():
        raise BadInput(f"{path}: needs scores of the same and of different users; give more users")
    ahead = np.median(scores[valid & genuine]) - np.median(scores[valid & ~genuine])
    if ahead * (1 if matcher.score == "similarity" else -1) < 0:
        other = "distance" if matcher.score == "similarity" else "similarity"
        raise BadInput(
            f"{path}: declared as {matcher.score}, but scores of the same user are "
            f'{"lower" if ahead < 0 else "higher"} than those of others; declare score = "{other}"'
        )


SCORE_MATRICES = Importer(
    "biometric score matrices such as NIST BSSR1: a folder with a CSV per matcher, with users' ids",
    ScoreMatricesParameters,
    read,
)
