"""From options to a hand.

Its model, its motors' calibration, and the bus, to real motors or to a twin.
"""

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
    from vd.deploy.hardware.bus import MotorBus
    from vd.deploy.hardware.joints import Joints
    from vd.deploy.twin.child import TwinChild


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
    """Simulate the motors and the hand in place of --port."""
    twin_args: str = ""
    """More options of the twin: --twin-args="--lose 0.01"; see python -m vd.deploy.twin.twin
    --help.
    """
    calibration: Path | None = None
    """Calibration file of the joints' motors; by default IDs, directions and zeros are the
    USD's.
    """
    motor: str | None = None
    """Model of all motors, in place of what the hand's USD says."""
    baud_rate: int = BAUD_RATE
    """Of the port."""


@dataclass(frozen=True)
class Connection:
    """A hand and the bus to its motors."""

    joints: "Joints"
    """Which motor turns which joint of the hand."""
    bus: "MotorBus"
    """Its motors, in the joints' order."""
    twin: "TwinChild | None" = None
    """The twin, if it is one."""
    ros: Any = None
    """The node, where the hand is behind ROS 2."""

    @property
    def hand(self) -> "HandModel":
        """The hand, with its layer."""
        return self.joints.hand


def motors_of(options: HandOptions) -> "Joints":
    """The motors of the options' hand.

    Raises:
        ValueError: Port and twin, motor, hand, layer or calibration cannot be used.
    """
    from vd.assets_usd.hands import load_hand
    from vd.deploy.hardware.joints import read_joints

    hand = load_hand(options.hand, layer=options.hand_layer)
    return read_joints(hand, options.calibration, options.motor)


@contextlib.contextmanager
def connect(options: HandOptions, **twin_options: Any) -> Iterator[Connection]:
    """Open the bus to the hand of the options.

    A twin behind it is started, and ended with the block.

    Args:
        options: The options.
        twin_options: Defaults of the twin, if there is one: fields of TwinCommand.

    Raises:
        ValueError: Options that cannot be.
        TwinError: The twin did not start.
        BusError: The port cannot be opened.
    """
    from vd.command.line import parse
    from vd.deploy.hardware.bus import MotorBus
    from vd.deploy.twin.child import TwinChild
    from vd.deploy.twin.twin import TwinCommand

    joints = motors_of(options)
    if options.twin == (options.port is not None):
        raise ValueError("give --port, such as /dev/ttyUSB0, or --twin for a simulated hand")
    with contextlib.ExitStack() as stack:
        twin, port = None, options.port
        if port is None:
            default = TwinCommand(
                hand=options.hand,
                hand_layer=options.hand_layer,
                calibration=options.calibration,
                model=options.motor,
                **twin_options,
            )
            command = parse(
                TwinCommand, options.twin_args.split(), default=default, prog="--twin-args"
            )
            print(
                "starting the twin (the first start compiles its kernels for minutes) ...",
                file=sys.stderr,
                flush=True,
            )
            twin = TwinChild(command)
            stack.callback(twin.close)
            port = twin.path
        bus = MotorBus(port, joints.ids, joints.models, baud_rate=options.baud_rate)
        yield Connection(joints, stack.enter_context(bus), twin)
