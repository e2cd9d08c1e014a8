"""Posterior draws of returns of trajectories, their ranking, Q and the greedy action (steps 1 and 2).

The return of a trajectory is wᵀψ(τ). LSTD is linear in the utilities, so that one solution gives Q for every draw.

Results are in units of the utility, which the answers fix only up to a positive factor.
"""

from collections.abc import Sequence

import jax
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike
from scipy.stats import rankdata

from bayespbrl.diagnostics.axes import finished
from bayespbrl.diagnostics.estimates import expect_posterior
from bayespbrl.figures import spread
from bayespbrl.improvement.q_function import CriticData, estimate_q
from bayespbrl.learner import Learner
from bayespbrl.trajectories import Trajectory, transitions
from bayespbrl.utility import UtilityEstimate
from bayespbrl.utility.posterior_utility import spacing

# Quantiles and line widths of the intervals in the figures, which hold 50 % and 90 % of the draws.
INTERVALS = ((0.25, 0.75, 4.0), (0.05, 0.95, 1.2))


def return_draws(
    estimate: UtilityEstimate | None, trajectories: Sequence[Trajectory], *, number: int = 1000
) -> xr.Dataset:
    """Posterior draws of the utility wᵀψ(τ) of each trajectory.

    Args:
      estimate: one with a posterior.
      trajectories: n of them, of the run or of any other origin.
      number: cap on the draws, which are evenly spaced over the chains.

    Returns:
      `returns` (chain, draw, trajectory), with the attributes converged (0 or 1) and rhat_max of the fit.

    Raises:
      ValueError: an estimate without a posterior; no trajectories; a number < 1.
    """
    fit, posterior = expect_posterior(estimate)
    draws = fit.trajectory_draws(trajectories, number=number)
    chains = posterior["posterior"].sizes["chain"]
    return xr.Dataset(
        {"returns": (("chain", "draw", "trajectory"), draws.reshape(chains, -1, len(trajectories)))},
        {"trajectory": np.arange(len(trajectories))},
        _convergence(fit),
    )


def ranking_probabilities(returns: xr.Dataset) -> xr.Dataset:
    """Posterior probabilities of the order of n trajectories.

    Args:
      returns: what `return_draws` returned.

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


def q_draws(learner: Learner, states: ArrayLike, actions: ArrayLike, *, number: int = 200, seed: int = 0) -> xr.Dataset:
    """Posterior draws of Q(s, a) under the policy that the learner keeps, with its noise, for each state and action.

    LSTD-Q once, with the utility of each draw as a column, from all transitions of the learner. The state-action
    features are drawn as the learner draws them.

    Args:
      learner: after at least one iteration; `run.learner` for a run read from disk.
      states: n of them, shape (n, S), or (n,) where discrete.
      actions: m to choose from, shape (m, A), or (m,) where discrete.
      number: cap on the draws, which are evenly spaced over the chains.
      seed: of the state-action features and of fresh continuous actions.

    Returns:
      `q` (chain, draw, state, action), with the actions as a coordinate where they are numbers, and the attributes of
      `return_draws`.

    Raises:
      ValueError: a learner without an estimate that has a posterior; no states or no actions.
    """
    (fit, posterior), states, actions = expect_posterior(learner.estimate), np.asarray(states), np.asarray(actions)
    if states.ndim == 0 or actions.ndim == 0 or not (len(states) and len(actions)):
        raise ValueError(f"states, actions: expected at least one row each, got {states.shape} and {actions.shape}")
    steps = transitions(learner.trajectories)
    _, draws = fit.utilities_and_draws(steps.next_states, number=number, actions=steps.actions)
    q = estimate_q(
        learner.state.kept.policy,
        CriticData(steps, draws.T),
        key=jax.random.key(seed),
        action_space=learner.environment.action_space,
        features=learner.cycle.feature_source.of_steps(
            steps, learner.settings.features.of_critic, rng=np.random.default_rng(seed)
        ),
        critic=learner.settings.critic,
    )
    rows = q(np.repeat(states, len(actions), axis=0), np.concatenate([actions] * len(states)))
    shape = (posterior["posterior"].sizes["chain"], -1, len(states), len(actions))
    labels = actions.reshape(len(actions), -1)
    return xr.Dataset(
        {"q": (("chain", "draw", "state", "action"), rows.T.reshape(shape))},
        {"state": np.arange(len(states)), "action": labels[:, 0] if labels.shape[1] == 1 else np.arange(len(actions))},
        _convergence(fit),
    )


def greedy_probabilities(q: xr.Dataset) -> xr.Dataset:
    """Posterior probability that each action is greedy, state by state.

    Args:
      q: what `q_draws` returned.

    Returns:
      `greedy_probability` (state, action), the share of draws in which the action has the highest Q; equal actions
      share a draw; `greedy_of_mean` (state), the greedy action of the mean of Q; `expected_loss` (state), the mean over
      draws of the loss in Q of that action against the draw's best (the expected value of perfect information). The
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
    """Median, 50 % and 90 % intervals of each return relative to the mean over trajectories, the best on top.

    The answers leave open what trajectories of equal length have in common; its spread would be the prior's.
    """
    values = _pooled(returns["returns"])
    values = values - values.mean(axis=1, keepdims=True)
    order = np.argsort(np.median(values, axis=0), kind="stable")
    _intervals(values[:, order], np.arange(len(order)), axes)
    axes.set_yticks(np.arange(len(order)), [str(label) for label in returns["trajectory"].values[order]])
    axes.axvline(0.0, color="0.5", linestyle="--", linewidth=1)
    axes.set_title(_titled("Returns", returns))
    return finished(axes, whole=False, xlabel="return relative to the mean (units of the utility)", ylabel="trajectory")


def plot_ranking(ranking: xr.Dataset, axes: Axes) -> Axes:
    """Probability of each rank as a shade, by expected rank, with each trajectory's probability to be the best."""
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
    title = _titled("Ranking", ranking)
    return finished(axes, xlabel="rank", ylabel="trajectory (probability to be best)", title=title)


def plot_greedy(greedy: xr.Dataset, axes: Axes) -> Axes:
    """Probability that each action is the best, state by state, as a shade; dots: the greedy actions of the mean."""
    table = greedy["greedy_probability"].transpose("state", "action").values
    image = axes.imshow(table, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.figure.colorbar(image, ax=axes, label="probability to be the best action")
    actions = greedy["action"].values
    columns = [int(np.flatnonzero(actions == action)[0]) for action in greedy["greedy_of_mean"].values]
    axes.plot(columns, np.arange(len(columns)), "o", color="tab:orange", markersize=3)
    places = spread(len(actions), 9)
    axes.set_xticks(places, [f"{actions[place]:g}" for place in places])
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return finished(axes, whole=False, xlabel="action", ylabel="state", title=_titled("Best action", greedy))


def thinned(tree: xr.DataTree, number: int) -> xr.DataTree:
    """A posterior with about `number` draws, evenly spaced over the chains, and at least one a chain.

    Raises:
      ValueError: a number < 1.
    """
    sizes = tree.children["posterior"].sizes
    return tree.isel(draw=slice(None, None, spacing(sizes["chain"] * sizes["draw"], number)))


def _convergence(fit: UtilityEstimate) -> dict[str, float]:
    return {"converged": int(fit.quality.converged), "rhat_max": float(fit.quality.rhat_max)}


def _pooled(draws: xr.DataArray) -> np.ndarray:
    """Draws of all chains, (chain, draw, n), as rows (S, n)."""
    values = draws.transpose("chain", "draw", ...).values
    return values.reshape(-1, values.shape[2])


def _titled(title: str, result: xr.Dataset) -> str:
    return title if result.attrs.get("converged", 1) else f"{title} (the fit has not converged)"


def _intervals(values: np.ndarray, places: np.ndarray, axes: Axes) -> None:
    for low, high, width in INTERVALS:
        axes.hlines(places, *np.quantile(values, [low, high], axis=0), linewidth=width, color="tab:blue")
    axes.plot(np.median(values, axis=0), places, "o", color="white", markeredgecolor="tab:blue", markersize=5)
