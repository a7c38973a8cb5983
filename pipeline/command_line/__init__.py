"""The command `fuselog`. Commands import what they need when they run: `--help` answers at once."""

from pipeline.command_line.group import fuselog as fuselog
from pipeline.command_line.process import main as main
