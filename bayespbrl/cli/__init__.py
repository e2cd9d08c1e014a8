"""The command line: `bayespbrl run`, `resume`, `ask`, `report`, `trials`, `study`, `results`."""

from bayespbrl.cli.commands import main

__all__ = ["main"]
