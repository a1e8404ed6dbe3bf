"""What the policy is told: sight, joint noise, faulty taxels, history; and what stays true."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tactilerl import envs
from tactilerl.envs import objects, observations, scenes
from tactilerl.envs.observations import Broken, Delay, FalseReadings

import states


def make(hand="shadow", simulator="mujoco", **choices):
    return envs.make(hand, **{"simulator": simulator, "task": "reach-goal", **choices})


def episode(env, seed=3, n=8):
    """(observations by name, achieved goals, rewards) of a seeded episode of closing the hand."""
    told, rewards, _ = states.closing(env, seed, n)
    assert env.observation_space.contains(told[-1])
    seen, achieved = (np.array([obs[key] for obs in told]) for key in ("observation", "achieved_goal"))
    return dict(zip(env.observation_names(), seen.T, strict=True)), achieved, np.array(rewards)


@cache
def plain_episode(n=8):
    return episode(make(), n=n)


def entries(told, start):
    return np.array([values for name, values in told.items() if name.startswith(start)]).T


@pytest.mark.parametrize(
    "choices",
    [
        {"object_seen": "hidden"},
        {"object_seen": "start"},
        {"object_seen": "noisy"},
        {"object_seen": "noisy", "sight_noise": (0.02, 1.3), "sight_noise_kind": "held"},
        {"joint_noise": 0.1},
        {"taxel_false_on": 0.2, "taxel_false_off": 0.3, "taxel_dead": 0.1, "taxel_stuck": 0.1},
        {"taxel_delay": 2, "history": 3},
    ],
    ids=str,
)
def test_only_what_is_told_changes_and_a_seed_repeats_it(choices):
    plain, told, again = plain_episode(), episode(make(**choices)), episode(make(**choices))
    np.testing.assert_array_equal(plain[1], told[1])  # achieved goals and rewards keep the truth
    np.testing.assert_array_equal(plain[2], told[2])
    changed = {name for name in plain[0] if not np.array_equal(plain[0][name], told[0][name])}
    joints = ("position of ", "velocity of ")
    concerns = {"object_seen": "object ", "joint_noise": joints, "taxel": "taxel "}
    concern = next(what for key, what in concerns.items() if next(iter(choices)).startswith(key))
    assert changed
    assert all(name.startswith(concern) for name in changed)
    for name, values in told[0].items():
        np.testing.assert_array_equal(values, again[0][name])


class TestSight:
    def test_hidden_is_zero_and_start_is_the_start(self):
        plain, _, _ = plain_episode()
        hidden, _, _ = episode(make(object_seen="hidden"))
        start, _, _ = episode(make(object_seen="start"))
        assert list(hidden) == list(plain)
        assert not entries(hidden, "object ").any()
        pose = entries(plain, "object ")
        assert np.ptp(pose, axis=0).max() > 1e-4
        np.testing.assert_array_equal(entries(start, "object "), np.tile(pose[0], (len(pose), 1)))

    @pytest.mark.parametrize("kind", ["white", "held"])
    def test_noise_has_the_size_that_was_asked_for(self, kind):
        box = objects.make("box", (0.05,))
        choices = dict(object_seen="noisy", sight_noise=(0.02, 0.3), sight_noise_kind=kind)
        noisy = observations.Sight(observations.SensorConfig(**choices), box)
        turn = Rotation.from_rotvec([0.4, -0.2, 1.0])
        place, orientation = np.array([1.0, 2.0, 3.0]), turn.as_quat(scalar_first=True)
        thing = states.scene(shape=box, object_position=place, object_orientation=orientation)
        offsets, angles = [], []
        for number in range(300):
            noisy.reset(np.random.default_rng(number))
            seen = [noisy(thing) for _ in range(3)]
            offsets.append([s.object_position - place for s in seen])
            quaternions = [s.object_orientation for s in seen]
            turned = [Rotation.from_quat(q, scalar_first=True) * turn.inv() for q in quaternions]
            angles.append([t.as_rotvec() for t in turned])
        for errors, size in ((np.array(offsets), 0.02), (np.array(angles), 0.3)):
            assert errors.std() == pytest.approx(size, rel=0.1)
            assert abs(errors.mean()) < 0.2 * size
            assert (np.ptp(errors, axis=1).max() < 1e-9) == (kind == "held")


class TestJoints:
    def errors(self, start, **choices):
        plain, _, _ = plain_episode(15)
        noisy, _, _ = episode(make(**choices), n=15)
        return entries(noisy, start) - entries(plain, start)

    def test_noise_is_on_the_angles_and_velocities_err_as_their_differences(self):
        starts = "position of ", "velocity of "
        angle, speed = (self.errors(start, joint_noise=0.1) for start in starts)
        assert not angle[:, :3].any()  # of the slides
        assert angle[:, 3:].std() == pytest.approx(0.1, rel=0.15)
        np.testing.assert_allclose(speed[1:], np.diff(angle, axis=0) / 0.2, atol=1e-5)
        assert not speed[0].any()

    def test_held_errors_stay_for_an_episode_and_do_not_show_in_velocities(self):
        error = self.errors("position of ", joint_noise_held=0.1)
        assert not error[:, :3].any()
        assert error[0, 3:].std() == pytest.approx(0.1, rel=0.5)
        np.testing.assert_allclose(error, np.tile(error[0], (len(error), 1)), atol=1e-6)
        assert not self.errors("velocity of ", joint_noise_held=0.1).any()

    def test_the_hand_is_felt_where_its_slides_are_felt(self):
        choices = {"hand": "mpl", "slide_noise": 0.001, "slide_noise_held": 0.002}
        seen, true = (entries(episode(make(**c), n=15)[0], "hand ") for c in (choices, {"hand": "mpl"}))
        error = seen - true
        assert 5e-4 < error.std(axis=0).min() < error.std(axis=0).max() < 1.6e-3
        assert np.abs(error.mean(axis=0)).max() > 8e-4  # what is held: the others' mean is below


class TestTaxels:
    bits = np.random.default_rng(0).integers(0, 2, 40_000).astype(float)

    def test_false_readings_come_as_often_as_asked_for(self):
        stage = FalseReadings(0.1, 0.3)
        stage.reset(np.random.default_rng(1))
        read = stage(self.bits)
        assert set(read) == {0.0, 1.0}
        assert read[self.bits == 0].mean() == pytest.approx(0.1, abs=0.01)
        assert read[self.bits == 1].mean() == pytest.approx(0.7, abs=0.01)

    def test_broken_ones_are_the_hands_and_a_larger_share_has_the_smaller(self):
        few, many, other = Broken(79, 0.1, 0.1, 5), Broken(79, 0.4, 0.3, 5), Broken(79, 0.1, 0.1, 6)
        assert [few.dead.sum(), few.stuck.sum()] == [8, 8]
        assert (many.dead >= few.dead).all()
        assert (many.stuck >= few.stuck).all()
        assert not (many.dead & many.stuck).any()
        assert (few.dead != other.dead).any()
        read = few(np.ones(79))
        assert read.sum() == 71
        assert few(np.zeros(79)).sum() == 8
        assert Broken(79, 1.0, 0.0, 0).dead.all()

    def test_late_by_whole_control_steps_and_as_at_the_start_before(self):
        stage = Delay(2)
        for _ in range(2):  # the second episode knows nothing of the first
            stage.reset(np.random.default_rng(0))
            assert [stage(np.array([i]))[0] for i in range(5)] == [0, 0, 0, 1, 2]


class TestHistory:
    def test_side_by_side_newest_first_taxels_last(self):
        plain, _, _ = plain_episode()
        told, _, _ = episode(make(history=3))
        names = [name for name in plain if not name.startswith("taxel")]
        assert list(told)[: len(names)] == names
        assert all(name.startswith("taxel ") for name in list(told)[3 * len(names) :])
        assert len(told) == 3 * len(plain)
        for name, values in plain.items():
            np.testing.assert_array_equal(told[name], values)
            for age in (1, 2):
                past = np.concatenate([np.repeat(values[0], age), values[:-age]])
                np.testing.assert_array_equal(told[f"{name} (t-{age})"], past)


@pytest.mark.parametrize("scene", scenes.names())
def test_nothing_tells_what_a_scene_hides(scene):
    """Of objects that differ in all that a scene may hide, observations first differ in what is seen
    alone, then in touch and joints too. No policy here is shown the achieved goal: it is the truth."""
    env = envs.make(scene=scene)
    is_hidden = env.config.object_seen == "hidden"
    first = objects.make("sphere" if is_hidden else "box", (0.04,))
    things = (first, 300.0, 0.6), (objects.make("box", (0.05,)), 900.0, 1.2)
    sight = () if is_hidden else ("object x", "object y", "object z", "object quaternion")
    felt = "taxel", "position of", "velocity of", "hand"
    episodes = []
    for thing in things:
        env._items.draw = lambda rng, thing=thing: objects.Item(*thing)
        obs = [env.reset(seed=1)[0]]
        obs += [env.step(np.zeros(env.action_space.shape))[0] for _ in range(3)]
        episodes.append(obs)
    names = env.observation_names()
    for step, (one, other) in enumerate(zip(*episodes, strict=True)):
        for key in one.keys() - {"achieved_goal"}:
            differs = np.flatnonzero(one[key] != other[key])
            told = [names[i] for i in differs] if key == "observation" else [key] * len(differs)
            allowed = sight + felt * (step > 0)
            assert [name for name in told if not name.startswith(allowed or "?")] == []


@pytest.mark.parametrize(("simulator", "seen"), [("mujoco", "noisy"), ("pybullet", "exact")])
def test_quaternions_have_one_sign(simulator, seen):
    env = envs.make("shadow", simulator=simulator, object_seen=seen)
    entries, told = env.observation_entries("object_orientation"), []
    obs, _ = env.reset(seed=0)
    for turn in np.linspace(0.1, 4 * np.pi, 13):
        env.simulator.reset(env.hand.start_positions(), np.array([0.0, 0.0, 1.0]), turn)
        env.state = env.simulator.state()
        obs, *_ = env.step(np.zeros(env.action_space.shape))
        told.append(obs["observation"][entries])
    assert np.abs(np.array(told)[:, 3]).max() > 0.9
    assert np.array(told)[:, 0].min() >= 0.0
