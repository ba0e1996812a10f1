"""A log beside the simulator, and the same log shown."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from vd.assets_usd.hands import load_hand
from vd.deploy import cli
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.mirror import Mirror
from vd.deploy.loop.shadow import Difference, ShadowCfg, differences, summary
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.evaluate.senses import EnvironmentSenses
from vd.hand_log import JOINT_CHANNELS, LogError, read_log
from vd.play.cli import main as play
from vd.play.replay import Replay, ReplaySession
from vd.render import OUT_OF_SIGHT
from vd.sensors.cfg import DepthCameraCfg

STEPS = 24
GOALS = [[0.0, 0.0, 0.0, 1.0], [0.0, 0.6, 0.0, 0.8]]


def write(folder, *, truth=True, spoil=0.0, tolerance_rad=1.2):
    """A log of joints that swing and an object that turns; goals are sent as in training, ``spoil`` apart."""
    hand = load_hand("dclaw3")
    task = ReorientCfg(hand="dclaw3")
    run = {
        "tolerance_rad": tolerance_rad,
        "policy": "still",
        "object": {"name": "cube", "set": "cube"},
        "goals": GOALS,
        "control_hz": 12.0,
    }
    log = LogWriter(folder, hand, run, servo={}, truth=truth)
    actions = ActionFilter(hand, task)
    rng = np.random.default_rng(0)
    for step in range(STEPS):
        q = np.tile([0.0, 0.8, -1.1], 3) + 0.2 * np.sin(0.3 * step + np.arange(9))
        smoothed, action = actions.smoothed, rng.uniform(-1.0, 1.0, 9)
        joints = dict.fromkeys(JOINT_CHANNELS, np.zeros(9))
        joints |= {"position": q, "velocity": np.cos(q), "smoothed": smoothed, "action": action}
        joints["command"] = actions.goal(action, q) + spoil
        turn = 0.1 * step
        pose = [0.0, 0.0, 0.05, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2), turn]
        values = [float(step >= 12), 1.0, 0.5, 0.001, 0.004, 0.02, 0.01, 0.0]
        now = log.started_s + step / 12
        log.step(now, now + 0.02, joints, values, pose if truth else [])
        if step == 11:
            log._append(log._events, json.dumps({"t": 11.5 / 12, "event": "stop", "goal": 0} | STOPPED))
    log._append(log._events, json.dumps({"t": 3.0, "event": "stop", "goal": 1} | LOST))
    log.finish("lost")
    return folder


STOPPED = {"outcome": "stopped", "distance": 0.3}
LOST = {"outcome": "lost", "distance": 0.5}


def test_a_sound_log_is_what_the_simulator_shows(tmp_path, capsys):
    folder = write(tmp_path / "log")
    assert cli.main(["shadow", str(folder), "--every", "6", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] and result["steps"] == 4
    assert "object turned, median [rad]" not in result, "there are no images to look for it in"


def test_goals_of_another_rule_are_told(tmp_path, capsys):
    folder = write(tmp_path / "log", spoil=0.01)
    assert cli.main(["shadow", str(folder), "--every", "12"]) == 1
    assert "0.01" in capsys.readouterr().out


def test_without_the_objects_pose_the_rest_is_compared(tmp_path):
    folder = write(tmp_path / "log", truth=False)
    found = list(differences(ShadowCfg(folder, every=12)))
    assert len(found) == 2 and all(one.ok for one in found)


def test_a_log_is_followed_from_before_its_first_step(tmp_path, monkeypatch):
    """It does not exist, then has no row, then grows, then ends; nobody waits in truth."""
    whole, folder = write(tmp_path / "whole"), tmp_path / "log"
    run = json.loads((whole / "run.json").read_text())
    head, *rows = (whole / "steps.csv").read_text().splitlines(keepends=True)
    run.pop("end", None)
    done = {}

    def grow(_):
        folder.mkdir(exist_ok=True)
        steps = folder / "steps.csv"
        written = len(steps.read_text().splitlines()) if steps.exists() else 0
        steps.write_text("".join([head, *rows][: written * 2 or 1]))
        shutil.copy(whole / "events.jsonl", folder)
        if written > len(rows):
            done["end"] = {"reason": "done"}
        (folder / "run.json").write_text(json.dumps({**run, **done}))

    monkeypatch.setattr("vd.deploy.loop.shadow.time.sleep", grow)
    found = list(differences(ShadowCfg(folder, follow=True, every=6)))
    assert len(found) == STEPS // 6 and all(one.ok for one in found)


def test_what_differs_is_not_rounding():
    same = Difference(0.0, 0.0, None)
    assert same.ok
    for name, value in {
        "sense": 1e-3,
        "goal_rad": 0.01,
        "pixels": 0.2,
    }.items():
        assert not replace(same, **{name: value}).ok


def test_an_object_found_elsewhere_is_told():
    same = Difference(0.0, 0.0, None, 1e-5)
    assert summary([same] * 3)["ok"]
    assert not summary([same, replace(same, found_rad=0.2), replace(same, found_rad=0.3)])["ok"]
    assert "object turned, median [rad]" not in summary([replace(same, found_rad=None)])


def test_an_image_of_something_else_is_told(tmp_path):
    """The image that the simulator itself renders is the same, one of a moment later is not."""
    folder = write(tmp_path / "log")
    task = ReorientCfg(hand="dclaw3", num_envs=1, randomisation=RandomisationCfg(enabled=False))
    mirror = Mirror(task)
    from vd.deploy.loop.shadow import _sensed

    camera = EnvironmentSenses(mirror.env, mirror.env.hand.camera, DepthCameraCfg()).camera
    log = read_log(folder)
    (folder / "images").mkdir()
    for step, shown in ((0, 0), (6, 18)):
        mirror.take(_sensed(log, shown))
        camera.capture()
        np.save(folder / "images" / f"{step:06d}.npy", camera.depth.numpy()[0])
    first, second, *_ = differences(ShadowCfg(folder, every=6))
    assert first.ok and first.pixels == 0.0
    assert not second.ok and second.pixels > 0.05
    # The object is looked for in the images, and nowhere else.
    first, _, third, *_ = differences(ShadowCfg(folder, policy="dclaw3-tracking", every=6))
    assert first.found_rad is not None and first.found_rad < 1e-3
    assert third.found_rad is None


def test_a_log_is_shown(tmp_path, capsys):
    folder = write(tmp_path / "log")
    replay = Replay(read_log(folder))
    assert len(replay.snapshots) == STEPS
    np.testing.assert_allclose(replay.snapshots[5].joint_q[:9], read_log(folder).channel("position")[5])
    assert [shot.success for shot in replay.snapshots].index(True) == 11
    far = Replay(read_log(write(tmp_path / "far", tolerance_rad=1.0))).snapshots  # stopped at 1.1 rad
    assert not any(shot.success for shot in far)
    assert [shot.fell for shot in replay.snapshots].index(True) == STEPS - 1
    assert replay.snapshots[-1].goals == 1 and replay.snapshots[-1].drops == 1
    np.testing.assert_allclose(replay.snapshots[12].goal_quat, GOALS[1])
    assert play([str(folder), "--video", str(tmp_path / "log.mp4")]) == 0
    assert (tmp_path / "log.mp4").is_file() and f"({STEPS} frames)" in capsys.readouterr().out


def test_the_viewer_steps_through_a_log(tmp_path):
    session = ReplaySession(Replay(read_log(write(tmp_path / "log", truth=False))))
    assert session.snapshot.joint_q[9:].tolist() == list(OUT_OF_SIGHT)
    first = session.step().time_s
    assert session.step().time_s > first > 0.0
    np.testing.assert_allclose(session.new_goal().goal_quat, GOALS[1])
    assert session.reset().time_s == 0.0
    for _ in range(STEPS):
        session.step()
    assert session.snapshot.time_s == 0.0


def test_a_log_of_what_is_not_here_cannot_be_shown(tmp_path, capsys):
    folder = write(tmp_path / "log")
    run = json.loads((folder / "run.json").read_text())
    run["object"]["set"] = str(tmp_path / "gone.usda")
    (folder / "run.json").write_text(json.dumps(run))
    with pytest.raises(LogError, match="cannot be shown"):
        Replay(read_log(folder))
    assert play([str(folder), "--video", str(tmp_path / "log.mp4")]) == 1
    assert "cannot be shown" in capsys.readouterr().err
