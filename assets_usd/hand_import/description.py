"""What a person says about a hand that its URDF or MJCF does not: a small YAML."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from vd.assets_usd.hand_data import HandError, MotorModel
from vd.command.config import from_dict

BUILT_IN = ("leap", "leap_left", "allegro")
"""Hands whose description comes with the package."""


@dataclass(frozen=True)
class Follow:
    """A joint that follows another: ``factor * q + offset_rad``."""

    joint: str
    factor: float = 1.0
    offset_rad: float = 0.0


@dataclass(frozen=True)
class Drive:
    """Drive of a joint; what is not given is the file's, or guessed."""

    kp: float = math.nan
    """Stiffness [N m/rad]."""
    kd: float = math.nan
    """Damping [N m s/rad], in place of the file's."""
    effort: float = math.nan
    """Torque limit [N m]."""
    velocity: float = math.nan
    """Speed limit [rad/s]."""
    armature: float = math.nan
    """Rotor inertia about the axis [kg m^2]."""


@dataclass(frozen=True)
class Mount:
    """Pose of the base in the world: z up, table top at 0."""

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    """xyzw."""


@dataclass(frozen=True)
class Place:
    """Where objects are handled, world frame [m]; what is not given is guessed."""

    drop: tuple[float, float, float] | None = None
    goal: tuple[float, float, float] | None = None
    fall: float | None = None
    size: tuple[float, float] | None = None


@dataclass(frozen=True)
class Description:
    """The YAML. Links and joints are called as in the source."""

    name: str = ""
    """Of the hand; by default the source's."""
    hold: dict[str, float] = field(default_factory=dict)
    """Joints that do not move, and at which angle [rad]."""
    mimic: dict[str, Follow] = field(default_factory=dict)
    """Joints that follow others."""
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Lower and upper limit [rad]."""
    mass: dict[str, float] = field(default_factory=dict)
    """Of links [kg], their inertia with it."""
    drive: Drive = field(default_factory=Drive)
    """Of all joints."""
    drives: dict[str, Drive] = field(default_factory=dict)
    """Of single ones."""
    tips: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """By the link that it is on: a fingertip, in the frame of the link [m]."""
    palm: tuple[float, float, float] | None = None
    """Where the palm looks, in the frame of the root link."""
    mount: Mount | None = None
    start: dict[str, float] = field(default_factory=dict)
    """Start pose [rad]; of joints left out 0, or the limit nearest to it."""
    workspace: Place = field(default_factory=Place)
    motors: dict[str, MotorModel] = field(default_factory=dict)
    friction: float = 0.8
    """Of all surfaces."""


def read_description(name: str | Path | None) -> Description:
    """Read a description: a YAML file, or a built-in one by its name; none is an empty one.

    Raises:
        HandError: It is missing, no YAML, or has a field that there is not; names file and field.
    """
    import yaml

    if name is None:
        return Description()
    path = Path(__file__).parent / f"{name}.yaml" if str(name) in BUILT_IN else Path(name)
    if not path.is_file():
        raise HandError(
            f"--describe {name}: no such file; give a YAML, or one of {', '.join(BUILT_IN)}"
        )
    try:
        values = yaml.safe_load(path.read_text()) or {}
        if not isinstance(values, dict):
            raise ValueError("it has no fields")
        values = {
            key: _named(item) if isinstance(item, dict) else item for key, item in values.items()
        }
        return from_dict(Description, values, where="the description")
    except (yaml.YAMLError, ValueError, TypeError, UnicodeDecodeError) as error:
        raise HandError(f"{path}: {error}") from error


def _named(values: dict) -> dict[str, object]:
    """Names as text: YAML takes LEAP's joints, 0 to 15, for numbers."""
    return {str(key): item for key, item in values.items()}
