"""Step 2: on a small discrete problem with a known model, and once with continuous actions."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from bayespbrl.features import (
    OneHot,
    OwnFeatures,
    RadialBasisOptions,
    StateActionProduct,
    draw_state_action_features,
)
from bayespbrl.improvement import q_function, update
from bayespbrl.improvement.problem import PolicyUpdate, UpdateProblem, recent
from bayespbrl.improvement.q_function import Critic
from bayespbrl.policies import (
    GaussianProcessPolicy,
    LinearGaussianPolicy,
    SoftmaxPolicy,
    TabularPolicy,
    clipped,
    sample_actions,
    softmax,
)
from bayespbrl.trajectories import Trajectory, Transitions, transitions

STATES, ACTIONS, DISCOUNT = 6, 3, 0.9
CRITIC = Critic(DISCOUNT, 1e-8, 1e-8)


def model(seed=0):
    """P(s′|s, a), shape (S, A, S), and the reward of the next state, shape (S,)."""
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.full(STATES, 0.3), size=(STATES, ACTIONS)), rng.normal(size=STATES)


def walk(table, policy, rng, steps=4000, terminated=False):
    states, actions = [0], []
    for _ in range(steps):
        actions.append(rng.choice(ACTIONS, p=policy.table[states[-1]]))
        states.append(rng.choice(STATES, p=table[states[-1], actions[-1]]))
    rewards = np.zeros(steps)
    return Trajectory(np.array(states), np.array(actions), rewards, terminated)


def problem(steps, utilities, **changes):
    parts = {
        "states": steps.states,
        "critic": CRITIC,
        "state_action_features": StateActionProduct(OneHot(STATES), ACTIONS),
        "state_features": OneHot(STATES),
        "action_space": Discrete(ACTIONS),
    }
    return UpdateProblem(steps, utilities, **(parts | changes))


def improve(policy, steps, utilities, *, kl_bound=0.3, updates=1, key=None, utility_draws=None, **changes):
    """Propose and apply."""
    key = jax.random.key(1) if key is None else key
    proposed = update.propose(policy, problem(steps, utilities, **changes), key=key, utility_draws=utility_draws)
    return update.apply_update(proposed, kl_bound, key=key, rng=np.random.default_rng(1), updates=updates)


def random_policy(seed=4):
    return TabularPolicy(np.random.default_rng(seed).dirichlet(np.ones(ACTIONS), STATES))


def random_steps(seed=3, steps=400, terminated=False):
    table, reward = model()
    taken = transitions([walk(table, random_policy(), np.random.default_rng(seed), steps, terminated)])
    return taken, reward[taken.next_states]


def test_q_of_counted_steps_is_that_of_the_uncounted_ones(monkeypatch):
    steps, utilities = random_steps(terminated=True)
    utilities = utilities + 0.1 * np.random.default_rng(0).normal(size=len(steps))  # not a function of the state
    counted = improve(random_policy(), steps, utilities)
    assert len(q_function._counted(steps, utilities)[0]) < len(steps) / 2
    monkeypatch.setattr(q_function, "_counted", lambda steps, utilities: (steps, utilities, np.ones(len(steps))))
    uncounted = improve(random_policy(), steps, utilities)
    np.testing.assert_allclose(counted.q_function.weights, uncounted.q_function.weights, atol=1e-6)
    np.testing.assert_allclose(counted.policy.table, uncounted.policy.table, atol=1e-6)


def test_q_is_that_of_the_policy_under_the_observed_frequencies():
    # One-hot features make LSTD exact: Q = r + γ P̂ π Q with the empirical P̂.
    steps, utilities = random_steps(steps=3000)
    policy = random_policy()
    counts = np.zeros((STATES * ACTIONS, STATES))
    np.add.at(counts, (steps.states * ACTIONS + steps.actions, steps.next_states), 1)
    assert (counts.sum(axis=1) > 0).all()
    frequencies = counts / counts.sum(axis=1, keepdims=True)
    means = np.bincount(steps.states * ACTIONS + steps.actions, utilities) / counts.sum(axis=1)
    following = (frequencies[:, :, None] * policy.table).reshape(STATES * ACTIONS, -1)
    exact = np.linalg.solve(np.eye(STATES * ACTIONS) - DISCOUNT * following, means)
    states, actions = np.divmod(np.arange(STATES * ACTIONS), ACTIONS)
    np.testing.assert_allclose(improve(policy, steps, utilities).q_function(states, actions), exact, atol=1e-5)


def test_q_of_utilities_side_by_side_is_that_of_each_alone():
    steps, utilities = random_steps(terminated=True)
    others = np.random.default_rng(0).normal(size=(len(steps), 2))  # not a function of the state
    features = StateActionProduct(OneHot(STATES), ACTIONS)
    options = {"key": jax.random.key(1), "action_space": Discrete(ACTIONS), "features": features, "critic": CRITIC}
    together = q_function.estimate_q(
        random_policy(), q_function.CriticData(steps, np.column_stack([utilities, others])), **options
    )
    states, actions = np.divmod(np.arange(STATES * ACTIONS), ACTIONS)
    for column, alone in enumerate([utilities, *others.T]):
        by_itself = q_function.estimate_q(random_policy(), q_function.CriticData(steps, alone), **options)
        np.testing.assert_allclose(together(states, actions)[:, column], by_itself(states, actions), atol=1e-9)
    assert together(states, actions).shape == (STATES * ACTIONS, 3)


def test_four_quarters_have_three_divisions_into_halves_which_add_up_to_the_whole():
    assert q_function.halvings(list("abcd")) == [
        (["a", "b"], ["c", "d"]),
        (["a", "c"], ["b", "d"]),
        (["a", "d"], ["b", "c"]),
    ]
    assert q_function.halvings(["a", "b"]) == [(["a"], ["b"])]
    assert q_function.halvings(["a"]) == []


def test_the_halves_are_q_from_half_of_the_transitions_and_the_whole_stays_as_it_was(monkeypatch):
    steps, utilities = random_steps(terminated=True)
    quarters = np.arange(len(steps)) // 7 % 4
    features = StateActionProduct(OneHot(STATES), ACTIONS)
    options = {"key": jax.random.key(1), "action_space": Discrete(ACTIONS), "features": features, "critic": CRITIC}

    def estimated(*data):
        return q_function.estimate_q(random_policy(), q_function.CriticData(*data), **options)

    q = estimated(steps, utilities, quarters)
    np.testing.assert_allclose(q.weights, estimated(steps, utilities).weights, atol=1e-5)
    states, actions = np.divmod(np.arange(STATES * ACTIONS), ACTIONS)
    whole, halves = q.with_halves(states, actions)
    np.testing.assert_array_equal(whole, q(states, actions))
    assert halves.shape == (STATES * ACTIONS, 2, 3)
    for number, firsts in enumerate(((0, 1), (0, 2), (0, 3))):
        for side, chosen in enumerate((np.isin(quarters, firsts), ~np.isin(quarters, firsts))):
            rows = Transitions(*(column[chosen] for column in vars(steps).values()))
            alone = estimated(rows, utilities[chosen])(states, actions)
            np.testing.assert_allclose(halves[:, side, number], alone, atol=1e-6)
    monkeypatch.setattr(q_function, "ROWS_AT_A_TIME", 5)  # of 18 pairs, so that the last block is shorter
    for at_once, in_blocks in zip((whole, halves), q.with_halves(states, actions), strict=True):
        np.testing.assert_allclose(in_blocks, at_once, rtol=1e-12)


@pytest.mark.parametrize(("noise", "expected"), [(0.0, (0.7, 1.0)), (100.0, (0.0, 0.5))])
def test_reliability_is_near_one_where_transitions_tell_q_and_low_where_they_do_not(noise, expected):
    steps, utilities = random_steps(terminated=True)
    noisy = utilities + noise * np.random.default_rng(2).normal(size=len(steps))
    quarters = np.arange(len(steps)) // 50 % 4
    proposed = update.propose(random_policy(), problem(steps, noisy, quarters=quarters), key=jax.random.key(1))
    assert expected[0] <= proposed.reliability <= expected[1]
    assert update.propose(random_policy(), problem(steps, noisy), key=jax.random.key(1)).reliability == 1.0


def test_halves_that_agree_exactly_are_no_more_than_reliable():
    steps, utilities = random_steps(terminated=True)
    proposed = update.propose(random_policy(), problem(steps, utilities), key=jax.random.key(1))
    rng = np.random.default_rng(0)
    q = rng.normal(size=(40, len(proposed.base_weights)))
    alike = [replace(proposed, q_halves=np.stack([each, 3 * each], 1)[..., None]).reliability for each in q]
    assert max(alike) == 1.0  # rounding makes a correlation of 1 + 2e-16
    np.testing.assert_allclose(alike, 1.0)


@pytest.mark.parametrize("continuous", [False, True])
def test_q_is_the_same_however_many_transitions_are_taken_at_a_time(monkeypatch, continuous):
    if continuous:
        rng = np.random.default_rng(0)
        states = rng.normal(size=(40, 41, 2))
        steps = transitions([Trajectory(s, rng.normal(size=(40, 1)), np.zeros(40), terminated=True) for s in states])
        utilities, space = rng.normal(size=len(steps)), Box(-1, 1, (1,))
        policy = LinearGaussianPolicy.initial(Box(-9, 9, (2,)), space)
        features = draw_state_action_features(
            Box(-9, 9, (2,)), space, steps.states, steps.actions, RadialBasisOptions(9), rng=rng
        )
    else:
        (steps, utilities), space, policy = random_steps(terminated=True), Discrete(ACTIONS), random_policy()
        features = StateActionProduct(OneHot(STATES), ACTIONS)
    options = {"key": jax.random.key(1), "action_space": space, "features": features, "critic": CRITIC}
    at_once = q_function.estimate_q(policy, q_function.CriticData(steps, utilities), **options)(
        steps.states, steps.actions
    )
    monkeypatch.setattr(q_function, "ROWS_AT_A_TIME", 7)
    in_blocks = q_function.estimate_q(policy, q_function.CriticData(steps, utilities), **options)(
        steps.states, steps.actions
    )
    np.testing.assert_allclose(in_blocks, at_once, atol=1e-6)


def test_nothing_follows_a_terminal_state():
    # 0 → 1 → terminal 2, each step worth 1: Q(1, ·) = 1, Q(0, ·) = 1 + γ.
    trajectory = Trajectory(np.array([0, 1, 2]), np.array([0, 0]), np.zeros(2), terminated=True)
    steps = transitions([trajectory] * 5)
    q_function = improve(TabularPolicy(np.eye(ACTIONS)[np.zeros(STATES, int)]), steps, np.ones(10)).q_function
    np.testing.assert_allclose(q_function(np.array([0, 1]), np.array([0, 0])), [1 + DISCOUNT, 1], atol=1e-6)


def test_base_weights_are_policy_times_share_of_visits(monkeypatch):
    seen = {}

    def spy(q_values, features, base_weights, **options):
        seen.update(features=features, base_weights=base_weights)
        return reps_weights(q_values, features, base_weights, **options)

    reps_weights = update.reps_weights
    monkeypatch.setattr(update, "reps_weights", spy)
    steps, utilities = random_steps(steps=50)
    table = random_policy().table.copy()
    table[2] = [0.25, 0.75, 0]  # an action that the policy excludes needs no weight
    improve(TabularPolicy(table), steps, utilities)
    visits = np.bincount(steps.states, minlength=STATES) / len(steps)
    expected = (visits[:, None] * table)[visits > 0].ravel()
    np.testing.assert_allclose(seen["base_weights"], expected[expected > 0], rtol=1e-12)
    np.testing.assert_allclose(seen["base_weights"] @ seen["features"], visits, atol=1e-12)
    assert seen["base_weights"].sum() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("kl_bound", [0.05, 0.3])
def test_the_kl_of_the_fitted_table_is_that_of_reps_and_the_bound(kl_bound):
    steps, utilities = random_steps()
    updated = improve(random_policy(), steps, utilities, kl_bound=kl_bound)
    assert updated.reps.bound_active
    assert updated.reps.kl == pytest.approx(kl_bound, rel=1e-4)
    assert updated.kl_fitted_policy == pytest.approx(updated.reps.kl, rel=1e-5)
    visits = np.bincount(steps.states, minlength=STATES) / len(steps)
    new, old = updated.policy.table, random_policy().table
    assert updated.kl_fitted_policy == pytest.approx(visits @ np.sum(new * np.log(new / old), axis=1), rel=1e-9)
    assert updated.entropy == pytest.approx(-visits @ np.sum(new * np.log(new), axis=1), rel=1e-9)
    assert updated.action_standard_deviation is None  # the actions are discrete


@pytest.mark.parametrize("kl_bound", [10.0, 1e6])
def test_a_bound_that_no_policy_reaches_leads_to_a_greedy_one(kl_bound):
    steps, utilities = random_steps()
    updated = improve(random_policy(), steps, utilities, kl_bound=kl_bound)
    assert updated.updates == 1
    assert not updated.reps.bound_active
    assert updated.policy.table[np.unique(steps.states)].max(axis=1).min() > 0.99


def test_a_constant_utility_changes_nothing():
    steps, _ = random_steps()
    updated = improve(random_policy(), steps, np.full(len(steps), 2.5))
    np.testing.assert_allclose(updated.policy.table, random_policy().table, atol=1e-6)
    assert not updated.reps.bound_active


def test_states_never_visited_keep_their_row():
    trajectory = Trajectory(np.array([0, 1, 0, 1, 1]), np.array([0, 1, 2, 1]), np.zeros(4))
    updated = improve(random_policy(), transitions([trajectory]), np.array([1.0, 0, 2, 0.5]))
    np.testing.assert_array_equal(updated.policy.table[2:], random_policy().table[2:])
    assert not np.allclose(updated.policy.table[:2], random_policy().table[:2])


def test_repeated_improvement_with_the_reward_finds_the_policy_of_value_iteration():
    table, reward = model(seed=6)
    values = np.zeros(STATES)
    for _ in range(1000):
        optimal_q = table @ (reward + DISCOUNT * values)
        values = optimal_q.max(axis=1)
    gaps = np.sort(optimal_q, axis=1)
    assert (gaps[:, -1] - gaps[:, -2] > 0.02).all()  # the optimum is unique, and its margin above the noise of P̂
    rng, policy = np.random.default_rng(0), TabularPolicy(np.full((STATES, ACTIONS), 1 / ACTIONS))
    steps = transitions([walk(table, policy, rng, 40_000)])
    for _ in range(12):
        updated = improve(policy, steps, reward[steps.next_states], kl_bound=0.5)
        policy = updated.policy
    np.testing.assert_array_equal(policy.table.argmax(axis=1), optimal_q.argmax(axis=1))
    assert policy.table.max(axis=1).min() > 0.95


@pytest.mark.parametrize(
    "utilities", [np.zeros(3), np.full(400, np.nan), np.r_[np.zeros(399), np.inf], np.zeros((400, 1))]
)
def test_utilities_that_do_not_fit_or_are_not_finite_are_refused(utilities):
    with pytest.raises(ValueError, match=r"utilities: expected (shape \(400,\)|finite entries)"):
        improve(random_policy(), random_steps()[0], utilities)


OBSERVATIONS, FORCES = Box(-1.0, 1.0, (2,)), Box(-2.0, 1.0, (1,))


def quadratic(states, actions):
    """Features that hold Q = −(a − ½s₀)² exactly."""
    return np.column_stack([actions**2, actions * states[:, :1], states**2])


@pytest.mark.parametrize("kind", [LinearGaussianPolicy, pytest.param(GaussianProcessPolicy, marks=pytest.mark.slow)])
def test_a_continuous_policy_moves_towards_the_better_actions(kind):
    rng = np.random.default_rng(2)
    policy = kind.initial(OBSERVATIONS, FORCES, initial_scale=0.2)
    states = rng.uniform(-1, 1, size=(500, 2))
    actions = clipped(sample_actions(policy, jax.random.key(0), states), FORCES)
    steps = Transitions(states, actions, rng.uniform(-1, 1, (500, 2)), np.zeros(500), np.ones(500, bool))
    best = 0.5 * states[:, 0]
    before = np.mean((actions[:, 0] - best) ** 2)
    updated = improve(
        policy,
        steps,
        -((actions[:, 0] - best) ** 2),
        action_space=FORCES,
        state_features=lambda s: np.column_stack([s, s**2]),
        state_action_features=quadratic,
        critic=Critic(0.0),
        kl_bound=0.5,
    )
    np.testing.assert_allclose(updated.q_function(states, actions), -((actions[:, 0] - best) ** 2), atol=1e-5)
    assert updated.reps.bound_active
    assert updated.reps.feature_gap < 1e-6
    assert 0.1 < updated.kl_fitted_policy < 1.0
    after = sample_actions(updated.policy, jax.random.key(5), states)[:, 0]
    assert np.mean((after - best) ** 2) < 0.6 * before
    assert type(updated.policy) is kind
    assert updated.action_standard_deviation == pytest.approx(
        updated.policy.action_standard_deviation(states).mean(axis=0)
    )
    assert updated.action_standard_deviation[0] < policy.action_standard_deviation(states).mean()


def test_discrete_actions_in_continuous_states_leave_every_state_its_weight():
    rng = np.random.default_rng(3)
    states, actions = rng.uniform(-1, 1, size=(400, 2)), rng.integers(0, 2, 400)
    steps = Transitions(states, actions, rng.uniform(-1, 1, (400, 2)), np.zeros(400), np.ones(400, bool))
    better = np.where(states[:, 0] > 0, actions, 1 - actions)  # and far more depends on the state than on the action
    updated = improve(
        SoftmaxPolicy.initial(OBSERVATIONS, Discrete(2)),
        steps,
        better + 20 * states[:, 1],
        action_space=Discrete(2),
        state_features=lambda states: states,  # in these alone the weights could move from state to state
        state_action_features=StateActionProduct(lambda s: np.column_stack([s > 0, s, np.ones(len(s))]), 2),
        critic=Critic(0.0),
    )
    np.testing.assert_allclose(updated.reps.probabilities.reshape(400, 2).sum(axis=1), 1 / 400, rtol=1e-12)
    assert updated.reps.kl == pytest.approx(0.3, rel=1e-6)
    assert updated.kl_fitted_policy == pytest.approx(0.3, rel=0.15)
    chances = updated.policy.probabilities(np.array([[0.7, 0.0], [-0.7, 0.0]]))[:, 1]
    assert chances[0] > 0.8
    assert chances[1] < 0.2


@pytest.mark.parametrize("newton_steps", [50, 1])
def test_a_policy_that_knows_whether_its_fit_converged_says_so_in_the_summary(newton_steps, monkeypatch):
    monkeypatch.setattr(softmax, "NEWTON_STEPS", newton_steps)
    rng = np.random.default_rng(3)
    states, actions = rng.uniform(-1, 1, size=(60, 2)), rng.integers(0, 2, 60)
    steps = Transitions(states, actions, rng.uniform(-1, 1, (60, 2)), np.zeros(60), np.ones(60, bool))
    updated = improve(
        SoftmaxPolicy.initial(OBSERVATIONS, Discrete(2)),
        steps,
        np.where(states[:, 0] > 0, actions, 1.0 - actions),
        action_space=Discrete(2),
        state_features=lambda states: states,
        state_action_features=StateActionProduct(lambda s: np.column_stack([s, np.ones(len(s))]), 2),
        critic=Critic(0.0),
    )
    assert updated.summary()["policy_fit_converged"] is (newton_steps == 50)
    tabular = improve(random_policy(), random_steps()[0], np.zeros(400))
    assert "policy_fit_converged" not in tabular.summary()


def test_further_updates_go_on_from_the_last_with_the_spread_held_until_the_policy_has_moved_by_the_bound():
    rng = np.random.default_rng(2)
    states = rng.uniform(-1, 1, size=(500, 2))
    first = LinearGaussianPolicy.initial(OBSERVATIONS, FORCES, initial_scale=0.2)
    actions = clipped(sample_actions(first, jax.random.key(0), states), FORCES)
    # what an action is worth depends on what the policy does in the state that it leads to, and most of what is best in
    # a state is nothing that a linear policy can do
    steps = Transitions(states, actions, np.roll(states, 1, axis=0), np.zeros(500), np.zeros(500, bool))
    best = 0.5 * states[:, 0] + np.sign(states[:, 0] * states[:, 1])
    utilities = -((actions[:, 0] - best) ** 2)
    key = jax.random.key(1)
    options = {
        "action_space": FORCES,
        "state_features": lambda s: np.column_stack([s, s**2]),
        "state_action_features": lambda s, a: np.column_stack(
            [a**2, a * s[:, :1], a[:, 0] * np.sign(s[:, 0] * s[:, 1]), s**2]
        ),
        "critic": Critic(0.5),
        "kl_bound": 0.5,
    }
    one = improve(first, steps, utilities, key=key, **options)
    two, many = (
        improve(first, steps, utilities, key=key, updates=number, utility_draws=utilities[:, None], **options)
        for number in (2, 9)
    )
    second = improve(one.policy, steps, utilities, key=jax.random.fold_in(key, 1), **options)
    assert (one.updates, two.updates) == (1, 2)
    np.testing.assert_allclose(two.q_function.weights, second.q_function.weights, rtol=1e-9)
    np.testing.assert_allclose(two.reps.sample_weights, second.reps.sample_weights, rtol=1e-6)
    np.testing.assert_allclose(two.policy.coefficients, second.policy.coefficients, rtol=1e-6)
    np.testing.assert_allclose(two.policy.factor, one.policy.factor, rtol=1e-9)
    assert not np.allclose(second.policy.factor, one.policy.factor)
    assert one.kl_fitted_policy < update.NEARLY * 0.5
    assert one.kl_fitted_policy < two.kl_fitted_policy
    assert two.kl_fitted_policy == pytest.approx(np.mean(two.policy.kl_divergence(first, states)))
    assert two.kl_fitted_policy < update.NEARLY * 0.5 <= many.kl_fitted_policy
    assert 2 < many.updates < 9


def test_there_is_no_further_update_where_there_is_nothing_to_gain_and_none_at_all_is_refused():
    steps, utilities = random_steps()
    settled = improve(random_policy(), steps, utilities, updates=40, kl_bound=50.0)  # more than there is to gain
    assert 1 <= settled.updates < 40
    assert not settled.reps.bound_active
    assert improve(settled.policy, steps, utilities, updates=3, kl_bound=50.0).updates <= 1
    assert improve(random_policy(), steps, np.full(len(steps), 2.5), updates=3).updates == 0
    with pytest.raises(ValueError, match=r"^updates: expected a whole number >= 1, got 0$"):
        improve(random_policy(), steps, utilities, updates=0)


def few_samples(number=40):
    """A continuous policy and its actions in a few states, with as many features of the constraint as states."""
    rng = np.random.default_rng(2)
    policy = LinearGaussianPolicy.initial(OBSERVATIONS, FORCES, initial_scale=0.2)
    states = rng.uniform(-1, 1, size=(number, 2))
    actions = clipped(sample_actions(policy, jax.random.key(0), states), FORCES)
    steps = Transitions(states, actions, states, np.zeros(number), np.ones(number, bool))
    options = {
        "action_space": FORCES,
        "state_features": lambda s: np.exp(-8 * np.sum((s[:, None] - states) ** 2, axis=2)),
        "state_action_features": quadratic,
        "critic": Critic(0.0),
    }
    return policy, steps, options


def test_where_reps_finds_nothing_the_policy_stays_as_it_is_and_does_not_narrow():
    policy, steps, options = few_samples()
    updated = improve(policy, steps, np.full(len(steps), 2.5), updates=3, **options)
    assert updated.policy is policy
    assert (updated.updates, updated.kl_fitted_policy, updated.reps.bound_active) == (0, 0.0, False)


@pytest.mark.parametrize("failure", [{"kl": 0.0}, {"converged": False}])
def test_what_an_update_reports_is_of_the_last_that_was_applied(failure, monkeypatch):
    policy, steps, options = few_samples()
    utilities = steps.actions[:, 0] * np.sign(steps.states.prod(axis=1))  # a linear policy follows it in part
    once = improve(policy, steps, utilities, **options)
    solve, bounds = update.ProposedUpdate.solve, []

    def only_the_first(self, kl_bound):
        bounds.append(kl_bound)
        return solve(self, kl_bound) if len(bounds) == 1 else replace(solve(self, kl_bound), **failure)

    monkeypatch.setattr(update.ProposedUpdate, "solve", only_the_first)
    twice = improve(policy, steps, utilities, updates=2, **options)
    assert (len(bounds), twice.updates) == (2, 1)
    assert twice.reps.converged
    assert twice.summary() == once.summary()
    np.testing.assert_array_equal(twice.q_function.weights, once.q_function.weights)


def test_features_of_the_users_own_constrain_the_states_alike_in_any_units():
    policy, steps, options = few_samples()

    def features_in(unit):
        return OwnFeatures.in_any_units(lambda s: s * [1.0, unit], steps.states, of_equal_lengths=True)

    plain, mixed = (
        improve(policy, steps, steps.actions[:, 0], **options | {"state_features": features_in(unit)})
        for unit in (1.0, 1e5)
    )
    assert plain.reps.rank_kept == mixed.reps.rank_kept == 2
    np.testing.assert_allclose(mixed.reps.probabilities, plain.reps.probabilities, rtol=1e-4)


def test_few_sampled_actions_leave_the_weights_some_freedom():
    policy, steps, options = few_samples()
    updated = improve(policy, steps, steps.actions[:, 0], **options)
    assert updated.reps.rank_kept == 10
    assert updated.reps.bound_active
    assert updated.reps.kl == pytest.approx(0.3, rel=1e-3)


def test_a_policy_that_follows_the_weights_takes_one_update_whatever_is_allowed():
    steps, utilities = random_steps()
    once, often = (improve(random_policy(), steps, utilities, updates=number) for number in (1, 5))
    assert once.updates == often.updates == 1
    np.testing.assert_array_equal(once.policy.table, often.policy.table)


def test_continuous_actions_are_kept_within_the_bounds_and_discrete_ones_as_they_are():
    np.testing.assert_array_equal(clipped(np.array([[-5.0], [0.3], [5.0]]), FORCES), [[-2], [0.3], [1]])
    np.testing.assert_array_equal(clipped(np.array([0, 2]), Discrete(3)), [0, 2])


def test_the_critic_takes_the_last_iterations_but_neither_too_few_nor_too_many_transitions():
    def taken(lengths, iterations):
        trajectories = [Trajectory(np.zeros((n + 1, 1)), np.zeros((n, 1)), np.zeros(n)) for n in lengths]
        chosen = recent(trajectories, PolicyUpdate(critic_iterations=iterations), an_iteration=2)
        assert list(chosen) == trajectories[len(trajectories) - len(chosen) :]
        return len(chosen)

    assert taken([900] * 20, None) == 20
    assert taken([900] * 20, 4) == 8
    assert taken([10] * 20, 4) == 20  # 5000 are not there yet
    assert taken([100] * 200, 4) == 50
    assert taken([900] * 200, 100) == 11  # 10 000 at most
    assert taken([3000] * 20, 4) == 6  # but six trajectories, the last of which may be without noise
    assert taken([20_000] * 20, 2) == 4


def test_q_is_that_of_actions_kept_within_the_bounds_and_the_policy_is_fitted_to_the_actions_as_drawn():
    rng = np.random.default_rng(2)
    policy = LinearGaussianPolicy.initial(OBSERVATIONS, FORCES, initial_scale=0.5)
    states = rng.uniform(-1, 1, size=(200, 2))
    actions = clipped(sample_actions(policy, jax.random.key(0), states), FORCES)
    steps = Transitions(states, actions, states, np.zeros(200), np.ones(200, bool))
    features = {"state_features": lambda s: s, "state_action_features": quadratic}
    given = problem(steps, -(actions[:, 0] ** 2), action_space=FORCES, critic=Critic(0.0), **features)
    proposed = update.propose(policy, given, key=jax.random.key(1))
    seen, drawn = proposed.samples
    assert np.any(drawn > FORCES.high)
    assert np.any(drawn < FORCES.low)
    np.testing.assert_allclose(proposed.q_values, proposed.q_functions(seen, clipped(drawn, FORCES)))
