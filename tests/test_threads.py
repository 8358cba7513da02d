"""Linear algebra keeps to one thread while a run or a worker is at work."""

import cv2
import scipy.linalg  # noqa: F401  # its library is told as NumPy's is
from threadpoolctl import threadpool_info, threadpool_limits

from polmvs.parallel import Workers
from polmvs.pipeline.runner import Job, open_run
from polmvs.pipeline.stage_table import StageSpec
from polmvs.threads import one_thread_each


def threads(kind):
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == kind}


def cores_taken(_):
    return threads("blas"), cv2.getNumThreads()


def test_the_users_threads_are_given_back() -> None:
    with threadpool_limits(2, user_api="blas"):
        with one_thread_each():
            assert threads("blas") == {1}
        assert threads("blas") == {2}


def test_each_worker_keeps_to_one_core(monkeypatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")  # what a worker starts with
    with Workers(2) as workers:
        assert list(workers.map(cores_taken, range(2))) == [({1}, 1)] * 2


def test_a_run_keeps_to_one_thread(demo_capture, tmp_path) -> None:
    seen = []
    stage = StageSpec(
        name="toy",
        command="toy",
        writes=(),
        work=lambda run: seen.append(threads("blas") | threads("openmp")),
        result=type(None),
    )
    job = Job(capture=demo_capture, out=tmp_path / "out")
    with threadpool_limits(2), open_run(job, table=(stage,), min_images=3, taken_over=()) as run:
        run.do(stage)
    assert seen == [{1}]
