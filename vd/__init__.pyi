from vd.api import (
    ObjectTracker,
    analyse_gap,
    evaluate_policies,
    load_policy,
    observation_layout,
    read,
    write,
)
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set as load_objects
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv

__all__ = [
    "ObjectTracker",
    "ReorientCfg",
    "ReorientEnv",
    "analyse_gap",
    "evaluate_policies",
    "load_hand",
    "load_objects",
    "load_policy",
    "observation_layout",
    "read",
    "write",
]
