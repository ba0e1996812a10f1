"""Fits of the models that a search compares: with one more effect, with one less, from elsewhere."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vd.gap.coordinates import Scales, best_two, sizes, torque_power
from vd.gap.joint_fit import JointFit
from vd.gap.judge import EXPLAINED, JITTER
from vd.gap.telemetry import BEHIND_SENSOR
from vd.kernels.servo.effects import EFFECTS, equivalent

SHORT_LIST = 10
"""Candidates of a round that are fitted, after the linear screening of all."""
FINALISTS = 6
"""Candidates of a round that are fitted to the end."""
FIRST = 4
"""Candidates that are fitted before the rest of the short list."""
ALIKE = 0.5
"""Share of the best promise that a candidate must have to be fitted once another explains everything."""
BEHIND = 3.0
"""Finalists have at most this many times the error of the best after screening."""
HOPELESS = 1.5
"""The same factor half way: those beyond it are not fitted to the end."""
IDLE = 0.99
"""Share of the error before it that a further effect leaves at least half way if it does nothing: where more
than noise is left such a fit is not finished either."""
SCREEN_ITERATIONS = 6
HALF_ITERATIONS = 4
FULL_ITERATIONS = 12
ASTRAY = 2.0
"""Factor from the nominal model beyond which a fit starts from that as well."""
BETTER = 0.98
"""Share of the error from which a fit of the same model is a better one."""

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
        refits: Steps of each refit without a fold (:meth:`vd.gap.fit.JointProblem.fit`).
        vetoes: Effects that telemetry contradicts, with the reason.
        nominal: Nominal values of the baseline's parameters, by key.
        promised: Share of the squared error that each candidate of the last round could remove at best.
        added: The last fits with one more effect, by the effects of the model to which it was added: that
            model first.
        behind_jitter: Whether samples are weighted by what random delays do to them.
    """

    floor: float
    run: Run
    joint: int
    others: Sequence[int]
    candidates: Sequence[str]
    scales: Scales
    refits: int = 0
    vetoes: Mapping[str, str] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    promised: dict[str, float] = field(default_factory=dict)
    added: dict[frozenset[str], tuple[JointFit, ...]] = field(default_factory=dict)
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
            known: A fit with one that is left out; where it explains everything, what stays far from it is
                not fitted to the end.
        """
        out = {*present.effects, *(set(self.vetoes) - set(vetoed)), *skip, JITTER}
        white = 0.0 if self.behind_jitter else EXPLAINED * self.floor
        least = known.rmse if known is not None and known.rmse < white else np.inf
        names = [name for name in self.candidates if name not in out]
        starts = {name: self.sized(present, name) for name in names}
        flat = [(name, start) for name in names for start in starts[name]]
        if not flat:
            return {}
        promise = self.run(
            [("promise", {"fit": present, "starts": [s for _, s in flat], "scales": self.scales})]
        )[0]
        self.promised = {
            name: max(float(promise[i]) for i, (own, _) in enumerate(flat) if own == name) for name in names
        }
        order: dict[str, list[int]] = {name: [] for name in names}
        for i in np.argsort(-promise):
            order[flat[i][0]].append(int(i))
        ranked = sorted(names, key=lambda name: -promise[order[name][0]])[:SHORT_LIST]

        def screen(chosen: Sequence[str]) -> list[JointFit]:
            calls = [
                self.call(
                    present,
                    name,
                    self.starts(present, best_two([flat[i][1] for i in order[name]])),
                    SCREEN_ITERATIONS,
                )
                for name in chosen
            ]
            return self.run(calls)

        screened = screen(ranked[:FIRST])
        rest = ranked[FIRST:]
        if min(least, *(fit.rmse for fit in screened)) < white:
            # What explains everything has only those to fear that promised nearly as much.
            enough = ALIKE * promise[order[ranked[0]][0]]
            rest = [name for name in rest if promise[order[name][0]] > enough]
        screened += screen(rest)
        screened.sort(key=lambda fit: fit.rmse)
        finalists = [fit for fit in screened[:FINALISTS] if fit.rmse < BEHIND * screened[0].rmse]

        def go_on(chosen: Sequence[JointFit], iterations: int) -> list[JointFit]:
            return self.run([self.call(present, f.effects[-1], [f.values], iterations) for f in chosen])

        if len(finalists) > 1 or np.isfinite(least):
            finalists = sorted(go_on(finalists, HALF_ITERATIONS), key=lambda fit: fit.rmse)
        # The fit of what does nothing is not finished, but that of the best is.
        most = max(finalists[0].rmse, white, IDLE * present.rmse)
        most = min(most, HOPELESS * min(finalists[0].rmse, least))
        near = [fit for fit in finalists if fit.rmse <= most]
        last = [*go_on(near, FULL_ITERATIONS), *finalists[len(near) :]]
        fits = {fit.effects[-1]: fit for fit in (*last, *screened[len(finalists) :])}
        return fits

    def sized(self, present: JointFit, name: str) -> list[dict[str, float]]:
        """Starting values of an effect added to a model: none that differ only in what that does not fit."""
        starts = sizes(name, self.others, self.scales)
        return [start for start in starts if all("." in key or key in present.values for key in start)]

    def tried_beside(
        self, without: JointFit, present: JointFit, skip: Sequence[str]
    ) -> dict[str, JointFit] | None:
        """The fits with other effects in the place of a model's last, if it was chosen from among them."""
        before, *fits = self.added.get(frozenset(without.effects), (None,))
        if before is None or not any(fit is present for fit in fits) or without.rmse < BETTER * before.rmse:
            return None
        if {*BEHIND_SENSOR} & {*self.vetoes}:
            return None  # these are tried here, and were not there
        return {fit.effects[-1]: fit for fit in fits if fit.effects[-1] not in skip}

    def plain(self, baseline: JointFit) -> Call:
        """The call that fits the plain model anew."""
        call = {"base": baseline.rows, "effects": (), "starts": [{}, self.nominal], "scales": self.scales}
        return "fit", {**call, "iterations": FULL_ITERATIONS, "refits": self.refits}

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
                "refits": self.refits if iterations == FULL_ITERATIONS else 0,
            },
        )

    def refit(self, present: JointFit, effects: Sequence[str]) -> JointFit:
        """The fit with only some of a model's effects."""
        rows = present.rows.copy()
        for name in set(present.effects) - set(effects):
            for parameter in EFFECTS[name].parameters:
                rows[self.joint, parameter.column] = parameter.neutral
        values = {k: v for k, v in present.values.items() if k.rpartition(".")[0] in ("", *effects)}
        call = {"base": rows, "effects": tuple(effects), "starts": [values], "scales": self.scales}
        return self.run([("fit", {**call, "iterations": FULL_ITERATIONS, "refits": self.refits})])[0]


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
