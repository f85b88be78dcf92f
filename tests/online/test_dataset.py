"""PyTorch dataset of a stream, with PyTorch itself; skipped where it is not installed."""

import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.schema import LAYERS, Config
from synpick_warp.errors import ConfigError
from tests.online.conftest import LAYERED, tiny
from tests.worlds.small_worlds import settings

torch = pytest.importorskip("torch", exc_type=ImportError)
dataset = pytest.importorskip("synpick_warp.online.dataset", exc_type=ImportError)  # A stand-in for PyTorch lacks its iterable datasets.
StreamDataset, FIELDS = dataset.StreamDataset, dataset.FIELDS
loader = torch.utils.data.DataLoader


def episodes_of(batches) -> list[int]:
    return sorted({int(index) for batch in batches for index in torch.atleast_1d(batch["episode"])})


@pytest.fixture(scope="module")
def short() -> Config:
    """One world; an episode has six frames."""
    return tiny(bake__worlds=1, cameras__resolution=[32, 18])


def test_tensors_are_the_stream(tmp_path):
    """Each field against the reader of a bake, and images in the buffers themselves."""
    config = settings(**LAYERED | {"bake.episodes": 1})
    synpick_warp.bake(config, tmp_path / "set")
    data = synpick_warp.open(tmp_path / "set")
    count = 0
    views = StreamDataset(config, fields=(*FIELDS, "normals", "flow"))
    for batch in loader(views, batch_size=None):
        assert not batch["rgb"].is_contiguous()
        for row in range(len(batch["rgb"])):
            view = data[0].view(int(batch["frame"][row]), int(batch["camera"][row]))
            sample = {name: np.asarray(values[row].cpu()) for name, values in batch.items()}
            there = sample["object_ids"] >= 0
            np.testing.assert_array_equal(sample["rgb"], view.rgb.transpose(2, 0, 1))
            np.testing.assert_allclose(sample["depth"][0], view.depth, rtol=1e-6)
            np.testing.assert_array_equal(sample["classes"], view.layer("classes"))
            np.testing.assert_array_equal(sample["object_ids"][there], view.object_ids)
            np.testing.assert_array_equal(sample["masks"][there], view.masks)
            np.testing.assert_array_equal(sample["amodal_masks"][there], view.amodal_masks)
            np.testing.assert_array_equal(sample["instances"] == 1, view.masks[0])
            np.testing.assert_allclose(sample["visibility"][there], view.visibility, rtol=1e-6)
            np.testing.assert_allclose(sample["poses"][there], view.object_to_camera, atol=1e-6)
            seen = view.visible_boxes[:, 2] >= 0
            for name, boxes in (("boxes", view.visible_boxes), ("amodal_boxes", view.boxes)):
                corners = np.concatenate((boxes[:, :2], boxes[:, :2] + boxes[:, 2:] + 1), axis=1)
                np.testing.assert_array_equal(sample[name][there][seen], corners[seen])
            assert not sample["boxes"][~there].any()
            count += 1
    assert count == 3 * len(data[0])


def test_views_are_shuffled_and_collated(short):
    views = StreamDataset(short, fields=("rgb", "object_ids"), episodes=1, batched=False, shuffle=8)
    batches = list(loader(views, batch_size=4))
    order = [(int(f), int(c)) for batch in batches for f, c in zip(batch["frame"], batch["camera"], strict=True)]
    assert sorted(order) == [(frame, camera) for frame in range(len(order) // 3) for camera in range(3)] != order
    assert batches[0]["rgb"].shape == (4, 3, 18, 32)
    again = [(int(f), int(c)) for batch in loader(views, batch_size=4) for f, c in zip(batch["frame"], batch["camera"], strict=True)]
    assert again == order


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python 3.12 warns of threads at the fork of a worker.
def test_workers_and_processes_share_the_episodes_out():
    """On the CPU, since workers cannot share a GPU."""
    short = tiny(bake__worlds=1, bake__device="cpu", cameras__resolution=[32, 18])
    views = StreamDataset(short, fields=("rgb",), episodes=range(8), shard=(1, 2), stride=4, cameras=(0,))
    batches = list(loader(views, batch_size=None, num_workers=2))
    assert episodes_of(batches) == [1, 3, 5, 7]
    alone = {(int(batch["episode"]), int(batch["frame"])): batch["rgb"].clone() for batch in loader(views, batch_size=None)}
    assert len(alone) == len(batches)
    for batch in batches:
        np.testing.assert_array_equal(batch["rgb"], alone[int(batch["episode"]), int(batch["frame"])])


def test_epochs_continue_with_new_episodes_or_repeat(short):
    choice = {"fields": (), "stride": 99, "cameras": (0,)}
    fresh, same = StreamDataset(short, episodes=range(2, 4), **choice), StreamDataset(short, episodes=2, fresh=False, **choice)
    for views, expected in ((fresh, [[2, 3], [4, 5]]), (same, [[0, 1], [0, 1]])):
        seen = []
        for epoch in range(2):
            views.set_epoch(epoch)
            seen.append(episodes_of(loader(views, batch_size=None)))
        assert seen == expected


def test_mistakes_are_told_before_the_first_epoch(short, monkeypatch):
    for wrong, message in (
        ({"fields": ("colour",)}, "there is no field colour; fields: rgb"),
        ({"fields": ("normals",)}, "others are layers that render.layers names"),
        ({"shuffle": -5, "batched": False}, "shuffle is -5; allowed: a number of views"),
        ({"shuffle": 5}, "set batched=False"),
        ({"cameras": (7,)}, "cameras are"),
        ({"worlds": -1}, "bake.worlds is -1"),
        ({"episodes": range(0)}, "episodes are"),
    ):
        with pytest.raises(ConfigError, match=message):
            StreamDataset(short, **wrong)
    with pytest.raises(TypeError, match="has no argument 'world'"):
        StreamDataset(short, world=3)
    monkeypatch.setattr(dataset, "get_worker_info", lambda: type("Info", (), {"id": 0, "num_workers": 2}))
    monkeypatch.setattr(dataset, "pick_device", lambda name: type("Device", (), {"is_cuda": True, "alias": "cuda:0"}))
    with pytest.raises(ConfigError, match="workers cannot share cuda:0; use num_workers=0"):
        next(iter(StreamDataset(short)))
    assert set(LAYERS) & set(FIELDS) == {"classes"}
