"""Restart a motor: read first, asked before, checked afterwards."""

import contextlib
from dataclasses import dataclass
from typing import Annotated

import tyro

from vd.deploy.hardware.answers import BusError, GarbledError, LateError
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.check import confirm
from vd.deploy.hardware.control_table import MODELS, describe_hardware_error, to_angle
from vd.deploy.hardware.port import BAUD_RATE

RESTART_S = 1.0
"""Time that a motor is given to restart [s]; they need about half of it."""


@dataclass(frozen=True, kw_only=True)
class RebootCfg:
    """Restart a motor whose torque is off: its error is cleared, and it counts angles within one turn."""

    id: tyro.conf.Positional[int]
    """Its ID."""
    port: str
    """Serial port of the motors, such as /dev/ttyUSB0."""
    baud_rate: int = BAUD_RATE
    """At which it answers."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it restarts."""


def reboot(cfg: RebootCfg) -> int:
    """Restart a motor; 1 if its error came again.

    Raises:
        BusError: It does not answer, two answer, or its torque is on.
    """
    with MotorBus(cfg.port, [cfg.id], next(iter(MODELS)), baud_rate=cfg.baud_rate) as bus:
        if bus.ping(cfg.id) is None:
            raise BusError(f"motor {cfg.id} does not answer at {cfg.baud_rate} baud; is it its rate and ID?")
        try:
            on, error = bus.read(cfg.id, "torque_enable"), _error(bus, cfg.id)
        except (GarbledError, LateError):
            raise
        except BusError:
            on, error = 0, "not known, as it answers to pings alone, nor whether it holds something"
        if on:
            raise BusError(
                f"motor {cfg.id} has its torque on: end the program that moves it; support what it holds, "
                f"and {bus.command('home')} ends with the torque off"
            )
        confirm(
            f"Motor {cfg.id} will restart, with the gains of the factory; its error is {error}.", yes=cfg.yes
        )
        with contextlib.suppress(BusError):  # a status_return_level of 0 leaves it unanswered
            bus.reboot(cfg.id)
        bus.clock.sleep(RESTART_S)
        error, angle = _error(bus, cfg.id), to_angle(bus.read(cfg.id, "present_position"))
    print(f"motor {cfg.id} has restarted: at {angle:.2f} rad, hardware error: {error}")
    return 0 if error == describe_hardware_error(0) else 1


def _error(bus: MotorBus, id: int) -> str:
    return describe_hardware_error(bus.read(id, "hardware_error_status"))
