"""The utility as a reward, and a policy's `predict`."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

import bayespbrl
from bayespbrl import ReturnExpert, UtilityReward

FAST = {"preset": "paper", "iterations": 1, "max_steps": 20, "evaluation_episodes": 2, "centres": 20}


def run_of(env, directory, **options):
    bayespbrl.start(env, directory, **(FAST | options)).run(ReturnExpert())
    return bayespbrl.load(directory)


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    return run_of("Pendulum-v1", tmp_path_factory.mktemp("runs") / "pendulum")


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    return run_of("CartPole-v1", tmp_path_factory.mktemp("runs") / "cartpole")


def test_a_step_earns_the_utility_of_the_next_state_and_tells_the_true_reward(pendulum):
    plain, wrapped = gymnasium.make("Pendulum-v1"), UtilityReward(gymnasium.make("Pendulum-v1"), pendulum)
    plain.reset(seed=5)
    wrapped.reset(seed=5)
    for action in ([0.5], [-1.0], [2.0]):
        expected, true, *ends, _ = plain.step(np.array(action, np.float32))
        observation, reward, *found, info = wrapped.step(np.array(action, np.float32))
        np.testing.assert_array_equal(observation, expected)
        assert found == ends
        assert info["true_reward"] == pytest.approx(true)
        assert reward == pytest.approx(pendulum.estimate.utilities(observation[None].astype(float))[0])
        draws = pendulum.estimate.utilities_and_draws(observation[None].astype(float))[1]
        assert info["utility_deviation"] == pytest.approx(draws.std(), rel=0.2)
        few = pendulum.estimate.utilities_and_draws(observation[None].astype(float), number=200)[1]
        assert info["utility_deviation"] == pytest.approx(few.std(), rel=1e-5)


@pytest.mark.parametrize(
    ("utility", "hyperparameters"),
    [("posterior-mean", "given"), ("posterior-mean", "inferred"), ("linear-program", "given")],
)
def test_a_step_earns_the_utility_of_its_effort_too(tmp_path, utility, hyperparameters):
    chosen = {"utility": utility, "hyperparameters": hyperparameters}
    run = run_of("Pendulum-v1", tmp_path / "run", effort_utility=True, **chosen)
    assert len(run.estimate.features.effort) == 1
    wrapped = UtilityReward(gymnasium.make("Pendulum-v1"), run)
    for action in (0.0, 1.5, 7.0):
        wrapped.reset(seed=5)
        observation, reward, *_ = wrapped.step(np.array([action], np.float32))
        taken = np.array([[min(action, 2.0)]])  # as the environment takes it
        states = observation[None].astype(float)
        assert reward == pytest.approx(run.estimate.utilities(states, actions=taken)[0])
        weights = run.estimate.weights[..., -1]
        counts = run.estimate.multiples[:, -1] if utility == "posterior-mean" else 1.0
        part = run.estimate.features.efforts(taken) * np.sum(counts * weights)
        assert reward == pytest.approx(run.estimate.utilities(states)[0] + part[0])
    learner = bayespbrl.resume(tmp_path / "run")
    assert learner.estimate.features.effort == run.estimate.features.effort
    report = run.report("md").read_text()
    told = "weight of the effort of actions, in prior standard deviations: " in report
    assert told == (utility == "posterior-mean")
    assert ("That effort counts has probability" in report) == (hyperparameters == "inferred")
    assert ("The posterior is over 27 choices of length scales as well" in report) == (hyperparameters == "inferred")


def test_caution_subtracts_standard_deviations(pendulum):
    careless, careful = (UtilityReward(gymnasium.make("Pendulum-v1"), pendulum, caution=c) for c in (0.0, 2.0))
    careless.reset(seed=5)
    careful.reset(seed=5)
    _, more, *_ = careless.step(np.array([1.0], np.float32))
    _, less, *_, info = careful.step(np.array([1.0], np.float32))
    assert less == pytest.approx(more - 2 * info["utility_deviation"])
    with pytest.raises(ValueError, match="caution: expected a finite number"):
        UtilityReward(gymnasium.make("Pendulum-v1"), pendulum, caution=float("nan"))


class Picture(gymnasium.Env):
    """Four pixels that brighten by the action."""

    observation_space = Box(0, 255, (2, 2), np.uint8)
    action_space = Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.full((2, 2), 200, np.uint8)
        return self.state, {}

    def step(self, action):
        self.state = np.minimum(self.state, 250) + np.uint8(action)
        return self.state, float(action), False, False, {}


def brightness(states):
    return states[:, :1] * 2 + 100  # 8 bits would overflow


def test_features_of_small_integers_are_those_that_the_learner_had(tmp_path):
    options = FAST | {"max_steps": 4, "features": brightness}
    bayespbrl.start(Picture(), tmp_path / "run", **options).run(ReturnExpert())
    run = bayespbrl.load(tmp_path / "run", env=Picture(), features=brightness)
    wrapped = UtilityReward(Picture(), run)
    wrapped.reset(seed=0)
    observation, reward, *_ = wrapped.step(1)
    assert reward == pytest.approx(run.estimate.utilities(observation.reshape(1, -1).astype(float))[0])


def test_a_discrete_task_of_ours_earns_utility_too(gridworld_run):
    run = bayespbrl.load(gridworld_run)
    wrapped = UtilityReward(gymnasium.make("bayespbrl/Gridworld-v0"), run)
    wrapped.reset(seed=1)
    observation, reward, *_ = wrapped.step(0)
    assert reward == pytest.approx(run.estimate.utilities(np.array([observation]))[0])


@pytest.mark.slow
def test_other_spaces_and_runs_without_an_estimate_are_refused(pendulum, tmp_path):
    with pytest.raises(ValueError, match=r"^observation_space: expected Box.*, the run's, got Box"):
        UtilityReward(gymnasium.make("CartPole-v1"), pendulum)
    most = np.array([1.0, 1.0, 8.0])
    double = gymnasium.wrappers.TransformObservation(
        gymnasium.make("Pendulum-v1"), lambda observation: observation.astype(np.float64), Box(-most, most, dtype=float)
    )
    UtilityReward(double, pendulum)  # the same bounds, of another type
    with pytest.raises(ValueError, match=r"^env: expected an environment, got 'Pendulum-v1'"):
        UtilityReward("Pendulum-v1", pendulum)
    with pytest.raises(ValueError, match=r"^run: expected a run, as bayespbrl.load reads it, got Learner"):
        UtilityReward(gymnasium.make("Pendulum-v1"), pendulum.learner)
    with pytest.raises(ValueError, match=r"^caution: expected a finite number"):
        UtilityReward(gymnasium.make("Pendulum-v1"), pendulum, caution=[1.0, 2.0])
    bayespbrl.start("Pendulum-v1", tmp_path / "new", **FAST).ask()
    with pytest.raises(ValueError, match="run: expected a run with an estimate of the utility of states, got none yet"):
        UtilityReward(gymnasium.make("Pendulum-v1"), bayespbrl.load(tmp_path / "new"))
    known = run_of("Pendulum-v1", tmp_path / "known", utility="known-reward")
    with pytest.raises(
        ValueError, match="run: expected a run with an estimate of the utility of states, got KnownReward"
    ):
        UtilityReward(gymnasium.make("Pendulum-v1"), known)
    program = run_of("Pendulum-v1", tmp_path / "program", utility="linear-program")
    wrapped = UtilityReward(gymnasium.make("Pendulum-v1"), program)
    wrapped.reset(seed=1)
    assert wrapped.step(np.array([1.0], np.float32))[4]["utility_deviation"] == 0.0
    with pytest.raises(ValueError, match="caution: expected 0 for an estimate without a posterior, got 1"):
        UtilityReward(gymnasium.make("Pendulum-v1"), program, caution=1.0)


@pytest.fixture(scope="module")
def linear(tmp_path_factory):
    return run_of("Pendulum-v1", tmp_path_factory.mktemp("runs") / "linear", policy="linear-gaussian")


@pytest.mark.parametrize("task", ["pendulum", "cartpole", pytest.param("linear", marks=pytest.mark.slow)])
def test_predict_takes_one_observation_or_many(request, task):
    run = request.getfixturevalue(task)
    env = gymnasium.make(run.settings.env)
    one, _ = env.reset(seed=1)
    action, state = run.policy.predict(one, state="kept")
    assert state == "kept"
    assert env.action_space.contains(action) or env.action_space.contains(np.int64(action))
    batch = np.stack([one, one + 0.1, one])
    actions, _ = run.policy.predict(batch, deterministic=True)
    assert actions.shape == (3, *env.action_space.shape)
    np.testing.assert_array_equal(actions[0], actions[2])
    np.testing.assert_array_equal(run.policy.predict(one, deterministic=True)[0], actions[0])
    with pytest.raises(ValueError, match=r"observation: expected shape .*, or a batch of them, got \(2,\)"):
        run.policy.predict(np.zeros(2))


def test_the_deterministic_action_is_the_mean_or_the_most_probable(pendulum, cartpole):
    one, _ = gymnasium.make("CartPole-v1").reset(seed=1)
    probabilities = cartpole.learner.state.kept.policy.probabilities(one[None])
    assert cartpole.policy.predict(one, deterministic=True)[0] == probabilities.argmax()
    one, _ = gymnasium.make("Pendulum-v1").reset(seed=1)
    samples = np.array([pendulum.learner.state.kept.policy.mean_and_variance(one[None].astype(float))[0][0]])
    assert pendulum.policy.predict(one, deterministic=True)[0] == pytest.approx(np.clip(samples[0], -2, 2))
