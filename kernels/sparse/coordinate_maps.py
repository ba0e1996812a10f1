"""Which sites a sparse convolution reads: neighbours on a grid, and cells of a grid of half the resolution.

A site is an occupied cell, given by its key (:mod:`vd.kernels.sparse.voxels`); keys are sorted, and a key's
place among them is the site's row in every feature matrix. Level l counts cells of 2^l voxels a side.
Offset k of the 27 of a 3x3x3 kernel is (k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1).

A map is a table [M, K] of input rows, one row for each output site and one column for each of the K
weights of the kernel; where no site is, it holds the number of input sites, to read a row of zeros there.
"""

import warp as wp

from vd.kernels.launch import launch
from vd.kernels.sparse.voxels import AXIS_BITS, CLOUD_SHIFT, key_coordinates, spread_bits, unique_keys

wp.set_module_options({"enable_backward": False})

KERNEL = 27
"""Weights of a 3x3x3 kernel."""
_KERNEL = wp.constant(KERNEL)
CENTRE = wp.constant(KERNEL // 2)
"""Offset (0, 0, 0)."""
WINDOW = 8
"""Cells of a 2x2x2 window."""
SLOTS_PER_SITE = 2
"""Slots of the hash table for each site, at least: half of them stay empty, so searches are short."""
KEYS_PER_THREAD = wp.constant(256)
"""Keys that one thread counts before it adds to the sums of all."""

_Counts = wp.types.vector(length=AXIS_BITS, dtype=int)
_LEVELS = wp.constant(AXIS_BITS)
_ALL_DIFFER = wp.constant(wp.int64((1 << 62) - 1))
_NONE = wp.constant(wp.int64(-1))
"""Key of an empty slot, or of a cell beyond the grid."""
_KEY_SHIFT = wp.constant(wp.int64(CLOUD_SHIFT))
_MORTON_MASK = wp.constant(wp.int64((1 << CLOUD_SHIFT) - 1))
_AXIS_CELLS = wp.constant(1 << AXIS_BITS)
# Murmur's last multiplier: neighbouring cells land far apart.
_HASH_FACTOR = wp.constant(wp.uint64(0xFF51AFD7ED558CCD))


@wp.func
def hash_slot(key: wp.int64, mask: int) -> int:
    """First slot to look at for a key in a table of ``mask`` + 1 slots, a power of two."""
    bits = wp.uint64(key)
    bits = (bits ^ (bits >> wp.uint64(33))) * _HASH_FACTOR
    return int(bits >> wp.uint64(33)) & mask


@wp.func
def find_row(key: wp.int64, slot_key: wp.array[wp.int64], slot_row: wp.array[int]) -> int:
    """Row of the site with a key, or -1."""
    mask = slot_key.shape[0] - 1
    slot = hash_slot(key, mask)
    # More slots than sites: an empty one ends the search.
    while slot_key[slot] != key:
        if slot_key[slot] == _NONE:
            return -1
        slot = (slot + 1) & mask
    return slot_row[slot]


@wp.func
def cell_key(cloud: wp.int64, x: int, y: int, z: int, level: int) -> wp.int64:
    """Key of a cell of a level, counted from the grid's corner, or -1 where it lies beyond the grid."""
    cells = _AXIS_CELLS >> level
    if x < 0 or y < 0 or z < 0 or x >= cells or y >= cells or z >= cells:
        return _NONE
    morton = (spread_bits(x) << wp.int64(2)) | (spread_bits(y) << wp.int64(1)) | spread_bits(z)
    return (cloud << (_KEY_SHIFT - wp.int64(3 * level))) | morton


@wp.kernel
def insert_rows_kernel(
    # In:
    key_in: wp.array[wp.int64],
    # In/Out:
    slot_key: wp.array[wp.int64],
    # Out:
    slot_row_out: wp.array[int],
):
    """Enter every key, each given once, with its row into a hash table with linear probing. Launch: [M]."""
    row = wp.tid()
    key = key_in[row]
    mask = slot_key.shape[0] - 1
    slot = hash_slot(key, mask)
    while wp.atomic_cas(slot_key, slot, _NONE, key) != _NONE:
        slot = (slot + 1) & mask
    slot_row_out[slot] = row


@wp.kernel
def neighbour_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] keys of the level
    level: int,  # how often the grid was halved
    slot_key_in: wp.array[wp.int64],  # hash table of the same keys
    slot_row_in: wp.array[int],  # rows of its slots
    # Out:
    table_out: wp.array2d[int],  # [M, 27] rows of the neighbours, filled with M before
):
    """Sites around each site: a submanifold 3x3x3 kernel, input = output + offset. Launch: [M].

    If i has j at an offset, j has i at the opposite one; so 13 look-ups fill 26 columns.
    """
    row = wp.tid()
    key = key_in[row]
    shift = wp.int64(3 * level)
    cloud = key >> (_KEY_SHIFT - shift)
    cell = key_coordinates(key & (_MORTON_MASK >> shift))
    table_out[row, CENTRE] = row
    for k in range(CENTRE):
        x, y, z = cell[0] + k // 9 - 1, cell[1] + (k // 3) % 3 - 1, cell[2] + k % 3 - 1
        other = cell_key(cloud, x, y, z, level)
        if other != _NONE:
            found = find_row(other, slot_key_in, slot_row_in)
            if found >= 0:
                table_out[row, k] = found
                table_out[found, KERNEL - 1 - k] = row


@wp.kernel
def beside_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] keys of voxels
    asked_in: wp.array[wp.bool],  # [M] which are asked about
    other_in: wp.array[wp.bool],  # [M] which are the others
    slot_key_in: wp.array[wp.int64],  # hash table of the keys
    slot_row_in: wp.array[int],  # rows of its slots
    # Out:
    beside_out: wp.array[wp.bool],  # [M] false where not asked
):
    """Tell of some voxels whether any of the 3x3x3 about each is one of others. Launch: [M]."""
    row = wp.tid()
    found = wp.int32(0)
    if asked_in[row]:
        key = key_in[row]
        cell = key_coordinates(key & _MORTON_MASK)
        k = wp.int32(0)
        while k < _KERNEL and found == 0:
            x, y, z = cell[0] + k // 9 - 1, cell[1] + (k // 3) % 3 - 1, cell[2] + k % 3 - 1
            other = cell_key(key >> _KEY_SHIFT, x, y, z, 0)
            if other != _NONE:
                place = find_row(other, slot_key_in, slot_row_in)
                if place >= 0 and other_in[place]:
                    found = wp.int32(1)
            k += 1
    beside_out[row] = found == 1


@wp.kernel
def strided_kernel(
    # In:
    fine_key_in: wp.array[wp.int64],  # [F] keys of the fine level
    level: int,  # how often the fine grid was halved
    slot_key_in: wp.array[wp.int64],  # hash table of the keys of the coarse level
    slot_row_in: wp.array[int],  # rows of its slots
    reverse: int,  # 1 for the reverse map: coarse rows that read each fine site, by the same offsets
    # Out:
    table_out: wp.array2d[int],  # [M, 27] fine rows, F before; reversed [F, 27] coarse rows, M before
):
    """Sites of a fine grid that each site of the next coarser one reads: input = 2 output + offset.

    An even coordinate is read at offset 0 only; an odd one at +1 from the cell it lies in and at -1
    from the next: at most eight look-ups for each fine site. Launch: [F].
    """
    row = wp.tid()
    key = fine_key_in[row]
    shift = wp.int64(3 * level)
    cloud = key >> (_KEY_SHIFT - shift)
    cell = key_coordinates(key & (_MORTON_MASK >> shift))
    odd_x, odd_y, odd_z = cell[0] & 1, cell[1] & 1, cell[2] & 1
    for dx in range(odd_x + 1):
        for dy in range(odd_y + 1):
            for dz in range(odd_z + 1):
                coarse = cell_key(
                    cloud, (cell[0] >> 1) + dx, (cell[1] >> 1) + dy, (cell[2] >> 1) + dz, level + 1
                )
                if coarse != _NONE:
                    found = find_row(coarse, slot_key_in, slot_row_in)
                    if found >= 0:
                        # offset + 1 on each axis: 1 for an even coordinate, 2 or 0 for an odd one
                        k = 9 * (1 + odd_x - 2 * dx) + 3 * (1 + odd_y - 2 * dy) + 1 + odd_z - 2 * dz
                        if reverse != 0:
                            table_out[row, k] = found
                        else:
                            table_out[found, k] = row


@wp.kernel
def window_kernel(
    # In:
    fine_key_in: wp.array[wp.int64],  # [F] keys of the fine level
    coarse_place_in: wp.array[int],  # [F] place of each one's coarse cell, counted from 1
    # Out:
    table_out: wp.array2d[int],  # [M, 8] fine rows, filled with F before; column 4 x + 2 y + z
):
    """Sites in the 2x2x2 window of each cell of the next coarser grid: input = 2 output + {0, 1}^3.

    Launch: [F].
    """
    row = wp.tid()
    table_out[coarse_place_in[row] - 1, int(fine_key_in[row] & wp.int64(7))] = row


@wp.kernel
def level_count_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] sorted keys, each once
    threads: int,  # threads of the launch
    # In/Out:
    count: wp.array[int],  # [AXIS_BITS] cells one level up, two, and so on, zeros before
):
    """Count the cells of every coarser level, before any is made. Launch: [threads].

    A cell of a level begins where a key differs from the one before in more than the level's bits.
    """
    counts = _Counts()
    i = wp.tid()
    while i < key_in.shape[0]:
        changed = _ALL_DIFFER
        if i > 0:
            changed = key_in[i] ^ key_in[i - 1]
        changed = changed >> wp.int64(3)
        level = wp.int32(0)
        while changed != wp.int64(0) and level < _LEVELS:
            counts[level] += 1
            changed = changed >> wp.int64(3)
            level += 1
        i += threads
    for level in range(_LEVELS):
        if counts[level] > 0:
            wp.atomic_add(count, level, counts[level])


def level_counts(keys: wp.array) -> list[int]:
    """Numbers of sites that :func:`coarsen` would give, once, twice and so on, waiting for the device once.

    Of sorted keys, each once [M], one number for each bit of a coordinate.
    """
    counts = wp.zeros(AXIS_BITS, dtype=int, device=keys.device)
    threads = -(-keys.shape[0] // KEYS_PER_THREAD)
    launch(level_count_kernel, threads, [keys, threads], [counts])
    return counts.numpy().tolist()


def coarsen(keys: wp.array, count: int | None = None) -> tuple[wp.array, wp.array]:
    """Sites of the grid of half the resolution: floor(c / 2) of every site, each once, ascending.

    Args:
        keys: Keys of the level, sorted, each once [F].
        count: M, where it is known (:func:`level_counts`); else the device is waited for.

    Returns:
        Their keys [M], and the place of each finer site's cell among them, counted from 1 [F].
    """
    return unique_keys(keys, keys.shape[0], limit=2**63 - 1, shift=3, kept=count)


HashTable = tuple[wp.array, wp.array]
"""Key (-1 where empty) and row of each slot."""


def hash_table(keys: wp.array) -> HashTable:
    """A hash table from keys, each given once, to rows."""
    slots = 1 << max(1, SLOTS_PER_SITE * keys.shape[0] - 1).bit_length()
    slot_key = wp.full(slots, -1, dtype=wp.int64, device=keys.device)
    slot_row = wp.empty(slots, dtype=int, device=keys.device)
    launch(insert_rows_kernel, keys.shape, [keys, slot_key], [slot_row])
    return slot_key, slot_row


def neighbour_table(keys: wp.array, level: int, slots: HashTable | None = None) -> wp.array:
    """Map of a submanifold 3x3x3 convolution over sites of a level, shape [M, 27]; ``slots`` if known."""
    count = keys.shape[0]
    table = wp.full((count, KERNEL), count, dtype=int, device=keys.device)
    launch(neighbour_kernel, count, [keys, level, *(slots or hash_table(keys))], [table])
    return table


def beside(keys: wp.array, asked: wp.array, others: wp.array) -> wp.array:
    """Which of the voxels asked about are among others or touch one, by a corner at least, bool [M] each."""
    touches = wp.empty(keys.shape, dtype=wp.bool, device=keys.device)
    launch(beside_kernel, keys.shape, [keys, asked, others, *hash_table(keys)], [touches])
    return touches


def strided_table(
    fine: wp.array, coarse: wp.array, level: int, slots: HashTable | None = None, *, reverse: bool = False
) -> wp.array:
    """Map of a 3x3x3 convolution of stride 2.

    Args:
        fine: Keys of the input sites [F].
        coarse: Keys of the output sites [M], from :func:`coarsen`.
        level: Level of the input sites.
        slots: Hash table of the output sites' keys, if there is one already.
        reverse: Give the output sites that read each input site, not the input sites that each output reads.

    Returns:
        Input rows of each output site [M, 27]; or, reversed, output rows of each input site [F, 27].
    """
    rows, none = (fine, coarse) if reverse else (coarse, fine)
    table = wp.full((rows.shape[0], KERNEL), none.shape[0], dtype=int, device=fine.device)
    launch(strided_kernel, fine.shape, [fine, level, *(slots or hash_table(coarse)), int(reverse)], [table])
    return table


def window_table(fine: wp.array, place: wp.array, outputs: int) -> wp.array:
    """Map of a 2x2x2 pooling of stride 2 of sites [F], whose ``place`` :func:`coarsen` gave, [outputs, 8]."""
    table = wp.full((outputs, WINDOW), fine.shape[0], dtype=int, device=fine.device)
    launch(window_kernel, fine.shape, [fine, place], [table])
    return table
