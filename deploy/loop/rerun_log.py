"""The log of a run as a recording of Rerun (.rrd).

Curves, object, goal, and the camera's depth in 3D.

Needs the extra ``log``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.logs.log_format import FOUND_COLUMNS, TRUTH_COLUMNS

CURVES = ("command", "position", "velocity", "current", "action")
LATENCIES = ("late_s", "image_s", "sensed_s", "sent_s", "cpu_s")


class RerunLog:
    """A recording being written; methods are those of :class:`vd.deploy.loop.log.Sink`.

    Args:
        path: The file.
        run: As of run.json.
        hand: The hand.
        item: The object.
        camera: Lens and pose in the base frame, where there is a camera.
    """

    def __init__(
        self,
        path: Path,
        run: Mapping[str, Any],
        hand: HandModel,
        item: ObjectModel,
        camera: CameraModel | None = None,
    ):
        import rerun

        self._rr: Any = rerun
        self._to: Any = rerun.RecordingStream("visual_dexterity")
        self._to.save(str(path))
        self._run, self._joints, self._place = run, list(run["joints"]), hand.workspace.goal_m
        for channel in CURVES:
            self._to.log(f"joints/{channel}", rerun.SeriesLines(names=self._joints), static=True)
        mesh = rerun.Mesh3D(vertex_positions=item.vertices, triangle_indices=item.faces)
        for name in ("object", "found", "goal"):
            self._to.log(f"world/{name}", mesh, static=True)
        self._to.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if camera is not None:
            base = Rotation.from_quat(hand.mount[3:])
            place = base.apply(camera.position) + hand.mount[:3]
            self._pose(
                "camera",
                [*place, *(base * Rotation.from_quat(camera.quaternion)).as_quat()],
                static=True,
            )
            lens = rerun.Pinhole(
                image_from_camera=camera.matrix, width=camera.width, height=camera.height
            )
            self._to.log("world/camera", lens, static=True)

    def step(self, row: Mapping[str, float], depth: np.ndarray | None) -> None:
        """Write a control step, by columns of steps.csv, and the depth image [m] [H, W] that it saw."""
        rr, goals = self._rr, self._run["goals"]
        self._to.set_time("run", duration=row["t"])
        for channel in CURVES:
            self._to.log(
                f"joints/{channel}",
                rr.Scalars([row.get(f"{channel}.{name}", np.nan) for name in self._joints]),
            )
        for name in ("distance", "error"):
            if np.isfinite(row.get(name, np.nan)):
                self._to.log(f"goal/{name}", rr.Scalars(row[name]))
        for name in LATENCIES:
            if np.isfinite(row[name]):
                self._to.log(f"loop/{name}", rr.Scalars(row[name]))
        self._pose("object", [row.get(name, np.nan) for name in TRUTH_COLUMNS[:7]])
        self._pose("found", [row[name] for name in FOUND_COLUMNS])
        if (number := int(row["goal"])) < len(goals):
            self._pose("goal", [*self._place, *goals[number]])
        if depth is not None:
            self._to.log("world/camera/depth", rr.DepthImage(depth, meter=1.0))

    def event(self, line: Mapping[str, Any]) -> None:
        """Write an event, as of events.jsonl."""
        self._to.set_time("run", duration=line["t"])
        self._to.log(
            "events", self._rr.TextLog(", ".join(f"{name} {value}" for name, value in line.items()))
        )

    def close(self, run: Mapping[str, Any]) -> None:
        """End the file."""
        self._to.disconnect()

    def _pose(self, name: str, pose: Any, *, static: bool = False) -> None:
        """Where something is: position and quaternion [7], world frame.

        Not shown where that is not known.
        """
        known = bool(np.isfinite(pose).all())
        if known:
            at = self._rr.Transform3D(
                translation=pose[:3], quaternion=self._rr.Quaternion(xyzw=pose[3:])
            )
        else:
            at = self._rr.Transform3D(scale=0.0)
        self._to.log(f"world/{name}", at, static=static)
