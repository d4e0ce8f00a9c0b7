from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.selection.index import RetrievalIndex
from onthefly3r.selection.retry import RetryQueue


@pytest.fixture
def retrieval() -> RetrievalIndex:
    """Images 0 to 35 on a circle, ten degrees apart; 0 to 9 are in the map."""
    index = RetrievalIndex()
    for k in range(36):
        angle = np.radians(10.0 * k)
        index.add(k, np.array([np.cos(angle), np.sin(angle)], np.float32))
    index.accept(range(10))
    return index


def grow(queue: RetryQueue, retrieval: RetrievalIndex, new: list[int]) -> None:
    retrieval.accept(new)
    queue.placed(new, retrieval)


def test_an_image_returns_when_its_neighbourhood_has_grown(retrieval: RetrievalIndex) -> None:
    queue = RetryQueue(3)
    queue.set_aside(14, retrieval, 5)
    assert queue.take_ready(finishing=False) == []
    grow(queue, retrieval, [35, 34, 33])  # the other end
    assert queue.take_ready(finishing=False) == []
    grow(queue, retrieval, [10])
    assert queue.take_ready(finishing=False) == []  # one new neighbour
    grow(queue, retrieval, [11])
    assert queue.take_ready(finishing=False) == [14]
    assert len(queue) == 0 and queue.take_ready(finishing=False) == []


def test_attempts_are_limited_but_growth_at_the_end_gives_more(retrieval: RetrievalIndex) -> None:
    queue = RetryQueue(2)
    for attempt in (1, 2):
        queue.set_aside(14, retrieval, 5)
        assert queue.attempts == {14: attempt}
        assert queue.take_ready(finishing=True) == [14]
    queue.set_aside(14, retrieval, 5)
    assert queue.take_ready(finishing=True) == []
    grow(queue, retrieval, [10, 11])
    assert queue.take_ready(finishing=False) == []  # too often refused while images still arrive
    assert queue.take_ready(finishing=True) == [14]


def test_fewer_rejections_go_first(retrieval: RetrievalIndex) -> None:
    queue = RetryQueue(3)
    for index in (20, 21, 20, 12):
        queue.set_aside(index, retrieval, 5)
    assert queue.take_ready(finishing=True) == [12, 21, 20]


def test_placed_images_are_forgotten_and_no_retries_means_none(retrieval: RetrievalIndex) -> None:
    queue = RetryQueue(3)
    queue.set_aside(14, retrieval, 5)
    grow(queue, retrieval, [14])
    assert len(queue) == 0
    never = RetryQueue(0)
    never.set_aside(15, retrieval, 5)
    grow(never, retrieval, [10, 11, 12, 13])
    assert never.take_ready(finishing=True) == []
    assert never.attempts == {15: 1}


def test_retries_count_tries_and_not_rejections(retrieval: RetrievalIndex) -> None:
    queue = RetryQueue(2)
    queue.set_aside(14, retrieval, 5)
    assert (queue.attempts, queue.retries) == ({14: 1}, {})
    queue.take_ready(finishing=True)
    assert (queue.attempts, queue.retries) == ({14: 1}, {14: 1})
    queue.set_aside(14, retrieval, 5)
    assert (queue.attempts, queue.retries) == ({14: 2}, {14: 1})
    never = RetryQueue(0)
    never.set_aside(14, retrieval, 5)
    assert never.take_ready(finishing=True) == [] and never.retries == {}
