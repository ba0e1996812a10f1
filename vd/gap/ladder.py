"""The ladder: whole models of one joint, one member of each family of causes, fitted and held out.

All members of all families make thousands of models. The ladder fits those that can matter, in
rounds about the best model so far, the plain one at first. A round changes one family at a time: it
leaves the family out, or puts another member in. A linear estimate screens the changes, those that
promise least are not fitted. Rounds go on about models that are not worse; at last other members of
their families are put into all of these, since what is not fitted is not excluded. Which model is
good is not decided here (:mod:`vd.gap.rules`).

The members are those of the literature on servos: dry friction as in the models M1 to M4 of BAM
(Coulomb, Stribeck, either with a part in proportion to the load) or with a direction; a late or a
smoothed command; a torque that is limited, falls with speed, saturates or follows the supply; play
or an ignored error; a soft transmission; a load or an offset.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vd.gap import rules
from vd.gap.coordinates import PARAMETERS, Scales, keys_of, sizes, torque_power
from vd.gap.fit import JointFit, JointProblem
from vd.gap.rules import Evidence
from vd.kernels.servo.effects import EFFECTS

ROUNDS = 5
"""Rounds at most. Not tuned: hidden were two causes at most."""
FITTED = 9
"""Changes of a round that are fitted, of about 25; of the families that a model has all. Not tuned."""
STARTS = 2
"""Sizes of a further effect from which a fit starts, the most promising ones. Not tuned."""
COMPLETED = 8
"""Good models in which other members are tried at most: what is not fitted is not excluded. More than
eight were good on two of 14 halves of recordings. Not tuned."""

FitCall = Callable[[JointProblem], Any]
RunCalls = Callable[[Sequence[FitCall]], list[Any]]
"""Asks the problem of a joint, in parallel."""
Effects = frozenset[str]


@dataclass(frozen=True, eq=False)
class Ladder:
    """The ladder of one joint while it is built.

    Attributes:
        run: Asks the joint's problem.
        base: Rows of the chain, this joint's without effects [n, PARAMETER_COLUMNS].
        candidates: Effects that models may have.
        scales: Sizes of the joint's motion.
        others: Slots of the other joints of the chain.
        nominal: Nominal values of the baseline's parameters, by key.
        evidence: What models are judged by.
        models: All models fitted so far, by their effects.
    """

    run: RunCalls
    base: np.ndarray
    candidates: Sequence[str]
    scales: Scales
    others: Sequence[int]
    nominal: Mapping[str, float]
    evidence: Evidence
    models: dict[Effects, JointFit]

    def climb(self) -> None:
        """Fit models in rounds, then other members of their families in each that is good."""
        done: list[JointFit] = []
        while len(done) < ROUNDS and (centre := self.centre(done)):
            self.fit_changes(centre, FITTED)
            done.append(centre)
        completed: list[JointFit] = []
        while len(completed) < COMPLETED and (centre := next_of(self.good(), completed)):
            self.fit_changes(centre, 0)
            completed.append(centre)

    def centre(self, done: Sequence[JointFit]) -> JointFit | None:
        """The best good model, what has the best score, or another good one, if no round was about it yet."""
        inside = [fit for fit in self.models.values() if not rules.at_bound(fit)]
        first, *others = self.good()
        return next_of([first, rules.best_of(self.evidence, inside), *others], done)

    def good(self) -> list[JointFit]:
        """The good models, the best first."""
        return rules.good_models(self.evidence, list(self.models.values()))

    def fit_changes(self, centre: JointFit, additions: int) -> None:
        """Fit the models that differ from one in one family; of those with one more the most promising."""
        starts: list[tuple[Effects, dict[str, float]]] = []
        calls: dict[Effects, FitCall] = {}
        for effects in rules.changes(centre.effects, self.candidates):
            added = effects - {*centre.effects}
            if not added:
                calls[effects] = self.call(effects, [within(centre.values, effects)])
            elif effects not in self.models:
                starts += itertools.product([effects], self.sizes_of(added))
        for effects, best in self.promising(centre, starts, additions).items():
            calls[effects] = self.call(effects, self.beginnings(centre, effects, best))
        self.fit(calls)

    def sizes_of(self, added: Iterable[str]) -> list[dict[str, float]]:
        """Starting values of effects together, by key: small with small, large with large."""
        lists = []
        for name in sorted(added):
            fitted = {*self.nominal, *keys_of([name])}
            starts = sizes(name, self.others, self.scales)
            # None that differ only in what the joint's baseline does not fit.
            lists.append([start for start in starts if start.keys() <= fitted])
        longest = max(map(len, lists))
        result = []
        for index in range(longest):
            start: dict[str, float] = {}
            for values in lists:
                start |= values[index * len(values) // longest]
            result.append(start)
        return result

    def promising(
        self,
        centre: JointFit,
        starts: Sequence[tuple[Effects, dict[str, float]]],
        additions: int,
    ) -> dict[Effects, list[dict[str, float]]]:
        """The changes that promise most and all other members, and their most promising starts."""
        if not starts:
            return {}
        changed = []
        for effects, start in starts:
            change = dict(start)
            for key in keys_of({*centre.effects} - effects):
                change[key] = PARAMETERS[key].neutral
            changed.append(change)
        call = partial(JointProblem.promise, fit=centre, starts=changed, scales=self.scales)
        (promise,) = self.run([call])
        best: dict[Effects, list[dict[str, float]]] = {}
        for index in np.argsort(-promise):
            effects, start = starts[index]
            if effects in best or len(best) < additions or {*centre.effects} - effects:
                own = best.setdefault(effects, [])
                if len(own) < STARTS:
                    own.append(start)
        return best

    def beginnings(
        self, centre: JointFit, effects: Effects, added: Sequence[Mapping[str, float]]
    ) -> list[dict[str, float]]:
        """Where the fit of a changed model starts: at the present values, and at nominal ones.

        Without an effect the baseline may have gone far to imitate it (an unmodelled delay is best
        met by a servo twenty times as stiff), and from there no descent comes back.
        """
        values = within(centre.values, effects)
        starts = [{**values, **start} for start in added]
        stiffness = self.nominal.get("kp", 0.0)
        torque = stiffness / values["kp"] if stiffness and "kp" in values else 1.0
        nominal = {}
        for key, v in starts[0].items():
            nominal[key] = v * torque ** torque_power(key)
        nominal |= self.nominal
        if "velocity_limit" in self.nominal:
            # No slope leads to a speed limit that binds from one that does not.
            nominal["velocity_limit"] = self.scales.speed
            if starts[0]["velocity_limit"] > self.scales.speed:
                starts.append({**starts[0], "velocity_limit": self.scales.speed})
        nothing = dict(values)
        for key in keys_of(effects - {*centre.effects}):
            parameter = PARAMETERS[key]
            limit = parameter.lower > 0.0 == parameter.neutral
            nothing[key] = parameter.upper if limit else parameter.neutral
        return [*starts, nominal, nothing]

    def call(self, effects: Effects, starts: Sequence[Mapping[str, float]]) -> FitCall:
        """The call that fits a model."""
        return partial(
            JointProblem.fit,
            base=self.base,
            effects=tuple(name for name in EFFECTS if name in effects),
            starts=starts,
            scales=self.scales,
        )

    def fit(self, calls: Mapping[Effects, FitCall]) -> None:
        """Fit models, and note them; what was fitted before keeps its better minimum."""
        fits = self.run(list(calls.values()))
        for effects, fit in zip(calls, fits, strict=True):
            known = self.models.get(effects)
            if known is None or fit.rmse < known.rmse:
                self.models[effects] = fit


def next_of(models: Iterable[JointFit], done: Sequence[JointFit]) -> JointFit | None:
    """The first model that is not done."""
    for fit in models:
        if fit not in done:
            return fit
    return None


def within(values: Mapping[str, float], effects: Iterable[str]) -> dict[str, float]:
    """Values of the baseline and of some effects only."""
    kept = {"", *effects}
    return {key: value for key, value in values.items() if key.rpartition(".")[0] in kept}
