"""Explain the joints of a recording: fit models with more and fewer effects, and let the rules decide.

Forward selection with full refits, checked backward; then random delays, as the cause of what that
leaves; then what is named (:mod:`vd.gap.rules`). No single prediction shows random delays
(:mod:`vd.gap.jitter`). So the search is made once more with samples weighted by what delays do
(:class:`vd.gap.models.SampleWeighting`); they and what is found beside them are looked for in turn.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from vd.gap import rules
from vd.gap.chain import others_in
from vd.gap.coordinates import BASELINE_PARAMETERS, Scales, sizes, torque_power
from vd.gap.fit import JointProblem, JointSpec, Problems
from vd.gap.jitter import DROP, SIGMA, bound_jitter, fit_jitter, look
from vd.gap.models import Accepted, Explanation, JointFit, SampleWeighting, TriedEffect
from vd.gap.rules import JITTER, Evidence
from vd.gap.statistics import resamples
from vd.gap.telemetry import telemetry_of
from vd.gap.worker_pool import WorkerPool, parallel
from vd.kernels.servo.effects import EFFECTS

MAX_EFFECTS = 3
"""Effects of a joint, but for random delays. Not tuned: hidden were two at most."""
SHORT_LIST = 10
"""Candidates of a round that are fitted, after the linear screening of all: half of the table. Not
tuned.
"""
PASSES = 2
"""Searches for what there is beside random delays, each with these as they are beside what the last
found. With one, the interval of a delay beside them is a quarter as wide, and misses; three were
not tried.
"""

Progress = Callable[[str], None]
FitCall = Callable[[JointProblem], Any]
"""What is asked of a joint's problem, in another process too."""
RunCalls = Callable[[Sequence[FitCall]], list[Any]]
"""Asks a joint's problem, in parallel."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """Forward and backward selection for one joint.

    Attributes:
        run: Asks the joint's problem, in parallel.
        evidence: What fits are judged by.
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

    run: RunCalls
    evidence: Evidence
    others: Sequence[int]
    candidates: Sequence[str]
    scales: Scales
    vetoes: Mapping[str, str] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    report: Progress = lambda line: None
    rest: float = 0.0
    known: dict[frozenset[str], Mapping[str, float]] = field(default_factory=dict)

    def fit(
        self, base: np.ndarray, effects: Sequence[str], starts: Sequence[Mapping[str, float]]
    ) -> FitCall:
        """The call that fits a model from the rows of a chain."""
        known = self.known.get(frozenset(effects))
        if known is not None:
            starts = [*starts, known]
        return partial(
            JointProblem.fit, base=base, effects=tuple(effects), starts=starts, scales=self.scales
        )

    def refit(self, present: JointFit, effects: Sequence[str]) -> JointFit:
        """The fit with only some of a model's effects."""
        rows = present.rows.copy()
        for name in set(present.effects) - set(effects):
            for parameter in EFFECTS[name].parameters:
                rows[self.evidence.joint, parameter.column] = parameter.neutral
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
        flat: list[tuple[str, dict[str, float]]] = []
        for name in self.candidates:
            if name not in out:
                # None that differ only in what the joint's baseline does not fit.
                starts = sizes(name, self.others, self.scales)
                flat.extend((name, start) for start in starts if fitted(start, present))
        if not flat:
            return {}, {}
        starts = [start for _, start in flat]
        call = partial(JointProblem.promise, fit=present, starts=starts, scales=self.scales)
        promise = self.run([call])[0]
        best: dict[str, list[dict[str, float]]] = {}
        promised: dict[str, float] = {}
        for i in np.argsort(-promise):
            name, start = flat[i]
            best.setdefault(name, []).append(start)
            promised.setdefault(name, float(promise[i]))
        tried = list(best)[:SHORT_LIST]
        calls = [
            self.fit(present.rows, (*present.effects, name), self.starts(present, best[name]))
            for name in tried
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
        starts = [{**present.values, **size} for size in added[:2]]
        nominal = self.nominal.get("kp", 0.0)
        # No slope leads to a speed limit that binds from one that does not.
        limit = {"velocity_limit": self.scales.speed} if "velocity_limit" in self.nominal else {}
        torque = nominal / present.values["kp"] if nominal else 1.0
        scaled = {key: value * torque ** torque_power(key) for key, value in starts[0].items()}
        return [*starts, {**scaled, **self.nominal, **limit}]

    def forward(self, baseline: JointFit) -> tuple[JointFit, list[TriedEffect]]:
        """Forward steps from the plain model, each checked backward; what they add is tentative.

        Returns:
            The model, and the evidence.
        """
        present, trials, visited = baseline, [], {frozenset[str]()}
        for number in itertools.count(1):
            if len(present.effects) >= MAX_EFFECTS or rules.no_gap(self.evidence, present):
                break
            fits, promised = self.fit_candidates(present)
            if not fits:
                break
            best = rules.winner(self.evidence, list(fits.values()))
            refusal = rules.refused_step(self.evidence, present, best)
            trials += rules.judged(self.evidence, number, present, fits, best, refusal)
            trials += screened_out(number, present, fits, promised)
            if refusal:
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
            if rules.refused_step(self.evidence, without, present):
                self.report(f"- {name}: not needed beside the others")
                return without
            fits = self.rivals(present, name, without)
            if best := rules.exchanged(self.evidence, present, fits, self.vetoes):
                self.report(f"~ {name} exchanged for {best.effects[-1]}")
                return best
        return None

    def rivals(self, present: JointFit, name: str, without: JointFit) -> list[JointFit]:
        """The model itself, and fits with other effects in the place of one of its own."""
        skip = (name, *rules.containing(without.effects))
        fits, _ = self.fit_candidates(without, skip, tuple(rules.BEHIND_SENSOR))
        return [present, *fits.values()]


def fitted(start: Mapping[str, float], present: JointFit) -> bool:
    """Whether all of the baseline that a start of an effect changes is fitted in a model."""
    return all("." in key or key in present.values for key in start)


def screened_out(
    number: int, before: JointFit, fits: Mapping[str, JointFit], promised: Mapping[str, float]
) -> list[TriedEffect]:
    """The rows of candidates that promised too little to be fitted in a round."""
    rows = []
    for name, promise in promised.items():
        if name not in fits:
            share = 100.0 * max(promise, 0.0)
            reason = f"screened out: promised {share:.0f} % of the squared error"
            rows.append(untried(number, name, before, reason))
    return rows


def untried(number: int, name: str, before: JointFit, reason: str) -> TriedEffect:
    """The row of a candidate that was not fitted."""
    unknown = float("nan")
    fit = replace(before, held_out=before.held_out * unknown)
    return TriedEffect(number, name, fit, unknown, (unknown, unknown), reason=reason)


def explain(search: Search, baseline: JointFit) -> Explanation:
    """Select effects, starting from the fitted plain model.

    Args:
        search: Of the joint.
        baseline: The plain model.
    """
    loose = rules.undetermined(search.evidence, baseline)
    evidence = replace(search.evidence, whole=baseline.held_out_rmse)
    search = replace(search, evidence=evidence)
    if nothing := rules.nothing_to_explain(evidence, baseline, loose):
        return nothing
    present, rows = search.forward(baseline)
    vetoed = [(name, why) for name, why in search.vetoes.items() if name in search.candidates]
    trials = [*(untried(1, name, baseline, why) for name, why in vetoed), *rows]
    if present.effects and (refusal := rules.refused(evidence, baseline, present)):
        search.report(f"taken back: {refusal}")
        present = baseline
    known: tuple[Accepted, ...] = ()
    if rules.tries_jitter(evidence, present):
        found, known, rows = try_jitter(search, baseline, present)
        present = found if found is present or JITTER in found.effects else search.revise(found)
        rounds = max((row.round for row in trials), default=0)
        trials += [replace(row, round=row.round + rounds) for row in rows]
    trials = rules.settled(trials, present)
    conclude = partial(rules.conclude, evidence, baseline, present, trials=trials, loose=loose)
    if JITTER in present.effects:
        return conclude(rivals={}, refined=present, known=known)
    rivals = {
        name: search.rivals(present, name, search.without(present, name))
        for name in present.effects
    }
    refined = present
    if present.effects:
        refined = search.run([partial(JointProblem.refine, fit=present, scales=search.scales)])[0]
    explanation = conclude(rivals=rivals, refined=refined, known=known)
    return rules.with_notes(explanation, evidence.joint, search.rest, search.vetoes)


def try_jitter(
    search: Search, baseline: JointFit, present: JointFit
) -> tuple[JointFit, tuple[Accepted, ...], list[TriedEffect]]:
    """What nothing else explains can be random delays, and what is to be found beside them.

    Args:
        search: The search that has come to its end.
        baseline: The plain model.
        present: What the search has found.

    Returns:
        The better model; what it has besides random delays, if it has these; and the evidence.
    """
    evidence = search.evidence
    if evidence.behind_jitter or JITTER not in search.candidates or JITTER in search.vetoes:
        return present, (), []
    random, beside, rows, left = with_jitter(search, baseline, present)
    others = [name for name in random.effects if name != JITTER]
    if others:
        rest = search.refit(random, others)
        if rules.white(evidence, rest) and rules.unlikelier(evidence, rest, random):
            # No jitter is needed: it has only smoothed the way to where the search before did not
            # come.
            search.report(f"+ {' and '.join(others)}: {1e3 * rest.held_out_rmse:.2f} mrad held out")
            return rest, (), []
    refusal = rules.refused_jitter(evidence, present, random, left)
    decision = "rejected" if refusal else "named"
    gain = rules.gain(evidence, present, random)
    row = TriedEffect(1, JITTER, random, *gain, decision, refusal or rules.SPREAD)
    if refusal:
        return present, (), [row]
    random = search.run([partial(bound_jitter, fit=random, scales=search.scales)])[0]
    names, before, after = " and ".join(random.effects), present.held_out_rmse, random.held_out_rmse
    text = f"as likely as {1e3 * after:.2f} mrad of constant width, before {1e3 * before:.2f}"
    search.report(f"+ {names}: {text}")
    return random, beside, [row, *rows]


def with_jitter(
    search: Search, baseline: JointFit, present: JointFit
) -> tuple[JointFit, tuple[Accepted, ...], list[TriedEffect], float]:
    """The model with random delays, what is named beside them, and the evidence for that.

    The arguments are those of :func:`try_jitter`. The last result is the error of the rest of the
    model, seen through what the delays do [rad]: the noise floor if it is right.
    """
    jitter, weighting = search.run([partial(look, fit=baseline, scales=search.scales)])[0]
    for _ in range(PASSES):
        inner = replace(
            search,
            run=partial(run_weighted, search.run, weighting),
            known=dict(search.known),
            candidates=[name for name in search.candidates if name != JITTER],
            evidence=replace(search.evidence, behind_jitter=True),
            report=lambda line: search.report(f"beside {JITTER}: {line}"),
        )
        plain = inner.run([inner.fit(baseline.rows, (), [{}, inner.nominal])])[0]
        found = explain(inner, plain)
        clear = found.verdict in ("effects", "ambiguous")
        rest, beside = (found.final, found.accepted) if clear else (plain, ())
        call = partial(fit_jitter, fit=rest, scales=search.scales, start=jitter)
        random, weighting = search.run([call])[0]
        jitter = random.values[SIGMA], random.values[DROP]
        if rules.unlikelier(search.evidence, present, random):
            break
    rows = []
    for row in found.trials:
        fit = replace(row.fit, effects=(JITTER, *row.fit.effects))
        rows.append(replace(row, round=row.round + 1, fit=fit))
    return random, beside, rows, rest.rmse


def run_weighted(run: RunCalls, weighting: SampleWeighting, calls: Sequence[FitCall]) -> list[Any]:
    """The results of calls that weight the samples."""
    return run([partial(weighted, call, weighting) for call in calls])


def weighted(call: FitCall, weighting: SampleWeighting, problem: JointProblem) -> Any:
    """What a call has of a problem whose samples are weighted."""
    return call(problem.weighted(weighting))


@dataclass(frozen=True, eq=False)
class ExcitedJoint:
    """A joint under analysis: its data and its baseline."""

    name: str
    spec: JointSpec
    scales: Scales
    fit: JointFit


Explained = list[tuple[ExcitedJoint, Explanation]]
"""Joints, and what they lack."""


def explain_joints(
    pool: WorkerPool,
    problems: Problems,
    joints: Sequence[ExcitedJoint],
    effects: Sequence[str],
    seed: int,
    progress: Progress,
) -> list[Explanation]:
    """What every joint lacks.

    Of each finger from its tip on, as a joint's motion shakes those before it.

    Args:
        pool: Who fits.
        problems: Of the recording.
        joints: All its joints, with their plain models.
        effects: Effects to consider.
        seed: Of everything random.
        progress: Called with lines of progress.
    """

    def finger(chain: int) -> Explained:
        explained: Explained = []
        own = [joint for joint in joints if joint.spec.chain == chain]
        for joint in sorted(own, key=lambda each: -each.spec.joint):
            search = search_of(pool, problems, joint, explained, effects, seed, progress)
            result = explain(search, plain_model(pool, joint, explained))
            progress(f"explain: {joint.name}: {result.verdict}: {result.reason}")
            explained.append((joint, result))
        return explained

    by_name: dict[str, Explanation] = {}
    for explained in parallel(finger, sorted({joint.spec.chain for joint in joints})):
        by_name |= {joint.name: explanation for joint, explanation in explained}
    alone = [by_name[joint.name] for joint in joints]
    return rules.doubted(alone, [joint.spec.chain for joint in joints])


def search_of(
    pool: WorkerPool,
    problems: Problems,
    joint: ExcitedJoint,
    explained: Explained,
    effects: Sequence[str],
    seed: int,
    progress: Progress,
) -> Search:
    """The search for what a joint lacks, with what the others of its finger say of it.

    The arguments are those of :func:`explain_joints`; ``explained`` are joints of its finger.
    """
    spec, recording = joint.spec, problems.recording
    chain = problems.chains[spec.chain]
    column = int(chain.columns[spec.joint])
    own = [recording.trajectories[i] for i in spec.trajectories]
    names = rules.candidates(chain, effects)
    if rules.without_jitter([(other.spec.floor, found) for other, found in explained]):
        names = [name for name in names if name != JITTER]
    told = rules.contradicted(telemetry_of(recording, chain, spec))
    same = {
        name: others
        for name, others in rules.alike(effects, recording.model).items()
        if not {name, *others} & set(told)
    }
    rng = np.random.default_rng([seed, spec.chain, spec.joint])
    return Search(
        run=partial(pool.run, spec),
        evidence=Evidence(
            noise=spec.floor,
            weights=resamples(len(spec.trajectories), rng),
            moves=np.array([bool(np.ptp(t.command[:, column])) for t in own]),
            equivalent=same,
            joint=spec.joint,
        ),
        others=others_in(chain, spec.joint),
        candidates=names,
        nominal={
            key: float(chain.start_row[spec.joint, BASELINE_PARAMETERS[key].column])
            for key in spec.baseline
        },
        scales=joint.scales,
        vetoes={**rules.stood_for(same), **told},
        report=lambda line: progress(f"explain: {joint.name}: {line}"),
        rest=float(np.median([t.position[0, column] for t in own])),
    )


def plain_model(pool: WorkerPool, joint: ExcitedJoint, explained: Explained) -> JointFit:
    """The plain model, fitted again beside joints of which more is known than theirs."""
    rows = beside(joint, explained)
    if np.array_equal(rows, joint.fit.rows):
        return joint.fit
    call = partial(JointProblem.fit, base=rows, effects=(), starts=[{}], scales=joint.scales)
    return pool.run(joint.spec, [call])[0]


def beside(joint: ExcitedJoint, explained: Explained) -> np.ndarray:
    """Rows of a joint's chain with its plain model, the others as they were found to be, jitter aside."""
    rows = joint.fit.rows.copy()
    for other, found in explained:
        if other is not joint and other.spec.chain == joint.spec.chain and found.final.effects:
            rows[other.spec.joint] = found.final.rows[other.spec.joint]
            for parameter in EFFECTS[JITTER].parameters:
                rows[other.spec.joint, parameter.column] = parameter.neutral
    return rows
