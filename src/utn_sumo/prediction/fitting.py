"""Fits of the forecasts' models, here or in a process of their own, so that no plan ever waits for one.

A job and its answer are plain data. The process is `python -m utn_sumo.prediction.fitting`: a job a line in, an answer
a line out, in JSON, until its input ends.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from queue import SimpleQueue
from threading import Thread
from typing import Any, Protocol

import numpy as np

from utn_sumo.contract import Floats
from utn_sumo.errors import UtnError

LEAST_KNOWN = 15
"""Values of a series, without which it is left out."""
ORDERS = (((1, 0, 1), (0, 0)), ((1, 0, 1), (1, 1)))
"""What is fitted, order and spatial orders; the best by BIC serves, if it beats the assumption of no structure at all.

A level that is correlated in time and counted at random is an ARMA(1, 1).
"""
MOST_ITERATIONS = 300
"""Of a fit: where coefficients nearly cancel each other it is slow, and what ends before its maximum is not used."""
LARGEST_ROOT = 0.999
"""Of a fit that is used: nearer to 1 rounding makes of its likelihood whatever it likes."""
FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError, UtnError)
"""What a fit may end in on numbers that no model suits."""


@dataclass(frozen=True)
class Job:
    """Series to be fitted together, in groups: rows (T, n), weights W_1.. (n, n) each."""

    rows: list[list[float]]
    groups: list[list[int]]
    weights: list[list[list[float]]]
    centred: bool
    """Whether the rows are known to vary about 0."""


@dataclass(frozen=True)
class Fit:
    """What was found for some of the series: without `params` their mean is the best that can be said."""

    series: list[int]
    mean: list[float]
    order: tuple[int, int, int] = (0, 0, 0)
    spatial: tuple[int, int] = (0, 0)
    params: list[float] | None = None


class Fitter(Protocol):
    """Whoever does the jobs, one after the other."""

    def submit(self, job: Job) -> None:
        """Take on a job."""
        ...

    def result(self) -> list[Fit]:
        """The fits of the oldest job whose result was not asked for yet; none if it came to nothing."""
        ...

    def close(self) -> None:
        """Take on no more."""
        ...


class Here:
    """Does a job when its result is wanted."""

    def __init__(self) -> None:
        self._jobs: list[Job] = []

    def submit(self, job: Job) -> None:
        self._jobs.append(job)

    def result(self) -> list[Fit]:
        return fit(self._jobs.pop(0))

    def close(self) -> None:
        self._jobs.clear()


class Background:
    """Has the jobs done by a process of its own, which starts at once: statsmodels alone takes it seconds to import.

    A thread hands them over one by one and takes the answers: pipes hold little, and whoever writes waits.
    """

    def __init__(self) -> None:
        # In a session of its own Ctrl-C does not reach it; it ends with its input.
        self._process = subprocess.Popen(  # noqa: S603 - this very module
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._answers: SimpleQueue[str] = SimpleQueue()
        # A daemon, so that who forgets to close it can end all the same.
        self._thread = Thread(target=self._hand_over, daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> None:
        self._jobs.put(job)

    def result(self) -> list[Fit]:
        line = self._answers.get()
        return [Fit(**each) for each in json.loads(line)] if line else []

    def close(self) -> None:
        self._process.kill()
        self._jobs.put(None)
        self._thread.join()
        self._process.wait()

    def _hand_over(self) -> None:
        """Answer each job, with an empty line if the process has died."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        while (job := self._jobs.get()) is not None:
            line = ""
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(json.dumps(asdict(job)) + "\n")
                self._process.stdin.flush()
                line = self._process.stdout.readline()
            self._answers.put(line)
        self._process.stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()


def fit(job: Job) -> list[Fit]:
    """The best models of a job's groups by BIC, as far as there are any."""
    rows = np.array(job.rows, dtype=np.float64)
    weights = [np.array(matrix, dtype=np.float64) for matrix in job.weights]
    found = [_best(rows, group, weights, centred=job.centred) for group in job.groups]
    return [each for each in found if each is not None]


def model(
    rows: Floats, order: Sequence[int], spatial: Sequence[int], weights: Sequence[Floats], *, centred: bool
) -> Any:
    """The STARIMA of these rows (T, n)."""
    from utn_sumo.prediction.starima import STARIMA  # noqa: PLC0415 - statsmodels

    p, d, q = order
    m, n = spatial
    return STARIMA(rows, (p, d, q), (m, n), weights[: max(m, n)], trend="n" if centred else "c")


def _best(rows: Floats, series: list[int], weights: Sequence[Floats], *, centred: bool) -> Fit | None:
    heard = [each for each in series if np.count_nonzero(~np.isnan(rows[:, each])) >= LEAST_KNOWN]
    # A series that never varies has no structure, and STARIMA would refuse the others with it.
    series = [each for each in heard if np.nanmin(rows[:, each]) < np.nanmax(rows[:, each])]
    if not series:
        return None
    rows, weights = rows[:, series], [matrix[np.ix_(series, series)] for matrix in weights]
    known = np.count_nonzero(~np.isnan(rows))
    mean = np.zeros(len(series)) if centred else np.nanmean(rows, axis=0)
    best = Fit(series, mean.tolist())
    variance = float(np.nanmean((rows - mean) ** 2))
    least = known * (np.log(2 * np.pi * variance) + 1) + (1 if centred else 1 + len(series)) * np.log(known)
    for order, spatial in ORDERS:
        if max(spatial) > (len(weights) if len(series) > 1 else 0):
            continue
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                fitted = model(rows, order, spatial, weights, centred=centred)
                results = fitted.fit(method="conditional", maxiter=MOST_ITERATIONS)
        except FAILURES:
            continue
        root = max(fitted.form.ar_root(results.params), fitted.form.ma_root(results.params))
        if root >= LARGEST_ROOT or not results.mle_retvals["converged"]:
            continue
        criterion = -2 * results.llf + len(results.params) * np.log(known)
        if criterion < least:
            best, least = Fit(series, mean.tolist(), order, spatial, np.asarray(results.params).tolist()), criterion
    return best


def serve() -> None:
    """Answer jobs until the input ends."""
    # Small matrices: more threads than one only wait for each other.
    from threadpoolctl import threadpool_limits  # noqa: PLC0415 - only this process needs it

    import utn_sumo.prediction.starima  # noqa: F401, PLC0415 - now, while nobody waits

    threadpool_limits(1)
    for line in sys.stdin:
        sys.stdout.write(json.dumps([asdict(each) for each in fit(Job(**json.loads(line)))]) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    serve()
