"""The demo's twins: what they are called with, and what the page says of flights, or of none."""

from pathlib import Path

import numpy as np
import pytest

from vd.assets_usd.hands import load_hand
from vd.deploy import cli
from vd.deploy.log import LogWriter
from vd.files import write_json
from vd.hand_log import JOINT_CHANNELS
from vd.page import Page
from vd.train import demo_deploy
from vd.train.demo_stages import TimeUp


def made_up_flights(folder: Path, _seed: int, *, minutes: float, hands=demo_deploy.HANDS) -> None:
    """Logs and videos of hands that never flew; tests/test_deploy_loop.py flies them."""
    assert minutes > 0.0
    for name in hands:
        hand = load_hand(name)
        run = {"object": {"name": "cube", "set": "cube"}, "goals": [[0.0, 0.0, 0.0, 1.0]], "control_hz": 12.0}
        log = LogWriter(demo_deploy.deploy_log(folder, name), hand, run, servo={})
        for step in range(100):
            joints = dict.fromkeys(JOINT_CHANNELS, np.zeros(hand.num_joints))
            sent = 0.005 + 0.0001 * step
            now = log.started_s + step / 12
            log.step(now, now + sent, joints, [0.0, 1.0, 0.5, 0.0, 0.002, sent, 0.004, 1.0])
        log.event("stop", goal=0, outcome="stopped", distance=0.2)
        log.finish("all goals pursued")
        demo_deploy.deploy_video(folder, name).write_bytes(b"no film")
    write_json(demo_deploy.deploy_files(folder)[0], dict.fromkeys(hands, 0))


def test_the_page_tells_of_flights(tmp_path):
    made_up_flights(tmp_path, 0, minutes=1.0)
    page = Page("x")
    demo_deploy.add_deploy(page, tmp_path)
    text = page.html()
    assert text.count("<video") == 2 and "which no real hand" not in text
    assert "read the twin's true state" in text.replace("&#x27;", "'")
    for cell in ("dclaw3", "dclaw4", "100", "10.0", "14.9", "stopped"):
        assert f">{cell}</td>" in text


def test_a_hand_that_did_not_fly_is_told(tmp_path):
    made_up_flights(tmp_path, 0, minutes=1.0, hands=("dclaw3",))
    page = Page("x")
    demo_deploy.add_deploy(page, tmp_path)
    assert page.html().count("<video") == 1 and "did not fly" in page.html()


def test_the_commands_are_those_of_vd_deploy(tmp_path, monkeypatch):
    """Their flags are known; what would fly is only looked at."""
    seen = []
    monkeypatch.setattr("vd.deploy.run.run", lambda cfg: seen.append(cfg) or 0)
    for name, *arguments in demo_deploy.deploy_commands(tmp_path, 3):
        assert name == "vd-deploy" and cli.main(arguments) == 0
    assert [cfg.hand for cfg in seen] == list(demo_deploy.HANDS)
    assert all(cfg.twin and cfg.seed == 3 and cfg.log.parent == tmp_path for cfg in seen)


def test_without_time_or_driver_nothing_flies(tmp_path, monkeypatch):
    with pytest.raises(TimeUp):
        demo_deploy.fly_twins(tmp_path, 0, minutes=0.5)
    monkeypatch.setattr(demo_deploy, "DRIVER", "no_such_driver")
    with pytest.raises(RuntimeError, match="not installed"):
        demo_deploy.fly_twins(tmp_path, 0, minutes=2.0)
