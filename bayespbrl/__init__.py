"""Probabilistic programming for preference-based reinforcement learning."""

from bayespbrl.experts import NoisyExpert, ReturnExpert, TerminalExpert
from bayespbrl.learner import Learner
from bayespbrl.preferences import Answer, Preferences, Query
from bayespbrl.runs.answers_file import read_answers, read_questions
from bayespbrl.runs.run import Run, load, resume, start
from bayespbrl.runs.simulated import expert_of
from bayespbrl.runs.utility_reward import UtilityReward
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import infer_utility

__all__ = [
    "Answer",
    "Learner",
    "NoisyExpert",
    "Preferences",
    "Query",
    "ReturnExpert",
    "Run",
    "Settings",
    "TerminalExpert",
    "Trajectory",
    "UtilityReward",
    "expert_of",
    "infer_utility",
    "load",
    "read_answers",
    "read_questions",
    "resume",
    "start",
]
