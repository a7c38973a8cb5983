"""The header of a filter in C99, with types, names of components and functions."""

from fuselog.pipeline.deploying.c_source.names import CFilter, identifier, rendered
from fuselog.recorders.parameters import meanings
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.inference.formulas import reference_names
from fuselog.replay.inference.model.model import Sensor


def header(made: CFilter) -> str:
    """Write the text of NAME.h."""
    model = made.filtering.bound_model.model
    axes = tangent_components(list(model.state), model.kinds)
    return rendered(
        made,
        "filter.h",
        enums=[
            ("", map(identifier, model.state), "STATES"),
            ("AXIS_", [identifier(name) for name, _ in axes], "TANGENT"),
            ("CONTROL_", map(identifier, made.controls), "CONTROLS"),
            ("SENSOR_", [name for name, _ in made.sensors], "SENSORS"),
            ("INNOVATION_", map(identifier, made.innovation), "INNOVATION"),
        ],
        outcomes=outcomes(made),
        parameters=_parameters(made),
        control=model.control,
        silent_s=f"{made.filtering.gap_ns * 1e-9:g}",
        data_of=data_of,
    )


def _parameters(made: CFilter) -> dict[str, dict[str, str]]:
    """Describe the parameters of the motion and of each sensor, by their names in C."""
    meaning = meanings(made.filtering.bound_model.model.parameters)
    found: dict[str, dict[str, str]] = {}
    for part, values in made.values.items():
        found[part] = {}
        for name in values:
            words = " ".join(meaning.get(name, "").split()).replace("*/", "").rstrip(".")
            unit = unit_of(name)
            stated = f"in {unit}" if unit and unit not in words else ""
            found[part][identifier(name)] = ", ".join(filter(None, (words, stated)))
    return found


def outcomes(made: CFilter) -> dict[str, str]:
    """List what the functions of a filter may return, with the meaning of each outcome."""
    gap = {"NOT_DRIVEN": "the control is silent: the estimate is unknown"} if made.has_gaps else {}
    return {
        "WELL": "the state is finite: predicted, updated, or unchanged because a gate rejected the "
        "message",
        "NOTHING_MEASURED": "all measured components are NAN: nothing changed",
        "BAD_INPUT": "a number is infinite, is NAN but not missing, or is a negative variance: "
        "nothing changed",
        "BACKWARD": "the time is before that of the filter: nothing changed",
        "NOT_POSITIVE_DEFINITE": "the covariance of the state or of an innovation has no Cholesky "
        "factor: start again",
        "NOT_FINITE": "the state is not finite: start again",
        **gap,
    }


def data_of(sensor: Sensor) -> list[str]:
    """List the numbers in a sensor's message: measured components, references, and stated noise."""
    names = [*sensor.measured]
    names += reference_names(sensor)
    measured = list(sensor.measured)
    if sensor.covariance:
        names += [
            f"covariance of {measured[row]} and {measured[column]}"
            if row > column
            else f"variance of {measured[row]}"
            for row in range(len(measured))
            for column in range(row + 1)
        ]
    return names
