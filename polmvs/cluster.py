"""Work on a ``dask.distributed`` cluster behind the interface of an executor.

The user provides the cluster: a scheduler and its workers, on any machines that see the same
storage under the same paths and run the same versions. All of this is checked before work starts.
Dask replaces lost workers. If the scheduler is lost, the unfinished tasks are submitted again to
its successor at the same address. Tasks are safe to repeat: each depends on its arguments alone and
writes its files whole.

Dask pickles tasks and results: whoever runs the scheduler or a worker can run code in this program,
and whoever reaches the scheduler can run code on the workers. An address ``tcp://`` is for a
network of trusted machines; with ``tls://`` both sides need certificates.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from ssl import SSLError
from typing import Any

from polmvs._version import __version__
from polmvs.config import RunOptions
from polmvs.errors import DataError, OptionError
from polmvs.threads import keep_to_one_core

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "pycolmap")
SCATTERED_BYTES = 100_000  # size of arguments above which they bypass the scheduler's graph


@dataclass(frozen=True, kw_only=True)
class ClusterPatience:
    """Time limits, in seconds, and numbers of repetitions for a cluster.

    Attributes
    ----------
    connect_s : for the scheduler to answer. A guess.
    workers_s : for the first worker to connect. A guess.
    return_s : for a lost scheduler to return. A guess: longer than a restart by hand.
    max_losses : losses of the scheduler during one map; a guess.
    """

    connect_s: float = 10.0
    workers_s: float = 30.0
    return_s: float = 120.0
    max_losses: int = 5


@dataclass(frozen=True, kw_only=True)
class TlsFiles:
    """Certificates for a scheduler at ``tls://``, PEM files.

    Attributes
    ----------
    ca : certificate that signs all others.
    cert, key : certificate and key of this program.
    """

    ca: Path
    cert: Path
    key: Path

    @classmethod
    def of(cls, options: RunOptions) -> TlsFiles | None:
        """Those of a run; without any, Dask's own configuration is used."""
        if options.tls_ca is None or options.tls_cert is None or options.tls_key is None:
            return None
        return cls(ca=options.tls_ca, cert=options.tls_cert, key=options.tls_key)


class Cluster:
    """A connection to a scheduler.

    Parameters
    ----------
    address : of the scheduler, such as ``tcp://10.0.0.1:8786``.
    storage : folders that every worker must see under the same path; a test file is written there.
    sources : files and folders that every worker must be able to read.
    tls : certificates of an encrypted connection; None for Dask's own configuration.
    patience : time limits.

    Raises
    ------
    OptionError
        ``dask.distributed`` is not installed.
    DataError
        The scheduler does not answer or has no workers, or a worker runs other versions or does
        not see the storage.
    """

    def __init__(
        self,
        address: str,
        storage: Sequence[Path] = (),
        sources: Sequence[Path] = (),
        *,
        tls: TlsFiles | None = None,
        patience: ClusterPatience = ClusterPatience(),
    ) -> None:
        self.address = address
        self.patience = patience
        self._tls = tls
        self._client = _connect(address, tls, patience)
        try:
            self._check_workers()
            for folder in storage:
                self._check_storage(folder)
            self._check_sources(sources)
        except BaseException:
            self._client.close()
            raise
        self._pending: set[Any] = set()

    @property
    def num_threads(self) -> int:
        """Number of tasks that the current workers run at a time."""
        return sum(self._client.nthreads().values())

    def result(
        self,
        function: Callable[..., Any],
        tasks: list[tuple[Any, ...]],
        futures: list[Any],
        index: int,
    ) -> Any:
        """Result of a task; part of the interface of workers.

        Raises
        ------
        DataError
            Several workers died during the task, or the scheduler does not return.
        """
        from distributed import KilledWorker

        for losses in count(1):
            try:
                result = futures[index].result()
                break
            except KilledWorker as error:
                raise DataError(
                    self.address,
                    f"{error.allowed_failures + 1} workers were lost on the same task: out of "
                    "memory? Give each worker more memory or fewer threads.",
                ) from error
            except (CancelledError, OSError, TimeoutError) as error:
                of_task = futures[index].status == "error"
                if of_task or losses > self.patience.max_losses:
                    raise
                self._await_return(error)
                for later in range(index, len(tasks)):
                    if futures[later].status != "finished":
                        futures[later] = self.submit(function, tasks[later])
        self._pending.discard(futures[index])
        futures[index].release()
        tasks[index] = ()  # nothing of it is held for those to come
        return result

    def close(self, *, cancel: bool) -> None:
        """End the connection; the cluster stays."""
        if cancel and self._pending and self._client.status == "running":
            self._client.cancel(list(self._pending), force=True)
        self._pending.clear()
        self._client.close()

    def submit(self, function: Callable[..., Any], task: tuple[Any, ...]) -> Any:
        """Submit a task; large arguments go to the workers, not through the scheduler's graph."""
        import cloudpickle  # comes with Dask; a script's own functions travel whole

        packed = cloudpickle.dumps((function, task))
        payload: Any = packed
        if len(packed) > SCATTERED_BYTES:
            payload = self._client.scatter(packed, hash=False)
        future = self._client.submit(_work, own_versions(), payload, pure=False)
        self._pending.add(future)
        return future

    def _await_return(self, error: BaseException) -> None:
        """Wait for a scheduler at the address and connect again."""
        end = time.monotonic() + self.patience.return_s
        while True:
            try:
                if self._client.status != "running":
                    self._client.close(timeout=1)
                    self._client = _connect(self.address, self._tls, self.patience)
                self._client.wait_for_workers(1, timeout=self.patience.workers_s)
                return
            except (DataError, OSError, TimeoutError):
                if time.monotonic() > end:
                    raise DataError(
                        self.address,
                        "the scheduler or all of its workers were lost and did not come back. "
                        "Start them again and go on with `run.resume`.",
                    ) from error
                time.sleep(1)

    def _check_workers(self) -> None:
        """Every worker has this package, in these versions."""
        try:
            self._client.wait_for_workers(1, timeout=self.patience.workers_s)
        except (TimeoutError, OSError) as error:
            raise DataError(
                self.address, f"has no workers. Start some: dask worker {self.address}"
            ) from error
        mine = own_versions()
        for worker, found in self._on_all(installed_versions, PACKAGES).items():
            for package, wanted in mine.items():
                if found.get(package) != wanted:
                    raise DataError(
                        worker,
                        f"the worker has {package} {found.get(package, 'missing')}, this program "
                        f"{wanted}. Install the same versions there.",
                    )

    def _check_storage(self, folder: Path) -> None:
        """Check that every worker reads files written here and writes files readable here."""
        token = secrets.token_hex(8)
        probe = folder / f".polmvs-probe-{token}.tmp"
        answers: dict[str, Path] = {}
        try:
            probe.write_text(token, encoding="ascii")
            found = self._on_all(_try_storage, str(folder), token)
            answers = {worker: folder / name for worker, name in found.items() if name}
            for worker in found:
                if worker not in answers or not answers[worker].is_file():
                    raise DataError(
                        worker,
                        f"the worker does not share {folder} with this program. Give a folder on "
                        "storage that all workers read and write under the same path.",
                    )
        except OSError as error:
            raise DataError(folder, f"cannot be written: {error.strerror or error}.") from error
        finally:
            for path in (probe, *answers.values()):
                path.unlink(missing_ok=True)

    def _check_sources(self, sources: Sequence[Path]) -> None:
        names = [str(path.absolute()) for path in sources]
        for worker, missing in self._on_all(_missing, names).items():
            if missing:
                raise DataError(
                    missing[0],
                    f"the worker {worker} does not see it. Put it on storage that all workers "
                    "share under the same path.",
                )

    def _on_all(self, function: Callable[..., Any], *arguments: Any) -> Mapping[str, Any]:
        """Result of a function on each worker, by address."""
        try:
            return dict(self._client.run(function, *arguments, on_error="raise"))
        except Exception as error:  # whatever the worker could not load
            text = " ".join(str(error).split()) or type(error).__name__
            raise DataError(
                self.address,
                f"a worker cannot run polmvs {__version__} ({text}). Install it there.",
            ) from error


@lru_cache(maxsize=1)
def own_versions() -> dict[str, str]:
    """Versions on which the result of a task depends."""
    return installed_versions(PACKAGES)


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of this package and of others by name; "unknown" if one is missing."""
    found = {"polmvs": __version__}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def _connect(address: str, tls: TlsFiles | None, patience: ClusterPatience) -> Any:
    try:
        from distributed import Client
        from distributed.comm.addressing import parse_address
        from distributed.comm.registry import get_backend
        from distributed.security import Security
    except ImportError as error:
        raise OptionError(
            "needs dask.distributed: pip install '.[dask]'.", field="run.scheduler"
        ) from error
    security = Security()  # of Dask's own configuration
    if tls is not None:
        for path in (tls.ca, tls.cert, tls.key):
            if not path.is_file():
                raise DataError(path, "no such file; a certificate or key in PEM is expected.")
        security = Security(
            require_encryption=True,
            tls_ca_file=str(tls.ca),
            tls_client_cert=str(tls.cert),
            tls_client_key=str(tls.key),
        )
    try:
        # A client whose constructor raises before it connects leaves its event loop running. If the
        # garbage collector closes it while another client starts, both deadlock.
        scheme, _ = parse_address(address)
        get_backend(scheme)
        if scheme == "tls" and security.get_connection_args("client").get("ssl_context") is None:
            raise DataError(
                address,
                "needs certificates. Give `run.tls_ca`, `run.tls_cert` and `run.tls_key`, or name "
                "them in Dask's configuration.",
            )
        return Client(address, timeout=patience.connect_s, set_as_default=False, security=security)
    except SSLError as error:
        raise DataError(
            address, f"the certificates do not fit: {error.reason or error}. Check `run.tls_ca`."
        ) from error
    except (OSError, TimeoutError, ValueError) as error:
        raise DataError(
            address,
            "no Dask scheduler answers there. Start one ('dask scheduler'), or give its address "
            "as it prints it, such as tcp://10.0.0.1:8786.",
        ) from error


# On the workers


def _work(versions: dict[str, str], packed: bytes) -> Any:
    """Do a task; the versions of a worker that joined later are checked here."""
    import cloudpickle

    if versions != own_versions():
        raise DataError(
            "dask worker", f"has other versions ({own_versions()}) than the program ({versions})."
        )
    keep_to_one_core()  # a worker's thread is one core
    function, task = cloudpickle.loads(packed)
    return function(*task)


def _try_storage(folder: str, token: str) -> str:
    """Name of a file written beside the probe; empty where that is not seen."""
    probe = Path(folder) / f".polmvs-probe-{token}.tmp"
    answer = probe.with_name(f".polmvs-probe-{token}-{secrets.token_hex(8)}.tmp")
    try:
        if probe.read_text(encoding="ascii") != token:
            return ""
        answer.write_text(token, encoding="ascii")
    except OSError:
        return ""
    return answer.name


def _missing(paths: Sequence[str]) -> list[str]:
    return [path for path in paths if not Path(path).exists()]
