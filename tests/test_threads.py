"""Linear algebra keeps to one thread while a run or a worker is at work."""

import cv2
import scipy.linalg  # noqa: F401  # its library is told as NumPy's is
from threadpoolctl import threadpool_info, threadpool_limits

from polmvs.parallel import Workers
from polmvs.pipeline.runner import Job, open_run
from polmvs.threads import one_blas_thread


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def cores_taken(_):
    return blas_threads(), cv2.getNumThreads()


def test_the_users_threads_are_given_back() -> None:
    with threadpool_limits(2, user_api="blas"):
        with one_blas_thread():
            assert blas_threads() == {1}
        assert blas_threads() == {2}


def test_each_worker_keeps_to_one_core(monkeypatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")  # what a worker starts with
    with Workers(2) as workers:
        assert list(workers.map(cores_taken, range(2))) == [({1}, 1)] * 2


def test_a_run_keeps_to_one_thread(demo_capture, tmp_path) -> None:
    job = Job(capture=demo_capture, out=tmp_path / "out")
    run = open_run(job, table=(), min_images=3, taken_over=())
    with threadpool_limits(2, user_api="blas"), run:
        assert blas_threads() == {1}
