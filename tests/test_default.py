"""The default: a budget of answers, checked updates and the kept policy; questions from one start."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import gymnasium
import jax
import numpy as np
import pytest
import xarray as xr
from toys import Memory, Slope, fingerprint

import bayespbrl
from bayespbrl import Learner, ReturnExpert, collection, cycle, rollouts
from bayespbrl.envs import opening
from bayespbrl.events import answered
from bayespbrl.improvement.check import CLEARLY, Check, share_better
from bayespbrl.improvement.problem import recent
from bayespbrl.policies import greedy
from bayespbrl.policies.actor import Actor
from bayespbrl.rollouts import rollout
from bayespbrl.runs.files import write_netcdf

FAST = {"max_steps": 8, "evaluation_episodes": 4, "centres": 20, "seed": 3, "hyperparameters": "given"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of the default on a task without a preset, comparing by start, with a single policy."""
    directory = tmp_path_factory.mktemp("runs") / "slope"
    env = gymnasium.wrappers.TimeLimit(Slope(), 8)
    bayespbrl.start(env, directory, answers=4, same_start=True, restart_iterations=0, **FAST).run(ReturnExpert())
    return bayespbrl.load(directory, env=env)


@pytest.fixture(scope="module")
def restarted(tmp_path_factory):
    """The same with a policy that is started anew after the last answer."""
    directory = tmp_path_factory.mktemp("runs") / "restarted"
    options = {"answers": 4, "same_start": True, "restart_iterations": 3, **FAST}
    bayespbrl.start(Slope(), directory, **options).run(ReturnExpert())
    return bayespbrl.load(directory, env=Slope())


def test_the_budget_ends_the_questions_and_the_run_a_little_later(run):
    assert run.preferences.answers == 4
    answers = [summary["answers"] for summary in run.iterations]
    assert answers[-6:] == [4] * 6 or len(answers) == run.settings.most_iterations
    assert run.learner.finished
    assert run.settings.iterations is None


@pytest.mark.parametrize("seed", [4, 5])
def test_an_answer_says_nothing_of_trajectories_from_other_starts(seed):
    options = {"preset": "paper", "utility": "linear-program", "trajectories_per_iteration": 4, "iterations": 14}
    sizes = {"max_steps": 8, "evaluation_episodes": 1, "centres": 10}
    run = Learner(Slope(), same_start=True, answers=12, seed=seed, **options, **sizes).run(ReturnExpert())
    asked = {frozenset((past.first, past.second)) for past in run.state.past}
    assert {frozenset(pair) for pair in run.preferences.pairs} <= asked
    returns = [trajectory.total_reward for trajectory in run.trajectories]
    assert all(returns[better] > returns[worse] for better, worse in run.preferences.pairs)


@pytest.mark.parametrize(("seed", "skips"), [(2, False), (5, True)])
def test_no_two_from_one_start_are_asked_about_twice(seed, skips):
    options = {"answers": 8, "same_start": True, "queries_per_iteration": 3, "worthwhile": False, "iterations": 5}
    learner = Learner(Slope(), **FAST | {"seed": seed}, **options, trajectories_per_iteration=6)
    asked, rng = [], np.random.default_rng(seed)
    while questions := learner.ask():
        asked.append({questions[0].first, questions[0].second})
        skipped = skips and rng.random() < 0.6
        learner.tell(["skip" if skipped else ReturnExpert()(*questions[0].trajectories)])
    assert len(asked) >= 8
    assert all(pair not in asked[:place] for place, pair in enumerate(asked))


def test_the_two_of_a_question_start_alike(run):
    log = [line for line in (run.path / "events.jsonl").read_text().splitlines() if '"asked"' in line]
    assert len(log) == 4
    for i, j in (*run.preferences.pairs, *run.preferences.ties):
        np.testing.assert_array_equal(run.trajectories[i].states[0], run.trajectories[j].states[0])
    starts = [trajectory.states[0].tobytes() for trajectory in run.trajectories]
    assert starts[0] == starts[1] != starts[2]  # two of each at first
    assert starts[10:20] == starts[20:30]
    assert len(set(starts[10:20])) == 9
    assert starts[18] == starts[19]  # the two policies without noise
    assert run.learner.comparable_starts


def test_the_kept_policy_is_the_best_that_was_tried_and_its_value_is_reported(run):
    values = [summary["value_newest"] for summary in run.iterations]
    best = [summary["check"]["best"] for summary in run.iterations]
    kept = [summary["kept"] for summary in run.iterations]
    assert (best[:2], kept[0]) == ([0, 1], 1)
    assert all(before <= after <= number for number, (before, after) in enumerate(pairwise(best), 1))
    for number, (summary, before) in enumerate(zip(run.iterations, best, strict=True), 1):
        assert summary["kept"] in (before, number)
        assert summary["value"] == values[summary["kept"] - 1]
    utility = run.estimate.trajectory_utilities
    tried, best_tried = (
        utility(some).mean() for some in (run.learner.state.newest.tried, run.learner.state.best.tried)
    )
    assert (kept[-1] == len(kept)) == (tried > best_tried)
    assert run.evaluate(episodes=300, seed=1) == pytest.approx(run.iterations[-1]["value"], abs=6.0)
    assert run.learner.last_policy is run.learner.state.newest.policy


def test_a_policy_is_tried_without_its_noise_from_starts_that_all_policies_share(run):
    tried, kept = run.learner.state.newest.tried, run.learner.state.best.tried
    for trajectory, other in zip(tried, kept, strict=True):
        np.testing.assert_array_equal(trajectory.states[0], other.states[0])
    mode = jax.jit(run.last_policy.policy.mode)
    for trajectory in tried:
        actions = [mode(state) for state in trajectory.states[:-1]]
        np.testing.assert_allclose(trajectory.actions, np.clip(actions, -1, 1), atol=1e-4)  # outside float64
    observation = np.array([0.1, -0.2])
    assert all(run.policy.act(observation) == run.policy.act(observation) for _ in range(3))
    assert run.last_policy.policy.action_standard_deviation(observation[None]) > 0


@pytest.mark.slow
def test_undo_takes_back_which_policies_were_tried_and_kept():
    straight, undone = (Learner(Slope(), answers=3, iterations=4, **FAST) for _ in range(2))
    straight.run(ReturnExpert())
    while questions := undone.ask():
        undone.tell(["tie"])
        undone.undo()  # after an iteration, from the second answer on
        undone.tell([ReturnExpert()(*query.trajectories) for query in questions])
    assert fingerprint(undone) == fingerprint(straight)
    assert [undone.state.kept.number, undone.state.best.number] == [
        straight.state.kept.number,
        straight.state.best.number,
    ]


def test_after_the_last_answer_a_policy_is_started_anew(run, restarted):
    log = [json.loads(line) for line in (restarted.path / "events.jsonl").read_text().splitlines()]
    (began,) = [event["iteration"] - 1 for event in log if event.get("restarted")]
    total, restart = len(restarted.iterations), restarted.learner.state.restart
    assert total == began + 3
    assert restarted.learner.finished
    assert [summary["answers"] for summary in restarted.iterations[began - 1 :]] == [4] * 4
    assert "restarted" not in restarted.iterations[began - 1]
    assert all(summary["restarted"] == began for summary in restarted.iterations[began:])
    assert restarted.iterations[:began] == [
        {**summary, "seconds": mine["seconds"]}
        for summary, mine in zip(run.iterations, restarted.iterations[:began], strict=False)
    ]
    first = restarted.learner.state.first_policy
    drawn = rollouts.rollout(
        restarted.learner.environment,
        first,
        key=restarted.learner.cycle._key(collection.COLLECT, began),
        episodes=8,
        hold=restarted.learner.settings.rollouts.hold([len(each) for each in restarted.trajectories[:10]]),
        max_steps=8,
        starts=restarted.learner.cycle._starts(began)[:8],
    )
    for mine, other in zip(restarted.trajectories[10 * began : 10 * began + 8], drawn, strict=True):
        np.testing.assert_array_equal(mine.actions, other.actions)
    checks = [summary["check"] for summary in restarted.iterations[began:]]
    assert [check["best"] for check in checks[:2]] == [began, began + 1]
    assert restart.kept.number == restarted.iterations[began - 1]["kept"]


def test_after_a_restart_policies_improve_by_the_trajectories_since_then(restarted, monkeypatch):
    state, cycle_, taken = restarted.learner.state, restarted.learner.cycle, []

    def recorded(trajectories, *known, **options):
        taken.append(len(trajectories))
        return recent(trajectories, *known, **options)

    monkeypatch.setattr(cycle, "recent", recorded)
    cycle_.update(state, state.estimate, None)
    assert state.started > 0
    before = state.started * restarted.learner.settings.rollouts.trajectories_per_iteration
    assert taken == [len(state.trajectories) - before]


def test_after_a_restart_the_kept_policy_gives_way_only_to_a_clearly_better_one(restarted):
    state, cycle_ = restarted.learner.state, restarted.learner.cycle
    tried, check = state.newest.tried, Check(state.best.number, 1.0)
    of_best = cycle_._judged(state.estimate, state.best.tried)
    better = share_better(cycle_._judged(state.estimate, tried), of_best) >= CLEARLY
    same = tried if better else state.best.tried
    for kept, expected in ((same, False), (worst_first(state, tried), True)):
        before = replace(state, restart=replace(state.restart, kept=replace(state.restart.kept, tried=kept)))
        number = cycle_._kept(before, state.estimate, check, of_best, tried)
        assert (number != state.restart.kept.number) == expected
    if state.kept.number == state.restart.kept.number:
        assert restarted.learner.policy.policy is state.restart.kept.policy


@pytest.mark.parametrize("newest", [True, False])
def test_after_a_restart_the_best_policy_is_judged_by_its_own_trajectories(restarted, newest):
    state, cycle_ = restarted.learner.state, restarted.learner.cycle
    bad = worst_first(state, state.newest.tried)
    good = tuple(max(state.trajectories, key=lambda each: state.estimate.trajectory_utilities([each])[0]) for _ in bad)
    restart = replace(state.restart, kept=replace(state.restart.kept, tried=tuple(state.trajectories[: len(bad)])))
    of_newest, of_best = (good, bad) if newest else (bad, good)
    before = replace(
        state,
        restart=restart,
        newest=replace(state.newest, tried=of_newest),
        best=replace(state.best, tried=of_best),
    )
    check = Check(state.iteration if newest else state.best.number, 1.0)
    kept = cycle_._kept(before, state.estimate, check, cycle_._judged(state.estimate, good), bad)
    assert kept == check.best


def worst_first(state, tried):
    """As many trajectories as `tried`, each the one that the posterior thinks least of."""
    everything = state.trajectories
    worst = everything[int(np.argmin(state.estimate.trajectory_utilities(everything)))]
    return tuple(worst for _ in tried)


@pytest.mark.slow
def test_a_restarted_run_that_was_stopped_or_undone_goes_on_bit_for_bit(restarted, tmp_path):
    options = {"answers": 4, "same_start": True, "restart_iterations": 3, **FAST}
    again = bayespbrl.start(Slope(), tmp_path / "run", **options)
    expert = ReturnExpert()
    while query := again.ask():
        again.tell([expert(*query[0].trajectories)])
    assert again.finished
    again.undo()  # the last answer, and the restart with it
    assert again.state.restart is None
    assert not again.finished
    again.record(answered(again.state.query.number, expert(*again.state.query.trajectories)))
    stopped = bayespbrl.resume(tmp_path / "run", env=Slope())
    while not stopped.state.restart:
        stopped.record(stopped.cycle.next(stopped.state))
    finished = bayespbrl.resume(tmp_path / "run", env=Slope()).run(expert)
    assert fingerprint(finished) == fingerprint(restarted.learner)
    assert finished.state.kept.number == restarted.learner.state.kept.number


def test_what_shares_a_start_by_chance_is_no_comparison_of_policies():
    """The last two of the first iteration start alike, but both are of one policy with its noise."""
    options = FAST | {"answers": 12, "worthwhile": False, "trajectories_per_iteration": 4, "same_start": True}
    learner, expert, asked = Learner(Slope(), **options), ReturnExpert(), []
    while query := learner.ask():
        asked.append((query[0].newcomer, query[0].incumbent, query[0].duel, learner.state.to_beat.number))
        learner.tell([expert(*query[0].trajectories)])
    assert {2, 3} in [{newcomer, opponent} for newcomer, opponent, *_ in asked]
    assert not any(duel for *_, duel, best in asked if not best)
    duels = [(newcomer, opponent) for newcomer, opponent, duel, _ in asked if duel]
    assert duels
    assert all(newcomer % 4 == 3 and opponent == newcomer - 1 for newcomer, opponent in duels)


@pytest.mark.parametrize("seed", [8, 11])
def test_policies_are_compared_without_noise_and_a_restarted_one_before_it_is_kept(seed):
    sizes = FAST | {"answers": 10, "restart_iterations": 8, "worthwhile": False, "seed": seed}
    run, expert, log, duels = Learner(Slope(), **sizes), ReturnExpert(), Memory(), []
    run.logged(log)
    while query := run.ask():
        state, number = run.state, len(run.trajectories)
        if query[0].duel:
            assert (query[0].newcomer, query[0].incumbent) == (number - 1, number - 2)
            duels.append((state.iteration, (state.best if state.restart is None else state.restart.kept).number))
            undominated = state.preferences.undominated
        run.tell([expert(*query[0].trajectories)])
        if query[0].duel:
            assert run.preferences.undominated == undominated
            assert {number - 1, number - 2} == set(run.preferences.pairs[-1])
    policies = [run.state.first_policy, *(e.parts["policy"] for e in log.entries if e.event["event"] == "improved")]
    for newest, kept in duels:
        last_two = run.trajectories[10 * newest + 8 : 10 * newest + 10]
        np.testing.assert_array_equal(last_two[0].states[0], last_two[1].states[0])
        for policy, trajectory in zip((kept, newest), last_two, strict=True):
            as_kept = [policies[policy].mode(state) for state in trajectory.states[:-1]]
            np.testing.assert_allclose(trajectory.actions, np.clip(as_kept, -1, 1), atol=1e-3)
    restart = run.state.restart
    before = [e["answers"] for e in run.iterations if e["iteration"] <= restart.iteration + 1]
    assert max(before) <= 9  # a tenth is left
    confirmed = [newest for newest, _ in duels if newest > restart.iteration]
    assert confirmed
    assert restart.kept is run.state.kept
    assert restart.kept.number in (
        *confirmed,
        *(e["kept"] for e in run.iterations if e["iteration"] == restart.iteration),
    )
    assert fingerprint(replayed(run, log)) == fingerprint(run)


def replayed(run, log):
    return Learner(Slope(), entries=log.entries, kept=run.settings)


class Plain:
    """A policy of a user's with neither `mode` nor anything else of ours: a standard normal action."""

    @classmethod
    def initial(cls, observation_space, action_space):
        return cls()

    def sample(self, key, observation):
        return jax.random.normal(key, (1,))

    def log_prob(self, observation, action):
        return -0.5 * (action**2).sum()

    def entropy(self, observation):
        return 1.4

    def action_standard_deviation(self, observations):
        return np.ones((len(observations), 1))

    def kl_divergence(self, old, observations):
        return np.zeros(len(observations))

    def fit(self, observations, actions, sample_weights, *, rng, base_weights=None):
        return self


jax.tree_util.register_static(Plain)


def test_a_policy_without_a_mode_is_tried_and_kept_with_its_noise():
    learner = Learner(Slope(), policy=Plain(), answers=2, restart_iterations=1, **FAST).run(ReturnExpert())
    assert learner.iterations[-1]["kept"] > 0
    assert isinstance(learner.policy, Plain)
    actor = Actor(learner.policy, Slope.observation_space, Slope.action_space, np.random.default_rng(0))
    assert actor.act(np.zeros(2)) != actor.act(np.zeros(2))
    with pytest.raises(ValueError, match="observation: expected finite entries, got NaN or infinity"):
        actor.act(np.array([0, np.nan]))
    with pytest.raises(
        ValueError, match="deterministic: expected a policy with a method mode or probabilities, got Plain"
    ):
        actor.predict(np.zeros((1, 2)), deterministic=True)


@pytest.mark.slow
def test_a_run_of_an_earlier_version_which_tried_no_policy_goes_on(run, tmp_path):
    """Its kept policy stays the same, with its noise, until it is continued."""
    directory = shutil.copytree(run.path, tmp_path / "old")
    for file in (directory / "iterations").iterdir():
        with xr.open_datatree(file, engine="netcdf4", decode_times=False) as tree:
            old = tree.load()
        write_netcdf(file, old.drop_nodes("tried"))
    lines = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    last = max(number for number, line in enumerate(lines) if line["event"] == "collected")
    for line in lines:
        line.get("summary", {}).pop("kept", None)
        for field in ("check", "kept", "bound", "value"):  # the event had none of them beside its summary
            line.pop(field, None)
    (directory / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines[:last]))
    env = gymnasium.wrappers.TimeLimit(Slope(), 8)
    learner = bayespbrl.resume(directory, env=env)
    best = learner.state.best.number
    assert learner.policy is learner.state.best.policy
    learner.run(ReturnExpert())
    assert learner.iterations[-1]["check"]["best"] in (best, learner.state.iteration - 1)
    assert learner.policy is not learner.state.best.policy


@pytest.mark.slow
def test_a_step_back_goes_on_from_the_kept_policy_with_less_trust():
    """An estimate that calls the newest trajectories worse sends the next update back to the best policy."""
    learner = Learner(Slope(), answers=3, **FAST)
    learner.run(lambda first, second: "first" if first.total_reward > second.total_reward else "second")
    backwards = [s for s in learner.iterations if s["check"]["stepped_back"]]
    for summary in learner.iterations:
        check = summary["check"]
        assert check["stepped_back"] == (check["gain"] < -check["standard_error"])
        assert summary["kl_bound"] <= check["trust"] * 1.0 + 1e-12
    assert all(summary["check"]["trust"] < 1 for summary in backwards)


def test_after_a_step_back_the_update_begins_with_the_best_policy(run):
    state, cycle_ = run.learner.state, run.learner.cycle
    before = replace(state, trajectories=state.trajectories[-20:])

    def updated(state, stepped_back):
        improved, _ = cycle_.update(state, state.estimate, Check(state.best.number, 0.5, stepped_back))
        return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(improved.policy)]

    back = updated(before, True)
    assert back == updated(replace(before, newest=state.best), False)
    assert back != updated(before, False)


@pytest.mark.slow
def test_each_random_choice_has_a_stream_of_its_own(monkeypatch):
    drawn, real = Counter(), cycle.Cycle._rng

    def counted(self, purpose, count):
        drawn[purpose, count] += 1
        return real(self, purpose, count)

    monkeypatch.setattr(cycle.Cycle, "_rng", counted)
    learner = Learner(Slope(), answers=4, same_start=True, iterations=4, repeats=0.2, **FAST).run(ReturnExpert())
    of_all_policies = {(collection.EVALUATE, 0), (collection.CHECK, 0), (collection.STARTS, 0)}
    of_an_update = {(cycle.IMPROVE, n) for n in range(4)}  # fresh actions by a key, the fit by a generator
    assert {stream for stream, times in drawn.items() if times > 1} == of_all_policies | of_an_update
    assert len(learner.iterations) == 4
    each = {(purpose, n) for purpose in (collection.COLLECT, cycle.FIT, cycle.VISITED) for n in range(4)}
    assert each | {(cycle.FEATURES, n) for n in range(8)} <= set(drawn)


def test_the_value_is_that_of_the_policy_without_its_noise(run):
    newest = run.learner.last_policy
    assert run.iterations[-1]["value_newest"] == run.learner.cycle.evaluated(greedy(newest)).total.mean()
    assert run.iterations[-1]["value_newest"] != run.learner.cycle.evaluated(newest).total.mean()


class Unseeded(Slope):
    """Starts anew each time, whatever the seed."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=None, options=options)


@pytest.mark.slow
def test_an_environment_that_no_seed_resets_is_compared_across_starts():
    learner = Learner(Unseeded(), answers=3, same_start=True, restart_iterations=1, **FAST).run(ReturnExpert())
    assert learner.comparable_starts is False
    assert learner.preferences.answers == 3
    assert Learner(Unseeded(), answers=3, **FAST).comparable_starts is None  # not asked for


def test_what_the_best_question_is_worth_is_told_where_people_answer():
    learner = Learner("gridworld", expert="other", answers=4, **FAST)
    assert learner.worth_asking is None
    while learner.state.iteration < 1:
        learner.tell(["first"] * len(learner.ask()))
    assert 0 <= learner.worth_asking <= 1
    assert not learner.settings.questions.worthwhile  # nothing is left out by it


@pytest.mark.slow
def test_a_stopped_run_of_the_default_goes_on_bit_for_bit(tmp_path):
    options = {"answers": 3, "same_start": True, "iterations": 4, **FAST, "hyperparameters": "inferred"}
    whole = Learner("swing-up", **options).run(ReturnExpert())
    stopped, expert = bayespbrl.start("swing-up", tmp_path / "run", **options), ReturnExpert()
    for _ in range(2):
        stopped.tell([expert(*query.trajectories) for query in stopped.ask()])
    again = bayespbrl.resume(tmp_path / "run").run(expert)
    assert fingerprint(again) == fingerprint(whole)
    assert again.worth_asking == whole.worth_asking
    assert again.state.trust == whole.state.trust


@pytest.mark.parametrize(
    "env", ["swing-up", "Pendulum-v1", "CartPole-v1", pytest.param("acrobot", marks=pytest.mark.slow)]
)
def test_equal_starts_give_equal_first_states_and_other_actions(env):
    environment = opening.open_environment(env)
    policy = Learner(env, seed=1).last_policy
    first, second = (
        rollout(environment, policy, key=jax.random.key(key), episodes=3, max_steps=5, starts=[7, 7, 8])
        for key in (1, 2)
    )
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.states[0], other.states[0])
    assert any(not np.array_equal(a.actions, b.actions) for a, b in zip(first, second, strict=True))
    np.testing.assert_array_equal(first[0].states[0], first[1].states[0])
    if env not in ("swing-up", "acrobot"):  # which always start alike
        assert not np.array_equal(first[0].states[0], first[2].states[0])
    with pytest.raises(ValueError, match="starts: expected 3, one for each episode, got 2"):
        rollout(environment, policy, key=jax.random.key(1), episodes=3, max_steps=5, starts=[7, 7])


def test_a_budget_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"^answers: expected .*, got 0$"):
        Learner("CartPole-v1", answers=0)


@pytest.mark.slow
def test_a_person_who_favours_a_side_is_found_out(tmp_path):
    """Answers by the side alone, in a run whose expert is no simulation: the side bias is inferred, and reported."""
    options = {"preset": "paper", "iterations": 9, "max_steps": 20, "evaluation_episodes": 2, "seed": 5}
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="other", **options)
    learner.run(lambda first, second: "first")
    figures = learner.estimate.hyperparameters()
    assert figures["side_bias lower"] > 0
    assert figures["side_bias"] == pytest.approx(float(learner.estimate.posterior["posterior"]["side_bias"].mean()))
    assert "side bias" in bayespbrl.load(tmp_path / "run").report("md").read_text()
    honest = Learner("gridworld", **(options | {"iterations": 1})).run(ReturnExpert())
    assert "side_bias" not in honest.estimate.hyperparameters()  # the simulated expert looks at the return alone
