"""The options of a run, composed of those of its parts, and the presets."""

from bayespbrl.settings.settings import MOST_TRAJECTORIES, MOST_UNASKED, OPTIONS, PARTS, Settings, settings_for
from bayespbrl.settings.tasks import Task

__all__ = ["MOST_TRAJECTORIES", "MOST_UNASKED", "OPTIONS", "PARTS", "Settings", "Task", "settings_for"]
