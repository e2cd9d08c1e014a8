"""The environments of the paper, registered with gymnasium on import.

| short name | gymnasium id             | dynamics            |
|------------|--------------------------|---------------------|
| gridworld  | `bayespbrl/Gridworld-v0` | `GridworldDynamics` |
| bicycle    | `bayespbrl/Bicycle-v0`   | `BicycleDynamics`   |
| swing-up   | `bayespbrl/SwingUp-v0`   | `SwingUpDynamics`   |
| acrobot    | `bayespbrl/Acrobot-v0`   | `AcrobotDynamics`   |
"""

from typing import Any

import gymnasium

from bayespbrl.envs import acrobot, bicycle, gridworld, swing_up
from bayespbrl.envs.acrobot import AcrobotDynamics
from bayespbrl.envs.bicycle import BicycleDynamics
from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.envs.gridworld import GridworldDynamics
from bayespbrl.envs.swing_up import SwingUpDynamics

SHORT_NAMES = {
    "gridworld": "bayespbrl/Gridworld-v0",
    "bicycle": "bayespbrl/Bicycle-v0",
    "swing-up": "bayespbrl/SwingUp-v0",
    "acrobot": "bayespbrl/Acrobot-v0",
}

_REGISTERED: dict[str, tuple[str, Any]] = {
    "bayespbrl/Gridworld-v0": ("bayespbrl.envs.gridworld:Gridworld", gridworld.DYNAMICS),
    "bayespbrl/Bicycle-v0": ("bayespbrl.envs.bicycle:Bicycle", bicycle.DYNAMICS),
    "bayespbrl/SwingUp-v0": ("bayespbrl.envs.swing_up:SwingUp", swing_up.DYNAMICS),
    "bayespbrl/Acrobot-v0": ("bayespbrl.envs.acrobot:Acrobot", acrobot.DYNAMICS),
}


def register() -> None:
    """Register the environments with gymnasium; harmless when they are already there."""
    for name, (entry_point, dynamics) in _REGISTERED.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=entry_point, max_episode_steps=dynamics.max_episode_steps)


register()

__all__ = [
    "SHORT_NAMES",
    "AcrobotDynamics",
    "BicycleDynamics",
    "FunctionalEnv",
    "GridworldDynamics",
    "SwingUpDynamics",
    "register",
]
