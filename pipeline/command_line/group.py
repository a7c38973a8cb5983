"""Defines the group `fuselog`: which commands there are, by what they are for."""

import click

from fuselog.pipeline.command_line import experiments, judging, lists, logs, recording, replaying
from fuselog.pipeline.command_line.help import with_examples


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    help=with_examples(
        "Record, replay, judge and look at estimators for sensor fusion.",
        "fuselog record landmarks --seed 7 -o run.mcap",
        "fuselog replay run.mcap -e ekf -e ukf -o est.mcap",
        "fuselog view est.mcap",
    ),
)
@click.version_option(package_name="fuselog")
def fuselog() -> None:
    """Hold all commands; from here on it is told how long one takes."""
    from fuselog.pipeline.output.terminal import once_a_minute

    once_a_minute.begin()


for each in (
    *(recording.record, recording.import_),
    *(replaying.replay, replaying.explore, replaying.tune, replaying.calibrate, replaying.check),
    replaying.deploy,
    *(judging.evaluate, judging.compare, judging.diagnose, judging.stress, judging.observability),
    *(experiments.run, experiments.sweep, experiments.report),
    *(logs.info, logs.lint, logs.noise, logs.ellipsoid, logs.view, logs.export),
    *(logs.cut, logs.merge, logs.constrain, logs.relabel),
    *(
        lists.scenarios,
        lists.models,
        lists.estimators,
        lists.metrics,
        lists.experiments,
        lists.cache,
        lists.header,
    ),
):
    fuselog.add_command(each)
