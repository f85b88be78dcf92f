"""Bit sets of instances: rows of 32-bit words, in which bit i % 32 of word i // 32 is set if instance i is a member."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

WORD_BITS = wp.constant(32)
"""Instances of a word."""
WORD_SHIFT = wp.constant(5)
"""Binary logarithm of WORD_BITS: `instance >> WORD_SHIFT` is the index of an instance's word."""
NO_MEMBERS = wp.constant(wp.uint32(0))


@wp.func
def bit(instance: int) -> wp.uint32:
    """Word in which the instance's bit alone is set."""
    return wp.uint32(1) << wp.uint32(instance & (WORD_BITS - 1))


@wp.func
def has_member(words: wp.array2d[wp.uint32], row: int, instance: int) -> bool:
    """True if the instance is a member of the set in this row."""
    return (words[row, instance >> WORD_SHIFT] & bit(instance)) != NO_MEMBERS


@wp.func
def has_members(words: wp.array2d[wp.uint32], row: int) -> bool:
    """True if the set in this row is not empty."""
    for word in range(words.shape[1]):
        if words[row, word] != NO_MEMBERS:
            return True
    return False


@wp.func
def lowest_bit(word: Any) -> int:
    """Count of trailing zeros of a word of 32 or 64 bits: the index of its lowest set bit; the number of bits if none is set."""
    return int(wp.bit_count(~word & (word - type(word)(1))))


@wp.func
def pack_word(flags: wp.array2d[int], catalog_index: wp.array2d[int], row: int, word: int) -> wp.uint32:
    """One word of the set of the instances of a world (`row`) whose flag is not 0, among those in the scene (`catalog_index` from 0 on)."""
    members = wp.uint32(0)
    for instance in range(WORD_BITS * word, wp.min(WORD_BITS * (word + 1), flags.shape[1])):
        if flags[row, instance] != 0 and catalog_index[row, instance] >= 0:
            members = members | bit(instance)
    return members
