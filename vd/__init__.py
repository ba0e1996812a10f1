"""Core of Visual Dexterity on Newton: simulation, task, evaluation, viewing and benchmarks.

What programs build on are the names of ``__all__``; each is loaded where it is first used.
"""

from importlib import import_module
from typing import Any

_PLACES = {
    "load_hand": "vd.assets_usd.hands:load_hand",
    "load_objects": "vd.assets_usd.objects.sets:load_set",
    "ReorientCfg": "vd.envs.cfg:ReorientCfg",
    "ReorientEnv": "vd.envs.reorient:ReorientEnv",
    "load_policy": "vd.api:load_policy",
    "evaluate_policies": "vd.api:evaluate_policies",
    "observation_layout": "vd.api:observation_layout",
    "ObjectTracker": "vd.api:ObjectTracker",
    "analyse_gap": "vd.api:analyse_gap",
    "read": "vd.api:read",
    "write": "vd.api:write",
}
"""Where each stable name is."""
__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'vd' has no attribute {name!r}; it has {', '.join(_PLACES)}")
    module, _, attribute = _PLACES[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
