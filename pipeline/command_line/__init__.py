"""The command `fuselog`: its subcommands, their options, and what they do.

Commands import modules only when they run, which keeps `--help` fast. Begin with `group`.
"""

from fuselog.pipeline.command_line.group import fuselog as fuselog
from fuselog.pipeline.command_line.process import main as main
