import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, floats, indices, launch

from vd.kernels.task.contacts import restitution_kernel

OTHER, TABLE, OBJECT, HAND = 0, 1, 2, 3
LOWEST = 0.05


def references(device, nominal, kind, qd, coefficients, threshold=0.2, column=3):
    """Launch; returns references [N, G, 2], NaN where the kernel wrote nothing."""
    inputs = [nominal, kind, TABLE, HAND, column, threshold, LOWEST, qd, *coefficients]
    return launch(restitution_kernel, kind.shape, inputs, device, kind.shape)[0]


def oracle_ratio(e):
    """Solve e = exp(-pi z / sqrt(1 - z^2)) for z by bisection, in [LOWEST, 1]."""
    low, high = 0.0, 1.0
    if e <= 0.0:
        return 1.0
    for _ in range(60):
        z = 0.5 * (low + high)
        low, high = (z, high) if np.exp(-np.pi * z / np.sqrt(1.0 - z * z)) > e else (low, z)
    return float(np.clip(0.5 * (low + high), LOWEST, 1.0))


@EXAMPLES
@given(data=st.data())
def test_references_are_those_of_the_damped_spring(device, data):
    worlds, geoms = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 5))
    kind = data.draw(indices((worlds, geoms), 4))
    nominal = data.draw(floats((worlds, geoms, 2), 0.01, 1.0))
    qd = data.draw(floats((worlds, 9), -0.3, 0.3))
    coefficients = data.draw(floats((3, worlds), 0.0, 1.0))
    out = references(device, nominal, kind, qd, coefficients)
    speed = np.linalg.norm(qd[:, 3:6].astype(float), axis=1)
    for w in range(worlds):
        if abs(speed[w] - 0.2) < 1e-6:
            continue  # either side of the threshold in single precision
        for g in range(geoms):
            if kind[w, g] not in (TABLE, HAND):
                assert np.isnan(out[w, g]).all()
                continue
            own = coefficients[2 if kind[w, g] == TABLE else 0, w]
            ratio = oracle_ratio(0.5 * (own + coefficients[1, w])) if speed[w] > 0.2 else 1.0
            expected = [nominal[w, g, 0] / ratio, nominal[w, g, 1] * ratio]
            np.testing.assert_allclose(out[w, g], expected, rtol=2e-5)
            # The stiffness, which sets how deep a resting object sinks, stays.
            assert np.prod(out[w, g]) == pytest.approx(np.prod(nominal[w, g]), rel=1e-5)
