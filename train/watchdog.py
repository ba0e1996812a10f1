"""Says which process a run of several waits for, before the wait ends in an error that does not.

The processes of a run meet in every update. One that hangs elsewhere makes all others wait; after their limit
of time they fail, but with an error that names a collective, not a process. So each tells the others through
their store, from a thread of its own, where its main thread is, and reads the same of them when nothing has
gone on for long.
"""

import json
import sys
import threading
import time
from types import FrameType
from typing import Any

REPORT_AFTER_S = 90.0
"""An iteration that takes this long is reported, before the others' wait in a collective ends."""
PUBLISH_EVERY_S = 5.0
"""Between two messages of a process [s]."""
COLLECTIVES = "torch.distributed"
"""A main thread inside of this package waits for the others."""
REMEDY = (
    "The run ends when a wait reaches its limit. That process's own output has its stack. Go on with "
    "--resume auto; `torchrun --max-restarts 3 ... --resume auto` does so by itself."
)


class Watchdog:
    """A thread that publishes where this process is and reports what the others wait for.

    Args:
        store: Key-value store of the run; used by the thread alone, so give it a connection of its own.
        rank: Number of this process.
        world_size: Processes of the run.
    """

    def __init__(self, store: Any, rank: int, world_size: int):
        """Start watching."""
        self._store, self.rank, self.world_size = store, rank, world_size
        self._main = threading.main_thread().ident
        self._sent, self._beats, self._last, self._reported = 0, 0, time.monotonic(), False
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """An iteration begins."""
        self._beats += 1
        self._last, self._reported = time.monotonic(), False

    def stop(self) -> None:
        """Watch no longer."""
        self._end.set()

    def _run(self) -> None:
        try:
            while not self._end.wait(PUBLISH_EVERY_S):
                self._publish()
                if time.monotonic() - self._last > REPORT_AFTER_S and not self._reported and self._beats:
                    self._reported = True
                    print(self._report(), file=sys.stderr, flush=True)
        except Exception as error:  # the store ends with the process that holds it
            if not self._end.is_set():
                print(
                    f"vd-train: process {self.rank} no longer hears of the others: {error}", file=sys.stderr
                )

    def _publish(self) -> None:
        self._sent += 1
        self._store.set(f"watch/{self.rank}", json.dumps([self._sent, self._beats, *self._place()]))

    def _place(self) -> tuple[bool, str]:
        """Whether the main thread waits for others, and its innermost line of ours."""
        frame: FrameType | None = sys._current_frames().get(self._main or 0)
        waits, place = False, ""
        while frame is not None:
            module = frame.f_globals.get("__name__", "")
            waits = waits or module.startswith(COLLECTIVES)
            if not place and (module.startswith("vd.") or module == "__main__"):
                place = f"{module}:{frame.f_lineno} in {frame.f_code.co_name}"
            frame = frame.f_back
        return waits, place

    def _read(self) -> dict[int, list[Any]]:
        """The last message of every process that sent one."""
        keys = {rank: f"watch/{rank}" for rank in range(self.world_size)}
        return {
            rank: json.loads(self._store.get(key)) for rank, key in keys.items() if self._store.check([key])
        }

    def _report(self) -> str:
        before = self._read()
        # Twice the interval: whoever is alive has sent another message by then.
        deadline = time.monotonic() + 2.0 * PUBLISH_EVERY_S
        while time.monotonic() < deadline and not self._end.wait(PUBLISH_EVERY_S):
            self._publish()
        after = self._read()
        silent = [r for r in range(self.world_size) if after.get(r, [0])[0] == before.get(r, [0])[0]]
        head = f"vd-train: process {self.rank}: iteration {self._beats} has taken {REPORT_AFTER_S:.0f} s."
        lines = [f"{head} {verdict(after, silent, self.world_size)}"]
        for rank in range(self.world_size):
            if rank in silent:
                lines.append(f"  process {rank}: silent; stopped, or stuck in native code")
            else:
                _, beats, waits, place = after[rank]
                what = "waits for others" if waits else "is busy"
                lines.append(f"  process {rank}: iteration {beats}, {what} at {place or 'an unknown line'}")
        return "\n".join([*lines, REMEDY])


def verdict(messages: dict[int, list[Any]], silent: list[int], world_size: int) -> str:
    """Which processes hold the run up, in words.

    Args:
        messages: Number of the message, iterations begun, whether it waits, and its line, of each process.
        silent: Processes that send nothing.
        world_size: Processes of the run.
    """
    if silent:
        return f"Process {_listed(silent)} does not answer: the others wait for it."
    waiting = [rank for rank in range(world_size) if messages[rank][2]]
    busy = [rank for rank in range(world_size) if not messages[rank][2]]
    if waiting and busy:
        return f"Process {_listed(busy)} does something else while the others wait for it."
    # On a GPU a wait shows as a wait for the device. Then the line is what tells one from the others.
    places = [messages[rank][3] for rank in range(world_size)]
    alone = [rank for rank, place in enumerate(places) if places.count(place) == 1]
    if world_size > 2 and len(alone) == 1:
        return f"Process {alone[0]} is elsewhere than all others."
    return "Nothing tells which process the others wait for."


def _listed(ranks: list[int]) -> str:
    return ", ".join(map(str, ranks))
