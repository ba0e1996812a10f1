"""What a preflight finds: one line for each thing that was looked at."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

NAMED = 3
"""Parts that a finding names; where more are wrong they have a cause in common."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    """What was looked at."""
    ok: bool
    words: str
    """How it is; where it is wrong with the remedy."""


def listed(parts: Sequence[str]) -> str:
    """The first few parts, and how many more there are."""
    more = f"; and {len(parts) - NAMED} more" if len(parts) > NAMED else ""
    return "; ".join(parts[:NAMED]) + more


def finding(what: str, wrong: Sequence[str], right: str) -> Finding:
    """Whether nothing is wrong, and else what is."""
    return Finding(what, not wrong, listed(wrong) or right)


def show(findings: Iterable[Finding], *, quiet: bool = False) -> list[Finding]:
    """All findings, printed as they come unless ``quiet``."""
    shown = []
    for finding in findings:
        shown.append(finding)
        if not quiet:
            mark = "ok   " if finding.ok else "WRONG"
            print(f"{mark}  {finding.what:<20} {finding.words}", flush=True)
    return shown
