"""Checks that filters do not read the truth against which their estimates are judged.

A truth is a topic of type `TruthState`, or a topic that a channel or an estimator names as its truth.
`estimator.bound_to`, which binds estimators to logs, rejects an estimator that reads a truth. A bound is
not an estimate and may read the truth; a replay that starts from the truth passes it as a prior.
"""

from collections.abc import Collection, Mapping

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, schemas

TRUTH = schemas.TRUTH_STATE.full_name


def truths_among(topics: Mapping[str, Topic]) -> set[str]:
    """Return the topics that are truths, or that a channel names as its truth."""
    named = {each.metadata.get("truth", "") for each in topics.values()}
    return {name for name, each in topics.items() if each.schema_name == TRUTH or name in named}


def refuse_truths(label: str, read: Collection[str], truths: Collection[str], how: str = "") -> None:
    """Raise BadInput if an estimator would read a truth.

    Args:
        label: label of the estimator.
        read: topics that the estimator reads.
        truths: topics that are truths.
        how: the setting that makes the estimator read truths, if there is one.
    """
    for topic in read:
        if topic in truths:
            raise BadInput(
                f"estimator {label}: {how}{topic} is a truth, against which estimates are judged, so "
                "filters must not read it; to use it as a measurement, import it under another name, "
                'such as topic = "/survey/fix", becomes = "PositionFix" in a mapping'
            )


def refuse_named_truths(
    label: str, renamed: Mapping[str, str], topics: Mapping[str, Topic], own: Collection[str]
) -> None:
    """Raise BadInput if a setting `topics.ROLE` selects a truth for a role that is not a truth.

    Args:
        label: label of the estimator.
        renamed: topics by role.
        topics: topics of the log.
        own: the roles that are truths; a truth may be selected for these.
    """
    truths = truths_among(topics)
    for role, name in renamed.items():
        if name and role not in own:
            read = [each for each in topics if each.endswith(f"/{name.removeprefix('/')}")]
            refuse_truths(label, read, truths, f"topics.{role} = {name}: ")
