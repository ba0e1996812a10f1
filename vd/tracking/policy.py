"""Policies by camera: a teacher, and how it is let act on what a camera shows.

Tracking policies find the object by its known shape, vision policies by a network that was trained
for it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vd.policy.contract import Contract, Contracted, Kind, TrackingSpec

if TYPE_CHECKING:
    from vd.policy.actor import TrainedPolicy
    from vd.vision.alignment import AlignmentNetwork


@dataclass(frozen=True)
class TrackingPolicy(Contracted):
    """A teacher that acts on a camera's view of an object.

    Its layers have learned nothing for that.

    Attributes:
        teacher: Its layers, critic, and task.
        contract: All else, in ``contract.tracking``.
        alignment: Finds the object by the cloud of its goal; None: it is found by its known shape.
    """

    teacher: "TrainedPolicy"
    contract: Contract
    alignment: "AlignmentNetwork | None" = None

    @property
    def spec(self) -> TrackingSpec:
        """How the teacher is let act."""
        assert self.contract.tracking is not None
        return self.contract.tracking

    @property
    def kind(self) -> Kind:
        """What it is called."""
        return self.contract.kind
