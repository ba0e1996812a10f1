"""A search for what a joint lacks, as its variations see it: with jitter, a weighting, another's effects."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vd.gap.candidates import Call
from vd.gap.explanation import Explanation, Trial
from vd.gap.frictions import Frictions
from vd.gap.jitter import CALLS
from vd.gap.joint_fit import JointFit
from vd.gap.judge import EXPLAINED, MIN_GAIN_FLOORS, MIN_SHARE, REPEATABLE
from vd.gap.telemetry import BEHIND_SENSOR
from vd.gap.verdict import cancelled

WIDE = 15.0
"""Error of a round's best, in noise floors, up to which every start of every candidate is tried: a linear
promise is no guide to where an effect that rings or brakes can be found."""
LOOKS = 2
"""Rounds in which they are: each costs as much as several others."""
UNEARNED = float(np.hypot(1.0, MIN_GAIN_FLOORS))
"""Error, in noise floors, from which down to the floor no further effect can close what it has to."""
COARSE = 0.9
"""Share of an error that a finer time step leaves, at which the search is made with that."""
NEAR = 4.0
"""Error, in noise floors, up to which a model stands for a cause that the table has not."""


@dataclass(kw_only=True)
class Search(Frictions, ABC):
    """A search for one joint, which can be made again with samples weighted, or from another's effects.

    Attributes:
        looks: Rounds in which every start may be tried (:meth:`look_wider`).
        wide: Whether more is tried than the best starts and one effect after the other.
        like: What another joint of the finger certainly lacks: effects, and values by key.
        changing: The same of one whose friction changes over the recording: what comes nearest there.
        jittered: The same of one that has random delays, these among the effects: what is sure beside them.
    """

    looks: int = LOOKS
    wide: bool = True
    like: tuple[tuple[str, ...], Mapping[str, float]] = ((), {})
    changing: tuple[tuple[str, ...], Mapping[str, float]] = ((), {})
    jittered: tuple[tuple[str, ...], Mapping[str, float]] = ((), {})

    @abstractmethod
    def explain(self, baseline: JointFit, start: tuple[JointFit, list[Trial]] | None = None) -> Explanation:
        """Select effects, starting from the fitted baseline.

        Args:
            baseline: The plain model.
            start: A model that leaves noise, and the evidence for it, where a search with a coarser step has
                found one: it is only compared with others.
        """

    def finer(self) -> "Search":
        """The same search with the step at which estimates are finished."""

        def run(calls: list[Call]) -> list[Any]:
            every = [
                (name, options if name in CALLS else {**options, "finer": True}) for name, options in calls
            ]
            return self.run(every)

        return replace(self, run=run, fine=True, looks=LOOKS, without={}, apart={}, added={})

    def finished(self, present: JointFit) -> bool:
        """Whether a model leaves nothing to explain: noise, of no more than its size."""
        return self.no_gap(present) and not self.lack_of_fit(self.refined(present))

    def too_coarse(self, present: JointFit) -> bool:
        """Whether it is the time step of the search that keeps a model from leaving no more than noise."""
        if self.fine or self.behind_jitter or not present.effects:
            return False
        if self.no_gap(present) or self.white(present):
            return False
        if present.rmse > WIDE * self.floor:
            return False
        return self.refined(present).rmse < COARSE * present.rmse

    def a_spring(self, present: JointFit) -> bool:
        """Whether a model is near enough to stand for a cause that the table has not: it is no answer."""
        return present.rmse < NEAR * self.floor and bool(cancelled(present, self.joint, self.rest))

    def noise_only(self, present: JointFit, floors: float = UNEARNED) -> bool:
        """Whether a model leaves noise on what it was fitted to: no other search finds a better one.

        It may be a little more than the floor: at rest the rounding to counts repeats. Beside a gap of some
        sixty noise floors more than that is what no fit is better than: the times of a recording are good to
        0.1 ms, a milliradian where a joint is fast.

        Args:
            present: The model.
            floors: Error up to which it may be noise, in noise floors.
        """
        best = max(floors * self.floor, min(MIN_SHARE * self.whole, REPEATABLE * self.floor))
        if not self.behind_jitter and COARSE * present.rmse > best:
            return False
        refined = self.refined(present)  # without what the time step of the search leaves
        return (self.behind_jitter or refined.rmse < best) and not self.lack_of_fit(refined)

    def whitens(self, before: JointFit, after: JointFit) -> bool:
        """Whether a larger model leaves noise where the smaller leaves structure.

        Such a step is earned however little of the error it removes: two limits of one motor do nearly the
        same, and the smaller model would be refused for what it leaves.
        """
        if after.at_bound or after.rmse > EXPLAINED * self.floor or before.rmse > REPEATABLE * self.floor:
            return False
        if float(np.quantile(self.weights @ (before.sse - after.sse), 0.025)) <= 0.0:
            return False
        return bool(self.lack_of_fit(self.refined(before))) and not self.lack_of_fit(self.refined(after))

    def explained(self, explanation: Explanation) -> Explanation:
        """The explanation with what its names do not say.

        What a member of a set means that telemetry contradicts by its name; and no names where two
        effects are but one that is not in the table.
        """
        alike = cancelled(explanation.final, self.joint, self.rest)
        if alike and explanation.verdict in ("effects", "ambiguous"):
            return replace(explanation, verdict="unknown", reason=alike)
        tied = {name for one in explanation.accepted for name in one.tied}
        notes = [
            f"{name} {BEHIND_SENSOR[name]}" for name in sorted(tied & set(BEHIND_SENSOR) & set(self.vetoes))
        ]
        return replace(explanation, reason="; ".join([explanation.reason, *notes]))
