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
NAMED = 0.9
"""Share of the resamples that must choose an effect for it to be named."""
PENALTY = 0.01
"""Relative RMSE that a further parameter must earn to be preferred."""
TIE = 0.01
"""Relative RMSE within which two candidates are a tie whatever their interval."""
EXPLAINED = 1.1
"""A winner within this factor of the noise floor leaves white residuals ..."""
EXCESS_FLOORS = 0.25
"""... so that an alternative with this much more, in noise floors, is worse even if only few motions show
it: thousands of samples carry that difference."""
RECOVERED = 0.5
"""Share of the squared gap that the named effects must recover; less is an unknown cause."""
MAX_EFFECTS = 3
SHORT_LIST = 10
"""Candidates of a round that are fitted, after the linear screening of all."""
FINALISTS = 5
"""Candidates of a round that are fitted to the end."""
STARTS = 2
SCREEN_ITERATIONS = 4
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
        if baseline.held_out_rmse < NO_GAP * self.floor:
            return Explanation(baseline, baseline, "no_gap", "the plain model is within the noise floor")
        present = baseline
        trials: list[Trial] = []
        rivals: dict[str, list[JointFit]] = {}
        for number in range(1, MAX_EFFECTS + 1):
            fits = self.fit_candidates(present)
            if not fits:
                break
            best = self.winner(list(fits.values()))
            accepted, why = self.better(present, best)
            trials += self.judge(number, present, fits, best, accepted, why)
            if not accepted:
                break
            name = best.effects[-1]
            rivals[name] = list(fits.values())
            self.report(
                f"+ {name}: {1e3 * present.held_out_rmse:.2f} -> {1e3 * best.held_out_rmse:.2f} mrad held out"
            )
            present = best
            if present.held_out_rmse < NO_GAP * self.floor:
                break
        if len(present.effects) > 1:
            present, rivals = self.revise(present)
        return self.conclude(baseline, present, rivals, trials)

    def fit_candidates(self, present: JointFit, skip: Sequence[str] = ()) -> dict[str, JointFit]:
        """Fits with each promising further effect, the finalists to convergence, by name."""
        names = [
            n for n in self.candidates if n not in present.effects and n not in skip and n not in self.vetoes
        ]
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
        fits = {fit.effects[-1]: fit for fit in screened[FINALISTS:]}
        return {**{r[0].effects[-1]: r[0] for r in refits}, **fits}

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
        """The candidate with the best held-out score."""
        return fits[int(np.argmin(self.scores(fits)))]

    def gain(self, before: JointFit, after: JointFit) -> tuple[float, tuple[float, float]]:
        """Share of the held-out RMSE removed, with its interval over trajectories."""
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        return 1.0 - after.held_out_rmse / before.held_out_rmse, interval(1.0 - new / old)

    def better(self, before: JointFit, after: JointFit) -> tuple[bool, str]:
        """Whether the step from one model to the larger is earned, and if not why."""
        gain, (low, _) = self.gain(before, after)
        closed = np.sqrt(max(before.held_out_rmse**2 - after.held_out_rmse**2, 0.0))
        if gain < MIN_GAIN:
            return False, f"removes {100.0 * gain:.1f} % of the error, less than {100.0 * MIN_GAIN:.0f} %"
        if low <= 0.0:
            return False, "its gain over trajectories is not distinguishable from 0"
        if closed < MIN_GAIN_FLOORS * self.floor:
            return False, "what it removes is below the noise floor"
        return True, ""

    def tied(self, winner: JointFit, other: JointFit) -> tuple[bool, tuple[float, float]]:
        """Whether the recording does not tell two fits apart, and the interval of their difference [rad]."""
        best, error = (rmse(fit.held_out, fit.count, self.weights) for fit in (winner, other))
        low, high = interval(error - best)
        explained = winner.held_out_rmse < EXPLAINED * self.floor
        excess = other.held_out_rmse**2 - winner.held_out_rmse**2
        if explained and excess > (EXCESS_FLOORS * self.floor) ** 2:
            return False, (low, high)
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
                if not self.better(without, present)[0]:
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
    ) -> Explanation:
        """Confidence, sets and verdict of the final model."""
        spread = self.spread(final)
        accepted = [self.accept(final, name, rivals.get(name, [final]), spread) for name in final.effects]
        explanation = Explanation(baseline, final, "unknown", "", tuple(accepted), tuple(trials))
        if not accepted:
            best = max((t.gain for t in trials if not t.placebo), default=0.0)
            why = trials[0].reason if trials else "there is no candidate"
            if baseline.held_out_rmse > 2.0 * self.floor and best < MIN_GAIN:
                return replace(explanation, reason=f"a gap that no candidate explains ({why})")
            return replace(explanation, verdict="no_gap", reason=f"no effect is significant: the best {why}")
        gap = baseline.held_out_rmse**2 - self.floor**2
        share = (baseline.held_out_rmse**2 - final.held_out_rmse**2) / max(gap, 1e-30)
        if share < RECOVERED:
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

    def spread(self, fit: JointFit) -> dict[str, tuple[float, float]]:
        """95 % intervals of all parameters of a fit, by key."""
        return intervals(fit, self.floor)


def intervals(fit: JointFit, floor: float, ridge: float = 0.01) -> dict[str, tuple[float, float]]:
    """95 % intervals of a fit's parameters, by key, from the spread over trajectories."""
    matrix = covariance(fit.gram, fit.gradient, np.full(len(fit.x), ridge * floor**2), floor)
    width = half_width(np.diag(matrix), len(fit.gram))
    result = {}
    for c, x, w in zip(fit.coordinates, fit.x, width, strict=True):
        low, high = max(x - w, c.lower), min(x + w, c.upper)
        result[c.key] = float(c.value(low)), float(c.value(high))
    return result
