"""The dynamics against facts: one step by hand, energy, and the returns of reference policies."""

from dataclasses import dataclass
from math import atan, cos, pi, sin, sqrt, tan

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayespbrl import rollouts
from bayespbrl.envs import acrobot, bicycle, swing_up
from bayespbrl.envs.angles import wrapped


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Uniform:
    low: np.ndarray
    high: np.ndarray

    def sample(self, key, observation):
        return jax.random.uniform(key, self.low.shape, minval=self.low, maxval=self.high)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RandomSigns:
    size: np.ndarray

    def sample(self, key, observation):
        return self.size * jax.random.rademacher(key, self.size.shape)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Linear:
    gains: np.ndarray

    def sample(self, key, observation):
        return self.gains @ observation


def uniform(dynamics):
    return Uniform(dynamics.action_space.low, dynamics.action_space.high)


def evaluate(name, policy, episodes=2000, **options):
    return rollouts.returns(name, policy, key=jax.random.key(7), episodes=episodes, **options)


@pytest.mark.parametrize(("angle", "expected"), [(0.0, 0.0), (4.0, 4.0 - 2 * pi), (-3.5, 2 * pi - 3.5), (pi, -pi)])
def test_angles_are_wrapped_to_minus_pi_pi(angle, expected):
    assert float(wrapped(angle)) == pytest.approx(expected, abs=1e-12)


# Swing-up.


def test_swing_up_step_by_hand():
    angle, speed = 2.9, 1.7
    for _ in range(50):  # 1 ms each, velocity first
        speed += 0.001 * (58.86 * sin(angle) + 1.2 * 12.5 - 0.2 * speed)
        angle += 0.001 * speed
    np.testing.assert_allclose(swing_up.DYNAMICS.swing(jnp.array([2.9, 1.7]), 12.5), [angle, speed], rtol=1e-10)


def test_swing_up_constants_are_the_specified_ones():
    np.testing.assert_allclose([swing_up.WEIGHT, 1 / swing_up.INERTIA], [58.86, 1.2])


def test_swing_up_energy_changes_by_the_power_of_torque_and_friction_only():
    def energy(state):
        return 0.5 * swing_up.INERTIA * state[1] ** 2 + 10 * 9.81 * 0.5 * jnp.cos(state[0])

    for state, torque in (([0.7, -3.0], 0.0), ([2.2, 5.0], 11.0)):
        change = jnp.array([state[1], swing_up.DYNAMICS.acceleration(*state, torque)])
        power = state[1] * (torque - swing_up.INERTIA * 0.2 * state[1])
        assert float(jax.grad(energy)(jnp.array(state)) @ change) == pytest.approx(power)


def test_swing_up_keeps_its_energy_without_friction_and_torque(monkeypatch):
    monkeypatch.setattr(swing_up, "FRICTION", 0.0)
    state = jnp.array([1.0, 2.0])
    energies = []
    for _ in range(60):
        state = swing_up.DYNAMICS.swing(state, 0.0)
        energies.append(0.5 * float(state[1]) ** 2 + 58.86 * cos(float(state[0])))
    # a symplectic method's energy swings about the true one by O(step), here ½ % of the range, and does not drift
    np.testing.assert_allclose(energies, 0.5 * 4 + 58.86 * cos(1.0), atol=0.005 * 2 * 58.86)


def test_swing_up_noise_has_the_stated_spread_and_is_clipped_with_the_torque():
    keys = jax.random.split(jax.random.key(0), 20_000)
    state = jnp.array([pi, 0.0])  # the weight has no lever: θ̇′ ≈ 0.05 · 1.2 · torque, less a per cent

    def final_speed(torque):
        return np.asarray(jax.vmap(lambda key: swing_up.DYNAMICS.transition(state, jnp.array([torque]), key)[1])(keys))

    gain = float(swing_up.DYNAMICS.swing(state, 1.0)[1])
    assert np.std(final_speed(5.0)) == pytest.approx(4.47 * gain, rel=0.02)
    highest = float(swing_up.DYNAMICS.swing(state, 30.0)[1])
    assert final_speed(30.0).max() <= highest + 1e-9
    assert np.mean(final_speed(30.0) > highest - 1e-9) == pytest.approx(0.5, abs=0.02)


def test_swing_up_reward_is_taken_at_the_current_state_and_wrapped():
    reward = swing_up.DYNAMICS.reward(jnp.array([2 * pi - 0.5, 3.0]), None, jnp.array([1.0, 0.0]))
    assert float(reward) == pytest.approx(-10 * 0.25)


def test_swing_up_starts_hanging_give_or_take_a_fifth():
    starts = np.asarray(jax.vmap(swing_up.DYNAMICS.initial)(jax.random.split(jax.random.key(0), 2000)))
    from_hanging = np.mod(starts[:, 0], 2 * pi) - pi
    assert np.abs(from_hanging).max() <= 0.2
    assert np.std(from_hanging) == pytest.approx(0.2 / sqrt(3), rel=0.05)
    assert np.all(starts[:, 1] == 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "published", "tolerance"),
    [
        (Uniform(np.zeros(1), np.zeros(1)), -5500, 50),  # hanging still
        (uniform(swing_up.DYNAMICS), -4680, 100),
        (RandomSigns(np.array([30.0])), -3900, 60),  # bang-bang
    ],
)
def test_swing_up_reference_returns(policy, published, tolerance):
    assert evaluate("swing-up", policy).total.mean() == pytest.approx(published, abs=tolerance)


# Bicycle.


def test_bicycle_step_by_hand_with_radii_as_the_source_has_them():
    theta, theta_dot, omega, omega_dot, torque, displacement = -0.3, 0.8, 0.1, -0.4, 1.5, -0.03
    v, sigma = 10 / 3.6, 10 / 3.6 / 0.34
    front, back = 1.11 / abs(sin(theta)), 1.11 / abs(tan(theta))
    centre = sqrt((1.11 - 0.66) ** 2 + 1.11**2 / tan(theta) ** 2)
    phi = omega + atan(displacement / 0.94)
    inertia = 13 / 3 * 15 * 0.94**2 + 60 * 1.24**2
    disc, disc_v, disc_l = 1.7 * 0.34**2, 1.5 * 1.7 * 0.34**2, 0.5 * 1.7 * 0.34**2
    outward = -1 * v**2 * (1.7 * 0.34 * (1 / front + 1 / back) + 75 * 0.94 / centre)
    lean_acceleration = (0.94 * 75 * 9.82 * sin(phi) - cos(phi) * (disc * sigma * theta_dot + outward)) / inertia
    steering_acceleration = (torque - disc_v * sigma * omega_dot) / disc_l
    omega_dot_next = omega_dot + 0.01 * lean_acceleration
    theta_dot_next = theta_dot + 0.01 * steering_acceleration
    expected = [theta + 0.01 * theta_dot_next, theta_dot_next, omega + 0.01 * omega_dot_next, omega_dot_next]
    state = jnp.array([theta, theta_dot, omega, omega_dot])
    np.testing.assert_allclose(bicycle.DYNAMICS.ride(state, torque, displacement), expected, rtol=1e-12)


def test_bicycle_rides_on_unmoved_when_straight_and_upright():
    np.testing.assert_array_equal(bicycle.DYNAMICS.ride(jnp.zeros(4), 0.0, 0.0), np.zeros(4))


def test_bicycle_is_symmetric_between_left_and_right():
    state = jnp.array([0.2, -1.0, 0.05, 0.3])
    mirrored = bicycle.DYNAMICS.ride(-state, -1.0, -0.01)
    np.testing.assert_allclose(mirrored, -bicycle.DYNAMICS.ride(state, 1.0, 0.01), rtol=1e-12)


def test_bicycle_handlebar_stops_at_eighty_degrees():
    assert float(bicycle.DYNAMICS.ride(jnp.array([1.39, 5.0, 0.0, 0.0]), 2.0, 0.0)[0]) == pytest.approx(np.deg2rad(80))


def test_bicycle_reward_and_fall_at_twelve_degrees():
    upright, fallen = jnp.array([0.3, 0.0, pi / 30, 0.0]), jnp.array([0.3, 0.0, -pi / 14, 0.0])
    assert float(bicycle.DYNAMICS.reward(fallen, None, upright)) == pytest.approx(-0.25)
    assert float(bicycle.DYNAMICS.reward(upright, None, fallen)) == pytest.approx(-((15 / 14) ** 2) - 100)
    assert bool(bicycle.DYNAMICS.terminal(fallen))
    assert not bool(bicycle.DYNAMICS.terminal(upright))


@pytest.mark.slow
def test_bicycle_noise_is_on_the_displacement_only_and_actions_are_clipped():
    keys = jax.random.split(jax.random.key(0), 500)
    state = jnp.array([0.1, 0.2, 0.03, -0.1])
    after = np.asarray(jax.vmap(lambda key: bicycle.DYNAMICS.transition(state, jnp.array([9.0, 1.0]), key))(keys))
    lowest, highest = (float(bicycle.DYNAMICS.ride(state, 2.0, d)[3]) for d in (0.0, 0.04))
    np.testing.assert_allclose(after[:, 1], bicycle.DYNAMICS.ride(state, 2.0, 0.0)[1], rtol=1e-12)
    assert lowest <= after[:, 3].min() < after[:, 3].max() <= highest


@pytest.mark.slow
def test_bicycle_random_policy_falls_in_a_third_of_the_episodes():
    result = evaluate("bicycle", uniform(bicycle.DYNAMICS), episodes=10_000)
    assert result.total.mean() == pytest.approx(-40, abs=3)
    assert np.mean(~result.terminated) == pytest.approx(0.67, abs=0.02)


# Steer into the fall, and lean against it: torque and displacement per (θ, θ̇, ω, ω̇), found by a search over gains.
STEER_INTO_THE_FALL = np.array([[-900.0, -230.0, 19_000.0, 4450.0], [100.0, -23.0, -1000.0, -150.0]])


@pytest.mark.slow
def test_bicycle_linear_law_survives_fifty_steps():
    result = evaluate("bicycle", Linear(STEER_INTO_THE_FALL), episodes=10_000)
    assert result.total.mean() > -5
    assert np.mean(~result.terminated) > 0.99


@pytest.mark.slow
def test_bicycle_balancing_time_is_measured_beyond_fifty_steps():
    result = evaluate("bicycle", Linear(STEER_INTO_THE_FALL), episodes=200, max_steps=3000)
    assert result.steps.max() == 3000
    np.testing.assert_array_equal(result.terminated, result.steps < 3000)
    random = evaluate("bicycle", uniform(bicycle.DYNAMICS), episodes=200, max_steps=3000)
    assert random.terminated.all()
    assert result.steps.mean() > 3 * random.steps.mean()


# Acrobot.


def acrobot_energy(state):
    first, second, speed_1, speed_2 = state
    both = first + second
    # velocities of the centres of mass, l_c = ½
    velocity_1 = 0.25 * speed_1**2
    along = jnp.cos(first) * speed_1 + 0.5 * jnp.cos(both) * (speed_1 + speed_2)
    across = jnp.sin(first) * speed_1 + 0.5 * jnp.sin(both) * (speed_1 + speed_2)
    kinetic = 0.5 * (velocity_1 + along**2 + across**2 + speed_1**2 + (speed_1 + speed_2) ** 2)
    return kinetic + 9.8 * (-0.5 * jnp.cos(first) - jnp.cos(first) - 0.5 * jnp.cos(both))


@pytest.mark.parametrize("torque", [0.0, 0.8])
def test_acrobot_energy_changes_by_the_power_of_the_elbow_only(torque):
    for state in ([0.4, -0.9, 1.3, -2.1], [-2.0, 2.5, -3.0, 4.0]):
        state = jnp.array(state)
        change = jnp.concatenate([state[2:], acrobot.DYNAMICS.accelerations(state, torque)])
        assert float(jax.grad(acrobot_energy)(state) @ change) == pytest.approx(torque * float(state[3]), abs=1e-10)


def test_acrobot_step_by_hand():
    a1, a2, w1, w2, u = 0.4, -0.9, 1.3, -2.1, 0.7
    for _ in range(4):
        d1 = 0.25 + (1 + 0.25 + cos(a2)) + 2
        d2 = 0.25 + 0.5 * cos(a2) + 1
        phi2 = 0.5 * 9.8 * cos(a1 + a2 - pi / 2)
        phi1 = -0.5 * w2**2 * sin(a2) - w1 * w2 * sin(a2) + 1.5 * 9.8 * cos(a1 - pi / 2) + phi2
        second = (u + d2 / d1 * phi1 - 0.5 * w1**2 * sin(a2) - phi2) / (0.25 + 1 - d2**2 / d1)
        first = -(d2 * second + phi1) / d1
        w1, w2 = w1 + 0.05 * first, w2 + 0.05 * second
        a1, a2 = a1 + 0.05 * w1, a2 + 0.05 * w2
    result = acrobot.DYNAMICS.swing(jnp.array([0.4, -0.9, 1.3, -2.1]), 0.7)
    np.testing.assert_allclose(result, [a1, a2, w1, w2], rtol=1e-10)


def test_acrobot_speeds_are_limited():
    result = acrobot.DYNAMICS.swing(jnp.array([1.0, 2.0, 50.0, -100.0]), 0.0)
    assert abs(float(result[2])) <= 4 * pi
    assert abs(float(result[3])) <= 9 * pi


def test_acrobot_goal_is_a_tip_one_metre_above_the_bar():
    assert not bool(acrobot.DYNAMICS.terminal(jnp.zeros(4)))
    assert bool(acrobot.DYNAMICS.terminal(jnp.array([pi, 0.0, 0.0, 0.0])))
    angle = 2 * pi / 3  # straight: −2 cos θ₁ = 1
    assert not bool(acrobot.DYNAMICS.terminal(jnp.array([angle - 0.01, 0.0, 0.0, 0.0])))
    assert bool(acrobot.DYNAMICS.terminal(jnp.array([angle + 0.01, 0.0, 0.0, 0.0])))


@pytest.mark.slow
def test_acrobot_torque_is_clipped_before_the_noise():
    keys = jax.random.split(jax.random.key(0), 500)
    step = jax.vmap(lambda key: acrobot.DYNAMICS.transition(jnp.zeros(4), jnp.array([7.0]), key))
    speeds = np.asarray(step(keys))[:, 3]
    lowest, highest = (float(acrobot.DYNAMICS.swing(jnp.zeros(4), torque)[3]) for torque in (0.8, 1.2))
    assert lowest <= speeds.min() < speeds.max() <= highest
    assert speeds.max() - speeds.min() > 0.9 * (highest - lowest)


@pytest.mark.slow
def test_acrobot_pumping_the_elbow_reaches_the_goal_and_its_return_is_minus_the_steps():
    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Pump:
        size: np.ndarray

        def sample(self, key, observation):
            return self.size * jnp.sign(observation[3:])

    result = evaluate("acrobot", Pump(np.ones(1)), episodes=100)
    np.testing.assert_array_equal(result.total, -result.steps)
    assert np.median(result.steps) < 150
    assert np.mean(result.terminated) > 0.7


@pytest.mark.slow
def test_acrobot_random_policy_never_reaches_the_goal():
    assert evaluate("acrobot", uniform(acrobot.DYNAMICS), episodes=100).total.mean() < -495
