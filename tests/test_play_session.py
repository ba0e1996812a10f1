"""What the viewer's buttons do to a running environment, and what recordings show."""

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from fake_env import FakeEnv, FakeObject

from vd.geometry.quaternions import rotation_distance
from vd.play.cli import spread
from vd.play.session import Session
from vd.play.video import Watcher, act


class Turn:
    """Turns every object about the vertical."""

    def __init__(self, speed):
        self.speed = speed

    def act(self, observation):
        """The same speed in every world."""
        action = torch.zeros(len(observation), 9)
        action[:, 2] = self.speed
        return action


def make_session(speed=1.0, **kwargs):
    env = FakeEnv([FakeObject("a"), FakeObject("b")], num_envs=4, max_episode_steps=1000, **kwargs)
    return Session(env, Turn(speed))


def test_new_goal_changes_the_goal_alone():
    session = make_session(tolerance=-1.0)
    session.env.cfg.goal.max_angle_rad = 0.5
    before = session.snapshot
    session.new_goal()
    after = session.snapshot
    np.testing.assert_allclose(after.joint_q, before.joint_q)
    assert rotation_distance(after.goal_quat, before.goal_quat) > 1e-3
    assert after.error_rad <= 0.5 + 1e-3
    assert after.error_rad == pytest.approx(
        rotation_distance(after.joint_q[-4:], after.goal_quat), abs=1e-3
    )


def test_reset_shows_the_error_of_the_new_start_and_keeps_counts():
    session = make_session(speed=0.0, tolerance=4.0)  # every step succeeds
    session.step()
    assert session.snapshot.success and session.snapshot.goals == 1
    session.reset()
    shot = session.snapshot
    assert not shot.success and shot.goals == 1
    assert shot.error_rad == pytest.approx(
        rotation_distance(shot.joint_q[-4:], shot.goal_quat), abs=1e-3
    )


def test_watcher_counts_goals_and_drops_of_its_worlds_alone():
    env = FakeEnv(
        [FakeObject("a")], num_envs=3, max_episode_steps=1000, tolerance=-1.0, fall_at={1: 2}
    )
    watcher = Watcher(env, [2, 1])
    policy = Turn(0.0)
    for _ in range(6):
        act(env, policy)
        shots = watcher.read()
    assert [shot.drops for shot in shots] == [0, 3]
    assert [shot.goals for shot in shots] == [0, 0]
    assert shots[0].time_s == pytest.approx(0.5)


def test_cells_show_different_objects_first():
    assert spread([0, 0, 0, 1, 1, 2], 3) == [0, 3, 5]
    assert spread([0, 0, 0, 1, 1, 2], 4) == [0, 1, 3, 5]
    assert spread([0], 1) == [0]


@pytest.mark.slow
def test_video_of_the_real_environment(tmp_path):
    """In the air: the last of 26 frames is the first after the table has gone."""
    from vd.play.cli import main

    path = tmp_path / "random.mp4"
    flags = [
        "--hand",
        "dclaw3",
        "--video",
        str(path),
        "--seconds",
        "2.084",
        "--in-air",
        "--device",
        "cpu",
    ]
    assert main(["random", *flags]) == 0
    frames = iio.imread(path)
    assert frames.shape == (26, 460, 640, 3)
    first, last = frames[0, :400, :480].astype(int), frames[-1, :400, :480].astype(int)
    assert (np.abs(first - last).sum(axis=2) > 60).sum() > 200  # fingers moved
    corner = slice(340, 390), slice(20, 60)  # of the table, out of the fingers' reach
    background = last[200, 5]
    assert (np.abs(last[corner] - background).max(axis=2) <= 4).all()
    assert (np.abs(first[corner] - background).max(axis=2) > 10).all()
