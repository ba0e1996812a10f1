"""Find where the camera is: a person bends fingers with markers on their tips before it.

Print markers (--print-markers), stick marker k flat to the last link of finger k so that it faces
the camera at the start pose, and run. The torque goes off. A picture is taken whenever the fingers
rest and show something new. The result is a layer over the hand's USD, for vd-deploy
--camera-layer.
"""

import json
import sys
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, compose, invert
from vd.command.config import require
from vd.command.files import check_file
from vd.deploy.camera.camera import CameraError
from vd.deploy.camera.hand_eye import HandEye, Views, solve
from vd.deploy.camera.markers import CELLS, MARGIN_CELLS, find_markers, save_marker
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, find_device
from vd.deploy.finding import listed
from vd.deploy.hardware.answers import BusError
from vd.deploy.hardware.check import confirm
from vd.deploy.hardware.connect import HandOptions, connect, motors_of
from vd.deploy.safety.signals import held
from vd.paper import PAPER

SIDE_M = 0.020
"""Side of a marker [m]: with its white border 27 mm, as wide as the last link of a D'Claw."""
IMAGE_S = 1.0
"""Longest wait for an image [s]."""
STILL_RAD = 0.005
"""Joints that move by less while an image is taken rest."""
SEAT_M = 0.012
"""Distance of a marker from the middle of its link."""
SAME_RAD = 0.05
"""Joints of a finger that differ by less show its marker once more, not anew."""
LARGEST_ERROR_M = PAPER.cloud.voxel_m
"""Uncertainty at the object above which the result is called ill-conditioned [m]: a voxel of what
is seen.
"""


@dataclass(frozen=True)
class CalibrateCfg(HandOptions):
    """Find where the camera is, from markers on the fingertips."""

    out: Path = Path("camera.usda")
    """Layer to write."""
    fingers: tuple[int, ...] = ()
    """Fingers that carry a marker, from 0; all by default. Marker k is on finger k."""
    count: int = 10
    """Views to take of each finger."""
    side_m: float = SIDE_M
    """Side of the markers' black square [m]; measure the print."""
    print_markers: Path | None = None
    """Write the markers as pictures into this folder, and do nothing else."""
    camera: RealSenseCfg = field(default_factory=lambda: RealSenseCfg(width=1280, height=720))
    """The camera."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before the torque goes off."""


def calibrate(cfg: CalibrateCfg) -> int:
    """Take views, solve, write the layer; 1 if the result is too uncertain."""
    require(cfg, "--", "positive", "side_m count")
    hand = motors_of(cfg).hand
    fingers = cfg.fingers or tuple(range(hand.num_fingers))
    if not all(0 <= f < hand.num_fingers for f in fingers) or len(set(fingers)) != len(fingers):
        raise ValueError(
            f"--fingers {fingers}: {hand.name} has fingers 0 to {hand.num_fingers - 1}"
        )
    if cfg.print_markers is not None:
        return _print_markers(cfg.print_markers, fingers, cfg.side_m)
    check_file(cfg.out)  # a person's work is not to be lost
    views = take(cfg, fingers)
    thought = np.concatenate([hand.camera.position, hand.camera.quaternion])
    estimate = solve(views, thought, {finger: seat(hand, finger, thought) for finger in fingers})
    error_m = estimate.point_error(hand.goal_in_base)
    write_camera_layer(cfg.out, hand, estimate, error_m)
    print("\n".join(report(hand, estimate, views, error_m)))
    print(f"written to {cfg.out}; vd-deploy --camera-layer {cfg.out}")
    if error_m <= LARGEST_ERROR_M:
        return 0
    print(
        f"WARNING: ill-conditioned: where objects are, the cloud may be off by {1e3 * error_m:.1f} "
        f"mm, more than a voxel ({1e3 * LARGEST_ERROR_M:.0f} mm). The fingers turn too little for "
        "these pictures: take more views (--count), put markers on more fingers, larger ones, or "
        "move the camera nearer"
    )
    return 1


def _print_markers(folder: Path, fingers: tuple[int, ...], side_m: float) -> int:
    for finger in fingers:
        save_marker(folder / f"marker-{finger}.png", finger, side_m)
    border = 1e3 * side_m * MARGIN_CELLS / CELLS
    print(
        f"{len(fingers)} markers in {folder}: print them at true size (600 dots per inch), keep "
        f"their white"
    )
    print(f"border of {border:.1f} mm, check that the black square is {1e3 * side_m:.1f} mm wide")
    return 0


def take(cfg: CalibrateCfg, fingers: tuple[int, ...]) -> Views:
    """The markers in pictures of fingers that a person moves.

    Of a finger that waits only the first.

    Raises:
        BusError: A motor does not answer.
        CameraError: The camera does not serve.
    """
    if cfg.twin:
        raise CameraError("a twin has no camera that sees markers; give --port")
    with ExitStack() as stack:
        camera = RealSense(find_device(cfg.camera.serial), cfg.camera, infrared=True)
        stack.callback(camera.close)
        connection = stack.enter_context(connect(cfg))
        hand = connection.hand
        bus = connection.bus
        joints = connection.joints
        confirm("The torque goes off, and the hand lets go.", yes=cfg.yes)
        with held():  # else some motors would keep their torque
            failed = bus.torque(False)
        if failed:
            raise BusError(listed(list(failed.values())))
        print(
            "Bend one finger after the other, its marker to the camera; turn it all ways, hold it "
            "still."
        )
        poses: dict[int, list[np.ndarray]] = {number: [] for number in fingers}
        tip = []
        finger = []
        corners = []
        while min(map(len, poses.values())) < cfg.count:
            before = joints.to_joint(bus.read_state().position)
            image = camera.read(IMAGE_S).image
            after = joints.to_joint(bus.read_state().position)
            if np.abs(after - before).max() > STILL_RAD:
                continue
            joint_q = 0.5 * (before + after)
            for number, square in find_markers(image).items():
                finger_q = joint_q[3 * number : 3 * number + 3]
                if number in poses and all(
                    np.abs(finger_q - other).max() > SAME_RAD for other in poses[number]
                ):
                    poses[number].append(finger_q)
                    tip.append(hand.tip_poses(joint_q)[number])
                    finger.append(number)
                    corners.append(square)
            counts = ", ".join(str(len(kept)) for kept in poses.values())
            print(
                f"\r{counts} of {cfg.count} views of each finger",
                end="",
                file=sys.stderr,
                flush=True,
            )
        print(file=sys.stderr)
        return Views(
            np.array(tip), np.array(finger), np.array(corners), camera.intrinsics, cfg.side_m
        )


def seat(hand: HandModel, finger: int, camera: np.ndarray) -> np.ndarray:
    """Pose in the tip's frame [7] of a marker that faces a camera [7] when the hand is at its start."""
    tip = hand.tip_poses(hand.start)[finger]
    normal = camera[:3] - tip[:3]
    normal /= np.linalg.norm(normal)
    right = Rotation.from_quat(camera[3:]).apply([1.0, 0.0, 0.0])
    turn, _ = Rotation.align_vectors([normal, right], [[0, 0, 1], [1, 0, 0]], weights=[np.inf, 1.0])
    return compose(invert(tip), np.concatenate([tip[:3] + SEAT_M * normal, turn.as_quat()]))


def write_camera_layer(path: Path, hand: HandModel, found: HandEye, error_m: float) -> None:
    """Write the layer, with what is known of its errors (SI units, radians)."""
    from vd.assets_usd.camera_layer import write_camera_layer

    notes = {
        "tool": "vd-deploy calibrate",
        "position_half_width_m": json.dumps(found.half_width[:3].tolist()),
        "turn_half_width_rad": json.dumps(found.half_width[3:].tolist()),
        "error_at_object_m": f"{error_m:.6f}",
        "residual_px": f"{found.rms_px:.3f}",
        "views": str(len(found.inliers)),
    }
    write_camera_layer(path, hand, found.camera, notes)


def report(hand: HandModel, found: HandEye, views: Views, error_m: float) -> list[str]:
    """What was found and how well, as text."""
    rows = [
        f"{len(found.inliers)} of {len(views)} views agree, {found.rms_px:.2f} pixels apart",
        "camera in the hand's base, 95 % intervals:",
    ]
    for axis, value, half in zip("xyz", found.camera[:3], found.half_width[:3], strict=True):
        rows.append(f"  {axis}       {1e3 * value:8.1f} mm  +- {1e3 * half:.1f}")
    for axis, half in zip(("right", "down", "ahead"), found.half_width[3:], strict=True):
        rows.append(f"  turn about its {axis:<6} +- {np.degrees(half):.2f} deg")
    moved_m = np.linalg.norm(found.camera[:3] - hand.camera.position)
    rows.append(f"at the object: off by at most {1e3 * error_m:.1f} mm (95 %)")
    rows.append(f"{1e3 * moved_m:.1f} mm from where the hand's file has it")
    return rows
