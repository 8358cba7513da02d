"""Work on a Dask cluster: the same results as here, and one clear line where it cannot be."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import content_of

import polmvs
import polmvs.cluster
from polmvs.cluster import Cluster, ClusterPatience, TlsFiles
from polmvs.colmap.models import write_model
from polmvs.config import RunOptions
from polmvs.errors import DataError, OptionError
from polmvs.parallel import Workers
from polmvs.pipeline.stages.images import write_images
from polmvs.polarization.capture import open_capture
from polmvs.synthetic.printed import orbit_views
from polmvs.synthetic.printed_capture import (
    Part,
    camera_of,
    printed_model,
    scene_of,
    write_printed_capture,
)

distributed = pytest.importorskip("distributed")

QUICK = ClusterPatience(connect_s=2, workers_s=1, return_s=20)


def local_cluster(num_workers: int = 2, port: int = 0, **options):
    return distributed.LocalCluster(
        n_workers=num_workers,
        threads_per_worker=1,
        scheduler_port=port,
        dashboard_address=":0",
        worker_dashboard_address=None,
        silence_logs=50,
        **options,
    )


@pytest.fixture(scope="module")
def address():
    with local_cluster() as cluster:
        yield cluster.scheduler_address


def total(values, factor):
    return float(values.sum() * factor)


def fail(index):
    raise DataError("a.png", f"is number {index}.")


def die_once(folder, index):
    """The first of all tasks to come here takes its worker with it."""
    try:
        (folder / "died").touch(exist_ok=False)
    except FileExistsError:
        return index
    os._exit(9)


def die(index):
    os._exit(9)


def wait_for(path, index):
    while not path.exists():
        time.sleep(0.05)
    return index


def test_same_files_from_each_backend(address, demo_capture, tmp_path) -> None:
    capture = open_capture(demo_capture)
    backends = {
        "here": Workers(),
        "processes": Workers(2),
        "cluster": Workers.of_cluster(address, [tmp_path], [demo_capture]),
    }
    assert backends["cluster"].num == 2
    content = []
    for name, workers in backends.items():
        with workers:
            write_images(capture, tmp_path / name, workers=workers)
        content.append(content_of(tmp_path / name))
    assert len(content[0]) == 10
    assert content[0] == content[1] == content[2]
    # The probes of the storage are gone.
    assert {path.name for path in tmp_path.iterdir()} == set(backends)


def test_large_arguments_and_order(address) -> None:
    values = [np.full(50_000, float(index)) for index in range(6)]
    with Workers.of_cluster(address) as workers:
        found = list(workers.map(total, values, range(6)))
    assert found == [50_000.0 * index * index for index in range(6)]


def test_errors_of_tasks_arrive_whole(address) -> None:
    with Workers.of_cluster(address) as workers, pytest.raises(DataError, match=r"^a\.png: is nu"):
        list(workers.map(fail, range(2)))


@pytest.mark.slow
def test_a_scheduler_that_comes_back(tmp_path) -> None:
    first = local_cluster()
    port = int(first.scheduler_address.rpartition(":")[2])
    cluster = Cluster(first.scheduler_address, patience=ClusterPatience(workers_s=10))
    results = Workers(2, cluster).map(wait_for, [tmp_path / "go"] * 3, range(3))
    first.close()
    with local_cluster(port=port):
        (tmp_path / "go").touch()
        assert list(results) == [0, 1, 2]
        cluster.close(cancel=False)


@pytest.mark.slow
def test_a_scheduler_that_does_not(tmp_path) -> None:
    patience = ClusterPatience(connect_s=0.5, workers_s=0.5, return_s=1)
    first = local_cluster(1)
    cluster = Cluster(first.scheduler_address, patience=ClusterPatience())
    cluster.patience = patience
    results = Workers(2, cluster).map(wait_for, [tmp_path / "go"], [0])
    first.close()
    with pytest.raises(DataError, match=r"lost and did not come back.*`run\.resume`"):
        list(results)
    cluster.close(cancel=True)


def test_no_scheduler() -> None:
    for bad in ("tcp://127.0.0.1:9", "nonsense://x"):
        with pytest.raises(DataError, match=f"{bad}: no Dask scheduler answers"):
            Cluster(bad, patience=QUICK)


def test_no_workers() -> None:
    with (
        local_cluster(0) as cluster,
        pytest.raises(DataError, match=r"has no workers\. Start some: dask worker tcp://"),
    ):
        Cluster(cluster.scheduler_address, patience=QUICK)


def test_workers_of_another_version(address, monkeypatch) -> None:
    other = {**polmvs.cluster.own_versions(), "polmvs": "9.9"}
    monkeypatch.setattr(polmvs.cluster, "own_versions", lambda: other)
    with pytest.raises(DataError, match=r"the worker has polmvs .*, this program 9\.9"):
        Cluster(address)


@pytest.mark.skipif(not Path("/proc/self/cwd").exists(), reason="needs a path that differs")
def test_storage_that_workers_do_not_see(address, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # the workers stay where they are
    with pytest.raises(DataError, match="the worker does not share /proc/self/cwd"):
        Cluster(address, [Path("/proc/self/cwd")])
    assert not list(tmp_path.iterdir())
    (tmp_path / "capture").mkdir()
    with pytest.raises(DataError, match=r"capture: the worker tcp.* does not see it"):
        Cluster(address, [], [Path("/proc/self/cwd/capture")])
    with pytest.raises(DataError, match=r"none: cannot be written: No such file"):
        Cluster(address, [tmp_path / "none"])


def test_without_dask(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OptionError, match=r"`run\.scheduler` needs .*'\.\[dask\]'"):
        Cluster("tcp://127.0.0.1:9")


@pytest.mark.slow
def test_commands_on_a_cluster(cli, address, tmp_path) -> None:
    views, scene = orbit_views(4, camera_of(96)), scene_of(Part.BOARD)
    write_printed_capture(tmp_path / "capture", views, scene)
    write_model(printed_model(scene, views, num_points=400), tmp_path / "model")
    content = []
    for name, where in (("here", ()), ("there", ("--scheduler", address))):
        out = tmp_path / name
        first = cli("sfm", tmp_path / "capture", out, "--sparse", tmp_path / "model", *where)
        second = cli("normals", tmp_path / "capture", out, "--resume", *where)
        assert (first[0], second[0]) == (0, 0), first[2] + second[2]
        content.append(content_of(out / "images") | content_of(out / "maps"))
    assert len(content[0]) == 4 * 6
    assert content[0] == content[1]


def test_python_takes_the_address(demo_capture, tmp_path) -> None:
    for call in (polmvs.reconstruct, polmvs.compare):
        with pytest.raises(DataError, match="nonsense://x: no Dask scheduler answers"):
            call(demo_capture, tmp_path / "out", scheduler="nonsense://x")
    assert not (tmp_path / "out").exists()


def pem_files(folder: Path, name: str, *, signed_by: str | None = None) -> TlsFiles:
    """A certificate and its key, signed by another one or by itself."""
    key, cert, asked = (folder / f"{name}.{end}" for end in ("key", "pem", "csr"))
    make = ["openssl", "req", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-subj"]
    if signed_by is None:
        calls = [[*make, f"/CN={name}", "-x509", "-days", "2", "-out", cert]]
    else:
        ca = ["-CA", folder / f"{signed_by}.pem", "-CAkey", folder / f"{signed_by}.key"]
        signing = ["openssl", "x509", "-req", "-in", asked, *ca, "-CAcreateserial", "-days", "2"]
        calls = [[*make, f"/CN={name}", "-out", asked], [*signing, "-out", cert]]
    for call in calls:
        subprocess.run(call, check=True, capture_output=True)
    return TlsFiles(ca=folder / f"{signed_by or name}.pem", cert=cert, key=key)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")
def test_encrypted_connections(tmp_path) -> None:
    """Certificates of both sides are asked for; others of the same name do not do."""
    pem_files(tmp_path, "ca")
    own = pem_files(tmp_path, "own", signed_by="ca")
    pem_files(tmp_path, "other")
    foreign = pem_files(tmp_path, "foreign", signed_by="other")
    security = distributed.security.Security(
        require_encryption=True,
        tls_ca_file=str(own.ca),
        **{
            f"tls_{who}_{what}": str(getattr(own, what))
            for who in ("scheduler", "worker", "client")
            for what in ("cert", "key")
        },
    )
    with local_cluster(1, protocol="tls://", security=security) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        with Workers.of_cluster(address, tls=own) as workers:
            assert list(workers.map(pow, [2, 3], [3, 2])) == [8, 9]
        for wrong in (foreign, None):
            with pytest.raises(DataError, match=address):
                Cluster(address, tls=wrong, patience=QUICK)
        gone = TlsFiles(ca=own.ca, cert=own.cert, key=tmp_path / "none.key")
        with pytest.raises(DataError, match=r"none\.key: no such file"):
            Cluster(address, tls=gone, patience=QUICK)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"tls_ca": "a"}, "`run.tls_ca` needs `run.tls_cert` and `run.tls_key`"),
        ({"tls_ca": "a", "tls_cert": "b", "tls_key": "c"}, "needs `run.scheduler` at tls://"),
        (
            {"tls_ca": "a", "tls_cert": "b", "tls_key": "c", "scheduler": "tcp://x"},
            "needs `run.scheduler` at tls://",
        ),
    ],
)
def test_certificates_that_would_be_ignored_are_refused(given, said: str) -> None:
    with pytest.raises(OptionError, match=said):
        RunOptions(**{name: Path(v) if "tls" in name else v for name, v in given.items()})


# Last, as the workers may not be back at once


def test_a_killed_worker_changes_nothing(address, tmp_path) -> None:
    with Workers.of_cluster(address) as workers:
        assert list(workers.map(die_once, [tmp_path] * 6, range(6))) == list(range(6))
    assert (tmp_path / "died").exists()


@pytest.mark.slow
def test_a_task_that_kills_every_worker(address) -> None:
    with (
        Workers.of_cluster(address) as workers,
        pytest.raises(DataError, match=f"{address}: .*workers were lost.*memory"),
    ):
        list(workers.map(die, [0]))
