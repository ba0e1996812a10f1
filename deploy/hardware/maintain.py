"""Restart a motor, or give it another ID or baud rate: read first, asked before, checked afterwards."""

import contextlib
from dataclasses import dataclass
from typing import Annotated

import tyro

from vd.deploy.finding import command
from vd.deploy.hardware.answers import CLOCK_TOLERANCE_S, BusError, GarbledError, LateError
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.check import confirm
from vd.deploy.hardware.connect import BAUD_RATE
from vd.deploy.hardware.control_table import (
    BAUD_RATES,
    MODELS,
    TICK_MODULUS,
    describe_hardware_error,
    model_name,
    to_angle,
)
from vd.deploy.hardware.packets import MAX_ID
from vd.deploy.hardware.port import pseudo

RESTART_S = 5.0
"""Longest time that a motor takes to answer after a restart; they need about half a second."""
ASK_AGAIN_S = 0.2
CLOCK_S = TICK_MODULUS / 1000.0
"""After which a motor's clock begins anew by itself."""


@dataclass(frozen=True, kw_only=True)
class MotorOptions:
    """One motor on a port."""

    id: tyro.conf.Positional[int]
    """Its ID."""
    port: str
    """Serial port of the motors, such as /dev/ttyUSB0."""
    baud_rate: int = BAUD_RATE
    """At which it answers; vd-deploy scan finds it."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it is written."""


@dataclass(frozen=True, kw_only=True)
class RebootCfg(MotorOptions):
    """Restart a motor whose torque is off: its error is cleared, and it counts angles within one turn."""


@dataclass(frozen=True, kw_only=True)
class SetIdCfg(MotorOptions):
    """Give a motor whose torque is off another ID, which it keeps without power."""

    new: tyro.conf.Positional[int]
    """Its new ID, which no other motor on the line may have."""


@dataclass(frozen=True, kw_only=True)
class SetBaudCfg(MotorOptions):
    """Give a motor whose torque is off another baud rate, which it keeps without power."""

    new: tyro.conf.Positional[int]
    """Its new baud rate."""


def open_bus(cfg: MotorOptions, baud_rate: int) -> MotorBus:
    """The bus to a motor of any model, at a baud rate."""
    return MotorBus(cfg.port, [cfg.id], next(iter(MODELS)), baud_rate=baud_rate)


def _check_id(option: str, id: int) -> None:
    if not 0 <= id <= MAX_ID:
        raise ValueError(f"{option} {id}: an ID lies within 0 and {MAX_ID}")


def _look(bus: MotorBus, cfg: MotorOptions) -> tuple[str, dict[str, int]]:
    """The model and the control table of the motor, which is empty where it answers to pings alone.

    Raises:
        BusError: It does not answer, two answer, or its torque is on.
    """
    number = bus.ping(cfg.id)
    if number is None:
        scan = command("scan", cfg.port)
        raise BusError(f"motor {cfg.id} does not answer at {cfg.baud_rate} baud: {scan} finds who does")
    try:
        table = bus.read_table(cfg.id)
    except (GarbledError, LateError):
        raise
    except BusError:
        table = {}
    if table.get("torque_enable"):
        raise BusError(
            f"motor {cfg.id} has its torque on: end the program that moves it; support what it holds, and "
            f"{bus.command('home')} ends with the torque off"
        )
    return model_name(number), table


def reboot(cfg: RebootCfg) -> int:
    """Restart a motor; 1 if its error came again.

    Raises:
        BusError: It does not answer, two answer, its torque is on, or it did not restart.
    """
    _check_id("reboot", cfg.id)
    with open_bus(cfg, cfg.baud_rate) as bus:
        model, table = _look(bus, cfg)
        looked = bus.clock.now()
        if table:
            error = describe_hardware_error(table["hardware_error_status"])
            state = f"its torque is off, its hardware error is: {error}"
        else:
            state = "it answers to pings alone, so whether it holds something is not known: it lets go"
        confirm(
            f"Motor {cfg.id}, {model}, will restart, with the gains of the factory; {state}.", yes=cfg.yes
        )
        with contextlib.suppress(BusError):  # a status_return_level of 0 leaves it unanswered
            bus.reboot(cfg.id)
        table = _wait(bus, cfg.id, table.get("realtime_tick"), looked)
    error = describe_hardware_error(table["hardware_error_status"])
    angle = to_angle(table["present_position"])
    print(f"motor {cfg.id} has restarted: at {angle:.2f} rad, hardware error: {error}")
    return 1 if table["hardware_error_status"] else 0


def _wait(bus: MotorBus, id: int, tick: int | None, looked: float) -> dict[str, int]:
    """The control table of a motor that has restarted: its clock began anew.

    Args:
        bus: The bus.
        id: The motor.
        tick: What its clock said before [ms]; None where it could not be read.
        looked: When [s].

    Raises:
        BusError: It has not.
    """
    why, asked = "its clock went on", bus.clock.now()
    while bus.clock.now() - asked < RESTART_S:
        bus.clock.sleep(ASK_AGAIN_S)
        try:
            table = bus.read_table(id)
        except BusError as error:
            why = str(error)
            continue
        if tick is None:
            return table
        ahead = (table["realtime_tick"] - tick) / 1000.0 - (bus.clock.now() - looked)
        if abs((ahead + 0.5 * CLOCK_S) % CLOCK_S - 0.5 * CLOCK_S) > CLOCK_TOLERANCE_S:
            return table
    raise BusError(f"motor {id} did not restart within {RESTART_S:g} s ({why}): switch its power off and on")


def set_id(cfg: SetIdCfg) -> int:
    """Give a motor another ID.

    Raises:
        ValueError: IDs that cannot be.
        BusError: It does not answer, two answer, its torque is on, or the new ID is taken.
    """
    _check_id("set-id", cfg.id)
    _check_id("set-id", cfg.new)
    if cfg.id == cfg.new:
        raise ValueError(f"set-id {cfg.id} {cfg.new}: that is its ID")
    with open_bus(cfg, cfg.baud_rate) as bus:
        model, _ = _readable(bus, cfg)
        if _answers(bus, cfg.new):
            raise BusError(f"ID {cfg.new} is taken: a motor on the line answers to it; give that one another")
        confirm(f"Motor {cfg.id}, {model}, will have the ID {cfg.new}, and keep it.", yes=cfg.yes)
        _write(bus, cfg.id, "id", cfg.new)
        if _answers(bus, cfg.id) or not _answers(bus, cfg.new):
            raise BusError(f"motor {cfg.id} did not take the ID {cfg.new}: {command('scan', cfg.port)}")
    print(f"motor {cfg.id} is now motor {cfg.new}")
    return 0


def set_baud(cfg: SetBaudCfg) -> int:
    """Give a motor another baud rate.

    Raises:
        ValueError: A baud rate that motors do not have.
        BusError: The adapter lacks it, the motor does not answer, two answer, its torque is on, or its ID is
            taken at that rate.
    """
    _check_id("set-baud", cfg.id)
    if cfg.new not in BAUD_RATES:
        raise ValueError(f"set-baud {cfg.new}: motors have {', '.join(map(str, BAUD_RATES))}")
    if cfg.new == cfg.baud_rate:
        raise ValueError(f"set-baud {cfg.new}: that is its rate; --baud-rate is the one at which it answers")
    with open_bus(cfg, cfg.new) as bus:  # before anything is written: whether the adapter has this rate
        if not pseudo(bus.port) and _answers(bus, cfg.id):
            raise BusError(f"ID {cfg.id} is taken at {cfg.new} baud: give one of the two another ID")
    with open_bus(cfg, cfg.baud_rate) as bus:
        model, _ = _readable(bus, cfg)
        confirm(f"Motor {cfg.id}, {model}, will have {cfg.new} baud, and keep it.", yes=cfg.yes)
        _write(bus, cfg.id, "baud_rate", BAUD_RATES.index(cfg.new))
    with open_bus(cfg, cfg.new) as bus:
        if not _answers(bus, cfg.id):
            raise BusError(
                f"motor {cfg.id} does not answer at {cfg.new} baud: {command('scan', cfg.port)} finds it"
            )
    print(f"motor {cfg.id} is now at {cfg.new} baud")
    return 0


def _readable(bus: MotorBus, cfg: MotorOptions) -> tuple[str, dict[str, int]]:
    """The model and the control table of a motor that answers more than pings.

    Raises:
        BusError: It does not.
    """
    model, table = _look(bus, cfg)
    if not table:
        raise BusError(f"motor {cfg.id} answers to pings alone: {bus.command(f'reboot {cfg.id}')} first")
    return model, table


def _answers(bus: MotorBus, id: int) -> bool:
    """Whether a motor, or several, answer to an ID."""
    try:
        return bus.ping(id) is not None
    except GarbledError:
        return True


def _write(bus: MotorBus, id: int, name: str, value: int) -> None:
    """Write an item that changes how a motor is reached: what it answers to that counts for nothing."""
    with contextlib.suppress(BusError):
        bus.write(id, name, value)
