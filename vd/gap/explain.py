"""Explain one joint: search, weigh samples that say little, try random delays, conclude."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.chain import candidates, others_in
from vd.gap.coordinates import BASELINE_PARAMETERS, Scales
from vd.gap.evidence import JITTER, NO_GAP, cancelled
from vd.gap.explanation import Accepted, Explanation
from vd.gap.jitter_search import FIXED, try_jitter
from vd.gap.joint_fit import JointFit
from vd.gap.recording_checks import MIN_KINDS
from vd.gap.search import Search, alike, stood_for
from vd.gap.statistics import resamples
from vd.gap.telemetry import BEHIND_SENSOR, vetoes
from vd.gap.worker_pool import JointSpec, WorkerPool
from vd.kernels.servo.effects import EFFECTS


def explain(search: Search, baseline: JointFit) -> Explanation:
    """Select effects, starting from the fitted plain model.

    Args:
        search: Of the joint.
        baseline: The plain model.
    """
    loose, search.whole = search.undetermined(baseline), baseline.held_out_rmse
    if nothing := _nothing_to_explain(search, baseline, loose):
        return nothing
    present, rows = search.search(baseline)
    trials = [*search.contradicted(baseline), *rows]
    if present.effects:
        earned, why = search.better(baseline, present)
        if not earned:
            search.report(f"taken back: {why}")
            present = baseline
    known: tuple[Accepted, ...] = ()
    if not search.no_gap(present) and not search.white(present):
        found, known, rows = try_jitter(search, explain, baseline, present)
        present = found if found is present or JITTER in found.effects else search.revise(found)
        rounds = max((row.round for row in trials), default=0)
        trials += [replace(row, round=row.round + rounds) for row in rows]
    evidence = search.settle(trials, present)
    random = JITTER in present.effects
    rivals = {} if random else {name: search.rivals(present, name) for name in present.effects}
    refined = None if random or not present.effects else search.refined(present)
    result = search.conclude(baseline, present, rivals, evidence, loose, refined, known)
    return result if random else _with_notes(search, result)


def _nothing_to_explain(search: Search, baseline: JointFit, loose: str) -> Explanation | None:
    """The explanation of a joint whose plain model leaves nothing to search for, or cannot be judged."""
    if len(baseline.sse) < MIN_KINDS:
        text = (
            f"{len(baseline.sse)} trajectories leave none to hold out; record {MIN_KINDS} at least"
        )
        return Explanation(baseline, baseline, "under_excited", text)
    if not search.no_gap(baseline):
        return None
    text = "the plain model is within the noise floor"
    return Explanation(baseline, baseline, "under_excited" if loose else "no_gap", loose or text)


def _with_notes(search: Search, explanation: Explanation) -> Explanation:
    """The explanation with what its names do not say.

    What a member of a set means that telemetry contradicts by its name; and no names where two
    effects are but one that is not in the table.
    """
    alike = cancelled(explanation.final, search.joint, search.rest)
    if alike and explanation.verdict in ("effects", "ambiguous"):
        return replace(explanation, verdict="unknown", reason=alike)
    tied = {name for one in explanation.accepted for name in one.tied}
    notes = [
        f"{name} {BEHIND_SENSOR[name]}"
        for name in sorted(tied & set(BEHIND_SENSOR) & set(search.vetoes))
    ]
    return replace(explanation, reason="; ".join([explanation.reason, *notes]))


Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint under analysis: its data and its baseline."""

    name: str
    spec: JointSpec
    scales: Scales
    fit: JointFit


Explained = list[tuple[Joint, Explanation]]
"""Joints, and what they lack."""


@dataclass(eq=False)
class Explainer:
    """Explains joints, one at a time.

    Attributes:
        pool: Who fits.
        joints: All joints of the recording, with their plain models.
        effects: Effects to consider.
        seed: Of everything random.
        progress: Called with lines of progress.
    """

    pool: WorkerPool
    joints: Sequence[Joint]
    effects: Sequence[str]
    seed: int
    progress: Progress

    def explain(self, joint: Joint, explained: Explained) -> Explanation:
        """What a joint lacks.

        Args:
            joint: The joint.
            explained: Joints of its finger that are explained already.
        """
        result = explain(self.search(joint, explained), self.plain(joint, explained))
        self.progress(f"explain: {joint.name}: {result.verdict}: {result.reason}")
        return result

    def search(self, joint: Joint, explained: Explained) -> Search:
        """The search for what a joint lacks, with what the others of its finger say of it."""
        chain, spec = self.pool.problems.chains[joint.spec.chain], joint.spec
        recording = self.pool.problems.recording
        column = int(chain.columns[spec.joint])
        own = [recording.trajectories[i] for i in spec.trajectories]
        names = candidates(chain, self.effects)
        if _no_jitter(explained):
            names = [name for name in names if name != JITTER]
        told = vetoes(recording, chain, spec)
        pairs = alike(self.effects, recording.model).items()
        same = {name: others for name, others in pairs if not {name, *others} & set(told)}
        rng = np.random.default_rng([self.seed, spec.chain, spec.joint])
        return Search(
            run=lambda calls: self.pool.run(spec, calls),
            joint=spec.joint,
            others=others_in(chain, spec.joint),
            candidates=names,
            equivalent=same,
            nominal={
                key: float(chain.start_row[spec.joint, BASELINE_PARAMETERS[key].column])
                for key in spec.baseline
            },
            noise=spec.floor,
            scales=joint.scales,
            weights=resamples(len(spec.trajectories), rng),
            vetoes={**stood_for(same), **told},
            report=lambda line: self.progress(f"explain: {joint.name}: {line}"),
            rest=float(np.median([t.position[0, column] for t in own])),
            moves=np.array([bool(np.ptp(t.command[:, column])) for t in own]),
        )

    def plain(self, joint: Joint, explained: Explained) -> JointFit:
        """The plain model, fitted again beside joints of which more is known than theirs."""
        rows = beside(joint, explained)
        if np.array_equal(rows, joint.fit.rows):
            return joint.fit
        call = {"base": rows, "effects": (), "starts": [{}], "scales": joint.scales}
        return self.pool.run(joint.spec, [("fit", call)])[0]


def _no_jitter(explained: Explained) -> bool:
    """Whether random delays are none on a joint, by what is known of the others of its finger.

    They are none where they were tried on one and refused, not where too little was left there to
    try them; and where another is explained without them or a fixed one, their mean, as commands go
    out together.
    """
    found = [one for _, one in explained]
    random = any(JITTER in one.final.effects for one in found)
    tried = any(row.name == JITTER for one in found for row in one.trials)
    if tried and not random and any(one.verdict == "unknown" for one in found):
        return True
    return any(
        one.verdict == "effects"
        and not {JITTER, FIXED} & {*one.final.effects}
        and one.final.rmse < NO_GAP * joint.spec.floor
        for joint, one in explained
    )


def beside(joint: Joint, explained: Explained) -> np.ndarray:
    """Rows of a joint's chain with its plain model, the others as they were found to be, jitter aside."""
    rows = joint.fit.rows.copy()
    for other, found in explained:
        if other is not joint and other.spec.chain == joint.spec.chain and found.final.effects:
            rows[other.spec.joint] = found.final.rows[other.spec.joint]
            for parameter in EFFECTS[JITTER].parameters:
                rows[other.spec.joint, parameter.column] = parameter.neutral
    return rows
