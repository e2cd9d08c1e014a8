"""The command line: `bayespbrl run`, `resume`, `report`, `trials`."""

from bayespbrl.cli.commands import main

__all__ = ["main"]
