"""The command `fuselog`: its subcommands, their options, and what they do.

Commands import what they need when they run, so that `--help` answers quickly. Begin with `group`.
"""

from fuselog.pipeline.command_line.group import fuselog as fuselog
from fuselog.pipeline.command_line.process import main as main
