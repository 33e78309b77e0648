"""Ranks as threads of this process: what they do together, without starting any."""

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor

from mtl_bench.core.ranks import Ranks

Found = TypeVar("Found")


class _Meeting:
    """Where threads hand over what each of them has."""

    def __init__(self, size: int) -> None:
        self.barrier = threading.Barrier(size)
        self.brought: list[Any] = [None] * size

    def exchange(self, rank: int, value: Any) -> list[Any]:
        self.brought[rank] = value
        self.barrier.wait()
        found = list(self.brought)
        self.barrier.wait()  # until all have seen them
        return found


class Thread(Ranks):
    def __init__(self, rank: int, size: int, meeting: _Meeting) -> None:
        self.rank, self.size, self._meeting = rank, size, meeting

    def gather(self, value: Any) -> list[Any]:
        return [json.loads(text) for text in self._meeting.exchange(self.rank, json.dumps(value))]

    def to_first(self, value: Any) -> list[Any]:
        found = self._meeting.exchange(self.rank, value)
        return found if self.first else []

    def sum_(self, tensor: Tensor) -> Tensor:
        brought = self._meeting.exchange(self.rank, tensor.detach().clone())
        with torch.no_grad():
            return tensor.copy_(sum(brought[1:], brought[0]))

    def join(self, tensor: Tensor) -> Tensor:
        return torch.cat(self._meeting.exchange(self.rank, tensor.detach().clone()))


def side_by_side(size: int, work: Callable[[Ranks], Found]) -> list[Found]:
    """What each of so many ranks makes of it; an error of any of them."""
    meeting = _Meeting(size)

    def of_rank(rank: int) -> Found:
        try:
            return work(Thread(rank, size, meeting))
        except BaseException:
            meeting.barrier.abort()  # else the others would wait
            raise

    with ThreadPoolExecutor(size) as pool:
        futures = [pool.submit(of_rank, rank) for rank in range(size)]
    errors = [error for future in futures if (error := future.exception()) is not None]
    for error in sorted(errors, key=lambda e: isinstance(e, threading.BrokenBarrierError)):
        raise error
    return [future.result() for future in futures]
