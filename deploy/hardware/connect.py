"""From options to a hand: its model, its motors' calibration, and the bus, to real motors or to a twin."""

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vd.deploy.finding import BAUD_RATE
from vd.deploy.twin.child import TwinChild

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel
    from vd.deploy.hardware.bus import MotorBus
    from vd.deploy.hardware.joints import Joints

MOTOR = "XH430-V210"
"""The motors whose stall torque is the hand's effort limit."""
RETRIES, TWIN_RETRIES = 1, 3
"""The twin is a process among others, which may not run for longer than the SDK waits for an answer."""


@dataclass(frozen=True)
class HandOptions:
    """Which hand, and where its motors are."""

    hand: str = "dclaw3"
    """dclaw3, dclaw4 or a hand's USD."""
    hand_layer: Path | None = None
    """Identified servo model over the hand (identified.usda); a twin moves as it says."""
    port: str | None = None
    """Serial port of the motors, such as /dev/ttyUSB0."""
    twin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Simulate the motors and the hand in place of --port."""
    twin_args: str = ""
    """More options of the twin: --twin-args="--lose 0.01"; see python -m vd.deploy.twin.twin --help."""
    calibration: Path | None = None
    """Calibration file of the joints' motors; IDs 10, 11, 12, 20, ... with zero in the middle by default."""
    motor: str = MOTOR
    """Model of the motors."""
    baud_rate: int = BAUD_RATE
    """Of the port."""


@dataclass(frozen=True)
class Connection:
    """A hand and the bus to its motors."""

    hand: "HandModel"
    """The hand, with its layer."""
    joints: "Joints"
    """Which motor turns which joint."""
    bus: "MotorBus"
    """Its motors, in the joints' order."""


def read_hand_and_joints(options: HandOptions) -> tuple["HandModel", "Joints"]:
    """The hand of the options and its motors.

    Raises:
        ValueError: Motor, hand, layer or calibration cannot be used.
    """
    from vd.assets_usd.hands import load_hand
    from vd.deploy.hardware.control_table import MODELS
    from vd.deploy.hardware.joints import read_joints, uncalibrated

    if options.motor not in MODELS:
        raise ValueError(f"--motor {options.motor}: no such motor; choose of {', '.join(MODELS)}")
    hand = load_hand(options.hand, layer=options.hand_layer)
    if options.calibration is None:
        return hand, uncalibrated(hand)
    return hand, read_joints(options.calibration, hand)


@contextlib.contextmanager
def open_port(options: HandOptions, twin_options: Sequence[str] = ()) -> Iterator[str]:
    """The serial port of the options; a twin behind it is started, and ended with the block.

    Args:
        options: The options.
        twin_options: More of the twin's, if there is one.

    Raises:
        ValueError: Neither or both of a port and a twin are asked for.
        TwinError: The twin did not start.
    """
    if options.twin == (options.port is not None):
        raise ValueError("give --port, such as /dev/ttyUSB0, or --twin for a simulated hand")
    if options.port is not None:
        yield options.port
        return
    print("starting the twin ...", file=sys.stderr, flush=True)
    arguments = ["--hand", options.hand, "--model", options.motor]
    if options.hand_layer is not None:
        arguments += ["--hand-layer", str(options.hand_layer)]
    if options.calibration is not None:
        arguments += ["--calibration", str(options.calibration)]
    twin = TwinChild([*arguments, *twin_options, *options.twin_args.split()])
    try:
        yield twin.path
    finally:
        twin.close()


@contextlib.contextmanager
def connect(options: HandOptions, twin_options: Sequence[str] = ()) -> Iterator[Connection]:
    """Open the bus to the hand of the options.

    Args:
        options: The options.
        twin_options: More of the twin's, if there is one.

    Raises:
        ValueError: Options that cannot be.
        TwinError: The twin did not start.
        BusError: The port cannot be opened.
    """
    from vd.deploy.hardware.bus import MotorBus, check_wiring

    hand, joints = read_hand_and_joints(options)
    retries = TWIN_RETRIES if options.twin else RETRIES
    with open_port(options, twin_options) as port:
        bus = MotorBus(
            port,
            joints.ids,
            options.motor,
            baud_rate=options.baud_rate,
            retries=retries,
            remedy=_check_twin if options.twin else check_wiring,
        )
        with bus:
            yield Connection(hand, joints, bus)


def _check_twin() -> str:
    """What to try where a twin is silent: it has no cable, but this computer's processors."""
    return (
        f"the twin is a program on this computer (load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores): "
        "others may keep it from answering, or its --twin-args have it be silent"
    )
