"""The environments of the paper, registered with gymnasium on import.

| short name | gymnasium id             | dynamics            |
|------------|--------------------------|---------------------|
| gridworld  | `bayespbrl/Gridworld-v0` | `GridworldDynamics` |
"""

import gymnasium

from bayespbrl.envs import gridworld
from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.envs.gridworld import GridworldDynamics

SHORT_NAMES = {
    "gridworld": "bayespbrl/Gridworld-v0",
}

_ENTRY_POINTS = {
    "bayespbrl/Gridworld-v0": ("bayespbrl.envs.gridworld:Gridworld", gridworld.DYNAMICS.max_episode_steps),
}


def register() -> None:
    """Register the environments with gymnasium; harmless when they are already there."""
    for name, (entry_point, steps) in _ENTRY_POINTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=entry_point, max_episode_steps=steps)


register()

__all__ = ["SHORT_NAMES", "FunctionalEnv", "GridworldDynamics", "register"]
