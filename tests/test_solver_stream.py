"""Stream of the solver in a bake: the solver uses the reserved multiprocessors exactly while views are rendered."""

from __future__ import annotations

from synpick_warp.stages.render_streams import RenderStreams
from synpick_warp.stages.sim.physics import Physics
from tests.builders import bake_boxes
from tests.test_bake import TINY


def test_the_solver_runs_on_the_reserved_multiprocessors_while_there_are_views(tmp_path, monkeypatch):
    """On a CPU: `confine` is replaced to provide a marker as stream, which is removed before physics sees it."""
    monkeypatch.setattr(RenderStreams, "confine", lambda self, share: setattr(self, "solver", "reserved"))
    tick_parts, given = Physics.tick_parts, []

    def spy(self, *arguments):
        given.append(self.solver_stream)
        self.solver_stream = None
        return tick_parts(self, *arguments)

    monkeypatch.setattr(Physics, "tick_parts", spy)
    summary = bake_boxes(tmp_path / "out", TINY | {"bake.worlds": 1, "bake.episodes": 1, "bake.device": "cpu"})
    frames = summary.views // 3
    assert len(given) > frames
    first = given.index("reserved")
    assert first > 1
    assert given == [None] * first + ["reserved"] * (len(given) - first)
    assert frames - 1 <= len(given) - first <= frames
