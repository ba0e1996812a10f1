"""Find the motors on a line: who answers, at which rate, and how each differs from what the hand needs."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from vd.deploy.finding import command
from vd.deploy.hardware.connect import HandOptions, open_port, read_hand_and_joints

if TYPE_CHECKING:
    from vd.deploy.hardware.bus import MotorBus
    from vd.deploy.hardware.joints import Joints

BAUD_RATES = (57_600, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 115_200)
"""Rates of the motors, the ones that are met most first: the factory's, then ours."""
OUT_OF_THE_BOX = 1
"""ID of a motor that nobody has numbered."""


@dataclass(frozen=True)
class ScanCfg(HandOptions):
    """Find the motors on a line; nothing is written to them."""

    baud_rates: tuple[int, ...] = BAUD_RATES
    """Rates to try."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


@dataclass(frozen=True)
class FoundMotor:
    """One motor that answered."""

    id: int
    baud_rate: int
    model: str
    """Name, or its number where it is none of ours."""
    firmware: int
    garbled: bool = False
    """Whether what it answers beside a ping is no sound packet: several motors have this ID."""


def find(port: str, baud_rates: Sequence[int], say: Callable[[str], None]) -> list[FoundMotor]:
    """All motors that answer a broadcast ping, at each rate.

    Raises:
        BusError: The port cannot be opened.
    """
    from vd.deploy.hardware.answers import BusError
    from vd.deploy.hardware.bus import MotorBus
    from vd.deploy.hardware.control_table import MODELS, model_name

    found, refused = [], []
    for rate in baud_rates:
        try:
            with MotorBus(port, [OUT_OF_THE_BOX], next(iter(MODELS)), baud_rate=rate) as bus:
                answers = bus.ping_all()
                garbled = {id for id in answers if _garbled(bus, id)}
        except BusError as error:
            refused.append(error)  # not every adapter has every rate
            if len(refused) == len(baud_rates):
                raise
            continue
        say(f"{port} at {rate}: {len(answers)} motors")
        found += [
            FoundMotor(id, rate, model_name(number), firmware, id in garbled)
            for id, (number, firmware) in sorted(answers.items())
        ]
    return found


def _garbled(bus: "MotorBus", id: int) -> bool:
    """Whether several motors answer to one ID: what differs in their answers is garbled, but not a ping."""
    from vd.deploy.hardware.answers import BusError, GarbledError

    try:
        bus.read_table(id)
    except GarbledError:
        return True
    except BusError:  # it answers pings alone, or as no X motor does
        pass
    return False


def differences(
    found: Sequence[FoundMotor], joints: "Joints", model: str, baud_rate: int, port: str
) -> list[str]:
    """What differs from what the hand needs, a sentence for each, with the remedy."""
    from vd.deploy.hardware.control_table import MODELS

    wrong = []
    by_id: dict[int, list[FoundMotor]] = {}
    for motor in found:
        by_id.setdefault(motor.id, []).append(motor)
    spare = sorted(set(by_id) - set(joints.ids))
    # Where they are all of another model that we know, it is the option that is wrong.
    models = {motor.model for motor in found}
    other = models.pop() if len(models) == 1 and models <= set(MODELS) else ""
    remedy = f"give --motor {other}" if other else f"a hand has motors of one model of {', '.join(MODELS)}"
    for name, id in zip(joints.names, joints.ids, strict=True):
        if id not in by_id:
            guess = f"; is it {', '.join(f'ID {s}' for s in spare)}?" if spare else ""
            wrong.append(f"{name}: no motor {id} answers: check its cable, power and ID{guess}")
        for motor in by_id.get(id, []):
            if motor.baud_rate != baud_rate:
                mend = command(f"set-baud {id} {baud_rate}", port, motor.baud_rate)
                wrong.append(f"{name}: motor {id} is at {motor.baud_rate} baud, not {baud_rate}: {mend}")
            if motor.model != model:
                wrong.append(f"{name}: motor {id} is {motor.model}, not {model}: {remedy}")
    return wrong + _strangers(found, spare, by_id, port)


def _strangers(
    found: Sequence[FoundMotor], spare: Sequence[int], by_id: dict[int, list[FoundMotor]], port: str
) -> list[str]:
    """Motors that share an ID, are none of the hand's, or have another firmware than the rest."""
    wrong = []
    for motor in found:
        if motor.garbled:
            mend = command(f"set-id {motor.id} NEW", port, motor.baud_rate)
            wrong.append(f"motor {motor.id}: several have this ID: unplug one, then {mend} for the other")
    for id in spare:
        mend = command(f"set-id {id} NEW", port, by_id[id][0].baud_rate)
        wrong.append(f"motor {id} is none of the hand's: {mend} gives it its joint's; or --calibration")
    firmware = {motor.firmware for motor in found}
    if len(firmware) > 1:
        wrong.append(f"motors have firmware {', '.join(map(str, sorted(firmware)))}: update them to the same")
    return wrong


def scan(cfg: ScanCfg) -> int:
    """Find the motors and print them; 1 if they are not those of the hand."""
    from vd.deploy.hardware.port import pseudo

    _, joints = read_hand_and_joints(cfg)
    with open_port(cfg) as port:
        rates = [cfg.baud_rate] if pseudo(port) else cfg.baud_rates
        found = find(port, rates, lambda text: print(text, file=sys.stderr, flush=True))
    wrong = differences(found, joints, cfg.motor, cfg.baud_rate, port)
    if cfg.json:
        print(json.dumps({"motors": [asdict(motor) for motor in found], "differences": wrong}, indent=1))
    else:
        names = dict(zip(joints.ids, joints.names, strict=True))
        for motor in found:
            joint = names.get(motor.id, "-")
            print(
                f"{motor.id:>4} {joint:<6} {motor.model:<10} firmware {motor.firmware} {motor.baud_rate} baud"
            )
        print("\n".join(wrong) or f"all {len(joints.ids)} motors of {cfg.hand} are there")
    return 1 if wrong else 0
