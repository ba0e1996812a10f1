"""Fits of the models that a search compares: with one more effect, with one less, from elsewhere."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vd.gap.coordinates import Scales, best_two, sizes, torque_power
from vd.gap.evidence import JITTER
from vd.gap.joint_fit import JointFit
from vd.kernels.servo.effects import EFFECTS, equivalent

SHORT_LIST = 10
"""Candidates of a round that are fitted, after the linear screening of all."""
FINALISTS = 6
"""Candidates of a round that are fitted to the end."""
BEHIND = 2.0
"""Finalists have at most this many times the error of the best after screening."""
SCREEN_ITERATIONS = 6
FULL_ITERATIONS = 12
ASTRAY = 2.0
"""Factor from the nominal model beyond which a fit starts from that as well."""

Call = tuple[str, dict[str, Any]]
Run = Callable[[list[Call]], list[Any]]
"""Runs methods of the joint's :class:`vd.gap.fit.JointProblem` by name, in parallel."""


@dataclass(kw_only=True)
class CandidateFits:
    """Fits models of one joint.

    Attributes:
        floor: Noise floor [rad].
        run: Runs fits.
        joint: Index of the joint in its chain.
        others: Slots of the other joints of the chain.
        candidates: Effects to consider.
        scales: Sizes of the joint's motion.
        vetoes: Effects that telemetry contradicts, with the reason.
        nominal: Nominal values of the baseline's parameters, by key.
        promised: Share of the squared error that each candidate of the last round could remove at best.
        seen: Models to which an effect was added, by their effects.
        behind_jitter: Whether samples are weighted by what random delays do to them.
    """

    floor: float
    run: Run
    joint: int
    others: Sequence[int]
    candidates: Sequence[str]
    scales: Scales
    vetoes: Mapping[str, str] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    promised: dict[str, float] = field(default_factory=dict)
    seen: dict[frozenset[str], JointFit] = field(default_factory=dict)
    behind_jitter: bool = False

    def fit_candidates(
        self,
        present: JointFit,
        skip: Sequence[str] = (),
        vetoed: Sequence[str] = (),
        known: JointFit | None = None,
    ) -> dict[str, JointFit]:
        """Fits with each promising further effect, the finalists to convergence, by name.

        Args:
            present: Model to which they are added.
            skip: Effects to leave out.
            vetoed: Effects to try in spite of a veto.
            known: A fit with one that is left out: what stays far behind it is not fitted to the end.
        """
        out = {*present.effects, *(set(self.vetoes) - set(vetoed)), *skip, JITTER}
        starts = {name: self.sized(present, name) for name in self.candidates if name not in out}
        flat = [(name, start) for name, given in starts.items() for start in given]
        if not flat:
            return {}
        call = {"fit": present, "starts": [start for _, start in flat], "scales": self.scales}
        promise = self.run([("promise", call)])[0]
        best_first: dict[str, list[dict[str, float]]] = {}
        self.promised = {}
        for i in np.argsort(-promise):
            name, start = flat[i]
            best_first.setdefault(name, []).append(start)
            self.promised.setdefault(name, float(promise[i]))
        screened = self.run(
            [
                self.call(present, name, self.starts(present, best_two(given)), SCREEN_ITERATIONS)
                for name, given in list(best_first.items())[:SHORT_LIST]
            ]
        )
        least = min(fit.rmse for fit in (*screened, *([] if known is None else [known])))
        near = sorted((fit for fit in screened if fit.rmse < BEHIND * least), key=lambda fit: fit.rmse)
        calls = [self.call(present, f.effects[-1], [f.values], FULL_ITERATIONS) for f in near[:FINALISTS]]
        return {fit.effects[-1]: fit for fit in (*screened, *self.run(calls))}

    def sized(self, present: JointFit, name: str) -> list[dict[str, float]]:
        """Starting values of an effect added to a model: none that differ only in what that does not fit."""
        starts = sizes(name, self.others, self.scales)
        return [start for start in starts if all("." in key or key in present.values for key in start)]

    def plain(self, baseline: JointFit) -> Call:
        """The call that fits the plain model anew."""
        call = {"base": baseline.rows, "effects": (), "starts": [{}, self.nominal], "scales": self.scales}
        return "fit", {**call, "iterations": FULL_ITERATIONS}

    def refined(self, fit: JointFit) -> JointFit:
        """A fit at finer time steps."""
        return self.run([("refine", {"fit": fit, "scales": self.scales})])[0]

    def starts(self, present: JointFit, added: Sequence[dict[str, float]]) -> list[dict[str, float]]:
        """Where a fit with a further effect starts: at the present model, and from the nominal one.

        Without the effect, the baseline may have gone far to imitate it (an unmodelled delay is best met
        by a servo twenty times as stiff), and from there no descent comes back.
        """
        result = [{**present.values, **start} for start in added]
        away = {key: present.values[key] / value for key, value in self.nominal.items() if value > 0.0}
        if any(not 1.0 / ASTRAY < ratio < ASTRAY for ratio in away.values()):
            torque = 1.0 / away.get("kp", 1.0)
            start = {key: value * torque ** torque_power(key) for key, value in result[0].items()}
            result.append({**start, **self.nominal})
        return result

    def call(
        self,
        present: JointFit,
        added: str | Sequence[str],
        starts: Sequence[Mapping[str, float]],
        iterations: int,
    ) -> Call:
        """The call that fits ``present`` with one more effect, or several."""
        names = (added,) if isinstance(added, str) else tuple(added)
        return (
            "fit",
            {
                "base": present.rows,
                "effects": (*present.effects, *names),
                "starts": list(starts),
                "scales": self.scales,
                "iterations": iterations,
            },
        )

    def without(self, present: JointFit, name: str) -> JointFit:
        """The fit without one of a model's effects: the one to which it was added where that is as good.

        What was fitted beside that one is known.
        """
        fit = self.refit(present, [effect for effect in present.effects if effect != name])
        return min(fit, self.seen.get(frozenset(fit.effects), fit), key=lambda each: each.rmse)

    def refit(self, present: JointFit, effects: Sequence[str]) -> JointFit:
        """The fit with only some of a model's effects."""
        rows = present.rows.copy()
        for name in set(present.effects) - set(effects):
            for parameter in EFFECTS[name].parameters:
                rows[self.joint, parameter.column] = parameter.neutral
        values = {k: v for k, v in present.values.items() if k.rpartition(".")[0] in ("", *effects)}
        call = {"base": rows, "effects": tuple(effects), "starts": [values], "scales": self.scales}
        return self.run([("fit", {**call, "iterations": FULL_ITERATIONS})])[0]


def alike(names: Sequence[str], model: str) -> dict[str, tuple[str, ...]]:
    """The candidates that stand for others of the candidates, and for which."""
    return {
        name: inside
        for name, others in equivalent(model).items()
        if name in names and (inside := tuple(other for other in others if other in names))
    }


def stood_for(same: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Candidates that another stands for, with the reason why they are not tried."""
    return {
        other: f"leaves the same positions as {name}, which stands for both"
        for name, others in same.items()
        for other in others
    }
