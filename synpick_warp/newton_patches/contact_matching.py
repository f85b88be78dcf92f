"""Contact matching between substeps in which no contact loses its impulse to another one, in place of Newton's."""

from __future__ import annotations

from typing import Any

import newton
import warp as wp
from newton._src.geometry.contact_match import ContactMatcher

from synpick_warp.kernels.newton_patches import contact_matching

MAX_DISTANCE = 0.02
"""Largest distance of a contact from the one whose impulse it starts with, if none within Newton's distance is left [m]."""


class CompleteMatcher(ContactMatcher):
    """Newton's contact matching, after which contacts without a partner get one of those left over (`complete_matching_kernel`)."""

    def __init__(self, matcher: ContactMatcher) -> None:
        """Prepare a matcher with the settings of `matcher`, Newton's, which has not matched anything yet."""
        super().__init__(
            matcher._capacity,
            sorter=matcher._sorter,
            shape_world=matcher._shape_world,
            world_count=matcher._world_count,
            shape_index_bits=matcher._shape_index_bits,
            sub_key_bits=matcher._sub_key_bits,
            pos_threshold=matcher._pos_threshold_sq**0.5,
            normal_dot_threshold=matcher._normal_dot_threshold,
            device=matcher._prev_count.device,
        )

    def match(self, *args: Any, **contacts: Any) -> None:
        """Match the contacts of a substep with those of the last one; arguments as in Newton's `match`, by keyword."""
        super().match(*args, **contacts)
        history = contact_matching.ContactHistory()
        history.count, history.key, history.position = self._prev_count, self._prev_sorted_keys, self._prev_pos_world
        history.normal, history.pair_bits = self._prev_normal, self._pair_sub_key_mask
        names = ("contact_count", "sort_keys", "shape0", "shape1", "point0", "point1", "normal")
        inputs = [contacts["shape_body"], MAX_DISTANCE, self._normal_dot_threshold, history, contacts["body_q"]]
        wp.launch(
            contact_matching.complete_matching_kernel,
            dim=self._capacity,
            inputs=inputs + [contacts[name] for name in names],
            outputs=[contacts["match_index_out"]],
            device=contacts["device"],
        )


def complete_matching(pipeline: newton.CollisionPipeline) -> None:
    """Replace the contact matching of a pipeline, before it is used."""
    assert pipeline._contact_matcher is not None
    pipeline._contact_matcher = CompleteMatcher(pipeline._contact_matcher)
