"""Step 3: compiled rollouts, the gymnasium interface, and what happens when either goes wrong."""

import pickle
import re
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from unittest import mock

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.functional_jax_env import FunctionalJaxVectorEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from toys import Push

import bayespbrl
from bayespbrl import rollouts
from bayespbrl.envs import functional, opening, spaces
from bayespbrl.envs.gridworld import Gridworld
from bayespbrl.envs.opening import open_environment
from bayespbrl.envs.stepping import of_whole_episodes, random_episodes, step_limit
from bayespbrl.features import checked_features
from bayespbrl.rollouts import returns, rollout
from bayespbrl.settings import Task

KEY = jax.random.key(5)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Table:
    probabilities: np.ndarray

    def sample(self, key, observation):
        return jax.random.categorical(key, jnp.log(self.probabilities[observation]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Constant:
    action: np.ndarray

    def sample(self, key, observation):
        return self.action


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Gaussian:
    mean: np.ndarray
    deviation: np.ndarray

    def sample(self, key, observation):
        return self.mean + self.deviation * jax.random.normal(key, self.mean.shape)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Coin:
    probability: np.ndarray

    def sample(self, key, observation):
        return jax.random.bernoulli(key, self.probability).astype(int)


UNIFORM_TABLE = Table(np.full((25, 5), 0.2))
WIDE = Gaussian(np.zeros(2), np.array([2.0, 0.02]))


def compilations():
    """How many programs the module has compiled so far in this process."""
    return sum(function._cache_size() for function in (rollouts._simulate, rollouts._evaluate, rollouts._act))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Listing:
    """An action of two numbers, as a list."""

    first: float

    def sample(self, key, observation):
        return [self.first + observation[0], -2.0]


@pytest.mark.parametrize("episodes", [1, 2, 3])
def test_an_action_that_is_a_list_is_a_row(episodes):
    class Two(gymnasium.Env):
        observation_space, action_space = Box(-9, 9, (1,), np.float64), Box(-9, 9, (2,), np.float64)

        def reset(self, *, seed=None, options=None):
            return np.zeros(1), {}

        def step(self, action):
            return np.array([0.5]), 0.0, False, False, {}

    for shown in rollout(Two(), Listing(1.0), key=jax.random.key(0), episodes=episodes, max_steps=2):
        np.testing.assert_array_equal(shown.actions, [[1.0, -2.0], [1.5, -2.0]])


class Plain(gymnasium.Env):
    """Counts its steps, adds up the action, and can be told to go wrong at a step."""

    observation_space = Box(-np.inf, np.inf, (2,), dtype=np.float64)
    action_space = Box(-1.0, 1.0, (1,), dtype=np.float32)

    def __init__(self, bad_observation=None, bad_reward=None, fails=None, ends=None):
        self.bad_observation, self.bad_reward, self.fails, self.ends = bad_observation, bad_reward, fails, ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.total = 0, self.np_random.uniform()
        return self._seen(), {}

    def step(self, action):
        assert action.dtype == np.float32
        assert self.action_space.contains(action)
        self.t += 1
        self.total += float(action[0])
        if self.t == self.fails:
            raise RuntimeError("the motor is on fire")
        return self._seen(), np.nan if self.t == self.bad_reward else 1.0, self.t == self.ends, False, {}

    def _seen(self):
        return np.array([np.nan if self.t == self.bad_observation else self.t, self.total])


gymnasium.register("bayespbrl-tests/Plain-v0", entry_point=Plain, max_episode_steps=9)
STEER = Gaussian(np.array([0.1]), np.array([3.0]))


# Pure functions, compiled.


@pytest.fixture(scope="module")
def rides():
    """Sixty episodes of the bicycle, of which some end in a fall."""
    return rollout("bicycle", WIDE, key=KEY, episodes=60)


def test_a_trajectory_is_the_loop_over_the_pure_functions(rides):
    trajectory = rides[1]
    dynamics = opening.open_environment("bicycle").unwrapped.dynamics
    with jax.enable_x64(True):
        start_key, steps_key = jax.random.split(jax.random.split(KEY, 60)[1])
        state, observation = functional.reset(dynamics, start_key)
        np.testing.assert_allclose(trajectory.states[0], observation, rtol=1e-12)
        for t, (action, reward) in enumerate(zip(trajectory.actions, trajectory.rewards, strict=True)):
            action_key, transition_key = jax.random.split(jax.random.fold_in(steps_key, t))
            by_hand = np.clip(WIDE.sample(action_key, observation), [-2, -0.02], [2, 0.02])
            np.testing.assert_allclose(action, by_hand, rtol=1e-12)
            state, observation, earned, _ = functional.step(dynamics, transition_key, state, by_hand)
            np.testing.assert_allclose(trajectory.states[t + 1], observation, rtol=1e-9)
            assert reward == pytest.approx(float(earned))


def test_shapes_and_dtypes_of_discrete_and_continuous_trajectories():
    discrete = rollout("gridworld", UNIFORM_TABLE, key=KEY, episodes=3)
    assert len(discrete) == 3
    assert discrete[0].states.shape == (301,)
    assert discrete[0].actions.shape == discrete[0].rewards.shape == (300,)
    assert discrete[0].states.dtype == discrete[0].actions.dtype == np.int64
    continuous = rollout("swing-up", Gaussian(np.zeros(1), np.ones(1)), key=KEY, episodes=2)[0]
    assert continuous.states.shape == (61, 2)
    assert continuous.actions.shape == (60, 1)
    assert {part.dtype for part in (continuous.states, continuous.actions, continuous.rewards)} == {np.dtype(float)}
    assert not continuous.terminated
    assert jnp.zeros(1).dtype == jnp.float32  # the caller's precision is as it was


def test_a_trajectory_ends_with_its_last_real_state(rides):
    fallen = [trajectory for trajectory in rides if trajectory.terminated]
    assert 5 < len(fallen) < 55
    for trajectory in rides:
        over = np.abs(trajectory.states[:, 2]) > np.pi / 15
        assert not over[:-1].any()
        assert over[-1] == trajectory.terminated
        assert trajectory.terminated or len(trajectory) == 50
        assert (trajectory.rewards[-1] < -100) == trajectory.terminated


def test_stored_actions_are_clipped_to_the_action_space(rides):
    actions = np.concatenate([t.actions for t in rides])
    assert np.abs(actions).max(axis=0).tolist() == [2.0, 0.02]


def changes(trajectories):
    """Steps at which the first action differs from the one before, by trajectory."""
    return [np.flatnonzero(np.diff(t.actions[:, 0]) != 0) + 1 for t in trajectories]


@pytest.mark.slow
def test_chance_is_held_for_so_many_steps_from_a_phase_of_each_episode_and_keeps_its_law():
    policy = Gaussian(np.zeros(1), np.array([5.0]))
    before = compilations()
    held = rollout("swing-up", policy, key=KEY, episodes=200, hold=5)
    for at in changes(held):
        assert np.all(np.diff(at) == 5)
    assert {int(at[0]) for at in changes(held)} == {1, 2, 3, 4, 5}
    values = np.concatenate([t.actions[2::5, 0] for t in held])
    assert abs(values.mean()) < 4 * 5 / np.sqrt(len(values))
    assert values.std() == pytest.approx(5.0, rel=0.06)
    assert len(changes(rollout("swing-up", policy, key=KEY, episodes=1))[0]) == 59
    assert compilations() <= before + 2  # one for each number of episodes, none for another hold


def test_chance_is_held_through_the_interface_too():
    mild = Gaussian(np.zeros(1), np.array([0.3]))
    trajectories = rollout("bayespbrl-tests/Plain-v0", mild, key=KEY, episodes=3, hold=4)
    for trajectory, at in zip(trajectories, changes(trajectories), strict=True):
        assert len(trajectory) == 9
        assert np.all(np.diff(at) == 4)
        assert len(at) == 2


def test_noise_is_not_held_from_one_episode_to_the_next():
    mild = Gaussian(np.zeros(1), np.array([0.3]))
    held = rollout(Plain(), mild, key=KEY, episodes=3, max_steps=9, hold=4)
    for before, after in pairwise(held):
        assert before.actions[-1, 0] != after.actions[0, 0]
    for trajectory, at in zip(held, changes(held), strict=True):
        assert len(trajectory) == 9
        np.testing.assert_array_equal(at, [4, 8])


@pytest.mark.parametrize("hold", [0, -1, True, 1.5, None])
def test_a_hold_that_is_no_number_of_steps_is_refused(hold):
    with pytest.raises(ValueError, match="hold: expected a whole number >= 1"):
        rollout("swing-up", STEER, key=KEY, episodes=1, hold=hold)


def test_returns_are_those_of_the_same_rollout(rides):
    result = returns("bicycle", WIDE, key=KEY, episodes=60)
    np.testing.assert_allclose(result.total, [t.total_reward for t in rides])
    np.testing.assert_array_equal(result.steps, [len(t) for t in rides])
    np.testing.assert_array_equal(result.terminated, [t.terminated for t in rides])


@pytest.mark.slow
def test_uniform_gridworld_return_is_the_exact_expectation():
    total = returns("gridworld", UNIFORM_TABLE, key=KEY, episodes=4000).total
    assert total.mean() == pytest.approx(44.34, abs=4 * total.std() / np.sqrt(4000))


def test_the_key_decides_everything():
    first, again, other = (rollout("swing-up", STEER, key=jax.random.key(k), episodes=2)[0] for k in (1, 1, 2))
    np.testing.assert_array_equal(first.states, again.states)
    assert np.any(first.states != other.states)


@pytest.mark.slow
def test_nothing_is_compiled_again_for_new_policies_keys_environments_or_evaluation_lengths():
    def once(seed):
        policy = Table(np.random.default_rng(seed).dirichlet(np.ones(5), size=25))
        rollout("gridworld", policy, key=jax.random.key(seed), episodes=3)
        returns("gridworld", policy, key=jax.random.key(seed), episodes=3, max_steps=50 + seed)
        rollout("CartPole-v1", Coin(np.array(0.1 * seed)), key=jax.random.key(seed), episodes=3)

    once(1)
    before = compilations()
    assert before >= 3
    for seed in range(2, 6):
        once(seed)
    assert compilations() == before


def test_an_explicit_limit_overrides_the_environments_own():
    assert len(rollout("gridworld", UNIFORM_TABLE, key=KEY, episodes=1, max_steps=7)[0]) == 7
    assert returns("gridworld", UNIFORM_TABLE, key=KEY, episodes=3, max_steps=400).steps.tolist() == 3 * [400]
    pole = Gaussian(np.zeros(1), np.ones(1))
    assert len(rollout("Pendulum-v1", pole, key=KEY, episodes=2, max_steps=210)[1]) == 210  # its own: 200


def test_of_several_limits_the_least_holds():
    for limits in ((3, 9), (9, 3)):
        env = gymnasium.make("bayespbrl/Gridworld-v0").unwrapped
        for limit in limits:
            env = gymnasium.wrappers.TimeLimit(env, limit)
        assert len(rollout(env, UNIFORM_TABLE, key=KEY, episodes=1)[0]) == 3


def test_the_limit_of_an_object_holds_under_a_users_wrapper():
    env = gymnasium.wrappers.RescaleAction(gymnasium.make("bayespbrl/SwingUp-v0"), np.float64(-1), np.float64(1))
    assert step_limit(env, 200) == len(rollout(env, STEER, key=KEY, episodes=1, max_steps=200)[0]) == step_limit(env)


@pytest.mark.parametrize(("steps", "optimum"), [(None, 294.8125), (300, 294.8125), (10, None), (600, None)])
def test_an_optimum_is_of_the_tasks_own_episodes(steps, optimum):
    assert of_whole_episodes(open_environment("gridworld"), "optimal_return", steps) == optimum


@pytest.mark.parametrize("value", [1.5, np.nan])
def test_no_fraction_passes_for_a_number_of_a_discrete_space(value):
    assert spaces.to_plain(Discrete(5, start=1), 2.0) == 1
    with pytest.raises(ValueError, match=r"observation: expected one of Discrete\(5, start=1\), got"):
        spaces.to_plain(Discrete(5, start=1), value)


def test_users_wrappers_are_not_bypassed():
    env = gymnasium.wrappers.TransformReward(gymnasium.make("bayespbrl/Gridworld-v0"), lambda reward: -reward)
    trajectory = rollout(env, UNIFORM_TABLE, key=KEY, episodes=1, max_steps=20)[0]
    assert np.all(trajectory.rewards < 0)


class OneStep(Gridworld):
    """A user's subclass, which rewards and ends otherwise."""

    def step(self, action):
        observation, _, _, truncated, info = super().step(action)
        return observation, 7.0, True, truncated, info


def test_users_subclasses_are_not_bypassed():
    trajectory = rollout(OneStep(), UNIFORM_TABLE, key=KEY, episodes=1, max_steps=20)[0]
    assert (trajectory.rewards.tolist(), trajectory.terminated) == ([7.0], True)


class Meddling(gymnasium.Env):
    """Discrete observations, continuous actions that it changes in place, and infos that grow."""

    observation_space, action_space = Discrete(3, start=2), Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = 0, 0
        return np.int64(2), {}

    def step(self, action):
        action *= 5
        self.steps += 1
        self.place = int(np.clip(self.place + np.sign(action[0]), 0, 2))
        ended = self.steps >= self.np_random.integers(2, 6)
        return np.int64(self.place + 2), float(self.place), ended, False, {"steps": np.arange(self.steps)}


@pytest.fixture
def meddling():
    gymnasium.register("Meddling-v0", entry_point=Meddling, max_episode_steps=8)
    yield "Meddling-v0"
    del gymnasium.registry["Meddling-v0"]


@pytest.mark.parametrize("by_name", [False, True])
def test_an_environment_may_change_its_actions_and_give_any_infos(meddling, by_name):
    env = open_environment(meddling if by_name else Meddling())
    assert env.observation_space == Box(0, 1, (3,), np.float64)  # one-hot: no policy is a table of continuous actions
    policy = Constant(np.array([0.5]))
    episodes = rollout(env, policy, key=KEY, episodes=6, max_steps=8)
    assert all(np.all(episode.actions == 0.5) for episode in episodes)
    assert all(np.all(episode.states.sum(axis=1) == 1) for episode in episodes)


class Counting(gymnasium.Env):
    """Counts its steps, and rewards with their number."""

    observation_space, action_space = Box(-10, 10, (1,), np.float64), Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0.0
        return np.zeros(1), {}

    def step(self, action):
        self.t += 1
        return np.array([self.t]), self.t, False, False, {}


class CountingSideBySide(VectorEnv):
    """Many of them, which return their own arrays, and write to them anew."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 (gymnasium's interface)
    single_observation_space, single_action_space = Counting.observation_space, Counting.action_space

    def __init__(self, num_envs=1, max_episode_steps=5):
        self.num_envs = num_envs
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.seen, self.reward, self.ended = np.zeros((num_envs, 1)), np.zeros(num_envs), np.zeros(num_envs, bool)

    def reset(self, *, seed=None, options=None):
        self.seen[:] = 0
        return self.seen, {}

    def step(self, actions):
        self.seen += 1
        self.reward[:] = self.seen[:, 0]
        return self.seen, self.reward, self.ended, self.ended, {}


def test_arrays_that_a_vector_environment_writes_to_anew_are_copied():
    gymnasium.register("Counting-v0", entry_point=Counting, vector_entry_point=CountingSideBySide, max_episode_steps=5)
    try:
        for episode in rollout("Counting-v0", Coin(np.array(0.5)), key=KEY, episodes=2):
            np.testing.assert_array_equal(episode.states[:, 0], range(6))
            np.testing.assert_array_equal(episode.rewards, range(1, 6))
    finally:
        del gymnasium.registry["Counting-v0"]


class OtherSpaces(CountingSideBySide):
    """Observes something else than the environment that it is a version of."""

    single_observation_space = Box(0, 255, (3,), np.float64)


class OthersStay(CountingSideBySide, FunctionalJaxVectorEnv):
    """Of the kind whose other lanes stay where they were while one is reset."""

    render_state = None  # for `close`


@pytest.mark.parametrize("version", [OtherSpaces, OthersStay])
def test_a_vector_version_that_is_not_like_the_environment_is_not_used(version):
    gymnasium.register("Counting-v0", entry_point=Counting, vector_entry_point=version, max_episode_steps=5)
    try:
        with mock.patch.object(version, "step", side_effect=AssertionError("used")):
            (episode, *_) = rollout("Counting-v0", Coin(np.array(0.5)), key=KEY, episodes=2)
        np.testing.assert_array_equal(episode.states[:, 0], range(6))
    finally:
        del gymnasium.registry["Counting-v0"]


def test_what_random_actions_do_is_measured_up_to_the_limit_that_is_asked_for():
    env = open_environment("MountainCar-v0")
    assert {len(states) - 1 for states in random_episodes(env, 260, time_limit=260)} == {260}
    assert Task.of(env, 400).longer_hold()["exploration_hold"] > 1


def test_observations_of_a_wrapper_have_no_period_of_the_dynamics():
    made = gymnasium.make("bayespbrl/SwingUp-v0")
    assert opening.environment_attribute(made, "observation_period") is not None
    wrapped = open_environment(gymnasium.wrappers.TimeAwareObservation(made))
    assert opening.environment_attribute(wrapped, "observation_period") is None


def test_a_copy_of_an_environment_is_stepped_as_the_original():
    for env in (open_environment("CartPole-v1"), open_environment("FrozenLake-v1")):
        for copied in (deepcopy(env), pickle.loads(pickle.dumps(env))):
            assert opening.made_from(copied) == opening.made_from(env) is not None
    wrapped = gymnasium.wrappers.TimeAwareObservation(open_environment("CartPole-v1"))
    assert opening.made_from(wrapped) is None
    flat = open_environment(gymnasium.wrappers.ReshapeObservation(gymnasium.make("CartPole-v1"), (2, 2)))
    again = deepcopy(flat)
    assert opening.as_given(again) is again.env


def test_an_observation_of_too_many_numbers_is_refused():
    picture = gymnasium.wrappers.ReshapeObservation(gymnasium.make("CartPole-v1"), (2, 2))
    picture.observation_space = gymnasium.spaces.Box(0, 255, (84, 84), np.uint8)
    with pytest.raises(ValueError, match="CartPole-v1: expected observations of at most 1000 numbers, got 7056"):
        open_environment(picture)


@dataclass
class ByValue(FuncEnv):
    size: int = 3


def test_functions_that_compare_by_value_are_named():
    with pytest.raises(ValueError, match="environment ByValue: expected a class with a hash"):
        open_environment(ByValue())


def test_features_may_work_in_place():
    def halved(states):
        states /= 2
        return states

    states = np.ones((3, 1))
    assert np.all(checked_features(halved, states) == 0.5)
    assert np.all(states == 1)


class Drifting(FuncEnv):
    """A user's own pure functions, in float32, whose reward is not finite from the fourth step on if so wished."""

    observation_space = Box(-np.inf, np.inf, (1,), dtype=np.float32)
    action_space = Discrete(2)

    def initial(self, rng, params=None):
        return jnp.zeros(1, jnp.float32)

    def transition(self, state, action, rng, params=None):
        return state + 1

    def observation(self, state, rng, params=None):
        return jnp.where((state == 3) & (self.bad == "observation"), jnp.nan, state)

    def reward(self, state, action, next_state, rng, params=None):
        return jnp.where((next_state[0] == 4) & (self.bad == "reward"), jnp.nan, next_state[0])

    def terminal(self, state, rng, params=None):
        return state[0] >= 6


def test_a_users_pure_functions_run_compiled():
    trajectory = rollout(Drifting({"bad": ""}), Coin(np.array(0.5)), key=KEY, episodes=2, max_steps=10)[0]
    np.testing.assert_array_equal(trajectory.states, np.arange(7.0)[:, None])
    assert trajectory.total_reward == 21
    assert trajectory.terminated


class FromWhole(Drifting):
    """Starts at a whole number, and moves by a half."""

    def initial(self, rng, params=None):
        return jnp.zeros(1, int)

    def transition(self, state, action, rng, params=None):
        return state + 0.5


def test_pure_functions_may_start_with_other_types_than_they_go_on_with():
    trajectory = rollout(FromWhole({"bad": ""}), Coin(np.array(0.5)), key=KEY, episodes=1, max_steps=3)[0]
    np.testing.assert_array_equal(trajectory.states[:, 0], [0, 0.5, 1, 1.5])


@pytest.mark.parametrize(("bad", "step"), [("observation", 3), ("reward", 4)])
@pytest.mark.parametrize("run", [rollout, pytest.param(returns, marks=pytest.mark.slow)])
def test_pure_functions_that_return_nan_are_named_with_the_step(run, bad, step):
    with pytest.raises(ValueError, match=f"Drifting: .*NaN or infinity at step {step}"):
        run(Drifting({"bad": bad}), Coin(np.array(0.5)), key=KEY, episodes=2, max_steps=10)


class Corridor(Drifting):
    """Counts its steps in a space of five numbers, and leaves it."""

    observation_space = Discrete(5)

    def observation(self, state, rng, params=None):
        return state[0].astype(int)


class Cell(FromWhole):
    """Starts at a Python number."""

    observation_space = Discrete(5)

    def initial(self, rng, params=None):
        return 2

    def transition(self, state, action, rng, params=None):
        return jnp.clip(state + 1, 0, 4)

    def observation(self, state, rng, params=None):
        return state

    def reward(self, state, action, next_state, rng, params=None):
        return next_state * 1.0

    def terminal(self, state, rng, params=None):
        return state < 0


def test_a_state_may_begin_as_a_python_number():
    dynamics, coin = Cell({"bad": ""}), Coin(np.array(0.5))
    assert rollout(dynamics, coin, key=KEY, episodes=1, max_steps=3)[0].states.tolist() == [2, 3, 4, 4]
    assert returns(dynamics, coin, key=KEY, episodes=1, max_steps=3).total.tolist() == [11]


class Slip(Drifting):
    """Returns one reward in an array."""

    def reward(self, state, action, next_state, rng, params=None):
        return next_state


class Broken(Drifting):
    def transition(self, state, action, rng, params=None):
        raise RuntimeError("the motor\nis on fire")


@pytest.mark.parametrize(
    ("dynamics", "message"),
    [
        (Slip({"bad": ""}), r"Slip: reward: expected shape \(\), got \(1,\)"),
        (Broken({"bad": ""}), "Broken failed: RuntimeError: the motor is on fire"),
    ],
)
@pytest.mark.parametrize("run", [rollout, returns])
def test_pure_functions_that_go_wrong_are_named(run, dynamics, message):
    with pytest.raises(ValueError, match=message):
        run(dynamics, Coin(np.array(0.5)), key=KEY, episodes=1, max_steps=3)


# The gymnasium interface.


@pytest.mark.parametrize(
    "environment",
    ["bayespbrl-tests/Plain-v0", EnvSpec("bayespbrl-tests/Copy-v0", entry_point=Plain, max_episode_steps=9)],
)
def test_copies_of_an_environment_run_side_by_side(environment):
    trajectories = rollout(environment, STEER, key=KEY, episodes=4)
    for trajectory in trajectories:
        np.testing.assert_array_equal(trajectory.states[:, 0], np.arange(10))
        np.testing.assert_allclose(np.diff(trajectory.states[:, 1]), trajectory.actions[:, 0])
        assert np.abs(trajectory.actions).max() == 1.0
        assert not trajectory.terminated
    assert len({trajectory.states[0, 1] for trajectory in trajectories}) == 4  # each its own seed


class Draws(gymnasium.Env):
    """Ends by chance, and counts the steps and resets of all its copies."""

    observation_space, action_space = Box(0, 1, (1,), np.float64), Discrete(2)
    steps, resets = 0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        Draws.resets += 1
        return self.np_random.uniform(size=1), {}

    def step(self, action):
        Draws.steps += 1
        drawn = self.np_random.uniform(size=1)
        return drawn, float(drawn[0]), bool(drawn[0] < 0.2), False, {}


def test_a_copy_whose_episode_has_ended_is_not_stepped_while_the_others_go_on():
    gymnasium.register("bayespbrl-tests/Draws-v0", entry_point=Draws, max_episode_steps=15)
    try:
        trajectories = rollout("bayespbrl-tests/Draws-v0", Coin(np.array(0.5)), key=KEY, episodes=128)
        assert Draws.resets == 128
        assert Draws.steps == sum(len(trajectory) for trajectory in trajectories) < 0.6 * 128 * 15
        assert max(len(trajectory) for trajectory in trajectories) == 15
        more = rollout("bayespbrl-tests/Draws-v0", Coin(np.array(0.5)), key=KEY, episodes=130)  # the copies begin anew
    finally:
        del gymnasium.registry["bayespbrl-tests/Draws-v0"]
    alone = Draws()
    for number, trajectory in enumerate(more):
        first, _ = alone.reset(seed=rollouts.reset_seed(KEY) + number)
        steps = [alone.step(0) for _ in range(len(trajectory))]
        np.testing.assert_array_equal(trajectory.states, [first, *(step[0] for step in steps)])
        assert trajectory.terminated == steps[-1][2]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NotAtNought:
    action: np.ndarray

    def sample(self, key, observation):
        return jnp.where(observation[0] <= 0, jnp.nan, self.action)


class Countdown(gymnasium.Env):
    observation_space, action_space = Box(-5, 5, (1,), np.float64), Box(-1, 1, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = float(self.np_random.integers(1, 4))
        return np.array([self.left]), {}

    def step(self, action):
        self.left -= 1
        return np.array([self.left]), 0.0, self.left <= 0, False, {}


def test_no_policy_is_asked_for_an_action_at_the_last_observation_of_an_episode():
    gymnasium.register("bayespbrl-tests/Countdown-v0", entry_point=Countdown, max_episode_steps=9)
    arguments = {"key": KEY, "episodes": 6, "max_steps": 9}
    try:
        run = [
            rollout(env, NotAtNought(np.zeros(1)), **arguments) for env in (Countdown(), "bayespbrl-tests/Countdown-v0")
        ]
    finally:
        del gymnasium.registry["bayespbrl-tests/Countdown-v0"]
    for trajectories in run:
        assert len({len(trajectory) for trajectory in trajectories}) > 1
        assert all(trajectory.terminated for trajectory in trajectories)


def test_a_single_object_runs_episode_by_episode_and_stays_open():
    class Closing(Plain):
        def close(self):
            raise AssertionError("closed although it is the user's")

    env = Closing(ends=5)
    first = rollout(env, STEER, key=KEY, episodes=3, max_steps=20)
    again = rollout(env, STEER, key=KEY, episodes=3, max_steps=20)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
        assert one.terminated
        assert len(one) == 5
    assert first[0].states[0, 1] != first[1].states[0, 1]


def test_cart_pole_through_its_own_vector_environment_follows_its_physics():
    trajectories = rollout("CartPole-v1", Coin(np.array(0.5)), key=KEY, episodes=6)
    assert len({len(trajectory) for trajectory in trajectories}) > 1
    single = gymnasium.make("CartPole-v1").unwrapped
    for trajectory in trajectories:
        assert trajectory.terminated
        assert trajectory.actions.dtype == np.int64
        assert trajectory.total_reward == len(trajectory)
        for state, action, after in zip(trajectory.states[:-1], trajectory.actions, trajectory.states[1:], strict=True):
            single.reset()
            single.state = state
            np.testing.assert_allclose(single.step(action)[0], after, atol=1e-5)


def test_returns_through_the_interface_are_those_of_the_rollout():
    result = returns("CartPole-v1", Coin(np.array(0.5)), key=KEY, episodes=130)  # more than run side by side
    trajectories = rollout("CartPole-v1", Coin(np.array(0.5)), key=KEY, episodes=130)
    np.testing.assert_array_equal(result.steps, [len(t) for t in trajectories])
    np.testing.assert_array_equal(result.total, [t.total_reward for t in trajectories])
    assert len({t.states[0, 0] for t in trajectories}) == 130


def test_a_policy_that_is_an_ordinary_object_is_asked_one_observation_at_a_time():
    class Stubborn:
        def sample(self, key, observation):
            return 2 if observation < 24 else 0

    trajectory = rollout("gridworld", Stubborn(), key=KEY, episodes=1, max_steps=40)[0]
    assert set(trajectory.actions) == {2}
    assert trajectory.states[-1] == 22  # straight down from the centre


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Plain(bad_observation=3), "Plain: .*NaN or infinity at step 3"),
        (Plain(bad_observation=0), "Plain: .*NaN or infinity at its reset"),
        (Plain(bad_reward=4), "Plain: .*NaN or infinity at step 4"),
        (Plain(fails=5), "Plain failed at step 5: RuntimeError: the motor is on fire"),
    ],
)
def test_an_environment_that_goes_wrong_is_named_with_the_step(env, message):
    with pytest.raises(ValueError, match=message) as caught:
        rollout(env, STEER, key=KEY, episodes=1, max_steps=9)
    if env.fails:
        assert isinstance(caught.value.__cause__, RuntimeError)


class Rooms(gymnasium.Env):
    """Shows the numbers of a list, one after the other."""

    action_space = Discrete(2)

    def __init__(self, shown, start=0):
        self.shown, self.observation_space = shown, Discrete(3, start=start)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = list(self.shown)
        return self.left.pop(0), {}

    def step(self, action):
        return self.left.pop(0), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Rooms([0, 2, 7]), r"Rooms: expected observations of Discrete\(3\), got 7 at step 2"),
        (Rooms([-1, 2]), r"Rooms: expected observations of Discrete\(3\), got -1 at its reset"),
        (Rooms([5, 7, 8], start=5), r"Rooms: expected observations of Discrete\(3, start=5\), got 8 at step 2"),
        (Corridor({"bad": ""}), r"Corridor: expected observations of Discrete\(5\), got 5 at step 5"),
    ],
)
@pytest.mark.parametrize("run", [rollout, returns])
def test_a_discrete_observation_outside_its_space_is_named_with_the_step(run, env, message):
    with pytest.raises(ValueError, match=message):
        run(env, Coin(np.array(0.5)), key=KEY, episodes=1, max_steps=9)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Times:
    factor: np.ndarray

    def sample(self, key, observation):
        return self.factor * observation


class Pushed(Drifting):
    """Adds the action to its state; its fourth observation is NaN if so wished."""

    action_space = Box(-np.inf, np.inf, (1,), dtype=np.float32)

    def transition(self, state, action, rng, params=None):
        return state + 1 + action.astype(state.dtype)


@pytest.mark.parametrize("run", [rollout, returns])
@pytest.mark.parametrize("env", [Plain(), "swing-up"], ids=["by interface", "compiled"])
def test_a_policy_that_returns_nan_is_named(run, env):
    with pytest.raises(ValueError, match="policy Gaussian: expected finite actions"):
        run(env, Gaussian(np.array([np.nan]), np.ones(1)), key=KEY, episodes=1, max_steps=9)


@pytest.mark.parametrize("run", [rollout, returns])
def test_of_a_policy_and_an_environment_the_first_that_returns_nan_is_named(run):
    arguments = {"key": KEY, "episodes": 2, "max_steps": 9}
    with pytest.raises(ValueError, match=r"environment Pushed: expected finite .* at step 3"):
        run(Pushed({"bad": "observation"}), Times(np.zeros(1)), **arguments)
    with pytest.raises(ValueError, match="policy Times: expected finite actions"):
        run(Pushed({"bad": "observation"}), Times(np.array([np.nan])), **arguments)


@pytest.mark.parametrize("run", [rollout, returns])
@pytest.mark.parametrize("bad", ["", "observation"])
def test_an_action_outside_the_space_is_named(run, bad):
    with pytest.raises(ValueError, match=r"policy Constant: expected actions of Discrete\(2\), got 2"):
        run(Drifting({"bad": bad}), Constant(np.array(2)), key=KEY, episodes=3, max_steps=9)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AtTheEnd:
    end: np.ndarray

    def sample(self, key, observation):
        return jnp.where(observation[0] >= self.end, 2, 1)


class Uneven(Drifting):
    """Begins anywhere below 3, so that some episodes end before others."""

    def initial(self, rng, params=None):
        return jax.random.randint(rng, (1,), 0, 3).astype(jnp.float32)


def test_what_a_policy_would_do_after_the_end_is_not_looked_at():
    env, arguments = Uneven({"bad": ""}), {"key": KEY, "episodes": 8, "max_steps": 9}
    evaluated = returns(env, AtTheEnd(np.array(6)), **arguments)
    assert len(set(evaluated.steps)) > 1
    run = rollout(env, AtTheEnd(np.array(6)), **arguments)
    assert [trajectory.total_reward for trajectory in run] == list(evaluated.total)
    for function in (rollout, returns):
        with pytest.raises(ValueError, match="policy AtTheEnd"):
            function(env, AtTheEnd(np.array(5)), **arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": 0}, "episodes: expected a whole number >= 1, got 0"),
        ({"episodes": 2.5}, "episodes"),
        ({"max_steps": 0}, "max_steps: expected a whole number >= 1, got 0"),
        ({"max_steps": None}, "max_steps: expected a number, because Plain has no time limit, got None"),
        ({"key": 3}, "key: expected a JAX random key, got int"),
        ({"policy": object()}, "policy: expected an object with sample"),
    ],
)
@pytest.mark.parametrize("run", [rollout, returns])
def test_bad_arguments_are_named(run, options, message):
    arguments = {"environment": Plain(), "policy": STEER, "key": KEY, "episodes": 1, "max_steps": 3} | options
    with pytest.raises(ValueError, match=message):
        run(**arguments)


@pytest.mark.parametrize(
    ("environment", "limit"), [("bicycle", 50), ("CartPole-v1", 500), (gymnasium.wrappers.TimeLimit(Plain(), 4), 4)]
)
def test_the_time_limit_is_the_environments_own(environment, limit):
    assert step_limit(environment) == limit


def test_episodes_of_random_actions_are_cut_and_held_the_same_at_every_call():
    for steps, cut in ((1, 1), (4, 4), (9, 6)):
        assert {len(states) - 1 for states in random_episodes(open_environment(Push(steps)), 6)} == {cut}
    cart = open_environment("CartPole-v1")
    one, again = random_episodes(cart, 40), random_episodes(cart, 40)
    assert all(np.array_equal(*pair) for pair in zip(one, again, strict=True))
    assert np.mean([len(states) for states in one]) < 40
    forces = [np.sign(np.diff(states[:, 1])) for states in random_episodes(cart, 40, hold=4)]
    assert all((block == block[0]).all() for force in forces for block in np.split(force, range(4, len(force), 4)))
    assert len({tuple(force[:8]) for force in forces}) > 1
    cart.reset(seed=0)  # still open


@pytest.mark.parametrize(("task", "hold"), [("Acrobot-v1", 4), ("MountainCar-v0", 16), ("CartPole-v1", 1)])
def test_a_learner_repeats_random_actions_where_they_lead_nowhere_by_themselves(task, hold):
    assert bayespbrl.Learner(task).settings.rollouts.exploration_hold == hold


def test_a_learner_of_episodes_that_end_at_once_collects_more_of_them():
    learner = bayespbrl.Learner(Push(5, ends=True), max_steps=60)
    assert learner.settings.rollouts.trajectories_per_iteration == 80
    assert bayespbrl.Learner(Push(50), max_steps=60).settings.rollouts.trajectories_per_iteration == 10


def test_episodes_begin_alike_whether_or_not_the_program_uses_jax_with_64_bits():
    seeds = []
    for wide in (False, True):
        with jax.enable_x64(wide):
            seeds.append(rollouts.reset_seed(jax.random.key(5)))
    assert seeds[0] == seeds[1]


@pytest.mark.parametrize(
    ("environment", "action", "shown"),
    [
        ("CartPole-v1", 2, "Discrete(2), got 2"),
        ("CartPole-v1", -1, "Discrete(2), got -1"),
        ("gridworld", 1.7, "Discrete(5), got 1.7"),
        ("gridworld", [1, 2], r"Discrete(5), got [1 2]"),
        ("bicycle", [1.0], "(2,), float64), got [1.]"),
    ],
)
def test_actions_that_are_none_of_the_space_are_named(environment, action, shown):
    class Same:
        def sample(self, key, observation):
            return np.asarray(action)

    with pytest.raises(ValueError, match=f"^policy Same: expected actions of .*{re.escape(shown)}$"):
        rollout(environment, Same(), key=jax.random.key(0), episodes=2, max_steps=3)
