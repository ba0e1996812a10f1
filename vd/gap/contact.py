"""What the recorded motions of an object tell of its contact.

Nothing is simulated. Each parameter is the slope of a law that is exact for a rigid object, fitted
by linear
least squares to every motion that obeys it:

- ``table_friction`` mu: a sliding object slows down by mu g, its path is s0 + v t - mu g t^2 / 2.
- ``centre_of_mass`` d: in flight o(t) + R(t) d is on a parabola, o the object's origin.
- ``restitution`` e: a face that hits the table leaves with e times the speed it came with.
- ``mass`` m: while a pushed object slides, the impulse of the push is m (change of velocity + mu g
  time).
- ``tip_compliance`` c: the rigid part of a pressing finger comes nearer by c times the force.

The unit of all intervals is the motion, since residuals within one are correlated.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.ndimage import find_objects, label
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from vd.assets_usd.objects.contact_layer import CONTACT, contact_of
from vd.assets_usd.objects.model import ObjectModel
from vd.gap.chain import GRAVITY_M_S2
from vd.gap.statistics import SMOOTH_S
from vd.logs.contact_recording import ContactMotion, ContactRecording, Kind
from vd.logs.recording_checks import RecordingError

FALSE_NAMES = 0.02
"""Share of recordings without a gap in which any name may be given; split evenly over all
numbers.
"""
NUMBERS = sum(len(parameter.nominal) for parameter in CONTACT.values())
"""Of all parameters, which together may give a false name in that share of recordings."""
OUTLIER = 3.5
"""Residuals beyond this many standard deviations, by the median, are samples that came late."""
FEWEST = 5
"""Samples below which a stretch of a motion is no evidence; motions: three."""
CLEAR_M = 0.003
"""An object flies if its lowest point is this far above the table, and points this close to the
lowest one hit it with that: more than a tracker errs by [m].
"""
SURE_S = 0.15
"""Before an impact a hand has let go for as long: a fall of 11 cm [s]."""
SLIDING = 0.1
"""Share of the top speed down to which a slide or a push counts: slower, noise decides the direction."""
UPRIGHT_RAD = 0.05
"""Tilt within which a sliding object stays: more is tumbling or rolling."""
TURNING = 0.3
"""Speed of the rim by turning over that of the object below which friction is against the motion,
to 2 %.
"""
PRESSED_N = 0.2
"""Force above which a finger touches: ten times the noise of a cheap load cell."""

Equations = tuple[np.ndarray, np.ndarray]
"""Linear equations of one motion for a parameter of P numbers: X^T X [P, P] and X^T y [P]."""


@dataclass(frozen=True)
class ContactEstimate:
    """A parameter as the motions tell it; P numbers each, NaN where they do not.

    Attributes:
        name: Key of :data:`vd.assets_usd.objects.contact_layer.CONTACT`.
        verdict: ``effect``: other than the object's file says; ``no_gap``: as it says; ``unknown``:
            not told.
        value, low, high: Estimate, and its 95 % interval [P].
        nominal: As the object's file has it [P].
        confidence: That it differs.
        weight: Difference over the half-width from which it is named; more than 1 for an effect.
        motions: Motions that tell it.
        reason: One sentence.
    """

    name: str
    verdict: Literal["effect", "no_gap", "unknown"]
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    nominal: np.ndarray
    confidence: float
    weight: float
    motions: int
    reason: str


@dataclass
class _State:
    """What laws need besides a motion.

    Corners of the object [N, 3], height of the table, earlier parameters.

    A bounce too low to be seen has the share ``unseen`` of the highest such.
    """

    points: np.ndarray
    table_m: float
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    friction: float = math.nan
    unseen: float = 0.5

    @property
    def reach(self) -> float:
        return float(np.linalg.norm(self.points, axis=1).max())


def identify_contact(recording: ContactRecording, item: ObjectModel) -> list[ContactEstimate]:
    """Every parameter of the contact, in the order of :data:`CONTACT`.

    Args:
        recording: The motions.
        item: The object as its file has it.

    Raises:
        RecordingError: Objects do not fall by g along -z: another frame, unit or clock.
    """
    points = np.unique(np.concatenate([vertices for vertices, _ in item.hulls]), axis=0)
    heights = [np.percentile(_lowest(motion, points), 5) for motion in recording.motions]
    state = _State(points, float(np.median(heights)))
    _check_gravity(recording, state)

    def equations(
        kind: Kind, rows: Callable[[ContactMotion, _State], Iterator[Equations]]
    ) -> list[Equations]:
        result = []
        for motion in recording.motions:
            own = list(rows(motion, state)) if motion.kind == kind else []
            if own:
                grams, slopes = zip(*own, strict=True)
                result.append((np.sum(grams, axis=0), np.sum(slopes, axis=0)))
        return result

    centre = _judge("centre_of_mass", equations("drop", _flights), item)
    if centre.verdict == "effect":  # impacts need it
        state.centre = centre.value
    # What is known within bounds only widens an interval by what it does to the estimate.
    state.unseen = 0.0
    least, _ = _estimate(equations("drop", _impacts), 1)
    state.unseen = 1.0
    most, _ = _estimate(equations("drop", _impacts), 1)
    state.unseen = 0.5
    spread = np.abs(most - least) / math.sqrt(12.0)
    restitution = _judge("restitution", equations("drop", _impacts), item, spread)
    friction = _judge("table_friction", equations("slide", _slides), item)
    state.friction = float(friction.low[0])
    least, _ = _estimate(equations("push", _pushes), 1)
    state.friction = float(friction.high[0])
    most, _ = _estimate(equations("push", _pushes), 1)
    state.friction = float(friction.value[0])
    spread = np.abs(most - least) / 4.0
    mass = _judge("mass", equations("push", _pushes), item, spread)
    compliance = _judge("tip_compliance", equations("press", _presses), item)
    found = [friction, restitution, mass, centre, compliance]
    return sorted(found, key=lambda each: [*CONTACT].index(each.name))


def verdict(found: Sequence[ContactEstimate]) -> Literal["effects", "no_gap", "under_excited"]:
    """What the recording says as a whole, in the words of ``vd-gap run``."""
    told = {each.verdict for each in found}
    return "effects" if "effect" in told else "no_gap" if "no_gap" in told else "under_excited"


def by_weight(found: Sequence[ContactEstimate]) -> list[ContactEstimate]:
    """The effects, those that stand out most from their intervals first."""
    effects = [each for each in found if each.verdict == "effect"]
    return sorted(effects, key=lambda each: -each.weight)


def _judge(
    name: str, motions: list[Equations], item: ObjectModel, besides: np.ndarray | float = 0.0
) -> ContactEstimate:
    """A parameter's estimate and verdict.

    ``besides``: deviation from parameters taken as known [P].
    """
    parameter = CONTACT[name]
    nominal = contact_of(item, name)
    resolution = parameter.resolution * (nominal if parameter.relative else np.ones(len(nominal)))
    value, deviation = _estimate(motions, len(nominal))
    deviation = np.hypot(deviation, besides)
    freedom = max(len(motions) - 1, 1)
    half = student.ppf(1.0 - 0.5 * FALSE_NAMES / NUMBERS, freedom) * deviation
    gap = np.abs(value - nominal)
    least = np.maximum(half, resolution)
    told = bool(np.isfinite(deviation).all())
    weight = float((gap / least).max()) if told else 0.0
    says: Literal["effect", "no_gap", "unknown"] = "unknown"
    if not told:
        reason = f"no motion tells it; {parameter.record}"
    elif weight > 1.0:
        says = "effect"
        reason = "the interval excludes what the object's file says"
    elif (half > resolution).any():
        reason = f"the interval is too wide to say; {parameter.record}"
    else:
        says = "no_gap"
        reason = "as the object's file says, as far as can be told"
    confidence = float(1.0 - 2.0 * student.sf((gap / deviation).max(), freedom)) if told else 0.0
    usual = student.ppf(0.975, freedom) * deviation
    ends = value - usual, value + usual
    return ContactEstimate(
        name, says, value, *ends, nominal, confidence, weight, len(motions), reason
    )


def _estimate(motions: list[Equations], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Least squares over all motions, and the jackknife's deviation over them [P].

    NaN if not determined.
    """
    count = len(motions)
    blank = np.full(size, np.nan)
    if count < 3:
        return blank, blank
    gram, slope = map(np.array, zip(*motions, strict=True))
    try:
        value = np.linalg.solve(gram.sum(0), slope.sum(0))
        others = np.linalg.solve(gram.sum(0) - gram, (slope.sum(0) - slope)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return blank, blank
    return value, np.sqrt((count - 1) / count * ((others - value) ** 2).sum(0))


def _equations(nuisance: np.ndarray, slopes: np.ndarray, values: np.ndarray) -> Equations:
    """Of values [T] = nuisance [T, K] a + slopes [T, P] theta.

    A is taken out, late samples are dropped.
    """
    full = np.hstack([nuisance, slopes])
    left = np.abs(values - full @ np.linalg.lstsq(full, values, rcond=None)[0])
    kept = left <= OUTLIER * 1.4826 * np.median(left) + 1e-12
    basis = np.linalg.qr(nuisance[kept])[0]
    inner = slopes[kept] - basis @ (basis.T @ slopes[kept])
    return inner.T @ inner, inner.T @ values[kept]


def _lowest(motion: ContactMotion, points: np.ndarray) -> np.ndarray:
    """Height of the lowest point of the object [T]."""
    return motion.position[:, 2] + (motion.rotation.as_matrix()[:, 2] @ points.T).min(1)


def _step(motion: ContactMotion) -> float:
    """Usual time between two samples [s]."""
    return float(np.median(np.diff(motion.time)))


def _velocity(motion: ContactMotion) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal velocity [T, 2] and its size [T], by parabolas through :data:`SMOOTH_S`."""
    time = motion.time
    step = _step(motion)
    even = np.arange(time[0], time[-1] + step, step)
    window = min(max(2 * round(0.5 * SMOOTH_S / step) + 1, 5), 2 * ((len(even) - 1) // 2) + 1)
    velocity = np.empty((len(time), 2))
    for axis in range(2):
        position = np.interp(even, time, motion.position[:, axis])
        smooth = savgol_filter(position, window, 2, deriv=1, delta=step)
        velocity[:, axis] = np.interp(time, even, smooth)
    return velocity, np.linalg.norm(velocity, axis=1)


def _stretches(mask: np.ndarray) -> Iterator[slice]:
    """Runs of true samples, long enough to be evidence."""
    for (part,) in find_objects(label(mask)[0]):
        if part.stop - part.start >= FEWEST:
            yield part


def _in_flight(motion: ContactMotion, state: _State) -> list[slice]:
    """Stretches in which nothing touches the object."""
    found = list(_stretches(_lowest(motion, state.points) > state.table_m + CLEAR_M))
    if found:
        found[0] = _released(motion, found[0])
    return found


def _released(motion: ContactMotion, part: slice) -> slice:
    """The end of a stretch that a hand begins.

    As long before the impact as the motion is free flight.
    """
    time = motion.time
    end = part.stop
    first = min(max(int(np.searchsorted(time, time[end - 1] - SURE_S)), part.start), end - FEWEST)
    usual = float(np.median(_flight_errors(motion, slice(first, end))))
    while first > part.start:
        longer = max(first - FEWEST, part.start)
        if np.median(_flight_errors(motion, slice(longer, end))[:FEWEST]) > OUTLIER * usual:
            # What the hand did to the first samples is still below noise there.
            return slice(int(np.searchsorted(time, time[first] + SMOOTH_S)), end)
        first = longer
    return slice(first, end)


def _flight_errors(motion: ContactMotion, part: slice) -> np.ndarray:
    """Distances of a stretch from the best parabola of any centre of mass, [T] [m]."""
    time = motion.time[part] - motion.time[part].mean()
    turn = motion.rotation[part].as_matrix()
    design = np.zeros((3, len(time), 9))
    for axis in range(3):
        design[axis, :, 2 * axis : 2 * axis + 2] = np.vander(time, 2)
        design[axis, :, 6:] = -turn[:, axis, :]
    values = motion.position[part].T.copy()
    values[2] += 0.5 * GRAVITY_M_S2 * time**2
    found = np.linalg.lstsq(design.reshape(-1, 9), values.reshape(-1), rcond=1e-3)[0]
    return np.linalg.norm(values - design @ found, axis=0)


def _check_gravity(recording: ContactRecording, state: _State) -> None:
    """Refuse drops that do not fall as things do."""
    falls = []
    for motion in recording.motions:
        if motion.kind != "drop":
            continue
        for part in _in_flight(motion, state):
            time = motion.time[part] - motion.time[part].mean()
            if np.ptp(time) > SURE_S:
                falls.append(-2.0 * np.polyfit(time, motion.position[part, 2], 2)[0])
    if falls and not 0.8 < np.median(falls) / GRAVITY_M_S2 < 1.25:
        raise RecordingError(
            f"{recording.path}: dropped objects fall with {np.median(falls):.3g} m/s^2, not "
            f"{GRAVITY_M_S2}: z of the table's frame points up, positions are in m, t is in s: "
            "correct table_pose or the columns"
        )


def _flights(motion: ContactMotion, state: _State) -> Iterator[Equations]:
    """Of the origin: o + g t^2 / 2 = c + v t - R d, for x, y and z of every flight."""
    for part in _in_flight(motion, state):
        time = motion.time[part] - motion.time[part].mean()
        for axis, fall in enumerate((0.0, 0.0, GRAVITY_M_S2)):
            slopes = -motion.rotation[part].as_matrix()[:, axis, :]
            yield _equations(
                np.vander(time, 2), slopes, motion.position[part, axis] + 0.5 * fall * time**2
            )


def _slides(motion: ContactMotion, state: _State) -> Iterator[Equations]:
    """Path along the direction of a slide = s0 + v t - mu g t^2 / 2."""
    time = motion.time
    velocity, speed = _velocity(motion)
    free = (time > time[speed.argmax()] + SMOOTH_S) & (speed > SLIDING * speed.max())
    for part in _stretches(free & _flat_on_table(motion, state)):
        since = time[part] - time[part].mean()
        turned = (motion.rotation[part][0].inv() * motion.rotation[part][-1]).magnitude()
        if state.reach * turned / np.ptp(since) < TURNING * speed[part].mean():
            ahead = velocity[part].mean(0) / np.linalg.norm(velocity[part].mean(0))
            slopes = -0.5 * GRAVITY_M_S2 * since[:, None] ** 2
            yield _equations(np.vander(since, 2), slopes, motion.position[part, :2] @ ahead)
        return  # what moves again was touched


def _flat_on_table(motion: ContactMotion, state: _State) -> np.ndarray:
    """Samples at which the object is on the table and as upright as at the end, [T] bool."""
    upward = motion.rotation.as_matrix()[:, 2]
    tilt = np.arccos(np.clip(upward @ upward[-1], -1.0, 1.0))
    return (tilt < UPRIGHT_RAD) & (_lowest(motion, state.points) < state.table_m + CLEAR_M)


def _impacts(motion: ContactMotion, state: _State) -> Iterator[Equations]:
    """Speed of the touching points after an impact = e times before.

    Of a face: an edge or a corner hits off the centre, and turns the object instead.
    """
    flights = _in_flight(motion, state)
    # Of the fastest bounce with too few samples above CLEAR_M.
    fall = 0.5 * GRAVITY_M_S2 * (0.5 * FEWEST * _step(motion)) ** 2
    unseen = math.sqrt(2.0 * GRAVITY_M_S2 * (CLEAR_M + fall))
    for before, after in zip(flights, [*flights[1:], None], strict=False):
        if before.stop == len(motion.time):
            return
        falling, touching = _touch(motion, before, state, None)
        if touching.sum() < 3:
            continue
        rising = state.unseen * unseen
        if after is not None:
            rising, _ = _touch(motion, after, state, touching)
        yield np.array([[falling**2]]), np.array([-falling * rising])


def _touch(
    motion: ContactMotion, part: slice, state: _State, touching: np.ndarray | None
) -> tuple[float, np.ndarray]:
    """Where a flight meets the table: at its end, or at its begin for given points [N] bool.

    Returns:
        How fast the points that touch it rise then [m/s]; which points they are, [N] bool.
    """
    time = motion.time[part]
    edge = -1 if touching is None else 0
    since = time - time[edge]
    centre = motion.position[part] + motion.rotation[part].apply(state.centre)
    height, rise = polyfit(since, centre[:, 2] + 0.5 * GRAVITY_M_S2 * since**2, 1)
    near = np.abs(since) < SMOOTH_S
    base = motion.rotation[part][edge]
    turned = (motion.rotation[part][near] * base.inv()).as_rotvec()
    turn, spin = polyfit(since[near], turned, 1)
    times = np.linspace(-0.5 * SMOOTH_S, 0.5 * SMOOTH_S, 501)
    turns = (Rotation.from_rotvec(turn + times[:, None] * spin) * base).as_matrix()
    arms = turns @ (state.points - state.centre).T  # [501, 3, N]
    above = height + rise * times - 0.5 * GRAVITY_M_S2 * times**2 - state.table_m
    if touching is None:
        first = arms[np.abs(above + arms[:, 2].min(1)).argmin(), 2]
        touching = first < first.min() + CLEAR_M
    arms = arms[:, :, touching].mean(2)
    at = np.abs(above + arms[:, 2]).argmin()
    speed = rise - GRAVITY_M_S2 * times[at] + np.cross(spin, arms[at])[2]
    return speed, touching


def _pushes(motion: ContactMotion, state: _State) -> Iterator[Equations]:
    """Impulse of a push along the path = m (change of velocity + mu g time) while the object slides."""
    velocity, speed = _velocity(motion)
    pressing = np.linalg.norm(motion.force, axis=1) > PRESSED_N
    sliding = pressing & (speed > SLIDING * speed.max()) & _flat_on_table(motion, state)
    margin = round(SMOOTH_S / _step(motion))
    for whole in _stretches(sliding):
        # Velocities at the ends are of other motions too.
        part = slice(whole.start + margin, whole.stop - margin)
        time = motion.time[part]
        ahead = velocity[part] / speed[part, None]
        if len(time) >= FEWEST:
            along = (motion.force[part, :2] * ahead).sum(1) + state.friction * motion.force[part, 2]
            gain = speed[part][-1] - speed[part][0] + state.friction * GRAVITY_M_S2 * np.ptp(time)
            yield np.array([[gain**2]]), np.array([gain * np.trapezoid(along, time)])


def _presses(motion: ContactMotion, state: _State) -> Iterator[Equations]:
    """Way of the pusher into the object = c times the force."""
    size = np.linalg.norm(motion.force, axis=1)
    ahead = motion.force[size.argmax()] / size.max()
    force = motion.force @ ahead
    way = (motion.pusher - motion.position) @ ahead
    touching = force > PRESSED_N
    if touching.sum() >= FEWEST:
        yield _equations(np.ones((touching.sum(), 1)), force[touching, None], way[touching])
