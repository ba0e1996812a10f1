"""``vd-gap convert``: what other programs recorded, as a recording that ``vd-gap run`` reads."""

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from vd.logs.motions import Recording, Trajectory
from vd.logs.readers import FORMATS, ReaderOptions, SourceMotion, format_of
from vd.logs.recording_checks import MIN_SAMPLES, RecordingError

REQUIRED = ("command", "position")


@dataclass(frozen=True)
class Convert:
    """Write a recording from a LeRobot dataset, a ROS bag or MCAP, BAM's logs, or CSV files with units.

    An episode, bag or file becomes one motion. Nothing is guessed: what a file does not say, a flag
    says.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Dataset, bag, file, or folder of files."""
    out: Path
    """Folder of the recording to write."""
    counts_per_turn: int
    """Encoder counts a turn: 4096 of Dynamixel X and STS3215."""
    format: Literal["csv", "bam", "lerobot", "ros"] | None = None
    """Format of SOURCE; found by its name where left out."""
    model: str | None = None
    """servo, pendulum, or the hand whose joints these are; by default servo, of BAM's logs
    pendulum.
    """
    unit: Literal["rad", "deg"] | None = None
    """Unit of angles where the file has none, as in LeRobot datasets."""
    joints: tuple[str, ...] = ()
    """Joints to take; all by default."""
    rename: tuple[str, ...] = ()
    """OLD=NEW: columns of a CSV ('elbow angle=position.elbow [deg]'), or joints."""
    drop: tuple[
        Literal["velocity", "current", "pwm", "voltage", "temperature", "enabled"], ...
    ] = ()
    """Telemetry to leave out, such as a velocity of unknown unit."""
    state_topic: str | None = None
    """ROS topic of the measured joints, where there is more than one JointState."""
    command_topic: str | None = None
    """ROS topic of the commands."""

    def run(self) -> int:
        """Read, check and write."""
        recording = convert(self)
        seconds = sum(t.time[-1] for t in recording.trajectories)
        names = ", ".join(recording.joints)
        print(f"{self.out}: {len(recording.trajectories)} motions of {names}, {seconds:.1f} s")
        return 0


def convert(asked: Convert) -> Recording:
    """Write the recording, once it passes the checks of :func:`vd.logs.recording.read_recording`.

    Raises:
        RecordingError: The source cannot be used; names file, column and remedy.
        ValueError: A flag cannot be used, or the folder holds a recording.
        ModuleNotFoundError: The reader's library is not installed.
    """
    from vd.logs.recording import read_recording, write_recording

    if asked.counts_per_turn < 1:
        raise ValueError(
            f"--counts-per-turn is {asked.counts_per_turn}; give the encoder's, such as 4096"
        )
    if (asked.out / "recording.json").exists():
        raise ValueError(f"--out {asked.out} holds a recording; name another folder")
    rename = {}
    for pair in asked.rename:
        old, mark, rename[old] = pair.partition("=")
        if not mark:
            raise ValueError(f"--rename {pair!r} is no OLD=NEW")
    format = asked.format or format_of(asked.source)
    if format != "ros" and (topic := asked.state_topic or asked.command_topic):
        raise ValueError(
            f"topic {topic}: {asked.source} is read as {format}, which has no topics; leave it out"
        )
    options = ReaderOptions(
        asked.unit, rename, asked.state_topic, asked.command_topic, asked.joints
    )
    motions = list(FORMATS[format](asked.source, options))
    if unused := sorted(rename.keys() - options.used):
        raise ValueError(
            f"--rename {unused[0]}={rename[unused[0]]}: {asked.source} has no {unused[0]!r}"
        )
    joints = asked.joints or motions[0].joints
    resolution = 2.0 * math.pi / asked.counts_per_turn
    trajectories = []
    for motion in motions:
        trajectory = _trajectory(asked, motion, joints, MIN_SAMPLES * resolution)
        if (asked.out / trajectory.file).exists():
            raise ValueError(
                f"--out {asked.out} holds {trajectory.file}, which would be lost; "
                "name another folder"
            )
        trajectories.append(trajectory)
    model = asked.model or ("pendulum" if format == "bam" else "servo")
    with TemporaryDirectory() as work:
        made = Recording(Path(work), model, joints, {}, resolution, tuple(trajectories))
        write_recording(made, work)
        try:
            recording = read_recording(work)  # every check
        except RecordingError as error:
            raise RecordingError(str(error).replace(work, f"{asked.source}, converted")) from error
    write_recording(recording, asked.out)
    return recording


def _trajectory(
    asked: Convert, motion: SourceMotion, joints: tuple[str, ...], moved_rad: float
) -> Trajectory:
    """A motion with the wanted joints in their order."""
    where = f"{asked.source}: {motion.name}"
    for joint in joints:
        if joint not in motion.joints:
            there = ", ".join(motion.joints)
            raise RecordingError(f"{where}: no joint {joint!r}; there are {there}")
    picked = [*map(motion.joints.index, joints)]
    channels: dict[str, Any] = {}
    for name, values in motion.channels.items():
        if name not in asked.drop and not np.isnan(values[:, picked]).all():
            channels[name] = values[:, picked]
    for name in REQUIRED:
        bad = joints if name not in channels else [joints[j] for j in _with_gaps(channels[name])]
        if len(bad):
            raise RecordingError(
                f"{where}: {name} of {', '.join(bad)} has gaps; choose others by --joints"
            )
    enabled = channels.pop("enabled", np.ones_like(channels["position"])) > 0.5
    excited = np.ptp(channels["command"], axis=0) > moved_rad
    begun = motion.time[0] if len(motion.time) else 0.0
    return Trajectory(
        file=f"{motion.name}.csv",
        excitation=motion.kind or motion.name,
        joints=tuple(joint for joint, on in zip(joints, excited, strict=True) if on) or joints,
        conditions=dict(motion.conditions),
        time=motion.time - begun,
        command_time=None if motion.command_time is None else motion.command_time - begun,
        enabled=enabled,
        **channels,
    )


def _with_gaps(values: np.ndarray) -> np.ndarray:
    """Joints whose values [T, J] are not all finite."""
    return np.flatnonzero(~np.isfinite(values).all(axis=0))
