"""Where a known shape is, from points seen of it.

Poses are fitted, many at once, and the best kept.

A shape is a grid of distances to its surface, so that a point costs one look-up whatever the shape
is. Each pose is improved by steps of Gauss and Newton on the distances of the seen points, of which
far ones count less. How badly it fits is the mean square of two lengths, both cut off at ``far``:
how far the seen points are from the shape, and how far the shape stands out before what a camera
saw.

Frames: *base* is that of the points and poses, *object* that of the samples. Metres, quaternions
xyzw. N worlds, P seen points at most, O shapes of S samples, grids of E^3 distances; M rows, each
of one world, with C poses each.
"""

import warp as wp

from vd.kernels.sensor.shape_grids import Shapes, surface_distance

wp.set_module_options({"enable_backward": False})

LEVER_M = wp.constant(0.03)
"""Turns weigh against shifts as at this distance from the centre, about the size of an object."""
DAMPING = wp.constant(0.01)
"""Curvature added to each direction, of one: what the points do not fix stays where it is."""
LARGEST_TURN = wp.constant(0.5)
"""Largest turn of one step [rad]."""
SETTLED_M = wp.constant(5.0e-5)
"""A step that shifts a pose by less than this [m] (ours, far below what is seen) ..."""
SETTLED_RAD = wp.constant(1.0e-3)
"""... and turns it by less than this [rad] is the last one (ours)."""
SMALL = wp.constant(1.0e-7)
"""Lengths and angles below this have no direction."""
NEVER = wp.constant(1.0e9)
"""Misfit of a pose that is not to be taken."""


@wp.struct
class Eye:
    """A camera and what it can tell."""

    focal: wp.vec2  # focal lengths [pixel]
    centre: wp.vec2  # principal point, from the top left corner of the image [pixel]
    pose: wp.transform  # optical frame in the base frame
    cell: float  # side of a cell of the image [pixel]
    margin: float  # what is nearer than all that was seen in its cell by less than this may be there [m]


@wp.func
def cell_of(eye: Eye, seen: wp.vec3):
    """Row and column of the cell that shows a point of the optical frame."""
    column = wp.floor((eye.focal[0] * seen[0] / seen[2] + eye.centre[0]) / eye.cell)
    row = wp.floor((eye.focal[1] * seen[1] / seen[2] + eye.centre[1]) / eye.cell)
    return int(row), int(column)


@wp.kernel
def nearness_kernel(
    # Model:
    eye: Eye,  # the camera
    # In:
    points_in: wp.array2d[wp.vec3],  # [N, K] what it saw, base frame [m], NaN for none
    # In/Out:
    nearness: wp.array3d[float],  # [N, Y, X] one over depth [1/m], zeros before; 0: nothing seen
):
    """How near the nearest is that was seen in each cell of the image. Launch: [N, K]."""
    world, k = wp.tid()
    place = wp.transform_point(wp.transform_inverse(eye.pose), points_in[world, k])
    if place[2] > 0.0:  # not so of NaN
        row, column = cell_of(eye, place)
        if row >= 0 and row < nearness.shape[1] and column >= 0 and column < nearness.shape[2]:
            wp.atomic_max(nearness, world, row, column, 1.0 / place[2])


@wp.func
def standing_out(
    eye: Eye, place: wp.vec3, world: int, nearness: wp.array3d[float], far: float
) -> float:
    """How far a point of the base frame lies before all that was seen in its cell [m], at most ``far``.

    Where nothing was seen, not even the hand, there is nothing for a long way. Beyond the image all
    may be.
    """
    seen = wp.transform_point(wp.transform_inverse(eye.pose), place)
    row, column = cell_of(eye, seen)
    if row < 0 or row >= nearness.shape[1] or column < 0 or column >= nearness.shape[2]:
        return 0.0
    near = nearness[world, row, column]
    if near == 0.0:
        return far
    return wp.clamp(1.0 / near - eye.margin - seen[2], 0.0, far)


@wp.kernel
def place_poses_kernel(
    # Model:
    shapes: Shapes,  # the shapes
    eye: Eye,  # the camera
    rendered: int,  # 1 where a camera saw the points, 0 where they are of all sides
    every: int,  # look at every so many-th sample
    # In:
    world_in: wp.array[int],  # [M] world of each row; a row of -1 is left out
    turn_in: wp.array2d[wp.quat],  # [M, C] rotations
    misfit_in: wp.array2d[float],  # [M, C] NEVER where nothing is to be done
    seen_in: wp.array2d[wp.vec3],  # [N, P] points seen of the object, base frame [m]
    count_in: wp.array[int],  # [N] how many there are
    # Out:
    pose_out: wp.array2d[wp.transform],  # [M, C] object frame in the base frame
):
    """Place the shape in given rotations, what would be seen of it where points are.

    Launch: [M, C].

    The mean of the samples that lie nearer to the camera than their mean, of all without a camera,
    comes to the mean of the seen points.
    """
    row, c = wp.tid()
    world = world_in[row]
    if world < 0 or misfit_in[row, c] >= NEVER:
        return
    turn = turn_in[row, c]
    shape = shapes.world_shape[world]
    middle = wp.vec3()
    for i in range(count_in[world]):
        middle += seen_in[world, i]
    middle = middle / wp.max(float(count_in[world]), 1.0)
    whole = wp.vec3()
    for i in range(0, shapes.samples.shape[1], every):
        whole += shapes.samples[shape, i]
    samples = (shapes.samples.shape[1] + every - 1) // every
    whole = whole / float(samples)
    part = whole
    if rendered != 0:
        ray = wp.quat_rotate_inv(turn, middle - wp.transform_get_translation(eye.pose))
        total = wp.vec3()
        near = wp.float32(0.0)
        for i in range(0, shapes.samples.shape[1], every):
            sample = shapes.samples[shape, i]
            if wp.dot(sample - whole, ray) <= 0.0:
                total += sample
                near += 1.0
        part = total / wp.max(near, 1.0)
    pose_out[row, c] = wp.transform(
        middle - wp.quat_rotate(turn, shapes.world_scale[world] * part), turn
    )


@wp.func
def improved(
    shapes: Shapes,
    world: int,
    pose: wp.transform,
    far: float,
    every: int,
    seen: wp.array2d[wp.vec3],
    count: wp.array[int],
) -> wp.transform:
    """A pose after one step of Gauss and Newton on the distances of the seen points from the shape."""
    shape = shapes.world_shape[world]
    scale = shapes.world_scale[world]
    place = wp.transform_get_translation(pose)
    turn = wp.transform_get_rotation(pose)
    # Curvature of shifts, of turns, and between them; slopes of both.
    shifts = wp.mat33()
    turns = wp.mat33()
    mixed = wp.mat33()
    shift_slope = wp.vec3()
    turn_slope = wp.vec3()
    used = wp.float32(0.0)
    for i in range(0, count[world], every):
        arm = seen[world, i] - place
        distance, gradient = surface_distance(shapes, shape, wp.quat_rotate_inv(turn, arm) / scale)
        distance = scale * distance
        normal = wp.quat_rotate(turn, gradient)
        moment = wp.cross(arm, normal) / LEVER_M
        weight = far * far / (far * far + distance * distance)
        shifts += weight * wp.outer(normal, normal)
        turns += weight * wp.outer(moment, moment)
        mixed += weight * wp.outer(normal, moment)
        shift_slope += weight * distance * normal
        turn_slope += weight * distance * moment
        used += 1.0
    if used == 0.0:
        return pose
    damping = DAMPING * used * wp.identity(n=3, dtype=float)
    solved = wp.inverse(shifts + damping)
    # The shift that is best for each turn put in (Schur's complement).
    left = turns + damping - wp.transpose(mixed) * solved * mixed
    angle_axis = wp.inverse(left) * (turn_slope - wp.transpose(mixed) * solved * shift_slope)
    shift = solved * (shift_slope - mixed * angle_axis)
    angle_axis = angle_axis / LEVER_M
    angle = wp.length(angle_axis)
    if angle > SMALL:
        step = wp.quat_from_axis_angle(angle_axis / angle, wp.min(angle, LARGEST_TURN))
        turn = wp.normalize(step * turn)
    return wp.transform(place + shift, turn)


@wp.kernel
def fit_poses_kernel(
    # Model:
    shapes: Shapes,  # the shapes
    eye: Eye,  # the camera
    far: float,  # length at which distances are cut off [m]; from about there on points count less
    steps: int,  # steps of each pose at most
    every: int,  # look at every so many-th seen point
    every_sample: int,  # look at every so many-th sample for what stands out
    # In:
    world_in: wp.array[int],  # [M] world of each row; a row of -1 is left out
    seen_in: wp.array2d[wp.vec3],  # [N, P] points seen of the object, base frame [m]
    count_in: wp.array[int],  # [N] how many there are
    nearness_in: wp.array3d[float],  # [N, Y, X] of ``nearness_kernel``; [N, 0, 0] without a camera
    # In/Out:
    pose: wp.array2d[wp.transform],  # [M, C] object frame in the base frame
    misfit: wp.array2d[float],  # [M, C] both mean squares added [m^2]; NEVER: nothing to do
):
    """Improve poses until they stay, and say how badly they fit. Launch: [M, C]."""
    row, c = wp.tid()
    world = world_in[row]
    if world < 0 or misfit[row, c] >= NEVER:
        return
    best = pose[row, c]
    for _ in range(steps):
        before = best
        best = improved(shapes, world, before, far, every, seen_in, count_in)
        shift = wp.transform_get_translation(best) - wp.transform_get_translation(before)
        # Half the angle, if small.
        turn = wp.transform_get_rotation(best) - wp.transform_get_rotation(before)
        if wp.length(shift) < SETTLED_M and 2.0 * wp.length(turn) < SETTLED_RAD:
            break
    pose[row, c] = best

    shape = shapes.world_shape[world]
    scale = shapes.world_scale[world]
    to_object = wp.transform_inverse(best)
    off = wp.float32(0.0)
    points = wp.float32(0.0)
    for i in range(0, count_in[world], every):
        place = wp.transform_point(to_object, seen_in[world, i]) / scale
        distance, _gradient = surface_distance(shapes, shape, place)
        distance = wp.min(wp.abs(scale * distance), far)
        off += distance * distance
        points += 1.0
    out = wp.float32(0.0)
    samples = wp.float32(0.0)
    if nearness_in.shape[1] > 0:
        for i in range(0, shapes.samples.shape[1], every_sample):
            place = wp.transform_point(best, scale * shapes.samples[shape, i])
            length = standing_out(eye, place, world, nearness_in, far)
            out += length * length
            samples += 1.0
    misfit[row, c] = off / wp.max(points, 1.0) + out / wp.max(samples, 1.0)


@wp.kernel
def keep_poses_kernel(
    # Model:
    apart: float,  # least angle between two kept poses [rad]
    stay: float,  # factor on the misfit of the first pose when it is compared
    share: float,  # share of the latest misfit in the average over time
    known: int,  # how many of the found poses were kept before, 0 or K
    # In:
    world_in: wp.array[int],  # [M] world of each row; a row of -1 is left out
    found_in: wp.array2d[wp.transform],  # [M, C] found poses
    # In/Out:
    cost: wp.array2d[float],  # [M, C] their misfits now; of no meaning after
    pose: wp.array2d[wp.transform],  # [N, K] kept poses
    misfit: wp.array2d[float],  # [N, K] their misfits, averaged over time; NEVER where none is left
):
    """Keep the best poses of each world that are not nearly the same. Launch: [M].

    The first of the found poses may be those kept before, improved: their misfits are averaged over
    time. The very first stays so unless another is better by a good deal: of a shape that looks the
    same from several sides any is as good, but not another one in each step. The kept poses are in
    the order of their misfits.
    """
    row = wp.tid()
    world = world_in[row]
    if world < 0:
        return
    for c in range(known):
        if misfit[world, c] >= NEVER:
            cost[row, c] = NEVER
        else:
            cost[row, c] = misfit[world, c] + share * (cost[row, c] - misfit[world, c])
    for k in range(pose.shape[1]):
        best = wp.int32(0)
        least = 2.0 * NEVER
        for c in range(found_in.shape[1]):
            weighed = cost[row, c]
            if c == 0 and known > 0:
                weighed = stay * weighed
            if weighed < least:
                best = c
                least = weighed
        misfit[world, k] = wp.min(cost[row, best], NEVER)
        pose[world, k] = found_in[row, best]
        turn = wp.transform_get_rotation(found_in[row, best])
        for c in range(found_in.shape[1]):
            cosine = wp.abs(wp.dot(turn, wp.transform_get_rotation(found_in[row, c])))
            if c == best or 2.0 * wp.acos(wp.min(cosine, 1.0)) < apart:
                cost[row, c] = NEVER
