"""The contract that all four environments keep, the opening of any environment, and the pictures."""

import sys
import warnings
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, OneOf, Sequence, Tuple
from gymnasium.utils.env_checker import check_env
from matplotlib.figure import Figure
from PIL import Image
from toys import QUICK, Echo, Odd, Push

import bayespbrl
from bayespbrl import envs
from bayespbrl.envs import functional
from bayespbrl.envs.opening import environment_attribute, open_environment
from bayespbrl.envs.pictures import draw_trajectory, film, frames
from bayespbrl.envs.spaces import to_plain
from bayespbrl.policies import LinearGaussianPolicy, SoftmaxPolicy
from bayespbrl.rollouts import rollout

IDS = list(envs.SHORT_NAMES.values())


@pytest.fixture(params=IDS)
def env(request):
    return gymnasium.make(request.param, render_mode="rgb_array")


def test_registering_twice_is_harmless():
    before = dict(gymnasium.registry)
    envs.register()
    assert gymnasium.registry == before


def test_gymnasiums_checker_is_content(env):
    with warnings.catch_warnings():
        # It recommends actions scaled to [−1, 1]; ours are in newton metres and metres. (Gymnasium's own Pendulum too.)
        warnings.filterwarnings("ignore", message=".*symmetric and normalized space")
        check_env(env.unwrapped)


def test_observations_are_float64_or_int64_and_the_global_precision_is_left_alone(env):
    observation, _ = env.reset(seed=0)
    observation, reward, *_ = env.step(env.action_space.sample())
    expected = np.int64 if isinstance(env.observation_space, Discrete) else np.float64
    assert observation.dtype == expected
    assert isinstance(reward, float)
    assert jnp.zeros(1).dtype == jnp.float32


def test_a_seed_decides_the_whole_episode_and_another_seed_another(env):
    def episode(seed):
        env.action_space.seed(1)
        rows = [env.reset(seed=seed)[0]]
        return np.array(rows + [env.step(env.action_space.sample())[0] for _ in range(20)])

    np.testing.assert_array_equal(episode(3), episode(3))
    assert np.any(episode(3) != episode(4))


def test_the_environment_is_its_pure_functions(env):
    env.action_space.seed(2)
    inner, dynamics = env.unwrapped, env.unwrapped.dynamics
    env.reset(seed=11)
    for _ in range(5):
        key, state, action = inner._key, inner._state, env.action_space.sample()
        observed = env.step(action)[:3]
        with jax.enable_x64(True):
            _, *expected = functional.step(dynamics, jax.random.split(key)[1], state, action)
        np.testing.assert_allclose(observed[0], expected[0], atol=1e-12)
        assert observed[1] == pytest.approx(float(expected[1]), abs=1e-12)
        assert observed[2] == bool(expected[2])


@pytest.mark.slow
def test_the_pure_functions_follow_their_callers_precision(env):
    if isinstance(env.observation_space, Discrete):
        assert env.unwrapped.dynamics.initial(jax.random.key(0)).dtype == jnp.int32
        return
    for wide, dtype in ((False, jnp.float32), (True, jnp.float64)):
        with jax.enable_x64(wide):
            _, observation, *_ = functional.step(
                env.unwrapped.dynamics, jax.random.key(0), jnp.full(env.observation_space.shape, 0.1), jnp.ones(2)
            )
        assert observation.dtype == dtype


def test_dynamics_state_their_period_limit_and_spaces(env):
    dynamics = env.unwrapped.dynamics
    assert env.spec.max_episode_steps == dynamics.max_episode_steps
    assert len(dynamics.observation_period) == int(np.prod(env.observation_space.shape or (1,)))
    assert dynamics.action_space == env.action_space


def test_rendering_shows_the_state(env):
    env.reset(seed=0)
    first = env.render()
    for _ in range(12):
        env.step(env.action_space.high if isinstance(env.action_space, Box) else 4)
    second = env.render()
    assert first.dtype == np.uint8
    assert first.shape == second.shape == (320, 320, 3)
    assert np.any(first != second)


def test_rendering_or_stepping_before_reset_and_an_unknown_mode_are_refused():
    fresh = gymnasium.make(IDS[0], render_mode="rgb_array").unwrapped
    for call in (fresh.render, lambda: fresh.step(0)):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    with pytest.raises(ValueError, match="render_mode"):
        functional.FunctionalEnv(fresh.dynamics, "human")


def wandering(env, steps=6, terminated=False):
    env.action_space.seed(0)
    states = [env.reset(seed=0)[0]] + [env.step(env.action_space.sample())[0] for _ in range(steps)]
    actions = np.zeros(steps)

    class Wandering(SimpleNamespace):
        def __len__(self):
            return steps

    return Wandering(states=np.array(states), actions=actions, rewards=np.zeros(steps), terminated=terminated)


@pytest.mark.parametrize("name", [*envs.SHORT_NAMES, "CartPole-v1"])
def test_a_whole_trajectory_is_drawn_on_the_axes_it_is_given(name):
    axes = Figure().add_subplot()
    opened = open_environment(name)
    assert draw_trajectory(opened, wandering(opened, terminated=True), axes) is axes
    assert axes.has_data()


def test_gridworld_picture_counts_the_visits_and_hides_the_reward():
    opened = open_environment("gridworld")
    trajectory = wandering(opened)
    axes = draw_trajectory(opened, trajectory, Figure().add_subplot())
    counts = np.array([int(text.get_text()) for text in axes.texts])
    np.testing.assert_array_equal(counts, np.bincount(trajectory.states, minlength=25))


def test_discrete_observations_without_a_drawing_of_their_own_are_drawn_as_steps():
    axes = Figure().add_subplot()
    trajectory = wandering(open_environment("gridworld"))
    draw_trajectory(open_environment("CartPole-v1"), trajectory, axes)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), trajectory.states)


def test_a_film_has_the_first_and_last_state_and_no_more_frames_than_asked(tmp_path):
    opened = open_environment("swing-up")
    trajectory = wandering(opened, steps=20)
    pictures = frames(opened, trajectory, max_frames=4)
    assert pictures.shape == (4, 320, 320, 3)
    env = gymnasium.make("bayespbrl/SwingUp-v0", render_mode="rgb_array")
    wandering(env, steps=20)
    np.testing.assert_array_equal(pictures[-1], env.render())
    with Image.open(film(opened, trajectory, tmp_path / "film.gif", max_frames=4)) as image:
        assert image.n_frames == 4
    with pytest.raises(ValueError, match="max_frames"):
        frames(opened, trajectory, max_frames=1)


def test_a_film_of_an_environment_that_cannot_draw_is_one_still():
    opened = open_environment("CartPole-v1")
    assert len(frames(opened, wandering(opened))) == 1


# Opening environments.


def test_short_names_open_the_registered_environments():
    assert {name: open_environment(name).spec.id for name in envs.SHORT_NAMES} == envs.SHORT_NAMES


def test_opening_what_is_open_changes_nothing():
    opened = open_environment("CartPole-v1")
    assert open_environment(opened) is opened


def test_shapes_are_flattened_and_discrete_actions_counted_from_zero():
    inner = Odd(Discrete(3, start=5), columns=3)
    opened = open_environment(inner)
    assert opened.observation_space.shape == (6,)
    assert opened.action_space == Discrete(3)
    np.testing.assert_array_equal(opened.reset(seed=1)[0], inner.reset(seed=1)[0].ravel())
    opened.step(2)
    assert inner.received == 7

    inner = Odd(Box(-1.0, 1.0, (2, 1)))
    opened = open_environment(inner)
    assert opened.action_space.shape == (2,)
    opened.step(np.array([0.5, -0.5], np.float32))
    np.testing.assert_array_equal(inner.received, [[0.5], [-0.5]])


@pytest.mark.parametrize("space", [MultiDiscrete([2, 3]), Dict(a=Discrete(2)), Box(0, 5, (2,), dtype=np.int64)])
def test_an_unsupported_action_space_is_named(space):
    with pytest.raises(ValueError, match=r"Odd: expected .* action space, got (MultiDiscrete|Dict|Box)"):
        open_environment(Odd(space))


def test_an_unsupported_observation_space_is_named():
    odd = Odd(Discrete(2))
    odd.observation_space = Sequence(Discrete(2))
    with pytest.raises(ValueError, match="expected an observation space of fixed size, got Sequence"):
        open_environment(odd)


@pytest.mark.parametrize("outside", [0, 6, -1])
def test_an_observation_that_cannot_be_one_hot_is_refused(outside):
    with pytest.raises(ValueError, match=f"observation: expected one of Discrete.*, got {outside}"):
        to_plain(Discrete(5, start=1), outside, Box(-1, 1, (1,)))


def test_observations_of_several_parts_are_flattened_as_gymnasium_does():
    space = Dict(hand=MultiDiscrete([2, 3]), place=Box(-1, 1, (2, 2)), turn=Discrete(3, start=1))
    odd = Odd(Discrete(2))
    odd.observation_space = space
    opened = open_environment(odd)
    assert opened.observation_space == Box(np.array([0.0] * 5 + [-1.0] * 4 + [0.0] * 3), np.ones(12), dtype=np.float64)
    observation = {"hand": np.array([1, 2]), "place": np.array([[0.1, 0.2], [0.3, 0.4]], np.float32), "turn": 2}
    expected = np.float32([0, 1, 0, 0, 1, 0.1, 0.2, 0.3, 0.4, 0, 1, 0]).astype(float)
    np.testing.assert_array_equal(to_plain(space, observation), expected)


def test_a_task_whose_observations_have_parts_is_learned_and_acted_in(tmp_path):
    options = {"iterations": 1, "evaluation_episodes": 5, "max_steps": 20, "centres": 10}
    bayespbrl.start("Blackjack-v1", tmp_path / "run", **options).run(bayespbrl.ReturnExpert())
    observation, _ = gymnasium.make("Blackjack-v1").reset(seed=0)
    policy = bayespbrl.load(tmp_path / "run").policy
    assert policy.act(observation) in (0, 1)
    one, _ = policy.predict(observation, deterministic=True)
    assert one in (0, 1)
    batch = tuple(
        np.array([part, other]) for part, other in zip(observation, (4, 10, 0), strict=True)
    )  # as copies give
    actions, _ = policy.predict(batch, deterministic=True)
    other, _ = policy.predict((4, 10, 0), deterministic=True)
    assert actions.tolist() == [one, other]
    for wrong in (3, {"hand": 3}, (40, 1)):
        with pytest.raises(ValueError, match=r"observation: expected one of Tuple\(Discrete\(32\), .*, got "):
            policy.act(wrong)


@pytest.mark.parametrize("name", ["swingup", "no/Such-v0", "CartPole-v99", "no_such_module:Env-v0", "not an id!", ""])
def test_an_unknown_name_gets_one_line_with_the_known_ones(name):
    with pytest.raises(ValueError, match="gridworld, bicycle, swing-up, acrobot") as caught:
        open_environment(name)
    assert "\n" not in str(caught.value)


def test_neither_name_nor_environment_is_refused():
    with pytest.raises(ValueError, match="got int"):
        open_environment(3)


def test_pure_functions_are_wrapped():
    class Still(FuncEnv):
        observation_space = Box(-1.0, 1.0, (1,), dtype=np.float64)
        action_space = Discrete(2)

        def initial(self, rng, params=None):
            return jnp.zeros(1)

    dynamics = Still()
    assert open_environment(dynamics).unwrapped.dynamics is dynamics


def test_an_environment_without_spaces_is_named():
    with pytest.raises(ValueError, match="environment Env: expected a space as its observation_space, got None"):
        open_environment(gymnasium.Env())


def test_a_step_of_the_old_interface_is_refused_instead_of_its_info_being_taken_for_a_flag():
    class Old(gymnasium.Env):
        observation_space, action_space = Box(-1.0, 1.0, (2,)), Discrete(2)

        def reset(self, *, seed=None, options=None):
            return np.zeros(2, np.float32), {}

        def step(self, action):
            return np.zeros(2, np.float32), 1.0, False, {"distance": 0.3}

    policy = SoftmaxPolicy.initial(Old.observation_space, Old.action_space)
    with pytest.raises(
        ValueError, match=r"Old failed at step 1: .*expected \(observation, reward, terminated, .*, got \(array"
    ):
        rollout(Old(), policy, key=jax.random.key(0), episodes=2, max_steps=5)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (np.zeros(2, np.float32), r"expected \(observation, info\), got array"),
        ((np.zeros(3, np.float32), {}), r"expected an observation of shape \(2,\), got array\(\[0., 0., 0.\]"),
    ],
    ids=["the observation alone", "a number more"],
)
def test_a_reset_that_returns_something_else_is_told_what_was_expected(returned, message):
    class Odd(gymnasium.Env):
        observation_space, action_space = Box(-1.0, 1.0, (2,)), Discrete(2)

        def reset(self, *, seed=None, options=None):
            return returned

    policy = SoftmaxPolicy.initial(Odd.observation_space, Odd.action_space)
    with pytest.raises(ValueError, match=f"environment Odd failed at its reset: ValueError: {message}"):
        rollout(Odd(), policy, key=jax.random.key(0), episodes=2, max_steps=5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_largest_number_as_a_bound_of_actions_stands_for_none(dtype):
    env = Push(3)
    env.action_space = Box(-np.finfo(dtype).max, np.finfo(dtype).max, (1,), dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gymnasium's own, about so wide a space
        opened = open_environment(env)
    assert opened.action_space == Box(-np.inf, np.inf, (1,), dtype)
    policy = LinearGaussianPolicy.initial(opened.observation_space, opened.action_space)
    (path,) = rollout(env, policy, key=jax.random.key(0), episodes=1, max_steps=5)
    assert 0 < np.abs(path.actions).max() < 10


@pytest.mark.parametrize(
    ("space", "inside", "outside"),
    [
        (MultiDiscrete([2, 3]), [1, 2], [2, 0]),
        (MultiDiscrete([2, 3], start=[5, 0]), [5, 0], [4, 0]),
        (Dict(a=Discrete(3), b=Discrete(2)), {"a": 2, "b": 0}, {"a": -1, "b": 0}),
        (Tuple([Discrete(3, start=5), Box(0, 1, (1,))]), (5, np.full(1, 7.0)), (8, np.zeros(1))),
        (MultiBinary(3), [1, 0, 1], [2, 0, 1]),
        (OneOf([Box(0, 1, (2,)), Discrete(3)]), (0, np.zeros(2, np.float32)), (1, 3)),
    ],
)
def test_discrete_parts_outside_their_space_are_refused_and_not_taken_for_others(space, inside, outside):
    assert to_plain(space, inside).ndim == 1
    with pytest.raises(ValueError, match="observation: expected one of"):
        to_plain(space, outside)


def test_bounds_of_half_precision_may_be_wide():
    class Half(Push):
        action_space = Box(-1, 1, (1,), dtype=np.float16)

    assert open_environment(Half(3)).action_space.dtype == np.float16


def test_a_module_beside_the_user_that_is_not_found_is_given_a_hint(monkeypatch, tmp_path):
    (tmp_path / "mazes_of_mine.py").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder])  # as the command has it
    with pytest.raises(ValueError, match=r"No module named 'mazes_of_mine'; PYTHONPATH=\. lets it be found"):
        open_environment("mazes_of_mine:Maze-v0")
    with pytest.raises(ValueError, match=r"No module named 'nowhere_else'\)"):
        open_environment("nowhere_else:Maze-v0")


class Scaled(gymnasium.ActionWrapper):
    """Chooses among discrete actions by a number."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(0, 4.99, (1,), np.float64)

    def action(self, action):
        return int(action[0])


def test_discrete_observations_of_continuous_actions_are_one_hot_whatever_the_dynamics_say_of_them():
    options = {"answers": 1, "iterations": 1, "utility": "linear-program", "max_steps": 4, "centres": 9}
    learner = bayespbrl.Learner(Scaled(gymnasium.make("bayespbrl/Gridworld-v0")), **QUICK | options)
    learner.run(bayespbrl.ReturnExpert())
    assert learner.trajectories[0].states.shape == (5, 25)
    assert environment_attribute(learner.environment, "grid_shape") is None
    assert environment_attribute(learner.environment, "optimal_return") > 0


def test_a_smooth_utility_of_too_many_states_is_refused_before_anybody_is_asked():
    options = {"max_steps": 5, "answers": 2, "diffusion_utility": True}
    with pytest.raises(ValueError, match="diffusion_utility: expected at most 1000 states, got 1500"):
        bayespbrl.Learner(Echo(states=1500), **options)
    bayespbrl.Learner(Echo(states=1500), features=lambda states: np.eye(2)[np.minimum(states, 1)], **options)
