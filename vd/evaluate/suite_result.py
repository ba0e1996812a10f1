"""What the suite measured."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from vd.config import to_dict
from vd.evaluate.agents import sees_clouds
from vd.evaluate.comparison import SUCCESS, Comparison
from vd.evaluate.statistics import Interval
from vd.evaluate.suite import CLAIMS, NO_STUDENT, Claim, Condition, Group
from vd.paper import PAPER


@dataclass(frozen=True)
class Objects:
    """The objects of one group.

    Attributes:
        sets: What vd-eval is given: sets, or chosen files of them.
        text: The same for a reader.
        own: Whether they are our procedural ones, since no others were given.
    """

    sets: tuple[str, ...]
    text: str
    own: bool


@dataclass
class SuiteResult:
    """What the suite measured.

    Attributes:
        policies: Names, in order.
        objects: By group.
        conditions: Those that were asked for.
        quick: Whether this is the reduced suite.
        found: Comparison of one policy by the names of condition and policy.
        failed: Why a condition could not be measured, likewise.
        late: Conditions and policies for which there was no time.
    """

    policies: tuple[str, ...]
    objects: dict[Group, Objects]
    conditions: tuple[Condition, ...]
    quick: bool
    found: dict[tuple[str, str], Comparison] = field(default_factory=dict)
    failed: dict[tuple[str, str], str] = field(default_factory=dict)
    late: list[tuple[str, str]] = field(default_factory=list)

    @property
    def students(self) -> tuple[str, ...]:
        """Those of the policies that are students."""
        return tuple(name for name in self.policies if sees_clouds(name))

    @cached_property
    def pictures(self) -> dict[Group, bytes]:
        """PNG with the objects of each group."""
        from vd.assets_usd.objects.sets import load_set
        from vd.assets_usd.objects.sheet import pictures

        return {group: pictures(load_set(list(objects.sets))) for group, objects in self.objects.items()}

    def merged(self, *conditions: str) -> Comparison | None:
        """The comparisons of conditions as one of all policies and groups; None if there is none.

        Without the success criteria of training: the paper's evaluations do not ask for stillness.
        """
        parts = [
            self.found[condition, policy]
            for condition in conditions
            for policy in self.policies
            if (condition, policy) in self.found
        ]
        if not parts:
            return None
        return Comparison(
            rows=tuple(row for part in parts for row in part.rows if row.stopped_by != SUCCESS),
            predictions=tuple(entry for part in parts for entry in part.predictions),
            software=parts[0].software,
        )

    def summary(self) -> dict[str, Any]:
        """The paper's figures beside ours, as JSON."""
        names = {condition.name for condition in self.conditions}
        return {
            "quick": self.quick,
            "objects": {group: to_dict(objects) for group, objects in self.objects.items()},
            "students": list(self.students) or NO_STUDENT,
            "figures": [self._figure(claim) for claim in CLAIMS if claim.condition in names],
            "failed": [
                {"condition": condition, "policy": policy, "why": why}
                for (condition, policy), why in self.failed.items()
            ],
            "out of time": [list(pair) for pair in self.late],
        }

    def _figure(self, claim: Claim) -> dict[str, Any]:
        def value(comparison: Comparison) -> Any:
            found = claim.of(comparison)
            return to_dict(found) if isinstance(found, Interval) else found

        return {
            "figure": claim.text,
            "condition": claim.condition,
            "unit": claim.unit,
            "stopped_by": claim.stopped_by,
            "paper": None if claim.paper is None else list(getattr(PAPER.results, claim.paper)),
            "source": claim.source,
            "ours": {
                policy: value(self.found[claim.condition, policy])
                for policy in self.policies
                if (claim.condition, policy) in self.found
            },
        }
