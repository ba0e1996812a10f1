"""States are timed by the motors' own clocks, whatever a packet waited for on its way."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vd.deploy.hardware.control_table import TICK_MODULUS
from vd.deploy.hardware.motor_time import measured_at


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
