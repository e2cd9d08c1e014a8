"""Any gymnasium environment, made ready for the learner: opened by name, its spaces checked and flattened."""

from collections.abc import Iterator
from copy import deepcopy
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Box, Discrete, Space
from gymnasium.wrappers import (
    HumanRendering,
    OrderEnforcing,
    PassiveEnvChecker,
    RecordEpisodeStatistics,
    RecordVideo,
    RenderCollection,
    TimeLimit,
    TransformAction,
    TransformObservation,
)

from bayespbrl import checks
from bayespbrl.envs import SHORT_NAMES
from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.envs.names import parsed, spec_named
from bayespbrl.envs.spaces import bounded, from_plain, plain_space, to_plain

# Attributes of dynamics that are about their own observations.
OF_OBSERVATIONS = ("observation_period", "observation_names", "draw", "draw_trajectory", "pose", "grid_shape")
OF_MAKE = (TimeLimit, OrderEnforcing, PassiveEnvChecker)
ONLY_LOOKING = (*OF_MAKE, RecordEpisodeStatistics, RecordVideo, RenderCollection, HumanRendering)  # change nothing seen
STEPS_COMPARED = 10
MOST_NUMBERS = 1000  # of an observation: radial functions of it take 1 MB a number, and thrice that with more centres
AnyEnvironment = str | EnvSpec | gymnasium.Env | FuncEnv

# Attributes of an environment object, which its copies have too: the spec from which we made it, so that it can be made
# again, N at a time, and what `flattened` wrapped.
_MADE_FROM, _GIVEN = "_bayespbrl_made_from", "_bayespbrl_given"


def open_environment(environment: AnyEnvironment) -> gymnasium.Env:
    """The environment behind a short name, a gymnasium id or spec, an environment object or pure functions.

    The result has 1-D `Box` spaces or `Discrete` spaces counted from 0, so that policies and features meet nothing
    else. Decision: other shapes are flattened and other starts shifted, by wrappers that undo it on the way in.
    Observations of several parts (`Dict`, `Tuple`, `MultiDiscrete`, …) become numbers, discrete parts one-hot, as
    gymnasium flattens them. Opening what is already open gives the same object back.

    Raises:
      ValueError: unknown name; an environment that cannot be made; an action space that is neither a real `Box` nor
        `Discrete`, or an observation space that gymnasium does not flatten, or to more than 1000 numbers.
    """
    if isinstance(environment, str | EnvSpec):
        spec = _spec(environment)
        opened = flattened(_make(spec))
        vars(opened)[_MADE_FROM] = spec
        return opened
    if isinstance(environment, FuncEnv) and type(environment).__hash__ is None:
        raise ValueError(
            f"environment {type(environment).__name__}: expected a class with a hash, got one that compares by value; "
            "@dataclass(eq=False) does not"
        )
    if isinstance(environment, FuncEnv):
        return flattened(FunctionalEnv(environment))
    if isinstance(environment, gymnasium.Env):
        return flattened(environment)
    raise ValueError(
        f"environment: expected a short name ({', '.join(SHORT_NAMES)}), a gymnasium id or spec, a gymnasium.Env or a "
        f"FuncEnv, got {type(environment).__name__}"
    )


def made_from(env: gymnasium.Env) -> EnvSpec | None:
    """The spec from which `open_environment` made `env`; None for a user's object, of which there is only one."""
    return vars(env).get(_MADE_FROM)  # not getattr: a wrapper of the user's passes on what it wraps


def environment_name(env: gymnasium.Env) -> str:
    """What to call the environment in a message: its id, else its class."""
    if env.spec is not None:
        return env.spec.id
    inner = env.unwrapped
    return type(inner.dynamics if isinstance(inner, FunctionalEnv) else inner).__name__


def reopened(environment: object) -> str:
    """How the name alone opens the same environment again, by a value of the setting `environment`.

    `named`: by its name, or pure functions, which run alike. `object`: made by gymnasium from its name; an object is
    stepped alone, where many copies of a name are stepped side by side. `other`: not at all, since it was made with
    other arguments, changed since, wrapped, or never registered.
    """
    if isinstance(environment, str):
        return "named"
    if not isinstance(environment, gymnasium.Env):
        return "named" if given_by_name(environment) else "other"
    given = as_given(environment)
    if not given_by_name(given) or _changed(given):
        return "other"
    return "object" if made_from(environment) is None and pure_functions(flattened(environment)) is None else "named"


def made_again(name: str) -> gymnasium.Env:
    """The object that gymnasium makes of a name, as for a run that was started with one; `ValueError` if it cannot."""
    return _make(_spec(name))


def given_by_name(environment: object) -> bool:
    """Whether an environment or spec is what gymnasium makes of its name, as far as its arguments tell."""
    spec = _spec_of(environment)
    if spec is None or (registered := gymnasium.registry.get(spec.id)) is None:
        return False
    named = [
        _keywords(one) | {"max_episode_steps": one.max_episode_steps, "additional_wrappers": one.additional_wrappers}
        for one in (spec, registered)
    ]
    return named[0].keys() == named[1].keys() and all(_same(named[0][name], named[1][name]) for name in named[0])


def keywords_of(environment: gymnasium.Env) -> str | None:
    """The plain arguments that gymnasium made an environment with, in words that differ where these do.

    None for an object that gymnasium did not make.
    """
    spec = environment.spec
    if spec is None:
        return None
    plain = sorted((name, value) for name, value in _keywords(spec).items() if isinstance(value, int | float | str))
    return ", ".join(f"{name}={_plain_in_words(value)}" for name, value in plain) or "none"


def _keywords(spec: EnvSpec) -> dict[str, Any]:
    """The arguments of a spec that decide what the environment does."""
    return {name: value for name, value in spec.kwargs.items() if name != "render_mode"}


def _plain_in_words(value: Any) -> str:
    """The same for 3, 3.0 and NumPy's 3.0, but for whole numbers that no float is."""
    if isinstance(value, float) or (type(value) is int and abs(value) <= 2**53):
        value = float(value)
    return repr(value)


def _changed(environment: gymnasium.Env) -> bool:
    """Whether an environment, as a Pendulum with another `g`, is no longer what gymnasium made of its name.

    Compared are attributes after a reset with the same seed, and what a few steps return; of one that does not return
    twice the same, the attributes alone. What cannot reset or step says so when it is used. One that cannot be made
    again, such as a robot, has to be given again too.
    """
    spec = environment.spec
    assert spec is not None
    try:
        again = _make(gymnasium.spec(spec.id))
    except ValueError:
        return True
    try:
        mine, made = (_first_steps(one, again.action_space) for one in (environment, again))
        for one in (environment, again):
            one.reset(seed=0)
        ours, theirs = vars(environment.unwrapped), vars(again.unwrapped)
        if not all(_alike(ours[name], theirs[name]) for name in ours.keys() & theirs.keys() - {"render_mode"}):
            return True
        return not _alike(mine, made) and _alike(made, _first_steps(again, again.action_space))
    except Exception:  # whatever an environment of the user's raises
        return False
    finally:
        again.close()


def _first_steps(env: gymnasium.Env, actions: Space[Any]) -> list[Any]:
    """What a reset and a few steps return without their infos, always by the same actions."""
    actions.seed(0)
    seen: list[Any] = [deepcopy(env.reset(seed=0)[0])]
    for _ in range(STEPS_COMPARED):
        observation, *rest, _ = env.step(actions.sample())
        seen.append(deepcopy((observation, *rest)))
        if rest[1] or rest[2]:  # terminated or truncated
            break
    return seen


def _alike(mine: Any, made: Any, depth: int = 5) -> bool:
    """Whether two values are equal, as far as they are plain ones, or consist of such."""
    if isinstance(mine, dict) and isinstance(made, dict):
        return mine.keys() == made.keys() and (not depth or all(_alike(mine[k], made[k], depth - 1) for k in mine))
    if isinstance(mine, list | tuple) and isinstance(made, list | tuple):
        return len(mine) == len(made) and (not depth or all(map(_alike, mine, made, [depth - 1] * len(mine))))
    plain = (bool, int, float, str, np.ndarray, np.generic)
    return not (isinstance(mine, plain) and isinstance(made, plain)) or _same(mine, made)


def identity(environment: object) -> str | None:
    """gymnasium's id of an environment or of its name, with the arguments that the name has.

    None where the name alone does not open the same one again.
    """
    if isinstance(environment, str):
        name = parsed(environment)
        return ",".join([name.id, *(f"{argument}={value!r}" for argument, value in sorted(name.arguments.items()))])
    given = as_given(environment) if isinstance(environment, gymnasium.Env) else environment
    spec = _spec_of(given)
    return spec.id if spec is not None and given_by_name(given) else None


def _spec_of(environment: object) -> EnvSpec | None:
    """The spec of an environment, or the spec that it is; None without one."""
    return environment if isinstance(environment, EnvSpec) else getattr(environment, "spec", None)


def _same(first: Any, second: Any) -> bool:
    """Whether two arguments are equal, arrays too; False where they cannot be compared."""
    try:
        if isinstance(first, np.ndarray):
            return bool(np.array_equal(first, second, equal_nan=first.dtype.kind in "fc"))
        return bool(first == second or (first != first and second != second))
    except (TypeError, ValueError):
        return False


def environment_attribute(env: gymnasium.Env, name: str) -> Any:
    """An attribute that the environment's dynamics have beyond gymnasium's, as `optimal_return`; None without it.

    None too where it is about the observations, and a wrapper gives others.
    """
    if name in OF_OBSERVATIONS and observed_otherwise(env):
        return None
    return getattr(getattr(env.unwrapped, "dynamics", None), name, None)


def observed_otherwise(env: gymnasium.Env) -> bool:
    """Whether a wrapper gives other observations than the environment itself."""
    given, inner = as_given(env), env.unwrapped
    *wrappers, _ = layers(given)
    changed = not all(type(layer) in ONLY_LOOKING or _passes_observations(layer) for layer in wrappers)
    one_hot = isinstance(inner.observation_space, Discrete) and not isinstance(env.observation_space, Discrete)
    return changed or one_hot or given.observation_space != inner.observation_space


def _passes_observations(wrapper: gymnasium.Env) -> bool:
    """Whether a wrapper's steps and resets are those of gymnasium that leave observations alone, not its own."""
    kinds = (gymnasium.Wrapper, gymnasium.ActionWrapper, gymnasium.RewardWrapper)
    return all(getattr(type(wrapper), name) in {getattr(kind, name) for kind in kinds} for name in ("reset", "step"))


def plainly_wrapped(env: gymnasium.Env) -> bool:
    """Whether all wrappers are those of `gymnasium.make`, which leave observations, actions and rewards alone."""
    *wrappers, _ = layers(env)
    return all(type(layer) in OF_MAKE for layer in wrappers)


def pure_functions(env: gymnasium.Env) -> FuncEnv | None:
    """All that an opened environment is; None where a wrapper or subclass, such as a user's, may change them."""
    inner = env.unwrapped
    if not (isinstance(inner, FunctionalEnv) and inner.is_its_dynamics and plainly_wrapped(env)):
        return None
    return inner.dynamics


def layers(env: gymnasium.Env) -> Iterator[gymnasium.Env]:
    """The environment with its wrappers, the outermost first."""
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = env.env
    yield env


def _spec(environment: str | EnvSpec) -> EnvSpec:
    return environment if isinstance(environment, EnvSpec) else spec_named(environment)


def _make(spec: EnvSpec) -> gymnasium.Env:
    try:
        return gymnasium.make(spec)
    except Exception as error:
        raise ValueError(
            f"environment {spec.id}: expected one that gymnasium.make can make, got {checks.one_line(error)}"
        ) from error


def flattened(env: gymnasium.Env) -> gymnasium.Env:
    """`env` with 1-D `Box` spaces and `Discrete` spaces counted from 0; `env` itself where it has them already."""
    for name in ("observation_space", "action_space"):
        if not isinstance(space := getattr(env, name, None), Space):
            raise ValueError(f"environment {environment_name(env)}: expected a space as its {name}, got {space!r}")
    given, observations, actions = env, env.observation_space, env.action_space
    if not observations.is_np_flattenable:
        raise ValueError(
            f"environment {environment_name(env)}: expected an observation space of fixed size, got {observations}"
        )
    if not (isinstance(actions, Discrete) or (isinstance(actions, Box) and np.issubdtype(actions.dtype, np.floating))):
        raise ValueError(
            f"environment {environment_name(env)}: expected a Discrete or real Box action space, got {actions}"
        )
    plain = plain_space(observations, actions)
    if isinstance(plain, Box) and plain.shape[0] > MOST_NUMBERS:
        raise ValueError(
            f"environment {environment_name(env)}: expected observations of at most {MOST_NUMBERS} numbers, got "
            f"{plain.shape[0]}; wrap it so that it observes less, for example positions in place of a picture"
        )
    if plain is not observations:
        env = TransformObservation(env, partial(to_plain, observations, actions=actions), plain)
    if (plain := bounded(plain_space(actions))) is not actions:
        env = TransformAction(env, partial(from_plain, actions), plain)
    if env is not given:
        vars(env)[_GIVEN] = given
    return env


def as_given(env: gymnasium.Env) -> gymnasium.Env:
    """The user's environment that `flattened` wrapped, with its own spaces; `env` itself where it wrapped nothing."""
    given: gymnasium.Env = vars(env).get(_GIVEN, env)
    return given
