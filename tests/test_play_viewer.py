"""The web viewer: a headless browser draws its scene, and its controls reach the simulation."""

import asyncio
import inspect
import shutil
import subprocess
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from fake_env import FakeEnv
from PIL import Image
from test_play_session import Turn
from test_render import box
from viser import GuiEvent

from vd.assets_usd.hands import load_hand
from vd.play.session import Session
from vd.play.viewer import PlayViewer

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=1280,800",
    "--virtual-time-budget=20000",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # no network
)
PATIENCE_S = 300.0


def session(policy=None, hand="dclaw3"):
    objects = [box("brick", [0.09, 0.05, 0.03]), box("stick", [0.14, 0.02, 0.02])]
    env = FakeEnv(
        objects, num_envs=2, max_episode_steps=10_000, tolerance=-1.0, hand=load_hand(hand)
    )
    return Session(env, policy or Turn(1.0))


class Sees(Turn):
    """Sees by a camera a plane at half a metre, and believes the object in the middle of it."""

    def __init__(self):
        super().__init__(1.0)
        self.hand, self.predicted = load_hand("dclaw4"), torch.full((2,), 0.25)
        camera = replace(
            self.hand.camera, position=np.zeros(3), quaternion=np.array([0.0, 0.0, 0.0, 1.0])
        )
        self.camera = SimpleNamespace(
            camera=camera, depth=wp.full((2, camera.height, camera.width), 0.5)
        )
        tips = self.hand.tip_poses(self.hand.start)[:, :3].mean(axis=0)
        self.tracker = SimpleNamespace(pose=torch.tensor([*tips, 0.0, 0.0, 0.0, 1.0]).expand(2, 7))

    def surface(self, world):
        """A point, the origin."""
        return np.zeros((1, 3))


@pytest.fixture
def player():
    viewer = PlayViewer(session())
    yield viewer
    viewer.close()


def picture(player, path):
    """What a browser shows of the page while it runs, as RGB."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser found; install one of {', '.join(BROWSERS)}")
    profile = f"--user-data-dir={path.with_suffix('')}"
    browser = subprocess.Popen([program, *FLAGS, profile, f"--screenshot={path}", player.url])
    deadline = time.monotonic() + PATIENCE_S
    while browser.poll() is None:
        assert time.monotonic() < deadline
        player.update()
        time.sleep(0.02)
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.slow
def test_a_browser_draws_object_and_goal_without_a_network(player, tmp_path):
    shown = picture(player, tmp_path / "page.png")
    red, green, blue = np.moveaxis(shown, -1, 0)
    assert ((red - blue > 80) & (red > green + 15)).sum() > 300, "the object"
    assert ((green - red > 20) & (green > blue)).sum() > 300, "its goal"


def use(player, label, value=None):
    """Do with a control of the page what a browser's user does."""
    handles = player.viewer.server.gui._gui_input_handle_from_uuid.values()
    (control,) = [handle for handle in handles if handle.label == label]
    if value is not None:
        control._impl.value = value
    for told in control._impl.update_cb:
        if inspect.isawaitable(done := told(GuiEvent(client=None, client_id=0, target=control))):
            asyncio.run(done)
    player.update()


def test_controls_reach_the_simulation(player):
    session = player.session
    player.run(steps=3)
    assert session.snapshot.time_s == pytest.approx(3 / 12)
    use(player, "Pause", True)
    for _ in range(3):
        assert not player.update()
    assert session.snapshot.time_s == pytest.approx(3 / 12)
    use(player, "Step")
    assert session.snapshot.time_s == pytest.approx(4 / 12)
    goal = session.snapshot.goal_quat.copy()
    use(player, "New goal")
    assert not np.allclose(session.snapshot.goal_quat, goal)
    use(player, "Object", "stick")
    assert session.object_name == "stick" and "stick" in player.status.content
    use(player, "Reset")
    assert session.snapshot.time_s == 0.0


def test_what_a_policys_camera_sees_is_shown():
    player = PlayViewer(session(Sees(), "dclaw4"))
    player.run(steps=1)
    assert "believed 0.25" in player.status.content and "ms" in player.status.content
    seen, camera = player.session.view(), player.session.hand.camera
    player.close()
    assert seen.shape == (camera.height, camera.width, 3)
    assert (seen[..., 1] > seen[..., 0] + 100).any(), "the believed surface"
