"""Search for the effects that a joint's servo lacks: forward selection with full refits, checked backward.

A step of the search is tentative; :mod:`vd.gap.verdict` has the last word.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.candidates import BETTER, HOPELESS
from vd.gap.clock_sensitivity import clock_sensitivity, explain_weighted
from vd.gap.consensus import as_another, as_changing
from vd.gap.explanation import Accepted, Explanation, Trial
from vd.gap.frictions import EXACTLY
from vd.gap.jitter_search import at_once, in_place, jitter_as_another, try_jitter, unlimited
from vd.gap.joint_fit import ONE_SIDED, JointFit
from vd.gap.judge import EXPLAINED, JITTER, NESTED, SHARP
from vd.gap.search import UNEARNED, WIDE, Search
from vd.gap.telemetry import BEHIND_SENSOR

MIN_TRAJECTORIES = 3
MAX_EFFECTS = 3
MAX_ROUNDS = 6
"""Rounds in all, with those after a revision."""
LARGE = 4.0
"""Gap, in noise floors, that two wrong effects together do not imitate: only a search that fails has to look
that wide."""
SEARCH_TAIL = 0.4
"""Share of the resamples that may see no gain from an effect while the search goes on: one of two causes
alone can make some motions worse."""
KEEP_TAIL = 0.1
"""Share of the resamples that may see no gain from an effect that is in the model already: what was
earned is not lost to the luck of another local fit."""

Rivals = dict[str, list[JointFit]]
"""Fits with others in the place of an effect, by its name."""


@dataclass(kw_only=True)
class Selection(Search):
    """Forward selection for one joint."""

    def explain(self, baseline: JointFit, start: tuple[JointFit, list[Trial]] | None = None) -> Explanation:
        """See :meth:`Search.explain`."""
        loose = self.undetermined(baseline)
        self.whole = baseline.held_out_rmse
        known = self.without_search(baseline, loose)
        if known is None and not start:
            known = (
                as_another(self, baseline, loose)
                or as_changing(self, baseline, loose)
                or jitter_as_another(self, baseline, loose)
            )
        if known is not None:
            return known
        trials = [] if start else self.contradicted(baseline)
        present, rivals, rows = (start[0], {}, start[1]) if start else self.first(baseline)
        trials += rows
        if weighting := clock_sensitivity(self, present):
            return explain_weighted(self, baseline, weighting)
        if self.too_coarse(present):
            return self.explain_finer(baseline, present, trials)
        if present.effects:
            earned, why = self.better(baseline, present)
            if not earned:
                self.report(f"taken back: {why}")
                present, rivals = baseline, {}
        present, rivals, beside, rows = self.with_jitter(baseline, present, rivals)
        trials += rows
        present, rivals = self.with_rivals(present, rivals)
        evidence = self.settle(trials, present)
        if not present.effects or JITTER in present.effects:
            return self.conclude(baseline, present, rivals, evidence, loose, known=beside)
        return self.confirmed(baseline, present, rivals, evidence, loose)

    def without_search(self, baseline: JointFit, loose: str) -> Explanation | None:
        """The explanation of a joint whose plain model leaves nothing to search for, or cannot be judged."""
        if len(baseline.sse) < MIN_TRAJECTORIES:
            text = (
                f"{len(baseline.sse)} trajectories leave none to hold out; record {MIN_TRAJECTORIES} at least"
            )
            return Explanation(baseline, baseline, "under_excited", text)
        if self.no_gap(baseline):
            if loose:
                return Explanation(baseline, baseline, "under_excited", loose)
            return Explanation(baseline, baseline, "no_gap", "the plain model is within the noise floor")
        if weighting := clock_sensitivity(self, baseline):  # with an identified limit in it
            return explain_weighted(self, baseline, weighting)
        return None

    def explain_finer(self, baseline: JointFit, present: JointFit, trials: list[Trial]) -> Explanation:
        """The explanation by a search with a finer time step, or by the model that leaves noise with it."""
        self.report(f"{' and '.join(present.effects)}: the time step shows, so again with a finer one")
        fine, refined = self.finer(), self.refined(present)
        plain = fine.run([fine.plain(baseline)])[0]
        if refined.rmse > UNEARNED * self.floor or self.lack_of_fit(refined):
            return fine.explain(plain)
        return fine.explain(plain, (fine.refit(refined, refined.effects), trials))

    def with_jitter(
        self, baseline: JointFit, present: JointFit, rivals: Rivals
    ) -> tuple[JointFit, Rivals, tuple[Accepted, ...], list[Trial]]:
        """The model, its rivals, what is known beside random delays, and the evidence, where these may be.

        What is fitted well leaves nothing to them, nor does a spring.
        """
        fitted = self.finished(present) or self.white(present) or self.noise_only(present)
        if fitted or self.a_spring(present):
            return present, rivals, (), []
        found, beside, rows = try_jitter(self, baseline, present)
        if found is not present:
            present, rivals = found, {}
            if JITTER not in present.effects:
                present, rivals = self.revise(present)
        return present, rivals, beside, [replace(row, round=row.round + 2 * MAX_ROUNDS) for row in rows]

    def with_rivals(self, present: JointFit, rivals: Rivals) -> tuple[JointFit, Rivals]:
        """The model with frictions put together, and fits with others in the place of each of its effects."""
        behind = set(BEHIND_SENSOR) & set(self.vetoes) & set(self.candidates)
        stale = any(len(fit.effects) != len(present.effects) for fits in rivals.values() for fit in fits)
        named = present.effects and JITTER not in present.effects
        if named and (behind or stale or set(rivals) != set(present.effects)):
            rivals = {name: self.rivals(present, name) for name in present.effects}
        together = self.as_an_offset(self.put_together(present))
        if together is not present:
            present = together
            rivals = {name: self.rivals(present, name) for name in present.effects}
        return present, rivals

    def confirmed(
        self, baseline: JointFit, present: JointFit, rivals: Rivals, evidence: list[Trial], loose: str
    ) -> Explanation:
        """The conclusion on a model, once searched for from elsewhere and at finer time steps."""
        found = present
        again = self.search_again(present)
        if again is not None and again.rmse < BETTER * present.rmse:
            self.report(f"another search finds {1e3 * again.rmse:.2f} mrad, not {1e3 * present.rmse:.2f}")
            present = self.refit(again, again.effects)
            rivals = {k: [present if fit is found else fit for fit in fits] for k, fits in rivals.items()}
        refined = self.refined(present)
        result = self.conclude(baseline, present, rivals, evidence, loose, refined, again)
        better = self.beside_better(result, present)
        if better:
            result = self.conclude(baseline, present, {**rivals, **better}, evidence, loose, refined, again)
        return self.explained(result)

    def beside_better(self, result: Explanation, final: JointFit) -> Rivals:
        """Fits with others in the place of an effect, where all are sets, beside better members of others.

        What the final model lacks there is as large as what tells the members of a set apart.
        """
        if result.verdict != "ambiguous" or not self.white(final):
            return {}
        found = {}
        for one in result.accepted:
            beside = [
                fit
                for other in result.accepted
                for fit in result.rivals.get(other.name, ())
                if other is not one and fit.effects[-1] in other.tied and one.name in fit.effects
                if fit.rmse < final.rmse and not self.tied(fit, final)[0]
            ]
            if beside:
                best = min(beside, key=lambda fit: fit.rmse)
                order = (*(name for name in best.effects if name != one.name), one.name)
                found[one.name] = self.rivals(replace(best, effects=order), one.name)
        return found

    def first(self, baseline: JointFit) -> tuple[JointFit, Rivals, list[Trial]]:
        """The first search; it looks wide at once where a gap is small, but not where jitter fills it."""
        if not self.behind_jitter and (
            baseline.held_out_rmse > LARGE * self.floor or at_once(self, baseline)
        ):
            self.wide = False
            found = self.search(baseline, baseline)
            self.wide = True
            if self.finished(found[0]) or self.ended(found[0]):
                return found
            random = at_once(self, baseline)
            if random and self.likelier(found[0], random[0]) and unlimited(self, found[0], random[0]):
                self.report(f"{JITTER} leaves noise: nothing else is tried from every start")
                return found
            self.report("not explained: every candidate is tried from every start")
        return self.search(baseline, baseline)

    def search(self, baseline: JointFit, start: JointFit) -> tuple[JointFit, Rivals, list[Trial]]:
        """Forward and backward steps from a model; what it adds is tentative until the end."""
        present, trials, tried = start, [], len(start.effects)
        rivals = {start.effects[-1]: [start]} if start.effects else {}
        while tried < MAX_ROUNDS:
            begun = set(present.effects)
            longer, added, rows = self.extend(present, tried)
            trials += rows
            tried = max((row.round for row in rows), default=MAX_ROUNDS)
            rivals.update(added)
            grown = longer is not present
            present = longer
            if (
                (not grown and present is not start)
                or clock_sensitivity(self, present)
                or self.too_coarse(present)
            ):
                break
            if in_place(self, present):
                break
            if len(present.effects) > 1:
                revised, rivals = self.revise(present)
                settled = set(revised.effects) in (set(present.effects), begun)  # or back where it began
                present = revised
                if settled or in_place(self, present):
                    break
            if not grown or self.finished(present) or self.a_spring(present):
                break
            if len(present.effects) >= MAX_EFFECTS:
                break
        return present, rivals, trials

    def screened_out(self, number: int, before: JointFit, fits: Mapping[str, JointFit]) -> list[Trial]:
        """The rows of candidates that promised too little to be fitted in a round."""
        unknown = float("nan")
        return [
            Trial(
                number,
                name,
                replace(before, held_out=before.held_out * unknown),
                unknown,
                (unknown, unknown),
                reason=f"screened out: promised {100.0 * max(promise, 0.0):.0f} % of the squared error",
            )
            for name, promise in sorted(self.promised.items(), key=lambda item: -item[1])
            if name not in fits
        ]

    def contradicted(self, baseline: JointFit) -> list[Trial]:
        """The rows of candidates that telemetry rules out."""
        unknown = float("nan"), float("nan")
        return [
            Trial(
                1,
                name,
                replace(baseline, held_out=baseline.held_out * np.nan),
                unknown[0],
                unknown,
                reason=why,
            )
            for name, why in self.vetoes.items()
            if name in self.candidates
        ]

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
            if self.wide and self.looks > 0 and EXPLAINED * self.floor < best.rmse < WIDE * self.floor:
                self.looks -= 1
                fits = self.look_wider(present, fits)
                best = self.winner(list(fits.values()))
            if not clock_sensitivity(self, best):
                best = fits[best.effects[-1]] = self.search_nearby(best, self.whole)
            best, accepted, why = self.earned(present, best, fits)
            trials += self.judge(number, present, fits, best, accepted, why)
            trials += self.screened_out(number, present, fits)
            if not accepted:
                break
            pair = self.as_two(present, best, fits)
            if pair is not None:
                trials += self.pair_rows(number, present, pair)
                present = pair
                break
            name, before, after = best.effects[-1], present.held_out_rmse, best.held_out_rmse
            self.report(f"+ {name}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
            rivals[name] = list(fits.values())
            self.added[frozenset(present.effects)] = (present, *fits.values())
            present = best
            if self.is_last(present):
                break
        return present, rivals, trials

    def earned(
        self, present: JointFit, best: JointFit, fits: Mapping[str, JointFit]
    ) -> tuple[JointFit, bool, str]:
        """The candidate that a round adds, whether it is earned, and if not why."""
        accepted, why = self.better(present, best, SEARCH_TAIL)
        if accepted or self.whitens(present, best):
            return best, True, ""
        # The simpler of two stands for the one that contains it only if it earns its place as well.
        name = best.effects[-1]
        richer = [f for f in fits.values() if name in NESTED.get(f.effects[-1], ()) and not f.at_bound]
        earned = [f for f in richer if self.better(present, f, SEARCH_TAIL)[0]]
        return (earned[int(np.argmin(self.scores(earned)))], True, "") if earned else (best, False, why)

    def as_two(self, present: JointFit, best: JointFit, fits: Mapping[str, JointFit]) -> JointFit | None:
        """The model with two effects that together are friction with a direction, if they are the better.

        What explains everything needs no two in its place, unless it is what two do together; nor do two
        explain what both as one are far from. In a tie one effect is simpler than two.
        """
        both = fits.get(ONE_SIDED)
        open_ = best is both or (self.wide and best.rmse > EXPLAINED * self.floor)
        room = MAX_EFFECTS - len(present.effects)
        if both is None or not open_ or both.rmse >= HOPELESS * best.rmse or room < 2:
            return None
        apart = self.take_apart(present, both)
        pair = self.winner(apart) if apart else best
        if apart and best is both:
            self.apart[ONE_SIDED] = pair
        better = int(np.argmin(self.scores([best, pair]))) == 1
        same = best is both and {*pair.effects[-2:]} == EXACTLY
        return pair if better and not self.tied(pair, best, same)[0] else None

    def pair_rows(self, number: int, present: JointFit, pair: JointFit) -> list[Trial]:
        """The rows of two effects that a round adds together."""
        before, after = present.held_out_rmse, pair.held_out_rmse
        names = " and ".join(pair.effects[-2:])
        self.report(f"+ {names}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
        gain, ci = self.gain(present, pair)
        reason = f"{names} together: best on unseen motions"
        return [Trial(number, name, pair, gain, ci, "named", reason) for name in pair.effects[-2:]]

    def is_last(self, present: JointFit) -> bool:
        """Whether no further effect is to be added to a model."""
        if self.finished(present) or clock_sensitivity(self, present) or in_place(self, present):
            return True
        if self.too_coarse(present) or self.a_spring(present):
            return True
        return len(present.effects) >= MAX_EFFECTS

    def ended(self, present: JointFit) -> bool:
        """Whether no other search would change what a model says."""
        if clock_sensitivity(self, present):
            return True
        if self.noise_only(present) or self.too_coarse(present) or self.a_spring(present):
            return True
        return in_place(self, present) is not None

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
                if not self.better(without, present, KEEP_TAIL)[0] and not self.whitens(without, present):
                    self.report(f"- {name}: not needed beside the others")
                    present, changed = without, True
                    break
                rivals[name] = self.rivals(present, name, without)
                best = self.winner([fit for fit in rivals[name] if not set(fit.effects) & set(self.vetoes)])
                simpler = best.effects[-1] in NESTED.get(name, ())
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
        self.without[name] = without.held_out_rmse
        # Beside Coulomb friction, a friction that contains it is no other cause.
        contains = [c for c, simpler in NESTED.items() if set(simpler) & set(without.effects)]
        skip, tried = (name, *contains), tuple(BEHIND_SENSOR)
        fits = self.tried_beside(without, present, skip)
        if fits is None:
            fits = self.fit_candidates(without, skip=skip, vetoed=tried, known=present)
        for simpler in {*NESTED.get(name, ())} & {*self.candidates} - {
            *self.vetoes,
            *contains,
            *without.effects,
        }:
            # Near a sharp optimum a simpler effect is found from what contains it, if from anywhere.
            inside = self.from_richer(present, name, simpler)
            if simpler not in fits or inside.rmse < fits[simpler].rmse:
                fits[simpler] = inside
        if len(present.effects) > 1 and present.rmse < SHARP * self.whole:
            fits |= self.from_present(present, without, fits)
        self.added[frozenset(without.effects)] = (without, present, *fits.values())
        return [present, *fits.values()]
