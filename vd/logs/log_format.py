"""Names in the log of a run on a hand (:mod:`vd.logs.hand_log`)."""

LOG_FORMAT = "vd-hand-log/1"
RUN_FILE = "run.json"
STEPS_FILE = "steps.csv"
EVENTS_FILE = "events.jsonl"
RECORDING_FILE = "recording.json"
JOINT_CHANNELS = ("command", "position", "velocity", "current", "temperature", "action", "smoothed")
"""Columns ``channel.joint``: goal sent [rad], measured [rad], [rad/s], [A], [deg C]; the policy's
action, and its moving average as it was before that action."""
STEP_COLUMNS = (
    "goal",
    "acting",
    "distance",
    "late_s",
    "image_s",
    "sensed_s",
    "sent_s",
    "cpu_s",
    "missed",
)
"""Number of the goal; whether the policy acts, or the hand holds still after a stop; distance to
the goal that the stopping rule sees [rad]; how late the step began, and from its due time, the
image's exposure, the state's reading and the sending of goals [s]; processor time of the process
for this step [s]; deadlines missed so far."""
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Position [m] and quaternion."""
TRUTH_COLUMNS = (*map("object.{}".format, POSE), "error")
"""Pose of the object and its angle to the goal, up to symmetry: a twin's only."""

FOUND_COLUMNS = tuple(map("found.{}".format, POSE))
"""Pose of the object as a policy that sees by camera finds it; NaN where none was looked for."""

FINISHED = "finished"
"""Reason of the stop at the end of what was to be done."""
STOPPED = "hand stopped"
"""Event of the hand's stop: ``reason``, and in ``may_be_on`` the motors whose torque may be on, by
ID, each with why."""


class LogError(ValueError):
    """A log that cannot be used; names file and remedy."""
