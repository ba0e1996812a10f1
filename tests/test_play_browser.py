"""The web viewer in a real, headless browser: it draws, and its controls reach the simulation."""

import base64
import contextlib
import io
import itertools
import json
import shutil
import socket
import subprocess
import time
import urllib.request

import numpy as np
import pytest
import torch
from fake_env import FakeEnv
from PIL import Image
from test_render import box

from vd.play.session import Session

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=1280,800",
    "--remote-debugging-port=0",
)
START_S = 300.0


class Browser:
    """A headless Chromium, driven through its DevTools protocol."""

    def __init__(self, program, profile):
        self._process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = profile / "DevToolsActivePort"
        deadline = time.monotonic() + START_S
        while not port_file.exists() or "\n" not in port_file.read_text():
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"{program} did not start (exit status {self._process.poll()})")
            time.sleep(0.1)
        port = port_file.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(p for p in json.load(answer) if p["type"] == "page")
        from websockets.sync.client import connect

        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None, proxy=None)
        self._ids = itertools.count(1)
        self.requested = []
        self.errors = []
        for domain in ("Network", "Page", "Runtime"):
            self.send(f"{domain}.enable")

    def send(self, method, **params):
        """One command and its answer; events on the way are kept."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=START_S))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._event(message)

    def _event(self, message):
        if message.get("method") == "Network.requestWillBeSent":
            self.requested.append(message["params"]["request"]["url"])
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(message["params"]["exceptionDetails"]["text"])

    def run(self, script):
        """The value of a JavaScript expression."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def screenshot(self):
        """The window as RGB bytes."""
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def click(self, x, y):
        """Press and release the mouse at a place in the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def click_text(self, text, selector="*"):
        """Click the innermost element with exactly this text."""
        place = self.run(
            f"(() => {{ const found = [...document.querySelectorAll({selector!r})].filter("
            f"e => e.textContent.trim() === {text!r} && e.getBoundingClientRect().width > 0);"
            "if (!found.length) return null; const box = found[found.length - 1].getBoundingClientRect();"
            "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
        )
        assert place, f"no element with the text {text!r}"
        self.click(*place)

    def close(self):
        """End the browser that was started here."""
        with contextlib.suppress(Exception):
            self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=120)


@pytest.fixture
def browser(tmp_path):
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser found; install one of {', '.join(BROWSERS)}")
    opened = Browser(program, tmp_path)
    yield opened
    opened.close()


class Spin:
    """Turns every object about the vertical."""

    def act(self, observation):
        """The same speed in every world."""
        action = torch.zeros(len(observation), 9)
        action[:, 2] = 1.0
        return action


@pytest.fixture
def player():
    from vd.assets_usd.hands import load_hand
    from vd.play.viewer import PlayViewer, open_page

    objects = [box("brick", [0.09, 0.05, 0.03]), box("stick", [0.14, 0.02, 0.02])]
    env = FakeEnv(objects, num_envs=2, max_episode_steps=10_000, tolerance=-1.0, hand=load_hand("dclaw3"))
    session = Session(env, Spin())
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    viewer = PlayViewer(session, open_page(port=port, verbose=False))
    yield viewer
    viewer.close()


def keep_running(viewer, browser, condition, *, limit_s=60.0):
    """Step and draw until the page fulfils a condition."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        viewer.update()
        time.sleep(0.02)
        if condition():
            return
    raise AssertionError("the page never got there; it says: " + browser.run("document.body.innerText")[:500])


def press(viewer, browser, text, selector, condition, *, tries=4, wait_s=15.0):
    """Click until it took effect; returns the clicks it took. A page that shifts may swallow one."""
    for clicks in range(1, tries + 1):
        browser.click_text(text, selector)
        try:
            keep_running(viewer, browser, condition, limit_s=wait_s)
        except AssertionError:
            if clicks == tries:
                raise
        else:
            return clicks
    raise AssertionError(f"{text} had no effect")


def orange(picture):
    picture = picture.astype(int)
    return (picture[..., 0] - picture[..., 2] > 80) & (picture[..., 0] > picture[..., 1] + 15)


@pytest.mark.slow
def test_viewer_draws_the_scene_and_its_controls_reach_the_simulation(browser, player, tmp_path):
    browser.send("Page.navigate", url=player.url)

    def text():
        return browser.run("document.body ? document.body.innerText : ''")

    keep_running(player, browser, lambda: "goals reached" in text())
    keep_running(player, browser, lambda: orange(browser.screenshot()).sum() > 300)

    # The object turns on the screen while it runs, and stands still while it is paused.
    first = browser.screenshot()
    keep_running(player, browser, lambda: (orange(browser.screenshot()) ^ orange(first)).sum() > 150)
    press(player, browser, "Pause", "label", player.viewer.is_paused)
    steps = player.session.snapshot.time_s
    for _ in range(5):
        player.update()
    assert player.session.snapshot.time_s == steps
    clicks = press(player, browser, "Step", "button", lambda: player.session.snapshot.time_s > steps)
    stepped = (player.session.snapshot.time_s - steps) * 12
    assert stepped == pytest.approx(round(stepped)) and 1 <= round(stepped) <= clicks, "one step a click"

    goal = player.session.snapshot.goal_quat.copy()
    press(
        player,
        browser,
        "New goal",
        "button",
        lambda: not np.allclose(player.session.snapshot.goal_quat, goal),
    )

    assert "brick" in text()
    browser.run(
        "(() => { const field = [...document.querySelectorAll('input')].find("
        "e => e.value === 'brick'); field.scrollIntoView(); field.click(); })()"
    )
    keep_running(player, browser, lambda: "stick" in text())
    options = "[role=option], [role=option] *"
    press(player, browser, "stick", options, lambda: player.session.object_name == "stick")
    keep_running(player, browser, lambda: "stick" in text())
    keep_running(player, browser, lambda: orange(browser.screenshot()).sum() > 100)

    outside = [
        url for url in browser.requested if not url.startswith((player.url, "data:", "blob:", "ws://"))
    ]
    assert [url for url in outside if "127.0.0.1" not in url and "localhost" not in url] == []
    assert browser.errors == []
