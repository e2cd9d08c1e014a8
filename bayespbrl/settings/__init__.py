"""The options of a run, composed of those of its parts, and the presets."""

from bayespbrl.settings.presets import Task
from bayespbrl.settings.settings import OPTIONS, PARTS, Settings, settings_for

__all__ = ["OPTIONS", "PARTS", "Settings", "Task", "settings_for"]
