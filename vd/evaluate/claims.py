"""What stands beside the paper's figures: measures of a row, by name."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vd.evaluate.result import Row
from vd.evaluate.statistics import Interval, rate_intervals
from vd.evaluate.suite import Claim
from vd.paper import PAPER


def claimed(claim: Claim, rows: Sequence[Row]) -> Any:
    """Our figure, from the rows of one policy in an evaluation; None where it has none."""
    for row in rows:
        if row.stopped_by == claim.stopped_by or (claim.stopped_by is None and row.headline):
            return measured(row, claim.measure)
    return None


def measured(row: Row, measure: str) -> Any:
    """A measure of a row: fields and keys with ``/`` between, or a name of ``OF_EPISODES``.

    None where it has no meaning.
    """
    if measure in OF_EPISODES:
        return OF_EPISODES[measure](row)
    value: Any = row
    for name in measure.split("/"):
        value = value.get(name) if isinstance(value, dict) else getattr(value, name, None)
    return value


def lost_at_once(row: Row) -> Interval:
    """Share of episodes that lost the object in the half second after the table went."""
    table_step = round(PAPER.scene.air_table_s * row.protocol.control_hz)
    soon = table_step + round(0.5 * row.protocol.control_hz)
    return _share(row, [e.fell and table_step < e.steps <= soon for e in row.episodes])


def success_without_table(row: Row) -> Interval:
    """Share of episodes that were stopped within the tolerance when the table had gone."""
    table_step = round(PAPER.scene.air_table_s * row.protocol.control_hz)
    without_table = np.array([e.steps > table_step for e in row.episodes])
    return _share(row, row.successes.ravel() & without_table)


def _share(row: Row, chosen: list[bool] | np.ndarray) -> Interval:
    return rate_intervals(np.reshape(chosen, (1, len(row.object_names), -1)))[0]


OF_EPISODES = {"lost_at_once": lost_at_once, "success_without_table": success_without_table}
"""Measures that look at each episode."""
