"""Every rule by which a cause is named, in the order in which they act.

Whole models of a joint are compared, each fitted to all its motions (:mod:`vd.gap.ladder`) and held
out motion by motion. A name is what all models share that are not worse than the best: a family of
causes first, then its member where the motions tell. Rules take the data on which they act, and
simulate nothing.

1. Which effects are tried: those that the joint can have and telemetry does not contradict.
2. Whether there is a gap: not where the plain model leaves no more than noise.
3. The best model: least error of the models that earn what they have more than each smaller one
   that they contain, by one standard error over motions.
4. Which models are good: those that are not sure to be worse than the best by more than 5 %, by
   the 95 % interval of paired differences over motions, or by samples where the best leaves no more
   than noise.
5. What is named: what all good models share, if fitted and held-out errors both fall by enough.
   So an effect is named only if without it every model is worse by that interval.
"""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.stats import binom

import vd.kernels.servo.actuators as servo
from vd.gap.chain import Chain
from vd.gap.coordinates import PARAMETERS, keys_of
from vd.gap.fit import JointFit, intervals
from vd.gap.result import Certainty, Verdict
from vd.gap.statistics import CONFIDENCE, OWN_ERROR, REPEATABLE, half_width, rmse
from vd.gap.telemetry import Telemetry
from vd.gap.words import listing, model_text, percent
from vd.kernels.servo.effects import EFFECTS, TOGETHER, equivalent
from vd.logs.recording_checks import MIN_KINDS


@dataclass(frozen=True)
class Family:
    """Causes of one kind, of which a model has one member or none.

    Attributes:
        members: Effects of each member.
        motions: Set of motions that tells the members, and the family from others
            (:data:`vd.logs.excitations.MENU`).
    """

    members: tuple[tuple[str, ...], ...]
    motions: str

    @property
    def effects(self) -> set[str]:
        """Effects of all members."""
        return set().union(*self.members)


FAMILIES = {
    "dry friction": Family(
        (
            ("coulomb_friction",),
            ("stribeck_friction",),
            ("load_friction",),
            ("coulomb_friction", "load_friction"),
            ("stribeck_friction", "load_friction"),
            ("asymmetric_friction",),
        ),
        "slow_triangle",
    ),
    "delay": Family(
        (
            ("command_delay",),
            ("read_delay",),
            ("command_filter",),
            ("command_delay", "command_filter"),
        ),
        "chirp",
    ),
    "torque ceiling": Family(
        (("torque_limit",), ("torque_speed_limit",), ("torque_saturation",), ("supply_sag",)),
        "gain_ladder",
    ),
    "play": Family((("backlash",), ("dead_zone",)), "gain_ladder"),
    "load or offset": Family((("gravity_load",), ("encoder_bias",)), "gain_ladder"),
    "elasticity": Family((("elastic_transmission",),), "chirp"),
    "acceleration limit": Family((("acceleration_limit",),), "steps_and_sines"),
    "integral action": Family((("integral_action",),), "long_holds"),
    "warming": Family((("thermal_drift",),), "long_holds"),
    "inertia": Family((("payload_inertia",),), "chirp"),
    "coupling": Family((("joint_coupling",),), "steps_and_sines"),
}
"""Every cause that is named, by family. ``command_jitter`` is in none: no single prediction shows
delays that are random, so they end as unknown."""
CONTAINS = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "elastic_transmission": ("payload_inertia",),
}
"""Effects that contain a simpler one."""
DETERMINED = ("kp", "kd", "inertia")
"""Baseline parameters that every useful excitation determines."""
UPSTREAM = (
    "command_delay",
    "read_delay",
    "command_filter",
    "acceleration_limit",
    "dead_zone",
    "integral_action",
    "backlash",
)
"""Effects between command and controller output, each of which the duty cycle shows. Backlash is
that of the reference, as the servo model has it, not play behind the motor."""

SAGGING = 0.1
"""Share by which the voltage of a supply must fall under load for it to sag. Not tuned."""
LINEAR = 0.995
"""Share of the duty cycle's variance that the plain error must explain for it to be linear. Not
tuned.
"""
NO_GAP = 1.15
"""A model within this factor of the noise floor leaves white residuals, and nothing to explain.
Half of what it leaves above 1 turns none of 41 joints, twice turns five."""
MIN_GAIN = 0.05
"""Share of the error that an addition to a model must remove, and by which a model is worse than
another. Of an addition, half turns none of 41 joints, twice turns one."""
PENALTY = 0.01
"""Relative error that a further effect, and each of its parameters, must earn. And what a model must
leave more than one with white residuals, in squared noise floors, to be worse: thousands of samples
carry that difference. Half turns none of 41 joints; twice was tried for the first use alone, and
turns none."""
FEW = 5
"""Folds below which each motion stands for itself in intervals. Not tuned."""
RECOVERED = 0.5
"""Share of the squared gap that a model must recover to be an explanation. Half turns none of 41
joints, half more one."""


@dataclass(frozen=True)
class Evidence:
    """What the models of one joint are judged by.

    Attributes:
        noise: Noise floor of the recording [rad].
        folds: Fold of each trajectory [S].
        whole: Fitted RMSE of the plain model [rad].
    """

    noise: float
    folds: Sequence[int]
    whole: float

    @property
    def without(self) -> np.ndarray:
        """The trajectories without each block of those that are held out together [B, S]."""
        blocks = np.array(self.folds)
        if len(np.unique(blocks)) < FEW:
            blocks = np.arange(len(blocks))
        return (np.unique(blocks)[:, None] != blocks).astype(float)

    @property
    def floor(self) -> float:
        """The least error that a right model can have [rad].

        Noise, and what it misses of a large effect.
        """
        return float(np.hypot(self.noise, OWN_ERROR * self.whole))


# 1. Which effects are tried on a joint.


def families_of(effects: Collection[str]) -> set[str]:
    """Families that some effects are of."""
    return {name for name, family in FAMILIES.items() if family.effects.intersection(effects)}


def candidates(chain: Chain, effects: Sequence[str]) -> list[str]:
    """Effects that a joint of a chain can have besides its baseline."""
    allowed = {*effects}
    if "tau_g_nm" in chain.baseline_free:
        allowed.discard("gravity_load")
    if "inertia" in chain.baseline_free:
        allowed.discard("payload_inertia")
    if len(chain.joints) == 1:
        allowed.discard("joint_coupling")
    return [name for name in EFFECTS if name in allowed]


def alike(names: Sequence[str], model: str) -> dict[str, tuple[str, ...]]:
    """The candidates that stand for others of the candidates, and for which."""
    result = {}
    for name, others in equivalent(model).items():
        if name in names and (inside := {*names}.intersection(others)):
            result[name] = tuple(sorted(inside, key=others.index))
    return result


def contradicted(telemetry: Telemetry) -> dict[str, str]:
    """Effects that recorded voltage and duty cycle contradict, with the reason.

    The voltage that a sagging supply needs is there to be seen. And the duty cycle of a position
    servo is its controller's output: where it follows the plain error at the recorded gain, nothing
    upstream of it (a delay, a filter, a dead zone, integral action) is at work.
    """
    result = {}
    if telemetry.fall is not None and telemetry.fall[0] < SAGGING * telemetry.fall[1]:
        fall, idle = telemetry.fall
        result["supply_sag"] = (
            f"the recorded voltage falls by {fall:.2f} V of {idle:.1f} V at full pull, "
            "too little for sag"
        )
    if telemetry.follows >= LINEAR:
        share = f"{100.0 * telemetry.follows:.1f} % of it"
        reason = f"the recorded duty cycle follows the plain error ({share}): it acts downstream"
        result |= dict.fromkeys(UPSTREAM, reason)
    return result


def changes(effects: Iterable[str], allowed: Iterable[str]) -> list[frozenset[str]]:
    """The models next to one: with another member of one family, or two effects for the same one.

    Args:
        effects: Of the model.
        allowed: Effects that models may have.
    """
    present = {*effects}
    result = []
    swaps: list[tuple[set[str], tuple[str, ...]]] = []
    for family in FAMILIES.values():
        rest = present - family.effects
        swaps += itertools.product([rest], [(), *family.members])
    if "asymmetric_friction" in present:  # friction beside a load or an offset can be the same
        rest = present - FAMILIES["dry friction"].effects - FAMILIES["load or offset"].effects
        friction = rest | {"coulomb_friction"}
        swaps += itertools.product([friction], FAMILIES["load or offset"].members)
    for rest, member in swaps:
        model = frozenset(rest.union(member))
        if model != present and {*allowed}.issuperset(model - present):
            result.append(model)
    return result


# 2. Whether there is a gap.


def undetermined(evidence: Evidence, fit: JointFit) -> str:
    """Which parameter of the baseline the motions leave open, in words; empty if none."""
    for key, (low, high) in intervals(fit, evidence.floor).items():
        if key in DETERMINED and high > np.e**2 * low:  # as of a limit that is not shown
            return (
                f"{key} can lie anywhere between {low:.2g} and {high:.2g}: "
                "the motions do not show it"
            )
    return ""


def white(evidence: Evidence, fit: JointFit) -> bool:
    """Whether a model leaves no more than noise on what it was fitted to."""
    return fit.rmse < NO_GAP * evidence.floor


def too_few(fit: JointFit) -> str:
    """Why motions cannot be held out, or nothing."""
    if len(fit.sse) >= MIN_KINDS:
        return ""
    return f"{len(fit.sse)} trajectories leave none to hold out; record {MIN_KINDS} at least"


# 3. The best model.


def scores(evidence: Evidence, fits: Sequence[JointFit]) -> np.ndarray:
    """Log of the error of C models plus the price of what they have [C]."""
    result = np.log(np.maximum(rmse(errors(evidence, fits), fits[0].count), 1e-12))
    for i, fit in enumerate(fits):
        result[i] += PENALTY * (len(fit.effects) + len(fit.x) - len(fits[0].x))
    return result


def errors(evidence: Evidence, fits: Sequence[JointFit]) -> np.ndarray:
    """Sums of squared errors by which C models are compared [C, S].

    Those on held-out motions. Once a model leaves white residuals, all samples tell more than the
    luck of a held-out motion.
    """
    held_out = []
    fitted = []
    by_samples = False
    for fit in fits:
        held_out.append(fit.held_out)
        fitted.append(fit.sse)
        by_samples = by_samples or white(evidence, fit)
    return np.stack(fitted if by_samples else held_out)


def at_bound(fit: JointFit) -> str:
    """Which effect of a model fits only at a bound of its parameters, in words; empty if none."""
    for c, x in zip(fit.coordinates, fit.x, strict=True):
        if "." in c.key and c.bound(float(x)):
            return f"{c.key.partition('.')[0]} fits only with a parameter at its bound"
    if "asymmetric_friction" in fit.effects:
        # No dry friction spares one direction: what does is a load, and a greater one would push.
        plus = fit.values["asymmetric_friction.tau_plus_nm"]
        minus = fit.values["asymmetric_friction.tau_minus_nm"]
        if min(plus, minus) <= OWN_ERROR * max(plus, minus):
            return "asymmetric_friction fits only with none in one direction"
    return ""


def flaw(evidence: Evidence, fit: JointFit) -> str:
    """Why a model explains nothing whatever its error; empty if there is no reason."""
    if bound := at_bound(fit):
        return bound
    names = idle(evidence, fit)
    return f"{listing(names)} can be nothing at all" if names else ""


def idle(evidence: Evidence, fit: JointFit) -> list[str]:
    """Effects of a model whose size can be nothing."""
    spread = intervals(fit, evidence.floor)
    return [name for name in fit.effects if not shown(name, fit.values, spread)]


def shown(
    name: str, values: Mapping[str, float], spread: Mapping[str, tuple[float, float]]
) -> bool:
    """Whether the interval of an effect's size leaves out its absence.

    Absence is 0, but infinity of a limit or a stiffness: its inverse is more than 0 for sure if
    half the interval of its logarithm is less than 1, to first order. Several sizes of one effect
    stand in for each other and say nothing one by one.
    """
    limits = []
    strengths = []
    for key in keys_of([name]):
        parameter = PARAMETERS[key]
        if parameter.column == servo.GRAVITY_PHASE or key not in values:
            continue
        low, high = spread[key]
        if parameter.lower > 0.0 == parameter.neutral:
            limits.append(high < np.e * values[key])
        if parameter.lower == 0.0:
            strengths.append(not low <= 0.0 <= high)
    known = limits or strengths
    return len(known) != 1 or bool(known[0])


def best_of(evidence: Evidence, fits: Sequence[JointFit]) -> JointFit:
    """The model with the best score."""
    return fits[int(np.argmin(scores(evidence, fits)))]


def contains(larger: JointFit, smaller: JointFit) -> bool:
    """Whether a model is another with something added, or with a more general effect for one.

    Of two that can do the same, neither contains the other.
    """
    return covered(larger) > covered(smaller)


def covered(fit: JointFit) -> set[str]:
    """The effects of a model, and those that it can imitate."""
    result = {*fit.effects}
    for name in fit.effects:
        result.update(CONTAINS.get(name, ()))
    for name, parts in TOGETHER.items():
        if result.issuperset(parts):
            result.add(name)
    return result


def not_earned(evidence: Evidence, smaller: JointFit, larger: JointFit) -> str:
    """Why what a model has more than a smaller one is not earned; empty if it is.

    Fitted and held-out errors must both fall: a motion held out can make the smaller one
    extrapolate, which no effect has to explain. They fall by more than one standard error.
    """
    fitted = 1.0 - larger.rmse / smaller.rmse
    held_out = 1.0 - larger.held_out_rmse / smaller.held_out_rmse
    certain = True
    if white(evidence, larger):
        gain = fitted
        before = smaller.rmse
    else:
        gain = min(fitted, held_out)
        before = smaller.held_out_rmse
        gained, error = paired(evidence, larger, smaller)
        certain = gained > error
    if gain < MIN_GAIN:
        return f"removes {percent(gain)} of the error, less than {percent(MIN_GAIN)}"
    if before * np.sqrt(1.0 - (1.0 - gain) ** 2) < np.sqrt(NO_GAP**2 - 1.0) * evidence.floor:
        return "what it removes is below the noise floor"
    return "" if certain else "the gain over motions is not distinguishable from none"


def earned(evidence: Evidence, fits: Sequence[JointFit]) -> list[JointFit]:
    """The models that explain something and earn what they have more than each that they contain."""
    sound = [fit for fit in fits if not fit.effects or not flaw(evidence, fit)]
    return [fit for fit in sound if not unearned(evidence, sound, fit)]


def unearned(evidence: Evidence, fits: Sequence[JointFit], fit: JointFit) -> str:
    """Beside which smaller model one does not earn what it has more, and why; empty if none."""
    for smaller in fits:
        if contains(fit, smaller) and (why := not_earned(evidence, smaller, fit)):
            return f"beside {model_text(smaller.effects)} {why}"
    return ""


# 4. Which models are good.


def paired(evidence: Evidence, best: JointFit, other: JointFit) -> tuple[float, float]:
    """What a model's held-out RMSE is above another's, and its standard error [rad].

    The jackknife over blocks of motions.
    """
    without = evidence.without
    parts = rmse(other.held_out, best.count, without) - rmse(best.held_out, best.count, without)
    error = np.sqrt((len(parts) - 1) * parts.var())
    return other.held_out_rmse - best.held_out_rmse, float(error)


def difference(evidence: Evidence, best: JointFit, other: JointFit) -> tuple[float, float]:
    """95 % interval of what a model's held-out RMSE is above another's, over motions [rad]."""
    value, error = paired(evidence, best, other)
    width = float(half_width(np.square(error), len(evidence.without)))
    return value - width, value + width


def not_worse(evidence: Evidence, best: JointFit, other: JointFit) -> bool:
    """Whether the recording does not tell a model from the best one.

    If that leaves white residuals, samples count: what the other leaves in excess is then decisive,
    even if few motions show it, but not if the best itself leaves as much more than noise.
    """
    if not white(evidence, best):
        return difference(evidence, best, other)[0] <= MIN_GAIN * best.held_out_rmse
    own = (best.rmse / evidence.floor) ** 2
    excess = (other.rmse / evidence.floor) ** 2 - own
    return bool(excess < max(PENALTY, own - 1.0))


def good_models(evidence: Evidence, fits: Sequence[JointFit]) -> list[JointFit]:
    """The models that are not worse than the best, the best first."""
    candidates = earned(evidence, fits)
    first, *others = np.argsort(scores(evidence, candidates))
    good = [candidates[first]]
    for index in others:
        fit = candidates[index]
        if not_worse(evidence, good[0], fit):
            good.append(fit)
    return good


def against(
    evidence: Evidence, fits: Sequence[JointFit], good: Sequence[JointFit], fit: JointFit
) -> str:
    """What speaks against a model that is not good, in words.

    Args:
        evidence: What models are judged by.
        fits: All models.
        good: The good ones, the best first.
        fit: The model.
    """
    worse = f"worse than {model_text(good[0].effects)}"
    return flaw(evidence, fit) or unearned(evidence, fits, fit) or worse


def shares(evidence: Evidence, good: Sequence[JointFit]) -> np.ndarray:
    """Share of the motions that each good model predicts best of them; those about as good share."""
    error = np.sqrt(errors(evidence, good))
    best = error <= error.min(axis=0) / (1.0 - MIN_GAIN)
    return (best / best.sum(axis=0)).mean(axis=1)


# 5. What is named.


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What is concluded of one joint.

    Attributes:
        verdict: The verdict.
        reason: Why, in a sentence.
        final: The model that is delivered: the best of the good ones, the plain one where nothing
            is explained.
        good: The good models, the best first.
        shares: Share of the motions that each of them predicts best.
        names: Effects that all good models share, where that is an answer.
        families: What is known of each family that was tried with the best model.
    """

    verdict: Verdict
    reason: str
    final: JointFit
    good: tuple[JointFit, ...]
    shares: np.ndarray
    names: tuple[str, ...] = ()
    families: Mapping[str, Certainty] = field(default_factory=dict)


def conclude(
    evidence: Evidence, plain: JointFit, fits: Sequence[JointFit], loose: str
) -> Conclusion:
    """Verdict, names and good models of a joint.

    Args:
        evidence: What models are judged by.
        plain: The plain model.
        fits: All models, the plain one among them.
        loose: What of the plain model the motions leave open.
    """
    if few := too_few(plain):
        return Conclusion("under_excited", few, plain, (plain,), np.ones(1))
    good = good_models(evidence, fits)
    weights = shares(evidence, good)
    if not good[0].effects:
        verdict, reason = nothing_named(evidence, plain, fits, loose)
        families = said_of_families(good, weights, fits) if verdict == "no_gap" else {}
        return Conclusion(verdict, reason, plain, tuple(good), weights, (), families)
    share = recovered(evidence, plain, good[0])
    if share < RECOVERED:
        text = (
            f"the best model, {model_text(good[0].effects)}, recovers {percent(share)} "
            "of the squared gap, less than half"
        )
        return Conclusion("unknown", text, plain, tuple(good), weights)
    shared = {*good[0].effects}
    for fit in good:
        shared.intersection_update(fit.effects)
    names = tuple(sorted(shared, key=good[0].effects.index))
    families = said_of_families(good, weights, fits)
    certain = [name for name in families if families[name] == "certain"]
    if names:
        reason = f"all models that are not worse than the best have {listing(names)}"
    elif certain:
        reason = f"it is {listing(certain)}, of which kind these motions do not tell"
    elif plain in good:
        reason = "over so few motions the best model is not told from the plain servo"
    else:
        reason = "models with nothing in common are not worse than the best"
    verdict = "effects" if names else "ambiguous"
    return Conclusion(verdict, reason, good[0], tuple(good), weights, names, families)


def nothing_named(
    evidence: Evidence, plain: JointFit, fits: Sequence[JointFit], loose: str
) -> tuple[Verdict, str]:
    """Verdict and reason where no model earns what it has more than the plain one."""
    if white(evidence, plain):
        quiet = "the plain model leaves no more than noise"
        return ("under_excited", loose) if loose else ("no_gap", quiet)
    why = "there is no candidate"
    if others := [fit for fit in fits if fit.effects]:
        best = best_of(evidence, others)
        why = f"the best model, {model_text(best.effects)}: "
        why += not_earned(evidence, plain, best) or flaw(evidence, best) or "not needed"
    if plain.rmse > REPEATABLE * evidence.floor:
        return "unknown", f"a gap that no model explains; {why}"
    if loose:
        return "under_excited", loose
    return "no_gap", f"no effect is significant; {why}"


def recovered(evidence: Evidence, plain: JointFit, fit: JointFit) -> float:
    """Share of the squared gap that a model recovers, of fitted and held-out errors the lesser."""
    before = np.array([plain.rmse, plain.held_out_rmse])
    after = np.array([fit.rmse, fit.held_out_rmse])
    shares = (before**2 - after**2) / np.maximum(before**2 - evidence.floor**2, 1e-30)
    return float(shares.min())


def said_of_families(
    good: Sequence[JointFit], weights: np.ndarray, fits: Sequence[JointFit]
) -> dict[str, Certainty]:
    """What good models say of each family: certain if all have it.

    Likely if those that have it predict so many motions best that as many by chance, as of tossed
    coins, are not to be expected; untold if not, or if a good model imitates it. Excluded if the
    best model was fitted with it and does not earn it.
    """
    motions = len(good[0].count)
    best = {*good[0].effects}
    imitated: set[str] = set()
    for fit in good:
        for name in fit.effects:
            imitated |= families_of(TOGETHER.get(name, ()))
    tried: set[str] = set()
    for fit in fits:
        if best.issubset(fit.effects):
            tried |= families_of({*fit.effects} - best)
    result: dict[str, Certainty] = {}
    for name in FAMILIES:
        having = np.array([name in families_of(fit.effects) for fit in good])
        if having.all():
            result[name] = "certain"
        elif having.any():
            luck = binom.sf(round(weights @ having * motions) - 1, motions, 0.5)
            result[name] = "likely" if luck < 1.0 - CONFIDENCE else "untold"
        elif name in imitated:
            result[name] = "untold"
        elif name in tried:
            result[name] = "excluded"
    return result


def open_sets(good: Sequence[JointFit]) -> list[tuple[str, ...]]:
    """Effects that stand in for each other in the good models, a set each."""
    models: dict[str, set[int]] = {}
    for index, fit in enumerate(good):
        for name in fit.effects:
            models.setdefault(name, set()).add(index)
    loose = [name for name in models if len(models[name]) < len(good)]
    apart = np.zeros((len(loose), len(loose)))
    for i, name in enumerate(loose):
        for j, other in enumerate(loose):
            apart[i, j] = models[name].isdisjoint(models[other])
    count, labels = connected_components(apart)
    sets: list[tuple[str, ...]] = [()] * count
    for name, group in zip(loose, labels, strict=True):
        sets[group] += (name,)
    return sets


def overall(verdicts: Sequence[Verdict]) -> Verdict:
    """The verdict on a recording: the first, in the order of importance, that some joint has."""
    return min(verdicts, key=get_args(Verdict).index, default="no_gap")
