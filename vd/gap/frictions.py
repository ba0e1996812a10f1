"""Frictions that are one another's with something constant: taken apart, put together, named alike."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.candidates import FULL_ITERATIONS, HOPELESS, SCREEN_ITERATIONS, CandidateFits
from vd.gap.coordinates import sizes
from vd.gap.joint_fit import ONE_SIDED, JointFit
from vd.gap.judge import JITTER
from vd.gap.verdict import Verdicts

EXACTLY = {"coulomb_friction", "encoder_bias"}
"""The two effects that move a joint exactly as friction with a direction does: what one fits better, the
integrator has done."""


@dataclass(kw_only=True)
class Frictions(CandidateFits, Verdicts):
    """Exchanges frictions of a model for others that move the joint alike.

    Attributes:
        report: Called with a line of progress.
        rest: Where the joint rests before it moves [rad].
    """

    report: Callable[[str], None] = lambda line: None
    rest: float = 0.0

    def take_apart(self, present: JointFit, asymmetric: JointFit) -> list[JointFit]:
        """Fits with asymmetric friction taken apart: dry friction or a dead zone, and a load or an offset.

        Friction that differs between the directions is the same as friction that does not and a constant
        torque. Each alone can make motions worse, so that one after the other they would not be found.
        """
        plus, minus = (asymmetric.values[f"{ONE_SIDED}.tau_{side}_nm"] for side in ("plus", "minus"))
        load = 0.5 * (minus - plus)
        level = 0.5 * (plus + minus)
        dry = {
            "coulomb_friction": {"coulomb_friction.tau_c_nm": level},
            "dead_zone": {"dead_zone.width_rad": 2.0 * level / self.scales.kp},
        }
        base = {k: v for k, v in asymmetric.values.items() if not k.startswith(ONE_SIDED)}
        starts = {
            "gravity_load": {
                "gravity_load.tau_g_nm": abs(load),
                "gravity_load.phase_rad": -0.5 * np.pi * np.sign(load),
            },
            "encoder_bias": {"encoder_bias.bias_rad": load / self.scales.kp},
        }
        usable = {*self.candidates} - {*present.effects, *self.vetoes}
        calls = []
        for friction, name in itertools.product(dry, starts):
            if not {friction, name} <= usable:
                continue
            others = sizes(name, self.others, self.scales)
            given = [{**base, **dry[friction], **start} for start in (starts[name], *others)]
            calls.append(self.call(present, (friction, name), given, SCREEN_ITERATIONS))
        screened = self.run(calls)
        least = min((fit.rmse for fit in screened), default=0.0)
        near = [fit for fit in screened if fit.rmse < HOPELESS * least]
        return self.run([self.call(present, f.effects[-2:], [f.values], FULL_ITERATIONS) for f in near])

    def put_together(self, present: JointFit) -> JointFit:
        """The model with asymmetric friction in the place of dry friction and an offset, if that is as good.

        One cause is simpler than two that are the same as it.
        """
        usable = {*self.candidates} - {*present.effects, *self.vetoes}
        parts = [
            {friction, offset}
            for friction in ("coulomb_friction", "dead_zone")
            for offset in ("encoder_bias", "gravity_load")
            if {friction, offset} <= {*present.effects}
        ]
        if not parts or ONE_SIDED not in usable or JITTER in present.effects:
            return present
        kept = [name for name in present.effects if name not in parts[0]]
        without = self.refit(present, kept)
        given = [self.both_ways(present), *sizes(ONE_SIDED, self.others, self.scales)]
        starts = self.starts(without, given)
        fit = self.run([self.call(without, ONE_SIDED, starts, FULL_ITERATIONS)])[0]
        if fit.at_bound or not self.tied(present, fit, parts[0] == EXACTLY)[0]:
            return present
        self.report(f"~ {' and '.join(sorted(parts[0]))} are {ONE_SIDED}")
        self.apart[ONE_SIDED] = present
        return fit

    def as_an_offset(self, present: JointFit) -> JointFit:
        """The model with an offset in the place of friction with a direction beside Stribeck friction.

        They are the same (:data:`vd.kernels.servo.effects.BESIDE`), and the offset is simpler.
        """
        dry, offset = "stribeck_friction", "encoder_bias"
        usable = {*self.candidates} - {*present.effects, *self.vetoes}
        if not {dry, ONE_SIDED} <= {*present.effects} or offset not in usable or JITTER in present.effects:
            return present
        values, kp = present.values, float(present.rows[self.joint, servo.KP])
        plus, minus = (values[f"{ONE_SIDED}.tau_{side}_nm"] for side in ("plus", "minus"))
        start = {f"{offset}.bias_rad": 0.5 * (minus - plus) / kp}
        start |= {f"{dry}.tau_{x}_nm": values[f"{dry}.tau_{x}_nm"] + 0.5 * (plus + minus) for x in "sc"}
        without = self.refit(present, [name for name in present.effects if name != ONE_SIDED])
        call = self.call(without, offset, [{**present.values, **start}], FULL_ITERATIONS)
        fit = self.run([call])[0]
        if not self.tied(present, fit, loose=True)[0]:
            return present
        self.report(f"~ {ONE_SIDED} is {offset} beside {dry}")
        return fit

    def both_ways(self, present: JointFit) -> dict[str, float]:
        """The asymmetric friction that dry friction or a dead zone and an offset of a model are together."""
        values, kp = present.values, float(present.rows[self.joint, servo.KP])
        level = values.get("coulomb_friction.tau_c_nm", 0.5 * kp * values.get("dead_zone.width_rad", 0.0))
        load = kp * values.get("encoder_bias.bias_rad", 0.0)
        if "gravity_load" in present.effects:
            angle = self.rest + values["gravity_load.phase_rad"]
            load -= values["gravity_load.tau_g_nm"] * float(np.sin(angle))
        return {
            f"{ONE_SIDED}.tau_plus_nm": max(level - load, 0.0),
            f"{ONE_SIDED}.tau_minus_nm": max(level + load, 0.0),
        }
