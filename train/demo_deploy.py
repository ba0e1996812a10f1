"""The demo's hands: the installed teachers fly twins through the motors' own protocol, and what that took."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from vd.files import write_json
from vd.hand_log import HandLog, LogError, read_log
from vd.page import Page
from vd.train.demo_stages import TimeUp

HANDS = ("dclaw3", "dclaw4")
"""Both at once: two loops and two simulated hands on one machine."""
GOALS, GOAL_ANGLE_RAD = 2, 1.2
"""Goals of each hand, each within this angle of the one before."""
MISSES = 12
"""Deadlines missed in a row at which a hand stops: a second, since the demo's machine may do other things."""
LEAST_FLIGHT_MIN = 1.0
"""Least time for both [min]; two cores take 40 to 60 s."""
NOT_FLOWN = "did not fly: preflight found the machine too busy, or a motor did not answer in time"
DRIVER = "dynamixel_sdk"
"""Without the driver of the motors there is nothing to fly."""


def deploy_log(folder: Path, hand: str) -> Path:
    """Log of a hand's flight."""
    return folder / f"twin-{hand}"


def deploy_video(folder: Path, hand: str) -> Path:
    """Video of it."""
    return folder / f"twin-{hand}.mp4"


def deploy_files(folder: Path) -> list[Path]:
    """What the stage leaves: the exit status of each hand's flight."""
    return [folder / "twins.json"]


def deploy_commands(folder: Path, seed: int) -> list[list[str]]:
    """``vd-deploy`` for each hand: command and arguments."""
    return [
        [
            "vd-deploy",
            *("--hand", hand, "--twin", "--log", str(deploy_log(folder, hand))),
            *("--random-goals", str(GOALS), "--max-goal-angle", str(GOAL_ANGLE_RAD)),
            *("--safety.misses", str(MISSES), "--seed", str(seed)),
        ]
        for hand in HANDS
    ]


def replay_command(folder: Path, hand: str) -> list[str]:
    """``vd-play`` of a log into a video."""
    return ["vd-play", str(deploy_log(folder, hand)), "--video", str(deploy_video(folder, hand))]


def fly_twins(folder: Path, seed: int, *, minutes: float) -> None:
    """Fly both hands, then draw both videos.

    Args:
        folder: The demo's folder.
        seed: Of the goals.
        minutes: Time there is.

    Raises:
        TimeUp: There is less than LEAST_FLIGHT_MIN.
        RuntimeError: The driver of the motors is missing, or a video could not be drawn.
    """
    if minutes < LEAST_FLIGHT_MIN:
        raise TimeUp
    if find_spec(DRIVER) is None:
        raise RuntimeError(f"{DRIVER} is not installed: pip install -e '.[hardware]'")
    for hand in HANDS:  # of a call before this one that was ended
        shutil.rmtree(deploy_log(folder, hand), ignore_errors=True)
    statuses = _together(deploy_commands(folder, seed))
    replays = [replay_command(folder, hand) for hand, log in read_flights(folder).items() if log]
    if any(_together(replays)):
        raise RuntimeError("vd-play failed; the reason is above")
    write_json(deploy_files(folder)[0], dict(zip(HANDS, statuses, strict=True)))


def read_flights(folder: Path) -> dict[str, HandLog | None]:
    """Logs by hand; None where a hand made no step."""
    flights: dict[str, HandLog | None] = {}
    for hand in HANDS:
        try:
            flights[hand] = read_log(deploy_log(folder, hand))
        except LogError:
            flights[hand] = None
    return flights


def _together(commands: Sequence[Sequence[str]]) -> list[int]:
    """Run commands side by side, which end with this stage; their exit statuses."""
    modules = {"vd-deploy": "vd.deploy.cli", "vd-play": "vd.play.cli"}
    running = [
        subprocess.Popen([sys.executable, "-m", modules[name], *arguments]) for name, *arguments in commands
    ]
    try:
        return [process.wait() for process in running]
    finally:
        for process in running:
            if process.poll() is None:
                process.terminate()
                process.wait()


def add_deploy(page: Page, folder: Path) -> None:
    """Add the flights to the demo's page."""
    flights = read_flights(folder)
    page.section("On hands behind their motors")
    page.text(
        "vd-deploy flies a policy on a real hand. There is none here, so the far end is a twin: a process "
        "with simulated motors on a serial line, which answer the protocol of the real ones, in front of the "
        "hand, the table and a cube in Newton, in real time. Everything else is as on a robot: the driver of "
        "the motors, preflight, limits, 12 Hz by the clock. The policies are the installed teachers, which "
        "read the twin's true state; no real hand tells that, so on one a student has to see."
    )
    rows = [(hand, *(_row(log) if log else ("0", *[""] * 4, NOT_FLOWN))) for hand, log in flights.items()]
    header = ["hand", "control steps", "deadlines missed", "goals sent after [ms]", "99 %", "most", "goals"]
    page.table(header, rows, words=[6])
    page.text(
        "Both hands flew at the same time on this machine. A step's goals have to be sent within 83 ms of "
        "the time at which it was due.",
        small=True,
    )
    for hand, log in flights.items():
        if log is None:
            continue
        page.video(
            deploy_video(folder, hand),
            f"{hand}, drawn from the log of its motors by vd-play; the cube's pose is the twin's. The bars "
            "are the loop's time and lateness, and the largest current and speed of a joint.",
        )


def _row(log: HandLog) -> tuple[str, ...]:
    """Steps, misses, loop times and outcomes of a flight."""
    sent = sorted(1e3 * value for value in log.columns["sent_s"])
    middle, high = (sent[min(len(sent) - 1, int(share * len(sent)))] for share in (0.5, 0.99))
    outcomes = [stop.outcome for stop in log.stops]
    end = log.run.get("end", {}).get("reason", "")
    words = ", ".join(outcomes) if outcomes else end
    missed = f"{log.columns['missed'][-1]:.0f}"
    return str(len(sent)), missed, f"{middle:.1f}", f"{high:.1f}", f"{sent[-1]:.1f}", words
