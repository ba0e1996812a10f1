"""A friction that changes from motion to motion is told from one that does not, and is no name."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap_judge import FLOOR, made_up

from vd.gap.consensus import CHANGING, no_constant_friction
from vd.gap.coordinates import Coordinate
from vd.gap.explanation import Accepted, Explanation
from vd.gap.joint_fit import JointFit
from vd.gap.result import Verdict
from vd.gap.statistics import resamples
from vd.gap.verdict import Verdicts
from vd.gap.warming import change, warming

SAMPLES, WHEN = 400, np.linspace(3.0, 140.0, 12)
KEYS = ("kp", "coulomb_friction.tau_c_nm")
FRICTION = 0.3


def warm_fit(falls: float, seed: int, shown: float = 20.0) -> tuple[JointFit, float]:
    """A linear model of a gain and a constant friction, fitted where the friction falls by a share of it.

    Args:
        falls: Change of the friction over the recording, as a share of it.
        seed: Of the motions and the noise.
        shown: What a unit of the friction does to the samples, in noise floors.

    Returns:
        The fit, and the change that a fit of all samples with one finds.
    """
    rng = np.random.default_rng(seed)
    slopes = rng.normal(0.0, shown * FLOOR, (len(WHEN), SAMPLES, len(KEYS)))
    time = (WHEN - WHEN.mean()) / np.ptp(WHEN)
    measured = FRICTION * slopes[:, :, 1] * (1.0 + falls * time[:, None])
    measured += 2.0 * slopes[:, :, 0] + rng.normal(0.0, FLOOR, measured.shape)
    flat, target = slopes.reshape(-1, len(KEYS)), measured.ravel()
    x = np.linalg.lstsq(flat, target, rcond=None)[0]
    residual = measured - slopes @ x
    moving = np.repeat(time, SAMPLES) * x[1] * flat[:, 1]
    left = np.linalg.lstsq(np.column_stack([flat, moving]), residual.ravel(), rcond=None)[0]
    fit = replace(
        made_up(("coulomb_friction",), FLOOR),
        coordinates=tuple(Coordinate(key, i, False, 1.0, -9.0, 9.0) for i, key in enumerate(KEYS)),
        x=x,
        sse=np.sum(residual**2, axis=1),
        count=np.full(len(WHEN), float(SAMPLES)),
        gram=np.einsum("sni,snj->sij", slopes, slopes),
        gradient=np.einsum("sni,sn->si", slopes, residual),
    )
    return fit, float(left[-1])


@pytest.mark.parametrize("falls", [-0.8, 0.0, 0.5])
def test_the_change_is_that_of_a_fit_of_all_samples(falls: float) -> None:
    inside = 0
    for seed in range(40):
        fit, expected = warm_fit(falls, seed)
        share, width = change(fit, "coulomb_friction", WHEN, FLOOR)
        assert share == pytest.approx(expected, abs=1e-3)
        inside += abs(share - falls) < width
    assert inside >= 34, "95 % intervals"


def test_a_coordinate_that_is_a_logarithm_changes_by_the_same_share() -> None:
    fit, expected = warm_fit(-0.4, 1)
    log = (fit.coordinates[0], replace(fit.coordinates[1], log=True))
    tau = fit.x[1]
    gram, gradient = fit.gram.copy(), fit.gradient.copy()
    gram[:, 1] *= tau
    gram[:, :, 1] *= tau
    gradient[:, 1] *= tau
    same = replace(fit, coordinates=log, x=np.log(fit.x), gram=gram, gradient=gradient)
    assert change(same, "coulomb_friction", WHEN, FLOOR)[0] == pytest.approx(expected, abs=1e-3)


def test_only_a_sure_and_large_change_of_a_friction_counts() -> None:
    assert "falls over the recording by 8" in warming(warm_fit(-0.8, 2)[0], WHEN, FLOOR)
    assert "rises" in warming(warm_fit(0.8, 2)[0], WHEN, FLOOR)
    assert warming(warm_fit(-0.8, 2, shown=0.2)[0], WHEN, FLOOR) == "", "not sure"
    assert warming(warm_fit(-0.1, 2)[0], WHEN, FLOOR) == "", "small"
    play = replace(warm_fit(-0.8, 2)[0], effects=("backlash",))
    assert warming(play, WHEN, FLOOR) == "", "no friction"


def test_a_friction_that_changes_is_no_name() -> None:
    judge = Verdicts(floor=FLOOR, weights=resamples(len(WHEN), np.random.default_rng(0)), when=WHEN)

    def concluded(falls: float, left: float = FLOOR) -> Explanation:
        fit, _ = warm_fit(falls, 3)
        final = replace(fit, held_out=fit.count * left**2, sse=fit.count * left**2)
        gap = fit.count * (10.0 * FLOOR) ** 2
        plain = replace(fit, effects=(), held_out=gap, sse=gap)
        return judge.conclude(plain, final, {"coulomb_friction": [final]}, [], "")

    assert concluded(0.0).verdict == "effects" and not concluded(0.0).warms
    found = concluded(-0.8)
    assert found.verdict == "unknown" and found.warms and "changes" in found.reason
    # Far from the floor a real machine's repeatability is not known.
    assert concluded(-0.8, left=5.0 * FLOOR).verdict == "effects"


def test_what_is_found_beside_a_friction_that_changes_on_another_joint_is_no_name() -> None:
    def explanation(verdict: Verdict, *names: str, warms: bool = False) -> Explanation:
        accepted = tuple(Accepted(name, 1.0, {}, (), (), False) for name in names)
        final = made_up(names, FLOOR)
        return Explanation(made_up((), 0.02), final, verdict, "", accepted, warms=warms)

    beside, other = explanation("effects", "coulomb_friction", "backlash"), explanation("effects", "backlash")
    shown = explanation("unknown", "coulomb_friction", warms=True)
    found = no_constant_friction([beside, shown, other], [0, 0, 0])
    assert [e.verdict for e in found] == ["unknown", "unknown", "effects"] and found[0].reason == CHANGING
    assert no_constant_friction([beside, shown], [0, 1]) == [beside, shown], "of other fingers"
    same = [beside, replace(shown, warms=False)]
    assert no_constant_friction(same, [0, 0]) == same, "no joint shows it"
