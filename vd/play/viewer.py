"""The web viewer: Newton's viser viewer with goal ghost, buttons, and a camera's view.

Browser events arrive on viser's threads; they are queued and handled between steps on the thread
that runs the simulation. Everything is served from this machine, so it works without a network.
"""

import math
import queue
import time
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import numpy as np
import warp as wp
from newton.viewer import ViewerViser

from vd.paper import PAPER
from vd.play.render import GHOST_OPACITY, PictureCamera, PictureModel
from vd.play.replay import Replay
from vd.play.session import Session
from vd.play.video import Snapshot

# Where the goal's object floats, in the camera's right and up [m]: left of the hand, for panels are
# right.
GHOST_RIGHT = -0.22
GHOST_HEIGHT = 0.12
# The viewer's camera stands this much farther than that of videos: a browser window has panels
# around it.
CAMERA_DISTANCE = 1.25


class PlayViewer:
    """Shows a session in the browser and lets it be steered from there.

    :meth:`close` closes the session too.

    It serves on ``host``, of which ``127.0.0.1`` keeps it on this machine, and the next free port.

    Args:
        session: What is shown.
        host: Address.
        port: Port.
    """

    def __init__(
        self,
        session: Session | Replay,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
    ):
        self.viewer = ViewerViser(host=host, port=port, label="vd-play", verbose=False)
        self._events: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self.session = session
        self.camera = PictureCamera.for_hand(session.hand)
        self._models: dict[str, PictureModel] = {}
        x, y, _ = GHOST_RIGHT * self.camera.rotation[:, 0]
        self._ghost = float(x), float(y), GHOST_HEIGHT
        self._show_object()
        self._set_camera()
        self._build_panel()
        self.viewer.set_reset_callback(lambda: self.session.reset())
        self.draw()

    @property
    def url(self) -> str:
        """Address to open in a browser."""
        return self.viewer.url

    def run(self, *, steps: int | None = None) -> None:
        """Step in real time until the viewer is closed, or ``steps`` control steps were made."""
        period = 1.0 / self.session.control_hz
        done = 0
        due = time.monotonic()
        while self.viewer.is_running() and (steps is None or done < steps):
            done += self.update()
            # After a pause, do not hurry to catch up.
            due = max(due + period, time.monotonic() - period)
            time.sleep(max(0.0, due - time.monotonic()))

    def update(self) -> bool:
        """Handle browser events, step unless paused, and draw; returns whether a step was made."""
        while not self._events.empty():
            self._events.get()()
        step = self.viewer.should_step()
        if step:
            self.session.step()
        self.draw()
        return step

    def draw(self) -> None:
        """Send the present state to the browser."""
        shot = self.session.snapshot
        self._pictured.pose(shot.joint_q[None], shot.goal_quat[None], self._ghost, table=shot.table)
        self.viewer.begin_frame(shot.time_s)
        self.viewer.log_state(self._pictured.state)
        self.viewer.log_scalar("orientation error [rad]", shot.error_rad)
        self.status.content = status_html(shot)
        if isinstance(self.session, Session) and self.session.sees:
            self._eye.image = self.session.view()
        self.viewer.end_frame()

    def close(self) -> None:
        """Stop serving, and close the session."""
        self.viewer.close()
        self.session.close()

    def _show_object(self) -> None:
        """Show the model of the chosen object.

        Models are kept, since building one takes a second.
        """
        name = self.session.object_name
        if name not in self._models:
            item = self.session.objects[self.session.object_names.index(name)]
            self._models[name] = PictureModel(self.session.hand, [item], goal_opacity=GHOST_OPACITY)
        self._pictured = self._models[name]
        self.viewer.set_model(self._pictured.model)

    def _set_camera(self) -> None:
        eye = np.asarray(self.camera.eye)
        target = np.asarray(self.camera.target)
        forward = (target - eye) / np.linalg.norm(target - eye)
        self.viewer.set_camera(
            wp.vec3(*(target + CAMERA_DISTANCE * (eye - target))),
            pitch=math.degrees(math.asin(forward[2])),
            yaw=math.degrees(math.atan2(forward[1], forward[0])),
        )

    def _build_panel(self) -> None:
        gui = self.viewer.server.gui
        session = self.session
        with gui.add_folder("Policy", order=-1.0):
            self.status = gui.add_html(status_html(session.snapshot))
            """What the page says of the moment."""
            if len(session.object_names) > 1:
                self._build_menu(session)
            new_goal = gui.add_button("New goal")
        if isinstance(session, Session) and session.sees:
            with gui.add_folder("Camera, believed pose drawn in", order=-0.5):
                self._eye = gui.add_image(session.view(), format="jpeg")

        @new_goal.on_click
        def _(_event: Any) -> None:
            self._events.put(lambda: self.session.new_goal())

    def _build_menu(self, session: Session | Replay) -> None:
        menu = self.viewer.server.gui.add_dropdown(
            "Object", tuple(session.object_names), initial_value=session.object_name
        )

        @menu.on_update
        def _(event: Any) -> None:
            if event.client_id is not None:
                self._events.put(partial(self._choose_object, menu.value))

    def _choose_object(self, name: str) -> None:
        self.session.choose_object(name)
        self._show_object()


def status_html(shot: Snapshot) -> str:
    """Error, what the policy believes of it, latency, time and counts as HTML."""
    details = []
    if shot.alike_rad is not None:
        details.append(f"up to symmetry {shot.alike_rad:.2f}")
    if shot.believed_rad is not None:
        details.append(f"believed {shot.believed_rad:.2f}")
    if shot.latency_s is not None:
        details.append(f"latency {1e3 * shot.latency_s:.0f} ms")
    color = "#12a150" if shot.error_rad <= PAPER.success.rotation_rad else "inherit"
    return (
        '<div style="padding:.2em .8em;font-variant-numeric:tabular-nums">'
        f"<b>{escape(shot.name)}</b>"
        f'<div style="font-size:1.5em;color:{color}">{shot.error_rad:.2f} rad</div>'
        f"<div>{' &middot; '.join(details)}</div>"
        f'<div style="opacity:.75">{shot.time_s:.1f} s &middot; goals reached {shot.goals}'
        f" &middot; drops {shot.drops}</div></div>"
    )
