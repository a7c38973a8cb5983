"""What `--help` says: of every command what it does, and of every option that no earlier one has."""

from collections.abc import Iterator

import click

from fuselog.pipeline.command_line.group import fuselog


def in_words() -> Iterator[str]:
    """A line per paragraph, example and option; what is on the terminal is broken by its width."""
    said: set[str] = set()
    for name, command in {"": fuselog, **dict(sorted(fuselog.commands.items()))}.items():
        yield f"$ fuselog {name} --help".replace("  ", " ")
        text, _, examples = (command.help or "").partition("\b\n")
        yield from (" ".join(each.split()) for each in text.split("\n\n") if each.strip())
        yield from examples.splitlines()
        with click.Context(command, info_name=name) as context:
            records = [each.get_help_record(context) for each in command.params]  # without --help
        options = [f"  {names}: {told}" for names, told in filter(None, records) if told]
        yield from (each for each in options if each not in said)
        said.update(options)
        yield ""
