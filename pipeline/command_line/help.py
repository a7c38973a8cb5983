"""Makes commands, and their help: the docstring, and below it commands to try."""

import inspect
from collections.abc import Callable

import click

from fuselog.pipeline.command_line.options import SetOption


class _Command(click.Command):
    """Settles its settings before it begins."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the options."""
        left = super().parse_args(ctx, args)
        for each in self.params:
            if isinstance(each, SetOption) and not ctx.resilient_parsing:
                each.settle(ctx)
        return left


def with_examples(text: str, *examples: str) -> str:
    """Return a help text that ends with commands to try, which click does not wrap."""
    return "\n".join([inspect.cleandoc(text), "", "\b", *(f"    {each}" for each in examples)])


def command(
    short_help: str, *examples: str, name: str | None = None
) -> Callable[[Callable[..., None]], click.Command]:
    """Make a command, whose help is its docstring, or the short one, and examples of it."""

    def added(function: Callable[..., None]) -> click.Command:
        text = with_examples(function.__doc__ or short_help, *examples)
        return click.command(name, _Command, short_help=short_help, help=text)(function)

    return added
