"""The policy that commands take where none is named."""


def default_policy(hand: str, *kinds: str) -> str:
    """Name of the installed policy of a hand, of the first of these kinds that there is.

    Of several of a kind that with the shortest name, which is the one for most objects.

    Args:
        hand: Name or USD of the hand.
        kinds: ``teacher``, ``tracking`` or ``vision``.

    Raises:
        ValueError: The hand has none.
    """
    from vd.assets_usd.hands import root_name
    from vd.policy.store import installed_entries

    entries = installed_entries()
    own = [name for name, entry in entries.items() if entry.hand == root_name(hand)]
    for kind in kinds:
        if names := [name for name in own if entries[name].kind == kind]:
            return min(names, key=len)
    there = f"there are {', '.join(own)}" if own else "vd-policies list shows what there is"
    raise ValueError(
        f"no {' or '.join(kinds)} policy of {hand} is installed ({there}); name a policy, or train "
        "one with vd-train"
    )
