"""The command line: `bayespbrl run`, `resume`, `ask`, `report`, `trials`."""

from bayespbrl.cli.commands import main

__all__ = ["main"]
