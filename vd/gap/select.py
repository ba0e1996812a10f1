"""Choose the effects that a joint's servo lacks, prove them on held-out motions, and know when not to.

Forward selection with a full refit in every round. Everything is judged on trajectories that the fit has
not seen, and resampled by whole trajectories with the choice inside the resampling.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vd.gap.coordinates import Scales, sizes
from vd.gap.fit import JointFit
from vd.gap.statistics import covariance, half_width, interval, rmse
from vd.kernels.effects import EFFECTS

NESTED = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "torque_speed_limit": ("torque_limit",),
    "elastic_transmission": ("payload_inertia",),
}
"""Effects that contain a simpler one; in a tie the simpler one is meant."""

NO_GAP = 1.15
"""A baseline within this factor of the noise floor leaves nothing to explain."""
MIN_GAIN = 0.05
"""Share of the held-out RMSE that an effect must remove."""
MIN_GAIN_FLOORS = 0.7
"""Gap that an effect must close, as sqrt(before^2 - after^2), in noise floors."""
KEEP_TAIL = 0.1
"""Share of the resamples that may see no gain from an effect that is in the model already: what was
earned is not lost to the luck of another local fit."""
NAMED = 0.9
"""Share of the resamples that must choose an effect for it to be named."""
PENALTY = 0.01
"""Relative RMSE that a further parameter must earn to be preferred."""
TIE = 0.01
"""Relative RMSE within which two candidates are a tie whatever their interval."""
EXPLAINED = 1.1
"""A winner within this factor of the noise floor leaves white residuals ..."""
EXCESS_FLOORS = 0.15
"""... so that an alternative that leaves this much more, in noise floors, is worse: thousands of samples
carry that difference."""
RECOVERED = 0.5
"""Share of the squared gap that the named effects must recover; less is an unknown cause."""
RANDOM = "command_jitter"
"""The effect that no single prediction shows (:mod:`vd.gap.jitter`); it is tried when nothing else is
enough, and as the last."""
JITTER_START_S = 0.005
MIN_TRAJECTORIES = 3
DETERMINED = ("kp", "kd", "inertia")
"""Baseline parameters that every useful excitation determines."""
WIDE = 10.0
"""Ratio of the ends of an interval from which a parameter counts as open."""
MAX_EFFECTS = 3
MAX_ROUNDS = 6
"""Rounds in all, with those after a revision."""
SHORT_LIST = 10
"""Candidates of a round that are fitted, after the linear screening of all."""
FINALISTS = 6
"""Candidates of a round that are fitted to the end."""
STARTS = 2
SCREEN_ITERATIONS = 7
FULL_ITERATIONS = 12

Call = tuple[str, dict[str, Any]]
Run = Callable[[list[Call]], list[Any]]
"""Runs methods of the joint's :class:`vd.gap.fit.JointProblem` by name, in parallel."""


@dataclass(frozen=True)
class Trial:
    """A candidate in one round of the selection."""

    round: int
    name: str
    fit: JointFit
    gain: float
    gain_ci: tuple[float, float]
    decision: str = "rejected"
    reason: str = ""
    placebo: bool = False


@dataclass(frozen=True)
class Accepted:
    """An effect of the final model."""

    name: str
    confidence: float
    estimates: dict[str, tuple[float, float, float]]
    """Parameter -> (value, low, high)."""
    alternatives: tuple[tuple[str, float, tuple[float, float]], ...]
    """(name, held-out RMSE, interval of the difference to this effect's), best first."""
    tied: tuple[str, ...]
    """Alternatives that this recording does not tell from it."""
    at_bound: bool

    @property
    def named(self) -> bool:
        """Whether it is the answer rather than one of a set."""
        return not self.tied and not self.at_bound and self.confidence >= NAMED


@dataclass(frozen=True)
class Explanation:
    """What one joint lacks."""

    baseline: JointFit
    final: JointFit
    verdict: str
    reason: str
    accepted: tuple[Accepted, ...] = ()
    trials: tuple[Trial, ...] = ()


@dataclass
class Selection:
    """Forward selection for one joint.

    Attributes:
        run: Runs fits.
        joint: Index of the joint in its chain.
        others: Slots of the other joints of the chain.
        candidates: Effects to consider.
        floor: Noise floor [rad].
        scales: Sizes of the joint's motion.
        weights: Bootstrap weights of the trajectories [R, S].
        refits: Steps of each refit without a fold (:meth:`vd.gap.fit.JointProblem.fit`).
        vetoes: Effects that telemetry contradicts, with the reason.
        report: Called with a line of progress.
    """

    run: Run
    joint: int
    others: Sequence[int]
    candidates: Sequence[str]
    floor: float
    scales: Scales
    weights: np.ndarray
    refits: int = 0
    vetoes: Mapping[str, str] = field(default_factory=dict)
    report: Callable[[str], None] = lambda line: None

    def explain(self, baseline: JointFit) -> Explanation:
        """Select effects, starting from the fitted baseline."""
        loose = self.undetermined(baseline)
        if len(baseline.sse) < MIN_TRAJECTORIES:
            text = (
                f"{len(baseline.sse)} trajectories leave none to hold out; record {MIN_TRAJECTORIES} at least"
            )
            return Explanation(baseline, baseline, "under_excited", text)
        if baseline.held_out_rmse < NO_GAP * self.floor:
            if loose:
                return Explanation(baseline, baseline, "under_excited", loose)
            return Explanation(baseline, baseline, "no_gap", "the plain model is within the noise floor")
        present, rivals, trials = baseline, {}, self.contradicted(baseline)
        tried = 0
        while tried < MAX_ROUNDS:
            longer, added, rows = self.extend(present, tried)
            trials += rows
            tried = max((row.round for row in rows), default=MAX_ROUNDS)
            rivals.update(added)
            if longer is present:
                break
            present = longer
            if RANDOM in present.effects:
                break
            if len(present.effects) > 1:
                revised, rivals = self.revise(present)
                if set(revised.effects) == set(present.effects) or len(revised.effects) >= MAX_EFFECTS:
                    present = revised
                    break
                present = revised
            if present.held_out_rmse < NO_GAP * self.floor or len(present.effects) >= MAX_EFFECTS:
                break
        return self.conclude(baseline, present, rivals, trials, loose)

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
            accepted, why = self.better(present, best)
            trials += self.judge(number, present, fits, best, accepted, why)
            if not accepted:
                break
            name, before, after = best.effects[-1], present.held_out_rmse, best.held_out_rmse
            self.report(f"+ {name}: {1e3 * before:.2f} -> {1e3 * after:.2f} mrad held out")
            rivals[name] = list(fits.values())
            present = best
            if name == RANDOM:
                break
            if present.held_out_rmse < NO_GAP * self.floor or len(present.effects) >= MAX_EFFECTS:
                break
        return present, rivals, trials

    def undetermined(self, fit: JointFit) -> str:
        """Which parameter of the baseline the motions leave open, in words; empty if none."""
        for key, (low, high) in intervals(fit, self.floor).items():
            if key in DETERMINED and high > WIDE * low:
                return f"{key} can lie anywhere between {low:.2g} and {high:.2g}: the motions do not show it"
        return ""

    def fit_candidates(self, present: JointFit, skip: Sequence[str] = ()) -> dict[str, JointFit]:
        """Fits with each promising further effect, the finalists to convergence, by name."""
        skip = {*present.effects, *self.vetoes, *skip}
        names = [name for name in self.candidates if name not in skip and name != RANDOM]
        starts = {name: sizes(name, self.others, self.scales) for name in names}
        flat = [(name, start) for name in names for start in starts[name]]
        if not flat:
            return {}
        promise = self.run(
            [("promise", {"fit": present, "starts": [s for _, s in flat], "scales": self.scales})]
        )[0]
        order: dict[str, list[int]] = {name: [] for name in names}
        for i in np.argsort(-promise):
            order[flat[i][0]].append(int(i))
        ranked = sorted(names, key=lambda name: -promise[order[name][0]])[:SHORT_LIST]
        calls = []
        for name in ranked:
            chosen = [{**present.values, **flat[i][1]} for i in order[name][:STARTS]]
            calls.append(self.call(present, name, chosen, SCREEN_ITERATIONS))
        screened = [fits[0] for fits in self.run(calls)]
        screened.sort(key=lambda fit: float(fit.sse.sum()))
        finalists = screened[:FINALISTS]
        refits = self.run(
            [self.call(present, fit.effects[-1], [fit.values], FULL_ITERATIONS) for fit in finalists]
        )
        fits = {fit.effects[-1]: fit for fit in (*(r[0] for r in refits), *screened[FINALISTS:])}
        if RANDOM in self.candidates and RANDOM not in skip:
            if min(fit.rmse for fit in fits.values()) > NO_GAP * self.floor:
                fits[RANDOM] = self.run([("fit_jitter", self.jitter_start(present, fits))])[0]
        return fits

    def jitter_start(self, present: JointFit, fits: Mapping[str, JointFit]) -> dict[str, Any]:
        """Where the fit of a random delay starts: at the constant delay, if that was fitted."""
        delay = fits.get("command_delay")
        start = {**present.values, "command_delay.delay_s": JITTER_START_S}
        return {
            "base": present.rows,
            "effects": present.effects,
            "starts": [start if delay is None else delay.values],
            "scales": self.scales,
            "iterations": FULL_ITERATIONS,
        }

    def call(
        self, present: JointFit, name: str, starts: Sequence[Mapping[str, float]], iterations: int
    ) -> Call:
        """The call that fits ``present`` with one more effect."""
        return (
            "fit",
            {
                "base": present.rows,
                "effects": (*present.effects, name),
                "starts": list(starts),
                "scales": self.scales,
                "iterations": iterations,
                "refits": self.refits if iterations == FULL_ITERATIONS else 0,
            },
        )

    def scores(self, fits: Sequence[JointFit], weights: np.ndarray | None = None) -> np.ndarray:
        """Log of held-out RMSE plus the price of parameters, shape [C] or [C, R]."""
        loss = np.stack([fit.held_out for fit in fits])
        error = np.log(np.maximum(rmse(loss, fits[0].count, weights), 1e-12))
        price = PENALTY * np.array([len(fit.x) for fit in fits], float)
        return error + (price if weights is None else price[:, None])

    def winner(self, fits: Sequence[JointFit]) -> JointFit:
        """The candidate with the best held-out score; the simpler one that it contains if that is as good.

        One with a parameter at its bound wins only if all have.
        """
        inside = [fit for fit in fits if not fit.at_bound] or list(fits)
        best = inside[int(np.argmin(self.scores(inside)))]
        simpler = [f for f in inside if f.effects[-1] in NESTED.get(best.effects[-1], ())]
        return next((fit for fit in simpler if self.tied(best, fit)[0]), best)

    def gain(self, before: JointFit, after: JointFit) -> tuple[float, tuple[float, float]]:
        """Share of the held-out RMSE removed, with its interval over trajectories."""
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        return 1.0 - after.held_out_rmse / before.held_out_rmse, interval(1.0 - new / old)

    def better(self, before: JointFit, after: JointFit, tail: float = 0.025) -> tuple[bool, str]:
        """Whether the step from one model to the larger is earned, and if not why.

        Args:
            before: The smaller model.
            after: The larger.
            tail: Share of the resamples that may see no gain.
        """
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        gain = 1.0 - after.held_out_rmse / before.held_out_rmse
        low = float(np.quantile(1.0 - new / old, tail))
        closed = np.sqrt(max(before.held_out_rmse**2 - after.held_out_rmse**2, 0.0))
        if gain < MIN_GAIN:
            return False, f"removes {100.0 * gain:.1f} % of the error, less than {100.0 * MIN_GAIN:.0f} %"
        if low <= 0.0:
            return False, "its gain over trajectories is not distinguishable from 0"
        if closed < MIN_GAIN_FLOORS * self.floor:
            return False, "what it removes is below the noise floor"
        return True, ""

    def tied(self, winner: JointFit, other: JointFit) -> tuple[bool, tuple[float, float]]:
        """Whether the recording does not tell two fits apart, and the interval of their difference [rad].

        A winner at the noise floor leaves white residuals, so that samples count: what the other leaves
        in excess of it is then decisive, even if few motions show it.
        """
        best, error = (rmse(fit.held_out, fit.count, self.weights) for fit in (winner, other))
        low, high = interval(error - best)
        if winner.held_out_rmse < EXPLAINED * self.floor:
            excess = other.rmse**2 - winner.rmse**2
            return excess < (EXCESS_FLOORS * self.floor) ** 2, (low, high)
        return low <= TIE * winner.held_out_rmse, (low, high)

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
                if not self.better(without, present, KEEP_TAIL)[0]:
                    self.report(f"- {name}: not needed beside the others")
                    present, changed = without, True
                    break
                others = self.fit_candidates(without, skip=(name,))
                rivals[name] = [present, *others.values()]
                best = self.winner(rivals[name])
                if best is not present and not self.tied(best, present)[0]:
                    self.report(f"~ {name} exchanged for {best.effects[-1]}")
                    present, changed = best, True
                    break
            if not changed:
                break
        return present, rivals

    def refit(self, present: JointFit, effects: Sequence[str]) -> JointFit:
        """The fit with only some of a model's effects."""
        rows = present.rows.copy()
        for name in set(present.effects) - set(effects):
            for parameter in EFFECTS[name].parameters:
                rows[self.joint, parameter.column] = parameter.neutral
        values = {k: v for k, v in present.values.items() if k.rpartition(".")[0] in ("", *effects)}
        call = {"base": rows, "effects": tuple(effects), "starts": [values], "scales": self.scales}
        return self.run([("fit", {**call, "iterations": FULL_ITERATIONS, "refits": self.refits})])[0][0]

    def conclude(
        self,
        baseline: JointFit,
        final: JointFit,
        rivals: Mapping[str, list[JointFit]],
        trials: Sequence[Trial],
        loose: str,
    ) -> Explanation:
        """Confidence, sets and verdict of the final model."""
        spread = intervals(final, self.floor)
        accepted = [self.accept(final, name, rivals.get(name, [final]), spread) for name in final.effects]
        explanation = Explanation(baseline, final, "unknown", "", tuple(accepted), tuple(trials))
        if not accepted:
            tried = [t for t in trials if not t.placebo and np.isfinite(t.gain)]
            best = max((t.gain for t in tried), default=0.0)
            why = tried[0].reason if tried else "there is no candidate"
            if baseline.held_out_rmse > 2.0 * self.floor and best < MIN_GAIN:
                return replace(explanation, reason=f"a gap that no candidate explains ({why})")
            if loose:
                return replace(explanation, verdict="under_excited", reason=loose)
            return replace(explanation, verdict="no_gap", reason=f"no effect is significant: the best {why}")
        gap = baseline.held_out_rmse**2 - self.floor**2
        share = (baseline.held_out_rmse**2 - final.held_out_rmse**2) / max(gap, 1e-30)
        # What chance does to each sample stays, however well its size is known.
        if share < RECOVERED and RANDOM not in final.effects:
            text = f"the best candidate recovers {100.0 * share:.0f} % of the squared gap, less than half"
            return replace(explanation, reason=text)
        named = [a.name for a in accepted if a.named]
        if named:
            return replace(explanation, verdict="effects", reason=f"{' and '.join(named)} explain it")
        if all(a.at_bound for a in accepted):
            return replace(explanation, reason=f"{accepted[0].name} fits only with a parameter at its bound")
        sets = "; ".join(" or ".join((a.name, *a.tied)) for a in accepted if not a.at_bound)
        return replace(explanation, verdict="ambiguous", reason=f"{sets}: not told apart")

    def accept(
        self, final: JointFit, name: str, rivals: Sequence[JointFit], spread: Mapping[str, tuple[float, ...]]
    ) -> Accepted:
        """Confidence and set of one effect of the final model."""
        own = next((fit for fit in rivals if fit.effects and fit.effects[-1] == name), None)
        mine = final if own is None or final in rivals else own
        others = [fit for fit in rivals if fit is not mine and fit.effects[-1] != name]
        choice = np.argmin(self.scores([mine, *others], self.weights), axis=0)
        simple = {i + 1 for i, fit in enumerate(others) if name in NESTED.get(fit.effects[-1], ())}
        share = float(np.mean([c == 0 or c in simple for c in choice]))
        alternatives, tied = [], []
        for fit in sorted(others, key=lambda other: other.held_out_rmse):
            other = fit.effects[-1]
            same, ci = self.tied(mine, fit)
            alternatives.append((other, fit.held_out_rmse, ci))
            if same and name not in NESTED.get(other, ()):
                tied.append(other)
        if share < NAMED and not tied:
            rival = int(np.argmax(np.bincount(choice, minlength=len(others) + 1)[1:]))
            tied.append(others[rival].effects[-1])
        return Accepted(
            name=name,
            confidence=share,
            estimates={
                p.name: (final.values[f"{name}.{p.name}"], *spread[f"{name}.{p.name}"])
                for p in EFFECTS[name].parameters
                if f"{name}.{p.name}" in final.values
            },
            alternatives=tuple(alternatives),
            tied=tuple(tied),
            at_bound=any(key.startswith(f"{name}.") for key in final.at_bound),
        )


def intervals(fit: JointFit, floor: float, ridge: float = 0.01) -> dict[str, tuple[float, float]]:
    """95 % intervals of a fit's parameters, by key, from the spread over trajectories."""
    matrix = covariance(fit.gram, fit.gradient, np.full(len(fit.x), ridge * floor**2), floor)
    width = half_width(np.diag(matrix), len(fit.gram))
    result = {}
    for c, x, w in zip(fit.coordinates, fit.x, width, strict=True):
        low, high = max(x - w, c.lower), min(x + w, c.upper)
        result[c.key] = float(c.value(low)), float(c.value(high))
    return result
