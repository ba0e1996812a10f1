"""The USB adapter of the motors' line: how long it keeps what the motors answer."""

from collections.abc import Iterator
from pathlib import Path

from vd.deploy.finding import Finding

USB_SERIAL = Path("/sys/bus/usb-serial/devices")
"""Where the kernel tells of adapters of the FTDI kind, the U2D2 among them."""
LATENCY_MS = 1
"""The shortest latency timer. The kernel's 16 ms leave a recording 54 of its 100 samples a second, and a
policy sees every state that much later."""


def adapter_findings(port: str) -> Iterator[Finding]:
    """Whether an adapter passes answers on at once; nothing of one that has no latency timer.

    Args:
        port: Device, or a link to it.
    """
    timer = USB_SERIAL / Path(port).resolve().name / "latency_timer"
    try:
        latency = int(timer.read_text())
    except (OSError, ValueError):
        return
    what, right = "USB latency timer", latency <= LATENCY_MS
    remedy = f", which keeps answers that long: echo {LATENCY_MS} | sudo tee {timer}"
    yield Finding(what, right, f"{latency} ms" + ("" if right else remedy))
