"""Limits of a hand that hold whatever decides on its goals.

Which goals are sent, and which states end it.

Angles [rad] and speeds [rad/s] are the joints'.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.command.config import require
from vd.deploy.hardware.answers import HandState
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.hardware.registers import RESTART
from vd.paper import PAPER

PERIOD_S = 1.0 / PAPER.scene.control_hz
OUTSIDE_RAD = 0.1
"""How far a joint may hang out of its range and still be brought back slowly."""
BLOCKED_SHARE = 0.5
"""Distance from its goal, over the farthest that a goal may be, from which a joint is to move."""
STANDING_RAD_S = 0.1
"""Speed below which it does not."""
SHUTDOWN_C = 10.0
"""How far below the temperature at which a motor shuts down the hand is stopped."""


@dataclass(frozen=True)
class SafetyCfg:
    """Limits that hold whatever the policy asks for."""

    margin_rad: float = 0.0
    """Distance that goals keep from the ends of the joints' ranges [rad]."""
    step_rad: float = 0.35
    """Farthest goal from where a joint is [rad]: the policy asks for 3.5 rad/s / 12 Hz = 0.29 at
    most. It limits the torque as well, to stiffness times this."""
    blocked_s: float = 15.0
    """How long [s] a joint may stand at half of that or more from its goal: what blocks it is
    pressed for no longer. In the 10 s of a goal dclaw4 presses so for up to 9 s."""
    velocity_share: float = 1.5
    """Speed over the joints' own limit at which the hand is stopped; it turns faster only when
    something else moves it."""
    current_share: float = 0.8
    """Current over the one for the joints' largest torque at which the hand is stopped, if it
    lasts; motors shut down by themselves near 1. Motors whose mode limits their current may go on
    at that limit.
    """
    current_s: float = 0.5
    """How long [s] a current may be above that, or a voltage beyond ``voltage_share``."""
    voltage_share: float = 0.2
    """Deviation of a motor's voltage from its supply's, over the latter, at which the hand is
    stopped, if it lasts: under load it sags by less."""
    temperature_c: float = 70.0
    """Temperature [deg C] at which the hand is stopped, or 10 below that at which a motor shuts
    down.
    """
    lost_s: float = 3.0 * PERIOD_S
    """Time [s] without a sound state after which the bus is lost; shorter gaps repeat the last
    state.
    """
    misses: int = 3
    """Deadlines missed in a row at which the hand is stopped; also this many periods without a
    beat.
    """
    stale_s: float = 3.0 * PERIOD_S
    """Age [s] of the newest image at which the hand is stopped, once there was one."""
    pose_stale_s: float = 1.0
    """Age [s] of the newest pose of --pose at which the hand is stopped: for less long the object
    may be behind a finger, and a tracker of 10 Hz that drops one is 0.35 s old."""
    watchdog_s: float = 0.3
    """Silence [s] after which the motors stop by themselves; 0 for never. Above three control
    periods.
    """
    then: Literal["off", "hold"] = "off"
    """After the hold: torque off, or leave the hand holding."""
    hold_s: float = 1.0
    """How long [s] the hand holds before its torque goes off: time to support what it carries."""

    def __post_init__(self) -> None:
        """Refuse numbers that would switch a limit off by accident."""
        limits = (
            "step_rad blocked_s velocity_share current_share current_s voltage_share "
            "temperature_c lost_s misses stale_s pose_stale_s"
        )
        require(self, "safety.", "positive", limits)
        require(self, "safety.", "zero or positive", "margin_rad watchdog_s hold_s")


def out_of_range(hand: HandModel, q: np.ndarray) -> list[str]:
    """Joints that are too far out of their ranges to be brought back, in words with the remedy.

    Args:
        hand: The hand.
        q: Angles of its joints [rad] [D].
    """
    out = np.maximum(hand.lower - q, q - hand.upper)
    turns = np.round((q - 0.5 * (hand.lower + hand.upper)) / (2.0 * np.pi))
    wrong = []
    for axis in np.flatnonzero(out > OUTSIDE_RAD):
        # Turned by hand without torque a motor counts on; one that starts counts within one turn.
        mend = (
            f"it was turned round: {RESTART}"
            if turns[axis]
            else "move it by hand, or mend its calibration"
        )
        where = f"{q[axis]:.2f} rad, out of {hand.lower[axis]:.2f} to {hand.upper[axis]:.2f}"
        wrong.append(f"{hand.joint_names[axis]}: {where}: {mend}")
    return wrong


class Limits:
    """Limits of one hand; ``lower`` and ``upper`` are the least and largest goals [rad] [D].

    Raises:
        ValueError: The margin leaves a joint no range.
    """

    def __init__(self, joints: JointMotors, names: Sequence[str], cfg: SafetyCfg):
        hand = joints.hand
        self._names = tuple(names)
        self._cfg = cfg
        self.lower = hand.lower + cfg.margin_rad
        self.upper = hand.upper - cfg.margin_rad
        if (self.lower >= self.upper).any():
            raise ValueError(
                f"safety.margin_rad is {cfg.margin_rad}; some joint's range is no wider"
            )
        self._current = np.where(joints.capped, np.inf, cfg.current_share * joints.currents())
        shutdown_c = np.array([model.temperature_limit for model in joints.models])
        self._temperature = np.minimum(cfg.temperature_c, shutdown_c - SHUTDOWN_C)
        self._velocity = cfg.velocity_share * hand.velocity_limit
        self._supply = np.array([model.supply_v for model in joints.models])
        self._blocked = Lasting(cfg.blocked_s)
        self._strained = Lasting(cfg.current_s)
        self._weak = Lasting(cfg.current_s)

    def goal(self, target: np.ndarray, here: np.ndarray) -> np.ndarray:
        """The goal in range nearest to the target, but never far from the joints, all [D].

        A joint that is out of its range is brought back by steps.
        """
        inside = np.clip(target, self.lower, self.upper)
        return np.clip(inside, here - self._cfg.step_rad, here + self._cfg.step_rad)

    def passed(self, state: HandState, away: np.ndarray) -> str:
        """Which limit the newest state of the joints is beyond, in words; empty for none.

        Args:
            state: The state.
            away: Distance of each joint from the goal that it had until then [rad] [D]; zero for
                one that is let go.
        """
        far = np.abs(away) >= BLOCKED_SHARE * self._cfg.step_rad
        standing = np.abs(state.velocity) < STANDING_RAD_S
        off = np.abs(state.voltage - self._supply) > self._cfg.voltage_share * self._supply
        fast = np.abs(state.velocity) > self._velocity
        hot = state.temperature > self._temperature
        blocked = self._blocked(state.time_s, far & standing)
        strained = self._strained(state.time_s, np.abs(state.current) > self._current)
        weak = self._weak(state.time_s, off)
        for axis, name in enumerate(self._names):
            if fast[axis]:
                return f"{name}: {state.velocity[axis]:.1f} rad/s, over {self._velocity[axis]:.1f}"
            if hot[axis]:
                return (
                    f"{name}: {state.temperature[axis]:.0f} deg C, over {self._temperature[axis]:g}"
                )
            if strained[axis]:
                current = f"{state.current[axis]:.2f} A for {self._cfg.current_s:g} s"
                return f"{name}: {current}; is it blocked?"
            if blocked[axis]:
                return (
                    f"{name}: it stands {abs(away[axis]):.2f} rad from its goal for "
                    f"{self._cfg.blocked_s:g} s: free it, or raise --safety.blocked-s where it "
                    f"is to press for longer"
                )
            if weak[axis]:
                return (
                    f"{name}: {state.voltage[axis]:.1f} V for {self._cfg.current_s:g} s, not "
                    f"{self._supply[axis]:g}: check the supply and its wires"
                )
        return ""


class Lasting:
    """Which joints something has been true of for longer than ``seconds``."""

    def __init__(self, seconds: float):
        self._seconds = seconds
        self._since = np.array(np.inf)

    def __call__(self, time_s: float, now: np.ndarray) -> np.ndarray:
        """Of which it has, shape [D] bool.

        Args:
            time_s: The present [s].
            now: Of which it is true at present, shape [D] bool.
        """
        self._since = np.where(now, np.minimum(self._since, time_s), np.inf)
        return time_s - self._since > self._seconds
