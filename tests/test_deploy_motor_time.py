"""States are timed by the motors' own clocks, whatever a packet waited for on its way."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vd.deploy.control_table import TICK_MODULUS
from vd.deploy.motor_time import arrived_at, measured_at


@given(seed=st.integers(0, 2**32 - 1), rate=st.floats(-1e-4, 1e-4), begin=st.floats(0.0, 60.0))
def test_late_packets_do_not_move_the_times_of_states(seed, rate, begin):
    rng = np.random.default_rng(seed)
    true = 1000.0 + 0.01 * np.arange(300) + rng.uniform(0.0, 0.002, 300)
    phase = begin + rng.uniform(0.0, 1e-3, 9)
    ticks = (1e3 * ((true[:, None] - 1000.0) * (1.0 + rate) + phase)).astype(int) % TICK_MODULUS
    waited = np.where(rng.random(300) < 0.25, rng.uniform(0.0, 0.02, 300), rng.uniform(0.0, 1e-4, 300))
    found = measured_at(true - waited, ticks)
    assert np.abs(found - true).max() < 0.7e-3
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.3e-3


@given(seed=st.integers(0, 2**32 - 1), given_up=st.integers(20, 60), caught_up=st.integers(80, 120))
def test_goals_arrive_with_their_own_question_though_answers_come_a_sample_late(seed, given_up, caught_up):
    """A motor line that was 25 ms behind at one question answered the question before from then on."""
    rng = np.random.default_rng(seed)
    sent = 0.014 * np.arange(150) + rng.uniform(0.0, 0.002, 150)
    heard = sent + rng.uniform(0.0, 3e-4, 150)
    answered = np.arange(150)
    answered[given_up + 1 : caught_up] -= 1
    kept = np.delete(np.arange(150), [given_up, caught_up - 1])  # no answer, and two of which one counts
    found = arrived_at(sent[kept], (heard + rng.normal(0.0, 1e-4, 150))[answered[kept]])
    np.testing.assert_allclose(found, heard[kept], rtol=0.0, atol=1e-3)
