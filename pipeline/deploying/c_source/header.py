"""The header of a filter in C99, with types, names of components and functions."""

from collections.abc import Iterator, Sequence

from fuselog.pipeline.deploying.c_source.names import CFilter, filled, identifier
from fuselog.recorders.parameters import meanings
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.inference.formulas import reference_names
from fuselog.replay.inference.model.model import Sensor

_COVARIANCE = """\
/* The covariance L L' from the lower factor L that the filter carries. */
void NAME_covariance(const NAME *filter, REAL covariance[NAME_TANGENT][NAME_TANGENT]);
"""


def header(made: CFilter) -> str:
    """Write the text of NAME.h."""
    model, upper = made.filtering.bound_model.model, made.name.upper()
    state = [(identifier(name), kind) for name, kind in model.state.items()]
    axes = [identifier(name) for name, _ in tangent_components(list(model.state), model.kinds)]
    lines = [
        f"/* {made.origin}",
        f" * Made by fuselog deploy; graphs and numbers {made.digest}. Licence: Apache-2.0, or yours.",
        " *",
        " * No heap, no recursion, no arrays of varying length. Times are in nanoseconds. The",
        " * covariance is in the tangent space, which has three components for a quaternion. */",
        f"#ifndef {upper}_H\n#define {upper}_H\n",
        "#include <stdint.h>\n",
        f'#define {upper}_DIGEST "{made.digest}"\n',
        *_enum(made, "", [name for name, _ in state], "STATES"),
        *(_enum(made, "AXIS_", axes, "TANGENT")),
        *_enum(made, "CONTROL_", [identifier(name) for name in made.controls], "CONTROLS"),
        *_enum(made, "SENSOR_", [name for name, _ in made.sensors], "SENSORS"),
        *_enum(made, "INNOVATION_", [identifier(name) for name in made.innovation], "INNOVATION"),
        f"enum {{ {upper}_MOST = {made.most} }}; /* components of the widest sensor */",
        *_outcomes(made),
        filled(
            made,
            """/* A measurement with a larger NIS than nis[its components] is not used, unless the last
 * used one is more than reopens_s ago; the other options reduce the weight of used ones. NAN: off. */
typedef struct {
    REAL nis[NAME_MOST + 1];
    double reopens_s;
    REAL inflate_nis, student_freedom, switch_nis;
} NAME_gate;
""",
        ),
        "typedef struct {",
        *_struct(made),
        f"}} {made.name}_parameters;\n",
        f"extern const {made.name}_parameters {made.name}_as_tuned;\n",
        filled(
            made,
            """typedef struct {
    int64_t time_ns;
    REAL mean[NAME_STATES];
    REAL CARRIED[NAME_TANGENT][NAME_TANGENT];
    REAL control[NAME_CONTROLS + 1];
    int64_t accepted_ns[NAME_SENSORS + 1]; /* when a measurement was last used */
GAP} NAME;

/* Measured minus predicted, and its covariance before the update; NAN if a component is missing. */
typedef struct {
    REAL difference[NAME_INNOVATION];
    REAL covariance[NAME_INNOVATION][NAME_INNOVATION];
    REAL nis;
    int is_accepted; /* 1 if the measurement changed the state; only together with NAME_WELL */
} NAME_innovation;

/* Starts at a prior, without a control. An invalid prior leaves a state that is not finite. */
NAME_outcome NAME_init(NAME *filter, int64_t time_ns, const REAL *mean,
    const REAL *covariance);

FACTOR""".replace("CARRIED", "factor" if made.is_root else "covariance")
            .replace("FACTOR", _COVARIANCE if made.is_root else "")
            .replace(
                "GAP",
                "    int is_in_gap; /* whether the control is silent */\n" if made.has_gaps else "",
            ),
        ),
        _predict_comment(made),
        filled(made, f"{predict_signature(made)};\n"),
    ]
    for name, sensor in made.sensors:
        lines.append(_update_comment(sensor))
        lines.append(filled(made, f"{update_signature(name)};\n"))
    return "\n".join([*lines, f"#endif /* {upper}_H */"]) + "\n"


def _enum(made: CFilter, part: str, names: Sequence[str], count: str) -> Iterator[str]:
    upper = made.name.upper()
    listed = [f"{upper}_{part}{name.upper()}" for name in names]
    yield "enum {" + "".join(f"\n    {each}," for each in listed) + f"\n    {upper}_{count}\n}};\n"


def _struct(made: CFilter) -> Iterator[str]:
    meaning = meanings(made.filtering.bound_model.model.parameters)
    for part, values in made.values.items():
        yield "    struct {"
        for name in values:
            words = " ".join(meaning.get(name, "").split()).replace("*/", "")
            unit = unit_of(name)
            comment = ", ".join(
                filter(None, (words.rstrip("."), f"in {unit}" if unit and unit not in words else ""))
            )
            yield f"        {made.precision.real} {identifier(name)};" + (
                f" /* {comment} */" if comment else ""
            )
        if part != "motion":
            yield f"        {made.name}_gate gate;"
        elif not values:
            yield "        char unused; /* it has no parameters */"
        yield f"    }} {part};"


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


def _outcomes(made: CFilter) -> Iterator[str]:
    """Write the enum of outcomes."""
    yield "typedef enum {"
    for name, meaning in outcomes(made).items():
        yield f"    {made.name.upper()}_{name}, /* {meaning} */"
    yield f"}} {made.name}_outcome;\n"


def predict_signature(made: CFilter) -> str:
    """Write the signature of a prediction."""
    control = ", const REAL *control" if made.is_interpolated else ""
    return (
        f"NAME_outcome NAME_predict(NAME *filter, int64_t time_ns{control},\n"
        "    const NAME_parameters *parameters)"
    )


def _predict_comment(made: CFilter) -> str:
    if made.is_interpolated:
        return _between_comment(made)
    driven = "; filter->control holds until you change it" if made.controls else ""
    return f"/* Predicts to a time{driven}. */"


def _between_comment(made: CFilter) -> str:
    control = made.filtering.bound_model.model.control
    assert control is not None
    note = "Predicts to a time with the mean of the last control and the control at that time."
    if not made.has_gaps:
        return f"/* {note} */"
    after = (
        "the next prediction with a control covers the whole gap"
        if made.steps.gap is not None
        else "the filter has to be started again"
    )
    silent = made.filtering.gap_ns * 1e-9
    return (
        f"/* {note}\n * Pass NAN while {control.topic} is silent for longer than {control.gap},\n"
        f" * {silent:g} s, up to its first message then: {made.name.upper()}_NOT_DRIVEN says that the\n"
        f" * estimate is unknown, messages must not be used, and {after}. */"
    )


def update_signature(name: str) -> str:
    """Write the signature of an update by a sensor."""
    return (
        f"NAME_outcome NAME_update_{name}(NAME *filter, const REAL *data,\n"
        "    const NAME_parameters *parameters, NAME_innovation *innovation)"
    )


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


def _update_comment(sensor: Sensor) -> str:
    return (
        f"/* Updates by {sensor.topic}, at the filter's time: data is {', '.join(data_of(sensor))}. */"
    )
