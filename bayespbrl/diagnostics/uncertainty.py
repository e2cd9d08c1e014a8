"""The posterior over what matters: returns of trajectories, their ranking, Q and the greedy action (steps 1 and 2).

All of these are linear in the weights: the return of a trajectory is wᵀψ(τ), and because LSTD is linear in the
utilities, Q(s, a) = wᵀψ(s, a) with the successor features ψ(s, a), which one solution gives for every draw of w.

Results are in units of the utility, which answers fix up to a positive factor only.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from scipy.stats import rankdata

from bayespbrl.improvement.q_function import QFunction, estimate_q
from bayespbrl.learner import Learner
from bayespbrl.trajectories import Trajectory, transitions
from bayespbrl.utility.averaging import AveragedUtility
from bayespbrl.utility.posterior_utility import spacing

# Quantiles of the intervals in the figures: half and nine tenths of the draws.
INTERVALS = ((0.25, 0.75, 4.0), (0.05, 0.95, 1.2))


def return_draws(estimate: Any, trajectories: Sequence[Trajectory], *, number: int = 1000) -> xr.Dataset:
    """Posterior draws of the utility wᵀψ(τ) of each trajectory; an average's as one chain.

    Args:
      estimate: a `LinearUtility` with a posterior.
      trajectories: n of them, of the run or of any other origin.
      number: at most so many draws, evenly spaced over the chains.

    Returns:
      `returns` (chain, draw, trajectory), with the attributes converged (0 or 1) and rhat_max of the fit.

    Raises:
      ValueError: an estimate without a posterior; no trajectories; a number < 1.
    """
    draws = _with_posterior(estimate).trajectory_draws(trajectories, number=number)
    chains = 1 if isinstance(estimate, AveragedUtility) else estimate.posterior["posterior"].sizes["chain"]
    return xr.Dataset(
        {"returns": (("chain", "draw", "trajectory"), draws.reshape(chains, -1, len(trajectories)))},
        {"trajectory": np.arange(len(trajectories))},
        _honesty(estimate),
    )


def ranking_probabilities(returns: xr.Dataset) -> xr.Dataset:
    """What the posterior says about the order of n trajectories.

    Args:
      returns: what `return_draws` gave.

    Returns:
      `rank_probability` (trajectory, rank), rank 1 the best; `best_probability` (trajectory); `expected_rank`
      (trajectory); `better_probability` (trajectory, other), ½ on the diagonal. Equal returns share their ranks. The
      attributes are those of `returns`.
    """
    values = _pooled(returns["returns"])
    number = values.shape[1]
    highest = rankdata(-values, method="min", axis=1).astype(np.int64)
    lowest = rankdata(-values, method="max", axis=1).astype(np.int64)
    share = 1 / (lowest - highest + 1) / len(values)
    # each draw adds its share to ranks highest … lowest: the running sum of a step up and a step down
    steps = np.zeros((number, number + 1))
    which = np.broadcast_to(np.arange(number), values.shape)
    np.add.at(steps, (which, highest - 1), share)
    np.add.at(steps, (which, lowest), -share)
    ranks = np.clip(np.cumsum(steps, axis=1)[:, :number], 0.0, 1.0)
    better = np.array([np.mean((1 + np.sign(column[:, None] - values)) / 2, axis=0) for column in values.T])
    labels = returns["trajectory"].values
    return xr.Dataset(
        {
            "rank_probability": (("trajectory", "rank"), ranks),
            "best_probability": ("trajectory", ranks[:, 0]),
            "expected_rank": ("trajectory", np.mean((highest + lowest) / 2, axis=0)),
            "better_probability": (("trajectory", "other"), better),
        },
        {"trajectory": labels, "other": labels, "rank": np.arange(1, number + 1)},
        returns.attrs,
    )


def successor_features(learner: Learner, *, seed: int = 0) -> QFunction:
    """ψ(s, a): the discounted sum of φ that follows action a in s under the learner's policy, for Q(s, a) = wᵀψ(s, a).

    LSTD-Q with every feature of the next state as a utility of its own, from all transitions of the learner; the
    state-action features are drawn as the learner draws its own.

    Args:
      learner: after its first iteration at least; `run.learner` for a run read from disk.
      seed: of the state-action features and of fresh continuous actions.

    Returns:
      a `QFunction` whose value is (N, D) at N states and actions.

    Raises:
      ValueError: a learner without an estimate that has a posterior.

    Source: Dayan (1993), "Improving generalization for temporal difference learning: the successor representation".
    """
    features = _with_posterior(learner.estimate).features
    steps = transitions(learner.trajectories)
    return estimate_q(
        learner.policy,
        steps,
        features(steps.next_states),
        key=jax.random.key(seed),
        action_space=learner.environment.action_space,
        features=learner.state_action_features(steps, rng=np.random.default_rng(seed)),
        critic=learner.settings.critic,
    )


def q_draws(
    estimate: Any, successors: QFunction, states: np.ndarray, actions: np.ndarray, *, number: int = 1000
) -> xr.Dataset:
    """Posterior draws of Q(s, a) for each of some states and each of some actions.

    Args:
      estimate: a `LinearUtility` with a posterior, of the same features as `successors`.
      successors: what `successor_features` gave.
      states: n of them, shape (n, S), or (n,) where discrete.
      actions: m to choose from, shape (m, A), or (m,) where discrete.
      number: at most so many draws, evenly spaced over the chains.

    Returns:
      `q` (chain, draw, state, action), with the actions as a coordinate where they are numbers, and the attributes of
      `return_draws`. Of an `AveragedUtility` they are those of the one setting that was sampled, not of the average.

    Raises:
      ValueError: an estimate without a posterior; no states or no actions.
    """
    estimate, states, actions = _with_posterior(estimate), np.asarray(states), np.asarray(actions)
    if states.ndim == 0 or actions.ndim == 0 or not (len(states) and len(actions)):
        raise ValueError(f"states, actions: expected at least one row each, got {states.shape} and {actions.shape}")
    rows = successors(np.repeat(states, len(actions), axis=0), np.concatenate([actions] * len(states)))
    draws = estimate.draws(rows, number=number)
    labels = actions.reshape(len(actions), -1)
    return xr.Dataset(
        {"q": (("chain", "draw", "state", "action"), draws.reshape(*draws.shape[:2], len(states), len(actions)))},
        {
            "state": np.arange(len(states)),
            "action": labels[:, 0] if labels.shape[1] == 1 else np.arange(len(actions)),
        },
        _honesty(estimate),
    )


def greedy_probabilities(q: xr.Dataset) -> xr.Dataset:
    """What the posterior says about the best action in each state.

    Args:
      q: what `q_draws` gave.

    Returns:
      `greedy_probability` (state, action), the share of draws in which the action has the highest Q, equal ones
      sharing; `greedy_of_mean` (state), the action that is greedy to the mean of Q; `expected_loss` (state), the mean
      over draws of how much less Q that action has than the draw's own best: what certainty would be worth. The
      attributes are those of `q`.
    """
    values = q["q"]
    best = values == values.max("action")
    choice = values.mean(("chain", "draw")).argmax("action")
    return xr.Dataset(
        {
            "greedy_probability": (best / best.sum("action")).mean(("chain", "draw")),
            "greedy_of_mean": ("state", values["action"].values[choice.values]),
            "expected_loss": (values.max("action") - values.isel(action=choice)).mean(("chain", "draw")),
        },
        attrs=q.attrs,
    )


def plot_returns(returns: xr.Dataset, axes: Axes) -> Axes:
    """Median, half and nine tenths of the draws of each return less the draw's mean over them, the best on top.

    Answers say nothing about what trajectories of equal length have in common; the prior alone would set that spread.
    """
    values = _pooled(returns["returns"])
    values = values - values.mean(axis=1, keepdims=True)
    order = np.argsort(np.median(values, axis=0), kind="stable")
    _intervals(values[:, order], np.arange(len(order)), axes, horizontal=True)
    axes.set_yticks(np.arange(len(order)), [str(label) for label in returns["trajectory"].values[order]])
    axes.axvline(0.0, color="0.5", linestyle="--", linewidth=1)
    axes.set(
        xlabel="return less its mean (units of the utility)", ylabel="trajectory", title=_titled("Returns", returns)
    )
    return axes


def plot_ranking(ranking: xr.Dataset, axes: Axes) -> Axes:
    """Probability of each rank as a shade, trajectories by their expected rank, beside the probability to be best."""
    order = np.argsort(ranking["expected_rank"].values, kind="stable")
    number = len(order)
    table = ranking["rank_probability"].values[order]
    image = axes.imshow(table, cmap="Blues", vmin=0, aspect="auto", extent=(0.5, number + 0.5, number - 0.5, -0.5))
    axes.figure.colorbar(image, ax=axes, label="probability")
    labels = ranking["trajectory"].values[order]
    best = ranking["best_probability"].values[order]
    axes.set_yticks(
        np.arange(number), [f"{label} ({share:.0%})" for label, share in zip(labels, best, strict=True)], fontsize=8
    )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="rank", ylabel="trajectory (probability to be best)", title=_titled("Ranking", ranking))
    return axes


def plot_q(q: xr.Dataset, axes: Axes, *, state: int = 0) -> Axes:
    """Draws of Q(s, a) − the draw's mean over the actions: what they have in common does not matter to the choice.

    Args:
      q: what `q_draws` gave.
      axes: to draw on.
      state: the number of the state.

    Raises:
      ValueError: a state that there is not.
    """
    if not 0 <= state < q.sizes["state"]:
        raise ValueError(f"state: expected a number in 0 … {q.sizes['state'] - 1}, got {state}")
    values = _pooled(q["q"].isel(state=state))
    values = values - values.mean(axis=1, keepdims=True)
    actions = q["action"].values
    _intervals(values, actions, axes, horizontal=False)
    if not np.issubdtype(actions.dtype, np.floating):
        axes.set_xticks(actions)
    axes.axhline(0.0, color="0.5", linestyle="--", linewidth=1)
    label = "Q less its mean (units of the utility)"
    axes.set(xlabel="action", ylabel=label, title=_titled(f"Q in state {state}", q))
    return axes


def plot_greedy(greedy: xr.Dataset, axes: Axes) -> Axes:
    """Probability that each action is the best, state by state, as a shade; a dot where it is greedy to the mean."""
    table = greedy["greedy_probability"].transpose("state", "action").values
    image = axes.imshow(table, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.figure.colorbar(image, ax=axes, label="probability to be the best action")
    actions = greedy["action"].values
    columns = [int(np.flatnonzero(actions == action)[0]) for action in greedy["greedy_of_mean"].values]
    axes.plot(columns, np.arange(len(columns)), "o", color="tab:orange", markersize=3)
    places = np.unique(np.linspace(0, len(actions) - 1, min(len(actions), 9)).round().astype(int))
    axes.set_xticks(places, [f"{actions[place]:g}" for place in places])
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="action", ylabel="state", title=_titled("Best action", greedy))
    return axes


def thinned(estimate: Any, number: int) -> Any:
    """The estimate with at most `number` draws, evenly spaced over the chains, and at least one a chain.

    Raises:
      ValueError: an estimate without a posterior; a number < 1.
    """
    sizes = _with_posterior(estimate).posterior.children["posterior"].sizes
    apart = spacing(sizes["chain"] * sizes["draw"], number)
    return replace(estimate, posterior=estimate.posterior.isel(draw=slice(None, None, apart)))


def _with_posterior(estimate: Any) -> Any:
    if getattr(estimate, "posterior", None) is None:
        raise ValueError(f"estimate: expected one with a posterior, got {type(estimate).__name__} without")
    return estimate


def _honesty(estimate: Any) -> dict[str, Any]:
    return {"converged": int(estimate.quality.converged), "rhat_max": float(estimate.quality.rhat_max)}


def _pooled(draws: xr.DataArray) -> np.ndarray:
    """All chains' draws in one row each: (chain, draw, n) as (S, n)."""
    values = draws.transpose("chain", "draw", ...).values
    return values.reshape(-1, values.shape[2])


def _titled(title: str, result: xr.Dataset) -> str:
    return title if result.attrs.get("converged", 1) else f"{title} (the fit has not converged)"


def _intervals(values: np.ndarray, places: np.ndarray, axes: Axes, *, horizontal: bool) -> None:
    lines = axes.hlines if horizontal else axes.vlines
    for low, high, width in INTERVALS:
        lines(places, *np.quantile(values, [low, high], axis=0), linewidth=width, color="tab:blue")
    medians = np.median(values, axis=0)
    across = (medians, places) if horizontal else (places, medians)
    axes.plot(*across, "o", color="white", markeredgecolor="tab:blue", markersize=5)
