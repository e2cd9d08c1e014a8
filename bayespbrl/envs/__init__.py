"""The environments of the paper, registered with gymnasium on import.

gridworld, bicycle, swing_up, acrobot  the four domains: their dynamics as pure functions; angles helps them
functional                             pure functions as a gymnasium environment
names                                  what a name says: short names, ids, packages, arguments
opening                                any environment, made ready for the learner; spaces: rows of numbers
stepping                               episodes of environments without pure functions
pictures, film_strip                   a trajectory as a picture
"""

from importlib import import_module

import gymnasium

from bayespbrl.envs.acrobot import AcrobotDynamics
from bayespbrl.envs.bicycle import BicycleDynamics
from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.envs.gridworld import GridworldDynamics
from bayespbrl.envs.swing_up import SwingUpDynamics

# A short name says the module, its id the class in it: "swing-up" is `SwingUp` of `envs/swing_up.py`.
SHORT_NAMES = {
    "gridworld": "bayespbrl/Gridworld-v0",
    "bicycle": "bayespbrl/Bicycle-v0",
    "swing-up": "bayespbrl/SwingUp-v0",
    "acrobot": "bayespbrl/Acrobot-v0",
}


def register() -> None:
    """Register the environments with gymnasium; harmless when they are already there."""
    for short, identity in SHORT_NAMES.items():
        if identity not in gymnasium.registry:
            module = import_module(f"{__name__}.{short.replace('-', '_')}")
            entry_point = f"{module.__name__}:{identity.removeprefix('bayespbrl/').removesuffix('-v0')}"
            steps = module.DYNAMICS.max_episode_steps
            gymnasium.register(id=identity, entry_point=entry_point, max_episode_steps=steps)


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
