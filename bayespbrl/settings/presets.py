"""Presets: the options that differ from those of the parts, with one line of reason for each (docs/tuning.md).

`default` is for any task: what it needs to know of one, it derives from the spaces and the horizon. `paper` is the
paper's protocol, on the paper's tasks, CartPole-v1 and Pendulum-v1 with what their rows say otherwise.
"""

from collections.abc import Mapping
from typing import Any

from bayespbrl import checks
from bayespbrl.envs import SHORT_NAMES
from bayespbrl.experts import SIMULATED
from bayespbrl.queries import WITHOUT_DRAWS
from bayespbrl.settings.tasks import Task
from bayespbrl.utility.inference import WITHOUT_POSTERIOR

NAMES = ("default", "paper")
# The paper's protocol, and the control: a constant bound, one update and one question per iteration.
PAPER: dict[str, dict[str, Any]] = {
    "gridworld": {
        "iterations": 25,  # not compared
        "discount": 0.995,  # the expert judges 300 undiscounted steps
        "trajectory_discount": None,  # that of Q; all was measured with it
        "exploration_hold": 3,  # noise drawn at each step averages out
    },
    "swing-up": {
        "iterations": 40,  # the paper's
        "trajectory_discount": 1.0,  # 0.98 lost more trials
        "kl_bound": 0.35,  # the paper's authors'
        "centres": 300,  # as good as 700 in a quarter of the time
        "bandwidth_factor": 0.5,  # the paper's authors'
        "recent_iterations": 4,  # all states hold the bound back late in a run
        "exploration_hold": 5,  # a quarter of a second
        "initial_action_scale": 0.9,  # the paper's authors'
        "fixed_point_ridge": 1e-5,  # the paper's authors'
        "projection_ridge": 1e-5,  # the paper's authors'
    },
    "bicycle": {
        "iterations": 25,  # the paper's
        "trajectory_discount": None,  # that of Q; all was measured with it
        "kl_bound": 0.3,  # the paper's authors'
        "utility_bandwidth_factor": 12.0,  # nearly a quadratic utility
        "centres": 300,  # as good as the paper's 400
        "bandwidth_factor": 2.0,  # not compared
        "update_states": 4000,  # all states are no better
        "exploration_hold": 3,  # not compared
        "initial_action_scale": 1.5,  # 0.75 and 3 ended lower
        "fixed_point_ridge": 1e-5,  # 1e-8 and 1e-3 ended lower
        "projection_ridge": 1e-5,  # 1e-8 and 1e-3 ended lower
    },
    "acrobot": {
        "iterations": 15,  # the paper's
        "discount": 0.995,  # the goal comes after 100 to 500 steps
        "trajectory_discount": None,  # that of Q; all was measured with it
        "kl_bound": 0.3,  # the paper's authors'
        "centres": 300,  # the paper's
        "bandwidth_factor": 2.0,  # the paper's authors'
        "exploration_hold": 3,  # not compared
        "initial_action_scale": 3.0,  # the paper's authors'
        "fixed_point_ridge": 1e-8,  # the paper's authors'
        "projection_ridge": 1e-6,  # the paper's authors'
    },
    "CartPole-v1": {
        "iterations": 15,  # not compared
        "trajectory_discount": 1.0,  # all was measured with it
        "kl_bound": 0.1,  # not distinguishable from 0.3
        "discount": 0.995,  # 0.98 and 0.99 ended lower
    },
}
# The swing-up with starts anywhere; its ridges were not tried.
PAPER["Pendulum-v1"] = PAPER["swing-up"] | {
    "iterations": 15,  # not compared
    "fixed_point_ridge": 1e-8,  # not compared
    "projection_ridge": 1e-8,  # not compared
}

# The four tasks under the default: what their rows say of features and exploration, and as many checks as their figures
# were measured with; the rest is as for any task.
KEPT = (
    "discount",
    "trajectory_discount",
    "centres",
    "bandwidth_factor",
    "utility_bandwidth_factor",
    "exploration_hold",
    "initial_action_scale",
    "fixed_point_ridge",
    "projection_ridge",
)
# What the default has come to do since those figures were measured, where states are discrete or actions continuous.
LATER = ("standardised_utility", "informative_ties", "effort_utility", "noise_free", "against_kept")
TASKS = {
    task: {name: PAPER[task][name] for name in KEPT if name in PAPER[task]}
    | {"updates_per_iteration": 3, "trajectories_per_iteration": 10, "check_episodes": check_episodes}
    | dict.fromkeys(LATER, False)
    for task, check_episodes in (("gridworld", 40), ("swing-up", 8), ("bicycle", 40), ("acrobot", 40))
}
TASKS["gridworld"] |= {"critic_iterations": 4}  # as its figures were measured too
# An environment object of the user's is known by its gymnasium id.
IDS = {identity: short for short, identity in SHORT_NAMES.items()}
DEFAULT: dict[str, Any] = {
    "iterations": None,  # they follow from the answers
    "answers": 20,  # not compared
    "schedule": "confidence",  # with checks and recent transitions best on the hidden reward
    "query": "information-when-unsure",  # as good as information always on SwingUp
    "unasked_iterations": 4,  # 0 was no better on Pendulum
    "worthwhile": True,  # not compared
    "checked": True,  # without it the last policy of Pendulum was far below its best
    "restart_iterations": 8,  # what the first policy misses, one that begins with the last posterior often finds
    "constant_utility": True,  # CartPole's answers are foreseen better
    "critic_iterations": 4,  # on the hidden reward Pendulum forgets with all transitions
    "recent_iterations": 4,  # not compared
    "update_states": 10_000,  # not compared
    "fixed_point_ridge": 1e-5,  # 1e-8 is no better on the hidden reward
    "projection_ridge": 1e-5,  # 1e-8 is no better on the hidden reward
}
# What random episodes of a task decide.
MEASURED = {"trajectories_per_iteration": Task.more_trajectories, "exploration_hold": Task.longer_hold}
# Where people answer.
PEOPLE: dict[str, Any] = {
    "repeats": 0.1,  # a simulated expert would only repeat itself
    "unasked_iterations": 0,  # a person waits for them
    "evaluation_episodes": 20,  # and for these
    "worthwhile": False,  # the page says what an answer is worth, and leaves it to the person to stop
}


def measured_options(env: str, chosen: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of the options that random episodes decide: neither the user gives them, nor the preset of the task."""
    if chosen.get("preset", "default") != "default":
        return ()
    given = {*TASKS.get(IDS.get(env, env), {}), *chosen}
    return tuple(name for name in MEASURED if name not in given)


def preset_options(env: str, chosen: Mapping[str, Any], task: Task | None = None) -> dict[str, Any]:
    """The options of the preset that `chosen` names, for an environment.

    Args:
      env: short name or gymnasium id.
      chosen: the user's options, some of which leave others no choice.
      task: None: nothing is derived from it.

    Raises:
      ValueError: an unknown preset.
    """
    name = IDS.get(env, env)
    few = chosen.get("trajectories_per_iteration") == 2  # one question, and no room for what is kept
    first = {"first_queries": 1} if few else {}
    if checks.one_of("preset", chosen.get("preset", "default"), NAMES) == "paper":
        return {"hyperparameters": "given", "trajectory_discount": None} | PAPER.get(name, {}) | first
    expert = chosen.get("expert", "return")
    people = not isinstance(expert, str) or expert not in SIMULATED
    options = DEFAULT | ({} if task is None else task.derived(people=people)) | TASKS.get(name, {}) | first
    if task is not None:
        for measured in measured_options(env, chosen):
            options |= MEASURED[measured](task)
    if not chosen.get("checked", True):
        options.pop("noise_free", None)  # such a run keeps the newest policy, with its noise
    if chosen.get("diffusion_utility"):
        options.pop("standardised_utility", None)  # the other kind of features of discrete states
    if people:
        options |= PEOPLE
    shown = chosen.get("noise_free", options.get("noise_free"))
    alone = few or chosen.get("clip_steps") is not None or not chosen.get("checked", True)
    if not shown or alone or chosen.get("utility") in WITHOUT_POSTERIOR:
        options.pop("against_kept", None)
    if chosen.get("utility") in WITHOUT_POSTERIOR or chosen.get("schedule", "confidence") != "confidence":
        options["query"] = WITHOUT_DRAWS[0]
    return options
