"""Help texts of commands, with example commands and an example value of every option."""

import inspect
from collections.abc import Callable

import click

from fuselog.pipeline.command_line.options import SetOption

# An example value of every option that takes one, by option name, or by command and option name.
EXAMPLES = {
    "--again": "run.mcap",
    "--against": "ekf.golden.xz",
    "--at": "worst:ekf",
    "--bound": "sigma_range_m=0.01:1",
    "--case": "robot2",
    "--component": "x_m=east_m",
    "--connect": "rerun+http://localhost:9876/proxy",
    "--data": "mrclam6.tar.xz",
    "--decimate": "/robot1/odometry=5Hz",
    "--delta": "5",
    "--end": "20",
    "--estimator": "ekf",
    "--every": "0.1",
    "--field": "/imu.magnetic_field_ut",
    "--fixed": "lever_y_m",
    "--focus": "robot3",
    "--folds": "5",
    "--free": "sigma_range_m",
    "--gap-limit": "0.5",
    "--grid": "5",
    "--group": "folder",
    "--junit": "check.xml",
    "--keep": "'*/pose mean'",
    "--late": "rewind:0.5",
    "--length": "48.5",
    "--log": "run.mcap",
    "--logs": "30",
    "--mapping": "mapping.toml",
    "--margin": "0.05",
    "--max-difference": "0.02",
    "--metric": "consistency",
    "--model": "robot",
    "--offset": "left.mcap=-0.5",
    "--origin": "48.137,11.575,520",
    "--out": "out/mine",
    "--over": "ekf.sigma_range_m=0.05:0.8:log9",
    "--port": "51234",
    "--run": "3",
    "--runs": "20",
    "--samples": "64",
    "--save": "run.rrd",
    "--scale": "x_m=0.5",
    "--scheduler": "local:8",
    "--screenshot": "view.png",
    "--seed": "7",
    "--set": "sigma_range_m=0.3",
    "--settings": "out/tune/settings.toml",
    "--sheet": "turn_rate_radps='0.05 deg/s/sqrt(Hz)'",
    "--start": "10",
    "--start-from": "truth",
    "--start-sigma": "heading_rad=0.1",
    "--tau": "10",
    "--time-offset": "estimate",
    "--tolerance": "'/estimates/ekf/* mean=1e-9'",
    "--topic": "/robot1/odometry",
    "--topics": "'/robot1/*'",
    "--truth": "truth.txt",
    "--unit": "/imu",
    "--validate": "test",
    "--where": "'duration_s > 60'",
    "--window": "10",
    "--workers": "4",
    "catalog --out": "logs.parquet",
    "record --out": "run.mcap",
    "import --out": "run.mcap",
    "replay --out": "est.mcap",
    "cut --out": "part.mcap",
    "merge --out": "both.mcap",
    "relabel --out": "left.mcap",
    "constrain --out": "constrained.mcap",
    "deploy --out": "robot_ekf",
    "report --out": "report.html",
    "export --out": "odometry.csv",
    "import --set": "truth=/mocap",
    "record --set": "duration_s=120",
    "run --set": "ekf.sigma_range_m=0.3",
    "sweep --set": "duration_s=30",
    "constrain --set": "rolling_hz=10",
    "lint --set": "/imu.specific_force_scale=9.807",
    "calibrate --set": "lever_x_m=1.1",
    "calibrate --bound": "lever_x_m=-2:2",
    "noise --topic": "/imu",
    "view --runs": "worst:50",
    "relabel --topic": "/robot1/=/left/",
}


class _Command(click.Command):
    """A command that completes its settings before it runs."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the options, then complete the settings."""
        left = super().parse_args(ctx, args)
        for each in self.params:
            if isinstance(each, SetOption) and not ctx.resilient_parsing:
                each.settle(ctx)
        return left


def with_examples(text: str, *examples: str) -> str:
    """Append example commands to a help text, in a block that click does not wrap."""
    return "\n".join([inspect.cleandoc(text), "", "\b", *(f"    {each}" for each in examples)])


def example_of(command: str, option: click.Option) -> str | None:
    """Return an example of an option as typed, or None for flags and options that list choices."""
    if option.is_flag or isinstance(option.type, click.Choice):
        return None
    name = option.opts[-1]
    return f"{option.opts[0]} {EXAMPLES.get(f'{command} {name}') or EXAMPLES[name]}"


def command(
    short_help: str, *examples: str, name: str | None = None
) -> Callable[[Callable[..., None]], click.Command]:
    """Make a command. The help is the docstring or the short help, then examples."""

    def added(function: Callable[..., None]) -> click.Command:
        text = with_examples(function.__doc__ or short_help, *examples)
        made = click.command(name, _Command, short_help=short_help, help=text)(function)
        for option in made.params:
            if isinstance(option, click.Option) and (example := example_of(str(made.name), option)):
                option.help = f"{option.help} Example: {example}"
        return made

    return added
