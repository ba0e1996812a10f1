"""Search for the effects that a joint's servo lacks: forward selection with full refits, checked backward.

A step of the search is tentative; :mod:`vd.gap.verdict` has the last word.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vd.gap.candidates import BETTER, HOPELESS, Call
from vd.gap.chance import as_random, at_once, in_place, try_random, unlimited
from vd.gap.clock import explain_weighted, swayed
from vd.gap.consensus import as_another, as_changing
from vd.gap.explanation import Accepted, Explanation, Trial
from vd.gap.frictions import EXACTLY, Frictions
from vd.gap.jitter import CALLS
from vd.gap.joint_fit import ONE_SIDED, JointFit
from vd.gap.judge import EXPLAINED, MIN_GAIN_FLOORS, MIN_SHARE, NESTED, RANDOM, REPEATABLE, SHARP
from vd.gap.telemetry import BEHIND_SENSOR
from vd.gap.verdict import cancelled

MIN_TRAJECTORIES = 3
MAX_EFFECTS = 3
MAX_ROUNDS = 6
"""Rounds in all, with those after a revision."""
WIDE = 15.0
"""Error of a round's best, in noise floors, up to which every start of every candidate is tried: a linear
promise is no guide to where an effect that rings or brakes can be found."""
LOOKS = 2
"""Rounds in which they are: each costs as much as several others."""
RESTARTS = 2
"""Searches from another first effect, where the first search leaves a gap."""
UNEARNED = float(np.hypot(1.0, MIN_GAIN_FLOORS))
"""Error, in noise floors, from which down to the floor no further effect can close what it has to."""
COARSE = 0.9
"""Share of an error that a finer time step leaves, at which the search is made with that."""
LARGE = 4.0
"""Gap, in noise floors, that two wrong effects together do not imitate: only a search that fails has to look
that wide."""
NEAR = 4.0
"""A final error between ``NO_GAP`` and this, in noise floors, is worth a search from another first effect."""
SEARCH_TAIL = 0.4
"""Share of the resamples that may see no gain from an effect while the search goes on: one of two causes
alone can make some motions worse."""
KEEP_TAIL = 0.1
"""Share of the resamples that may see no gain from an effect that is in the model already: what was
earned is not lost to the luck of another local fit."""


@dataclass(kw_only=True)
class Selection(Frictions):
    """Forward selection for one joint.

    Attributes:
        restarts: Searches from another first effect, where the first search leaves a gap.
        looks: Rounds in which every start may be tried (:meth:`look_wider`).
        wide: Whether more is tried than the best starts and one effect after the other.
        like: What another joint of the finger certainly lacks: effects, and values by key.
        changing: The same of one whose friction changes over the recording: what comes nearest there.
        random: The same of one that has random delays, these among the effects: what is sure beside them.
    """

    restarts: int = RESTARTS
    looks: int = LOOKS
    wide: bool = True
    like: tuple[tuple[str, ...], Mapping[str, float]] = ((), {})
    changing: tuple[tuple[str, ...], Mapping[str, float]] = ((), {})
    random: tuple[tuple[str, ...], Mapping[str, float]] = ((), {})

    def explain(self, baseline: JointFit, start: tuple[JointFit, list[Trial]] | None = None) -> Explanation:
        """Select effects, starting from the fitted baseline.

        Args:
            baseline: The plain model.
            start: A model that leaves noise, and the evidence for it, where a search with a coarser step has
                found one: it is only compared with others.
        """
        loose = self.undetermined(baseline)
        self.whole = baseline.held_out_rmse
        if len(baseline.sse) < MIN_TRAJECTORIES:
            text = (
                f"{len(baseline.sse)} trajectories leave none to hold out; record {MIN_TRAJECTORIES} at least"
            )
            return Explanation(baseline, baseline, "under_excited", text)
        if self.no_gap(baseline):
            if loose:
                return Explanation(baseline, baseline, "under_excited", loose)
            return Explanation(baseline, baseline, "no_gap", "the plain model is within the noise floor")
        if veil := swayed(self, baseline):  # with an identified limit in it
            return explain_weighted(self, baseline, veil)
        known = None if start else as_another(self, baseline, loose) or as_changing(self, baseline, loose)
        if not start and known is None:
            known = as_random(self, baseline, loose)
        if known is not None:
            return known
        trials = [] if start else self.contradicted(baseline)
        present, rivals, rows = (start[0], {}, start[1]) if start else self.first(baseline)
        trials += rows
        if veil := swayed(self, present):
            return explain_weighted(self, baseline, veil)
        alone = [t for t in rows if t.round == 1 and len(t.fit.effects) == 1]
        first = {t.name: t.fit for t in alone if not t.placebo and np.isfinite(t.gain)}
        tied = {t.name for t in rows if t.round == 1 and t.decision == "tied"}
        for name in sorted(first, key=lambda n: first[n].rmse):
            if present.effects and (self.finished(present) or self.ended(present)):
                break
            # Far from the floor another path would change little, unless its beginning was as good.
            far = present.effects and present.held_out_rmse >= NEAR * self.floor
            skipped = name not in tied if far else name in present.effects
            if skipped or self.restarts == 0 or first[name].at_bound:
                continue
            self.restarts -= 1
            other, fits, rows = self.search(baseline, first[name])
            if self.best([present, other]) is other:
                self.report(f"from {name}: {1e3 * other.held_out_rmse:.2f} mrad held out is better")
                present, rivals = other, fits
                trials += [replace(row, round=row.round + MAX_ROUNDS) for row in rows]
        if self.too_coarse(present):
            self.report(f"{' and '.join(present.effects)}: the time step shows, so again with a finer one")
            fine, refined = self.finer(), self.refined(present)
            plain = fine.run([fine.plain(baseline)])[0]
            if refined.rmse > UNEARNED * self.floor or self.lack_of_fit(refined):
                return fine.explain(plain)
            return fine.explain(plain, (fine.refit(refined, refined.effects), trials))
        if present.effects:
            earned, why = self.better(baseline, present)
            if not earned:
                self.report(f"taken back: {why}")
                present, rivals = baseline, {}
        beside: tuple[Accepted, ...] = ()
        # What is fitted well leaves none to chance, nor does a spring.
        fitted = self.finished(present) or self.white(present) or self.noise_only(present)
        if not fitted and not self.a_spring(present):
            chance, beside, rows = try_random(self, baseline, present)
            trials += [replace(row, round=row.round + 2 * MAX_ROUNDS) for row in rows]
            if chance is not present:
                present, rivals = chance, {}
                if RANDOM not in present.effects:
                    present, rivals = self.revise(present)
        behind = set(BEHIND_SENSOR) & set(self.vetoes) & set(self.candidates)
        stale = any(len(fit.effects) != len(present.effects) for fits in rivals.values() for fit in fits)
        named = present.effects and RANDOM not in present.effects
        if named and (behind or stale or set(rivals) != set(present.effects)):
            rivals = {name: self.rivals(present, name) for name in present.effects}
        together = self.as_an_offset(self.put_together(present))
        if together is not present:
            present = together
            rivals = {name: self.rivals(present, name) for name in present.effects}
        evidence = self.settle(trials, present)
        if not present.effects or RANDOM in present.effects:
            return self.conclude(baseline, present, rivals, evidence, loose, known=beside)
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

    def beside_better(self, result: Explanation, final: JointFit) -> dict[str, list[JointFit]]:
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

    def explained(self, explanation: Explanation) -> Explanation:
        """The explanation with what its names do not say.

        What a member of a set means that telemetry contradicts by its name; and no names where two
        effects are but one that is not in the table.
        """
        alike = cancelled(explanation.final, self.joint, self.rest)
        if alike and explanation.verdict in ("effects", "ambiguous"):
            return replace(explanation, verdict="unknown", reason=alike)
        tied = {name for one in explanation.accepted for name in one.tied}
        notes = [
            f"{name} {BEHIND_SENSOR[name]}" for name in sorted(tied & set(BEHIND_SENSOR) & set(self.vetoes))
        ]
        return replace(explanation, reason="; ".join([explanation.reason, *notes]))

    def first(self, baseline: JointFit) -> tuple[JointFit, dict[str, list[JointFit]], list[Trial]]:
        """The first search; it looks wide at once where a gap is small, but not where chance fills it."""
        if not self.veiled and (baseline.held_out_rmse > LARGE * self.floor or at_once(self, baseline)):
            self.wide = False
            found = self.search(baseline, baseline)
            self.wide = True
            if self.finished(found[0]) or self.ended(found[0]):
                return found
            chance = at_once(self, baseline)
            if chance and self.likelier(found[0], chance[0]) and unlimited(self, found[0], chance[0]):
                self.report(f"{RANDOM} leaves noise: nothing else is tried from every start")
                self.restarts = 0
                return found
            self.report("not explained: every candidate is tried from every start")
        return self.search(baseline, baseline)

    def search(
        self, baseline: JointFit, start: JointFit
    ) -> tuple[JointFit, dict[str, list[JointFit]], list[Trial]]:
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
            if (not grown and present is not start) or swayed(self, present) or self.too_coarse(present):
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

    def extend(self, present: JointFit, done: int) -> tuple[JointFit, dict[str, list[JointFit]], list[Trial]]:
        """Add effects one by one while they are earned.

        Returns:
            The larger model, the fits with others in the place of each added effect, and the evidence.
        """
        rivals: dict[str, list[JointFit]] = {}
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
            if not swayed(self, best):
                best = fits[best.effects[-1]] = self.look_beside(best, self.whole)
            accepted, why = self.better(present, best, SEARCH_TAIL)
            if not accepted and self.whitens(present, best):
                accepted, why = True, ""
            if not accepted:
                # The simpler of two stands for the one that contains it only if it earns its place as well.
                name = best.effects[-1]
                richer = [
                    f for f in fits.values() if name in NESTED.get(f.effects[-1], ()) and not f.at_bound
                ]
                earned = [f for f in richer if self.better(present, f, SEARCH_TAIL)[0]]
                if earned:
                    best, accepted, why = earned[int(np.argmin(self.scores(earned)))], True, ""
            trials += self.judge(number, present, fits, best, accepted, why)
            trials += self.screened_out(number, present, fits)
            if not accepted:
                break
            room = MAX_EFFECTS - len(present.effects)
            both = fits.get(ONE_SIDED)
            # What explains everything needs no two in its place, unless it is what two do together; nor do
            # two explain what both as one are far from.
            open_ = best is both or (self.wide and best.rmse > EXPLAINED * self.floor)
            if both is not None and open_ and both.rmse < HOPELESS * best.rmse and room >= 2:
                apart = self.take_apart(present, both)
                pair = self.winner(apart) if apart else best
                if apart and best is both:
                    self.apart[ONE_SIDED] = pair
                better = int(np.argmin(self.scores([best, pair]))) == 1
                same = best is both and {*pair.effects[-2:]} == EXACTLY
                if better and not self.tied(pair, best, same)[0]:  # in a tie one effect is simpler than two
                    before, after = present.held_out_rmse, pair.held_out_rmse
                    names = " and ".join(pair.effects[-2:])
                    self.report(f"+ {names}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
                    gain, ci = self.gain(present, pair)
                    trials += [
                        Trial(
                            number, name, pair, gain, ci, "named", f"{names} together: best on unseen motions"
                        )
                        for name in pair.effects[-2:]
                    ]
                    present = pair
                    break
            name, before, after = best.effects[-1], present.held_out_rmse, best.held_out_rmse
            self.report(f"+ {name}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
            rivals[name] = list(fits.values())
            self.added[frozenset(present.effects)] = (present, *fits.values())
            present = best
            if self.finished(present) or swayed(self, present) or in_place(self, present):
                break
            if self.too_coarse(present) or self.a_spring(present):
                break
            if len(present.effects) >= MAX_EFFECTS:
                break
        return present, rivals, trials

    def too_coarse(self, present: JointFit) -> bool:
        """Whether it is the time step of the search that keeps a model from leaving no more than noise."""
        if self.fine or self.veiled or not present.effects or self.no_gap(present) or self.white(present):
            return False
        if present.rmse > WIDE * self.floor:
            return False
        return self.refined(present).rmse < COARSE * present.rmse

    def finer(self) -> "Selection":
        """The same search with the step at which estimates are finished."""

        def run(calls: list[Call]) -> list[Any]:
            every = [
                (name, options if name in CALLS else {**options, "finer": True}) for name, options in calls
            ]
            return self.run(every)

        return replace(
            self, run=run, fine=True, restarts=RESTARTS, looks=LOOKS, without={}, apart={}, added={}
        )

    def finished(self, present: JointFit) -> bool:
        """Whether a model leaves nothing to explain: noise, of no more than its size."""
        return self.no_gap(present) and not self.lack_of_fit(self.refined(present))

    def ended(self, present: JointFit) -> bool:
        """Whether no other search would change what a model says."""
        if swayed(self, present):
            return True
        if self.noise_only(present) or self.too_coarse(present) or self.a_spring(present):
            return True
        return in_place(self, present) is not None

    def a_spring(self, present: JointFit) -> bool:
        """Whether a model is near enough to stand for a cause that the table has not: it is no answer."""
        return present.rmse < NEAR * self.floor and bool(cancelled(present, self.joint, self.rest))

    def noise_only(self, present: JointFit, floors: float = UNEARNED) -> bool:
        """Whether a model leaves noise on what it was fitted to: no other search finds a better one.

        It may be a little more than the floor: at rest the rounding to counts repeats. Beside a gap of some
        sixty noise floors more than that is what no fit is better than: the times of a recording are good to
        0.1 ms, a milliradian where a joint is fast.

        Args:
            present: The model.
            floors: Error up to which it may be noise, in noise floors.
        """
        best = max(floors * self.floor, min(MIN_SHARE * self.whole, REPEATABLE * self.floor))
        if not self.veiled and COARSE * present.rmse > best:
            return False
        refined = self.refined(present)  # without what the time step of the search leaves
        return (self.veiled or refined.rmse < best) and not self.lack_of_fit(refined)

    def whitens(self, before: JointFit, after: JointFit) -> bool:
        """Whether a larger model leaves noise where the smaller leaves structure.

        Such a step is earned however little of the error it removes: two limits of one motor do nearly the
        same, and the smaller model would be refused for what it leaves.
        """
        if after.at_bound or after.rmse > EXPLAINED * self.floor or before.rmse > REPEATABLE * self.floor:
            return False
        if float(np.quantile(self.weights @ (before.sse - after.sse), 0.025)) <= 0.0:
            return False
        return bool(self.lack_of_fit(self.refined(before))) and not self.lack_of_fit(self.refined(after))

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

    def revise(self, present: JointFit) -> tuple[JointFit, dict[str, list[JointFit]]]:
        """Backward check: drop what is not needed, exchange what another effect does better.

        Returns the revised model and, for each of its effects, the fits with others in its place.
        """
        rivals: dict[str, list[JointFit]] = {}
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
