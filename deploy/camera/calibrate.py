"""Find where the camera is: a person bends a finger with the cube of tags on its tip before it.

Print the cube (vd-deploy tags), tape it to the last link of a finger so that the camera sees it, and
run. The torque goes off. A picture is used whenever the finger rests and shows something new. The
result is a layer over the hand's USD, for vd-deploy --camera-layer. On a twin the finger bends
itself.
"""

import json
import sys
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from vd.command.config import require
from vd.command.files import check_file
from vd.deploy.camera.hand_eye import HandEye, Views, solve
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, find_device
from vd.deploy.finding import listed
from vd.deploy.hardware.answers import BusError
from vd.deploy.hardware.check import confirm
from vd.deploy.hardware.connect import Connection, HandOptions, connect, motors_of
from vd.deploy.pose.tags import SIZE_M, find_cube, find_tags
from vd.deploy.safety.signals import held
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.deploy.camera.camera import ImageSource

IMAGE_S = 1.0
"""Longest wait for an image [s]."""
STILL_RAD = 0.005
"""Joints that move by less while an image is taken rest."""
SAME_RAD = 0.05
"""Joints of a finger that differ by less show the cube once more, not anew."""
LARGEST_ERROR_M = PAPER.cloud.voxel_m
"""Uncertainty at the object above which the result is called ill-conditioned [m]: a voxel of what
is seen.
"""


@dataclass(frozen=True)
class CalibrateCfg(HandOptions):
    """Find where the camera is, from a cube of tags on a fingertip."""

    out: Path = Path("camera.usda")
    """Layer to write."""
    fingers: tuple[int, ...] = (0,)
    """Fingers that carry the cube, from 0, one after the other; more make the result surer."""
    count: int = 20
    """Views to take of each finger."""
    size: float = SIZE_M
    """Side of the cube [m]; measure the print."""
    camera: RealSenseCfg = field(default_factory=lambda: RealSenseCfg(width=1280, height=720))
    """The camera."""
    pose_frame: tuple[float, float, float, float, float, float, float] | None = None
    """Where a twin's camera is, or a real one is thought to be, in the hand's base: position [m]
    and quaternion xyzw; by default where the hand's file has it."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before the torque goes off."""


def calibrate(cfg: CalibrateCfg) -> int:
    """Take views, solve, write the layer; 1 if the result is too uncertain."""
    from vd.assets_usd.camera_layer import write_camera_layer
    from vd.deploy.pose.open import source_frame

    require(cfg, "--", "positive", "size count")
    hand = motors_of(cfg).hand
    fingers = cfg.fingers
    if not all(0 <= f < hand.num_fingers for f in fingers) or len(set(fingers)) != len(fingers):
        raise ValueError(
            f"--fingers {fingers}: {hand.name} has fingers 0 to {hand.num_fingers - 1}"
        )
    check_file(cfg.out)  # a person's work is not to be lost
    thought = None
    if cfg.twin or cfg.pose_frame or hand.mounted_camera is not None:
        thought = source_frame(hand, cfg.pose_frame, None)
    views = take(cfg, thought)
    estimate = solve(views)
    error_m = estimate.point_error(hand.goal_in_base)
    notes = {
        "tool": "vd-deploy calibrate",
        "position_half_width_m": json.dumps(estimate.half_width[:3].tolist()),
        "turn_half_width_rad": json.dumps(estimate.half_width[3:].tolist()),
        "error_at_object_m": f"{error_m:.6f}",
        "residual_px": f"{estimate.rms_px:.3f}",
        "views": str(len(estimate.inliers)),
    }
    write_camera_layer(cfg.out, hand, estimate.camera, notes)
    print("\n".join(report(estimate, views, error_m, thought)))
    print(f"written to {cfg.out}; vd-deploy --camera-layer {cfg.out}")
    if error_m <= LARGEST_ERROR_M:
        return 0
    print(
        f"WARNING: ill-conditioned: objects may seem off by {1e3 * error_m:.1f} mm, more than "
        f"{1e3 * LARGEST_ERROR_M:.0f}. The finger turns too little for these pictures: take more "
        "views (--count), of more fingers (--fingers), or move the camera nearer"
    )
    return 1


def take(cfg: CalibrateCfg, camera_pose: np.ndarray | None = None) -> Views:
    """The cube in pictures of fingers that bend.

    Args:
        cfg: The options.
        camera_pose: Where a twin's camera is, in the hand's base [7].

    Raises:
        BusError: A motor does not answer.
        CameraError: The camera does not serve.
    """
    views: list[tuple[np.ndarray, np.ndarray]] = []
    finger_of = []
    with ExitStack() as stack:
        connection = stack.enter_context(connect(cfg))
        camera: ImageSource
        if connection.twin is None:
            camera = RealSense(find_device(cfg.camera.serial), cfg.camera, infrared=True)
            stack.callback(camera.close)
            _let_go(connection, yes=cfg.yes)
        for finger in cfg.fingers:
            if connection.twin is not None:
                from vd.deploy.pose.twin_poses import BentFinger

                assert camera_pose is not None
                camera = BentFinger(
                    connection.twin, connection.joints, finger, camera_pose, cfg.size
                )
            elif finger != cfg.fingers[0]:
                confirm(f"Tape the cube to finger {finger}.", yes=False)
            new = views_of(connection, camera, finger, cfg.size, cfg.count)
            views += new
            finger_of += [finger] * len(new)
        tip, cube = map(np.array, zip(*views, strict=True))
        return Views(tip, np.array(finger_of), cube, camera.intrinsics, cfg.size)


def _let_go(connection: Connection, *, yes: bool) -> None:
    """Switch the torque of real motors off, after asking.

    Raises:
        BusError: A motor does not answer.
    """
    confirm("The torque goes off, and the hand lets go.", yes=yes)
    with held():  # else some motors would keep their torque
        failed = connection.bus.torque(False)
    if failed:
        raise BusError(listed(list(failed.values())))


def views_of(
    connection: Connection, camera: "ImageSource", finger: int, size_m: float, count: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """While a finger bends, poses of its tip in the hand's base [7] and of the cube in the camera [7].

    Args:
        connection: The hand.
        camera: Images of brightness, uint8 [H, W].
        finger: The finger that has the cube.
        size_m: Side of the cube [m].
        count: How many.
    """
    hand = connection.hand
    bus = connection.bus
    joints = connection.joints
    print(f"Bend finger {finger} all ways, the cube to the camera; hold it still now and then.")
    bent: list[np.ndarray] = []
    views: list[tuple[np.ndarray, np.ndarray]] = []
    while len(views) < count:
        before = joints.to_joint(bus.read_state().position)
        image = camera.read(IMAGE_S).image
        after = joints.to_joint(bus.read_state().position)
        if np.abs(after - before).max() > STILL_RAD:
            continue
        joint_q = 0.5 * (before + after)
        finger_q = joint_q[hand.fingers[finger]]
        if any(np.abs(finger_q - other).max() < SAME_RAD for other in bent):
            continue
        cube, _ = find_cube(find_tags(image), camera.intrinsics, size_m)
        if cube is None:
            continue
        bent.append(finger_q)
        views.append((hand.tip_poses(joint_q)[finger], cube))
        print(f"\r{len(views)} of {count} views", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return views


def report(found: HandEye, views: Views, error_m: float, thought: np.ndarray | None) -> list[str]:
    """What was found and how well, as text."""
    rows = [
        f"{len(found.inliers)} of {len(views)} views agree, {found.rms_px:.2f} pixels apart",
        "camera in the hand's base, 95 % intervals:",
    ]
    for axis, value, half in zip("xyz", found.camera[:3], found.half_width[:3], strict=True):
        rows.append(f"  {axis}       {1e3 * value:8.1f} mm  +- {1e3 * half:.1f}")
    for axis, half in zip(("right", "down", "ahead"), found.half_width[3:], strict=True):
        rows.append(f"  turn about its {axis:<6} +- {np.degrees(half):.2f} deg")
    rows.append(f"at the object: off by at most {1e3 * error_m:.1f} mm (95 %)")
    if thought is not None:
        moved_m = np.linalg.norm(found.camera[:3] - thought[:3])
        turn = Rotation.from_quat(found.camera[3:]) * Rotation.from_quat(thought[3:]).inv()
        angle_deg = np.degrees(turn.magnitude())
        rows.append(f"{1e3 * moved_m:.1f} mm and {angle_deg:.2f} degrees from where it was thought")
    return rows
