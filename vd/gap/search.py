"""Search for the effects that a joint's servo lacks.

Forward selection with full refits, checked backward.

A step of the search is tentative; :mod:`vd.gap.evidence` has the last word.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vd.gap.coordinates import Scales, sizes, torque_power
from vd.gap.evidence import JITTER, NESTED, Evidence
from vd.gap.explanation import Trial
from vd.gap.joint_fit import JointFit, SampleWeighting
from vd.gap.telemetry import BEHIND_SENSOR
from vd.gap.worker_pool import Call
from vd.kernels.servo.effects import EFFECTS, equivalent

MAX_EFFECTS = 3
"""Effects of a joint, but for random delays. Not tuned: hidden were two at most."""
SHORT_LIST = 10
"""Candidates of a round that are fitted, after the linear screening of all: half of the table. Not
tuned.
"""

Run = Callable[[list[Call]], list[Any]]
"""Runs methods of the joint's :class:`vd.gap.fit.JointProblem` by name, in parallel."""


@dataclass(kw_only=True)
class Search(Evidence):
    """Forward and backward selection for one joint.

    Attributes:
        run: Runs fits.
        others: Slots of the other joints of the chain.
        candidates: Effects to consider.
        scales: Sizes of the joint's motion.
        vetoes: Effects that telemetry contradicts, with the reason.
        nominal: Nominal values of the baseline's parameters, by key.
        report: Called with a line of progress.
        rest: Where the joint rests before it moves [rad].
        known: Values of the models that steps led to, by their effects: fits of these start there,
            too.
    """

    run: Run
    others: Sequence[int]
    candidates: Sequence[str]
    scales: Scales
    vetoes: Mapping[str, str] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    report: Callable[[str], None] = lambda line: None
    rest: float = 0.0
    known: dict[frozenset[str], Mapping[str, float]] = field(default_factory=dict)

    def fit(
        self, base: np.ndarray, effects: Sequence[str], starts: Sequence[Mapping[str, float]]
    ) -> Call:
        """The call that fits a model from the rows of a chain."""
        known = self.known.get(frozenset(effects))
        starts = [*starts, *([] if known is None else [known])]
        return "fit", {
            "base": base,
            "effects": tuple(effects),
            "starts": starts,
            "scales": self.scales,
        }

    def plain(self, baseline: JointFit) -> JointFit:
        """The plain model, fitted anew."""
        return self.run([self.fit(baseline.rows, (), [{}, self.nominal])])[0]

    def refined(self, fit: JointFit) -> JointFit:
        """A fit at finer time steps."""
        return self.run([("refine", {"fit": fit, "scales": self.scales})])[0]

    def refit(self, present: JointFit, effects: Sequence[str]) -> JointFit:
        """The fit with only some of a model's effects."""
        rows = present.rows.copy()
        for name in set(present.effects) - set(effects):
            for parameter in EFFECTS[name].parameters:
                rows[self.joint, parameter.column] = parameter.neutral
        values = {k: v for k, v in present.values.items() if k.rpartition(".")[0] in ("", *effects)}
        return self.run([self.fit(rows, effects, [values])])[0]

    def without(self, present: JointFit, name: str) -> JointFit:
        """The fit without one of a model's effects."""
        return self.refit(present, [effect for effect in present.effects if effect != name])

    def fit_candidates(
        self, present: JointFit, skip: Sequence[str] = (), vetoed: Sequence[str] = ()
    ) -> tuple[dict[str, JointFit], dict[str, float]]:
        """Fits with each promising further effect.

        Args:
            present: Model to which they are added.
            skip: Effects to leave out.
            vetoed: Effects to try in spite of a veto.

        Returns:
            The fits by name; and the share of the squared error that each candidate can remove at
            best, by a linear estimate, the most promising first.
        """
        out = {*present.effects, *(set(self.vetoes) - set(vetoed)), *skip, JITTER}
        flat = [
            (name, start)
            for name in self.candidates
            if name not in out
            for start in sizes(name, self.others, self.scales)
            # None that differ only in what the joint's baseline does not fit.
            if all("." in key or key in present.values for key in start)
        ]
        if not flat:
            return {}, {}
        call = {"fit": present, "starts": [start for _, start in flat], "scales": self.scales}
        promise = self.run([("promise", call)])[0]
        best: dict[str, list[dict[str, float]]] = {}
        promised: dict[str, float] = {}
        for i in np.argsort(-promise):
            name, start = flat[i]
            best.setdefault(name, []).append(start)
            promised.setdefault(name, float(promise[i]))
        tried = list(best)[:SHORT_LIST]
        calls = [
            self.fit(present.rows, (*present.effects, n), self.starts(present, best[n]))
            for n in tried
        ]
        return dict(zip(tried, self.run(calls), strict=True)), promised

    def starts(
        self, present: JointFit, added: Sequence[Mapping[str, float]]
    ) -> list[dict[str, float]]:
        """Where a fit with a further effect starts.

        At the present model with two sizes, and the nominal one.

        Without the effect, the baseline may have gone far to imitate it (an unmodelled delay is
        best met by a servo twenty times as stiff), and from there no descent comes back.
        """
        starts, nominal = (
            [{**present.values, **one} for one in added[:2]],
            self.nominal.get("kp", 0.0),
        )
        # No slope leads to a speed limit that binds from one that does not.
        limit = {"velocity_limit": self.scales.speed} if "velocity_limit" in self.nominal else {}
        torque = nominal / present.values["kp"] if nominal else 1.0
        scaled = {key: value * torque ** torque_power(key) for key, value in starts[0].items()}
        return [*starts, {**scaled, **self.nominal, **limit}]

    def weighted(self, weighting: SampleWeighting, **changes: Any) -> "Search":
        """The same search with samples weighted, and other attributes changed."""

        def run(calls: list[Call]) -> list[Any]:
            return self.run(
                [(name, {"weighting": weighting, **options}) for name, options in calls]
            )

        return replace(self, run=run, known=dict(self.known), **changes)

    def search(self, baseline: JointFit) -> tuple[JointFit, list[Trial]]:
        """Forward steps from the plain model, each checked backward; what they add is tentative.

        Returns:
            The model, and the evidence.
        """
        present, trials, visited = baseline, [], {frozenset[str]()}
        for number in itertools.count(1):
            if len(present.effects) >= MAX_EFFECTS or self.no_gap(present):
                break
            fits, promised = self.fit_candidates(present)
            if not fits:
                break
            best = self.winner(list(fits.values()))
            earned, why = self.better(present, best, tentative=True)
            trials += self.judge(number, present, fits, best, earned, why)
            trials += self.screened_out(number, present, fits, promised)
            if not earned:
                break
            name, before, after = best.effects[-1], present.held_out_rmse, best.held_out_rmse
            self.report(f"+ {name}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
            self.known[frozenset(best.effects)] = best.values
            present = self.revise(best)
            self.known[frozenset(present.effects)] = present.values
            if frozenset(present.effects) in visited:
                break  # back where it was before
            visited.add(frozenset(present.effects))
        return present, trials

    def revise(self, present: JointFit) -> JointFit:
        """Backward check: drop what is not needed, exchange what another effect does better."""
        for _ in range(MAX_EFFECTS):
            changed = self._revised(present)
            if changed is None:
                break
            present = changed
        return present

    def _revised(self, present: JointFit) -> JointFit | None:
        """The model without an effect that it does not need, or with a better one in its place, or None."""
        for name in present.effects if len(present.effects) > 1 else ():
            without = self.without(present, name)
            if not self.better(without, present, tentative=True)[0]:
                self.report(f"- {name}: not needed beside the others")
                return without
            fits = self.rivals(present, name, without)
            best = self.winner([fit for fit in fits if not set(fit.effects) & set(self.vetoes)])
            simpler = len(best.x) < len(present.x)
            if best is not present and (simpler or not self.tied(best, present)[0]):
                self.report(f"~ {name} exchanged for {best.effects[-1]}")
                return best
        return None

    def rivals(
        self, present: JointFit, name: str, without: JointFit | None = None
    ) -> list[JointFit]:
        """The model itself, and fits with other effects in the place of one of its own."""
        without = self.without(present, name) if without is None else without
        # Beside Coulomb friction, a friction that contains it is no other cause.
        contains = [c for c, simpler in NESTED.items() if set(simpler) & set(without.effects)]
        fits, _ = self.fit_candidates(without, (name, *contains), tuple(BEHIND_SENSOR))
        return [present, *fits.values()]

    def judge(
        self,
        number: int,
        before: JointFit,
        fits: Mapping[str, JointFit],
        best: JointFit,
        accepted: bool,
        why: str,
    ) -> list[Trial]:
        """The rows of one round for the evidence table, best first."""
        rows = []
        for name, fit in sorted(fits.items(), key=lambda item: item[1].held_out_rmse):
            gain, ci = self.gain(before, fit)
            decision, reason = (
                "rejected",
                why or f"{best.effects[-1]} predicts unseen motions better",
            )
            if fit is best and accepted:
                decision, reason = "named", "best on unseen motions"
            elif accepted and self.tied(best, fit)[0]:
                decision, reason = "tied", f"not told from {best.effects[-1]} by this recording"
                if set(NESTED.get(name, ())) & {best.effects[-1]}:
                    decision, reason = (
                        "rejected",
                        f"contains {best.effects[-1]} and adds nothing to it",
                    )
            rows.append(Trial(number, name, fit, gain, ci, decision, reason))
        return rows

    def screened_out(
        self,
        number: int,
        before: JointFit,
        fits: Mapping[str, JointFit],
        promised: Mapping[str, float],
    ) -> list[Trial]:
        """The rows of candidates that promised too little to be fitted in a round."""
        text = "screened out: promised {:.0f} % of the squared error"
        return [
            self.untried(number, name, before, text.format(100.0 * max(promise, 0.0)))
            for name, promise in promised.items()
            if name not in fits
        ]

    def contradicted(self, baseline: JointFit) -> list[Trial]:
        """The rows of candidates that telemetry rules out."""
        return [
            self.untried(1, name, baseline, why)
            for name, why in self.vetoes.items()
            if name in self.candidates
        ]

    def untried(self, number: int, name: str, before: JointFit, reason: str) -> Trial:
        """The row of a candidate that was not fitted."""
        unknown = float("nan")
        fit = replace(before, held_out=before.held_out * unknown)
        return Trial(number, name, fit, unknown, (unknown, unknown), reason=reason)


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
