"""Names, sizes and numbers of a filter in C99, and the templates that they fill."""

import re
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FunctionLoader, StrictUndefined

from fuselog.replay.inference.kalman.update import innovation_components
from fuselog.replay.inference.linear_algebra.factors import FACTORS
from fuselog.replay.inference.model.model import Sensor
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.run.filtering import Filter
from fuselog.replay.inference.step_graphs import Step
from fuselog.replay.inference.whole_steps import WholeSteps
from fuselog.replay.tracing.c_text import Precision
from fuselog.replay.tracing.graph import INPUT, described, needed

_NAMES_OF_C = """auto break case char const continue default do double else enum extern float for goto if
inline int long register restrict return short signed sizeof static struct switch typedef union unsigned
void volatile while filter parameters P S C v F H G u a slope data time_ns duration_s step innovation
samples away centre shift value again index round i k found noise factorisation drawn_samples
abs acos asin atan ceil cos cosh div erf exp exp2 expm1 fabs fdim float_t floor fma fmax fmin fmod gamma
hypot j0 j1 jn ldexp log log10 log1p log2 logb main nan pow remainder rint sin sinh sqrt stderr stdin
stdout tan tanh time trunc y0 y1 yn vectors cortex_m4f"""


class CFilter(NamedTuple):
    """A filter that is to be written as C.

    Attributes:
        name: the prefix of its identifiers in C.
        filtering: the filter, bound to a log.
        steps: its steps.
        precision: the precision of its numbers.
        origin: description of the filter's source.
    """

    name: str
    filtering: Filter
    steps: WholeSteps
    precision: Precision
    origin: str

    @property
    def states(self) -> int:
        """Return the number of components of the state."""
        return self.filtering.bound_model.model.size

    @property
    def tangent(self) -> int:
        """Return the number of components of the state's tangent space."""
        return self.filtering.bound_model.model.tangent

    @property
    def controls(self) -> tuple[str, ...]:
        """Return the names of the filter's controls."""
        control = self.filtering.bound_model.model.control
        return control.components if control else ()

    @property
    def is_root(self) -> bool:
        """Test whether the filter stores a factor of the covariance, not the covariance itself."""
        return self.filtering.form is FACTORS

    @property
    def carried(self) -> str:
        """Return the name in C of the matrix that the filter stores."""
        return "factor" if self.is_root else "covariance"

    @property
    def is_interpolated(self) -> bool:
        """Test whether the motion uses the mean of the controls at the two ends of a step."""
        control = self.filtering.bound_model.model.control
        return control is not None and control.interpolated

    @property
    def has_gaps(self) -> bool:
        """Test whether the control may be missing for so long that the state becomes unknown."""
        control = self.filtering.bound_model.model.control
        return control is not None and bool(control.gap)

    @property
    def sensors(self) -> list[tuple[str, Sensor]]:
        """Return the sensors with their names in C; topics of the same kind have separate names."""
        found: dict[str, Sensor] = {}
        topics: dict[str, set[str]] = {}
        for sensor, topic in self.filtering.found.sensors:
            topics.setdefault(sensor.topic, set()).add(topic.name)
        for sensor, (_, topic) in zip(
            self.filtering.bound_model.sensors, self.filtering.found.sensors, strict=True
        ):
            if len(topics[sensor.topic]) > 1:
                sensor = replace(sensor, topic=topic.name)
            name = identifier(sensor.topic)
            found[name if name not in found else f"{name}_{'_'.join(sensor.measured)}"] = sensor
        return list(found.items())

    @property
    def most(self) -> int:
        """Return the number of components of the sensor that has the most."""
        return max((len(sensor.measured) for _, sensor in self.sensors), default=1)

    @property
    def innovation(self) -> list[str]:
        """Return the components of innovations."""
        return list(innovation_components(self.filtering.bound_model.sensors)) or ["none"]

    @property
    def parts(self) -> list[str]:
        """Return the motion and the sensors, in the order of the parameters in C."""
        return ["motion", *(name for name, _ in self.sensors)]

    @property
    def values(self) -> dict[str, dict[str, float]]:
        """Return the parameters that the motion and each sensor read, with their values, by name."""
        names = number_fields(self.filtering.bound_model.model.parameters)
        found = {}
        for row, part in enumerate(self.parts):
            read = set().union(*(_read(step) for step in self.steps.of(row)))
            of_part = zip(names, self.filtering.settings[row], strict=True)
            found[part] = {name: float(value) for name, value in of_part if name in read}
        return found

    def robustness(self, row: int) -> dict[str, float]:
        """Return the options of the gate and of robust updates, which are NaN if they are off."""
        names = number_fields(self.filtering.bound_model.model.parameters)
        options = ("gate_reopens_s", "inflate_nis", "student_freedom", "switch_nis")
        return {
            name.removeprefix("gate_"): float(self.filtering.settings[row, names.index(name)])
            for name in options
        }

    @property
    def digest(self) -> str:
        """Return a digest of the filter's graphs and numbers, which identifies the filter."""
        words = [repr([[*step.outputs] for step in self.steps.all])]
        words += [word for step in self.steps.all for word in described([*step.outputs.values()])]
        words += [
            repr((each.points.tolist(), each.weights.tolist()))
            for each in self.steps.sampled
            if each is not None
        ]
        words += ["factors"] if self.is_root else []
        numbers = [repr(self.values), repr(self.filtering.gates.tolist()), self.precision.real]
        return sha256("\n".join([*words, *numbers]).encode()).hexdigest()[:16]


def identifier(name: str) -> str:
    """Convert a name to a C identifier in lower case, without the slashes of topics."""
    text = re.sub(r"\W+", "_", name.strip("/")).lower()
    return (
        f"{text}_"
        if text in _NAMES_OF_C.split()
        else f"n{text}"
        if text[:1].isdigit()
        else text or "filter"
    )


def _read(step: Step) -> set[str]:
    nodes = needed([*step.outputs.values()])
    return {
        each.value[1] for each in nodes if each.operation is INPUT and isinstance(each.value[1], str)
    }


def text_of(name: str) -> str:
    """Read a file of this folder."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


_TEMPLATES = Environment(
    loader=FunctionLoader(text_of),
    block_start_string="/*%",
    block_end_string="%*/",
    variable_start_string="${",
    variable_end_string="}",
    comment_start_string="/*#",
    comment_end_string="#*/",
    keep_trailing_newline=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)


def rendered(made: CFilter, template: str, **values: Any) -> str:
    """Render a template of this folder, in which `made` is the filter.

    NAME is a placeholder for the filter's name; REAL and the suffix _S are placeholders for the
    precision. `/*% ... %*/` is a statement of Jinja2, `/*# ... #*/` a comment, `${...}` an expression.
    """
    text = _TEMPLATES.get_template(template).render(made=made, **values)
    text = re.sub(r"\bNAME_(?=[A-Z])", f"{made.name.upper()}_", text)
    text = re.sub(r"\bNAME(?=_|\b)", made.name, text)
    return made.precision.text(text)
