"""The options of a run, composed of those of its parts, and the presets."""

from bayespbrl.settings.presets import Task
from bayespbrl.settings.settings import MOST_UNASKED, OPTIONS, PARTS, Settings, settings_for

__all__ = ["MOST_UNASKED", "OPTIONS", "PARTS", "Settings", "Task", "settings_for"]
