"""Every rule by which an effect of a joint is named, in the order in which they act.

Which effects are tried, whether there is anything to explain, what a step of the search earns,
whether delays are random, what is named in the end, and what joints tell each other. Rules take the
data on which they act, and simulate nothing. Everything is judged on trajectories that the fit has
not seen, and resampled by whole trajectories with the choice inside the resampling.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.chain import Chain
from vd.gap.models import (
    Accepted,
    Explanation,
    JointFit,
    Telemetry,
    TriedEffect,
    estimates,
    intervals,
)
from vd.gap.result import Verdict
from vd.gap.statistics import OWN_ERROR, REPEATABLE, interval, rmse
from vd.kernels.servo.effects import BESIDE, EFFECTS, TOGETHER, equivalent
from vd.logs.recording_checks import MIN_KINDS

JITTER = "command_jitter"
"""The effect that no single prediction shows (:mod:`vd.gap.jitter`): tried last, on what is
left.
"""
FIXED = "command_delay"
"""What is the mean of random delays, too."""
ONE_SIDED = "asymmetric_friction"
"""The friction that can have a direction without any."""
DRY = ("coulomb_friction", "stribeck_friction")
"""Those that fill it up."""
NESTED = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "torque_speed_limit": ("torque_limit",),
    "elastic_transmission": ("payload_inertia",),
}
"""Effects that contain a simpler one; in a tie the simpler one is meant."""
CANCELLING = ("gravity_load", "encoder_bias")
"""Effects that hold a joint off its command at rest. Where they cancel there, they are no two
causes but one that pulls with the travel from there, a spring, which the table has not."""
DETERMINED = ("kp", "kd", "inertia")
"""Baseline parameters that every useful excitation determines."""
UPSTREAM = (
    "command_delay",
    "read_delay",
    "command_filter",
    "command_jitter",
    "acceleration_limit",
    "dead_zone",
    "integral_action",
    "backlash",
)
"""Effects between command and controller output, each of which the duty cycle shows. Backlash is
that of the reference, as the servo model has it, not play behind the motor."""
BEHIND_SENSOR = {
    "supply_sag": "only as a resistance behind the voltage sensor, which loses torque like a sagging supply"
}
"""Effects whose cause telemetry contradicts, but not a loss of the same form where it has no
sensor.
"""

CLOSE = 0.1
"""Two values within this share of each other are one: of an effect on two joints, as what a model
lacks moves them by more than their intervals tell; of a load and an offset that cancel, which by
luck few in a hundred machines do; of a supply idle and under load. Not tuned."""
LINEAR = 0.995
"""Share of the duty cycle's variance that the plain error must explain for it to be linear. Not
tuned.
"""
CLEARER = 4.0
"""How many times more of the duty cycle the wrong delay must leave than the right one: a read delay
leaves 0.5 % on either side. Not tuned."""
# Half and twice: what they turn of the decisions in the XL330 and eight recordings of the battery.
NO_GAP = 1.15
"""A model within this factor of the noise floor leaves white residuals, and nothing to explain.
With half of what it leaves above 1 none of 40 is decided otherwise, with twice two are."""
MIN_GAIN = 0.05
"""Share of the held-out RMSE that an effect must remove. Half passes two more of 46, twice none
less.
"""
JITTER_GAIN_FLOORS = 0.3
"""Gap that an effect must close beside random delays, as sqrt(before^2 - after^2), in noise floors:
one of six floors leaves half of one there. Without delays it is what :data:`NO_GAP` takes for none.
Half and twice turn none of 7."""
MEMORY = 8
"""Samples in a row that say the same beside random delays: what a late command does lasts that
long. Half and twice turn none of 38."""
PENALTY = 0.01
"""Relative RMSE that a further parameter must earn to be preferred. Half and twice turn none of
166.
"""
EXCESS_FLOORS = 0.07
"""What an alternative to a winner that leaves white residuals must leave more, in noise floors, to
be worse: thousands of samples carry that difference. Half and twice turn none of 164."""
CONTAINED_FLOORS = 0.15
"""The same for one that the winner contains: with more parameters it imitates what the integrator
misses. Of two, half and twice turn none."""
RECOVERED = 0.5
"""Share of the squared gap that the named effects must recover. Half turns none of 12, half more
one.
"""
NAMED = 0.9
"""Share of the resamples that must choose an effect for it to be named. Not tuned."""
SPREAD = "its spread is what is measured"
"""Why random delays are named."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the fits of one joint are judged by.

    Attributes:
        noise: Noise floor of the recording [rad].
        weights: Bootstrap weights of the trajectories [R, S].
        whole: Held-out RMSE of the plain model [rad].
        moves: Whether the joint's command changes, of each trajectory [S]; None: in all.
        behind_jitter: Whether samples are weighted by what random delays do
            (:class:`vd.gap.models.SampleWeighting`).
        equivalent: Effects that one stands for, since the recording cannot tell them apart.
        joint: Index of the joint in its chain.
    """

    noise: float
    weights: np.ndarray
    whole: float = 0.0
    moves: np.ndarray | None = None
    behind_jitter: bool = False
    equivalent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    joint: int = 0

    @property
    def floor(self) -> float:
        """The least error that a right model can have [rad].

        Noise, and what it misses of a large effect.
        """
        return float(np.hypot(self.noise, OWN_ERROR * self.whole))


# 1. Which effects are tried on a joint.


def candidates(chain: Chain, effects: Sequence[str]) -> list[str]:
    """Effects that a joint of a chain can have besides its baseline."""
    own = {"tau_g_nm": "gravity_load", "inertia": "payload_inertia"}
    excluded = {effect for name, effect in own.items() if name in chain.baseline_free}
    if len(chain.joints) == 1:
        excluded.add("joint_coupling")
    return [name for name in EFFECTS if name in effects and name not in excluded]


def alike(names: Sequence[str], model: str) -> dict[str, tuple[str, ...]]:
    """The candidates that stand for others of the candidates, and for which."""
    result = {}
    for name, others in equivalent(model).items():
        inside = tuple(other for other in others if other in names)
        if name in names and inside:
            result[name] = inside
    return result


def stood_for(same: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Candidates that another stands for, with the reason why they are not tried."""
    return {
        other: f"leaves the same positions as {name}, which stands for both"
        for name, others in same.items()
        for other in others
    }


def contradicted(telemetry: Telemetry) -> dict[str, str]:
    """Effects that recorded voltage and duty cycle contradict, with the reason.

    The voltage that a sagging supply needs is there to be seen. And the duty cycle of a position
    servo is its controller's output: where it follows the plain error at the recorded gain, nothing
    upstream of it (a delay, a filter, a dead zone, integral action) is at work.
    """
    result = {}
    if telemetry.fall is not None and telemetry.fall[0] < CLOSE * telemetry.fall[1]:
        fall, idle = telemetry.fall
        result["supply_sag"] = (
            f"the recorded voltage falls by {fall:.2f} V of {idle:.1f} V at full pull, "
            "too little for sag"
        )
    late = late_side(telemetry)
    if late:
        reason = f"the recorded duty cycle follows the error with a {late.replace('_', ' ')} alone"
    elif telemetry.follows >= LINEAR:
        told = f"{100.0 * telemetry.follows:.1f} % of it"
        reason = f"the recorded duty cycle follows the plain error ({told}): it acts downstream"
    else:
        return result
    return result | {name: reason for name in UPSTREAM if name != late}


def late_side(telemetry: Telemetry) -> str:
    """Which of command and reading is late, if the recorded duty cycle says so.

    Positions alone cannot tell (:data:`vd.kernels.servo.effects.EQUIVALENT`). The duty cycle
    follows the late command less the position there is, or the command there is less the position
    that is reported later.

    Returns:
        ``command_delay``, ``read_delay``, or nothing where neither fits, both do, or no duty is
        recorded.
    """
    (side, (lag, left)), (_, (_, other)) = sorted(
        telemetry.late.items(), key=lambda item: item[1][1]
    )
    # Registers read one after the other are less than a sample apart: that is nobody's delay.
    clear = left < 1.0 - LINEAR and CLEARER * left < other
    return side if lag >= telemetry.sample_s and clear else ""


def without_jitter(explained: Sequence[tuple[float, Explanation]]) -> bool:
    """Whether random delays are none on a joint, by what is known of the others of its finger.

    They are none where they were tried on one and refused, not where too little was left there to
    try them; and where another is explained without them or a fixed one, their mean, as commands go
    out together.

    Args:
        explained: Noise floor [rad] and explanation of each joint that is explained already.
    """
    known = [explanation for _, explanation in explained]
    random = any(JITTER in one.final.effects for one in known)
    tried = any(row.name == JITTER for one in known for row in one.trials)
    if tried and not random and any(one.verdict == "unknown" for one in known):
        return True
    return any(
        one.verdict == "effects"
        and not {JITTER, FIXED} & {*one.final.effects}
        and one.final.rmse < NO_GAP * floor
        for floor, one in explained
    )


# 2. Whether there is anything to explain.


def undetermined(evidence: Evidence, fit: JointFit) -> str:
    """Which parameter of the baseline the motions leave open, in words; empty if none."""
    for key, (low, high) in intervals(fit, evidence.floor).items():
        if key in DETERMINED and high > np.e**2 * low:  # as of a limit that is not shown
            return (
                f"{key} can lie anywhere between {low:.2g} and {high:.2g}: "
                "the motions do not show it"
            )
    return ""


def nothing_to_explain(evidence: Evidence, baseline: JointFit, loose: str) -> Explanation | None:
    """The explanation of a joint whose plain model leaves nothing to search for, or cannot be judged.

    Args:
        evidence: What fits are judged by.
        baseline: The plain model.
        loose: What of it the motions leave open.
    """
    if len(baseline.sse) < MIN_KINDS:
        text = (
            f"{len(baseline.sse)} trajectories leave none to hold out; record {MIN_KINDS} at least"
        )
        return Explanation(baseline, baseline, "under_excited", text)
    if not no_gap(evidence, baseline):
        return None
    text = "the plain model is within the noise floor"
    return Explanation(baseline, baseline, "under_excited" if loose else "no_gap", loose or text)


def no_gap(evidence: Evidence, fit: JointFit) -> bool:
    """Whether a fit predicts as well as noise lets it.

    Beside jitter that is not known as exactly.
    """
    return not evidence.behind_jitter and fit.held_out_rmse < NO_GAP * evidence.floor


# 3. What a step of the search earns.


def white(evidence: Evidence, fit: JointFit) -> bool:
    """Whether samples tell how good a fit is.

    It leaves no more than noise, or jitter, on all of them.
    """
    return evidence.behind_jitter or fit.rmse < NO_GAP * evidence.floor


def winner(evidence: Evidence, fits: Sequence[JointFit]) -> JointFit:
    """The candidate with the best held-out score.

    The simpler one that it contains if that is as good.

    One with a parameter at its bound wins only if all have.
    """
    inside = [fit for fit in fits if not at_bound(fit)] or list(fits)
    best = _best(evidence, inside)
    for fit in inside:
        contained = fit.effects[-1] in NESTED.get(best.effects[-1], ())
        if contained and tied(evidence, best, fit, CONTAINED_FLOORS):
            return fit
    return best


def at_bound(fit: JointFit) -> tuple[str, ...]:
    """Keys of effect parameters that ended at a bound."""
    pairs = zip(fit.coordinates, fit.x, strict=True)
    bound = [c.key for c, x in pairs if "." in c.key and c.bound(float(x))]
    if ONE_SIDED in fit.effects and not set(DRY) & set(fit.effects):
        # No dry friction spares one direction: what does is a load, and a greater one would push.
        sides = {key: value for key, value in fit.values.items() if key.startswith(ONE_SIDED)}
        bound += [key for key, value in sides.items() if value <= OWN_ERROR * max(sides.values())]
    return tuple(bound)


def _best(evidence: Evidence, fits: Sequence[JointFit]) -> JointFit:
    """The fit with the best held-out score.

    With the best fitted one of those with white residuals.

    Of these, samples tell more than the luck of a held-out motion.
    """
    at_floor = [fit for fit in fits if white(evidence, fit)]
    compared = at_floor or fits
    errors = [fit.sse if at_floor else fit.held_out for fit in compared]
    return compared[int(np.argmin(_scores(compared, errors)))]


def _scores(
    fits: Sequence[JointFit], errors: Sequence[np.ndarray], weights: np.ndarray | None = None
) -> np.ndarray:
    """Log of RMSE plus the price of parameters, shape [C] or [C, R].

    Args:
        fits: C fits.
        errors: The squared errors of each trajectory that count, of each fit [S].
        weights: Bootstrap weights of the trajectories [R, S].
    """
    error = np.log(np.maximum(rmse(np.stack(errors), fits[0].count, weights), 1e-12))
    price = PENALTY * np.array([len(fit.x) for fit in fits], float)
    return error + (price if weights is None else price[:, None])


def gain(
    evidence: Evidence, before: JointFit, after: JointFit
) -> tuple[float, tuple[float, float]]:
    """Share of the held-out RMSE removed, with its interval over trajectories."""
    old = rmse(before.held_out, before.count, evidence.weights)
    new = rmse(after.held_out, after.count, evidence.weights)
    return 1.0 - after.held_out_rmse / before.held_out_rmse, interval(1.0 - new / old)


def refused_step(evidence: Evidence, before: JointFit, after: JointFit) -> str:
    """Why a tentative step from one model to the larger is not earned; empty if it is.

    Its gain may be that of a few motions: one of two causes alone can make some worse.
    """
    before, after = _compared(evidence, before, after)
    return _too_small(before, after) or _below_noise(evidence, before, after)


def refused(evidence: Evidence, before: JointFit, after: JointFit) -> str:
    """Why the larger of two models is not earned; empty if it is."""
    before, after = _compared(evidence, before, after)
    if small := _too_small(before, after):
        return small
    if gain(evidence, before, after)[1][0] <= 0.0:
        return "its gain over trajectories is not distinguishable from 0"
    return _below_noise(evidence, before, after)


def _compared(evidence: Evidence, before: JointFit, after: JointFit) -> tuple[JointFit, JointFit]:
    """Two models with the errors by which they are compared in the place of the held-out ones.

    Motions that no fit has seen decide; but a larger model that leaves white residuals is judged on
    all samples: that a parameter is not known well enough without one motion to predict it, as that
    of a profile that cannot follow, says nothing against it. Nor does luck with such a motion speak
    for a larger model if the smaller one leaves white residuals already.
    """
    if white(evidence, before) or white(evidence, after):
        return replace(before, held_out=before.sse), replace(after, held_out=after.sse)
    return before, after


def _too_small(before: JointFit, after: JointFit) -> str:
    """Why a larger model gains too little, or nothing."""
    share = 1.0 - after.held_out_rmse / before.held_out_rmse
    if share >= MIN_GAIN:
        return ""
    return f"removes {100.0 * share:.1f} % of the error, less than {100.0 * MIN_GAIN:.0f} %"


def _below_noise(evidence: Evidence, before: JointFit, after: JointFit) -> str:
    """Why what a larger model removes is nothing, or nothing."""
    share = 1.0 - after.held_out_rmse / before.held_out_rmse
    closed = before.held_out_rmse * np.sqrt(max(1.0 - (1.0 - share) ** 2, 0.0))
    least = JITTER_GAIN_FLOORS if evidence.behind_jitter else np.sqrt(NO_GAP**2 - 1.0)
    return "what it removes is below the noise floor" if closed < least * evidence.floor else ""


def tied(
    evidence: Evidence, best: JointFit, other: JointFit, excess_floors: float = EXCESS_FLOORS
) -> bool:
    """Whether the recording does not tell a fit from a better one.

    A winner at the noise floor leaves white residuals, so that samples count: what the other leaves
    in excess of it is then decisive, even if few motions show it.

    Args:
        evidence: What fits are judged by.
        best: The better fit.
        other: The other.
        excess_floors: What the other may leave in excess, in noise floors.
    """
    if not white(evidence, best):
        return difference(evidence, best, other)[0] <= 0.0
    excess = (other.rmse**2 - best.rmse**2) / evidence.floor**2
    if excess > 0.0:  # what needs more parameters to do worse is no equal
        more = max(len(other.x) - len(best.x), 0)
        excess += 2.0 * PENALTY * more * (best.rmse / evidence.floor) ** 2
    excess /= MEMORY if evidence.behind_jitter else 1.0
    return bool(excess < excess_floors**2)


def difference(evidence: Evidence, best: JointFit, other: JointFit) -> tuple[float, float]:
    """Interval of what a fit's held-out RMSE is above a better one's [rad]."""
    least = rmse(best.held_out, best.count, evidence.weights)
    error = rmse(other.held_out, other.count, evidence.weights)
    return interval(error - least)


def judged(
    evidence: Evidence,
    number: int,
    before: JointFit,
    fits: Mapping[str, JointFit],
    best: JointFit,
    refusal: str,
) -> list[TriedEffect]:
    """The rows of one round for the evidence table, best first.

    Args:
        evidence: What fits are judged by.
        number: The round.
        before: The model before it.
        fits: With each candidate.
        best: Their winner.
        refusal: Why that is not earned; empty if it is.
    """
    rows = []
    chosen = best.effects[-1]
    for name, fit in sorted(fits.items(), key=lambda item: item[1].held_out_rmse):
        decision = "rejected"
        reason = refusal or f"{chosen} predicts unseen motions better"
        if fit is best and not refusal:
            decision, reason = "named", "best on unseen motions"
        elif not refusal and tied(evidence, best, fit):
            if chosen in NESTED.get(name, ()):
                reason = f"contains {chosen} and adds nothing to it"
            else:
                decision, reason = "tied", f"not told from {chosen} by this recording"
        rows.append(TriedEffect(number, name, fit, *gain(evidence, before, fit), decision, reason))
    return rows


def exchanged(
    evidence: Evidence, present: JointFit, fits: Sequence[JointFit], vetoes: Iterable[str]
) -> JointFit | None:
    """What does better than a model with another effect in the place of one of its own, or None.

    Args:
        evidence: What fits are judged by.
        present: The model.
        fits: It, and those with another effect.
        vetoes: Effects that are none.
    """
    best = winner(evidence, [fit for fit in fits if not {*fit.effects} & {*vetoes}])
    simpler = len(best.x) < len(present.x)
    better = best is not present and (simpler or not tied(evidence, best, present))
    return best if better else None


def containing(effects: Iterable[str]) -> list[str]:
    """Effects that contain one of those given, and beside it are no other cause."""
    return [name for name, simpler in NESTED.items() if {*simpler} & {*effects}]


# 4. Whether delays are random.


def tries_jitter(evidence: Evidence, present: JointFit) -> bool:
    """Whether enough is left for random delays to be a cause."""
    return not no_gap(evidence, present) and not white(evidence, present)


def refused_jitter(evidence: Evidence, present: JointFit, random: JointFit, left: float) -> str:
    """Why random delays are none; empty if they are what is left.

    Args:
        evidence: What fits are judged by.
        present: The model without them.
        random: The model with them.
        left: What that leaves, seen through what the delays do [rad].
    """
    if left > REPEATABLE * evidence.floor:
        return f"leaves {left / evidence.floor:.1f} noise floors besides, more than chance does"
    return unlikelier(evidence, present, random)


def unlikelier(evidence: Evidence, before: JointFit, after: JointFit) -> str:
    """Why random delays are no likelier than a model without them; empty if they are.

    The other model has a width of its own for every motion, no less than the floor, lest jitter be
    credited with what any excuse for some of them would gain; a width is a parameter, and costs
    what one costs (half the log of its samples). A motion whose command stays as it is does not
    count: nothing can be late there. What random delays add to a model has to be worth another
    effect.

    Args:
        evidence: What fits are judged by.
        before: The model without them.
        after: The model with them.
    """
    noise = evidence.noise
    power = before.sse / after.count / noise**2
    widths = noise**2 * np.where(power < 1.0, np.exp(np.minimum(power, 1.0) - 1.0), power)
    count = after.count if evidence.moves is None else after.count * evidence.moves
    ratio = np.maximum(widths * after.count, 1e-30) / np.maximum(after.sse, 1e-30)
    gained = 0.5 * count * np.log(ratio)
    share = 1.0 - float(np.exp(-gained.sum() / max(count.sum(), 1.0)))
    if len(after.effects) > len(before.effects) and share < MIN_GAIN:
        least = 100.0 * MIN_GAIN
        return f"narrows what is left by {100.0 * share:.1f} %, less than {least:.0f} %"
    price = 0.5 * np.log(np.maximum(count, 1.0))
    if interval(evidence.weights @ (gained + price))[0] <= 0.0:
        return "not likelier than a width of its own for every motion"
    return ""


# 5. What of the final model is named.


def settled(trials: Sequence[TriedEffect], final: JointFit) -> list[TriedEffect]:
    """The evidence with the steps that did not last marked as such."""
    text = "helped at first, not needed or not earned in the end"
    result = []
    for row in trials:
        lost = row.decision == "named" and row.name not in final.effects
        result.append(replace(row, decision="rejected", reason=text) if lost else row)
    return result


def conclude(
    evidence: Evidence,
    baseline: JointFit,
    final: JointFit,
    rivals: Mapping[str, list[JointFit]],
    trials: Sequence[TriedEffect],
    loose: str,
    refined: JointFit,
    known: Sequence[Accepted] = (),
) -> Explanation:
    """Confidence, sets and verdict of the final model.

    Args:
        evidence: What fits are judged by.
        baseline: The model without effects.
        final: The model chosen.
        rivals: Fits with others in the place of each effect.
        trials: The evidence.
        loose: What of the baseline the motions leave open.
        refined: The final model at finer time steps where it was refined: its values are reported.
        known: Effects that are judged already.
    """
    spread = intervals(refined, evidence.floor)
    accepted = [*known]
    judged_already = {one.name for one in known}
    for name in final.effects:
        if name not in judged_already:
            fits = rivals.get(name, [final])
            accepted.append(accept(evidence, final, name, fits, spread, refined))
    explanation = Explanation(baseline, refined, "unknown", "", tuple(accepted), tuple(trials))
    if not accepted:
        return nothing_earned(evidence, explanation, loose)
    # One motion can be all that shows a parameter: that no fit without it predicts it says nothing
    # then.
    fitted = white(evidence, final) and not evidence.behind_jitter
    before, after = ((f.rmse if fitted else f.held_out_rmse) ** 2 for f in (baseline, final))
    share = (before - after) / max(before - evidence.floor**2, 1e-30)
    # What jitter does to each sample stays, however well its size is known.
    if share < RECOVERED and JITTER not in final.effects:
        text = (
            f"the best candidate recovers {100.0 * share:.0f} % of the squared gap, less than half"
        )
        return replace(explanation, reason=text)
    return _by_names(explanation)


def accept(
    evidence: Evidence,
    final: JointFit,
    name: str,
    rivals: Sequence[JointFit],
    spread: Mapping[str, tuple[float, float]],
    refined: JointFit,
) -> Accepted:
    """Confidence and set of one effect of the final model, with the values of the ``refined``."""
    own = next((fit for fit in rivals if fit.effects and fit.effects[-1] == name), None)
    mine = final if own is None or any(fit is final for fit in rivals) else own
    means = (*evidence.equivalent.get(name, ()), *same_beside(final, name, evidence.joint))
    others = [fit for fit in rivals if fit is not mine and fit.effects[-1] not in (name, *means)]
    alone = not {*DRY, *TOGETHER.get(name, ())} & {*final.effects}
    fits = [mine, *others]
    errors = [fit.sse if white(evidence, mine) else fit.held_out for fit in fits]
    choice = np.argmin(_scores(fits, errors, evidence.weights), axis=0)
    simple = {i + 1 for i, fit in enumerate(others) if name in NESTED.get(fit.effects[-1], ())}
    share = float(np.mean([c == 0 or c in simple for c in choice]))
    alternatives, equals = [], []
    for fit in sorted(others, key=lambda other: other.held_out_rmse):
        other = fit.effects[-1]
        alternatives.append((other, fit.held_out_rmse, difference(evidence, mine, fit)))
        if tied(evidence, mine, fit):
            equals.append(other)
    # In a tie the simpler one is meant: none beside an effect that it contains.
    equals = [other for other in equals if not {name, *equals} & set(NESTED.get(other, ()))]
    if share < NAMED and not equals:
        rival = int(np.argmax(np.bincount(choice, minlength=len(others) + 1)[1:]))
        equals.append(others[rival].effects[-1])
    return Accepted(
        name=name,
        confidence=share,
        estimates=estimates(refined, name, spread),
        equivalent=(*means, *TOGETHER.get(name, ())) if alone else means,
        alternatives=tuple(alternatives),
        tied=tuple(equals),
        at_bound=any(key.startswith(f"{name}.") for key in at_bound(final)),
    )


def same_beside(final: JointFit, name: str, joint: int) -> tuple[str, ...]:
    """Effects that move the joint as one does beside the others of a model (:data:`BESIDE`)."""
    same = [other for one in final.effects for other in BESIDE.get(one, {}).get(name, ())]
    if ONE_SIDED in same:
        # A side of friction cannot push: it is at most what is dry in all.
        level = final.values.get("stribeck_friction.tau_c_nm", 0.0)
        pull = abs(final.values["encoder_bias.bias_rad"]) * float(final.rows[joint, servo.KP])
        same = [other for other in same if other != ONE_SIDED or pull <= level]
    return tuple(same)


def nothing_earned(evidence: Evidence, explanation: Explanation, loose: str) -> Explanation:
    """The verdict where no effect earned its place."""
    tried = [row for row in explanation.trials if np.isfinite(row.gain)]
    why = tried[0].reason if tried else "there is no candidate"
    if explanation.baseline.held_out_rmse > REPEATABLE * evidence.floor:
        return replace(explanation, reason=f"a gap that no candidate explains: the best {why}")
    if loose:
        return replace(explanation, verdict="under_excited", reason=loose)
    return replace(
        explanation, verdict="no_gap", reason=f"no effect is significant: the best {why}"
    )


def _by_names(explanation: Explanation) -> Explanation:
    """The verdict by what of a model that fits is named, or a set, or neither."""
    accepted = explanation.accepted
    names = [one.name for one in accepted if named(one)]
    if names:
        return replace(explanation, verdict="effects", reason=explains(names))
    if all(one.at_bound for one in accepted):
        return replace(
            explanation, reason=f"{accepted[0].name} fits only with a parameter at its bound"
        )
    sets = [" or ".join((a.name, *a.tied)) for a in accepted if a.tied and not a.at_bound]
    if not sets:
        absent = [one.name for one in accepted if not shown(one)]
        text = f"{absent[0]} can be nothing at all" if absent else "nothing is chosen often enough"
        return replace(explanation, reason=text)
    return replace(explanation, verdict="ambiguous", reason=f"{'; '.join(sets)}: not told apart")


def named(accepted: Accepted) -> bool:
    """Whether an effect is the answer rather than one of a set."""
    one_of_many = accepted.tied or accepted.at_bound
    return not one_of_many and shown(accepted) and accepted.confidence >= NAMED


def shown(accepted: Accepted) -> bool:
    """Whether the interval of an effect's size leaves out its absence.

    Several sizes stand in for each other.

    Absence is 0, but infinity of a limit or a stiffness: its inverse is more than 0 for sure if
    half the interval of its logarithm is less than 1, to first order.
    """
    limits, sizes = [], []
    for parameter in EFFECTS[accepted.name].parameters:
        if parameter.column == servo.GRAVITY_PHASE or parameter.name not in accepted.estimates:
            continue
        value, low, high = accepted.estimates[parameter.name]
        if parameter.lower > 0.0 == parameter.neutral:
            limits.append(high < np.e * value)
        if parameter.lower == 0.0:
            sizes.append(not low <= 0.0 <= high)
    known = limits or sizes
    return len(known) != 1 or bool(known[0])


def explains(names: Sequence[str]) -> str:
    """The reason of a verdict that names effects."""
    return f"{' and '.join(names)} {'explains' if len(names) == 1 else 'explain'} it"


def with_notes(
    explanation: Explanation, joint: int, rest: float, vetoes: Iterable[str]
) -> Explanation:
    """The explanation with what its names do not say.

    What a member of a set means that telemetry contradicts by its name; and no names where two
    effects are but one that is not in the table.

    Args:
        explanation: Of a joint.
        joint: Its index in its chain.
        rest: Where it rests before it moves [rad].
        vetoes: Effects that telemetry contradicts.
    """
    one_cause = cancelled(explanation.final, joint, rest)
    if one_cause and explanation.verdict in ("effects", "ambiguous"):
        return replace(explanation, verdict="unknown", reason=one_cause)
    members = {name for one in explanation.accepted for name in one.tied}
    notes = [
        f"{name} {BEHIND_SENSOR[name]}" for name in sorted(members & set(BEHIND_SENSOR) & {*vetoes})
    ]
    return replace(explanation, reason="; ".join([explanation.reason, *notes]))


def cancelled(fit: JointFit, joint: int, rest: float) -> str:
    """What two effects of a model are instead if they cancel at rest, in words.

    Empty if they do not.

    Args:
        fit: The model.
        joint: Index of its joint in the chain.
        rest: Where the joint rests before it moves [rad].
    """
    if not {*CANCELLING} <= {*fit.effects}:
        return ""
    values, kp = fit.values, float(fit.rows[joint, servo.KP])
    load = values["gravity_load.tau_g_nm"] * np.sin(rest + values["gravity_load.phase_rad"])
    offset = kp * values["encoder_bias.bias_rad"]
    if abs(offset - load) > CLOSE * min(abs(load), abs(offset)):
        return ""
    return (
        "gravity_load and encoder_bias cancel where the joint rests: a spring about that place "
        "would look the same, and is not among the candidates"
    )


# 6. What joints tell each other.

SPRUNG = (
    f"{explains(CANCELLING)} here, but cancel at rest on another joint of the finger, "
    "as a spring does"
)
"""Why a load and an offset are no names."""


def doubted(explanations: Sequence[Explanation], groups: Sequence[int]) -> list[Explanation]:
    """Explanations without what another joint of the finger shows to be a cause that is not in the table.

    That is a load and an offset that cancel at rest there: where a joint travels little they
    imitate the same spring.

    Args:
        explanations: Of the joints.
        groups: Number of the finger of each joint.
    """
    both, pairs = {*CANCELLING}, list(zip(explanations, groups, strict=True))
    sprung = {group for e, group in pairs if e.verdict == "unknown" and both <= {*e.final.effects}}
    result = []
    for explanation, group in pairs:
        answer = explanation.verdict in ("effects", "ambiguous")
        if answer and group in sprung and both == {*explanation.final.effects}:
            explanation = replace(explanation, verdict="unknown", reason=SPRUNG)
        result.append(explanation)
    return result


def answered(explanation: Explanation) -> tuple[Accepted, ...]:
    """Effects of a joint's final model, where that is an answer."""
    return explanation.accepted if explanation.verdict in ("effects", "ambiguous") else ()


def agree(one: Accepted, other: Accepted) -> bool:
    """Whether the values of an effect on two joints can be the same.

    Close, or of intervals that overlap.
    """
    if one.estimates.keys() != other.estimates.keys():
        return False
    for key, (value, low, high) in one.estimates.items():
        other_value, other_low, other_high = other.estimates[key]
        close = abs(value - other_value) <= CLOSE * max(abs(value), abs(other_value))
        if not close and not (low <= other_high and other_low <= high):
            return False
    return True


def overall(verdicts: Sequence[Verdict]) -> Verdict:
    """The verdict on a recording: the first, in the order of importance, that some joint has."""
    return next((verdict for verdict in get_args(Verdict) if verdict in verdicts), "no_gap")
