"""Types of options, and the options that several commands share."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from fuselog.recorders.remote.paths import located
from fuselog.replay.foreign.naming import allow_programs_of_files

if TYPE_CHECKING:
    from fuselog.pipeline.selecting.selection import SelectionOptions


class Output(click.Path):
    """A path that a command writes; the tests find all such options by this type.

    Attributes:
        suffix: suffix of the file; empty for a path that is always a folder.
    """

    def __init__(self, suffix: str = "", **options: Any) -> None:
        super().__init__(path_type=Path, **options)
        self.suffix = suffix


class Input(click.Path):
    """A path that a command reads, or a URL that fsspec knows."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path."""
        path = super().convert(value, param, ctx)
        return located(path if isinstance(path, Path) else os.fsdecode(path))


class OutputFile(Output):
    """A file that a command creates or replaces; devices and folders are rejected."""

    def __init__(self, suffix: str) -> None:
        super().__init__(suffix, dir_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path; reject it if it exists and is not a regular file."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if path.exists() and not path.is_file():
            self.fail(f"{path} is not a regular file", param, ctx)
        return path


class Seconds(click.ParamType):
    """A time in seconds, within the range of a log's stamps."""

    name = "seconds"

    def __init__(self, minimum: float = -1e9) -> None:
        self._minimum = minimum

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the text to seconds."""
        seconds = float(click.FLOAT.convert(value, param, ctx))
        if not self._minimum <= seconds <= 1e9:
            self.fail(
                f"{seconds:g} is not between {self._minimum:.0f} and 1000000000 seconds", param, ctx
            )
        return seconds


class Instant(Seconds):
    """A time in seconds, or `worst` for the moment of the largest NEES or error."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the text to seconds, or return it unchanged if it begins with `worst`."""
        is_worst = isinstance(value, str) and value.partition(":")[0] == "worst"
        return value if is_worst else super().convert(value, param, ctx)


class TimeOffset(Seconds):
    """A time in seconds, or the word `estimate`."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the text to seconds, or return the word as it is."""
        return value if value == "estimate" else super().convert(value, param, ctx)


class Place(click.ParamType):
    """A position on the Earth: latitude and longitude in deg, and optionally the height in m."""

    name = "place"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse the position into a list of numbers."""
        from fuselog.recorders.log.planes import EXAMPLE, origin_of

        found = origin_of(str(value).split(","))
        if found is None:
            self.fail(f"{value}: expected {EXAMPLE}", param, ctx)
        return list(found)


class Name(click.types.StringParamType):
    """A name from one of fuselog's lists, completed in the shell."""

    def __init__(self, kind: str, *, or_file: bool = False) -> None:
        self._kind, self._or_file = kind, or_file

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        """Return the names that begin with the typed text, each with a line of description."""
        from fuselog.pipeline.api.lists import listed

        names = listed(self._kind).items()
        found = [CompletionItem(name, help=what) for name, what in names if name.startswith(incomplete)]
        # must precede the names: bash forgets completions that come before a file
        return [CompletionItem(incomplete, type="file"), *found] if self._or_file else found


PLACE = Place()
ESTIMATOR, MODEL, METRIC = map(Name, ("estimators", "models", "metrics"))
SCENARIO, EXPERIMENT = (Name(kind, or_file=True) for kind in ("scenarios", "experiments"))
RESULT = Output(file_okay=False)
LOG_OR_FOLDER, TIMELINE_OR_FOLDER = Output(".mcap"), Output(".rrd")
LOG, TIMELINE, PICTURE, PAGE = map(OutputFile, (".mcap", ".rrd", ".png", ".html"))
GOLDEN, JUNIT, CATALOG = map(OutputFile, (".xz", ".xml", ".parquet"))
ANY_PATH = Input()
COUNT = click.IntRange(min=0)
FORMAT = click.Choice(["tum", "kitti", "euroc"])


def settings_option(function: Callable[..., None]) -> Callable[..., None]:
    """Add the options --settings and --allow-programs; the latter permits programs in such files."""

    def allow(context: click.Context, parameter: click.Parameter, value: bool) -> None:  # noqa: ARG001
        allow_programs_of_files(value)

    file = click.option(
        "--settings",
        "settings_file",
        type=ANY_PATH,
        metavar="FILE",
        help="Read parameters of estimators from this TOML file, as written by fuselog tune; --set "
        "overrides them.",
    )
    programs = click.option(
        "--allow-programs",
        is_flag=True,
        expose_value=False,
        callback=allow,
        help="Also run programs (lib:, exec:) that are named by a golden, a result or a settings file.",
    )
    return file(programs(function))


errors_option = click.option(
    "--errors", is_flag=True, help="Keep every error of every estimate, as Parquet files."
)
workers_option = click.option(
    "--workers", type=click.IntRange(min=1), help="Share the work among N processes, each on one core."
)
scheduler_option = click.option(
    "--scheduler",
    metavar="ADDRESS|local:N",
    help="Share the work among the workers of a Dask scheduler, or among N local workers.",
)
where_option = click.option(
    "--where",
    metavar="CONDITION",
    help="Use only logs whose columns in the catalog meet this condition, such as "
    "'fix_rate_hz > 4 and duration_s > 60'.",
)
group_option = click.option(
    "--group",
    metavar="COLUMN",
    help="The catalog column that names the units over which intervals are computed, such as the robot "
    "[default: the log].",
)


def selection_options(function: Callable[..., None]) -> Callable[..., None]:
    """Add the options for commands that process a selection of logs one by one."""
    return where_option(group_option(workers_option(scheduler_option(function))))


def selecting(
    paths: Sequence[Path], options: dict[str, Any], *, always: bool = False
) -> "SelectionOptions | None":
    """Move the options of a selection out of the options of a command.

    Returns None if there is no selection: the paths are logs and folders, no option is given, and
    `always` is not set.
    """
    from fuselog.pipeline.selecting.catalog import is_catalog
    from fuselog.pipeline.selecting.selection import SelectionOptions

    names = SelectionOptions._fields[1:]
    found = SelectionOptions(paths, *(options.pop(name, None) for name in names))
    is_given = any(value is not None for value in found[1:]) or any(map(is_catalog, paths))
    return found if always or is_given else None


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
model_option = click.option("--model", type=MODEL, help="The model to use, if several fit the logs.")
parameters_option = click.option(
    "--parameters", "tells_parameters", is_flag=True, help="Print all parameters, including defaults."
)
parameters_alone_option = click.option(
    "--parameters",
    "tells_parameters",
    is_flag=True,
    help="Print all parameters of the estimators, including defaults, and run nothing.",
)
recover_option = click.option(
    "--recover", is_flag=True, help="Read the intact part of a log that was cut off or damaged."
)
out_log_option = click.option("-o", "--out", type=LOG, required=True, help="The log to write.")
gap_option = click.option(
    "--gap-limit",
    "gap_limit_s",
    type=Seconds(0),
    default=0.2,
    show_default=True,
    help="The longest gap over which truth is interpolated.",
)
arrival_option = click.option(
    "--arrival-order",
    is_flag=True,
    help="Process messages in the order in which they arrived (log time).",
)
late_option = click.option(
    "--late",
    metavar="drop|wait:SECONDS|rewind:SECONDS",
    help="With --arrival-order: process measurements in the order of their stamps. Drop out-of-sequence "
    "measurements, wait SECONDS for them, or rewind by up to SECONDS and reprocess.",
)
origin_option = click.option(
    "--origin",
    type=PLACE,
    metavar="LATITUDE,LONGITUDE[,HEIGHT]",
    help="The origin, in deg and m, of the local tangent plane of all topics that do not state one.",
)
foxglove_option = click.option(
    "--foxglove",
    is_flag=True,
    help="Also write messages for the Foxglove viewer.",
)


def estimator_option(
    name: str, text: str, *, many: bool = False, required: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add `-e`, which names an estimator, as the argument `name`; `many` makes it repeatable."""
    return click.option(
        "-e", "--estimator", name, type=ESTIMATOR, multiple=many, required=required, help=text
    )


_REPLAYING = ("estimators", "experiment")


class SetOption(click.Option):
    """The option --set, to which `settle` adds the values of other options after parsing.

    Attributes:
        takes: kind of object to which the settings belong, a key of
            `fuselog.pipeline.api.asking.TAKERS`.
        replays: whether the command replays logs and therefore also has --origin, which becomes a
            setting of all topics.
    """

    def __init__(self, names: Sequence[str], *, takes: str, **options: Any) -> None:
        super().__init__(names, **options)
        self.takes, self.replays = takes, takes in _REPLAYING

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return the parameters whose names begin with the typed text."""
        from fuselog.pipeline.api.asking import settings_that_begin

        # click does not assign arguments while the option lacks its value
        [argument, *_] = [each for each in ctx.command.params if isinstance(each, click.Argument)]
        left = tuple(ctx.args) if argument.nargs < 0 else next(iter(ctx.args), None)
        options = ctx.params | ({str(argument.name): left} if left else {})
        found = settings_that_begin(incomplete, self.takes, options)
        return [CompletionItem(name, help=meaning) for name, meaning in found.items()]

    def settle(self, context: click.Context) -> None:
        """Add the origin to the settings; if a value is `?`, print what the setting means and exit."""
        options = context.params
        if self.replays and (place := options.pop("origin")):
            options["settings"] += (f"/*.plane={','.join(map(repr, place))}",)
        if any(text.endswith("=?") for text in options["settings"]):
            from fuselog.pipeline.api.asking import show_meanings

            show_meanings(options["settings"], self.takes, options)
            context.exit()


def set_option(takes: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add the option --set to a command, and --origin if the command replays logs; see `SetOption`."""

    def added(function: Callable[..., None]) -> Callable[..., None]:
        option = click.option(
            "--set",
            "settings",
            cls=SetOption,
            takes=takes,
            multiple=True,
            metavar="KEY=VALUE",
            help="Set a parameter (repeatable); KEY=? explains it.",
        )
        return origin_option(option(function)) if takes in _REPLAYING else option(function)

    return added


def replay_options(function: Callable[..., None]) -> Callable[..., None]:
    """Add the options that all replay commands share: for reading, judging, printing and settings."""
    return recover_option(gap_option(json_option(settings_option(set_option("estimators")(function)))))
