"""Move a hand slowly to the pose in which an episode starts."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import tyro

from vd.command.config import require
from vd.deploy.hardware.check import ready
from vd.deploy.hardware.connect import HandOptions, connect
from vd.deploy.safety.limits import SafetyCfg
from vd.deploy.safety.safety import SafeHand

SPEED_RAD_S = 0.5
"""A tenth of what the joints can: time to reach the switch."""
CLOSE_RAD = 0.15
"""Distance from the pose that counts as there: gravity bends the joints by 0.1 rad at the paper's
gain.
"""


@dataclass(frozen=True)
class HomeCfg(HandOptions):
    """Move slowly to the pose in which an episode starts, then switch the torque off."""

    speed: float = SPEED_RAD_S
    """Of the joint with the farthest way [rad/s]."""
    safety: SafetyCfg = field(default_factory=SafetyCfg)
    """Limits; --safety.then hold leaves the hand there with its torque on."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves."""


def home(cfg: HomeCfg) -> int:
    """Move; 1 if the hand did not come there."""
    require(cfg, "--", "positive", "speed")
    with connect(cfg) as connection:
        pose = connection.hand.start
        ready(connection, f"The hand will move to its start at {cfg.speed:g} rad/s.", yes=cfg.yes)
        with SafeHand(connection.bus, connection.joints, cfg.safety) as safe:
            safe.arm()
            safe.move(pose, cfg.speed)
            left = np.abs(safe.read().position - pose)
    axis = int(np.argmax(left))
    print(f"farthest from its place: {connection.joints.names[axis]}, {left[axis]:.3f} rad")
    return 0 if left[axis] < CLOSE_RAD else 1
