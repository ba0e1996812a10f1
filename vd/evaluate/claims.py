"""What the paper says of its evaluations in simulation, and how ours beside it is measured."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from vd.evaluate.result import Row, StoppedBy
from vd.evaluate.statistics import Interval, choose_unit, rate_intervals
from vd.paper import PAPER


@dataclass(frozen=True)
class Claim:
    """A figure of the paper, and how ours beside it is measured."""

    text: str
    """What it is."""
    condition: str
    """Name of the suite's entry."""
    measure: Callable[[Row], Interval | float | None]
    """Takes it from a row; None where it has no meaning."""
    paper: str | None
    """Name of the paper's figure in ``PAPER.results``; None: it gives no number."""
    unit: Literal["share", "rad", "s"] = "share"
    stopped_by: StoppedBy | None = None
    """Whose rule; None: that of each policy."""

    def of(self, rows: Sequence[Row]) -> Interval | float | None:
        """Ours, from the rows of one policy in the condition; None where it has no such figure."""
        for row in rows:
            own = row.headline if self.stopped_by is None else row.stopped_by == self.stopped_by
            if own and not row.ours:
                return self.measure(row)
        return None

    def paper_text(self) -> str:
        """What the paper says: ``96 % (94 to 97)``, ``0.12 to 0.13``, ``below 7``.

        Empty: nothing.
        """
        if self.paper is None:
            return ""
        value: tuple[float, ...] = getattr(PAPER.results, self.paper)
        if self.unit == "share":
            return share_text(*value)
        return f"{value[0]:.2f} to {value[1]:.2f}" if self.unit == "rad" else f"below {value[0]:g}"


def share_text(value: float, *interval: float) -> str:
    """``85 % (82 to 88)``, with a decimal where whole per cents would hide how small it is."""
    digits = 0 if interval and value >= 0.1 else 1
    texts = [f"{100.0 * part:.{digits}f}" for part in (value, *interval)]
    return f"{texts[0]} %" + (f" ({texts[1]} to {texts[2]})" if interval else "")


def lost_at_once(row: Row) -> Interval:
    """Share of episodes that lost the object in the half second after the table went."""
    gone = round(PAPER.scene.air_table_s * row.protocol.control_hz)
    soon = gone + round(0.5 * row.protocol.control_hz)
    return _share(row, [e.fell and gone < e.steps <= soon for e in row.episodes])


def success_without_table(row: Row) -> Interval:
    """Share of episodes that were stopped within the tolerance when the table had gone."""
    gone = round(PAPER.scene.air_table_s * row.protocol.control_hz)
    return _share(row, row.successes.ravel() & [e.steps > gone for e in row.episodes])


def _seen(row: Row, bound: str) -> float | None:
    """Share of the states truly within a bound [rad] that a camera policy predicts within it."""
    return None if row.prediction is None else row.prediction.seen[bound]


def _share(row: Row, chosen: list[bool] | np.ndarray) -> Interval:
    objects = len(row.object_names)
    return rate_intervals(np.reshape(chosen, (1, objects, -1)), choose_unit(objects))[0]


def _claims(name: str, *claims: tuple[Any, ...]) -> list[Claim]:
    """Claims of a condition.

    Their text, measure and figure of the paper, and what else they have.
    """
    return [Claim(text, name, *others) for text, *others in claims]


def _on_table(name: str, key: str) -> list[Claim]:
    """The paper's figures on the table; ``key`` begins their names."""
    return _claims(
        name,
        ("error at most 0.4 rad", lambda row: row.overall.success["0.4"], key),
        ("error at most 0.8 rad", lambda row: row.overall.success["0.8"], f"{key}_rad08"),
        (
            "median error [rad]",
            lambda row: row.overall.median_error_rad,
            f"{key}_median_rad",
            "rad",
        ),
    )


def _in_air(name: str) -> list[Claim]:
    """The paper's figures in the air."""

    def share(outcome: str) -> Callable[[Row], Interval]:
        return lambda row: row.overall.outcomes[outcome]

    claims = []
    for way, key in (("prediction", "prediction"), ("true distance", "truth")):
        claims += _claims(
            name,
            (f"stopped within 0.4 rad by {way}", share("success"), f"air_by_{key}", "share", way),
            (
                f"stopped within 0.1 rad by {way}",
                lambda row: row.precise,
                f"air_by_{key}_rad01",
                "share",
                way,
            ),
        )
    return claims + _claims(
        name,
        ("stopped within 0.4 rad without the table", success_without_table, None),
        ("median time to success [s]", lambda row: row.overall.time_s, "air_time_s", "s"),
        ("object lost", share("object falls"), "air_dropped"),
        ("object lost within 0.5 s of the table", lost_at_once, "air_dropped_at_once"),
        (
            "states within 0.4 rad up to symmetry seen so",
            lambda row: _seen(row, "0.4"),
            "near_seen",
        ),
        (
            "states within 0.1 rad up to symmetry seen so",
            lambda row: _seen(row, "0.1"),
            "near_seen_rad01",
        ),
    )


CLAIMS = (
    *_on_table("training", "table_training"),
    *_on_table("training-points", "table_training"),
    *_on_table("held-out", "table_held_out"),
    *_on_table("held-out-points", "table_held_out"),
    *_in_air("air"),
    *_in_air("air-points"),
)
"""The paper's figures and what we measure beside them, in the order of the conditions."""
