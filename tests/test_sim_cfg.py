"""Settings of the physics: what makes them coarser."""

from dataclasses import replace

import pytest

from vd.sim.cfg import SimCfg, coarser

FINE, SLOW = (
    {"physics_hz": 240.0, "iterations": 2},
    {"physics_hz": 72.0, "contact_time_constant_s": 0.03},
)


@pytest.mark.parametrize("changes", [{}, FINE, SLOW])
def test_coarser_physics_is_valid_never_finer_and_coarse_at_once(changes):
    cfg = replace(SimCfg(), **changes)
    found = coarser(cfg)
    found.validate()
    assert found.physics_hz <= cfg.physics_hz and found.iterations <= cfg.iterations
    assert found.ls_iterations <= cfg.ls_iterations
    assert found.contact_time_constant_s >= cfg.contact_time_constant_s
    assert coarser(found) == found
    assert found.substeps < cfg.substeps or found == cfg
