"""Estimators made from a model and a method, and their binding to the topics of a log."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import Annotated, Any, NamedTuple

from pydantic import Field, create_model
from pydantic.fields import FieldInfo

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Topic
from fuselog.recorders.parameters import Parameters, build, meanings
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.arrays import AnyArgument, Floats
from fuselog.replay.engine.replaying.estimator import (
    Alike,
    AnyEstimator,
    Bound,
    Estimator,
    Recursive,
)
from fuselog.replay.engine.replaying.truth import refuse_named_truths
from fuselog.replay.engine.streams.blocks import Findings
from fuselog.replay.inference.kalman.methods import Method
from fuselog.replay.inference.model.augmentation import (
    Added,
    Start,
    augmented,
    augmented_model,
    begin,
    check_augmentable,
    estimated,
    with_gauss_markov,
)
from fuselog.replay.inference.model.binding import (
    Found,
    first_and_more,
    in_its_plane,
    offers_of,
    roles_of,
    topics_of,
    with_more,
)
from fuselog.replay.inference.model.bound_model import BoundModel, bound_model_of
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.own_parameters import check_tables, with_own_parameters
from fuselog.replay.inference.model.parameters import (
    CombinedParameters,
    ModelParameters,
    number_fields,
)
from fuselog.replay.inference.model.settings import (
    assumed_of,
    settings_of,
)
from fuselog.replay.inference.requirements import (
    OWN_MODEL,
    elsewhere,
    names_state,
    nearest,
    requirements_of,
)
from fuselog.replay.inference.run.filtering import Filter, samplers_of
from fuselog.replay.inference.run.initialization import Initializer
from fuselog.replay.inference.run.out_of_sequence import OutOfSequenceFilter
from fuselog.replay.inference.run.reading import reading_of


def combined(model: Model, method: Method) -> type[ModelParameters]:
    """Return the parameter type that combines the parameters of a model and of a method."""
    return _combined(model.parameters, method.parameters)


@lru_cache(maxsize=256)
def _combined(of_model: type[ModelParameters], of_method: type[Parameters]) -> type[ModelParameters]:
    return _created(f"{of_model.__name__}With{of_method.__name__}", (of_method, of_model))


def _created(
    name: str, bases: tuple[type[Parameters], ...], fields: Mapping[str, AnyArgument] | None = None
) -> type[CombinedParameters]:
    """Create a parameter type that inherits the fields and descriptions of its bases."""
    made: type[CombinedParameters] = create_model(name, __base__=bases, **(fields or {}))
    return made


def _with_defaults(kind: type[ModelParameters], defaults: Mapping[str, object]) -> type[ModelParameters]:
    """Create a parameter type that overrides some of the defaults of another type."""
    fields: dict[str, AnyArgument] = {}
    for name, value in defaults.items():
        field = kind.model_fields[name]
        fields[name] = (_accepted(field), Field(value, description=field.description))
    return _created(kind.__name__, (kind,), fields) if fields else kind


def _accepted(field: FieldInfo) -> AnyArgument:
    """Return the type that a parameter accepts, including its bounds."""
    bounds = tuple(field.metadata)
    return Annotated[(field.annotation, *bounds)] if bounds else field.annotation


def modelled_by(
    model: Model, method: Method, name: str, settings: Mapping[str, object] | None = None
) -> AnyEstimator:
    """Make the estimator that applies a method to one model.

    Args:
        model: the model whose state is estimated.
        method: the method.
        name: name of the method, with its variant, for the summary, the label and error messages.
        settings: defaults that the method's variant sets, by parameter name.

    Raises BadInput if the method does not accept the settings, or if the model lacks something that the
    method needs.
    """
    where, settings = f"method {name}", settings or {}
    values = build(method.parameters, settings, where)
    made = _made_for(where, method, values)
    if made.sampling:
        made.sampling(values)
    lacking = made.lacks(model)
    if lacking:
        raise BadInput(f"{where}: the model lacks {lacking}, which this method needs")
    of_name = f" ({name})" if settings else ""
    return Estimator(
        f"{model.summary}, {method.summary}{of_name}",
        requirements_of(model),
        _with_defaults(combined(model, method), {each: getattr(values, each) for each in settings}),
        partial(bind_model, model=model, method=method),
        variant=method.variant,
        label=name,
    )


def model_of(estimator: AnyEstimator) -> Model | None:
    """Return the model of an estimator that `modelled_by` made; None for other estimators."""
    made = estimator.bind
    return made.keywords["model"] if isinstance(made, partial) and made.func is bind_model else None


def of_any_model(method: Method) -> AnyEstimator:
    """Make the estimator that applies one method to the registered model that fits a log."""
    return _OfAnyModel(method)


class _OfAnyModel(AnyEstimator):
    """Estimator that collects its requirements and parameters from all models on demand."""

    def __init__(self, method: Method) -> None:
        vars(self).update(
            summary=method.summary,
            bind=partial(_bind_fitting, method=method),
            variant=method.variant,
            _method=method,
        )

    @cached_property
    def requirements(self) -> str:
        """Describe what the log must contain, for every registered model."""
        return " or ".join(
            f"({name}) {requirements_of(model)}" for name, model in registered_models().items()
        )

    @cached_property
    def parameters(self) -> type[Parameters]:
        """The parameters of all models and of the method."""
        return _any_parameters(vars(self)["_method"])

    def parameters_with(self, name: str, variant: Mapping[str, object]) -> type[Parameters]:
        """Return the parameters of all models and of the method that the variant selects."""
        return _any_parameters(self._made(name, variant))

    def parameters_by_model(
        self, name: str, variant: Mapping[str, object]
    ) -> dict[str, type[Parameters]]:
        """Return the parameters for each model that the method can estimate, by model name."""
        method = self._made(name, variant)
        models = registered_models().items()
        return {each: combined(model, method) for each, model in models if not method.lacks(model)}

    def _made(self, name: str, variant: Mapping[str, object]) -> Method:
        where, method = f"estimator {name}", vars(self)["_method"]
        return _made_for(where, method, build(method.parameters, variant, where))


def registered_models(names: Iterable[str] | None = None) -> dict[str, Model]:
    """Return all registered models, or those named, by name, without those that fail to load.

    An error in such a model is raised only when the user names it.
    """
    found = {}
    for name in available("models") if names is None else names:
        with suppress(BadInput):
            found[name] = load("models", name, Model)
    return found


@lru_cache(maxsize=16)
def _any_parameters(method: Method) -> type[Parameters]:
    """Make the parameter type with a method's parameters, all models' parameters (unset), and `model`.

    The values are checked against a model's requirements once the model that fits the log is known.
    """
    fields: dict[str, AnyArgument] = {"model": (str | None, Field(None, description=_MODEL))}
    models_of: dict[str, dict[str, list[str]]] = {}
    for model_name, model in registered_models().items():
        meaning_of = meanings(model.parameters)
        for name, field in model.parameters.model_fields.items():
            if name not in method.parameters.model_fields:
                models_of.setdefault(name, {}).setdefault(meaning_of.get(name, ""), []).append(
                    model_name
                )
                kind = _accepted(field)
                other = fields.get(name, (kind,))[0]
                meaning = _of_models(models_of[name])
                unset = Field(None, description=meaning, validate_default=False)
                fields[name] = (kind if other == kind else Any, unset)
    return _created(f"Any{method.parameters.__name__}", (method.parameters,), fields)


_MODEL = "name of the model to estimate; by default, the registered model that fits the log."


def _of_models(meanings_of: Mapping[str, Sequence[str]]) -> str:
    """Describe a parameter; if its meaning differs between models, describe it model by model."""
    if len(meanings_of) == 1:
        return next(iter(meanings_of))
    return " ".join(f"{', '.join(models)}: {meaning}" for meaning, models in meanings_of.items())


# Topics found for each model in the last few logs; logs are often bound again with other parameters.
_FOUND = Findings()


def _bind_fitting(
    label: str, topics: Mapping[str, Topic], values: Parameters, *, method: Method
) -> list[Bound]:
    """Bind the model that the parameters name, or the only registered model that fits the log.

    Raises BadInput if the named model does not fit, if no model or several models fit, if the method
    cannot estimate the model, or if the model has no such parameter.
    """
    models = registered_models()
    given = {name: getattr(values, name) for name in values.model_fields_set}
    named = given.pop("model", None)
    if named is not None:
        models = {named: load("models", named, Model)}
    renamed, _ = first_and_more(given.get("topics") or {})
    asked = {name: roles_of(model) for name, model in models.items()} if renamed else {}
    for role in renamed:
        _check_role(label, role, {each for roles in asked.values() for each in roles})
    refuse_named_truths(label, renamed, topics, {model.truth for model in models.values()})
    stated = (
        (
            each.name,
            each.schema_name,
            each.encoding,
            each.channel_ids,
            each.messages,
            *each.metadata.items(),
        )
        for each in topics.values()
    )
    found = _FOUND.once(
        (*models.items(), *renamed.items(), *stated),
        lambda: {
            name: topics_of(model, topics, renamed) if renamed.keys() <= set(asked.get(name, ())) else []
            for name, model in models.items()
        },
    )
    fitting = [name for name, model in models.items() if found[name] and (named or not model.by_name)]
    chooses = elsewhere(models, topics, renamed)
    if chooses:
        raise BadInput(f"estimator {label}: {chooses}")
    # prefer models whose prior has all components, then models whose prior has only these
    for exactly in (False, True):
        if len(fitting) > 1:
            named_alike = [
                name
                for name in fitting
                if any(names_state(each.prior, models[name], exactly=exactly) for each in found[name])
            ]
            fitting = named_alike or fitting
    if len(fitting) > 1:
        raise BadInput(
            f"estimator {label}: models {' and '.join(fitting)} fit this log; choose with "
            f"{' or '.join(f'--model {name}' for name in fitting)}"
        )
    if not fitting:
        which = f"estimator {label}: model {named}" if named else f"estimator {label}"
        own = "" if named else f"; {OWN_MODEL}"
        raise BadInput(
            f"{which} does not fit this log: {nearest(models, topics)}; "
            f"the log has {', '.join(topics) or 'no topics'}{own}"
        )
    (name,) = fitting
    lacking = _made_for(f"estimator {label}", method, values).lacks(models[name])
    if lacking:
        raise BadInput(f"estimator {label}: model {name} lacks {lacking}, which this method needs")
    parameters = build(combined(models[name], method), given, f"estimator {label}, model {name}")
    return bind_model(label, topics, parameters, model=models[name], method=method)


def bind_model(
    label: str,
    topics: Mapping[str, Topic],
    parameters: CombinedParameters,
    *,
    model: Model,
    method: Method,
) -> list[Bound]:
    """Return a bound estimator for every object in the log that this model describes."""
    numeric = {*number_fields(model.parameters)} - {*method.parameters.model_fields}
    method = _made_for(f"estimator {label}", method, parameters)
    bound: list[Bound] = []
    motion = _motion_of(label, model, parameters.mode)
    modes = tuple((model.modes or {}).values()) if method.takes_all_modes else ()
    check_augmentable(f"estimator {label}", model)
    renamed, more = first_and_more(parameters.topics or {})
    _check_topics(label, model, topics, renamed, more)
    things = [with_more(label, model, each, topics, more) for each in topics_of(model, topics, renamed)]
    tables, kind, given = parameters.of_topics or {}, model, parameters
    check_tables(label, model, things, tables)
    bound_models: dict[
        tuple[Model, tuple[Sensor, ...]], BoundModel
    ] = {}  # shared by objects with the same sensors
    for found in things:
        found = in_its_plane(label, kind, found, topics)
        model, found, parameters = with_own_parameters(kind, found, tables, given)
        added = estimated(label, model, parameters)
        lacking = method.lacks(augmented(model, added.parameters, added.errors))
        if added.names and lacking:
            raise BadInput(
                f"estimator {label}: with estimate = {', '.join(parameters.estimate)} the model lacks "
                f"{lacking}, which this method needs"
            )
        own = BoundModel(model, motion, tuple(sensor for sensor, _ in found.sensors), modes)
        assumed = assumed_of(label, own, found, parameters)
        numbers = settings_of(label, own, found, parameters, assumed)
        if (model, own.sensors) not in bound_models:
            try:
                bound_models[model, own.sensors] = bound_model_of(*augmented_model(own, added))
            except BadInput as error:
                raise BadInput(f"estimator {label}: {error}") from error
        bound_model = bound_models[model, own.sensors]
        offers = offers_of(model, found, topics)
        described = _Described(label, topics, found, own, bound_model, method, added, offers)
        made = _bound_with(described, parameters, assumed, numbers)
        if made.alike is not None and parameters is given:  # no topic has its own parameters
            again = partial(_again, described, parameters, numeric)
            made = replace(made, alike=made.alike._replace(again=again))
        bound.append(made)
    return bound


class _Described(NamedTuple):
    """An object in a log, and everything that binds it to a model, except the parameters.

    Attributes:
        label: the estimator's label.
        topics: topics of the log.
        found: topics of the object.
        own: the model with the sensors of the log.
        bound_model: the same with the components that are added to its state, and traced functions.
        method: the method.
        added: components that are added to the state.
        offers: see `offers_of`.
    """

    label: str
    topics: Mapping[str, Topic]
    found: Found
    own: BoundModel
    bound_model: BoundModel
    method: Method
    added: Added
    offers: Mapping[str, str]


def _bound_with(
    described: _Described, parameters: CombinedParameters, assumed: Mapping[str, float], numbers: Floats
) -> Recursive:
    """Bind parameters to an object; see `assumed_of` and `settings_of` for the last two arguments."""
    label, topics, found, own, bound_model, method, added, offers = described
    name = label + found.prefix
    samplers = samplers_of(bound_model, method, parameters)
    settings = with_gauss_markov(numbers, added)
    made_of = (name, found, bound_model, method, parameters, settings, samplers)
    filtering = (method.filtering or Filter)(*made_of)
    control = [found.control.name] if found.control else []
    read = (*found.fallbacks, *found.sensors)
    streams = (*control, *(topic.name for _, topic in read))
    initialization = Initializer(name, found, own, numbers, assumed).initialization
    static = filtering.static(topics)
    priors = {found.prior.name: own.model.state}
    begun = begin(label, found.prior.name, own, added, numbers)
    start, run = begun(filtering.start), filtering.run
    finish = filtering.finish if filtering.has_end else None
    is_random = method.is_random or any(each.redrawn for each in samplers)
    made = Recursive(
        name,
        streams,
        static,
        start,
        run,
        priors,
        finish=finish,
        parameters=parameters,
        initialization=initialization,
        assumed=assumed,
        is_random=is_random,
        offers=offers,
        reading=partial(reading_of, own, found, numbers),
        truth=found.truth,
        is_bound=filtering.is_bound,
    )
    reprocessing = partial(_reprocessing, made, filtering, begun)
    alike = None
    if type(filtering) is Filter and not (is_random or added.names):
        alike = Alike(filtering.beside_settings, settings, partial(_together, made, filtering))
    return replace(made, out_of_sequence=reprocessing, alike=alike)


def _again(
    described: _Described, parameters: CombinedParameters, names: set[str], values: Mapping[str, float]
) -> Recursive | None:
    """Bind the same object with other values of numbers; None if other settings than `names` differ."""
    if not values.keys() <= names:
        return None
    given = {name: getattr(parameters, name) for name in parameters.model_fields_set}
    own, found = described.own, described.found
    changed = build(type(parameters), {**given, **values}, f"estimator {described.label}")
    assumed = assumed_of(described.label, own, found, changed)
    numbers = settings_of(described.label, own, found, changed, assumed)
    return _bound_with(described, changed, assumed, numbers)


def _check_role(label: str, role: str, roles: Collection[str]) -> None:
    if role not in roles:
        raise BadInput(
            f"estimator {label}: topics.{role}: no model has a topic of this name; "
            f"{choices(role, roles)}"
        )


def _check_topics(
    label: str,
    model: Model,
    topics: Mapping[str, Topic],
    renamed: Mapping[str, str],
    more: Mapping[str, Sequence[str]],
) -> None:
    """Raise BadInput if a renamed topic has an unknown role or is not in the log."""
    named = [*renamed.items(), *((role, name) for role, names in more.items() for name in names)]
    for role, name in named:
        refuse_named_truths(label, {role: name}, topics, {model.truth})
        _check_role(label, role, roles_of(model))
        if name and not any(topic.endswith(f"/{name.removeprefix('/')}") for topic in topics):
            raise BadInput(
                f"estimator {label}: topics.{role} = {name}: the log has no such topic; "
                f"{choices(name, topics)}"
            )


def _reprocessing(
    bound: Recursive, filtering: "Filter", begun: Callable[[Start], Start], window_ns: int
) -> Recursive:
    """Make the estimator that reprocesses out-of-sequence messages; raise BadInput if it cannot."""
    reason = filtering.why_in_sequence
    if reason:
        raise BadInput(
            f"estimator {bound.name}: --late rewind: {reason}; give --late drop or --late wait:SECONDS"
        )
    back = OutOfSequenceFilter(filtering, window_ns)
    return replace(bound, start=begun(back.start), run=back.run, finish=back.finish)


def _together(bound: Recursive, filtering: Filter, settings: Floats) -> Recursive:
    """Make an estimator that uses separate settings (runs, 1 + sensors, fields) for each run."""
    each = replace(filtering, each_run=settings)
    return replace(bound, start=each.start, run=each.run, finish=each.finish)


def _made_for(where: str, method: Method, parameters: CombinedParameters) -> Method:
    """Return the variant of a method that the parameters select.

    Raises BadInput, with a message that begins with `where`, if there is no such variant.
    """
    try:
        return method.made_for(parameters) if method.made_for else method
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from error


def _motion_of(label: str, model: Model, mode: str | None) -> Motion:
    """Return the motion of the named mode, or the model's own motion if no mode is named."""
    if mode is None:
        return model.motion
    if not model.modes:
        raise BadInput(f"estimator {label}: mode = {mode}: the model has one motion; leave out `mode`")
    if mode not in model.modes:
        raise BadInput(
            f"estimator {label}: the model has no mode '{mode}'; {choices(mode, model.modes)}"
        )
    return model.modes[mode]
