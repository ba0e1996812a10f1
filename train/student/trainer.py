"""The training of the student, the same in all stages: act, learn from what was done, save the policy."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from vd.command.config import to_dict
from vd.policy.bundle import write_policy
from vd.policy.contract import Contract
from vd.train.checkpoint import POLICY_NAME
from vd.train.student.config import StudentTrainCfg
from vd.train.student.made import MadeSequences
from vd.train.student.sequences import (
    Looks,
    Sequences,
    belief_errors,
    flow_loss,
)
from vd.train.student.simulated import SimulatedSequences
from vd.train.supervised import SupervisedLoop
from vd.vision.acting import ActingStudent, StudentPolicy
from vd.vision.inputs import Belief
from vd.vision.student import Student


class StudentTrainer(SupervisedLoop):
    """Trains a student on the looks and sequences of a stage.

    While it acts, batch norms use their running statistics, as they do at work.

    Args:
        acting: The student at work, on the hands of ``source``.
        source: Where sequences come from.
        cfg: Settings.
        contract: What its policy's file says of it.
        device: Torch device.
    """

    kind = "student"
    network: Student

    def __init__(
        self,
        acting: ActingStudent,
        source: MadeSequences | SimulatedSequences,
        cfg: StudentTrainCfg,
        *,
        contract: Contract,
        device: str,
    ) -> None:
        super().__init__(
            acting.network,
            cfg.run,
            cfg.learn,
            measure_every=cfg.clouds.validate_every,
            task=contract.task,
            device=device,
            env=source.env,
        )
        self.acting = acting
        self.source = source
        self.cfg = cfg
        self.contract = contract
        network = acting.network
        self._seeing = [*network.stages.parameters(), *network.flow.parameters()]
        seeing = set(self._seeing)
        self._acting = [weight for weight in network.parameters() if weight not in seeing]
        self.network.half = cfg.learn.precision == "bf16"

    def _samples(self) -> int:
        return self.source.samples

    def _iterate(self) -> dict[str, Any] | None:
        done = self._done()
        self.network.eval()
        if not self.source.collect(self.acting, self._stopping):
            return None
        seen = []
        for looks in self.source.looks(self.acting):
            if self._stopping():
                return None
            seen.append(self.see(looks, done))
        acted = [self.act(sequences, done) for sequences in self.source.sequences()]
        self.network.eval()
        figures = self._figures(seen)
        if acted:
            figures |= self._figures(acted)
        self._share_statistics()
        return figures | self.source.figures()

    def measure(self) -> dict[str, Tensor]:
        """Errors on what is not learned from; empty for none."""
        return self.source.measure(self.acting)

    def see(self, looks: Looks, done: float) -> dict[str, Tensor]:
        """One optimiser step of what sees; its loss and errors."""
        self.network.train()
        look = self.network.look(looks.sight)
        losses = {"flow": flow_loss(look.flow, looks)}
        logged = self._descend(losses, done, self._seeing)
        turn, shift = belief_errors(look.belief, looks.truth)
        logged["learn/rotation_error"] = turn.mean()
        logged["learn/position_error_mm"] = 1e3 * shift.mean()
        return logged

    def act(self, sequences: Sequences, done: float) -> dict[str, Tensor]:
        """One optimiser step of what acts; its loss."""
        self.network.train()
        decision = self.network(sequences.told, sequences.hidden, sequences.done)
        off = sequences.label - decision.action
        return self._descend({"action": off.square().mean()}, done, self._acting)

    def _share_statistics(self) -> None:
        """Average the batch norms' running statistics over the processes."""
        for value in self.network.buffers():
            if value.is_floating_point():
                self._average(value)

    def _shared_state(self) -> dict[str, Any]:
        return super()._shared_state() | {"contract": to_dict(self.contract)}

    def _process_state(self) -> dict[str, Any]:
        state = super()._process_state() | {"source": self.source.state_dict()}
        if self.env is not None:
            state["belief"] = vars(self.acting.belief)
            state["hidden"] = self.acting.hidden
            state["lost"] = self.acting.lost
        return state

    def _restore_process(self, state: dict[str, Any]) -> None:
        super()._restore_process(state)
        self.source.load_state_dict(state["source"])
        if self.env is not None:
            self.acting.belief = Belief(**state["belief"])
            self.acting.hidden = state["hidden"]
            self.acting.lost = state["lost"]

    def close(self) -> None:
        """Free the environments."""
        self.source.close()

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        network = Student(self.network.cfg, self.network.num_actions, self.network.num_tips)
        network.load_state_dict(state["student_state_dict"])
        network.eval().requires_grad_(False)
        contract = replace(self.contract, iterations=self.iteration, env_steps=self.env_steps)
        write_policy(StudentPolicy(network, contract), self.run.out / POLICY_NAME)
