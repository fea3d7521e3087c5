"""Tasks that do not depend on each other, spread over the workers of a dask cluster, any of which may be lost.

In: a function, what all tasks need, the tasks, a client. Out: results, as they are finished. Called by ``recover``.
Needs the extra ``cluster`` where a client is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

__all__ = ["spread"]

ATTEMPTS = 5  # times that everything is sent anew after a worker that held it was lost


def spread(
    function: Callable[[Any, Any], Any], common: Any, tasks: Sequence[Any], client: Any
) -> Iterator[tuple[int, Any]]:
    """Number of the task and ``function(common, task)``, in the order in which workers finish.

    client: a ``dask.distributed.Client``. What a lost worker had in hand is done again by another; ``common`` is sent
    anew where its last copy went with a worker. Errors of the function are raised as they are.

    Raises
    ------
    TypeError: no client. RuntimeError: workers are lost again and again.
    """
    try:
        from dask.distributed import Client, as_completed
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise TypeError("client needs dask: pip install 'polinfer[cluster]'.") from error
    if not isinstance(client, Client):
        raise TypeError(f"client must be a dask.distributed.Client, got {type(client).__name__}.")
    from concurrent.futures import CancelledError

    left = dict(enumerate(tasks))
    for _ in range(ATTEMPTS):
        sent = client.scatter(common, broadcast=True, hash=False)
        futures = {client.submit(function, sent, task, pure=False): number for number, task in left.items()}
        for future in as_completed(futures):
            try:
                found = future.result()
            except (CancelledError, KilledWorker):
                continue
            number = futures[future]
            del left[number]
            future.release()
            yield number, found
        if not left:
            return
    raise RuntimeError(f"client lost its workers {ATTEMPTS} times; {len(left)} of {len(tasks)} tasks are not done.")
