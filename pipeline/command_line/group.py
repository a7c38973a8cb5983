"""The command group `fuselog`, whose commands are listed in sections by purpose."""

import click

from fuselog.pipeline.command_line import experiments, judging, lists, logs, recording, replaying
from fuselog.pipeline.command_line.help import with_examples

SECTIONS = {
    "Start here": (
        recording.record,
        recording.import_,
        logs.info,
        replaying.replay,
        logs.view,
        judging.diagnose,
        replaying.tune,
        judging.compare,
        experiments.run,
        experiments.report,
    ),
    "Check sensors and logs": (logs.catalog, logs.lint, logs.noise, replaying.calibrate, logs.ellipsoid),
    "Judge estimators": (
        judging.evaluate,
        replaying.explore,
        judging.stress,
        judging.observability,
        experiments.sweep,
        replaying.check,
    ),
    "Change and convert logs": (logs.cut, logs.merge, logs.relabel, logs.constrain, logs.export),
    "Deploy filters": (replaying.deploy, lists.header),
    "List what there is": (
        lists.scenarios,
        lists.models,
        lists.estimators,
        lists.metrics,
        lists.experiments,
        lists.cache,
    ),
}


class _Sections(click.Group):
    """A group that lists its commands in sections."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write one line per command, with aligned columns."""
        width = max(map(len, self.commands))
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(f"{each.name:{width}}", each.get_short_help_str(1000)) for each in commands]
                )


@click.group(
    cls=_Sections,
    context_settings={"help_option_names": ["-h", "--help"]},
    help=with_examples(
        "Record, replay, evaluate and visualise estimators for sensor fusion.\n\n"
        "A log can be a file, or a URL that fsspec can open, such as https:// or s3://.",
        "fuselog record landmarks --seed 7 -o run.mcap",
        "fuselog replay run.mcap -e ekf -e ukf -o est.mcap",
        "fuselog view est.mcap",
    ),
)
@click.version_option(package_name="fuselog")
def fuselog() -> None:
    """Start the timer that reports progress once a minute; all commands are subcommands of this one."""
    from fuselog.pipeline.output.terminal import once_a_minute

    once_a_minute.begin()


for section in SECTIONS.values():
    for each in section:
        fuselog.add_command(each)
