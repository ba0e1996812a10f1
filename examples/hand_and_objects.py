"""Load a hand and objects, and look at what their USD files say."""

import vd

hand = vd.load_hand("dclaw3")
print(f"{hand.name}: {hand.num_fingers} fingers, joints {', '.join(hand.joint_names)}")
print(
    "limits [rad]:",
    [f"{low:.2f} to {high:.2f}" for low, high in zip(hand.lower, hand.upper, strict=True)],
)

for item in vd.load_objects(["cube", "cuboid"]):
    print(
        f"{item.name}: {len(item.vertices)} vertices, {len(item.symmetry)} rotations that look "
        f"alike"
    )
