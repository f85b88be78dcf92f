"""Stand-in for torch.utils.data: a DataLoader whose workers are copies made by pickle, in this process."""

import pickle
import random
from collections.abc import Callable, Iterator
from typing import Any


class DataLoader:
    """Batches of a map-style dataset, in order or shuffled."""

    def __init__(
        self, dataset: Any, batch_size: int = 1, shuffle: bool = False, num_workers: int = 0, collate_fn: Callable[[list[Any]], Any] = list
    ) -> None:
        self._workers = [pickle.loads(pickle.dumps(dataset)) for _ in range(num_workers)] or [dataset]
        self._count, self._size, self._shuffle, self._collate = len(dataset), batch_size, shuffle, collate_fn

    def __iter__(self) -> Iterator[Any]:
        order = list(range(self._count))
        if self._shuffle:
            random.Random(0).shuffle(order)
        for number, start in enumerate(range(0, self._count, self._size)):
            worker = self._workers[number % len(self._workers)]
            yield self._collate([worker[index] for index in order[start : start + self._size]])

    def __len__(self) -> int:
        return (self._count + self._size - 1) // self._size
