"""The command line: `bayespbrl run`, `resume`, `ask`, `report`, `trials`, `study`, `results`.

commands  the commands and their options
display   progress, tables and pictures in a terminal; studies: of a declared study
opening   the page of a command, and the browser that shows it
compiled  where compiled functions are kept between processes
"""

from bayespbrl.cli.commands import main

__all__ = ["main"]
