"""dynamixel-sdk, unchanged, against simulated motors behind a pseudo-terminal."""

import time

import numpy as np
import pytest

sdk = pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from motor_line import Faults  # noqa: E402
from motor_model import Motor  # noqa: E402
from motor_packets import Failure  # noqa: E402
from motor_terminal import MotorTerminal  # noqa: E402
from simulated_hand import simulated_bus  # noqa: E402

from vd.assets_usd.hands import load_hand  # noqa: E402
from vd.deploy.hardware.answers import (  # noqa: E402
    STATE_ADDRESS,
    STATE_BYTES,
    Answer,
    BusError,
    LateError,
    SilentError,
    StateCheck,
)
from vd.deploy.hardware.bus import MotorBus  # noqa: E402
from vd.deploy.hardware.control_table import MODELS, to_angle  # noqa: E402
from vd.deploy.hardware.joints import read_joints  # noqa: E402
from vd.deploy.hardware.registers import MotorSettings  # noqa: E402

IDS = (10, 11, 12)
MODEL = "XH430-V210"
MODELS_OF_ALL = [MODELS[MODEL]] * len(IDS)
LIMITS = MotorSettings(current_limit_a=0.5, velocity_limit_rad_s=1.0, lower_rad=-1.0, upper_rad=1.2)


@pytest.fixture
def twin():
    with MotorTerminal([Motor(MODELS[MODEL], id) for id in IDS]) as served:
        yield served


@pytest.fixture
def bus(twin):
    # The SDK waits 34 ms for an answer; on a busy machine the twin may not run for longer.
    with MotorBus(twin.path, IDS, MODELS_OF_ALL, retries=20) as opened:
        yield opened


def ready(bus: MotorBus) -> None:
    bus.configure(dict.fromkeys(bus.ids, LIMITS))
    assert bus.torque(True) == {}


def settle(bus: MotorBus, seconds: float = 1.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        state = bus.read_state()
        time.sleep(0.02)
    return state


def test_the_sdk_finds_the_motors(bus, twin):
    assert bus.missing() == {}
    found, result = sdk.PacketHandler(2.0).broadcastPing(bus._port)
    assert result == sdk.COMM_SUCCESS and sorted(found) == list(IDS)


def test_a_port_is_for_one_program_at_a_time_and_says_why_it_cannot_be_opened(bus, twin):
    with pytest.raises(BusError, match=f"another program .*`fuser -v {twin.path}`"):
        MotorBus(twin.path, IDS, MODELS_OF_ALL)
    with pytest.raises(BusError, match=r"There are: "):
        MotorBus("/dev/ttyUSB99", IDS, MODELS_OF_ALL)
    bus.close()
    with pytest.raises(BusError, match="is lost"):
        bus.read_state()
    with MotorBus(twin.path, IDS, MODELS_OF_ALL, retries=20) as again:
        again.read_state()


def test_goals_are_reached_by_the_settings_that_were_written(bus, twin):
    """At the speed that is allowed, and no farther than the limits."""
    ready(bus)
    assert bus.read(11, "position_p_gain") == 200
    assert twin.motors[1].get("current_limit") == int(0.5 / 1.34e-3)
    bus.write_goals(np.array([0.5, -0.4, 3.0]))
    first = bus.read_state()
    second = settle(bus, 0.3)
    rate = (second.position - first.position) / (second.time_s - first.time_s)
    np.testing.assert_allclose(rate[0], 1.0, rtol=0.2)
    state = settle(bus, 1.5)
    np.testing.assert_allclose(state.position, [0.5, -0.4, 1.2], atol=0.005)
    assert not state.alert.any()
    with pytest.raises(ValueError, match="finite angles"):
        bus.write_goals(np.array([0.0, np.nan, 0.0]))


@pytest.mark.parametrize(
    ("name", "value", "torque", "failure"),
    [
        ("position_p_gain", 20000, 0, Failure.RANGE),
        ("goal_position", 4000, 0, Failure.LIMIT),
        ("model_number", 1, 0, Failure.ACCESS),
        ("current_limit", 100, 1, Failure.ACCESS),
        ("goal_position", 2100, 1, Failure.NONE),
    ],
)
def test_motors_refuse_what_the_manual_says(name, value, torque, failure):
    motor = Motor(MODELS[MODEL], 1)
    motor.put("max_position_limit", 3000)
    motor.put("torque_enable", torque)
    item = motor.items[name]
    before = bytes(motor.memory)
    assert motor.write(item.address, item.to_bytes(value)) == failure
    assert (bytes(motor.memory) == before) == (failure != Failure.NONE)
    assert motor.write(item.address, b"") == Failure.LENGTH


def test_a_blocked_motor_shuts_down_and_says_why_until_rebooted(bus, twin):
    full = MotorSettings(
        current_limit_a=0.923, velocity_limit_rad_s=5.0, lower_rad=-1.5, upper_rad=1.5
    )
    bus.configure(dict.fromkeys(IDS, full))
    bus.torque(True)
    twin.plant.blocked[1] = True
    bus.write_goals(np.array([0.2, 1.4, 0.2]))
    end = time.monotonic() + 30.0
    while not bus.read_state().alert[1] and time.monotonic() < end:
        time.sleep(0.02)
    state = bus.read_state()
    assert state.alert.tolist() == [False, True, False]
    assert bus.hardware_errors() == {11: "overload"}
    assert bus.read(11, "torque_enable") == 0 and state.current[1] == 0.0
    assert "not available" in bus.torque(True, [11])[11]
    twin.motors[1].reboot()
    bus.configure(dict.fromkeys(IDS, full))
    assert bus.hardware_errors() == {}


@pytest.mark.parametrize("starved_s", [0.0, 0.05])
def test_a_program_that_did_not_run_is_not_called_a_lost_cable(starved_s):
    hand = load_hand("dclaw3")
    with simulated_bus(hand, read_joints(hand)) as (line, bus):
        line.port.starved_s = starved_s
        line.faults.cut_off.add(11)
        ask = (lambda: bus.read(11, "drive_mode"), bus.read_state, bus.read_torque)
        for one in ask:
            with pytest.raises(LateError if starved_s else SilentError) as caught:
                one()
            assert ("computer is busy" in str(caught.value)) == bool(starved_s)
            assert ("cable" in str(caught.value)) != bool(starved_s)
        assert ("cable" in bus.missing()[11]) != bool(starved_s)


def test_late_lost_and_corrupted_states_are_not_taken_for_fresh_ones(bus, twin):
    """Axes move all the time.

    Each accepted state is compared with where they were when it was read.
    """
    ready(bus)
    twin.faults = Faults(lose=0.02, corrupt=0.05, truncate=0.03, late=0.05, late_s=0.06, seed=1)
    accepted = 0
    begin = time.monotonic()
    for step in range(150):
        bus.write_goals(0.8 * np.sin(2.0 * (time.monotonic() - begin)) * np.ones(3))
        try:
            state = bus.read_state()
        except BusError:
            continue
        accepted += 1
        # The twin moves on meanwhile: 2 rad/s for less than 50 ms.
        np.testing.assert_allclose(state.position, twin.plant.position, atol=0.12)
        time.sleep(0.01 * (step % 2))
    assert accepted > 60
    assert bus.rejected > 10


def test_the_answer_to_a_question_that_was_given_up_is_not_taken_for_the_next_ones():
    """A line that was 50 ms behind once and 20 from then on was a question late all the time."""
    hand = load_hand("dclaw3")
    given_up = []
    with simulated_bus(hand, read_joints(hand)) as (line, bus):
        first = bus.read_state()
        for step in range(40):
            bus.clock.sleep(0.005)
            line.port.lag_s = (0.0, 0.05, 0.02)[(step >= 10) + (step > 10)]
            try:
                state = bus.read_state(retries=0)
            except BusError:
                given_up.append(step)
                continue
            gone_s = 1e-3 * (state.tick - first.tick)
            np.testing.assert_allclose(gone_s, state.time_s - first.time_s, rtol=0.0, atol=0.003)
    assert given_up == [10]


def test_the_second_answer_to_a_question_asked_twice_is_not_taken_for_the_next_ones():
    """A starved line answers a first try only after the second was sent, and that one later still."""
    hand = load_hand("dclaw3")
    with simulated_bus(hand, read_joints(hand)) as (line, bus):
        bus.retries = 1
        motor = line.motors[0]
        motor.put("position_p_gain", 321)
        motor.put("position_d_gain", 12)
        line.port.lag_s = 0.06  # the SDK waits for 34 ms
        first = bus.read(motor.id, "position_p_gain")
        line.port.lag_s = 0.0
        bus.clock.sleep(0.03)
        assert (first, bus.read(motor.id, "position_d_gain")) == (321, 12)


@pytest.mark.parametrize("counts", [25_882_000, -25_882_000])
def test_a_position_that_no_motor_can_count_is_refused_before_any_other_is_known(counts):
    """As from a broken packet whose checksum happens to be right."""
    motor = Motor(MODELS[MODEL], 11)
    check = StateCheck([11], [MODELS[MODEL]])
    far = bytearray(motor.memory[STATE_ADDRESS : STATE_ADDRESS + STATE_BYTES])
    sound = bytes(far)
    start = motor.items["present_position"].address - STATE_ADDRESS
    far[start : start + 4] = counts.to_bytes(4, "little", signed=True)
    with pytest.raises(BusError, match=rf"motor 11: its position .*{counts} counts"):
        check.accept(0.0, [Answer(11, 0, False, bytes(far))])
    assert check.accept(0.0, [Answer(11, 0, False, sound)]).position[0] == 0.0


def test_goals_arrive_with_the_question_for_the_state_unless_others_are_sent_before(bus, twin):
    ready(bus)
    goals = np.array([0.3, -0.3, 0.2])

    def told() -> np.ndarray:
        return np.array([to_angle(motor.get("goal_position")) for motor in twin.motors])

    first = told()
    bus.write_goals(goals, with_state=True)
    time.sleep(0.05)
    np.testing.assert_array_equal(told(), first)
    bus.read_state()
    np.testing.assert_allclose(told(), goals, atol=0.001)
    bus.write_goals(goals + 0.1, with_state=True)
    bus.write_goals(np.zeros(3))  # as a stop of the hand does
    bus.read_state()
    np.testing.assert_allclose(told(), 0.0, atol=0.001)
