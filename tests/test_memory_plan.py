"""Memory plan: oversized settings are refused in one line before anything is loaded, and what fits is not."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.configs.cell.cameras import CameraRow, Jitter, Pose
from synpick_warp.configs.episodes.randomize import Distribution
from synpick_warp.configs.fields import INT32_MAX, settings_of
from synpick_warp.configs.files.load import load_config, sections
from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.factory import assembly, memory_plan, pipeline
from synpick_warp.factory.memory_plan import check_memory, plan_memory
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.build import build_model
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.system.progress import SilentProgress
from tests.builders import refusal
from tests.harness.hostile import fuzz_examples
from tests.worlds.small_worlds import catalog, settings

GIB = 1024**3
CPU = SimpleNamespace(is_cuda=False, alias="cpu")
GPU = SimpleNamespace(is_cuda=True, alias="cuda:0", total_memory=64 << 30)
"""Stand-ins for devices: the plan asks for no more."""


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    """A machine with 8 GiB of memory, and 80 GiB on the GPU."""
    monkeypatch.setattr(memory_plan, "free_host_memory", lambda: 8 * GIB)
    monkeypatch.setattr(memory_plan, "free_device_memory", lambda device: 80 * GIB)


def refused(tmp_path: Path, monkeypatch, **overrides: object) -> str:
    """The one line with which a bake is refused before models are loaded; nothing is left behind."""
    monkeypatch.setattr(assembly, "load_catalog", lambda *_: pytest.fail("models are loaded"))
    said = refusal(pipeline.run_bake, settings(**{"bake__device": "cpu"} | overrides), tmp_path / "out", SilentProgress())
    assert not (tmp_path / "out").exists()
    return said


# ---- fault 8 ----

CAMERAS = {"cameras__positions": [[0.0, 0.0, 2.0]] * 1000, "cameras__ups": [[0.0, 1.0, 0.0]] * 1000}


@pytest.mark.parametrize(
    ("overrides", "largest", "advice"),
    [
        (
            {"cameras__resolution": [8192, 8192], "render__views_per_batch": 3},
            "images of 3 views of 8,192x8,192 px",
            "lower cameras.resolution ([8192, 8192])",
        ),
        (
            {"cameras__resolution": [8192, 8192], "bake__worlds": 65536, "bake__mode": "pick"},
            "light averaged over frames",
            "lower bake.worlds (65536)",
        ),
        (
            CAMERAS | {"cameras__resolution": [1280, 720]},
            "backgrounds of 1,000 cameras of 1,280x720 px",
            "lower cameras.positions (1,000 cameras)",
        ),
        ({"render__views_per_batch": 10_000}, "images of 10,000 views of 320x180 px", "lower render.views_per_batch (10000)"),
        ({"physics__contacts_per_world": 10**9}, "Newton's contacts", "lower physics.contacts_per_world (1000000000)"),
        (
            {"perception__contour_points": 10**8, "bake__mode": "target", "arrangement__max_objects": 20},
            "perception of 1 worlds at 640x360 px",
            "lower perception.contour_points (100000000)",
        ),
        ({"bake__worlds": 65536}, "light averaged over frames", "lower bake.worlds (65536)"),
    ],
)
def test_settings_that_exceed_the_memory_are_refused_in_one_line(overrides, largest, advice, tmp_path, monkeypatch):
    """Fault 8: "Failed to allocate ... bytes on device" as a traceback, or the kernel's out-of-memory killer."""
    said = refused(tmp_path, monkeypatch, **overrides)
    assert said.startswith("a bake with these settings takes at least ")
    assert f" GiB of them for {largest}, but this machine has 8.0 GiB free; {advice}" in said


@pytest.mark.parametrize(
    ("overrides", "advice"),
    [
        ({"render__views_per_batch": 10**6}, "lower render.views_per_batch (1000000)"),
        ({"physics__contacts_per_world": INT32_MAX, "bake__worlds": 2}, "lower physics.contacts_per_world (2147483647)"),
    ],
)
def test_arrays_longer_than_32_bit_indices_are_refused_on_any_machine(overrides, advice, tmp_path, monkeypatch):
    monkeypatch.setattr(memory_plan, "free_host_memory", lambda: 2**60)
    said = refused(tmp_path, monkeypatch, **overrides)
    assert "elements, more than 32-bit indices reach" in said
    assert said.endswith(advice)


LENS = CameraRow(
    fov=40.0, distortion=(-0.1, 0.0, 0.0, 0.0), pose=Pose(position=(0.0, 0.0, 1.2), look_at=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
)
DRAWN = replace(LENS, jitter=Jitter(center=Distribution("uniform", ((-2.0,), (2.0,)))))
"""A camera whose lens each episode draws."""
STEREO = {"render__layers": ["depth_stereo"]}
INFRARED = {"render__layers": ["depth_sensor", "ir_left"]}


@pytest.mark.parametrize(
    ("cameras", "given", "name", "shapes"),
    [
        ((LENS,), {}, "Lenses.ray", []),
        ((DRAWN,), {}, "Lenses.ray", [(5, 180, 320)]),
        ((LENS, DRAWN), {}, "Lenses.ray", [(5, 180, 320)]),
        ((), {}, "RandomizedSurfaces.recolor", []),
        # Of 20 objects, 3 fixtures, table and background.
        ((), {"randomize__lamps": 1}, "RandomizedSurfaces.recolor", [(5 * 25,)]),
        # Once more without transparent objects.
        ((), {}, "ShadedImage.radiance", [(5, 180, 320)]),
        ((), {"randomize__object_transmission": 0.5}, "ShadedImage.radiance", [(5, 180, 320)] * 2),
        # One cost volume for all views.
        ((), STEREO, "MatchingScratch.cost", [(1, 180, 320, 256)]),
        ((), STEREO | {"depth_sensor__max_disparity": 100.0}, "MatchingScratch.cost", [(1, 180, 320, 102)]),
        ((), STEREO, "InfraredImages.ir_left", [(5, 180, 320)]),
        ((), INFRARED, "MatchingScratch.cost", []),
        ((), INFRARED, "InfraredImages.ir_right", []),
    ],
)
def test_arrays_are_counted_where_settings_need_them(cameras, given, name, shapes):
    config = replace(settings(render__views_per_batch=5, arrangement__max_objects=20, **given), camera=cameras)
    assert [shape for term in plan_memory(config, CPU) for found, shape, *_ in term.rows if found == name] == shapes


def test_whole_numbers_and_times_in_ticks_stay_within_32_bits():
    """They wrapped around without a word: an episode that may settle for 1e300 s was given up at once."""
    bounds = {f"{section}.{name}": item for section, kind in sections().items() for name, item in settings_of(kind).items()}
    counts = {key: item.bounds.high for key, item in bounds.items() if item.kind is int and key != "bake.seed"}
    assert len(counts) > 20
    assert {key: high for key, high in counts.items() if high > INT32_MAX} == {}
    times = [bounds[f"settle.{name}"] for name in ("max_time", "relax_time", "stuck_time")] + [bounds["pick.press_time"]]
    assert max(item.bounds.high for item in times) < INT32_MAX * bounds["physics.step"].bounds.low


def test_episodes_that_the_memory_cannot_list_are_refused_before_they_are_listed(tmp_path, monkeypatch):
    said = refused(tmp_path, monkeypatch, bake__episodes=INT32_MAX)
    assert said == (
        "the lists of 2,147,483,647 episodes take at least 200.0 GiB of memory, but this machine has 8.0 GiB free; "
        "lower bake.episodes (2147483647), or bake a part with --shard"
    )


def fail_to_build(monkeypatch, error: Exception) -> None:
    def build_factory(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(pipeline, "build_factory", build_factory)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("Failed to allocate 1610612736 bytes on device 'cpu'"),
        RuntimeError("Warp CUDA error 2: out of memory (in function wp_cuda_graph_create_exec)"),
        Exception("Failed to load CUDA module: CUDA_ERROR_OUT_OF_MEMORY: out of memory"),
    ],
)
def test_memory_that_runs_out_later_is_one_line_too(error, tmp_path, monkeypatch):
    """The plan is a lower bound, and other programs may take memory at any time."""
    fail_to_build(monkeypatch, error)
    with pytest.raises(
        ConfigError, match=r"\Athe bake ran out of memory; its largest part are images of 3 views .*; lower cameras\.resolution "
    ):
        pipeline.run_bake(settings(bake__device="cpu", cameras__resolution=[2048, 2048]), tmp_path / "out", SilentProgress())
    assert not (tmp_path / "out").exists()


def test_other_runtime_errors_stay_what_they_are(tmp_path, monkeypatch):
    fail_to_build(monkeypatch, RuntimeError("a fault"))
    with pytest.raises(RuntimeError, match="a fault"):
        pipeline.run_bake(settings(bake__device="cpu"), tmp_path / "out", SilentProgress())


# ---- what fits ----


@pytest.mark.parametrize(
    ("preset", "worlds", "machine_device"),
    [
        *((preset, 32, device) for preset in ("smoke", "synpick", "synpick-released") for device in (CPU, GPU)),
        ("synpick", 512, GPU),  # The plan is a lower bound: that it accepts them does not say they fit.
    ],
)
def test_presets_fit_into_a_common_machine(preset, worlds, machine_device):
    config = load_config(preset, {"bake.mode": "mixed", "bake.worlds": worlds})
    check_memory(plan_memory(config, machine_device, 16), machine_device)


def test_the_gpus_memory_is_its_own(monkeypatch):
    monkeypatch.setattr(memory_plan, "free_device_memory", lambda device: GIB // 8)
    with pytest.raises(ConfigError, match=r"for .*, but cuda:0 has 0\.2 GiB free; lower cameras\.resolution|lower bake\.worlds"):
        check_memory(plan_memory(load_config("synpick", {"bake.worlds": 64}), GPU), GPU)


ROOMY = {"physics__contacts_per_world": 2048, "physics__gripper_rows_per_world": 1024}
FULL = {"objects__embedded": ["industrial"], "arrangement__max_objects": 150, "arrangement__drop": "layers", "bake__formats": ["zarr"]}


@pytest.mark.parametrize(
    ("overrides", "pieces", "least"),
    [(ROOMY, 1, 0.5), (FULL | {"arrangement__counts": {"bracket": 150}}, 2, 0.9), (FULL | {"arrangement__counts": {"box": 100}}, 1, 0.9)],
)
def test_the_plan_is_below_what_a_bake_allocates(device, overrides, pieces, least):
    """Lower bound: Newton's terms are at most what building its model and solver allocates on a CPU, and within 10 % of it for parts whose
    number is set."""
    if device.is_cuda:
        pytest.skip("allocations of a GPU's memory pool are not counted by this test")
    config = settings(bake__worlds=4, bake__device="cpu", **overrides)
    objects = load_catalog(config) if "arrangement__counts" in overrides else catalog()
    config = assembly.fit_to_catalog(config, objects, make_bins(config.cell.bins), device, SilentProgress())
    kind = type(device.default_allocator)
    sizes: list[int] = []
    allocate = kind.allocate
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kind, "allocate", lambda self, size: (sizes.append(size), allocate(self, size))[1])
        physics = Physics(config.physics, build_model(config, objects, device))
    assert physics.layout.worlds == 4
    terms = plan_memory(config, wp.get_device("cpu"), pieces=pieces)
    planned = sum(term.size for term in terms if term.name.startswith("Newton") or term.name == "separating axes")
    assert least * sum(sizes) < planned <= sum(sizes)


def test_a_catalog_too_large_for_the_memory_is_refused_in_one_line(monkeypatch):
    """What the settings alone need is free, but not what 100 bolts of two pieces need."""
    config = settings(bake__worlds=64, **FULL | {"arrangement__counts": {"bolt": 100}, "arrangement__max_objects": 100})
    needed = sum(term.size for term in plan_memory(config, CPU, 0))
    monkeypatch.setattr(memory_plan, "free_host_memory", lambda: needed)
    objects, bins = load_catalog(config), make_bins(config.cell.bins)
    with pytest.raises(
        ConfigError, match=r"for .*, but this machine has .* GiB free; lower (bake\.worlds|arrangement\.max_objects) \(\d+\)\Z"
    ):
        assembly.fit_to_catalog(config, objects, bins, wp.get_device("cpu"), SilentProgress())


def test_without_paths_images_need_less():
    """Mode unoccluded has G-buffer and shadows, but neither coarse pixels nor histories; mode reference has not even those."""
    sizes = {}
    for mode in (FAST, UNOCCLUDED, REFERENCE):
        terms = plan_memory(settings(render__mode=mode), CPU)
        sizes[mode] = sum(term.size for term in terms if "image" in term.name or "light" in term.name)
    assert sizes[REFERENCE] < sizes[UNOCCLUDED] < sizes[FAST]


def test_shapes_of_bins_take_a_separating_axis_a_pair():
    """Floor, four walls, four corners and four guide walls of each bin, and a shape for each of 24 objects."""
    base = load_config("smoke", {"bake.worlds": 5})
    config = replace(base, bins=replace(base.bins, kind="own"), bin=(BinRow(name="a"), BinRow(name="b")))
    sizes = {term.name: term.size for term in plan_memory(config, wp.get_device("cpu"))}
    shapes = 2 * (9 + 4) + 24
    assert "shared memory of writers" in {name for term in plan_memory(config, CPU) for name, *_ in term.rows}
    assert sizes["separating axes"] == 4 * 5 * shapes * (shapes - 1) // 2
    assert "separating axes" not in {term.name for term in plan_memory(base, wp.get_device("cpu"))}


# ---- any settings ----

NUMBERS = [
    (f"{section}.{name}", item.kind)
    for section, kind in sections().items()
    for name, item in settings_of(kind).items()
    if item.kind in (int, float, tuple[int, int])
]
WHOLE = st.one_of(
    st.integers(-1, 4096),
    st.builds(lambda base, power: base * 10**power, st.integers(1, 9), st.integers(0, 40)),
    st.integers(2**31 - 2, 2**31 + 1),
)
VALUES = {int: WHOLE, float: st.floats(), tuple[int, int]: st.lists(st.one_of(WHOLE, st.integers(1, 8192)), min_size=2, max_size=2)}


@hypothesis_settings(max_examples=fuzz_examples(100), deadline=5000)
@given(data=st.data(), cuda=st.booleans(), mode=st.sampled_from(("pick", "move", "mixed")), cameras=st.sampled_from((None, 1, 1000)))
def test_extreme_settings_give_a_plan_or_one_line(data, cuda, mode, cameras):
    chosen = data.draw(st.lists(st.sampled_from(NUMBERS), max_size=4, unique_by=lambda item: item[0]))
    values: dict[str, object] = {"bake.mode": mode, "bake.formats": data.draw(st.sampled_from((["bop"], ["zarr"], ["bop", "zarr", "usd"])))}
    values |= {key: data.draw(VALUES[annotation]) for key, annotation in chosen}
    if cameras:
        values |= {"cameras.positions": [[0.0, 0.0, 2.0]] * cameras, "cameras.ups": [[0.0, 1.0, 0.0]] * cameras}
    try:
        config = load_config("smoke", values)
        device = GPU if cuda else CPU
        terms = plan_memory(config, device, writers=config.bake.writers or 2)
        for term in terms:
            for _, shape, _, size in term.rows:
                assert type(size) is int
                assert size >= 0
                assert all(type(extent) is int and extent >= 0 for extent in shape)
            # Without history, or without images, there is nothing to hold.
            assert term.size > 0 or term.name.startswith(("images in", "light averaged over frames", "pictures kept over frames"))
        check_memory(terms, device)
    except SynpickError as error:
        assert "\n" not in str(error)  # noqa: PT017 - most examples are errors, some are none
