"""What a preflight finds: one line for each thing that was looked at."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

BAUD_RATE = 1_000_000
"""Of the port, where the options name none."""
NAMED = 3
"""Parts that a finding names; where more are wrong they have a cause in common."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    """What was looked at."""
    ok: bool
    found: str
    """How it is; where it is wrong with the remedy."""


def command(words: str, port: str, baud_rate: int = BAUD_RATE) -> str:
    """A command of vd-deploy for the motors on a port, as a person can enter it."""
    rate = "" if baud_rate == BAUD_RATE else f" --baud-rate {baud_rate}"
    return f"`vd-deploy {words} --port {port}{rate}`"


def listed(parts: Sequence[str]) -> str:
    """The first few parts, and how many more there are."""
    more = f"; and {len(parts) - NAMED} more" if len(parts) > NAMED else ""
    return "; ".join(parts[:NAMED]) + more


def finding(what: str, wrong: Sequence[str], right: str) -> Finding:
    """Whether nothing is wrong, and else what is."""
    return Finding(what, not wrong, listed(wrong) or right)


def show(findings: Iterable[Finding], *, quiet: bool = False) -> list[Finding]:
    """All findings, printed as they come unless ``quiet``."""
    kept = []
    for one in findings:
        kept.append(one)
        if not quiet:
            print(f"{'ok   ' if one.ok else 'WRONG'}  {one.what:<20} {one.found}", flush=True)
    return kept
