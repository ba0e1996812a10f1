"""From options to a hand: its model, its motors' calibration, and the motors or their twin."""

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vd.deploy.hardware.port import BAUD_RATE

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel
    from vd.deploy.hardware.joints import JointMotors
    from vd.deploy.hardware.motors import Motors
    from vd.deploy.twin.twin import Twin

STARTING = "starting the twin (the first start compiles its kernels for minutes) ..."


@dataclass(frozen=True)
class HandOptions:
    """Which hand, and where its motors are."""

    hand: str = "dclaw3"
    """dclaw3, dclaw4, an imported hand or a hand's USD."""
    hand_layer: Path | None = None
    """Identified servo model over the hand (identified.usda); a twin moves as it says."""
    port: str | None = None
    """Serial port of the motors, such as /dev/ttyUSB0."""
    twin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Simulate the hand in place of --port."""
    calibration: Path | None = None
    """Calibration file of the joints' motors; by default IDs, directions and zeros are the
    USD's.
    """
    baud_rate: int = BAUD_RATE
    """Of the port."""


@dataclass(frozen=True)
class Connection:
    """A hand and its motors."""

    joints: "JointMotors"
    """Which motor turns which joint of the hand."""
    bus: "Motors"
    """Its motors, in the joints' order."""
    twin: "Twin | None" = None
    """The twin, if it is one."""
    ros: Any = None
    """The node, where the hand is behind ROS 2."""

    @property
    def hand(self) -> "HandModel":
        """The hand, with its layer."""
        return self.joints.hand


def motors_of(options: HandOptions) -> "JointMotors":
    """The motors of the options' hand.

    Raises:
        ValueError: Motor, hand, layer or calibration cannot be used.
    """
    from vd.assets_usd.hands import load_hand
    from vd.deploy.hardware.joints import read_joints

    hand = load_hand(options.hand, layer=options.hand_layer)
    return read_joints(hand, options.calibration)


@contextlib.contextmanager
def connect(options: HandOptions, **twin_options: Any) -> Iterator[Connection]:
    """The hand of the options.

    Args:
        options: The options.
        twin_options: Arguments of a twin, if it is one.

    Raises:
        ValueError: Options that cannot be.
        BusError: The port cannot be opened.
    """
    joints = motors_of(options)
    if options.twin == (options.port is not None):
        raise ValueError("give --port, such as /dev/ttyUSB0, or --twin for a simulated hand")
    if options.port is None:
        from vd.deploy.twin.twin import Twin

        print(STARTING, file=sys.stderr, flush=True)
        twin = Twin(joints, **twin_options)
        yield Connection(joints, twin, twin)
        return
    from vd.deploy.hardware.bus import MotorBus

    with MotorBus(options.port, joints.ids, joints.models, baud_rate=options.baud_rate) as bus:
        yield Connection(joints, bus)
