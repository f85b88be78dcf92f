"""The report on photographs: known scores, augmentation that keeps labels on objects, tiny trainings; skipped without PyTorch."""

import dataclasses
import time

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", exc_type=ImportError)
training = pytest.importorskip("tools.reports.real.training", exc_type=ImportError)

from synpick_warp.errors import ConfigError  # noqa: E402
from synpick_warp.system.hardware.device import pick_device  # noqa: E402
from tools.reports.real import __main__ as report  # noqa: E402
from tools.reports.real.training import Recipe, ViewPool, prepare_batch, segmentation_loss, train, warp_views  # noqa: E402

RECIPE = Recipe(views=8, passes=1.0, batch=4, width=8, seconds=10.0, capacity=8)


def test_a_crop_has_the_pixels_of_a_part_of_the_image():
    classes = torch.arange(48)[:, None] * 100 + torch.arange(64)
    images = classes[None, None].float().expand(5, 3, -1, -1)
    torch.manual_seed(0)
    crops, labels = warp_views(images / 1e4, classes.expand(5, -1, -1), dataclasses.replace(RECIPE, scale=1.0, rotation=0.0), crop=0.5)
    assert crops.shape == (5, 3, 24, 32)
    assert len({int(one[0, 0]) for one in labels}) > 1
    assert ((labels[:, 1:] - labels[:, :-1]) == 100).all()
    assert ((labels[:, :, 1:] - labels[:, :, :-1]) == 1).all()
    assert ((crops[:, 0] * 1e4 - labels).abs() <= 51).all()


def test_scores_of_a_known_prediction():
    truth = np.zeros((2, 10), np.uint8)
    truth[0, :4], truth[1, :2] = 1, 2
    found = truth.copy()
    found[0, 2:4], found[0, 8] = 0, 3
    made = report.score([(found, truth)], 4)
    assert made.iou == {1: 0.5, 2: 1.0}
    assert made.mean_iou == 0.75
    assert made.found == 0.5
    assert made.background == pytest.approx(1 / 14)


def test_predictions_have_the_size_of_the_image():
    """A network that names bright pixels, and sees an image of half the size."""

    def network(image):
        bright = (image[:, :1].float() > 100).float()
        return torch.cat((1 - bright, bright), dim=1)

    color = np.zeros((24, 40, 3), np.uint8)
    color[4:12, 10:28] = 200
    found = report.predict(network, color, (20, 12), torch.device("cpu"))
    np.testing.assert_array_equal(found, color[..., 0] > 0)


@pytest.mark.parametrize(("progress", "size"), [(0.0, (48, 64)), (0.69, (48, 64)), (0.7, (48, 64))])
def test_images_grow_over_the_schedule(progress, size):
    """Images are downsampled by two at first; later they are crops at full resolution, half as wide and high."""
    classes = (torch.arange(96)[:, None] // 8 % 2 + torch.zeros(128, dtype=torch.int64)).expand(2, -1, -1)
    recipe = dataclasses.replace(RECIPE, scale=1.0, rotation=0.0, jitter=0.0, jpeg=0.0, half=0.7)
    images, labels = prepare_batch((classes[:, None] * 255).expand(-1, 3, -1, -1), classes, recipe, progress)
    assert labels.shape[1:] == images.shape[2:] == size
    assert torch.equal(images[:, 0] > 0, labels == 1)
    assert int(labels[0, :, 0].diff().abs().sum()) == (11 if progress < 0.7 else pytest.approx(5, abs=1))


def test_the_interval_is_students():
    assert report.interval([1.0, 2.0, 3.0]) == "(-0.484 to 4.48)"
    assert report.interval([1.0, 2.0]) == "(1, 2)"
    assert report.interval([1.0]) == ""


def test_augmentation_moves_labels_with_the_image():
    classes = torch.zeros(6, 40, 60, dtype=torch.int64)
    classes[:, 10:30, 20:45] = 7
    torch.manual_seed(0)
    images, labels = warp_views((classes[:, None] / 7.0).expand(-1, 3, -1, -1), classes, RECIPE)
    assert ((images[:, 0] > 0.5) != (labels == 7)).float().mean() < 0.01
    assert (labels != classes).float().mean() > 0.02


@pytest.mark.parametrize("quality", [30, 75])
def test_jpeg_is_opencvs(quality):
    """OpenCV rounds YCbCr to 8 bits before the DCT: coefficients differ by less than half of the compression error."""
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8), (5, 5), 1.0)
    image = cv2.resize(image, (128, 96))
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    expected = cv2.imdecode(cv2.imencode(".jpg", image, options)[1], cv2.IMREAD_COLOR)[..., ::-1].astype(np.float64)
    tensor = torch.from_numpy(image[..., ::-1].copy()).permute(2, 0, 1)[None] / 255.0
    made = 255.0 * training.compress_views(tensor, torch.tensor([quality]))[0].permute(1, 2, 0).numpy()
    assert np.abs(made - expected).mean() < 0.5 * np.abs(expected - image[..., ::-1]).mean()
    assert np.abs(made - expected).max() < 20.0


def test_the_loss_of_known_logits():
    classes = torch.tensor([[[0, 0, 1, 2]]])
    exact = 50.0 * torch.nn.functional.one_hot(classes, 4).permute(0, 3, 1, 2).float()
    assert float(segmentation_loss(exact, classes, 1.0)) == pytest.approx(0.0, abs=1e-6)
    even = torch.zeros(1, 4, 1, 4)
    # Each object has one pixel, of which a quarter is predicted, as of the three others: Dice 2 x 1/4 / (1 + 1).
    entropy = float(segmentation_loss(even, classes, 0.0))
    assert entropy == pytest.approx(np.log(4.0))
    assert float(segmentation_loss(even, classes, 2.0)) - entropy == pytest.approx(2 * 0.75)


def test_logits_are_those_of_every_second_pixel():
    """So the training compares them; those between are interpolated, without a shift."""
    network, image = training.ResidualNetwork(5, 4), torch.randint(256, (2, 3, 32, 64), dtype=torch.uint8)
    half = network(image)
    assert half.shape == (2, 5, 16, 32)
    network.head.register_forward_hook(lambda *_: half)  # In `eval`, statistics are not those of the batch.
    whole = network.eval()(image)
    assert whole.shape == (2, 5, 32, 64)
    torch.testing.assert_close(whole[..., ::2, ::2], half)
    torch.testing.assert_close(whole[..., 1:-1:2, ::2], (half[..., 1:, :] + half[..., :-1, :]) / 2)


def test_images_are_blurred_or_sharpened():
    """A flat image stays as it is; an edge becomes softer, or overshoots by at most SHARPENING times what a blur takes off."""
    flat, edge = torch.full((64, 3, 8, 8), 0.5), torch.full((64, 3, 8, 8), 0.4)
    edge[..., 4:] = 0.6
    torch.manual_seed(0)
    torch.testing.assert_close(training.jitter_views(flat, 0.0), flat)
    steps = training.jitter_views(edge, 0.0)[:, 0, 4, 4] - 0.6
    assert -0.2 / 3 <= float(steps.min()) < -0.05
    assert 0.05 < float(steps.max()) <= training.SHARPENING * 0.2 / 3
    assert float((steps > 0).float().mean()) == pytest.approx(training.SHARPENING / (1 + training.SHARPENING), abs=0.15)


def test_a_pool_replaces_views_once_it_is_full():
    pool = ViewPool(4, 0)
    batches = iter([(torch.full((3, 3, 2, 2), index, dtype=torch.uint8), torch.full((3, 2, 2), index)) for index in range(6)])
    assert pool.fill(batches, 4)
    assert (pool.count, pool.seen) == (4, 6)
    assert not pool.fill(batches, 40)
    assert (pool.count, pool.seen) == (4, 18)
    images, classes = pool.draw(9)
    assert images.shape == (9, 3, 2, 2)
    assert torch.equal(images[:, 0], classes)


def draw(views: int, pause: float = 0.0):
    """Batches of four images of a bright square, each after a delay of `pause` seconds."""
    for _ in range(views // 4):
        time.sleep(pause)
        classes = torch.zeros(4, 16, 16, dtype=torch.uint8)
        classes[:, 4:12, 4:12] = 1
        yield (classes[:, None] * 200).expand(-1, 3, -1, -1), classes


def test_a_pool_that_fills_slowly_leaves_time_to_train():
    recipe = dataclasses.replace(RECIPE, views=4000, capacity=4000, width=2, seconds=2.0, jpeg=0.0)
    trained = train(draw(4000, 0.05), recipe, 2, torch.device("cpu"), 0)
    assert 0 < trained.views < 4000
    assert trained.stream_seconds < trained.seconds
    assert trained.samples >= recipe.batch


def test_views_beyond_the_pool_come_while_the_network_trains():
    recipe = dataclasses.replace(RECIPE, views=16, width=2, seconds=60.0, half=0.5)
    trained = train(draw(16), recipe, 2, torch.device("cpu"), 0)
    assert trained.views == 16
    assert trained.samples == 16


def test_views_keep_ahead_of_samples(monkeypatch):
    """An eighth of the views comes first, then a batch of four for each 16 samples."""
    steps, step = [], training._Trainer.step
    monkeypatch.setattr(training._Trainer, "step", lambda self, pool: (steps.append(pool.seen), step(self, pool)))
    recipe = dataclasses.replace(RECIPE, views=40, capacity=40, width=2, seconds=600.0, passes=5.0)
    train(draw(40), recipe, 2, torch.device("cpu"), 0)
    assert steps == [min(40, 8 + 4 * (1 + step // 4)) for step in range(50)]


def test_images_and_objects_that_networks_cannot_have_are_named():
    def sizes(resolution: str) -> list[tuple[int, int]]:
        options = ["--real", "frames", "--config", "synpick", "--set", f"cameras.resolution={resolution}"]
        return report.settings_of(report.make_options().parse_args(options), 0, pick_device("cpu")).rig.sizes

    assert sizes("[96,72]")[0] == (192, 144)
    with pytest.raises(ConfigError, match=r"200x192 px .* multiples of 16"):
        sizes("[100,96]")
    with pytest.raises(ConfigError, match="obj_id 22; allowed here: 1 to 21"):
        report.check_ids([np.zeros((2, 2), np.uint8), np.full((3, 2), 22, np.uint8)])
