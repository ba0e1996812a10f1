"""What the recorded motions of an object tell of its contact: friction, restitution, mass, its centre, soft tips.

Nothing is simulated. Each parameter is the slope of a law that is exact for a rigid object, fitted by linear least
squares to every motion that obeys it:

====================  ==========================================================================================
table_friction        a sliding object slows down by mu g: the path along its direction is s0 + v t - mu g t^2 / 2
centre_of_mass        in flight the centre, o(t) + R(t) d, is on a parabola: o = c + v t - g t^2 / 2 - R(t) d
restitution           the point that hits the table leaves it with e times the speed it came with
mass                  while a pushed object slides: impulse of the push = m (change of velocity + mu g time)
tip_compliance        the pusher's rigid part comes nearer by c times the force
====================  ==========================================================================================

The unit of all intervals is the motion, since residuals within one are correlated.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from vd.assets_usd.objects.contact_layer import CONTACT
from vd.assets_usd.objects.model import ObjectModel
from vd.gap.contact_recording import ContactMotion, ContactRecording, Kind
from vd.gap.recording_checks import RecordingError
from vd.gap.result import Verdict

GRAVITY = 9.81
FALSE_NAMES = 0.02
"""Share of recordings without a gap in which any name may be given; split evenly over all numbers."""
OUTLIER = 3.5
"""Residuals beyond this many standard deviations, by the median, are samples that came late."""
FEWEST = 5
"""Samples below which a stretch of a motion is no evidence."""
SMOOTH_S = 0.05
"""Window of the parabola that gives velocities [s]."""
CLEAR_M = 0.003
"""An object is in flight if its lowest point is this far above the table: tracking errors and soft contacts are less."""
SURE_S = 0.1
"""Before an impact a hand has let go for as long: a fall of 5 cm [s]."""
SLIDING = 0.1
"""A slide ends at this share of its top speed, before rest and noise decide the direction; a push begins at it."""
UPRIGHT_RAD = 0.05
"""Tilt within which a sliding object stays: more is tumbling or rolling."""
TURNING = 0.3
"""Speed of an object's rim by turning over its own speed, below which friction acts against its motion: within 2 %."""
FLAT_M = 0.003
"""Points this close to the lowest one hit the table with it."""
FAST_M_S = 1.0
"""Impacts from this speed on tell the restitution: the flight after slower ones is too short."""
CENTRAL = 0.25
"""Share of the object's reach that the middle of what hits the table may be beside the centre of mass."""
IMPACT_S = 0.01
"""Longest impact: a rubber ball on wood takes half."""
PRESSED_N = 0.2
"""Force above which a finger touches: ten times the noise of a cheap load cell."""


@dataclass(frozen=True)
class Rows:
    """Linear equations of one motion for a parameter of P numbers, and for one trend that should not be there.

    Attributes:
        gram: X^T X, shape [P + 1, P + 1].
        gradient: X^T y, shape [P + 1].
    """

    gram: np.ndarray
    gradient: np.ndarray


@dataclass(frozen=True)
class Found:
    """A parameter as the motions tell it; P numbers each, NaN where they do not.

    Attributes:
        name: Key of :data:`vd.assets_usd.objects.contact_layer.CONTACT`.
        verdict: ``effect``: it differs from the object's file; ``no_gap``: it does not; ``unknown``: not told.
        value, low, high: Estimate, and its 95 % interval [P].
        nominal: As the object's file has it [P].
        confidence: That it differs.
        weight: Difference over the half-width from which it is named; at least 1 of an effect.
        motions: Motions that tell it.
        bent: The motions contradict a constant.
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
    bent: bool
    reason: str


@dataclass
class _State:
    """What later parameters take from earlier ones."""

    points: np.ndarray
    table_m: float
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    friction: float = np.nan


def identify_contact(recording: ContactRecording, item: ObjectModel) -> list[Found]:
    """Every parameter of the contact, in the order of :data:`CONTACT`.

    Args:
        recording: The motions.
        item: The object as its file has it.

    Raises:
        RecordingError: Objects do not fall by g along -z: another frame, unit or clock.
    """
    points = np.unique(np.concatenate([vertices for vertices, _ in item.hulls]), axis=0)
    heights = [_lowest(motion, points) for motion in recording.motions]
    state = _State(points, float(np.median([np.percentile(height, 5) for height in heights])))
    _check_gravity(recording, state)

    def equations(kind: Kind, rows: Callable[[ContactMotion, _State], Iterator[Rows]]) -> list[Rows]:
        summed = [_sum(rows(motion, state)) for motion in recording.of(kind)]
        return [each for each in summed if each is not None]

    found = {}
    found["centre_of_mass"] = centre = _judge("centre_of_mass", equations("drop", _flights), item)
    if centre.verdict == "effect":  # impacts need it
        state.centre = centre.value
    found["restitution"] = _judge("restitution", equations("drop", _impacts), item)
    found["table_friction"] = friction = _judge("table_friction", equations("slide", _slides), item)
    # Pushes need the friction; what its error does to the mass widens the mass's interval.
    masses = []
    for value in (0.25 * (friction.high + 3.0 * friction.low), friction.value):
        state.friction = math.nan if friction.bent else float(value[0])
        pushes = equations("push", _pushes)
        masses.append(_estimate(pushes, slice(0, 1))[0])
    found["mass"] = _judge("mass", pushes, item, np.abs(masses[0] - masses[1]))
    found["tip_compliance"] = _judge("tip_compliance", equations("press", _presses), item)
    return [found[name] for name in CONTACT]


def verdict(found: Sequence[Found]) -> Verdict:
    """What the recording says as a whole, in the words of ``vd-gap run``."""
    told = {each.verdict for each in found}
    if "effect" in told:
        return "effects"
    if any(each.bent for each in found):
        return "unknown"
    return "no_gap" if "no_gap" in told else "under_excited"


def by_weight(found: Sequence[Found]) -> list[Found]:
    """The effects, those that stand out most from their intervals first."""
    return sorted((each for each in found if each.verdict == "effect"), key=lambda each: -each.weight)


def _nominal(item: ObjectModel, name: str) -> np.ndarray:
    """A parameter as the object's file has it [P]: what it was identified as before, or what the task assumes."""
    told = {"mass": (item.mass_kg,), "centre_of_mass": item.centre_of_mass}
    identified = item.contact.get(name, (CONTACT[name].nominal,))[0]
    return np.array(told.get(name, identified), dtype=float)


def _judge(name: str, motions: list[Rows], item: ObjectModel, besides: np.ndarray | float = 0.0) -> Found:
    """A parameter's estimate and verdict from the equations of its motions.

    Args:
        name: The parameter.
        motions: Its equations.
        item: The object as its file has it.
        besides: Standard deviation that comes from parameters taken as known.
    """
    parameter, nominal = CONTACT[name], _nominal(item, name)
    size = len(nominal)
    resolution = parameter.resolution * (nominal if parameter.relative else np.ones(size))
    value, deviation = _estimate(motions, slice(0, size))
    deviation = np.hypot(deviation, besides)
    freedom = max(len(motions) - 1, 1)
    # All numbers of all parameters together may give a false name in this share of recordings.
    numbers = sum(len(p.nominal) for p in CONTACT.values())
    level = student.ppf(1.0 - 0.5 * FALSE_NAMES / numbers, freedom)
    gap, least = np.abs(value - nominal), np.maximum(level * deviation, resolution)
    trend, spread = _estimate(motions, slice(0, size + 1))
    bent = bool(abs(trend[-1]) > max(level * spread[-1], resolution.max()))
    told = bool(np.isfinite(deviation).all())
    weight = float((gap / least).max()) if told else 0.0
    if not told:
        verdict, reason = "unknown", f"no motion tells it; {parameter.record}"
    elif bent:
        verdict, reason = "unknown", f"it is no constant: {parameter.trend}"
    elif weight > 1.0:
        verdict, reason = "effect", "the interval excludes what the object's file says"
    elif (least > resolution).any():
        verdict, reason = "unknown", f"the interval is too wide to say; {parameter.record}"
    else:
        verdict, reason = "no_gap", "as the object's file says, as far as can be told"
    confidence = float(1.0 - 2.0 * student.sf((gap / deviation).max(), freedom)) if told else 0.0
    half = student.ppf(0.975, freedom) * deviation
    ends = value - half, value + half
    return Found(name, verdict, value, *ends, nominal, confidence, weight, len(motions), bent, reason)


def _estimate(motions: list[Rows], part: slice) -> tuple[np.ndarray, np.ndarray]:
    """Least squares over all motions, and the jackknife's standard deviation over them; NaN if not determined."""
    size = part.stop
    blank = np.full(size, np.nan)
    if len(motions) < 3:
        return blank, blank
    gram = np.array([rows.gram[part, part] for rows in motions])
    gradient = np.array([rows.gradient[part] for rows in motions])
    try:
        value = np.linalg.solve(gram.sum(0), gradient.sum(0))
        others = np.linalg.solve(gram.sum(0) - gram, (gradient.sum(0) - gradient)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return blank, blank
    count = len(motions)
    return value, np.sqrt((count - 1) / count * ((others - value) ** 2).sum(0))


def _sum(rows: Iterator[Rows]) -> Rows | None:
    """All equations of a motion."""
    every = list(rows)
    return Rows(sum(r.gram for r in every), sum(r.gradient for r in every)) if every else None


def _equations(nuisance: np.ndarray, slopes: np.ndarray, values: np.ndarray) -> Rows:
    """Equations values [T] = nuisance [T, K] a + slopes [T, P + 1] theta, with a taken out and late samples dropped."""
    full = np.hstack([nuisance, slopes])
    left = values - full @ np.linalg.lstsq(full, values, rcond=None)[0]
    kept = np.abs(left) <= OUTLIER * 1.4826 * np.median(np.abs(left)) + 1e-12
    basis = np.linalg.qr(nuisance[kept])[0]
    inner, outer = slopes[kept], values[kept]
    inner = inner - basis @ (basis.T @ inner)
    return Rows(inner.T @ inner, inner.T @ outer)


def _lowest(motion: ContactMotion, points: np.ndarray) -> np.ndarray:
    """Height of the lowest point of the object [T]."""
    down = motion.rotation.inv().apply([0.0, 0.0, 1.0])
    return motion.position[:, 2] + (down @ points.T).min(1)


def _velocity(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Derivative of [T, K] by parabolas through :data:`SMOOTH_S`; samples are resampled evenly before."""
    step = float(np.median(np.diff(time)))
    even = np.arange(time[0], time[-1] + step, step)
    window = max(2 * round(0.5 * SMOOTH_S / step) + 1, 5)
    columns = [
        np.interp(time, even, savgol_filter(np.interp(even, time, v), window, 2, deriv=1, delta=step))
        for v in values.T
    ]
    return np.stack(columns, axis=1)


def _stretches(mask: np.ndarray) -> Iterator[slice]:
    """Runs of true samples, long enough to be evidence."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        if end - first >= FEWEST:
            yield slice(int(first), int(end))


def _in_flight(motion: ContactMotion, state: _State) -> list[slice]:
    """Stretches in which nothing touches the object."""
    clear = _lowest(motion, state.points) > state.table_m + CLEAR_M
    found = list(_stretches(clear))
    if found:
        found[0] = _released(motion, found[0])
    return found


def _released(motion: ContactMotion, part: slice) -> slice:
    """The end of a stretch that a hand begins: as long before the impact as the motion is that of free flight."""
    time, end = motion.time, part.stop
    first = min(max(int(np.searchsorted(time, time[end - 1] - SURE_S)), part.start), end - FEWEST)
    usual = float(np.median(_flight_errors(motion, slice(first, end))))
    while first > part.start:
        longer = max(first - FEWEST, part.start)
        if np.median(_flight_errors(motion, slice(longer, end))[:FEWEST]) > OUTLIER * usual:
            # What the hand did to the last samples is still below noise there.
            return slice(int(np.searchsorted(time, time[first] + 0.5 * SMOOTH_S)), end)
        first = longer
    return slice(first, end)


def _flight_errors(motion: ContactMotion, part: slice) -> np.ndarray:
    """Distances of a stretch from the best parabola of any centre of mass, [T] [m]."""
    time, turn = motion.time[part] - motion.time[part].mean(), motion.rotation[part].as_matrix()
    design = np.zeros((3, len(time), 9))
    for axis in range(3):
        design[axis, :, 2 * axis : 2 * axis + 2] = np.vander(time, 2)
        design[axis, :, 6:] = -turn[:, axis, :]
    values = motion.position[part].T.copy()
    values[2] += 0.5 * GRAVITY * time**2
    found = np.linalg.lstsq(design.reshape(-1, 9), values.reshape(-1), rcond=1e-3)[0]
    return np.linalg.norm(values - design @ found, axis=0)


def _check_gravity(recording: ContactRecording, state: _State) -> None:
    """Refuse drops that do not fall as things do."""
    falls = []
    for motion in recording.of("drop"):
        for part in _in_flight(motion, state):
            time = motion.time[part]
            if time[-1] - time[0] > 3.0 * SMOOTH_S:
                falls.append(-2.0 * np.polyfit(time - time[0], motion.position[part, 2], 2)[0])
    if falls and not 0.8 < np.median(falls) / GRAVITY < 1.25:
        raise RecordingError(
            f"{recording.path}: dropped objects fall with {np.median(falls):.3g} m/s^2, not {GRAVITY}; z of the "
            "table's frame points up, positions are in m, t is in s: correct table_pose or the columns"
        )


def _flights(motion: ContactMotion, state: _State) -> Iterator[Rows]:
    """o - g-term = c + v t - R d, for x, y and z of every flight."""
    for part in _in_flight(motion, state):
        time = motion.time[part] - motion.time[part].mean()
        turn = motion.rotation[part].as_matrix()
        fall = -0.5 * GRAVITY * time**2
        for axis in range(3):
            values = motion.position[part, axis] - (fall if axis == 2 else 0.0)
            slopes = np.hstack([-turn[:, axis, :], np.zeros((len(time), 1))])
            yield _equations(np.vander(time, 2), slopes, values)


def _slides(motion: ContactMotion, state: _State) -> Iterator[Rows]:
    """Path along the direction of a slide = s0 + v t - mu g t^2 / 2; the trend is t^3: friction that changes."""
    velocity = _velocity(motion.time, motion.position[:, :2])
    speed = np.linalg.norm(velocity, axis=1)
    top = int(np.argmax(speed))
    after = np.arange(len(speed)) > top
    fast = after & (motion.time > motion.time[top] + SMOOTH_S) & (speed > SLIDING * speed[top])
    for part in _stretches(fast & _flat_on_table(motion, state)):
        time = motion.time[part] - motion.time[part].mean()
        ahead = velocity[part].mean(0) / np.linalg.norm(velocity[part].mean(0))
        if _turning(motion, part, state) > TURNING * speed[part].mean():
            continue
        duration = time[-1] - time[0]
        slopes = np.stack([-0.5 * GRAVITY * time**2, -0.5 * GRAVITY * time**3 / duration], axis=1)
        yield _equations(np.vander(time, 2), slopes, motion.position[part, :2] @ ahead)
        break  # what moves again was touched


def _flat_on_table(motion: ContactMotion, state: _State) -> np.ndarray:
    """Samples at which the object is on the table and as upright as at the end, [T] bool."""
    final = motion.rotation[-1].inv().apply([0.0, 0.0, 1.0])
    tilt = np.arccos(np.clip(motion.rotation.inv().apply([0.0, 0.0, 1.0]) @ final, -1.0, 1.0))
    return (tilt < UPRIGHT_RAD) & (_lowest(motion, state.points) < state.table_m + CLEAR_M)


def _turning(motion: ContactMotion, part: slice, state: _State) -> float:
    """Mean speed of the object's rim by its turning about the vertical [m/s]."""
    between = (motion.rotation[part][0].inv() * motion.rotation[part][-1]).magnitude()
    reach = float(np.linalg.norm(state.points, axis=1).max())
    return reach * between / (motion.time[part][-1] - motion.time[part][0])


def _impacts(motion: ContactMotion, state: _State) -> Iterator[Rows]:
    """Speed of the touching points after an impact = e times before."""
    flights = _in_flight(motion, state)
    step = float(np.median(np.diff(motion.time)))
    # Of the fastest bounce with too few samples above CLEAR_M; one that is not seen had half that speed.
    unseen = math.sqrt(2.0 * GRAVITY * (CLEAR_M + GRAVITY * (0.5 * FEWEST * step) ** 2 / 2.0))
    for before, after in zip(flights, [*flights[1:], None], strict=True):
        if before.stop == len(motion.time):
            continue
        come, falling, touching = _touch(motion, before, state, None)
        if -falling < FAST_M_S or not _central(motion, before, state, touching):
            continue
        rising = 0.5 * unseen
        if after is not None:
            leave, rising, _ = _touch(motion, after, state, touching)
            if not -0.2 * IMPACT_S < leave - come < IMPACT_S:
                continue  # another point hit the table in between
        row = -falling * np.array([[1.0, 0.0]])
        yield Rows(row.T @ row, row[0] * rising)


def _central(motion: ContactMotion, part: slice, state: _State, touching: np.ndarray) -> bool:
    """Whether the points that touch first lie under the centre of mass: else several hit one after another."""
    arms = motion.rotation[part][-1].apply(state.points - state.centre)
    reach = float(np.linalg.norm(state.points, axis=1).max())
    return bool(np.linalg.norm(arms[touching, :2].mean(0)) < CENTRAL * reach)


def _touch(
    motion: ContactMotion, part: slice, state: _State, touching: np.ndarray | None
) -> tuple[float, float, np.ndarray]:
    """Where a flight, longer than it is, meets the table: at its end, or at its begin for given points.

    Returns:
        When [s]; how fast the points that touch it rise then [m/s]; which points they are, [N] bool.
    """
    ends = touching is None
    time, rotation = motion.time[part], motion.rotation[part]
    edge = time[-1] if ends else time[0]
    centre = motion.position[part] + rotation.apply(state.centre)
    heights = centre[:, 2] + 0.5 * GRAVITY * (time - edge) ** 2
    line = np.polynomial.polynomial.polyfit(time - edge, heights, 1)
    near = np.abs(time - edge) < SMOOTH_S
    base = rotation[-1] if ends else rotation[0]
    turned = (rotation[near] * base.inv()).as_rotvec()
    turn, spin = np.polynomial.polynomial.polyfit(time[near] - edge, turned, 1)
    # The edge is at most as far from the table as an object goes between clear and touched.
    times = np.linspace(-0.5 * SMOOTH_S, 0.5 * SMOOTH_S, 501)
    arms = (Rotation.from_rotvec(turn + times[:, None] * spin) * base).as_matrix() @ (state.points - state.centre).T
    falling = line[0] + line[1] * times - 0.5 * GRAVITY * times**2 - state.table_m
    if touching is None:
        first = int(np.abs(falling + arms[:, 2].min(1)).argmin())
        touching = arms[first, 2] < arms[first, 2].min() + FLAT_M
    at = int(np.abs(falling + arms[:, 2, touching].mean(1)).argmin())
    arm = arms[at][:, touching].mean(1)
    return edge + times[at], line[1] - GRAVITY * times[at] + np.cross(spin, arm)[2], touching


def _pushes(motion: ContactMotion, state: _State) -> Iterator[Rows]:
    """Impulse of a push along the path = m (change of velocity + mu g time) while the object slides."""
    velocity = _velocity(motion.time, motion.position[:, :2])
    speed, pressing = np.linalg.norm(velocity, axis=1), np.linalg.norm(motion.force, axis=1) > PRESSED_N
    sliding = pressing & (speed > 3.0 * SLIDING * speed.max()) & _flat_on_table(motion, state)
    for part in _stretches(sliding):
        time = motion.time[part]
        if time[-1] - time[0] < 2.0 * SMOOTH_S:
            continue
        ahead = velocity[part] / speed[part, None]
        along = (motion.force[part, :2] * ahead).sum(1) + state.friction * motion.force[part, 2]
        push = np.trapezoid(along, time)
        gain = speed[part][-1] - speed[part][0] + state.friction * GRAVITY * (time[-1] - time[0])
        row = np.array([[gain, 0.0]])
        yield Rows(row.T @ row, row[0] * push)


def _presses(motion: ContactMotion, state: _State) -> Iterator[Rows]:
    """Way of the pusher into the object = c times the force; the trend is its square: a tip that stiffens."""
    size = np.linalg.norm(motion.force, axis=1)
    ahead = motion.force[size.argmax()] / size.max()
    force, way = motion.force @ ahead, (motion.pusher - motion.position) @ ahead
    touching = force > PRESSED_N
    if touching.sum() >= FEWEST:
        force, way = force[touching], way[touching]
        slopes = np.stack([force, force * (force / force.max() - 1.0)], axis=1)
        yield _equations(np.ones((len(force), 1)), slopes, way)
