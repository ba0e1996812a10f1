"""The part of the preflight that reads the motors' control tables, whole, and compares them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from vd.deploy.finding import Finding, listed
from vd.deploy.hardware.answers import BusError, GarbledError, LateError
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.connect import Connection
from vd.deploy.hardware.joints import CalibrationError
from vd.deploy.hardware.registers import Register, different, kept


def read_tables(bus: MotorBus, ids: Sequence[int]) -> tuple[dict[int, dict[str, int]], list[str]]:
    """Control tables of motors that answer a ping, and what is wrong with those that answer nothing else."""
    tables, wrong = {}, []
    for id in ids:
        try:
            tables[id] = bus.read_table(id)
        except (GarbledError, LateError) as error:
            wrong.append(str(error))
        except BusError:
            mend = bus.command(f"reboot {id}")
            wrong.append(f"motor {id} answers pings, but no reads: its status_return_level is 0; {mend}")
    return tables, wrong


Tables = Mapping[int, Mapping[str, int]]
"""Control tables by ID, each by item."""


def register_findings(connection: Connection, tables: Tables) -> Iterator[Finding]:
    """Compare control tables with what is wanted of them: a finding for each register that differs."""
    bus, what = connection.bus, "registers"
    try:
        rows = {**_different(connection, tables, ours=False), **_different(connection, tables, ours=True)}
    except CalibrationError as error:
        yield Finding(what, False, str(error))
        return
    for one, motors in rows.items():
        if one.remedy:
            values = [
                f"motor {id}: {value}; {one.remedy.format(reboot=bus.command(f'reboot {id}'), wanted=wanted)}"
                for id, value, wanted in motors
            ]
            yield Finding(one.name, False, f"{one.why}: {listed(values)}")
            continue
        where = " (kept without power)" if kept(bus.model, one) else ""
        yield Finding(one.name, True, f"{listed(_changes(motors))}{where}; else {one.why}")
    if not rows:
        yield Finding(what, True, "as the hand needs them")


def _changes(motors: Iterable[tuple[int, int, int]]) -> list[str]:
    """What will be set, motors that are alike together: of each its ID, value, and the wanted one."""
    alike: dict[tuple[int, int], list[str]] = {}
    for id, value, wanted in motors:
        alike.setdefault((value, wanted), []).append(str(id))
    return [
        f"motors {', '.join(ids)}: {value}; they will be set to {wanted}"
        if len(ids) > 1
        else f"motor {ids[0]}: {value}; it will be set to {wanted}"
        for (value, wanted), ids in alike.items()
    ]


def to_be_set(connection: Connection) -> str:
    """Which registers will be written, for the question whether they may be; empty for none.

    Raises:
        BusError: A motor does not answer.
    """
    bus = connection.bus
    rows = _different(connection, {id: bus.read_table(id) for id in bus.ids}, ours=True)
    names = [one.name + (" (kept without power)" if kept(bus.model, one) else "") for one in rows]
    return f"Of its motors {', '.join(names)} will be set. " if names else ""


def _different(
    connection: Connection, tables: Tables, *, ours: bool
) -> dict[Register, list[tuple[int, int, int]]]:
    """Registers that differ: of each the motors, with the value that each has and the wanted one.

    Raises:
        CalibrationError: A joint's range leaves the motor's one turn.
    """
    model = connection.bus.model
    settings = connection.joints.settings(connection.hand, model.name)
    rows: dict[Register, list[tuple[int, int, int]]] = {}
    for id, found in tables.items():
        for one, values in different(found, model, settings[id], ours=ours).items():
            rows.setdefault(one, []).append((id, *values))
    return rows
