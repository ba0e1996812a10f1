"""Settings of the physics: what makes them coarser."""

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from vd.sim.cfg import SimCfg, coarser


@given(
    substeps=st.integers(1, 40).map(lambda half: 2 * half),
    stiffness=st.floats(1.0, 4.0),
    iterations=st.integers(1, 50),
    ls_iterations=st.integers(1, 50),
)
def test_coarser_physics_is_valid_never_finer_and_coarse_at_once(
    substeps, stiffness, iterations, ls_iterations
):
    control_hz = SimCfg().control_hz
    cfg = replace(
        SimCfg(),
        physics_hz=substeps * control_hz,
        contact_time_constant_s=2.0 * stiffness / (substeps * control_hz),
        iterations=iterations,
        ls_iterations=ls_iterations,
    )
    cfg.validate()
    found = coarser(cfg)
    found.validate()
    assert found.physics_hz <= cfg.physics_hz and found.iterations <= cfg.iterations
    assert found.ls_iterations <= cfg.ls_iterations
    assert found.contact_time_constant_s >= cfg.contact_time_constant_s
    assert coarser(found) == found
    assert found.control_hz == control_hz


def test_what_is_simulated_by_default_gets_cheaper():
    assert coarser(SimCfg()).substeps < SimCfg().substeps
