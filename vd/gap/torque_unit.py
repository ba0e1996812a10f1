"""The unit of torque of a machine without known masses.

Commands and positions of a bare servo, or of a pendulum whose load is not known, show torques up to one
common factor: the fit holds the stiffness at a nominal value, and everything in N m or kg m^2 follows. Where
the recording tells the stiffness (``servo.kp_nm_rad``) they are turned into N m after the search.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from vd.gap.chain import load_of
from vd.gap.recording import BARE_MODELS, STIFFNESS, Recording
from vd.gap.result import UNITS, Candidate, Estimate, Fit, NamedEffect, Report, parameters_of


def relative_torques(recording: Recording) -> bool:
    """Whether the torques of a report on this recording are in a unit of their own."""
    return _free(recording) and not all(known_stiffness(recording, joint) for joint in recording.joints)


def known_stiffness(recording: Recording, joint: str) -> float | None:
    """Stiffness of a joint's drive at the largest P gain recorded [N m/rad], if the recording tells it."""
    told = recording.servo.get(STIFFNESS)
    value = told.get(joint) if isinstance(told, Mapping) else told
    return None if value is None else float(value)


def in_known_unit(report: Report, recording: Recording) -> Report:
    """The report with torques in N m where the recording tells the stiffness; a second time changes nothing.

    Args:
        report: What was found, with the stiffness that the fit held.
        recording: From what.
    """
    source = replace(report.recording, relative_torques=relative_torques(recording))
    report = replace(report, recording=source)
    if not _free(recording):
        return report
    factors = {}
    for joint, values in report.identified.parameters.items():
        known = known_stiffness(recording, joint)
        if known is not None and "kp" in values:
            factors[joint] = known / values["kp"]
    if not factors:
        return report
    return replace(
        report,
        baseline=_fit(report.baseline, factors),
        identified=_fit(report.identified, factors),
        effects=_effects(report.effects, factors),
        provisional=_effects(report.provisional, factors),
        evidence=tuple(_candidate(row, factors) for row in report.evidence),
    )


def _free(recording: Recording) -> bool:
    """Whether nothing that moves has a known mass."""
    loads = [load_of(trajectory.conditions) for trajectory in recording.trajectories]
    return recording.model == "servo" or (recording.model in BARE_MODELS and not any(loads))


def _scaled(value: float, unit: str, factor: float) -> float:
    """A number of this unit, where torques are ``factor`` times what they were."""
    if unit == "1/(N m)":
        return value / factor
    return value * factor if "N m" in unit or "kg" in unit else value


def _fit(fit: Fit, factors: Mapping[str, float]) -> Fit:
    parameters = {
        joint: {name: _scaled(v, UNITS[name], factors.get(joint, 1.0)) for name, v in values.items()}
        for joint, values in fit.parameters.items()
    }
    return replace(fit, parameters=parameters)


def _effects(effects: Sequence[NamedEffect], factors: Mapping[str, float]) -> tuple[NamedEffect, ...]:
    """Effects in the unit of their joints; apart where joints that shared a torque have different ones."""
    result = []
    for effect in effects:
        units = {joint: factors.get(joint, 1.0) for joint in effect.joints}
        shared = len(set(units.values())) == 1 or all(
            _scaled(1.0, one.unit, 2.0) == 1.0 for one in effect.parameters.values()
        )
        for joints in [effect.joints] if shared else [(joint,) for joint in effect.joints]:
            factor = units[joints[0]]
            parameters = {name: _estimate(one, factor) for name, one in effect.parameters.items()}
            result.append(replace(effect, joints=joints, parameters=parameters))
    return tuple(result)


def _estimate(one: Estimate, factor: float) -> Estimate:
    low, high = (_scaled(bound, one.unit, factor) for bound in one.ci95)
    return replace(one, value=_scaled(one.value, one.unit, factor), ci95=(low, high))


def _candidate(row: Candidate, factors: Mapping[str, float]) -> Candidate:
    factor = factors.get(row.joints[0], 1.0) if row.joints else 1.0
    known = parameters_of(row.name)
    values = {key: _scaled(v, known[key].unit, factor) for key, v in row.parameters.items()}
    return replace(row, parameters=values)
