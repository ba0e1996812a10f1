"""Search for the effects that a joint's servo lacks: forward selection with full refits, checked backward.

A step of the search is tentative; :mod:`vd.gap.verdict` has the last word.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vd.gap.candidates import Call, CandidateFits
from vd.gap.explanation import Trial
from vd.gap.jitter import CALLS
from vd.gap.joint_fit import JointFit
from vd.gap.judge import JITTER, MIN_GAIN_FLOORS, NESTED
from vd.gap.sample_weighting import SampleWeighting
from vd.gap.telemetry import BEHIND_SENSOR
from vd.gap.verdict import Verdicts

MAX_EFFECTS = 3
MAX_ROUNDS = 6
"""Rounds in all, with those after a revision."""
UNEARNED = float(np.hypot(1.0, MIN_GAIN_FLOORS))
"""Error, in noise floors, from which down to the floor no further effect can close what it has to."""
SEARCH_TAIL = 0.4
"""Share of the resamples that may see no gain from an effect while the search goes on: one of two causes
alone can make some motions worse."""
KEEP_TAIL = 0.1
"""Share of the resamples that may see no gain from an effect that is in the model already: what was
earned is not lost to the luck of another local fit."""
GROWN = 1.5
"""Spread of the samples of a motion, in that of the noise alone, from which they are weighted. Motions that
do not let errors grow have 1.05 at most (our choice)."""

Rivals = dict[str, list[JointFit]]
"""Fits with others in the place of an effect, by its name."""


@dataclass(kw_only=True)
class Search(CandidateFits, Verdicts):
    """Forward and backward selection for one joint.

    Attributes:
        report: Called with a line of progress.
        rest: Where the joint rests before it moves [rad].
        clocked: Whether samples are weighted by what errors of the clock do.
    """

    report: Callable[[str], None] = lambda line: None
    rest: float = 0.0
    clocked: bool = False

    def clock_sensitivity(self, fit: JointFit) -> SampleWeighting | None:
        """What errors of the clock do under a model that leaves more than noise; None where they do not grow.

        A profile of bounded acceleration that cannot follow its command turns at moments that hang on ever
        smaller things: a tenth of a millisecond is tens of milliradians some seconds later, and no fit of the
        right model leaves noise there. Weighted by how surely they are known
        (:mod:`vd.gap.sample_weighting`), samples are noise again under the right model.
        """
        if self.clocked or self.behind_jitter or JITTER in fit.effects or self.no_gap(fit):
            return None
        weighting = self.run([("clock_weighting", {"fit": fit, "scales": self.scales})])[0]
        ends = np.cumsum(fit.count.astype(int))[:-1]
        spread = [float(np.sqrt(np.mean(part**2))) for part in np.split(weighting.growth, ends)]
        return weighting if max(spread) > GROWN else None

    def weighted(self, weighting: SampleWeighting) -> "Search":
        """The same search with samples weighted by how surely the clock lets them be known."""

        def run(calls: list[Call]) -> list[Any]:
            # What jitter does is more than what the clock does, and is measured on the samples themselves.
            return self.run(
                [
                    (name, options if name in CALLS else {"weighting": weighting, **options})
                    for name, options in calls
                ]
            )

        return replace(self, run=run, clocked=True, promised={}, added={})

    def search(self, baseline: JointFit) -> tuple[JointFit, Rivals, list[Trial]]:
        """Forward and backward steps from the plain model; what is added is tentative until the end."""
        present, trials, tried, rivals = baseline, [], 0, {}
        while tried < MAX_ROUNDS:
            begun = set(present.effects)
            longer, added, rows = self.extend(present, tried)
            trials += rows
            tried = max((row.round for row in rows), default=MAX_ROUNDS)
            rivals.update(added)
            grown = longer is not present
            present = longer
            if not grown or self.clock_sensitivity(present):
                break
            if len(present.effects) > 1:
                revised, rivals = self.revise(present)
                settled = set(revised.effects) in (set(present.effects), begun)  # or back where it began
                present = revised
                if settled:
                    break
            if self.is_last(present):
                break
        return present, rivals, trials

    def extend(self, present: JointFit, done: int) -> tuple[JointFit, Rivals, list[Trial]]:
        """Add effects one by one while they are earned.

        Returns:
            The larger model, the fits with others in the place of each added effect, and the evidence.
        """
        rivals: Rivals = {}
        trials: list[Trial] = []
        for number in range(done + 1, MAX_ROUNDS + 1):
            fits = self.fit_candidates(present)
            if not fits:
                break
            best = self.winner(list(fits.values()))
            accepted, why = self.better(present, best, SEARCH_TAIL)
            trials += self.judge(number, present, fits, best, accepted, why)
            trials += self.screened_out(number, present, fits)
            if not accepted:
                break
            name, before, after = best.effects[-1], present.held_out_rmse, best.held_out_rmse
            self.report(f"+ {name}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
            rivals[name] = list(fits.values())
            self.added[frozenset(present.effects)] = (present, *fits.values())
            present = best
            if self.is_last(present):
                break
        return present, rivals, trials

    def is_last(self, present: JointFit) -> bool:
        """Whether no further effect is to be added to a model."""
        full = len(present.effects) >= MAX_EFFECTS
        return full or self.no_gap(present) or self.clock_sensitivity(present) is not None

    def revise(self, present: JointFit) -> tuple[JointFit, Rivals]:
        """Backward check: drop what is not needed, exchange what another effect does better.

        Returns the revised model and, for each of its effects, the fits with others in its place.
        """
        rivals: Rivals = {}
        for _ in range(MAX_EFFECTS):
            rivals, changed = {}, False
            for name in present.effects:
                if len(present.effects) < 2:
                    break
                without = self.refit(present, [e for e in present.effects if e != name])
                if not self.better(without, present, KEEP_TAIL)[0]:
                    self.report(f"- {name}: not needed beside the others")
                    present, changed = without, True
                    break
                rivals[name] = self.rivals(present, name, without)
                best = self.winner([fit for fit in rivals[name] if not set(fit.effects) & set(self.vetoes)])
                simpler = len(best.x) < len(present.x)
                if best is not present and (simpler or not self.tied(best, present)[0]):
                    self.report(f"~ {name} exchanged for {best.effects[-1]}")
                    present, changed = best, True
                    break
            if not changed:
                break
        return present, rivals

    def rivals(self, present: JointFit, name: str, without: JointFit | None = None) -> list[JointFit]:
        """The model itself, and fits with other effects in the place of one of its own."""
        if without is None:
            without = self.refit(present, [e for e in present.effects if e != name])
        # Beside Coulomb friction, a friction that contains it is no other cause.
        contains = [c for c, simpler in NESTED.items() if set(simpler) & set(without.effects)]
        skip, tried = (name, *contains), tuple(BEHIND_SENSOR)
        fits = self.tried_beside(without, present, skip)
        if fits is None:
            fits = self.fit_candidates(without, skip=skip, vetoed=tried, known=present)
        own = replace(present, effects=(*without.effects, name))  # by its last effect it is known
        self.added[frozenset(without.effects)] = (without, own, *fits.values())
        return [present, *fits.values()]

    def all_rivals(self, present: JointFit, rivals: Rivals) -> Rivals:
        """Fits with others in the place of each effect of a model, made anew where they are of another."""
        behind = set(BEHIND_SENSOR) & set(self.vetoes) & set(self.candidates)
        stale = any(len(fit.effects) != len(present.effects) for fits in rivals.values() for fit in fits)
        if not present.effects or JITTER in present.effects:
            return rivals
        if behind or stale or set(rivals) != set(present.effects):
            return {name: self.rivals(present, name) for name in present.effects}
        return rivals

    def judge(
        self,
        number: int,
        before: JointFit,
        fits: Mapping[str, JointFit],
        best: JointFit,
        accepted: bool,
        why: str,
    ) -> list[Trial]:
        """The rows of one round for the evidence table, best first, placebo last."""
        rows = []
        for name, fit in sorted(fits.items(), key=lambda item: item[1].held_out_rmse):
            gain, ci = self.gain(before, fit)
            decision, reason = "rejected", why or f"{best.effects[-1]} predicts unseen motions better"
            if fit is best and accepted:
                decision, reason = "named", "best on unseen motions"
            elif accepted and self.tied(best, fit)[0]:
                decision, reason = "tied", f"not told from {best.effects[-1]} by this recording"
                if set(NESTED.get(name, ())) & {best.effects[-1]}:
                    decision, reason = "rejected", f"contains {best.effects[-1]} and adds nothing to it"
            rows.append(Trial(number, name, fit, gain, ci, decision, reason))
        if accepted:
            gain = self.run([("placebo", {"before": before, "after": best})])[0]
            text = (
                f"{best.effects[-1]} with its times reversed and its trajectories exchanged: must be rejected"
            )
            rows.append(Trial(number, best.effects[-1], best, gain, (gain, gain), reason=text, placebo=True))
        return rows

    def screened_out(self, number: int, before: JointFit, fits: Mapping[str, JointFit]) -> list[Trial]:
        """The rows of candidates that promised too little to be fitted in a round."""
        promises = sorted(self.promised.items(), key=lambda item: -item[1])
        return [
            self.untried(
                number,
                name,
                before,
                f"screened out: promised {100.0 * max(promise, 0.0):.0f} % of the squared error",
            )
            for name, promise in promises
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
