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

_MODULES: dict[str, Any] = {"Gridworld": gridworld, "Bicycle": bicycle, "SwingUp": swing_up, "Acrobot": acrobot}


def register() -> None:
    """Register the environments with gymnasium; harmless when they are already there."""
    for name, module in _MODULES.items():
        if (identity := f"bayespbrl/{name}-v0") not in gymnasium.registry:
            steps = module.DYNAMICS.max_episode_steps
            gymnasium.register(id=identity, entry_point=f"{module.__name__}:{name}", max_episode_steps=steps)


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
