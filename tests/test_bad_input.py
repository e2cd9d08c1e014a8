"""What of the user's goes wrong in the middle of a run is named, and the run on disk goes on once it is mended."""

import numpy as np
import pytest
from gymnasium.spaces import Discrete, MultiDiscrete, Sequence, Tuple
from toys import Slope, fingerprint

import bayespbrl
from bayespbrl import ReturnExpert
from bayespbrl.policies import LinearGaussianPolicy
from bayespbrl.runs import run as runs

STEPS = 5
QUICK = {
    "preset": "paper",
    "utility": "linear-program",
    "iterations": 3,
    "max_steps": STEPS,
    "evaluation_episodes": 4,
    "centres": 20,
}
# 10 trajectories of an iteration, then 4 of its evaluation, and so on
AN_ITERATION = (10 + 4) * STEPS


def features(states):
    return np.column_stack([states, states**2])


class Faulty:
    """A function of the user's that does something else from its n-th call on, until it is mended."""

    def __init__(self, right, wrong, calls):
        self.right, self.wrong, self.calls = right, wrong, calls

    def __call__(self, *arguments):
        self.calls -= 1
        return self.right(*arguments) if self.calls >= 0 else self.wrong(*arguments)


def own_parts():
    return {"features": features, "policy": LinearGaussianPolicy.initial(Slope.observation_space, Slope.action_space)}


@pytest.fixture(scope="module")
def straight():
    """The run in which nothing went wrong."""
    return fingerprint(bayespbrl.Learner(Slope(), **own_parts(), **QUICK).run(ReturnExpert()))


@pytest.fixture(scope="module")
def calls_an_iteration():
    """How often the features are called in the first iteration."""
    counted = Faulty(features, None, 10**6)
    parts = own_parts() | {"features": counted}
    bayespbrl.Learner(Slope(), **parts, **(QUICK | {"iterations": 1})).run(ReturnExpert())
    return 10**6 - counted.calls


def stopped(directory, message, *, env=None, expert=None, **parts):
    """A run on disk that stops with an error; nothing in it is half-written."""
    learner = runs.start(env or Slope(), directory, **(own_parts() | parts), **QUICK)
    with pytest.raises(ValueError, match=message):
        learner.run(expert or ReturnExpert())
    assert not list(directory.rglob("*.part"))
    return learner


def fails_again(learner, message, expert=None):
    """Tried again, the learner fails again, and keeps nothing of it."""
    before = contents(learner.log.path)
    with pytest.raises(ValueError, match=message):
        learner.run(expert or ReturnExpert())
    assert contents(learner.log.path) == before


def contents(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def goes_on(directory, completed, straight):
    """Mended, the run goes on from its last complete iteration and ends as if nothing had gone wrong."""
    learner = runs.resume(directory, env=Slope(), **own_parts())
    assert learner.state.iteration == completed
    assert fingerprint(learner.run(ReturnExpert())) == straight
    assert fingerprint(bayespbrl.load(directory, env=Slope(), **own_parts()).learner) == straight


FINITE = "environment Slope: expected finite observations and rewards, got NaN or infinity at step 3"
FAULTS = {
    "observation": FINITE,
    "reward": FINITE,
    "no reward": "environment Slope failed at step 3: ValueError: expected a number as the reward, got None",
    "rewards": r"environment Slope failed at step 3: ValueError: expected a number as the reward, got array\(\[1",
    "raises": "environment Slope failed at step 3: RuntimeError: the motor is on fire",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "completed"),
    [(3, 0), (10 * STEPS + 3, 0), (AN_ITERATION + 3, 1), (AN_ITERATION + 10 * STEPS + 3, 1)],
    ids=["first trajectory", "first evaluation", "second iteration", "second evaluation"],
)
def test_an_environment_that_fails_in_the_middle_of_a_trajectory(tmp_path, straight, at, completed):
    env = Slope("observation", at)
    learner = stopped(tmp_path / "run", FAULTS["observation"], env=env)
    for fault, message in FAULTS.items():
        env.fault, env.at = fault, env.life + 3  # what failed is tried again from its beginning
        fails_again(learner, message)
    goes_on(tmp_path / "run", completed, straight)


WRONG = [
    (lambda states: states[:, 0], r"features Faulty: expected shape \(\d+, D\), got \(\d+,\)"),
    (lambda states: features(states)[1:], r"features Faulty: expected shape \(\d+, D\), got \(\d+, 4\)"),
    (lambda states: np.zeros((len(states), 0)), r"features Faulty: expected shape \(\d+, D\), got \(\d+, 0\)"),
    (lambda states: features(states).astype(str), "features Faulty: expected real numbers, got <U"),
    (lambda states: features(states) * np.inf, "features Faulty: expected finite numbers, got NaN or infinity"),
    (lambda states: None, r"features Faulty: expected shape \(\d+, D\), got \(\)"),
]


def test_features_of_the_wrong_shape_or_kind(tmp_path, straight, calls_an_iteration):
    faulty = Faulty(features, WRONG[0][0], calls_an_iteration + 1)
    learner = stopped(tmp_path / "run", WRONG[0][1], features=faulty)
    for wrong, message in WRONG:
        faulty.wrong = wrong
        fails_again(learner, message)
    goes_on(tmp_path / "run", 1, straight)


def test_features_that_are_suddenly_more(tmp_path, straight, calls_an_iteration):
    more = Faulty(features, lambda states: np.hstack([states, features(states)]), calls_an_iteration)
    stopped(tmp_path / "run", "features: expected 4 for each state, as before, got 6", features=more)
    goes_on(tmp_path / "run", 1, straight)


def test_an_expert_that_returns_nonsense(tmp_path, straight):
    message = "answer: expected one of 'first', 'second', 'tie', .*, got "
    learner = stopped(tmp_path / "run", message, expert=Faulty(ReturnExpert(), lambda first, second: "perhaps", 3))
    for answer in ("perhaps", None, 1, ["first"], np.nan, True):
        fails_again(learner, message, expert=Faulty(ReturnExpert(), lambda first, second, a=answer: a, 0))
    goes_on(tmp_path / "run", 2, straight)


@pytest.mark.parametrize(
    ("kind", "expected", "space"),
    [
        ("observation", "an observation space of fixed size", Sequence(Discrete(2))),
        ("action", "a Discrete or real Box action space", MultiDiscrete([2, 3])),
        ("action", "a Discrete or real Box action space", Tuple([Discrete(2)])),
    ],
)
def test_an_environment_with_an_unsupported_space_leaves_nothing_behind(tmp_path, kind, expected, space):
    env = Slope()
    setattr(env, f"{kind}_space", space)
    with pytest.raises(ValueError, match=rf"environment Slope: expected {expected}, got "):
        runs.start(env, tmp_path / "run", **QUICK)
    assert list(tmp_path.iterdir()) == []
