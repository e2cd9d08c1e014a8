"""A run that is kept on disk."""

from bayespbrl.runs.run import Run, load, resume, start

__all__ = ["Run", "load", "resume", "start"]
