"""Launches whose arguments are found by the names of the kernel's parameters."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import warp as wp

from synpick_warp.stages.arrays import array_group
from synpick_warp.stages.launch import launch


@wp.kernel
def add_kernel(first: wp.array[int], count: int, second_inout: wp.array[int], first_out: wp.array[int]):
    index = wp.tid()
    second_inout[index] += count
    first_out[index] = first[index] + count


@wp.struct
class Pair:
    left: wp.array[int]
    right: wp.array[int]


@wp.kernel
def swap_kernel(pair_inout: Pair):
    index = wp.tid()
    left = pair_inout.left[index]
    pair_inout.left[index] = pair_inout.right[index]
    pair_inout.right[index] = left


class PairArrays(array_group(Pair, "place")):
    """The arrays of `Pair`."""


def numbers(*values: int) -> wp.array:
    return wp.array(values, dtype=wp.int32, device="cpu")


def test_arguments_are_found_by_name_and_outputs_in_their_object():
    one, two, out = SimpleNamespace(first=numbers(1, 2)), SimpleNamespace(second=numbers(5, 6)), SimpleNamespace(first=numbers(0, 0))
    launch(add_kernel, 2, one, two, out=out, count=10)
    assert [array.numpy().tolist() for array in (one.first, two.second, out.first)] == [[1, 2], [15, 16], [11, 12]]
    launch(add_kernel, 2, one, count=1, second_inout=two.second, first_out=out.first)
    assert [array.numpy().tolist() for array in (one.first, two.second, out.first)] == [[1, 2], [16, 17], [2, 3]]


def test_structs_are_groups_of_arrays_or_bundles_of_attributes():
    group = PairArrays(numbers(1, 2), numbers(3, 4))
    launch(swap_kernel, 2, SimpleNamespace(left=numbers(7, 7)), group)
    assert [array.numpy().tolist() for array in (group.left, group.right)] == [[3, 4], [1, 2]]
    halves = SimpleNamespace(left=group.left), SimpleNamespace(right=group.right)
    launch(swap_kernel, 1, *halves)
    assert [array.numpy().tolist() for array in (group.left, group.right)] == [[1, 4], [3, 2]]
    with pytest.raises(TypeError, match=r"swap_kernel: no source has Pair\.right"):
        launch(swap_kernel, 1, halves[0])


def test_missing_ambiguous_and_unknown_arguments_are_errors():
    one, both = SimpleNamespace(first=numbers(1)), SimpleNamespace(first=numbers(1), second=numbers(2))
    for sources, given, message in (
        ((one,), {}, "0 sources have second"),
        ((one, both), {}, "2 sources have first"),
        ((both,), {"other": 1}, "no parameter other"),
    ):
        with pytest.raises(TypeError, match=message):
            launch(add_kernel, 1, *sources, count=1, **given)
