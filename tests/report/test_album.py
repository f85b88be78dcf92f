"""Pictures: what is encoded is read back, and the budget is never exceeded."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from synpick_warp.apps.report.album import BUDGET, Album, EncodedPicture, Section, encode_ids, encode_photo, shrink


def test_ids_are_exact_and_photos_similar():
    ids = np.arange(256, dtype=np.uint8).reshape(8, 32)
    assert (cv2.imdecode(np.frombuffer(encode_ids(ids).data, np.uint8), cv2.IMREAD_UNCHANGED) == ids).all()
    photo = np.full((40, 60, 3), (30, 90, 200), np.uint8)
    picture = encode_photo(photo)
    assert picture.kind == "webp"
    assert np.abs(cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR).astype(int) - photo).max() < 8


def test_shrinking_keeps_ids_and_never_enlarges():
    ids = np.kron(np.array([[1, 7], [9, 200]], np.uint8), np.ones((50, 50), np.uint8))
    assert set(np.unique(shrink(ids, 10, smooth=False))) == {1, 7, 9, 200}
    assert shrink(ids, 10, smooth=False).shape == (10, 10)
    assert shrink(ids, 1000) is ids


@pytest.mark.parametrize("size", [1, 2, 3, 4, 1000])
def test_the_size_of_a_picture_is_that_of_its_base64(size):
    picture = EncodedPicture("png", bytes(size))
    assert picture.size == len(base64.b64encode(picture.data))


def test_pictures_are_added_together_or_not_at_all():
    album = Album(budget=4000)
    share = int(4000 * Section.ATTEMPTS.value)
    small = EncodedPicture("png", bytes(300))
    assert album.add(Section.ATTEMPTS, [small]) == [0]
    assert album.add(Section.ATTEMPTS, [small, small]) is None
    assert album.left(Section.ATTEMPTS) == share - 400
    assert album.add(Section.FRAMES, [small, small]) == [1, 2]
    assert [kind for kind, _ in album.encoded()] == 3 * ["png"]
    assert sum(len(data) for _, data in album.encoded()) == sum(album.spent.values())


def test_the_shares_are_the_whole_budget():
    assert sum(section.value for section in Section) == pytest.approx(1.0)
    assert BUDGET == 25_000_000
